"""splits.csv: training, validation and test objects, assigned by the hash of their names.

An object's split follows from its name alone, so that it stays where it is when others are added.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

NAME = "splits.csv"
MIDDLES = {"train": 0.3, "validation": 0.7, "test": 0.9}
"""Of the spans that names are assigned by: 60, 20 and 20 %."""
FEWEST = 3
"""Objects from which on no split is empty."""


def split_objects(names: Iterable[str]) -> dict[str, str]:
    """Assign objects to splits, ``train``, ``validation`` or ``test``, by the SHA-256 of their names; sorted by name.

    From three objects on, an empty split takes the object that lies nearest to it from the largest one.

    >>> split_objects(["icon1", "icon2", "icon3", "icon4", "icon5", "icon6"])["icon1"]
    'test'
    """
    places = {name: _place(name) for name in sorted(names)}
    splits = {
        name: "train" if place < 0.6 else "validation" if place < 0.8 else "test"
        for name, place in places.items()
    }
    if len(places) >= FEWEST:
        for wanted in [s for s in MIDDLES if s not in splits.values()]:
            largest = max(MIDDLES, key=list(splits.values()).count)
            mine = [name for name, split in splits.items() if split == largest]
            splits[min(mine, key=lambda n: (abs(places[n] - MIDDLES[wanted]), n))] = wanted
    return splits


def _place(name: str) -> float:
    """A number from 0 to 1 for a name, evenly spread."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:6], "big") / 2**48

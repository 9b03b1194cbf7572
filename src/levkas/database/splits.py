"""splits.csv: training, validation and test objects, assigned by the hash of their names.

An object's split follows from its name alone, so that it stays where it is when others are added.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

NAME = "splits.csv"
SHARES = {"train": 0.6, "validation": 0.2, "test": 0.2}
FEWEST = 3
"""Objects from which on no split is empty."""


def split_objects(names: Iterable[str]) -> dict[str, str]:
    """Assign objects to splits by the SHA-256 of their names.

    Returns
    -------
    splits : dict
        Name → ``train``, ``validation`` or ``test``, sorted by name. From three objects on, an empty
        split takes the object that lies nearest to it from the largest one.

    Examples
    --------
    >>> split_objects(["icon1", "icon2", "icon3", "icon4", "icon5", "icon6"])["icon1"]
    'test'
    """
    places = {name: _place(name) for name in sorted(names)}
    splits = {name: _split_at(place) for name, place in places.items()}
    if len(places) >= FEWEST:
        for wanted in [s for s in SHARES if s not in splits.values()]:
            largest = max(SHARES, key=list(splits.values()).count)
            low, high = _span(wanted)
            middle = (low + high) / 2
            mine = [name for name, split in splits.items() if split == largest]
            splits[min(mine, key=lambda name: (abs(places[name] - middle), name))] = wanted
    return splits


def _place(name: str) -> float:
    """A number from 0 to 1 for a name, evenly spread."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:6], "big") / 2**48


def _span(split: str) -> tuple[float, float]:
    low = 0.0
    for name, share in SHARES.items():
        if name == split:
            return low, low + share
        low += share
    raise KeyError(split)


def _split_at(place: float) -> str:
    return next((s for s in SHARES if place < _span(s)[1]), "test")

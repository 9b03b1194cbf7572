"""Shares of a layer: how much of what is published was checked, and why the rest was not.

Every share that a person reads is of the layer: the published frame, as far as the reference's frame reaches. What lies
outside the object's outline was not checked, nor what a camera does not show, nor where nothing confirms its map.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Numbers = Mapping[str, Any]
LEAST_OUTSIDE = 0.005
"""Share of the layer from which on it is reported that the outline leaves it out; less is no percent."""


def object_share(numbers: Numbers) -> float:
    """Return the share of the layer that shows the object, 0 … 1; 1 where nothing says."""
    return float(numbers.get("object_share", 1.0))


def overlap_share(numbers: Numbers) -> float:
    """Return the share of the layer in which a camera shows the object, 0 … 1."""
    return object_share(numbers) * float(numbers["overlap"])


def checked_share(numbers: Numbers) -> float:
    """Return the share of the layer where windows or matches confirm a map, 0 … 1.

    >>> round(checked_share({"object_share": 0.8, "overlap": 0.5, "checked": 0.9, "coverage": 1.0}), 2)
    0.36
    """
    confirmed = min(numbers.get("checked", 1.0), max(numbers.get("coverage", 1.0), 0.0))
    return overlap_share(numbers) * float(confirmed)

"""Transforms, pixel maps, grids, and the one resampling."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from levkas.geometry.depth_step import DepthStepShift
from levkas.geometry.spline import SplineShift
from levkas.geometry.transforms import (
    Affine,
    Composed,
    Homography,
    Inverse,
    Lens,
    Polynomial,
    Transform,
)


def from_dict(record: dict[str, Any]) -> Transform:
    """Return the transform that `to_dict` wrote; raises ValueError on an unknown kind."""
    kind = record.get("kind")
    if kind not in KINDS:
        raise ValueError(f"unknown transform kind {kind!r}; known: {', '.join(sorted(KINDS))}")
    return KINDS[kind](record)


def _of_numbers(kind: Callable[..., Transform]) -> Callable[[dict[str, Any]], Transform]:
    """Return what makes a map from its numbers and lists of numbers."""

    def made(record: dict[str, Any]) -> Transform:
        lists = {k: np.array(v, float) if isinstance(v, list) else v for k, v in record.items()}
        return kind(**{k: v for k, v in lists.items() if k != "kind"})

    return made


KINDS: dict[str, Callable[[dict[str, Any]], Transform]] = {
    **{one.__name__.lower(): _of_numbers(one) for one in (Affine, Homography, Polynomial, Lens)},
    "composed": lambda r: Composed(*(from_dict(step) for step in r["steps"])),
    "inverse": lambda r: Inverse(from_dict(r["of"])),
    "spline": SplineShift.from_dict,
    "depth_step": _of_numbers(DepthStepShift),
}

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


def _array(record: dict[str, Any], key: str) -> np.ndarray:
    return np.array(record[key], float)


KINDS: dict[str, Callable[[dict[str, Any]], Transform]] = {
    "affine": lambda r: Affine(_array(r, "matrix")),
    "homography": lambda r: Homography(_array(r, "matrix")),
    "polynomial": lambda r: Polynomial(
        r["order"], _array(r, "centre"), r["spread"], _array(r, "coefficients")
    ),
    "lens": lambda r: Lens(
        _array(r, "centre"), r["spread"], tuple(r["radial"]), tuple(r["tangential"])
    ),
    "composed": lambda r: Composed(*(from_dict(step) for step in r["steps"])),
    "inverse": lambda r: Inverse(from_dict(r["of"])),
    "spline": SplineShift.from_dict,
    "depth_step": lambda r: DepthStepShift(
        _array(r, "lines"), r["width"], _array(r, "centre"), r["spread"], _array(r, "shift")
    ),
}

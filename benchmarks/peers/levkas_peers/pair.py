"""What every peer gets and returns: a pair of grey pictures with a start by scale alone, and a map between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine, invert
from levkas.registration.bands import BandImage, area_average, grey
from levkas.registration.mirhashemi2019 import SensorPicture, scale_only

Map = Callable[[np.ndarray], np.ndarray]
STEP_PX = 0.5
"""Half the base line of a difference, px."""


class NoAnswer(Exception):
    """A pair for which a method finds no map, with the reason."""


@dataclass(frozen=True)
class Answer:
    """The map that a method found: (n, 2) px of the pair's reference → px of its target.

    `note` is its matches kept, final cost, and the like; `decision` is ``"none"`` where a method does not judge
    its own result.
    """

    found: Map
    note: str = ""
    decision: str = "none"


@dataclass(frozen=True, eq=False)
class AnyMap:
    """A function of points as a `Transform`: differentiated by differences, inverted by Newton."""

    function: Map

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self.function(np.asarray(points, float))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2), by differences over a pixel."""
        points = np.asarray(points, float)
        steps = np.eye(2) * STEP_PX
        columns = [(self(points + s) - self(points - s)) / (2 * STEP_PX) for s in steps]
        return np.stack(columns, axis=2)

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back; NaN where Newton does not converge."""
        return invert(self, points, np.asarray(points, float))

    def to_dict(self) -> dict[str, Any]:
        """Refuse: a function cannot be stored."""
        raise NotImplementedError("a map of another program is not stored")


@dataclass(frozen=True)
class Pair:
    """Two grey pictures of one scene at about one sampling.

    Parameters
    ----------
    reference, target : ndarray, (h, w), float32
        Mean of all bands; the reference cut to the object's region, the target area-averaged to the
        sampling of the reference.
    reference_valid, target_valid : ndarray of bool
    start : Affine
        Scale alone, centre upon centre: px of `reference` → px of `target`.
    origin : (x, y)
        Of `reference` in reference px.
    back : Affine
        px of `target` → native px of the target's first sensor.
    """

    reference: np.ndarray
    reference_valid: np.ndarray
    target: np.ndarray
    target_valid: np.ndarray
    start: Affine
    origin: tuple[int, int]
    back: Affine

    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the target on the reference's pixels by `start` alone, and what of it is valid.

        What the intensity-based peers are given; pixels without a value are the mean of the rest.
        """
        filled = np.where(self.target_valid, self.target, np.float32(np.nan))
        values = warp(filled.astype(np.float32), self.start, self.reference.shape).values
        valid = np.isfinite(values)
        level = float(values[valid].mean()) if valid.any() else 0.0
        return np.where(valid, values, np.float32(level)), valid

    def whole(self, found: Map) -> Map:
        """Return a map between the pictures as one from reference px to native px of the target."""
        shift = np.array(self.origin, float)
        return lambda points: self.back(found(np.asarray(points, float) - shift))


def pair_of(
    reference: Sequence[BandImage],
    target: Sequence[BandImage],
    reference_band: str,
    region: Sequence[float] | None = None,
) -> Pair:
    """Return the pair of two cameras; `target` are bands of one sensor."""
    sensor = next(image.sensor for image in reference if image.label == reference_band)
    ours = SensorPicture(*grey([i for i in reference if i.sensor == sensor]))
    theirs = SensorPicture(*grey(target))
    x, y, w, h = _cut(region, ours.size)
    pull = scale_only(ours.size, theirs.size)  # target → reference
    scale = min(1.0, float(pull.matrix[0, 0]))
    values, valid, back = area_average(theirs.values, theirs.valid, scale)
    corners = np.array([[0, 0], [w, 0], [0, h]], float)
    start = Affine.fit(corners, back.inverse(pull.inverse(corners + np.array([x, y]))))
    box = np.s_[y : y + h, x : x + w]
    return Pair(
        np.ascontiguousarray(ours.values[box], np.float32),
        np.ascontiguousarray(ours.valid[box]),
        np.ascontiguousarray(values, np.float32),
        np.ascontiguousarray(valid),
        start,
        (x, y),
        back,
    )


def _cut(region: Sequence[float] | None, size: tuple[int, int]) -> tuple[int, int, int, int]:
    x, y, w, h = (round(float(v)) for v in region or (0, 0, *size))
    left, top = min(max(x, 0), size[0] - 1), min(max(y, 0), size[1] - 1)
    return left, top, min(x + w, size[0]) - left, min(y + h, size[1]) - top

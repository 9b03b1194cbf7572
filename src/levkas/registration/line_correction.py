"""Correction of displaced lines: where every line of a scan lies, as a spline along the scan, and the map that puts lines right.

x and y of a line that was exposed at once are functions of the line alone, and of the place along it, linearly, where lines turn or
stretch. Splines are fitted to the inner parts of all lines and have to predict the outer ones, and the other way round ([roberts2017]_):
knots are as dense as the data show.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.linalg import solveh_banded

from levkas.geometry.resample import warp
from levkas.geometry.spline import SplineShift, spline_weights
from levkas.registration.line_displacement import legendre

if TYPE_CHECKING:
    from collections.abc import Mapping

    from levkas.registration.line_displacement import LineDisplacement, LineShifts

SPACINGS = (512, 256, 128, 64, 32, 16, 8, 4, 3, 2, 1)
"""Of knots, lines apart: at 1 every line lies by itself."""
CLOSEST = (1, 3)
"""Of them, along and across the lines: between lines that stand at odd distances nothing can be interpolated."""
LEAST_KNOWN = 0.2
"""Information of a line over that of the median line; of less, at the rim, a spline goes astray."""
ROUNDS, STRAY = 4, 4.0
"""Of re-weighting; in typical deviations, the median of all: so far out a line has half its weight."""
AT_ONCE = 8
"""Pictures that are put right together: the map of their pixels is evaluated once."""
NEAREST = 0.2
"""Distance of neighbouring lines, px, from which on they still follow one another."""
GAIN = 0.995
"""A richer spline has to lower the squares of what it misses in the parts left out to this share; 0.98 leaves up to 0.02 px more."""
STIFFNESS = 1e-5
"""Of second differences, as a share of the mean weight of a knot: takes 0.1 % of the distance of odd and even lines."""


@dataclass(frozen=True, eq=False)
class LineCorrection:
    """Where the lines of a picture lie in the picture put right."""

    lines: Literal["rows", "columns"]
    shift: np.ndarray
    slope: np.ndarray
    """`shift`, `slope`: (lines, 2), px. How far the middle of each line lies along and across, and how much farther its end does."""
    ends: tuple[float, float]
    """In px: places along the lines at which `slope` is subtracted, and added."""
    spacing: float
    """In lines: of the densest knots."""
    error: float
    """In px: standard error of the course, root mean square of both axes, by how much inner and outer parts disagree."""
    scale: float
    """Px of the picture per reference px."""
    before: LineDisplacement
    """As it was measured before anything was put right."""

    @property
    def uneven(self) -> float:
        """Root mean square of half of how far a line lies from the middle of its neighbours, reference px: a place between two shows both."""
        middle, end = (np.diff(part, n=2, axis=0) / 4 for part in (self.shift, self.slope))
        return float(np.sqrt((middle**2 + end**2 / 3).sum(1).mean())) / self.scale

    @property
    def sigma(self) -> float:
        """Standard deviation, of each axis, that it adds to where a place lies, reference px."""
        return float(np.hypot(self.error / self.scale, self.uneven)) / 2**0.5

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, JSON-ready, without the displacement of every line."""
        return {
            "error_px": round(self.error / self.scale, 4),
            "uneven_px": round(self.uneven, 4),
            "before": self.before.to_dict(),
        }

    def transform(self) -> SplineShift:
        """Return px of the picture put right → px of the picture."""
        number = np.arange(len(self.shift), dtype=float)
        lie = number + self.shift[:, 1]
        spacing = max(1.0, self.spacing / 2)
        first, last = float(min(lie.min(), 0.0)), float(max(lie.max(), number[-1]))
        count = int(np.ceil((last - first) / spacing)) + 3
        middle, end = (
            np.stack([_fit((lie - first) / spacing, -v, np.ones(len(v)), count) for v in part.T], 1)
            for part in (self.shift, self.slope)
        )
        # A cubic spline through values that grow evenly is a straight line, and goes on as one.
        centre, half = sum(self.ends) / 2, (self.ends[1] - self.ends[0]) / 2
        steps = (np.arange(4) - 1)[None, :, None] * spacing / half
        lattice, origin = middle[:, None] + steps * end[:, None], np.array([centre, first])
        if self.lines == "columns":
            lattice, origin = lattice.transpose(1, 0, 2)[..., ::-1], origin[::-1]
        return SplineShift(origin, spacing, np.round(lattice, 5))

    def put_right(self, images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return pictures, (h, w) float32, NaN where invalid, with their lines where they belong."""
        every, transform = list(images), self.transform()
        found: dict[str, np.ndarray] = {}
        for start in range(0, len(every), AT_ONCE):
            names = every[start : start + AT_ONCE]
            cube = np.stack([images[name] for name in names], -1)
            moved = warp(cube, transform, (cube.shape[0], cube.shape[1])).values
            found.update(zip(names, np.ascontiguousarray(moved.transpose(2, 0, 1)), strict=True))
        return found

    def followed_by(self, rest: LineCorrection) -> LineCorrection:
        """Return this correction and another one, found in the picture that this one put right, as one."""
        number = np.arange(len(self.shift), dtype=float)
        lie = number + self.shift[:, 1]
        shift, slope = (
            np.stack([np.interp(lie, number, v) for v in values.T], 1)
            for values in (rest.shift, rest.slope)
        )
        return replace(
            rest, shift=self.shift + shift, slope=self.slope + slope, before=self.before,
            spacing=min(self.spacing, rest.spacing), error=max(self.error, rest.error),
        )  # fmt: skip


def find_correction(found: LineDisplacement, scale: float) -> LineCorrection | None:
    """Return the correction of displaced lines, `scale` px a reference px; None where no spline predicts parts left out, or lines would change order."""
    course = {of_ends: np.zeros_like(found.displacement) for of_ends in (False, True)}
    errors, spacings = [0.0], [np.inf]
    for of_ends in found.of_ends:
        shifts = found.parts.slopes() if of_ends else found.parts
        outer = np.isin(np.arange(shifts.shift.shape[1]), (0, 3))
        outer = outer if outer.sum() > 1 else np.arange(len(outer)) == 0
        for axis in (0, 1):
            halves = [_mean(shifts, part, axis) for part in (outer, ~outer)]
            spacing, error = _choose_spacing(halves, CLOSEST[axis])
            if np.isfinite(spacing):
                whole = _mean(shifts, np.ones_like(outer), axis)
                course[of_ends][:, axis] = _evaluate(*whole, spacing)
            spacings.append(spacing)
            errors.append(error * shifts.spread)
    spacing, shift = min(spacings), course[False]
    if not np.isfinite(spacing) or np.diff(shift[:, 1]).min() < NEAREST - 1:
        return None
    error = float(np.linalg.norm(errors))
    return LineCorrection(
        found.lines, shift, course[True], found.parts.ends, spacing, error, scale, found
    )


def _choose_spacing(
    halves: list[tuple[np.ndarray, np.ndarray]], closest: int
) -> tuple[float, float]:
    """Return which spacing predicts the other half of the parts best, infinite of none, and the standard error of that spline."""
    weight, totals = halves[0][1] + halves[1][1], [float(w.sum()) for _, w in halves]
    if not min(totals) > 0:
        return np.inf, 0.0
    # Two halves apart by d have a weighted mean of variance d² w₁ w₂ / (w₁ + w₂)²; maps follow a cubic along the scan.
    share = np.sqrt(np.prod(totals)) / sum(totals)
    basis = legendre(len(weight))
    best, error, least = np.inf, 0.0, sum(float(w @ np.square(y)) for y, w in halves)
    for spacing in SPACINGS:
        if 4 * spacing > len(weight) or spacing < closest:
            continue
        one, other = (_evaluate(*half, spacing) for half in halves)
        missed = sum(
            float(w @ np.square(y - fit)) for (y, w), fit in zip(halves, (other, one), strict=True)
        )
        if missed < GAIN * least:
            cubic = np.linalg.solve(
                basis.T @ (weight[:, None] * basis), basis.T @ (weight * (one - other))
            )
            apart = one - other - basis @ cubic
            error = share * np.sqrt(float(weight @ np.square(apart) / weight.sum()))
            best, least = float(spacing), missed
    return best, error


def _mean(shifts: LineShifts, parts: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean shift of some parts of each line, (lines,) px, and its weight."""
    weight = shifts.weight[:, parts, axis]
    total = weight.sum(1)
    mean = (weight * shifts.shift[:, parts, axis]).sum(1) / np.where(total > 0, total, 1.0)
    if total.any():
        sure = np.flatnonzero(total > LEAST_KNOWN * np.median(total[total > 0]))
        total[: sure[0]] = total[sure[-1] + 1 :] = 0.0
    return mean, total


def _evaluate(values: np.ndarray, weight: np.ndarray, spacing: float) -> np.ndarray:
    """Return a spline fitted to values of all lines, (lines,), at each line; beyond what was measured it stays as it is there."""
    place = np.arange(len(values)) / spacing
    count = int(np.ceil(place[-1])) + 3
    first = np.clip(place.astype(int), 0, count - 4)
    robust = weight
    for _ in range(ROUNDS):
        knots = _fit(place, values, robust, count)
        course = (spline_weights(place - first) * knots[first[:, None] + np.arange(4)]).sum(1)
        square = weight * np.square(values - course)
        robust = weight / (1 + square / (STRAY**2 * float(np.median(square[weight > 0])) + 1e-9))
    low, high = np.flatnonzero(weight > 0)[[0, -1]]
    near = int(np.ceil(4 / spacing))  # of single lines a few: the next one need not lie as the last
    course[:low] = course[low : low + near].mean()
    course[high + 1 :] = course[high + 1 - near : high + 1].mean()
    return np.asarray(course)


def _fit(place: np.ndarray, values: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """Return the knots, (count,), of a cubic spline by weighted least squares; places, (n,), are in spacings."""
    first = np.clip(place.astype(int), 0, count - 4)
    basis = spline_weights(place - first)
    normal, right = np.zeros((4, count)), np.zeros(count)
    for i in range(4):
        right += np.bincount(first + i, weight * basis[:, i] * values, count)
        for k in range(4 - i):
            normal[k] += np.bincount(first + i, weight * basis[:, i] * basis[:, i + k], count)
    stiff = STIFFNESS * weight.sum() / count
    bend = (1, -2, 1)
    for i in range(3):
        for k in range(3 - i):
            normal[k, i : count - 2 + i] += stiff * bend[i] * bend[i + k]
    normal[0] += 1e-9 * stiff
    return np.asarray(solveh_banded(normal, right, lower=True))

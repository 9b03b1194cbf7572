"""Overlap of two tiles: where they show the same, window by window, to hundredths of a pixel, and whether they do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration.local_shifts import (
    CELL_PX,
    Predictor,
    WindowShifts,
    detail_on_grid,
    highpass,
    picture_on_grid,
)
from levkas.registration.models import (
    Observations,
    fit_polynomial,
    fit_similarity,
    scale_covariance,
)

#: Reductions at which windows are compared, coarse first; rounds at each, at most; change, px, at which one ends.
STEPS, ROUNDS, CONVERGED_PX = (8, 4, 2, 1), 5, 0.005
#: Shift that windows find, px of a step.
CAPTURE_PX = 1.5
#: Least share of a window's variance that the other tile explains, whatever chance gives; percentile of chance.
LEAST_R2, CHANCE_PERCENT = 0.15, 95.0
#: Cells by which an overlap is displaced to find what chance gives.
ASIDE_CELLS = (3, 4)
#: Windows that have to agree, each 3 x 3 cells; and their share of those that have detail.
LEAST_WINDOWS, LEAST_SHARE = 6, 0.25
#: Windows, and cells across the narrow side, from which on a polynomial of an order maps them; fewer are turned and scaled.
RICHEST = {1: (12, 1.5), 2: (30, 2.5), 3: (80, 3.5)}
#: Distance from their common map up to which windows agree: times the median, and px at least.
AGREE, AGREE_PX = 4.0, 0.25
#: Narrowest overlap, px, in which windows can be laid.
NARROWEST = 14
#: Windows of an overlap that are handed on: those of a cell of a coarser lattice are averaged.
MOST_KEPT = 64
#: Cells that share px of one window.
SHARED_CELLS = 9.0
#: Variance of detail at half the sampling, of that at all of it, below which it is noise: smoothed white noise has about 0.6, paint more.
LEAST_DETAIL = 0.78


@dataclass(frozen=True)
class OverlapWindows:
    """What two tiles show both."""

    points: np.ndarray
    partners: np.ndarray
    """`points`, `partners`: (n, 2), px of the first and of the second tile. Where both have a window; means of neighbours."""
    information: np.ndarray
    """(n, 2, 2), 1/px²."""
    windows: int
    """That agree."""
    share: float
    """0..1. Of the first tile's area."""
    transform: Transform
    """Px of the first → px of the second tile, within the overlap."""
    rms: float
    """In px: of the windows about `transform`."""
    explained: float
    """0..1. Share of the detail that the other tile explains, the median."""


@dataclass(frozen=True)
class NoOverlap:
    """Why two tiles are not joined."""

    reason: str
    """``"apart"``: they do not touch; ``"no detail"``: what they share shows none; ``"unlike"``: they show different things."""


def measure_overlap(
    first: np.ndarray, second: np.ndarray, begin: Transform, *, reach: float = 4.0
) -> OverlapWindows | NoOverlap:
    """Measure where two tiles, (h, w) float32, NaN where invalid, show the same.

    `begin` goes px of the first → px of the second, and may be wrong by `reach` px. Windows are those of [baker2004]_ with gain, bias and
    ramp, three cells wide, doi:10.1023/B:VISI.0000011205.11775.fd; chance is what they reach where one tile is displaced by some cells.
    """
    transform, pictures = begin, (first, second)
    for step in (one for one in STEPS if one == 1 or one * CAPTURE_PX < 2 * reach):
        for _ in range(ROUNDS):
            place = _Place.of(transform, first.shape, second.shape)
            if place is None:
                return NoOverlap("apart")
            compared = place.compare(pictures, transform, step)
            if compared is None:
                break
            before, transform = transform, compared.fitted(transform)
            if place.change(before, transform) < CONVERGED_PX * step:
                break
    place = _Place.of(transform, first.shape, second.shape)
    compared = None if place is None else place.compare(pictures, transform, 1)
    if place is None or compared is None:
        return NoOverlap("apart")
    return _judged(compared, transform, place, pictures)


@dataclass(frozen=True)
class _Compared:
    """Windows of an overlap: places in the first tile, shifts, information, and what is explained."""

    found: WindowShifts
    observations: Observations
    """With the information of their own px."""
    step: int
    cell: float

    @cached_property
    def usable(self) -> np.ndarray:
        """Windows with detail that lie within the capture range."""
        has_detail = np.trace(self.found.information, axis1=1, axis2=2) > 0
        near = np.abs(self.found.shift).max(1) < 3 * CAPTURE_PX * self.step
        return np.asarray(has_detail & near)

    def fitted(self, transform: Transform) -> Transform:
        """Return the map of windows, as rich as they determine it in both directions; the one before where they are too few."""
        windows = self.observations.part(self.usable & (self.found.r2 > LEAST_R2))
        if len(windows) < 4:
            return transform
        wide = np.ptp(windows.points, axis=0).min() / self.cell
        orders = (n for n, (least, w) in RICHEST.items() if len(windows) >= least and wide >= w)
        order, weighted = max(orders, default=0), windows
        for _ in range(6):
            transform = fit_polynomial(weighted, order) if order else fit_similarity(weighted)
            information, weights = scale_covariance(
                windows.residuals(transform), windows.information
            )
            weighted = Observations(
                *(windows.points, windows.target, windows.jacobian),
                information * weights[:, None, None],
            )
        return transform


@dataclass(frozen=True)
class _Place:
    """The box of the first tile, px, in which the second one lies."""

    left: int
    top: int
    width: int
    height: int
    share: float

    @classmethod
    def of(
        cls, transform: Transform, shape: tuple[int, ...], other: tuple[int, ...]
    ) -> _Place | None:
        x, y = (np.linspace(0, n - 1, min(n, 129)) for n in shape[::-1])
        with np.errstate(all="ignore"):
            there = transform(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
            inside = (there >= -0.5).all(1) & (there <= np.array(other[::-1]) - 0.5).all(1)
        inside = inside.reshape(len(y), len(x))
        if not inside.any():
            return None
        columns, rows = x[inside.any(0)], y[inside.any(1)]
        left, top = int(columns[0]), int(rows[0])
        width, height = (int(np.ceil(n[-1])) - int(n[0]) + 1 for n in (columns, rows))
        if min(width, height) < NARROWEST:
            return None
        return cls(left, top, width, height, float(inside.mean()))

    @property
    def corner(self) -> Affine:
        """Px of the box → px of the first tile."""
        return Affine.of_box(self.left, self.top)

    def cell(self, step: int) -> int:
        """Side of a cell, px of the step: an overlap that is narrow has small ones."""
        return int(np.clip(min(self.width, self.height) // (4 * step), 4, CELL_PX))

    def compare(
        self, pictures: Sequence[np.ndarray], transform: Transform, step: int
    ) -> _Compared | None:
        """Compare windows of both tiles; None where the overlap is too small for any at that step."""
        shape = self.height // step, self.width // step
        if min(shape) < NARROWEST:
            return None
        maps: tuple[Transform, ...] = (self.corner, Composed(self.corner, transform))
        one, two = (
            picture_on_grid(p, m, shape, step=step) for p, m in zip(pictures, maps, strict=True)
        )
        # Where both are: a local mean that reaches farther in one than in the other would move it.
        missing = np.isnan(one) | np.isnan(two)
        one[missing] = two[missing] = np.nan
        cell = self.cell(step)
        predictor = Predictor(highpass(one)[None], step=float(step), cell=cell)
        found = predictor.compare(highpass(two))
        points = self.corner(found.centres)
        with np.errstate(all="ignore"):
            partners, jacobian = transform(points), transform.jacobian(points)
        windows = Observations(
            points + found.shift, partners, jacobian, found.information / SHARED_CELLS
        )
        return _Compared(found, windows, step, float(cell * step))

    def chance(self, pictures: Sequence[np.ndarray], transform: Transform) -> float:
        """Return the share of variance that windows reach which show different things."""
        shares = []
        for across, down in (ASIDE_CELLS, ASIDE_CELLS[::-1]):
            aside = Affine.of_box(self.cell(1) * across, -self.cell(1) * down)
            found = self.compare(pictures, Composed(aside, transform), 1)
            if found is not None and found.usable.any():
                shares.append(found.found.r2[found.usable])
        return float(np.percentile(np.concatenate(shares), CHANCE_PERCENT)) if shares else 0.0

    def change(self, before: Transform, after: Transform) -> float:
        """Return by how much two maps differ in the box, px."""
        x, y = (np.linspace(0, n - 1, 5) for n in (self.width, self.height))
        points = self.corner(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
        return float(np.median(np.abs(after(points) - before(points)).max(1)))

    def is_plain(self, pictures: Sequence[np.ndarray], transform: Transform) -> bool:
        """Whether what is shared shows no detail but noise: at half the sampling as much less as noise has."""
        maps: tuple[Transform, ...] = (self.corner, Composed(self.corner, transform))
        for picture, onto in zip(pictures, maps, strict=True):
            powers = []
            for step in (1, 2):
                shape = self.height // step, self.width // step
                detail = detail_on_grid(picture, onto, shape, step=step)
                powers.append(float(np.nanvar(detail)) if np.isfinite(detail).any() else 0.0)
            if powers[1] < LEAST_DETAIL * powers[0]:
                return True
        return False


def _judged(
    compared: _Compared, transform: Transform, place: _Place, pictures: Sequence[np.ndarray]
) -> OverlapWindows | NoOverlap:
    """Return the overlap if more windows agree than chance gives."""
    usable = compared.usable
    if not usable.any():
        return NoOverlap("no detail" if place.is_plain(pictures, transform) else "apart")
    threshold = max(LEAST_R2, place.chance(pictures, transform))
    good = usable & (compared.found.r2 > threshold)
    windows = compared.observations.part(good)
    if len(windows) < max(LEAST_WINDOWS, LEAST_SHARE * usable.sum()):
        return NoOverlap("no detail" if place.is_plain(pictures, transform) else "unlike")
    miss = np.linalg.norm(windows.residuals(transform), axis=1)
    windows = windows.part(miss <= max(AGREE * float(np.median(miss)), AGREE_PX))
    if len(windows) < LEAST_WINDOWS or np.median(miss) > CAPTURE_PX / 2:
        return NoOverlap("unlike")
    return OverlapWindows(
        *_merged(windows, compared.cell),
        len(windows),
        place.share,
        transform,
        float(np.sqrt(np.mean(windows.residuals(transform) ** 2))),
        float(np.median(compared.found.r2[good])),
    )


def _merged(windows: Observations, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, partners and information of neighbouring windows together, at most about `MOST_KEPT`."""
    extent = np.ptp(windows.points, axis=0) + cell
    side = max(3 * cell, float(np.sqrt(extent.prod() / MOST_KEPT)))
    place = np.floor((windows.points - windows.points.min(0)) / side).astype(int)
    kept, group = np.unique(place, axis=0, return_inverse=True)

    def total(values: np.ndarray) -> np.ndarray:
        sums = np.zeros((len(kept), *values.shape[1:]))
        np.add.at(sums, group.ravel(), values)
        return sums

    weight = np.trace(windows.information, axis1=1, axis2=2)[:, None]
    means = (total(values * weight) / total(weight) for values in (windows.points, windows.target))
    return *means, total(windows.information)

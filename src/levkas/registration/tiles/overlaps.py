"""Overlap of two tiles: where they show the same, window by window, to hundredths of a pixel, and whether they do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

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
#: Windows that reach beyond the capture range at a step, px of that step.
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
#: Sub-windows of detail: a tile's detail over that of its noise below which there is none.
LEAST_DETAIL = 1.3


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
    """Measure where two tiles show the same.

    Parameters
    ----------
    first, second : ndarray, (h, w), float32
        Detail of either tile, NaN where invalid.
    begin : Transform
        Px of the first → px of the second.
    reach : float, px
        By which it may be wrong.

    Returns
    -------
    overlap : OverlapWindows or NoOverlap

    Notes
    -----
    Windows are those of [baker2004]_ with gain, bias and ramp, three cells wide, doi:10.1023/B:VISI.0000011205.11775.fd; chance is what they reach
    where one tile is displaced by some cells.
    """
    transform, compared = begin, None
    for step in _steps(reach):
        for _ in range(ROUNDS):
            place = _Place.of(transform, first.shape, second.shape)
            if place is None:
                return NoOverlap("apart")
            compared = place.compare(first, second, transform, step)
            if compared is None:
                break
            before, transform = transform, _fitted(compared, transform, place)
            if _moved(before, transform, place) < CONVERGED_PX * step:
                break
    place = _Place.of(transform, first.shape, second.shape)
    compared = None if place is None else place.compare(first, second, transform, 1)
    if place is None or compared is None:
        return NoOverlap("apart")
    return _judged(compared, transform, place, (first, second))


def _steps(reach: float) -> Iterator[int]:
    yield from (step for step in STEPS if step == 1 or step * CAPTURE_PX < 2 * reach)


@dataclass(frozen=True)
class _Compared:
    """Windows of an overlap: places in the first tile, shifts, information, and what is explained."""

    found: WindowShifts
    points: np.ndarray
    partners: np.ndarray
    jacobian: np.ndarray
    step: int
    cell: float

    @property
    def usable(self) -> np.ndarray:
        trace = np.trace(self.found.information, axis1=1, axis2=2)
        return np.asarray(
            (trace > 0) & (np.abs(self.found.shift).max(1) < 3 * CAPTURE_PX * self.step)
        )

    def observations(self, mask: np.ndarray) -> Observations:
        """Return the windows of `mask` with the information of their own px."""
        return Observations(
            self.points[mask],
            self.partners[mask],
            self.jacobian[mask],
            self.found.information[mask] / SHARED_CELLS,
        )


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
        h, w = shape
        x, y = np.linspace(0, w - 1, min(w, 129)), np.linspace(0, h - 1, min(h, 129))
        with np.errstate(all="ignore"):
            there = transform(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
            inside = (there >= -0.5).all(1) & (there <= np.array(other[::-1]) - 0.5).all(1)
        inside = inside.reshape(len(y), len(x))
        if not inside.any():
            return None
        columns, rows = (np.flatnonzero(inside.any(axis)) for axis in (0, 1))
        left, right = int(x[columns[0]]), int(np.ceil(x[columns[-1]]))
        top, bottom = int(y[rows[0]]), int(np.ceil(y[rows[-1]]))
        if min(right - left, bottom - top) + 1 < NARROWEST:
            return None
        return cls(left, top, right - left + 1, bottom - top + 1, float(inside.mean()))

    def cell(self, step: int) -> int:
        """Side of a cell, px of the step: an overlap that is narrow has small ones."""
        return int(np.clip(min(self.width, self.height) // (4 * step), 4, CELL_PX))

    def compare(
        self, first: np.ndarray, second: np.ndarray, transform: Transform, step: int
    ) -> _Compared | None:
        """Compare windows of both tiles; None where the overlap is too small for any at that step."""
        shape = self.height // step, self.width // step
        if min(shape) < NARROWEST:
            return None
        corner = Affine(np.array([[1.0, 0, self.left], [0, 1, self.top]]))
        onto = Composed(corner, transform)
        one, two = _details((first, second), (corner, onto), shape, step)
        cell = self.cell(step)
        found = Predictor(one[None], step=float(step), cell=cell).compare(two)
        points = corner(found.centres)
        with np.errstate(all="ignore"):
            partners, jacobian = transform(points), transform.jacobian(points)
        return _Compared(found, points + found.shift, partners, jacobian, step, float(cell * step))

    def chance(self, first: np.ndarray, second: np.ndarray, transform: Transform) -> float:
        """Return the share of variance that windows reach which show different things."""
        shares = []
        for across, down in (ASIDE_CELLS, ASIDE_CELLS[::-1]):
            aside = self.cell(1) * np.array([across, -down])
            moved = Composed(Affine(np.array([[1.0, 0, aside[0]], [0, 1, aside[1]]])), transform)
            found = self.compare(first, second, moved, 1)
            if found is not None and found.usable.any():
                shares.append(found.found.r2[found.usable])
        return float(np.percentile(np.concatenate(shares), CHANCE_PERCENT)) if shares else 0.0


def _details(
    pictures: Sequence[np.ndarray], maps: Sequence[Transform], shape: tuple[int, int], step: int
) -> list[np.ndarray]:
    """Return the detail of pictures where all of them are: a mean that reaches farther in one than in another would move it."""
    found = [picture_on_grid(p, m, shape, step=step) for p, m in zip(pictures, maps, strict=True)]
    missing = np.any(np.isnan(found), axis=0)
    for picture in found:
        picture[missing] = np.nan
    return [highpass(picture) for picture in found]


def _good(compared: _Compared, least: float = LEAST_R2) -> np.ndarray:
    return np.asarray(compared.usable & (compared.found.r2 > least))


def _fitted(compared: _Compared, transform: Transform, place: _Place) -> Transform:
    """Return the map of windows, as rich as they determine it in both directions; the one before where they are too few."""
    good = _good(compared)
    if good.sum() < 3:
        return transform
    return _robust_map(compared.observations(good), compared.cell, transform)


def _robust_map(windows: Observations, cell: float, transform: Transform) -> Transform:
    observations, extent = windows, np.ptp(windows.points, axis=0).min() / cell
    for _ in range(6):
        order = max(
            (n for n, (most, wide) in RICHEST.items() if len(windows) >= most and extent >= wide),
            default=0,
        )
        if order:
            transform = fit_polynomial(observations, order)
        elif len(windows) >= 4:
            transform = fit_similarity(observations)
        else:
            break
        information, weights = scale_covariance(windows.residuals(transform), windows.information)
        observations = Observations(
            windows.points, windows.target, windows.jacobian, information * weights[:, None, None]
        )
    return transform


def _moved(before: Transform, after: Transform, place: _Place) -> float:
    x, y = np.meshgrid(
        place.left + np.linspace(0, place.width - 1, 5),
        place.top + np.linspace(0, place.height - 1, 5),
    )
    points = np.stack([x.ravel(), y.ravel()], 1)
    return float(np.median(np.abs(after(points) - before(points)).max(1)))


def _judged(
    compared: _Compared,
    transform: Transform,
    place: _Place,
    pictures: tuple[np.ndarray, np.ndarray],
) -> OverlapWindows | NoOverlap:
    """Return the overlap if more windows agree than chance gives."""
    usable = compared.usable
    if not usable.any():
        return NoOverlap("no detail" if _is_plain(place, pictures, transform) else "apart")
    threshold = max(LEAST_R2, place.chance(*pictures, transform))
    good = _good(compared, threshold)
    windows = compared.observations(good)
    if len(windows) < LEAST_WINDOWS or good.sum() < LEAST_SHARE * usable.sum():
        plain = _is_plain(place, pictures, transform)
        return NoOverlap("no detail" if plain else "unlike")
    miss = np.linalg.norm(windows.residuals(transform), axis=1)
    agreeing = miss <= max(AGREE * float(np.median(miss)), AGREE_PX)
    windows = windows.part(agreeing)
    if len(windows) < LEAST_WINDOWS or np.median(miss) > CAPTURE_PX / 2:
        return NoOverlap("unlike")
    residual = windows.residuals(transform)
    merged = _merged(windows, compared.cell)
    return OverlapWindows(
        merged.points,
        merged.target,
        merged.information,
        len(windows),
        place.share,
        transform,
        float(np.sqrt(np.mean(residual**2))),
        float(np.median(compared.found.r2[good])),
    )


def _is_plain(place: _Place, pictures: tuple[np.ndarray, np.ndarray], transform: Transform) -> bool:
    """Whether what is shared shows no detail but noise: at half the sampling as much less as noise has."""
    corner = Affine(np.array([[1.0, 0, place.left], [0, 1, place.top]]))
    maps: tuple[Transform, ...] = (corner, Composed(corner, transform))
    for picture, onto in zip(pictures, maps, strict=True):
        powers = []
        for step in (1, 2):
            shape = place.height // step, place.width // step
            detail = detail_on_grid(picture, onto, shape, step=step)
            known = detail[np.isfinite(detail)]
            powers.append(float(np.var(known)) if known.size else 0.0)
        # White noise, smoothed by one spline: means of 2 x 2 px have about 0.6 of its variance; paint has more.
        if powers[1] < LEAST_DETAIL * 0.6 * powers[0]:
            return True
    return False


def _merged(windows: Observations, cell: float) -> Observations:
    """Return the means of neighbouring windows by their information, at most about `MOST_KEPT`."""
    extent = np.ptp(windows.points, axis=0) + cell
    side = max(3 * cell, float(np.sqrt(extent.prod() / MOST_KEPT)))
    place = np.floor((windows.points - windows.points.min(0)) / side).astype(int)
    _, group = np.unique(place, axis=0, return_inverse=True)
    order = np.argsort(group.ravel(), kind="stable")
    starts = np.flatnonzero(np.diff(group.ravel()[order], prepend=-1))
    weight = np.trace(windows.information, axis1=1, axis2=2)[order]

    def mean(values: np.ndarray) -> np.ndarray:
        shape = (-1,) + (1,) * (values.ndim - 1)
        total = np.add.reduceat(values[order] * weight.reshape(shape), starts)
        return np.asarray(total / np.add.reduceat(weight, starts).reshape(shape))

    return Observations(
        mean(windows.points),
        mean(windows.target),
        mean(windows.jacobian),
        np.add.reduceat(windows.information[order], starts),
    )

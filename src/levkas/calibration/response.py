"""Response of a sensor that is not linear, estimated from exposures of one still scene.

Light is a polynomial through 0 of the counts y above dark, x = y·(1 + Σ aₖ (y/full)ᵏ), whose slope in
the dark is 1. Groups g of pixels of like brightness have x = C(g)·t at every exposure t. Where
exposures have other times than they state, all levels of one are off by one factor; a curve is
off by level, at whatever exposure. Which of them the counts show is decided by what is left.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from levkas.calibration.linearity import RECIPROCAL, Point
from levkas.calibration.templates import Template

CURVED = 0.003  # rms from a line, relative, from which on a curve is looked for: reflectance may be off by as much
STRAIGHT = 0.005  # rms that a curve may leave
BETTER = 0.7  # of the rms that the best other explanation leaves
SURE = 0.003  # relative error of the curve, at most
TERMS = (1, 2)  # of the polynomial
ALIKE = 1.15  # contrast of the pixels of a group whose mean is a point of a curve
FEWEST_LEVELS = 8  # points for each parameter
MOST_WEIGHT = 0.1  # of all pixels, that a group may count for
OUTLIER = 4.0  # usual deviations from a curve, from which on a group moved
STILL = 0.85  # share of the pixels that did not, at least
LEAST = 1e-4  # relative: deviations below it are alike
ROUNDS = 20


@dataclass(frozen=True)
class Response:
    """A curve from counts to light.

    Parameters
    ----------
    terms : tuple of float
        a₁, a₂, …
    full : float
        Counts above dark that they belong to.
    error : float
        Largest standard error of the light at the levels of the series, relative.
    rms_line, rms : float
        Deviation of the series from a line, and from the curve, relative.

    Examples
    --------
    A sensor that loses 6 % at its end, where 940 counts are 1,000:

    >>> bent = Response((0.0638,), 940.0, 1e-3, 0.02, 1e-3)
    >>> bent.light(np.array([0.0, 940.0])).round().tolist()
    [0.0, 1000.0]
    """

    terms: tuple[float, ...]
    full: float
    error: float
    rms_line: float
    rms: float

    def light(self, counts: np.ndarray) -> np.ndarray:
        """Return the light, in counts of a linear sensor, of counts above dark."""
        share = np.clip(counts / self.full, 0.0, 1.0)
        return np.asarray(counts * (1 + sum(a * share**k for k, a in enumerate(self.terms, 1))))

    def slope(self, counts: np.ndarray) -> np.ndarray:
        """Return the change of light with counts."""
        share = np.clip(counts / self.full, 0.0, 1.0)
        more = sum((k + 1) * a * share**k for k, a in enumerate(self.terms, 1))
        return np.asarray(1 + more)

    def straighten(self, frame: Template, level: np.ndarray | float) -> Template:
        """Return a template as a linear sensor had recorded it; `level` are its counts without light."""
        above = frame.mean - level
        mean = (level + self.light(above)).astype(np.float32)
        variance = frame.variance
        if variance is not None:
            variance = (variance * self.slope(above) ** 2).astype(np.float32)
        return replace(frame, mean=mean, variance=variance)


def find_response(points: Sequence[Point], full: float) -> Response | None:
    """Return the curve that an exposure series shows; None where it is a line, or no curve explains what is left.

    Parameters
    ----------
    points : sequence of Point
        Of one or more series of one sensor, from `linearity.find_points` with the contrast `ALIKE`; groups numbered apart.
    full : float
        Full scale above dark, counts.

    Examples
    --------
    >>> rows = [Point(g, t, g * t - 0.06 * (g * t) ** 2 / 4000) for g in range(300, 1500, 20) for t in (1.0, 2.0)]
    >>> found = find_response(rows, 4000.0)
    >>> light = np.array([1000.0, 3000.0])
    >>> bool(np.abs(found.light(light - 0.06 * light**2 / 4000) / light - 1).max() < 1e-3)
    True
    """
    series = _Series.of(points, full)
    if series is None:
        return None
    line = series.rest(series.log)
    if series.rms(line) <= CURVED:
        return None
    by_time = series.rms(series.without(line, series.of_times()))
    still = series.part(series.without(line, series.of_levels()[: max(TERMS)]))
    best = None
    for count in TERMS:
        terms, error, rest = _fit(still, count)
        left = still.rms(rest)
        if best is None or left < BETTER * best.rms:
            best = Response(tuple(terms.tolist()), full, error, series.rms(line), left)
    assert best is not None
    good = best.rms <= STRAIGHT and best.rms <= BETTER * min(best.rms_line, by_time)
    rising = np.all(best.slope(np.linspace(0, full, 50)) > 0)
    return best if good and rising and best.error <= SURE else None


def bends(points: Sequence[Point], full: float) -> bool:
    """Tell whether the misfit of a series depends on the level, whatever times its exposures really had.

    Parameters are those of `find_response`.

    Examples
    --------
    >>> knee = lambda x: min(x, 2500 + (x - 2500) / 2)
    >>> both = [(g, t) for g in range(300, 1900, 20) for t in (1.0, 2.0)]
    >>> bends([Point(g, t, knee(g * t)) for g, t in both], 4000.0)
    True
    >>> bends([Point(g, t, g * (1.2 if t == 1.0 else 2.0)) for g, t in both], 4000.0)
    False
    """
    series = _Series.of(points, full)
    if series is None:
        return False
    line = series.rest(series.log)
    if series.rms(line) <= RECIPROCAL:
        return False
    timed = series.rms(series.without(line, series.of_times()))
    return series.rms(series.without(line, series.of_levels())) < BETTER * timed


class _Series(NamedTuple):
    """Points of groups that are met twice or more: logarithm of counts a second, counts over full, group, exposure, weight."""

    log: np.ndarray
    share: np.ndarray
    group: np.ndarray
    which: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, points: Sequence[Point], full: float) -> _Series | None:
        """Return them; None of too few, or of one exposure."""
        often = Counter(point.group for point in points)
        points = [point for point in points if often[point.group] >= 2]
        if len(points) < FEWEST_LEVELS * 2:
            return None
        _, group = np.unique([p.group for p in points], return_inverse=True)
        times, which = np.unique([p.time_s for p in points], return_inverse=True)
        counts, pixels = (np.array([p[i] for p in points], float) for i in (2, 3))
        weight = np.minimum(pixels, MOST_WEIGHT * pixels.sum())
        log = np.log(counts) - np.log(times)[which]
        return cls(log, counts / full, group, which, weight / weight.sum())

    def rms(self, values: np.ndarray) -> float:
        """Return the root of the mean square, without what is most off: something may have moved."""
        order = np.argsort(np.abs(values))
        weight = self.weight[order]
        weight = np.where(weight.cumsum() <= STILL, weight, 0)
        return float(np.sqrt(np.sum(weight * values[order] ** 2) / max(weight.sum(), 1e-12)))

    def part(self, rest: np.ndarray) -> _Series:
        """Return the points of groups that are not off by far more than most."""
        order = np.argsort(np.abs(rest))
        half = np.searchsorted(self.weight[order].cumsum(), 0.5)
        usual = 1.4826 * float(np.abs(rest)[order][half])
        off = np.unique(self.group[np.abs(rest) > max(OUTLIER * usual, CURVED)])
        kept = ~np.isin(self.group, off)
        _, group = np.unique(self.group[kept], return_inverse=True)
        arrays = (self.log[kept], self.share[kept], group, self.which[kept], self.weight[kept])
        return _Series(*arrays)

    def rest(self, values: np.ndarray) -> np.ndarray:
        """Return values, (n,), without the mean of their group."""
        count = np.bincount(self.group)
        return np.asarray(values - (np.bincount(self.group, weights=values) / count)[self.group])

    def of_times(self) -> list[np.ndarray]:
        """Return what a factor on one exposure changes, exposure by exposure."""
        times = range(int(self.which.max()) + 1)
        return [self.rest((self.which == one).astype(float)) for one in times]

    def of_levels(self) -> list[np.ndarray]:
        """Return what a polynomial of the counts changes, term by term."""
        return [self.rest(self.share**k) for k in range(1, 4)]

    def without(self, rest: np.ndarray, columns: Sequence[np.ndarray]) -> np.ndarray:
        """Return what a fit of some columns leaves, of least absolute deviations: what moved draws it little."""
        design, left = np.stack(columns, -1), rest
        for _ in range(ROUNDS):
            root = np.sqrt(self.weight / np.maximum(np.abs(left), LEAST))
            found = np.linalg.lstsq(design * root[:, None], rest * root, rcond=None)[0]
            left = rest - design @ found
        return np.asarray(left)


def _fit(series: _Series, count: int) -> tuple[np.ndarray, float, np.ndarray]:
    """Return terms of a curve, its largest relative error, and what it leaves, by Gauss and Newton."""
    powers = np.stack([series.share**k for k in range(1, count + 1)], -1)
    terms, root = np.zeros(count), np.sqrt(series.weight)
    for _ in range(ROUNDS):
        bent = np.maximum(1 + powers @ terms, 1e-3)
        rest = series.rest(series.log + np.log(bent))
        slopes = np.stack([series.rest(column) for column in (powers / bent[:, None]).T], -1)
        slopes = slopes * root[:, None]
        step = np.linalg.lstsq(slopes, -rest * root, rcond=None)[0]
        terms = terms + step
        if np.abs(step).max() < 1e-9:
            break
    freedom = max(len(rest) - int(series.group.max()) - 1 - count, 1)
    covariance = np.linalg.pinv(slopes.T @ slopes) * series.rms(rest) ** 2 / freedom
    # Beyond what the series reached nothing is known: there the error grows.
    at = np.linspace(0, 1, 20)[:, None] * series.share.max()
    at = at ** np.arange(1, count + 1)
    spread = np.sqrt(np.einsum("ni,ij,nj->n", at, covariance, at)) / (1 + at @ terms)
    return terms, float(spread.max()), rest

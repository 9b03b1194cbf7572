"""Response of a sensor that is not linear, estimated from exposures of one still scene.

Light is a polynomial through 0 of the counts y above dark, x = y·(1 + Σ aₖ (y/full)ᵏ), whose slope in
the dark is 1. Groups g of pixels of like brightness have log x = log C(g) + log t + δ(e) at every exposure e, whose
light is off by a factor common to all levels: a lamp flickers, a shutter has other times than are stated. A wrong
black level is an offset of all counts. Which of them a series shows is decided by its likelihood.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from levkas.calibration.linearity import RECIPROCAL, Point
from levkas.calibration.templates import Template

CURVED = 0.003  # of the light, relative: reflectance may be off by as much before a curve counts
STRAIGHT = 0.005  # rms that a curve may leave
BETTER = 0.7  # of the rms that wrong times leave, that of a curve
SURE = 0.003  # relative error of a curve, at most: it is in the budget, as all pixels share it
TERMS = 2  # of the polynomial, at most
SIGMAS = 4.0  # of a curve, or of an offset, to be one
ALIKE = 1.15  # contrast of the pixels of a group whose mean is a point of a curve
FEWEST_LEVELS = 8  # points for each parameter
MOST_WEIGHT = 0.1  # of all pixels, that a group may count for
OUTLIER = 4.0  # usual deviations from a curve, from which on a group moved
STILL = 0.85  # share of the pixels that did not, at least
LEAST = 1e-4  # relative: deviations below it are alike
FLICKER = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)  # rms of exposures, of the noise of a point
ROUNDS = 20  # of fits by iteration, at most
PLACES = 20  # levels at which a curve is looked at


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


class SeriesFit(NamedTuple):
    """What exposure series show.

    Parameters
    ----------
    response : Response or None
        Curve of the sensor; None where they show a line, or none that is sure.
    unsure : float
        Change of the light by a curve that is not sure, relative; 0 of none.
    offset, offset_error : float
        Counts above dark where there is no light by the series, and their standard error: not 0 where the dark is another
        than the shots', or the response has a toe below the levels of the series.
    straightness : float
        How far the light of its highest level lies off the line of its lowest, relative, where nothing is corrected: the curve
        of one term that fits best and its standard error, as one; infinite where there are too few points.
    """

    response: Response | None = None
    unsure: float = 0.0
    offset: float = 0.0
    offset_error: float = float("inf")
    straightness: float = float("inf")


def fit_series(points: Sequence[Point], full: float) -> SeriesFit:
    """Estimate curve and offset of a sensor from exposure series.

    Parameters
    ----------
    points : sequence of Point
        Of one or more series of one sensor, from `linearity.find_points` with the contrast `ALIKE`; groups and series
        numbered apart.
    full : float
        Full scale above dark, counts.

    Notes
    -----
    Line, curves of one and two terms, each with and without an offset, and each with exposures whose light scatters: of
    them that of the least Bayesian information criterion [schwarz1978]_ is taken, of a curve with both terms. One that
    changes less than 0.3 % of the light is none.

    Examples
    --------
    >>> rows = [Point(g, t, g * t - 0.06 * (g * t) ** 2 / 4000) for g in range(300, 1500, 20) for t in (1.0, 2.0)]
    >>> found = fit_series(rows, 4000.0)
    >>> light = np.array([1000.0, 3000.0])
    >>> bool(np.abs(found.response.light(light - 0.06 * light**2 / 4000) / light - 1).max() < 1e-3)
    True
    >>> bool(fit_series([p._replace(counts=p.time_s * p.group) for p in rows], 4000.0).straightness < 1e-3)
    True
    >>> round(fit_series([p._replace(counts=p.time_s * p.group + 3) for p in rows], 4000.0).offset, 2)
    3.0
    """
    series = _Series.of(points, full)
    if series is None:
        return SeriesFit()
    line = series.rest(series.log)
    columns = [*series.of_times(), *series.of_levels()[:TERMS], series.rest(1 / series.share)]
    still = series.part(series.without(line, columns))
    fits = [*_fits(still)]
    best = min(fits, key=lambda fit: fit.criterion)
    bent = min((fit for fit in fits if len(fit.terms) == 1), key=lambda fit: fit.criterion)
    straightness = float(np.hypot(bent.terms[0] * still.share.max(), bent.error))
    if len(best.terms):  # of fewer terms than the sensor has, the error is not that of the curve
        whole = (fit for fit in fits if len(fit.terms) == TERMS)
        best = min(whole, key=lambda fit: fit.criterion)
    sure = abs(best.offset) > SIGMAS * best.offset_error
    shown = SeriesFit(None, 0.0, best.offset * full if sure else 0.0, best.offset_error * full)
    shown = shown._replace(straightness=straightness)
    if not len(best.terms):
        return shown
    response = Response(tuple(best.terms.tolist()), full, best.error, series.rms(line), best.rms)
    reach = np.linspace(0, float(still.share.max()), PLACES)[1:] * full
    size = float(np.abs(response.light(reach) / reach - 1).max())
    if size <= CURVED:
        return shown
    rising = np.all(response.slope(np.linspace(0, full, 50)) > 0)
    good = best.error <= min(SURE, size / SIGMAS) and best.rms <= STRAIGHT and rising
    return (
        shown._replace(response=response)
        if good
        else shown._replace(unsure=size, straightness=max(size, straightness))
    )


def bends(points: Sequence[Point], full: float) -> bool:
    """Return whether the misfit of a series depends on the level, whatever times its exposures really had.

    Parameters are those of `fit_series`.

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
        of_series, times, counts, pixels = (
            np.array([p[i] for p in points], float) for i in (4, 1, 2, 3)
        )
        which = np.unique(np.stack([of_series, times]), axis=1, return_inverse=True)[1].ravel()
        weight = np.minimum(pixels, MOST_WEIGHT * pixels.sum())
        log = np.log(counts) - np.log(times)
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


class _Fit(NamedTuple):
    """One explanation of a series: terms of a curve, offset over full with its error, largest error of the curve, rms left."""

    criterion: float
    terms: np.ndarray
    offset: float
    offset_error: float
    error: float
    rms: float


def _fits(series: _Series) -> Iterator[_Fit]:
    """Yield every explanation that the points suffice for."""
    for count in range(TERMS + 1):
        for shifted in (False, True):
            for flicker in FLICKER:
                yield _fit(series, count, shifted, flicker)


def _fit(series: _Series, count: int, shifted: bool, flicker: float) -> _Fit:
    """Fit `count` terms, an offset if `shifted`, and exposures whose light scatters by `flicker` times the noise of a point.

    By Gauss and Newton; factors of exposures are penalised by their scatter, and their determinant is that of the
    marginal likelihood.
    """
    places = len(series.log)
    root = np.sqrt(series.weight * places)
    factors = np.stack(series.of_times(), -1)[:, : None if flicker else 0] * flicker
    penalty = np.eye(factors.shape[1], count + shifted + factors.shape[1], count + shifted)
    found = np.zeros(count + shifted + factors.shape[1])
    for _ in range(ROUNDS):
        terms, offset = found[:count], found[count] if shifted else 0.0
        share = np.maximum(series.share - offset, LEAST)
        powers = share[:, None] ** np.arange(1, count + 1)
        bent = np.maximum(1 + powers @ terms, 1e-3)
        level = series.rest(series.log + np.log(share / series.share * bent))
        columns = [*(powers / bent[:, None]).T, *[-1 / share][: int(shifted)]]
        own = np.reshape([series.rest(column) for column in columns], (len(columns), places))
        slopes = np.concatenate([own.T, factors], axis=1)
        rest = level + factors @ found[count + shifted :]
        design = np.concatenate([slopes * root[:, None], penalty])
        target = np.r_[rest * root, found[count + shifted :]]
        step = np.linalg.lstsq(design, -target, rcond=None)[0]
        found = found + step
        if np.abs(step[: count + shifted]).max(initial=0.0) < 1e-9:
            break
    square = float(np.sum(np.square(target + design @ step)))
    freedom = max(places - int(series.group.max()) - 1 - count - shifted, 1)
    noise = max(square, LEAST**2) / freedom
    scatter = np.linalg.slogdet(
        np.eye(factors.shape[1]) + (factors * root[:, None] ** 2).T @ factors
    )[1]
    parameters = count + shifted + bool(flicker)
    criterion = freedom * np.log(noise) + scatter + parameters * np.log(places)
    covariance = np.linalg.pinv(design.T @ design) * noise
    # Beyond what the series reached nothing is known: there the error grows.
    at = np.linspace(0, 1, PLACES)[:, None] * series.share.max()
    at = at ** np.arange(1, count + 1)
    spread = np.sqrt(np.einsum("ni,ij,nj->n", at, covariance[:count, :count], at))
    error = float((spread / np.maximum(1 + at @ found[:count], 1e-3)).max(initial=0.0))
    shift = (found[count], np.sqrt(covariance[count, count])) if shifted else (0.0, np.inf)
    left = rest + slopes @ step
    return _Fit(
        float(criterion), found[:count], float(shift[0]), float(shift[1]), error, series.rms(left)
    )

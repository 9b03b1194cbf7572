"""Light on a picture, from the patches of a chart whose reflectance is known.

Patch i of reflectance R at (x, y) has m = L(x, y) · R counts above dark, L = level · shape the counts of a
perfect diffuser: shape a polynomial in x and y fitted to all patches, level fitted to the grey ones, both by
least squares weighted with the variance that is expected of m. The order of the polynomial is the one by which
patches that are left out in turn come out best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from levkas.calibration.patterns import channel_table
from levkas.calibration.templates import Template

CHART_WHITE = "chart_white"
"""Name, among what is measured of a sensor, of the record of its chart."""
HIGHEST_ORDER = 3
"""Of the polynomial; ten terms."""
PATCHES_A_TERM = 2
"""Patches that an order needs, for each of its terms."""
BETTER = 0.85
"""A higher order is taken where it has less than this share of the held-out error of the lower one: scatter of the
patches alone makes it 5 to 10 % smaller by chance, and beyond the chart a term too many costs more than it gives."""
RELATIVE, ABSOLUTE = 0.02, 0.004
"""What a patch may differ from its published reflectance, a share and a reflectance; weights alone hang on them.
BabelColor's thirty charts scatter by about that much. Half or twice as much changes weights of dark patches only."""
NODES = 97
"""Places a side at which the light is worked out; between them it is interpolated."""
LEAST, MOST = 0.5, 2.0
"""Beyond the chart the light is kept between these parts of its least and greatest level on the chart."""


class Patches(NamedTuple):
    """The patches of a chart in one band that can be used.

    Parameters
    ----------
    places : ndarray, (n, 2), px
    levels, variance : ndarray, (n,)
        Counts above dark, and the variance of that mean.
    reflectance : ndarray, (n,)
    greys : ndarray, (n,), bool
        Patches of the grey scale.
    """

    places: np.ndarray
    levels: np.ndarray
    variance: np.ndarray
    reflectance: np.ndarray
    greys: np.ndarray

    def pick(self, chosen: np.ndarray) -> Patches:
        """Return some of the patches."""
        return Patches(*(part[chosen] for part in self))

    def weights(self, light: np.ndarray) -> np.ndarray:
        """Return one over the variance that is expected of each level; `light` is of a perfect diffuser there."""
        apart = (light * RELATIVE * self.reflectance) ** 2 + (light * ABSOLUTE) ** 2
        return np.asarray(1.0 / (self.variance + apart))


@dataclass(frozen=True, eq=False)
class ChartOutline:
    """Outline of a chart, and coordinates of polynomials: px about its middle, in halves of its size.

    Parameters
    ----------
    corners : ndarray, (n, 2), px
        Corners of the convex hull of the patches, in order.
    """

    corners: np.ndarray

    @classmethod
    def around(cls, points: np.ndarray) -> ChartOutline:
        """Return the outline of a chart whose patches have these corners, (n, 2) px."""
        from scipy.spatial import ConvexHull

        return cls(points[ConvexHull(points).vertices])

    @cached_property
    def centre(self) -> np.ndarray:
        """(2,), px."""
        return np.asarray(self.corners.mean(0))

    @cached_property
    def half(self) -> float:
        """Half of the chart's longer side, px."""
        return float(np.ptp(self.corners, axis=0).max() / 2)

    def basis(self, points: np.ndarray, order: int) -> np.ndarray:
        """Return the terms of a polynomial, (n, terms)."""
        x, y = ((points - self.centre) / self.half).T
        return np.stack([x ** (k - j) * y**j for k in range(order + 1) for j in range(k + 1)], 1)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the point of the chart that is nearest to each, (n, 2) px, and whether it lies on the chart."""
        starts, ends = self.corners, np.roll(self.corners, -1, 0)
        edges = ends - starts
        apart = points[:, None] - starts
        turns = edges[:, 0] * apart[..., 1] - edges[:, 1] * apart[..., 0]
        inside = (turns >= 0).all(1) | (turns <= 0).all(1)
        along = np.clip((apart * edges).sum(2) / (edges**2).sum(1), 0, 1)
        feet = starts + along[..., None] * edges
        best = np.argmin(((points[:, None] - feet) ** 2).sum(2), 1)
        return np.where(inside[:, None], points, feet[np.arange(len(points)), best]), inside


class LightShape(NamedTuple):
    """A polynomial with the covariance of its coefficients, that of the scatter about it."""

    outline: ChartOutline
    order: int
    coefficients: np.ndarray
    covariance: np.ndarray

    @classmethod
    def fit(cls, outline: ChartOutline, patches: Patches, order: int) -> LightShape:
        """Fit the light to patches; the weights follow from a first fit without them."""
        design = outline.basis(patches.places, order) * patches.reflectance[:, None]
        light = np.full(len(design), _mean_light(patches))
        for _ in range(2):
            weight = np.sqrt(patches.weights(light))
            found = np.linalg.lstsq(design * weight[:, None], patches.levels * weight, rcond=None)[
                0
            ]
            light = np.maximum(outline.basis(patches.places, order) @ found, light / 4)
        left = (patches.levels - design @ found) * weight
        scatter = float(left @ left) / max(len(left) - len(found), 1)
        inverse = np.linalg.pinv((design * weight[:, None]).T @ (design * weight[:, None]))
        return cls(outline, order, found, scatter * inverse)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the light, counts, at (n, 2) px; beyond the chart along its slope at the edge, within bounds."""
        foot, inside = self.outline.nearest(points)
        values = self.unbound(foot)
        if inside.all():
            return np.asarray(values)
        out = ~inside
        away = points[out] - foot[out]
        length = np.linalg.norm(away, axis=1, keepdims=True)
        unit = away / length
        step = self.outline.half / 100
        ahead = self.unbound(foot[out] + step * unit)
        reach = np.minimum(length[:, 0], 2 * self.outline.half)
        edge = self.unbound(self.outline.corners)
        values[out] += (ahead - values[out]) / step * reach
        values[out] = np.clip(values[out], LEAST * edge.min(), MOST * edge.max())
        return np.asarray(values)

    def unbound(self, points: np.ndarray) -> np.ndarray:
        """Return the polynomial itself, which runs away beyond the chart."""
        return np.asarray(self.outline.basis(points, self.order) @ self.coefficients)


def _mean_light(patches: Patches) -> float:
    """Return the light on the chart as one number."""
    return float(patches.levels @ patches.reflectance / (patches.reflectance @ patches.reflectance))


@dataclass(frozen=True, eq=False)
class LightFit:
    """The light in one band, fitted.

    Parameters
    ----------
    shape : LightShape or None
        None: the light is taken as even.
    judge : LightShape or None
        Of the next higher order: what it differs by is part of the uncertainty.
    level : float
        Counts of a perfect diffuser over `shape`.
    level_sigma : float
        Of `level`, relative.
    greys : ndarray, (n, 2), px
        Places of the grey patches.
    errors : ndarray, (n,)
        Reflectance of each patch by the fit to all others, minus what is known.
    flat_errors : ndarray, (n,)
        The same with an even light.
    """

    shape: LightShape | None
    judge: LightShape | None
    level: float
    level_sigma: float
    greys: np.ndarray
    errors: np.ndarray
    flat_errors: np.ndarray

    @property
    def order(self) -> int:
        """Of the polynomial."""
        return self.shape.order if self.shape else 0

    @property
    def rmse(self) -> float:
        """Root mean square of `errors`."""
        return float(np.sqrt(np.mean(self.errors**2)))

    @property
    def flat_rmse(self) -> float:
        """Root mean square of `flat_errors`."""
        return float(np.sqrt(np.mean(self.flat_errors**2)))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the counts of a perfect diffuser at (n, 2) px."""
        return self.level * (self.shape(points) if self.shape else np.ones(len(points)))

    def sigma(self, points: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the light, relative, at (n, 2) px: of level and shape, at most 1.

        Notes
        -----
        The variance of the shape is that of its coefficients, against the grey patches, to which the level is
        fitted; and what it differs by, squared, from the next higher order, and from itself where it is bound
        beyond the chart. It is at least the variance of that order, and grows with the distance from the chart.
        """
        total = np.full(len(points), self.level_sigma**2)
        if self.judge is not None:
            here, own = np.ones(len(points)), np.zeros(len(points))
            others = [self.judge]
            if self.shape is not None:
                here = self.shape(points) / self.shape(self.greys).mean()
                own = self._spread(self.shape, points)
                others.append(self.shape)
            apart = [
                np.abs(o.unbound(points) / o.unbound(self.greys).mean() / here - 1) for o in others
            ]
            total += np.maximum(own + np.max(apart, axis=0) ** 2, self._spread(self.judge, points))
        return np.asarray(np.sqrt(np.minimum(total, 1.0)))

    def _spread(self, shape: LightShape, points: np.ndarray) -> np.ndarray:
        """Return the relative variance of a shape against its mean on the grey patches."""
        basis = shape.outline.basis
        here = basis(points, shape.order) / shape(points)[:, None]
        there = (basis(self.greys, shape.order) / shape(self.greys)[:, None]).mean(0)
        apart = here - there
        return np.asarray(np.einsum("ni,ij,nj->n", apart, shape.covariance, apart))


def fit_light(patches: Patches, outline: ChartOutline, shape: LightShape | None = None) -> LightFit:
    """Fit the light in one band to the patches of a chart.

    Parameters
    ----------
    shape : LightShape, optional
        Shape from another band, for one in which the grey patches alone are known: level only is fitted.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(6) * 100.0, np.arange(4) * 100.0)
    >>> places = np.stack([x.ravel(), y.ravel()], 1)
    >>> known = np.linspace(0.9, 0.05, 24)[np.random.default_rng(0).permutation(24)]
    >>> levels = 3000 * (1 + 0.0005 * places[:, 0]) * known
    >>> patches = Patches(places, levels, np.full(24, 4.0), known, np.arange(24) >= 18)
    >>> light = fit_light(patches, ChartOutline.around(places))
    >>> light.order, light(np.array([[200.0, 100.0]])).round().tolist(), round(light.flat_rmse, 2)
    (1, [3300.0], 0.05)
    """
    if shape is not None:
        return replace(_fitted(patches, shape, again=False), judge=shape)
    fits = [_fitted(patches, None)]
    for order in range(1, HIGHEST_ORDER + 1):
        terms = (order + 1) * (order + 2) // 2
        if PATCHES_A_TERM * terms > len(patches.levels):
            break
        fits.append(_fitted(patches, LightShape.fit(outline, patches, order)))
    # The highest order that the patches allow judges the one below it, and is not taken itself.
    chosen = 0
    for i, one in enumerate(fits[:-1]):
        if one.rmse < BETTER * fits[chosen].rmse:
            chosen = i
    judge = fits[chosen + 1].shape if chosen + 1 < len(fits) else None
    return replace(fits[chosen], judge=judge, flat_errors=fits[0].errors)


def _fitted(patches: Patches, shape: LightShape | None, *, again: bool = True) -> LightFit:
    """Fit the level over a shape; each patch is held out in turn, the shape fitted `again` without it."""
    level, spread = _level(patches, shape)
    errors = np.full(len(patches.levels), np.nan)
    every = np.arange(len(errors))
    for i in every:
        rest = patches.pick(every != i)
        own = LightShape.fit(shape.outline, rest, shape.order) if shape and again else shape
        here = 1.0 if own is None else float(own(patches.places[i : i + 1])[0])
        light = _level(rest, own)[0] * here
        errors[i] = patches.levels[i] / max(light, 1e-9) - patches.reflectance[i]
    return LightFit(shape, None, level, spread, patches.places[patches.greys], errors, errors)


def _level(patches: Patches, shape: LightShape | None) -> tuple[float, float]:
    """Return the level over a shape by the grey patches, and its relative standard deviation."""
    grey = patches.pick(patches.greys)
    light = np.ones(len(grey.levels)) if shape is None else shape(grey.places)
    first = float(grey.levels.sum() / (light * grey.reflectance).sum())
    model = light * grey.reflectance
    weight = grey.weights(np.abs(first * light))
    level = float(weight @ (grey.levels * model) / (weight @ model**2))
    left = grey.levels - level * model
    scatter = float(weight @ left**2) / max(len(left) - 1, 1)
    variance = max(scatter, 0.0) / float(weight @ model**2)
    return level, float(np.sqrt(variance) / abs(level)) if level else 1.0


class PatchScatter(NamedTuple):
    """What values of patches that were held out miss beyond light and noise: a share, and a reflectance."""

    relative: float
    absolute: float

    @classmethod
    def fit(cls, errors: np.ndarray, reflectance: np.ndarray, known: np.ndarray) -> PatchScatter:
        """Fit var(error) = known + relative² R² + absolute² to patches.

        Parameters
        ----------
        errors, reflectance : ndarray, (n,)
            What held-out values of patches miss, and what the patches reflect.
        known : ndarray, (n,)
            Variance of that error by noise and by the uncertainty of the light.

        Notes
        -----
        The squares are weighted by one over the variance of a square, 2 var², in ten rounds. A filter that leaks, stray
        light and a chart that has aged show here and nowhere else; so do patches that differ from what is published,
        by which no value of an object is wrong: the sum is an upper estimate.

        Examples
        --------
        >>> rng = np.random.default_rng(2)
        >>> known, paints = np.full(2400, 1e-6), rng.uniform(0.02, 0.9, 2400)
        >>> errors = rng.normal(0, np.hypot(0.03 * paints, 0.004))
        >>> [round(v, 3) for v in PatchScatter.fit(errors, paints, known)]
        [0.03, 0.004]
        """
        from scipy.optimize import nnls

        if not len(errors):
            return cls(0.0, 0.0)
        design = np.stack([reflectance**2, np.ones(len(errors))], 1)
        parts = np.array([0.0, float(np.mean(errors**2))])
        for _ in range(10):
            weight = 1 / np.maximum(known + design @ parts, 1e-12)
            parts, _ = nnls(design * weight[:, None], np.maximum(errors**2 - known, 0) * weight)
        return cls(*map(float, np.sqrt(parts)))


# --- the light of a sensor ----------------------------------------------------------------------


class LightNodes(NamedTuple):
    """Values at nodes of a picture: `x` (columns,) and `y` (rows,) px, `values` (rows, columns)."""

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray

    def at(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Interpolate at some rows and columns, (rows, columns) float32."""
        across = np.empty((len(self.y), len(columns)))
        for row, values in zip(across, self.values, strict=True):
            row[:] = np.interp(columns, self.x, values)
        places = np.clip(np.searchsorted(self.y, rows, "right") - 1, 0, max(len(self.y) - 2, 0))
        after = np.minimum(places + 1, len(self.y) - 1)
        gap = np.maximum(self.y[after] - self.y[places], 1e-9)
        part = np.clip((rows - self.y[places]) / gap, 0, 1)[:, None].astype(np.float32)
        across = across.astype(np.float32)
        return np.asarray((1 - part) * across[places] + part * across[after])


class LightMap(NamedTuple):
    """Light of a perfect diffuser, counts, and its relative sigma; `beyond` is the share beyond the chart."""

    levels: LightNodes
    sigma: LightNodes
    beyond: float

    @classmethod
    def of(cls, fit: LightFit, outline: ChartOutline, size: tuple[int, int]) -> LightMap:
        """Work the light out over a picture of (height, width)."""
        y, x = (np.linspace(0, n - 1, NODES) for n in size)
        points = np.stack([part.ravel() for part in np.meshgrid(x, y)], 1)
        levels, sigma = (
            LightNodes(x, y, found.reshape(NODES, NODES))
            for found in (fit(points), fit.sigma(points))
        )
        return cls(levels, sigma, float(np.mean(~outline.nearest(points)[1])))


@dataclass(frozen=True, eq=False)
class ChartLight:
    """The light of one sensor by a chart, in place of a white frame.

    Parameters
    ----------
    times : dict of label to float or None
        Exposure of the chart, s.
    unevenness : dict of label to float
        What sensels differ by, relative: a white frame would divide it out.
    pattern : rows of channel names, optional
        Of a mosaic whose channels are the bands.
    size : (height, width)
    record : dict
        By which chart, and how good: for the reports.
    """

    maps: Mapping[str, LightMap]
    times: Mapping[str, float | None]
    unevenness: Mapping[str, float]
    scatter: Mapping[str, PatchScatter]
    pattern: Sequence[Sequence[str]] | None
    size: tuple[int, int]
    notes: tuple[str, ...]
    record: Mapping[str, object]

    def white(self, size: tuple[int, int], labels: Sequence[str]) -> Template:
        """Return what a perfect diffuser would show of (height, width), above dark: of a band, or of a mosaic."""
        mean = np.empty(size, np.float32)
        variance = np.empty(size, np.float32)
        table = np.zeros((1, 1), int)
        if self.pattern is not None and len(labels) > 1:
            table = channel_table(self.pattern, labels)
        for y, x in np.ndindex(table.shape):
            label = labels[int(table[y, x])]
            rows, columns = (
                np.arange(y, size[0], table.shape[0]),
                np.arange(x, size[1], table.shape[1]),
            )
            light = self.maps[label].levels.at(rows, columns)
            mean[y :: table.shape[0], x :: table.shape[1]] = light
            part = np.square(light * np.float32(self.unevenness[label]))
            variance[y :: table.shape[0], x :: table.shape[1]] = part
        none = np.zeros(size, bool)
        return Template(mean, variance, 1, none, none, self.times[labels[0]], above_dark=True)

"""Light on a picture, from the patches of a chart whose reflectance is known.

Patch i of reflectance R at (x, y) has m = L(x, y) · R counts above dark, L = level · shape the counts of a perfect diffuser: shape
a polynomial in x and y fitted to all patches, level fitted to the grey ones, both by least squares weighted with the variance
that is expected of m ([jcgm2008]_, H.3). The order of the polynomial is the one by which patches that are left out in turn come
out best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from levkas.calibration.patterns import channel_table
from levkas.calibration.templates import Template

CHART_WHITE = "chart_white"
"""Name, among what is measured of a sensor, of the record of its chart."""
HIGHEST_ORDER, PATCHES_A_TERM = 2, 2
"""Of the polynomial, of six terms: vignetting is quadratic; and patches that an order needs, for each of its terms."""
BETTER = 0.85
"""A higher order is taken where it has less than this share of the held-out error of the lower one: scatter of the patches alone
makes it 5 to 10 % smaller by chance, and beyond the chart a term too many costs more than it gives."""
RELATIVE, ABSOLUTE = 0.02, 0.004
"""What a patch may differ from its published reflectance, a share and a reflectance; weights alone hang on them. BabelColor's thirty
charts scatter by about that much. Half or twice as much changes weights of dark patches only."""
LEAST, MOST = 0.5, 2.0
"""Beyond the chart the light is kept between these parts of its least and greatest level on the chart."""
NONE = np.zeros(0)


class Patches(NamedTuple):
    """The patches of a chart in one band that can be used, (n,) each.

    `places` (n, 2) px; `levels` and `variance`: counts above dark, and the variance of that mean; `reflectance`; `greys`: whether
    a patch is of the grey scale.
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


class Light(NamedTuple):
    """The light in one band: counts of a perfect diffuser over a picture.

    Parameters
    ----------
    centre, half : (2,) and float, px
        Coordinates of the polynomial: from the middle of the chart, in halves of its longer side.
    coefficients : ndarray, (order + 1, order + 1)
        Of yʲ xⁱ.
    bounds : (float, float)
        Least and greatest shape on the chart.
    level, level_sigma : float
        Counts over the shape, by the grey patches, and its relative standard deviation.
    errors, even_errors : ndarray, (n,)
        Reflectance of each patch by the fit to all others, minus what is known; the same with an even light.
    """

    centre: np.ndarray
    half: float
    coefficients: np.ndarray
    bounds: tuple[float, float]
    level: float = 1.0
    level_sigma: float = 0.0
    errors: np.ndarray = NONE
    even_errors: np.ndarray = NONE

    @property
    def order(self) -> int:
        """Of the polynomial."""
        return len(self.coefficients) - 1

    @property
    def rmse(self) -> float:
        """Root mean square of `errors`."""
        return float(np.sqrt(np.mean(self.errors**2)))

    def _powers(self, at: np.ndarray, axis: int) -> np.ndarray:
        return np.vander((at - self.centre[axis]) / self.half, self.order + 1, increasing=True)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the counts of a perfect diffuser at (n, 2) px."""
        x, y = (self._powers(points[:, axis], axis) for axis in (0, 1))
        return self._bound(np.einsum("nj,ji,ni->n", y, self.coefficients, x))

    def over(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the same over some rows and columns of a picture, (rows, columns) float32."""
        y, x = self._powers(rows, 1) @ self.coefficients, self._powers(columns, 0).T
        return self._bound(y.astype(np.float32) @ x.astype(np.float32))

    def _bound(self, shape: np.ndarray) -> np.ndarray:
        return self.level * np.clip(shape, LEAST * self.bounds[0], MOST * self.bounds[1])


def fit_light(patches: Patches, shape: Light | None = None) -> Light:
    """Fit the light in one band to the patches of a chart; of a `shape` of another band, to grey patches alone, the level.

    >>> x, y = np.meshgrid(np.arange(6) * 100.0, np.arange(4) * 100.0)
    >>> places = np.stack([x.ravel(), y.ravel()], 1)
    >>> known = np.linspace(0.9, 0.05, 24)[np.random.default_rng(0).permutation(24)]
    >>> levels = 3000 * (1 + 0.0005 * places[:, 0]) * known
    >>> patches = Patches(places, levels, np.full(24, 4.0), known, np.arange(24) >= 18)
    >>> light = fit_light(patches)
    >>> light.order, light(np.array([[200.0, 100.0]])).round().tolist(), round(float(np.std(light.even_errors)), 2)
    (1, [3300.0], 0.05)
    """
    even = _held_out(patches, 0)
    if shape is not None:
        return _held_out(patches, shape)._replace(even_errors=even.errors)
    best = even
    for order in range(1, HIGHEST_ORDER + 1):
        if PATCHES_A_TERM * (order + 1) * (order + 2) // 2 <= len(patches.levels):
            one = _held_out(patches, order)
            best = one if one.rmse < BETTER * best.rmse else best
    return best._replace(even_errors=even.errors)


def _held_out(patches: Patches, shape: int | Light) -> Light:
    """Fit a light of some order, or of a shape, and each patch again without it."""
    light, errors = _fitted(patches, shape), np.empty(len(patches.levels))
    every = np.arange(len(errors))
    for i in every:
        there = _fitted(patches.pick(every != i), shape)(patches.places[i : i + 1])[0]
        errors[i] = patches.levels[i] / max(there, 1e-9) - patches.reflectance[i]
    return light._replace(errors=errors)


def _fitted(patches: Patches, shape: int | Light) -> Light:
    """Fit a polynomial of some order to all patches, or take one as it is, and the level to the grey ones."""
    light = _shape(patches, shape) if isinstance(shape, int) else shape._replace(level=1.0)
    grey = patches.pick(patches.greys)
    model = light(grey.places) * grey.reflectance
    first = float(grey.levels.sum() / model.sum())
    weight = grey.weights(np.abs(first * light(grey.places)))
    level = float(weight @ (grey.levels * model) / (weight @ model**2))
    scatter = float(weight @ (grey.levels - level * model) ** 2) / max(len(model) - 1, 1)
    sigma = float(np.sqrt(scatter / (weight @ model**2)) / abs(level)) if level else 1.0
    return light._replace(level=level, level_sigma=sigma)


def _shape(patches: Patches, order: int) -> Light:
    """Fit a polynomial to patches; its weights follow from a first fit, whose weights are of even light."""
    low, high = patches.places.min(0), patches.places.max(0)
    terms = [(j, i) for j in range(order + 1) for i in range(order + 1 - j)]
    middle, half = (low + high) / 2, max(float((high - low).max()) / 2, 1.0)
    x, y = ((patches.places - middle) / half).T
    basis = np.stack([y**j * x**i for j, i in terms], 1)
    known = patches.reflectance
    light = np.full(len(known), float(patches.levels @ known / (known @ known)))
    for _ in range(2):
        weight = np.sqrt(patches.weights(light))
        design = basis * (known * weight)[:, None]
        found = np.linalg.lstsq(design, patches.levels * weight, rcond=None)[0]
        light = np.maximum(basis @ found, light / 4)
    coefficients = np.zeros((order + 1, order + 1))
    coefficients[tuple(zip(*terms, strict=True))] = found
    there = basis @ found
    return Light(middle, half, coefficients, (float(there.min()), float(there.max())))


@dataclass(frozen=True, eq=False)
class ChartLight:
    """The light of one sensor by a chart, in place of a white frame.

    Parameters
    ----------
    bands : dict of label to Light
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

    bands: Mapping[str, Light]
    times: Mapping[str, float | None]
    unevenness: Mapping[str, float]
    pattern: Sequence[Sequence[str]] | None
    size: tuple[int, int]
    notes: tuple[str, ...]
    record: Mapping[str, object]

    def white(self, size: tuple[int, int], labels: Sequence[str]) -> Template:
        """Return what a perfect diffuser would show of (height, width), above dark: of a band, or of a mosaic."""
        mean, variance = np.empty(size, np.float32), np.empty(size, np.float32)
        table = np.zeros((1, 1), int)
        if self.pattern is not None and len(labels) > 1:
            table = channel_table(self.pattern, labels)
        for y, x in np.ndindex(table.shape):
            label, phase = labels[int(table[y, x])], np.s_[y :: table.shape[0], x :: table.shape[1]]
            rows, columns = (np.arange(n)[part] for n, part in zip(size, phase, strict=True))
            mean[phase] = self.bands[label].over(rows, columns)
            variance[phase] = np.square(mean[phase] * np.float32(self.unevenness[label]))
        none = np.zeros(size, bool)
        return Template(mean, variance, 1, none, none, self.times[labels[0]], above_dark=True)

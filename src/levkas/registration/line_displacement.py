"""Displacement of single lines: rows or columns, registered one by one, finer than a check window.

A push-broom scanner exposes a line at once: where its stage wobbles or loses lines, each line as a whole lies elsewhere than
its neighbours; so do interlaced halves and lines of a rolling shutter. The displacement (dx, dy) of a line against the picture that
the other camera predicts is a least-squares step along it (Lucas-Kanade, [baker2004]_) with a gain of its own. What the line as a whole
does, all of its four parts do; noise, relief and unlike pigments move them independently. The covariance of the parts along the scan is
therefore the variance of the common displacement, and that of their *differences*, shifted along the scan, is what chance makes of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from levkas.core.threads import each, in_threads
from levkas.geometry.transforms import Affine, Composed, Inverse
from levkas.registration.line_displacement_kernel import register_rows
from levkas.registration.local_shifts import detail_on_grid, highpass_rows, smoothing_warp
from levkas.registration.verification import predict

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

Lines = Literal["rows", "columns"]
ENDS = (0, 1 / 8, 1 / 2, 7 / 8, 1)
"""Of the parts, as shares of a line; the outer ones are as narrow as the border of an icon, whose ledge displaces the others alone."""
SAMPLES = (16, 200)
"""In px, of a part: fewer determine nothing; of more the middle is used, which gives 0.03 to 0.1 px."""
STEPS = 5
"""Of Gauss-Newton, each of 1 px at most; four suffice for 3 px."""
PRIOR, MOST = 2.0, 6.0
"""In px: standard deviation of displacements before any measurement; beyond `MOST` a line is lost."""
SCALES = (0.05, 20.0)
"""Native px per reference px of maps that are looked at."""
MOST_DRAWN = 1000
LEAST_LINES = 32
"""That are registered in two parts at least."""
DEGREE, STRAY, ALIKE = 3, 8.0, 0.6
"""Of the polynomial along the scan that is taken out, since maps err smoothly too; typical shifts at which a shift has half its
weight; a part off the middle of all by more than this share of it strays."""
LEAST_DEVIATIONS, LEAST_SLOPE = 4.0, 6.0
"""Covariance of the parts, and of their slopes, in deviations by chance, from which lines are displaced; of 250 honest pairs
few had more than 2, and 4."""
OUTER = 0.4
"""Share of the covariance that the two outer parts have at least: a ledge displaces the parts within it."""
EDGE_LINES, LEAST_SHARE = 8, 0.5
"""So far from an edge other sharpness feigns a displacement; that explains half of the covariance on tiles, 0.23 at most on paintings."""
BLOCK, MOST_OF_BLOCKS = 8, 0.3
"""In lines; in reference px: side of the blocks of JPEG, and what they feign: 0.1 at quality 50, 0.27 at 15."""


@dataclass(frozen=True)
class LineShifts:
    """Shifts of the parts of lines beside a smooth course along the scan, (lines, parts, 2) px, along and across the lines.

    `weight`, 1/px², is their information, 0 where unknown, less of shifts that stray.
    """

    shift: np.ndarray
    weight: np.ndarray
    information: np.ndarray
    places: np.ndarray
    """(parts,). Middles of the parts, -1 to 1 along the line."""
    ends: tuple[float, float]
    """Of places, in px along the line."""
    spread: float = 1.0
    """Root mean square over a line of a displacement that is 1 px where it is stated: less than 1 of slopes, stated at the ends."""

    def slopes(self) -> LineShifts:
        """Return how lines turn (across) or stretch (along) about their middle, at their ends, as the outermost and the next parts show it."""
        low, high = [0, 1], [-1, -2]
        apart = (self.places[high] - self.places[low])[:, None]

        def of_both(known: np.ndarray) -> np.ndarray:
            one, other = known[:, low], known[:, high]
            return np.asarray(apart**2 * one * other / np.maximum(one + other, 1e-30))

        known = of_both(self.information)
        slope = np.where(known > 0, (self.shift[:, high] - self.shift[:, low]) / apart, 0.0)
        return LineShifts(slope, of_both(self.weight), known, np.zeros(2), self.ends, 3**-0.5)

    def common(self) -> np.ndarray:
        """Return the mean over the parts, (lines, 2); NaN where nothing is known."""
        total = self.weight.sum(1)
        with np.errstate(invalid="ignore"):
            mean = (self.weight * self.shift).sum(1) / np.where(total > 0, total, np.nan)
        return np.asarray(mean)

    def covariance(self, outer: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return the variance that parts, or the outer two, have in common along the scan, (2,) px², and its standard deviation by chance."""
        last = len(self.places) - 1
        pairs = [(0, last)] if outer else combinations(range(last + 1), 2)
        one, other = (list(part) for part in zip(*pairs, strict=True))
        a, b = self.shift[:, one], self.shift[:, other]
        root = (self.weight[:, one] * self.weight[:, other]) ** 0.25
        found = (root**2 * a * b).sum((0, 1)) / np.maximum((root**2).sum((0, 1)), 1e-30)
        apart = np.where(root > 0, a - b, 0.0) / np.sqrt(2)
        products, weights = (_autocorrelation(x).sum(1) for x in (root * apart, root))
        far = slice(len(root) // 8, len(root) // 2)
        chance = products[far] / np.maximum(weights[far], 1e-30)
        return found, np.sqrt(np.mean(np.square(chance), 0))

    def variance(self, sizes: np.ndarray) -> np.ndarray:
        """Return the variance along and across the lines, (2,) reference px²; `sizes`, (2,), are reference px per px along and across."""
        return np.asarray(self.covariance()[0].clip(0) * (sizes * self.spread) ** 2)

    def are_displaced(self, sizes: np.ndarray) -> tuple[bool, float]:
        """Return whether lines are displaced beyond chance, and by how many deviations."""
        found, chance = self.covariance()
        deviations = found / np.maximum(chance, 1e-30)
        most, axis = float(deviations.max()), int(deviations.argmax())
        outer, by_chance = self.covariance(outer=True)
        beyond = most >= (LEAST_SLOPE if self.spread < 1 else LEAST_DEVIATIONS)
        by_all = outer[axis] + by_chance[axis] > OUTER * found[axis]
        return bool(beyond and by_all and not self._is_feigned(sizes)), most

    def _is_feigned(self, sizes: np.ndarray) -> bool:
        """Return whether a coder's blocks, which move every eighth line alike, or edges along the lines explain what parts have in common."""
        lines = np.arange(len(self.shift))[:, None]
        rms = float(np.sqrt(self.variance(sizes).sum())) / self.spread
        eighths = (lines % BLOCK == np.arange(BLOCK - 1)).astype(float)
        blocks = self._share_of(eighths, sizes) - self._share_of(lines % 2.0, sizes)
        if blocks > LEAST_SHARE and rms < MOST_OF_BLOCKS:
            return True
        # Odd about edges along the lines: where more detail lies behind a line than before it.
        known = self.information[..., 1].sum(1)
        detail = np.log(known + 0.05 * np.median(known) + 1e-30)
        near = range(1, EDGE_LINES + 1)
        courses = np.stack([np.roll(detail, -n) - np.roll(detail, n) for n in near], 1)
        courses[:EDGE_LINES] = courses[-EDGE_LINES:] = 0.0
        return self._share_of(courses, sizes) > LEAST_SHARE

    def _share_of(self, basis: np.ndarray, sizes: np.ndarray) -> float:
        """Return the share of the covariance that basis functions, (lines, k), explain beside a cubic."""
        cubic, common = legendre(len(basis)), self.common()
        known = np.isfinite(common).all(1)
        amounts = np.linalg.lstsq(np.hstack([basis, cubic])[known], common[known], rcond=None)[0]
        course = basis @ amounts[: basis.shape[1]]
        rest = replace(self, shift=self.shift - (course - course.mean(0))[:, None])
        before, after = (float(one.variance(sizes).sum()) for one in (self, rest))
        return 1 - after / max(before, 1e-30)


@dataclass(frozen=True)
class LineDisplacement:
    """Displacement of the lines of one picture against one another, beside what another picture predicts."""

    lines: Lines
    displaced: bool
    """Whether lines are displaced beyond chance."""
    deviations: float
    """Covariance of the parts of lines, in standard deviations by chance."""
    along: float
    across: float
    """`along`, `across`: in reference px: root mean square of the common displacement."""
    displacement: np.ndarray
    """(n, 2), reference px. Of every line as measured, along and across; NaN where unknown."""
    parts: LineShifts
    of_ends: tuple[bool, ...]
    """What is displaced beyond chance: lines as a whole (False), their ends about their middles (True), or both."""
    step: int
    """In reference px: of the grid on which it was measured."""

    @property
    def rms(self) -> float:
        """Root mean square of the common displacement, reference px."""
        return float(np.hypot(self.along, self.across))

    @property
    def sigma(self) -> float:
        """Standard deviation, of each axis, that it adds to where a place lies, reference px; 0 where lines are not displaced."""
        return self.rms / 2**0.5 if self.displaced else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, JSON-ready, without the displacement of every line."""
        sizes = np.hypot(*self.displacement.T)
        return {
            "lines": self.lines,
            "displaced": self.displaced,
            "rms_px": round(self.rms, 4),
            "largest_px": round(float(np.nanmax(sizes)), 4),
            "step": self.step,
        }

    def drawn(self) -> dict[str, Any] | None:
        """Return the displacement of the middle lines for a figure, JSON-ready; None where lines are not displaced."""
        if not self.displaced:
            return None
        start = max(0, (len(self.displacement) - MOST_DRAWN) // 2)
        shown = np.round(self.displacement[start : start + MOST_DRAWN], 3)
        along, across = (
            [None if np.isnan(v) else v for v in column] for column in shown.T.tolist()
        )
        return {"lines": self.lines, "first": start, "along": along, "across": across}


def measure_line_displacement(
    predictors: np.ndarray, image: np.ndarray, transform: Transform, *, step: int = 1
) -> LineDisplacement | None:
    """Return how rows or columns of a band, whichever are displaced most beyond chance, lie; None where too few show enough.

    `predictors`, (k, h, w) float32, are high-passed images of the reference on a grid of `step` reference px, `image`, (H, W), is the band
    in native px, both NaN where invalid; `transform` is reference px → native px.
    """
    size = (predictors.shape[1], predictors.shape[2])
    change = transform.jacobian((np.array([[size[1], size[0]]]) * step - 1) / 2)[0]
    scale = abs(np.linalg.det(change)) ** 0.5
    if not (np.isfinite(scale) and SCALES[0] < scale < SCALES[1]):
        return None
    native = np.linalg.norm(np.linalg.inv(change), axis=0)
    predicted = predict(predictors, detail_on_grid(image, transform, size, step=step))
    to_grid = Composed(Inverse(transform), Affine.scaling(1 / step))
    scene = smoothing_warp(predicted, to_grid, (image.shape[0], image.shape[1]))

    def measured(lines: Lines) -> LineDisplacement | None:
        one, other, sizes = image, scene, native
        if lines == "columns":
            one, other, sizes = one.T, other.T, sizes[::-1]
        shifts = _register_lines(one, other)
        return None if shifts is None else _describe(shifts, sizes, lines, step)

    found = [one for one in each(measured, ("rows", "columns")) if one]
    return max(found, key=lambda one: (one.displaced, one.deviations), default=None)


def _register_lines(lines: np.ndarray, scene: np.ndarray) -> LineShifts | None:
    """Register the parts of every row of `lines` against `scene`, both (h, w); None where too few show enough."""
    lines, scene = highpass_rows(lines), highpass_rows(scene)
    known = np.cumsum((np.isfinite(lines) & np.isfinite(scene)).sum(0))
    if not known[-1]:
        return None
    edges = np.searchsorted(known, known[-1] * np.array(ENDS), side="right")
    shift = np.zeros((len(lines), len(ENDS) - 1, 2))
    information = np.zeros_like(shift)
    settings = (*SAMPLES, STEPS), (PRIOR, MOST), (shift, information)
    in_threads(register_rows, len(lines), (lines, scene), edges, *settings, worth=3 * lines.size)
    if ((information > 0).all(2).sum(1) >= 2).sum() < LEAST_LINES:
        return None
    left, weight = _without_course(shift, information)
    ends = (float(edges[0]), float(edges[-1]))
    places = (edges[:-1] + edges[1:] - sum(ends)) / (ends[1] - ends[0])
    return LineShifts(left, weight, np.where(weight > 0, information, 0.0), places, ends)


def _without_course(shift: np.ndarray, information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what is left of every part without a smooth course along the scan, and its weight, less where it strays from its line."""
    lines, parts, _ = shift.shape
    basis = legendre(lines)
    left, stray = np.full_like(shift, np.nan), np.full((parts, 2), np.inf)
    for part, axis in np.ndindex(parts, 2):
        y, known = shift[:, part, axis], information[:, part, axis]
        measured = known > 0
        if measured.sum() < LEAST_LINES:
            continue
        w = known
        for _ in range(3):
            weighted = basis * w[:, None]
            gram = weighted.T @ basis + 1e-9 * w.max() * np.eye(basis.shape[1])
            rest = y - basis @ np.linalg.solve(gram, weighted.T @ y)
            typical = 1.4826 * float(np.median(np.abs(rest[measured]))) + 1e-6
            w = known / (1 + (rest / (STRAY * typical)) ** 2)
        left[measured, part, axis], stray[part, axis] = rest[measured], STRAY * typical
    known = np.isfinite(left)
    middle = np.nanmedian(np.where(known.any(1, keepdims=True), left, 0.0), 1, keepdims=True)
    apart = np.where(known, left - middle, 0.0)
    weight = information / (1 + (apart / (stray + (1 - ALIKE) * np.abs(middle))) ** 2)
    return np.where(known, left, 0.0), np.where(known, weight, 0.0)


def legendre(lines: int) -> np.ndarray:
    """Return polynomials along the scan, (lines, 4)."""
    return np.polynomial.legendre.legvander(np.linspace(-1, 1, lines), DEGREE)


def _autocorrelation(values: np.ndarray) -> np.ndarray:
    """Return the sums of products with all shifts along the scan, circular, of the same shape."""
    power = np.abs(np.fft.rfft(values, axis=0)) ** 2
    return np.asarray(np.fft.irfft(power, len(values), axis=0))


def _describe(shifts: LineShifts, sizes: np.ndarray, lines: Lines, step: int) -> LineDisplacement:
    """Describe what lines have in common; `sizes`, (2,), are reference px per px along and across the lines."""
    kinds = (shifts, shifts.slopes())
    displaced = [one.are_displaced(sizes) for one in kinds]
    shown = [k for k in (0, 1) if displaced[k][0]] or [int(displaced[1][1] > displaced[0][1])]
    variance = [kinds[k].variance(sizes) for k in shown]
    along, across = np.sqrt(np.sum(variance, 0))
    most = shown[int(np.argmax([one.sum() for one in variance]))]
    return LineDisplacement(
        lines, any(one for one, _ in displaced), max(displaced[k][1] for k in shown), float(along), float(across),
        kinds[most].common() * sizes, shifts, tuple(bool(k) for k in shown if displaced[k][0]), step,
    )  # fmt: skip

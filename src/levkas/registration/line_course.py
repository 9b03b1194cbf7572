"""Course of displaced lines along the scan: what the parts of lines have in common, and which period, comb or step it is.

Shifts of the parts of a line are sums of what the line does as a whole and of errors that are independent from part to part. So
the covariance of parts along the scan is the variance of the common displacement, free of noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np

Pairs = tuple[np.ndarray, np.ndarray]
"""Numbers of the first and of the second part of each pair."""


@dataclass(frozen=True)
class CourseSettings:
    """Constants of the course.

    Parameters
    ----------
    least_lines : int
        That are registered in two parts at least.
    degree : int
        Of the polynomial along the scan that is taken out of each part: a map is off smoothly, too.
    stray : float
        In typical shifts, the median of all: so far out a shift has half its weight.
    least_deviations, least_slope, least_step : float
        Covariance of the parts, that of the slopes, and height of a step, in standard deviations by chance, from which lines
        are displaced. Of 250 honest pairs, real and simulated, few covariances had more than 2, and slopes, which two pairs of
        parts show where six show the mean, 4 at most.
    common_edges, averaged : float; int, lines
        Mean correlation, along the scan, of how much detail the parts show, averaged over some lines, from which they are no
        independent witnesses: below 0.1 of 95 % of painted scans, 0.25 to 0.8 of nine in ten grids of tiles, 0.15 to 0.5 of
        icons whose frames run along the lines.
    most_beside, noise_information : float; float, 1/px²
        Share of the lines that may lie beside such edges, and median information of the others, so that these
        count: on icons 8 to 40 % and 9 to 27, of the lines between tiles 1 to 8, as noise that is matched with noise has. Of
        some lines that alone are displaced, at the rim of what both pictures show, less is left out, too.
    beside_weight : float
        Of lines beside such edges.
    edge_lines : int
        So far from an edge along the lines other sharpness and noise feign a displacement. On grids of tiles that explains
        half of the covariance and more, of painted scans 0.23 at most.
    outer, few : float
        Share of the covariance that the two outer parts have at least, and that is left without the share of lines, `few`,
        that have most of it: else some lines alone are displaced.
    near_lines, gap_lines : int
        That are averaged to find these lines. Of single ones, noise would choose: without a tenth of them 0.2 to 0.4 of a
        weak wobble is left, without a tenth of means of seven 0.5 to 0.75, and 0.2 of a few lines; of 5 or 13 the same.
        Such lines that are closer than `gap_lines` belong together.
    aside : float
        Share of the covariance of such lines that their mean has, for them to lie aside as one.
    least_share : float
        Of the covariance that one period explains, for it to be named.
    comb_lines : float
        Period up to which odd and even lines are apart.
    block, most_of_blocks, block_share : int, lines; float, reference px; float
        Side of the blocks of JPEG; the displacement that they feign at most: 0.1 at quality 50, 0.27 at 15; how much more
        of the covariance they explain than one period.
    beside, steps : int
        Lines on either side of a step that are averaged; places up to which steps are named.
    least_height, step_factor, tall, alike : float
        A step is so much larger than the root mean square of all displacements, and than the median of all such
        differences; what reaches `tall` of it counts as one more; every part has `alike` of it at least.
    """

    least_lines: int = 32
    degree: int = 3
    stray: float = 8.0
    least_deviations: float = 4.0
    least_slope: float = 6.0
    least_step: float = 6.0
    common_edges: float = 0.15
    averaged: int = 3
    edge_lines: int = 8
    most_beside: float = 0.4
    noise_information: float = 8.0
    beside_weight: float = 0.05
    outer: float = 0.4
    few: float = 0.1
    near_lines: int = 7
    gap_lines: int = 24
    aside: float = 0.6
    least_share: float = 0.5
    comb_lines: float = 2.2
    block: int = 8
    most_of_blocks: float = 0.3
    block_share: float = 0.15
    beside: int = 8
    steps: int = 2
    least_height: float = 2.0
    step_factor: float = 5.0
    tall: float = 0.7
    alike: float = 0.6


SETTINGS = CourseSettings()


@dataclass(frozen=True)
class Course:
    """Course of a displacement along the scan.

    Parameters
    ----------
    kind : {"period", "comb", "step", "aside", "irregular"}
        Of a comb odd and even lines are apart; some lines alone lie aside.
    size : float, reference px
        Amplitude of the period; distance of odd from even lines; height of the step; how far lines lie aside; else the
        root mean square. Of lines that turn or stretch, at their ends.
    period : float, lines
        Of a period or a comb, else NaN.
    place, last : int
        First line behind the step, or first and last of the lines that alone are displaced, else -1.
    beside : Course or None
        A second period or comb.
    """

    kind: Literal["period", "comb", "step", "aside", "irregular"]
    size: float
    period: float = np.nan
    place: int = -1
    last: int = -1
    beside: Course | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, JSON-ready."""
        return {
            "course": self.kind,
            "size_px": round(self.size, 4),
            "period_lines": round(self.period, 2) if self.period > 0 else None,
            "place": self.place if self.place >= 0 else None,
            "last": self.last if self.last >= 0 else None,
            "beside": self.beside and self.beside.to_dict(),
        }


def find_course(shifts: LineShifts, sizes: np.ndarray) -> tuple[Course | None, float]:
    """Return the course of what parts of lines have in common, None where that is chance, and its deviations by chance.

    `sizes`, (2,), are reference px per px along and across the lines.
    """
    variance = shifts.covariance()
    deviations = variance / np.maximum(shifts.by_chance(), 1e-30)
    most = float(deviations.max())
    axis = int(deviations.argmax())
    needed = SETTINGS.least_slope if shifts.spread < 1 else SETTINGS.least_deviations
    displaced = most >= needed and _has_outer_parts(shifts, axis) and not _is_feigned(shifts, sizes)
    some = _displaced_lines(shifts, axis) if displaced else None
    if some and np.median(shifts.information[some, :, axis]) < SETTINGS.noise_information:
        return find_course(shifts.leaving_out(some), sizes)
    course = _find_course_of_some(shifts, sizes, some) if some else None
    if course and course.kind == "aside":
        return course, most
    # Of slopes there are two independent ones, too few to agree on a step; a covariance they have.
    step = _find_step(shifts, sizes) if shifts.spread == 1 else None
    least = SETTINGS.least_height * _rms(shifts, sizes)
    if step and step[1] >= SETTINGS.least_step and step[0].size > least:
        return step[0], max(most, step[1])
    if not displaced:
        return None, most
    return course or _find_period(shifts, sizes), most


@dataclass(frozen=True)
class LineShifts:
    """Shifts of the parts of lines about their course along the scan, (lines, parts, 2) px.

    `information` is that of each, 1/px², 0 where unknown; `weight` the same, less of shifts that stray. Edges that run along the
    lines through all parts, as of a frame, a chart or a grid of tiles, move what lies beside them where sharpness differs, in
    all parts alike: across the lines, lines beside them weigh next to nothing. `common_edges` says whether nothing else is
    left: then those shifts are 0. `places` are the middles of the parts, -1 to 1 along the line; `spread` is
    the root mean square over a line of a displacement that is 1 px where it is stated: less than 1 of `slopes`, which are stated
    at the ends. `ends`, px along the line, are the places -1 and 1.
    """

    shift: np.ndarray
    information: np.ndarray
    weight: np.ndarray
    places: np.ndarray
    common_edges: bool = False
    spread: float = 1.0
    ends: tuple[float, float] = (-1.0, 1.0)

    @classmethod
    def of(
        cls,
        shift: np.ndarray,
        information: np.ndarray,
        middles: np.ndarray,
        ends: tuple[float, float],
    ) -> LineShifts | None:
        """Return shifts, (lines, parts, 2) px, of parts with `middles`, (parts,) px, beside a smooth course of each part; None where too few lines have two parts."""
        measured = (information > 0).all(2).sum(1) >= 2
        if measured.sum() < SETTINGS.least_lines:
            return None
        left, weight = _without_course(shift, information)
        beside = _beside_common_edges(information[..., 1])
        if common_edges := bool(beside.all()):
            left[..., 1] = 0.0
        else:  # they carry the course of lines where nothing else is known
            weight[beside, :, 1] *= SETTINGS.beside_weight
        places = (2 * middles - ends[0] - ends[1]) / (ends[1] - ends[0])
        known = np.where(weight > 0, information, 0.0)
        return cls(left, known, weight, places, common_edges, ends=ends)

    def slopes(self) -> LineShifts:
        """Return what lines do that turn (across) or stretch (along) about their middle, at their ends.

        The outermost parts and the next ones show it independently, whatever they have in common.
        """
        count = len(self.places)
        pairs = [(k, count - 1 - k) for k in range(count // 2)]
        a, b = (self.shift[:, list(k)] for k in zip(*pairs, strict=True))
        apart = np.array([self.places[j] - self.places[i] for i, j in pairs])[:, None]

        def of_both(known: np.ndarray) -> np.ndarray:
            one, other = (known[:, list(k)] for k in zip(*pairs, strict=True))
            return np.asarray(apart**2 * one * other / np.maximum(one + other, 1e-30))

        known, weight = of_both(self.information), of_both(self.weight)
        slope = np.where(known > 0, (b - a) / apart, 0.0)
        places = np.zeros(len(pairs))
        return LineShifts(slope, known, weight, places, self.common_edges, 3**-0.5, self.ends)

    @property
    def pairs(self) -> Pairs:
        """All pairs of parts."""
        first, second = np.array(list(combinations(range(self.shift.shape[1]), 2))).T
        return first, second

    @property
    def outer(self) -> Pairs:
        """The pair of the outermost parts."""
        return np.array([0]), np.array([self.shift.shape[1] - 1])

    @property
    def common(self) -> np.ndarray:
        """Mean over the parts, (lines, 2); NaN where nothing is known."""
        total = self.weight.sum(1)
        with np.errstate(invalid="ignore"):
            return np.asarray(
                (self.weight * self.shift).sum(1) / np.where(total > 0, total, np.nan)
            )

    def products(self, pairs: Pairs | None = None) -> np.ndarray:
        """Return the weighted products of pairs of parts, (lines, pairs, 2)."""
        a, b = (self.shift[:, k] for k in pairs or self.pairs)
        return np.asarray(self._both(pairs) * a * b)

    def covariance(self, pairs: Pairs | None = None) -> np.ndarray:
        """Return the variance of what parts have in common along the scan, (2,), px²; of all pairs of parts or some."""
        weight = self._both(pairs).sum((0, 1))
        return np.asarray(self.products(pairs).sum((0, 1)) / np.maximum(weight, 1e-30))

    def by_chance(self, pairs: Pairs | None = None) -> np.ndarray:
        """Return the standard deviation of that covariance where parts have nothing in common, (2,), px²."""
        a, b = (self.shift[:, k] for k in pairs or self.pairs)
        root, lines = np.sqrt(self._both(pairs)), len(self.shift)
        apart = np.where(root > 0, a - b, 0.0) / np.sqrt(2)
        products, weights = (_autocorrelation(x).sum(1) for x in (root * apart, root))
        far = slice(lines // 8, lines // 2)
        found = products[far] / np.maximum(weights[far], 1e-30)
        return np.asarray(np.sqrt(np.mean(np.square(found), 0)))

    def among(self, lines: slice) -> LineShifts:
        """Return some lines alone."""
        shift, information = self.shift[lines], self.information[lines]
        return replace(self, shift=shift, information=information, weight=self.weight[lines])

    def leaving_out(self, lines: slice) -> LineShifts:
        """Return the same, of which some lines are not known."""
        information, weight = self.information.copy(), self.weight.copy()
        information[lines] = weight[lines] = 0.0
        return replace(self, information=information, weight=weight)

    def without(self, course: np.ndarray) -> LineShifts:
        """Return what is left of the shifts beside a common course, (lines, 2)."""
        return replace(self, shift=self.shift - course[:, None])

    def _both(self, pairs: Pairs | None = None) -> np.ndarray:
        """Return the weight of every pair of parts, (lines, pairs, 2)."""
        a, b = (self.weight[:, k] for k in pairs or self.pairs)
        return np.sqrt(a * b)


def _autocorrelation(values: np.ndarray) -> np.ndarray:
    """Return the sums of products with all shifts along the scan, circular, of the same shape."""
    power = np.abs(np.fft.rfft(values, axis=0)) ** 2
    return np.asarray(np.fft.irfft(power, len(values), axis=0))


def _without_course(shift: np.ndarray, information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Take a smooth course along the scan out of every part, robustly: maps err smoothly, relief and noise do not.

    Returns what is left and its weight, which is less where a part strays from the others of its line.
    """
    lines, parts, _ = shift.shape
    basis = np.polynomial.legendre.legvander(np.linspace(-1, 1, lines), SETTINGS.degree)
    left, stray = np.full_like(shift, np.nan), np.full((parts, 2), np.inf)
    for part in range(parts):
        for axis in range(2):
            y, known = shift[:, part, axis], information[:, part, axis]
            measured = known > 0
            if measured.sum() < SETTINGS.least_lines:
                continue
            w = known
            for _ in range(3):
                weighted = basis * w[:, None]
                gram = weighted.T @ basis + 1e-9 * w.max() * np.eye(basis.shape[1])
                rest = y - basis @ np.linalg.solve(gram, weighted.T @ y)
                typical = 1.4826 * float(np.median(np.abs(rest[measured]))) + 1e-6
                w = known / (1 + (rest / (SETTINGS.stray * typical)) ** 2)
            left[measured, part, axis], stray[part, axis] = rest[measured], SETTINGS.stray * typical
    known = np.isfinite(left)
    middle = np.nanmedian(np.where(known.any(1, keepdims=True), left, 0.0), 1, keepdims=True)
    apart = np.where(known, left - middle, 0.0)
    stray = stray + (1 - SETTINGS.alike) * np.abs(middle)
    weight = np.where(known, information / (1 + (apart / stray) ** 2), 0.0)
    return np.where(known, left, 0.0), weight


def _beside_common_edges(information: np.ndarray) -> np.ndarray:
    """Return which lines, (lines,), lie beside edges that run along them through all parts; all of them where nothing else is known.

    The line of which all parts, (lines, parts) 1/px², show most or least detail is left out with its neighbours, until parts show
    their detail in different lines. What then is left between edges may be noise, which a match with noise seems to know to
    half a pixel.
    """
    lines = len(information)
    whole = (information > 0).all(1)
    beside = np.zeros(lines, bool)
    while (left := whole & ~beside).sum() >= SETTINGS.least_lines:
        number, common, correlation = _common_detail(information, left)
        if not correlation >= SETTINGS.common_edges:  # or NaN, of detail that is even
            known = not beside.any() or np.median(information[left]) > SETTINGS.noise_information
            return beside if known else np.ones(lines, bool)
        edge = number[np.abs(common).argmax()]
        beside[max(0, edge - SETTINGS.edge_lines) : edge + SETTINGS.edge_lines + 1] = True
        if (whole & beside).sum() > SETTINGS.most_beside * whole.sum():
            break
    return beside if not beside.any() else np.ones(lines, bool)


def _common_detail(
    information: np.ndarray, lines: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return by how much more detail than along a smooth course all parts show in some lines, their numbers, and the correlation of the parts."""
    number = np.flatnonzero(lines)
    windows = np.lib.stride_tricks.sliding_window_view(information[number], SETTINGS.averaged, 0)
    detail = np.log(windows.mean(-1))
    basis = np.polynomial.legendre.legvander(np.linspace(-1, 1, len(detail)), SETTINGS.degree)
    rest = detail - basis @ np.linalg.lstsq(basis, detail, rcond=None)[0]
    half = SETTINGS.averaged // 2
    above = np.triu_indices(rest.shape[1], 1)
    correlation = float(np.corrcoef(rest.T)[above].mean())
    return number[half : len(number) - half], rest.mean(1), correlation


def _has_outer_parts(shifts: LineShifts, axis: int) -> bool:
    """Return whether the outer parts are displaced too, along `axis`, as far as their noise shows; a ledge displaces the parts within it."""
    least = SETTINGS.outer * shifts.covariance()[axis]
    outer = shifts.covariance(shifts.outer)[axis] + shifts.by_chance(shifts.outer)[axis]
    return bool(outer > least)


def _displaced_lines(shifts: LineShifts, axis: int) -> slice | None:
    """Return the lines that alone are displaced along `axis`, those that have most of it where they lie apart; None where lines are everywhere."""
    products = shifts.products()[..., axis].sum(1)
    near = np.convolve(products, np.ones(SETTINGS.near_lines), "same")
    most = np.abs(near) > np.quantile(np.abs(near), 1 - SETTINGS.few)
    rest = replace(shifts, weight=np.where(most[:, None, None], 0.0, shifts.weight))
    if rest.covariance()[axis] > SETTINGS.outer * shifts.covariance()[axis]:
        return None
    far = np.flatnonzero(near > SETTINGS.few * near.max())
    groups = np.split(far, np.flatnonzero(np.diff(far) > SETTINGS.gap_lines) + 1)
    half = SETTINGS.near_lines // 2
    first, last = max(groups, key=lambda g: products[g[0] : g[-1] + 1].sum())[[0, -1]]
    return slice(int(first) + half, int(max(last - half, first + half)) + 1)


def _find_course_of_some(shifts: LineShifts, sizes: np.ndarray, lines: slice) -> Course:
    """Return the course of lines that alone are displaced."""
    some = shifts.among(lines)
    mean = np.nanmean(some.common, 0)
    place, last = lines.start, lines.stop - 1
    if np.square(mean * sizes).sum() > SETTINGS.aside * _rms(some, sizes) ** 2:
        return Course("aside", float(np.hypot(*(mean * sizes))), place=place, last=last)
    return replace(_find_period(some, sizes), place=place, last=last)


def _find_step(shifts: LineShifts, sizes: np.ndarray) -> tuple[Course, float] | None:
    """Return the largest step along the scan and how many standard deviations it has; None where parts disagree on it.

    The median of some lines before a line is taken from that of as many behind it, part by part.
    """
    beside = SETTINGS.beside
    windows = np.lib.stride_tricks.sliding_window_view
    known = shifts.information
    shown = windows(np.where(known > 0, shifts.shift, np.nan), beside, 0)
    medians = np.median(shown, -1)
    scatter = 1.4826 * np.median(np.abs(shown - medians[..., None]), -1)
    sure = windows(known, beside, 0).sum(-1)
    heights = (medians[beside:] - medians[:-beside]) * sizes
    sure = np.minimum(sure[beside:], sure[:-beside]).min((1, 2))
    measured = np.isfinite(heights).all((1, 2))
    if measured.sum() < SETTINGS.least_lines:
        return None
    # Parts that scatter much there show no step: a median of n values has pi/2n of their variance.
    local = np.square(scatter[beside:]) + np.square(scatter[:-beside])
    local = np.sqrt(np.pi / 2 / beside * local.sum(1)) * sizes / known.shape[1]
    heights, sure, local = heights[measured], sure[measured], local[measured]
    a, b = (heights[:, k] for k in shifts.pairs)
    noise = 1.4826 * np.median(np.abs(a - b), (0, 1)) / np.sqrt(2 * heights.shape[1])
    common = heights.mean(1) * np.sqrt(np.minimum(sure / np.median(sure), 1.0))[:, None]
    length = np.hypot(*common.T)
    best = int(length.argmax())
    height = float(np.hypot(*heights[best].mean(0)))
    way = common[best] / max(float(length[best]), 1e-30)
    tall = np.diff((length > SETTINGS.tall * length[best]).astype(int), prepend=0) == 1
    alone = tall.sum() <= SETTINGS.steps and length[best] > SETTINGS.step_factor * np.median(length)
    stray = 1.4826 * np.median(np.abs(heights - heights.mean(1, keepdims=True)), 0)
    if not alone or (heights[best] @ way + stray @ np.abs(way)).min() < SETTINGS.alike * height:
        return None
    noise = np.maximum(noise, local[best])
    deviations = float(length[best]) / max(float(np.hypot(*(way * noise))), 1e-30)
    near = beside + int(np.flatnonzero(measured)[best]) + np.arange(-beside, beside + 1)
    line, course = np.arange(len(shifts.shift)), shifts.common * sizes
    # Medians are flat beside the step: its place is where it explains most.
    fits = [_fit_beside_cubic((line >= place)[:, None].astype(float), course) for place in near]
    chosen = int(np.argmin([rest for _, rest in fits]))
    return Course("step", float(np.hypot(*fits[chosen][0][0])), place=int(near[chosen])), deviations


def _fit_beside_cubic(basis: np.ndarray, common: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the amounts, (k, 2), of basis functions, (lines, k), in a common course, beside a cubic, and the squares left."""
    cubic = np.polynomial.legendre.legvander(np.linspace(-1, 1, len(basis)), SETTINGS.degree)
    known = np.isfinite(common).all(1)
    both = np.hstack([basis, cubic])[known]
    amounts = np.linalg.lstsq(both, common[known], rcond=None)[0]
    rest = float(np.square(common[known] - both @ amounts).sum())
    return amounts[: basis.shape[1]], rest


def _is_feigned(shifts: LineShifts, sizes: np.ndarray) -> bool:
    """Return whether a coder's blocks or edges along the lines explain what parts have in common.

    Blocks of JPEG move what lies at their borders by a tenth of a pixel, every eighth line alike.
    """
    lines = np.arange(len(shifts.shift))[:, None]
    eighths = lines % SETTINGS.block == np.arange(SETTINGS.block - 1)
    blocks, _ = _share_of(eighths.astype(float), shifts, sizes)
    least = max(SETTINGS.least_share, _take_wave(shifts, sizes)[1] + SETTINGS.block_share)
    if blocks > least and _rms(shifts, sizes) < SETTINGS.most_of_blocks:
        return True
    return _share_of(_beside_edges(shifts), shifts, sizes)[0] > SETTINGS.least_share


def _rms(shifts: LineShifts, sizes: np.ndarray) -> float:
    """Return the root mean square of what parts have in common, reference px."""
    return float(np.sqrt((shifts.covariance() * sizes**2).clip(0).sum()))


def _find_period(shifts: LineShifts, sizes: np.ndarray) -> Course:
    """Return the period that explains most of what parts have in common, and a second one beside it, or an irregular course."""
    lines = len(shifts.shift)
    irregular = Course("irregular", _rms(shifts, sizes))
    if lines < SETTINGS.least_lines:
        return irregular
    frequency, share, first, rest = _take_wave(shifts, sizes)
    other, share_of_rest, second, _ = _take_wave(rest, sizes)
    left = float((rest.covariance() / np.maximum(rest.by_chance(), 1e-30)).max())
    sure = share_of_rest > SETTINGS.least_share and left > SETTINGS.least_deviations
    if sure and not _is_overtone(other, frequency, lines):
        largest, less = sorted((first, second), key=lambda one: -one.size)
        return replace(largest, beside=less)
    return first if share > SETTINGS.least_share else irregular


def _take_wave(shifts: LineShifts, sizes: np.ndarray) -> tuple[float, float, Course, LineShifts]:
    """Return frequency, share of the covariance and course of the sine that parts have most in common, and what is left."""
    lines = len(shifts.shift)
    padded = 8 * lines
    measured = shifts.weight.min(2) > 0
    waves = np.fft.rfft(np.where(measured[..., None], shifts.shift, 0.0) * sizes, padded, axis=0)
    a, b = (waves[:, k] for k in shifts.pairs)
    power = (a * np.conj(b)).real.sum((1, 2))
    power[: padded // lines] = 0  # less than one period
    frequency = max(float(power.argmax()), 1.0) / padded
    phase = 2 * np.pi * frequency * np.arange(lines)[:, None]
    basis = np.hstack([np.cos(phase), np.sin(phase)])
    share, wave = _share_of(basis, shifts, sizes)
    size, period = float(np.linalg.svd(wave * sizes, compute_uv=False)[0]), 1 / frequency
    is_comb = period < SETTINGS.comb_lines
    course = Course("comb", 2 * size, period) if is_comb else Course("period", size, period)
    return frequency, share, course, shifts.without(basis @ wave)


def _is_overtone(frequency: float, of: float, lines: int) -> bool:
    """Return whether one frequency, 1/lines, is two to four times another one, as in a saw-tooth, or the same."""
    times = np.arange(1, 5)
    return bool(
        min(np.abs(frequency - times * of).min(), np.abs(of - times * frequency).min()) < 1 / lines
    )


def _beside_edges(shifts: LineShifts) -> np.ndarray:
    """Return courses, (lines, k), that are odd about edges along the lines: where more detail lies behind a line than before it."""
    known = shifts.information[..., 1].sum(1)
    detail = np.log(known + 0.05 * np.median(known) + 1e-30)
    near = range(1, SETTINGS.edge_lines + 1)
    courses = np.stack([np.roll(detail, -n) - np.roll(detail, n) for n in near], 1)
    courses[: SETTINGS.edge_lines] = courses[-SETTINGS.edge_lines :] = 0.0
    return courses


def _share_of(basis: np.ndarray, shifts: LineShifts, sizes: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the share of the covariance that basis functions, (lines, k), explain, and their amounts, (k, 2)."""
    amounts, _ = _fit_beside_cubic(basis, shifts.common)
    course = basis @ amounts
    total, rest = (
        float((one.covariance() * sizes**2).clip(0).sum())
        for one in (shifts, shifts.without(course - course.mean(0)))
    )
    return 1 - rest / max(total, 1e-30), amounts

"""Displacement of lines along the scan: what the parts of lines have in common, beyond chance.

Shifts of the parts of a line are sums of what the line does as a whole and of errors that are independent from part to part. So
the covariance of parts along the scan is the variance of the common displacement, free of noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

Pairs = tuple[np.ndarray, np.ndarray]
"""Numbers of the first and of the second part of each pair."""


@dataclass(frozen=True)
class CourseSettings:
    """Constants of the course."""

    least_lines: int = 32
    """That are registered in two parts at least."""
    degree: int = 3
    """Of the polynomial along the scan that is taken out of each part: a map is off smoothly, too."""
    stray: float = 8.0
    """In typical shifts, the median of all: so far out a shift has half its weight."""
    least_deviations: float = 4.0
    least_slope: float = 6.0
    """`least_deviations`, `least_slope`: covariance of the parts, and that of the slopes, in standard deviations by chance,
    from which lines are displaced. Of 250 honest pairs, real and simulated, few covariances had more than 2, and slopes,
    which two pairs of parts show where six show the mean, 4 at most."""
    common_edges: float = 0.15
    averaged: int = 3
    """`common_edges`, `averaged`: in lines: mean correlation, along the scan, of how much detail the parts show, averaged
    over some lines, from which they are no independent witnesses: below 0.1 of 95 % of painted scans, 0.25 to 0.8 of nine
    in ten grids of tiles, 0.15 to 0.5 of icons whose frames run along the lines."""
    edge_lines: int = 8
    """So far from an edge along the lines other sharpness and noise feign a displacement. On grids of tiles that explains
    half of the covariance and more, of painted scans 0.23 at most."""
    most_beside: float = 0.4
    noise_information: float = 8.0
    """`most_beside`, `noise_information`: 1/px². Share of the lines that may lie beside such edges, and median information
    of the others, so that these count: on icons 8 to 40 % and 9 to 27, of the lines between tiles 1 to 8, as noise that
    is matched with noise has. Of some lines that alone are displaced, at the rim of what both pictures show, less is left
    out, too."""
    beside_weight: float = 0.05
    """Of lines beside such edges."""
    outer: float = 0.4
    few: float = 0.1
    """`outer`, `few`: share of the covariance that the two outer parts have at least, and that is left without the share of
    lines, `few`, that have most of it: else some lines alone are displaced."""
    near_lines: int = 7
    gap_lines: int = 24
    """`near_lines`, `gap_lines`: that are averaged to find these lines. Of single ones, noise would choose: without a tenth
    of them 0.2 to 0.4 of a weak wobble is left, without a tenth of means of seven 0.5 to 0.75, and 0.2 of a few lines; of
    5 or 13 the same. Such lines that are closer than `gap_lines` belong together."""
    least_share: float = 0.5
    """Of the covariance that blocks, or edges along the lines, explain, for it to be theirs."""
    block: int = 8
    most_of_blocks: float = 0.3
    """`block`, `most_of_blocks`: in lines; float, reference px: side of the blocks of JPEG; the displacement that they feign
    at most: 0.1 at quality 50, 0.27 at 15."""
    alike: float = 0.6
    """A part that lies off the middle of all by more than this is left of it strays."""


SETTINGS = CourseSettings()


def find_displacement(shifts: LineShifts, sizes: np.ndarray) -> tuple[bool, float]:
    """Return whether lines are displaced beyond chance, and the covariance of their parts in deviations by chance.

    `sizes`, (2,), are reference px per px along and across the lines.
    """
    deviations = shifts.covariance() / np.maximum(shifts.by_chance(), 1e-30)
    most, axis = float(deviations.max()), int(deviations.argmax())
    needed = SETTINGS.least_slope if shifts.spread < 1 else SETTINGS.least_deviations
    if most < needed or not _has_outer_parts(shifts, axis) or _is_feigned(shifts, sizes):
        return False, most
    some = _displaced_lines(shifts, axis)
    if some and np.median(shifts.information[some, :, axis]) < SETTINGS.noise_information:
        return find_displacement(shifts.leaving_out(some), sizes)
    return True, most


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


def _is_feigned(shifts: LineShifts, sizes: np.ndarray) -> bool:
    """Return whether a coder's blocks or edges along the lines explain what parts have in common.

    Blocks of JPEG move what lies at their borders by a tenth of a pixel, every eighth line alike; odd and even lines that lie apart do not.
    """
    lines = np.arange(len(shifts.shift))[:, None]
    eighths = lines % SETTINGS.block == np.arange(SETTINGS.block - 1)
    rms = float(np.sqrt((shifts.covariance() * sizes**2).clip(0).sum()))
    blocks, halves = (
        _share_of(basis.astype(float), shifts, sizes) for basis in (eighths, lines % 2)
    )
    if blocks - halves > SETTINGS.least_share and rms < SETTINGS.most_of_blocks:
        return True
    return _share_of(_beside_edges(shifts), shifts, sizes) > SETTINGS.least_share


def _beside_edges(shifts: LineShifts) -> np.ndarray:
    """Return courses, (lines, k), that are odd about edges along the lines: where more detail lies behind a line than before it."""
    known = shifts.information[..., 1].sum(1)
    detail = np.log(known + 0.05 * np.median(known) + 1e-30)
    near = range(1, SETTINGS.edge_lines + 1)
    courses = np.stack([np.roll(detail, -n) - np.roll(detail, n) for n in near], 1)
    courses[: SETTINGS.edge_lines] = courses[-SETTINGS.edge_lines :] = 0.0
    return courses


def _share_of(basis: np.ndarray, shifts: LineShifts, sizes: np.ndarray) -> float:
    """Return the share of the covariance that basis functions, (lines, k), explain beside a cubic."""
    cubic = np.polynomial.legendre.legvander(np.linspace(-1, 1, len(basis)), SETTINGS.degree)
    common = shifts.common
    known = np.isfinite(common).all(1)
    amounts = np.linalg.lstsq(np.hstack([basis, cubic])[known], common[known], rcond=None)[0]
    course = basis @ amounts[: basis.shape[1]]
    total, rest = (
        float((one.covariance() * sizes**2).clip(0).sum())
        for one in (shifts, shifts.without(course - course.mean(0)))
    )
    return 1 - rest / max(total, 1e-30)

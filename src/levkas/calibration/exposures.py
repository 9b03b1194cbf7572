"""Several exposures of one scene: whether their counts are in the ratio of their times; the best of them, or all merged into counts a second.

Linearity: y(g, t) = C(g)·t + offset for groups g of pixels of like brightness, fitted so that Σ(Δy/y)² is least over 5–95 % of
saturation; what is left, relative, is the deviation. Whether it is the sensor's or that of wrong times is whether it depends on
the level at one exposure (`find_bend`). Two traps, both met in real series: a group must not be chosen by its own noise, or it
comes back to the mean in the next exposure, so pixels are ranked by their neighbours of the same colour; and a dim sensel beside a
bright one holds some of its light (0.7 % in a Bayer sensor behind a 550 nm filter) until that one is full, and no more after.

Merging weighs each exposure by the inverse of its variance, wᵢ = tᵢ²/(gain·C·tᵢ + read²), with the rate C of the round before
(Granados 2010, doi:10.1109/CVPR.2010.5540208); what saturates is left out pixel by pixel, and what lies next to it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from levkas.calibration.darks import MatchedDark, dark_under
from levkas.calibration.findings import Finding, refusal
from levkas.calibration.flatfield import require_dark
from levkas.calibration.motion import find_moved_between
from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.record import WithError
from levkas.calibration.templates import (
    ShotLevels,
    Template,
    as_marks,
    as_rows,
    read_only,
    union_of,
)
from levkas.core.compiled import njit
from levkas.core.threads import in_threads

USED, MANY_ROWS = (0.05, 0.95), 600
"""Of saturation, as EMVA 1288 has it; rows of a frame: the rest adds nothing to means that are known to 0.1 %."""
GROUPS, FEWEST = 20, 50
"""Of pixels of like brightness; pixels of a group."""
RECIPROCAL, CURVED, SIGMAS = 0.01, 0.003, 4.0
"""Rms up to which one exposure may be scaled to the time of another; of the light, relative, from which a curve counts; deviations
of a bend, or of an offset, to be one."""
ALIKE, EVEN = 1.15, 1.5
"""Contrast of the pixels of a group whose mean is a point of a curve; brightest over dimmest of eight neighbours: noise of a tenth makes as much."""
FEWEST_POINTS, LEAST_SPAN = 16, 2.0
"""Points of a curve; of counts at one exposure: an even white alone shows no bend."""
MOST_WEIGHT, OUTLIER = 0.1, 4.0
"""Of all pixels, of a group; usual deviations from a line, from which on a group moved."""
PERIOD = (2, 2)
"""Of mosaics, unless declared; plain sensors do not mind."""
BLACK_ERROR = 0.5
"""Counts, of a black level by a series, at most: a quarter of a small read noise."""
TOLERATED, USABLE = 1e-4, 0.98
"""Share of clipped pixels of the best exposure: hot pixels, a glint; of saturation: beyond it the response bends."""
NEARLY, BEYOND = 0.9, 1.1
"""Of saturation: shown at most, and predicted, by a sensel that is full before others."""
ROUNDS = 3
"""Of a merge: within 1 % of the Cramér–Rao bound over four decades."""
OF_NOISE, DIM = (24, 200, 500_000), 4.0
"""Groups whose noise two exposures show, pixels of one and in all; least variances of a group, beyond which it says little of noise without light."""


# --- linearity ------------------------------------------------------------------------------------


class Point(NamedTuple):
    """Mean counts above dark of a group of pixels at one exposure, s; how many they are, and of which series."""

    group: int
    time_s: float
    counts: float
    pixels: int = 1
    series: int = 0


@dataclass(frozen=True)
class Linearity:
    """How well exposures scale.

    `rms` and `worst`, with its sign, are relative deviations from the line, `worst_at_s` and `worst_level` where that is, s and counts
    above dark; `points` are groups times exposures behind them, 0 where nothing could be compared. `offset` are counts at exposure 0
    above what was subtracted, with its standard error. `levels` is the light of every exposure over what its time states, shortest first.
    """

    rms: float
    worst: float
    worst_at_s: float
    offset: float
    points: int
    worst_level: float = float("nan")
    offset_error: float = float("nan")
    levels: tuple[float, ...] = ()


def check_linearity(
    shots: Sequence[Template],
    darks: Template | Sequence[Template] | None = None,
    *,
    saturation: float,
    black: float | np.ndarray | None = None,
    fit_offset: bool = False,
    period: tuple[int, int] = PERIOD,
) -> Linearity:
    """Compare exposures of one still scene, of different known `exposure_s`, over 5 to 95 % of `saturation`, counts.

    An offset common to all is fitted where cameras that clip their darks at 0 hide one. A pixel takes part at the exposures at which neither it nor one beside it comes near saturation, predicted from the
    rates of its neighbours one `period`, (rows, columns), away. Pixels of like range and rate, by the same neighbours, make a group.
    """
    points = find_points(shots, darks, saturation=saturation, black=black, period=period)
    return _fit(points, fit_offset, sorted(shot.exposure_s or 0.0 for shot in shots))


def find_points(
    shots: Sequence[Template],
    darks: Template | Sequence[Template] | None = None,
    *,
    saturation: float,
    black: float | np.ndarray | None = None,
    period: tuple[int, int] = PERIOD,
    contrast: float = np.inf,
) -> list[Point]:
    """Return what exposures of one still scene have in common: groups of pixels, and their counts at each, as of `check_linearity`.

    `contrast` is that of the pixels of a group, at most: scaling commutes with the mean of any, a curve only with that of like pixels.
    """
    timed = sorted(shots, key=lambda shot: shot.exposure_s or 0.0)
    under = [dark_under(shot, darks, black=black).mean for shot in timed]
    pairs = zip(timed, under, strict=True)
    signal = np.array([(s.mean - u).astype(np.float32)[:MANY_ROWS] for s, u in pairs])
    usable = np.array([~shot.saturated[:MANY_ROWS] for shot in timed])
    times = np.array([shot.exposure_s for shot in timed], float)
    return _points(signal, usable, times, saturation, period, contrast)


def find_black(
    shots: Sequence[Template], darks: Sequence[Template], *, saturation: float
) -> WithError | None:
    """Return the counts at no time at all by which three exposures or more of a scene lie on a line; None where they are not sure."""
    if len(shots) < 3:
        return None
    found = check_linearity(shots, saturation=saturation, fit_offset=True)
    highest = float(np.median(darks[0].mean)) if darks else 0.0
    sure = found.rms <= CURVED and found.offset_error <= BLACK_ERROR
    if not sure or found.offset > highest + 3 * BLACK_ERROR:
        return None
    return WithError(counts=found.offset, error=found.offset_error)


class Bend(NamedTuple):
    """What exposure series show beside a line.

    `size` is by how much light is more than the counts of the highest level say, on the scale of the lowest, relative, with its standard
    error, infinite where there are too few points. `offset` are counts above dark where there is no light; 0 where not beyond four errors.
    """

    size: float = 0.0
    error: float = float("inf")
    offset: float = 0.0
    offset_error: float = float("inf")

    @property
    def is_sure(self) -> bool:
        """Whether the sensor is not linear: by more than 0.3 %, and four standard errors."""
        return abs(self.size) > max(CURVED, SIGMAS * self.error)


def find_bend(points: Sequence[Point], full: float) -> Bend:
    """Find the bend of a sensor in exposure series, whatever times its exposures really had.

    Points are of one or more series, from `find_points` with the contrast `ALIKE`, groups and series numbered apart; `full` is the full
    scale above dark, counts. log y = log C(g) + log t + δ(e) − a·y/full + o/y by least squares, of a group g and an exposure e whose light is off by a
    factor common to all levels: a lamp flickers, a shutter has other times than are stated. Whether δ and o are there is
    decided by the Bayesian information criterion [schwarz1978]_.

    >>> rows = [Point(g, t, g * t - 0.06 * (g * t) ** 2 / 4000) for g in range(300, 1500, 20) for t in (1.0, 2.0)]
    >>> bent = find_bend(rows, 4000.0)
    >>> bent.is_sure, round(bent.size, 3)
    (True, 0.05)
    >>> find_bend([p._replace(counts=p.group * (1.2 if p.time_s == 1 else 2.0)) for p in rows], 4000.0).is_sure
    False
    """
    often = Counter(point.group for point in points)
    points = [point for point in points if often[point.group] >= 2]
    if len(points) < FEWEST_POINTS:
        return Bend()
    named = np.array([(p.group, p.series, p.time_s, p.counts, p.pixels) for p in points], float)
    group = np.unique(named[:, 0], return_inverse=True)[1]
    which = np.unique(named[:, 1:3], axis=0, return_inverse=True)[1].ravel()
    counts, pixels = named[:, 3], named[:, 4]
    spans = (np.ptp(np.log(counts[which == one])) for one in range(which.max() + 1))
    if max(spans) < np.log(LEAST_SPAN):
        return Bend()
    weight = np.minimum(pixels, MOST_WEIGHT * pixels.sum())

    def rest(values: np.ndarray) -> np.ndarray:
        return np.asarray(values - (np.bincount(group, values) / np.bincount(group))[group])

    level = rest(np.log(counts) - np.log(named[:, 2]))
    exposures = range(1, which.max() + 1)
    factors = [rest((which == one).astype(float)) for one in exposures]
    bent, shifted = rest(-counts / full), rest(full / counts)
    left, columns = level, np.stack([bent, *factors, shifted], -1)
    for _ in range(20):  # least absolute deviations: what moved draws the fit little
        root = np.sqrt(weight / np.maximum(np.abs(left), 1e-4))
        found = np.linalg.lstsq(columns * root[:, None], level * root, rcond=None)[0]
        left = level - columns @ found
    usual = 1.4826 * float(np.median(np.abs(left)))
    kept = ~np.isin(group, group[np.abs(left) > max(OUTLIER * usual, CURVED)])
    root = np.sqrt(weight[kept] / weight[kept].mean())
    best, bend = np.inf, Bend()
    for more in ([], [shifted], factors, [*factors, shifted]):
        design = np.stack([bent, *more], -1)[kept] * root[:, None]
        freedom = len(design) - len(np.unique(group[kept])) - design.shape[1]
        if freedom < 1:
            continue
        found = np.linalg.lstsq(design, level[kept] * root, rcond=None)[0]
        square = float(np.sum(np.square(level[kept] * root - design @ found)))
        error = np.sqrt(np.diag(np.linalg.pinv(design.T @ design)) * square / freedom)
        criterion = len(design) * np.log(square) + design.shape[1] * np.log(len(design))
        if criterion < best:
            highest = float(counts[kept].max()) / full
            best, bend = criterion, Bend(float(found[0]) * highest, float(error[0]) * highest)
            if more and more[-1] is shifted and abs(found[-1]) > SIGMAS * error[-1]:
                bend = bend._replace(
                    offset=float(found[-1]) * full, offset_error=float(error[-1]) * full
                )
    return bend


def require_scaling(found: Linearity, code: str = "not_reciprocal") -> None:
    """Refuse to scale counts from one exposure to another where they do not scale, E_EXPOSURES, or where nothing could be compared.

    >>> require_scaling(Linearity(0.004, 0.006, 1.0, 0.0, 40))
    """
    if not found.points:
        raise refusal("linearity_unknown")
    if found.rms > RECIPROCAL:
        at = f"{found.worst_at_s:g} s and {found.worst_level:.0f} counts"
        raise refusal(code, f"worst {found.worst:+.1%} at {at}", found.rms, RECIPROCAL)


def doubt_scaling(taken: Sequence[float], other: Sequence[float], same: float) -> list[Finding]:
    """Report that counts are scaled from the white's times to the object's, s, without a series that shows that they scale."""
    if not taken or not other:
        return []
    if all(abs(mine / its - 1) <= same for mine, its in np.broadcast(taken, other)):
        return []
    ends = (sorted({min(times), max(times)}) for times in (other, taken))
    white, object_ = (" to ".join(f"{t:g}" for t in times) for times in ends)
    return [Finding("not_scaled", f"the white for {white} s, the object for {object_} s")]


def _around(rate: np.ndarray, known: np.ndarray, period: tuple[int, int]) -> np.ndarray:
    """Return the mean rate of the eight neighbours one period away, without the pixel itself."""
    rows, columns = period
    kernel = np.zeros((2 * rows + 1, 2 * columns + 1), np.float32)
    kernel[::rows, ::columns] = 1
    kernel[rows, columns] = 0
    planes = (np.ascontiguousarray(a, np.float32) for a in (np.where(known, rate, 0), known))
    total, count = (cv2.filter2D(a, -1, kernel, borderType=cv2.BORDER_CONSTANT) for a in planes)
    return (total / np.maximum(count, 1)).reshape(rate.shape)


def _points(
    signal: np.ndarray,
    usable: np.ndarray,
    times: np.ndarray,
    saturation: float,
    period: tuple[int, int],
    contrast: float,
) -> list[Point]:
    """Return the points of groups that are in range at an exposure."""
    # Codes of 12 bits in files of 16 use little of what could be: the largest is their scale.
    largest = float(signal.max(initial=0.0, where=usable))
    low = USED[0] * min(saturation, largest)
    high = USED[1] * saturation
    fits = usable & (signal < high)
    longest = len(times) - 1 - np.argmax(fits[::-1], 0)
    known = np.asarray(fits.any(0))
    rate = np.take_along_axis(signal, longest[None], 0)[0] / times[longest]
    key = np.where(known, _around(rate, known, period), 0).astype(np.float32)
    # Where even the shortest exposure is full nothing is predicted but that it is.
    bright = np.where(known, np.maximum(key, 0), np.float32(np.inf))
    brightest = cv2.dilate(bright, np.ones((3, 3), np.uint8)).reshape(bright.shape)
    clean = (brightest * times.reshape(-1, *[1] * key.ndim) < high).sum(0)
    whole = [usable[:n].all(0) for n in range(len(times) + 1)]
    rows: list[Point] = []
    for n in range(2, len(times) + 1):
        pixels = np.flatnonzero((clean == n) & whole[n] & (key > 0))
        pixels = pixels[np.argsort(key.flat[pixels], kind="stable")]
        parts = np.array_split(pixels, max(1, round(GROUPS * len(pixels) / key.size)))
        if np.isfinite(contrast):
            even = pixels[_is_even(rate, period).flat[pixels]]
            steps = np.floor(np.log(key.flat[even]) / np.log(contrast))
            parts = np.split(even, np.flatnonzero(np.diff(steps)) + 1)
        for members in (part for part in parts if len(part) >= FEWEST):
            group = len(rows)
            means = _middle_means(signal[:n].reshape(n, -1)[:, members])
            rows += [
                Point(group, float(t), float(mean), len(members))
                for t, mean in zip(times, means, strict=False)
                if low <= mean <= high
            ]
    return rows


def _is_even(rate: np.ndarray, period: tuple[int, int]) -> np.ndarray:
    """Return where the eight neighbours one period away are alike, but for noise: no edge."""
    rows, columns = period
    kernel = np.zeros((2 * rows + 1, 2 * columns + 1), np.uint8)
    kernel[::rows, ::columns] = 1
    kernel[rows, columns] = 0
    plane = np.ascontiguousarray(rate, np.float32)
    highest, lowest = (f(plane, kernel).reshape(rate.shape) for f in (cv2.dilate, cv2.erode))
    return np.asarray(highest < EVEN * lowest)


def _middle_means(values: np.ndarray) -> np.ndarray:
    """Return the means without the tenth at either end, exposure by exposure: what moved is left out.

    Scaling commutes with it, as with the mean itself; a median would be one code of coarse ones.
    """
    ordered = np.sort(values, axis=1)
    cut = values.shape[1] // 10
    return np.asarray(ordered[:, cut : values.shape[1] - cut].mean(1, dtype=float))


def _fit(rows: list[Point], fit_offset: bool, exposures: Sequence[float] = ()) -> Linearity:
    groups = [g for g, *_ in rows]
    rows = [row for row in rows if groups.count(row[0]) >= 2]
    if not rows:
        return Linearity(np.nan, np.nan, np.nan, 0.0, 0)
    found, which = np.unique([g for g, *_ in rows], return_inverse=True)
    times, signal = (np.array([row[i] for row in rows]) for i in (1, 2))
    design = np.zeros((len(rows), len(found) + int(fit_offset)))
    design[np.arange(len(rows)), which] = times
    design[:, len(found) :] = 1
    solved = np.linalg.lstsq(design / signal[:, None], np.ones(len(rows)), rcond=None)[0]
    miss = signal / (design @ solved) - 1
    worst = int(np.abs(miss).argmax())
    offset = float(solved[-1]) if fit_offset else 0.0
    rms = float(np.sqrt(np.mean(miss**2)))
    error = float("nan")
    if fit_offset:
        freedom, scaled = max(len(rows) - design.shape[1], 1), design / signal[:, None]
        square = np.linalg.pinv(scaled.T @ scaled)[-1, -1] * np.sum(miss**2) / freedom
        error = float(np.sqrt(square))
    at = float(times[worst]), offset, len(rows), float(signal[worst])
    # By their counts: an offset of all counts is no change of the light.
    of_times = [(signal[times == time], miss[times == time]) for time in exposures]
    levels = tuple(1 + float(own @ off) / max(float(own.sum()), 1.0) for own, off in of_times)
    return Linearity(rms, float(miss[worst]), *at, error, levels)


# --- one of several, or all ----------------------------------------------------------------------


def best_exposure(shots: Sequence[Template]) -> Template:
    """Return the longest exposure that is not saturated, but for a share of `TOLERATED`, else the one with the fewest saturated pixels.

    Raises CalibrationRefused, E_NO_FRAMES without a shot, E_EXPOSURES where an exposure is unknown.
    """
    timed = _in_order(shots)
    shares = [float(np.mean(shot.saturated)) for shot in timed]
    good = [shot for shot, share in zip(timed, shares, strict=True) if share <= TOLERATED]
    return good[-1] if good else timed[int(np.argmin(shares))]


@dataclass(frozen=True)
class Merged:
    """An exposure series in one.

    `template` has counts a second, `above_dark` (`exposure_s` 1.0), with the variance of the merge where the noise is known; saturated
    where no exposure was usable, and the shortest was taken; black where the longest usable one was clipped. `moved` is where the
    exposures disagree by more than their noise and non-linearity explain; None where the noise is not known.
    """

    template: Template
    linearity: Linearity
    moved: np.ndarray | None = None


def merge_exposures(
    shots: Sequence[Template],
    darks: Template | Sequence[Template] | None = None,
    *,
    saturation: float,
    black: float | np.ndarray | None = None,
    noise: NoiseModel | None = None,
    period: tuple[int, int] = PERIOD,
) -> Merged:
    """Merge two exposures or more of one still scene into counts a second; parameters are those of `check_linearity`.

    Raises CalibrationRefused, E_EXPOSURES with fewer than two exposures, unknown ones, or ones that do not scale.

    Beyond 98 % of `saturation` a value does not count; without the `noise` of one shot weights are those of shot noise alone, and no
    variance comes out. An offset common to all is fitted and subtracted where the darks were clipped at black over more than half
    of their pixels, and so say little about it. Three rounds from rate 0. PRNU stays out: it is the same in every exposure.
    An exposure counts next to sensels that are full in it only where no other does.

    >>> clear = np.zeros((1, 1), bool)
    >>> shots = [Template(np.full((1, 1), 100.0 * t, "f4"), None, 1, clear, clear, t) for t in (1, 4)]
    >>> merge_exposures(shots, saturation=4095).template.mean.tolist()
    [[100.0]]
    """
    timed = _in_order(shots)
    shapes, times = {shot.mean.shape for shot in timed}, {shot.exposure_s for shot in timed}
    if len(shapes) > 1 or not len(times) == len(timed) >= 2:
        listed = ", ".join(f"{shot.exposure_s:g} s {shot.mean.shape}" for shot in timed)
        raise refusal("not_a_series", listed)
    offered = [darks] if isinstance(darks, Template) else list(darks or ())
    fit_offset = hides_offset(offered)
    unders = [dark_under(shot, darks, black=black) for shot in timed]
    for shot, under in zip(timed, unders, strict=True):
        require_dark(shot, under, noise)
    scaling = check_linearity(
        timed, darks, saturation=saturation, black=black, fit_offset=fit_offset, period=period
    )
    if scaling.points:
        require_scaling(scaling, "not_linear")
    levels = [under.mean + np.float32(scaling.offset) for under in unders]
    early = zip(timed, _full_early(timed, levels, saturation), strict=True)
    full = [s.saturated | (s.mean > USABLE * saturation) | e for s, e in early]
    apart = [
        cv2.dilate(marks.astype(np.uint8), np.ones((3, 3), np.uint8)).reshape(marks.shape) > 0
        for marks in full
    ]
    allowed = noise
    if noise is not None:
        read, miss = read_variance_between(timed, levels, apart, noise.gain)
        more = max(read - noise.read_under(unders[0]), 0.0)
        noise = replace(noise, read_variance=noise.read_variance + more)
        allowed = replace(noise, read_variance=noise.read_variance + miss)
    template = _merge(timed, unders, apart, USABLE * saturation, scaling.offset, noise)
    template = replace(template, shots=_light_of_exposures(timed, scaling))
    moved = None
    if allowed is not None:
        reads = [allowed.read_under(under) for under in unders]
        moved = find_moved_between(
            timed, levels, template.mean, allowed, reads=reads, left_out=apart, period=period
        )
    return Merged(template, scaling, moved)


def hides_offset(darks: Sequence[Template]) -> bool:
    """Whether darks were clipped at black over more than half of their pixels: the level of such is fitted to the series itself."""
    return bool(darks) and all(np.mean(dark.black) > 0.5 for dark in darks)


def read_variance_between(
    timed: Sequence[Template],
    levels: Sequence[np.ndarray],
    left_out: Sequence[np.ndarray],
    gain: float,
) -> tuple[float, float]:
    """Estimate the noise without light of one shot, counts², by the shortest and the longest exposure, and the square of what `levels` miss.

    With ρ = t_s/t_l, the difference S − ρL has variance read²(1 + ρ²) + gain·S(1 + ρ), and is not correlated with ρS + L where read noise
    rules: by that pixels are sorted into groups, of whose dim ones the median counts, so that what moved does not. 0 of too few pixels.

    >>> rng = np.random.default_rng(1)
    >>> shots = [Template(rng.normal(100, 3, (99, 99)), None, 1, *2 * [np.zeros((99, 99), bool)], t)
    ...          for t in (1.0, 4.0)]
    >>> level, none = np.full((1, 1), 100.0), np.zeros((99, 99), bool)
    >>> [round(v) for v in read_variance_between(shots, [level] * 2, [none] * 2, 0.5)]
    [9, 0]
    """
    short, long = timed[0], timed[-1]
    ratio = (short.exposure_s or 0.0) / (long.exposure_s or 1.0)
    step = max(1, short.mean.size // OF_NOISE[2])
    good = ~(short.black | long.black | left_out[0] | left_out[-1]).ravel()[::step]
    ends = ((short, levels[0]), (long, levels[-1]))
    lit = [(s.mean - level).ravel()[::step][good].astype(float) for s, level in ends]
    order = np.argsort(ratio * lit[0] + lit[1], kind="stable")
    apart, dim = (lit[0] - ratio * lit[1])[order], (ratio * lit[1])[order]
    parts = np.array_split(np.arange(len(order)), min(OF_NOISE[0], len(order) // OF_NOISE[1]) or 1)
    found = []
    for part in parts:
        if len(part) < OF_NOISE[1]:
            return 0.0, 0.0
        miss, variance = _middle(apart[part])
        light = gain * max(float(dim[part].mean()), 0.0)
        shots = 1 / short.count + ratio**2 / long.count
        read = (variance - light * (1 / short.count + ratio / long.count)) / shots
        found.append((variance, read, miss**2))
    table = np.array(found)
    table = table[table[:, 0] <= DIM * table[:, 0].min()]
    return max(float(np.median(table[:, 1])), 0.0), float(np.median(table[:, 2]))


def _middle(values: np.ndarray) -> tuple[float, float]:
    """Return mean and variance without what lies more than five deviations off."""
    kept = values
    for _ in range(20):
        inside = values[np.abs(values - np.median(kept)) <= 5 * max(kept.std(), 0.5)]
        if len(inside) == len(kept):
            break
        kept = inside
    return float(kept.mean()), float(kept.var())


def _full_early(
    timed: Sequence[Template], levels: Sequence[np.ndarray], saturation: float
) -> list[np.ndarray]:
    """Return where a sensel is full below the others' saturation, as a shorter exposure foretells."""
    full = [np.zeros(timed[0].mean.shape, bool)]
    rate = (timed[0].mean - levels[0]) / np.float32(timed[0].exposure_s or 1.0)
    for shot, level in zip(timed[1:], levels[1:], strict=True):
        time = np.float32(shot.exposure_s or 1.0)
        bright = shot.mean > NEARLY * saturation
        full.append(bright & (rate * time > BEYOND * saturation))
        rate = np.where(bright, rate, (shot.mean - level) / time)
    return full


def _merge(
    timed: list[Template],
    unders: list[MatchedDark],
    apart: list[np.ndarray],
    full: float,
    offset: float,
    noise: NoiseModel | None,
) -> Template:
    shape = as_rows(timed[0].mean).shape
    total, weights, clipped, rate = _sums(timed, unders, apart, full, offset, noise)
    if not weights.all():
        alone = weights == 0
        own = _sums(timed, unders, [s.saturated for s in timed], full, offset, noise)
        for kept, more in zip((total, weights, clipped, rate), own, strict=True):
            kept[alone] = more[alone]
    lost, first, shortest = weights == 0, timed[0], timed[0].exposure_s or 1.0
    level = np.broadcast_to(as_rows(unders[0].mean), shape)[lost]
    rate[lost] = (as_rows(first.mean)[lost] - level - offset) / shortest
    variance = None
    if noise is not None:
        variance = (1 / np.where(lost, 1, weights)).astype(np.float32)
        variance[lost] = noise.variance(rate[lost] * shortest) / shortest**2
        variance = variance.reshape(first.mean.shape)
    mean, full_in_all, black = (a.reshape(first.mean.shape) for a in (rate, lost, clipped > 0))
    gone, absent = (union_of(*(getattr(s, name) for s in timed)) for name in ("lost", "absent"))
    return Template(mean, variance, 1, full_in_all, black, 1.0, gone, True, absent=absent)


def _sums(
    timed: list[Template],
    unders: list[MatchedDark],
    left_out: list[np.ndarray],
    full: float,
    offset: float,
    noise: NoiseModel | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return Σ w·rate, Σ w, whether the last that counted was clipped at black, and their rate."""

    shape = as_rows(timed[0].mean).shape
    gain = -1.0 if noise is None else noise.gain
    reads = [0.0 if noise is None else noise.read_under(under) for under in unders]
    rate = np.zeros(shape, np.float32)
    for _ in range(ROUNDS if noise is not None else 1):
        total, weights = np.zeros(shape), np.zeros(shape)
        clipped = np.zeros(shape, np.uint8)
        sums = rate, total, weights, clipped
        for shot, under, read, marks in zip(timed, unders, reads, left_out, strict=True):
            planes = as_rows(shot.mean), as_rows(under.mean), as_marks(marks), as_marks(shot.black)
            scalars = shot.exposure_s or 0.0, read, 1.0 / shot.count, under.share_of(read)
            frame = (*map(read_only, planes), *map(float, scalars))
            numbers = float(full), float(offset), float(gain)
            in_threads(_add_exposure, shape[0], frame, sums, numbers, worth=total.size)
        rate = (total / np.where(weights > 0, weights, 1)).astype(np.float32)
    return total, weights, clipped, rate


def _light_of_exposures(timed: Sequence[Template], scaling: Linearity) -> ShotLevels | None:
    """Return how bright each exposure is over what its time states: a lamp that flickers is that of a merge, too."""
    first = timed[0].shots
    if len(timed) != len(scaling.levels) or first is None:
        return first
    channels = first.levels.shape[1]
    return ShotLevels(np.tile(np.array(scaling.levels)[:, None], channels), np.zeros(channels))


def _in_order(shots: Sequence[Template]) -> list[Template]:
    if not shots:
        raise refusal("no_frames")
    if any(not shot.exposure_s for shot in shots):
        raise refusal("exposure_unknown", ", ".join(f"{shot.exposure_s}" for shot in shots))
    return sorted(shots, key=lambda shot: shot.exposure_s or 0.0)


@njit(cache=True)
def _add_exposure(start, stop, frame, sums, numbers):  # type: ignore[no-untyped-def]
    """Add w·(mean − dark − offset)/time to `total` and w to `weights`, where not saturated.

    w = time²/(share·(gain·rate·time + read) + dark_share·read), or `time` where `gain` < 0, with the `rate` of the round before. All are
    (h, w), `dark` may be one line or one number; `time` in s, `read` the variance without light, counts², `share` of a mean's variance in
    that of one shot. `clipped` keeps whether the last exposure that counted was clipped at black.
    """
    mean, dark, saturated, black, time, read, share, dark_share = frame
    rate, total, weights, clipped = sums
    limit, offset, gain = numbers
    for y in range(start, stop):
        dy, dx = y % dark.shape[0], dark.shape[1] > 1
        for x in range(mean.shape[1]):
            if saturated[y, x] or mean[y, x] > limit:
                continue
            signal = np.float64(mean[y, x]) - np.float64(dark[dy, x * dx]) - offset
            weight = time
            if gain >= 0.0:
                light = gain * max(np.float64(rate[y, x]), 0.0) * time
                weight = time * time / (share * (light + read) + dark_share * read)
            total[y, x] += weight * signal / time
            weights[y, x] += weight
            clipped[y, x] = black[y, x]

"""Linearity: the same scene at several exposure times must give counts in their ratio.

y(g, t) = C(g)·t + offset for groups g of pixels of like brightness, fitted so that Σ(Δy/y)² is
least over 5–95 % of saturation; what is left, relative, is the deviation from linearity. Whether it is the
sensor's or that of wrong times is whether it depends on the level at one exposure (`find_bend`).

Two traps, both met in real series. A group must not be chosen by its own noise, or it comes back to the
mean in the next exposure: pixels are ranked by what their neighbours of the same colour say. And a
dim sensel beside a bright one holds some of its light (0.7 % in a Bayer sensor behind a 550 nm filter)
until that one is full, and no more after: next to saturated pixels nothing scales.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from levkas.calibration.darks import dark_under
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.core.problems import Problem

USED = (0.05, 0.95)  # of saturation, as EMVA 1288 has it
GROUPS = 20
FEWEST = 50  # pixels of a group
MANY_ROWS = 600  # of a frame; the rest adds nothing to means that are known to 0.1 %
RECIPROCAL = 0.01  # rms up to which one exposure may be scaled to the time of another
CURVED = 0.003  # of the light, relative: reflectance may be off by as much before a curve counts
SIGMAS = 4.0  # of a bend, or of an offset, to be one
ALIKE = 1.15  # contrast of the pixels of a group whose mean is a point of a curve
FEWEST_POINTS = 16
LEAST_SPAN = (
    2.0  # of counts at one exposure, brightest over dimmest: an even white alone shows no bend
)
MOST_WEIGHT = 0.1  # of all pixels, that a group may count for
OUTLIER = 4.0  # usual deviations from a line, from which on a group moved
EVEN = 1.5  # of the dimmest of eight neighbours, the brightest: noise of a tenth makes as much
PERIOD = (2, 2)  # of mosaics, unless declared; plain sensors do not mind


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

    Parameters
    ----------
    rms, worst : float
        Deviation from the line, relative; `worst` keeps its sign.
    worst_at_s : float
        Exposure of the worst, s.
    worst_level : float
        Counts above dark of the worst.
    offset : float
        Counts at exposure 0 above what was subtracted; 0 where it was not fitted.
    points : int
        Groups times exposures behind the numbers; 0: nothing could be compared.
    offset_error : float
        One standard error of `offset`; NaN where it was not fitted.
    levels : tuple of float
        Light of every exposure, over what its time states, shortest first; 1 where none of its pixels was in range.
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
    """Compare exposures of one still scene.

    Parameters
    ----------
    shots : sequence of Template
        Of different `exposure_s`, all known; of one shape.
    darks, black
        Subtracted as in `darks.match_dark`.
    saturation : float
        Counts; 5 to 95 % of it is compared.
    fit_offset : bool
        Fit an offset common to all: cameras that clip their darks at 0 hide one.
    period : (rows, columns)
        Of a mosaic's pattern.

    Notes
    -----
    A pixel takes part at the exposures at which neither it nor one beside it comes near saturation,
    predicted from the rates of its neighbours one period away. Pixels of like range and rate, by the
    same neighbours, make a group.
    """
    points = find_points(shots, darks, saturation=saturation, black=black, period=period)
    times = sorted(shot.exposure_s or 0.0 for shot in shots)
    return _fit(points, fit_offset, times)


def find_points(
    shots: Sequence[Template],
    darks: Template | Sequence[Template] | None = None,
    *,
    saturation: float,
    black: float | np.ndarray | None = None,
    period: tuple[int, int] = PERIOD,
    contrast: float = np.inf,
) -> list[Point]:
    """Return what exposures of one still scene have in common: groups of pixels, and their counts at each.

    Parameters are those of `check_linearity`; `contrast` is that of the pixels of a group, at most: scaling
    commutes with the mean of any, a curve only with that of pixels that are alike.
    """
    timed = sorted(shots, key=lambda shot: shot.exposure_s or 0.0)
    times = np.array([shot.exposure_s for shot in timed], float)
    rows = slice(0, MANY_ROWS)
    signal, usable = [], []
    for shot in timed:
        under = dark_under(shot, darks, black=black).mean
        signal.append((shot.mean - under).astype(np.float32)[rows])
        usable.append(~shot.saturated[rows])
    return _points(np.array(signal), np.array(usable), times, saturation, period, contrast)


class Bend(NamedTuple):
    """What exposure series show beside a line.

    Parameters
    ----------
    size, error : float
        By how much light is more than the counts of the highest level say, on the scale of the lowest, relative, and its
        standard error; infinite where there are too few points.
    offset, offset_error : float
        Counts above dark where there is no light, and their standard error; 0 where they are not beyond four of it.
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

    Parameters
    ----------
    points : sequence of Point
        Of one or more series of one sensor, from `find_points` with the contrast `ALIKE`; groups and series numbered apart.
    full : float
        Full scale above dark, counts.

    Notes
    -----
    log y = log C(g) + log t + δ(e) − a·y/full + o/y by least squares, of a group g and an exposure e whose light is off by a
    factor common to all levels: a lamp flickers, a shutter has other times than are stated. Whether δ and o are there is
    decided by the Bayesian information criterion [schwarz1978]_.

    Examples
    --------
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
    left = _without(level, np.stack([bent, *factors, shifted], -1), weight)
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


def _without(values: np.ndarray, columns: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return what a fit of least absolute deviations leaves: what moved draws it little."""
    left = values
    for _ in range(20):
        root = np.sqrt(weight / np.maximum(np.abs(left), 1e-4))
        found = np.linalg.lstsq(columns * root[:, None], values * root, rcond=None)[0]
        left = values - columns @ found
    return np.asarray(left)


def require_reciprocity(found: Linearity) -> None:
    """Refuse to scale counts from one exposure to another where they do not scale.

    Raises CalibrationRefused, E_EXPOSURES with where it broke, or that nothing could be compared.

    Examples
    --------
    >>> require_reciprocity(Linearity(0.004, 0.006, 1.0, 0.0, 40))
    """
    if found.points and found.rms <= RECIPROCAL:
        return
    raise CalibrationRefused(
        Problem(
            "E_EXPOSURES",
            "the counts are not proportional to the exposure"
            if found.points
            else "the linearity cannot be checked",
            field="exposures",
            found=f"rms deviation {found.rms:.1%}, worst {found.worst:+.1%} at {found.worst_at_s:g} s "
            f"and {found.worst_level:.0f} counts"
            if found.points
            else "no scene lies between 5 and 95 % of saturation in two exposures",
            expected=f"at most {RECIPROCAL:.1%} rms",
            fix="Capture object and white with the same exposure, or capture an exposure series of "
            "the white with a dark for each time."
            if found.points
            else "Capture the white at three exposures or more, a factor of two apart.",
        )
    )


def _around(rate: np.ndarray, known: np.ndarray, period: tuple[int, int]) -> np.ndarray:
    """Return the mean rate of the eight neighbours one period away, without the pixel itself."""
    import cv2

    rows, columns = period
    kernel = np.zeros((2 * rows + 1, 2 * columns + 1), np.float32)
    kernel[::rows, ::columns] = 1
    kernel[rows, columns] = 0
    total, count = (
        cv2.filter2D(
            np.ascontiguousarray(a, np.float32), -1, kernel, borderType=cv2.BORDER_CONSTANT
        )
        for a in (np.where(known, rate, 0), known)
    )
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
    import cv2

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
    import cv2

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
        freedom = max(len(rows) - design.shape[1], 1)
        scaled = design / signal[:, None]
        spread = np.linalg.pinv(scaled.T @ scaled)[-1, -1] * np.sum(miss**2) / freedom
        error = float(np.sqrt(spread))
    at = float(times[worst]), offset, len(rows), float(signal[worst])
    # By their counts: an offset of all counts is no change of the light.
    of_times = [(signal[times == time], miss[times == time]) for time in exposures]
    levels = tuple(1 + float(own @ off) / max(float(own.sum()), 1.0) for own, off in of_times)
    return Linearity(rms, float(miss[worst]), *at, error, levels)

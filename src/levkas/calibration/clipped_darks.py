"""Darks that the camera clipped at 0: their black level, their noise, and the level of each sensel, by the moments of a truncated normal.

With the true black at 0, the mean of a clipped dark is 0.399 σ and its spread 0.584 σ: subtracting it biases every lit pixel. A code
k means (k − ½, k + ½), the code 0 everything below ½. The share of codes up to k is Φ((k + ½ − black)/spread), so its probit is a
line over k; noise in time is that whose clipped values differ from shot to shot as these do, and the rest of the spread is of sensels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from levkas.calibration.findings import refusal
from levkas.calibration.patterns import thin_periods
from levkas.calibration.templates import DarkFit, Template

MANY_ZEROS, FAR = 0.005, 4.0
"""Of the pixels: fewer bias the mean of a dark by less than 0.002 of its noise; spreads from 0 to the median: zeros below are dead sensels'."""
NODES, ENDS, FEWEST = 17, 2.0, 30
"""Of Gauss and Hermite; probit up to which, or from that of zeros on, a dark is normal: above it warm sensels tell; pixels at codes 2 to 4."""
MOST_PIXELS, MOST_BANDS = 1_000_000, 16
"""Of a dark that are looked at; of a cube, each with a black of its own: of more the sensels' own levels give it."""
SMOOTH, GLOWS, ALIKE = 25, 5.0, 0.25
"""Sensels a side of a neighbourhood: its mean is known to a twenty-fifth of the noise; deviations of these means beyond noise, from which
on a dark glows; share of its sensels, of middle level, that noise and pattern are fitted to."""
HOT, PAIRS, ENOUGH = 5.0, (4, 64), 10_000
"""Deviations of a sensel's mean beyond which its level is its own; of lines of a scan's dark; samples of a band in them."""
LEVELS, FEWEST_SHOTS = 401, 3
"""At which the moments of clipped shots are worked out; whose mean shows more than that it is clipped."""


class DarkLevel(NamedTuple):
    """Mean of a dark before clipping, standard deviations over time and from sensel to sensel, error of the mean, counts; share of zeros.

    Of a single shot `noise` holds both deviations, and `fixed` is NaN.
    """

    black: float
    noise: float
    fixed: float
    black_error: float
    zeros: float


def is_clipped(frame: np.ndarray) -> bool:
    """Whether a dark frame was clipped at zero, so that its mean is not black: zeros in more than 0.5 % of the pixels, at the foot of the others.

    >>> is_clipped(np.array([[0, 0, 1, 2]])), is_clipped(np.full((2, 2), 64))
    (True, False)
    """
    if frame.min() != 0 or np.mean(frame == 0) <= MANY_ZEROS:
        return False
    median, high = np.quantile(frame, (0.5, 0.841))
    return bool(median <= FAR * (high - median))


def black_clip_of(frames: Iterable[np.ndarray]) -> float | None:
    """Return the code at which frames are clipped at black: 0, or None where their noise goes below it.

    One code alone below zero is a mark for what is not there.

    >>> black_clip_of([np.array([0, 3, -9999])]), black_clip_of([np.array([-0.3, 0.1, -0.2])])
    (0.0, None)
    """
    below = [frame[frame < 0] for frame in frames if frame.dtype.kind != "u"]
    return None if any(len(np.unique(some)) > 1 for some in below) else 0.0


def fit_clipped_dark(frames: Sequence[np.ndarray], *, step: float = 1.0) -> DarkLevel:
    """Fit black, noise and spread of shots of one exposure and channel, whole codes `step` apart, that were clipped at zero.

    Two shots or more separate noise from fixed pattern. Hot sensels lie beyond the codes that are looked at. Raises CalibrationRefused,
    E_DARK_CLIPPED where so few codes are above zero that black and noise cannot be separated.

    >>> rng = np.random.default_rng(1)
    >>> shots = [np.rint(rng.normal(0.5, 2.0, (300, 300))).clip(0) for _ in range(2)]
    >>> level = fit_clipped_dark(shots)
    >>> abs(level.black - 0.5) < 0.05, abs(level.noise - 2.0) < 0.05
    (True, True)
    """
    from scipy.optimize import brentq
    from scipy.special import ndtri

    codes = [np.rint(np.asarray(frame) / step).astype(np.int64).ravel() for frame in frames]
    pooled = np.concatenate(codes)
    zeros, median = float(np.mean(pooled == 0)), np.median(pooled)
    # Hot sensels stand anywhere: a few counts above zero there must be more than those.
    beyond = np.count_nonzero((pooled >= 2) & ((pooled <= 4) | (median > 2))) // len(codes)
    if beyond < FEWEST:
        raise refusal("clipped_too_much", number=zeros, limit=beyond)
    # Twice the 99th percentile lies beyond 4 sigma of what is no hot sensel, even for half a normal.
    top = int(max(2 * np.quantile(pooled, 0.99), 6))
    counts = np.cumsum(np.bincount(np.minimum(pooled, top + 1))[: top + 1])
    count = float(counts[-1])
    shares = counts / count
    known = (shares * count > FEWEST) & ((1 - shares) * count > FEWEST)
    known &= ndtri(shares) < max(ENDS, float(ndtri(shares[0])) + ENDS)
    at, probit = np.flatnonzero(known) + 0.5, ndtri(shares[known])
    # Of a probit z the variance is p (1 − p) / (n φ²); neighbours have most of their errors in common.
    weight = np.exp(-(probit**2) / 2) / np.sqrt(shares[known] * (1 - shares[known]))
    slope, start = np.polyfit(at, probit, 1, w=weight)
    black, spread = float(-start / slope), float(1 / slope)
    error = float(spread / np.sqrt(count * (1 - zeros)))
    if len(codes) < 2:
        return DarkLevel(black * step, spread * step, np.nan, error * step, zeros)
    pairs = [(a, b) for a, b in zip(codes[::2], codes[1::2], strict=False)]
    cool = [(a <= top) & (b <= top) for a, b in pairs]
    apart = np.mean([np.mean((a - b)[c] ** 2.0) / 2 for (a, b), c in zip(pairs, cool, strict=True)])
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)

    def missing(noise: float) -> float:
        levels = black + np.sqrt(spread**2 - noise**2) * nodes
        return float(np.average(clipped_moments(levels, noise)[1], weights=weights) - apart)

    least = 0.05 * spread
    if missing(spread) <= 0:
        noise = spread
    else:
        noise = least if missing(least) >= 0 else brentq(missing, least, spread)
    fixed = float(np.sqrt(max(spread**2 - noise**2, 0.0)))
    error = float(np.hypot(error, fixed / np.sqrt(len(codes[0]))))
    return DarkLevel(black * step, noise * step, fixed * step, error * step, zeros)


def unclip(
    dark: Template,
    frames: Sequence[np.ndarray],
    *,
    period: tuple[int, int] = (1, 1),
    step: float = 1.0,
) -> Template:
    """Return a dark, (h, w) or (h, w, b), by some of its shots as if its codes had not been clipped at zero; one that was not as it is.

    Each phase of a mosaic of `period` has a black of its own. `mean` is the expected level of each sensel, `fit` has its variance; nothing
    is black. Raises CalibrationRefused, E_DARK_CLIPPED, as `fit_clipped_dark`.

    A sensel's level is spread about the black of its phase, the mean of its clipped shots about what clipping leaves
    of that level. Its expected level is the linear estimate of least error (empirical Bayes, [efron1973]_,
    doi:10.1080/01621459.1973.10481350): with few shots close to black, with many its own. Hot sensels keep theirs.
    Where a dark glows, black is that of its neighbourhood.

    >>> from levkas.calibration.templates import average
    >>> rng = np.random.default_rng(1)
    >>> shots = [rng.normal(0.5, 2.5, (200, 200)).clip(0).astype(np.uint16) for _ in range(4)]
    >>> clipped = average(shots)
    >>> bool(clipped.mean.mean() > 0.9), abs(float(unclip(clipped, shots).mean.mean())) < 0.03
    (True, True)
    """
    thin = [thin_periods(np.asarray(frame), period[0], MOST_PIXELS) for frame in frames]
    if not thin or thin[0].dtype.kind not in "ui" or not is_clipped(thin[0]):
        return dark
    mean, variance = dark.mean.copy(), np.empty_like(dark.mean)
    levels = []
    for part in _parts(dark.mean.shape, period):
        smooth = _smooth_light(dark.mean[part])
        alike = np.ones(dark.mean.shape, bool)
        if smooth is not None:
            apart = np.abs(smooth - np.median(smooth))
            alike[part] = apart <= np.quantile(apart, ALIKE)
        chosen = thin_periods(alike, period[0], MOST_PIXELS)[part]
        level = fit_clipped_dark([frame[part][chosen] for frame in thin], step=step)
        base = np.array(level.black) if smooth is None else _unclipped(smooth, level, step)
        mean[part], variance[part] = _own_levels(dark.mean[part], dark.count, level, base, step)
        levels.append(level)
    noise = float(np.mean([level.noise**2 for level in levels]) ** 0.5)
    zeros = float(np.mean([level.zeros for level in levels]))
    fit = DarkFit(variance, tuple(float(level.black) for level in levels), noise, zeros)
    return replace(dark, mean=mean, variance=None, black=np.zeros_like(dark.black), fit=fit)


def unclip_means(
    shots: Template, level: float, *, gain: float, read_variance: float, step: float = 1.0
) -> Template:
    """Return an average of three shots or more whose means, where any was `black`, are those that they had without clipping at zero.

    `level` are counts without light, `gain` counts per photo-electron, `read_variance` that of one shot without light before rounding,
    counts². The mean of clipped shots grows with the signal, and is inverted. Where all shots are zero the signal is that at
    which half of such stacks are. Without light, eight shots are then 0.24 of their sigma too low; clipped, 1.1 too high.

    >>> from levkas.calibration.templates import average
    >>> rng = np.random.default_rng(1)
    >>> dim = [np.rint(rng.normal(1.0, 2.5, (99, 99))).clip(0).astype(np.uint16) for _ in range(8)]
    >>> found = unclip_means(average(dim), 0.0, gain=0.0, read_variance=6.25)
    >>> round(float(average(dim).mean.mean()), 2), round(float(found.mean.mean()), 2)
    (1.56, 0.86)
    """
    from scipy.special import ndtr

    if shots.count < FEWEST_SHOTS or read_variance <= 0 or not shots.black.any():
        return shots
    read = float(np.sqrt(read_variance))
    levels = level + np.linspace(-3, 8, LEVELS) * read
    noise = np.sqrt(read_variance + gain * np.maximum(levels - level, 0.0))
    expected = clipped_moments(levels / step, noise / step)[0] * step
    zeros = ndtr((step / 2 - levels) / noise) ** shots.count
    least = float(np.interp(-0.5, -zeros, levels))
    clipped, mean = shots.mean[shots.black], shots.mean.copy()
    inverted = np.maximum(np.interp(clipped, expected, levels), least)
    mean[shots.black] = np.where(clipped < expected[-1], inverted, clipped)
    return replace(shots, mean=mean)


def clipped_moments(levels: np.ndarray, noise: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of whole codes, none below zero, of normal values of means `levels`, (n,), and deviations `noise` > 0, codes.

    Half a normal, 0.399 σ and 0.341 σ²:

    >>> mean, variance = clipped_moments(np.array([0.0]), 30.0)
    >>> round(float(mean[0]) / 30, 3), round(float(variance[0]) / 900, 3)
    (0.399, 0.341)
    """
    from scipy.special import ndtr

    codes = np.arange(1, int(np.max(levels) + 7 * np.max(noise)) + 3)
    reached = ndtr((levels - (codes[:, None] - 0.5)) / noise).T  # P(code or more)
    mean = reached.sum(1)
    return mean, np.maximum(((2 * codes - 1) * reached).sum(1) - mean**2, 1e-9)


def _smooth_light(plane: np.ndarray) -> np.ndarray | None:
    """Return the means about each sensel of a plane, (h, w), where they vary by more than noise: glow."""
    import cv2

    if plane.ndim != 2 or min(plane.shape) < 2 * SMOOTH:
        return None
    cool = np.minimum(plane, np.float32(np.quantile(plane, 0.995)))
    smooth = cv2.blur(np.ascontiguousarray(cool, np.float32), (SMOOTH, SMOOTH))
    by_chance = float(np.std(cool - smooth)) / SMOOTH
    unsure = SMOOTH / np.sqrt(2 * plane.size)  # of a standard deviation of so many neighbourhoods
    return smooth if float(np.std(smooth)) > (1 + GLOWS * unsure) * by_chance else None


def _unclipped(smooth: np.ndarray, level: DarkLevel, step: float) -> np.ndarray:
    """Return the level whose clipped codes have some mean, noise and fixed pattern being those of a fit."""
    total = float(np.hypot(level.noise, np.nan_to_num(level.fixed)))
    levels = np.linspace(level.black - 3 * total, max(smooth.max(), level.black) + total, LEVELS)
    return np.interp(smooth, clipped_moments(levels / step, total / step)[0] * step, levels)


def _own_levels(
    mean: np.ndarray, count: int, level: DarkLevel, base: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected level of each sensel from the mean of its `count` clipped shots, and its variance.

    `base` is the level about which the sensels of a neighbourhood, or of all, are spread. About it the clipped mean is taken as
    a line over the level.
    """
    fixed = level.fixed if np.isfinite(level.fixed) else 0.0
    levels = np.linspace(base.min() - level.noise, base.max() + level.noise, LEVELS)
    total = float(np.hypot(level.noise, fixed))
    expected = clipped_moments(levels / step, total / step)[0] * step
    spread = clipped_moments(levels / step, level.noise / step)[1] * step**2 / count
    at, slope, noise = (
        np.interp(base, levels, row) for row in (expected, np.gradient(expected, levels), spread)
    )
    share = slope * fixed**2 / (slope**2 * fixed**2 + noise)
    own = base + share * (mean - at)
    hot = mean > at + HOT * np.sqrt(noise + fixed**2)
    # Of few shots the mean is not normal: what that leaves is the same everywhere.
    if not hot.all():
        own = own + np.mean((base - own)[~hot])
    variance = fixed**2 * (1 - share * slope) + level.black_error**2
    return np.where(hot, mean, own), np.where(hot, level.noise**2 / count, variance)


def _parts(shape: tuple[int, ...], period: tuple[int, int]) -> list[tuple]:
    """Return where sensels share a black: phases of a mosaic, bands of a cube where they are few."""
    if len(shape) == 2:
        rows, columns = period
        return [np.s_[y::rows, x::columns] for y in range(rows) for x in range(columns)]
    if shape[2] > MOST_BANDS:
        return [np.s_[:, :, :]]
    return [np.s_[:, :, band] for band in range(shape[2])]


def pairs_of_lines(count: int, samples: int) -> list[int]:
    """Return pairs of neighbouring lines of a scan's dark of `count` lines: shots of the same sensels.

    >>> pairs_of_lines(100, 2000), pairs_of_lines(1, 2000), len(pairs_of_lines(100, 400))
    ([0, 1, 24, 25, 48, 49, 74, 75, 98, 99], [0], 50)
    """
    pairs = int(np.clip(ENOUGH // samples, *PAIRS))
    starts = np.unique(np.linspace(0, max(count - 2, 0) // 2, pairs).round().astype(int))
    return [y for start in (2 * starts).tolist() for y in (start, start + 1) if y < count]

"""Darks that the camera clipped at 0: their black level, their noise, and the level of each sensel.

With the true black at 0, the mean of a clipped dark is 0.399 σ and its spread 0.584 σ: subtracting it
biases every lit pixel.  A code k means (k − ½, k + ½), the code 0 for everything below ½; black,
noise in time and spread between sensels are those that make pairs of shots likeliest, a sensel's own
offset being integrated out. Its own level is then the mean of what its shots leave of that spread.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from levkas.calibration.findings import refusal
from levkas.calibration.patterns import thin_periods
from levkas.calibration.templates import DarkFit, Template

MANY_ZEROS = 0.005  # of the pixels: fewer bias the mean of a dark by less than 0.002 of its noise
FAR = 4.0  # spreads from 0 to the median: zeros below are dead sensels', not the noise's
BINS = 160
NODES = 17  # of Gauss and Hermite
FEWEST = 30  # pixels at codes 2 to 4, without which spread and black cannot be separated


@dataclass(frozen=True)
class DarkLevel:
    """Black and noise of a dark, counts.

    Parameters
    ----------
    black : float
        Mean before clipping; may be negative.
    noise : float
        Standard deviation over time, rounding not included.
    fixed : float
        Standard deviation from sensel to sensel; NaN from a single shot, whose `noise` holds both.
    black_error, noise_error, fixed_error : float
        One standard error of each.
    zeros : float
        Share of pixels at 0.
    """

    black: float
    noise: float
    fixed: float
    black_error: float
    noise_error: float
    fixed_error: float
    zeros: float


def is_clipped(frame: np.ndarray) -> bool:
    """Whether a dark frame was clipped at zero, so that its mean is not black.

    Zeros in more than 0.5 % of the pixels, at the foot of what the others are spread over.

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
    """Fit black, noise and spread of darks that were clipped at zero.

    Raises CalibrationRefused, E_DARK_CLIPPED where so few codes are above zero that black and noise cannot be separated.

    Parameters
    ----------
    frames : sequence of ndarray, one shape, whole codes
        Shots of one exposure and one channel. Two or more separate noise from fixed pattern; they are
        taken in pairs.
    step : float
        Counts from code to code.

    Notes
    -----
    Normal in time and from sensel to sensel; hot sensels are a share of outliers, spread evenly,
    that is fitted too. Errors are from the curvature of the likelihood. From 300,000 pixels black
    and noise come within 1 % of σ while a tenth of the pixels is above zero.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> shots = [np.rint(rng.normal(0.5, 2.0, (300, 300))).clip(0) for _ in range(2)]
    >>> level = fit_clipped_dark(shots)
    >>> abs(level.black - 0.5) < 0.05, abs(level.noise - 2.0) < 0.05
    (True, True)
    """
    from scipy.optimize import minimize

    frames = [np.asarray(frame) / step for frame in frames]
    first = frames[0]
    pairs = [(a, b) for a, b in zip(frames[::2], frames[1::2], strict=False)] or [(first, first)]
    edges, table = _table(pairs, alone=len(frames) == 1)
    zeros = float(np.mean([np.mean(frame == 0) for frame in frames]))
    _check_informative(frames, zeros)
    start = _first_guess(np.concatenate([np.ravel(frame) for frame in frames]))
    free = np.array([True, True, len(frames) > 1, True])

    def loss(part: np.ndarray) -> float:
        full = start.copy()
        full[free] = part
        if not free[2]:
            full[2] = -20.0
        return _loss(full, edges, table, alone=len(frames) == 1)

    options = {"xatol": 1e-4, "fatol": 5e-3, "maxiter": 4000, "maxfev": 4000}
    optimum = minimize(loss, start[free], method="Nelder-Mead", options=options)
    optimum = minimize(loss, optimum.x, method="Nelder-Mead", options=options)
    errors = _errors(loss, optimum.x)
    found, error = np.full(4, np.nan), np.full(4, np.nan)
    found[free], error[free] = optimum.x, errors
    noise, fixed = np.exp(found[1]), np.exp(found[2])
    numbers = found[0], noise, fixed, error[0], noise * error[1], fixed * error[2], zeros / step
    return DarkLevel(*(float(n * step) for n in numbers))


def _check_informative(frames: Sequence[np.ndarray], zeros: float) -> None:
    # Hot sensels stand anywhere: a few counts above zero there must be more than those.
    parts = [((f >= 2) & (f <= 4), (f > 4) & (np.median(f) > 2)) for f in frames]
    beyond = max(int(np.logical_or.reduce(part).sum()) for part in zip(*parts, strict=True))
    if beyond >= FEWEST:
        return
    raise refusal("clipped_too_much", number=zeros, limit=beyond)


def _first_guess(codes: np.ndarray) -> np.ndarray:
    """Return parameters from how much lies above two codes."""
    from scipy.special import ndtri

    above = 1 - np.cumsum(np.bincount(codes.astype(np.int64))[:4000]) / len(codes)
    low = int(np.argmax(above < 0.7))
    high = max(low + 1, int(np.argmax(above <= above[low] / 8)))
    z = -ndtri(np.clip([above[low], above[min(high, len(above) - 1)]], 1e-6, 1 - 1e-6))
    noise = (high - low) / max(z[1] - z[0], 0.05)
    black = low + 0.5 - z[0] * noise
    return np.array([black, np.log(noise), np.log(noise / 4), -7.0])


def _table(
    pairs: list[tuple[np.ndarray, np.ndarray]], *, alone: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the upper edges of bins of codes, and how often pairs of bins occur."""
    sample = np.concatenate([pair[0].ravel() for pair in pairs])
    # Twice the 99th percentile lies beyond 4 sigma of what is no hot sensel, even for half a normal.
    top = int(max(2 * np.quantile(sample, 0.99), 6))
    width = -(-(top + 1) // BINS)
    bins = top // width + 1
    table = np.zeros((bins, bins))
    for a, b in pairs:
        i, j = (np.asarray(p).ravel().astype(np.int64) // width for p in (a, b))
        inside = (i < bins) & (j < bins)
        table += np.bincount(i[inside] * bins + j[inside], minlength=bins * bins).reshape(bins, -1)
    return (np.arange(bins) + 1) * width - 0.5, table.diagonal().copy() if alone else table


def _loss(numbers: np.ndarray, edges: np.ndarray, table: np.ndarray, *, alone: bool) -> float:
    """Return minus the logarithm of the likelihood."""
    from scipy.special import ndtr

    black, noise, fixed, outliers = numbers
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    centre = black + np.exp(fixed) * nodes[:, None]
    below = ndtr((edges - centre) / np.exp(noise))
    share = np.diff(below, axis=1, prepend=0.0)
    weights = weights / weights.sum()
    likely = weights @ share if alone else (share * weights[:, None]).T @ share
    odd = 1 / (1 + np.exp(-np.clip(outliers, -40, 40)))
    return -float(np.sum(table * np.log((1 - odd) * likely + odd / table.size + 1e-300)))


def _errors(loss: object, best: np.ndarray) -> np.ndarray:
    """Return standard errors from the curvature of the loss."""
    count, step = len(best), 2e-3
    curvature = np.empty((count, count))
    moves = np.eye(count) * step
    for i in range(count):
        for j in range(count):
            corners = [
                loss(best + a * moves[i] + b * moves[j])  # type: ignore[operator]
                for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
            ]
            curvature[i, j] = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * step**2)
    # A parameter on which nothing depends (no outliers, no fixed pattern) has no curvature.
    return np.sqrt(np.maximum(np.diag(np.linalg.pinv(curvature, rcond=1e-9)), 0.0))


MOST_PIXELS = 1_000_000  # of a dark, in the likelihood
MOST_BANDS = 16  # of a cube, each with a black of its own; of more the sensels' own levels give it
SMOOTH = 25  # sensels a side of a neighbourhood: its mean is known to a twenty-fifth of the noise
GLOWS = 5.0  # deviations by which these means vary by more than noise makes them, from which on a dark glows
ALIKE = 0.25  # share of the sensels of a glowing dark that noise and pattern are fitted to: those of middle level
HOT = 5.0  # deviations of a sensel's mean beyond which its level is its own
PAIRS, ENOUGH = (4, 64), 10_000  # of lines of a scan's dark; samples of a band in them
LEVELS = 401  # at which the moments of clipped shots are worked out


def unclip(
    dark: Template,
    frames: Sequence[np.ndarray],
    *,
    period: tuple[int, int] = (1, 1),
    step: float = 1.0,
) -> Template:
    """Return a dark as if its codes had not been clipped at zero; one that was not as it is.

    Raises CalibrationRefused, E_DARK_CLIPPED, as `fit_clipped_dark`.

    Parameters
    ----------
    dark : Template, (h, w) or (h, w, b)
        Average of shots; (1, w, b) of lines.
    frames : sequence of ndarray like `dark.mean`, whole codes
        Some of these shots; two or more separate noise from fixed pattern.
    period : (rows, columns)
        Of a mosaic: each phase has a black of its own.
    step : float
        Counts from code to code.

    Returns
    -------
    dark : Template
        `mean` is the expected level of each sensel, and `fit` has its variance; nothing is black.

    Notes
    -----
    A sensel's level is spread about the black of its phase, the mean of its clipped shots about what clipping leaves
    of that level. Its expected level is the linear estimate of least error (empirical Bayes, [efron1973]_,
    doi:10.1080/01621459.1973.10481350): with few shots close to black, with many its own. Hot sensels keep theirs.
    Where a dark glows, black is that of its neighbourhood.

    Examples
    --------
    >>> from levkas.calibration.templates import average
    >>> rng = np.random.default_rng(1)
    >>> shots = [rng.normal(0.5, 2.5, (200, 200)).clip(0).astype(np.uint16) for _ in range(4)]
    >>> clipped = average(shots)
    >>> bool(clipped.mean.mean() > 0.9), abs(float(unclip(clipped, shots).mean.mean())) < 0.02
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
    noise, zeros = (
        float(np.mean([level.noise**2 for level in levels]) ** 0.5),
        float(np.mean([level.zeros for level in levels])),
    )
    fit = DarkFit(variance, tuple(level.black for level in levels), noise, zeros)
    return replace(dark, mean=mean, variance=None, black=np.zeros_like(dark.black), fit=fit)


FEWEST_SHOTS = 3  # whose mean shows more than that it is clipped


def unclip_means(
    shots: Template, level: float, *, gain: float, read_variance: float, step: float = 1.0
) -> Template:
    """Return an average of shots whose means are those that they had without clipping at zero.

    Parameters
    ----------
    shots : Template
        Where any shot was `black` its mean is changed, of three shots or more; it stays marked.
    level : float
        Counts without light.
    gain : float
        Counts per photo-electron.
    read_variance : float
        Of one shot without light, before rounding, counts².
    step : float
        Counts from code to code.

    Notes
    -----
    The mean of clipped shots grows with the signal, and is inverted. Where all shots are zero the signal is that at
    which half of such stacks are. Without light, eight shots are then 0.24 of their sigma too low; clipped, 1.1 too high.

    Examples
    --------
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
    clipped = shots.mean[shots.black]
    mean = shots.mean.copy()
    mean[shots.black] = np.where(
        clipped < expected[-1], np.maximum(np.interp(clipped, expected, levels), least), clipped
    )
    return replace(shots, mean=mean)


def clipped_moments(levels: np.ndarray, noise: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of whole codes, none below zero, of normal values.

    Parameters
    ----------
    levels : ndarray, (n,)
        Means before rounding and clipping, codes.
    noise : float or ndarray, (n,)
        Standard deviation, codes, > 0.

    Examples
    --------
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
    expected = clipped_moments(levels / step, total / step)[0] * step
    return np.interp(smooth, expected, levels)


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
    every = slice(None)
    if len(shape) == 2:
        rows, columns = period
        return [
            (slice(y, None, rows), slice(x, None, columns))
            for y in range(rows)
            for x in range(columns)
        ]
    if shape[2] > MOST_BANDS:
        return [(every, every, every)]
    return [(every, every, band) for band in range(shape[2])]


def pairs_of_lines(count: int, samples: int) -> list[int]:
    """Return pairs of neighbouring lines of a scan's dark of `count` lines: shots of the same sensels.

    >>> pairs_of_lines(100, 2000), pairs_of_lines(1, 2000), len(pairs_of_lines(100, 400))
    ([0, 1, 24, 25, 48, 49, 74, 75, 98, 99], [0], 50)
    """
    pairs = int(np.clip(ENOUGH // samples, *PAIRS))
    starts = np.unique(np.linspace(0, max(count - 2, 0) // 2, pairs).round().astype(int))
    return [y for start in (2 * starts).tolist() for y in (start, start + 1) if y < count]

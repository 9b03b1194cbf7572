"""Noise model of a sensor, variance = read² + gain · signal, fitted to the frames of a campaign.

From stacks (two shots or more of one scene) the variance over time is free of everything fixed:
texture, PRNU, shading. From single shots only an upper estimate can be had, from what is left of
the smoothest parts of object over white, where PRNU and shading divide out.

Rounding to codes a step apart adds step²/12 to the variance of one value. Repeats show it as long as
the noise carries a value over half a step; what they do not show, B, stays in the mean of any number of
shots: variance of a mean = (T − B)/n + B, with T = noise² + step²/12 of one shot.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.patterns import channel_table, split
from levkas.calibration.templates import MANY_PIXELS, Template, gaps_of

if TYPE_CHECKING:
    from levkas.calibration.darks import MatchedDark

WORKED_OUT = 1e9  # degrees of freedom of a variance that was derived, not sampled
PRIOR = 60.0  # a noise model weighs as much as this many degrees of freedom of a stack
HIDES = 0.25  # of step²: more noise than that shows all of rounding (B < 3e-6 step²)
TERMS = 12  # of the series of B: its error is below 0.4 % of step²
MOST_FREEDOM = 2e4  # of a group: a misfit of 1 % in a full one does not rule the line
LEVELS = 24  # groups of equal size by signal, a stack
MANY_BLACK = 0.02  # a dark with more zeros than this was clipped, and its spread is not noise
BLOCK = 8
OF_GROUP = 100.0  # degrees of freedom of a group of blocks
ROUNDS = 4  # of the expected noise by which blocks of unlike signal are compared
DIM = 0.5  # of the brightest group: the noise of those below is that of a linear sensor
TENTH = 0.593  # lower tenth of chi-squared over its freedom: 64 differences count as 17 (Σρ² 3.78)
SPREAD = 2.0  # highest over lowest signal that separates gain from read noise
FEW_PIXELS = 20_000  # of a band that is compared: its variance by two shots is known to 1 %
FULL = 0.2  # of the variance of other bands: a white with less is full, not of another gain
UNLIKE = (
    1.3  # of the variance of other bands, or its inverse, from which on a band has another gain
)


@dataclass(frozen=True)
class NoiseModel:
    """Variance of one raw value of a sensor.

    Parameters
    ----------
    gain : float
        Counts per photo-electron: slope of variance over signal.
    read_variance : float
        Variance without light, counts², rounding's step²/12 included.
    source : str
        ``"temporal"`` (from stacks) or ``"spatial"`` (from single shots: an upper estimate).
    step : float
        Counts from one code of the file to the next; 0 where values are no whole numbers.
    level : float, optional
        Counts of the dark at which `read_variance` holds: that of a longer exposure has the shot
        noise of its dark current besides.

    Examples
    --------
    >>> float(NoiseModel(0.1, 4.0).variance(1000.0))
    104.0
    """

    gain: float
    read_variance: float
    source: str = "temporal"
    step: float = 1.0
    level: float | None = None

    def variance(self, signal: float | np.ndarray) -> np.ndarray:
        """Return the variance of one shot at a signal in counts above dark."""
        return self.read_variance + self.gain * np.maximum(signal, 0.0)

    def read_under(self, dark: MatchedDark) -> float:
        """Return the variance without light, counts², of frames from which this dark is subtracted.

        >>> from levkas.calibration.darks import match_dark
        >>> from levkas.calibration.templates import average
        >>> NoiseModel(0.5, 4.0, level=64.0).read_under(match_dark(average([np.full((2, 2), 74)]), None))
        9.0
        """
        if self.level is None or not dark.count:
            return self.read_variance
        more = self.gain * (dark.level - self.level)
        return max(self.read_variance + more, self.step**2 / 12)


def hidden_rounding(noise: float | np.ndarray, step: float) -> np.ndarray:
    """Return the variance of rounding that repeats do not show, counts².

    Parameters
    ----------
    noise : float or ndarray
        Variance of one value before it is rounded, counts².
    step : float
        Counts from code to code.

    Notes
    -----
    B = step²/(2π²) Σ exp(−4π²k² noise/step²)/k², the variance of the mean rounding error over values
    that lie anywhere between two codes [widrow2008]_: step²/12 without noise, nothing from noise of
    half a step on.

    Examples
    --------
    >>> hidden_rounding(np.array([0.0, 0.04, 1.0]), 1.0).round(3).tolist()
    [0.083, 0.01, 0.0]
    """
    if not step:
        return np.zeros(np.shape(noise))
    k = np.arange(1, TERMS + 1)
    share = np.maximum(np.asarray(noise, float)[..., None], 0.0) / step**2
    series = np.sum(np.exp(-4 * np.pi**2 * k**2 * share) / k**2, axis=-1)
    # Without noise the series has what its first terms have, and the rest of π²/6.
    rest = (np.pi**2 / 6 - np.sum(1.0 / k**2)) * np.exp(-4 * np.pi**2 * TERMS**2 * share[..., 0])
    return np.asarray(step**2 / (2 * np.pi**2) * (series + rest))


def whole_variance(shown: float | np.ndarray, step: float) -> np.ndarray:
    """Return the variance of one value, rounding included, from what repeats show of it, counts².

    >>> whole_variance(np.array([0.0, 4.0]), 1.0).round(3).tolist()
    [0.083, 4.0]
    """
    if not step:
        return np.asarray(shown, float)
    whole, shows = (step**2 * one for one in _rounded())
    small = np.interp(shown, shows, whole)
    return np.where(np.asarray(shown) < shows[-1], small, shown)


@cache
def _rounded() -> tuple[np.ndarray, np.ndarray]:
    """Return variances of one value, rounding included, and what repeats show of each, both (500,), of codes 1 apart."""
    noise = np.linspace(0, HIDES, 500)
    whole = noise + 1 / 12
    return whole, whole - hidden_rounding(noise, 1.0)


def fit_noise_of_frames(
    shots: Sequence[Template],
    whites: Sequence[Template | None],
    darks: Sequence[Template],
    *,
    black: float | np.ndarray = 0.0,
    pattern: str | Sequence[Sequence[str]] | None = None,
    step: float = 1.0,
) -> NoiseModel | None:
    """Estimate the noise of a sensor from stacks, else from single shots.

    Parameters
    ----------
    shots, whites, darks : sequence of Template, (h, w)
        Frames of one sensor at one gain setting; a white or None for each shot. Where there are more
        whites than shots, as of a line scan, single shots are not used.
    black, pattern, step
        As of `fit_noise_single`.

    Returns
    -------
    noise : NoiseModel or None
        Where no dark has several shots and stacks leave no read noise above rounding's, that of single
        shots is taken.
    """
    stacks = [t for t in (*shots, *(w for w in whites if w is not None)) if t.count > 1]
    quiet = [d for d in darks if d.count > 1 or d.fit is not None]
    fitted = None
    if stacks:
        stacks += quiet
        under = [_dark_of(t, darks) for t in stacks] if darks else None
        fitted = fit_noise(stacks, under, black=black, step=step)
    unread = fitted is not None and not quiet
    if (fitted is None or unread) and len(shots) == len(whites):
        under = [_dark_of(t, darks) for t in shots] if darks else None
        single = fit_noise_single(shots, whites, under, black=black, pattern=pattern, step=step)
        if fitted is None:
            fitted = single
        elif single is not None and fitted.read_variance <= fitted.step**2 / 12:
            fitted = replace(fitted, read_variance=single.read_variance)
    return fitted


def _dark_of(stack: Template, darks: Sequence[Template]) -> Template:
    """Return the dark nearest in time, a dark itself where it is one of them."""
    if any(stack is dark for dark in darks):
        return stack
    time = stack.exposure_s
    timed = [
        (abs(np.log(d.exposure_s / time)), i) for i, d in enumerate(darks) if time and d.exposure_s
    ]
    return darks[min(timed)[1] if timed else 0]


def fit_noise(
    stacks: Sequence[Template],
    dark: Template | Sequence[Template] | None = None,
    *,
    black: float | np.ndarray = 0.0,
    step: float = 1.0,
) -> NoiseModel | None:
    """Fit the noise of a sensor to stacks of at least two shots.

    Parameters
    ----------
    stacks : sequence of Template
        Objects, whites, darks, charts of one sensor at one gain setting; those of a single shot
        are passed over.
    dark : Template or sequence of Template, optional
        Subtracted from each to have the signal, one for all or one for each stack; without it
        `black` is, counts, one number or of every pixel. Darks of several shots are stacks like others: pass them among `stacks`.
    step : float
        Counts from code to code; 0 where values are not rounded.

    Returns
    -------
    noise : NoiseModel or None
        None where no stack has signal. Where all stacks have about the same signal, the read
        noise is taken as rounding's alone and the gain follows.

    Notes
    -----
    Where darks have different levels, those of longer exposures, what they have above the lowest counts
    as light: dark current has shot noise.
    Pixels are grouped by signal; a group's variance is the mean of theirs without what chance
    does not explain (something moved), so that few shots suffice where there are many pixels.
    Then one weighted line, three rounds. PRNU never enters; lamp flicker does.
    """
    darks = [dark] * len(stacks) if dark is None or isinstance(dark, Template) else list(dark)
    levels = [None if d is None else d.level for d in darks]
    lowest = min((level for level in levels if level is not None), default=None)
    groups: list[tuple[float, ...]] = []
    for stack, under, level in zip(stacks, darks, levels, strict=True):
        warm = 0.0 if level is None or lowest is None else level - lowest
        if stack.fit is not None:
            groups.append((warm, stack.fit.noise**2 + step**2 / 12, MOST_FREEDOM))
        elif stack.variance is not None:
            groups += [(s + warm, v, n) for s, v, n in _groups(stack, under, black, step)]
    if not groups:
        return None
    signal, variance, freedom = np.array(groups).T
    if signal.max() <= 0 or variance.max() <= 0:
        return None
    freedom = np.minimum(freedom, MOST_FREEDOM)
    gain, read = _line(signal, np.ones_like(signal), variance, freedom, step)
    return NoiseModel(gain, read, "temporal", step, lowest)


def compare_noise(
    noise: NoiseModel, stacks: Sequence[Template], levels: Sequence[np.ndarray | float]
) -> float:
    """Return the variance that stacks of one band have, over what the model of its sensor says; 1 where they do not tell.

    Parameters
    ----------
    noise : NoiseModel
        Of other bands of the sensor.
    stacks : sequence of Template, (h, w)
        Objects and whites of one band, above `levels`.
    levels : sequence of ndarray or float, as many
        Counts without light.

    Notes
    -----
    Where shot noise exceeds read noise: another gain multiplies that. What lies above half of the brightest counts may be
    full, and lack noise for that. Where there is nothing else, as in a white alone, it is looked at, too, and less
    than a fifth is taken for a sensor that is full, not for another gain.

    Examples
    --------
    The variance of two shots is 8 everywhere, that of the model 0.04 · 100 + 3:

    >>> from levkas.calibration.templates import average
    >>> stack = average([np.full((50, 50), 98.0), np.full((50, 50), 102.0)])
    >>> round(compare_noise(NoiseModel(0.04, 3.0, step=0.0), [stack], [0.0]), 2)
    1.14
    """
    groups = [
        group
        for stack, level in zip(stacks, levels, strict=True)
        if stack.count > 1 and stack.variance is not None and not stack.above_dark
        for group in _groups(stack, None, level, noise.step, most=FEW_PIXELS)
    ]
    if not groups:
        return 1.0
    signal, variance, freedom = np.array(groups).T
    lit = noise.gain * signal > noise.read_variance
    dim = lit & (signal <= DIM * signal.max())
    some = dim if dim.any() else lit
    if not some.any():
        return 1.0
    found = float(np.average((variance / noise.variance(signal))[some], weights=freedom[some]))
    return found if dim.any() or found > FULL else 1.0


def fit_noise_of_band(
    noise: NoiseModel,
    shots: Sequence[Template],
    whites: Sequence[Template],
    darks: Sequence[Template],
    *,
    black: float | np.ndarray = 0.0,
    step: float = 1.0,
) -> tuple[NoiseModel, float]:
    """Return the noise of one band, and its variance over that of other bands of the sensor.

    A camera may set its gain by itself, and another one for each filter. The model of the other bands, `noise`,
    is returned, and 1, unless the band's own stacks deny it (`compare_noise`, by `UNLIKE`).

    Parameters
    ----------
    noise : NoiseModel
        Of other bands of the sensor.
    shots, whites, darks : sequence of Template, (h, w)
        Of the band.
    black, step
        As of `fit_noise`.
    """
    lit = [*shots, *whites]
    levels = [_dark_of(t, darks).mean if darks else black for t in lit]
    found = compare_noise(noise, lit, levels)
    if 1 / UNLIKE < found < UNLIKE:
        return noise, 1.0
    own = fit_noise_of_frames(shots, [*whites], darks, black=black, step=step)
    if own is None or own.source != "temporal" or own.gain <= 0:
        return noise, 1.0
    return own, found


def mean_variance(stack: Template, *, step: float = 1.0) -> np.ndarray:
    """Return the variance of a stack's mean where nothing is known of the sensor: of a photograph.

    Parameters
    ----------
    stack : Template, (h, w) or (h, w, b)
        Of two shots or more, of whatever tone curve.
    step : float
        Counts from code to code; 0 where values are not rounded.

    Returns
    -------
    variance : ndarray like the stack, float32
        Counts².

    Notes
    -----
    A pixel's own variance of a few shots is no sigma: it weighs n − 1 against 60 of what pixels of like
    signal have in the mean, channel by channel.
    """
    freedom = stack.count - 1
    assert stack.variance is not None
    found = np.empty(stack.mean.shape, np.float32)
    for part in np.ndindex(stack.mean.shape[2:]):
        mean, variance, saturated, black = (
            array[(..., *part)]
            for array in (stack.mean, stack.variance, stack.saturated, stack.black)
        )
        groups = _groups(Template(mean, variance, stack.count, saturated, black), None, 0.0, step)
        whole = np.interp(mean, *zip(*(g[:2] for g in groups), strict=True)) if groups else variance
        alike = hidden_rounding(whole - step**2 / 12, step)
        shown = (freedom * variance + PRIOR * (whole - alike)) / (freedom + PRIOR)
        found[(..., *part)] = shown / stack.count + alike
    return found


def fit_noise_single(
    shots: Sequence[Template],
    whites: Sequence[Template | None],
    dark: Template | Sequence[Template] | None = None,
    *,
    black: float | np.ndarray = 0.0,
    pattern: str | Sequence[Sequence[str]] | None = None,
    step: float = 1.0,
) -> NoiseModel | None:
    """Estimate the noise of a sensor from single shots: an upper estimate.

    Parameters
    ----------
    shots : sequence of Template, (h, w)
        Objects, of one sensor at one gain setting; several bands may be pooled.
    whites : sequence of Template or None, as many
        The white of each; PRNU and shading divide out. None: they count as noise.
    dark : Template or sequence of Template, optional
        Subtracted from all, or one for each; without it `black` is, counts.
    pattern : str or rows of names, optional
        Of a mosaic: differences are taken within a phase.
    step : float
        Counts from code to code; 0 where values are not rounded.

    Returns
    -------
    noise : NoiseModel or None
        `source` is ``"spatial"``. None where too little of the frames is usable.

    Notes
    -----
    Immerkær's mask [1 −2 1]ᵀ[1 −2 1] leaves nothing of planes; of blocks of 8x8 of like signal the
    smoothest tenth, over what the fit of the round before expects of each, is read as what chi-squared
    says of pure noise. Fine texture everywhere still counts as noise.
    """
    rows, columns = (1, 1) if pattern is None else channel_table(pattern).shape
    found: list[np.ndarray] = []
    darks = [dark] * len(shots) if dark is None or isinstance(dark, Template) else list(dark)
    lowest = min((d.level for d in darks if d is not None), default=None)
    for shot, white, under in zip(shots, whites, darks, strict=True):
        level = np.asarray(black, np.float32) if under is None else under.mean
        warm = 0.0 if under is None or lowest is None else under.level - lowest
        planes = _ratio_planes(shot, white, level, gaps_of(shot, white, under))
        # A dark that was clipped has no noise that it adds.
        noisy = under is not None and under.fit is None and np.mean(under.black) <= MANY_BLACK
        counts = (shot.count, white.count if white else 0, under.count if under and noisy else 0)
        for parts in zip(*(split(plane, rows, columns) for plane in planes), strict=True):
            light, dim, variance = _blocks(*parts, shots=counts)
            found.append(np.stack([light + warm * dim, dim, variance]))
    groups = [group for blocks in found for group in _groups_of_blocks(blocks)]
    gain, read = 1.0, 0.0  # at first blocks are compared as shot noise alone would have them
    if not groups or max(float(light.max()) for light, _, _ in groups) <= 0:
        return None
    quiet = _noise_of_darks(
        {id(d): d for d in darks if d is not None}.values(), lowest, step, (rows, columns)
    )
    for _ in range(ROUNDS):
        shown = [(*_smoothest(group, gain, read), OF_GROUP) for group in groups] + quiet
        light, dim, variance, freedom = np.array(shown).T
        gain, read = _line(light, dim, variance, freedom, step)
    return NoiseModel(gain, read, "spatial", step, lowest)


def _groups(
    stack: Template,
    dark: Template | None,
    black: float | np.ndarray,
    step: float,
    *,
    most: int = MANY_PIXELS,
) -> list[tuple[float, float, float]]:
    """Return (signal, variance, degrees of freedom) of groups of pixels of one stack, of about `most` of them."""
    thin = np.s_[:: max(1, stack.mean.size // most)]
    level = np.asarray(black if dark is None else dark.mean)
    if level.size > 1:
        level = np.broadcast_to(level, stack.mean.shape).ravel()[thin]
    signal = stack.mean.ravel()[thin].astype(float) - level.ravel()
    spread = np.asarray(stack.variance).ravel()[thin].astype(float)
    clipped = stack.black.ravel()[thin]
    keep = np.isfinite(signal) & np.isfinite(spread) & ~stack.saturated.ravel()[thin]
    if (gaps := gaps_of(stack, dark)) is not None:
        keep &= ~np.broadcast_to(gaps, stack.mean.shape).flat[thin]
    if np.mean(clipped) > MANY_BLACK:
        keep &= ~clipped
    # Near black the clipping of single shots thins the spread where none was marked.
    if np.mean(clipped) > MANY_BLACK and keep.any():
        keep &= signal > 5 * np.sqrt(max(np.median(spread[keep]), step**2 / 12))
    kept = np.flatnonzero(keep)  # which is counted twice as fast as by a mask
    signal, spread = signal[kept], spread[kept]
    order = np.argsort(signal, kind="stable")
    parts = np.array_split(order, max(1, min(LEVELS, len(order) // 50)))
    freedom = stack.count - 1
    found = []
    for p in (part for part in parts if len(part) >= 20):
        # Of the same pixels: in a group of very unlike signal chance does not explain the brighter ones' spread.
        still = p[spread[p] <= _largest_spread(spread[p], freedom, step)]
        variance = float(whole_variance(float(spread[still].mean()), step))
        found.append((float(signal[still].mean()), variance, float(freedom * len(still))))
    return found


def _largest_spread(spread: np.ndarray, freedom: int, step: float) -> float:
    """Return the largest of sample variances that chance or rounding explains by those below it."""
    limit, kept = _largest_by_chance(freedom), spread
    for _ in range(20):
        inside = spread[spread <= max(limit * kept.mean(), step**2 / 2)]
        if len(inside) == len(kept) or not len(inside):
            break
        kept = inside
    return float(kept.max())


def _ratio_planes(
    shot: Template, white: Template | None, level: np.ndarray, gaps: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return object over white, white above dark, and where both are usable."""
    lit = np.ones_like(shot.mean) if white is None else white.mean - level
    good = ~shot.saturated & ~shot.black & (lit > 0)
    if white is not None:
        good &= ~white.saturated
    if gaps is not None:
        good &= ~gaps
    ratio = (shot.mean - level) / np.where(good, lit, 1)
    return ratio, lit, good


def _blocks(
    ratio: np.ndarray, lit: np.ndarray, good: np.ndarray, *, shots: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (factor of gain, factor of read², variance of what is rough) of the blocks of a plane that are usable whole."""
    high, wide = (max(0, n - 2) // BLOCK * BLOCK for n in ratio.shape)
    part = (slice(1, 1 + high), slice(1, 1 + wide))
    usable = _block_means(good[part]) == 1
    planes = (ratio[part], lit[part], _roughness_squared(ratio))
    f, m, v = (_block_means(plane)[usable] for plane in planes)
    n, white_n, dark_n = shots
    by_white = f**2 / white_n if white_n else 0 * f
    by_dark = (1 - (f if white_n else 0 * f)) ** 2 / dark_n if dark_n else 0 * f
    return np.maximum(f, 0) * m / n + by_white * m, 1 / n + by_white + by_dark, v * m**2


def _roughness_squared(plane: np.ndarray) -> np.ndarray:
    """Return the square of Immerkær's mask, (h - 2, w - 2): of white noise its variance, of planes nothing."""
    rough = plane[:-2] - 2 * plane[1:-1] + plane[2:]
    return np.square((rough[:, :-2] - 2 * rough[:, 1:-1] + rough[:, 2:]) / 6)


def _block_means(plane: np.ndarray) -> np.ndarray:
    """Return the means of whole blocks, one after another."""
    high, wide = (n // BLOCK for n in plane.shape)
    whole = plane[: high * BLOCK, : wide * BLOCK].astype(float)
    return whole.reshape(high, BLOCK, wide, BLOCK).mean((1, 3)).ravel()


def _noise_of_darks(
    darks: Iterable[Template],
    lowest: float | None,
    step: float,
    period: tuple[int, int],
) -> list[tuple[float, float, float, float]]:
    """Return (signal, 1, variance, degrees of freedom) of darks, of single ones by their smooth parts.

    Of dark paint nothing else tells as much. A single dark may have been averaged before: it weighs as one group of blocks.
    """
    found = []
    for dark in darks:
        warm = dark.level - (lowest or 0.0)
        if dark.fit is not None:
            found.append((warm, 1.0, dark.fit.noise**2 + step**2 / 12, MOST_FREEDOM))
        elif np.mean(dark.black) > MANY_BLACK:
            continue
        elif dark.variance is None:
            for plane in split(dark.mean, *period):
                blocks = _block_means(_roughness_squared(plane))
                if len(blocks) >= 40:
                    variance = float(np.quantile(blocks, 0.1)) / TENTH
                    found.append((warm, 1.0, variance, OF_GROUP))
        else:
            groups = _groups(dark, None, 0.0, step)
            found += [(warm, 1.0, variance, min(n, MOST_FREEDOM)) for _, variance, n in groups]
    return found


def _groups_of_blocks(blocks: np.ndarray) -> list[np.ndarray]:
    """Return groups of blocks (3, n) of like factor of gain."""
    count = blocks.shape[1]
    blocks = blocks[:, np.argsort(blocks[0], kind="stable")]
    parts = np.array_split(blocks, max(1, min(LEVELS, count // 100)), axis=1)
    return [part for part in parts if part.shape[1] >= 40]


def _smoothest(group: np.ndarray, gain: float, read: float) -> tuple[float, float, float]:
    """Return mean factors of gain and of read² of a group (3, n), and its variance by the smoothest tenth of what is expected."""
    light, dim, variance = group
    expected = np.maximum(gain * np.maximum(light, 0) + read * dim, 1e-9)
    tenth = float(np.quantile(variance / expected, 0.1)) / TENTH
    return float(light.mean()), float(dim.mean()), tenth * float(expected.mean())


def _line(
    light: np.ndarray, dim: np.ndarray, variance: np.ndarray, freedom: np.ndarray, step: float
) -> tuple[float, float]:
    """Return (gain, read²) of variance = gain·light + read²·dim, weighted, both kept in range."""
    least = max(step**2 / 12, 1e-12 * float(variance.max()))  # rounding, or hardly anything
    if light.max() < SPREAD * max(light.min(), 1e-9):
        rest = np.maximum(variance - least * dim, 0.0)
        return float(np.sum(freedom * rest) / np.sum(freedom * light)), least
    gain, read, expected = 0.0, 0.0, np.maximum(variance, least * dim)
    for _ in range(3):
        weight = np.sqrt(freedom) / expected
        design = np.stack([light, dim], 1) * weight[:, None]
        gain, read = np.linalg.lstsq(design, variance * weight, rcond=None)[0]
        if read < least:
            read = least
            rest = variance - read * dim
            gain = np.sum(weight**2 * light * rest) / np.sum((weight * light) ** 2)
        if gain < 0:
            gain = 0.0
            read = np.sum(weight**2 * dim * variance) / np.sum((weight * dim) ** 2)
        expected = read * dim + gain * np.maximum(light, 0.0)
    return float(gain), float(read)


@cache
def _largest_by_chance(freedom: int) -> float:
    """Return the sample variance that one in a million exceeds, over the true one."""
    from scipy.special import gammainccinv

    return 2 * float(gammainccinv(freedom / 2, 1e-6)) / freedom

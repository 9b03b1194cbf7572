"""Photon transfer: variance = read² + gain · signal of one raw value, fitted to the frames of a campaign.

EMVA 1288; its parts are those of Healey & Kondepudy 1994, doi:10.1109/34.276126. From stacks (two shots or more of one
scene) the variance over time is free of everything fixed: texture, PRNU, shading. From single shots only an upper estimate
can be had, from what is left of the smoothest parts of object over white, where PRNU and shading divide out.

Rounding to codes a step apart adds step²/12 to the variance of one value. Repeats show it as long as the noise carries a
value over half a step; what they do not show, B, stays in the mean of any number of shots: variance of a mean =
(T − B)/n + B, with T = noise² + step²/12 of one shot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.patterns import blocks_of, channel_table
from levkas.calibration.templates import MANY_PIXELS, Template, gaps_of
from levkas.core.compiled import njit

if TYPE_CHECKING:
    from levkas.calibration.darks import MatchedDark

WORKED_OUT = 1e9
"""Degrees of freedom of a variance that was derived, not sampled."""
PRIOR = 60.0
"""Degrees of freedom that a noise model counts for beside those of a stack: 30 or 90 change sigma of ten shots by 3 %."""
HIDES = 0.25
"""Of step²: of more noise repeats show all of rounding, B < 3e-6 step²."""
MOST_FREEDOM = 2e4
"""Of a group: a misfit of 1 % in a full one does not rule the line."""
LEVELS, OF_GROUP = 24, 100.0
"""Groups of equal size by signal, and degrees of freedom of one of blocks; half or twice moves a gain by less than its error."""
MANY_BLACK = 0.02
"""A dark with a larger share of zeros was clipped: its spread is not its noise."""
BLOCK, TENTH = 8, 0.593
"""Side of a block, sensels, and lower tenth of chi-squared over its freedom: 64 differences count as 17 (Σρ² = 3.78)."""
SPREAD = 2.0
"""Highest over lowest signal that tells gain from read noise."""
UNLIKE = 1.3
"""Of the variance of other bands, or its inverse, from which on a band has another gain; two shots tell 1 %."""

Phase = tuple[slice | int, ...]
Groups = list[tuple[float, float, float, float]]
"""Light, dimming of read², variance and degrees of freedom: variance = gain · light + read² · dimming."""


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
        Counts of the dark at which `read_variance` holds: a longer exposure has the shot noise of its dark current besides.

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


@njit(cache=True)
def hidden_rounding(noise, step):  # type: ignore[no-untyped-def]
    """Return B, the variance of rounding that repeats do not show, counts², from the variance before rounding.

    B = step²/(2π²) Σ exp(−4π²k² noise/step²)/k², the variance of the mean rounding error over values that lie anywhere between
    two codes [widrow2008]_: step²/12 without noise, nothing from noise of half a step on.

    >>> [round(hidden_rounding(noise, 1.0), 3) for noise in (0.0, 0.04, 1.0)]
    [0.083, 0.01, 0.0]
    """
    if not noise < HIDES * step * step:
        return 0.0
    x, total = -4.0 * np.pi**2 * max(noise, 0.0) / (step * step), np.pi**2 / 6
    if x < 0.0:
        total = 0.0
        for k in range(1, 64):
            term = np.exp(x * k * k) / (k * k)
            total += term
            if term < 1e-6:
                break
    return step * step / (2.0 * np.pi**2) * total


@cache
def _rounded() -> tuple[np.ndarray, np.ndarray]:
    """Return variances before rounding and what it hides of each, both (500,), of codes 1 apart."""
    noise = np.linspace(0, HIDES, 500)
    return noise, np.array([hidden_rounding(one, 1.0) for one in noise])


def whole_variance(shown: float | np.ndarray, step: float) -> np.ndarray:
    """Return the variance of one value, rounding included, from what repeats show of it, counts².

    >>> whole_variance(np.array([0.0, 4.0]), 1.0).round(3).tolist()
    [0.083, 4.0]
    """
    if not step:
        return np.asarray(shown, float)
    noise, hidden = _rounded()
    whole, shows = step**2 * (noise + 1 / 12), step**2 * (noise + 1 / 12 - hidden)
    return np.where(np.asarray(shown) < shows[-1], np.interp(shown, shows, whole), shown)


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

    Frames are (h, w) or (h, w, bands), of one sensor at one gain; a white or None for each shot. Where there are more whites than shots, as
    of a line scan, single shots are not used. Where stacks hold no dark and leave no read noise above rounding's, that of
    single shots is taken.
    """
    stacks = [t for t in (*shots, *(w for w in whites if w is not None)) if t.count > 1]
    quiet = [d for d in darks if d.count > 1 or d.fit is not None]
    fitted = fit_noise([*stacks, *quiet], darks, black=black, step=step) if stacks else None
    if (fitted is not None and quiet) or len(shots) != len(whites):
        return fitted
    single = fit_noise_single(shots, whites, darks, black=black, pattern=pattern, step=step)
    if fitted is None or single is None:
        return fitted or single
    known = fitted.read_variance > step**2 / 12
    return fitted if known else replace(fitted, read_variance=single.read_variance)


def _dark_of(stack: Template, darks: Sequence[Template]) -> Template | None:
    """Return the dark nearest in time, a dark itself where it is one of them; None of none."""
    if any(stack is dark for dark in darks):
        return stack
    time = stack.exposure_s or 0.0
    timed = [d for d in darks if time and d.exposure_s] or darks[:1]
    return min(timed, key=lambda d: abs(np.log((d.exposure_s or 1) / (time or 1))), default=None)


def _with_darks(
    frames: Sequence[Template], darks: Sequence[Template]
) -> tuple[list[tuple[Template | None, float]], float | None]:
    """Return the dark of each frame and what its level has above the lowest, counts, and that lowest."""
    own = [_dark_of(frame, darks) for frame in frames]
    lowest = min((d.level for d in own if d is not None), default=None)
    return [(d, 0.0 if d is None or lowest is None else d.level - lowest) for d in own], lowest


def fit_noise(
    stacks: Sequence[Template],
    darks: Sequence[Template] = (),
    *,
    black: float | np.ndarray = 0.0,
    step: float = 1.0,
) -> NoiseModel | None:
    """Fit the noise of a sensor to stacks of at least two shots; None where no stack has signal.

    Objects, whites, darks, charts of one sensor at one gain; those of a single shot are passed over. From each the dark nearest
    in time is subtracted, else `black`, counts. `step` is from code to code, 0 where values are not rounded.

    What darks of longer exposures have above the lowest counts as light: dark current has shot noise. Pixels are grouped by
    signal; a group's variance is the mean of theirs without what chance does not explain (something moved). Then one
    weighted line, three rounds. PRNU never enters; lamp flicker does. Where all stacks have about one signal, read noise is
    taken as rounding's alone.
    """
    under, lowest = _with_darks(stacks, darks)
    groups: Groups = []
    for stack, (dark, warm) in zip(stacks, under, strict=True):
        if stack.fit is not None:
            groups.append((warm, 1.0, stack.fit.noise**2 + step**2 / 12, MOST_FREEDOM))
        elif stack.variance is not None:
            found = _groups(stack, black if dark is None else dark.mean, step, under=dark)
            groups += [(s + warm, 1.0, v, min(n, MOST_FREEDOM)) for s, v, n in found]
    if not groups or max(g[0] for g in groups) <= 0 or max(g[2] for g in groups) <= 0:
        return None
    return NoiseModel(*_line(groups, step), "temporal", step, lowest)


def compare_noise(
    noise: NoiseModel, stacks: Sequence[Template], levels: Sequence[np.ndarray | float]
) -> float:
    """Return the variance that stacks of one band have, over what the model of other bands says; 1 where they do not tell.

    Looked at is where shot noise exceeds read noise, which another gain multiplies, below half of the brightest counts: what
    lies above may be full, and lack noise for that. Where there is nothing else, as in a white alone, it is looked at, too,
    and less than a fifth is taken for a sensor that is full. `levels` are counts without light.

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
        for group in _groups(stack, level, noise.step, most=MANY_PIXELS // 10)
    ]
    if not groups:
        return 1.0
    signal, variance, freedom = np.array(groups).T
    lit = noise.gain * signal > noise.read_variance
    dim = lit & (signal <= signal.max() / 2)
    some = dim if dim.any() else lit
    if not some.any():
        return 1.0
    found = float(np.average((variance / noise.variance(signal))[some], weights=freedom[some]))
    return found if dim.any() or found > 0.2 else 1.0


def fit_noise_of_band(
    noise: NoiseModel,
    shots: Sequence[Template],
    whites: Sequence[Template],
    darks: Sequence[Template],
    *,
    black: float | np.ndarray = 0.0,
    step: float = 1.0,
) -> tuple[NoiseModel, float]:
    """Return the noise of one band, and its variance over that of other bands, `noise`.

    A camera may set its gain by itself, and another one for each filter. The model of the other bands is returned, and 1,
    unless the band's own stacks deny it (`compare_noise`, by `UNLIKE`).
    """
    lit = [*shots, *whites]
    under = [_dark_of(t, darks) for t in lit]
    found = compare_noise(noise, lit, [black if d is None else d.mean for d in under])
    if 1 / UNLIKE < found < UNLIKE:
        return noise, 1.0
    own = fit_noise_of_frames(shots, [*whites], darks, black=black, step=step)
    if own is None or own.source != "temporal" or own.gain <= 0:
        return noise, 1.0
    return own, found


def mean_variance(stack: Template, *, step: float = 1.0) -> np.ndarray:
    """Return the variance of a stack's mean where nothing is known of the sensor: of a photograph, counts², float32.

    A pixel's own variance of a few shots is no sigma: it weighs n − 1 against 60 of what pixels of like signal have in the
    mean, channel by channel.
    """
    freedom = stack.count - 1
    assert stack.variance is not None
    found = np.empty(stack.mean.shape, np.float32)
    for part in np.ndindex(stack.mean.shape[2:]):
        own = (..., *part)
        planes = (stack.mean, stack.variance, stack.saturated, stack.black)
        mean, variance, saturated, black = (plane[own] for plane in planes)
        groups = _groups(Template(mean, variance, stack.count, saturated, black), 0.0, step)
        whole = np.interp(mean, *zip(*(g[:2] for g in groups), strict=True)) if groups else variance
        noise, hidden = _rounded()
        alike = step**2 * np.interp(whole / step**2 - 1 / 12, noise, hidden) if step else 0.0
        shown = (freedom * variance + PRIOR * (whole - alike)) / (freedom + PRIOR)
        found[own] = shown / stack.count + alike
    return found


def fit_noise_single(
    shots: Sequence[Template],
    whites: Sequence[Template | None],
    darks: Sequence[Template] = (),
    *,
    black: float | np.ndarray = 0.0,
    pattern: str | Sequence[Sequence[str]] | None = None,
    step: float = 1.0,
) -> NoiseModel | None:
    """Estimate the noise of a sensor from single shots, an upper estimate; None where too little of them is usable.

    Objects (h, w), several bands may be pooled, with the white of each; without one PRNU and shading count as noise. `darks`,
    `black` and `step` are as of `fit_noise`; of a mosaic differences are taken within a phase.

    The mask [1 −2 1]ᵀ[1 −2 1] of [immerkaer1996]_, doi:10.1006/cviu.1996.0060, leaves nothing of planes; of blocks of 8x8 of
    like signal the smoothest tenth, over what the fit of the round before expects of each, is read as what chi-squared says
    of pure noise. Fine texture everywhere still counts as noise.
    """
    bands = range(shots[0].mean.shape[2] if shots and shots[0].mean.ndim == 3 else 0)
    period = (1, 1) if pattern is None else channel_table(pattern).shape
    phases: list[Phase] = [np.s_[y :: period[0], x :: period[1]] for y, x in np.ndindex(period)]
    phases = [np.s_[:, :, k] for k in bands] or phases
    under, lowest = _with_darks(shots, darks)
    groups: list[np.ndarray] = []
    for shot, white, (dark, warm) in zip(shots, whites, under, strict=True):
        level = np.asarray(black, np.float32) if dark is None else dark.mean
        for phase in phases:
            groups += _groups_of_blocks(_blocks(shot, white, dark, level, phase), warm)
    if not groups or max(float(light.max()) for light, _, _ in groups) <= 0:
        return None
    quiet: Groups = []
    for one, warm in {id(d): (d, more) for d, more in under if d is not None}.values():
        quiet += _noise_of_dark(one, warm, step, phases)
    gain, read = 1.0, 0.0  # at first blocks are compared as shot noise alone would have them
    for _ in range(4):
        gain, read = _line([*(_smoothest(group, gain, read) for group in groups), *quiet], step)
    return NoiseModel(gain, read, "spatial", step, lowest)


def _groups(
    stack: Template,
    level: np.ndarray | float,
    step: float,
    *,
    under: Template | None = None,
    most: int = MANY_PIXELS,
) -> list[tuple[float, float, float]]:
    """Return (signal, variance, degrees of freedom) of groups of pixels of one stack, of about `most` of them."""
    thin = np.s_[:: max(1, stack.mean.size // most)]

    def some(plane: np.ndarray | float) -> np.ndarray:
        return np.broadcast_to(plane, stack.mean.shape).ravel()[thin]

    signal = some(stack.mean).astype(float) - some(level)
    spread = some(np.asarray(stack.variance)).astype(float)
    keep = np.isfinite(signal) & np.isfinite(spread) & ~some(stack.saturated)
    if (gaps := gaps_of(stack, under)) is not None:
        keep &= ~some(gaps)
    clipped = some(stack.black)
    if np.mean(clipped) > MANY_BLACK:
        keep &= ~clipped
        # Near black the clipping of single shots thins the spread where none was marked.
        if keep.any():
            keep &= signal > 5 * np.sqrt(max(np.median(spread[keep]), step**2 / 12))
    signal, spread = signal[keep], spread[keep]
    order = np.argsort(signal, kind="stable")
    freedom = stack.count - 1
    found = []
    for part in np.array_split(order, max(1, min(LEVELS, len(order) // 50))):
        if len(part) < 20:
            continue
        # Of the same pixels: in a group of very unlike signal chance does not explain the brighter ones' spread.
        still = part[spread[part] <= _largest_spread(spread[part], freedom, step)]
        variance = float(whole_variance(float(spread[still].mean()), step))
        found.append((float(signal[still].mean()), variance, float(freedom * len(still))))
    return found


def _largest_spread(spread: np.ndarray, freedom: int, step: float) -> float:
    """Return the largest of sample variances that chance (one in a million) or rounding explains by those below it."""
    from scipy.special import gammainccinv

    limit, kept = 2 * float(gammainccinv(freedom / 2, 1e-6)) / freedom, spread
    for _ in range(20):
        inside = spread[spread <= max(limit * kept.mean(), step**2 / 2)]
        if len(inside) == len(kept) or not len(inside):
            break
        kept = inside
    return float(kept.max())


def _blocks(
    shot: Template, white: Template | None, under: Template | None, level: np.ndarray, phase: Phase
) -> np.ndarray:
    """Return factor of gain, factor of read² and variance of what is rough, (3, n), of blocks of a phase that are usable whole."""
    lit = np.ones_like(shot.mean) if white is None else white.mean - level
    good = ~shot.saturated & ~shot.black & (lit > 0)
    if white is not None:
        good &= ~white.saturated
    if (gaps := gaps_of(shot, white, under)) is not None:
        good &= ~gaps
    ratio = ((shot.mean - level) / np.where(good, lit, 1))[phase]
    high, wide = (max(0, n - 2) // BLOCK * BLOCK for n in ratio.shape)
    part = (slice(1, 1 + high), slice(1, 1 + wide))
    usable = _block_means(good[phase][part]) == 1
    planes = (ratio[part], lit[phase][part], _roughness_squared(ratio))
    f, m, v = (_block_means(plane)[usable] for plane in planes)
    white_share = 1 / white.count if white else 0.0
    # A dark that was clipped has no noise that it adds.
    noisy = under is not None and under.fit is None and np.mean(under.black) <= MANY_BLACK
    dark_share = 1 / under.count if under and noisy else 0.0
    light = (np.maximum(f, 0) / shot.count + f**2 * white_share) * m
    dim = 1 / shot.count + f**2 * white_share + (1 - f * bool(white)) ** 2 * dark_share
    return np.stack([light, dim, v * m**2])


def _roughness_squared(plane: np.ndarray) -> np.ndarray:
    """Return the square of Immerkær's mask, (h - 2, w - 2): of white noise its variance, of planes nothing."""
    rough = plane[:-2] - 2 * plane[1:-1] + plane[2:]
    return np.square((rough[:, :-2] - 2 * rough[:, 1:-1] + rough[:, 2:]) / 6)


def _block_means(plane: np.ndarray) -> np.ndarray:
    """Return the means of whole blocks, one after another."""
    return blocks_of(plane.astype(float), BLOCK).mean((2, 3)).ravel()


def _noise_of_dark(dark: Template, warm: float, step: float, phases: Sequence[Phase]) -> Groups:
    """Return groups of a dark, of a single one by its smooth parts: of dark paint nothing else tells as much.

    A single dark may have been averaged before: it weighs as one group of blocks.
    """
    if dark.fit is not None:
        return [(warm, 1.0, dark.fit.noise**2 + step**2 / 12, MOST_FREEDOM)]
    if np.mean(dark.black) > MANY_BLACK:
        return []
    if dark.variance is not None:
        groups = _groups(dark, 0.0, step)
        return [(warm, 1.0, variance, min(n, MOST_FREEDOM)) for _, variance, n in groups]
    planes = [_block_means(_roughness_squared(dark.mean[phase])) for phase in phases]
    tenths = [float(np.quantile(blocks, 0.1)) / TENTH for blocks in planes if len(blocks) >= 40]
    return [(warm, 1.0, variance, OF_GROUP) for variance in tenths]


def _groups_of_blocks(blocks: np.ndarray, warm: float) -> list[np.ndarray]:
    """Return groups of blocks (3, n) of like factor of gain, to which the dark current of `warm` counts is added."""
    blocks = np.stack([blocks[0] + warm * blocks[1], *blocks[1:]])
    blocks = blocks[:, np.argsort(blocks[0], kind="stable")]
    parts = np.array_split(blocks, max(1, min(LEVELS, blocks.shape[1] // 100)), axis=1)
    return [part for part in parts if part.shape[1] >= 40]


def _smoothest(group: np.ndarray, gain: float, read: float) -> tuple[float, float, float, float]:
    """Return a group of blocks (3, n) as one, its variance by the smoothest tenth of what is expected."""
    light, dim, variance = group
    expected = np.maximum(gain * np.maximum(light, 0) + read * dim, 1e-9)
    tenth = float(np.quantile(variance / expected, 0.1)) / TENTH
    return float(light.mean()), float(dim.mean()), tenth * float(expected.mean()), OF_GROUP


def _line(groups: Groups, step: float) -> tuple[float, float]:
    """Return gain and read² by weighted least squares, both kept in range: read² is rounding's at least."""
    from scipy.optimize import nnls

    light, dim, variance, freedom = np.array(groups).T
    least = max(step**2 / 12, 1e-12 * float(variance.max()))
    if light.max() < SPREAD * max(light.min(), 1e-9):
        rest = np.maximum(variance - least * dim, 0.0)
        return float(np.sum(freedom * rest) / np.sum(freedom * light)), least
    gain, read, expected = 0.0, 0.0, np.maximum(variance, least * dim)
    for _ in range(3):
        weight = np.sqrt(freedom) / expected
        design = np.stack([light, dim], 1) * weight[:, None]
        (gain, more), _ = nnls(design, (variance - least * dim) * weight)
        read = least + more
        expected = read * dim + gain * np.maximum(light, 0.0)
    return float(gain), float(read)

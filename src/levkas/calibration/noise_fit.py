"""How noisy a sensor is: variance = read² + gain · signal, fitted to the frames that are there.

From stacks (two shots or more of one scene) the variance over time is free of everything fixed:
texture, PRNU, shading. From single shots only an upper estimate can be had, from what is left of
the smoothest parts of object over white, where PRNU and shading divide out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.patterns import channel_table, split
from levkas.calibration.templates import Template

QUANTISATION = 1 / 12  # variance of rounding to whole counts
MANY_PIXELS = 200_000  # of one stack that are looked at
LEVELS = 24  # groups of equal size by signal, a stack
MANY_BLACK = 0.02  # a dark with more zeros than this was clipped, and its spread is not noise
BLOCK = 8
TENTH = 0.593  # lower tenth of chi-squared over its freedom: 64 differences count as 17 (Σρ² 3.78)
SPREAD = 2.0  # highest over lowest signal that tells gain from read noise


@dataclass(frozen=True)
class NoiseModel:
    """Variance of one raw value of a sensor.

    Parameters
    ----------
    gain : float
        Counts per photo-electron: slope of variance over signal.
    read_variance : float
        Variance without light, counts², quantisation included.
    source : str
        ``"temporal"`` (from stacks) or ``"spatial"`` (from single shots: an upper estimate).

    Examples
    --------
    >>> float(NoiseModel(0.1, 4.0).variance(1000.0))
    104.0
    """

    gain: float
    read_variance: float
    source: str = "temporal"

    def variance(self, signal: float | np.ndarray) -> np.ndarray:
        """Return the variance at a signal in counts above dark."""
        return self.read_variance + self.gain * np.maximum(signal, 0.0)


def fit_noise(
    stacks: Sequence[Template], dark: Template | None = None, *, black: float = 0.0
) -> NoiseModel | None:
    """Fit the noise of a sensor to stacks of at least two shots.

    Parameters
    ----------
    stacks : sequence of Template
        Objects, whites, darks, charts of one sensor at one gain setting; those of a single shot
        are passed over.
    dark : Template, optional
        Subtracted from each to have the signal; without it `black` is, counts.

    Returns
    -------
    noise : NoiseModel or None
        None where no stack has signal. Where all stacks have about the same signal, the read
        noise is taken as quantisation's alone and the gain follows.

    Notes
    -----
    Pixels are grouped by signal; a group's variance is the mean of theirs without what chance
    does not explain (something moved), so that few shots suffice where there are many pixels.
    Then one weighted line, three rounds. PRNU never enters; lamp flicker does.
    """
    groups = [g for s in stacks if s.variance is not None for g in _groups(s, dark, black)]
    if not groups:
        return None
    signal, variance, freedom = np.array(groups).T
    if signal.max() <= 0 or variance.max() <= 0:
        return None
    # Freedom is bounded so that a misfit of 1 % in one full group does not rule the line.
    gain, read = _line(signal, np.ones_like(signal), variance, np.minimum(freedom, 2e4))
    return NoiseModel(gain, read, "temporal")


def fit_noise_single(
    shots: Sequence[Template],
    whites: Sequence[Template | None],
    dark: Template | None = None,
    *,
    black: float = 0.0,
    pattern: str | Sequence[Sequence[str]] | None = None,
) -> NoiseModel | None:
    """Estimate the noise of a sensor from single shots: an upper estimate.

    Parameters
    ----------
    shots : sequence of Template, (h, w)
        Objects, of one sensor at one gain setting; several bands may be pooled.
    whites : sequence of Template or None, as many
        The white of each; PRNU and shading divide out. None: they count as noise.
    dark : Template, optional
        Subtracted from all; without it `black` is, counts.
    pattern : str or rows of names, optional
        Of a mosaic: differences are taken within a phase.

    Returns
    -------
    noise : NoiseModel or None
        `source` is ``"spatial"``. None where too little of the frames is usable.

    Notes
    -----
    Immerkær's mask [1 −2 1]ᵀ[1 −2 1] leaves nothing of planes; of blocks of 8x8 with like
    expected noise the smoothest tenth is read as what chi-squared says of pure noise. Fine
    texture everywhere still counts as noise.
    """
    rows, columns = (1, 1) if pattern is None else channel_table(pattern).shape
    groups: list[tuple[float, ...]] = []
    for shot, white in zip(shots, whites, strict=True):
        level = np.float32(black) if dark is None else dark.mean
        planes = _ratio_planes(shot, white, level)
        for parts in zip(*(split(plane, rows, columns) for plane in planes), strict=True):
            groups += _smooth_groups(*parts, shots=(shot.count, white.count if white else 0))
    if not groups:
        return None
    light, dim, variance = np.array(groups).T
    if light.max() <= 0:
        return None
    gain, read = _line(light, dim, variance, np.full(len(light), 100.0))
    return NoiseModel(gain, read, "spatial")


def _groups(stack: Template, dark: Template | None, black: float) -> list[tuple[float, ...]]:
    """Return (signal, variance, degrees of freedom) of groups of pixels of one stack."""
    step = max(1, stack.mean.size // MANY_PIXELS)
    level = black if dark is None else np.broadcast_to(dark.mean, stack.mean.shape).ravel()[::step]
    signal = stack.mean.ravel()[::step].astype(float) - level
    spread = np.asarray(stack.variance).ravel()[::step].astype(float)
    clipped = stack.black.ravel()[::step]
    keep = np.isfinite(signal) & np.isfinite(spread) & ~stack.saturated.ravel()[::step]
    if np.mean(clipped) > MANY_BLACK:
        keep &= ~clipped
    # Near black the clipping of single shots thins the spread where none was marked.
    if np.mean(clipped) > MANY_BLACK and keep.any():
        keep &= signal > 5 * np.sqrt(max(np.median(spread[keep]), QUANTISATION))
    signal, spread = signal[keep], spread[keep]
    order = np.argsort(signal, kind="stable")
    parts = np.array_split(order, LEVELS) if len(order) >= 50 * LEVELS else [order]
    freedom = stack.count - 1
    return [
        (float(signal[p].mean()), _mean_variance(spread[p], freedom), float(freedom * len(p)))
        for p in parts
        if len(p) >= 20
    ]


def _mean_variance(spread: np.ndarray, freedom: int) -> float:
    """Return the mean of sample variances without those that chance does not explain."""
    from scipy.special import gammainccinv

    limit = 2 * float(gammainccinv(freedom / 2, 1e-6)) / freedom
    kept = spread
    for _ in range(20):
        inside = spread[spread <= limit * kept.mean()]
        if len(inside) == len(kept) or not len(inside):
            break
        kept = inside
    return float(kept.mean())


def _ratio_planes(
    shot: Template, white: Template | None, level: np.ndarray | np.float32
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return object over white, white above dark, and where both are usable."""
    lit = np.ones_like(shot.mean) if white is None else white.mean - level
    good = ~shot.saturated & ~shot.black & (lit > 0)
    if white is not None:
        good &= ~white.saturated
    ratio = (shot.mean - level) / np.where(good, lit, 1)
    return ratio, lit, good


def _smooth_groups(
    ratio: np.ndarray, lit: np.ndarray, good: np.ndarray, *, shots: tuple[int, int]
) -> list[tuple[float, float, float]]:
    """Return (factor of gain, factor of read², variance) of groups of smooth blocks."""
    high, wide = ((n - 2) // BLOCK for n in ratio.shape)
    if high < 1 or wide < 1:
        return []
    part = (slice(1, 1 + high * BLOCK), slice(1, 1 + wide * BLOCK))
    rough = ratio[:-2] - 2 * ratio[1:-1] + ratio[2:]
    rough = (rough[:, :-2] - 2 * rough[:, 1:-1] + rough[:, 2:]) / 6

    def blocks(plane: np.ndarray) -> np.ndarray:
        whole = plane[: high * BLOCK, : wide * BLOCK].astype(float)
        return whole.reshape(high, BLOCK, wide, BLOCK).mean((1, 3)).ravel()

    usable = blocks(good[part]) == 1
    f, m, v = (a[usable] for a in (blocks(ratio[part]), blocks(lit[part]), blocks(rough**2)))
    n, white_n = shots
    by_white = f**2 / white_n if white_n else 0 * f
    light = np.maximum(f, 0) * m / n + by_white * m
    variance, dim = v * m**2, 1 / n + by_white
    order = np.argsort(light, kind="stable")
    parts = np.array_split(order, max(1, min(LEVELS, len(order) // 100))) if len(order) else []
    return [
        (float(light[p].mean()), float(dim[p].mean()), float(np.quantile(variance[p], 0.1) / TENTH))
        for p in parts
        if len(p) >= 40
    ]


def _line(
    light: np.ndarray, dim: np.ndarray, variance: np.ndarray, freedom: np.ndarray
) -> tuple[float, float]:
    """Return (gain, read²) of variance = gain·light + read²·dim, weighted, both kept in range."""
    if light.max() < SPREAD * max(light.min(), 1e-9):
        rest = np.maximum(variance - QUANTISATION * dim, 0.0)
        return float(np.sum(freedom * rest) / np.sum(freedom * light)), QUANTISATION
    gain, read, expected = 0.0, 0.0, np.maximum(variance, QUANTISATION * dim)
    for _ in range(3):
        weight = np.sqrt(freedom) / expected
        design = np.stack([light, dim], 1) * weight[:, None]
        gain, read = np.linalg.lstsq(design, variance * weight, rcond=None)[0]
        if read < QUANTISATION:
            read = QUANTISATION
            rest = variance - read * dim
            gain = np.sum(weight**2 * light * rest) / np.sum((weight * light) ** 2)
        if gain < 0:
            gain = 0.0
            read = np.sum(weight**2 * dim * variance) / np.sum((weight * dim) ** 2)
        expected = read * dim + gain * np.maximum(light, 0.0)
    return float(gain), float(read)

"""A mosaic sensor behind a narrow filter: every sensel sees the same band, each phase by a gain.

v_p(x, y) = g_p · s(x, y). The gains are measured against the strongest phase where the picture is smooth; one plane is then
made of the phases that say something, at the sensor's own pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from levkas.calibration.findings import refusal
from levkas.calibration.mosaic import Place, Taps, interpolate, smoothed
from levkas.calibration.patterns import as_pattern, blocks_of, split
from levkas.core.cube import Flag

BLOCK, FLATTEST = 6, 0.5
"""Sensels of a phase to a side of the blocks whose means are compared, and the share of the lit ones that is used, the flattest
first: half or twice moves gains by less than 0.1 %."""
WEAKEST, CLIPPED = 0.15, 0.01
"""Gain below which a phase adds nothing but its noise and its black's error; share of a phase that may be saturated or black."""
CLIPS = Flag.SATURATED.value | Flag.BLACK.value


class PhaseGains(NamedTuple):
    """What each place of the pattern records of one narrow band, (rows, columns) float64.

    `gains` are relative to the strongest phase, NaN where they could not be measured; `weights` of each phase in the common
    plane are gain²/variance, the largest 1, 0 where it is dropped.
    """

    gains: np.ndarray
    weights: np.ndarray


def phase_gains(
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    pattern: str | Sequence[Sequence[str]],
) -> PhaseGains:
    """Measure the gains of a mosaic's phases on a picture of one narrow band, counts above dark, (h, w).

    Means of blocks of a phase against those of the strongest, a line through 0 by iteratively reweighted least squares (Tukey's
    biweight), over the flatter half of the lit blocks without flags; that the phases lie at different places is made good by
    each block's slope. Dropped are phases of less gain than `WEAKEST`, and those that are saturated or black over more than a
    share of `CLIPPED`, if another is not. Of the pattern its size alone matters.

    Raises CalibrationRefused, E_VALUE where no phase has a signal, E_SIZE where the frame is smaller than a block.
    """
    rows = as_pattern(pattern)
    shape = (len(rows), len(rows[0]))
    if any(n < BLOCK * p for n, p in zip(values.shape, shape, strict=True)):
        raise refusal(
            "mosaic_small", str(values.shape), expected=f"{BLOCK} periods of {shape} at least"
        )
    phases, marks = split(values, *shape), split(flags, *shape)
    shares = np.array([np.mean((m & CLIPS) != 0) for m in marks])
    usable = shares <= max(CLIPPED, shares.min())
    high, wide = np.array([p.shape for p in phases]).min(0)  # an odd frame has longer phases

    def cut(phase: np.ndarray) -> np.ndarray:
        return blocks_of(phase[:high, :wide].astype(float), BLOCK).reshape(-1, BLOCK, BLOCK)

    blocks = [cut(phase) for phase in phases]
    means = np.array([b.mean((1, 2)) for b in blocks])
    marked = [cut(m).any((1, 2)) for m, u in zip(marks, usable, strict=True) if u]
    clean = ~np.any(marked, axis=0)
    strength = np.array([np.median(m[clean]) if clean.any() else 0.0 for m in means])
    best = int(np.argmax(np.where(usable, strength, -np.inf)))
    if not strength[best] > 0:
        raise refusal("no_phase", number=float(strength[best]))
    level = means[best]
    lit = clean & (level > 0.1 * np.quantile(level[clean], 0.98))
    rough = blocks[best].std((1, 2)) / np.maximum(level, 1e-9)
    flat = lit & (rough <= np.quantile(rough[lit], FLATTEST))
    gains = np.full(len(phases), np.nan)
    for index in np.flatnonzero(usable):
        offset = np.subtract(np.divmod(index, shape[1]), np.divmod(best, shape[1])) / shape
        gains[index] = _slope(means[index][flat], _shifted_means(blocks[best][flat], offset))
    noise = np.ones(len(phases))
    if variance is not None:
        noise = np.array([np.nanmean(part) for part in split(variance, *shape)])
    weights = np.where(gains >= WEAKEST, gains**2 / np.maximum(noise, 1e-12), 0.0)
    return PhaseGains(gains.reshape(shape), (weights / weights.max()).reshape(shape))


def _shifted_means(blocks: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return block means as they would be `offset` sensels of a phase away, by each block's own slope."""
    at = np.arange(BLOCK) - (BLOCK - 1) / 2
    at = at / (BLOCK * np.sum(at**2))
    slopes = np.einsum("nyx,y->n", blocks, at), np.einsum("nyx,x->n", blocks, at)
    return np.asarray(blocks.mean((1, 2)) + offset[0] * slopes[0] + offset[1] * slopes[1])


def _slope(own: np.ndarray, strongest: np.ndarray) -> float:
    """Return the robust slope through 0 of `own` over `strongest`."""
    gain = float(np.median(own / strongest))
    for _ in range(10):
        miss = own - gain * strongest
        scale = 1.4826 * np.median(np.abs(miss)) * 4.685  # Tukey's constant: 95 % of efficiency
        if scale <= 0:
            break
        weight = np.clip(1 - (miss / scale) ** 2, 0, None) ** 2
        gain = float(np.sum(weight * own * strongest) / np.sum(weight * strongest**2))
    return gain


def equalise_phases(
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    pattern: str | Sequence[Sequence[str]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Make one plane, (h, w), of a mosaic that looked through one narrow filter; arguments as of `phase_gains`.

    Values are in the scale of the strongest phase, at the sensor's own pixels: plane-exact normalised convolution over the
    phases that are kept, under a tent of one period, so that nothing is shifted. They are NEAR where a flagged sensel took
    part, with its bits.

    >>> y, x = np.mgrid[:24, :24]
    >>> sees = np.array([[1.0, 0.5], [0.25, 1.0]])[y % 2, x % 2]
    >>> made, _, _ = equalise_phases(sees * (100 + x), np.zeros((24, 24), "u1"), None, "GBRG")
    >>> bool(np.abs(made - 100 - x).max() < 0.01)
    True
    """
    gains = phase_gains(values, flags, variance, pattern)
    kept = gains.weights > 0
    scale = np.where(kept, 1 / np.where(kept, gains.gains, 1), 0).astype(np.float32)
    repeats = [-(-n // p) for n, p in zip(values.shape, kept.shape, strict=True)]
    spread = np.tile(scale, repeats)[: values.shape[0], : values.shape[1]]
    plane = np.where(spread > 0, values, 0) * spread
    noise = None if variance is None else np.where(spread > 0, variance, 0) * spread**2
    made = interpolate(plane, flags, noise, np.where(kept, 0, 1), _common, gains.weights)
    return made[0][..., 0], made[1][..., 0], None if made[2] is None else made[2][..., 0]


def _common(place: Place, channel: int) -> Taps:
    """Return the stencil of the kept phases; those that were dropped need none."""
    return smoothed(place, 0) if channel == 0 else []

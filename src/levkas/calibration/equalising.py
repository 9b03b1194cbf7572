"""A mosaic sensor behind a narrow filter: every sensel sees the same band, each phase by a gain.

v_p(x, y) = g_p · s(x, y). The gains are measured against the strongest phase where the picture is
smooth; one plane is then made of the phases that say something, at the sensor's own pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.mosaic import Place, Taps, interpolate, smoothed
from levkas.calibration.patterns import as_pattern, split
from levkas.calibration.templates import CalibrationRefused
from levkas.core.cube import Flag
from levkas.core.problems import Problem

BLOCK = 6  # sensels of a phase to a side of the blocks whose means are compared
FLATTEST = 0.5  # share of the lit blocks that is used, the flattest first
WEAKEST = 0.15  # gain below which a phase adds nothing but its noise and its black's error
CLIPPED = 0.01  # share of a phase that may be saturated or black
ROUNDS = 10
_CLIPS = Flag.SATURATED.value | Flag.BLACK.value


@dataclass(frozen=True)
class PhaseGains:
    """What each place of the pattern records of one narrow band.

    Parameters
    ----------
    gains : ndarray, (rows, columns), float64
        Relative to the strongest phase; NaN where it could not be measured.
    weights : ndarray like `gains`
        Of each phase in the common plane: gain²/variance, largest 1; 0 where it is dropped.
    """

    gains: np.ndarray
    weights: np.ndarray


def phase_gains(
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    pattern: str | Sequence[Sequence[str]],
) -> PhaseGains:
    """Measure the gains of a mosaic's phases on a picture of one narrow band.

    Raises CalibrationRefused, E_VALUE where no phase has a signal, E_SIZE where the frame is smaller than a block.

    Parameters
    ----------
    values : ndarray, (h, w), float32
        Counts above dark.
    flags : ndarray, (h, w), uint8
        Blocks with any flag are left out.
    variance : ndarray, (h, w), float32, or None
        Of `values`. None: the same for all phases.
    pattern : str or rows of channel names
        Its size alone matters: two places of one channel are measured apart.

    Notes
    -----
    Dropped are phases of less gain than `WEAKEST`, and those that are saturated or black over more
    than a share of `CLIPPED`, if another is not. Means of blocks of phase p against those of the strongest, a line through 0 by iteratively
    reweighted least squares (Tukey's biweight), over the flatter half of the lit blocks; that
    the phases lie at different places is made good by each block's slope.
    """
    rows = as_pattern(pattern)
    shape = (len(rows), len(rows[0]))
    if any(n < BLOCK * p for n, p in zip(values.shape, shape, strict=True)):
        raise CalibrationRefused(
            Problem(
                "E_SIZE",
                "the frame is too small to measure its phases",
                found=str(values.shape),
                expected=f"{BLOCK} periods of {shape} at least",
            )
        )
    phases, marks = split(values, *shape), split(flags, *shape)
    shares = np.array([np.mean((m & _CLIPS) != 0) for m in marks])
    usable = shares <= max(CLIPPED, shares.min())
    size = tuple(
        np.array([p.shape for p in phases]).min(0) // BLOCK
    )  # an odd frame has longer phases
    blocks = [_cut(p, size) for p in phases]
    means = np.array([b.mean((1, 2)) for b in blocks])
    marked = [_cut(m, size).any((1, 2)) for m, u in zip(marks, usable, strict=True) if u]
    clean = ~np.any(marked, axis=0)
    strength = np.array([np.median(m[clean]) if clean.any() else 0.0 for m in means])
    best = int(np.argmax(np.where(usable, strength, -np.inf)))
    if not strength[best] > 0:
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                "no phase of the mosaic has a signal",
                found=f"medians {np.array2string(strength, precision=2)} counts",
                fix="Use a longer exposure for this band.",
            )
        )
    flat = clean & _flattest(blocks[best], means[best], clean)
    gains = np.full(len(phases), np.nan)
    for index in np.flatnonzero(usable):
        offset = np.subtract(np.divmod(index, shape[1]), np.divmod(best, shape[1]))
        gains[index] = _slope(means[index][flat], _shifted_means(blocks[best][flat], offset, shape))
    noise = np.ones(len(phases))
    if variance is not None:
        noise = np.array([np.nanmean(part) for part in split(variance, *shape)])
    weights = np.where(gains >= WEAKEST, gains**2 / np.maximum(noise, 1e-12), 0.0)
    return PhaseGains(gains.reshape(shape), (weights / weights.max()).reshape(shape))


def _cut(phase: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Return as many whole blocks of a phase, down and across, as `size` says, (n, BLOCK, BLOCK)."""
    high, wide = size
    whole = phase[: high * BLOCK, : wide * BLOCK].astype(float)
    return whole.reshape(high, BLOCK, wide, BLOCK).swapaxes(1, 2).reshape(-1, BLOCK, BLOCK)


def _flattest(blocks: np.ndarray, level: np.ndarray, clean: np.ndarray) -> np.ndarray:
    """Return which blocks are lit and, among those, relatively flat."""
    lit = clean & (level > 0.1 * np.quantile(level[clean], 0.98))
    rough = blocks.std((1, 2)) / np.maximum(level, 1e-9)
    return lit & (rough <= np.quantile(rough[lit], FLATTEST))


def _shifted_means(blocks: np.ndarray, offset: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return block means as they would be `offset` sensels away, by each block's own slope."""
    at = np.arange(BLOCK) - (BLOCK - 1) / 2
    down = np.einsum("nyx,y->n", blocks, at) / (BLOCK * np.sum(at**2) * shape[0])
    across = np.einsum("nyx,x->n", blocks, at) / (BLOCK * np.sum(at**2) * shape[1])
    return blocks.mean((1, 2)) + offset[0] * down + offset[1] * across


def _slope(own: np.ndarray, strongest: np.ndarray) -> float:
    """Return the robust slope through 0 of `own` over `strongest`."""
    gain = float(np.median(own / strongest))
    for _ in range(ROUNDS):
        miss = own - gain * strongest
        scale = 1.4826 * np.median(np.abs(miss)) * 4.685
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
    """Make one plane of a mosaic that looked through one narrow filter.

    Parameters
    ----------
    values, flags, variance, pattern
        As in `phase_gains`.

    Returns
    -------
    values, flags, variance : ndarray, (h, w), float32, uint8, float32 or None
        In the scale of the strongest phase, at the sensor's own pixels: plane-exact normalised
        convolution over the phases that are kept, under a tent of one period, so that nothing is
        shifted. Values are NEAR where a flagged sensel took part, with its bits.

    Examples
    --------
    >>> y, x = np.mgrid[:24, :24]
    >>> sees = np.array([[1.0, 0.5], [0.25, 1.0]])[y % 2, x % 2]
    >>> made, _, _ = equalise_phases(sees * (100 + x), np.zeros((24, 24), "u1"), None, "GBRG")
    >>> bool(np.abs(made - 100 - x).max() < 0.01)
    True
    """
    gains = phase_gains(values, flags, variance, pattern)
    kept = gains.weights > 0
    scale = np.where(kept, 1 / np.where(kept, gains.gains, 1), 0)
    rows, columns = kept.shape
    down, across = np.arange(values.shape[0]) % rows, np.arange(values.shape[1]) % columns
    spread = scale[np.ix_(down, across)].astype(np.float32)
    table = np.where(kept, 0, 1)
    equalised = interpolate(
        np.where(spread > 0, values, 0) * spread,
        flags,
        None if variance is None else np.where(spread > 0, variance, 0) * spread**2,
        table,
        _common,
        gains.weights,
    )
    return (
        equalised[0][:, :, 0],
        equalised[1][:, :, 0],
        None if equalised[2] is None else equalised[2][:, :, 0],
    )


def _common(place: Place, channel: int) -> Taps:
    """Return the stencil of the kept phases; those that were dropped need none."""
    return smoothed(place, 0) if channel == 0 else []

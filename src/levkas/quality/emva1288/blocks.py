"""Stacks of shots in small blocks: the signal, its noise over time, and what is fixed from sensel to sensel.

Within a block of one colour phase a fitted plane takes shading and vignetting out. Blocks, not pixels,
are what a bootstrap draws again: neighbours may share dust, banding and texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.patterns import channel_names, channel_table, split
from levkas.calibration.templates import Template
from levkas.quality.emva1288.drift import Drift, common_variance

SIDE = 16  # pixels of one phase
STRAY = 7.0  # sigmas of a block at which a pixel is a defect: one in 10^12 by chance


@dataclass(frozen=True)
class Blocks:
    """One stack, block by block of one channel; NaN where a block cannot be used.

    Parameters
    ----------
    mean : ndarray, (n,)
        Counts.
    temporal : ndarray, (n,)
        Mean variance of one shot over time, without what the lamp does to all pixels alike, counts².
    spatial : ndarray, (n,)
        Variance of the stack's mean about a plane, counts².
    band : str, optional
        Of a tunable filter, which may have a dark for each band.
    """

    mean: np.ndarray
    temporal: np.ndarray
    spatial: np.ndarray
    shots: int
    exposure_s: float | None = None
    band: str | None = None


def block_statistics(
    stack: Template,
    pattern: str | Sequence[Sequence[str]] | None = None,
    *,
    drift: Drift | None = None,
    dark: float = 0.0,
    clipped: bool = False,
) -> dict[str, Blocks]:
    """Reduce a stack to blocks, channel by channel.

    Parameters
    ----------
    stack : Template, (h, w)
        Two shots or more for a variance over time; of one, `temporal` is NaN.
    pattern : str or rows of names, optional
        Of a mosaic; phases of one channel are put together. None: one channel named "".
    drift : Drift, optional
        Of the light in these shots: its share of the variance is taken out.
    dark : float
        Counts without light, for that.
    clipped : bool
        Use blocks with pixels at black, too.
    """
    rows, columns = (1, 1) if pattern is None else channel_table(pattern).shape
    names = ("",) if pattern is None else channel_names(pattern)
    which = np.zeros(1, int) if pattern is None else channel_table(pattern).ravel()
    bad = stack.saturated if clipped else stack.saturated | stack.black
    variance = stack.variance if stack.variance is not None else np.full_like(stack.mean, np.nan)
    planes = (split(a, rows, columns) for a in (stack.mean, variance, bad))
    shared = common_variance(drift.scales) if drift is not None else 0.0
    found: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for channel, mean, spread, marks in zip(which, *planes, strict=True):
        found[names[channel]].append(_phase(mean, spread, marks, stack.count))
    blocks = {}
    for name, phases in found.items():
        mean, temporal, spatial = np.concatenate(phases, axis=1)
        temporal = temporal - shared * np.maximum(mean - dark, 0) ** 2
        blocks[name] = Blocks(mean, temporal, spatial, stack.count, stack.exposure_s)
    return blocks


def cut_blocks(plane: np.ndarray, side: int) -> np.ndarray:
    """Return the pixels of each whole block, (n, side²).

    >>> cut_blocks(np.arange(8).reshape(2, 4), 2).tolist()
    [[0, 1, 4, 5], [2, 3, 6, 7]]
    """
    high, wide = (n // side for n in plane.shape)
    whole = plane[: high * side, : wide * side].reshape(high, side, wide, side)
    return whole.transpose(0, 2, 1, 3).reshape(high * wide, side * side)


def without_plane(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of each block, (n,), and what a fitted plane leaves of its pixels, (n, SIDE²)."""
    pixels = cut_blocks(plane, SIDE).astype(np.float64)
    ramp = (np.arange(SIDE) - (SIDE - 1) / 2).repeat(SIDE)
    across = ramp.reshape(SIDE, SIDE).T.ravel()
    centre = pixels.mean(1)
    rest = pixels - centre[:, None]
    for slope in (ramp, across):
        rest -= np.outer(rest @ slope / (slope @ slope), slope)
    return centre, rest


def _phase(mean: np.ndarray, variance: np.ndarray, bad: np.ndarray, shots: int) -> np.ndarray:
    """Return mean, temporal and spatial variance of each block, (3, n)."""
    centre, rest = without_plane(mean)
    spatial = np.sum(rest**2, 1) / (SIDE * SIDE - 3)
    over_time = cut_blocks(variance, SIDE).mean(1, dtype=np.float64)
    usual = np.sqrt(_typical(spatial))
    stray = np.abs(rest).max(1) > STRAY * np.maximum(usual, 0.3 / np.sqrt(shots))
    lost = cut_blocks(bad, SIDE).any(1)
    spatial[stray] = np.nan
    found = np.stack([centre, over_time, spatial])
    found[:, lost | ~np.isfinite(centre)] = np.nan
    return found


def _typical(values: np.ndarray) -> np.ndarray:
    """Return the typical variance of blocks, (n,)."""
    known = values[np.isfinite(values)]
    return np.maximum(np.median(known), values * 0) if len(known) else values

"""Stacks of shots in small blocks: the signal, its noise over time, and what is fixed from sensel to sensel.

Within a block of one colour phase a fitted plane takes shading and vignetting out. Blocks, not pixels,
are what a bootstrap draws again: neighbours may share dust, banding and texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.drift import Drift, common_variance
from levkas.calibration.patterns import channel_names, channel_table, split
from levkas.calibration.templates import Template

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
    shots : int
    exposure_s : float, optional
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
    side: int = SIDE,
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
    side : int
        Of a block, in pixels of one phase.

    Returns
    -------
    blocks : dict of Blocks
        By channel; the n-th block is the same place in every stack of that shape.
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
        found[names[channel]].append(_phase(mean, spread, marks, side, stack.count))
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


def without_plane(plane: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of each block, (n,), and what a fitted plane leaves of its pixels, (n, side²)."""
    pixels = cut_blocks(plane, side).astype(np.float64)
    ramp = (np.arange(side) - (side - 1) / 2).repeat(side)
    across = ramp.reshape(side, side).T.ravel()
    centre = pixels.mean(1)
    rest = pixels - centre[:, None]
    for slope in (ramp, across):
        rest -= np.outer(rest @ slope / (slope @ slope), slope)
    return centre, rest


def _phase(
    mean: np.ndarray, variance: np.ndarray, bad: np.ndarray, side: int, shots: int
) -> np.ndarray:
    """Return mean, temporal and spatial variance of each block, (3, n)."""
    centre, rest = without_plane(mean, side)
    spatial = np.sum(rest**2, 1) / (side * side - 3)
    over_time = cut_blocks(variance, side).mean(1, dtype=np.float64)
    usual = np.sqrt(_typical(spatial))
    stray = np.abs(rest).max(1) > STRAY * np.maximum(usual, 0.3 / np.sqrt(shots))
    lost = cut_blocks(bad, side).any(1)
    spatial[stray] = np.nan
    found = np.stack([centre, over_time, spatial])
    found[:, lost | ~np.isfinite(centre)] = np.nan
    return found


def _typical(values: np.ndarray) -> np.ndarray:
    """Return the typical variance of blocks, (n,)."""
    known = values[np.isfinite(values)]
    return np.maximum(np.median(known), values * 0) if len(known) else values


MOST_APART = 6.0
"""Ratio of two levels beyond which the darker one's noise is all that is measured."""


def pair_blocks(
    first: Template, second: Template, *, dark: float = 0.0, side: int = SIDE
) -> Blocks:
    """Reduce two neighbouring lines of a mirror scanner's white to blocks, as if they were two shots of one level.

    Both show the same sensels under proportional light. a − α·b, with α the ratio of the two levels, is
    free of PRNU; its variance is that of noise over time, K·a(1 + α) + read²(1 + α²).

    Parameters
    ----------
    first, second : Template, (h, w)
        Of the same sensor and, block by block, of proportional light.
    dark : float
        Counts without light.
    side : int
        Of a block, in pixels.

    Returns
    -------
    blocks : Blocks
        Of 2 shots; `mean` is counts above dark at which one shot has the variance `temporal`. NaN where a frame is
        saturated or at black, or the levels lie more than a factor of 6 apart.

    Examples
    --------
    >>> rng = np.random.default_rng(1); fixed = 1 + 0.02 * rng.standard_normal((640, 640))
    >>> none = np.zeros((640, 640), bool)
    >>> frames = [rng.poisson(e * fixed) * 0.1 for e in (8_000, 12_000)]
    >>> a, b = (Template(f.astype("f4"), None, 1, none, none) for f in frames)
    >>> found = pair_blocks(a, b)
    >>> gain = np.mean(found.temporal) / np.mean(found.mean)
    >>> prnu = np.sqrt(np.mean(found.spatial - found.temporal / 2)) / np.mean(found.mean)
    >>> round(float(gain), 3), round(float(prnu), 3)
    (0.1, 0.02)
    """
    bad = first.saturated | second.saturated | first.black | second.black
    level, rest = without_plane(first.mean - dark, side)
    other, other_rest = without_plane(second.mean - dark, side)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = level / other
    known = np.isfinite(ratio) & (ratio > 1 / MOST_APART) & (ratio < MOST_APART)
    ratio = np.where(known, ratio, 1.0)
    brought = ratio[:, None] * other_rest
    apart, freedom = rest - brought, side * side - 3
    temporal = np.sum(apart**2, 1) / freedom / (1 + ratio**2)
    fixed = np.sum(rest * brought, 1) / freedom
    alike = (1 + ratio) / (1 + ratio**2)
    mean, spatial = level * alike, fixed * alike**2 + temporal / 2
    lost = (without_plane(bad.astype(np.float32), side)[0] > 0) | ~known
    stray = _strays(apart, known) | _strays(rest, known) | lost  # hot sensels are alike in both
    mean[lost] = temporal[stray] = spatial[stray] = np.nan
    return Blocks(mean, temporal, spatial, 2, first.exposure_s)


def _strays(rest: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return blocks in which a pixel lies farther off than chance allows."""
    usual = np.median(np.mean(rest[known] ** 2, 1)) if known.any() else 0.0
    far: np.ndarray = np.abs(rest).max(1) > STRAY * np.sqrt(max(usual, 0.09))
    return far

"""Two frames of one fixed pattern that stand in for two shots.

Behind a tunable filter the white of another band, and in an exposure series another time, show the same
sensels and the same scene at another level. a − α·b, with α the ratio of the two levels, is free of PRNU, texture
and scene; its variance is that of noise over time, K·a(1 + α) + read²(1 + α²).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from levkas.calibration.patterns import channel_table, split
from levkas.calibration.templates import Template
from levkas.quality.emva1288.blocks import SIDE, STRAY, Blocks, without_plane

MOST_APART = 6.0
"""Ratio of two levels beyond which the darker one's noise is all that is seen."""


def pair_blocks(
    first: Template,
    second: Template,
    *,
    dark: tuple[float, float] = (0.0, 0.0),
    pattern: str | Sequence[Sequence[str]] | None = None,
    scaled: bool = True,
    clipped: bool = False,
    side: int = SIDE,
) -> Blocks:
    """Reduce two single frames to blocks, as if they were two shots of one level.

    Parameters
    ----------
    first, second : Template, (h, w)
        Of the same sensor and, block by block, of proportional light.
    dark : (float, float)
        Counts without light of each.
    pattern : str or rows of names, optional
        Of a mosaic behind the filter: phases are reduced apart and put together.
    scaled : bool
        Bring `second` to the level of `first` block by block; False for darks, which differ by an offset.
    clipped : bool
        Use blocks with pixels at black too.
    side : int
        Of a block, in pixels of one phase.

    Returns
    -------
    blocks : Blocks
        Of 2 shots; `mean` is counts above dark at which one shot has the variance `temporal`, and `level` the
        counts without light at which it has the variance of the dark's. NaN where a frame is saturated, or the levels lie more than a factor of 6 apart.

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
    rows, columns = (1, 1) if pattern is None else channel_table(pattern).shape
    bad = first.saturated | second.saturated
    if not clipped:
        bad = bad | first.black | second.black
    planes = (split(a, rows, columns) for a in (first.mean - dark[0], second.mean - dark[1], bad))
    parts = [_phase(a, b, marks, scaled, side) for a, b, marks in zip(*planes, strict=True)]
    mean, temporal, spatial, squared = np.concatenate(parts, axis=1)
    level = (dark[0] + squared * dark[1]) / (1 + squared)  # as the two shots' noise is weighted
    return Blocks(mean, temporal, spatial, 2, first.exposure_s, level=level)


def _phase(a: np.ndarray, b: np.ndarray, bad: np.ndarray, scaled: bool, side: int) -> np.ndarray:
    """Return level, variance over time, variance of the mean and squared ratio of each block, (4, n)."""
    level, rest = without_plane(a, side)
    other, other_rest = without_plane(b, side)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = level / other if scaled else np.ones_like(level)
    known = np.isfinite(ratio) & (ratio > 1 / MOST_APART) & (ratio < MOST_APART)
    ratio = np.where(known, ratio, 1.0)
    brought = ratio[:, None] * other_rest
    apart, freedom = rest - brought, side * side - 3
    temporal = np.sum(apart**2, 1) / freedom / (1 + ratio**2)
    fixed = np.sum(rest * brought, 1) / freedom
    alike = (1 + ratio) / (1 + ratio**2) if scaled else np.ones_like(ratio)
    mean = level * alike if scaled else (level + other) / 2
    stray = _strays(apart, known) | _strays(rest, known)  # hot sensels are alike in both
    lost = without_plane(bad.astype(np.float32), side)[0] > 0
    found = np.stack([mean, temporal, fixed * alike**2 + temporal / 2, ratio**2])
    found[:3, lost | ~known] = np.nan
    found[1:3, stray] = np.nan
    return found


def _strays(rest: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return blocks in which a pixel lies farther off than chance allows."""
    usual = np.median(np.mean(rest[known] ** 2, 1)) if known.any() else 0.0
    far: np.ndarray = np.abs(rest).max(1) > STRAY * np.sqrt(max(usual, 0.09))
    return far

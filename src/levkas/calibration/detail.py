"""Interpolation error of a mosaic: the variance by which interpolated values miss detail between the sensels.

Where a sensel differs from the mean of its two neighbours of the same phase, the scene has detail that interpolation between
sensels cannot know. How much such disagreement means for a method is tried on the scene itself: of every period of the
pattern one sensel a channel makes a smaller picture of which all channels are known; it is made a mosaic again, interpolated,
and compared. For a method that compares channels, as Malvar's, they are moved to the middle of the period before: lying apart
they would spoil what it gains.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np

from levkas.core.compiled import njit
from levkas.core.threads import each, in_threads
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine

FEWEST, MOST = 5000, 300_000
"""Values of a channel in the smaller picture from which the trial counts, and that are looked at: half or twice move sigma by 1 %."""
QUANTILES = (0.0, 0.25, 0.5, 0.7, 0.8, 0.87, 0.92, 0.95, 0.97, 0.98, 0.99, 0.995, 1.0)
EDGE = 3
"""Periods of the smaller picture at its border, where stencils are others."""

Planes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Values, flags and variance."""
Interpolate = Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray | None]]


def disagreement(values: np.ndarray, variance: np.ndarray, period: tuple[int, int]) -> np.ndarray:
    """Return the local disagreement of sensels with their neighbours a period away, free of noise, (h, w) float32, >= 0.

    Mean over a period to each side, and down and across, of (v − (v₋ + v₊)/2)² − u² − (u₋² + u₊²)/4.

    >>> y, x = np.mgrid[:12, :12].astype("f4")
    >>> float(disagreement(3 * x + y, 0 * x, (2, 2)).max())  # a plane has no detail
    0.0
    """
    axes = [axis for axis, step in enumerate(period) if values.shape[axis] > 2 * step]

    def along(axis: int) -> np.ndarray:
        step = period[axis]
        v, u = np.moveaxis(values, axis, 0), np.moveaxis(variance, axis, 0)
        rough = v[step:-step] - (v[2 * step :] + v[: -2 * step]) / 2
        found = rough * rough - (u[step:-step] + (u[2 * step :] + u[: -2 * step]) / 4)
        found[~np.isfinite(found)] = 0
        return found

    total, count = np.zeros(values.shape, np.float32), np.zeros(values.shape, np.float32)
    for axis, found in zip(axes, each(along, axes), strict=True):
        inner = slice(period[axis], -period[axis])
        np.moveaxis(total, axis, 0)[inner] += found
        np.moveaxis(count, axis, 0)[inner] += 1
    size = (2 * period[1] + 1, 2 * period[0] + 1)
    smooth = each(lambda a: cv2.blur(a, size, borderType=cv2.BORDER_REFLECT_101), (total, count))
    return np.maximum(smooth[0] / np.maximum(smooth[1], 1e-6), 0.0)


def interpolation_variance(
    mosaic: Planes, table: np.ndarray, interpolate: Interpolate, *, compares: bool = False
) -> np.ndarray:
    """Return the variance by which interpolated values miss the scene, beside their noise, (h, w, c); 0 where measured.

    E² = g(d²) with d² from `disagreement` and g from the trial, channel by channel: the mean of (interpolated − true)² less
    the noise of both in groups of like d², rising; in proportion beyond the last. Where the picture is too small for a trial,
    E² = d².

    Parameters
    ----------
    mosaic : (values, flags, variance), (h, w) each
    table : ndarray, (rows, columns), int
        Channel at each place of the pattern.
    interpolate : callable
        (values, flags, variance) of a mosaic → (h, w, c) of each.
    compares : bool
        Whether it compares channels.
    """
    rough = disagreement(mosaic[0], mosaic[2], (table.shape[0], table.shape[1]))
    curves = _trial(_smaller(mosaic, table, together=compares), table, interpolate)
    found = np.empty((*rough.shape, len(curves)), np.float32)
    kinds = np.ascontiguousarray(table, np.int64)
    in_threads(_follow, len(rough), np.ascontiguousarray(rough), kinds, curves, found)
    return found


@njit(cache=True)
def _follow(start, stop, rough, table, curves, found):  # type: ignore[no-untyped-def]
    """Fill `found`, (h, w, c), with each channel's curve, (c, 2, groups), at `rough`; 0 where measured."""
    channels, _, groups = curves.shape
    for y in range(start, stop):
        for x in range(rough.shape[1]):
            d = np.float64(rough[y, x])
            own = table[y % table.shape[0], x % table.shape[1]]
            for k in range(channels):
                at, mean, g = curves[k, 0], curves[k, 1], 1
                if k == own:
                    found[y, x, k] = 0.0
                elif d >= at[groups - 1]:
                    found[y, x, k] = mean[groups - 1] * d / max(at[groups - 1], 1e-30)
                else:
                    while g < groups - 1 and d > at[g]:
                        g += 1
                    part = (d - at[g - 1]) / max(at[g] - at[g - 1], 1e-30)
                    part = min(max(part, 0.0), 1.0)
                    found[y, x, k] = mean[g - 1] + part * (mean[g] - mean[g - 1])


def _smaller(mosaic: Planes, table: np.ndarray, *, together: bool) -> Planes:
    """Return one sensel a channel of every period as a picture, (h, w, c) of each; `together` moved to the middle of the period."""
    rows, columns = table.shape
    size = (mosaic[0].shape[0] // rows, mosaic[0].shape[1] // columns)
    planes: list[Planes] = []
    for channel in range(int(table.max()) + 1):
        y, x = np.argwhere(table == channel)[0]
        values, flags, variance = (a[y::rows, x::columns][: size[0], : size[1]] for a in mosaic)
        if together:
            middle = ((columns - 1) / 2 - x) / columns, ((rows - 1) / 2 - y) / rows
            move = Affine(np.array([[1.0, 0, middle[0]], [0, 1.0, middle[1]]]))
            moved = warp(values, move, size, flags=flags, variance=variance)
            assert moved.variance is not None
            values, flags, variance = moved.values, moved.flags, moved.variance
        planes.append((values, flags, variance))
    values, flags, variance = (np.stack(part, -1) for part in zip(*planes, strict=True))
    return values, flags, variance


def _trial(known: Planes, table: np.ndarray, interpolate: Interpolate) -> np.ndarray:
    """Return d² and E² of groups for each channel, (c, 2, groups), from a picture of which all channels are known."""
    rows, columns = table.shape
    high, wide, channels = known[0].shape
    if high < 2 * EDGE * rows + rows or wide < 2 * EDGE * columns + columns:
        return np.stack([_curve(none, none) for none in np.empty((channels, 0))])
    which = table[np.arange(high)[:, None] % rows, np.arange(wide) % columns]
    mosaic = [np.take_along_axis(a, which[..., None], 2)[..., 0] for a in known]
    planes, noted, spread = interpolate(*mosaic)
    assert spread is not None
    rough = disagreement(mosaic[0], mosaic[2], (rows, columns))
    inner = np.s_[EDGE * rows : -EDGE * rows, EDGE * columns : -EDGE * columns]
    miss = ((planes - known[0]) ** 2 - spread - known[2])[inner]
    sound = ((noted | known[1])[inner] == 0) & np.isfinite(miss)
    used = [sound[..., k] & (which[inner] != k) for k in range(channels)]
    return np.stack([_curve(rough[inner][u], miss[..., k][u]) for k, u in enumerate(used)])


def _curve(rough: np.ndarray, miss: np.ndarray) -> np.ndarray:
    """Return the means of both in groups by `rough`, (2, groups), that of `miss` never falling."""
    if len(rough) < FEWEST:
        return np.tile(np.linspace(0, 1, len(QUANTILES) - 1), (2, 1))
    thin = np.s_[:: max(1, len(rough) // MOST)]
    rough, miss = rough[thin].astype(np.float64), miss[thin].astype(np.float64)
    order = np.argsort(rough, kind="stable")
    edges = (np.array(QUANTILES) * len(order)).astype(int)
    means = [(rough[order[a:b]].mean(), miss[order[a:b]].mean()) for a, b in pairwise(edges)]
    at, mean = np.array(means).T
    return np.stack([at, np.maximum.accumulate(np.maximum(mean, 0.0))])

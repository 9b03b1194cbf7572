"""Interpolation error of a mosaic: the variance by which interpolated values miss detail between the sensels.

Where a sensel differs from the mean of its two neighbours of the same phase, the scene has detail that
interpolation between sensels cannot know. How much such disagreement means for a method is tried on the
scene itself: of every period of the pattern one sensel a channel makes a smaller picture of which all
channels are known; it is made a mosaic again, interpolated, and compared. For a method that compares channels, as Malvar's,
they are moved to the middle of the period before: lying apart they would spoil what it gains.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from levkas.core.threads import each
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine

FEWEST = 5000  # values of a channel in the smaller picture from which the trial counts
Interpolate = Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray | None]]
EDGE = 3  # periods of the smaller picture at its border, where stencils are others


def disagreement(values: np.ndarray, variance: np.ndarray, period: tuple[int, int]) -> np.ndarray:
    """Return the local disagreement of sensels with their neighbours, free of noise.

    Parameters
    ----------
    values, variance : ndarray, (h, w), float32
        Of a mosaic, and of its noise.
    period : (rows, columns)
        Of its pattern.

    Returns
    -------
    squared : ndarray, (h, w), float32
        Mean over a period to each side, and down and across, of (v − (v₋ + v₊)/2)² − u² − (u₋² + u₊²)/4
        with neighbours a period away; at least 0.

    Examples
    --------
    >>> y, x = np.mgrid[:12, :12].astype("f4")
    >>> float(disagreement(3 * x + y, 0 * x, (2, 2)).max())  # a plane has no detail
    0.0
    """
    axes = [axis for axis, step in enumerate(period) if values.shape[axis] > 2 * step]

    def along(axis: int) -> np.ndarray:
        step = period[axis]
        v, u = np.moveaxis(values, axis, 0), np.moveaxis(variance, axis, 0)
        rough = v[step:-step] - (v[2 * step :] + v[: -2 * step]) / 2
        noise = u[step:-step] + (u[2 * step :] + u[: -2 * step]) / 4
        found = rough * rough - noise
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


Planes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Values, flags and variance."""


def interpolation_variance(
    mosaic: Planes, table: np.ndarray, interpolate: Interpolate, *, compares: bool = False
) -> np.ndarray:
    """Return the variance by which interpolated values miss the scene, beside their noise.

    Parameters
    ----------
    mosaic : (values, flags, variance), ndarray, (h, w)
    table : ndarray, (rows, columns), int
        Channel at each place of the pattern.
    interpolate : callable
        (values, flags, variance) of a mosaic → (h, w, c) of each.
    compares : bool
        Whether it compares channels.

    Returns
    -------
    variance : ndarray, (h, w, c), float32
        0 where the channel was measured.

    Notes
    -----
    E² = k·d² with d² from `disagreement` and k of each channel from the trial: the mean of
    (interpolated − true)² less the noise of both over that of d². Where the picture is too small for a trial, k = 1.
    """
    rough = disagreement(mosaic[0], mosaic[2], (table.shape[0], table.shape[1]))
    factors = _trial(_smaller(mosaic, table, together=compares), table, interpolate)
    found = rough[..., None] * factors.astype(np.float32)
    for y, x in np.ndindex(table.shape):
        found[y :: table.shape[0], x :: table.shape[1], table[y, x]] = 0
    return found


def _smaller(mosaic: Planes, table: np.ndarray, *, together: bool) -> Planes:
    """Return one sensel a channel of every period as a picture, (h, w, c) of each.

    `together`: each is moved to the middle of the period.
    """
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
    """Return E² over d² of each channel, (c,), from a picture of which all channels are known."""
    rows, columns = table.shape
    high, wide, channels = known[0].shape
    if high < 2 * EDGE * rows + rows or wide < 2 * EDGE * columns + columns:
        return np.ones(channels)
    which = table[np.arange(high)[:, None] % rows, np.arange(wide) % columns]
    mosaic = [np.take_along_axis(a, which[..., None], 2)[..., 0] for a in known]
    planes, noted, spread = interpolate(*mosaic)
    assert spread is not None
    rough = disagreement(mosaic[0], mosaic[2], (rows, columns))
    inner = np.s_[EDGE * rows : -EDGE * rows, EDGE * columns : -EDGE * columns]
    miss = ((planes - known[0]) ** 2 - spread - known[2])[inner]
    sound = ((noted | known[1])[inner] == 0) & np.isfinite(miss)
    used = [sound[..., k] & (which[inner] != k) for k in range(channels)]
    return np.array([_factor(rough[inner][u], miss[..., k][u]) for k, u in enumerate(used)])


def _factor(rough: np.ndarray, miss: np.ndarray) -> float:
    total = float(rough.sum(dtype=float))
    if len(rough) < FEWEST or total <= 0:
        return 1.0
    return max(float(miss.sum(dtype=float)) / total, 0.0)

"""Vector strokes, areas and grain in millimetres, rasterized at any resolution."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.core.compiled import njit

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike

SUB_BITS = 6


def curve(points: ArrayLike, *, count: int = 24, closed: bool = False) -> np.ndarray:
    """Return a smooth curve through `points` (Catmull–Rom), (count·segments + 1, 2)."""
    p = np.asarray(points, float)
    if closed:
        p = np.vstack([p[-1:], p, p[:2]])
    else:
        p = np.vstack([2 * p[0] - p[1], p, 2 * p[-1] - p[-2]])
    t = np.arange(count)[:, None] / count
    parts = [
        0.5
        * (
            2 * b
            + (c - a) * t
            + (2 * a - 5 * b + 4 * c - d) * t**2
            + (3 * b - a - 3 * c + d) * t**3
        )
        for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True)
    ]
    return np.vstack([*parts, p[-2:-1]])


def ellipse(
    centre: ArrayLike, rx: float, ry: float | None = None, *, count: int = 96
) -> np.ndarray:
    """Return the closed outline of an ellipse about `centre`, (count + 1, 2); a circle without `ry`."""
    a = np.linspace(0, 2 * np.pi, count + 1)
    return np.asarray(centre) + np.stack(
        [rx * np.cos(a), (rx if ry is None else ry) * np.sin(a)], 1
    )


def brush(points: np.ndarray, width: float, *, taper: float = 0.7) -> np.ndarray:
    """Give a line the width of a brush stroke, thin at both ends.

    Parameters
    ----------
    points : ndarray, (n, 2), mm
    width : float
        At its widest, mm.
    taper : float
        0 keeps the width, 1 ends in points.

    Returns
    -------
    stroke : ndarray, (n, 3)
        x, y and half the width, mm.
    """
    swell = np.sin(np.pi * np.linspace(0.04, 0.96, len(points))) ** 0.6
    return np.column_stack([points, 0.5 * width * (1 - taper + taper * swell)])


def draw_strokes(mask: np.ndarray, strokes: Iterable[np.ndarray], px_per_mm: float) -> None:
    """Draw strokes (n, 3), as `brush` makes them, into a uint8 mask, edges anti-aliased."""
    parts = [np.hstack([s[:-1], s[1:]]) for s in strokes if len(s) > 1]
    if parts:
        segments = np.vstack(parts) * px_per_mm
        # Raster positions are pixel centres at integers, as everywhere.
        segments[:, [0, 1, 3, 4]] -= 0.5
        _draw(mask, segments)


def fill_area(mask: np.ndarray, outline: np.ndarray, px_per_mm: float) -> None:
    """Fill a closed outline (n, 2), mm, into a uint8 mask."""
    import cv2

    scaled = (np.asarray(outline)[:, :2] * px_per_mm - 0.5) * 2**SUB_BITS
    cv2.fillPoly(mask, [np.round(scaled).astype(np.int32)], 255, cv2.LINE_AA, SUB_BITS)


def soften(mask: np.ndarray, radius: float) -> np.ndarray:
    """Return a mask blurred by a Gaussian of `radius` pixels, at a cost that does not grow with it."""
    import cv2

    factor = max(1.0, radius / 4)
    height, width = mask.shape
    small = (max(2, round(width / factor)), max(2, round(height / factor)))
    reduced = cv2.resize(mask, small, interpolation=cv2.INTER_AREA) if factor > 1 else mask
    blurred = cv2.GaussianBlur(reduced, (0, 0), radius / factor)
    return cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR)


def grain(
    shape: tuple[int, int],
    px_per_mm: float,
    spacing: tuple[float, float],
    rng: np.random.Generator,
    *,
    octaves: int = 5,
    fall: float = 0.7,
) -> np.ndarray:
    """Return a random field of several octaves, the same at every fineness of the raster.

    Parameters
    ----------
    shape : (rows, columns)
    px_per_mm : float
    spacing : (x, y)
        Distance of the nodes of the coarsest octave, mm; unequal for streaks.
    rng : Generator
    octaves : int
    fall : float
        Amplitude of an octave over that of the coarser one.

    Returns
    -------
    field : ndarray, shape, float32
        Mean about 0, spread about 1.
    """
    import cv2

    total = np.zeros(shape, np.float32)
    power = 0.0
    for k, child in enumerate(rng.spawn(octaves)):
        step = np.array(spacing) / 2**k
        if min(step) * px_per_mm < 1.2:
            break
        nodes = [
            int(np.ceil(n / px_per_mm / s)) + 4 for n, s in zip(shape[::-1], step, strict=True)
        ]
        lattice = child.standard_normal((nodes[1], nodes[0]), np.float32)
        size = [round(n * s * px_per_mm) for n, s in zip(nodes, step, strict=True)]
        field = cv2.resize(lattice, size, interpolation=cv2.INTER_CUBIC)
        offset = [round(1.5 * s * px_per_mm) for s in step]
        total += fall**k * field[offset[1] : offset[1] + shape[0], offset[0] : offset[0] + shape[1]]
        power += fall ** (2 * k) * 0.45
    return total / np.float32(max(power, 1e-6) ** 0.5)


@njit(cache=True)
def _draw(mask: np.ndarray, segments: np.ndarray) -> None:
    """Draw capsules whose radius runs linearly from end to end."""
    rows, columns = mask.shape
    for k in range(len(segments)):
        x0, y0, r0, x1, y1, r1 = segments[k]
        reach = max(r0, r1, 0.5) + 1.0
        left, right = int(np.floor(min(x0, x1) - reach)), int(np.ceil(max(x0, x1) + reach))
        top, low = int(np.floor(min(y0, y1) - reach)), int(np.ceil(max(y0, y1) + reach))
        dx, dy = x1 - x0, y1 - y0
        length = dx * dx + dy * dy
        for i in range(max(top, 0), min(low + 1, rows)):
            for j in range(max(left, 0), min(right + 1, columns)):
                at = 0.0
                if length > 0.0:
                    at = min(max(((j - x0) * dx + (i - y0) * dy) / length, 0.0), 1.0)
                away = np.hypot(j - x0 - at * dx, i - y0 - at * dy)
                radius = r0 + at * (r1 - r0)
                # A line thinner than a pixel covers it in part, and keeps its place.
                cover = min(max(radius, 0.5) + 0.5 - away, 1.0) * min(2.0 * radius, 1.0)
                if cover > 0.0:
                    mask[i, j] = max(mask[i, j], np.uint8(255.0 * cover + 0.5))


@njit(cache=True)
def blend(amounts: np.ndarray, mask: np.ndarray, paint: int, opacity: float) -> None:
    """Lay `paint` over what is there, where and as far as `mask` (uint8) says."""
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            m = mask[i, j] * opacity / 255.0
            if m <= 0.002:
                continue
            rest = 255
            for k in range(amounts.shape[2]):
                value = int(amounts[i, j, k] * (1.0 - m) + 0.5)
                amounts[i, j, k] = value
                if k != paint:
                    rest -= value
            amounts[i, j, paint] = max(rest, 0)


@njit(cache=True)
def shrink(planes: np.ndarray, factor: int, out: np.ndarray) -> None:
    """Average blocks of factor x factor of uint8 planes (rows, columns, n) into `out`."""
    area = factor * factor
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                total = area // 2
                for y in range(i * factor, (i + 1) * factor):
                    for x in range(j * factor, (j + 1) * factor):
                        total += planes[y, x, k]
                out[i, j, k] = total // area

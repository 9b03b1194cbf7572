"""Compiled loops of the resampling."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
from numba import njit, prange

MOST_TAPS = 64
SHARE = 0.02  # of a weight that makes a flagged pixel count
OUTSIDE, NEAR = 1, 64


@njit(cache=True)
def lagrange(t):  # noqa: D103
    return (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )


@njit(cache=True)
def map_at(nodes, step, x, y):
    """Interpolate a lattice of a map at one grid point, cubic."""
    i, j = min(int(x // step), nodes.shape[1] - 4), min(int(y // step), nodes.shape[0] - 4)
    a, b = lagrange(x / step - i), lagrange(y / step - j)
    u = v = 0.0
    for r in range(4):
        su = sv = 0.0
        for c in range(4):
            su += a[c] * nodes[j + r, i + c, 0]
            sv += a[c] * nodes[j + r, i + c, 1]
        u += b[r] * su
        v += b[r] * sv
    return u, v


@njit(cache=True)
def interpolate_map(nodes, step, points):
    """Interpolate a lattice of a map at (n, 2) grid points."""
    out = np.empty((len(points), 2))
    for k in range(len(points)):
        out[k, 0], out[k, 1] = map_at(nodes, step, points[k, 0], points[k, 1])
    return out


@njit(cache=True)
def keys(t):
    """Keys' cubic, a = −0.5."""
    t = abs(t)
    if t < 1:
        return (1.5 * t - 2.5) * t * t + 1
    if t < 2:
        return ((-0.5 * t + 2.5) * t - 4) * t + 2
    return 0.0


@njit(cache=True)
def weigh(position, scale, size, weights):
    """Fill weights of the taps around `position`; return the first tap and their number.

    Corrected to Σw = 1 and Σw·d = 0 over the taps that are there, so that a ramp stays a ramp.
    """
    reach = 2.0 * scale
    first = max(0, int(np.ceil(position - reach)))
    last = min(size - 1, int(np.floor(position + reach)))
    if last - first + 1 > MOST_TAPS:
        middle = int(np.floor(position + 0.5))
        first, last = max(0, middle - MOST_TAPS // 2 + 1), min(size - 1, middle + MOST_TAPS // 2)
    n = last - first + 1
    total = moment = level = lean = 0.0
    for k in range(n):
        d = first + k - position
        weights[k] = keys(d / scale)
        total += weights[k]
        moment += weights[k] * d
        tent = 1 - abs(d) / reach
        level += tent
        lean += tent * d
    # What sampling the kernel leaves of the first moment is taken up by a tent, whose second
    # moment, unlike the cubic's own, is far from zero.
    lean = lean / level if level > 0 else 0.0
    power = 0.0
    for k in range(n):
        d = first + k - position
        power += (1 - abs(d) / reach) * (d - lean) * d
    slope = -moment / total / power if n > 1 and power > 1e-12 else 0.0
    for k in range(n):
        d = first + k - position
        weights[k] = weights[k] / total + slope * (1 - abs(d) / reach) * (d - lean)
    return first, n


@njit(cache=True, parallel=True)
def resample_plane(source, flags, variance, nodes, step, height, width):
    """Resample one band; flags and variance are (1, 1) where there are none."""
    h, w = source.shape
    values = np.empty((height, width), np.float32)
    out_flags = np.zeros((height, width), np.uint8)
    with_flags, with_variance = flags.shape == source.shape, variance.shape == source.shape
    spread = np.empty((height, width) if with_variance else (1, 1), np.float32)
    for y in prange(height):
        wx, wy = np.empty(MOST_TAPS), np.empty(MOST_TAPS)
        for x in range(width):
            u, v = map_at(nodes, step, float(x), float(y))
            if not (u >= -0.5 and v >= -0.5 and u <= w - 0.5 and v <= h - 0.5):
                values[y, x] = np.nan
                out_flags[y, x] = OUTSIDE
                if with_variance:
                    spread[y, x] = np.nan
                continue
            u2, v2 = map_at(nodes, step, float(x) + 1, float(y))
            u3, v3 = map_at(nodes, step, float(x), float(y) + 1)
            sx = max(1.0, np.sqrt((u2 - u) ** 2 + (u3 - u) ** 2))
            sy = max(1.0, np.sqrt((v2 - v) ** 2 + (v3 - v) ** 2))
            if sx < 1.15:
                sx = 1.0
            if sy < 1.15:
                sy = 1.0
            i, n = weigh(u, sx, w, wx)
            j, m = weigh(v, sy, h, wy)
            total = other = 0.0
            bits = 0
            for r in range(m):
                row = 0.0
                row2 = 0.0
                for c in range(n):
                    row += wx[c] * source[j + r, i + c]
                    if with_variance:
                        row2 += wx[c] * wx[c] * variance[j + r, i + c]
                    if (
                        with_flags
                        and flags[j + r, i + c] != 0
                        and abs(wx[c] * wy[r]) > SHARE / (sx * sy)
                    ):
                        bits |= flags[j + r, i + c] | NEAR
                total += wy[r] * row
                other += wy[r] * wy[r] * row2
            if with_flags:
                nearest = flags[
                    min(max(int(np.floor(v + 0.5)), 0), h - 1),
                    min(max(int(np.floor(u + 0.5)), 0), w - 1),
                ]
                bits = (bits & ~OUTSIDE) | nearest
            values[y, x] = total
            out_flags[y, x] = bits
            if with_variance:
                spread[y, x] = other
            if bits & OUTSIDE or not np.isfinite(total):
                values[y, x] = np.nan
                out_flags[y, x] |= OUTSIDE
    return values, out_flags, spread

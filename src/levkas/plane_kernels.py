"""Compiled loops of the resampling."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
from numba import njit, prange

MOST_TAPS = 64
SHARE = 0.02  # of a weight that makes a flagged pixel count
OUTSIDE, NEAR = 1, 64
WIDENED_FROM = 1.15  # source px per grid px


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


@njit(cache=True)
def row_of(nodes, step, y, along):
    """Interpolate the nodes of a lattice on one grid row, (columns, 2)."""
    j = min(int(y // step), nodes.shape[0] - 4)
    a, b, c, d = lagrange(y / step - j)
    for i in range(nodes.shape[1]):
        for k in range(2):
            along[i, k] = (
                a * nodes[j, i, k]
                + b * nodes[j + 1, i, k]
                + c * nodes[j + 2, i, k]
                + d * nodes[j + 3, i, k]
            )


@njit(cache=True)
def blended(source, first_x, n, first_y, m, wx, wy):
    """Return the weighted sum of a block of taps, in float64."""
    total = 0.0
    for r in range(m):
        row = 0.0
        for c in range(n):
            row += wx[c] * source[first_y + r, first_x + c]
        total += wy[r] * row
    return total


@njit(cache=True)
def cubic_four(t, weights):
    """Fill Keys' four weights around a fraction `t`, exact on a ramp as they are."""
    weights[0] = ((-0.5 * t + 1.0) * t - 0.5) * t
    weights[1] = (1.5 * t - 2.5) * t * t + 1.0
    weights[2] = ((-1.5 * t + 2.0) * t + 0.5) * t
    weights[3] = (0.5 * t - 0.5) * t * t


@njit(cache=True)
def flag_bits(flags, first_x, n, first_y, m, wx, wy, share, near_x, near_y):
    """Bits of the nearest pixel, and of every flagged one with a share in the value, with NEAR."""
    bits = 0
    for r in range(m):
        for c in range(n):
            flag = flags[first_y + r, first_x + c]
            if flag != 0 and abs(wx[c] * wy[r]) > share:
                bits |= flag | NEAR
    nearest = flags[near_y, near_x]
    if bits == (nearest | NEAR) and nearest != 0 and abs(wx.max() * wy.max()) > 1 - 1e-9:
        return nearest
    return (bits & ~OUTSIDE) | nearest


@njit(cache=True, parallel=True)
def resample_plane(source, flags, variance, nodes, step, height, width, wide):
    """Resample one band; flags and variance are (1, 1) where there are none.

    `wide` says that somewhere the grid is coarser than the source.
    """
    h, w = source.shape
    values = np.empty((height, width), np.float32)
    out_flags = np.zeros((height, width), np.uint8)
    with_flags, with_variance = flags.shape == source.shape, variance.shape == source.shape
    spread = np.empty((height, width) if with_variance else (1, 1), np.float32)
    table = np.empty((step, 4))
    for k in range(step):
        table[k] = lagrange(k / step)
    for y in prange(height):
        wx, wy = np.empty(MOST_TAPS), np.empty(MOST_TAPS)
        here, below = np.empty((nodes.shape[1], 2)), np.empty((nodes.shape[1], 2))
        row_of(nodes, step, float(y), here)
        if wide:
            row_of(nodes, step, float(y) + 1, below)
        for x in range(width):
            i = x // step
            t = table[x - i * step]
            u = (
                t[0] * here[i, 0]
                + t[1] * here[i + 1, 0]
                + t[2] * here[i + 2, 0]
                + t[3] * here[i + 3, 0]
            )
            v = (
                t[0] * here[i, 1]
                + t[1] * here[i + 1, 1]
                + t[2] * here[i + 2, 1]
                + t[3] * here[i + 3, 1]
            )
            if not (u >= -0.5 and v >= -0.5 and u <= w - 0.5 and v <= h - 0.5):
                values[y, x] = np.nan
                out_flags[y, x] = OUTSIDE
                if with_variance:
                    spread[y, x] = np.nan
                continue
            sx = sy = 1.0
            if wide:
                du = (here[i + 2, 0] - here[i + 1, 0]) / step
                dv = (here[i + 2, 1] - here[i + 1, 1]) / step
                eu, ev = below[i + 1, 0] - here[i + 1, 0], below[i + 1, 1] - here[i + 1, 1]
                sx, sy = np.sqrt(du * du + eu * eu), np.sqrt(dv * dv + ev * ev)
                sx = 1.0 if sx < WIDENED_FROM else sx
                sy = 1.0 if sy < WIDENED_FROM else sy
            fx, fy = int(np.floor(u)), int(np.floor(v))
            if sx == 1.0 and 1 <= fx < w - 2:
                first_x, n = fx - 1, 4
                cubic_four(u - fx, wx)
            else:
                first_x, n = weigh(u, sx, w, wx)
            if sy == 1.0 and 1 <= fy < h - 2:
                first_y, m = fy - 1, 4
                cubic_four(v - fy, wy)
            else:
                first_y, m = weigh(v, sy, h, wy)
            total = blended(source, first_x, n, first_y, m, wx, wy)
            bits = 0
            if with_flags:
                near_x = min(max(int(np.floor(u + 0.5)), 0), w - 1)
                near_y = min(max(int(np.floor(v + 0.5)), 0), h - 1)
                bits = flag_bits(
                    flags, first_x, n, first_y, m, wx[:n], wy[:m], SHARE / (sx * sy), near_x, near_y
                )
            if with_variance:
                for k in range(n):
                    wx[k] *= wx[k]
                for k in range(m):
                    wy[k] *= wy[k]
                spread[y, x] = blended(variance, first_x, n, first_y, m, wx, wy)
            values[y, x] = total
            if bits & OUTSIDE or not np.isfinite(total):
                values[y, x] = np.nan
                bits |= OUTSIDE
            out_flags[y, x] = bits
    return values, out_flags, spread

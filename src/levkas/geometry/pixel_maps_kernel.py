"""Compiled loops of maps: splines and depth steps."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit


@njit
def _place(value, last):
    """Return the cell, the fraction in it, and how far `value` lies beyond the knots 0 … last."""
    inner = min(max(value, 0.0), float(last)) if np.isfinite(value) else 0.0
    cell = min(int(inner), last - 1)
    return cell, inner - cell, value - inner if np.isfinite(value) else 0.0


@njit
def _weigh(t, values, slopes):
    """Fill the four cubic B-spline weights at fraction `t`, and their derivatives."""
    s = 1 - t
    values[0], slopes[0] = s**3 / 6, -s * s / 2
    values[1], slopes[1] = (4 - 6 * t * t + 3 * t**3) / 6, (3 * t * t - 4 * t) / 2
    values[2], slopes[2] = (4 - 6 * s * s + 3 * s**3) / 6, (4 * s - 3 * s * s) / 2
    values[3], slopes[3] = t**3 / 6, t * t / 2


@njit
def _sums(knots, i, j, axis, bx, by, dx, dy):
    """Return the sum over four by four knots, its slopes along x and y, and how the one changes along the other."""
    shift = along = down = both = 0.0
    for r in range(4):
        value = slope = 0.0
        for c in range(4):
            value += bx[c] * knots[j + r, i + c, axis]
            slope += dx[c] * knots[j + r, i + c, axis]
        shift += by[r] * value
        along += by[r] * slope
        down += dy[r] * value
        both += dy[r] * slope
    return shift, along, down, both


@njit(cache=True)
def displace(points, origin, spacing, coefficients, slopes):
    """Return displaced points, (n, 2), straight on beyond the knots; fill their derivatives where `slopes` is (n, 2, 2)."""
    rows, columns = coefficients.shape[:2]
    out = np.empty_like(points)
    bx, by, dx, dy = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for n in range(len(points)):
        i, t, over_x = _place((points[n, 0] - origin[0]) / spacing, columns - 3)
        j, s, over_y = _place((points[n, 1] - origin[1]) / spacing, rows - 3)
        _weigh(t, bx, dx)
        _weigh(s, by, dy)
        for axis in range(2):
            shift, along, down, both = _sums(coefficients, i, j, axis, bx, by, dx, dy)
            shift += along * over_x + down * over_y + both * over_x * over_y
            out[n, axis] = points[n, axis] + shift
            if len(slopes):
                slopes[n, axis, 0] = (axis == 0) + (along + both * over_y) / spacing
                slopes[n, axis, 1] = (axis == 1) + (down + both * over_x) / spacing
    return out


@njit
def _rise(x):
    x = min(max(x, 0.0), 1.0)
    return x**3 * (x * (6 * x - 15) + 10)


@njit(cache=True)
def share_inside(points, edges, centre, offsets, weights):
    """Return the share of windows, (n,), that lies inside of a turned rectangle, its slope included."""
    out = np.empty(len(points))
    c, s, width = np.cos(edges[5]), np.sin(edges[5]), edges[4]
    for n in range(len(points)):
        x, y = points[n, 0] - centre[0], points[n, 1] - centre[1]
        whole = 1.0
        for axis in range(2):
            place = x * c + y * s if axis == 0 else y * c - x * s
            low, high = edges[2 * axis], edges[2 * axis + 1]
            part = 0.0
            for k in range(len(offsets)):
                spot = place + offsets[k]
                part += weights[k] * _rise((spot - low) / width) * _rise((high - spot) / width)
            whole *= part
        out[n] = whole
    return out


@njit(cache=True)
def spline_sums(first, across, down, weight, goal, columns, normal, right):
    """Add up the normal equations of a cubic spline lattice: each point touches four by four knots.

    `first` (n, 2) whole places, `across` and `down` (n, 4) weights, `weight` (n, 2, 2), `goal` (n, 2);
    `right` (terms,) is filled, and `normal`, of which row d has the products of each term with that d behind it:
    terms row by row of `columns` knots, x and y of each in turns.
    """
    for n in range(len(first)):
        p, q, r = weight[n, 0, 0], weight[n, 0, 1], weight[n, 1, 1]
        x, y = p * goal[n, 0] + q * goal[n, 1], q * goal[n, 0] + r * goal[n, 1]
        for i in range(16):
            one = 2 * ((first[n, 1] + i // 4) * columns + first[n, 0] + i % 4)
            here = down[n, i // 4] * across[n, i % 4]
            right[one] += here * x
            right[one + 1] += here * y
            both = here * here
            normal[0, one] += both * p
            normal[1, one] += both * q
            normal[0, one + 1] += both * r
            for k in range(i + 1, 16):
                apart = 2 * ((k // 4 - i // 4) * columns + k % 4 - i % 4)
                both = here * down[n, k // 4] * across[n, k % 4]
                normal[apart, one] += both * p
                normal[apart + 1, one] += both * q
                normal[apart - 1, one + 1] += both * q
                normal[apart, one + 1] += both * r

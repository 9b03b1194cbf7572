"""Compiled loops of maps: splines, polynomials, and the cubics along rows that stand for a map."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
from numba import njit


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


@njit(cache=True, nogil=True)
def displace(points, origin, spacing, coefficients):
    """Return displaced points, (n, 2); beyond the knots the displacement goes on in a straight line."""
    rows, columns = coefficients.shape[:2]
    out = np.empty_like(points)
    bx, by, dx, dy = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for n in range(len(points)):
        i, t, over_x = _place((points[n, 0] - origin[0]) / spacing, columns - 3)
        j, s, over_y = _place((points[n, 1] - origin[1]) / spacing, rows - 3)
        _weigh(t, bx, dx)
        _weigh(s, by, dy)
        for axis in range(2):
            shift = along = down = both = 0.0
            for r in range(4):
                value = slope = 0.0
                for c in range(4):
                    value += bx[c] * coefficients[j + r, i + c, axis]
                    slope += dx[c] * coefficients[j + r, i + c, axis]
                shift += by[r] * value
                along += by[r] * slope
                down += dy[r] * value
                both += dy[r] * slope
            shift += along * over_x + down * over_y + both * over_x * over_y
            out[n, axis] = points[n, axis] + shift
    return out


@njit(cache=True, nogil=True)
def polynomial(points, order, centre, spread, coefficients):
    """Return Σ c u^i v^j at points, (n, 2); terms by total degree, those of u first."""
    out = np.empty((len(points), 2))
    us, vs = np.ones(order + 1), np.ones(order + 1)
    for n in range(len(points)):
        u, v = (points[n, 0] - centre[0]) / spread, (points[n, 1] - centre[1]) / spread
        for k in range(order):
            us[k + 1] = us[k] * u
            vs[k + 1] = vs[k] * v
        x = y = 0.0
        term = 0
        for degree in range(order + 1):
            for j in range(degree + 1):
                power = us[degree - j] * vs[j]
                x += power * coefficients[term, 0]
                y += power * coefficients[term, 1]
                term += 1
        out[n, 0], out[n, 1] = x, y
    return out


@njit(cache=True, nogil=True)
def segments(nodes, first, weights, length, step_y, table):
    """Fill (rows, segments, 10): a cubic along each segment of each row of nodes, and the scales.

    `first` and `weights`, (3 segments + 1) and (…, taps), interpolate the nodes of a row at thirds
    of the segments, `length` px long; rows are `step_y` px apart.
    """
    rows, count, taps = nodes.shape[0], table.shape[1], weights.shape[1]
    middle = np.empty((rows, count, 2))
    along = np.empty((3 * count + 1, 2))
    for r in range(rows):
        for k in range(3 * count + 1):
            for a in range(2):
                total = 0.0
                for t in range(taps):
                    total += weights[k, t] * nodes[r, first[k] + t, a]
                along[k, a] = total
        for s in range(count):
            for a in range(2):
                p, q = along[3 * s, a], along[3 * s + 1, a]
                u, v = along[3 * s + 2, a], along[3 * s + 3, a]
                one = (18 * q - 11 * p - 9 * u + 2 * v) / (2 * length)
                two = 4.5 * (2 * p - 5 * q + 4 * u - v) / length**2
                three = 4.5 * (3 * q - p - 3 * u + v) / length**3
                # What is left of rounding would make a copy of whole pixels an interpolation.
                table[r, s, 4 * a] = p
                table[r, s, 4 * a + 1] = one if abs(one) * length >= 1e-9 else 0.0
                table[r, s, 4 * a + 2] = two if abs(two) * length**2 >= 1e-9 else 0.0
                table[r, s, 4 * a + 3] = three if abs(three) * length**3 >= 1e-9 else 0.0
                table[r, s, 8 + a] = (v - p) / length
                middle[r, s, a] = (q + u) / 2
    for r in range(rows):
        above, below = max(r - 1, 0), min(r + 1, rows - 1)
        for s in range(count):
            for a in range(2):
                down = (middle[below, s, a] - middle[above, s, a]) / ((below - above) * step_y)
                table[r, s, 8 + a] = np.hypot(table[r, s, 8 + a], down)

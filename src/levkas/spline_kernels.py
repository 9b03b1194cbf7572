"""Compiled loop of the spline displacement."""

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

"""Fitting a homography, with Brown's lens behind it or not, by Gauss-Newton with exact derivatives."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
from numba import njit

TURNS = 5
#: A turn that takes less of the squares than this is the last.
SETTLED = 1e-9


def fit_parameters(
    places: np.ndarray, goals: np.ndarray, roots: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Return the parameters for which the weighted squares of what is missed are least.

    Parameters
    ----------
    places : ndarray, (n, 2)
        Points, centred and scaled to about -1..1.
    goals : ndarray, (n, 2)
        Where they lie, in the same way.
    roots : ndarray, (n, 2, 2)
        Weigh what is missed: its product with them is squared.
    start : ndarray, (8,) or (12,)
        Of the homography x: 1, u, v; y: 1, u, v; w: u, v; then, with a lens, k1, k2, p1, p2.

    Returns
    -------
    parameters : ndarray, (8,) or (12,)

    Examples
    --------
    >>> u, v = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    >>> places = np.stack([u.ravel(), v.ravel()], 1)
    >>> goals = (places + 0.1) / (1 + 0.05 * places[:, :1])
    >>> start = np.array([0.0, 1, 0, 0, 0, 1, 0, 0])
    >>> found = fit_parameters(places, goals, np.tile(np.eye(2), (25, 1, 1)), start)
    >>> np.abs(found - [0.1, 1, 0, 0.1, 0, 1, 0.05, 0]).max() < 1e-9
    np.True_
    """
    best = np.array(start, float)
    missed, slopes = np.empty(2 * len(places)), np.empty((2 * len(places), len(best)))
    _look(places, goals, roots, best, missed, slopes)
    tried, after = np.empty_like(missed), np.empty_like(slopes)
    for _ in range(TURNS):
        if not np.isfinite(slopes).all():
            break
        scale = 1 / np.maximum(np.sqrt((slopes * slopes).sum(0)), 1e-150)
        normal = (slopes.T @ slopes) * scale[:, None] * scale
        move = -scale * np.linalg.lstsq(normal, scale * (slopes.T @ missed), rcond=1e-13)[0]
        _look(places, goals, roots, best + move, tried, after)
        before, now = float(missed @ missed), float(tried @ tried)
        if not (np.isfinite(tried).all() and now < before):
            break
        best = best + move
        missed, tried, slopes, after = tried, missed, after, slopes
        if before - now < SETTLED * before:
            break
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def weigh(information, jacobian, unit):
    """Return roots, (n, 2, 2), that weigh misses of the target in `unit` by information of the reference."""
    out = np.empty_like(information)
    for n in range(len(information)):
        p, q, r = information[n, 0, 0] + 1e-9, information[n, 0, 1], information[n, 1, 1] + 1e-9
        first = np.sqrt(p)
        cross, second = q / first, np.sqrt(r - q * q / p)
        a, b, c, d = jacobian[n, 0, 0], jacobian[n, 0, 1], jacobian[n, 1, 0], jacobian[n, 1, 1]
        whole = unit / (a * d - b * c)
        out[n, 0, 0], out[n, 0, 1] = (
            (first * d - cross * c) * whole,
            (cross * a - first * b) * whole,
        )
        out[n, 1, 0], out[n, 1, 1] = -second * c * whole, second * a * whole
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _look(places, goals, roots, p, missed, slopes):
    """Fill what is missed, weighted, and its derivatives by the parameters."""
    lens = len(p) > 8
    along, down = np.zeros(12), np.zeros(12)
    for n in range(len(places)):
        u, v = places[n, 0], places[n, 1]
        w = 1 / (1 + p[6] * u + p[7] * v)
        a, b = (p[0] + p[1] * u + p[2] * v) * w, (p[3] + p[4] * u + p[5] * v) * w
        x, y = a, b
        xa, xb, yb = 1.0, 0.0, 1.0
        if lens:
            k1, k2, t1, t2 = p[8], p[9], p[10], p[11]
            r2 = a * a + b * b
            gain, slope = 1 + k1 * r2 + k2 * r2 * r2, k1 + 2 * k2 * r2
            x = a * gain + 2 * t1 * a * b + t2 * (r2 + 2 * a * a)
            y = b * gain + 2 * t2 * a * b + t1 * (r2 + 2 * b * b)
            xa = gain + 2 * a * a * slope + 2 * t1 * b + 6 * t2 * a
            xb = 2 * a * b * slope + 2 * t1 * a + 2 * t2 * b
            yb = gain + 2 * b * b * slope + 2 * t2 * a + 6 * t1 * b
            along[8], down[8] = a * r2, b * r2
            along[9], down[9] = a * r2 * r2, b * r2 * r2
            along[10], down[10] = 2 * a * b, r2 + 2 * b * b
            along[11], down[11] = r2 + 2 * a * a, 2 * a * b
        for k, term in enumerate((w, u * w, v * w)):
            along[k], down[k] = xa * term, xb * term
            along[3 + k], down[3 + k] = xb * term, yb * term
        for k, term in enumerate((u * w, v * w)):
            along[6 + k] = -(xa * a + xb * b) * term
            down[6 + k] = -(xb * a + yb * b) * term
        dx, dy = goals[n, 0] - x, goals[n, 1] - y
        for row in range(2):
            q, r = roots[n, row, 0], roots[n, row, 1]
            missed[2 * n + row] = q * dx + r * dy
            for k in range(len(p)):
                slopes[2 * n + row, k] = -(q * along[k] + r * down[k])

"""Compiled ray geometry between the panel and base pixels.

One file, because numba's cache of a kernel does not notice a change in another file that it calls.
`shape` is `Panel.vector()`, `c` is `View.vector()`; lengths are millimetres.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit
from levkas.core.threads import in_threads

Triple = tuple[float, float, float]


@njit
def _slope(x: float) -> float:
    if x <= 0.0:
        return 0.0
    if x >= 1.0:
        return 1.0
    return x * x * x * (x * (6.0 * x - 15.0) + 10.0)


@njit
def _height_at(s: float, t: float, shape: np.ndarray) -> float:
    """Return the height above the cylinder at (s, t), mm; twice differentiable."""
    bevel = shape[5]
    along = _slope((0.5 * shape[0] - shape[4] - abs(s)) / bevel)
    across = _slope((0.5 * shape[1] - shape[4] - abs(t)) / bevel)
    twist = 4.0 * shape[6] * s * t / (shape[0] * shape[1])
    return twist - shape[3] * along * across


@njit
def _surface_point(s: float, t: float, shape: np.ndarray) -> Triple:
    """Return the world point of (s, t), mm."""
    radius = shape[2]
    outer = radius + _height_at(s, t, shape)
    return s, outer * np.sin(t / radius), radius - outer * np.cos(t / radius)


@njit
def _gap(tau: float, start: Triple, ray: Triple, shape: np.ndarray) -> Triple:
    """Return (distance above the surface, s, t) at `tau` along a ray."""
    radius = shape[2]
    y = start[1] + tau * ray[1]
    z = radius - start[2] - tau * ray[2]
    s = start[0] + tau * ray[0]
    t = radius * np.arctan2(y, z)
    return np.sqrt(y * y + z * z) - radius - _height_at(s, t, shape), s, t


@njit
def _reach_level(start: Triple, ray: Triple, radius: float, lift: float) -> float:
    """Return where a ray first meets the cylinder `lift` above the panel's, or NaN."""
    axis = start[2] - radius
    a = ray[1] * ray[1] + ray[2] * ray[2]
    b = start[1] * ray[1] + axis * ray[2]
    # (r − ρ)(r + ρ) keeps the digits that r² − ρ² loses for a nearly flat panel.
    outer = np.hypot(start[1], axis)
    c = (outer - radius - lift) * (outer + radius + lift)
    inside = b * b - a * c
    if inside < 0.0:
        return np.nan
    return c / (-b + np.sqrt(inside))


@njit
def _first_hit(start: Triple, ray: Triple, shape: np.ndarray) -> tuple[float, float]:
    """Return the (s, t) where a ray first meets the surface, to 1e-9 mm; NaN where it misses.

    Between the highest and the lowest level of the relief the ray is walked in steps shorter than
    the bevel, so that the near lip of a ledge hides what is behind it.
    """
    radius, reach = shape[2], shape[3] + 4.0 * abs(shape[6]) + 0.02
    lift = 2.0 * abs(shape[6]) + 0.01
    tau = _reach_level(start, ray, radius, lift)
    end = _reach_level(start, ray, radius, lift - reach)
    if np.isnan(tau) or np.isnan(end):
        return np.nan, np.nan
    steps = int(shape[7])
    low, gap_low = tau, _gap(tau, start, ray, shape)[0]
    gap_high = gap_low
    for k in range(1, steps + 1):
        high = tau + (end - tau) * k / steps
        gap_high = _gap(high, start, ray, shape)[0]
        if gap_high <= 0.0:
            break
        low, gap_low = high, gap_high
    if gap_high > 0.0:
        return np.nan, np.nan
    for _ in range(80):  # regula falsi, Illinois: the gap is nearly linear
        middle = (low * gap_high - high * gap_low) / (gap_high - gap_low)
        gap, s, t = _gap(middle, start, ray, shape)
        if abs(gap) < 1e-10:
            break
        if gap > 0.0:
            low, gap_low, gap_high = middle, gap, 0.5 * gap_high
        else:
            high, gap_high, gap_low = middle, gap, 0.5 * gap_low
    return s, t


@njit
def _lens(u: float, v: float, c: np.ndarray) -> tuple[float, float]:
    r2 = u * u + v * v
    gain = 1.0 + c[16] * r2 + c[17] * r2 * r2
    return (
        u * gain + 2.0 * c[18] * u * v + c[19] * (r2 + 2.0 * u * u),
        v * gain + 2.0 * c[19] * u * v + c[18] * (r2 + 2.0 * v * v),
    )


@njit
def _unlens(a: float, b: float, c: np.ndarray) -> tuple[float, float]:
    """Invert the lens by Newton."""
    u, v = a, b
    for _ in range(30):
        x, y = _lens(u, v, c)
        ex, ey = x - a, y - b
        if abs(ex) + abs(ey) < 1e-14:
            break
        r2 = u * u + v * v
        gain, slope = 1.0 + c[16] * r2 + c[17] * r2 * r2, c[16] + 2.0 * c[17] * r2
        cross = 2.0 * u * v * slope + 2.0 * c[18] * u + 2.0 * c[19] * v
        xx = gain + 2.0 * u * u * slope + 2.0 * c[18] * v + 6.0 * c[19] * u
        yy = gain + 2.0 * v * v * slope + 2.0 * c[19] * u + 6.0 * c[18] * v
        det = xx * yy - cross * cross
        u -= (yy * ex - cross * ey) / det
        v -= (xx * ey - cross * ex) / det
    return u, v


@njit
def _travel(q: float, c: np.ndarray) -> float:
    return q / c[24] + c[25] * np.sin(2.0 * np.pi * q / c[26] + c[27])


@njit
def _project(px: float, py: float, pz: float, c: np.ndarray) -> tuple[float, float]:
    """Return the base pixel of a world point."""
    x = c[0] * px + c[1] * py + c[2] * pz + c[9]
    y = c[3] * px + c[4] * py + c[5] * pz + c[10]
    z = c[6] * px + c[7] * py + c[8] * pz + c[11]
    scale = c[12] / c[15]
    if c[20] == 0.0:
        u, v = _lens(scale * x / z, scale * y / z, c)
        return c[13] + c[15] * u, c[14] + c[15] * v
    q = y / c[22]
    u, _ = _lens(scale * (x - q * c[21]) / (z - q * c[23]), 0.0, c)
    return c[13] + c[15] * u, c[14] + _travel(q, c)


@njit
def _turned_back(x: float, y: float, z: float, c: np.ndarray) -> Triple:
    return (
        c[0] * x + c[3] * y + c[6] * z,
        c[1] * x + c[4] * y + c[7] * z,
        c[2] * x + c[5] * y + c[8] * z,
    )


@njit
def _cast(bx: float, by: float, c: np.ndarray, shape: np.ndarray) -> tuple[float, float]:
    """Return the panel point that a base pixel sees."""
    if c[20] == 0.0:
        u, v = _unlens((bx - c[13]) / c[15], (by - c[14]) / c[15], c)
        q = 0.0
    else:
        goal = by - c[14]
        q = goal * c[24]
        for _ in range(60):
            miss = _travel(q, c) - goal
            if abs(miss) < 1e-13 * max(1.0, abs(goal)):
                break
            pace = 2.0 * np.pi / c[26]
            q -= miss / (1.0 / c[24] + c[25] * pace * np.cos(pace * q + c[27]))
        # A scan line has no second dimension: the lens acts along it alone.
        u, v = (bx - c[13]) / c[15], 0.0
        for _ in range(60):
            miss = _lens(u, 0.0, c)[0] - (bx - c[13]) / c[15]
            if abs(miss) < 1e-15:
                break
            r2 = u * u
            u -= miss / (1.0 + 3.0 * c[16] * r2 + 5.0 * c[17] * r2 * r2 + 6.0 * c[19] * u)
    dx, dy = u * c[15] / c[12], v * c[15] / c[12]
    ox, oy, oz = q * c[21] - c[9], q * c[22] - c[10], q * c[23] - c[11]
    return _first_hit(_turned_back(ox, oy, oz, c), _turned_back(dx, dy, 1.0, c), shape)


@njit(cache=True)
def _lift(start, stop, points, shape, out):  # type: ignore[no-untyped-def]
    for i in range(start, stop):
        out[i] = _height_at(points[i, 0], points[i, 1], shape)


@njit(cache=True)
def _project_points(start, stop, points, c, shape, out):  # type: ignore[no-untyped-def]
    for i in range(start, stop):
        px, py, pz = _surface_point(points[i, 0], points[i, 1], shape)
        out[i, 0], out[i, 1] = _project(px, py, pz, c)


@njit(cache=True)
def _cast_points(start, stop, points, c, shape, out):  # type: ignore[no-untyped-def]
    for i in range(start, stop):
        out[i, 0], out[i, 1] = _cast(points[i, 0], points[i, 1], c, shape)


def heights(points: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the height above the cylinder of each panel point, (n,)."""
    out = np.empty(len(points))
    in_threads(_lift, len(points), points, shape, out)
    return out


def project(points: np.ndarray, c: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the base pixels of panel points, (n, 2)."""
    out = np.empty((len(points), 2))
    in_threads(_project_points, len(points), points, c, shape, out)
    return out


def cast(points: np.ndarray, c: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the panel points that base pixels see, (n, 2)."""
    out = np.empty((len(points), 2))
    in_threads(_cast_points, len(points), points, c, shape, out)
    return out

"""Places and weights of taps, and the careful way to resample one pixel of one band.

Compiled into the kernels of `warping_kernels`, which has to change with this file.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from math import floor, pi, sin
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from levkas.lanes import (
    WIDTH,
    all_marks,
    constant,
    fma,
    join,
    load_marks,
    look,
    mark_where,
    no_marks,
    put,
    store_marks,
    whole,
)

F = np.float32
CUBIC, LANCZOS, LINEAR = 0, 1, 2
NODES = 6
"""Nodes a position is interpolated from on either axis: exact for polynomials of order 5."""
OUTSIDE, NEAR = np.uint8(1), np.uint8(64)
LIGHTEST = 1 / 32
"""A tap that weighs less than this share of the heaviest hands on no flag."""
SNAP = 2.0**20
"""Positions are rounded to this part of a pixel where a segment starts: identity copies bits."""


class Frame(NamedTuple):
    """Sides of the source: the whole frame, and which of its rows are held in memory."""

    top: int
    held: int
    height: int
    width: int
    bands: int


class Planes(NamedTuple):
    """Source arrays, flat; all but `values` may be empty.

    `suspect`, a byte a pixel: flags of all its bands; `around`: some pixel of the 4 x 4 about it has one.
    """

    values: Any
    variance: Any
    flags: Any
    suspect: Any
    around: Any


class Result(NamedTuple):
    """Result arrays, flat, from grid row `first` on; `variance` may be empty."""

    values: Any
    variance: Any
    flags: Any
    first: int
    fill: float


class Nodes(NamedTuple):
    """Where grid pixels fall in the source: cubics along segments of rows.

    `table` is (rows, segments, 8 or 10[, maps]): coefficients of 1, t, t², t³ of x, then of y, t in
    px from the segment's start; for the wide kernels the scales along x and y. Its first and last
    row belong to the first and last row of the grid of (`height`, `width`) px. With `exact` there
    is a row and a segment for each pixel, rows from `first` on.
    """

    table: Any
    height: int
    width: int
    first: int
    segment: int
    exact: bool


@njit
def lagrange(u, count, weights):
    """Write the weights of the nodes from `first` on for a place `u` among `count`; return `first`."""
    first = min(max(floor(u) - NODES // 2 + 1, 0), count - NODES)
    for i in range(NODES):
        weight = 1.0
        for j in range(NODES):
            if j != i:
                weight *= (u - first - j) / (i - j)
        weights[i] = weight
    return first


@njit
def mix(table, at, step, w, out):
    """Write to `out` the weighted sum of `NODES` stretches of the flat `table`, `step` apart."""
    w0, w1, w2, w3, w4, w5 = w[0], w[1], w[2], w[3], w[4], w[5]
    for i in range(out.size):
        k = at + i
        total = w0 * look(table, k) + w1 * look(table, k + step) + w2 * look(table, k + 2 * step)
        total += w3 * look(table, k + 3 * step) + w4 * look(table, k + 4 * step)
        put(out, i, total + w5 * look(table, k + 5 * step))


@njit
def split(row, at, maps, curve, pixels):
    """Write a segment's curves as the whole pixels they start in and float32 from there on.

    Row by row of `curve`, (8, lanes): coefficients of 1, t, t², t³ of x, then of y; of `pixels`,
    (2, lanes): whole pixels from the one that is returned, (x, y).
    """
    n = curve.size // 8
    x0 = y0 = 0.0
    for b in range(maps):
        if abs(look(row, at + b)) < 1e8 and abs(look(row, at + 4 * maps + b)) < 1e8:
            x0, y0 = np.floor(look(row, at + b)), np.floor(look(row, at + 4 * maps + b))
            break
    for axis in range(2):
        origin = y0 if axis else x0
        k, to = at + 4 * axis * maps, 4 * axis * n
        for b in range(maps):
            here = look(row, k + b)
            pixel = np.floor(here)
            put(pixels, axis * n + b, F(pixel - origin))
            put(curve, to + b, F(np.floor((here - pixel) * SNAP + 0.5) / SNAP))
        for c in range(1, 4):
            for b in range(maps):
                put(curve, to + c * n + b, F(look(row, k + c * maps + b)))
    return int(x0), int(y0)


@njit
def run_along(c0, c1, c2, c3, t):
    """Return a cubic at `t`, split in whole and rest; float32 or lanes."""
    place = fma(t, fma(t, fma(t, c3, c2), c1), c0)
    pixel = whole(place)
    return pixel, place - pixel


@njit
def place(curve, pixels, corner, b, t):
    """Return where map `b` is at `t` px along its segment: whole pixel and rest, x and then y."""
    n = curve.size // 8
    c = (look(curve, b), look(curve, n + b), look(curve, 2 * n + b), look(curve, 3 * n + b))
    fx, x = run_along(c[0], c[1], c[2], c[3], t)
    b += 4 * n
    c = (look(curve, b), look(curve, n + b), look(curve, 2 * n + b), look(curve, 3 * n + b))
    fy, y = run_along(c[0], c[1], c[2], c[3], t)
    b -= 4 * n
    fx, fy = fx + look(pixels, b), fy + look(pixels, n + b)
    return corner[0] + int(fx), float(x), corner[1] + int(fy), float(y)


@njit
def cubic(t):
    """Weights of Keys's cubic, a = -0.5, for pixels -1, 0, 1, 2 from `t` in [0, 1]."""
    half, square = constant(t, 0.5), t * t
    return (
        t * fma(t, fma(constant(t, -0.5), t, constant(t, 1.0)), constant(t, -0.5)),
        fma(square, fma(constant(t, 1.5), t, constant(t, -2.5)), constant(t, 1.0)),
        t * fma(t, fma(constant(t, -1.5), t, constant(t, 2.0)), half),
        square * fma(half, t, constant(t, -0.5)),
    )


@njit
def inside(at, frame):
    """Tell whether a place, whole and rest, x then y, is on the area of some pixel."""
    return (
        -0.5 <= at[0] + at[1] <= frame.width - 0.5 and -0.5 <= at[2] + at[3] <= frame.height - 0.5
    )


@njit
def within(fx, fy, frame):
    """Tell whether the 4 x 4 taps around a pixel are in the frame and in memory."""
    return (
        fx >= 1 and fx + 2 < frame.width and fy - 1 >= frame.top and fy + 2 < frame.top + frame.held
    )


@njit
def any_suspect(suspect, frame, x, y, columns, rows):
    """Return the flags that pixels of a box in memory have in any band."""
    found = np.uint8(0)
    for r in range(y - frame.top, y - frame.top + rows):
        for c in range(x, x + columns):
            found |= look(suspect, r * frame.width + c)
    return found


@njit
def kernel_value(kind, d):
    """Keys's cubic (a = -0.5), Lanczos of three lobes, or a tent, at distance `d` in taps."""
    d = abs(d)
    if kind == CUBIC:
        if d < 1.0:
            return 1.0 + d * d * (1.5 * d - 2.5)
        return 2.0 + d * (d * (2.5 - 0.5 * d) - 4.0) if d < 2.0 else 0.0
    if kind == LINEAR:
        return max(0.0, 1.0 - d)
    if d < 1e-9:
        return 1.0
    return 3.0 * sin(pi * d) * sin(pi * d / 3.0) / (pi * d) ** 2 if d < 3.0 else 0.0


@njit
def weigh_axis(kind, whole, rest, scale, size, weights):
    """Write the weights of one axis for the place whole + rest; return first tap and count.

    The kernel is `scale` times as wide. Taps outside [0, size) are left out. The rest is brought to
    sum 1 and to a centre of weight at the place, by a slope under a tent: exact on a ramp.
    """
    reach = scale * (2.0 if kind == CUBIC else (3.0 if kind == LANCZOS else 1.0))
    first = max(whole + floor(rest - reach) + 1, 0)
    last = min(whole + floor(rest + reach), size - 1)
    count = last - first + 1
    total = moment = tents = lean = 0.0
    for i in range(count):
        d = first + i - whole - rest
        weights[i] = kernel_value(kind, d / scale)
        total += weights[i]
        tent = max(0.0, 1.0 - abs(d) / reach)
        tents += tent
        lean += tent * d
    lean /= tents
    square = 0.0
    for i in range(count):
        d = first + i - whole - rest
        weights[i] /= total
        moment += weights[i] * d
        square += max(0.0, 1.0 - abs(d) / reach) * d * (d - lean)
    if square > 1e-9:
        for i in range(count):
            d = first + i - whole - rest
            weights[i] -= moment / square * max(0.0, 1.0 - abs(d) / reach) * (d - lean)
    return first, count


@njit
def peak(weights, count):
    """Return the largest size of `count` weights."""
    largest = 0.0
    for i in range(count):
        largest = max(largest, abs(weights[i]))
    return largest


@njit
def gather(planes, result, frame, kind, at, wide_x, wide_y, b, to, always, scratch):
    """Resample one pixel of one band with care: edges, flags, pixels that are not there.

    `at`: whole and rest of the place, x then y. Where all taps are there and none is cut off by
    the frame, only flags are written unless `always`. Returns 1 where a tap is not in memory.
    """
    fx, x, fy, y = at
    u, v = scratch[0], scratch[1]
    x0, columns = weigh_axis(kind, fx, x, wide_x, frame.width, u)
    y0, rows = weigh_axis(kind, fy, y, wide_y, frame.height, v)
    if y0 < frame.top or y0 + rows > frame.top + frame.held:
        return 1
    near_x = min(max(fx + (1 if x >= 0.5 else 0), 0), frame.width - 1)
    near_y = min(max(fy + (1 if y >= 0.5 else 0), 0), frame.height - 1)
    heaviest = peak(u, columns) * peak(v, rows)
    value = spread = soft_value = soft_spread = soft = 0.0
    own = others = np.uint8(0)
    lacking = lost = False
    for r in range(rows):
        for k in range(columns):
            p = ((y0 + r - frame.top) * frame.width + x0 + k) * frame.bands + b
            weight = v[r] * u[k]
            tap = float(planes.values[p])
            flag = planes.flags[p] if planes.flags.size else np.uint8(0)
            nearest = x0 + k == near_x and y0 + r == near_y
            gone = not np.isfinite(tap) or flag & OUTSIDE
            if nearest:
                own, lost = flag, gone
            elif (flag or gone) and abs(weight) >= LIGHTEST * heaviest:
                others |= (flag & ~OUTSIDE) | NEAR
            if gone:
                lacking |= weight != 0.0
                continue
            noise = float(planes.variance[p]) if planes.variance.size else 0.0
            value += weight * tap
            spread += weight * weight * noise
            tent = max(0.0, 1.0 - abs(x0 + k - fx - x) / max(1.0, wide_x))
            tent *= max(0.0, 1.0 - abs(y0 + r - fy - y) / max(1.0, wide_y))
            soft += tent
            soft_value += tent * tap
            soft_spread += tent * tent * noise
    if lost:
        leave_out(planes, result, to, own | OUTSIDE)
        return 0
    result.flags[to] = own | others
    if lacking:
        value, spread = soft_value / soft, soft_spread / (soft * soft)
        result.flags[to] |= NEAR
    whole = x0 == fx - 1 and columns == 4 and y0 == fy - 1 and rows == 4
    if always or lacking or not whole:
        result.values[to] = value
        if planes.variance.size:
            result.variance[to] = spread
    return 0


@njit
def pass_flags(planes, result, frame, kind, at, wide_x, wide_y, b, count, to, scratch):
    """Hand on the flags of `count` bands from `b` on that share a place, as `gather` does.

    False where a tap is OUTSIDE in one of them: then `gather` has to see to each.
    """
    fx, x, fy, y = at
    u, v = scratch[0], scratch[1]
    x0, columns = weigh_axis(kind, fx, x, wide_x, frame.width, u)
    y0, rows = weigh_axis(kind, fy, y, wide_y, frame.height, v)
    if y0 < frame.top or y0 + rows > frame.top + frame.held:
        return False
    near_x = min(max(fx + (1 if x >= 0.5 else 0), 0), frame.width - 1)
    near_y = min(max(fy + (1 if y >= 0.5 else 0), 0), frame.height - 1)
    least = LIGHTEST * (peak(u, columns) * peak(v, rows))
    flags, out, step = planes.flags, result.flags, frame.bands
    p = ((y0 - frame.top) * frame.width + x0) * step + b
    wide, own = frame.width * step, p + ((near_y - y0) * frame.width + near_x - x0) * step
    lacking = any_suspect(planes.suspect, frame, x0, y0, columns, rows) & OUTSIDE
    gone = np.uint8(0)
    if count < WIDTH:
        for i in range(count):
            gone |= pass_one(
                flags, p + i, own + i, step, wide, u, v, columns, rows, least, out, to + i
            )
        return gone & OUTSIDE == 0
    taps = np.empty(rows * columns, np.int64)
    heavy, light = sort_taps(taps, p, own, step, wide, u, v, columns, rows, least)
    for block in range(0, count, WIDTH):
        i = min(block, count - WIDTH)
        passed = there = no_marks()
        for k in range(heavy):
            passed = join(passed, load_marks(flags, look(taps, k) + i))
        # Taps that weigh little are looked at only for what is not there.
        for k in range(light if lacking else taps.size, taps.size):
            there = join(there, load_marks(flags, look(taps, k) + i))
        marks = load_marks(flags, own + i)
        gone |= all_marks(join(join(there, passed), marks))
        store_marks(out, to + i, join(join(marks, passed), mark_where(passed, NEAR)))
    return gone & OUTSIDE == 0


@njit
def sort_taps(taps, p, own, step, wide, u, v, columns, rows, least):
    """Write where taps are that weigh `least` or more to the front, and other ones to the back.

    Returns how many are in front, and where those at the back begin.
    """
    heavy, light = 0, taps.size
    for r in range(rows):
        for k in range(columns):
            weight, tap = abs(v[r] * u[k]), p + r * wide + k * step
            if weight == 0.0 or tap == own:
                continue
            if weight >= least:
                put(taps, heavy, tap)
                heavy += 1
            else:
                light -= 1
                put(taps, light, tap)
    return heavy, light


@njit
def pass_one(flags, p, own, step, wide, u, v, columns, rows, least, out, to):
    """Hand on the flags of one band, taps from flat index `p` on; return all that are there."""
    there = flag = look(flags, own)
    for r in range(rows):
        for k in range(columns):
            weight, tap = abs(v[r] * u[k]), p + r * wide + k * step
            if weight != 0.0 and tap != own:
                mark = look(flags, tap)
                there |= mark
                if weight >= least and mark != 0:
                    flag |= mark | NEAR
    put(out, to, flag)
    return there


@njit
def leave_out(planes, result, to, flag):
    """Write that there is nothing."""
    result.values[to] = result.fill
    result.flags[to] = flag
    if planes.variance.size:
        result.variance[to] = result.fill

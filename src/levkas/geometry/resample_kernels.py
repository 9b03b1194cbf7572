"""Compiled loops of resampling: Keys's cubic convolution, bands innermost.

A pixel of the grid is interpolated from a box of source pixels, the *taps*. The box and its weights are
computed once and the loop over bands is innermost. Weights are float64, sums float32 (float64 where
the kernel is widened) in one order and without fastmath, so that a value depends
on nothing but its taps. Flags and pixels that are not there take the slow path, `_gather`.

Source: R. G. Keys, "Cubic convolution interpolation for digital image processing" (1981),
doi:10.1109/TASSP.1981.1163711, a = −1/2.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from math import floor
from typing import Any, NamedTuple

import numpy as np

from levkas.core.compiled import njit

F = np.float32
NODES = 6
"""Nodes a map is interpolated from down the rows: exact for polynomials of order 5."""
OUTSIDE, NEAR = np.uint8(1), np.uint8(64)
LIGHTEST = 1 / 32
"""A tap that weighs less than this share of the heaviest hands on no flag."""
SNAP = 2.0**20
"""Places are rounded to this part of a pixel: the identity copies bits."""


class SourceFrame(NamedTuple):
    """Arrays of the source, (rows, width, bands); `variance` and `flags` may be empty.

    `suspect`, (rows, width): flags that any band of a pixel has. The first row held is row `top` of
    an image of `height` rows.
    """

    values: Any
    variance: Any
    flags: Any
    suspect: Any
    top: int
    height: int


class Result(NamedTuple):
    """Arrays of the result, (rows, width, bands), from grid row `first` on; `variance` may be empty."""

    values: Any
    variance: Any
    flags: Any
    first: int


class Nodes(NamedTuple):
    """Where grid pixels fall in the source: cubics along segments of rows.

    `table` is (rows, segments, 8 or 10): coefficients of 1, t, t², t³ of x, then of y, t in px
    from the segment's start; then, where kernels are widened, how many times along x and y. Its first
    and last row belong to the first and last row of the grid of (`height`, `width`) px. With `exact`
    there is a row and a segment for each pixel, rows from `first` on. Kernels are never widened more
    than `widest` times.
    """

    table: Any
    height: int
    width: int
    first: int
    segment: int
    exact: bool
    widest: float


@njit(cache=True)
def find_suspects(start, stop, flags, suspect):
    """Join the flags of all bands, rows `start` to `stop`."""
    for y in range(start, stop):
        for x in range(flags.shape[1]):
            found = np.uint8(0)
            for b in range(flags.shape[2]):
                found |= flags[y, x, b]
            suspect[y, x] = found


@njit
def _mix(nodes, y, segment, part):
    """Interpolate the cubics of a segment between the rows of nodes, (channels,)."""
    table = nodes.table
    rows = table.shape[0]
    if nodes.exact:
        for c in range(len(part)):
            part[c] = table[y - nodes.first, segment, c]
        return
    place = y * ((rows - 1) / (nodes.height - 1))
    first = min(max(floor(place) - NODES // 2 + 1, 0), rows - NODES)
    part[:] = 0.0
    for i in range(NODES):
        weight = 1.0
        for j in range(NODES):
            if j != i:
                weight *= (place - first - j) / (i - j)
        for c in range(len(part)):
            part[c] += weight * table[first + i, segment, c]


@njit(forceinline=True)
def _follow(part, t):
    """Return where the map is at `t` px along its segment, (x, y)."""
    x = part[0] + t * (part[1] + t * (part[2] + t * part[3]))
    y = part[4] + t * (part[5] + t * (part[6] + t * part[7]))
    return np.floor(x * SNAP + 0.5) / SNAP, np.floor(y * SNAP + 0.5) / SNAP


@njit
def _widths(part, widest):
    """Return how many times the kernel is widened along x and y."""
    if len(part) == 8:
        return 1.0, 1.0
    return min(max(1.0, part[8]), widest), min(max(1.0, part[9]), widest)


@njit(forceinline=True)
def _inside(x, y, source):
    """Return whether a place is on the area of a pixel of the source."""
    width = source.values.shape[1]
    return -0.5 <= x <= width - 0.5 and -0.5 <= y <= source.height - 0.5


@njit(forceinline=True)
def _keys(d):
    """Keys's cubic, a = -0.5, at distance `d` in taps."""
    d = abs(d)
    if d < 1.0:
        return 1.0 + d * d * (1.5 * d - 2.5)
    return 2.0 + d * (d * (2.5 - 0.5 * d) - 4.0) if d < 2.0 else 0.0


@njit(forceinline=True)
def _cubic(t):
    """Weights of Keys's cubic for pixels -1, 0, 1, 2 from `t` in [0, 1]."""
    square = t * t
    return (
        F(t * ((-0.5 * t + 1.0) * t - 0.5)),
        F(square * (1.5 * t - 2.5) + 1.0),
        F(t * ((-1.5 * t + 2.0) * t + 0.5)),
        F(square * (0.5 * t - 0.5)),
    )


@njit(forceinline=True)
def _reach(place, scale, size):
    """Return the first tap on an axis and one past the last; those beyond the image are left out."""
    first = max(floor(place - 2.0 * scale) + 1, 0)
    return first, min(floor(place + 2.0 * scale), size - 1) + 1


@njit(forceinline=True)
def _weigh(place, scale, first, count, u):
    """Write the weights of the taps of one axis to `u`; the kernel is `scale` times as wide.

    They are brought to sum 1, and to a centre of weight at the place by a slope under a tent: exact
    on a ramp, also where the edge of the image cuts taps off.
    """
    total = moment = tents = lean = square = 0.0
    narrow = 1.0 / scale
    for i in range(count):
        d = first + i - place
        weight, tent = _keys(d * narrow), max(0.0, 1.0 - abs(d) * narrow / 2.0)
        total += weight
        moment += weight * d
        tents += tent
        lean += tent * d
        square += tent * d * d
        u[i] = weight
    lean /= tents
    square -= lean * lean * tents
    shift = moment / total / square if square > 1e-9 else 0.0
    for i in range(count):
        d = first + i - place
        tent = max(0.0, 1.0 - abs(d) * narrow / 2.0)
        u[i] = u[i] / total - shift * tent * (d - lean)


@njit(forceinline=True)
def _axis(place, scale, size, u):
    """Write the weights of one place on one axis; return the first tap and how many there are."""
    first, stop = _reach(place, scale, size)
    if scale == 1.0 and stop - first == 4:
        u[0], u[1], u[2], u[3] = _cubic(place - first - 1.0)
    else:
        _weigh(place, scale, first, stop - first, u)
    return first, stop - first


@njit
def _largest(u, count):
    """Return the largest size of `count` weights."""
    largest = 0.0
    for i in range(count):
        largest = max(largest, abs(u[i]))
    return largest


@njit(forceinline=True)
def _any_suspect(suspect, x, columns, y, rows):
    """Return the flags that pixels of a box have in any band."""
    found = np.uint8(0)
    for r in range(y, y + rows):
        for c in range(x, x + columns):
            found |= suspect[r, c]
    return found


@njit
def _nearest(x, y, source):
    """Return the column and the row, as held, of the pixel that a place lies on."""
    column = min(max(floor(x + 0.5), 0), source.values.shape[1] - 1)
    return column, min(max(floor(y + 0.5), 0), source.height - 1) - source.top


@njit
def _inner(source):
    """Return the columns and rows about which 4 x 4 taps are there: first, one past the last, twice."""
    held, width = source.values.shape[:2]
    return 1, width - 2, max(1, 1 - source.top), min(held, source.height - source.top) - 2


@njit(forceinline=True)
def _is_inner(x, y, inner):
    return inner[0] <= x < inner[1] and inner[2] <= y < inner[3]


@njit(forceinline=True)
def _squares(u):
    return u[0] * u[0], u[1] * u[1], u[2] * u[2], u[3] * u[3]


@njit
def _scratch(widest, bands):
    """Return room for the weights of the taps on both axes, and for the sums of bands."""
    taps = 8 + int(6 * widest)
    return np.empty(taps), np.empty(taps), np.empty(bands)


@njit
def _leave_out(result, row, x, b, flag):
    """Write that there is nothing."""
    result.values[row, x, b] = np.nan
    result.flags[row, x, b] = flag
    if result.variance.size:
        result.variance[row, x, b] = np.nan


@njit
def _gather(source, result, at, spot, b, always, weights):
    """Resample one band of one pixel with care: edges, flags, pixels that are not there.

    `at`: place x, y and how many times the kernel is widened along either; `spot`: row and column of
    the result. Where all taps are there only flags are written unless `always`. Returns 1 where a tap
    is in a row that is not held.
    """
    (px, py, wide_x, wide_y), (row, x), (u, v) = at, spot, weights[:2]
    if not _inside(px, py, source):
        _leave_out(result, row, x, b, OUTSIDE)
        return 0
    x0, columns = _axis(px, wide_x, source.values.shape[1], u)
    y0, rows = _axis(py, wide_y, source.height, v)
    y0 -= source.top
    if y0 < 0 or y0 + rows > source.values.shape[0]:
        return 1
    near, least = _nearest(px, py, source), LIGHTEST * _largest(u, columns) * _largest(v, rows)
    value = spread = 0.0
    own = others = np.uint8(0)
    lacking = False
    for r in range(rows):
        for k in range(columns):
            weight, tap = v[r] * u[k], float(source.values[y0 + r, x0 + k, b])
            flag = source.flags[y0 + r, x0 + k, b] if source.flags.size else np.uint8(0)
            missing = not np.isfinite(tap) or flag & OUTSIDE
            if (x0 + k, y0 + r) == near:
                own = flag
                if missing:
                    _leave_out(result, row, x, b, np.uint8(own | OUTSIDE))
                    return 0
            elif (flag or missing) and abs(weight) >= least:
                others |= (flag & ~OUTSIDE) | NEAR
            if missing:
                lacking |= weight != 0.0
            else:
                value += weight * tap
                if source.variance.size:
                    spread += weight * weight * source.variance[y0 + r, x0 + k, b]
    result.flags[row, x, b] = own | others
    if lacking:
        result.flags[row, x, b] |= NEAR
        value, spread = _linear(source, (x0, columns, y0, rows), at, b)
    if always or lacking:
        result.values[row, x, b] = value
        if result.variance.size:
            result.variance[row, x, b] = spread
    return 0


@njit
def _linear(source, box, at, b):
    """Return value and variance by linear interpolation from the taps that are there."""
    (x0, columns, y0, rows), (px, py, wide_x, wide_y) = box, at
    value = spread = total = 0.0
    for r in range(y0, y0 + rows):
        for k in range(x0, x0 + columns):
            tap = float(source.values[r, k, b])
            if not np.isfinite(tap) or (source.flags.size and source.flags[r, k, b] & OUTSIDE):
                continue
            tent = max(0.0, 1.0 - abs(k - px) / wide_x)
            tent *= max(0.0, 1.0 - abs(r + source.top - py) / wide_y)
            total += tent
            value += tent * tap
            if source.variance.size:
                spread += tent * tent * source.variance[r, k, b]
    return value / total, spread / (total * total)


@njit
def _pass_flags(flags, out, box, near, spot, weights):
    """Hand on the flags of all bands of a pixel, as `_gather` does where no tap is OUTSIDE."""
    (x0, columns, y0, rows), (row, x), (u, v) = box, spot, weights[:2]
    least = LIGHTEST * _largest(u, columns) * _largest(v, rows)
    for r in range(rows):
        for k in range(columns):
            if abs(v[r] * u[k]) >= least and (x0 + k, y0 + r) != near:
                for b in range(flags.shape[2]):
                    out[row, x, b] |= flags[y0 + r, x0 + k, b]
    for b in range(flags.shape[2]):
        mark = out[row, x, b]
        out[row, x, b] = mark | flags[near[1], near[0], b] | (NEAR if mark else np.uint8(0))


@njit(forceinline=True)
def _sum_cubic(plane, x, y, weights, out, spot):
    """Sum the 4 x 4 taps about (x, y), all bands of a pixel."""
    u0, u1, u2, u3, v0, v1, v2, v3 = weights
    x, y = x - 1, y - 1
    for k in range(plane.shape[2]):
        a = u0 * F(plane[y, x, k]) + u1 * F(plane[y, x + 1, k])
        a += u2 * F(plane[y, x + 2, k]) + u3 * F(plane[y, x + 3, k])
        b = u0 * F(plane[y + 1, x, k]) + u1 * F(plane[y + 1, x + 1, k])
        b += u2 * F(plane[y + 1, x + 2, k]) + u3 * F(plane[y + 1, x + 3, k])
        c = u0 * F(plane[y + 2, x, k]) + u1 * F(plane[y + 2, x + 1, k])
        c += u2 * F(plane[y + 2, x + 2, k]) + u3 * F(plane[y + 2, x + 3, k])
        d = u0 * F(plane[y + 3, x, k]) + u1 * F(plane[y + 3, x + 1, k])
        d += u2 * F(plane[y + 3, x + 2, k]) + u3 * F(plane[y + 3, x + 3, k])
        out[spot[0], spot[1], k] = (v0 * a + v1 * b) + (v2 * c + v3 * d)


@njit(forceinline=True)
def _sum_box(plane, box, weights, squared, out, spot):
    """Sum the taps of a box of any size, all bands of a pixel, by weights or `squared` ones."""
    (left, columns, top, rows), (row, x) = box, spot
    u, v, sums = weights
    if plane.shape[2] == 1:
        total = 0.0
        for r in range(rows):
            for k in range(columns):
                weight = v[r] * u[k]
                weight = weight * weight if squared else weight
                total += weight * plane[top + r, left + k, 0]
        out[row, x, 0] = total
        return
    sums[:] = 0.0
    for r in range(rows):
        for k in range(columns):
            weight = v[r] * u[k]
            weight = weight * weight if squared else weight
            for b in range(plane.shape[2]):
                sums[b] += weight * plane[top + r, left + k, b]
    for b in range(plane.shape[2]):
        out[row, x, b] = sums[b]


@njit
def _leave_out_all(result, spot):
    """Write that there is nothing in any band of a pixel."""
    for b in range(result.values.shape[2]):
        _leave_out(result, spot[0], spot[1], b, OUTSIDE)


@njit
def _mark_pixel(source, result, at, spot, weights):
    """Hand flags on to all bands of a pixel, and do those with care that lack a tap; values are there."""
    x0, columns = _axis(at[0], at[2], source.values.shape[1], weights[0])
    y0, rows = _axis(at[1], at[3], source.height, weights[1])
    y0 -= source.top
    suspect = np.uint8(0)
    if source.suspect.size:
        suspect = _any_suspect(source.suspect, x0, columns, y0, rows)
        if suspect and not suspect & OUTSIDE:
            box, near = (x0, columns, y0, rows), _nearest(at[0], at[1], source)
            _pass_flags(source.flags, result.flags, box, near, spot, weights)
    for b in range(source.values.shape[2]):
        not_finite = not np.isfinite(result.values[spot[0], spot[1], b])
        if not_finite or suspect & OUTSIDE:
            _gather(source, result, at, spot, b, not_finite, weights)


@njit(cache=True)
def resample_rows(start, stop, nodes, source, result):
    """Resample grid rows `start` to `stop` of all bands through the map of `nodes`.

    Returns how many pixels need a source row that is not held.
    """
    values, variance, out, noise = source.values, source.variance, result.values, result.variance
    suspect, top, inner = source.suspect, source.top, _inner(source)
    u, v, sums = _scratch(nodes.widest, values.shape[2])
    part, absent = np.empty(nodes.table.shape[2]), 0
    # Segment by segment from top to bottom: what the rows share of the source stays in the cache.
    for x0 in range(0, nodes.width, nodes.segment):
        for y in range(start, stop):
            _mix(nodes, y, x0 // nodes.segment, part)
            wide_x, wide_y = _widths(part, nodes.widest)
            row = y - result.first
            for x in range(x0, min(x0 + nodes.segment, nodes.width)):
                px, py = _follow(part, float(x - x0))
                fx, fy, marks = int(px), int(py) - top, np.uint8(0)
                if wide_x == wide_y == 1.0 and _is_inner(fx, fy, inner):
                    across, down = _cubic(px - fx), _cubic(py - top - fy)
                    _sum_cubic(values, fx, fy, (*across, *down), out, (row, x))
                    if noise.size:
                        squares = (*_squares(across), *_squares(down))
                        _sum_cubic(variance, fx, fy, squares, noise, (row, x))
                    if suspect.size:
                        marks = _any_suspect(suspect, fx - 1, 4, fy - 1, 4)
                elif _inside(px, py, source):
                    left, columns = _axis(px, wide_x, values.shape[1], u)
                    high, rows = _axis(py, wide_y, source.height, v)
                    high -= top
                    if high < 0 or high + rows > values.shape[0]:
                        absent += 1
                        continue
                    box = left, columns, high, rows
                    _sum_box(values, box, (u, v, sums), False, out, (row, x))
                    if noise.size:
                        _sum_box(variance, box, (u, v, sums), True, noise, (row, x))
                    if suspect.size:
                        marks = _any_suspect(suspect, *box)
                else:
                    _leave_out_all(result, (row, x))
                    continue
                care = marks != 0
                for b in range(values.shape[2]):
                    care |= out[row, x, b] - out[row, x, b] != 0
                if care:
                    at = px, py, wide_x, wide_y
                    _mark_pixel(source, result, at, (row, x), (u, v, sums))
    return absent

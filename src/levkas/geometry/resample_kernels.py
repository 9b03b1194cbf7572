"""Compiled loops of resampling: Keys's cubic convolution, bands innermost.

A pixel of the grid is interpolated from a box of source pixels, the *taps*, whose weights are computed once for all
bands. Weights are float64, sums float32 (float64 where the kernel is widened) in one order and without fastmath, so
that a value depends on nothing but its taps. Flags and pixels that are not there take the slow path, `_with_care`.

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

    `suspect`, (rows, width): flags that any band of a pixel has. The first row held is row `top` of an image of
    `height` rows.
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

    `table` is (rows, segments, 8 or 10): coefficients of 1, t, t², t³ of x, then of y, t in px from the segment's
    start; then, where kernels are widened, how many times along x and y, never more than `widest`. Its first and last
    row belong to those of the grid of (`height`, `width`) px. With `exact` there is a row and a segment for each
    pixel, rows from `first` on.
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


# --- places and weights -----------------------------------------------------------------------


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
def _weigh(place, scale, first, count, u):
    """Write the weights of the taps of one axis to `u`; the kernel is `scale` times as wide.

    They are brought to sum 1, and to a centre of weight at the place by a slope under a tent: exact on a ramp, also
    where the edge of the image cuts taps off.
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
    """Write the weights of one place on one axis; return the first tap in the image and how many there are."""
    first = max(floor(place - 2.0 * scale) + 1, 0)
    count = min(floor(place + 2.0 * scale), size - 1) + 1 - first
    if scale == 1.0 and count == 4:
        u[0], u[1], u[2], u[3] = _cubic(place - first - 1.0)
    else:
        _weigh(place, scale, first, count, u)
    return first, count


# --- sums of taps -----------------------------------------------------------------------------


@njit(forceinline=True)
def _squares(u):
    return u[0] * u[0], u[1] * u[1], u[2] * u[2], u[3] * u[3]


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


# --- flags, and pixels that are not there -----------------------------------------------------


@njit(forceinline=True)
def _any_suspect(suspect, box):
    """Return the flags that pixels of a box have in any band."""
    left, columns, top, rows = box
    found = np.uint8(0)
    for r in range(top, top + rows):
        for c in range(left, left + columns):
            found |= suspect[r, c]
    return found


@njit
def _leave_out(result, row, x, b, flag):
    """Write that there is nothing."""
    result.values[row, x, b] = np.nan
    result.flags[row, x, b] = flag
    if result.variance.size:
        result.variance[row, x, b] = np.nan


@njit
def _tap(source, r, k, b):
    """Return value and flag of a tap, and whether it is not there."""
    value = float(source.values[r, k, b])
    flag = source.flags[r, k, b] if source.flags.size else np.uint8(0)
    return value, flag, not np.isfinite(value) or flag & OUTSIDE != 0


@njit
def _pass_flags(flags, out, box, near, least, spot, weights):
    """Hand on the flags of all bands of a pixel, where no tap is OUTSIDE."""
    (x0, columns, y0, rows), (row, x), (u, v) = box, spot, weights[:2]
    for r in range(rows):
        for k in range(columns):
            if abs(v[r] * u[k]) >= least and (x0 + k, y0 + r) != near:
                for b in range(flags.shape[2]):
                    out[row, x, b] |= flags[y0 + r, x0 + k, b]
    for b in range(flags.shape[2]):
        mark = out[row, x, b]
        out[row, x, b] = mark | flags[near[1], near[0], b] | (NEAR if mark else np.uint8(0))


@njit
def _gather(source, result, box, near, least, at, spot, weights):
    """Resample a band, the last of `spot`, linearly where it lacks a tap; else its sum stays, if it is finite."""
    (x0, columns, y0, rows), (row, x, b), (u, v) = box, spot, weights[:2]
    _, own, gone = _tap(source, near[1], near[0], b)
    if gone:
        _leave_out(result, row, x, b, np.uint8(own | OUTSIDE))
        return
    value = spread = 0.0
    others, lacking = np.uint8(0), False
    for r in range(rows):
        for k in range(columns):
            weight = v[r] * u[k]
            tap, flag, missing = _tap(source, y0 + r, x0 + k, b)
            heavy = abs(weight) >= least and (x0 + k, y0 + r) != near
            if heavy and (flag or missing):
                others |= (flag & ~OUTSIDE) | NEAR
            if missing:
                lacking |= weight != 0.0
                continue
            value += weight * tap
            if source.variance.size:
                spread += weight * weight * source.variance[y0 + r, x0 + k, b]
    result.flags[row, x, b] = own | others
    if lacking:
        result.flags[row, x, b] |= NEAR
        value, spread = _linear(source, box, at, b)
    if lacking or not np.isfinite(result.values[row, x, b]):
        result.values[row, x, b] = value
        if result.variance.size:
            result.variance[row, x, b] = spread


@njit
def _with_care(source, result, at, spot, weights, suspect):
    """Hand flags on to all bands of a pixel, and do those with care that lack a tap; the sums of all taps are there.

    `at`: place x, y and how many times the kernel is widened along either; `spot`: row and column of the result;
    `suspect`: flags that the taps have in any band.
    """
    (px, py, wide_x, wide_y), (row, x), (u, v) = at, spot, weights[:2]
    x0, columns = _axis(px, wide_x, source.values.shape[1], u)
    y0, rows = _axis(py, wide_y, source.height, v)
    box = x0, columns, y0 - source.top, rows
    column = min(max(floor(px + 0.5), 0), source.values.shape[1] - 1)
    near = column, min(max(floor(py + 0.5), 0), source.height - 1) - source.top
    least = LIGHTEST * np.abs(u[:columns]).max() * np.abs(v[:rows]).max()
    if suspect and not suspect & OUTSIDE:
        _pass_flags(source.flags, result.flags, box, near, least, spot, weights)
    for b in range(source.values.shape[2]):
        if suspect & OUTSIDE or not np.isfinite(result.values[row, x, b]):
            _gather(source, result, box, near, least, at, (row, x, b), weights)


@njit
def _linear(source, box, at, b):
    """Return value and variance by linear interpolation from the taps that are there."""
    (x0, columns, y0, rows), (px, py, wide_x, wide_y) = box, at
    value = spread = total = 0.0
    for r in range(y0, y0 + rows):
        for k in range(x0, x0 + columns):
            tap, _, missing = _tap(source, r, k, b)
            if missing:
                continue
            tent = max(0.0, 1.0 - abs(k - px) / wide_x)
            tent *= max(0.0, 1.0 - abs(r + source.top - py) / wide_y)
            total += tent
            value += tent * tap
            if source.variance.size:
                spread += tent * tent * source.variance[r, k, b]
    return value / total, spread / (total * total)


@njit(cache=True)
def resample_rows(start, stop, nodes, source, result):
    """Resample grid rows `start` to `stop` of all bands through the map of `nodes`.

    Returns how many pixels need a source row that is not held.
    """
    values, variance, out, noise = source.values, source.variance, result.values, result.variance
    suspect, top, (held, width) = source.suspect, source.top, values.shape[:2]
    taps, part, absent = 8 + int(6 * nodes.widest), np.empty(nodes.table.shape[2]), 0
    u, v, sums = np.empty(taps), np.empty(taps), np.empty(values.shape[2])
    high, low = max(1, 1 - top), min(held, source.height - top) - 2
    wide_x = wide_y = 1.0
    # Segment by segment from top to bottom: what the rows share of the source stays in the cache.
    for x0 in range(0, nodes.width, nodes.segment):
        for y in range(start, stop):
            _mix(nodes, y, x0 // nodes.segment, part)
            if len(part) > 8:
                wide_x = min(max(1.0, part[8]), nodes.widest)
                wide_y = min(max(1.0, part[9]), nodes.widest)
            for x in range(x0, min(x0 + nodes.segment, nodes.width)):
                px, py = _follow(part, float(x - x0))
                spot, fx, fy = (y - result.first, x), int(px), int(py) - top
                if wide_x == wide_y == 1.0 and 1 <= fx < width - 2 and high <= fy < low:
                    across, down = _cubic(px - fx), _cubic(py - top - fy)
                    box = fx - 1, 4, fy - 1, 4
                    _sum_cubic(values, fx, fy, (*across, *down), out, spot)
                    if noise.size:
                        squares = (*_squares(across), *_squares(down))
                        _sum_cubic(variance, fx, fy, squares, noise, spot)
                elif -0.5 <= px <= width - 0.5 and -0.5 <= py <= source.height - 0.5:
                    left, columns = _axis(px, wide_x, width, u)
                    first, rows = _axis(py, wide_y, source.height, v)
                    box = left, columns, first - top, rows
                    if box[2] < 0 or box[2] + rows > held:
                        absent += 1
                        continue
                    _sum_box(values, box, (u, v, sums), False, out, spot)
                    if noise.size:
                        _sum_box(variance, box, (u, v, sums), True, noise, spot)
                else:
                    for b in range(values.shape[2]):
                        _leave_out(result, spot[0], x, b, OUTSIDE)
                    continue
                marks = _any_suspect(suspect, box) if suspect.size else np.uint8(0)
                care = marks != 0
                for b in range(values.shape[2]):
                    care |= out[spot[0], x, b] - out[spot[0], x, b] != 0
                if care:
                    at = px, py, wide_x, wide_y
                    _with_care(source, result, at, spot, (u, v, sums), marks)
    return absent

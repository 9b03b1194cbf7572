"""The loops of resampling with a kernel wider than a pixel of the source, or of another kind.

Like those of `warping_kernels`, whose words on sums and on numba's cache hold here too: sixteen bands
that stand in one pixel are done together, each with its own weights, and each comes out with the bits
it has alone. For that, taps beyond a band's own reach weigh nothing, exactly.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
from numba import njit

from levkas.lanes import (
    WIDTH,
    constant,
    equal,
    fma,
    lane,
    larger,
    least,
    load,
    look,
    lowest,
    most,
    put,
    size,
    smaller,
    splat,
    store,
    store_some,
    whole,
)
from levkas.taps import (
    CUBIC,
    LANCZOS,
    LINEAR,
    NODES,
    F,
    any_suspect,
    gather,
    inside,
    kernel_value,
    lagrange,
    leave_out,
    mix,
    pass_flags,
    place,
    run_along,
    split,
)
from levkas.taps import OUTSIDE as OUTSIDE

HELPERS = "ade58db30c45ad42"
EVERY = np.uint16(0xFFFF)
STRETCH = 16
"""Grid pixels side by side whose rows are done one after another; divides a segment, or is longer."""
LOBES = (F(2.0), F(3.0), F(1.0))
"""Reach of the kernels that `taps` counts, in taps."""


@njit
def weight_at(kind, distance, scratch):
    """Value of a kernel at sixteen distances, none below zero."""
    one = constant(distance, 1.0)
    if kind == LINEAR:
        return larger(one - distance, constant(distance, 0.0))
    if kind == CUBIC:
        # Each half is nought where the other one holds: no choice is made.
        near, two = smaller(distance, one), constant(distance, 2.0)
        far = larger(smaller(distance, two), one)
        inner = fma(constant(near, 1.5), near, constant(near, -2.5))
        outer = fma(constant(far, -0.5), far, constant(far, 2.5))
        outer = fma(fma(outer, far, constant(far, -4.0)), far, two)
        return fma(inner, near * near, one) + outer
    store(scratch, 0, distance)
    for k in range(WIDTH):
        put(scratch, k, F(kernel_value(LANCZOS, look(scratch, k))))
    return load(scratch, 0)


@njit
def weigh_lanes(kind, first, count, rest, scale, reach, weights, scratch):
    """Write sixteen bands' weights of taps `first` to `first` + `count` about one pixel.

    `weigh_axis` for lanes: of sum 1, and brought to the place `rest` by a slope under a tent.
    """
    nothing, one = constant(rest, 0.0), constant(rest, 1.0)
    narrow, slope = one / scale, one / reach
    total = moment = tents = lean = square = nothing
    for i in range(count):
        d = constant(rest, float(first + i)) - rest
        weight = weight_at(kind, size(d) * narrow, scratch)
        tent = larger(one - size(d) * slope, nothing)
        total, moment = total + weight, fma(weight, d, moment)
        tents, lean, square = tents + tent, fma(tent, d, lean), fma(tent * d, d, square)
        store(weights, i * WIDTH, weight)
    middle = lean / tents
    shift = moment / total / larger(square - middle * lean, constant(rest, 1e-9))
    for i in range(count):
        d = constant(rest, float(first + i)) - rest
        tent = larger(one - size(d) * slope, nothing)
        store(weights, i * WIDTH, load(weights, i * WIDTH) / total - shift * tent * (d - middle))


@njit
def taps_of(pixel, rest, reach, length):
    """First tap and count of sixteen places about a pixel of an axis; none out of the frame."""
    first = max(pixel + int(least(whole(rest - reach))) + 1, 0)
    return first, min(pixel + int(most(whole(rest + reach))), length - 1) - first + 1


@njit
def copied(source, at, wide, step, columns, rows):
    """Copy taps of sixteen bands, nought beyond the end of the source."""
    copy = np.zeros(rows * columns * WIDTH, source.dtype)
    for r in range(rows):
        for k in range(columns):
            start = at + r * wide + k * step
            for b in range(min(WIDTH, source.size - start)):
                copy[(r * columns + k) * WIDTH + b] = source[start + b]
    return copy


@njit
def sum_box(source, at, wide, step, c, u, v, columns, rows):
    """Sum taps of sixteen bands, as differences to `c`, weights of each in `u` and `v`."""
    total = constant(c, 0.0)
    for r in range(rows):
        line, p = constant(c, 0.0), at + r * wide
        for k in range(columns):
            line = fma(load(u, k * WIDTH), load(source, p) - c, line)
            p += step
        total = fma(load(v, r * WIDTH), line, total)
    return total + c


@njit
def sum_taps(source, at, wide, step, near, u, v, columns, rows):
    """Sum taps of sixteen bands from flat index `at` on, anywhere in the source.

    They are summed as differences to the tap at `near`; below zero, as they are.
    """
    if at + (rows - 1) * wide + (columns - 1) * step + WIDTH > source.size:
        box = copied(source, at, wide, step, columns, rows)
        c = constant(load(box, 0), 0.0)
        if near >= 0:
            r, k = (near - at) // wide, (near - at) % wide // step
            c = load(box, (r * columns + k) * WIDTH)
        return sum_box(box, 0, columns * WIDTH, WIDTH, c, u, v, columns, rows)
    c = constant(load(source, at), 0.0)
    if near >= 0:
        c = load(source, near)
    return sum_box(source, at, wide, step, c, u, v, columns, rows)


@njit
def sum_all(source, at, wide, step, near, u, v, columns, rows, sums, n):
    """Do as `sum_taps` for all of `n` bands, sixteen or more, that share a place.

    Row by row, for the taps of one row lie side by side: those of all rows at once would fall on a
    few places of the cache. `sums` holds blocks of sixteen, the last ones those before `n`.
    """
    nothing = splat(F(0.0))
    for r in range(rows):
        share = load(v, r * WIDTH)
        for block in range(0, n, WIDTH):
            s, c, line = min(block, n - WIDTH), nothing, nothing
            p = at + s + r * wide
            if near >= 0:
                c = load(source, near + s)
                for k in range(columns):
                    line = fma(splat(look(u, k * WIDTH)), load(source, p) - c, line)
                    p += step
            else:
                for k in range(columns):
                    line = fma(splat(look(u, k * WIDTH)), load(source, p), line)
                    p += step
            total = fma(share, line, nothing if r == 0 else load(sums, block))
            store(sums, block, total + c if r == rows - 1 else total)


@njit
def write(out, to, lanes, chosen):
    """Write the chosen ones of sixteen bands."""
    if chosen == EVERY:
        store(out, to, lanes)
    else:
        store_some(out, to, lanes, chosen)


@njit
def square(weights, count, squares):
    """Write the squares of the weights of `count` taps."""
    for k in range(0, count * WIDTH, WIDTH):
        store(squares, k, load(weights, k) * load(weights, k))


@njit
def not_finite(lanes):
    """Tell which of sixteen numbers are infinite or none."""
    rest = lanes - lanes
    return np.uint16(~equal(rest, constant(rest, 0.0)))


@njit
def put_alone(planes, result, frame, kind, spot, wide_x, wide_y, b, to, weights):
    """Write value and variance of one band, no tap taken that is out of its reach.

    Returns 1 where the value is not finite.
    """
    px, rx, py, ry = spot
    step, wide = frame.bands, frame.width * frame.bands
    scales, lobes = (splat(F(wide_x)), splat(F(wide_y))), splat(F(LOBES[kind]))
    (u, v, uu, vv), spare, one = weights, np.empty(WIDTH, np.float32), np.uint16(1)
    rest, scale, reach = splat(F(rx)), scales[0], scales[0] * lobes
    left, columns = taps_of(px, rest, reach, frame.width)
    weigh_lanes(kind, left - px, columns, rest, scale, reach, u, spare)
    rest, scale, reach = splat(F(ry)), scales[1], scales[1] * lobes
    above, lines = taps_of(py, rest, reach, frame.height)
    weigh_lanes(kind, above - py, lines, rest, scale, reach, v, spare)
    at = (above - frame.top) * wide + left * step + b
    near = at + (py - above) * wide + (px - left) * step
    values = sum_taps(planes.values, at, wide, step, near, u, v, columns, lines)
    write(result.values, to, values, one)
    if planes.variance.size:
        square(u, columns, uu)
        square(v, lines, vv)
        values_ = sum_taps(planes.variance, at, wide, step, -1, uu, vv, columns, lines)
        write(result.variance, to, values_, one)
    return not_finite(values) & one


@njit
def settle(planes, result, frame, kind, spot, wide_x, wide_y, b, to, strange, weights, scratch):
    """See to one band of one pixel: at the edge, with flags about it, or `strange`.

    Returns 1 where a tap is not in memory.
    """
    if not inside(spot, frame):
        leave_out(planes, result, to, OUTSIDE)
        return 0
    if 0 <= spot[0] < frame.width - 1 and 0 <= spot[2] < frame.height - 1:
        if strange:
            # What is not there may be beyond this band's reach, and in that of its neighbours.
            strange = put_alone(planes, result, frame, kind, spot, wide_x, wide_y, b, to, weights)
        if not strange and (
            planes.suspect.size == 0
            or pass_flags(planes, result, frame, kind, spot, wide_x, wide_y, b, 1, to, scratch)
        ):
            return 0
    return gather(planes, result, frame, kind, spot, wide_x, wide_y, b, to, True, scratch)


@njit(cache=True, nogil=True)
def wide_rows(start, stop, nodes, planes, frame, result, first, count, kind, widest):
    """Do as `cubic_rows` with a kernel of any `kind`, as wide as a grid pixel, `widest` at most."""
    shared = nodes.table.ndim == 3
    rows, segments, channels = nodes.table.shape[:3]
    maps = nodes.table.size // (rows * segments * channels)
    length, table = nodes.segment, nodes.table.reshape(-1)
    # Arrays taken out of their tuples here cost no reference count in the loops.
    source, noise, suspect = planes.values, planes.variance, planes.suspect
    out, out_noise = result.values, result.variance
    step, wide = frame.bands, frame.width * frame.bands
    stride, part, nearby = segments * channels * maps, np.empty(channels * maps), np.empty(NODES)
    n = max(maps, WIDTH)
    curve, pixels = np.zeros(8 * n, np.float32), np.zeros(2 * n, np.float32)
    widths = np.ones(2 * n, np.float32)
    longest = (8 + int(6 * widest)) * WIDTH
    u, v, uu, vv = (
        np.empty(longest, np.float32),
        np.empty(longest, np.float32),
        np.empty(longest, np.float32),
        np.empty(longest, np.float32),
    )
    weights, lobes = (u, v, uu, vv), splat(F(LOBES[kind]))
    scratch, spare = np.empty((2, 8 + int(6 * widest))), np.empty(WIDTH, np.float32)
    known = EVERY if count >= WIDTH else np.uint16((1 << count) - 1)
    sums, spreads = np.empty(count + WIDTH, np.float32), np.empty(count + WIDTH, np.float32)
    together = shared and count >= WIDTH
    absent = 0
    # Some pixels of a segment from top to bottom: what the rows share of the source stays in the cache.
    stretch = min(STRETCH, length)
    for begin in range(0, nodes.width, stretch):
        x0 = begin - begin % length
        segment = x0 // length * part.size
        for y in range(start, stop):
            places, at = table, (y - nodes.first) * stride + segment
            if not nodes.exact:
                node = lagrange(y * ((rows - 1) / (nodes.height - 1)), rows, nearby)
                mix(table, node * stride + segment, stride, nearby, part)
                places, at = part, 0
            line = (y - result.first) * nodes.width * step + first
            corner = split(places, at, maps, curve, pixels)
            for axis in range(2):
                for m in range(maps):
                    wanted = look(places, at + (8 + axis) * maps + m)
                    put(widths, axis * n + m, F(min(max(1.0, wanted), widest)))
            for x in range(begin, min(begin + stretch, x0 + length, nodes.width)):
                t, to = F(x - x0), line + x * step
                laid = flagged = handed = False
                for block in range(0, count, WIDTH):
                    s = max(0, min(block, count - WIDTH))
                    m = 0 if shared else s
                    if shared:
                        px, rx, py, ry = place(curve, pixels, corner, 0, t)
                        rests_x, rests_y = splat(F(rx)), splat(F(ry))
                        scale_x, scale_y = splat(look(widths, 0)), splat(look(widths, n))
                        fx = fy = rests_x
                    else:
                        times = splat(t)
                        fx, rests_x = run_along(
                            load(curve, s),
                            load(curve, n + s),
                            load(curve, 2 * n + s),
                            load(curve, 3 * n + s),
                            times,
                        )
                        fy, rests_y = run_along(
                            load(curve, 4 * n + s),
                            load(curve, 5 * n + s),
                            load(curve, 6 * n + s),
                            load(curve, 7 * n + s),
                            times,
                        )
                        fx, fy = fx + load(pixels, s), fy + load(pixels, n + s)
                        scale_x, scale_y = load(widths, s), load(widths, n + s)
                    todo = known
                    while todo:
                        # Bands of one block that stand in one pixel are done together.
                        chosen = todo
                        if not shared:
                            b = lowest(todo)
                            kx, ky = lane(fx, b), lane(fy, b)
                            chosen = np.uint16(equal(fx, splat(kx)) & equal(fy, splat(ky)) & todo)
                            px, py = corner[0] + int(kx), corner[1] + int(ky)
                        todo = np.uint16(todo ^ chosen)
                        careful = strange = chosen
                        if 0 <= px < frame.width - 1 and 0 <= py < frame.height - 1:
                            if not laid:
                                reach_x, reach_y = scale_x * lobes, scale_y * lobes
                                left, columns = taps_of(px, rests_x, reach_x, frame.width)
                                above, lines = taps_of(py, rests_y, reach_y, frame.height)
                                weigh_lanes(
                                    kind, left - px, columns, rests_x, scale_x, reach_x, u, spare
                                )
                                weigh_lanes(
                                    kind, above - py, lines, rests_y, scale_y, reach_y, v, spare
                                )
                                if noise.size:
                                    square(u, columns, uu)
                                    square(v, lines, vv)
                            if above < frame.top or above + lines > frame.top + frame.held:
                                absent += 1
                                continue
                            corner_ = (above - frame.top) * wide + left * step + first + s
                            near = corner_ + (py - above) * wide + (px - left) * step
                            if together and not laid:
                                sum_all(
                                    source, corner_, wide, step, near, u, v, columns, lines,
                                    sums, count,
                                )  # fmt: skip
                                if noise.size:
                                    sum_all(
                                        noise, corner_, wide, step, -1, uu, vv, columns, lines,
                                        spreads, count,
                                    )  # fmt: skip
                            if suspect.size and not laid:
                                flagged = (
                                    any_suspect(suspect, frame, left, above, columns, lines) != 0
                                )
                                handed = shared and flagged and pass_flags(
                                    planes, result, frame, kind, (px, rx, py, ry), look(widths, 0),
                                    look(widths, n), first, count, line + x * step, scratch,
                                )  # fmt: skip
                            laid = shared
                            if together:
                                values = load(sums, block)
                            else:
                                values = sum_taps(
                                    source, corner_, wide, step, near, u, v, columns, lines
                                )
                            write(out, to + s, values, chosen)
                            if noise.size:
                                if together:
                                    spread = load(spreads, block)
                                else:
                                    spread = sum_taps(
                                        noise, corner_, wide, step, -1, uu, vv, columns, lines
                                    )
                                write(out_noise, to + s, spread, chosen)
                            strange = np.uint16(chosen & not_finite(values))
                            careful = strange
                            if flagged and not handed:
                                # What is not there for one band may be there for these sixteen.
                                spot = (px, rx, py, ry)
                                if strange or not shared or not pass_flags(
                                    planes, result, frame, kind, spot, look(widths, 0),
                                    look(widths, n), first + s, min(WIDTH, count), to + s, scratch,
                                ):  # fmt: skip
                                    careful = chosen
                        while careful:
                            b = lowest(careful)
                            careful = np.uint16(careful & (careful - 1))
                            k = 0 if shared else s + b
                            absent += settle(
                                planes, result, frame, kind, place(curve, pixels, corner, k, t),
                                look(widths, k), look(widths, n + k), first + s + b, to + s + b,
                                strange >> b & 1, weights, scratch,
                            )  # fmt: skip
    return absent

"""The loops of resampling over rows, pixels and bands.

Numba's cache notices a change of the file that a kernel stands in, not of what it calls elsewhere:
`HELPERS` is the digest of the other files, and a test sees to it that it changes with them.

Sums of the cubic kernel are of float32 differences to the pixel below left of the place, in one
order: near values differ by exact numbers, so that ramps come out as exactly as with float64 sums,
at twice the speed. A result depends on nothing but its own taps. No fastmath.
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
    load,
    look,
    lowest,
    put,
    splat,
    store,
    store_some,
)
from levkas.taps import (
    CUBIC,
    NODES,
    OUTSIDE,
    F,
    cubic,
    gather,
    inside,
    lagrange,
    leave_out,
    mix,
    pass_flags,
    place,
    run_along,
    split,
    within,
)
from levkas.taps import Frame as Frame
from levkas.taps import Nodes as Nodes
from levkas.taps import Planes as Planes
from levkas.taps import Result as Result

HELPERS = "ade58db30c45ad42"
EVERY = np.uint16(0xFFFF)


@njit(cache=True, nogil=True)
def find_suspects(start, stop, planes, frame):
    """Note what flags the bands of a pixel have, in rows `start` to `stop` in memory."""
    flags, suspect = planes.flags, planes.suspect
    for p in range(start * frame.width, stop * frame.width):
        found = np.uint8(0)
        for b in range(p * frame.bands, (p + 1) * frame.bands):
            found |= look(flags, b)
        put(suspect, p, found)


@njit(cache=True, nogil=True)
def find_around(start, stop, planes, frame):
    """Note around which pixels one of the 4 x 4 taps is suspect."""
    for y in range(start, stop):
        for x in range(frame.width):
            found = False
            for r in range(max(y - 1, 0), min(y + 3, frame.held)):
                for c in range(max(x - 1, 0), min(x + 3, frame.width)):
                    found |= planes.suspect[r * frame.width + c] != 0
            planes.around[y * frame.width + x] = found


@njit
def across(source, q, step, c, u):
    """Sum four taps of one row of the source, as differences to `c`."""
    total = u[0] * (load(source, q - step) - c)
    total = fma(u[1], load(source, q) - c, total)
    total = fma(u[2], load(source, q + step) - c, total)
    return fma(u[3], load(source, q + 2 * step) - c, total)


@njit
def blend(source, at, wide, step, c, u, v):
    """Sum 4 x 4 taps about flat index `at`, weights u along x and v along y; differences to `c`."""
    total = v[0] * across(source, at - wide, step, c, u)
    total = fma(v[1], across(source, at, step, c, u), total)
    total = fma(v[2], across(source, at + wide, step, c, u), total)
    return fma(v[3], across(source, at + 2 * wide, step, c, u), total) + c


@njit
def blend_values(source, at, wide, step, u, v):
    """Interpolate sixteen bands."""
    return blend(source, at, wide, step, load(source, at), u, v)


@njit
def blend_variances(source, at, wide, step, u, v):
    """Add up sixteen bands' variances with squared weights."""
    u = (u[0] * u[0], u[1] * u[1], u[2] * u[2], u[3] * u[3])
    v = (v[0] * v[0], v[1] * v[1], v[2] * v[2], v[3] * v[3])
    return blend(source, at, wide, step, constant(u[0], 0.0), u, v)


@njit
def last_taps(source, at, wide, step):
    """Copy 4 x 4 taps of sixteen bands, nought beyond the end of the source."""
    copy = np.zeros(16 * WIDTH, source.dtype)
    for r in range(4):
        for k in range(4):
            start = at + (r - 1) * wide + (k - 1) * step
            for b in range(min(WIDTH, source.size - start)):
                copy[(4 * r + k) * WIDTH + b] = source[start + b]
    return copy


@njit
def write(out, to, lanes, chosen):
    """Write the chosen ones of sixteen bands."""
    if chosen == EVERY:
        store(out, to, lanes)
    else:
        store_some(out, to, lanes, chosen)


@njit
def spread_out(u):
    """Turn the weights of one place into lanes."""
    return splat(u[0]), splat(u[1]), splat(u[2]), splat(u[3])


@njit(cache=True, nogil=True)
def cubic_rows(start, stop, nodes, planes, frame, result, first, count):
    """Resample grid rows `start` to `stop` of `count` bands from `first` on, 4 x 4 taps each.

    Returns how often a tap was in the frame, but not in memory.
    """
    # A constant to the compiler: one map for all bands and a map for each are kernels of their own.
    shared = nodes.table.ndim == 3
    rows, segments, channels = nodes.table.shape[:3]
    maps = nodes.table.size // (rows * segments * channels)
    length, table = nodes.segment, nodes.table.reshape(-1)
    # Arrays taken out of their tuples here cost no reference count in the loops.
    source, noise, around = planes.values, planes.variance, planes.around
    out, out_noise = result.values, result.variance
    step, wide = frame.bands, frame.width * frame.bands
    stride, part, weights = segments * channels * maps, np.empty(channels * maps), np.empty(NODES)
    n = max(maps, WIDTH)
    curve, pixels = np.zeros(8 * n, np.float32), np.zeros(2 * n, np.float32)
    scratch = np.empty((2, 8))
    known = EVERY if count >= WIDTH else np.uint16((1 << count) - 1)
    safe = source.size - 2 * wide - 2 * step - WIDTH
    absent = 0
    # Segment by segment from top to bottom: what the rows share of the source stays in the cache.
    for x0 in range(0, nodes.width, length):
        segment = x0 // length * part.size
        for y in range(start, stop):
            places, at = table, (y - nodes.first) * stride + segment
            if not nodes.exact:
                node = lagrange(y * ((rows - 1) / (nodes.height - 1)), rows, weights)
                mix(table, node * stride + segment, stride, weights, part)
                places, at = part, 0
            line = (y - result.first) * nodes.width * step + first
            corner = split(places, at, maps, curve, pixels)
            for x in range(x0, min(x0 + length, nodes.width)):
                t, to, handed = F(x - x0), line + x * step, False
                if shared:
                    px, rx, py, ry = place(curve, pixels, corner, 0, t)
                    u, v = spread_out(cubic(F(rx))), spread_out(cubic(F(ry)))
                    if around.size and within(px, py, frame):
                        handed = around[(py - frame.top) * frame.width + px] and pass_flags(
                            planes, result, frame, CUBIC, (px, rx, py, ry), 1.0, 1.0, first,
                            count, to, scratch,
                        )  # fmt: skip
                for block in range(0, count, WIDTH):
                    s = max(0, min(block, count - WIDTH))
                    todo = known
                    if not shared:
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
                        u, v = cubic(rests_x), cubic(rests_y)
                    while todo:
                        # Bands of one block that stand in one pixel are done together.
                        chosen = todo
                        if not shared:
                            b = lowest(todo)
                            kx, ky = lane(fx, b), lane(fy, b)
                            chosen = np.uint16(equal(fx, splat(kx)) & equal(fy, splat(ky)) & todo)
                            px, py = corner[0] + int(kx), corner[1] + int(ky)
                        todo = np.uint16(todo ^ chosen)
                        careful, strange = chosen, np.uint16(0)
                        if within(px, py, frame):
                            pixel = (py - frame.top) * frame.width + px
                            at = pixel * step + first + s
                            if at <= safe:
                                values = blend_values(source, at, wide, step, u, v)
                            else:
                                values = blend_values(
                                    last_taps(source, at, wide, step),
                                    5 * WIDTH,
                                    4 * WIDTH,
                                    WIDTH,
                                    u,
                                    v,
                                )
                            write(out, to + s, values, chosen)
                            if noise.size:
                                if at <= safe:
                                    values_ = blend_variances(noise, at, wide, step, u, v)
                                else:
                                    values_ = blend_variances(
                                        last_taps(noise, at, wide, step),
                                        5 * WIDTH,
                                        4 * WIDTH,
                                        WIDTH,
                                        u,
                                        v,
                                    )
                                write(out_noise, to + s, values_, chosen)
                            difference = values - values
                            strange = np.uint16(
                                chosen & ~equal(difference, constant(difference, 0.0))
                            )
                            if around.size == 0 or around[pixel] == 0 or handed:
                                careful = strange
                            elif shared and strange == 0:
                                # What is not there for one band may be there for these sixteen.
                                spot = (px, rx, py, ry)
                                if pass_flags(
                                    planes, result, frame, CUBIC, spot, 1.0, 1.0, first + s,
                                    min(WIDTH, count), to + s, scratch,
                                ):  # fmt: skip
                                    careful = strange
                        while careful:
                            b = lowest(careful)
                            careful = np.uint16(careful & (careful - 1))
                            spot = place(curve, pixels, corner, 0 if shared else s + b, t)
                            if inside(spot, frame):
                                always = (strange >> b) & 1 != 0
                                absent += gather(
                                    planes,
                                    result,
                                    frame,
                                    CUBIC,
                                    spot,
                                    1.0,
                                    1.0,
                                    first + s + b,
                                    to + s + b,
                                    always,
                                    scratch,
                                )
                            else:
                                leave_out(planes, result, to + s + b, OUTSIDE)
    return absent


@njit
def narrow(u, count, power, weights):
    """Write `count` weights, or their squares, as float32."""
    for k in range(count):
        put(weights, k, F(u[k] * u[k]) if power == 2 else F(u[k]))

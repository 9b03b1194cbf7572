"""Compiled loop of the displacement of lines: every part of every row registered by Gauss-Newton steps of its own."""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit
from levkas.registration.local_shifts_kernel import spline_slopes, spline_weights

#: A step shorter than this, px, is the last.
CONVERGED_PX = 0.02
#: Where a part that is lost from 0 is begun, px: steps along a line of fine detail reach 2 px.
STARTS_PX = ((2, 0), (-2, 0), (0, 2), (0, -2), (4, 0), (-4, 0), (0, 4), (0, -4))
#: Least squared correlation of a part that was begun there.
FOUND = 0.5


@njit(cache=True)
def register_rows(start, stop, pictures, edges, limits, sizes, found):  # type: ignore[no-untyped-def]
    """Fill shift and information, (rows, parts, 2), of rows that show enough; zeros elsewhere.

    `pictures` are lines and scene, `limits` the least and the most samples of a part and the steps, `sizes` the
    prior's sigma and the largest shift, px.
    """
    most_samples = limits[1]
    width = pictures[0].shape[1]
    settings, work = (limits, sizes), ((np.empty(width), np.empty(width)), np.empty(11))
    one, best = np.empty(5), np.empty(5)
    for i in range(start, stop):
        for part in range(len(edges) - 1):
            # Of a wide part its middle is enough.
            more = max(0, edges[part + 1] - edges[part] - most_samples)
            span = (edges[part] + more // 2, edges[part + 1] - (more - more // 2))
            least = _register(pictures, i, span, (0.0, 0.0), settings, work, best)
            if least == -1.0:
                least = FOUND
                for x, y in STARTS_PX:
                    at = (float(x), float(y))
                    alike = _register(pictures, i, span, at, settings, work, one)
                    if alike > least:
                        least = alike
                        best[:] = one
            if least >= 0.0 and least != FOUND:
                # The information on either component where the other one is unknown.
                xx, xy, yy = best[2], best[3], best[4]
                found[0][i, part, 0], found[0][i, part, 1] = best[0], best[1]
                found[1][i, part, 0] = max(xx - xy * xy / max(yy, 1e-30), 0.0)
                found[1][i, part, 1] = max(yy - xy * xy / max(xx, 1e-30), 0.0)


@njit
def _register(pictures, i, span, start, settings, work, out):  # type: ignore[no-untyped-def]
    """Write the shift of a part of row i and its information, x y xx xy yy; return its squared correlation, -1 where it is lost, -2 of too few px."""
    ((least, _, rounds), (prior, most)), (buffers, s) = settings, work
    (dx, dy), length = start, 1.0
    for r in range(rounds + 1):
        _sum_line(pictures, i, span, (dx, dy), buffers, s)
        gain = s[6] / s[0] if s[0] > 0.0 else 0.0
        if not (s[10] >= least and gain > 0.0):
            return -1.0 if s[10] >= least or r > 0 else -2.0
        # The gain is eliminated: what is left of the slopes without the picture itself.
        scale = gain * gain * (s[10] - 3) / max(s[9] - gain * s[6], 1e-12)
        xx = (s[3] - s[1] * s[1] / s[0]) * scale
        xy = (s[4] - s[1] * s[2] / s[0]) * scale
        yy = (s[5] - s[2] * s[2] / s[0]) * scale
        if r == rounds or length < CONVERGED_PX:
            out[0], out[1], out[2], out[3], out[4] = dx, dy, xx, xy, yy
            return gain * s[6] / s[9]
        p = 1 / (prior * prior)
        bx = (s[7] / gain - s[1]) * scale - dx * p
        by = (s[8] / gain - s[2]) * scale - dy * p
        det = (xx + p) * (yy + p) - xy * xy
        ex, ey = ((yy + p) * bx - xy * by) / det, ((xx + p) * by - xy * bx) / det
        length = np.sqrt(ex * ex + ey * ey)
        shorter = 1 / max(length, 1.0)
        dx, dy = dx + ex * shorter, dy + ey * shorter
        if not (abs(dx) <= most and abs(dy) <= most):
            return -1.0
    return -1.0


@njit
def _sum_line(pictures, i, span, shift, buffers, s):  # type: ignore[no-untyped-def]
    """Sum products of scene p, its slopes x and y at row i + shift, and the line t: pp px py xx xy yy pt xt yt tt n."""
    (lines, scene), (line, slope), (low, high), (dx, dy) = pictures, buffers, span, shift
    height, width = scene.shape
    s[:] = 0.0
    x0, y0 = int(np.floor(dx)), int(np.floor(i + dy))
    if y0 < 1 or y0 >= height - 2:
        return
    u, v = spline_weights(dx - x0), spline_weights(i + dy - y0)
    du, dv = spline_slopes(dx - x0), spline_slopes(i + dy - y0)
    for j in range(max(low + x0 - 1, 0), min(high + x0 + 2, width)):
        a, b, c, d = scene[y0 - 1, j], scene[y0, j], scene[y0 + 1, j], scene[y0 + 2, j]
        line[j] = v[0] * a + v[1] * b + v[2] * c + v[3] * d
        slope[j] = dv[0] * a + dv[1] * b + dv[2] * c + dv[3] * d
    for j in range(max(low, 1 - x0), min(high, width - 2 - x0)):
        k, t = j + x0, lines[i, j]
        p = u[0] * line[k - 1] + u[1] * line[k] + u[2] * line[k + 1] + u[3] * line[k + 2]
        if not np.isfinite(p + t):
            continue
        x = du[0] * line[k - 1] + du[1] * line[k] + du[2] * line[k + 1] + du[3] * line[k + 2]
        y = u[0] * slope[k - 1] + u[1] * slope[k] + u[2] * slope[k + 1] + u[3] * slope[k + 2]
        s[0] += p * p
        s[1] += p * x
        s[2] += p * y
        s[3] += x * x
        s[4] += x * y
        s[5] += y * y
        s[6] += p * t
        s[7] += x * t
        s[8] += y * t
        s[9] += t * t
        s[10] += 1.0

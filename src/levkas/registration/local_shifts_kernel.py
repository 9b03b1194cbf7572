"""Compiled loops of the local shifts: a picture warped, sums over cells and windows of cells, gains and shift of each.

A pixel has a row of d = 3 + 3 k values: 1, u, v (its place in cells), k predictors, and their derivatives along x and along y.
What depends on these alone is summed once for every window, and freed of bias and ramp; a band then costs one row of sums a
cell. Only windows whose cells the band covers in part are summed anew.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit

#: Px between the nodes of a lattice on which maps are evaluated; between them they are interpolated linearly.
LATTICE_PX = 8
#: In place of the slot of a cell: a band shows nothing of it, or all that the predictors do.
EMPTY, WHOLE = -2, -1


@njit(inline="always")
def spline_weights(t):  # type: ignore[no-untyped-def]
    """Return the weights of the four samples about a place `t` behind the second, 0..1."""
    sixth, half, two = np.float32(1 / 6), np.float32(0.5), np.float32(2 / 3)
    s = np.float32(1.0) - t
    tt, ss = t * t, s * s
    return ss * s * sixth, two - tt + half * tt * t, two - ss + half * ss * s, tt * t * sixth


@njit(inline="always")
def spline_slopes(t):  # type: ignore[no-untyped-def]
    """Return the derivatives of `spline_weights` by the place."""
    s = np.float32(1.0) - t
    half, more = np.float32(0.5), np.float32(1.5)
    return -half * s * s, (more * t - 2) * t, (2 - more * s) * s, half * t * t


@njit(cache=True)
def warp_rows(start, stop, image, lattice, out):  # type: ignore[no-untyped-def]
    """Sample `image` through a cubic B-spline where `lattice`, (rows, columns, 2), puts the pixels of `out`."""
    h, w = image.shape
    last_row, last = lattice.shape[0] - 1, lattice.shape[1] - 1
    nodes = np.empty((last + 1, 2))
    for i in range(start, stop):
        row = i // LATTICE_PX
        share = i / LATTICE_PX - row
        for n in range(last + 1):
            for axis in range(2):
                low, high = lattice[row, n, axis], lattice[min(row + 1, last_row), n, axis]
                nodes[n, axis] = (1 - share) * low + share * high
        for j in range(out.shape[1]):
            n = j // LATTICE_PX
            m, along = min(n + 1, last), j / LATTICE_PX - n
            x = nodes[n, 0] + along * (nodes[m, 0] - nodes[n, 0])
            y = nodes[n, 1] + along * (nodes[m, 1] - nodes[n, 1])
            if not (x >= 1.0 and y >= 1.0 and x < w - 2.0 and y < h - 2.0):
                continue
            left, top = np.uintp(x), np.uintp(y)  # unsigned: no index counts from the end
            u0, u1, u2, u3 = spline_weights(np.float32(x - left))
            total, first = np.float32(0.0), left - np.uintp(1)
            for r, weight in enumerate(spline_weights(np.float32(y - top))):
                line = image[top + np.uintp(r) - np.uintp(1)]
                total += weight * (
                    (u0 * line[first] + u1 * line[left])
                    + (u2 * line[left + np.uintp(1)] + u3 * line[left + np.uintp(2)])
                )
            out[i, j] = total


@njit
def _fill_table(images, shown, r, c, cell, table):  # type: ignore[no-untyped-def]
    """Fill the values of the pixels of a cell, a column each; zeros where it is not `shown`, as the frame's rim never is."""
    k, h, w = images.shape
    half, left = np.float32(0.5), c * cell
    first, last = max(left - 1, 0), min(left + cell + 1, w)
    for y in range(cell):
        i, place = r * cell + y, y * cell
        table[0, place : place + cell] = 1.0
        table[2, place : place + cell] = (i + 0.5) / cell
        for x in range(cell):
            table[1, place + x] = (left + x + 0.5) / cell
        for a in range(k):
            above = images[a, max(i - 1, 0), left : left + cell]
            here, around = images[a, i, left : left + cell], images[a, i, first:last]
            below = images[a, min(i + 1, h - 1), left : left + cell]
            plain = table[3 + a, place : place + cell]
            along = table[3 + k + a, place + first + 1 - left : place + last - 1 - left]
            down = table[3 + 2 * k + a, place : place + cell]
            for x in range(cell):
                plain[x] = here[x]
                down[x] = (below[x] - above[x]) * half
            for x in range(len(along)):
                along[x] = (around[x + 2] - around[x]) * half
        for x in range(cell):
            if not shown[i, c * cell + x]:
                table[:, place + x] = 0.0


@njit(cache=True)
def sum_cells(start, stop, images, shown, cell, counts, sums):  # type: ignore[no-untyped-def]
    """Sum the products of the values of each cell with one another, (d, d), over its `counts` pixels that are shown."""
    table = np.empty((sums.shape[2], cell * cell))
    for r in range(start, stop):
        for c in range(counts.shape[1]):
            if counts[r, c] > 0:
                _fill_table(images, shown, r, c, cell, table)
                np.dot(table, table.T, sums[r, c])


@njit(cache=True)
def sum_band(start, stop, target, images, shown, cell, slots, out):  # type: ignore[no-untyped-def]
    """Sum the products of a band with the values of each cell, its own square last, and all products anew in the cells of `slots`.

    Predictors in single precision, as if the band had noise of 1e-7.
    """
    lines, partial = out
    d = lines.shape[2] - 1
    table, single = np.empty((d, cell * cell)), np.empty((d, cell * cell), np.float32)
    band, sums = np.empty(cell * cell, np.float32), np.empty(d, np.float32)
    for r in range(start, stop):
        for c in range(lines.shape[1]):
            if slots[r, c] == EMPTY:
                continue
            plain = across = down = square = 0.0
            for y in range(cell):
                i, row = r * cell + y, 0.0
                for x in range(cell):
                    j = c * cell + x
                    t = np.float64(target[i, j]) if shown[i, j] else 0.0
                    band[y * cell + x] = t
                    row, across, square = row + t, across + t * (j + 0.5), square + t * t
                plain, down = plain + row, down + row * (i + 0.5)
            _fill_table(images, shown, r, c, cell, single)
            np.dot(single, band, sums)
            lines[r, c, :d] = sums
            lines[r, c, 0], lines[r, c, 1], lines[r, c, 2] = plain, across / cell, down / cell
            lines[r, c, d] = square
            if slots[r, c] >= 0:
                _fill_table(images, shown, r, c, cell, table)
                np.dot(table, table.T, partial[slots[r, c]])


@njit(inline="always")
def _tent(r, c, a, b):  # type: ignore[no-untyped-def]
    """Return the weight of cell (a, b) in the window of 3 x 3 cells about (r, c)."""
    return (0.5 if a == r else 0.25) * (0.5 if b == c else 0.25)


@njit
def _count_window(counts, r, c):  # type: ignore[no-untyped-def]
    """Return the weighted number of pixels of a window."""
    total = 0.0
    for a in range(max(r - 1, 0), min(r + 2, counts.shape[0])):
        for b in range(max(c - 1, 0), min(c + 2, counts.shape[1])):
            total += _tent(r, c, a, b) * counts[a, b]
    return total


@njit
def _eliminate(g, r, c, n):  # type: ignore[no-untyped-def]
    """Take bias and ramp out of a window's products, (d, d), of `n` pixels: Gaussian elimination of the first three, in place.

    Ramps about the window's own centre keep the system well conditioned. False where it is ill all the same.
    """
    d = len(g)
    for axis, centre in ((1, c + 0.5), (2, r + 0.5)):
        for i in range(d):
            g[axis, i] -= centre * g[0, i]
        for i in range(d):
            g[i, axis] -= centre * g[i, 0]
    for p in range(3):
        g[p, p] += 1e-9 * n
    for p in range(3):
        if not g[p, p] > 0.0:
            return False
        for i in range(p + 1, d):
            factor = g[i, p] / g[p, p]
            for j in range(p + 1, d):
                g[i, j] -= factor * g[p, j]
    return True


@njit
def _eliminate_band(g, r, c, line):  # type: ignore[no-untyped-def]
    """Take bias and ramp out of a band's products with the values, (d + 1,), as `_eliminate` left these; its square last."""
    d = len(g)
    line[1] -= (c + 0.5) * line[0]
    line[2] -= (r + 0.5) * line[0]
    for p in range(3):
        factor = line[p] / g[p, p]
        line[d] -= factor * line[p]
        for j in range(p + 1, d):
            line[j] -= factor * g[p, j]


@njit(cache=True)
def sum_windows(start, stop, sums, counts, least, able, windows):  # type: ignore[no-untyped-def]
    """Sum the products of every window under tent weights, without bias and ramp; `able` where it has `least` weighted pixels."""
    for r in range(start, stop):
        for c in range(counts.shape[1]):
            n, g = _count_window(counts, r, c), windows[r, c]
            if n < least[r, c]:
                continue
            for a in range(max(r - 1, 0), min(r + 2, counts.shape[0])):
                for b in range(max(c - 1, 0), min(c + 2, counts.shape[1])):
                    _add_scaled(g, _tent(r, c, a, b), sums[a, b])
            able[r, c] = _eliminate(g, r, c, n)


@njit
def _add_scaled(g, weight, cell):  # type: ignore[no-untyped-def]
    for i in range(g.shape[0]):
        for j in range(g.shape[1]):
            g[i, j] += weight * cell[i, j]


@njit
def _factor_rows(a, first, last):  # type: ignore[no-untyped-def]
    """Factor rows of a symmetric matrix in place, those before them being factored (Cholesky); False where it is not positive."""
    for i in range(first, last):
        for j in range(i + 1):
            total = a[i, j]
            for m in range(j):
                total -= a[i, m] * a[j, m]
            if j < i:
                a[i, j] = total / a[j, j]
            elif total > 0.0:
                a[i, i] = np.sqrt(total)
            else:
                return False
    return True


@njit
def _solve(a, n, right, out):  # type: ignore[no-untyped-def]
    """Solve by the first `n` rows that `_factor_rows` left."""
    for i in range(n):
        total = right[i]
        for m in range(i):
            total -= a[i, m] * out[m]
        out[i] = total / a[i, i]
    for i in range(n - 1, -1, -1):
        total = out[i]
        for m in range(i + 1, n):
            total -= a[m, i] * out[m]
        out[i] = total / a[i, i]


@njit
def _fit(g, t, ridge, shift, info, sensitivity):  # type: ignore[no-untyped-def]
    """Fit gains and shift of a window by Gauss-Newton; return the square that is left, negative where it cannot be fitted.

    `g`, (3k, 3k), and `t`, (3k + 1,), are without bias and ramp. Unknowns are k gains and the shift, whose columns are the gradient
    of the prediction: the gains' own part of the system is factored once, the shift's two rows in each round.
    """
    k = len(g) // 3
    a, right, out = np.empty((k + 2, k + 2)), np.empty(k + 2), np.zeros(k + 2)
    slopes = np.empty((2, 3 * k))
    energy = 0.0
    for i in range(k):
        energy += g[i, i]
        right[i] = t[i]
    a[:k, :k] = g[:k, :k]
    for i in range(k):
        a[i, i] += ridge * energy
    if not _factor_rows(a, 0, k):
        return -1.0
    _solve(a, k, right, out)
    for _ in range(3):
        gains = out[:k].copy()
        for axis in range(2):
            row = (1 + axis) * k
            slopes[axis], right[k + axis] = 0.0, 0.0
            for i in range(k):
                right[k + axis] += gains[i] * t[row + i]
                for j in range(3 * k):
                    slopes[axis, j] += gains[i] * g[row + i, j]
            a[k + axis, :k] = slopes[axis, :k]
            for other in range(axis + 1):
                total = 0.0
                for i in range(k):
                    total += gains[i] * slopes[axis, (1 + other) * k + i]
                a[k + axis, k + other] = total
        energy = a[k, k] + a[k + 1, k + 1]
        for i in (k, k + 1):
            a[i, i] += 1e-9 * energy + 1e-300
        if not _factor_rows(a, k, k + 2):
            return -1.0
        _solve(a, k + 2, right, out)
    left = t[3 * k]
    for i in range(k + 2):
        left -= out[i] * right[i]
    shift[:] = out[k:]
    info[0, 0], info[0, 1] = a[k, k] ** 2, a[k, k] * a[k + 1, k]
    info[1, 0], info[1, 1] = info[0, 1], a[k + 1, k] ** 2 + a[k + 1, k + 1] ** 2
    for i in range(k):
        for j in range(k):
            sensitivity[i, j] = out[i] * (slopes[0, k + j] + slopes[1, 2 * k + j]) / energy
    return max(left, 0.0)


@njit
def _sum_partial(g, r, c, sums, counts, slots, partial):  # type: ignore[no-untyped-def]
    """Sum the products of a window of which the band covers some cells in part."""
    g[:] = 0.0
    for a in range(max(r - 1, 0), min(r + 2, counts.shape[0])):
        for b in range(max(c - 1, 0), min(c + 2, counts.shape[1])):
            if counts[a, b] > 0:
                here = partial[slots[a, b]] if slots[a, b] >= 0 else sums[a, b]
                _add_scaled(g, _tent(r, c, a, b), here)


@njit(cache=True)
def fit_windows(start, stop, predictor, band, least, ridge, out):  # type: ignore[no-untyped-def]
    """Fit every window that has `least` weighted pixels.

    `predictor` is (sums, counts, able, windows), `band` is (lines, counts, slots, partial), and `out` is (shift, information,
    r2, sensitivity), which is filled where a window can be fitted.
    """
    sums, whole, able, windows = predictor
    lines, counts, slots, partial = band
    shift, info, r2, sensitivity = out
    d, k = sums.shape[2], sensitivity.shape[2]
    own, line = np.empty((d, d)), np.empty(d + 1)
    for r in range(start, stop):
        for c in range(counts.shape[1]):
            n = _count_window(counts, r, c)
            if n < least[r, c] or n < 3 * (k + 5):
                continue
            line[:], cut = 0.0, False
            for a in range(max(r - 1, 0), min(r + 2, counts.shape[0])):
                for b in range(max(c - 1, 0), min(c + 2, counts.shape[1])):
                    line += _tent(r, c, a, b) * lines[a, b]
                    cut = cut or counts[a, b] != whole[a, b]
            if cut:
                _sum_partial(own, r, c, sums, counts, slots, partial)
                if not _eliminate(own, r, c, n):
                    continue
            elif not able[r, c]:
                continue
            g = own if cut else windows[r, c]
            _eliminate_band(g, r, c, line)
            total = line[d]
            if not total > 1e-12 * n:
                continue
            left = _fit(g[3:, 3:], line[3:], ridge, shift[r, c], info[r, c], sensitivity[r, c])
            if left < 0.0:
                continue
            info[r, c] /= max(left, 1e-9 * total) / max(n - k - 5, 1.0)
            r2[r, c] = 1.0 - left / total

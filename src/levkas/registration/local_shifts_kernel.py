"""Compiled loops of the local shifts: sums over cells, windows of cells, gains and shift of each.

What depends on the predictors alone is summed, centred and freed of bias and ramp once for every
window; a band then costs one row of sums a cell. Only windows whose cells the band covers in part
are summed anew.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit


@njit(inline="always")
def _see(images, i, j, k, cell, v):  # type: ignore[no-untyped-def]
    """Fill v with 1, u, v, the predictors and their derivatives along x and y at one pixel."""
    v[0] = 1.0
    v[1] = (j + 0.5) / cell
    v[2] = (i + 0.5) / cell
    half = np.float32(0.5)
    for a in range(k):
        v[3 + a] = images[a, i, j]
        v[3 + k + a] = (images[a, i, j + 1] - images[a, i, j - 1]) * half
        v[3 + 2 * k + a] = (images[a, i + 1, j] - images[a, i - 1, j]) * half


@njit(inline="always")
def _add_square(g, v, d):  # type: ignore[no-untyped-def]
    for a in range(d):
        left = v[a]
        for b in range(a + 1):
            g[a, b] += left * v[b]


@njit(inline="always")
def _mirror(g, d):  # type: ignore[no-untyped-def]
    for a in range(d):
        for b in range(a):
            g[b, a] = g[a, b]


@njit(cache=True)
def find_known(start, stop, images, known):  # type: ignore[no-untyped-def]
    """Return where all predictors and their derivatives are finite; the frame's rim never is."""
    k, h, w = images.shape
    total = np.empty(w, np.float32)
    for i in range(max(start, 1), min(stop, h - 1)):
        total[:] = np.float32(0.0)
        for a in range(k):  # a NaN or an infinity anywhere makes the sum one
            for j in range(1, w - 1):
                total[j] += images[a, i, j] - images[a, i, j]
                total[j] += images[a, i, j + 1] - images[a, i, j - 1]
                total[j] += images[a, i + 1, j] - images[a, i - 1, j]
        for j in range(1, w - 1):
            known[i, j] = np.isfinite(total[j])


@njit(cache=True)
def sum_squares(start, stop, images, known, cell, grams, counts):  # type: ignore[no-untyped-def]
    """Sum the products of what `_see` gives over each cell, where all of it is known."""
    k = images.shape[0]
    table = np.empty((3 + 3 * k, cell * cell))
    for r in range(start, stop):
        for c in range(counts.shape[1]):
            counts[r, c] = _tabulate(images, known, cell, r, c, table)
            if counts[r, c] > 0:
                np.dot(table, table.T, grams[r, c])


@njit
def _tabulate(images, known, cell, r, c, table):  # type: ignore[no-untyped-def]
    """Fill what `_see` gives at every pixel of a cell, a row each; zeros where it is not known."""
    k, _, w = images.shape
    left = c * cell
    half = np.float32(0.5)
    count = 0
    for y in range(cell):
        i, place = r * cell + y, y * cell
        whole = 0
        for x in range(cell):
            whole += known[i, left + x]
        count += whole
        if whole == 0:
            table[:, place : place + cell] = 0.0
            continue
        table[0, place : place + cell] = 1.0
        table[2, place : place + cell] = (i + 0.5) / cell
        for x in range(cell):
            table[1, place + x] = (left + x + 0.5) / cell
        for a in range(k):
            # First and last column are not known: it matters not what stands beside them.
            for x in range(cell):
                j = left + x
                along = images[a, i, min(j + 1, w - 1)] - images[a, i, max(j - 1, 0)]
                table[3 + a, place + x] = images[a, i, j]
                table[3 + k + a, place + x] = along * half
                table[3 + 2 * k + a, place + x] = (images[a, i + 1, j] - images[a, i - 1, j]) * half
        if whole < cell:
            for x in range(cell):
                if not known[i, left + x]:
                    table[:, place + x] = 0.0
    return count


@njit(cache=True)
def count_cover(start, stop, target, known, cell, number):  # type: ignore[no-untyped-def]
    """Count the pixels of each cell that predictors and target both know."""
    count = np.zeros(target.shape[1], np.int32)
    for r in range(start, stop):
        count[:] = 0
        for i in range(r * cell, (r + 1) * cell):
            row, there = target[i], known[i]
            for j in range(len(count)):
                count[j] += there[j] & np.isfinite(row[j])
        for c in range(number.shape[1]):
            total = 0
            for j in range(c * cell, (c + 1) * cell):
                total += count[j]
            number[r, c] = total


@njit(cache=True)
def sum_products(start, stop, target, images, known, cell, cover, out):  # type: ignore[no-untyped-def]
    """Sum the target's products, its square last, and all products anew in partial cells.

    Columns side by side, the rows of a cell one by one, these in single precision: as if the
    target had noise of 1e-7.
    """
    number, slots = cover
    lines = out[0]
    k, h, w = images.shape
    # Rows one by one: of a slice of several the compiler does not know that its pixels lie side by side.
    plain, along, down = np.empty(w, np.float32), np.empty(w, np.float32), np.empty(w, np.float32)
    for r in range(start, stop):
        for a in range(k):
            for sums in (plain, along, down):
                sums[:] = np.float32(0.0)
            for i in range(max(r * cell, 1), min((r + 1) * cell, h - 1)):
                above, image, below = images[a, i - 1], images[a, i], images[a, i + 1]
                _add_products(target[i], above, image, below, plain, along, down)
            for c in range(number.shape[1]):
                if number[r, c] == cell * cell:
                    line, left = lines[r, c], c * cell
                    line[3 + a] = _sum(plain, left, cell)
                    line[3 + k + a] = _sum(along, left, cell) * 0.5
                    line[3 + 2 * k + a] = _sum(down, left, cell) * 0.5
        _add_ramps(target, cell, r, number[r], lines[r])
        for c in range(number.shape[1]):
            if 0 < number[r, c] < cell * cell:
                _masked_cell(target, images, known, cell, r, c, slots[r, c], out)


@njit
def _add_products(target, above, image, below, plain, along, down):  # type: ignore[no-untyped-def]
    for j in range(1, len(target) - 1):
        t = target[j]
        plain[j] += t * image[j]
        along[j] += t * (image[j + 1] - image[j - 1])
        down[j] += t * (below[j] - above[j])


@njit
def _sum(values, left, count):  # type: ignore[no-untyped-def]
    total = 0.0
    for j in range(left, left + count):
        total += values[j]
    return total


@njit
def _add_ramps(target, cell, r, number, lines):  # type: ignore[no-untyped-def]
    """Add the sums of the target, times 1, u and v, and of its square in the whole cells of a row of cells."""
    w = target.shape[1]
    plain, down, square = np.zeros(w), np.zeros(w), np.zeros(w)
    for i in range(r * cell, (r + 1) * cell):
        v, row = (i + 0.5) / cell, target[i]
        for j in range(w):
            t = np.float64(row[j])
            plain[j] += t
            down[j] += t * v
            square[j] += t * t
    for c in range(len(number)):
        if number[c] < cell * cell:
            continue
        total, left = 0.0, c * cell
        for j in range(left, left + cell):
            total += plain[j] * (j + 0.5)
        line = lines[c]
        line[0], line[1] = _sum(plain, left, cell), total / cell
        line[2], line[-1] = _sum(down, left, cell), _sum(square, left, cell)


@njit
def _masked_cell(target, images, known, cell, r, c, slot, out):  # type: ignore[no-untyped-def]
    line, k = out[0][r, c], images.shape[0]
    d = 3 + 3 * k
    v, whole = np.empty(d), slot >= 0
    g = out[1][max(slot, 0)]
    if whole:
        g[:] = 0.0
    for i in range(r * cell, (r + 1) * cell):
        for j in range(c * cell, (c + 1) * cell):
            t = np.float64(target[i, j])
            if not (known[i, j] and np.isfinite(t)):
                continue
            _see(images, i, j, k, cell, v)
            for a in range(d):
                line[a] += t * v[a]
            line[d] += t * t
            if whole:
                _add_square(g, v, d)
    if whole:
        _mirror(g, d)


@njit
def _cholesky(a, n):  # type: ignore[no-untyped-def]
    """Factor the leading n x n block in place (lower); False where it is not positive definite."""
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for m in range(j):
                total -= a[i, m] * a[j, m]
            if i == j:
                if not total > 0.0:
                    return False
                a[i, i] = np.sqrt(total)
            else:
                a[i, j] = total / a[j, j]
    return True


@njit
def _substitute(factor, n, right, out):  # type: ignore[no-untyped-def]
    """Solve with the factor that `_cholesky` left."""
    for i in range(n):
        total = right[i]
        for m in range(i):
            total -= factor[i, m] * out[m]
        out[i] = total / factor[i, i]
    for back in range(n):
        i = n - 1 - back
        total = out[i]
        for m in range(i + 1, n):
            total -= factor[m, i] * out[m]
        out[i] = total / factor[i, i]


@njit(inline="always")
def _tent(r, c, a, b):  # type: ignore[no-untyped-def]
    return (0.5 if a == r else 0.25) * (0.5 if b == c else 0.25)


@njit
def _add_scaled(g, weight, cell):  # type: ignore[no-untyped-def]
    for i in range(g.shape[0]):
        for j in range(g.shape[1]):
            g[i, j] += weight * cell[i, j]


@njit
def _free(g, d, r, c, n, gram, mixed, ramp):  # type: ignore[no-untyped-def]
    """Centre a window's sums and take bias and ramp out; `ramp` is left factored; False if ill."""
    # Ramps about the window's own centre keep the system well conditioned.
    for i in range(d):
        g[1, i] -= (c + 0.5) * g[0, i]
        g[2, i] -= (r + 0.5) * g[0, i]
    for i in range(d):
        g[i, 1] -= (c + 0.5) * g[i, 0]
        g[i, 2] -= (r + 0.5) * g[i, 0]
    for i in range(3):
        for j in range(3):
            ramp[i, j] = g[i, j] + (1e-9 * n if i == j else 0.0)
    if not _cholesky(ramp, 3):
        return False
    right, out = np.empty(3), np.empty((d, 3))
    for j in range(3, d):
        for i in range(3):
            right[i] = g[i, j]
            mixed[i, j - 3] = g[i, j]
        _substitute(ramp, 3, right, out[j])
    for i in range(3, d):
        for j in range(3, d):
            gram[i - 3, j - 3] = g[i, j] - (
                g[i, 0] * out[j, 0] + g[i, 1] * out[j, 1] + g[i, 2] * out[j, 2]
            )
    return True


@njit(cache=True)
def sum_windows(start, stop, cells, counts, cell, cover, out):  # type: ignore[no-untyped-def]
    """Sum every 3 x 3 window of cells under tent weights, without bias and ramp.

    `out` is (able, gram, mixed, ramp); `able` is left at the weighted number of pixels, and at 0 where a window is of no use.
    """
    able, gram, mixed, ramp = out
    rows, cols = counts.shape
    d = cells.shape[2]
    g = np.empty((d, d))
    for r in range(start, stop):
        for c in range(cols):
            g[:] = 0.0
            n = 0.0
            full = 0.0
            for a in range(max(r - 1, 0), min(r + 2, rows)):
                for b in range(max(c - 1, 0), min(c + 2, cols)):
                    weight = _tent(r, c, a, b)
                    full += weight * cell * cell
                    if counts[a, b] > 0:
                        n += weight * counts[a, b]
                        _add_scaled(g, weight, cells[a, b])
            if n >= cover * full and _free(g, d, r, c, n, gram[r, c], mixed[r, c], ramp[r, c]):
                able[r, c] = n


@njit
def _factor_gains(g, t, ridge, factor, forward):  # type: ignore[no-untyped-def]
    """Factor the gains' block as L with the reciprocals of its diagonal, and solve L forward = t."""
    k = len(forward)
    energy = 0.0
    for a in range(k):
        energy += g[a, a]
    for i in range(k):
        for j in range(i + 1):
            value = g[i, j] + (ridge * energy if i == j else 0.0)
            for n in range(j):
                value -= factor[i, n] * factor[j, n]
            if i == j:
                if not value > 0.0:
                    return False
                factor[i, i] = 1.0 / np.sqrt(value)
            else:
                factor[i, j] = value * factor[j, j]
        value = t[i]
        for n in range(i):
            value -= factor[i, n] * forward[n]
        forward[i] = value * factor[i, i]
    return True


@njit
def _border_shift(g, t, gains, factor, border, grad, right):  # type: ignore[no-untyped-def]
    """Fill the two rows of the shift: sums of the prediction's gradient, and their part beside the gains."""
    k = len(gains)
    for axis in range(2):
        line = grad[axis]
        line[:] = 0.0
        value = 0.0
        for a in range(k):
            gain, row = gains[a], g[(1 + axis) * k + a]
            for c in range(3 * k):
                line[c] += gain * row[c]
            value += gain * t[(1 + axis) * k + a]
        right[axis] = value
        for i in range(k):
            value = line[i]
            for n in range(i):
                value -= factor[i, n] * border[axis, n]
            border[axis, i] = value * factor[i, i]


@njit
def _schur_complement(gains, border, grad):  # type: ignore[no-untyped-def]
    """Return what the shift's own block keeps once the gains are out of it: xx, xy, and yy less xy²/xx; its trace."""
    k = len(gains)
    xx = xy = yy = sxx = sxy = syy = 0.0
    for a in range(k):
        xx += gains[a] * grad[0, k + a]
        xy += gains[a] * grad[1, k + a]
        yy += gains[a] * grad[1, 2 * k + a]
        sxx += border[0, a] * border[0, a]
        sxy += border[1, a] * border[0, a]
        syy += border[1, a] * border[1, a]
    tiny = 1e-9 * (xx + yy) + 1e-300
    xx += tiny
    yy += tiny
    p2 = xx - sxx
    q = xy - sxy
    r2 = yy - syy - q * q / p2 if p2 > 0.0 else 0.0
    return p2, q, r2, xx + yy


@njit
def _gauss_newton(g, t, ridge, total, answer, sensitivity, work):  # type: ignore[no-untyped-def]
    """Fit gains and shift; answer holds e, the Schur complement (3) and what is left; False if ill.

    g: sums (3k, 3k) of predictors and derivatives, t: their sums with the target, (3k,). The
    gains' own block does not change with the shift: it is factored once, and every round borders
    it by two rows.
    """
    gains, factor, forward, border, grad, right = work
    k = len(gains)
    if not _factor_gains(g, t, ridge, factor, forward):
        return False
    _backward(factor, forward, k, gains)
    ex = ey = p2 = q = r2 = energy = 0.0
    for _ in range(3):
        _border_shift(g, t, gains, factor, border, grad, right)
        p2, q, r2, energy = _schur_complement(gains, border, grad)
        if not (p2 > 0.0 and r2 > 0.0):
            return False
        left_x, left_y = right[0], right[1]
        for a in range(k):
            left_x -= border[0, a] * forward[a]
            left_y -= border[1, a] * forward[a]
        ey = (left_y - q / p2 * left_x) / r2
        ex = (left_x - q * ey) / p2
        for a in range(k):
            gains[a] = forward[a] - border[0, a] * ex - border[1, a] * ey
        _backward(factor, gains, k, gains)
    left = total - ex * right[0] - ey * right[1]
    for a in range(k):
        left -= gains[a] * t[a]
    answer[0], answer[1], answer[5] = ex, ey, left
    answer[2], answer[3], answer[4] = p2, q, r2 + q * q / p2
    for a in range(k):
        for b in range(k):
            value = grad[0, k + b] + grad[1, 2 * k + b]
            sensitivity[a, b] = gains[a] * value / energy
    return True


@njit
def _backward(factor, forward, k, out):  # type: ignore[no-untyped-def]
    """Solve Lᵀ out = forward, the diagonal of L given by its reciprocals; in place if need be."""
    for back in range(k):
        i = k - 1 - back
        value = forward[i]
        for n in range(i + 1, k):
            value -= factor[n, i] * out[n]
        out[i] = value * factor[i, i]


@njit
def _sum_target(r, c, cell, counts, number, lines, line):  # type: ignore[no-untyped-def]
    """Sum the target's products of a window's cells; return pixels, pixels if all were known, and whether they are."""
    rows, cols = number.shape
    n, full, whole = 0.0, 0.0, True
    line[:] = 0.0
    for a in range(max(r - 1, 0), min(r + 2, rows)):
        for b in range(max(c - 1, 0), min(c + 2, cols)):
            weight = _tent(r, c, a, b)
            full += weight * cell * cell
            whole = whole and number[a, b] == counts[a, b]
            if number[a, b] > 0:
                n += weight * number[a, b]
                for i in range(len(line)):
                    line[i] += weight * lines[a, b, i]
    return n, full, whole


@njit
def _sum_partial(r, c, cells, number, slots, partial, g):  # type: ignore[no-untyped-def]
    """Sum the predictors' products of a window whose cells the target covers in part."""
    rows, cols = number.shape
    g[:] = 0.0
    for a in range(max(r - 1, 0), min(r + 2, rows)):
        for b in range(max(c - 1, 0), min(c + 2, cols)):
            if number[a, b] > 0:
                weight = _tent(r, c, a, b)
                slot = slots[a, b]
                _add_scaled(g, weight, cells[a, b] if slot < 0 else partial[slot])


@njit
def _free_target(r, c, line, factor, mix, t):  # type: ignore[no-untyped-def]
    """Centre the target's sums and take bias and ramp out of them; return what is left of its square."""
    d = len(line) - 1
    slope = np.empty(3)
    line[1] -= (c + 0.5) * line[0]
    line[2] -= (r + 0.5) * line[0]
    _substitute(factor, 3, line, slope)
    for j in range(d - 3):
        t[j] = line[3 + j] - (slope[0] * mix[0, j] + slope[1] * mix[1, j] + slope[2] * mix[2, j])
    return line[d] - (line[0] * slope[0] + line[1] * slope[1] + line[2] * slope[2])


@njit(cache=True)
def solve_windows(start, stop, cells, band, windows, limits, out):  # type: ignore[no-untyped-def]
    """Fit every window whose cells the target covers enough.

    Parameters
    ----------
    start, stop : int
        Rows of windows.
    cells : (rows, columns, d, d)
        Of `sum_squares`.
    band : (lines, number, slots, partial)
        Of `sum_products` and `count_cover`.
    windows : (counts, able, gram, mixed, ramp)
        Of `sum_squares` and `sum_windows`.
    limits : (cell, ridge, cover)
    out : (shift, information, r2, sensitivity)
        Filled where a window can be fitted.
    """
    lines, number, slots, partial = band
    counts, able, gram, mixed, ramp = windows
    cell, ridge, cover = limits
    shift, info, r2, sensitivity = out
    d, k = cells.shape[2], sensitivity.shape[2]
    g, line, t = np.empty((d, d)), np.empty(d + 1), np.empty(d - 3)
    own_gram, own_mixed, own_ramp = np.empty((d - 3, d - 3)), np.empty((3, d - 3)), np.empty((3, 3))
    answer = np.empty(6)
    work = (
        np.empty(k), np.empty((k, k)), np.empty(k), np.empty((2, k)), np.empty((2, d - 3)),
        np.empty(2),
    )  # fmt: skip
    for r in range(start, stop):
        for c in range(number.shape[1]):
            n, full, whole = _sum_target(r, c, cell, counts, number, lines, line)
            if n < cover * full or n < 3 * (k + 5):
                continue
            sums, mix, factor = own_gram, own_mixed, own_ramp
            if whole:
                if able[r, c] == 0.0:
                    continue
                sums, mix, factor = gram[r, c], mixed[r, c], ramp[r, c]
            else:
                _sum_partial(r, c, cells, number, slots, partial, g)
                if not _free(g, d, r, c, n, own_gram, own_mixed, own_ramp):
                    continue
            total = _free_target(r, c, line, factor, mix, t)
            here = sensitivity[r, c]
            if not (total > 1e-12 * n and _gauss_newton(sums, t, ridge, total, answer, here, work)):
                continue
            noise = max(answer[5], 1e-9 * total) / max(n - k - 5, 1.0)
            shift[r, c, 0], shift[r, c, 1] = answer[0], answer[1]
            info[r, c, 0, 0], info[r, c, 1, 1] = answer[2] / noise, answer[4] / noise
            info[r, c, 0, 1] = info[r, c, 1, 0] = answer[3] / noise
            r2[r, c] = 1.0 - answer[5] / total

"""Dense refinement: a linear prediction plus a shift, window by window, from sums over cells.

In a window the warped target band is T(x) = b + r·x + Σ g_k R_k(x) + e·∇P(x), with predictors R_k
(images of the reference in its own frame), P = Σ g_k R_k, and e the shift that is looked for.
Bias, ramp and gains are fitted along with e in every window, so that neither another contrast nor
its inversion nor a glare gradient moves the answer. All images are seen through one cubic B-spline
as a *smoothing* kernel: its value and derivative at any position are exact for one blurred scene,
so that the fraction of a pixel at which a sample falls does not bias the shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from levkas.registration.sampling import in_threads

CELL_PX = 16
RIDGE = 1e-4
LEAST_COVER = 0.6


@dataclass(frozen=True)
class Windows:
    """What dense refinement saw: one row a window.

    Parameters
    ----------
    centres : ndarray, (n, 2), reference px
    shift : ndarray, (n, 2), reference px
        e, with target(map(x)) = scene(x + e).
    information : ndarray, (n, 2, 2), 1/px²
        Inverse covariance of `shift` under white residuals; zero where a window is unusable.
    r2 : ndarray, (n,), 0..1
        Share of the window's variance (after bias and ramp) that the prediction explains.
    leaning : ndarray, (n, k, k)
        g_i <∇R_j, ∇P> / <∇P, ∇P>: how the prediction's position hangs on those of its predictors.
    """

    centres: np.ndarray
    shift: np.ndarray
    information: np.ndarray
    r2: np.ndarray
    leaning: np.ndarray


def features(predictors: np.ndarray) -> np.ndarray:
    """Return predictors, their x and then their y derivatives, (h, w, 3k), from (k, h, w)."""
    k, h, w = predictors.shape
    stack = np.full((h, w, 3 * k), np.nan, np.float32)
    for n, image in enumerate(predictors):
        stack[:, :, n] = image
        stack[:, 1:-1, k + n] = (image[:, 2:] - image[:, :-2]) / 2
        stack[1:-1, :, 2 * k + n] = (image[2:] - image[:-2]) / 2
    return stack


@njit(nogil=True, cache=True)
def _gram(start, stop, stack, known, cell, grams, counts):  # type: ignore[no-untyped-def]
    """Sums of products of (1, u, v, stack) over each cell where all of it is valid."""
    d = stack.shape[2] + 3
    v = np.empty(d)
    g = np.empty((d, d))
    for r in range(start, stop):
        for c in range(counts.shape[1]):
            g[:] = 0.0
            n = 0
            for i in range(r * cell, (r + 1) * cell):
                for j in range(c * cell, (c + 1) * cell):
                    if not known[i, j]:
                        continue
                    n += 1
                    v[0] = 1.0
                    v[1] = (j + 0.5) / cell
                    v[2] = (i + 0.5) / cell
                    for a in range(d - 3):
                        v[3 + a] = stack[i, j, a]
                    for a in range(d):
                        left = v[a]
                        for b in range(a + 1):
                            g[a, b] += left * v[b]
            for a in range(d):
                for b in range(a):
                    g[b, a] = g[a, b]
            grams[r, c] = g
            counts[r, c] = n


@njit(nogil=True, cache=True)
def _cross(start, stop, target, stack, known, cell, grams, counts, out, number):  # type: ignore[no-untyped-def]
    """Bordered sums: those of `_gram` with the target as the last row, masked by both."""
    d = stack.shape[2] + 3
    v = np.empty(d)
    g = np.empty((d, d))
    line = np.empty(d)
    for r in range(start, stop):
        for c in range(counts.shape[1]):
            n = 0
            for i in range(r * cell, (r + 1) * cell):
                for j in range(c * cell, (c + 1) * cell):
                    if known[i, j] and np.isfinite(target[i, j]):
                        n += 1
            if n == 0:
                continue
            whole = n == counts[r, c]
            number[r, c] = n
            g[:] = 0.0
            line[:] = 0.0
            square = 0.0
            for i in range(r * cell, (r + 1) * cell):
                for j in range(c * cell, (c + 1) * cell):
                    t = np.float64(target[i, j])
                    if not (known[i, j] and np.isfinite(t)):
                        continue
                    line[0] += t
                    line[1] += t * ((j + 0.5) / cell)
                    line[2] += t * ((i + 0.5) / cell)
                    for a in range(d - 3):
                        line[3 + a] += t * stack[i, j, a]
                    square += t * t
                    if not whole:
                        v[0] = 1.0
                        v[1] = (j + 0.5) / cell
                        v[2] = (i + 0.5) / cell
                        for a in range(d - 3):
                            v[3 + a] = stack[i, j, a]
                        for a in range(d):
                            left = v[a]
                            for b in range(a + 1):
                                g[a, b] += left * v[b]
            for a in range(d):
                for b in range(a + 1):
                    value = grams[r, c, a, b] if whole else g[a, b]
                    out[r, c, a, b] = value
                    out[r, c, b, a] = value
                out[r, c, d, a] = line[a]
                out[r, c, a, d] = line[a]
            out[r, c, d, d] = square


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
def _project_out(g, d, n):  # type: ignore[no-untyped-def]
    """Take bias and ramp (rows 0..2) out of the sums in place."""
    factor = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            factor[i, j] = g[i, j] + (1e-9 * n if i == j else 0.0)
    if not _cholesky(factor, 3):
        return False
    right, out = np.empty(3), np.empty((d, 3))
    for c in range(3, d):
        for i in range(3):
            right[i] = g[i, c]
        _substitute(factor, 3, right, out[c])
    for r in range(3, d):
        for c in range(3, d):
            g[r, c] -= g[r, 0] * out[c, 0] + g[r, 1] * out[c, 1] + g[r, 2] * out[c, 2]
    return True


@njit(cache=True)
def _gauss_newton(g, d, k, ridge, total, gains, answer, lean):  # type: ignore[no-untyped-def]
    """Fit gains and shift; answer holds e, the Schur complement (3) and what is left; False if ill."""
    size, t = k + 2, d - 1
    system, factor = np.zeros((size, size)), np.zeros((size, size))
    right, solved = np.zeros(size), np.zeros(size)
    grad = np.zeros((2, d))
    energy = 0.0
    for a in range(k):
        energy += g[3 + a, 3 + a]
        right[a] = g[t, 3 + a]
        for b in range(k):
            system[a, b] = g[3 + a, 3 + b]
    for a in range(k):
        system[a, a] += ridge * energy
    factor[:k, :k] = system[:k, :k]
    if not _cholesky(factor, k):
        return False
    _substitute(factor, k, right, gains)
    for _ in range(3):
        for axis in range(2):
            first = 3 + (1 + axis) * k
            for c in range(3, d):
                value = 0.0
                for a in range(k):
                    value += gains[a] * g[first + a, c]
                grad[axis, c] = value
            right[k + axis] = grad[axis, t]
            for a in range(k):
                system[k + axis, a] = grad[axis, 3 + a]
                system[a, k + axis] = grad[axis, 3 + a]
        for axis in range(2):
            for other in range(2):
                value = 0.0
                for a in range(k):
                    value += gains[a] * grad[axis, 3 + (1 + other) * k + a]
                system[k + axis, k + other] = value
        tiny = 1e-9 * (system[k, k] + system[k + 1, k + 1]) + 1e-300
        system[k, k] += tiny
        system[k + 1, k + 1] += tiny
        factor[:, :] = system
        if not _cholesky(factor, size):
            return False
        _substitute(factor, size, right, solved)
        left = total
        for a in range(size):
            left -= solved[a] * right[a]
        gains[:] = solved[:k]
    answer[0], answer[1], answer[5] = solved[k], solved[k + 1], left
    # The lower right block of the factor is that of the Schur complement.
    p, q, r = factor[k, k], factor[k + 1, k], factor[k + 1, k + 1]
    answer[2], answer[3], answer[4] = p * p, p * q, q * q + r * r
    whole = system[k, k] + system[k + 1, k + 1]
    for a in range(k):
        for b in range(k):
            value = 0.0
            for axis in range(2):
                value += grad[axis, 3 + (1 + axis) * k + b]
            lean[a, b] = gains[a] * value / whole
    return True


@njit(nogil=True, cache=True)
def _solve(start, stop, cells, number, cell, ridge, cover, shift, info, r2, lean):  # type: ignore[no-untyped-def]
    """Shift, information, r² and leaning of every 3 x 3 window of cells under tent weights."""
    rows, cols = number.shape
    d, k = cells.shape[2], lean.shape[2]
    for r in range(start, stop):
        g = np.empty((d, d))
        answer = np.empty(6)
        gains = np.empty(k)
        here = np.empty((k, k))
        for c in range(cols):
            g[:] = 0.0
            n = 0.0
            full = 0.0
            for a in range(max(r - 1, 0), min(r + 2, rows)):
                for b in range(max(c - 1, 0), min(c + 2, cols)):
                    weight = (0.5 if a == r else 0.25) * (0.5 if b == c else 0.25)
                    full += weight * cell * cell
                    if number[a, b] > 0:
                        n += weight * number[a, b]
                        g += weight * cells[a, b]
            if n < cover * full or n < 3 * (k + 5):
                continue
            # Ramps about the window's own centre keep the system well conditioned.
            for i in range(d):
                g[1, i] -= (c + 0.5) * g[0, i]
                g[2, i] -= (r + 0.5) * g[0, i]
            for i in range(d):
                g[i, 1] -= (c + 0.5) * g[i, 0]
                g[i, 2] -= (r + 0.5) * g[i, 0]
            if not _project_out(g, d, n):
                continue
            total = g[d - 1, d - 1]
            if not (
                total > 1e-12 * n and _gauss_newton(g, d, k, ridge, total, gains, answer, here)
            ):
                continue
            noise = max(answer[5], 1e-9 * total) / max(n - k - 5, 1.0)
            shift[r, c, 0] = answer[0]
            shift[r, c, 1] = answer[1]
            info[r, c, 0, 0] = answer[2] / noise
            info[r, c, 0, 1] = answer[3] / noise
            info[r, c, 1, 0] = answer[3] / noise
            info[r, c, 1, 1] = answer[4] / noise
            r2[r, c] = 1.0 - answer[5] / total
            lean[r, c] = here


class Predictor:
    """Reference images made ready, so that each band of each camera costs one pass.

    Parameters
    ----------
    images : ndarray, (k, h, w)
        In the common frame; NaN where invalid.
    step : float
        Reference px per px of `images`.
    """

    def __init__(self, images: np.ndarray, *, step: float = 1.0, cell: int = CELL_PX) -> None:
        self.k, self.step = len(images), step
        self.cell = min(cell, *images.shape[1:])
        self.stack = features(np.asarray(images, np.float32))
        # A NaN anywhere among the features makes their sum one.
        self.known = np.isfinite(self.stack.sum(2))
        d = self.stack.shape[2] + 3
        rows, cols = (n // self.cell for n in self.known.shape)
        self.grams = np.zeros((rows, cols, d, d))
        self.counts = np.zeros((rows, cols), np.int64)
        in_threads(_gram, rows, self.stack, self.known, self.cell, self.grams, self.counts)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the common frame."""
        return self.known.shape[0], self.known.shape[1]

    def compare(self, target: np.ndarray, *, ridge: float = RIDGE) -> Windows:
        """Return the shifts of `target`, warped into the common frame, against the predictors."""
        rows, cols = self.counts.shape
        d, k = self.grams.shape[2] + 1, self.k
        cells, number = np.zeros((rows, cols, d, d)), np.zeros((rows, cols), np.int64)
        target = np.ascontiguousarray(target, np.float32)
        ours = (self.stack, self.known, self.cell, self.grams, self.counts)
        in_threads(_cross, rows, target, *ours, cells, number)
        shift, r2 = np.zeros((rows, cols, 2)), np.zeros((rows, cols))
        info, lean = np.zeros((rows, cols, 2, 2)), np.zeros((rows, cols, k, k))
        result = (shift, info, r2, lean)
        in_threads(_solve, rows, cells, number, self.cell, ridge, LEAST_COVER, *result)
        x, y = np.meshgrid(np.arange(cols), np.arange(rows))
        centres = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * (self.cell * self.step) - 0.5
        return Windows(
            centres,
            shift.reshape(-1, 2) * self.step,
            info.reshape(-1, 2, 2) / self.step**2,
            r2.reshape(-1),
            lean.reshape(-1, self.k, self.k),
        )

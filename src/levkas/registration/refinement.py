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
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

if TYPE_CHECKING:
    from levkas.transforms import Transform

CELL_PX = 16
LATTICE_PX = 8
RIDGE = 1e-4
LEAST_COVER = 0.6
HIGHPASS_PX = 3.0


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
    """

    centres: np.ndarray
    shift: np.ndarray
    information: np.ndarray
    r2: np.ndarray


def warp(
    image: np.ndarray, transform: Transform, shape: tuple[int, int], *, step: float = 1.0
) -> np.ndarray:
    """Return `image` seen in the frame of `transform`'s source through a cubic B-spline.

    Parameters
    ----------
    image : ndarray, (h, w), float32
        NaN where invalid.
    transform : Transform
        Output px (times `step`, about pixel corners) → px of `image`.
    shape : (height, width) of the output
    step : float
        Source px per output px.

    Returns
    -------
    warped : ndarray, `shape`, float32
        NaN where the kernel touches what is invalid or outside.

    Notes
    -----
    The map is evaluated every 8 px and interpolated linearly: 1e-4 px for lenses with up to one
    per cent of distortion.
    """
    rows, cols = (ceil((n - 1) / LATTICE_PX) + 1 for n in shape)
    x, y = np.meshgrid(np.arange(cols) * LATTICE_PX, np.arange(rows) * LATTICE_PX)
    points = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * step - 0.5
    lattice = np.ascontiguousarray(transform(points).reshape(rows, cols, 2))
    return _warp(np.ascontiguousarray(image, np.float32), lattice, shape[0], shape[1])


@njit(parallel=True, cache=True)
def _warp(image, lattice, height, width):  # type: ignore[no-untyped-def]
    out = np.full((height, width), np.nan, np.float32)
    h, w = image.shape
    for i in prange(height):
        fy = i / LATTICE_PX
        ly = min(int(fy), lattice.shape[0] - 2) if lattice.shape[0] > 1 else 0
        ty = fy - ly
        my = min(ly + 1, lattice.shape[0] - 1)
        wx = np.empty(4)
        wy = np.empty(4)
        for j in range(width):
            fx = j / LATTICE_PX
            lx = min(int(fx), lattice.shape[1] - 2) if lattice.shape[1] > 1 else 0
            tx = fx - lx
            mx = min(lx + 1, lattice.shape[1] - 1)
            x = (1 - ty) * ((1 - tx) * lattice[ly, lx, 0] + tx * lattice[ly, mx, 0]) + ty * (
                (1 - tx) * lattice[my, lx, 0] + tx * lattice[my, mx, 0]
            )
            y = (1 - ty) * ((1 - tx) * lattice[ly, lx, 1] + tx * lattice[ly, mx, 1]) + ty * (
                (1 - tx) * lattice[my, lx, 1] + tx * lattice[my, mx, 1]
            )
            if not (x >= 1.0 and y >= 1.0 and x < w - 2.0 and y < h - 2.0):
                continue
            x0 = int(x)
            y0 = int(y)
            _spline_weights(x - x0, wx)
            _spline_weights(y - y0, wy)
            total = 0.0
            for a in range(4):
                line = 0.0
                for b in range(4):
                    line += wx[b] * image[y0 - 1 + a, x0 - 1 + b]
                total += wy[a] * line
            out[i, j] = total
    return out


@njit(inline="always")
def _spline_weights(t, weights):  # type: ignore[no-untyped-def]
    s = 1.0 - t
    weights[0] = s * s * s / 6.0
    weights[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
    weights[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
    weights[3] = t * t * t / 6.0


@njit(parallel=True, cache=True)
def reduce(image, n):  # type: ignore[no-untyped-def]
    """Return the means of n x n blocks, (h // n, w // n) float32; NaN where a pixel is invalid."""
    h, w = image.shape[0] // n, image.shape[1] // n
    out = np.empty((h, w), np.float32)
    for i in prange(h):
        for j in range(w):
            total = 0.0
            for a in range(n):
                for b in range(n):
                    total += image[i * n + a, j * n + b]
            out[i, j] = total / (n * n)
    return out


def highpass(image: np.ndarray) -> np.ndarray:
    """Return `image` less its local mean over what is valid (Gaussian, sigma 3 px); NaN stays NaN.

    Glare, shading and the difference of two cameras' flat fields are smooth; paint is not. Without
    its slow part the residual of a prediction is nearly white, which least squares takes for granted.
    """
    taps = np.exp(-0.5 * (np.arange(-8, 9) / HIGHPASS_PX) ** 2)
    return _highpass(
        np.ascontiguousarray(image, np.float32), (taps / taps.sum()).astype(np.float32)
    )


@njit(parallel=True, cache=True)
def _highpass(image, taps):  # type: ignore[no-untyped-def]
    h, w = image.shape
    reach = len(taps) // 2
    across = np.zeros((h, w), np.float32)
    share = np.zeros((h, w), np.float32)
    out = np.empty((h, w), np.float32)
    for i in prange(h):
        value = np.zeros(w + 2 * reach, np.float32)
        mask = np.zeros(w + 2 * reach, np.float32)
        for j in range(w):
            if np.isfinite(image[i, j]):
                value[j + reach] = image[i, j]
                mask[j + reach] = 1.0
        for k in range(len(taps)):
            for j in range(w):
                across[i, j] += taps[k] * value[j + k]
                share[i, j] += taps[k] * mask[j + k]
    for i in prange(h):
        total = np.zeros(w, np.float32)
        weight = np.zeros(w, np.float32)
        for k in range(max(0, i - reach), min(h, i + reach + 1)):
            tap = taps[k - i + reach]
            for j in range(w):
                total[j] += tap * across[k, j]
                weight[j] += tap * share[k, j]
        for j in range(w):
            out[i, j] = image[i, j] - total[j] / max(weight[j], np.float32(1e-6))
    return out


def features(predictors: np.ndarray) -> np.ndarray:
    """Return predictors, their x and then their y derivatives, (3k, h, w), from (k, h, w)."""
    stack = np.full((3 * len(predictors), *predictors.shape[1:]), np.nan, np.float32)
    k = len(predictors)
    stack[:k] = predictors
    stack[k : 2 * k, :, 1:-1] = (predictors[:, :, 2:] - predictors[:, :, :-2]) / 2
    stack[2 * k :, 1:-1, :] = (predictors[:, 2:, :] - predictors[:, :-2, :]) / 2
    return stack


@njit(parallel=True, cache=True)
def _gram(stack, cell):  # type: ignore[no-untyped-def]
    """Sums of products of (1, u, v, stack) over each cell where all of it is valid."""
    d = stack.shape[0] + 3
    rows, cols = stack.shape[1] // cell, stack.shape[2] // cell
    grams = np.zeros((rows, cols, d, d))
    counts = np.zeros((rows, cols), np.int64)
    for r in prange(rows):
        v = np.empty(d)
        g = np.empty((d, d))
        for c in range(cols):
            g[:] = 0.0
            n = 0
            for i in range(r * cell, (r + 1) * cell):
                for j in range(c * cell, (c + 1) * cell):
                    good = True
                    for k in range(d - 3):
                        v[3 + k] = stack[k, i, j]
                        if not np.isfinite(v[3 + k]):
                            good = False
                    if not good:
                        continue
                    n += 1
                    v[0] = 1.0
                    v[1] = (j + 0.5) / cell
                    v[2] = (i + 0.5) / cell
                    for a in range(d):
                        for b in range(d):
                            g[a, b] += v[a] * v[b]
            grams[r, c] = g
            counts[r, c] = n
    return grams, counts


@njit(parallel=True, cache=True)
def _cross(target, stack, cell, grams, counts):  # type: ignore[no-untyped-def]
    """Bordered sums: those of `_gram` with the target as the last row, masked by both."""
    d = stack.shape[0] + 3
    rows, cols = counts.shape
    out = np.zeros((rows, cols, d + 1, d + 1))
    number = np.zeros((rows, cols), np.int64)
    for r in prange(rows):
        v = np.empty(d + 1)
        for c in range(cols):
            n = 0
            for i in range(r * cell, (r + 1) * cell):
                for j in range(c * cell, (c + 1) * cell):
                    if np.isfinite(target[i, j]):
                        n += 1
            if n == 0 or counts[r, c] == 0:
                continue
            whole = n == cell * cell and counts[r, c] == n
            kept = 0
            for i in range(r * cell, (r + 1) * cell):
                for j in range(c * cell, (c + 1) * cell):
                    t = target[i, j]
                    good = np.isfinite(t)
                    for k in range(d - 3):
                        v[3 + k] = stack[k, i, j]
                        if not whole and not np.isfinite(v[3 + k]):
                            good = False
                    if not good:
                        continue
                    kept += 1
                    v[0] = 1.0
                    v[1] = (j + 0.5) / cell
                    v[2] = (i + 0.5) / cell
                    v[d] = t
                    for a in range(d + 1):
                        out[r, c, d, a] += t * v[a]
                    if not whole:
                        for a in range(d):
                            for b in range(d):
                                out[r, c, a, b] += v[a] * v[b]
            for a in range(d):
                out[r, c, a, d] = out[r, c, d, a]
                if whole:
                    for b in range(d):
                        out[r, c, a, b] = grams[r, c, a, b]
            number[r, c] = kept
    return out, number


@njit(parallel=True, cache=True)
def _solve(cells, number, cell, k, ridge, cover):  # type: ignore[no-untyped-def]
    """Shift, information, r² of every 3 x 3 window of cells under tent weights."""
    rows, cols = number.shape
    shift = np.zeros((rows, cols, 2))
    info = np.zeros((rows, cols, 2, 2))
    r2 = np.zeros((rows, cols))
    d = cells.shape[2]
    m = 3 + k
    for r in prange(rows):
        g = np.empty((d, d))
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
            if n < cover * full or n < 3 * (m + 2):
                continue
            # Ramps about the window's own centre keep the system well conditioned.
            for axis, centre in ((1, c + 0.5), (2, r + 0.5)):
                g[axis] -= centre * g[0]
                g[:, axis] -= centre * g[:, 0]
            t = d - 1
            base = np.linalg.solve(g[:3, :3] + 1e-9 * n * np.eye(3), g[:3, 3:])
            g[3:, 3:] -= g[3:, :3] @ base
            total = g[t, t]
            energy = 0.0
            for a in range(k):
                energy += g[3 + a, 3 + a]
            if not (total > 1e-12 * n and energy > 1e-12 * n):
                continue
            system = np.zeros((k + 2, k + 2))
            right = np.zeros(k + 2)
            system[:k, :k] = g[3:m, 3:m]
            for a in range(k):
                system[a, a] += ridge * energy
                right[a] = g[t, 3 + a]
            gains = np.linalg.solve(system[:k, :k], right[:k])
            e = np.zeros(2)
            schur = np.zeros((2, 2))
            left = total
            for _ in range(3):
                for axis in range(2):
                    first = m + axis * k
                    grad = np.zeros(d)
                    for a in range(k):
                        grad += gains[a] * g[first + a]
                    for a in range(k):
                        system[k + axis, a] = grad[3 + a]
                        system[a, k + axis] = grad[3 + a]
                    right[k + axis] = grad[t]
                    for other in range(2):
                        total_gg = 0.0
                        for a in range(k):
                            total_gg += gains[a] * grad[m + other * k + a]
                        system[k + axis, k + other] = total_gg
                tiny = 1e-9 * (system[k, k] + system[k + 1, k + 1]) + 1e-15 * n
                system[k, k] += tiny
                system[k + 1, k + 1] += tiny
                solved = np.linalg.solve(system, right)
                gains = solved[:k].copy()
                e[0] = solved[k]
                e[1] = solved[k + 1]
                left = total - (solved * right).sum()
            inner = np.linalg.solve(system[:k, :k], system[:k, k:].copy())
            schur = system[k:, k:] - system[k:, :k] @ inner
            noise = max(left, 1e-9 * total) / max(n - m - 2, 1.0)
            shift[r, c] = e
            info[r, c] = schur / noise
            r2[r, c] = 1.0 - left / total
    return shift, info, r2


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
        self.stack = np.ascontiguousarray(features(np.asarray(images, np.float32)))
        self.grams, self.counts = _gram(self.stack, self.cell)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the common frame."""
        return self.stack.shape[1:]

    def compare(self, target: np.ndarray, *, ridge: float = RIDGE) -> Windows:
        """Return the shifts of `target`, warped into the common frame, against the predictors."""
        cells, number = _cross(target, self.stack, self.cell, self.grams, self.counts)
        shift, info, r2 = _solve(cells, number, self.cell, self.k, ridge, LEAST_COVER)
        rows, cols = number.shape
        x, y = np.meshgrid(np.arange(cols), np.arange(rows))
        centres = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * (self.cell * self.step) - 0.5
        return Windows(
            centres,
            shift.reshape(-1, 2) * self.step,
            info.reshape(-1, 2, 2) / self.step**2,
            r2.reshape(-1),
        )

"""Local shifts: Lucas-Kanade ([baker2004]_) with linear appearance variation ([hager1998]_), window by window.

In a window the warped target band is T(x) = b + r·x + Σ g_k R_k(x) + e·∇P(x), with predictors R_k
(images of the reference in its own frame), P = Σ g_k R_k, and e the shift that is looked for.
Bias, ramp and gains are fitted along with e in every window, so that neither another contrast nor
its inversion nor a glare gradient moves the answer. All images are resampled through one cubic B-spline
as a *smoothing* kernel: its value and derivative at any position are exact for one blurred scene,
so that the fraction of a pixel at which a sample falls does not bias the shift.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.compiled import njit
from levkas.core.threads import in_threads
from levkas.geometry.transforms import Affine, Composed
from levkas.registration import local_shifts_kernel as kernels
from levkas.registration.bands import LATTICE_PX, evaluate_lattice

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

#: Side of a cell, px; a window is three cells wide.
CELL_PX = 16
#: Of the gains, as a share of the predictors' energy.
RIDGE = 1e-4
#: Share of a window that has to be valid.
LEAST_COVER = 0.6
#: Standard deviation of the local mean that a high-pass filter subtracts, px.
HIGHPASS_PX = 3.0


@dataclass(frozen=True)
class WindowShifts:
    """Shifts of one band against its predictors; one row a window."""

    centres: np.ndarray
    """(n, 2), reference px."""
    shift: np.ndarray
    """(n, 2), reference px. e, with target(map(x)) = scene(x + e)."""
    information: np.ndarray
    """(n, 2, 2), 1/px². Inverse covariance of `shift` under white residuals; zero where a window is unusable."""
    r2: np.ndarray
    """(n,), 0..1. Share of the window's variance (after bias and ramp) that the prediction explains."""
    position_sensitivity: np.ndarray
    """(k, k). g_i <∇R_j, ∇P> / <∇P, ∇P>: how the prediction's position hangs on those of its predictors, the mean over the
    windows by their information; zeros where none has any."""


class Predictor:
    """Reference images with the sums of their products, so that each band of each camera costs one pass.

    Parameters
    ----------
    images : ndarray, (k, h, w)
        In the common frame; NaN where invalid.
    step : float
        Reference px per px of `images`.
    """

    def __init__(self, images: np.ndarray, *, step: float = 1.0, cell: int = CELL_PX) -> None:
        self.k, self.step = len(images), step
        height, width = images.shape[1:]
        self.cell = min(cell, height, width)
        self._images = np.ascontiguousarray(images, np.float32)
        self._known = np.zeros((height, width), bool)
        in_threads(kernels.find_known, height, self._images, self._known)
        self._rows, self._cols = height // self.cell, width // self.cell
        lattice, d = (self._rows, self._cols), 3 + 3 * self.k
        self._cells, self.counts = np.zeros((*lattice, d, d)), np.zeros(lattice, np.int64)
        in_threads(
            kernels.sum_squares,
            self._rows,
            *(self._images, self._known, self.cell, self._cells, self.counts),
        )
        self._able, self._gram = np.zeros(lattice), np.empty((*lattice, d - 3, d - 3))
        self._mixed, self._ramp = np.empty((*lattice, 3, d - 3)), np.empty((*lattice, 3, 3))
        in_threads(
            kernels.sum_windows,
            self._rows,
            *(self._cells, self.counts, self.cell, LEAST_COVER, self._windows),
        )

    @property
    def _windows(self) -> tuple[np.ndarray, ...]:
        return self._able, self._gram, self._mixed, self._ramp

    @property
    def images(self) -> np.ndarray:
        """The predictors, (k, h, w)."""
        return self._images

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the common frame."""
        return self._known.shape[0], self._known.shape[1]

    def compare(self, target: np.ndarray, *, ridge: float = RIDGE) -> WindowShifts:
        """Return the shifts of `target`, warped into the common frame, against the predictors."""
        rows, cols, cell, k = self._rows, self._cols, self.cell, self.k
        target = np.ascontiguousarray(target, np.float32)
        number = np.zeros((rows, cols), np.int64)
        in_threads(kernels.count_cover, rows, target, self._known, cell, number)
        slots, lines, partial = self._products(target, number)
        shift, r2 = np.zeros((rows, cols, 2)), np.zeros((rows, cols))
        info, sensitivity = np.zeros((rows, cols, 2, 2)), np.zeros((rows, cols, k, k))
        in_threads(
            kernels.solve_windows,
            rows,
            self._cells,
            (lines, number, slots, partial),
            (self.counts, *self._windows),
            (cell, ridge, LEAST_COVER),
            (shift, info, r2, sensitivity),
        )
        x, y = np.meshgrid(np.arange(cols), np.arange(rows))
        centres = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * (cell * self.step) - 0.5
        information = info.reshape(-1, 2, 2) / self.step**2
        weights = np.trace(information, axis1=1, axis2=2)
        if weights.any():
            weights = weights / weights.sum()
        mean = np.einsum("n,nij->ij", weights, sensitivity.reshape(-1, k, k))
        return WindowShifts(
            centres, shift.reshape(-1, 2) * self.step, information, r2.reshape(-1), mean
        )

    def _products(
        self, target: np.ndarray, number: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the sums of the target's products with the predictors, and all sums anew of cells that it covers in part."""
        cut = (number > 0) & (number < self.counts)
        slots = np.full(number.shape, -1)
        slots[cut] = np.arange(int(cut.sum()))
        d = self._cells.shape[2]
        lines, partial = np.zeros((*number.shape, d + 1)), np.empty((int(cut.sum()), d, d))
        in_threads(
            kernels.sum_products,
            self._rows,
            *(target, self._images, self._known, self.cell, (number, slots), (lines, partial)),
        )
        return slots, lines, partial


# --- resampling before windows are compared


def smoothing_warp(
    image: np.ndarray, transform: Transform, shape: tuple[int, int], *, step: float = 1.0
) -> np.ndarray:
    """Return `image` resampled in the frame of `transform`'s source through a cubic B-spline.

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
    """
    lattice = evaluate_lattice(transform, shape, step)
    out = np.full(shape, np.nan, np.float32)
    in_threads(_warp, shape[0], np.ascontiguousarray(image, np.float32), lattice, out)
    return out


@njit(cache=True)
def _warp(start, stop, image, lattice, out):  # type: ignore[no-untyped-def]
    h, w = image.shape
    flat, width = image.reshape(-1), out.shape[1]
    last = lattice.shape[0] - 1
    nodes = np.empty((lattice.shape[1], 2))
    first = np.empty(width, np.int64)
    u, v = np.empty((4, width), np.float32), np.empty((4, width), np.float32)
    for i in range(start, stop):
        fy = i / LATTICE_PX
        ly = min(int(fy), last)
        my = min(ly + 1, last)
        ty = fy - ly
        for n in range(len(nodes)):
            nodes[n, 0] = (1 - ty) * lattice[ly, n, 0] + ty * lattice[my, n, 0]
            nodes[n, 1] = (1 - ty) * lattice[ly, n, 1] + ty * lattice[my, n, 1]
        _place_row(nodes, h, w, first, u, v)
        for j in range(width):
            if first[j] < 0:
                continue
            total = np.float32(0.0)
            for r in range(4):
                p = np.uintp(first[j] + r * w)  # unsigned: no index counts from the end
                line = u[0, j] * flat[p] + u[1, j] * flat[p + np.uintp(1)]
                more = u[2, j] * flat[p + np.uintp(2)] + u[3, j] * flat[p + np.uintp(3)]
                total += v[r, j] * (line + more)
            out[i, j] = total


@njit
def _place_row(nodes, h, w, first, u, v):  # type: ignore[no-untyped-def]
    """Fill, for the pixels of a row, the first of four by four samples, -1 outside, and the weights of columns and rows.

    Places lie on a straight line from node to node. The loops over pixels have no branches, so that several go at once.
    """
    width = len(first)
    x_part, y_part = np.empty(width, np.float32), np.empty(width, np.float32)
    for left in range(0, width, LATTICE_PX):
        n = left // LATTICE_PX
        m = min(n + 1, len(nodes) - 1)
        x, y = nodes[n]
        slope_x, slope_y = (nodes[m, 0] - x) / LATTICE_PX, (nodes[m, 1] - y) / LATTICE_PX
        for j in range(min(LATTICE_PX, width - left)):
            here, there = x + j * slope_x, y + j * slope_y
            inside = here >= 1.0 and there >= 1.0 and here < w - 2.0 and there < h - 2.0
            x0 = np.floor(here) if inside else 1.0
            y0 = np.floor(there) if inside else 1.0
            first[left + j] = np.int64((y0 - 1) * w + x0 - 1) if inside else -1
            x_part[left + j], y_part[left + j] = here - x0, there - y0
    for j in range(width):
        u[0, j], u[1, j], u[2, j], u[3, j] = spline_weights(x_part[j])
        v[0, j], v[1, j], v[2, j], v[3, j] = spline_weights(y_part[j])


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


def reduce(image: np.ndarray, n: int) -> np.ndarray:
    """Return the means of n x n blocks, (h // n, w // n) float32; NaN where a pixel is invalid."""
    out = np.empty((image.shape[0] // n, image.shape[1] // n), np.float32)
    in_threads(_reduce, out.shape[0], np.ascontiguousarray(image, np.float32), n, out)
    return out


@njit(cache=True)
def _reduce(start, stop, image, n, out):  # type: ignore[no-untyped-def]
    sums = np.empty(out.shape[1] * n)
    for i in range(start, stop):
        sums[:] = 0.0
        for a in range(n):
            for j in range(len(sums)):
                sums[j] += image[i * n + a, j]
        for j in range(out.shape[1]):
            total = 0.0
            for b in range(n):
                total += sums[j * n + b]
            out[i, j] = total / (n * n)


def detail_on_grid(
    image: np.ndarray, transform: Transform, shape: tuple[int, int], *, step: int = 1
) -> np.ndarray:
    """Return `image`, (h, w), resampled on a grid of `step` reference px and high-passed.

    `transform` is reference px → px of the image, `shape` that of the grid. Blocks of about one px of the grid are averaged: less lets
    detail finer than the grid feign other detail, more makes noise alike in neighbours.
    """
    centre = (np.array([[shape[1], shape[0]]]) * step - 1) / 2
    size = step * float(np.sqrt(np.abs(np.linalg.det(transform.jacobian(centre)[0]))))
    block = max(1, round(size / 1.2)) if np.isfinite(size) else 1
    whole = Composed(transform, Affine.scaling(1 / block))
    return highpass(smoothing_warp(reduce(image, block), whole, shape, step=step))


def highpass(image: np.ndarray) -> np.ndarray:
    """Return `image` less its local mean over what is valid (Gaussian, sigma 3 px); NaN stays NaN.

    Glare, shading and the difference of two cameras' flat fields are smooth; paint is not. Without
    its slow part the residual of a prediction is nearly white, which least squares takes for granted.
    """
    image = np.ascontiguousarray(image, np.float32)
    across, share, out = (np.empty(image.shape, np.float32) for _ in range(3))
    in_threads(_average_rows, image.shape[0], image, across, share)
    in_threads(_average_columns, image.shape[0], image, across, share, out)
    return out


def highpass_rows(image: np.ndarray) -> np.ndarray:
    """Return `highpass` along rows alone: no row has anything of its neighbours."""
    image = np.ascontiguousarray(image, np.float32)
    across, share = (np.empty(image.shape, np.float32) for _ in range(2))
    in_threads(_average_rows, image.shape[0], image, across, share)
    across /= np.maximum(share, np.float32(1e-6), out=share)
    return np.asarray(np.subtract(image, across, out=across))


_REACH = 8
_TAPS = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / HIGHPASS_PX) ** 2)
_TAPS = (_TAPS / _TAPS.sum()).astype(np.float32)


@njit(cache=True)
def _average_rows(start, stop, image, across, share):  # type: ignore[no-untyped-def]
    w = image.shape[1]
    value, mask = np.zeros((2, w + 2 * _REACH), np.float32)
    for i in range(start, stop):
        for j in range(w):
            known = np.isfinite(image[i, j])
            value[j + _REACH] = image[i, j] if known else np.float32(0.0)
            mask[j + _REACH] = np.float32(known)
        for j in range(w):
            total = weight = np.float32(0.0)
            for k in range(2 * _REACH + 1):
                total += _TAPS[k] * value[j + k]
                weight += _TAPS[k] * mask[j + k]
            across[i, j], share[i, j] = total, weight


@njit(cache=True)
def _average_columns(start, stop, image, across, share, out):  # type: ignore[no-untyped-def]
    h, w = image.shape
    for i in range(start, stop):
        total = np.zeros(w, np.float32)
        weight = np.zeros(w, np.float32)
        for k in range(max(0, i - _REACH), min(h, i + _REACH + 1)):
            tap = _TAPS[k - i + _REACH]
            for j in range(w):
                total[j] += tap * across[k, j]
                weight[j] += tap * share[k, j]
        for j in range(w):
            out[i, j] = image[i, j] - total[j] / max(weight[j], np.float32(1e-6))

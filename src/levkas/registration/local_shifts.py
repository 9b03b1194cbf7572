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

import cv2
import numpy as np

from levkas.core.threads import in_threads
from levkas.geometry.transforms import Affine, Composed
from levkas.registration import local_shifts_kernel as kernels
from levkas.registration.bands import evaluate_lattice

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

    `images`, (k, h, w), lie in the common frame, NaN where invalid, with `step` reference px a px; `cell` is the side of a cell, px.
    """

    def __init__(self, images: np.ndarray, *, step: float = 1.0, cell: int = CELL_PX) -> None:
        self.images = np.ascontiguousarray(images, np.float32)
        self.step, (k, height, width) = step, self.images.shape
        self.shape, self.cell = (height, width), min(cell, height, width)
        finite = np.asarray(np.isfinite(self.images).all(0))
        self._shown = np.zeros_like(finite)
        sides = finite[1:-1, 2:] & finite[1:-1, :-2] & finite[2:, 1:-1] & finite[:-2, 1:-1]
        self._shown[1:-1, 1:-1] = finite[1:-1, 1:-1] & sides
        self.counts = self._count(self._shown)
        lattice, d = self.counts.shape, 3 + 3 * k
        whole = [np.convolve(np.ones(n), (0.25, 0.5, 0.25))[1:-1] for n in lattice]
        self._least = LEAST_COVER * self.cell**2 * np.outer(*whole)
        self._sums, self._windows = np.zeros((2, *lattice, d, d))
        self._able = np.zeros(lattice, bool)
        in_threads(
            kernels.sum_cells, lattice[0],
            self.images, self._shown, self.cell, self.counts, self._sums,
        )  # fmt: skip
        in_threads(
            kernels.sum_windows, lattice[0],
            self._sums, self.counts, self._least, self._able, self._windows,
        )  # fmt: skip

    def _count(self, shown: np.ndarray) -> np.ndarray:
        """Return how many pixels of each cell are shown; what is left of the frame behind the last whole cells is in none."""
        rows, columns = (n // self.cell for n in shown.shape)
        inside = shown[: rows * self.cell, : columns * self.cell]
        return np.asarray(inside.reshape(rows, self.cell, columns, self.cell).sum((1, 3)))

    def compare(self, target: np.ndarray, *, ridge: float = RIDGE) -> WindowShifts:
        """Return the shifts of `target`, (h, w), warped into the common frame, against the predictors."""
        target = np.ascontiguousarray(target, np.float32)
        shown = self._shown & np.isfinite(target)
        counts = self._count(shown)
        slots = np.where(counts == 0, kernels.EMPTY, kernels.WHOLE)
        cut = (counts > 0) & (counts < self.counts)
        slots[cut] = np.arange(cut.sum())
        (rows, columns), k, d = counts.shape, len(self.images), self._sums.shape[2]
        lines, partial = np.zeros((rows, columns, d + 1)), np.empty((int(cut.sum()), d, d))
        in_threads(
            kernels.sum_band, rows,
            target, self.images, shown, self.cell, slots, (lines, partial),
        )  # fmt: skip
        shift, r2 = np.zeros((rows, columns, 2)), np.zeros((rows, columns))
        information = np.zeros((rows, columns, 2, 2))
        sensitivity = np.zeros((rows, columns, k, k))
        in_threads(
            kernels.fit_windows, rows,
            (self._sums, self.counts, self._able, self._windows), (lines, counts, slots, partial),
            self._least, ridge, (shift, information, r2, sensitivity),
            worth=self._sums.size,
        )  # fmt: skip
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        centres = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * (self.cell * self.step) - 0.5
        information = information.reshape(-1, 2, 2) / self.step**2
        weights = np.trace(information, axis1=1, axis2=2)
        weights = weights / weights.sum() if weights.any() else weights
        mean = np.einsum("n,nij->ij", weights, sensitivity.reshape(-1, k, k))
        return WindowShifts(
            centres, shift.reshape(-1, 2) * self.step, information, r2.reshape(-1), mean
        )


# --- resampling before windows are compared


def smoothing_warp(
    image: np.ndarray, transform: Transform, shape: tuple[int, int], *, step: float = 1.0
) -> np.ndarray:
    """Return `image`, (h, w), NaN where invalid, resampled through a cubic B-spline, float32.

    `transform` takes px of the output, of `shape` and `step` source px a px, to px of the image; NaN where the kernel touches
    what is invalid or outside.
    """
    lattice = evaluate_lattice(transform, shape, step)
    out = np.full(shape, np.nan, np.float32)
    in_threads(kernels.warp_rows, shape[0], np.ascontiguousarray(image, np.float32), lattice, out)
    return out


def reduce(image: np.ndarray, n: int) -> np.ndarray:
    """Return the means of n x n blocks, (h // n, w // n) float32; NaN where a pixel is invalid."""
    height, width = (side // n for side in image.shape)
    whole = np.asarray(image, np.float32)[: height * n, : width * n]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))


def detail_on_grid(
    image: np.ndarray, transform: Transform, shape: tuple[int, int], *, step: int = 1
) -> np.ndarray:
    """Return `picture_on_grid`, high-passed."""
    return highpass(picture_on_grid(image, transform, shape, step=step))


def picture_on_grid(
    image: np.ndarray, transform: Transform, shape: tuple[int, int], *, step: int = 1
) -> np.ndarray:
    """Return `image`, (h, w), resampled on a grid of `step` reference px.

    `transform` is reference px → px of the image, `shape` that of the grid. Blocks of about one px of the grid are averaged: less lets
    detail finer than the grid feign other detail, more makes noise alike in neighbours.
    """
    centre = (np.array([[shape[1], shape[0]]]) * step - 1) / 2
    size = step * float(np.sqrt(np.abs(np.linalg.det(transform.jacobian(centre)[0]))))
    block = max(1, round(size / 1.2)) if np.isfinite(size) else 1
    whole = Composed(transform, Affine.scaling(1 / block))
    return smoothing_warp(reduce(image, block), whole, shape, step=step)


def highpass(image: np.ndarray) -> np.ndarray:
    """Return `image` less its local mean over what is valid (Gaussian, sigma 3 px); NaN stays NaN.

    Glare, shading and the difference of two cameras' flat fields are smooth; paint is not. Without
    its slow part the residual of a prediction is nearly white, which least squares takes for granted.
    """
    return _less_mean(image, _TAPS)


def highpass_rows(image: np.ndarray) -> np.ndarray:
    """Return `highpass` along rows alone: no row has anything of its neighbours."""
    return _less_mean(image, np.ones(1, np.float32))


_TAPS = np.exp(-0.5 * (np.arange(-8, 9) / HIGHPASS_PX) ** 2)
_TAPS = (_TAPS / _TAPS.sum()).astype(np.float32)


def _less_mean(image: np.ndarray, down: np.ndarray) -> np.ndarray:
    known = np.isfinite(image)
    total, share = (
        cv2.sepFilter2D(part.astype(np.float32), -1, _TAPS, down, borderType=cv2.BORDER_CONSTANT)
        for part in (np.where(known, image, 0), known)
    )
    return np.asarray(image - total / np.maximum(share, np.float32(1e-6)), np.float32)

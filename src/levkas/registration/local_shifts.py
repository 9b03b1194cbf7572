"""Local shifts: Lucas-Kanade ([baker2004]_) with linear appearance variation ([hager1998]_), window by window.

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

from levkas.core.threads import in_threads
from levkas.registration import local_shifts_kernel as kernels

#: Side of a cell, px; a window is three cells wide.
CELL_PX = 16
#: Of the gains, as a share of the predictors' energy.
RIDGE = 1e-4
#: Share of a window that has to be valid.
LEAST_COVER = 0.6


@dataclass(frozen=True)
class WindowShifts:
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
    position_sensitivity : ndarray, (n, k, k)
        g_i <∇R_j, ∇P> / <∇P, ∇P>: how the prediction's position hangs on those of its predictors.
    """

    centres: np.ndarray
    shift: np.ndarray
    information: np.ndarray
    r2: np.ndarray
    position_sensitivity: np.ndarray


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
        return WindowShifts(
            centres,
            shift.reshape(-1, 2) * self.step,
            info.reshape(-1, 2, 2) / self.step**2,
            r2.reshape(-1),
            sensitivity.reshape(-1, k, k),
        )

    def _products(
        self, target: np.ndarray, number: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sums of the target with the predictors; of all that it covers in cells that it cuts."""
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

"""Estimates that are linear in the responses: model, ridge regression and choice of the ridge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from levkas.estimation.model import in_blocks
from levkas.estimation.training import Training, held_out_errors, sample_weights

RIDGES = np.logspace(-10, 1, 23)
"""Ridges that are tried, in units of the largest eigenvalue of X Xᵀ."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """``spectra = responses @ coefficients + offset``, (channels, bands) and (bands,).

    `ridge` is the penalty that it was fitted with, `error` that of the samples held out.
    """

    coefficients: np.ndarray
    offset: np.ndarray
    ridge: float = 0.0
    error: float = 0.0

    def __call__(self, responses: np.ndarray) -> tuple[np.ndarray, None]:
        (spectra,) = in_blocks(self._block, responses, len(self.coefficients))
        return spectra, None

    def _block(self, responses: np.ndarray) -> tuple[np.ndarray]:
        return (responses @ self.coefficients + self.offset,)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that the model is, as arrays."""
        return {name: np.asarray(value) for name, value in vars(self).items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> LinearModel:
        """Return the model of some arrays."""
        numbers = (float(arrays[name]) for name in ("ridge", "error"))
        return cls(arrays["coefficients"], arrays["offset"], *numbers)


def fit_ridge(
    training: Training, *, ridge: float | None = None, centred: bool = True
) -> LinearModel:
    """Fit spectra to responses by weighted least squares with a penalty on the coefficients.

    Parameters
    ----------
    training : Training
        Its sigma weighs the samples.
    ridge : float, optional
        Penalty λ; that of the smallest held-out error by default.
    centred : bool
        Whether an offset is fitted, which is not penalised.

    Notes
    -----
    minimises Σ w |y − x B − b|² + λ |B|²; solved by the singular values of the weighted responses.
    """
    columns, weights = training.responses, sample_weights(training)
    root = np.sqrt(weights)[:, None]
    mean_x = weights @ columns / weights.sum() * centred
    mean_y = weights @ training.spectra / weights.sum() * centred
    left, scale, right = np.linalg.svd(root * (columns - mean_x), full_matrices=False)
    largest = scale[0]
    known = scale > largest * len(columns) * np.finfo(float).eps
    left, scale, right = left[:, known], scale[known], right[known]
    targets = root * (training.spectra - mean_y)
    vectors, values = left, scale**2
    if centred:  # the offset is a column of its own, at right angles to the centred ones
        vectors = np.column_stack([left, root / np.linalg.norm(root)])
        values = np.append(values, np.inf)
    tried = RIDGES * largest**2 if ridge is None else [ridge]
    errors = held_out_errors(training, vectors, values, targets, tried)
    best = int(np.argmin(errors))
    chosen = float(tried[best])
    coefficients = right.T @ ((scale / (scale**2 + chosen))[:, None] * (left.T @ targets))
    return LinearModel(coefficients, mean_y - mean_x @ coefficients, chosen, errors[best])

"""Estimates that are linear in terms of the responses: model, ridge regression and choice of the ridge."""

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
    """``spectra = terms(responses) @ coefficients + offset``.

    Parameters
    ----------
    factors : ndarray, (terms, degree), int
        Channels whose product each term is; −1 is no channel.
    roots : bool
        Whether a term is the geometric mean of its channels instead.
    coefficients : ndarray, (terms, bands)
    offset : ndarray, (bands,)
    channels : int
    """

    factors: np.ndarray
    roots: bool
    coefficients: np.ndarray
    offset: np.ndarray
    channels: int

    def __call__(self, responses: np.ndarray) -> tuple[np.ndarray, None]:
        (spectra,) = in_blocks(self._block, responses, self.channels)
        return spectra, None

    def _block(self, responses: np.ndarray) -> tuple[np.ndarray]:
        columns = expand(responses, self.factors, roots=self.roots)
        return (columns @ self.coefficients + self.offset,)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that the model is, as arrays."""
        return {name: np.asarray(value) for name, value in vars(self).items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> LinearModel:
        """Return the model of some arrays."""
        return cls(
            arrays["factors"],
            bool(arrays["roots"]),
            arrays["coefficients"],
            arrays["offset"],
            int(arrays["channels"]),
        )


def expand(responses: np.ndarray, factors: np.ndarray, *, roots: bool) -> np.ndarray:
    """Return the terms of responses, (n, channels) → (n, terms).

    Examples
    --------
    >>> expand(np.array([[4.0, 9.0]]), np.array([[0, -1], [0, 1]]), roots=False).tolist()
    [[4.0, 36.0]]
    >>> expand(np.array([[4.0, 9.0]]), np.array([[0, -1], [0, 1]]), roots=True).tolist()
    [[4.0, 6.0]]
    """
    values = np.column_stack([responses, np.ones(len(responses))])  # channel −1 is 1
    if roots:
        values = np.maximum(values, 0)
    terms = values[:, factors[:, 0]]
    for place in range(1, factors.shape[1]):
        terms = terms * values[:, factors[:, place]]
    if roots:
        degrees = (factors >= 0).sum(1)
        for degree in range(2, factors.shape[1] + 1):
            some = degrees == degree
            terms[:, some] = terms[:, some] ** (1 / degree)
    return np.asarray(terms)


def single_channels(channels: int) -> np.ndarray:
    """Return the factors of terms that are the channels themselves, (channels, 1)."""
    return np.arange(channels)[:, None]


@dataclass(frozen=True)
class RidgeFit:
    """A ridge regression: coefficients (terms, bands), offset (bands,), ridge, held-out error."""

    coefficients: np.ndarray
    offset: np.ndarray
    ridge: float
    error: float


def fit_ridge(
    columns: np.ndarray, training: Training, *, ridge: float | None = None, centred: bool = True
) -> RidgeFit:
    """Fit spectra to columns by weighted least squares with a penalty on the coefficients.

    Parameters
    ----------
    columns : ndarray, (n, terms)
    training : Training
        Its sigma weighs the samples.
    ridge : float, optional
        Penalty λ; that of the smallest held-out error by the training's criterion by default.
    centred : bool
        Whether an offset is fitted, which is not penalised.

    Notes
    -----
    minimises Σ w |y − x B − b|² + λ |B|²; solved by the singular values of the weighted columns.
    """
    weights = sample_weights(training)
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
    return RidgeFit(coefficients, mean_y - mean_x @ coefficients, chosen, errors[best])

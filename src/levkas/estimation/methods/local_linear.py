"""Locally weighted linear regression: a line through the nearest samples, for every pixel anew.

    ŷ = b,   minimising Σ_i w_i |y_i − b − (x_i − x) B|² + λ |B|²,   w_i = 1 / (|x_i − x| + ε)

over the nearest samples i; λ in units of their weighted spread. [liang2017]_, 10.1364/OE.25.028273.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from levkas.estimation.methods.kernel_ridge import spread
from levkas.estimation.model import in_blocks
from levkas.estimation.training import Training, require_samples, sample_weights, select_training

MOST_ANCHORS = 1000
NEIGHBOURS = 40
"""Nearest samples, or three for each coefficient where that is more, but 60 at most."""
MOST_NEIGHBOURS = 60
NEAR = 0.02
"""ε in units of the responses' spread: below it noise decides which sample is nearest."""
RIDGE = 0.01


@dataclass(frozen=True, eq=False)
class LocalModel:
    """Training samples that lines are fitted to.

    Parameters
    ----------
    anchors : ndarray, (n, channels)
    spectra : ndarray, (n, bands)
    weights : ndarray, (n,)
        Of the samples by their sigma.
    neighbours : int
    near : float
        ε, in units of the responses.
    """

    anchors: np.ndarray
    spectra: np.ndarray
    weights: np.ndarray
    neighbours: int
    near: float

    def __call__(self, responses: np.ndarray) -> tuple[np.ndarray, None]:
        (spectra,) = in_blocks(self._block, responses, self.anchors.shape[1])
        return spectra, None

    def _block(self, responses: np.ndarray) -> tuple[np.ndarray]:
        known = np.isfinite(responses).all(1)
        spectra = np.full((len(responses), self.spectra.shape[1]), np.nan)
        x = responses[known]
        square = np.square(self.anchors).sum(1) - 2 * x @ self.anchors.T
        nearest = np.argpartition(square, self.neighbours - 1, axis=1)[:, : self.neighbours]
        away = self.anchors[nearest] - x[:, None]
        weights = self.weights[nearest] / (np.linalg.norm(away, axis=2) + self.near)
        weights /= weights.sum(1, keepdims=True)
        shares = _shares(away, weights)
        spectra[known] = np.matmul(shares[:, None], self.spectra[nearest])[:, 0]
        return (spectra,)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that the model is, as arrays."""
        return {name: np.asarray(value) for name, value in vars(self).items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> LocalModel:
        """Return the model of some arrays."""
        return cls(
            arrays["anchors"],
            arrays["spectra"],
            arrays["weights"],
            int(arrays["neighbours"]),
            float(arrays["near"]),
        )


def _shares(away: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return how much each neighbour's spectrum counts in the line's value at the pixel, (m, k).

    Of sum 1: with the weighted mean d of the differences and their scatter S,
    share_i = w_i (1 − d (S + λ)⁻¹ (x_i − x − d)ᵀ).
    """
    mean = np.matmul(weights[:, None], away)
    away = away - mean
    scatter = np.matmul(np.swapaxes(away * weights[..., None], 1, 2), away)
    channels = scatter.shape[1]
    size = np.trace(scatter, axis1=1, axis2=2) / channels
    scatter[:, range(channels), range(channels)] += (RIDGE * size + 1e-12)[:, None]
    slope = np.linalg.solve(scatter, np.swapaxes(mean, 1, 2))
    return np.asarray(weights * (1 - np.matmul(away, slope)[..., 0]))


def fit_local_linear(training: Training, rng: np.random.Generator) -> LocalModel:
    """Keep the samples that lines are fitted to; `rng` draws the first of the farthest points."""
    coefficients = training.responses.shape[1] + 1
    require_samples(training, coefficients, "locally weighted regression")
    training = select_training(training, MOST_ANCHORS, rng)
    neighbours = min(max(NEIGHBOURS, 3 * coefficients), MOST_NEIGHBOURS, len(training))
    return LocalModel(
        training.responses,
        training.spectra,
        sample_weights(training),
        neighbours,
        NEAR * spread(training),
    )

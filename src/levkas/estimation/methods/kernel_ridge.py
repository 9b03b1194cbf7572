"""Kernel ridge regression with a Matérn 3/2 kernel.

    ŷ = ȳ + k(x)ᵀ (K + λ W⁻¹)⁻¹ (Y − ȳ),   k = (1 + √3 r) exp(−√3 r),   r = |x − x′| / l

[heikkinen2013]_, 10.1364/JOSAA.30.002444. W weighs the samples. Length l and ridge λ are those of the smallest
held-out error, in closed form.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from levkas.estimation.model import in_blocks
from levkas.estimation.training import (
    Training,
    held_out_errors,
    require_samples,
    sample_weights,
    select_training,
)

MOST_ANCHORS = 1500
"""Samples that carry kernels; of more the farthest points. A full-size cube takes 3·10⁹ kernels."""
TRIAL_ANCHORS = 400
"""Samples on which the length is chosen."""
LENGTHS = np.geomspace(0.5, 32, 7)
"""That are tried, in units of the responses' root mean square distance from their mean."""
RIDGES = np.logspace(-6, 1, 15)
"""That are tried, in units of the kernel's mean diagonal."""


@dataclass(frozen=True)
class Kernel:
    """A Matérn 3/2 kernel: its length, and the centre of the responses, (channels,)."""

    length: float
    centre: np.ndarray

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the kernel of all pairs, (n, channels) and (m, channels) → (n, m)."""
        a, b = (a - self.centre) / self.length, (b - self.centre) / self.length
        square_a, square_b = np.square(a).sum(1)[:, None], np.square(b).sum(1)
        r = a @ (-2 * b.T)
        r += square_a
        r += square_b
        np.maximum(r, 0, out=r)
        r *= 3
        np.sqrt(r, out=r)
        decay = np.negative(r)
        np.exp(decay, out=decay)
        r += 1
        r *= decay
        return r


@dataclass(frozen=True, eq=False)
class KernelModel:
    """``spectra = kernel(responses, anchors) @ coefficients + offset``.

    Parameters
    ----------
    anchors : ndarray, (anchors, channels)
    coefficients : ndarray, (anchors, bands)
    offset : ndarray, (bands,)
    """

    kernel: Kernel
    anchors: np.ndarray
    coefficients: np.ndarray
    offset: np.ndarray
    ridge: float

    def __call__(self, responses: np.ndarray) -> tuple[np.ndarray, None]:
        (spectra,) = in_blocks(self._block, responses, self.anchors.shape[1])
        return spectra, None

    def _block(self, responses: np.ndarray) -> tuple[np.ndarray]:
        return (self.kernel(responses, self.anchors) @ self.coefficients + self.offset,)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that the model is, as arrays."""
        own = {k: np.asarray(v) for k, v in vars(self).items() if k != "kernel"}
        return {**own, **{k: np.asarray(v) for k, v in vars(self.kernel).items()}}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> KernelModel:
        """Return the model of some arrays."""
        kernel = Kernel(float(arrays["length"]), arrays["centre"])
        return cls(
            kernel,
            arrays["anchors"],
            arrays["coefficients"],
            arrays["offset"],
            float(arrays["ridge"]),
        )


def fit_kernel_ridge(
    training: Training,
    rng: np.random.Generator,
    *,
    length: float | None = None,
    ridge: float | None = None,
) -> KernelModel:
    """Fit spectra to kernels of the responses.

    Parameters
    ----------
    rng : numpy Generator
        Draws the first of the farthest points.
    length, ridge : float, optional
        In units of the responses, and of the kernel; chosen by default.
    """
    require_samples(training, training.responses.shape[1] + 1, "kernel ridge regression")
    training = select_training(training, MOST_ANCHORS, rng)
    centre = training.responses.mean(0)
    if length is None:
        trial = select_training(training, TRIAL_ANCHORS, rng)
        kernels = [Kernel(unit * spread(training), centre) for unit in LENGTHS]
        length = min((_best_ridge(trial, k)[1], k.length) for k in kernels)[1]
    kernel = Kernel(length, centre)
    if ridge is None:
        ridge = _best_ridge(training, kernel)[0]
    offset, coefficients = solve(training, kernel, ridge)
    return KernelModel(kernel, training.responses, coefficients, offset, ridge)


def spread(training: Training) -> float:
    """Return the root mean square distance of the responses from their mean; 1 where all are equal."""
    return float(np.sqrt(training.responses.var(0).sum())) or 1.0


def solve(training: Training, kernel: Kernel, ridge: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the offset, (bands,), and the coefficients, (n, bands), of weighted kernel ridge regression."""
    weights = sample_weights(training)
    offset = weights @ training.spectra / weights.sum()
    matrix = kernel(training.responses, training.responses)
    matrix[np.diag_indices_from(matrix)] += ridge / weights
    return offset, np.linalg.solve(matrix, training.spectra - offset)


def _best_ridge(training: Training, kernel: Kernel) -> tuple[float, float]:
    """Return the ridge of the smallest held-out error, and that error."""
    weights = sample_weights(training)
    root = np.sqrt(weights)[:, None]
    targets = root * (training.spectra - weights @ training.spectra / weights.sum())
    matrix = kernel(training.responses, training.responses)
    values, vectors = np.linalg.eigh(root * matrix * root.T)
    values = np.maximum(values, np.finfo(float).tiny)
    tried = RIDGES * np.diag(matrix).mean()
    errors = held_out_errors(training, vectors, values, targets, tried)
    best = int(np.argmin(errors))
    return float(tried[best]), errors[best]

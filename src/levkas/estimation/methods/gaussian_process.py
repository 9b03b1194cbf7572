"""Gaussian process with a Matérn 3/2 kernel: spectra and their standard deviations.

    ŷ = ȳ + k(x)ᵀ (K + λI)⁻¹ (Y − ȳ),   σ² = s² c² (1 + λ − k(x)ᵀ (K + λI)⁻¹ k(x))

Length and noise λ are those of the highest marginal likelihood, with the scale s² of each band in closed
form. c makes the 95 % interval of samples that were held out hold 95 % of them: groups, where training has
them. [rasmussen2006]_, Eqs. (2.25), (2.26), (5.8); [heikkinen2018]_.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from levkas.estimation.methods.kernel_ridge import LENGTHS, RIDGES, Kernel, spread
from levkas.estimation.model import in_blocks
from levkas.estimation.training import (
    Training,
    covering,
    require_samples,
    sample_weights,
    select_training,
)

MOST_ANCHORS = 450
"""Samples that the process is conditioned on: a variance costs their square for every pixel."""
MOST_SAMPLES = 1_000
"""Farthest points on which c is measured: of all pixels, common colours near the anchors would rule it, and the
interval held 75 to 79 % instead of 86 to 90 % of another painting of other paints."""
FOLDS = 10
"""In which samples are held out for c, where there are not fewer groups."""
WIDE = 1.959964
"""Half of a 95 % interval, in standard deviations of a normal distribution."""


@dataclass(frozen=True, eq=False)
class GaussianProcessModel:
    """A process conditioned on its anchors.

    Parameters
    ----------
    noise : float
        λ, in units of the kernel.
    anchors : ndarray, (n, channels)
    coefficients : ndarray, (n, bands)
    offset : ndarray, (bands,)
    whitening : ndarray, (n, n)
        L⁻ᵀ of K + λ W⁻¹ = L Lᵀ.
    scale : ndarray, (bands,)
        s c.
    """

    kernel: Kernel
    noise: float
    anchors: np.ndarray
    coefficients: np.ndarray
    offset: np.ndarray
    whitening: np.ndarray
    scale: np.ndarray

    def __call__(self, responses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        spectra, spread_of = in_blocks(self._block, responses, self.anchors.shape[1])
        return spectra, spread_of * self.scale

    def _block(self, responses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        near = self.kernel(responses, self.anchors)
        known = np.square(near @ self.whitening).sum(1)
        variance = np.maximum(1 - known, 0) + self.noise
        return near @ self.coefficients + self.offset, np.sqrt(variance)[:, None]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that the model is, as arrays."""
        own = {k: np.asarray(v) for k, v in vars(self).items() if k != "kernel"}
        return {**own, **{k: np.asarray(v) for k, v in vars(self.kernel).items()}}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> GaussianProcessModel:
        """Return the model of some arrays."""
        kernel = Kernel(float(arrays["length"]), arrays["centre"])
        rest = ("anchors", "coefficients", "offset", "whitening", "scale")
        return cls(kernel, float(arrays["noise"]), *(arrays[name] for name in rest))


def fit_gaussian_process(training: Training, rng: np.random.Generator) -> GaussianProcessModel:
    """Learn length and noise, condition on the anchors, calibrate the interval.

    `rng` draws the first of the farthest points, and the folds where there are no groups.
    """
    require_samples(training, training.responses.shape[1] + 1, "a Gaussian process")
    training = select_training(training, MOST_SAMPLES, rng)
    chosen = covering(training, MOST_ANCHORS, rng)
    anchors = training.take(chosen)
    centre, unit = training.responses.mean(0), spread(training)
    kernels = [Kernel(length * unit, centre) for length in LENGTHS]
    likelihoods = np.array([log_likelihoods(anchors, kernel, RIDGES) for kernel in kernels])
    length, noise = np.unravel_index(likelihoods.argmax(), likelihoods.shape)
    model = condition(anchors, kernels[length], float(RIDGES[noise]))
    ratios = _held_out_ratios(training, chosen, model, _folds(training, rng))
    return replace(model, scale=model.scale * np.quantile(ratios, 0.95, axis=0) / WIDE)


def condition(training: Training, kernel: Kernel, noise: float) -> GaussianProcessModel:
    """Condition a process of given kernel and noise on samples; its interval is not calibrated."""
    weights = sample_weights(training)
    offset = weights @ training.spectra / weights.sum()
    targets = training.spectra - offset
    matrix = kernel(training.responses, training.responses)
    matrix[np.diag_indices_from(matrix)] += noise / weights
    whitening = np.linalg.inv(np.linalg.cholesky(matrix)).T
    coefficients = whitening @ (whitening.T @ targets)
    scale = np.sqrt(np.maximum((targets * coefficients).mean(0), 1e-12))
    return GaussianProcessModel(
        kernel, noise, training.responses, coefficients, offset, whitening, scale
    )


def log_likelihoods(
    training: Training, kernel: Kernel, noises: Sequence[float] | np.ndarray
) -> list[float]:
    """Return the log marginal likelihood of each noise, summed over bands, less a constant.

    Eq. (5.8) of [rasmussen2006]_ with s² of each band where it is highest.
    """
    weights = sample_weights(training)
    root = np.sqrt(weights)[:, None]
    targets = root * (training.spectra - weights @ training.spectra / weights.sum())
    matrix = kernel(training.responses, training.responses)
    values, vectors = np.linalg.eigh(root * matrix * root.T)
    turned = np.square(vectors.T @ targets)
    count, bands = targets.shape
    found = []
    for noise in noises:
        total = np.maximum(values, 0) + noise
        square = np.maximum((turned / total[:, None]).mean(0), 1e-12)
        found.append(float(-0.5 * (count * np.log(square).sum() + bands * np.log(total).sum())))
    return found


def _folds(training: Training, rng: np.random.Generator) -> np.ndarray:
    """Return the fold of each sample, (n,): its group, or several groups together."""
    groups = np.arange(len(training)) if training.groups is None else training.groups
    names, numbers = np.unique(groups, return_inverse=True)
    if len(names) == 1:
        return rng.integers(FOLDS, size=len(training))
    return np.asarray(rng.permutation(len(names))[numbers] % FOLDS)


def _held_out_ratios(
    training: Training, chosen: np.ndarray, model: GaussianProcessModel, folds: np.ndarray
) -> np.ndarray:
    """Return |error| / σ of every sample under the process that does not know its fold, (n, bands).

    `chosen` are the indices of the anchors, `folds` (n,) those of the folds.
    """
    ratios = np.empty(training.spectra.shape)
    for fold in np.unique(folds):
        held, others = folds == fold, chosen[folds[chosen] != fold]
        others = others if len(others) else chosen
        ignorant = condition(training.take(others), model.kernel, model.noise)
        spectra, sigma = replace(ignorant, scale=model.scale)(training.responses[held])
        ratios[held] = np.abs(training.spectra[held] - spectra) / sigma
    return ratios

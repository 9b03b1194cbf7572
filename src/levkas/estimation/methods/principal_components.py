"""Principal components: the responses give the weights of the spectra's first components.

    ŷ = ȳ + (x − x̄) X_c⁺ Y_c V Vᵀ,   V the first components of the training spectra

As many components as there are channels. [maloney1986]_, 10.1364/JOSAA.3.001673; [heikkinen2008]_.
"""

from __future__ import annotations

import numpy as np

from levkas.estimation.methods.linear_model import LinearModel, fit_ridge, single_channels
from levkas.estimation.training import Training, require_samples, sample_weights


def fit_principal_components(training: Training, rng: np.random.Generator) -> LinearModel:
    """Fit mean, components and the regression on their weights; `rng` is not used."""
    channels = training.responses.shape[1]
    require_samples(training, channels + 1, "principal components")
    fit = fit_ridge(training.responses, training, ridge=0.0)
    weights = sample_weights(training)
    mean = weights @ training.spectra / weights.sum()
    centred = np.sqrt(weights)[:, None] * (training.spectra - mean)
    components = np.linalg.svd(centred, full_matrices=False)[2][:channels]
    onto = components.T @ components
    offset = mean + (fit.offset - mean) @ onto
    return LinearModel(single_channels(channels), False, fit.coefficients @ onto, offset, channels)

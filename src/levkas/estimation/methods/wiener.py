"""Wiener estimation: the linear estimator of least mean square error (LMMSE).

    ŷ = ȳ + (x − x̄) (Cxx + λ/n I)⁻¹ Cxy

With the covariances of the training samples it is ridge regression on centred data; λ represents noise of the
responses beyond that of the samples. [murakami2008]_, 10.1364/OE.16.004106.
"""

from __future__ import annotations

import numpy as np

from levkas.estimation.methods.linear_model import LinearModel, fit_ridge
from levkas.estimation.training import Training, require_samples


def fit_wiener(
    training: Training, rng: np.random.Generator, *, ridge: float | None = None
) -> LinearModel:
    """Fit the estimator; λ of the smallest held-out error unless `ridge` is given, `rng` is not used."""
    require_samples(training, training.responses.shape[1] + 1, "Wiener estimation")
    return fit_ridge(training, ridge=ridge)

"""Pseudo-inverse: the linear map of least squares from responses to spectra.

    B = X⁺ Y,   ŷ = x B

Without offset or penalty; [heikkinen2008]_, 10.1364/JOSAA.25.002444.
"""

from __future__ import annotations

import numpy as np

from levkas.estimation.methods.linear_model import LinearModel, fit_ridge
from levkas.estimation.training import Training, require_samples


def fit_pseudo_inverse(training: Training, rng: np.random.Generator) -> LinearModel:
    """Fit the map of least squares; `rng` is not used.

    Examples
    --------
    >>> x = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    >>> model = fit_pseudo_inverse(Training(x, x @ [[0.2], [0.6]]), np.random.default_rng(0))
    >>> model.coefficients.round(6).tolist()
    [[0.2], [0.6]]
    """
    require_samples(training, training.responses.shape[1], "pseudo-inverse")
    return fit_ridge(training, ridge=0.0, centred=False)

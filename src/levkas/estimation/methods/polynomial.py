"""Polynomial regression: spectra are linear in products of up to three channels.

    ŷ = b + Σ_t B_t Π_{c ∈ t} x_c

Degree and ridge are those of the smallest held-out error. [connah2005]_, 10.1117/12.586315.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np

from levkas.estimation.methods.linear_model import LinearModel, expand, fit_ridge
from levkas.estimation.training import Training, require_samples

DEGREES = (1, 2, 3)
MOST_TERMS = 300
"""Of a polynomial: degree 2 of 22 channels. With more the ridge decides alone, at length."""


def fit_polynomial(training: Training, rng: np.random.Generator) -> LinearModel:
    """Fit polynomials of each degree that the samples allow, keep the best; `rng` is not used."""
    channels = training.responses.shape[1]
    require_samples(training, channels + 1, "polynomial regression")
    fits = []
    for degree in DEGREES:
        factors = products(channels, degree)
        if len(factors) > min(MOST_TERMS, len(training) - 1) and degree > 1:
            break
        fit = fit_ridge(expand(training.responses, factors, roots=False), training)
        fits.append((fit, factors))
    fit, factors = min(fits, key=lambda one: one[0].error)
    return LinearModel(factors, False, fit.coefficients, fit.offset, channels)


def products(channels: int, degree: int) -> np.ndarray:
    """Return the factors of all products of one to `degree` channels, (terms, degree); −1 is none.

    >>> products(2, 2).tolist()
    [[0, -1], [1, -1], [0, 0], [0, 1], [1, 1]]
    """
    terms = [
        (*term, *[-1] * (degree - size))
        for size in range(1, degree + 1)
        for term in combinations_with_replacement(range(channels), size)
    ]
    return np.array(terms, int)

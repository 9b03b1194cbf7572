"""Root-polynomial regression: spectra are linear in geometric means of up to three channels.

    ŷ = Σ_t B_t (Π_{c ∈ t} x_c)^(1 / |t|)

Every term grows with the exposure as the channels do, and so does the estimate.
[finlayson2015]_, 10.1109/TIP.2015.2405336.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from math import gcd

import numpy as np

from levkas.estimation.methods.linear_model import LinearModel, expand, fit_ridge
from levkas.estimation.training import Training, require_samples

DEGREES = (1, 2, 3)
MOST_TERMS = 300
"""Of a polynomial: degree 2 of 22 channels. With more the ridge decides alone, at length."""


def fit_root_polynomial(training: Training, rng: np.random.Generator) -> LinearModel:
    """Fit root-polynomials of each degree that the samples allow, keep the best; `rng` is not used."""
    channels = training.responses.shape[1]
    require_samples(training, channels, "root-polynomial regression")
    fits = []
    for degree in DEGREES:
        factors = roots(channels, degree)
        if len(factors) > min(MOST_TERMS, len(training)) and degree > 1:
            break
        columns = expand(training.responses, factors, roots=True)
        fit = fit_ridge(columns, training, centred=False)
        fits.append((fit, factors))
    fit, factors = min(fits, key=lambda one: one[0].error)
    return LinearModel(factors, True, fit.coefficients, fit.offset, channels)


def roots(channels: int, degree: int) -> np.ndarray:
    """Return the factors of different geometric means: (r r g g)^¼ is (r g)^½, r^(2/2) is r.

    >>> roots(2, 2).tolist()
    [[0, -1], [1, -1], [0, 1]]
    >>> [len(roots(3, degree)) for degree in (1, 2, 3)]
    [3, 6, 13]
    """
    terms = products(channels, degree)
    counts = [np.unique(term[term >= 0], return_counts=True)[1].tolist() for term in terms]
    return terms[[gcd(*count) == 1 for count in counts]]


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

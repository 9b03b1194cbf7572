"""Kernels of `denoising`: products of bands summed over spectra, projection to a subspace, its variance.

Sums run in the order of the spectra, whatever the threads.
"""

from __future__ import annotations

import numba
import numpy as np
from numba import types

from levkas.calibration.numba_types import readonly

TILE = 8  # bands whose sums stay in the first cache while the spectra pass by

_SPECTRA, _BASIS = readonly(types.float32), readonly(types.float64)


@numba.njit([types.void(_SPECTRA, types.float64[:, ::1])], parallel=True, cache=True)
def add_products(spectra, products):  # type: ignore[no-untyped-def]
    """Add Σ yᵢyⱼ to `products`, (b, b); only what lies on and above the diagonal is whole."""
    pixels, bands = spectra.shape
    for tile in numba.prange((bands + TILE - 1) // TILE):
        first, last = tile * TILE, min(bands, tile * TILE + TILE)
        for n in range(pixels):
            for i in range(first, last):
                value = np.float64(spectra[n, i])
                for j in range(first, bands):
                    products[i, j] += value * np.float64(spectra[n, j])


@numba.njit([types.UniTuple(types.float32[:, ::1], 2)(_SPECTRA, _BASIS)], parallel=True, cache=True)
def project(spectra, basis):  # type: ignore[no-untyped-def]
    """Return the spectra's projection on the columns of `basis`, (b, k), and what it removed."""
    pixels, bands = spectra.shape
    k = basis.shape[1]
    across = np.ascontiguousarray(basis.T)
    kept = np.empty((pixels, bands), np.float32)
    removed = np.empty((pixels, bands), np.float32)
    for n in numba.prange(pixels):
        line = np.zeros(bands)
        for c in range(k):
            part = 0.0
            for i in range(bands):
                part += spectra[n, i] * across[c, i]
            for i in range(bands):
                line[i] += part * across[c, i]
        for i in range(bands):
            kept[n, i] = line[i]
            removed[n, i] = spectra[n, i] - line[i]
    return kept, removed


@numba.njit(
    [types.float32[:, ::1](_SPECTRA, _SPECTRA, _BASIS, types.float64)], parallel=True, cache=True
)
def project_variance(variance, removed, projector, most):  # type: ignore[no-untyped-def]
    """Return the variances of projected spectra; `projector` is P = EEᵀ, (b, b).

    Σⱼ Pᵢⱼ² uⱼ²; where Σ removed² is more than `most` times what noise explains, removedᵢ² besides.
    """
    pixels, bands = variance.shape
    weights = projector * projector
    found = np.empty((pixels, bands), np.float32)
    for n in numba.prange(pixels):
        line = np.zeros(bands)
        for j in range(bands):
            spread = np.float64(variance[n, j])
            for i in range(bands):
                line[i] += weights[j, i] * spread
        away, expected = 0.0, 0.0
        for i in range(bands):
            away += np.float64(removed[n, i]) ** 2
            expected += line[i] + (1.0 - 2.0 * projector[i, i]) * np.float64(variance[n, i])
        for i in range(bands):
            more = np.float64(removed[n, i]) ** 2 if away > most * expected else 0.0
            found[n, i] = line[i] + more
    return found

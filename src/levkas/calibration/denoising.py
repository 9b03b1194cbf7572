"""Denoising by projection on the signal subspace that HySime finds, block by block of lines.

With R = Σ y yᵀ the noise of band i that no other band predicts has the power 1/(R⁻¹)ᵢᵢ: one pass suffices. Kept are the
eigenvectors e of R − Rn with −eᵀR e + 2 eᵀRn e < 0 [bioucas2008]_, doi:10.1109/TGRS.2008.918089.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from levkas.calibration.findings import refusal

CORRELATED = 0.1
"""Of neighbouring bands' noise, beyond what white noise would show; binning of two bands gives 0.5."""
MOST_KEPT = 0.45
"""Of the dimensions: beyond it noise has been taken for signal."""
MORE_PIXELS = 10
"""Than bands, times: with fewer, chance alone makes directions of noise stand out."""


class Subspace(NamedTuple):
    """Signal subspace of a cube.

    Parameters
    ----------
    basis : ndarray, (b, k), float64
        Orthonormal columns, strongest first.
    noise : ndarray, (b,), float64
        Standard deviation of the noise of each band, in the unit of the values.
    """

    basis: np.ndarray
    noise: np.ndarray

    @property
    def k(self) -> int:
        """Dimension of the subspace."""
        return int(self.basis.shape[1])


def find_subspace(blocks: Iterable[np.ndarray]) -> Subspace:
    """Find the signal subspace by HySime in one pass over blocks of spectra, (…, b); those with NaN are left out.

    Noise is taken as independent of the signal; where shot noise rules, stabilise first. The covariance of what bands leave
    each other unexplained is D P D with P = R⁻¹, D = 1/diag(P): its correlation of bands i and j is Pᵢⱼ/√(PᵢᵢPⱼⱼ), and for
    white noise that of I − EEᵀ.

    Raises CalibrationRefused, E_SIZE with fewer than 3 bands or 10 spectra a band; E_CORRELATED where the noise of neighbouring
    bands correlates by more than `CORRELATED` (binning, smoothing in the camera's software): HySime would take it for signal.
    """
    products, pixels = np.zeros((0, 0)), 0
    for block in blocks:
        spectra = _spectra(block)
        wide = spectra[np.isfinite(spectra).all(1)].astype(np.float64)
        products = wide.T @ wide + (products if products.size else 0)
        pixels += len(wide)
    bands = len(products)
    if bands < 3 or pixels < MORE_PIXELS * bands:
        raise refusal("few_spectra", str(bands), pixels, MORE_PIXELS)
    # Equilibrated: bands of a dark and of a bright wavelength differ by orders of magnitude.
    size = np.sqrt(np.maximum(np.diag(products), 1e-300))
    inverse = np.linalg.inv(products / np.outer(size, size) + 1e-12 * np.eye(bands))
    power = size**2 / np.diag(inverse) / (pixels - bands + 1)  # each is regressed on all others
    second = products / pixels
    signal = second - np.diag(power)
    vectors = np.linalg.eigh(signal)[1][:, ::-1]
    twice = 2 * np.diag(power + 1e-5 * np.trace(signal) / bands)
    gain = np.einsum("ik,ij,jk->k", vectors, twice - second, vectors)
    basis = np.ascontiguousarray(vectors[:, gain < 0])
    excess = _neighbours(inverse) - _neighbours(np.eye(bands) - basis @ basis.T)
    if abs(excess) > CORRELATED or basis.shape[1] > int(MOST_KEPT * bands):
        dimensions = f"{basis.shape[1]} of {bands}"
        raise refusal("noise_correlated", dimensions, excess, CORRELATED)
    return Subspace(basis, np.sqrt(power))


def _neighbours(covariance: np.ndarray) -> float:
    """Return the mean correlation of bands i and i + 1."""
    root = np.sqrt(np.maximum(np.diag(covariance), 1e-12))
    return float(np.mean(np.diag(covariance, 1) / (root[1:] * root[:-1])))


class Projecting:
    """Projects blocks of lines on a subspace, and gathers what that takes away.

    Rare real spectra are what projection deletes: `most`, of all blocks so far, is of the pixel that lost most the rms over
    bands of (removed/noise), little above 1 for noise, far above where rare spectra (gold, glare) were lost.

    With P = EEᵀ a denoised value has the variance Σⱼ Pᵢⱼ² uⱼ². A pixel that loses more than noise explains, Σ removed² >
    (1 + 4√(2/(b − k))) Σ u²(removed), gets what it lost, band by band, on top.
    """

    def __init__(self, subspace: Subspace) -> None:
        self.subspace, self.most = subspace, 0.0
        self._squares, self._count = np.zeros(len(subspace.noise)), 0

    @property
    def removed(self) -> np.ndarray:
        """Rms of what was taken away, band by band, of all blocks so far: that of the noise where nothing else went."""
        return np.asarray(np.sqrt(self._squares / max(self._count, 1)))

    def __call__(
        self, block: np.ndarray, variance: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return lines, (lines, samples, bands), projected, and their variance; spectra with NaN as they are."""
        spectra, basis = np.array(_spectra(block)), self.subspace.basis
        good = np.isfinite(spectra).all(1)
        whole = spectra[good].astype(np.float64)
        kept = (whole @ basis) @ basis.T
        away = whole - kept
        spectra[good] = kept
        every = np.zeros(spectra.shape)
        every[good] = away**2
        for line in every.reshape(block.shape):  # so that any blocks give one sum
            self._squares += line.sum(0)
        self._count += len(away)
        lost = np.sqrt(np.mean((away / self.subspace.noise) ** 2, axis=1))
        self.most = max(self.most, float(lost.max(initial=0.0)))
        if variance is None:
            return spectra.reshape(block.shape), None
        spread = np.array(_spectra(variance))
        projector, known = basis @ basis.T, spread[good].astype(np.float64)
        left = known @ projector**2
        expected = left.sum(1) + known @ (1 - 2 * np.diag(projector))
        chance = 1 + 4 * np.sqrt(2 / (basis.shape[0] - basis.shape[1]))
        rare = (away**2).sum(1) > chance * expected
        spread[good] = left + rare[:, None] * away**2
        return spectra.reshape(block.shape), spread.reshape(block.shape)


def describe_removed(subspace: Subspace, removed: np.ndarray, most: float) -> str:
    """Report what a projection took away, from the fields of `Projecting`."""
    share = float(np.median(removed / np.maximum(subspace.noise, 1e-12)))
    return (
        f"hysime kept {subspace.k} of {len(subspace.noise)} dimensions and removed {share:.2f} times "
        f"the noise in the median band, up to {most:.1f} times at single pixels"
    )


def _spectra(block: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(block, np.float32).reshape(-1, block.shape[-1])

"""Errors of estimated spectra, pixel by pixel, and what tables say of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from levkas.estimation import metrics
from levkas.estimation.samples import PaintSamples

METRICS = {"rmse": "RMSE", "delta_e_d65": "ΔE₀₀ D65"}
"""Key → title."""
DIGITS = 6
"""Significant digits of numbers in reports."""


@dataclass(frozen=True)
class PixelErrors:
    """Errors of one method on one test painting.

    Parameters
    ----------
    rows, columns : ndarray, (n,), int
        Places on the grid.
    metrics : dict of str to ndarray, (n,), float32
        Keys of `METRICS`; ΔE is missing where the bands do not reach through the visible.
    residuals : ndarray, (n, bands), float32
        Estimated − measured.
    measured : ndarray, (n, bands), float32
    sigma : ndarray, (n,), float32, or None
        Of the reference, root mean square over bands.
    """

    object: str
    rows: np.ndarray
    columns: np.ndarray
    metrics: dict[str, np.ndarray]
    residuals: np.ndarray
    measured: np.ndarray
    sigma: np.ndarray | None


def score_pixels(
    name: str, spectra: np.ndarray, test: PaintSamples, wavelengths: np.ndarray
) -> PixelErrors:
    """Compare estimated spectra with the measured ones."""
    errors = {"rmse": metrics.rmse(spectra, test.spectra)}
    if metrics.sees_colour(wavelengths):
        errors["delta_e_d65"] = metrics.delta_e(spectra, test.spectra, wavelengths)
    sigma = test.spectrum_sigma
    return PixelErrors(
        name, test.rows, test.columns,
        {key: values.astype(np.float32) for key, values in errors.items()},
        (spectra - test.spectra).astype(np.float32),
        test.spectra.astype(np.float32),
        None if sigma is None else np.sqrt(np.square(sigma).mean(1)).astype(np.float32),
    )  # fmt: skip


@dataclass(frozen=True)
class MethodScore:
    """One method's errors on all its test paintings.

    Parameters
    ----------
    errors : tuple of PixelErrors
        One a test painting of a fold.
    """

    method: str
    errors: tuple[PixelErrors, ...]

    def values(self, metric: str, *, name: str = "") -> np.ndarray:
        """Return the errors of all pixels, of one painting or of all."""
        chosen = [
            error.metrics[metric]
            for error in self.errors
            if name in ("", error.object) and metric in error.metrics
        ]
        return np.concatenate(chosen) if chosen else np.zeros(0, np.float32)

    @property
    def rmse(self) -> float:
        """Root mean square error over pixels and bands: what methods are ranked by."""
        return float(np.sqrt(np.square(self.values("rmse"), dtype=float).mean()))

    def summary(self, *, name: str = "") -> dict[str, dict[str, float]]:
        """Return mean, median, 95th percentile and maximum of each metric."""
        found = {}
        for metric in METRICS:
            values = self.values(metric, name=name)
            if len(values):
                found[metric] = summarise(values)
        return found

    @property
    def objects(self) -> list[str]:
        """Test paintings in order."""
        return list(dict.fromkeys(error.object for error in self.errors))

    def residuals(self) -> np.ndarray:
        """Return estimated − measured of all pixels, (n, bands)."""
        return np.concatenate([e.residuals for e in self.errors]).astype(float)

    def pairs(self, apart: int) -> tuple[np.ndarray, np.ndarray]:
        """Return which of the `residuals` lie beside one another, `apart` px or the next multiple of their lattice, (m,) each, int."""
        found, start = [], 0
        for error in self.errors:
            found.append(start + _neighbours(error.rows, error.columns, apart))
            start += len(error.rows)
        first, second = np.concatenate(found, axis=1)
        return first, second

    def by_band(self) -> np.ndarray:
        """Return the RMSE of every band."""
        return np.asarray(np.sqrt(np.square(self.residuals()).mean(0)))


def _neighbours(rows: np.ndarray, columns: np.ndarray, apart: int) -> np.ndarray:
    """Return which places lie beside one another in a row or a column, (2, m)."""
    places = np.unique(columns)
    step = int(np.diff(places).min()) if len(places) > 1 else 1
    away, width = step * -(-apart // step), int(columns.max(initial=0)) + 1
    key = rows.astype(np.int64) * 2 * (width + away) + columns
    order = np.argsort(key, kind="stable")
    found = []
    for move in (away, away * 2 * (width + away)):
        at = np.minimum(np.searchsorted(key[order], key + move), len(key) - 1)
        there = key[order][at] == key + move
        found.append(np.stack([np.flatnonzero(there), order[at[there]]]))
    return np.concatenate(found, axis=1)


def summarise(values: np.ndarray) -> dict[str, float]:
    """Return mean, median, 95th percentile and maximum of errors.

    >>> summarise(np.array([0.0, 1.0, 2.0]))
    {'mean': 1.0, 'median': 1.0, 'p95': 1.9, 'max': 2.0}
    """
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    if not len(values):
        return dict.fromkeys(("mean", "median", "p95", "max"), nan)
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": float(values.max()),
    }


def rank(errors: Sequence[float], ceiling: float) -> list[int]:
    """Return ranks from 1; what is no farther than the reference's own sigma is alike.

    >>> rank([0.03, 0.002, 0.003], 0.004)
    [3, 1, 1]
    """
    clipped = [max(error, ceiling) for error in errors]
    return [1 + sum(other < error for other in clipped) for error in clipped]


def noise_ceiling(errors: Sequence[PixelErrors]) -> float | None:
    """Return the reference's own sigma, root mean square: no score means more below it."""
    known = [e.sigma for e in errors if e.sigma is not None]
    return float(np.sqrt(np.square(np.concatenate(known), dtype=float).mean())) if known else None

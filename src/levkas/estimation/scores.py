"""Errors of estimated spectra, pixel by pixel, and what tables and curves say of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from levkas.estimation import metrics
from levkas.estimation.samples import PaintSamples

METRICS = {
    "rmse": "RMSE",
    "gfc": "goodness of fit",
    "angle_deg": "spectral angle, °",
    "delta_e_d65": "ΔE₀₀ D65",
    "delta_e_a": "ΔE₀₀ A",
    "mrae": "MRAE",
}
"""Key → title; of all but the goodness of fit less is better."""
BINS = 10
"""Of error over distance and over sigma: a tenth of the pixels each."""
WIDE = 1.959964
"""Half of a 95 % interval of a normal distribution, in standard deviations."""
DIGITS = 6
"""Significant digits of numbers in reports."""


@dataclass(frozen=True)
class PixelErrors:
    """Errors of one method on one test painting.

    Parameters
    ----------
    object : str
    rows, columns : ndarray, (n,), int
        Places on the grid.
    gold : ndarray, (n,), bool
    metrics : dict of str to ndarray, (n,), float32
        Keys of `METRICS`; ΔE is missing where the bands do not reach through the visible.
    residuals : ndarray, (n, bands), float32
        Estimated − measured.
    measured : ndarray, (n, bands), float32
    covered : ndarray, (n,), float32, or None
        Share of the bands whose measurement lies in the method's 95 % interval.
    distance : ndarray, (n,), float32
        To the nearest training sample, in standard deviations of the training responses.
    sigma : ndarray, (n,), float32, or None
        Of the reference, root mean square over bands.
    """

    object: str
    rows: np.ndarray
    columns: np.ndarray
    gold: np.ndarray
    metrics: dict[str, np.ndarray]
    residuals: np.ndarray
    measured: np.ndarray
    covered: np.ndarray | None
    distance: np.ndarray
    sigma: np.ndarray | None


def score_pixels(
    name: str,
    estimated: tuple[np.ndarray, np.ndarray | None],
    test: PaintSamples,
    wavelengths: np.ndarray,
    distance: np.ndarray,
) -> PixelErrors:
    """Compare estimated spectra, and their sigma where there is one, with the measured ones.

    The interval of an estimate holds its own sigma and that of the measurement.
    """
    spectra, sigma = estimated
    residuals = spectra - test.spectra
    covered = None
    if sigma is not None:
        own = 0.0 if test.spectrum_sigma is None else np.square(test.spectrum_sigma)
        covered = (np.abs(residuals) <= WIDE * np.sqrt(np.square(sigma) + own)).mean(1)
    reference = test.spectrum_sigma
    return PixelErrors(
        name, test.rows, test.columns, test.gold,
        {key: values.astype(np.float32) for key, values in measure_errors(spectra, test.spectra, wavelengths).items()},
        residuals.astype(np.float32),
        test.spectra.astype(np.float32),
        None if covered is None else covered.astype(np.float32),
        distance.astype(np.float32),
        None if reference is None else np.sqrt(np.square(reference).mean(1)).astype(np.float32),
    )  # fmt: skip


def measure_errors(
    estimated: np.ndarray, measured: np.ndarray, wavelengths: np.ndarray
) -> dict[str, np.ndarray]:
    """Return every metric of `METRICS` that the bands allow, pixel by pixel."""
    found = {
        "rmse": metrics.rmse(estimated, measured),
        "gfc": metrics.gfc(estimated, measured),
        "angle_deg": np.degrees(metrics.spectral_angle(estimated, measured)),
    }
    if metrics.sees_colour(wavelengths):
        for key, illuminant in (("delta_e_d65", "D65"), ("delta_e_a", "A")):
            found[key] = metrics.delta_e(estimated, measured, wavelengths, illuminant)
    return {**found, "mrae": metrics.mrae(estimated, measured)}


@dataclass(frozen=True)
class MethodScore:
    """One method's errors on all its test paintings.

    Parameters
    ----------
    method : str
    errors : tuple of PixelErrors
        One a test painting of a fold.
    seconds : float
        Of fitting and estimating; not part of any record.
    """

    method: str
    errors: tuple[PixelErrors, ...]
    seconds: float = 0.0

    def values(self, metric: str, *, gold: bool = False, name: str = "") -> np.ndarray:
        """Return the errors of all pixels of paint, or of gold, of one painting or of all."""
        chosen = [
            error.metrics[metric][error.gold == gold]
            for error in self.errors
            if name in ("", error.object) and metric in error.metrics
        ]
        return np.concatenate(chosen) if chosen else np.zeros(0, np.float32)

    @property
    def rmse(self) -> float:
        """Root mean square error over pixels and bands of paint: what methods are ranked by."""
        return float(np.sqrt(np.square(self.values("rmse"), dtype=float).mean()))

    def summary(self, *, gold: bool = False, name: str = "") -> dict[str, dict[str, float]]:
        """Return mean, median, 95th percentile and maximum of each metric; least of the goodness of fit."""
        found = {}
        for metric in METRICS:
            values = self.values(metric, gold=gold, name=name)
            if len(values):
                found[metric] = summarise(values, lower_is_worse=metric == "gfc")
        return found

    @property
    def objects(self) -> list[str]:
        """Test paintings in order."""
        return list(dict.fromkeys(error.object for error in self.errors))

    def residuals(self) -> np.ndarray:
        """Return estimated − measured of all pixels of paint, (n, bands)."""
        return np.concatenate([e.residuals[~e.gold] for e in self.errors]).astype(float)

    def pairs(self, apart: int) -> tuple[np.ndarray, np.ndarray]:
        """Return which of the `residuals` lie beside one another, `apart` px or the next multiple of their lattice, (m,) each, int."""
        found, start = [], 0
        for error in self.errors:
            rows, columns = error.rows[~error.gold], error.columns[~error.gold]
            found.append(start + _neighbours(rows, columns, apart))
            start += len(rows)
        first, second = np.concatenate(found, axis=1)
        return first, second

    def by_band(self) -> tuple[np.ndarray, np.ndarray]:
        """Return RMSE and R² of every band, over paint."""
        residuals = self.residuals()
        measured = np.concatenate([e.measured[~e.gold] for e in self.errors]).astype(float)
        squared = np.square(residuals).mean(0)
        return np.sqrt(squared), metrics.r2(measured + residuals, measured)

    def coverage(self) -> float | None:
        """Return the share of measurements of paint that lie in the method's 95 % interval."""
        known = [e.covered[~e.gold] for e in self.errors if e.covered is not None]
        return float(np.concatenate(known).mean(dtype=float)) if known else None

    def over(self, what: str) -> list[dict[str, float]]:
        """Return RMSE over `distance` or `sigma`, a tenth of the pixels a row."""
        known = [
            (getattr(e, what)[~e.gold], e.metrics["rmse"][~e.gold])
            for e in self.errors
            if getattr(e, what) is not None
        ]
        if not known:
            return []
        place, error = (np.concatenate(part).astype(float) for part in zip(*known, strict=True))
        order = np.argsort(place, kind="stable")
        rows = [chunk for chunk in np.array_split(order, BINS) if len(chunk)]
        return [
            {
                what: float(np.median(place[chunk])),
                "rmse": float(np.sqrt(np.square(error[chunk]).mean())),
            }
            for chunk in rows
        ]


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


def summarise(values: np.ndarray, *, lower_is_worse: bool = False) -> dict[str, float]:
    """Return mean, median, p95 and max of errors; of a goodness p95 is the 5th percentile and max the least.

    >>> summarise(np.array([0.0, 1.0, 2.0]))
    {'mean': 1.0, 'median': 1.0, 'p95': 1.9, 'max': 2.0}
    """
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    if not len(values):
        return dict.fromkeys(("mean", "median", "p95", "max"), nan)
    far, worst = (5, values.min()) if lower_is_worse else (95, values.max())
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, far)),
        "max": float(worst),
    }


def rank(errors: Sequence[float], ceiling: float) -> list[int]:
    """Return ranks from 1; what is no farther than the reference's own sigma is alike.

    >>> rank([0.03, 0.002, 0.003], 0.004)
    [3, 1, 1]
    """
    clipped = [max(error, ceiling) for error in errors]
    return [1 + sum(other < error for other in clipped) for error in clipped]


def noise_ceiling(errors: Sequence[PixelErrors]) -> float | None:
    """Return the reference's own sigma, root mean square over paint: no score means more below it."""
    known = [e.sigma[~e.gold] for e in errors if e.sigma is not None]
    return float(np.sqrt(np.square(np.concatenate(known), dtype=float).mean())) if known else None


def distances(training: np.ndarray, responses: np.ndarray) -> np.ndarray:
    """Return the distance of responses to the nearest training response, in its standard deviations."""
    from scipy.spatial import cKDTree

    scale = np.maximum(training.std(0), 1e-9)
    found, _ = cKDTree(training / scale).query(responses / scale)
    return np.asarray(found)


def metamer_floor(
    samples: PaintSamples, most: int, rng: np.random.Generator
) -> dict[str, float] | None:
    """Return how different spectra of equal responses are: what no method can resolve.

    Parameters
    ----------
    samples : PaintSamples
        With sigma of the responses.
    most : int
        Pixels among which pairs are looked for.

    Returns
    -------
    floor : dict or None
        `pairs`: pixels whose nearest neighbour in responses is within their noise; `rmse`: the standard
        deviation of spectra about what their responses determine, the reference's sigma taken off; `p95`.
        None where sigma is not known or no pair is that near.

    Notes
    -----
    Of a pair of equal responses, half the mean squared difference is the conditional variance.
    """
    from scipy.spatial import cKDTree

    if samples.response_sigma is None:
        return None
    paint = np.flatnonzero(~samples.gold)
    chosen = samples.take(np.sort(rng.permutation(paint)[:most]))
    assert chosen.response_sigma is not None
    scale = np.maximum(np.sqrt(np.square(chosen.response_sigma).mean(0)), 1e-9)
    near, index = cKDTree(chosen.responses / scale).query(chosen.responses / scale, k=2)
    other = np.where(index[:, 1] == np.arange(len(index)), index[:, 0], index[:, 1])
    other = _others_of_equal(chosen.responses, other, rng)
    pairs = np.flatnonzero(near[:, 1] <= np.sqrt(2 * chosen.responses.shape[1]))
    if not len(pairs):
        return None
    squared = np.square(chosen.spectra[pairs] - chosen.spectra[other[pairs]]).mean(1) / 2
    noise = 0.0 if chosen.spectrum_sigma is None else float(np.square(chosen.spectrum_sigma).mean())
    return {
        "pairs": len(pairs),
        "rmse": float(np.sqrt(max(0.0, squared.mean() - noise))),
        "p95": float(np.sqrt(max(0.0, np.percentile(squared, 95) - noise))),
    }


def _others_of_equal(
    responses: np.ndarray, other: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return `other` with, for each pixel whose responses others share to the last digit, one of those at random.

    Among coinciding points a tree names the pixel itself, and always the same few.
    """
    group = np.unique(responses, axis=0, return_inverse=True)[1].ravel()
    order = np.lexsort((rng.permutation(len(group)), group))
    ends = np.flatnonzero(np.diff(group[order], append=-1))
    after = np.roll(order, -1)
    after[ends] = order[np.r_[0, ends[:-1] + 1]]  # round in each group: all are drawn alike often
    found = other.copy()
    shared = np.bincount(group)[group[order]] > 1
    found[order[shared]] = after[shared]
    return found

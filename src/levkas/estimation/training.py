"""Training samples of spectral estimation: checks, choice, weights from sigma, and held-out residuals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from levkas.core.problems import Problem, Refused

MOST_JUDGED = 4_000
"""Samples, evenly through the training, on which parameters are judged; all are fitted to."""
MOST_CANDIDATES = 20_000
"""Samples among which the farthest points are looked for; of more, so many are drawn at random."""


ARRAYS = ("responses", "spectra", "response_sigma", "spectrum_sigma", "groups")


@dataclass(frozen=True)
class Training:
    """Samples whose responses and spectra are both known.

    Parameters
    ----------
    responses : ndarray, (n, channels)
        Reflectance-like values of the channels, white = 1.
    spectra : ndarray, (n, bands)
        Reflectance, 0 to 1; gloss may exceed 1.
    response_sigma : ndarray, (n, channels), optional
        Standard deviations of the responses, >= 0.
    spectrum_sigma : ndarray, (n, bands), optional
        Standard deviations of the spectra, >= 0.
    groups : ndarray, (n,), optional
        What is held out together when parameters are chosen: the painting or pigment of each sample.

    Raises
    ------
    Refused
        For shapes that do not fit, values that are not finite, and negative sigma.
    """

    responses: np.ndarray
    spectra: np.ndarray
    response_sigma: np.ndarray | None = None
    spectrum_sigma: np.ndarray | None = None
    groups: np.ndarray | None = None

    def __post_init__(self) -> None:
        found: dict[str, np.ndarray | None] = {k: getattr(self, k) for k in ARRAYS}
        wrong = [
            Problem(
                "E_TRAINING", "training needs finite rows, one a sample, and sigma >= 0", field=name
            )
            for name, values in found.items()
            if values is not None and not self._fits(name, values)
        ]
        if wrong:
            raise Refused(*wrong)

    def _fits(self, name: str, values: np.ndarray) -> bool:
        if name == "groups":
            return values.shape == (len(self.responses),)
        like = self.responses if name == "response_sigma" else self.spectra
        shape = values.shape if name == "responses" else (len(self.responses), *like.shape[1:])
        if values.ndim != 2 or values.shape != shape or not np.isfinite(values).all():
            return False
        return not name.endswith("sigma") or bool((values >= 0).all())

    def __len__(self) -> int:
        return len(self.responses)

    def take(self, chosen: np.ndarray) -> Training:
        """Return the samples of some indices, or of a mask."""

        parts = (getattr(self, name) for name in ARRAYS)
        return Training(*(None if values is None else values[chosen] for values in parts))  # type: ignore[arg-type]

    def judged(self) -> np.ndarray:
        """Return the indices of the samples, `MOST_JUDGED` at most, by whose errors parameters are chosen."""
        return np.arange(0, len(self), -(-len(self) // MOST_JUDGED))


def require_samples(training: Training, coefficients: int, method: str) -> None:
    """Refuse to fit more coefficients a band than there are samples."""
    if len(training) < coefficients:
        raise Refused(
            Problem(
                "E_TOO_FEW_SAMPLES",
                f"{method} fits {coefficients} coefficients a band and needs as many samples",
                found=len(training),
                expected=coefficients,
                fix="give more samples, fewer channels, or a simpler method",
            )
        )


def select_training(training: Training, count: int, rng: np.random.Generator) -> Training:
    """Choose samples that cover the space of responses: each the farthest from those chosen before.

    Parameters
    ----------
    count : int
        1,000 to 3,000 are usual; with fewer samples all are returned.
    rng : numpy Generator
        Draws the first sample, and candidates where there are very many.

    Returns
    -------
    selected : Training
        In the order of the choice: its first half covers the space too.

    Notes
    -----
    The greedy 2-approximation of the k-centre problem, [gonzalez1985]_ (10.1016/0304-3975(85)90224-5).

    Examples
    --------
    >>> line = Training(np.array([[0.0], [0.1], [0.5], [1.0]]), np.zeros((4, 1)))
    >>> select_training(line, 3, np.random.default_rng(1)).responses[:, 0].tolist()
    [0.1, 1.0, 0.5]
    """
    return training if len(training) <= count else training.take(covering(training, count, rng))


def covering(training: Training, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the indices of the samples that `select_training` chooses, (count,) or fewer, int."""
    if len(training) <= count:
        return np.arange(len(training))
    drawn = np.arange(len(training))
    if len(training) > MOST_CANDIDATES:
        drawn = np.sort(rng.choice(len(training), max(MOST_CANDIDATES, count), replace=False))
    points = training.responses[drawn]
    chosen, distance = np.empty(min(count, len(points)), int), np.full(len(points), np.inf)
    index = int(rng.integers(len(points)))
    for place in range(len(chosen)):
        chosen[place] = index
        distance = np.minimum(distance, np.square(points - points[index]).sum(1))
        index = int(distance.argmax())
    return np.asarray(drawn[chosen])


def held_out_errors(
    training: Training,
    vectors: np.ndarray,
    values: np.ndarray,
    targets: np.ndarray,
    ridges: Sequence[float] | np.ndarray,
) -> list[float]:
    """Return the weighted mean square error for each ridge, over samples held out."""
    at, weights = training.judged(), sample_weights(training)
    root = np.sqrt(weights)[at, None]
    residuals = held_out_residuals(vectors, values, targets, ridges, training.groups, at)
    found = (np.square(missed / root).mean(1) for missed in residuals)
    return [float(np.mean(weights[at] * errors)) for errors in found]


def sample_weights(training: Training) -> np.ndarray:
    """Return a weight for each sample from its sigma, mean 1.

    Returns
    -------
    weights : ndarray, (n,)
        1 / (misfit² + σ²), mean over bands; all 1 where no sigma is given. σ² is that of the spectrum and,
        through the slope of a linear fit, that of the responses; misfit² is what the linear fit leaves
        beyond it, so that samples of very small sigma do not rule alone.

    Notes
    -----
    Effective variance, Orear 1982 (10.1119/1.12972).

    Examples
    --------
    >>> training = Training(np.ones((2, 1)), np.ones((2, 1)), None, np.array([[0.1], [0.2]]))
    >>> sample_weights(training).round(2).tolist()  # 1/0.01 and 1/0.04 over their mean
    [1.6, 0.4]
    """
    if training.response_sigma is None and training.spectrum_sigma is None:
        return np.ones(len(training))
    columns = np.column_stack([training.responses, np.ones(len(training))])
    slope = np.linalg.lstsq(columns, training.spectra, rcond=None)[0]
    left = np.square(training.spectra - columns @ slope).mean()
    variance = np.zeros(len(training))
    if training.spectrum_sigma is not None:
        variance += np.square(training.spectrum_sigma).mean(1)
    if training.response_sigma is not None:
        variance += np.square(training.response_sigma) @ np.square(slope[:-1]).mean(1)
    variance += max(0.0, left - variance.mean())
    weights = 1 / np.maximum(variance, 1e-12)
    return weights / weights.mean()


def held_out_residuals(
    vectors: np.ndarray,
    values: np.ndarray,
    targets: np.ndarray,
    ridges: Sequence[float] | np.ndarray,
    groups: np.ndarray | None = None,
    at: np.ndarray | slice = slice(None),
) -> Iterator[np.ndarray]:
    """Yield what ridge regressions miss of samples that they were not fitted to, in closed form.

    Parameters
    ----------
    vectors, values : ndarray, (n, r) and (r,)
        Eigenvectors and eigenvalues of X Xᵀ, or of the kernel matrix; an infinite value is not shrunk.
    targets : ndarray, (n, bands)
    ridges : sequence of float
        > 0 where values are 0.
    groups : ndarray, (n,), optional
        Samples of one group are held out together; each by itself without, or with one group only.
    at : indices or slice
        Samples whose residuals are wanted; all are fitted to.

    Yields
    ------
    residuals : ndarray, (samples of `at`, bands)
        Of each ridge.

    Notes
    -----
    With the hat matrix H = U diag(s / (s + λ)) Uᵀ, e = (I − H) y / (1 − h) a sample and
    e_G = (I − H_GG)⁻¹ (y − H y)_G a group; [hastie2009]_, Eq. (7.64). With H_GG = V Vᵀ of few columns,
    (I − V Vᵀ)⁻¹ = I + V (I − Vᵀ V)⁻¹ Vᵀ ([woodbury1950]_), so that a group may have any number of samples.
    """
    shown, wanted = vectors[at], targets[at]
    whole = vectors.T @ targets
    single = groups is None or bool((groups == groups[0]).all())
    names = np.zeros(0) if single or groups is None else np.unique(groups)
    there = np.zeros(len(shown), int) if groups is None else np.asarray(groups)[at]
    parts = [(there == g, *_sums_of(vectors[groups == g], targets[groups == g])) for g in names]
    for ridge in ridges:
        with np.errstate(over="ignore"):  # a value near 0 is shrunk to 0
            shrunk = 1 / (1 + ridge / values)
        fitted = shrunk[:, None] * whole
        residuals = wanted - shown @ fitted
        if single:
            leverage = np.square(shown) @ shrunk
            residuals /= np.maximum(1 - leverage, 1e-9)[:, None]
        root = np.sqrt(shrunk)
        for mine, factor, turned in parts:
            # factorᵀ factor = U_Gᵀ U_G and factorᵀ turned = U_Gᵀ y_G, in as few rows as there can be
            roots = factor * root
            rest = (1 + 1e-9) * np.eye(len(roots)) - roots @ roots.T
            missed = np.linalg.solve(rest, turned - factor @ fitted)
            residuals[mine] += (shown[mine] * root) @ (roots.T @ missed)
        yield residuals


def _sums_of(rows: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a group's rows and targets, (m, r) and (m, bands), turned into r rows where there are more."""
    if len(rows) <= rows.shape[1]:
        return rows, targets
    q, factor = np.linalg.qr(rows)
    return factor, q.T @ targets

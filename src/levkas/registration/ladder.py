"""The ladder of models: similarity to quintic, lens and spline, chosen on held-out blocks.

A model is fitted to displacements that windows saw, each with its own 2 x 2 information, by
re-weighted least squares; it is judged on spatial blocks that it did not see (neighbours err
alike), and a richer one is taken only where it is better there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from levkas.registration.models import (
    Observations,
    fit_polynomial,
    fit_projective,
    fit_similarity,
    fit_spline,
    temper,
)
from levkas.transforms import Transform

FOLDS = 4
BLOCKS = 8
ROUNDS = 5
GAIN = 0.01

Fit = Callable[[Observations], Transform]

#: Name → (least number of observations, fit); from the stiffest to the most yielding.
RUNGS: dict[str, tuple[int, Fit]] = {
    "similarity": (6, fit_similarity),
    "affine": (9, partial(fit_polynomial, order=1)),
    "homography": (16, partial(fit_projective, lens=False)),
    "quadratic": (24, partial(fit_polynomial, order=2)),
    "homography+lens": (36, partial(fit_projective, lens=True)),
    "cubic": (40, partial(fit_polynomial, order=3)),
    "quartic": (60, partial(fit_polynomial, order=4)),
    "quintic": (84, partial(fit_polynomial, order=5)),
}
SPLINE_LEAST = 150
STIFF = (1e-3, 1e-2, 1e-1)


@dataclass(frozen=True)
class Rung:
    """The model that was taken, and how all of them did.

    Parameters
    ----------
    name : str
    transform : Transform
    scores : dict of str to float
        Held-out error of each model: root mean square in reference px under the weights.
    observations : Observations
        As fitted: with the common variance floor and robust weights in their information.
    weights : ndarray, (n,)
        Robust weight of each observation, 0..1.
    """

    name: str
    transform: Transform
    scores: dict[str, float]
    observations: Observations
    weights: np.ndarray


def climb(observations: Observations, *, spacing: float, highest: str | None = None) -> Rung:
    """Return the model that predicts held-out blocks best.

    Parameters
    ----------
    observations : Observations
        At least 6 of them.
    spacing : float, reference px
        Of the spline's knots; windows closer than this share a block.
    highest : str, optional
        Go no further than this rung.

    Raises
    ------
    ValueError
        With fewer observations than the lowest rung needs.
    """
    names = list(RUNGS)
    names = names[: names.index(highest) + 1] if highest else names
    names = [name for name in names if len(observations) >= RUNGS[name][0]]
    if not names:
        raise ValueError(f"a similarity needs at least 6 windows, got {len(observations)}")
    model, tempered, weights = _robust(observations, names[-1])
    folds = _folds(observations.points)
    scores: dict[str, float] = {}
    taken, best = names[0], np.inf
    for name in names:
        scores[name] = _held_out(tempered, folds, RUNGS[name][1])
        if scores[name] < best * (1 - GAIN):
            taken, best = name, scores[name]
    transform = model if taken == names[-1] else RUNGS[taken][1](tempered)
    if highest is None and len(observations) >= SPLINE_LEAST:
        for stiff in STIFF[::-1]:
            name = f"{taken}+spline({stiff:g})"
            fit = partial(_on_top, under=RUNGS[taken][1], spacing=spacing, stiff=stiff)
            scores[name] = _held_out(tempered, folds, fit)
            if scores[name] < best * (1 - GAIN):
                best, transform = scores[name], fit(tempered)
        taken = next((n for n in scores if scores[n] == best), taken)
    return Rung(taken, transform, scores, tempered, weights)


def _on_top(observations: Observations, *, under: Fit, spacing: float, stiff: float) -> Transform:
    return fit_spline(observations, under(observations), spacing, stiff)


def _robust(observations: Observations, name: str) -> tuple[Transform, Observations, np.ndarray]:
    """Re-weight under the most yielding model, so that no stiffer one declares its misfit outliers."""
    fit = RUNGS[name][1]
    current, weights = observations, np.ones(len(observations))
    model = fit(current)
    for _ in range(ROUNDS):
        residuals = observations.residuals(model)
        information, weights = temper(residuals, observations.information)
        current = Observations(
            observations.points, observations.target, observations.jacobian, information
        ).weighted(weights)
        model = fit(current)
    return model, current, weights


def _folds(points: np.ndarray) -> np.ndarray:
    low, high = points.min(0), points.max(0)
    size = max(float((high - low).max()) / BLOCKS, 1e-9)
    block = ((points - low) / size).astype(int)
    return (block[:, 0] + 2 * block[:, 1]) % FOLDS


def _held_out(observations: Observations, folds: np.ndarray, fit: Fit) -> float:
    total = weight = 0.0
    for fold in range(FOLDS):
        unseen = folds == fold
        if not unseen.any() or (~unseen).sum() < 6:
            continue
        rest = observations.part(~unseen)
        seen = observations.part(unseen)
        residuals = seen.residuals(fit(rest))
        total += float(np.einsum("na,nab,nb->", residuals, seen.information, residuals))
        weight += float(np.trace(seen.information, axis1=1, axis2=2).sum()) / 2
    return float(np.sqrt(total / (2 * weight))) if weight else np.inf

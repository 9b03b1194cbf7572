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

from levkas.registration.ledges import Ledge, find_ledge, fit_behind
from levkas.registration.models import (
    Observations,
    fit_polynomial,
    fit_projective,
    fit_similarity,
    fit_spline,
    solve_pairs,
    temper,
)
from levkas.transforms import Transform

FOLDS = 4
BLOCKS = 8
ROUNDS = 5
GAIN = 0.01
MOST_JUDGED = 2000

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
SPLINE_LEAST, LEDGE_LEAST = 150, 250
COARSE = ["similarity", "affine", "quadratic", "cubic"]
REACHING = ["similarity", "affine", "homography", "homography+lens"]
STIFF = (1e-3, 1e-2)


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
    parts : tuple of Transform
        The same model fitted without each fold of blocks.
    """

    name: str
    transform: Transform
    scores: dict[str, float]
    observations: Observations
    weights: np.ndarray
    parts: tuple[Transform, ...] = ()

    @property
    def knowledge(self) -> float:
        """All information together, 1/px², by how windows really scatter about the model."""
        return float(np.trace(self.observations.information, axis1=1, axis2=2).sum())

    def sigma(self, points: np.ndarray) -> np.ndarray:
        """Return one standard deviation of either axis at `points`, (n,), reference px.

        Delete-a-group jackknife over the folds: it sees errors that whole blocks share, which
        residuals of single windows do not.
        """
        if not self.parts:
            return np.full(len(points), np.nan)
        jacobian = self.transform.jacobian(points)
        places = np.stack([part(points) for part in self.parts])
        apart = np.stack([solve_pairs(jacobian, miss) for miss in places - places.mean(0)])
        share = (len(self.parts) - 1) / len(self.parts)
        return np.sqrt(share * (apart**2).sum((0, 2)) / 2)


def climb(
    observations: Observations,
    *,
    spacing: float,
    cell: float = 0.0,
    coarse: bool = False,
    reaching: bool = False,
    sure: int = 0,
) -> Rung:
    """Return the model that predicts held-out blocks best.

    Parameters
    ----------
    observations : Observations
        At least 6 of them.
    spacing : float, reference px
        Of the spline's knots; windows closer than this share a block.
    cell : float, reference px
        Side of the cells of the windows, for the term of a ledge; 0: none is tried.
    coarse : bool
        Polynomials up to cubic only: what is left is for a finer grid.
    reaching : bool
        Only what is tame where nothing was observed: the map has to reach far beyond.
    sure : int
        So many of the last observations keep their weight, whatever their residual.

    Raises
    ------
    ValueError
        With fewer observations than the lowest rung needs.
    """
    names = REACHING[: -1 if coarse else None] if reaching else COARSE if coarse else list(RUNGS)
    names = [name for name in names if len(observations) >= RUNGS[name][0]]
    if not names:
        raise ValueError(f"a similarity needs at least 6 windows, got {len(observations)}")
    model, tempered, weights = _robust(observations, names[-1], sure)
    # Which model is right shows in some thousands of windows; all of them decide how it lies.
    judged = tempered.part(np.arange(len(tempered)) % (1 + len(tempered) // MOST_JUDGED) == 0)
    folds = _folds(judged.points)
    scores: dict[str, float] = {}
    taken, best = names[0], np.inf
    for name in names:
        scores[name] = _held_out(judged, folds, RUNGS[name][1])
        if scores[name] < best * (1 - GAIN):
            taken, best = name, scores[name]
    fit, transform = RUNGS[taken][1], model if taken == names[-1] else None
    if not (coarse or reaching) and len(observations) >= SPLINE_LEAST:
        under = fit
        for stiff in STIFF[::-1]:
            name = f"{taken.partition('+spline')[0]}+spline({stiff:g})"
            tried = partial(_on_top, under=under, spacing=spacing, stiff=stiff)
            scores[name] = _held_out(judged, folds, tried)
            if scores[name] < best * (1 - GAIN):
                taken, best, fit, transform = name, scores[name], tried, None
        ledge = find_ledge(tempered, cell) if cell and len(observations) >= LEDGE_LEAST else None
        for name, behind in _behind(taken, under, fit, spacing, ledge) if ledge else ():
            scores[name] = _held_out(judged, folds, behind)
            if scores[name] < best * (1 - GAIN):
                taken, best, fit, transform = name, scores[name], behind, None
    parts = () if coarse else _parts(judged, folds, fit)
    return Rung(taken, transform or fit(tempered), scores, tempered, weights, parts)


def _behind(
    taken: str, under: Fit, fit: Fit, spacing: float, ledge: Ledge
) -> list[tuple[str, Fit]]:
    """What may stand behind a ledge: what was taken, without its spline, and with a stiff one."""
    plain = taken.partition("+spline")[0]
    stiff: Fit = partial(_on_top, under=under, spacing=spacing, stiff=STIFF[-1])
    kinds = {plain: under, f"{plain}+spline({STIFF[-1]:g})": stiff, taken: fit}
    return [(f"{n}+ledge", partial(fit_behind, ledge=ledge, fit=kind)) for n, kind in kinds.items()]


def _parts(observations: Observations, folds: np.ndarray, fit: Fit) -> tuple[Transform, ...]:
    groups = [folds != fold for fold in range(FOLDS)]
    return tuple(fit(observations.part(group)) for group in groups if 6 <= group.sum() < len(folds))


def _on_top(observations: Observations, *, under: Fit, spacing: float, stiff: float) -> Transform:
    return fit_spline(observations, under(observations), spacing, stiff)


def _robust(
    observations: Observations, name: str, sure: int
) -> tuple[Transform, Observations, np.ndarray]:
    """Re-weight under the most yielding model, so that no stiffer one declares its misfit outliers."""
    fit = RUNGS[name][1]
    current, weights = observations, np.ones(len(observations))
    model = fit(current)
    for _ in range(ROUNDS):
        residuals = observations.residuals(model)
        information, weights = temper(residuals, observations.information)
        weights[len(weights) - sure :] = 1.0
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

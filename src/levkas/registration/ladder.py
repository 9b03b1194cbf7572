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

#: Folds are blocks of every third row and column: nine of them.
EVERY = 3
FOLDS = EVERY**2
BLOCKS = 8
#: Side of a block, in lengths within which windows share pixels.
LEAST_BLOCK = 3.0
ROUNDS = 5
GAIN = 0.01
#: Models whose held-out error is up to so much above the best might as well be right.
NEAR = 0.1
MOST_JUDGED = 2000

Fit = Callable[[Observations], Transform]
Folds = list[tuple[np.ndarray, np.ndarray]]

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
COARSE = ["similarity", "affine", "homography", "quadratic", "homography+lens", "cubic"]
REACHING = ["similarity", "affine", "homography", "homography+lens"]
STIFF = (1e-3, 1e-2)
STANDING = "as it was"


@dataclass(frozen=True)
class Part:
    """A model fitted without some blocks, and the share of all information that these hold."""

    transform: Transform
    without: float


@dataclass(frozen=True)
class Rival:
    """Another model, and how close it comes to the one that was taken, 0..1."""

    transform: Transform
    weight: float


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
    parts : tuple of Part
        The same model fitted without each fold of blocks.
    rivals : tuple of Rival
        Models that predict blocks nearly as well.
    """

    name: str
    transform: Transform
    scores: dict[str, float]
    observations: Observations
    weights: np.ndarray
    parts: tuple[Part, ...] = ()
    rivals: tuple[Rival, ...] = ()

    @property
    def knowledge(self) -> float:
        """All information together, 1/px², by how windows really scatter about the model."""
        return float(np.trace(self.observations.information, axis1=1, axis2=2).sum())

    def sigma(self, points: np.ndarray) -> np.ndarray:
        """Return one standard deviation of either axis at `points`, (n,), reference px.

        Delete-a-group jackknife over the folds: it sees errors that whole blocks share, which
        residuals of single windows do not. Without a share f of what is known, a map moves by
        f / (1 - f) of its variance. Where windows cannot tell which model is right, how far the others
        lie from it is added: a stiff model is steady where it is wrong.
        """
        if not self.parts:
            return np.full(len(points), np.nan)
        jacobian = self.transform.jacobian(points)
        here, total = self.transform(points), np.zeros(len(points))
        for part in self.parts:
            moved = solve_pairs(jacobian, part.transform(points) - here)
            total += (1 - part.without) / part.without * (moved**2).sum(1) / 2
        variance = total / len(self.parts)
        weights = 1 + sum(rival.weight for rival in self.rivals)
        for rival in self.rivals:
            apart = solve_pairs(jacobian, rival.transform(points) - here)
            variance += rival.weight / weights * (apart**2).sum(1) / 2
        return np.sqrt(variance)


def climb(
    observations: Observations,
    *,
    spacing: float,
    apart: float = 0.0,
    cell: float = 0.0,
    coarse: bool = False,
    reaching: bool = False,
    sure: int = 0,
    standing: Transform | None = None,
) -> Rung:
    """Return the model that predicts held-out blocks best.

    Parameters
    ----------
    observations : Observations
        At least 6 of them.
    spacing : float, reference px
        Of the spline's knots.
    apart : float, reference px
        Windows up to so far from one another, along both axes, share pixels and err alike.
    cell : float, reference px
        Side of the cells of the windows, for the term of a ledge; 0: none is tried.
    coarse : bool
        Nothing richer than a cubic: what is left is for a finer grid.
    reaching : bool
        Only what is tame where nothing was observed: the map has to reach far beyond.
    sure : int
        So many of the last observations keep their weight, whatever their residual.
    standing : Transform, optional
        A map from elsewhere; it stays where no model predicts blocks better.

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
    contest = _Contest(judged, deal(judged.points, apart))
    for name in names:
        contest.enter(name, *RUNGS[name])
    if standing is not None and contest.withstands(standing):
        return Rung(STANDING, standing, contest.scores, tempered, weights)
    if contest.taken == names[-1]:
        contest.fitted = model
    if not (coarse or reaching) and len(observations) >= SPLINE_LEAST:
        under = contest.taken
        for stiff in STIFF[::-1]:
            bent = partial(_on_top, under=RUNGS[under][1], spacing=spacing, stiff=stiff)
            contest.enter(f"{under}+spline({stiff:g})", RUNGS[under][0], bent)
        ledge = find_ledge(tempered, cell) if cell and len(observations) >= LEDGE_LEAST else None
        for name, behind in _behind(contest, under, spacing, ledge) if ledge else ():
            contest.enter(name, RUNGS[under][0], behind)
    parts = () if coarse else contest.parts()
    transform = contest.fitted or contest.fit(tempered)
    rivals = () if coarse else contest.rivals()
    return Rung(contest.taken, transform, contest.scores, tempered, weights, parts, rivals)


class _Contest:
    """Which of several models predicts blocks best that it did not see.

    `scores` by name, `taken` the name of the best so far, `fit` how it is fitted, and `fitted` itself
    where that is known already.
    """

    def __init__(self, judged: Observations, folds: Folds) -> None:
        self._judged, self._folds = judged, folds
        self.scores: dict[str, float] = {}
        self._fits: dict[str, Fit] = {}
        self.taken = ""
        self.fit: Fit = fit_similarity
        self.fitted: Transform | None = None

    def enter(self, name: str, least: int, fit: Fit) -> None:
        """Try one more model, richer than those before."""
        score = self.scores[name] = _held_out(self._judged, self._folds, least, fit)
        self._fits[name] = fit
        if not self.taken or score < self.scores[self.taken] * (1 - GAIN):
            self.taken, self.fit, self.fitted = name, fit, None

    def withstands(self, standing: Transform) -> bool:
        """Tell whether a map that was not fitted to any of this is as good as the best."""
        self.scores[STANDING] = _missed(self._judged, standing)
        return not self.scores[self.taken] < self.scores[STANDING] * (1 - GAIN)

    def parts(self) -> tuple[Part, ...]:
        """Return the best model fitted without each fold, and the share of knowledge left out."""
        know = np.trace(self._judged.information, axis1=1, axis2=2)
        return tuple(
            Part(self.fit(self._judged.part(rest)), float(know[~rest].sum() / know.sum()))
            for unseen, rest in self._folds
            if unseen.any() and rest.sum() >= 6
        )

    def rivals(self) -> tuple[Rival, ...]:
        """Return the models that come within `NEAR` of the best."""
        best = self.scores[self.taken]
        close = (
            {n: 1 - (score / best - 1) / NEAR for n, score in self.scores.items()} if best else {}
        )
        return tuple(
            Rival(self._fits[name](self._judged), min(weight, 1.0))
            for name, weight in close.items()
            if weight > 0 and name != self.taken and name in self._fits
        )


def _behind(contest: _Contest, under: str, spacing: float, ledge: Ledge) -> list[tuple[str, Fit]]:
    """What may stand behind a ledge: what was taken, without its spline, and with a stiff one."""
    plain = RUNGS[under][1]
    stiff: Fit = partial(_on_top, under=plain, spacing=spacing, stiff=STIFF[-1])
    kinds = {under: plain, f"{under}+spline({STIFF[-1]:g})": stiff, contest.taken: contest.fit}
    return [(f"{n}+ledge", partial(fit_behind, ledge=ledge, fit=kind)) for n, kind in kinds.items()]


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


def deal(points: np.ndarray, apart: float = 0.0) -> Folds:
    """Return (held out, fitted), masks (n,), of every fold of blocks.

    Windows within `apart` of a held-out block are neither: they share pixels with what they would
    predict.
    """
    low, high = points.min(0), points.max(0)
    size = max(float((high - low).max()) / BLOCKS, LEAST_BLOCK * apart, 1e-9)
    number = _numbers(points - low, size)
    near = np.stack([_numbers(points - low + shift, size) for shift in _around(apart)])
    return [(number == fold, (near != fold).all(0)) for fold in range(FOLDS)]


def _around(apart: float) -> np.ndarray:
    steps = np.array([-apart, 0.0, apart])
    return np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)


def _numbers(offsets: np.ndarray, size: float) -> np.ndarray:
    block = np.floor(offsets / size).astype(int) % EVERY
    return np.asarray(block[:, 0] + EVERY * block[:, 1])


def _missed(observations: Observations, model: Transform) -> float:
    """Return the root mean square, reference px under the weights, by which a map misses."""
    residuals, information = observations.residuals(model), observations.information
    total = float(np.einsum("na,nab,nb->", residuals, information, residuals))
    return float(np.sqrt(total / np.trace(information, axis1=1, axis2=2).sum()))


def _held_out(observations: Observations, folds: Folds, least: int, fit: Fit) -> float:
    """Return the error in blocks that were not fitted; infinite where too little is left to fit."""
    total = weight = 0.0
    for unseen, rest in folds:
        if not unseen.any():
            continue
        if rest.sum() < least:
            return np.inf
        seen = observations.part(unseen)
        residuals = seen.residuals(fit(observations.part(rest)))
        total += float(np.einsum("na,nab,nb->", residuals, seen.information, residuals))
        weight += float(np.trace(seen.information, axis1=1, axis2=2).sum()) / 2
    return float(np.sqrt(total / (2 * weight))) if weight else np.inf

"""The ladder of models: similarity to quintic, lens and spline, chosen on held-out blocks.

A model is fitted to displacements that windows saw, each with its own 2 x 2 information, by
re-weighted least squares; it is judged on spatial blocks that it did not see (neighbours err
alike), and a richer one is taken only where it is better there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from levkas.geometry.transforms import Composed, Transform
from levkas.registration.cross_validation import STANDING, Contest, Fit, Part, Rival, deal
from levkas.registration.depth_steps import ORDERS, Ledge, find_ledges, fit_behind
from levkas.registration.models import (
    Observations,
    fit_polynomial,
    fit_projective,
    fit_similarity,
    fit_spline,
    solve_pairs,
    temper,
)

ROUNDS = 5
MOST_JUDGED = 2000

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
SPLINE_LEAST, LEDGE_LEAST = 150, 120
#: What is tried behind a ledge whatever did best without it → order of a polynomial as yielding.
BEHIND = {"cubic": 3, "quartic": 4}
COARSE = ["similarity", "affine", "homography", "quadratic", "homography+lens", "cubic"]
REACHING = ["similarity", "affine", "homography", "homography+lens"]
STIFF = (1e-3, 1e-2)
#: What is tried before the map of a rig; it is near already, and seen afresh in so many steps.
TWICE = 1.0
RIG, NEWTON = ("similarity", "affine", "homography", "quadratic"), 2


@dataclass(frozen=True)
class Terms:
    """On what terms models are tried; as the arguments of `climb` are called."""

    spacing: float
    apart: float = 0.0
    cell: float = 0.0
    coarse: bool = False
    reaching: bool = False
    sure: int = 0


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
    terms : Terms or None
        On which it was taken.
    fit : callable or None
        How it was fitted.
    reaching : callable or None
        Returns the models that predict blocks at most twice as badly: where nothing was seen they
        may be as right.
    """

    name: str
    transform: Transform
    scores: dict[str, float]
    observations: Observations
    weights: np.ndarray
    parts: tuple[Part, ...] = ()
    rivals: tuple[Rival, ...] = ()
    terms: Terms | None = None
    fit: Fit | None = None
    reaching: Callable[[], tuple[Rival, ...]] | None = None

    @property
    def knowledge(self) -> float:
        """All information together, 1/px², by how windows really scatter about the model."""
        return float(np.trace(self.observations.information, axis1=1, axis2=2).sum())

    def held_out(self) -> np.ndarray:
        """Return how far each window, (n,), reference px, lies from a fit without its block; NaN without one."""
        missed = np.full(len(self.observations), np.nan)
        if self.parts and self.terms is not None:
            folds = deal(self.observations.points, self.terms.apart)
            for part in self.parts:
                unseen = folds[part.fold][0]
                left = self.observations.part(unseen).residuals(part.transform)
                missed[unseen] = np.hypot(*left.T)
        return missed

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
        return np.sqrt(total / len(self.parts) + self._apart(points, self.rivals))

    def sigma_beyond(self, points: np.ndarray) -> np.ndarray:
        """Return how far models lie apart at `points`, (n,), reference px, that may be right beyond what was seen."""
        return np.sqrt(self._apart(points, self.reaching() if self.reaching else ()))

    def _apart(self, points: np.ndarray, rivals: Sequence[Rival]) -> np.ndarray:
        """Return the variance, of either axis, of `rivals` about this model, each by its weight."""
        jacobian, here = self.transform.jacobian(points), self.transform(points)
        weights = 1 + sum(rival.weight for rival in rivals)
        variance = np.zeros(len(points))
        for rival in rivals:
            apart = solve_pairs(jacobian, rival.transform(points) - here)
            variance += rival.weight / weights * (apart**2).sum(1) / 2
        return variance


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
    rig: Fit | None = None,
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
    rig : callable, optional
        Fits one map to observations and to what other captures of the same rig saw; plain models
        before it are tried too.

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
    every = 1 + len(tempered) // MOST_JUDGED
    judged = tempered.part(np.arange(len(tempered)) % every == 0)
    if rig is not None:
        judged = judged.weighted(np.full(len(judged), float(every)))
    contest = Contest(judged, deal(judged.points, apart, tempered.points))
    for name in names:
        contest.enter(name, *RUNGS[name])
    if standing is not None and contest.withstands(standing):
        return Rung(STANDING, standing, contest.scores, tempered, weights)
    if contest.taken == names[-1]:
        contest.fitted = model
    bending = not (coarse or reaching) and len(observations) >= SPLINE_LEAST
    seen = bending and cell and len(observations) >= LEDGE_LEAST
    ledges = find_ledges(tempered, cell) if seen else []
    if bending:
        _bend(contest, contest.taken, spacing, ledges)
    if rig is not None:
        through = _enter_rig(contest, rig, [name for name in RIG if name in names])
        if bending:
            _bend(contest, through, spacing, ledges)
    parts = () if coarse else contest.parts()
    transform = contest.fitted or contest.fit(tempered)
    rivals = () if coarse else contest.rivals()
    terms = Terms(spacing, apart, cell, coarse, reaching, sure)
    return Rung(
        contest.taken, transform, contest.scores, tempered, weights, parts, rivals, terms, contest.fit,
        partial(contest.rivals, TWICE),
    )  # fmt: skip


def _bend(contest: Contest, under: str, spacing: float, ledges: Sequence[Ledge]) -> None:
    """Try a model with splines of falling stiffness, then what did best and plain ones behind a ledge."""
    bent = [under]
    for stiff in STIFF[::-1]:
        bent.append(f"{under}+spline({stiff:g})")
        on_top = partial(_on_top, under=contest.fits[under], spacing=spacing, stiff=stiff)
        contest.enter(bent[-1], contest.least[under], on_top)
    best = contest.taken if contest.taken in bent else min(bent, key=lambda n: contest.scores[n])
    # Without its term richer models were needed than with it.
    plain = [name for name in BEHIND if name in contest.fits]
    for name in dict.fromkeys([*plain, *bent[:2], best]):
        order = BEHIND.get(name, ORDERS[-1])
        behind = [
            partial(fit_behind, ledge=ledge, fit=contest.fits[name], order=order)
            for ledge in ledges
        ]
        if behind:
            contest.enter(f"{name}+ledge", contest.least[name], *behind)


def _enter_rig(contest: Contest, rig: Fit, names: Sequence[str]) -> str:
    """Try the rig's map, and plain models before it; return the best of them."""
    entered = ["rig", *(f"rig+{name}" for name in names)]
    contest.enter("rig", RUNGS[names[0]][0], rig)
    for name, through in zip(names, entered[1:], strict=True):
        contest.enter(through, RUNGS[name][0], partial(_through, rig=rig, fit=RUNGS[name][1]))
    return min(entered, key=lambda name: contest.scores[name])


def _through(observations: Observations, *, rig: Fit, fit: Fit) -> Transform:
    whole = rig(observations)
    return Composed(fit(seen_through(whole, observations)), whole)


def seen_through(rig: Transform, observations: Observations) -> Observations:
    """Return where `rig` would have to be asked to answer what was observed."""
    places = observations.points
    for _ in range(NEWTON):
        places = places + solve_pairs(rig.jacobian(places), observations.target - rig(places))
    alike = np.broadcast_to(np.eye(2), (len(places), 2, 2))
    return replace(observations, target=places, jacobian=alike)


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

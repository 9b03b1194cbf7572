"""Models of the base map, and which of them is taken: blocked cross-validation.

From a similarity to a cubic, with a lens, a spline and a step in depth. A model is fitted to the shifts of
windows, each with its own 2 x 2 information, by re-weighted least squares. It is judged on spatial blocks
that it was not fitted to ([roberts2017]_): neighbouring windows err alike, so that single windows left out
are no independent evidence. A richer model is taken only where it predicts those blocks better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from levkas.geometry.transforms import Transform, solve_2x2
from levkas.registration.depth_step import ORDERS, DepthStep, find_depth_steps, fit_with_depth_step
from levkas.registration.models import (
    Observations,
    fit_polynomial,
    fit_projective,
    fit_similarity,
    fit_spline,
    scale_covariance,
)

Fit = Callable[[Observations], Transform]
Folds = list[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class SelectionSettings:
    """Constants of the selection."""

    rounds: int = 5
    """Of re-weighting observations under the most yielding model."""
    most_judged: int = 2000
    """Observations on which models are compared; all of them determine the one that is taken."""
    every: int = 3
    """A fold is every so many-th row and column of blocks."""
    blocks: int = 8
    """Across the longer side."""
    least_block: float = 3.0
    """Side of a block, in lengths within which windows share pixels."""
    gain: float = 0.01
    """Share by which a richer model has to lower the held-out error."""
    near: float = 0.1
    far: float = 1.0
    """`near`, `far`: models whose held-out error is up to so much, as a share, above the best may be right too: where
    windows were measured, and where none were."""
    least_spline: int = 150
    least_depth_step: int = 120
    """`least_spline`, `least_depth_step`: observations from which a spline, and a step in depth, are tried."""
    stiffness: tuple[float, ...] = (1e-2, 1e-3)
    """Prices of bending of the splines that are tried."""


SETTINGS = SelectionSettings()
POLYNOMIALS = {1: "affine", 2: "quadratic", 3: "cubic"}


@dataclass(frozen=True)
class ModelSpec:
    """One model of a base map.

    Examples
    --------
    >>> str(ModelSpec("homography", lens=True, spline=0.01))
    'homography+lens+spline(0.01)'
    """

    family: str
    order: int = 1
    """Of a polynomial."""
    lens: bool = False
    """Brown's radial and tangential terms behind a homography."""
    spline: float | None = None
    """Price of bending of a smooth spline before the map."""
    depth_step: bool = False
    """A step in depth before the map."""

    def __str__(self) -> str:
        plain = POLYNOMIALS[self.order] if self.family == "polynomial" else self.family
        parts = [plain] + ["lens"] * self.lens
        parts += [] if self.spline is None else [f"spline({self.spline:g})"]
        return "+".join(parts + ["depth_step"] * self.depth_step)

    @property
    def plain(self) -> ModelSpec:
        """The model without spline and step in depth."""
        return replace(self, spline=None, depth_step=False)

    @property
    def coefficients(self) -> int:
        """Coefficients of x and y each, without spline and step in depth."""
        return max(3, MODELS[self.plain][0] // 4)


SIMILARITY, HOMOGRAPHY = ModelSpec("similarity"), ModelSpec("homography")
AFFINE, QUADRATIC, CUBIC = (ModelSpec("polynomial", n) for n in POLYNOMIALS)
LENS = ModelSpec("homography", lens=True)

#: Model → (least number of observations, fit); from the stiffest to the most yielding.
MODELS: dict[ModelSpec, tuple[int, Fit]] = {
    SIMILARITY: (6, fit_similarity),
    AFFINE: (9, partial(fit_polynomial, order=1)),
    HOMOGRAPHY: (16, partial(fit_projective, lens=False)),
    QUADRATIC: (24, partial(fit_polynomial, order=2)),
    LENS: (36, partial(fit_projective, lens=True)),
    CUBIC: (40, partial(fit_polynomial, order=3)),
}
#: Under which observations are weighted, where it is no model for itself: it follows much of a step in depth.
QUINTIC: tuple[int, Fit] = (84, partial(fit_polynomial, order=5))
#: Models that are tame where nothing was observed.
STIFF = (SIMILARITY, AFFINE, HOMOGRAPHY, LENS)
#: Name of a given map that no model improves.
STANDING = "as it was"


@dataclass(frozen=True)
class SelectionTerms:
    """Models that are tried, and the lengths on which windows are compared."""

    spacing: float = 0.0
    """In reference px: of the spline's knots."""
    apart: float = 0.0
    """In reference px: windows up to so far from one another, along both axes, share pixels and err alike."""
    cell: float = 0.0
    """In reference px: side of the cells of the windows."""
    coarse: bool = False
    stiff: bool = False
    """`coarse`, `stiff`: neither spline nor step in depth, which are for finer grids; only `STIFF` models."""
    depth_step: bool = False
    """Whether a step in depth may be looked for."""
    fixed: int = 0
    """So many of the last observations keep their weight, whatever their residual."""

    def models(self, count: int) -> list[ModelSpec]:
        """Return the plain models that `count` observations determine."""
        tried = STIFF[: -1 if self.coarse else None] if self.stiff else tuple(MODELS)
        return [model for model in tried if count >= MODELS[model][0]]

    def yielding(self, count: int) -> Fit:
        """Return the fit under which `count` observations are weighted: more yielding than any model, so that none declares its misfit outliers."""
        least, fit = QUINTIC
        return (
            fit
            if count >= least and not (self.coarse or self.stiff)
            else MODELS[self.models(count)[-1]][1]
        )


@dataclass(frozen=True)
class FoldFit:
    """Model fitted without the blocks of a fold, and the share of all information that these hold."""

    transform: Transform
    without: float
    fold: int = 0


@dataclass(frozen=True)
class AlternativeModel:
    """Model whose held-out error comes close to that of the selected one, and how close, 0..1."""

    transform: Transform
    weight: float


@dataclass(frozen=True)
class SelectedModel:
    """Selected model, and the held-out errors of all."""

    spec: ModelSpec | None
    """None where a given map stayed as it was."""
    transform: Transform
    scores: dict[str, float]
    """Held-out error of each model by name: root mean square in reference px under the weights."""
    observations: Observations
    """As fitted: with the common variance floor and robust weights in their information."""
    weights: np.ndarray
    """(n,). Robust weight of each observation, 0..1."""
    terms: SelectionTerms
    folds: tuple[FoldFit, ...] = ()
    """The same model fitted without each fold of blocks."""
    alternatives: tuple[AlternativeModel, ...] = ()
    """Models that predict blocks nearly as well."""
    fit: Fit | None = None
    """How it was fitted."""
    far_alternatives: Callable[[], tuple[AlternativeModel, ...]] = tuple
    """Returns the models that predict blocks at most twice as badly: where nothing was measured they may be as right."""

    @property
    def name(self) -> str:
        """Name of the model in the record."""
        return STANDING if self.spec is None else str(self.spec)

    @property
    def held_out_error(self) -> float:
        """Root mean square, reference px under the weights, in blocks that were not fitted."""
        return float(self.scores[self.name])

    @property
    def total_information(self) -> float:
        """All information together, 1/px², by how windows scatter about the model."""
        return _total(self.observations)

    @property
    def window_sigma(self) -> float | None:
        """Median sigma of the windows' shifts, either axis, reference px; None where none is known."""
        known = np.trace(self.observations.information, axis1=1, axis2=2) / 2
        return float(np.median(known[known > 0]) ** -0.5) if (known > 0).any() else None

    def held_out(self) -> np.ndarray:
        """Return how far each window, (n,), reference px, lies from a fit without its block; NaN without one."""
        missed = np.full(len(self.observations), np.nan)
        if self.folds:
            folds = spatial_folds(self.observations.points, self.terms.apart)
            for one in self.folds:
                left_out = folds[one.fold][0]
                left = self.observations.part(left_out).residuals(one.transform)
                missed[left_out] = np.hypot(*left.T)
        return missed

    def sigma(self, points: np.ndarray) -> np.ndarray:
        """Return one standard deviation of either axis at `points`, (n,), reference px.

        Delete-a-group jackknife over the folds ([kott2001]_): it sees errors that whole blocks share,
        which residuals of single windows do not. Without a share f of the information, a map moves by
        f / (1 - f) of its variance. Where windows do not decide which model is right, the spread between
        models is added ([buckland1997]_): a stiff model is steady where it is wrong.
        """
        if not self.folds:
            return np.full(len(points), np.nan)
        jacobian = self.transform.jacobian(points)
        here, total = self.transform(points), np.zeros(len(points))
        for one in self.folds:
            moved = solve_2x2(jacobian, one.transform(points) - here)
            total += (1 - one.without) / one.without * (moved**2).sum(1) / 2
        return np.sqrt(total / len(self.folds) + self._spread(points, self.alternatives))

    def sigma_beyond(self, points: np.ndarray) -> np.ndarray:
        """Return the spread, (n,) reference px, of models that may be right beyond what was measured."""
        return np.sqrt(self._spread(points, self.far_alternatives()))

    def _spread(self, points: np.ndarray, models: Sequence[AlternativeModel]) -> np.ndarray:
        """Return the variance, of either axis, of other models about this one, each by its weight."""
        jacobian, here = self.transform.jacobian(points), self.transform(points)
        weights = 1 + sum(model.weight for model in models)
        variance = np.zeros(len(points))
        for model in models:
            apart = solve_2x2(jacobian, model.transform(points) - here)
            variance += model.weight / weights * (apart**2).sum(1) / 2
        return variance


def select_model(
    observations: Observations, terms: SelectionTerms, *, standing: Transform | None = None
) -> SelectedModel:
    """Return the model that predicts held-out blocks best.

    Raises ValueError with fewer observations than a similarity needs.

    Parameters
    ----------
    observations : Observations
        At least 6 of them.
    standing : Transform, optional
        A map from elsewhere; it stays where no model predicts blocks better.
    """
    models = terms.models(len(observations))
    if not models:
        raise ValueError(f"a similarity needs at least 6 windows, got {len(observations)}")
    weighted, weights = _reweight(observations, terms.yielding(len(observations)), terms.fixed)
    # Which model is right shows in some thousands of windows; all of them decide how it lies.
    every = 1 + len(weighted) // SETTINGS.most_judged
    judged = weighted.part(np.arange(len(weighted)) % every == 0)
    comparison = ModelComparison(judged, spatial_folds(judged.points, terms.apart, weighted.points))
    for model in models:
        least, fit = MODELS[model]
        comparison.add(model, least, fit)
    if standing is not None and comparison.is_withstood_by(standing):
        return SelectedModel(None, standing, comparison.scores, weighted, weights, terms)
    bends = not (terms.coarse or terms.stiff) and len(observations) >= SETTINGS.least_spline
    if bends:
        steps: list[DepthStep] = []
        if terms.depth_step and len(observations) >= SETTINGS.least_depth_step:
            steps = find_depth_steps(weighted, terms.cell)
        _add_bending(comparison, comparison.best, terms.spacing, steps)
    best = comparison.best
    return SelectedModel(
        best.spec, best.fit(weighted), comparison.scores, weighted, weights, terms,
        () if terms.coarse else comparison.fold_fits(),
        () if terms.coarse else comparison.alternatives(SETTINGS.near),
        best.fit, partial(comparison.alternatives, SETTINGS.far),
    )  # fmt: skip


def scattered_information(observations: Observations, terms: SelectionTerms) -> float:
    """Return the `total_information` of the model that would be selected: it is the same for all of them."""
    fit = terms.yielding(len(observations))
    return _total(_reweight(observations, fit, terms.fixed)[0])


def _total(observations: Observations) -> float:
    return float(np.trace(observations.information, axis1=1, axis2=2).sum())


@dataclass(frozen=True)
class Candidate:
    """One model in a comparison: its least number of observations, its fit and its held-out error."""

    spec: ModelSpec
    least: int
    fit: Fit
    score: float


class ModelComparison:
    """Compares models by how well they predict blocks to which they were not fitted."""

    best: Candidate

    def __init__(self, judged: Observations, folds: Folds) -> None:
        self._judged, self._folds = judged, folds
        self._parts = [(judged.part(left_out), judged.part(rest)) for left_out, rest in folds]
        self.candidates: dict[ModelSpec, Candidate] = {}
        self.scores: dict[str, float] = {}

    def add(self, spec: ModelSpec, least: int, *fits: Fit) -> Candidate:
        """Try one more model, richer than those before; of several ways to fit it the best is used."""
        # The best is wanted again without each fold, and so is what lies under a spline; others with all folds.
        fits = tuple(map(lru_cache(1 + SETTINGS.every**2), fits))
        tried = [Candidate(spec, least, fit, self._held_out_error(least, fit)) for fit in fits]
        found = min(tried, key=lambda one: one.score)
        if not self.candidates or found.score < self.best.score * (1 - SETTINGS.gain):
            self.best = found
        self.candidates[spec], self.scores[str(spec)] = found, found.score
        return found

    def _held_out_error(self, least: int, fit: Fit) -> float:
        """Return the error in blocks that were not fitted; infinite where too little is left to fit."""
        total = weight = 0.0
        for left_out, rest in self._parts:
            if not len(left_out):
                continue
            if len(rest) < least:
                return np.inf
            squares, information = _misfit(left_out, fit(rest))
            total, weight = total + squares, weight + information / 2
        return float(np.sqrt(total / (2 * weight))) if weight else np.inf

    def is_withstood_by(self, standing: Transform) -> bool:
        """Return whether a given map, which was not fitted to these observations, predicts them as well as the best model."""
        squares, information = _misfit(self._judged, standing)
        self.scores[STANDING] = float(np.sqrt(squares / information))
        return not self.best.score < self.scores[STANDING] * (1 - SETTINGS.gain)

    def fold_fits(self) -> tuple[FoldFit, ...]:
        """Return the best model fitted without each fold, and the share of information left out."""
        information = np.trace(self._judged.information, axis1=1, axis2=2)
        return tuple(
            FoldFit(
                self.best.fit(self._parts[fold][1]),
                float(information[~rest].sum() / information.sum()),
                fold,
            )
            for fold, (left_out, rest) in enumerate(self._folds)
            if left_out.any() and rest.sum() >= 6
        )

    def alternatives(self, near: float) -> tuple[AlternativeModel, ...]:
        """Return the models that come within `near` of the best, as a share of its held-out error."""
        if not self.best.score:
            return ()
        close = [
            (1 - (one.score / self.best.score - 1) / near, one)
            for one in self.candidates.values()
            if one.spec != self.best.spec
        ]
        return tuple(
            AlternativeModel(one.fit(self._judged), min(weight, 1.0))
            for weight, one in close
            if weight > 0
        )


def _misfit(observations: Observations, model: Transform) -> tuple[float, float]:
    """Return the weighted squares of what a map misses, and the trace of all information."""
    x, y = observations.residuals(model).T
    p, q, r = (observations.information[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    return float((p * x * x + 2 * q * x * y + r * y * y).sum()), float((p + r).sum())


def _add_bending(
    comparison: ModelComparison, under: Candidate, spacing: float, steps: Sequence[DepthStep]
) -> None:
    """Try a model with splines of falling stiffness, then the best and plain ones with a step in depth."""
    bent = [under]
    for price in SETTINGS.stiffness:
        fit = partial(_fit_spline_before, under=under.fit, spacing=spacing, price=price)
        bent.append(comparison.add(replace(under.spec, spline=price), under.least, fit))
    specs = [one.spec for one in bent]
    best = comparison.best
    if best.spec not in specs:
        best = min(bent, key=lambda one: one.score)
    # Without its term richer models were needed than with it.
    plain = [comparison.candidates[m] for m in (LENS, CUBIC) if m in comparison.candidates]
    for one in dict.fromkeys([*plain, *bent[:2], best]):
        if steps:
            fits = [_with_depth_step(one, step) for step in steps]
            comparison.add(replace(one.spec, depth_step=True), one.least, *fits)


def _with_depth_step(model: Candidate, step: DepthStep) -> Fit:
    """Return the fit of a model with a step in depth, which is displaced freely."""
    order = ORDERS[0] if model.spec in (LENS, CUBIC) else ORDERS[-1]
    return partial(fit_with_depth_step, step=step, fit=model.fit, order=order)


def _fit_spline_before(
    observations: Observations, *, under: Fit, spacing: float, price: float
) -> Transform:
    return fit_spline(observations, under(observations), spacing, price)


def _reweight(observations: Observations, fit: Fit, fixed: int) -> tuple[Observations, np.ndarray]:
    """Re-weight under the most yielding model, so that no stiffer one declares its misfit outliers."""
    current, weights = observations, np.ones(len(observations))
    model = fit(current)
    for _ in range(SETTINGS.rounds):
        residuals = observations.residuals(model)
        information, weights = scale_covariance(residuals, observations.information)
        weights[len(weights) - fixed :] = 1.0
        current = replace(observations, information=information).weighted(weights)
        model = fit(current)
    return current, weights


def spatial_folds(points: np.ndarray, apart: float = 0.0, over: np.ndarray | None = None) -> Folds:
    """Return (held out, fitted), masks (n,), of every fold of blocks over all of `over`, `points` without it.

    Windows within `apart` of a held-out block are neither: they share pixels with what they would
    predict.
    """
    over = points if over is None else over
    low, high = over.min(0), over.max(0)
    most = float((high - low).max()) / SETTINGS.blocks
    size = max(most, SETTINGS.least_block * apart, 1e-9)
    number = _fold_numbers(points - low, size)
    near = np.stack([_fold_numbers(points - low + shift, size) for shift in _around(apart)])
    return [(number == fold, (near != fold).all(0)) for fold in range(SETTINGS.every**2)]


def _around(apart: float) -> np.ndarray:
    steps = np.array([-apart, 0.0, apart])
    return np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)


def _fold_numbers(offsets: np.ndarray, size: float) -> np.ndarray:
    block = np.floor(offsets / size).astype(int) % SETTINGS.every
    return np.asarray(block[:, 0] + SETTINGS.every * block[:, 1])

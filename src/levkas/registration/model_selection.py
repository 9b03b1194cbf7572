"""Models of the base map, and which of them is taken: held-out blocks, and the rule of one standard error.

From a similarity to a cubic, with a lens, a spline and a step in depth, fitted to the shifts of windows, each with its own 2 x 2
information, by re-weighted least squares. Neighbouring windows err alike: a model is judged on spatial blocks that it was not fitted to
([roberts2017]_). A richer one is taken only where it predicts those better by more than the standard error of that gain, from block
to block ([hastie2009]_, section 7.10).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import NamedTuple

import numpy as np

from levkas.geometry.transforms import Transform, solve_2x2
from levkas.registration.depth_step import find_depth_steps, fit_with_depth_step
from levkas.registration.models import (
    Observations,
    fit_polynomial,
    fit_projective,
    fit_similarity,
    fit_spline,
    scale_covariance,
)

Fit = Callable[[Observations], Transform]
ROUNDS = 5
"""Of re-weighting observations under the most yielding model."""
MOST_JUDGED = 2000
"""Observations on which models are compared; all of them determine the one that is taken."""
EVERY, BLOCKS, LEAST_BLOCK = 3, 8, 3.0
"""A fold is every so many-th row and column of blocks; blocks across the longer side; least side of one, in lengths within which windows
share pixels."""
STANDARD_ERRORS = 1.0
"""By which a richer model has to predict the blocks better."""
NEAR, FAR = 0.1, 1.0
"""Models of a held-out error up to this share above the best may be right too: where windows were measured, and where none were."""
LEAST_SPLINE, LEAST_STEP = 150, 120
"""Observations from which a spline, and a step in depth, are tried."""
STIFFNESS = (1e-1, 1e-2)
"""Prices of bending of the splines that are tried; with 1e-2 and 1e-3 maps of two simulations are 2 % worse, at worst 20 %."""
STANDING = "as it was"
"""Name of a given map that no model improves."""


class MapModel(NamedTuple):
    """One model of a base map: coefficients of x and y each, least number of observations, and fit."""

    name: str
    coefficients: int
    least: int
    fit: Fit
    plain: MapModel | None = None
    """The same without a step in depth, where it has one."""


#: From the stiffest to the most yielding; under the quintic observations are weighted, so that no stiffer one declares its misfit outliers.
MODELS = (
    MapModel("similarity", 3, 6, fit_similarity),
    MapModel("homography", 4, 16, partial(fit_projective, lens=False)),
    MapModel("homography+lens", 9, 36, partial(fit_projective, lens=True)),
    MapModel("cubic", 10, 40, partial(fit_polynomial, order=3)),
)
QUINTIC = MapModel("quintic", 21, 84, partial(fit_polynomial, order=5))


@dataclass(frozen=True)
class SelectionTerms:
    """Models that are tried, and the lengths on which windows are compared."""

    spacing: float = 0.0
    apart: float = 0.0
    cell: float = 0.0
    """In reference px: between the spline's knots; up to which, along both axes, windows share pixels and err alike; side of their cells."""
    coarse: bool = False
    stiff: bool = False
    """Neither spline nor step in depth, which are for finer grids; no cubic either, which is wild where nothing was observed."""
    depth_step: bool = False
    """Whether a step in depth may be looked for."""
    fixed: int = 0
    """So many of the last observations keep their weight, whatever their residual."""

    def models(self, count: int) -> list[MapModel]:
        """Return the plain models that `count` observations determine."""
        return [one for one in MODELS[: 3 if self.stiff else None] if count >= one.least]

    def yielding(self, count: int) -> Fit:
        """Return the fit under which `count` observations are weighted."""
        plain = count < QUINTIC.least or self.coarse or self.stiff
        return (self.models(count)[-1] if plain else QUINTIC).fit


class FoldFit(NamedTuple):
    """The selected model fitted without the blocks of a fold, and the share of all information that these hold."""

    transform: Transform
    without: float
    fold: int


@dataclass(frozen=True)
class SelectedModel:
    """Selected model, and the held-out errors of all."""

    name: str
    transform: Transform
    coefficients: int
    """Of x and y each, without spline and step in depth."""
    scores: dict[str, float]
    """Held-out error of each model by name: root mean square in reference px under the weights."""
    observations: Observations
    """With the common variance floor and robust weights in their information."""
    weights: np.ndarray
    """(n,). Robust weight of each observation, 0..1."""
    terms: SelectionTerms
    comparison: ModelComparison | None = field(default=None, repr=False)
    """None on coarse grids."""

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

    @cached_property
    def folds(self) -> tuple[FoldFit, ...]:
        """The model fitted without each fold of blocks."""
        return self.comparison.fold_fits() if self.comparison else ()

    def held_out(self) -> np.ndarray:
        """Return how far each window, (n,), reference px, lies from a fit without its block; NaN without one."""
        missed = np.full(len(self.observations), np.nan)
        numbers = spatial_folds(self.observations.points, self.terms.apart)[0]
        for one in self.folds:
            left_out = numbers == one.fold
            left = self.observations.part(left_out).residuals(one.transform)
            missed[left_out] = np.hypot(*left.T)
        return missed

    def sigma(self, points: np.ndarray) -> np.ndarray:
        """Return one standard deviation of either axis at `points`, (n,), reference px.

        Delete-a-group jackknife over the folds ([kott2001]_), which sees errors that whole blocks share: without a share f of the
        information, a map moves by f / (1 - f) of its variance. Where windows do not decide which model is right, the spread between
        models is added ([buckland1997]_): a stiff one is steady where it is wrong.
        """
        if not self.folds:
            return np.full(len(points), np.nan)
        off = self._off([one.transform for one in self.folds], points)
        total = sum(
            (1 - one.without) / one.without * v for one, v in zip(self.folds, off, strict=True)
        )
        return np.asarray(np.sqrt(total / len(self.folds) + self._spread(points, NEAR)))

    def sigma_beyond(self, points: np.ndarray) -> np.ndarray:
        """Return the spread, (n,) reference px, of models that may be right beyond what was measured."""
        return np.sqrt(self._spread(points, FAR))

    def _spread(self, points: np.ndarray, near: float) -> np.ndarray:
        """Return the variance, of either axis, of other models about this one, each by its weight."""
        models = self.comparison.alternatives(near) if self.comparison else []
        total = 1 + sum(weight for _, weight in models)
        variance = np.zeros(len(points))
        for (_, weight), off in zip(
            models, self._off([one for one, _ in models], points), strict=True
        ):
            variance += weight / total * off
        return variance

    def _off(self, transforms: Sequence[Transform], points: np.ndarray) -> list[np.ndarray]:
        """Return the mean square, of either axis, (n,) px², by which other maps lie off this one at `points`."""
        jacobian, here = self.transform.jacobian(points), self.transform(points)
        return [(solve_2x2(jacobian, t(points) - here) ** 2).sum(1) / 2 for t in transforms]


def select_model(
    observations: Observations, terms: SelectionTerms, *, standing: Transform | None = None
) -> SelectedModel:
    """Return the plainest model that predicts held-out blocks as well as any; a `standing` map from elsewhere where none is better.

    Raises ValueError with fewer observations than a similarity needs, 6.
    """
    count = len(observations)
    models = terms.models(count)
    if not models:
        raise ValueError(f"a similarity needs at least 6 windows, got {count}")
    weighted, weights = _reweight(observations, terms.yielding(count), terms.fixed)
    # Which model is right shows in some thousands of windows; all of them decide how it lies.
    every = 1 + count // MOST_JUDGED
    judged = weighted.part(np.arange(count) % every == 0)
    comparison = ModelComparison(judged, terms.apart, weighted.points)
    if standing is not None:
        models.insert(0, MapModel(STANDING, 3, 0, lambda _: standing))
    for model in models:
        comparison.add(model, [model.fit])
    if not (terms.coarse or terms.stiff) and count >= LEAST_SPLINE:
        _add_bending(comparison, weighted, terms)
    best = comparison.best.model
    return SelectedModel(
        best.name, best.fit(weighted), best.coefficients, comparison.scores, weighted, weights, terms,
        None if terms.coarse else comparison,
    )  # fmt: skip


def scattered_information(observations: Observations, terms: SelectionTerms) -> float:
    """Return the `total_information` of any model that would be selected."""
    return _total(_reweight(observations, terms.yielding(len(observations)), terms.fixed)[0])


def _total(observations: Observations) -> float:
    return float(np.trace(observations.information, axis1=1, axis2=2).sum())


class Candidate(NamedTuple):
    """One model in a comparison, and the weighted squares that it misses in each observation of a block left out."""

    model: MapModel
    missed: np.ndarray
    score: float


class ModelComparison:
    """Compares models by how well they predict blocks to which they were not fitted."""

    best: Candidate

    def __init__(self, judged: Observations, apart: float, over: np.ndarray) -> None:
        self._judged = judged
        self._folds, self._blocks, near = spatial_folds(judged.points, apart, over)
        self._rest = [judged.part((near != fold).all(0)) for fold in range(EVERY**2)]
        self._information = np.trace(judged.information, axis1=1, axis2=2)
        self.candidates: list[Candidate] = []

    @property
    def scores(self) -> dict[str, float]:
        """Held-out error of each model by name."""
        return {one.model.name: one.score for one in self.candidates}

    def add(self, model: MapModel, fits: Sequence[Fit]) -> None:
        """Try one more model, by the best of its `fits`, and take it where it is better by more than the standard error of that."""
        tried = [self._try(model._replace(fit=fit)) for fit in fits]
        if not tried:
            return
        found = min(tried, key=lambda one: one.score)
        if not self.candidates or self._gain(self.best.missed, found.missed) > STANDARD_ERRORS:
            self.best = found
        self.candidates.append(found)

    def _try(self, model: MapModel) -> Candidate:
        # What lies under a spline is wanted again, with all folds.
        model = model._replace(fit=lru_cache(2 + EVERY**2)(model.fit))
        missed = np.full(len(self._judged), np.inf)
        if all(len(rest) >= model.least for rest in self._rest):
            for fold, rest in enumerate(self._rest):
                here = self._folds == fold
                if here.any():
                    missed[here] = _squares(self._judged.part(here), model.fit(rest))
        total = float(self._information.sum())
        return Candidate(model, missed, float(np.sqrt(missed.sum() / total)) if total else np.inf)

    def _gain(self, before: np.ndarray, after: np.ndarray) -> float:
        """Return by how many standard errors, from block to block, one model misses less than another."""
        if not np.isfinite(after).all():
            return -np.inf
        if not np.isfinite(before).all():
            return np.inf
        gains = np.bincount(self._blocks, before - after)
        gains = gains[np.bincount(self._blocks) > 0]
        error = float(np.sqrt(len(gains)) * gains.std(ddof=1)) if len(gains) > 1 else 0.0
        return float(gains.sum()) / max(error, 1e-300)

    def fold_fits(self) -> tuple[FoldFit, ...]:
        """Return the best model fitted without each fold, and the share of information left out."""
        total, found = self._information.sum(), []
        for fold, rest in enumerate(self._rest):
            if (self._folds == fold).any() and len(rest) >= 6:
                left = 1 - np.trace(rest.information, axis1=1, axis2=2).sum() / total
                found.append(FoldFit(self.best.model.fit(rest), float(left), fold))
        return tuple(found)

    def alternatives(self, near: float) -> list[tuple[Transform, float]]:
        """Return the models that come within `near` of the best, as a share of its held-out error, each with its weight, 0..1."""
        if not self.best.score:
            return []
        others = [one for one in self.candidates if one.model.name != self.best.model.name]
        close = [(one, 1 - (one.score / self.best.score - 1) / near) for one in others]
        return [(one.model.fit(self._judged), min(w, 1.0)) for one, w in close if w > 0]


def _squares(observations: Observations, model: Transform) -> np.ndarray:
    """Return the weighted squares, (n,), of what a map misses."""
    missed = observations.residuals(model)
    return np.einsum("na,nab,nb->n", missed, observations.information, missed)


def _add_bending(
    comparison: ModelComparison, weighted: Observations, terms: SelectionTerms
) -> None:
    """Try plain models with a step in depth, then the best of all with splines of falling stiffness, then these with a step."""
    steps = []
    if terms.depth_step and len(weighted) >= LEAST_STEP:
        steps = find_depth_steps(weighted, terms.cell)

    def add_stepped(model: MapModel) -> None:
        fits = [partial(fit_with_depth_step, step=step, fit=model.fit) for step in steps]
        comparison.add(model._replace(name=f"{model.name}+depth_step", plain=model), fits)

    for model in [one.model for one in comparison.candidates[-2:]]:
        add_stepped(model)
    best = comparison.best.model
    under = best.plain or best
    for price in STIFFNESS:
        fit = partial(_fit_bent, under=under.fit, spacing=terms.spacing, price=price)
        model = under._replace(name=f"{under.name}+spline({price:g})", fit=fit)
        if best.plain is None:
            comparison.add(model, [fit])
        else:
            add_stepped(model)


def _fit_bent(observations: Observations, *, under: Fit, spacing: float, price: float) -> Transform:
    return fit_spline(observations, under(observations), spacing, price)


def _reweight(observations: Observations, fit: Fit, fixed: int) -> tuple[Observations, np.ndarray]:
    """Re-weight under the most yielding model, so that no stiffer one declares its misfit outliers."""
    current, weights = observations, np.ones(len(observations))
    model = fit(current)
    for _ in range(ROUNDS):
        residuals = observations.residuals(model)
        information, weights = scale_covariance(residuals, observations.information)
        weights[len(weights) - fixed :] = 1.0
        current = replace(observations, information=information).weighted(weights)
        model = fit(current)
    return current, weights


def spatial_folds(
    points: np.ndarray, apart: float = 0.0, over: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the fold and the block of each point, (n,), by number, and the folds, (9, n), of windows within `apart`; blocks lie over `over`."""
    over = points if over is None else over
    low, high = over.min(0), over.max(0)
    size = max(float((high - low).max()) / BLOCKS, LEAST_BLOCK * apart, 1e-9)
    around = apart * np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), -1).reshape(-1, 1, 2)
    block = np.floor((points - low + around) / size).astype(int)
    fold = block[..., 0] % EVERY + EVERY * (block[..., 1] % EVERY)
    return fold[4], block[4, :, 0] + (BLOCKS + 1) * block[4, :, 1], fold

"""Which of several models predicts blocks of windows best that it did not see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from levkas.geometry.transforms import Transform
from levkas.registration.models import Observations, fit_similarity

#: Folds are blocks of every third row and column: nine of them.
EVERY = 3
FOLDS = EVERY**2
BLOCKS = 8
#: Side of a block, in lengths within which windows share pixels.
LEAST_BLOCK = 3.0
GAIN = 0.01
#: Models whose held-out error is up to so much above the best might as well be right.
NEAR = 0.1
STANDING = "as it was"

Fit = Callable[[Observations], Transform]
Folds = list[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Part:
    """A model fitted without the blocks of a fold, and the share of all information that these hold."""

    transform: Transform
    without: float
    fold: int = 0


@dataclass(frozen=True)
class Rival:
    """Another model, and how close it comes to the one that was taken, 0..1."""

    transform: Transform
    weight: float


class Contest:
    """Which of several models predicts blocks best that it did not see.

    `scores`, `fits` and the `least` observations of each by name, `taken` the name of the best so far,
    `fit` how it is fitted, and `fitted` itself where that is known already.
    """

    def __init__(self, judged: Observations, folds: Folds) -> None:
        self._judged, self._folds = judged, folds
        self.scores: dict[str, float] = {}
        self.fits: dict[str, Fit] = {}
        self.least: dict[str, int] = {}
        self.taken = ""
        self.fit: Fit = fit_similarity
        self.fitted: Transform | None = None

    def enter(self, name: str, least: int, *fits: Fit) -> None:
        """Try one more model, richer than those before; of several ways to fit it the best stands for it."""
        tried = [(_held_out(self._judged, self._folds, least, fit), fit) for fit in fits]
        score, fit = min(tried, key=lambda one: one[0])
        self.scores[name], self.fits[name], self.least[name] = score, fit, least
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
            Part(self.fit(self._judged.part(rest)), float(know[~rest].sum() / know.sum()), fold)
            for fold, (unseen, rest) in enumerate(self._folds)
            if unseen.any() and rest.sum() >= 6
        )

    def rivals(self, near: float = NEAR) -> tuple[Rival, ...]:
        """Return the models that come within `near` of the best, as a share of its held-out error."""
        best = self.scores[self.taken]
        close = (
            {n: 1 - (score / best - 1) / near for n, score in self.scores.items()} if best else {}
        )
        return tuple(
            Rival(self.fits[name](self._judged), min(weight, 1.0))
            for name, weight in close.items()
            if weight > 0 and name != self.taken and name in self.fits
        )


def deal(points: np.ndarray, apart: float = 0.0, over: np.ndarray | None = None) -> Folds:
    """Return (held out, fitted), masks (n,), of every fold of blocks over all of `over`, `points` without it.

    Windows within `apart` of a held-out block are neither: they share pixels with what they would
    predict.
    """
    over = points if over is None else over
    low, high = over.min(0), over.max(0)
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

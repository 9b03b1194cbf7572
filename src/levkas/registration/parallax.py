"""Plane and parallax: the map between two cameras that see a panel which is not flat.

A plane is mapped by a homography H, and what lies off it by a height z is displaced besides, along one direction, by as
much as it is high ([hartley2004]_, section 13.3): p ↦ L(H(p + z(p) · (a + b u))), with u = (p − centre) / spread and a
lens L. A warped panel is a quadric, z = z₁ u² + z₂ uv + z₃ v²; a centre that is lowered behind a ledge adds one height
inside it. All heights share the direction (a, b): where the warp of the border is displaced to, the centre is too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.geometry.transforms import Composed, Polynomial, Transform, exponents
from levkas.registration.models import (
    Normalisation,
    Observations,
    linearise,
    projective_parameters,
    weight_roots,
)

if TYPE_CHECKING:
    from levkas.registration.depth_step import DepthStep

#: Plane, heights and direction of a fit.
Parallax = tuple[np.ndarray, np.ndarray, np.ndarray]
#: Rounds of Gauss-Newton, at most; share of the squares that a round takes without which it is the last.
ROUNDS, CONVERGED = 20, 1e-3
#: Of the first round, as a share of the diagonal; ten times as much makes a round more.
DAMPING = 1e-5
#: Directions that are tried over half a sphere in the first round, and halvings of the search from the best of them.
DIRECTIONS, HALVINGS = 200, 8
AROUND = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
#: Of the heights along one direction, as a share of their squares.
RIDGE = 1e-9
#: Parameters of a homography with a lens.
PLANE = 12


def fit_parallax(observations: Observations, step: DepthStep | None = None) -> Transform:
    """Fit homography, lens, the heights of the panel and the direction of their parallax.

    Parameters
    ----------
    observations : Observations
    step : DepthStep, optional
        Where the centre of the panel is lowered.
    """
    fit = _ParallaxFit(observations, step)
    plane = projective_parameters(observations, fit.frames, PLANE)
    best = plane, np.zeros(fit.heights.shape[1]), np.zeros(3)
    residual, slopes = fit.linearised(*best)
    damping = DAMPING
    for _ in range(ROUNDS):
        tried = _solve(slopes, residual, best, damping)
        after, turned = fit.linearised(*tried)
        before, now = float(residual @ residual), float(after @ after)
        if not now < before:
            damping *= 10
            continue
        best, residual, slopes, damping = tried, after, turned, damping / 10
        if before - now < CONVERGED * before:
            break
    return fit.transform(*best)


def _solve(slopes: np.ndarray, residual: np.ndarray, before: Parallax, damping: float) -> Parallax:
    """Return the plane, heights and direction, of unit length, that leave least of the residual, damped ([marquardt1963]_)."""
    products = np.outer(*before[1:]).ravel()
    normal, right = slopes.T @ slopes, slopes.T @ residual
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    normal = normal * scale[:, None] * scale + damping * np.eye(len(scale))
    right = scale * right - normal[:, PLANE:] @ (products / scale[PLANE:])
    # What the plane takes of every column is taken out of it first.
    part, mixed = normal[:PLANE, :PLANE], normal[:PLANE, PLANE:]
    taken = np.linalg.solve(part, np.column_stack([mixed, right[:PLANE]]))
    inner = normal[PLANE:, PLANE:] - mixed.T @ taken[:, :-1]
    goal = right[PLANE:] - mixed.T @ taken[:, -1]
    unscaled = 1 / scale[PLANE:]
    inner, goal = inner * unscaled[:, None] * unscaled, goal * unscaled
    towards = _direction(inner, goal, before[2])
    heights, _ = _heights(inner, goal, towards[None])
    products = np.outer(heights[0], towards).ravel()
    move = -scale[:PLANE] * (taken[:, -1] + taken[:, :-1] @ (products * unscaled))
    return before[0] + move, heights[0], towards


def _direction(inner: np.ndarray, goal: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return the direction, (3,), along which heights explain most; `before` is none, or one that is near."""
    best = before
    if not before.any():
        n = np.arange(DIRECTIONS) + 0.5
        up, turn = n / DIRECTIONS, n * np.pi * (1 + 5**0.5)
        level = np.sqrt(1 - up**2)
        tried = np.stack([level * np.cos(turn), level * np.sin(turn), up], 1)
        best = tried[_heights(inner, goal, tried)[1].argmax()]
    size = 0.1
    for _ in range(HALVINGS):
        around = best + size * AROUND
        around /= np.linalg.norm(around, axis=1, keepdims=True)
        gains = _heights(inner, goal, around)[1]
        best = around[gains.argmax()]
        size = size if gains.argmax() else size / 2
    return best


def _heights(
    inner: np.ndarray, goal: np.ndarray, towards: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights, (n, k), that explain most along each direction, (n, 3), and how much, (n,)."""
    k = len(goal) // 3
    of_pairs = inner.reshape(k, 3, k, 3).transpose(1, 3, 0, 2).reshape(9, k * k)
    square = ((towards[:, :, None] * towards[:, None]).reshape(-1, 9) @ of_pairs).reshape(-1, k, k)
    side = towards @ goal.reshape(k, 3).T
    diagonal = square.reshape(-1, k * k)[:, :: k + 1]
    diagonal += RIDGE * diagonal.sum(1, keepdims=True)
    found = -np.linalg.solve(square, side[..., None])[..., 0]
    return found, -np.einsum("ni,ni->n", found, side)


class _ParallaxFit:
    """Residuals of a plane with parallax under the weights of observations, and their slopes."""

    def __init__(self, observations: Observations, step: DepthStep | None) -> None:
        self.step, self.frames = step, Normalisation.of(observations)
        self.places = self.frames.places(observations)
        self.goals, self.roots = self.frames.goals(observations)
        (u, v), ones, nil = self.places.T, np.ones(len(observations)), np.zeros(len(observations))
        heights = [u * u, u * v, v * v]
        if step is not None:
            heights.append(step.window_share(observations.points))
        self.heights = np.stack(heights, 1)
        self.parts = np.stack([np.stack([ones, nil, u], 1), np.stack([nil, ones, v], 1)], 1)
        products = self.heights[:, None, :, None] * self.parts[:, :, None, :]
        information = np.ascontiguousarray(observations.information)
        identity = np.ascontiguousarray(np.broadcast_to(np.eye(2), self.roots.shape))
        weights = weight_roots(information, identity, self.frames.spread)
        self.columns = -(weights @ products.reshape(len(u), 2, -1)).reshape(2 * len(u), -1)

    def linearised(
        self, plane: np.ndarray, heights: np.ndarray, towards: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the weighted residuals, (2n,), and their slopes by plane, and by heights times direction."""
        shifts = np.einsum("nad,nd->na", self.parts, np.outer(self.heights @ heights, towards))
        places = self.places + shifts
        residual = np.empty(2 * len(places))
        slopes = np.empty((len(residual), PLANE))
        linearise(places, self.goals, self.roots, plane, residual, slopes)
        return residual, np.column_stack([slopes, self.columns])

    def transform(self, plane: np.ndarray, heights: np.ndarray, towards: np.ndarray) -> Transform:
        """Return the map: step in depth, warp as a cubic, homography and lens."""
        frames, terms = self.frames, exponents(3)
        coefficients = np.zeros((len(terms), 2))
        for height, (i, j) in zip(heights, ((2, 0), (1, 1), (0, 2)), strict=False):
            coefficients[terms.index((i, j))] += height * towards[:2]
            for axis, term in enumerate(((i + 1, j), (i, j + 1))):
                coefficients[terms.index(term), axis] += height * towards[2]
        coefficients[1:3] += np.eye(2)
        coefficients *= frames.spread
        coefficients[0] += frames.centre
        cubic = Polynomial(3, frames.centre, frames.spread, coefficients)
        rest = Composed(cubic, frames.projective(plane))
        if self.step is None:
            return rest
        return Composed(self.step.displacing(self._shift(heights[-1], towards)), rest)

    def _shift(self, height: float, towards: np.ndarray) -> np.ndarray:
        """Return the displacement of the step, (3, 2) px of 1, u, v in its own coordinates."""
        assert self.step is not None
        frames, step = self.frames, self.step
        offset = (step.centre - frames.centre) / frames.spread
        even = towards[:2] + towards[2] * offset
        growing = towards[2] * step.spread / frames.spread * np.eye(2)
        return np.asarray(frames.spread * height * np.vstack([even, growing]))

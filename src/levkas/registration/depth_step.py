"""A step in depth: finding where a panel is recessed, and fitting maps with its displacement.

No polynomial follows a step in depth. Where it lies is looked for as the rectangle whose inside, displaced
and scaled, takes most from what a cubic leaves (a quintic follows much of a step itself); what it
displaces is fitted with every map anew. A window sees the mean of its pixels: the step is averaged over
the window before it is compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from levkas.geometry.depth_step import DepthStepShift
from levkas.geometry.pixel_maps_kernel import share_inside
from levkas.geometry.transforms import Composed, Transform, design_matrix, frame_of, solve_2x2
from levkas.registration.models import Observations, fit_polynomial


@dataclass(frozen=True)
class DepthStepSettings:
    """Constants of the search."""

    narrowest: float = 0.04
    widest: float = 0.3
    """`narrowest`, `widest`: margins that are tried, shares of the shorter side of what was observed."""
    margins: int = 14
    """How many."""
    least_width: float = 2.0
    most_width: float = 4.0
    """`least_width`, `most_width`: in cells: of the slope: narrower ones than windows resolve are laid at two cells."""
    near: float = 0.1
    """In cells: two steps whose sides lie closer are one."""
    halvings: int = 5
    turns: int = 2
    """`halvings`, `turns`: of the search's steps; of fitting the step and the rest in turns."""
    most_searched: int = 2000
    """Windows among which a step is looked for."""
    least_gain: float = 150.0
    """Weighted squares that a step has to explain, in units of the windows' variance. The best rectangle takes some tens by
    chance alone; the step of a simulated panel takes 200 to 1400."""


SETTINGS = DepthStepSettings()
#: Orders of the polynomial beside which a step is looked for: a cubic follows little of it, a quintic
#: more of a lens.
ORDERS = (3, 5)
#: Columns of 1, u, v that displace along x, and along y.
ALONG = ([0, 1], [0, 2])
#: A window is three cells wide, the middle one weighs as much as the two others.
OFFSETS = np.arange(-4, 5) / 3
WEIGHTS = np.repeat([0.25, 0.5, 0.25], 3) / 3


@dataclass(frozen=True)
class DepthStep:
    """Place of a step in depth, reference px."""

    edges: np.ndarray
    """(6,). Left, right, top and bottom begin of the slope about `centre`, the width of the slope, and by how much it is
    turned, radians."""
    centre: np.ndarray
    spread: float
    cell: float
    """Side of a window's cell."""

    def window_share(self, points: np.ndarray) -> np.ndarray:
        """Return the share of each window, (n,), that the recessed part makes up, slope included."""
        offsets, points = OFFSETS * self.cell, np.ascontiguousarray(points)
        return np.asarray(share_inside(points, self.edges, self.centre, offsets, WEIGHTS))

    def is_near(self, other: DepthStep) -> bool:
        """Whether no side lies farther off than windows resolve."""
        return bool(np.abs(self.edges[:5] - other.edges[:5]).max() < SETTINGS.near * self.cell)

    def columns(self, points: np.ndarray) -> np.ndarray:
        """Return the share of each window times 1, u, v, (n, 3)."""
        terms = np.column_stack([np.ones(len(points)), (points - self.centre) / self.spread])
        return np.asarray(self.window_share(points)[:, None] * terms)

    def displacing(self, shift: np.ndarray) -> DepthStepShift:
        """Return the displacement, (3, 2) px of 1, u, v, as a transform."""
        left, right, top, bottom, width, turned = self.edges
        c, s = np.cos(turned), np.sin(turned)
        normals = np.array([[c, s], [-c, -s], [-s, c], [s, -c]])
        begins = np.array([-left, right, -top, bottom]) - normals @ self.centre
        lines = np.column_stack([normals, begins])
        return DepthStepShift(lines, float(width), self.centre, self.spread, shift)


def find_depth_steps(observations: Observations, cell: float) -> list[DepthStep]:
    """Return the steps found beside polynomials of either order, the same one once."""
    found: list[DepthStep] = []
    for order in ORDERS:
        step = find_depth_step(observations, cell, order)
        if step is not None and not any(step.is_near(other) for other in found):
            found.append(step)
    return found


def find_depth_step(
    observations: Observations, cell: float, order: int = ORDERS[0]
) -> DepthStep | None:
    """Return where a step would explain most; None where none explains enough.

    Parameters
    ----------
    cell : float, reference px
        Side of the cells of which a window has three by three.
    order : int
        Of the polynomial that models all else.
    """
    every = 1 + len(observations) // SETTINGS.most_searched
    left = _Residual(observations.part(np.arange(len(observations)) % every == 0), order)
    low, high = observations.points.min(0), observations.points.max(0)
    half, middle = (high - low) / 2, (high + low) / 2
    centre, spread = frame_of(observations.points)
    best, most = None, 0.0
    for share in np.linspace(SETTINGS.narrowest, SETTINGS.widest, SETTINGS.margins):
        margin = share * 2 * half.min()
        x, y = half - margin
        if min(x, y) < 3 * cell:
            break
        off = middle - centre
        edges = np.array([off[0] - x, off[0] + x, off[1] - y, off[1] + y, 2.0 * cell, 0.0])
        tried = DepthStep(edges, centre, spread, cell)
        gain = left.explained(tried)
        if gain > most:
            best, most = tried, gain
    if best is None:
        return None
    best, most = _descend(left, best, most)
    return best if every * most > SETTINGS.least_gain else None


def _descend(left: _Residual, best: DepthStep, most: float) -> tuple[DepthStep, float]:
    """Move one edge at a time while that explains more, by ever smaller steps."""
    steps = np.array([1.5, 1.5, 1.5, 1.5, 0.8, 1.5]) * best.cell
    steps[5] /= 2 * best.spread
    for _ in range(SETTINGS.halvings):
        for _ in range(3):
            before = most
            for k, sign in [(k, sign) for k in range(6) for sign in (-1, 1)]:
                tried = _moved(best, k, sign * steps[k])
                gain = left.explained(tried)
                if gain > most:
                    best, most = tried, gain
            if most - before < 1e-3 * most:
                break
        steps = steps / 2
    return best, most


def _moved(step: DepthStep, k: int, by: float) -> DepthStep:
    edges = step.edges.copy()
    edges[k] += by
    edges[4] = np.clip(edges[4], SETTINGS.least_width * step.cell, SETTINGS.most_width * step.cell)
    return replace(step, edges=edges)


class _Residual:
    """Residuals of a polynomial, and how much of them a step explains."""

    def __init__(self, observations: Observations, order: int) -> None:
        self.points = observations.points
        self.root = np.sqrt(np.trace(observations.information, axis1=1, axis2=2) / 2)[:, None]
        design = design_matrix(self.points, order, *frame_of(self.points))
        self.basis = np.linalg.qr(self.root * design)[0]
        residuals = observations.residuals(fit_polynomial(observations, order))
        self.rest = self._projected(self.root * residuals)

    def _projected(self, columns: np.ndarray) -> np.ndarray:
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def shift(self, step: DepthStep) -> np.ndarray:
        """Return the displacement, (3, 2) px, that explains most."""
        return _fit_shift(self._projected(self.root * step.columns(self.points)), self.rest)

    def explained(self, step: DepthStep) -> float:
        """Return by how much the weighted squares fall."""
        columns = self._projected(self.root * step.columns(self.points))
        return sum(
            float(((np.linalg.qr(columns[:, of])[0].T @ self.rest[:, axis]) ** 2).sum())
            for axis, of in enumerate(ALONG)
        )


def _fit_shift(columns: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the displacement, (3, 2), by least squares: along either axis evenly, and growing along it.

    What lies deeper appears displaced and smaller; neither turns it.
    """
    shift = np.zeros((3, 2))
    for axis, of in enumerate(ALONG):
        shift[of, axis] = np.linalg.lstsq(columns[:, of], goal[:, axis], rcond=1e-6)[0]
    return shift


def fit_with_depth_step(
    observations: Observations,
    step: DepthStep,
    fit: Callable[[Observations], Transform],
    order: int = ORDERS[-1],
) -> Transform:
    """Fit the displacement of a step, and by `fit` the map of the rest, in turns.

    What a polynomial of `order`, about as yielding as the map, leaves gives the first displacement.
    """
    left, columns = _Residual(observations, order), step.columns(observations.points)
    shift, weighted = left.shift(step), left.root * columns
    for _ in range(SETTINGS.turns):
        moved = observations.points + columns @ shift
        rest = fit(replace(observations, points=moved))
        miss = solve_2x2(rest.jacobian(moved), observations.target - rest(moved))
        shift = shift + _fit_shift(weighted, left.root * miss)
    moved = observations.points + columns @ shift
    return Composed(step.displacing(shift), fit(replace(observations, points=moved)))


def depth_step_of(base: Transform) -> tuple[DepthStepShift | None, Transform]:
    """Return the displacement of a map's step in depth, None without one, and the rest of the map."""
    if isinstance(base, Composed) and isinstance(base.steps[0], DepthStepShift):
        return base.steps[0], Composed(*base.steps[1:])
    return None, base


def average_over_windows(base: Transform, points: np.ndarray, cell: float) -> np.ndarray:
    """Return where windows about `points` see a map's target: with a step in depth its mean over them."""
    step, rest = depth_step_of(base)
    if step is None:
        return base(points)
    moved = np.zeros_like(points)
    for x, across in zip(OFFSETS * cell, WEIGHTS, strict=True):
        for y, down in zip(OFFSETS * cell, WEIGHTS, strict=True):
            spots = points + np.array([x, y])
            moved += across * down * (step(spots) - spots)
    return rest(points + moved)

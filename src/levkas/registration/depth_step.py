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

MARGINS = np.linspace(0.04, 0.3, 14)
"""That are tried first, shares of the shorter side of what was observed."""
WIDTHS = (2.0, 4.0)
"""In cells: of the slope: narrower ones than windows resolve are laid at two cells."""
NEAR = 0.1
"""In cells: two steps whose sides lie closer are one."""
HALVINGS, TURNS = 5, 2
"""Of the search's steps; of fitting the step and the rest in turns."""
MOST_SEARCHED = 2000
"""Windows among which a step is looked for."""
LEAST_GAIN = 150.0
"""Weighted squares that a step has to explain, in units of the windows' variance. The best rectangle takes some tens by
chance alone; the step of a simulated panel takes 200 to 1400."""
ORDERS = (3, 5)
"""Of the polynomials beside which a step is looked for: a cubic follows little of it, a quintic more of a lens."""
ALONG = ([0, 1], [0, 2])
"""Columns of 1, u, v that displace along x, and along y: what lies deeper appears displaced and smaller; neither turns it."""
OFFSETS, WEIGHTS = np.arange(-4, 5) / 3, np.repeat([0.25, 0.5, 0.25], 3) / 3
"""A window is three cells wide, the middle one weighs as much as the two others."""


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

    def columns(self, points: np.ndarray) -> np.ndarray:
        """Return the share of each window that the recessed part makes up, slope included, times 1, u, v, (n, 3)."""
        points = np.ascontiguousarray(points)
        share = share_inside(points, self.edges, self.centre, OFFSETS * self.cell, WEIGHTS)
        terms = np.column_stack([np.ones(len(points)), (points - self.centre) / self.spread])
        return np.asarray(share[:, None] * terms)

    def moved(self, edge: int, by: float) -> DepthStep:
        """Return the step with one of its edges elsewhere."""
        edges = self.edges.copy()
        edges[edge] += by
        least, most = (n * self.cell for n in WIDTHS)
        edges[4] = np.clip(edges[4], least, most)
        return replace(self, edges=edges)

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
        apart = (np.abs(step.edges[:5] - other.edges[:5]).max() for other in found if step)
        if step is not None and min(apart, default=np.inf) >= NEAR * cell:
            found.append(step)
    return found


def find_depth_step(
    observations: Observations, cell: float, order: int = ORDERS[0]
) -> DepthStep | None:
    """Return where a step would explain most beside a polynomial; None where none explains enough.

    Windows have three by three cells of side `cell`, reference px.
    """
    every = 1 + len(observations) // MOST_SEARCHED
    left = _Residual(observations.part(np.arange(len(observations)) % every == 0), order)
    low, high = observations.points.min(0), observations.points.max(0)
    half, (centre, spread) = (high - low) / 2, frame_of(observations.points)
    tried = []
    for share in MARGINS:
        x, y = half - share * 2 * half.min()
        if min(x, y) >= 3 * cell:
            edges = np.array([-x, x, -y, y, 2.0 * cell, 0.0])
            tried.append(DepthStep(edges, centre, spread, cell))
    gains = [left.explained(step) for step in tried]
    if not max(gains, default=0.0) > 0:
        return None
    best, most = left.descend(tried[int(np.argmax(gains))], max(gains))
    return best if every * most > LEAST_GAIN else None


class _Residual:
    """Residuals of a polynomial, and how much of them a step explains."""

    def __init__(self, observations: Observations, order: int) -> None:
        self.points = observations.points
        self.root = np.sqrt(np.trace(observations.information, axis1=1, axis2=2) / 2)[:, None]
        design = design_matrix(self.points, order, *frame_of(self.points))
        self.basis = np.linalg.qr(self.root * design)[0]
        residuals = observations.residuals(fit_polynomial(observations, order))
        self.rest = self.projected(self.root * residuals)

    def projected(self, columns: np.ndarray) -> np.ndarray:
        """Return what the polynomial does not follow."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def explained(self, step: DepthStep) -> float:
        """Return by how much the weighted squares fall."""
        columns = self.projected(self.root * step.columns(self.points))
        return sum(
            float(((np.linalg.qr(columns[:, of])[0].T @ self.rest[:, axis]) ** 2).sum())
            for axis, of in enumerate(ALONG)
        )

    def descend(self, best: DepthStep, most: float) -> tuple[DepthStep, float]:
        """Move one edge at a time while that explains more, by ever smaller steps."""
        sizes = np.array([1.5, 1.5, 1.5, 1.5, 0.8, 0.75 / best.spread]) * best.cell
        for size in (sizes / 2**n for n in range(HALVINGS)):
            for _ in range(3):
                before = most
                for edge, sign in np.ndindex(6, 2):
                    tried = best.moved(edge, (2 * sign - 1) * size[edge])
                    gain = self.explained(tried)
                    if gain > most:
                        best, most = tried, gain
                if most - before < 1e-3 * most:
                    break
        return best, most


def _fit_shift(columns: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the displacement, (3, 2), by least squares: along either axis evenly, and growing along it."""
    shift = np.zeros((3, 2))
    for axis, of in enumerate(ALONG):
        shift[of, axis] = np.linalg.lstsq(columns[:, of], goal[:, axis], rcond=1e-6)[0]
    return shift


def fit_with_depth_step(
    observations: Observations, step: DepthStep, fit: Callable[[Observations], Transform]
) -> Transform:
    """Fit the displacement of a step, and by `fit` the map of the rest, in turns; the first displacement is that beside a cubic."""
    left, columns = _Residual(observations, ORDERS[0]), step.columns(observations.points)
    weighted = left.root * columns
    shift = _fit_shift(left.projected(weighted), left.rest)
    for _ in range(TURNS):
        moved = observations.points + columns @ shift
        rest = fit(replace(observations, points=moved))
        miss = solve_2x2(rest.jacobian(moved), observations.target - rest(moved))
        shift = shift + _fit_shift(weighted, left.root * miss)
    moved = observations.points + columns @ shift
    return Composed(step.displacing(shift), fit(replace(observations, points=moved)))


def average_over_windows(base: Transform, points: np.ndarray, cell: float) -> np.ndarray:
    """Return where windows about `points` see a map's target: with a step in depth its mean over them."""
    if not (isinstance(base, Composed) and isinstance(base.steps[0], DepthStepShift)):
        return base(points)
    step, moved = base.steps[0], np.zeros_like(points)
    for i, k in np.ndindex(len(OFFSETS), len(OFFSETS)):
        spots = points + cell * OFFSETS[[i, k]]
        moved += WEIGHTS[i] * WEIGHTS[k] * (step(spots) - spots)
    return Composed(*base.steps[1:])(points + moved)

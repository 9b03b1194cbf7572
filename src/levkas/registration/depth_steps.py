"""Finding the ledge of a panel in how windows are displaced, and fitting maps with its term.

No polynomial follows a step in depth. Where it lies is looked for as the rectangle whose inside,
displaced and grown, takes most from what a cubic leaves (a quintic follows much of a ledge itself);
what it displaces is fitted with every map anew. A window sees the mean of its pixels: the step is
averaged over the window before it is compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from levkas.geometry.depth_step import LedgeShift
from levkas.geometry.pixel_maps_kernel import share_inside
from levkas.geometry.transforms import Composed, Transform, design_matrix, frame_of
from levkas.registration.models import Observations, fit_polynomial, solve_pairs

#: Orders of what a ledge is looked for beside: a cubic follows little of it, a quintic more of a lens.
ORDERS = (3, 5)
#: Margins that are tried, shares of the shorter side of what was observed.
NARROWEST, WIDEST, TRIED = 0.04, 0.3, 14
#: Narrower slopes than windows can tell are laid at two cells.
LEAST_WIDTH_CELLS, MOST_WIDTH_CELLS, NEAR_CELLS = 2.0, 4.0, 0.1
#: Columns of 1, u, v that displace along x, and along y.
ALONG = ([0, 1], [0, 2])
#: A window is three cells wide, the middle one weighs as much as the two others.
OFFSETS = np.arange(-4, 5) / 3
WEIGHTS = np.repeat([0.25, 0.5, 0.25], 3) / 3
HALVINGS, MOST_SEARCHED, TURNS = 5, 2000, 2
#: What the best of all rectangles takes from windows that overlap by chance alone, in units of their
#: variance, is some tens; the ledge of a simulated panel takes 200 to 1400.
LEAST_GAIN = 150.0


@dataclass(frozen=True)
class Ledge:
    """Where a ledge lies, reference px.

    Parameters
    ----------
    edges : ndarray, (6,)
        Left, right, top and bottom begin of the slope about `centre`, the width of the slope, and by
        how much it is turned, radians.
    centre, spread : (2,) and float
    cell : float
        Side of a window's cell.
    """

    edges: np.ndarray
    centre: np.ndarray
    spread: float
    cell: float

    def averaged(self, points: np.ndarray) -> np.ndarray:
        """Return the share of each window, (n,), that the lowered part makes up, slope included."""
        offsets, points = OFFSETS * self.cell, np.ascontiguousarray(points)
        return np.asarray(share_inside(points, self.edges, self.centre, offsets, WEIGHTS))

    def is_near(self, other: Ledge) -> bool:
        """Whether no side lies farther off than windows can tell."""
        return bool(np.abs(self.edges[:5] - other.edges[:5]).max() < NEAR_CELLS * self.cell)

    def columns(self, points: np.ndarray) -> np.ndarray:
        """Return the share of each window times 1, u, v, (n, 3)."""
        terms = np.column_stack([np.ones(len(points)), (points - self.centre) / self.spread])
        return np.asarray(self.averaged(points)[:, None] * terms)

    def displacing(self, shift: np.ndarray) -> LedgeShift:
        """Return the displacement, (3, 2) px of 1, u, v, as a map."""
        left, right, top, bottom, width, turned = self.edges
        c, s = np.cos(turned), np.sin(turned)
        normals = np.array([[c, s], [-c, -s], [-s, c], [s, -c]])
        begins = np.array([-left, right, -top, bottom]) - normals @ self.centre
        lines = np.column_stack([normals, begins])
        return LedgeShift(lines, float(width), self.centre, self.spread, shift)


def find_ledges(observations: Observations, cell: float) -> list[Ledge]:
    """Return what is found beside polynomials of either order, the same one once."""
    found: list[Ledge] = []
    for order in ORDERS:
        ledge = find_ledge(observations, cell, order)
        if ledge is not None and not any(ledge.is_near(other) for other in found):
            found.append(ledge)
    return found


def find_ledge(observations: Observations, cell: float, order: int = ORDERS[0]) -> Ledge | None:
    """Return where a ledge would explain most; None where none explains enough.

    Parameters
    ----------
    observations : Observations
    cell : float, reference px
        Side of the cells of which a window has three by three.
    order : int
        Of the polynomial that all else is left to.
    """
    every = 1 + len(observations) // MOST_SEARCHED
    left = _Left(observations.part(np.arange(len(observations)) % every == 0), order)
    low, high = observations.points.min(0), observations.points.max(0)
    half, middle = (high - low) / 2, (high + low) / 2
    centre, spread = frame_of(observations.points)
    best, most = None, 0.0
    for share in np.linspace(NARROWEST, WIDEST, TRIED):
        margin = share * 2 * half.min()
        x, y = half - margin
        if min(x, y) < 3 * cell:
            break
        off = middle - centre
        edges = np.array([off[0] - x, off[0] + x, off[1] - y, off[1] + y, 2.0 * cell, 0.0])
        tried = Ledge(edges, centre, spread, cell)
        gain = left.explained(tried)
        if gain > most:
            best, most = tried, gain
    if best is None:
        return None
    best, most = _descend(left, best, most)
    return best if every * most > LEAST_GAIN else None


def _descend(left: _Left, best: Ledge, most: float) -> tuple[Ledge, float]:
    """Move one edge at a time while that explains more, by ever smaller steps."""
    least, widest = LEAST_WIDTH_CELLS * best.cell, MOST_WIDTH_CELLS * best.cell
    steps = np.array([1.5, 1.5, 1.5, 1.5, 0.8, 1.5]) * best.cell
    steps[5] /= 2 * best.spread
    for _ in range(HALVINGS):
        for _ in range(3):
            before = most
            for k in range(6):
                for sign in (-1, 1):
                    edges = best.edges.copy()
                    edges[k] += sign * steps[k]
                    edges[4] = np.clip(edges[4], least, widest)
                    tried = replace(best, edges=edges)
                    gain = left.explained(tried)
                    if gain > most:
                        best, most = tried, gain
            if most - before < 1e-3 * most:
                break
        steps = steps / 2
    return best, most


class _Left:
    """What a polynomial leaves, and how much of it a ledge would explain."""

    def __init__(self, observations: Observations, order: int) -> None:
        self.points = observations.points
        self.root = np.sqrt(np.trace(observations.information, axis1=1, axis2=2) / 2)[:, None]
        design = design_matrix(self.points, order, *frame_of(self.points))
        self.basis = np.linalg.qr(self.root * design)[0]
        residuals = observations.residuals(fit_polynomial(observations, order))
        self.rest = self._freed(self.root * residuals)

    def _freed(self, columns: np.ndarray) -> np.ndarray:
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def shift(self, ledge: Ledge) -> np.ndarray:
        """Return the displacement, (3, 2) px, that explains most."""
        return fit_shift(self._freed(self.root * ledge.columns(self.points)), self.rest)

    def explained(self, ledge: Ledge) -> float:
        """Return by how much the weighted squares fall."""
        columns = self._freed(self.root * ledge.columns(self.points))
        return sum(
            float(((np.linalg.qr(columns[:, of])[0].T @ self.rest[:, axis]) ** 2).sum())
            for axis, of in enumerate(ALONG)
        )


def fit_shift(columns: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the displacement, (3, 2), by least squares: along either axis evenly, and growing along it.

    What lies deeper is seen displaced and smaller; neither turns it.
    """
    shift = np.zeros((3, 2))
    for axis, of in enumerate(ALONG):
        shift[of, axis] = np.linalg.lstsq(columns[:, of], goal[:, axis], rcond=1e-6)[0]
    return shift


def fit_behind(
    observations: Observations,
    ledge: Ledge,
    fit: Callable[[Observations], Transform],
    order: int = ORDERS[-1],
) -> Transform:
    """Fit what a ledge displaces, and by `fit` the map of the rest, in turns.

    What a polynomial of `order`, about as yielding as the map, leaves says first what the ledge displaces.
    """
    left, columns = _Left(observations, order), ledge.columns(observations.points)
    shift, weighted = left.shift(ledge), left.root * columns
    for _ in range(TURNS):
        moved = observations.points + columns @ shift
        rest = fit(replace(observations, points=moved))
        miss = solve_pairs(rest.jacobian(moved), observations.target - rest(moved))
        shift = shift + fit_shift(weighted, left.root * miss)
    moved = observations.points + columns @ shift
    return Composed(ledge.displacing(shift), fit(replace(observations, points=moved)))


def averaged(base: Transform, points: np.ndarray, cell: float) -> np.ndarray:
    """Return where windows about `points` see a map's target: behind a ledge the mean of its step."""
    steps = base.steps if isinstance(base, Composed) else (base,)
    if not isinstance(steps[0], LedgeShift):
        return base(points)
    moved = np.zeros_like(points)
    for x, across in zip(OFFSETS * cell, WEIGHTS, strict=True):
        for y, down in zip(OFFSETS * cell, WEIGHTS, strict=True):
            spots = points + np.array([x, y])
            moved += across * down * (steps[0](spots) - spots)
    return Composed(*steps[1:])(points + moved)

"""One adjustment of all tiles of a mosaic ([brown1976]_): a projective map a tile behind one lens, windows of all overlaps.

A tile's px p is put right by the lens that all share, q = L⁻¹(p), as [brown1966]_ has it, and mapped to the plane of the mosaic by

    M(p) = t + s R(θ) (1 + E) u / (1 + w·u),   u = (q − c)/s₀,   E = (e1 e2; e2 −e1),

c being the middle of a tile and s₀ half of its longer side. An overlap demands that both tiles map a window to one place. Tiles of one
camera differ little in scale, shear and tilt, which is known before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from levkas.geometry.transforms import Composed, Homography, Inverse, Lens, Transform, solve_2x2
from levkas.registration.models import scale_covariance

#: Unknowns of a tile: log s/s₀, θ, tx, ty, e1, e2, w1, w2; shared ones: k1, k2, p1, p2, and the means of e1, e2, w1, w2. In px at the rim.
OWN, LENS, SHARED = 8, 4, 8
#: Of the unknowns of a tile, those in which tiles are alike; those that place the mosaic.
ALIKE, PLACE = (0, 4, 5, 6, 7), (1, 2, 3)
#: Standard deviations before anything is measured, as shares of s₀: of the lens, of the means of shear and of tilt; of what tiles differ by
#: in scale, shear and tilt (three times as much leaves nine tiles 0.24 px off in place of 0.08); of an unknown that is not free.
LENS_SHARE, SHEAR_SHARE, TILT_SHARE, DIFFER_SHARE, FIXED_SHARE = 0.1, 0.001, 0.01, 0.001, 1e-6
#: Deviation, px, by which one tile is held; change of an unknown, px, by which its slope is found, and at which Gauss-Newton ends.
HELD_PX, STEP_PX, CONVERGED_PX = 0.01, 0.01, 5e-4
#: Of Gauss-Newton, at most; of these, rounds that weigh windows anew.
ROUNDS, WEIGHED_ROUNDS = 15, 5
#: Error in windows left out that the lens has to reach, of that without.
GAIN = 0.97
#: Least scatter of windows, of what they state themselves: what is less was met exactly, and says nothing of them.
LEAST_SCATTER = 0.05
#: Standard errors up to which chance may leave residuals that are alike.
CHANCE = 3.0


@dataclass(frozen=True)
class TileMaps:
    """Maps of all tiles, of one (width, height) `size`, to the plane of the mosaic."""

    size: tuple[int, int]
    own: np.ndarray
    """(n, 8), px."""
    shared: np.ndarray
    """(8,), px."""

    @property
    def spread(self) -> float:
        """Half of the longer side, px."""
        return max(self.size) / 2

    @property
    def centre(self) -> np.ndarray:
        """The middle of a tile, (2,) px."""
        return (np.array(self.size, float) - 1) / 2

    @cached_property
    def lens(self) -> Lens:
        """The lens of all tiles: px put right → px."""
        k1, k2, p1, p2 = (self.shared[:LENS] / self.spread).tolist()
        return Lens(self.centre, self.spread, (k1, k2), (p1, p2))

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Return px put right, (n, 2)."""
        return self.lens.inverse(points) if self.shared[:LENS].any() else points

    def project(self, tile: np.ndarray, flat: np.ndarray) -> np.ndarray:
        """Return mosaic px, (n, 2), of px put right of the tiles `tile`, (n,)."""
        (u, v), own = ((flat - self.centre) / self.spread).T, self.own[tile].T
        size, turn, e1, e2, w1, w2 = own[[0, 1, 4, 5, 6, 7]] / self.spread
        sheared = (1 + e1) * u + e2 * v + 1j * (e2 * u + (1 - e1) * v)
        z = self.spread * np.exp(size + 1j * turn) * sheared / (1 + w1 * u + w2 * v)
        return np.stack([own[2] + z.real, own[3] + z.imag], 1)

    def __call__(self, tile: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return mosaic px, (n, 2), of `points`, (n, 2), of the tiles `tile`, (n,)."""
        return self.project(tile, self.flat(points))

    def transform(self, tile: int) -> Transform:
        """Return px of a tile → mosaic px."""
        x, y = self.size
        corners = np.array([[0.0, 0], [x, 0], [x, y], [0, y], [x / 2, y / 2]])
        onto = Homography.fit(corners, self.project(np.full(len(corners), tile), corners))
        return Composed(Inverse(self.lens), onto) if self.shared[:LENS].any() else onto

    def by_px(self, tile: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the derivatives of mosaic px by px, (n, 2, 2)."""
        ends = [self(tile, points + h) - self(tile, points - h) for h in STEP_PX * np.eye(2)]
        return np.stack(ends, 2) / (2 * STEP_PX)

    def by_unknowns(self, tile: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the derivatives of mosaic px by the unknowns of a tile and those of the lens, (n, 2, 12)."""
        flat, found = self.flat(points), []
        for k in range(OWN):
            h = STEP_PX * np.eye(OWN)[k]
            ends = [replace(self, own=self.own + s * h).project(tile, flat) for s in (1, -1)]
            found.append(ends[0] - ends[1])
        for k in range(LENS):
            h = STEP_PX * np.eye(SHARED)[k]
            ends = [replace(self, shared=self.shared + s * h)(tile, points) for s in (1, -1)]
            found.append(ends[0] - ends[1])
        return np.stack(found, 2) / (2 * STEP_PX)

    def moved(self, move: np.ndarray) -> TileMaps:
        """Return the maps after a move of all unknowns, at the scale at which tiles are as large as their px on average: a smaller mosaic has smaller residuals, and would shrink."""
        own = self.own + move[:-SHARED].reshape(-1, OWN)
        mean = own[:, 0].mean()
        own[:, 0] -= mean
        own[:, 2:4] *= np.exp(-mean / self.spread)
        return replace(self, own=own, shared=self.shared + move[-SHARED:])


@dataclass(frozen=True)
class Windows:
    """Windows of all overlaps, those of one overlap behind one another."""

    pairs: np.ndarray
    """(m, 2). Tiles of every overlap, the first lower."""
    overlap: np.ndarray
    """(n,), ascending. To which overlap a window belongs."""
    first: np.ndarray
    second: np.ndarray
    """`first`, `second`: (n, 2), px. Where either tile has it."""
    information: np.ndarray
    """(n, 2, 2), 1/px². Of where, in px of the first tile."""

    def part(self, mask: np.ndarray) -> Windows:
        """Return the windows that `mask` selects, of the same overlaps."""
        arrays = (self.overlap, self.first, self.second, self.information)
        return Windows(self.pairs, *(array[mask] for array in arrays))

    def residual(self, maps: TileMaps) -> np.ndarray:
        """Return where the second tile puts every window less where the first does, (n, 2), px of the first tile."""
        one, other = self.pairs[self.overlap].T
        apart = maps(other, self.second) - maps(one, self.first)
        return solve_2x2(maps.by_px(one, self.first), apart)

    def scaled(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return information as these residuals scatter, and robust weights; as windows say themselves where so few join the tiles that they are met exactly."""
        information, weight = scale_covariance(residual, self.information)
        found, known = (
            np.median(np.trace(i, axis1=1, axis2=2)) for i in (information, self.information)
        )
        if found > known / LEAST_SCATTER**2:
            return self.information, np.ones(len(residual))
        return information, weight

    def mean_residuals(self, residual: np.ndarray) -> np.ndarray:
        """Return by how much every overlap is off, (m, 2), px of its first tile: the mean of its windows by their information."""
        total, goal = np.zeros((len(self.pairs), 2, 2)), np.zeros((len(self.pairs), 2))
        np.add.at(total, self.overlap, self.information)
        np.add.at(goal, self.overlap, np.einsum("nab,nb->na", self.information, residual))
        return np.asarray(np.linalg.solve(total + 1e-12 * np.eye(2), goal[..., None])[..., 0])

    def common_residuals(self, residual: np.ndarray) -> np.ndarray:
        """Return what an overlap's windows are off by alike, (m,), px of its first tile along an axis, as a step of a panel leaves it; 0 where chance may be the cause.

        Noise of one window is not that of the next: the mean product of the residuals of both is what they have in common.
        """
        here = self.overlap[1:]
        alike = here == self.overlap[:-1]
        product = (residual[1:] * residual[:-1]).sum(1) / 2 * alike
        bins = {"minlength": len(self.pairs)}
        count = np.maximum(np.bincount(here, alike, **bins), 1)
        mean, square = (np.bincount(here, v, **bins) / count for v in (product, product**2))
        chance = CHANCE * np.sqrt(square / count)
        return np.asarray(np.sqrt(np.where(mean > chance, mean, 0.0)))


@dataclass(frozen=True)
class Adjustment:
    """Tiles after their adjustment."""

    maps: TileMaps
    residual: np.ndarray
    """(n, 2), px of the first tile. Of every window: where the second tile puts it less where the first does."""
    weight: np.ndarray
    """(n,), 0..1. Robust weight of every window."""

    @property
    def rms(self) -> float:
        """Root mean square of the residuals along an axis, weighted, px."""
        total = (self.weight[:, None] * self.residual**2).sum()
        return float(np.sqrt(total / max(2 * self.weight.sum(), 1e-12)))


def adjust(windows: Windows, begin: TileMaps, *, lens: bool = True) -> Adjustment:
    """Adjust all tiles to the windows of overlaps that join them, robustly, from where they lie to some hundred px.

    `lens` says whether they share a lens that is not known.
    """
    maps = begin
    for number in range(ROUNDS):
        residual = windows.residual(maps)
        if number < WEIGHED_ROUNDS:  # the last rounds keep the weights, so that they come to rest
            information, weight = windows.scaled(residual)
        slopes, goal = _equations(windows, maps, residual, information * weight[:, None, None])
        known, towards = _known_before(maps, lens)
        normal = sparse.csc_array(slopes.T @ slopes + known.T @ known)
        move = spsolve(normal, slopes.T @ goal + known.T @ towards)
        maps = maps.moved(move)
        if np.abs(move).max() < CONVERGED_PX:
            break
    residual = windows.residual(maps)
    return Adjustment(maps, residual, windows.scaled(residual)[1])


def _equations(
    windows: Windows, maps: TileMaps, residual: np.ndarray, information: np.ndarray
) -> tuple[sparse.csc_array, np.ndarray]:
    """Return the slopes of weighted residuals by all unknowns, and what these are to make up for."""
    count, n = len(maps.own), len(windows.overlap)
    one, other = windows.pairs[windows.overlap].T
    root = np.linalg.cholesky(information + 1e-12 * np.eye(2)).transpose(0, 2, 1)
    ours, theirs = maps.by_unknowns(one, windows.first), maps.by_unknowns(other, windows.second)
    rows = np.concatenate(
        [ours[..., :OWN], -theirs[..., :OWN], ours[..., OWN:] - theirs[..., OWN:]], 2
    )
    rows = root @ np.linalg.inv(maps.by_px(one, windows.first)) @ rows
    own = [OWN * tile[:, None] + np.arange(OWN) for tile in (one, other)]
    columns = np.concatenate([*own, np.tile(OWN * count + np.arange(LENS), (n, 1))], 1)
    row = np.broadcast_to(np.arange(2 * n).reshape(n, 2, 1), rows.shape)
    column = np.broadcast_to(columns[:, None], rows.shape)
    shape = (2 * n, OWN * count + SHARED)
    slopes = sparse.csc_array((rows.ravel(), (row.ravel(), column.ravel())), shape)
    return slopes, np.einsum("nab,nb->na", root, residual).ravel()


def _known_before(maps: TileMaps, lens: bool) -> tuple[sparse.csc_array, np.ndarray]:
    """Return rows of what is known before, and their goals: scale, shear and tilt are alike, the lens is small, the middle tile holds the mosaic."""
    count, spread = len(maps.own), maps.spread
    chosen, means = np.eye(OWN)[list(ALIKE)], np.zeros((len(ALIKE), SHARED))
    means[1:, LENS:] = -np.eye(4)
    alike = np.hstack([np.kron(np.eye(count), chosen), np.tile(means, (count, 1))])
    shares = [LENS_SHARE if lens else FIXED_SHARE, SHEAR_SHARE, TILT_SHARE]
    small = np.diag(1 / np.repeat(shares, [LENS, 2, 2]))
    places = maps.own[:, 2:4]
    middle = OWN * int(np.argmin(np.linalg.norm(places - places.mean(0), axis=1)))
    held = np.zeros((len(PLACE), alike.shape[1]))
    held[range(len(PLACE)), [middle + k for k in PLACE]] = spread / HELD_PX
    weights = [
        alike / DIFFER_SHARE,
        np.hstack([np.zeros((SHARED, OWN * count)), small]),
        held,
    ]
    known = sparse.csc_array(np.vstack(weights) / spread)
    now = np.concatenate([maps.own.ravel(), maps.shared])
    goals = -(known @ now)
    goals[-len(PLACE) :] = 0.0  # it stays where it is
    return known, goals


def choose_lens(windows: Windows, begin: TileMaps) -> tuple[bool, dict[str, float]]:
    """Return whether a lens predicts windows left out better, and the error of either, px: every other window is left out, then the others."""
    half = np.arange(len(windows.overlap)) % 2 == 0
    errors: dict[str, float] = {}
    for name in ("none", "lens"):
        squares = []
        for part in (half, ~half):
            maps = adjust(windows.part(part), begin, lens=name == "lens").maps
            squares.append((windows.part(~part).residual(maps) ** 2).sum(1))
        errors[name] = float(np.sqrt(np.median(np.concatenate(squares)) / (2 * np.log(2))))
    return errors["lens"] < GAIN * errors["none"], errors

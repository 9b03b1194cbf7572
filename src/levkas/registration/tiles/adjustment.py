"""One adjustment of all tiles of a mosaic: a projective map a tile, one lens, windows of all overlaps.

Their unknowns are those of `tile_maps`. An overlap demands that both tiles map a window to
one place: M_i(p_i) = M_j(p_j). Tiles of one camera differ little in scale, shear and tilt, and by how much is estimated along with
them: with 0.1 % for all, 192 tiles lie 0.35 px off where they lie 0.06 px off so. At most 200 tiles have 1,608 unknowns, whose normal equations are inverted whole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from levkas.geometry.transforms import solve_2x2
from levkas.registration.models import scale_covariance
from levkas.registration.tiles.tile_maps import LENS, OWN, SHARED, TileMaps

#: Standard deviations before anything is measured, as shares of half a tile's longer side: of the lens, of the means of shear
#: and tilt; and of what tiles differ by in scale, shear and tilt.
LENS_SHARE, SHEAR_SHARE, TILT_SHARE, DIFFER_SHARE = 0.1, 0.001, 0.01, 0.003
#: Rounds in which is estimated what tiles differ by, at most, and of Gauss-Newton in each; change, of the logarithm, at which it is found.
VARIANCE_ROUNDS, ROUNDS_EACH, SAME = 6, 2, 0.02
#: One more tile that differs by this share; least deviation, px.
STILL_SHARE, LEAST_PX = 0.0003, 1e-3
#: Of an unknown that is not free.
FIXED_SHARE = 1e-6
#: Of Gauss-Newton, at most; of these, rounds that weigh windows anew; change of an unknown, px, at which it ends.
ROUNDS, WEIGHED_ROUNDS, CONVERGED_PX = 15, 5, 5e-4
#: Error in windows left out that the lens has to reach, of that without.
GAIN = 0.97
#: Least scatter of windows, of what they state themselves: what is less was met exactly, and says nothing of them.
LEAST_SCATTER = 0.05
#: Standard errors up to which chance may leave residuals that are alike.
CHANCE = 3.0
#: Deviation, px, by which one tile is held while equations are solved.
HELD_PX = 0.01


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
        return Windows(
            self.pairs, *(a[mask] for a in (self.overlap, self.first, self.second, self.information))
        )  # fmt: skip

    def residual(self, maps: TileMaps) -> np.ndarray:
        """Return where the second tile puts every window less where the first does, (n, 2), px of the first tile."""
        one, other = self.pairs[self.overlap].T
        place, by_px, _, _ = maps.linearised(one, self.first)
        return solve_2x2(by_px, maps(other, self.second) - place)

    def scaled(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return information as these residuals scatter, and robust weights; as windows say themselves where so few join the tiles that they are met exactly."""
        information, weight = scale_covariance(residual, self.information)
        found, known = (
            np.median(np.trace(i, axis1=1, axis2=2)) for i in (information, self.information)
        )
        if found > known / LEAST_SCATTER**2:
            return self.information, np.ones(len(residual))
        return information, weight


@dataclass(frozen=True)
class Adjustment:
    """Tiles after their adjustment."""

    maps: TileMaps
    residual: np.ndarray
    """(n, 2), px of the first tile. Of every window: where the second tile puts it less where the first does."""
    weight: np.ndarray
    """(n,), 0..1. Robust weight of every window."""
    information: np.ndarray
    """(n, 2, 2), 1/px². As residuals scatter."""

    @property
    def rms(self) -> float:
        """Root mean square of the residuals along an axis, weighted, px."""
        total = (self.weight[:, None] * self.residual**2).sum()
        return float(np.sqrt(total / max(2 * self.weight.sum(), 1e-12)))


def adjust(
    windows: Windows, begin: TileMaps, *, lens: bool = True, alike: bool = False
) -> Adjustment:
    """Adjust all tiles to the windows of their overlaps, robustly.

    Parameters
    ----------
    windows : Windows
        Of overlaps that join all tiles.
    begin : TileMaps
        Where they lie, to some hundred px.
    lens : bool
        Whether they share a lens that is not known.
    alike : bool
        Whether what tiles differ by is taken as it is before anything is measured, which is faster, and places many tiles worse.

    Returns
    -------
    adjusted : Adjustment
    """
    work = _Work(windows, lens, np.full(3, DIFFER_SHARE * begin.frame.spread))
    maps, covariance = work.converge(begin, ROUNDS)
    for _ in range(0 if alike else VARIANCE_ROUNDS):
        before, found = work.differ, _differences(maps, covariance)
        work = replace(work, differ=found)
        maps, covariance = work.converge(maps, ROUNDS_EACH)
        if np.abs(np.log(found / before)).max() < SAME:
            break
    residual = windows.residual(maps)
    information, weight = windows.scaled(residual)
    return Adjustment(maps, residual, weight, information)


@dataclass(frozen=True)
class _Work:
    """An adjustment at work: with a lens or without, and what tiles differ by in scale, shear and tilt, (3,) px."""

    windows: Windows
    lens: bool
    differ: np.ndarray

    def converge(self, maps: TileMaps, rounds: int) -> tuple[TileMaps, np.ndarray]:
        """Return the maps after Gauss-Newton, and the covariance of all unknowns; the last rounds keep the weights, so that they come to rest."""
        for number in range(rounds):
            if number < WEIGHED_ROUNDS:
                information, weight = self.windows.scaled(self.windows.residual(maps))
            normal, right = self._equations(maps, information * weight[:, None, None])
            move = spsolve(normal, right)
            own = maps.own + move[:-SHARED].reshape(-1, OWN)
            maps = _at_mean_scale(replace(maps, own=own, shared=maps.shared + move[-SHARED:]))
            if np.abs(move).max() < CONVERGED_PX:
                break
        return maps, np.linalg.inv(normal.toarray())

    def _equations(
        self, maps: TileMaps, information: np.ndarray
    ) -> tuple[sparse.csc_array, np.ndarray]:
        """Return the normal matrix about the maps and the right side: windows by their information, and what is known before."""
        count, n = len(maps.own), len(self.windows.overlap)
        tile, other = self.windows.pairs[self.windows.overlap].T
        place, by_px, own, by_lens = maps.linearised(tile, self.windows.first)
        there, _, theirs, by_other = maps.linearised(other, self.windows.second)
        root = np.linalg.cholesky(information + 1e-12 * np.eye(2)).transpose(0, 2, 1)
        root = root @ np.linalg.inv(by_px)
        rows = root @ np.concatenate([own, -theirs, by_lens - by_other], 2)
        goal = np.einsum("nab,nb->na", root, there - place)
        columns = np.concatenate(
            [
                OWN * tile[:, None] + np.arange(OWN), OWN * other[:, None] + np.arange(OWN),
                np.tile(OWN * count + np.arange(LENS), (n, 1)),
            ], 1,
        )  # fmt: skip
        row = np.broadcast_to(np.arange(2 * n).reshape(n, 2, 1), rows.shape)
        column = np.broadcast_to(columns[:, None], rows.shape)
        shape = (2 * n, OWN * count + SHARED)
        slopes = sparse.csc_array((rows.ravel(), (row.ravel(), column.ravel())), shape)
        known, towards = self._known_before(maps)
        return slopes.T @ slopes + known.T @ known, slopes.T @ goal.ravel() + known.T @ towards

    def _known_before(self, maps: TileMaps) -> tuple[sparse.csc_array, np.ndarray]:
        """Return rows of what is known before, and their goals: scale, shear and tilt are alike, the lens is small, one tile holds the mosaic."""
        spread, own, count = maps.frame.spread, maps.own, len(maps.own)
        total, differ = OWN * count + SHARED, np.repeat(self.differ[1:], 2)
        size = np.hypot(own[:, 0], own[:, 1])
        slope = own[:, :2] / size[:, None]
        scale, alike = sparse.lil_array((count, total)), sparse.lil_array((4 * count, total))
        for k in range(count):
            scale[k, OWN * k : OWN * k + 2] = slope[k] / self.differ[0]
            for i in range(4):
                alike[4 * k + i, OWN * k + 4 + i] = 1 / differ[i]
                alike[4 * k + i, OWN * count + LENS + i] = -1 / differ[i]
        shares = [LENS_SHARE if self.lens else FIXED_SHARE, SHEAR_SHARE, TILT_SHARE]
        small = 1 / (np.repeat(shares, [LENS, 2, 2]) * spread)
        shared = sparse.lil_array((SHARED, total))
        shared[np.arange(SHARED), OWN * count + np.arange(SHARED)] = small
        places = own[:, 2:4]
        first = OWN * int(np.argmin(np.linalg.norm(places - places.mean(0), axis=1)))
        held = sparse.lil_array((3, total))
        across = slope[first // OWN]
        held[0, first : first + 2] = np.array([-across[1], across[0]]) / HELD_PX
        held[1, first + 2] = held[2, first + 3] = 1 / HELD_PX
        goals = [
            (spread - size) / self.differ[0],
            ((maps.shared[LENS:] - own[:, 4:]) / differ).ravel(),
            -small * maps.shared,
            np.zeros(3),
        ]
        return sparse.csc_array(sparse.vstack([scale, alike, shared, held])), np.concatenate(goals)


def _differences(maps: TileMaps, covariance: np.ndarray) -> np.ndarray:
    """Return what tiles differ by in scale, shear and tilt, (3,) px: of every unknown its square and its variance, the mean over the tiles."""
    spread, count = maps.frame.spread, len(maps.own)
    first = OWN * np.arange(count)
    size = np.hypot(maps.own[:, 0], maps.own[:, 1])
    slope, pair = maps.own[:, :2] / size[:, None], first[:, None] + np.arange(2)
    of_scale = np.einsum("na,nab,nb->n", slope, covariance[pair[:, :, None], pair[:, None]], slope)
    squares = [((size - spread) ** 2 + of_scale).sum()]
    variance = np.diag(covariance)
    for k in (4, 6):
        own, mean = first[:, None] + np.arange(k, k + 2), OWN * count + np.arange(k, k + 2)
        off = maps.own[:, k : k + 2] - maps.shared[k : k + 2]
        apart = variance[own] - 2 * covariance[own, mean] + variance[mean]
        squares.append((off**2 + apart).sum() / 2)
    found = np.sqrt((np.array(squares) + (STILL_SHARE * spread) ** 2) / (count + 1))
    return np.maximum(found, LEAST_PX)


def choose_lens(windows: Windows, begin: TileMaps) -> tuple[bool, dict[str, float]]:
    """Return whether a lens predicts windows left out better, and the error of either, px: every other window is left out, then the others."""
    half = np.arange(len(windows.overlap)) % 2 == 0
    errors: dict[str, float] = {}
    for name in ("none", "lens"):
        squares = []
        for part in (half, ~half):
            maps = adjust(windows.part(part), begin, lens=name == "lens", alike=True).maps
            squares.append((windows.part(~part).residual(maps) ** 2).sum(1))
        errors[name] = float(np.sqrt(np.median(np.concatenate(squares)) / (2 * np.log(2))))
    return errors["lens"] < GAIN * errors["none"], errors


def _at_mean_scale(maps: TileMaps) -> TileMaps:
    """Return the mosaic at the scale at which tiles are as large as their px on average: a smaller one has smaller residuals, and would shrink."""
    size = np.hypot(maps.own[:, 0], maps.own[:, 1])
    own = maps.own.copy()
    own[:, :4] *= maps.frame.spread / size.mean()
    return replace(maps, own=own)


def overlap_offsets(windows: Windows, adjusted: Adjustment) -> np.ndarray:
    """Return by how much every overlap is off after the adjustment, (m, 2), px of its first tile: the mean of its windows by their information."""
    count = len(windows.pairs)
    total, goal = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(total, windows.overlap, windows.information)
    np.add.at(
        goal, windows.overlap, np.einsum("nab,nb->na", windows.information, adjusted.residual)
    )
    return np.asarray(np.linalg.solve(total + 1e-12 * np.eye(2), goal[..., None])[..., 0])


def overlap_misfits(windows: Windows, adjusted: Adjustment) -> np.ndarray:
    """Return what an overlap's windows are off by alike, (m,), px of its first tile along an axis, as a step of a panel leaves it; 0 where chance may be the cause.

    Noise of one window is not that of the next: the mean product of the residuals of both is what they have in common.
    """
    here = windows.overlap[1:]
    alike = here == windows.overlap[:-1]
    product = (adjusted.residual[1:] * adjusted.residual[:-1]).sum(1) / 2 * alike
    bins = {"minlength": len(windows.pairs)}
    count = np.maximum(np.bincount(here, alike, **bins), 1)
    mean, square = (np.bincount(here, values, **bins) / count for values in (product, product**2))
    chance = CHANCE * np.sqrt(square / count)
    return np.asarray(np.sqrt(np.where(mean > chance, mean, 0.0)))

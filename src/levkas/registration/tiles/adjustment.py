"""One adjustment of all tiles of a mosaic: a projective map a tile, one lens, one surface, windows of all overlaps.

Their unknowns are those of `tile_maps`. An overlap demands that both tiles map a window to
one place: M_i(p_i) = M_j(p_j). Tiles of one camera differ little in scale, shear and tilt, and by how much is estimated along with
them (components of variance): without that a mosaic of many tiles bends, as a chain of free projective maps does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from levkas.geometry.transforms import solve_2x2
from levkas.registration.models import roughness, scale_covariance
from levkas.registration.tiles.dissection import BlockFactor, BlockSystem, Elimination
from levkas.registration.tiles.tile_maps import BEND, LENS, OWN, SHARED, TileMaps

#: Standard deviations before anything is measured, as shares of half a tile's longer side: of the lens, of the bend, of the means of shear
#: and tilt; and of what tiles differ by in scale, shear and tilt.
LENS_SHARE, BEND_SHARE, SHEAR_SHARE, TILT_SHARE, DIFFER_SHARE = 0.1, 0.01, 0.001, 0.01, 0.003
#: Standard deviation of second differences of the surface's coefficients before it is estimated, of half a tile's longer side.
SURFACE_SHARE = 0.003
#: Tiles from which on a surface is tried.
LEAST_TILES = 3
#: Of an unknown that is not free.
FIXED_SHARE = 1e-6
#: Change of a deviation, of its logarithm, at which it is found.
SAME = 0.02
#: One more tile that differs by this share; least deviation, px.
STILL_SHARE, LEAST_PX = 0.0003, 1e-3
#: Of Gauss-Newton, at most; of these, rounds that weigh windows anew; change of an unknown, px, at which it ends.
ROUNDS, WEIGHED_ROUNDS, CONVERGED_PX = 15, 5, 5e-4
#: Rounds of the components of variance, at most, and of Gauss-Newton in each.
VARIANCE_ROUNDS, ROUNDS_EACH = 6, 2
#: Error in windows left out that a richer model has to reach, of that of a simpler one; tiles up to which it is measured.
GAIN, MOST_JUDGED = 0.97, 400
#: Least scatter of windows, of what they state themselves: what is less was met exactly, and says nothing of them.
LEAST_SCATTER = 0.05
#: Windows that are linearised at once.
AT_ONCE = 4096
#: Standard errors up to which chance may leave residuals that are alike.
CHANCE = 3.0
#: Deviation, px, by which one tile is held while equations are solved.
HELD_PX = 0.01


@dataclass(frozen=True)
class Windows:
    """Windows of all overlaps, those of one overlap behind one another.

    Parameters
    ----------
    pairs : ndarray of int, (m, 2)
        Tiles of every overlap, the first lower.
    overlap : ndarray of int, (n,), ascending
        To which overlap a window belongs.
    first, second : ndarray, (n, 2), px
        Where either tile has it.
    information : ndarray, (n, 2, 2), 1/px²
        Of where, in px of the first tile.
    """

    pairs: np.ndarray
    overlap: np.ndarray
    first: np.ndarray
    second: np.ndarray
    information: np.ndarray

    def part(self, mask: np.ndarray) -> Windows:
        """Return the windows that `mask` selects, of the same overlaps."""
        return Windows(
            self.pairs, *(a[mask] for a in (self.overlap, self.first, self.second, self.information))
        )  # fmt: skip


@dataclass(frozen=True)
class Placed:
    """Fixed places of tiles, as far as they are known: a stage's table, for example.

    Parameters
    ----------
    tile : ndarray of int, (k,)
        Each once.
    place : ndarray, (k, 2), mosaic px
        Of the middle of the tile.
    sigma : float, px
    """

    tile: np.ndarray
    place: np.ndarray
    sigma: float


@dataclass(frozen=True)
class Adjustment:
    """Tiles after their adjustment.

    Parameters
    ----------
    maps : TileMaps
    residual : ndarray, (n, 2), px of the first tile
        Of every window: where the second tile puts it less where the first does.
    weight : ndarray, (n,), 0..1
        Robust weight of every window.
    information : ndarray, (n, 2, 2), 1/px²
        As residuals scatter.
    deviations : ndarray, (3,), px at the rim
        What tiles differ by in scale, in shear and in tilt.
    columns : ndarray of int
        Which shared unknowns are free: of lens, bend and surface.
    covariance : ndarray, (n, 8 + columns, 8 + columns), or None
        Of every tile's own unknowns and of `columns`, in the frame of the whole mosaic: what moves, turns or tilts all of it as one plane is no error of a tile.
    """

    maps: TileMaps
    residual: np.ndarray
    weight: np.ndarray
    information: np.ndarray
    deviations: np.ndarray
    columns: np.ndarray
    covariance: np.ndarray | None = None

    @property
    def rms(self) -> float:
        """Root mean square of the residuals along an axis, weighted, px."""
        total = (self.weight[:, None] * self.residual**2).sum()
        return float(np.sqrt(total / max(2 * self.weight.sum(), 1e-12)))

    def place_covariance(self, tile: int, points: np.ndarray) -> np.ndarray:
        """Return the covariance of the places, (n, 2, 2), mosaic px², of `points`, (n, 2), px of a tile."""
        assert self.covariance is not None
        _, _, own, common = self.maps.linearised(np.full(len(points), tile), points)
        slopes = np.concatenate([own, common[:, :, self.columns]], 2)
        return np.asarray(slopes @ self.covariance[tile] @ slopes.transpose(0, 2, 1))


@dataclass(frozen=True)
class AdjustmentTerms:
    """On which terms tiles are adjusted.

    Parameters
    ----------
    lens, bend, surface : bool
        Whether they share a lens that is not known, and a bend; whether they show a surface off the plane.
    projective : bool
        Whether a tile may be sheared and tilted by itself; else tiles are similar, but for what is common to all.
    covariance : bool
        Whether components of variance and covariances are estimated.
    rounds : int
        Of Gauss-Newton, at most.
    """

    lens: bool = True
    bend: bool = False
    surface: bool = False
    projective: bool = True
    covariance: bool = True
    rounds: int = ROUNDS

    def columns(self, shared: int) -> np.ndarray:
        """Return which of so many shared unknowns are free: of lens, bend and surface."""
        bend = LENS + 2 * BEND if self.bend else LENS
        return np.r_[0 : bend if self.lens else 0, SHARED : shared if self.surface else SHARED]


def adjust(
    windows: Windows,
    begin: TileMaps,
    terms: AdjustmentTerms | None = None,
    placed: Placed | None = None,
) -> Adjustment:
    """Adjust all tiles to the windows of their overlaps, robustly.

    Parameters
    ----------
    windows : Windows
        Of overlaps that join all tiles.
    begin : TileMaps
        Where they lie, to some hundred px.
    terms : AdjustmentTerms, optional
    placed : Placed, optional
        Tiles of which a place is known otherwise.

    Returns
    -------
    adjusted : Adjustment
    """
    terms = terms or AdjustmentTerms()
    if terms.surface:
        flat = replace(terms, surface=False, covariance=False)
        begin = adjust(windows, begin, flat, placed).maps.with_surface()
    work = _Work(windows, begin, terms, placed)
    maps = work.converge(begin, terms.rounds)
    covariance = None
    if terms.covariance:
        for _ in range(VARIANCE_ROUNDS):
            before = work.deviations.copy()
            work.estimate_deviations(maps)
            maps = work.converge(maps, ROUNDS_EACH)
            if np.abs(np.log(work.deviations / before)).max() < SAME:
                break
        maps = work.converge(maps, terms.rounds)
        covariance = work.covariances(maps)
    residual, weight, information = work.scattered(maps)
    columns = terms.columns(len(maps.shared))
    return Adjustment(maps, residual, weight, information, work.deviations, columns, covariance)


def choose_terms(windows: Windows, begin: TileMaps) -> tuple[AdjustmentTerms, dict[str, float]]:
    """Return the simplest terms that predict windows left out as well as richer ones, and the error of each, px.

    Every other window is left out, then the others; of more than 400 tiles the lens is taken unseen.
    """
    candidates = {
        "none": AdjustmentTerms(lens=False, covariance=False),
        "lens": AdjustmentTerms(covariance=False),
        "surface": AdjustmentTerms(surface=True, covariance=False),
        "bend": AdjustmentTerms(bend=True, covariance=False),
    }
    if len(begin.own) > MOST_JUDGED:
        return AdjustmentTerms(), {}
    if len(begin.own) < LEAST_TILES:
        del candidates["surface"]
    half = np.arange(len(windows.overlap)) % 2 == 0
    errors: dict[str, float] = {}
    best, chosen = np.inf, candidates["none"]
    for name, terms in candidates.items():
        squares = []
        for part in (half, ~half):
            maps = adjust(windows.part(part), begin, terms).maps
            left = _Work(windows.part(~part), maps, terms, None).scattered(maps)[0]
            squares.append((left**2).sum(1))
        errors[name] = float(np.sqrt(np.median(np.concatenate(squares)) / (2 * np.log(2))))
        if errors[name] < GAIN * best:
            best, chosen = errors[name], terms
    return replace(chosen, covariance=True), errors


@dataclass
class _Work:
    """An adjustment at work: the order of elimination, and the components of variance as they are now."""

    windows: Windows
    begin: TileMaps
    terms: AdjustmentTerms
    placed: Placed | None
    deviations: np.ndarray = field(init=False)
    order: Elimination = field(init=False)
    held: int = field(init=False)
    trusted: np.ndarray | None = None
    smooth: np.ndarray = field(init=False)
    level: np.ndarray = field(init=False)
    bending: float = field(init=False)

    def __post_init__(self) -> None:
        places = self.begin.own[:, 2:4]
        self.order = Elimination.of_plane(places, self.windows.pairs)
        self.held = int(np.argmin(np.linalg.norm(places - places.mean(0), axis=1)))
        spread = self.begin.frame.spread
        self.deviations = np.full(3, DIFFER_SHARE * spread)
        if not self.terms.projective:
            self.deviations[1:] = FIXED_SHARE * spread
        self.bending = SURFACE_SHARE * spread
        if (lattice := self.begin.lattice) is not None:
            level = np.column_stack([np.ones(len(lattice.knots)), lattice.knots])
            level = np.linalg.qr(level)[0]
            self.level = level @ level.T
            self.smooth = roughness(*lattice.shape)

    def converge(self, maps: TileMaps, rounds: int) -> TileMaps:
        """Return the maps after Gauss-Newton; the last rounds keep the weights, so that they come to rest."""
        for number in range(rounds):
            system, right, shared = self.equations(maps, weigh=number < WEIGHED_ROUNDS)
            move, common = BlockFactor(system, self.order).solve(right, shared)
            before, maps = maps, replace(maps, own=maps.own + move, shared=maps.shared + common)
            if self.placed is None:
                maps = _at_mean_scale(maps)
            moved = np.abs(maps.own - before.own).max(), np.abs(common).max()
            if max(map(float, moved)) < CONVERGED_PX:
                break
        return maps

    def scattered(self, maps: TileMaps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals, robust weights, and information as residuals scatter."""
        pieces = [
            solve_2x2(by_px, second - first)
            for _, (first, by_px, _, _), (second, _, _, _) in self._linearised(maps)
        ]
        residual = np.concatenate(pieces)
        return residual, *self._scaled(residual)[::-1]

    def _scaled(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return information as these residuals scatter, and robust weights; as windows say themselves where so few join the tiles that they are met exactly."""
        stated = self.windows.information
        information, weight = scale_covariance(residual, stated)
        found, known = (np.median(np.trace(i, axis1=1, axis2=2)) for i in (information, stated))
        if found > known / LEAST_SCATTER**2:
            return stated, np.ones(len(stated))
        return information, weight

    def _weigh(self, residual: np.ndarray) -> None:
        """Keep the information of windows as these residuals scatter: the next equations are weighted by it."""
        information, weight = self._scaled(residual)
        self.trusted = information * weight[:, None, None]

    def _linearised(
        self, maps: TileMaps
    ) -> Iterator[tuple[slice, tuple[np.ndarray, ...], tuple[np.ndarray, ...]]]:
        """Yield blocks of windows with both tiles' places and derivatives; no overlap is cut."""
        overlap, count = self.windows.overlap, len(self.windows.overlap)
        start = 0
        while start < count:
            stop = min(start + AT_ONCE, count)
            if stop < count:
                cut = int(np.searchsorted(overlap, overlap[stop]))
                stop = cut if cut > start else int(np.searchsorted(overlap, overlap[stop], "right"))
            here = slice(start, stop)
            tiles = self.windows.pairs[overlap[here]]
            yield (
                here,
                maps.linearised(tiles[:, 0], self.windows.first[here]),
                maps.linearised(tiles[:, 1], self.windows.second[here]),
            )
            start = stop

    def equations(
        self, maps: TileMaps, *, weigh: bool = False
    ) -> tuple[BlockSystem, np.ndarray, np.ndarray]:
        """Return normal equations about the maps: the matrix, and both parts of the right side."""
        if self.trusted is None:
            self._weigh(self.scattered(maps)[0])
        information = self.trusted
        assert information is not None
        residuals = []
        pairs, count = self.windows.pairs, len(maps.own)
        total_shared = len(maps.shared)
        diagonal, coupling = np.zeros((count, OWN, OWN)), np.zeros((len(pairs), OWN, OWN))
        border, corner = np.zeros((count, OWN, total_shared)), np.zeros((total_shared,) * 2)
        right, shared = np.zeros((count, OWN)), np.zeros(total_shared)
        columns = self.terms.columns(total_shared)
        k, s = OWN, slice(2 * OWN, -1)
        for here, (one, by_px, own, common), (other, _, theirs, others) in self._linearised(maps):
            back = np.linalg.inv(by_px)
            residuals.append(np.einsum("nab,nb->na", back, other - one))
            weights = back.transpose(0, 2, 1) @ information[here] @ back
            rest = (common - others)[:, :, columns]
            rows = np.concatenate([own, -theirs, rest, (other - one)[:, :, None]], 2)
            weighted = weights @ rows
            products = rows[:, :, : 2 * OWN].transpose(0, 2, 1) @ weighted
            overlap = self.windows.overlap[here]
            starts = np.flatnonzero(np.diff(overlap, prepend=-1))
            total = np.add.reduceat(products, starts)
            i, j = pairs[overlap[starts]].T
            np.add.at(diagonal, i, total[:, :k, :k])
            np.add.at(diagonal, j, total[:, k : 2 * k, k : 2 * k])
            coupling[overlap[starts]] += total[:, :k, k : 2 * k]
            for tiles, half in ((i, total[:, :k]), (j, total[:, k:])):
                part = np.zeros((len(tiles), OWN, total_shared))
                part[:, :, columns] = half[:, :, s]
                np.add.at(border, tiles, part)
                np.add.at(right, tiles, half[:, :, -1])
            left, whole = np.concatenate(rest, 0), np.concatenate(weighted[:, :, 2 * OWN :], 0)
            together = left.T @ whole
            corner[np.ix_(columns, columns)] += together[:, :-1]
            shared[columns] += together[:, -1]
        if weigh:
            self._weigh(np.concatenate(residuals))
        system = BlockSystem(pairs, diagonal, coupling, border, corner)
        self._add_priors(maps, system, right, shared)
        return system, right, shared

    def _add_priors(
        self, maps: TileMaps, system: BlockSystem, right: np.ndarray, shared: np.ndarray
    ) -> None:
        """Add what is known before: scale, shear and tilt are alike, the lens is small, one tile holds the mosaic."""
        spread, own = maps.frame.spread, maps.own
        every = np.arange(len(own))
        size = np.hypot(own[:, 0], own[:, 1])
        slope, w = own[:, :2] / size[:, None], 1 / self.deviations**2
        system.diagonal[:, :2, :2] += w[0] * slope[:, :, None] * slope[:, None, :]
        right[:, :2] += w[0] * (spread - size)[:, None] * slope
        for k, weight in zip(range(4, OWN), (w[1], w[1], w[2], w[2]), strict=True):
            mean = SHARED - OWN + k
            miss = maps.shared[mean] - own[:, k]
            system.diagonal[:, k, k] += weight
            system.border[:, k, mean] -= weight
            system.corner[mean, mean] += weight * len(every)
            right[:, k] += weight * miss
            shared[mean] -= weight * miss.sum()
        lens = LENS_SHARE if self.terms.lens else FIXED_SHARE
        bend = BEND_SHARE if self.terms.bend else FIXED_SHARE
        shares = [lens, bend, SHEAR_SHARE, TILT_SHARE]
        known = 1 / (np.repeat(shares, [LENS, 2 * BEND, 2, 2]) * spread) ** 2
        system.corner[np.arange(SHARED), np.arange(SHARED)] += known
        shared[:SHARED] -= known * maps.shared[:SHARED]
        if maps.lattice is not None:
            held = self.level / (FIXED_SHARE * spread) ** 2
            system.corner[SHARED:, SHARED:] += held + self.smooth / self.bending**2
            shared[SHARED:] -= self.smooth @ maps.shared[SHARED:] / self.bending**2
        if self.placed is not None:
            tile, trust = self.placed.tile, 1 / self.placed.sigma**2
            system.diagonal[tile, 2, 2] += trust
            system.diagonal[tile, 3, 3] += trust
            right[tile, 2:4] += trust * (self.placed.place - own[tile, 2:4])
        across = np.array([-slope[self.held, 1], slope[self.held, 0]])
        system.diagonal[self.held, :2, :2] += np.outer(across, across) / HELD_PX**2
        system.diagonal[self.held, [2, 3], [2, 3]] += 1 / HELD_PX**2

    def estimate_deviations(self, maps: TileMaps) -> None:
        """Estimate what tiles differ by: of every unknown its square and its variance, the mean over the tiles."""
        spread, count = maps.frame.spread, len(maps.own)
        system, _, _ = self.equations(maps)
        blocks, border, corner = BlockFactor(system, self.order).covariances()
        size = np.hypot(maps.own[:, 0], maps.own[:, 1])
        slope = maps.own[:, :2] / size[:, None]
        of_scale = np.einsum("na,nab,nb->n", slope, blocks[:, :2, :2], slope)
        squares = [((size - spread) ** 2 + of_scale).sum()]
        for first in (4, 6):
            k = np.arange(first, first + 2)
            mean = k + SHARED - OWN
            of_k = blocks[:, k, k] - 2 * border[:, k, mean] + corner[mean, mean]
            squares.append(((maps.own[:, k] - maps.shared[mean]) ** 2 + of_k).sum() / 2)
        found = np.sqrt((np.array(squares) + (STILL_SHARE * spread) ** 2) / (count + 1))
        free = slice(None) if self.terms.projective else slice(1)
        self.deviations[free] = np.maximum(found, LEAST_PX)[free]
        if maps.lattice is not None:
            heights, spread_of = maps.shared[SHARED:], corner[SHARED:, SHARED:]
            square = heights @ self.smooth @ heights + np.trace(self.smooth @ spread_of)
            self.bending = max(float(np.sqrt(square / (len(heights) - 3))), LEAST_PX)

    def covariances(self, maps: TileMaps) -> np.ndarray:
        """Return covariances of own and common unknowns, in the frame of the whole mosaic ([baarda1973]_): as if no tile had been held."""
        system, _, _ = self.equations(maps)
        factor = BlockFactor(system, self.order)
        blocks, border, corner = factor.covariances()
        columns = self.terms.columns(len(maps.shared))
        width = len(columns)
        whole = np.empty((len(maps.own), OWN + width, OWN + width))
        whole[:, :OWN, :OWN], whole[:, :OWN, OWN:] = blocks, border[:, :, columns]
        whole[:, OWN:, OWN:] = corner[np.ix_(columns, columns)]
        if self.placed is None:
            motion, by_place, by_lens = _motions(maps)
            moving, common = factor.solve(by_place, by_lens)
            mixing = np.linalg.inv(np.einsum("nak,nal->kl", by_place, motion))
            square = np.einsum("nak,nal->kl", by_place, moving) + by_lens.T @ common
            square = mixing @ square @ mixing.T
            turned = motion @ mixing
            cross = turned @ moving.transpose(0, 2, 1)
            together = motion @ square @ motion.transpose(0, 2, 1)
            whole[:, :OWN, :OWN] += together - cross - cross.transpose(0, 2, 1)
            whole[:, :OWN, OWN:] -= turned @ common[columns].T
        whole[:, OWN:, :OWN] = whole[:, :OWN, OWN:].transpose(0, 2, 1)
        return whole


def _at_mean_scale(maps: TileMaps) -> TileMaps:
    """Return the mosaic at the scale at which tiles are as large as their px on average: a smaller one has smaller residuals, and would shrink."""
    size = np.hypot(maps.own[:, 0], maps.own[:, 1])
    own = maps.own.copy()
    own[:, :4] *= maps.frame.spread / size.mean()
    return replace(maps, own=own)


def _motions(maps: TileMaps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how the whole mosaic moves as one plane.

    Returns
    -------
    motion : ndarray, (n, 8, 8)
        Changes of own unknowns under each of the eight small changes of a homography of the mosaic.
    by_place, by_lens : ndarray, (n, 8, 8) and (shared, 8)
        Products of unknowns, own and shared, with these give how far the corners of all tiles take part in each.
    """
    count, reach = len(maps.own), maps.frame.spread
    corners = maps.frame.centre + reach * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    tile = np.repeat(np.arange(count), 4)
    place, _, own, lens = maps.linearised(tile, np.tile(corners, (count, 1)))
    middle = place.mean(0)
    x, y = ((place - middle) / max(float(np.abs(place - middle).max()), 1.0)).T
    one, nil = np.ones_like(x), np.zeros_like(x)
    along = [one, nil, x, y, nil, nil, x * x, x * y]
    down = [nil, one, nil, nil, x, y, x * y, y * y]
    fields = np.stack([np.stack(along, 1), np.stack(down, 1)], 1).reshape(count, 8, 8)
    slopes = own.reshape(count, 8, OWN)
    by_lens = np.einsum("nak,nal->kl", lens.reshape(count, 8, -1), fields)
    return np.linalg.solve(slopes, fields), slopes.transpose(0, 2, 1) @ fields, by_lens


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

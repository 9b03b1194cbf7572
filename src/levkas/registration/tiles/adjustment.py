"""One adjustment of all tiles of a mosaic: a projective map a tile, one lens, windows of all overlaps.

A tile's px p is put right by the lens that all share, q = B(L⁻¹(p)), and mapped to the plane of the mosaic by

    M(p) = t + R (1 + E) u / (1 + w·u),   u = (q − c)/s,   R = (a −b; b a),   E = (e1 e2; e2 −e1),

B is the identity, or adds a bend: all quadratic and cubic terms of u, for optics that the lens L of [brown1966]_ does not follow. (a, b) turn and scale the tile, t places it, e shears it and w tilts it. An overlap demands that both tiles map a window to
one place: M_i(p_i) = M_j(p_j). Tiles of one camera differ little in scale, shear and tilt, and by how much is estimated along with
them (components of variance): without that a mosaic of many tiles bends, as a chain of free projective maps does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from levkas.geometry.transforms import (
    Composed,
    Homography,
    Inverse,
    Lens,
    Polynomial,
    Transform,
    design_matrix,
    solve_2x2,
)
from levkas.registration.models import scale_covariance
from levkas.registration.tiles.dissection import BlockFactor, BlockSystem, Elimination

#: Unknowns of a tile: a, b, tx, ty, e1, e2, w1, w2; shared ones: k1, k2, p1, p2; the bend's 7 along x and 7 along y; the means of e1, e2, w1, w2. All in px at the rim.
OWN, LENS, BEND = 8, 4, 7
SHARED = LENS + 2 * BEND + 4
#: Standard deviations before anything is measured, as shares of half a tile's longer side: of the lens, of the bend, of the means of shear
#: and tilt; and of what tiles differ by in scale, shear and tilt. Ten times more or less of the first two changes no place by 0.01 px.
LENS_SHARE, BEND_SHARE, SHEAR_SHARE, TILT_SHARE, DIFFER_SHARE = 0.1, 0.01, 0.001, 0.01, 0.003
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
#: Windows that are linearised at once.
AT_ONCE = 4096
#: Deviation, px, by which one tile is held while equations are solved.
HELD_PX = 0.01


@dataclass(frozen=True)
class TileFrame:
    """Coordinates of a tile's px: u = (q − centre)/spread.

    Parameters
    ----------
    centre : ndarray, (2,), px
    spread : float, px
        Half of the longer side.
    """

    centre: np.ndarray
    spread: float

    @classmethod
    def of_size(cls, size: tuple[int, int]) -> TileFrame:
        """Return the frame of tiles of `size`, (width, height)."""
        return cls((np.array(size, float) - 1) / 2, max(size) / 2)


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
class TileMaps:
    """Maps of all tiles to the plane of the mosaic.

    Parameters
    ----------
    frame : TileFrame
    own : ndarray, (n, 8), px
        a, b, tx, ty, e1, e2, w1, w2 of every tile.
    shared : ndarray, (22,), px
        Lens, bend, means of e1, e2, w1, w2.
    """

    frame: TileFrame
    own: np.ndarray
    shared: np.ndarray

    @property
    def lens(self) -> Lens:
        """The lens of all tiles: px put right → px."""
        k1, k2, p1, p2 = (self.shared[:LENS] / self.frame.spread).tolist()
        return Lens(self.frame.centre, self.frame.spread, (k1, k2), (p1, p2))

    @property
    def bend(self) -> Polynomial | None:
        """What the lens leaves: px put right by it → px put right; None where there is none."""
        terms = self.shared[LENS : LENS + 2 * BEND]
        if not terms.any():
            return None
        coefficients = np.zeros((10, 2))
        coefficients[0] = self.frame.centre
        coefficients[1, 0] = coefficients[2, 1] = self.frame.spread
        coefficients[3:] = terms.reshape(2, BEND).T
        return Polynomial(3, self.frame.centre, self.frame.spread, coefficients)

    def matrices(self) -> np.ndarray:
        """Return the homographies, (n, 3, 3), of px put right to mosaic px."""
        (x, y), s = self.frame.centre, self.frame.spread
        into = np.array([[1 / s, 0, -x / s], [0, 1 / s, -y / s], [0, 0, 1]])
        a, b, tx, ty = self.own[:, :4].T
        e1, e2, w1, w2 = self.own[:, 4:].T / s
        rows = [
            [a * (1 + e1) - b * e2 + tx * w1, a * e2 - b * (1 - e1) + tx * w2, tx],
            [b * (1 + e1) + a * e2 + ty * w1, b * e2 + a * (1 - e1) + ty * w2, ty],
            [w1, w2, np.ones_like(a)],
        ]
        return np.asarray(np.moveaxis(np.array(rows), -1, 0) @ into)

    def transform(self, tile: int) -> Transform:
        """Return px of a tile → mosaic px."""
        lens = Inverse(self.lens) if self.shared[:LENS].any() else None
        steps = (lens, self.bend, Homography(self.matrices()[tile]))
        return Composed(*(step for step in steps if step is not None))

    def __call__(self, tile: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return mosaic px, (n, 2), of `points`, (n, 2), of the tiles `tile`, (n,)."""
        return np.asarray(self.linearised(tile, points)[0])

    def linearised(
        self, tile: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return mosaic px, (n, 2), and their derivatives by px, (n, 2, 2), own unknowns, (n, 2, 8), and those of lens and bend, (n, 2, 18)."""
        s, lens = self.frame.spread, self.lens
        flat = lens.inverse(points) if self.shared[:LENS].any() else points
        bend, right = self.bend, flat
        if bend is not None:
            right = bend(flat)
        u, v = ((right - self.frame.centre) / s).T
        a, b, tx, ty, *small = self.own[tile].T
        e1, e2, w1, w2 = (value / s for value in small)
        f, g = (1 + e1) * u + e2 * v, e2 * u + (1 - e1) * v
        w = 1 / (1 + w1 * u + w2 * v)
        x, y = (a * f - b * g) * w, (b * f + a * g) * w
        place = np.stack([x + tx, y + ty], 1)
        one, nil = np.ones_like(u), np.zeros_like(u)
        along = [f, -g, (a * u + b * v) / s, (a * v - b * u) / s, -x * u / s, -x * v / s]
        down = [g, f, (b * u - a * v) / s, (b * v + a * u) / s, -y * u / s, -y * v / s]
        along, down = ([value * w for value in side] for side in (along, down))
        along[2:2], down[2:2] = [one, nil], [nil, one]
        own = np.stack([np.stack(along, 1), np.stack(down, 1)], 1)
        plane = (
            np.stack(
                [
                    np.stack([a * (1 + e1) - b * e2 - x * w1, a * e2 - b * (1 - e1) - x * w2], 1),
                    np.stack([b * (1 + e1) + a * e2 - y * w1, b * e2 + a * (1 - e1) - y * w2], 1),
                ],
                1,
            )
            * (w / s)[:, None, None]
        )
        from_flat = plane if bend is None else plane @ bend.jacobian(flat)
        by_px = from_flat @ np.linalg.inv(lens.jacobian(flat))
        terms = design_matrix(flat, 3, self.frame.centre, s)[:, 3:]
        bent = (plane[..., None] * terms[:, None, None, :]).reshape(len(points), 2, 2 * BEND)
        return place, by_px, own, np.concatenate([-by_px @ _lens_terms(flat, self.frame), bent], 2)


def _lens_terms(points: np.ndarray, frame: TileFrame) -> np.ndarray:
    """Return how px move, (n, 2, 4), with k1, k2, p1, p2."""
    u, v = ((points - frame.centre) / frame.spread).T
    r2 = u * u + v * v
    along = [u * r2, u * r2 * r2, 2 * u * v, r2 + 2 * u * u]
    down = [v * r2, v * r2 * r2, r2 + 2 * v * v, 2 * u * v]
    return np.stack([np.stack(along, 1), np.stack(down, 1)], 1)


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
    covariance : ndarray, (n, 12, 12), with a bend (n, 26, 26), or None
        Of every tile's own unknowns, those of the lens and of the bend, in the frame of the whole mosaic: what moves, turns or tilts all of it as one plane is no error of a tile.
    """

    maps: TileMaps
    residual: np.ndarray
    weight: np.ndarray
    information: np.ndarray
    deviations: np.ndarray
    covariance: np.ndarray | None = None

    @property
    def rms(self) -> float:
        """Root mean square of the residuals along an axis, weighted, px."""
        total = (self.weight[:, None] * self.residual**2).sum()
        return float(np.sqrt(total / max(2 * self.weight.sum(), 1e-12)))

    def place_covariance(self, tile: int, points: np.ndarray) -> np.ndarray:
        """Return the covariance of the places, (n, 2, 2), mosaic px², of `points`, (n, 2), px of a tile."""
        assert self.covariance is not None
        _, _, own, lens = self.maps.linearised(np.full(len(points), tile), points)
        slopes = np.concatenate([own, lens], 2)[:, :, : self.covariance.shape[1]]
        return np.asarray(slopes @ self.covariance[tile] @ slopes.transpose(0, 2, 1))


@dataclass(frozen=True)
class AdjustmentTerms:
    """On which terms tiles are adjusted.

    Parameters
    ----------
    lens, bend : bool
        Whether they share a lens that is not known, and a bend.
    projective : bool
        Whether a tile may be sheared and tilted by itself; else tiles are similar, but for what is common to all.
    covariance : bool
        Whether components of variance and covariances are estimated.
    rounds : int
        Of Gauss-Newton, at most.
    """

    lens: bool = True
    bend: bool = False
    projective: bool = True
    covariance: bool = True
    rounds: int = ROUNDS

    @property
    def common(self) -> int:
        """How many unknowns of lens and bend there are."""
        return LENS + 2 * BEND if self.bend else LENS


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
    return Adjustment(maps, residual, weight, information, work.deviations, covariance)


def choose_terms(windows: Windows, begin: TileMaps) -> tuple[AdjustmentTerms, dict[str, float]]:
    """Return the simplest terms that predict windows left out as well as richer ones, and the error of each, px.

    Every other window is left out, then the others; of more than 400 tiles the lens is taken unseen.
    """
    candidates = {
        "none": AdjustmentTerms(lens=False, covariance=False),
        "lens": AdjustmentTerms(covariance=False),
        "bend": AdjustmentTerms(bend=True, covariance=False),
    }
    if len(begin.own) > MOST_JUDGED:
        return AdjustmentTerms(), {}
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

    def __post_init__(self) -> None:
        places = self.begin.own[:, 2:4]
        self.order = Elimination.of_plane(places, self.windows.pairs)
        self.held = int(np.argmin(np.linalg.norm(places - places.mean(0), axis=1)))
        spread = self.begin.frame.spread
        self.deviations = np.full(3, DIFFER_SHARE * spread)
        if not self.terms.projective:
            self.deviations[1:] = FIXED_SHARE * spread

    def converge(self, maps: TileMaps, rounds: int) -> TileMaps:
        """Return the maps after Gauss-Newton; the last rounds keep the weights, so that they come to rest."""
        for number in range(rounds):
            system, right, shared = self.equations(maps, weigh=number < WEIGHED_ROUNDS)
            move, common = BlockFactor(system, self.order).solve(right, shared)
            maps = replace(maps, own=maps.own + move, shared=maps.shared + common)
            if max(float(np.abs(move).max()), float(np.abs(common).max())) < CONVERGED_PX:
                break
        return maps

    def scattered(self, maps: TileMaps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals, robust weights, and information as residuals scatter."""
        pieces = [
            solve_2x2(by_px, second - first)
            for _, (first, by_px, _, _), (second, _, _, _) in self._linearised(maps)
        ]
        residual = np.concatenate(pieces)
        information, weight = scale_covariance(residual, self.windows.information)
        return residual, weight, information

    def _weigh(self, residual: np.ndarray) -> None:
        """Keep the information of windows as these residuals scatter: the next equations are weighted by it."""
        information, weight = scale_covariance(residual, self.windows.information)
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
        diagonal, coupling = np.zeros((count, OWN, OWN)), np.zeros((len(pairs), OWN, OWN))
        border, corner = np.zeros((count, OWN, SHARED)), np.zeros((SHARED, SHARED))
        right, shared = np.zeros((count, OWN)), np.zeros(SHARED)
        common_px = slice(self.terms.common)
        for here, (one, by_px, own, lens), (other, _, theirs, bent) in self._linearised(maps):
            back = np.linalg.inv(by_px)
            residuals.append(np.einsum("nab,nb->na", back, other - one))
            weights = back.transpose(0, 2, 1) @ information[here] @ back
            common = (lens - bent)[:, :, common_px] * float(self.terms.lens)
            rows = np.concatenate([own, -theirs, common, (other - one)[:, :, None]], 2)
            products = rows.transpose(0, 2, 1) @ (weights @ rows)
            overlap = self.windows.overlap[here]
            starts = np.flatnonzero(np.diff(overlap, prepend=-1))
            total = np.add.reduceat(products, starts)
            (i, j), k, s = pairs[overlap[starts]].T, OWN, slice(2 * OWN, -1)
            np.add.at(diagonal, i, total[:, :k, :k])
            np.add.at(diagonal, j, total[:, k : 2 * k, k : 2 * k])
            coupling[overlap[starts]] += total[:, :k, k : 2 * k]
            np.add.at(border[:, :, common_px], i, total[:, :k, s])
            np.add.at(border[:, :, common_px], j, total[:, k : 2 * k, s])
            corner[common_px, common_px] += total[:, s, s].sum(0)
            np.add.at(right, i, total[:, :k, -1])
            np.add.at(right, j, total[:, k : 2 * k, -1])
            shared[common_px] += total[:, s, -1].sum(0)
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
        shared -= known * maps.shared
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

    def covariances(self, maps: TileMaps) -> np.ndarray:
        """Return covariances of own and common unknowns, in the frame of the whole mosaic ([baarda1973]_): as if no tile had been held."""
        system, _, _ = self.equations(maps)
        factor = BlockFactor(system, self.order)
        blocks, border, corner = factor.covariances()
        width = self.terms.common
        whole = np.empty((len(maps.own), OWN + width, OWN + width))
        whole[:, :OWN, :OWN], whole[:, :OWN, OWN:] = blocks, border[:, :, :width]
        whole[:, OWN:, OWN:] = corner[:width, :width]
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
            whole[:, :OWN, OWN:] -= turned @ common[:width].T
        whole[:, OWN:, :OWN] = whole[:, :OWN, OWN:].transpose(0, 2, 1)
        return whole


def _motions(maps: TileMaps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how the whole mosaic moves as one plane.

    Returns
    -------
    motion : ndarray, (n, 8, 8)
        Changes of own unknowns under each of the eight small changes of a homography of the mosaic.
    by_place, by_lens : ndarray, (n, 8, 8) and (22, 8)
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
    by_lens = np.zeros((SHARED, 8))
    lens = lens.reshape(count, 8, -1)
    by_lens[: lens.shape[2]] = np.einsum("nak,nal->kl", lens, fields)
    return np.linalg.solve(slopes, fields), slopes.transpose(0, 2, 1) @ fields, by_lens


def similar(own: np.ndarray) -> np.ndarray:
    """Return turn and scale of a tile, (2, 2), of its unknowns, (8,)."""
    return np.array([[own[0], -own[1]], [own[1], own[0]]])


def overlap_offsets(windows: Windows, adjusted: Adjustment) -> np.ndarray:
    """Return by how much every overlap is off after the adjustment, (m, 2), px of its first tile: the mean of its windows by their information."""
    count = len(windows.pairs)
    total, goal = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(total, windows.overlap, windows.information)
    np.add.at(
        goal, windows.overlap, np.einsum("nab,nb->na", windows.information, adjusted.residual)
    )
    return np.asarray(np.linalg.solve(total + 1e-12 * np.eye(2), goal[..., None])[..., 0])

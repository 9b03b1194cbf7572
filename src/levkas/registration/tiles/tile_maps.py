"""Maps of tiles to the plane of a mosaic: a projective map a tile, one lens, one surface, and their derivatives.

A tile's px p is put right by the lens that all share, q = B(L⁻¹(p)), and mapped to the plane of the mosaic by

    M(p) = t + R (1 + E) u / (1 + w·u),   u = (q − c)/s,   R = (a −b; b a),   E = (e1 e2; e2 −e1),

B is the identity, or adds a bend: all quadratic and cubic terms of u, for optics that the lens L of [brown1966]_ does not follow. (a, b) turn and scale the tile, t places it, e shears it and w tilts it.

A panel that is bent or recessed lies off the plane by a height z. A camera whose middle looks at f sees what lies at x displaced to M = x + γ(x) (x − f), γ = z/(d − z) at
its distance d: plane and parallax ([hartley2004]_, section 13.3). γ is one cubic B-spline for all tiles, and f is t.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from levkas.geometry.spline import SplineShift, spline_weights
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

#: Unknowns of a tile: a, b, tx, ty, e1, e2, w1, w2; shared ones: k1, k2, p1, p2; the bend's 7 along x and 7 along y; the means of e1, e2, w1, w2; those of the surface behind them. All in px at the rim.
OWN, LENS, BEND = 8, 4, 7
SHARED = LENS + 2 * BEND + 4
#: Between knots of the surface, of half a tile's longer side, at least; spans along a side of the mosaic, at most.
KNOT_SHARE, MOST_SPANS = 0.5, 8
#: Of Newton, to where the surface displaces a place from; it is displaced by a hundredth of a tile.
SURFACE_ROUNDS = 4


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
class SurfaceLattice:
    """Where the knots of the surface lie.

    Parameters
    ----------
    origin : ndarray, (2,), mosaic px
        As of a `SplineShift`.
    spacing : float, mosaic px
    shape : (rows, columns)
    """

    origin: np.ndarray
    spacing: float
    shape: tuple[int, int]

    @classmethod
    def about(cls, places: np.ndarray, frame: TileFrame) -> SurfaceLattice:
        """Return the lattice about tiles whose middles lie at `places`, (n, 2), mosaic px."""
        low, high = places.min(0) - frame.spread, places.max(0) + frame.spread
        spacing = max(KNOT_SHARE * frame.spread, float((high - low).max()) / MOST_SPANS)
        columns, rows = np.ceil((high - low) / spacing).astype(int) + 3
        origin = (low + high) / 2 - (np.array([columns, rows]) - 3) * spacing / 2
        return cls(origin, spacing, (int(rows), int(columns)))

    @property
    def knots(self) -> np.ndarray:
        """Where coefficients are centred, (rows x columns, 2), mosaic px."""
        rows, columns = self.shape
        x, y = np.meshgrid(np.arange(columns) - 1.0, np.arange(rows) - 1.0)
        return np.asarray(self.origin + self.spacing * np.stack([x.ravel(), y.ravel()], 1))

    def weights(self, points: np.ndarray) -> np.ndarray:
        """Return the weight of every coefficient at places, (n, rows x columns); beyond the lattice those of its rim."""
        rows, columns = self.shape
        place = (points - self.origin) / self.spacing
        out = np.zeros((len(points), rows, columns))
        within = np.clip(place, 0, np.array([columns, rows]) - 3)
        whole = np.minimum(within.astype(int), np.array([columns, rows]) - 4)
        bx, by = (spline_weights(within[:, k] - whole[:, k]) for k in (0, 1))
        every = np.arange(len(points))
        for i in range(4):
            for j in range(4):
                out[every, whole[:, 1] + i, whole[:, 0] + j] = by[:, i] * bx[:, j]
        return out.reshape(len(points), -1)

    def displacement(self, heights: np.ndarray) -> SplineShift:
        """Return how heights, (rows x columns, ...), displace along two axes, as coefficients."""
        return SplineShift(self.origin, self.spacing, heights.reshape(*self.shape, 2))


@dataclass(frozen=True)
class TileMaps:
    """Maps of all tiles to the plane of the mosaic.

    Parameters
    ----------
    frame : TileFrame
    own : ndarray, (n, 8), px
        a, b, tx, ty, e1, e2, w1, w2 of every tile.
    shared : ndarray, (22,) or more, px
        Lens, bend, means of e1, e2, w1, w2; of a surface its coefficients: γ times half of a tile's longer side.
    lattice : SurfaceLattice or None
    """

    frame: TileFrame
    own: np.ndarray
    shared: np.ndarray
    lattice: SurfaceLattice | None = None

    def with_surface(self) -> TileMaps:
        """Return the same maps with a surface, which is flat."""
        lattice = SurfaceLattice.about(self.own[:, 2:4], self.frame)
        shared = np.append(self.shared, np.zeros(np.prod(lattice.shape)))
        return replace(self, shared=shared, lattice=lattice)

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
        back = None
        if self.lattice is not None:
            away = self.lattice.knots - self.own[tile, 2:4]
            heights = self.shared[SHARED:, None] / self.frame.spread
            back = Inverse(self.lattice.displacement(heights * away))
        steps = (lens, self.bend, Homography(self.matrices()[tile]), back)
        return Composed(*(step for step in steps if step is not None))

    def parallax(self, tile: np.ndarray, other: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return by how much the surface displaces `places`, (n, 2), mosaic px, in one tile against another, (n, 2)."""
        if self.lattice is None:
            return np.zeros_like(places)
        height = self.lattice.weights(places) @ self.shared[SHARED:] / self.frame.spread
        return np.asarray(height[:, None] * (self.own[other, 2:4] - self.own[tile, 2:4]))

    def __call__(self, tile: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return mosaic px, (n, 2), of `points`, (n, 2), of the tiles `tile`, (n,)."""
        return np.asarray(self.linearised(tile, points)[0])

    def linearised(
        self, tile: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return mosaic px, (n, 2), and their derivatives by px, (n, 2, 2), own unknowns, (n, 2, 8), and shared ones, (n, 2, 22) or more."""
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
        nil = np.zeros((len(points), 2, SHARED - LENS - 2 * BEND))
        common = np.concatenate([-by_px @ _lens_terms(flat, self.frame), bent, nil], 2)
        if self.lattice is None:
            return place, by_px, own, common
        return self._off_the_plane(tile, place, (by_px, own, common))

    def _off_the_plane(
        self, tile: np.ndarray, there: np.ndarray, slopes: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return places and derivatives of what lies on the surface and is seen at `there`, (n, 2), on the plane."""
        lattice = self.lattice
        assert lattice is not None
        heights, knots = self.shared[SHARED:] / self.frame.spread, lattice.knots
        foot = self.own[tile, 2:4]
        moved = lattice.displacement(heights[:, None] * knots)
        raised = lattice.displacement(np.stack([heights, heights], 1))
        place = there
        for _ in range(SURFACE_ROUNDS):
            height, rise = raised(place) - place, raised.jacobian(place) - np.eye(2)
            bent = moved.jacobian(place) - foot[:, :, None] * rise[:, :1]
            off = moved(place) - foot * height - there
            place = place - solve_2x2(bent, off)
        back = np.linalg.inv(bent)
        by_px, own, common = slopes
        own = own.copy()
        own[:, :, 2:4] += height[:, :1, None] * np.eye(2)
        along = (foot[:, None] - knots[None]) / self.frame.spread
        by_height = (lattice.weights(place)[..., None] * along).transpose(0, 2, 1)
        return place, back @ by_px, back @ own, back @ np.concatenate([common, by_height], 2)


def _lens_terms(points: np.ndarray, frame: TileFrame) -> np.ndarray:
    """Return how px move, (n, 2, 4), with k1, k2, p1, p2."""
    u, v = ((points - frame.centre) / frame.spread).T
    r2 = u * u + v * v
    along = [u * r2, u * r2 * r2, 2 * u * v, r2 + 2 * u * u]
    down = [v * r2, v * r2 * r2, r2 + 2 * v * v, 2 * u * v]
    return np.stack([np.stack(along, 1), np.stack(down, 1)], 1)


def similar(own: np.ndarray) -> np.ndarray:
    """Return turn and scale of a tile, (2, 2), of its unknowns, (8,)."""
    return np.array([[own[0], -own[1]], [own[1], own[0]]])

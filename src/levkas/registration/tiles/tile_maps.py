"""Maps of tiles to the plane of a mosaic: a projective map a tile behind one lens, and their derivatives.

A tile's px p is put right by the lens that all share, q = L⁻¹(p), and mapped to the plane of the mosaic by

    M(p) = t + R (1 + E) u / (1 + w·u),   u = (q − c)/s,   R = (a −b; b a),   E = (e1 e2; e2 −e1),

with the lens L of [brown1966]_. (a, b) turn and scale the tile, t places it, e shears it and w tilts it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from levkas.geometry.transforms import Composed, Homography, Inverse, Lens, Transform

#: Unknowns of a tile: a, b, tx, ty, e1, e2, w1, w2; shared ones: k1, k2, p1, p2, and the means of e1, e2, w1, w2. All in px at the rim.
OWN, LENS, SHARED = 8, 4, 8


@dataclass(frozen=True)
class TileFrame:
    """Coordinates of a tile's px: u = (q − centre)/spread."""

    centre: np.ndarray
    """(2,), px."""
    spread: float
    """In px: half of the longer side."""

    @classmethod
    def of_size(cls, size: tuple[int, int]) -> TileFrame:
        """Return the frame of tiles of `size`, (width, height)."""
        return cls((np.array(size, float) - 1) / 2, max(size) / 2)


@dataclass(frozen=True)
class TileMaps:
    """Maps of all tiles to the plane of the mosaic."""

    frame: TileFrame
    own: np.ndarray
    """(n, 8), px. a, b, tx, ty, e1, e2, w1, w2 of every tile."""
    shared: np.ndarray
    """(8,), px. Lens, means of e1, e2, w1, w2."""

    @property
    def lens(self) -> Lens:
        """The lens of all tiles: px put right → px."""
        k1, k2, p1, p2 = (self.shared[:LENS] / self.frame.spread).tolist()
        return Lens(self.frame.centre, self.frame.spread, (k1, k2), (p1, p2))

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
        onto = Homography(self.matrices()[tile])
        return Composed(Inverse(self.lens), onto) if self.shared[:LENS].any() else onto

    def __call__(self, tile: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return mosaic px, (n, 2), of `points`, (n, 2), of the tiles `tile`, (n,)."""
        return np.asarray(self.linearised(tile, points)[0])

    def linearised(
        self, tile: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return mosaic px, (n, 2), and their derivatives by px, (n, 2, 2), own unknowns, (n, 2, 8), and those of the lens, (n, 2, 4)."""
        s, lens = self.frame.spread, self.lens
        flat = lens.inverse(points) if self.shared[:LENS].any() else points
        u, v = ((flat - self.frame.centre) / s).T
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
        plane = [
            np.stack([a * (1 + e1) - b * e2 - x * w1, a * e2 - b * (1 - e1) - x * w2], 1),
            np.stack([b * (1 + e1) + a * e2 - y * w1, b * e2 + a * (1 - e1) - y * w2], 1),
        ]
        by_px = np.stack(plane, 1) * (w / s)[:, None, None] @ np.linalg.inv(lens.jacobian(flat))
        return place, by_px, own, -by_px @ _lens_terms(u, v)


def _lens_terms(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return how px move, (n, 2, 4), with k1, k2, p1, p2."""
    r2 = u * u + v * v
    along = [u * r2, u * r2 * r2, 2 * u * v, r2 + 2 * u * u]
    down = [v * r2, v * r2 * r2, r2 + 2 * v * v, 2 * u * v]
    return np.stack([np.stack(along, 1), np.stack(down, 1)], 1)


def similar(own: np.ndarray) -> np.ndarray:
    """Return turn and scale of a tile, (2, 2), of its unknowns, (8,)."""
    return np.array([[own[0], -own[1]], [own[1], own[0]]])

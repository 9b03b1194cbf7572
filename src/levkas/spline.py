"""A smooth displacement on a lattice: what a global model leaves, such as a recessed centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.transforms import invert


@dataclass(frozen=True, eq=False)
class SplineShift:
    """``p ↦ p + Σ B(u − i) B(v − j) c[j, i]`` with cubic B-splines, u = (x − x0)/spacing.

    Beyond the lattice the displacement goes on in a straight line, so that the map has no kink.

    Parameters
    ----------
    origin : ndarray, (2,), px
        Where the first inner knot lies; coefficient (1, 1) is centred on it.
    spacing : float, px
    coefficients : ndarray, (rows, columns, 2), px
        At least 4 x 4.

    Examples
    --------
    >>> flat = SplineShift(np.zeros(2), 10.0, np.full((5, 6, 2), 0.5))
    >>> flat(np.array([[3.0, 4.0]]))
    array([[3.5, 4.5]])
    """

    origin: np.ndarray
    spacing: float
    coefficients: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        from levkas.map_kernels import displace

        points = np.ascontiguousarray(points, float)
        coefficients = np.ascontiguousarray(self.coefficients, float)
        return np.asarray(displace(points, self.origin, float(self.spacing), coefficients))

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map points back by Newton; NaN where the displacement folds."""
        return invert(self, points, np.asarray(points, float))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2)."""
        points = np.asarray(points, float)
        along, down, both = self._edge_slopes(points)
        over = self._over(points)
        along, down = along + both * over[:, 1:], down + both * over[:, :1]
        return np.eye(2) + np.stack([along, down], axis=2) / self.spacing

    def _over(self, points: np.ndarray) -> np.ndarray:
        """How far points lie beyond the knots, in spacings: there the shift goes on in a straight line."""
        place = (points - self.origin) / self.spacing
        return np.nan_to_num(place - np.clip(place, 0, self._limits()))

    def _edge_slopes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slopes along x, along y, and of either along the other, px per spacing, at the clamped place."""
        bx, by, i, j = self._weights(points, spline_weights)
        dx, dy, _, _ = self._weights(points, _slopes)
        patch = self._patch(i, j)
        return (
            np.einsum("na,nb,nabk->nk", by, dx, patch),
            np.einsum("na,nb,nabk->nk", dy, bx, patch),
            np.einsum("na,nb,nabk->nk", dy, dx, patch),
        )

    def _limits(self) -> np.ndarray:
        rows, columns = self.coefficients.shape[:2]
        return np.array([columns - 3, rows - 3], float)

    def _weights(self, points: np.ndarray, of: Any) -> tuple[np.ndarray, ...]:
        place = np.clip((points - self.origin) / self.spacing, 0, self._limits())
        place = np.nan_to_num(place)
        whole = np.minimum(place.astype(int), self._limits().astype(int) - 1)
        t = place - whole
        return of(t[:, 0]), of(t[:, 1]), whole[:, 0], whole[:, 1]

    def _patch(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        near = np.arange(4)
        return self.coefficients[j[:, None, None] + near[:, None], i[:, None, None] + near]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "kind": "spline",
            "origin": np.asarray(self.origin, float).tolist(),
            "spacing": float(self.spacing),
            "coefficients": np.asarray(self.coefficients, float).tolist(),
        }


def spline_weights(t: np.ndarray) -> np.ndarray:
    """Return the four cubic B-spline weights at fraction `t`, (n, 4)."""
    s = 1 - t
    inner = [(4 - 6 * a * a + 3 * a**3) / 6 for a in (t, s)]
    return np.stack([s**3 / 6, inner[0], inner[1], t**3 / 6], 1)


def _slopes(t: np.ndarray) -> np.ndarray:
    s = 1 - t
    return np.stack([-s * s / 2, (3 * t * t - 4 * t) / 2, (4 * s - 3 * s * s) / 2, t * t / 2], 1)

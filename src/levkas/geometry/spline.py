"""A smooth displacement on a lattice: what a global model leaves, such as a recessed centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.geometry.transforms import invert, stored


@dataclass(frozen=True, eq=False)
class SplineShift:
    """``p ↦ p + Σ B(u − i) B(v − j) c[j, i]`` with cubic B-splines, u = (x − x0)/spacing.

    `origin` (2,), px, is where the first inner knot lies, on which coefficient (1, 1) is centred; `coefficients`
    (rows, columns, 2), px, are at least 4 x 4. Beyond the lattice the displacement goes on in a straight line, so
    that the map has no kink.

    >>> flat = SplineShift(np.zeros(2), 10.0, np.full((5, 6, 2), 0.5))
    >>> flat(np.array([[3.0, 4.0]]))
    array([[3.5, 4.5]])
    """

    origin: np.ndarray
    spacing: float
    coefficients: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self._displaced(points, np.empty((0, 2, 2)))

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map points back by Newton; NaN where the displacement folds."""
        return invert(self, points, np.asarray(points, float))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        slopes = np.empty((len(points), 2, 2))
        self._displaced(points, slopes)
        return slopes

    def _displaced(self, points: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        from levkas.geometry.pixel_maps_kernel import displace

        points, knots = (np.ascontiguousarray(a, float) for a in (points, self.coefficients))
        return np.asarray(displace(points, self.origin, float(self.spacing), knots, slopes))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record; of rows or columns that are all alike, as of displaced lines, it has one."""
        knots = np.asarray(self.coefficients, float)
        for axis in (0, 1):
            if (np.diff(knots, axis=axis) == 0).all():
                knots = knots.take([0], axis)
        numbers = {"origin": self.origin, "spacing": self.spacing, "coefficients": knots}
        return {"kind": "spline", **{key: stored(value) for key, value in numbers.items()}}

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> SplineShift:
        """Return the displacement that `to_dict` wrote."""
        knots = np.array(record["coefficients"], float)
        for axis in (0, 1):
            knots = knots.repeat(4 if knots.shape[axis] == 1 else 1, axis)
        return cls(np.array(record["origin"], float), record["spacing"], knots)


def spline_weights(t: np.ndarray) -> np.ndarray:
    """Return the four cubic B-spline weights at fraction `t`, (n, 4)."""
    s = 1 - t
    inner = [(4 - 6 * a * a + 3 * a**3) / 6 for a in (t, s)]
    return np.stack([s**3 / 6, inner[0], inner[1], t**3 / 6], 1)

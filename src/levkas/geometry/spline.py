"""A smooth displacement on a lattice: what a global model leaves, such as a recessed centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.geometry.transforms import invert


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
        from levkas.geometry.pixel_maps_kernel import displace

        points = np.ascontiguousarray(points, float)
        coefficients = np.ascontiguousarray(self.coefficients, float)
        return np.asarray(displace(points, self.origin, float(self.spacing), coefficients))

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map points back by Newton; NaN where the displacement folds."""
        return invert(self, points, np.asarray(points, float))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2)."""
        from levkas.geometry.pixel_maps_kernel import displace_slopes

        points = np.ascontiguousarray(points, float)
        coefficients = np.ascontiguousarray(self.coefficients, float)
        return np.asarray(displace_slopes(points, self.origin, float(self.spacing), coefficients))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record; of rows or columns that are all alike, as of displaced lines, it has one."""
        coefficients = np.asarray(self.coefficients, float)
        for axis in (0, 1):
            if (np.diff(coefficients, axis=axis) == 0).all():
                coefficients = coefficients.take([0], axis)
        return {
            "kind": "spline",
            "origin": np.asarray(self.origin, float).tolist(),
            "spacing": float(self.spacing),
            "coefficients": coefficients.tolist(),
        }

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> SplineShift:
        """Return the displacement that `to_dict` wrote."""
        coefficients = np.array(record["coefficients"], float)
        for axis in (0, 1):
            coefficients = coefficients.repeat(4 if coefficients.shape[axis] == 1 else 1, axis)
        return cls(np.array(record["origin"], float), record["spacing"], coefficients)


def spline_weights(t: np.ndarray) -> np.ndarray:
    """Return the four cubic B-spline weights at fraction `t`, (n, 4)."""
    s = 1 - t
    inner = [(4 - 6 * a * a + 3 * a**3) / 6 for a in (t, s)]
    return np.stack([s**3 / 6, inner[0], inner[1], t**3 / 6], 1)

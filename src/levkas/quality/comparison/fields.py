"""Maps that a peer gives as displacements of pixels, or only as a function of points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.geometry.transforms import invert

STEP_PX = 0.5


@dataclass(frozen=True, eq=False)
class Displacement:
    """``p ↦ p + field(p)``, linear between pixels, constant beyond the edge.

    Parameters
    ----------
    field : ndarray, (h, w, 2), px
        Shift in x and y at every pixel.

    Examples
    --------
    >>> Displacement(np.full((3, 3, 2), 0.5))(np.array([[1.25, 2.0]]))
    array([[1.75, 2.5 ]])
    """

    field: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        from scipy.ndimage import map_coordinates

        points = np.asarray(points, float)
        places = points[:, ::-1].T
        shift = [
            map_coordinates(self.field[..., k], places, order=1, mode="nearest") for k in (0, 1)
        ]
        return points + np.stack(shift, 1)


@dataclass(frozen=True, eq=False)
class AnyMap:
    """A function of points as a `Transform`: differentiated by differences, inverted by Newton."""

    function: Callable[[np.ndarray], np.ndarray]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self.function(np.asarray(points, float))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2), by differences over a pixel."""
        points = np.asarray(points, float)
        columns = [
            (self(points + step) - self(points - step)) / (2 * STEP_PX)
            for step in np.eye(2) * STEP_PX
        ]
        return np.stack(columns, axis=2)

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back; NaN where Newton does not converge."""
        return invert(self, points, np.asarray(points, float))

    def to_dict(self) -> dict[str, Any]:
        """Refuse: a function cannot be stored."""
        raise NotImplementedError("a map of another program is not stored")

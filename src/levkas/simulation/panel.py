"""The panel: a bent board whose centre is lowered behind a ledge, and rays that meet it.

World: millimetres, X right, Y down, Z away from the viewer, origin at the panel's middle. Panel
points (s, t) are millimetres *on* the board: s along the straight axis of the cylinder (X), t along
the arc. A point with height h above the cylinder, towards the viewer, lies at
``(s, (R + h) sin(t/R), R − (R + h) cos(t/R))``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import ceil
from typing import Any

import numpy as np

from levkas.simulation import rays

FLAT_RADIUS_MM = 1e8
STEEPEST_RAY = 0.3  # tangent of the angle to the normal; cameras that look at a panel stay below


@dataclass(frozen=True)
class Panel:
    """Shape of a painted board as it lies before the cameras.

    Parameters
    ----------
    width_mm, height_mm : float
        Along s and t.
    radius_mm : float
        Of the cylinder, convex towards the viewer.
    depth_mm : float
        How far the centre is lowered.
    border_mm, bevel_mm : float
        Width of the rectangular frame left around it, and of the slope between the two.
    twist_mm : float
        Lift of the corners, alternately up and down.

    Raises
    ------
    ValueError
        Where a size is not positive.
    """

    width_mm: float = 421.0
    height_mm: float = 316.0
    radius_mm: float = FLAT_RADIUS_MM
    depth_mm: float = 0.0
    border_mm: float = 30.0
    bevel_mm: float = 4.0
    twist_mm: float = 0.0

    def __post_init__(self) -> None:
        for name in ("width_mm", "height_mm", "radius_mm", "bevel_mm"):
            if getattr(self, name) <= 0:
                raise ValueError(f"panel: {name} must be > 0, got {getattr(self, name)}")

    def vector(self) -> np.ndarray:
        """Return the shape as the numbers that kernels take, float64 (8,)."""
        reach = self.depth_mm + 4 * abs(self.twist_mm) + 0.02
        steps = max(2, ceil(2 * reach * STEEPEST_RAY / self.bevel_mm))
        return np.array(
            [
                self.width_mm,
                self.height_mm,
                self.radius_mm,
                self.depth_mm,
                self.border_mm,
                self.bevel_mm,
                self.twist_mm,
                steps,
            ]
        )

    def heights(self, points: np.ndarray) -> np.ndarray:
        """Return the height above the cylinder, mm, of `points` (n, 2) = (s, t)."""
        return rays.heights(np.ascontiguousarray(points, float), self.vector())

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return which of `points` (n, 2) = (s, t) lie on the board."""
        s, t = np.abs(np.asarray(points, float)).T
        return (s <= self.width_mm / 2) & (t <= self.height_mm / 2)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record; `Panel(**record)` is its inverse."""
        return asdict(self)

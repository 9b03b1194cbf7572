"""Windows that were free to be found elsewhere: what they confirm of a map, and where nothing does.

A map is known where windows of the picture that the reference predicts are found where it puts them.
Elsewhere it reaches out from there: its held-out error says nothing of such places, and they lie the
less surely the farther they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.models import solve_pairs

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

#: So many confirmed windows have to be near: one may be found where it should be by chance.
LEAST_NEAR = 2
#: A window of the dense refinement is three cells wide, and a frame's rim may be short of one.
REACH_CELLS = 2.0


@dataclass(frozen=True)
class Checks:
    """Windows of one sensor that were looked for around where its map puts them; one row a window.

    Parameters
    ----------
    centres : ndarray, (n, 2), reference px
    shift : ndarray, (n, 2), reference px
        From where the map puts the window to where it is seen.
    found : ndarray of bool, (n,)
        Whether it is recognised beyond chance.
    tolerance : float, reference px
        A window that is found within twice that of its place confirms the map.
    side : float, reference px
        Of a window; places up to so far from confirmed ones are checked.
    predicted : ndarray, (m, 2), reference px, optional
        Windows of the dense refinement that are predicted beyond chance as most around them are. They are
        smaller and closer, and tell more exactly where detail ends.
    cell : float, reference px
        How far apart those are.
    box : (x, y, width, height), reference px, optional
        Where the object lies: places beside it are as far as the nearest of its own.

    Examples
    --------
    >>> checks = Checks(np.array([[0.0, 0], [8, 0]]), np.zeros((2, 2)), np.ones(2, bool), 1.0, 10.0)
    >>> checks.beyond(np.array([[4.0, 0], [30, 0]])).tolist()
    [0.0, 20.0]
    """

    centres: np.ndarray
    shift: np.ndarray
    found: np.ndarray
    tolerance: float
    side: float
    predicted: np.ndarray | None = None
    cell: float = 0.0
    box: tuple[float, ...] | None = None

    @property
    def confirmed(self) -> np.ndarray:
        """Mask of the windows that are found where the map puts them, (n,) bool."""
        return np.asarray(self.found & (np.hypot(*self.shift.T) <= 2 * self.tolerance))

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Return how far beyond what is checked `points`, (n, 2), lie: (n,) reference px, 0 within.

        Infinite where fewer than `LEAST_NEAR` windows confirm anything.
        """
        from scipy.spatial import cKDTree

        places = self.centres[self.confirmed]
        if len(places) < LEAST_NEAR:
            return np.full(len(points), np.inf)
        if self.box is not None:
            low = np.array(self.box[:2])
            points = np.clip(points, low, low + np.array(self.box[2:]) - 1)
        far = np.asarray(cKDTree(places).query(points, k=LEAST_NEAR)[0])[:, -1] - self.side
        if self.predicted is not None and len(self.predicted):
            near = np.asarray(cKDTree(self.predicted).query(points)[0])
            far = np.maximum(far, near - REACH_CELLS * self.cell)
        return np.asarray(np.maximum(far, 0.0))

    def through(self, before: Transform, after: Transform) -> Checks:
        """Return what the same windows say of another map: each lies in the target where it was seen.

        `before` is the map through which they were looked for, `after` the other one.
        """
        miss = before(self.centres + self.shift) - after(self.centres)
        shift = solve_pairs(after.jacobian(self.centres), miss)
        known = np.isfinite(shift).all(1)
        return replace(self, shift=np.where(known[:, None], shift, 1e6), found=self.found & known)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record, a list a column."""
        return {
            "x": np.round(self.centres[:, 0], 1).tolist(),
            "y": np.round(self.centres[:, 1], 1).tolist(),
            "shift_x": np.round(self.shift[:, 0], 3).tolist(),
            "shift_y": np.round(self.shift[:, 1], 3).tolist(),
            "found": self.found.tolist(),
            "tolerance": self.tolerance,
            "side": self.side,
            "predicted": [] if self.predicted is None else np.round(self.predicted, 1).tolist(),
            "cell": self.cell,
            "box": None if self.box is None else list(self.box),
        }

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> Checks:
        """Read what `to_dict` wrote."""
        columns = {key: np.array(record[key], float) for key in ("x", "y", "shift_x", "shift_y")}
        return cls(
            np.stack([columns["x"], columns["y"]], 1),
            np.stack([columns["shift_x"], columns["shift_y"]], 1),
            np.array(record["found"], bool),
            float(record["tolerance"]),
            float(record["side"]),
            np.array(record["predicted"], float).reshape(-1, 2),
            float(record["cell"]),
            None if record["box"] is None else tuple(record["box"]),
        )

"""A displacement inside a rectangle: what a lowered centre behind a ledge does to a camera's view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.geometry.transforms import invert


@dataclass(frozen=True, eq=False)
class DepthStepShift:
    """``p ↦ p + Π S(dᵢ(p) / width) · (1, u, v) · shift``, u and v = (p − centre) / spread.

    The centre of a panel that is lowered behind a ledge lies farther from either camera: it appears
    displaced against its border, by an amount that grows evenly across it. S rises from 0 to 1 as
    6x⁵ − 15x⁴ + 10x³.

    `lines`, (4, 3), are left, right, top, bottom: a, b, c of the distance a·x + b·y + c, px, from where the slope of
    the ledge begins, positive inside; (a, b) of length 1. `width` of the slope, `centre`, (2,), `spread` and `shift`, (3, 2), are px.

    >>> lines = np.array([[1, 0, -10], [-1, 0, 90], [0, 1, -10], [0, -1, 90.0]])
    >>> shift = np.array([[0.5, 0], [0, 0], [0, 0]])
    >>> sunk = DepthStepShift(lines, 4.0, np.array([50.0, 50]), 50.0, shift)
    >>> sunk(np.array([[5.0, 50], [12, 50], [50, 50]])).tolist()
    [[5.0, 50.0], [12.25, 50.0], [50.5, 50.0]]
    """

    lines: np.ndarray
    width: float
    centre: np.ndarray
    spread: float
    shift: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        points = np.asarray(points, float)
        u, v = ((points - self.centre) / self.spread).T[:, :, None]
        share = _rise(self._places(points)).prod(1)[:, None]
        return points + share * (self.shift[0] + u * self.shift[1] + v * self.shift[2])

    @property
    def most(self) -> float:
        """Largest displacement inside, px: that of one of the corners."""
        left, right, top, bottom = self.lines
        pairs = [(a, b) for a in (left, right) for b in (top, bottom)]
        corners = np.array([np.linalg.solve([a[:2], b[:2]], [-a[2], -b[2]]) for a, b in pairs])
        return float(np.linalg.norm(self._terms(corners) @ self.shift, axis=1).max())

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map points back by Newton; NaN where the displacement folds."""
        return invert(self, points, np.asarray(points, float))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2)."""
        points = np.asarray(points, float)
        places = self._places(points)
        rises, slopes = _rise(places), _slope(places) / self.width
        gradient = np.zeros((len(points), 2))
        for i in range(4):
            rest = np.delete(rises, i, axis=1).prod(1) * slopes[:, i]
            gradient += rest[:, None] * self.lines[i, :2]
        moved = self._terms(points) @ self.shift
        inner = rises.prod(1)[:, None, None] * self.shift[1:].T / self.spread
        return np.eye(2) + moved[:, :, None] * gradient[:, None, :] + inner

    def _places(self, points: np.ndarray) -> np.ndarray:
        return np.asarray((points @ self.lines[:, :2].T + self.lines[:, 2]) / self.width)

    def _terms(self, points: np.ndarray) -> np.ndarray:
        return np.column_stack([np.ones(len(points)), (points - self.centre) / self.spread])

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "kind": "depth_step",
            "lines": np.asarray(self.lines, float).tolist(),
            "width": float(self.width),
            "centre": np.asarray(self.centre, float).tolist(),
            "spread": float(self.spread),
            "shift": np.asarray(self.shift, float).tolist(),
        }


def _rise(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (x * (6 * x - 15) + 10))


def _slope(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(30 * (x * (1 - x)) ** 2)

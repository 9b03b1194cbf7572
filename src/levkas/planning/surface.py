"""Sampled surface of a panel with a recessed middle: points, normals, texture contrast."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.setup import light_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.planning.setup import StudioLamp
    from levkas.planning.tables import StudioObjectKeys


@dataclass(frozen=True, eq=False)
class Surface:
    """Points of an object and their normals.

    Parameters
    ----------
    x, y : ndarray, (columns,), (rows,)
        mm along the board from its middle.
    points, normals : ndarray, (rows, columns, 3)
        mm; unit vectors, z towards the camera.
    """

    x: np.ndarray
    y: np.ndarray
    points: np.ndarray
    normals: np.ndarray


def sample_surface(thing: StudioObjectKeys, columns: int = 61) -> Surface:
    """Return the object's surface on an even grid, edges included.

    Parameters
    ----------
    columns : int
        Along the width; rows keep the spacing.

    Notes
    -----
    The recess's walls are thin lines, which `light.bright_fields` treats by themselves.
    """
    width, height = thing.size_mm
    rows = max(3, round(columns * height / width) | 1)
    x, y = np.linspace(-width / 2, width / 2, columns), np.linspace(-height / 2, height / 2, rows)
    along, across = np.meshgrid(x, y)
    inner = [np.abs(a) < s / 2 - thing.border_mm for a, s in ((along, width), (across, height))]
    sunk = np.where(inner[0] & inner[1], -thing.recess_mm, 0.0)
    zero = np.zeros_like(along)
    return Surface(x, y, np.stack([along, across, sunk], -1), np.stack([zero, zero, zero + 1], -1))


def wall_deg(thing: StudioObjectKeys) -> float:
    """Return the slope of the recess's walls, degrees; 0 without a recess."""
    return float(np.degrees(np.arctan2(thing.recess_mm, thing.bevel_mm)))


@cache
def slope_nodes(spread: float, side: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes (p, q), (n, 2), and weights of sum 1 for a normal spread, to average over them.

    An even grid out to four spreads, for shading has a kink where a slope turns from the lamp.
    """
    nodes = (np.arange(side) + 0.5) / side * 8 - 4
    weights = np.exp(-0.5 * nodes**2)
    weights /= weights.sum()
    p, q = (spread * g.ravel() for g in np.meshgrid(nodes, nodes))
    return np.stack([p, q], 1), np.outer(weights, weights).ravel()


def _at_middle(lamps: Sequence[StudioLamp]) -> tuple[np.ndarray, np.ndarray]:
    """Strength (k,) and direction (k, 3) of every point of light at the object's middle."""
    pairs = [light_of(lamp, np.zeros(3)) for lamp in lamps]
    return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])


def shading_contrast(lamps: Sequence[StudioLamp], slope: float) -> float:
    """Return the spread over mean of light on a matte relief.

    Parameters
    ----------
    slope : float
        Root mean square of the relief's slope along any direction.

    Returns
    -------
    contrast : float
        One lamp at 45° on gentle relief gives the slope itself.
    """
    strength, towards = _at_middle(lamps)
    slopes, weights = slope_nodes(slope)
    normals = np.concatenate([-slopes, np.ones((len(slopes), 1))], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = np.maximum(normals @ towards.T, 0) @ strength
    mean = float(weights @ light)
    return float(np.sqrt(weights @ (light - mean) ** 2)) / mean


def hidden_share(lamps: Sequence[StudioLamp], slope: float) -> float:
    """Return the share of relief that a lamp cannot reach, weighted by what the lamps give.

    Slopes steeper than the lamp's height above the panel turn away from it: this is what makes
    grazing light exaggerate.

    Examples
    --------
    >>> from levkas.planning.setup import StudioLamp, lamp_place
    >>> low, high = (StudioLamp("a", lamp_place(a, 0.0, 2000.0), np.zeros(3)) for a in (80.0, 60.0))
    >>> round(hidden_share([low], 0.12), 3), round(hidden_share([high], 0.12), 6)
    (0.071, 1e-06)
    """
    from math import erfc

    strength, towards = _at_middle(lamps)
    flat = strength * np.maximum(towards[:, 2], 0)
    if not slope:
        return 0.0
    height = towards[:, 2] / np.maximum(np.hypot(towards[:, 0], towards[:, 1]), 1e-9)
    turned = np.array([0.5 * erfc(float(h) / (slope * np.sqrt(2))) for h in height])
    return float((flat * turned).sum() / max(float(flat.sum()), 1e-30))

"""The object's surface as a plan needs it: points and normals of a bent panel with a sunken middle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from levkas.planning.tables import ObjectKeys


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


def sample_surface(thing: ObjectKeys, columns: int = 61, *, recess: bool = True) -> Surface:
    """Return the object's surface on an even grid, edges included.

    Parameters
    ----------
    thing : ObjectKeys
    columns : int
        Along the width; rows keep the spacing.
    recess : bool
        Whether the middle is sunken; normals are those of the bend alone, for the recess's walls
        are thin lines that `light.bright_field` treats by themselves.
    """
    width, height = thing.size_mm
    rows = max(3, round(columns * height / width) | 1)
    x, y = np.linspace(-width / 2, width / 2, columns), np.linspace(-height / 2, height / 2, rows)
    along, across = np.meshgrid(x, y)
    sunk = np.zeros(along.shape)
    if recess and thing.recess_mm:
        inside = (np.abs(along) < width / 2 - thing.border_mm) & (
            np.abs(across) < height / 2 - thing.border_mm
        )
        sunk = np.where(inside, -thing.recess_mm, 0.0)
    if thing.bend is None:
        points = np.stack([along, across, sunk], -1)
        normals = np.zeros_like(points)
        normals[..., 2] = 1
        return Surface(x, y, points, normals)
    radius = thing.bend.radius_mm
    turn = (across if thing.bend.straight == "width" else along) / radius
    out = (radius + sunk) * np.sin(turn)
    up = (radius + sunk) * np.cos(turn) - radius
    zero = np.zeros_like(turn)
    if thing.bend.straight == "width":
        points = np.stack([along, out, up], -1)
        normals = np.stack([zero, np.sin(turn), np.cos(turn)], -1)
    else:
        points = np.stack([out, across, up], -1)
        normals = np.stack([np.sin(turn), zero, np.cos(turn)], -1)
    return Surface(x, y, points, normals)


def tilt_deg(thing: ObjectKeys) -> float:
    """Return the largest tilt of the bent panel's normal, degrees: asin of half the side over R.

    >>> from levkas.planning.tables import Bend, ObjectKeys
    >>> round(tilt_deg(ObjectKeys(size_mm=(420, 320), bend=Bend(radius_mm=2000.0))), 2)
    4.58
    """
    if thing.bend is None:
        return 0.0
    side = thing.size_mm[1 if thing.bend.straight == "width" else 0]
    return float(np.degrees(side / 2 / thing.bend.radius_mm))


def wall_deg(thing: ObjectKeys) -> float:
    """Return the slope of the recess's walls, degrees; 0 without a recess."""
    return float(np.degrees(np.arctan2(thing.recess_mm, thing.bevel_mm)))


def height_range(thing: ObjectKeys) -> tuple[float, float]:
    """Return the lowest and highest z of the object, mm, 0 at the rim's top in the middle.

    >>> from levkas.planning.tables import ObjectKeys
    >>> height_range(ObjectKeys(size_mm=(420, 320), recess_mm=3.0))
    (-3.0, 0.0)
    """
    low = -thing.recess_mm
    if thing.bend is not None:
        side = thing.size_mm[1 if thing.bend.straight == "width" else 0]
        low = min(low, thing.bend.radius_mm * (np.cos(side / 2 / thing.bend.radius_mm) - 1))
    return float(low), 0.0

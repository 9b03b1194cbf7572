"""Irradiance of a surface under lamps: E = Σ I(θ)·max(0, n·s) / r²."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from levkas.planning.setup import StudioLamp


def light_of(lamp: StudioLamp, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the light that a lamp sends to points.

    Parameters
    ----------
    lamp : StudioLamp
    points : ndarray, (..., 3), mm

    Returns
    -------
    strength : ndarray, (k, ...)
        Illuminance of a plane that faces the lamp, lux where `lamp.candela` is known; one row a
        point of a soft light.
    towards : ndarray, (k, ..., 3)
        Unit vectors to the lamp.
    """
    places, shares = lamp.points()
    away = places.reshape(-1, *[1] * (points.ndim - 1), 3) - points
    squared = (away * away).sum(-1)
    towards = away / np.sqrt(squared)[..., None]
    lobe = lamp.lobe(-(towards @ lamp.axis))
    shares = shares.reshape(-1, *[1] * (points.ndim - 1))
    return 1e6 * lamp.candela * shares * lobe / squared, towards


def illuminate(lamps: Iterable[StudioLamp], points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the illuminance of points by all lamps, lux where their power is known.

    Parameters
    ----------
    lamps : iterable of StudioLamp
    points, normals : ndarray, (..., 3)
        mm; unit vectors.

    Returns
    -------
    illuminance : ndarray, (...)
        0 where a point faces away from every lamp.

    Examples
    --------
    One candela, one metre, straight above:

    >>> from levkas.planning.setup import StudioLamp
    >>> lamp = StudioLamp("a", np.array([0.0, 0.0, 1000.0]), np.array([0.0, 0.0, -1.0]))
    >>> float(illuminate([lamp], np.zeros(3), np.array([0.0, 0.0, 1.0])))
    1.0
    """
    total = np.zeros(points.shape[:-1])
    for lamp in lamps:
        strength, towards = light_of(lamp, points)
        total = total + (strength * np.maximum((towards * normals).sum(-1), 0)).sum(0)
    return total


def drop(values: np.ndarray) -> float:
    """Return how far light falls over an object: 1 − min/max.

    >>> drop(np.array([0.9, 1.0]))
    0.1
    """
    return round(float(1 - np.min(values) / np.max(values)), 12)

"""Lamps and cameras in their places, and the light that lamps send: E = Σ I(θ)·max(0, n·s) / r²."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.problems import unknown_name
from levkas.planning.spectra import GRID
from levkas.planning.tables import PlanRefused

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from levkas.planning.tables import Bench, StudioCameraKeys, StudioObjectKeys


SOFT_NODES = 5
"""Points along each side of a soft light: a Gauss-Legendre rule."""


def lobe_exponent(half_width_deg: float) -> float:
    """Return m of the lobe cosᵐ that is at half its intensity at an angle, degrees.

    >>> round(lobe_exponent(15.0), 2), round(lobe_exponent(60.0), 2)
    (19.99, 1.0)
    """
    return float(np.log(0.5) / np.log(np.cos(np.radians(half_width_deg))))


@dataclass(frozen=True, eq=False)
class StudioLamp:
    """A lamp in its place.

    Parameters
    ----------
    name : str
        Its kind, with a number where a setup has several.
    place, axis : ndarray, (3,)
        mm; unit vector of where it aims.
    exponent : float
        m of the lobe cosᵐ of its intensity; 0 shines evenly.
    candela : float
        Luminous intensity along the axis, filters and sheet included.
    spectrum : ndarray, (n,)
        Relative power after filters at `spectra.GRID`, of luminous integral 1.
    known : (first, last)
        Wavelengths at which the lamp and all its filters are known, nm.
    size_mm : (width, height) or None
        Of a soft light; none is a point.
    polariser : {"p", "s"} or None
        p lies in the plane of the object's normal and the lamp.
    measured : bool
        Whether its power is known; else `candela` is relative.
    """

    name: str
    place: np.ndarray
    axis: np.ndarray
    exponent: float = 0.0
    candela: float = 1.0
    spectrum: np.ndarray = field(default_factory=lambda: np.zeros(len(GRID)))
    known: tuple[float, float] = (GRID[0], GRID[-1])
    size_mm: tuple[float, float] | None = None
    polariser: str | None = None
    filters: tuple[str, ...] = ()
    measured: bool = True

    @property
    def angle_deg(self) -> float:
        """From the object's normal, degrees."""
        return float(np.degrees(np.arccos(self.place[2] / self.distance_mm)))

    @property
    def azimuth_deg(self) -> float:
        """From x towards y, degrees."""
        return float(np.degrees(np.arctan2(self.place[1], self.place[0])))

    @property
    def distance_mm(self) -> float:
        """From the object's middle."""
        return float(np.linalg.norm(self.place))

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return points that stand for the lamp, (n, 3) mm, and the share of each, of sum 1."""
        if self.size_mm is None:
            return self.place[None], np.ones(1)
        across = np.cross(self.axis, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        up = np.cross(across, self.axis)
        nodes, weights = np.polynomial.legendre.leggauss(SOFT_NODES)
        a, b = (g.ravel() for g in np.meshgrid(nodes, nodes))
        width, height = self.size_mm
        spread = 0.5 * (width * a[:, None] * across + height * b[:, None] * up)
        return self.place + spread, np.outer(weights, weights).ravel() / 4


@dataclass(frozen=True, eq=False)
class Lighting:
    """One setup: its lamps, and whether the camera looks through a sheet polariser."""

    name: str
    lamps: tuple[StudioLamp, ...]
    title: str = ""
    camera_polariser: str | None = None
    illuminance_lx: float | None = None

    @property
    def crossed(self) -> bool:
        """Whether camera and lamps are polarised at right angles."""
        return self.camera_polariser == "crossed"


@dataclass(frozen=True, eq=False)
class StudioCamera:
    """A camera in its place; `keys` are those of its table."""

    name: str
    keys: StudioCameraKeys
    labels: tuple[str, ...] = ()
    wavelengths: np.ndarray = field(default_factory=lambda: np.zeros(0))
    quantum: np.ndarray = field(default_factory=lambda: np.zeros((0, len(GRID))))
    range_nm: tuple[float, float] = (400.0, 720.0)

    @property
    def distance_mm(self) -> float:
        """From the object's middle."""
        return self.keys.distance_mm

    @property
    def place(self) -> np.ndarray:
        """Where it stands on the object's normal, mm, (3,)."""
        return np.array([0.0, 0.0, self.distance_mm])


@dataclass(frozen=True, eq=False)
class StudioSetup:
    """Everything of a setup file."""

    path: Path
    bench: Bench
    lightings: dict[str, Lighting]
    cameras: dict[str, StudioCamera]

    @property
    def object(self) -> StudioObjectKeys:
        """What is to be captured."""
        return self.bench.object

    def lighting(self, name: str | None = None) -> Lighting:
        """Return a lighting by name, the first without one."""
        if name is None:
            return next(iter(self.lightings.values()))
        if name not in self.lightings:
            what, file = "there is no such setup", str(self.path)
            raise PlanRefused(unknown_name(what, name, self.lightings, file=file, field="setups"))
        return self.lightings[name]


def lamp_place(angle_deg: float, azimuth_deg: float, distance_mm: float) -> np.ndarray:
    """Return where a lamp stands, mm, (3,).

    >>> lamp_place(70.0, 0.0, 2100.0).round().tolist()
    [1973.0, 0.0, 718.0]
    """
    angle, azimuth = np.radians(angle_deg), np.radians(azimuth_deg)
    sine = np.sin(angle)
    return distance_mm * np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(angle)])


def aim_point(aim: str, place: np.ndarray, size_mm: tuple[float, float]) -> np.ndarray:
    """Return the point on the object that a lamp aims at, mm, (3,).

    The far edge is where the line from the lamp's foot through the middle leaves the object.

    >>> aim_point("far edge", np.array([1973.0, 0.0, 718.0]), (420.0, 320.0)).tolist()
    [-210.0, 0.0, 0.0]
    """
    away = np.hypot(place[0], place[1])
    if aim == "middle" or away < 1e-6:
        return np.zeros(3)
    to_lamp = place[:2] / away
    reach = min(s / 2 / max(abs(c), 1e-9) for s, c in zip(size_mm, to_lamp, strict=True))
    return np.array([*(0.0 - reach * to_lamp), 0.0])


def light_of(lamp: StudioLamp, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the light that a lamp sends to points.

    Parameters
    ----------
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
    cosine = np.clip(-(towards @ lamp.axis), 0.0, 1.0)
    lobe = cosine**lamp.exponent if lamp.exponent else np.ones_like(cosine)
    shares = shares.reshape(-1, *[1] * (points.ndim - 1))
    return 1e6 * lamp.candela * shares * lobe / squared, towards


def illuminate(lamps: Iterable[StudioLamp], points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the illuminance of points by all lamps, lux where their power is known.

    Parameters
    ----------
    points, normals : ndarray, (..., 3)
        mm; unit vectors.

    Returns
    -------
    illuminance : ndarray, (...)
        0 where a point faces away from every lamp.

    Examples
    --------
    One candela, one metre, straight above:

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

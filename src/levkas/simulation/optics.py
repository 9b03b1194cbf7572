"""Exact maps between panel and pixels: pinhole, lens distortion, scan, lateral colour.

The chain of a band: panel (s, t) → camera frame → ideal pixel → lens → *base* pixel → chromatic
magnification and shift → misalignment of the sensor → native pixel. All sensors and bands of a
camera share the base frame; the two last steps are affine, but for the smile of a line scanner.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from levkas.simulation import rays
from levkas.simulation.painting import Panel

MIDDLE_NM, SPAN_NM = 550.0, 300.0


@dataclass(frozen=True)
class ChromaticOptics:
    """Lateral chromatic aberration, polynomials in x = (wavelength − 550 nm) / 300 nm.

    Parameters
    ----------
    magnification : tuple of float
        Coefficients of x, x², … of the relative magnification; 550 nm is the measure.
    shift_x, shift_y : tuple of float
        Coefficients of x, x², … of the shift, px.
    smile : tuple of float
        Coefficients of x, x², … of the bow of a scan line, px at the lens's `spread`.

    Examples
    --------
    >>> ChromaticOptics(magnification=(1e-3, 5e-4)).at(850.0)[0]
    1.0015
    """

    magnification: tuple[float, ...] = ()
    shift_x: tuple[float, ...] = ()
    shift_y: tuple[float, ...] = ()
    smile: tuple[float, ...] = ()

    def at(self, wavelength: float) -> tuple[float, float, float, float]:
        """Return (magnification, shift x, shift y, smile) at `wavelength`, nm."""
        x = (wavelength - MIDDLE_NM) / SPAN_NM
        m, dx, dy, bow = (
            float(sum(c * x ** (k + 1) for k, c in enumerate(part)))
            for part in (self.magnification, self.shift_x, self.shift_y, self.smile)
        )
        return 1.0 + m, dx, dy, bow


@dataclass(frozen=True)
class Viewpoint:
    """One camera before one object: where it stands, how it projects, how large its image is.

    Parameters
    ----------
    width, height : int
        Native pixels.
    rotation : tuple of 9 floats, row-major
    translation : tuple of 3 floats, mm
        A world point P is imaged at rotation · P + translation: x right, y down, z ahead.
    focal : float
        px.
    centre : tuple of 2 floats
        Principal point and centre of the lens, base px.
    spread : float
        px at which `radial` and `tangential` are quoted, as in `transforms.Lens`.
    motion : tuple of 3 floats, or None
        Direction in which a line scanner travels, world; None for a frame camera.
    step_mm : float
        Travel between two lines.
    wobble : tuple of 3 floats
        Amplitude in lines, period in mm and phase in radians of the unevenness of the travel.
    """

    width: int
    height: int
    rotation: tuple[float, ...]
    translation: tuple[float, ...]
    focal: float
    centre: tuple[float, float]
    spread: float
    radial: tuple[float, float] = (0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    motion: tuple[float, float, float] | None = None
    step_mm: float = 1.0
    wobble: tuple[float, float, float] = (0.0, 100.0, 0.0)

    def vector(self) -> np.ndarray:
        """Return the view as the numbers that kernels take, float64 (28,)."""
        turned = np.reshape(self.rotation, (3, 3)) @ np.array(self.motion or (0.0, 0.0, 0.0))
        return np.array(
            [
                *self.rotation,
                *self.translation,
                self.focal,
                *self.centre,
                self.spread,
                *self.radial,
                *self.tangential,
                0.0 if self.motion is None else 1.0,
                *turned,
                self.step_mm,
                *self.wobble,
            ]
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return asdict(self)

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> Viewpoint:
        """Return the view that `to_dict` wrote."""
        plain: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in record.items()
        }
        return cls(**plain)

    def moved(self, rotation: np.ndarray, translation: np.ndarray) -> Viewpoint:
        """Return the view of an object that was turned, then shifted, in the world (mm)."""
        mine = np.reshape(self.rotation, (3, 3))
        shifted = mine @ np.asarray(translation, float) + self.translation
        motion = None if self.motion is None else tuple(rotation.T @ self.motion)
        return replace(
            self,
            rotation=tuple(float(v) for v in (mine @ rotation).ravel()),
            translation=tuple(float(v) for v in shifted),
            motion=motion,
        )


def turn(x_deg: float, y_deg: float, z_deg: float) -> np.ndarray:
    """Return the (3, 3) rotation about X, then Y, then Z, degrees."""
    (cx, cy, cz), (sx, sy, sz) = (
        [f(np.radians(a)) for a in (x_deg, y_deg, z_deg)] for f in (np.cos, np.sin)
    )
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def band_to_base(
    view: Viewpoint, chromatic: tuple[float, float, float, float], affine: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return what takes native pixels of a band to base pixels: a (2, 3) matrix, then the bow.

    Parameters
    ----------
    chromatic : tuple
        What `Chromatic.at` returns.
    affine : ndarray, (2, 3)
        Misalignment of the sensor, pixels of the first sensor → this one.

    Returns
    -------
    matrix : ndarray, (2, 3)
    bow : float, px
        To be taken from y: ``bow · ((x_base − centre) / spread)²``.
    """
    m, dx, dy, bow = chromatic
    centre = np.array(view.centre)
    forward = np.eye(3)
    forward[:2, :2] *= m
    forward[:2, 2] = centre * (1 - m) + (dx, dy)
    sensor = np.vstack([affine, [0, 0, 1]])
    return np.linalg.inv(sensor @ forward)[:2], bow


def base_to_band(
    points: np.ndarray,
    view: Viewpoint,
    chromatic: tuple[float, float, float, float],
    affine: np.ndarray,
) -> np.ndarray:
    """Map base pixels, (n, 2), to native pixels of a band; the exact inverse of `band_to_base`."""
    m, dx, dy, bow = chromatic
    centre = np.array(view.centre)
    away = points - centre
    moved = centre + m * away + (dx, dy)
    moved[:, 1] += m * bow * (away[:, 0] / view.spread) ** 2
    return moved @ affine[:, :2].T + affine[:, 2]


def native_to_base(
    points: np.ndarray,
    view: Viewpoint,
    chromatic: tuple[float, float, float, float],
    affine: np.ndarray,
) -> np.ndarray:
    """Map native pixels of a band, (n, 2), to base pixels."""
    matrix, bow = band_to_base(view, chromatic, affine)
    base = np.asarray(points, float) @ matrix[:, :2].T + matrix[:, 2]
    base[:, 1] -= bow * ((base[:, 0] - view.centre[0]) / view.spread) ** 2
    return base


def panel_to_base(points: np.ndarray, view: Viewpoint, panel: Panel) -> np.ndarray:
    """Project panel points (n, 2) = (s, t) mm to base pixels, hidden or not."""
    return rays.project(np.ascontiguousarray(points, float), view.vector(), panel.vector())


def base_to_panel(points: np.ndarray, view: Viewpoint, panel: Panel) -> np.ndarray:
    """Return the panel points (n, 2) = (s, t) mm that base pixels see first.

    Beyond its edges the panel is continued, so that a picture's edge is interpolated like the
    rest; `Panel.contains` returns which. NaN where a ray misses even that.
    """
    return rays.cast(np.ascontiguousarray(points, float), view.vector(), panel.vector())

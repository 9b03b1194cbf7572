"""Field, working distance, sampling, depth of field and diffraction of a camera before an object.

Thin lens: with magnification m = f / (distance − f), the field is n·p/m, a point of blur c is
reached over 2·N·c·(1 + m)/m², and diffraction acts with N·(1 + m).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from levkas.planning.setup import StudioCamera, StudioSetup

MARGIN = 0.04
"""Narrow border around the object, as a share of the field, where lens faults are worst."""


def magnification(focal_mm: float, distance_mm: float) -> float:
    """Return the size of the image over that of the object."""
    if distance_mm <= focal_mm:
        raise ValueError(f"no image: {distance_mm:g} mm is within the focal length {focal_mm:g} mm")
    return focal_mm / (distance_mm - focal_mm)


def field_mm(pixels: tuple[int, int], pitch_um: float, m: float) -> tuple[float, float]:
    """Return what a sensor sees, (width, height) in mm.

    The paper's LCTF cameras, 60 mm at 185 cm:

    >>> [round(v) for v in field_mm((1392, 1040), 6.45, magnification(60.0, 1850.0))]
    [268, 200]
    """
    return pixels[0] * pitch_um / 1000 / m, pixels[1] * pitch_um / 1000 / m


def distance_for(focal_mm: float, sensor_mm: float, wanted_mm: float) -> float:
    """Return the working distance at which a field fills the sensor, mm: f·(1 + field/(n·p)).

    >>> round(distance_for(60.0, 1392 * 6.45e-3, 268.0))
    1851
    """
    return focal_mm * (1 + wanted_mm / sensor_mm)


def depth_of_field(f_number: float, blur_mm: float, m: float) -> float:
    """Return the depth over which a point stays within a circle of `blur_mm` on the sensor, mm.

    >>> round(depth_of_field(8.0, 6.45e-3, magnification(60.0, 1850.0)), 1)
    94.9
    """
    return 2 * f_number * blur_mm * (1 + m) / m**2


def diffraction_mtf(
    wavelength_nm: float | np.ndarray, f_number: float, m: float, pitch_um: float
) -> np.ndarray:
    """Return the contrast that diffraction leaves at the sensor's Nyquist frequency.

    Examples
    --------
    >>> m = magnification(60.0, 1850.0)
    >>> [round(float(diffraction_mtf(w, 8.0, m, 6.45)), 2) for w in (450, 550, 700, 950)]
    [0.64, 0.56, 0.45, 0.28]
    """
    cut_off = 1e6 / (np.asarray(wavelength_nm, float) * f_number * (1 + m))  # cycles per mm
    x = np.minimum(500 / pitch_um / cut_off, 1.0)
    return (2 / np.pi) * (np.arccos(x) - x * np.sqrt(1 - x * x))


@dataclass(frozen=True)
class Framing:
    """Field of one camera on the object, with contradictions in sentences."""

    camera: str
    distance_mm: float
    magnification: float
    field_mm: tuple[float, float]
    covers: bool
    samples_per_mm: float
    needed_distance_mm: float
    depth_of_field_mm: float
    relief_mm: float
    mtf: dict[str, float]
    contradictions: tuple[str, ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {**self.__dict__, "contradictions": list(self.contradictions)}


def plan_framing(setup: StudioSetup) -> list[Framing]:
    """Return the framing of every camera of a setup file.

    What a camera cannot do is listed in `contradictions`; nothing is raised.
    """
    return [_frame(setup, camera) for camera in setup.cameras.values()]


def _frame(setup: StudioSetup, camera: StudioCamera) -> Framing:
    keys, thing = camera.keys, setup.object
    m = magnification(keys.focal_mm, camera.distance_mm)
    field = field_mm(keys.pixels, keys.pitch_um, m)
    sensor = [n * keys.pitch_um / 1000 for n in keys.pixels]
    wanted = _oriented(thing.size_mm, field)
    covers = all(s >= w for s, w in zip(field, wanted, strict=True))
    needed = max(
        distance_for(keys.focal_mm, s, w * (1 + 2 * MARGIN))
        for s, w in zip(sensor, wanted, strict=True)
    )
    samples = 1000 * m / keys.pitch_um
    depth = depth_of_field(keys.f_number, keys.pitch_um / 1000, m)
    bands = (450.0, 550.0, 700.0, 950.0)
    mtf = {
        f"{w:g} nm": float(diffraction_mtf(w, keys.f_number, m, keys.pitch_um))
        for w in bands
        if camera.range_nm[0] <= w <= camera.range_nm[1]
    }
    frame = Framing(
        camera.name, camera.distance_mm, m, field, covers, samples, needed, depth,
        thing.recess_mm, mtf,
    )  # fmt: skip
    return Framing(
        **{**frame.__dict__, "contradictions": tuple(_contradictions(frame, camera, wanted))}
    )


def _oriented(size: tuple[float, float], field: tuple[float, float]) -> tuple[float, float]:
    """The object's sides along those of the picture, the longer along the longer."""
    turned = (size[0] >= size[1]) != (field[0] >= field[1])
    return (size[1], size[0]) if turned else size


def _contradictions(frame: Framing, camera: StudioCamera, wanted: tuple[float, float]) -> list[str]:
    """Describe in sentences what does not fit together."""
    keys, sentences = camera.keys, []
    w, h = frame.field_mm
    if not frame.covers:
        sensor = (keys.pixels[0] * keys.pitch_um / 1000, keys.pixels[1] * keys.pitch_um / 1000)
        shorter = (frame.distance_mm) / (
            1 + max(a / b for a, b in zip(wanted, sensor, strict=True))
        )
        sentences.append(
            f"From {frame.distance_mm / 10:.0f} cm a {keys.focal_mm:g} mm lens shows {w:.0f} x {h:.0f} mm on "
            f"{keys.pixels[0]} x {keys.pixels[1]} pixels of {keys.pitch_um:g} µm: smaller than the object, "
            f"{wanted[0]:.0f} x {wanted[1]:.0f} mm. Distance, focal length and sensor contradict the aim "
            f"of covering the object. Stand at {frame.needed_distance_mm / 10:.0f} cm, or take a lens of "
            f"{shorter:.0f} mm or shorter."
        )
    if frame.depth_of_field_mm < frame.relief_mm:
        sentences.append(
            f"The object is {frame.relief_mm:.1f} mm deep, but at f/{keys.f_number:g} only "
            f"{frame.depth_of_field_mm:.1f} mm are sharp to one pixel: stop down, or focus between."
        )
    weak = {k: v for k, v in frame.mtf.items() if v < 0.1}
    if weak:
        sentences.append(
            f"Diffraction at f/{keys.f_number:g} leaves less than a tenth of the contrast at the finest "
            f"detail in {', '.join(weak)}: open the lens."
        )
    return sentences

"""Calibrated cubes of one capture in native pixels, in memory and in the database."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.cube import Band, Cube, Flag
from levkas.registration.images import BandImage

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from levkas.building.places import Places
    from levkas.database.credits import Credits
    from levkas.discovery import Capture

UNRELIABLE = Flag.OUTSIDE | Flag.SATURATED
"""Pixels that registration must not lean on; single defects were replaced well enough for it."""


@dataclass(frozen=True)
class Native:
    """One capture, calibrated and not resampled: a cube a sensor.

    Parameters
    ----------
    cubes : dict of str to Cube
        Sensor name → cube; the name is empty for a camera of one sensor.
    aligns : dict of str to ("measure" or matrix)
        Native px of the first sensor → this one, as declared.
    captured : str or None
        Date of the first frame that says one, ISO 8601.
    warnings : tuple of str
    learnt : dict of str to dict
        What was learnt of each sensor and its light on the way, for the reports.
    """

    cubes: dict[str, Cube]
    aligns: Mapping[str, object] = field(default_factory=dict)
    captured: str | None = None
    warnings: tuple[str, ...] = ()
    learnt: Mapping[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def bands(self) -> tuple[Band, ...]:
        """All bands, sensor by sensor."""
        return tuple(band for cube in self.cubes.values() for band in cube.bands)

    @property
    def quantity(self) -> str:
        """``"reflectance"`` where every sensor has it, else ``"counts"``."""
        quantities = {cube.quantity for cube in self.cubes.values()}
        return "reflectance" if quantities == {"reflectance"} else "counts"

    @property
    def factor(self) -> int:
        """Side, px, of the blocks that make a pixel of `images`."""
        return 1

    def images(self) -> list[BandImage]:
        """Return every band as registration sees it, in memory of its own."""
        from levkas.database.spectral_tiff import planes_of

        return [
            BandImage(
                band.label,
                band.wavelength,
                values,
                np.isfinite(values) & ((flags & UNRELIABLE) == 0),
                sensor,
            )
            for sensor, cube in self.cubes.items()
            for band, values, flags in zip(
                cube.bands, planes_of(cube.values), planes_of(cube.flags), strict=True
            )
        ]

    def without_sigma(self) -> Native:
        """Return the cubes without sigma: it is on the disk, and only resampling asks for it."""
        cubes = {name: replace(cube, sigma=None) for name, cube in self.cubes.items()}
        return replace(self, cubes=cubes)

    def size_of(self, label: str) -> list[int]:
        """Return [width, height] of the sensor that recorded a band."""
        for cube in self.cubes.values():
            if label in cube.labels:
                return [cube.values.shape[1], cube.values.shape[0]]
        raise KeyError(label)


def least_bytes(cube: Cube) -> int:
    """Return what the files of a cube will take at the very least, so that a full disk is foreseen.

    Noise cannot be compressed: of float32 reflectance two bytes of four remain, of its sigma one;
    whole codes, which photographs are, get far smaller.
    """
    noisy = cube.quantity == "reflectance"
    each = (2 if noisy else 0) + (1 if noisy and cube.sigma is not None else 0)
    return cube.values.size * each


def write_native(native: Native, capture: Capture, places: Places, credits: Credits) -> list[Path]:
    """Write the cubes, their flags and, where known, their sigma; return the files."""
    from levkas.database.layers import Layer, write_tiffs
    from levkas.files import make_folder

    made = []
    layer = Layer(capture.object, capture.camera, capture.setup, credits=credits)
    for sensor, cube in native.cubes.items():
        path = places.native(capture.object, capture.camera, capture.setup, sensor, kind="")
        make_folder(path.parent)
        made += write_tiffs(path, layer, cube)
    return made


def read_native(
    capture: Capture, places: Places, quantity: str, warnings: tuple[str, ...]
) -> Native:
    """Read back what `write_native` wrote, without sigma."""
    cubes, aligns = {}, {}
    for sensor in capture.sensors:
        values = _read(capture, places, sensor.name, "")
        flags = _read(capture, places, sensor.name, ".flags")
        if values is None or flags is None:
            raise FileNotFoundError(
                places.native(capture.object, capture.camera, capture.setup, sensor.name)
            )
        cubes[sensor.name] = Cube(values, flags, None, sensor.bands, quantity)
        aligns[sensor.name] = sensor.align
    return Native(cubes, aligns, None, warnings)


def read_sigma(capture: Capture, places: Places, sensor: str) -> np.ndarray | None:
    """Read back the sigma of one sensor, None where it is not known."""
    return _read(capture, places, sensor, ".sigma")


def _read(capture: Capture, places: Places, sensor: str, kind: str) -> np.ndarray | None:
    from levkas.database.spectral_tiff import read_tiff_pages

    path = places.native(capture.object, capture.camera, capture.setup, sensor, kind=f"{kind}.tif")
    return read_tiff_pages(path) if path.is_file() else None

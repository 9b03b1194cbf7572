"""Calibrated cubes of one capture in native pixels, in memory and in the database."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.camera_kinds import KINDS
from levkas.core.cube import UNRELIABLE, Band, Cube, is_flagged
from levkas.core.files import make_folder
from levkas.core.machine import memory_bound
from levkas.core.problems import Problem, Refused
from levkas.core.threads import each
from levkas.database.layers import Layer, write_tiffs
from levkas.database.spectral_tiff import read_tiff_pages
from levkas.readers.frames import read_facts
from levkas.registration.bands import BandImage, share_of_most

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from levkas.campaign.discovery.captures import Capture
    from levkas.database.credits import Credits
    from levkas.database.layout import Places

PACKED_ROWS = 64


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
        """Return every band as registration sees it; reflectance in the memory of the cubes."""
        return [
            BandImage(band.label, band.wavelength, values, valid, sensor)
            for sensor, cube in self.cubes.items()
            for band, (values, valid) in zip(cube.bands, _pictures(cube), strict=True)
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


def _pictures(cube: Cube) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the values of every band and where they can be relied on, both (height, width); nowhere in a bad one."""
    planes = np.moveaxis(cube.values, 2, 0), np.moveaxis(cube.flags, 2, 0)
    for band, values, flags in zip(cube.bands, *planes, strict=True):
        known = np.isfinite(values) & ~is_flagged(flags, UNRELIABLE)
        if band.bad:
            known[:] = False
        yield share_of_most(values) if cube.quantity == "counts" else values, known


class PackedSigma:
    """Sigma of a cube kept small in memory, bit for bit, until resampling asks for it."""

    def __init__(self, sigma: np.ndarray) -> None:
        self._shape = sigma.shape
        parts = [sigma[y : y + PACKED_ROWS] for y in range(0, len(sigma), PACKED_ROWS)]
        self._parts = each(_pack, parts)

    def unpack(self) -> np.ndarray:
        """Return sigma as it was, float32, in memory of its own."""
        import imagecodecs

        sigma = np.empty(self._shape, np.float32)

        def fill(number: int) -> None:
            rows = sigma[number * PACKED_ROWS : (number + 1) * PACKED_ROWS]
            imagecodecs.blosc_decode(self._parts[number], out=rows.reshape(-1).view(np.uint8).data)

        each(fill, range(len(self._parts)))
        return sigma


@dataclass(frozen=True)
class FiledSigma:
    """Sigma of a cube in the database."""

    path: Path

    def unpack(self) -> np.ndarray:
        """Return sigma as it was written, float32."""
        return read_tiff_pages(self.path)


def sigmas_of(capture: Capture, places: Places) -> dict[str, FiledSigma]:
    """Return the sigma of every sensor of a capture that has one in the database."""
    paths = {
        s.name: places.native(
            capture.object, capture.camera, capture.setup, s.name, kind=".sigma.tif"
        )
        for s in capture.sensors
    }
    return {name: FiledSigma(path) for name, path in paths.items() if path.is_file()}


def _pack(part: np.ndarray) -> bytes:
    import imagecodecs

    packed = imagecodecs.blosc_encode(
        np.ascontiguousarray(part, np.float32).tobytes(),
        level=5,
        compressor="lz4",
        shuffle="bitshuffle",
        typesize=4,
        numthreads=1,
    )
    return bytes(packed)


def least_bytes(samples: int, quantity: str, *, noisy: bool) -> int:
    """Return what the files of so many samples will take at the very least, so that a full disk is foreseen.

    Noise cannot be compressed: of reflectance of 16 significant bits a good byte of four remains, of
    its sigma, where it is `noisy`, another; whole codes, which photographs are, get far smaller.
    """
    return samples * (1 + noisy) if quantity == "reflectance" else 0


def write_native(
    native: Native,
    capture: Capture,
    places: Places,
    credits: Credits,
    centroids: Mapping[str, float],
) -> list[Path]:
    """Write the cubes, their flags and, where known, their sigma; return the files."""

    made = []
    layer = Layer(
        capture.object, capture.camera, capture.setup, credits=credits, centroids=centroids
    )
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


def _read(capture: Capture, places: Places, sensor: str, kind: str) -> np.ndarray | None:

    path = places.native(capture.object, capture.camera, capture.setup, sensor, kind=f"{kind}.tif")
    return read_tiff_pages(path) if path.is_file() else None


CUBE_BYTES = 9
"""Of a calibrated value with its flags and its sigma; what is needed beside them comes on top."""


class TooLarge(Refused):
    """A capture that does not fit in memory."""


def require_memory(capture: Capture, kind: str) -> None:
    """Refuse with ``E_MEMORY`` a capture whose calibrated values alone are more than what is free.

    Parameters
    ----------
    capture : Capture
    kind : str
        Of its camera.

    Raises
    ------
    TooLarge
    """
    free = memory_bound()
    needed = CUBE_BYTES * count_values(capture, kind)
    if free is None or needed <= free:
        return
    raise TooLarge(
        Problem(
            "E_MEMORY",
            f"{capture.object}/{capture.layer} does not fit in memory",
            file=str(capture.sensors[0].object[0].path),
            field=f"cameras.{capture.camera}",
            found=f"{free / 1e9:.1f} GB free",
            expected=f"at least {needed / 1e9:.1f} GB",
            fix="Build on a machine with more memory, or crop or bin the frames. Only ENVI line "
            "scans of cameras other than the reference are built line by line.",
        )
    )


def count_values(capture: Capture, kind: str) -> int:
    """Return how many values, all bands, the largest sensor of a capture has; of a scan, all strips."""
    counts = [0]
    for sensor in capture.sensors:
        sizes = [_samples_in(frame.path) for frame in sensor.object]
        if KINDS[kind].is_scanned:
            counts.append(sum(sizes))
        elif KINDS[kind].bands_in == "files":
            counts.append(max(sizes, default=0) * len(sensor.bands))
        else:
            counts.append(max(sizes, default=0))
    return max(counts)


def _samples_in(path: Path) -> int:

    try:
        return prod(int(n) for n in read_facts(path).shape)
    except Refused:  # all that is wrong with the frames is told together, when they are read
        return 0

"""A capture calibrated in native pixels, and one whose cubes are held whole: in memory, in files, on the grid."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import prod
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from levkas.calibration.patterns import channel_table
from levkas.campaign.camera_kinds import KINDS
from levkas.core.cube import UNRELIABLE, Band, Cube, is_flagged
from levkas.core.disk import require_space
from levkas.core.files import make_folder
from levkas.core.machine import memory_bound
from levkas.core.problems import Problem, Refused
from levkas.core.rounding import round_root, round_sigma, round_values
from levkas.database.layers import Layer, write_tiffs
from levkas.database.spectral_tiff import read_tiff_pages
from levkas.geometry.resample import warp
from levkas.readers.frames import read_facts
from levkas.registration.bands import BandImage, Sites, share_of_most
from levkas.stages.capture_statistics import focus_of
from levkas.stages.shared_noise import neighbour_correlation, shared_by_strips, shared_noise

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from levkas.campaign.discovery.captures import Capture
    from levkas.core.cube import CubeRows
    from levkas.database.credits import Credits
    from levkas.database.layout import Places
    from levkas.geometry.transforms import Transform
    from levkas.stages.shared_noise import Mosaic


@dataclass(frozen=True)
class Native:
    """A capture that is held whole: a cube a sensor.

    Parameters
    ----------
    cubes : dict of str to Cube
        Sensor name → cube; the name is empty for a camera of one sensor.
    aligns : dict of str to object
        Native px of the first sensor → each, as declared: ``"measure"`` or a matrix.
    captured : str, optional
        Date of the first frame that states one, ISO 8601.
    warnings : tuple of str
    measured : dict of str to dict
        What was measured of each sensor and its light on the way, for the reports.
    mosaics : dict of str to Mosaic
        Of the sensors whose values were demosaiced.
    sigmas : dict of str to PackedSigma or FiledSigma
        Of the sensors whose cubes are without.
    """

    cubes: dict[str, Cube]
    aligns: Mapping[str, object] = field(default_factory=dict)
    captured: str | None = None
    warnings: tuple[str, ...] = ()
    measured: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    mosaics: Mapping[str, Mosaic] = field(default_factory=dict)
    sigmas: dict[str, PackedSigma | FiledSigma] = field(default_factory=dict)
    factor: ClassVar[int] = 1
    """Side, px, of the blocks that make a pixel of `images`."""
    thinning: ClassVar[int] = 1
    """Every so-many-th pixel a side of the layer makes its range and noise."""
    white: ClassVar[float | None] = None
    is_streamed: ClassVar[bool] = False

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
    def focus(self) -> list[dict[str, Any]]:
        """Blur of the sharpest edges, band by band."""
        return focus_of(self.cubes.values())

    def images(self) -> list[BandImage]:
        """Return every band as registration takes it; reflectance in the memory of the cubes."""
        return [
            BandImage(band.label, band.wavelength, values, valid, sensor, sites)
            for sensor, cube in self.cubes.items()
            for band, sites, (values, valid) in zip(
                cube.bands, self._sites(sensor), _pictures(cube), strict=True
            )
        ]

    def _sites(self, sensor: str) -> list[Sites | None]:
        """Return where each band of a sensor was measured, by its mosaic; None where everywhere."""
        count, mosaic = len(self.cubes[sensor].bands), self.mosaics.get(sensor)
        if mosaic is None:
            return [None] * count
        table = channel_table(mosaic.pattern, mosaic.channels)
        return [Sites.in_pattern(table, channel) for channel in range(count)]

    def sensors(self) -> Iterator[tuple[str, Cube | CubeRows]]:
        """Yield each sensor's name and its pixels."""
        yield from self.cubes.items()

    def packed(self) -> Native:
        """Return the cubes without sigma, which only resampling needs: packed."""
        cubes = {name: replace(cube, sigma=None) for name, cube in self.cubes.items()}
        sigmas = {n: PackedSigma(c.sigma) for n, c in self.cubes.items() if c.sigma is not None}
        return replace(self, cubes=cubes, sigmas={**self.sigmas, **sigmas})

    def size_of(self, label: str) -> list[int]:
        """Return [width, height] of the sensor that recorded a band."""
        for cube in self.cubes.values():
            if label in cube.labels:
                return [cube.values.shape[1], cube.values.shape[0]]
        raise KeyError(label)

    def noise_correlation(self, maps: Mapping[str, Transform], size: tuple[int, int]) -> np.ndarray:
        """Return the correlation of the noise of neighbours on the grid, by the first sensor."""
        name, cube = next(iter(self.cubes.items()))
        own = [maps[band.label] for band in cube.bands]
        return neighbour_correlation(own, size[::-1], self.mosaics.get(name))

    def on_grid(
        self, maps: Mapping[str, Transform], size: tuple[int, int], *, spool: Path | None = None
    ) -> Cube:
        """Return all bands on the grid; sensor by sensor, so that the memory of sigma goes.

        Neighbours of a demosaiced sensor share noise, and those of strips that were moved by a fraction of a pixel.
        A layer has sigma, and values rounded by it, where that of every sensor is known.
        """
        noisy = all(name in self.sigmas or c.sigma is not None for name, c in self.cubes.items())
        on_grid = [
            self._on_grid(name, [maps[b.label] for b in cube.bands], size, noisy=noisy)
            for name, cube in self.cubes.items()
        ]
        return Cube(
            _joined([one.values for one in on_grid]),
            _joined([one.flags for one in on_grid]),
            _joined([one.sigma for one in on_grid if one.sigma is not None]) if noisy else None,
            self.bands,
            self.quantity,
        )

    def _on_grid(
        self, sensor: str, maps: Sequence[Transform], size: tuple[int, int], *, noisy: bool
    ) -> Cube:
        cube, shape, measured = self.cubes[sensor], size[::-1], self.measured.get(sensor, {})
        variance = self._take_variance(sensor) if noisy else None
        if variance is not None:
            if sensor in self.mosaics:
                variance *= shared_noise(self.mosaics[sensor], maps, shape)
            if strips := measured.get("strips"):
                variance *= shared_by_strips(strips, cube.values.shape[1], maps, shape)[:, None]
        warped = warp(cube.values, maps, shape, flags=cube.flags, variance=variance)
        found = warped.variance
        if found is not None:
            found = round_root(found, out=found)
        values = round_values(warped.values, found, out=warped.values)
        return Cube(values, warped.flags, found, cube.bands, cube.quantity)

    def _take_variance(self, sensor: str) -> np.ndarray | None:
        """Return the square of a sensor's sigma, in place of it: of a scan it is most of a gigabyte."""
        packed = self.sigmas.pop(sensor, None)
        if packed is None:
            sigma = self.cubes[sensor].sigma
            return None if sigma is None else np.square(sigma)
        sigma = packed.unpack()
        return np.square(sigma, out=sigma)


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)


def _pictures(cube: Cube) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the values of every band and where they can be relied on, both (height, width); nowhere in a bad one."""
    planes = np.moveaxis(cube.values, 2, 0), np.moveaxis(cube.flags, 2, 0)
    for band, values, flags in zip(cube.bands, *planes, strict=True):
        known = np.isfinite(values) & ~is_flagged(flags, UNRELIABLE)
        if band.bad:
            known[:] = False
        yield share_of_most(values) if cube.quantity == "counts" else values, known


class PackedSigma:
    """Sigma of a cube in half of its memory until resampling needs it: the lower half of a float32 has none of its 8 significant bits.

    Examples
    --------
    >>> sigma = np.float32([[[0.75, np.nan]]])
    >>> PackedSigma(sigma).unpack().tolist()
    [[[0.75, nan]]]
    """

    def __init__(self, sigma: np.ndarray) -> None:
        self._upper = _halves(np.ascontiguousarray(round_sigma(sigma), "<f4")).copy()

    def unpack(self) -> np.ndarray:
        """Return sigma, rounded as `round_sigma` does, float32, in memory of its own."""
        sigma = np.zeros(self._upper.shape, "<f4")
        _halves(sigma)[...] = self._upper
        return sigma


def _halves(numbers: np.ndarray) -> np.ndarray:
    """Return the upper 16 bits of float32, in their memory."""
    return numbers.view("<u2")[..., 1::2]


@dataclass(frozen=True)
class FiledSigma:
    """Sigma of a cube in the database."""

    path: Path

    def unpack(self) -> np.ndarray:
        """Return sigma as it was written, float32."""
        return read_tiff_pages(self.path)


def least_bytes(samples: int, quantity: str, *, noisy: bool) -> int:
    """Return what the files of so many samples will take at the very least, so that a full disk is foreseen.

    Noise cannot be compressed: of reflectance of 16 significant bits a good byte of four remains, of
    its sigma, where it is `noisy`, another; whole codes, which photographs are, get far smaller.
    """
    return samples * (1 + noisy) if quantity == "reflectance" else 0


def write_native(
    parts: Iterable[tuple[str, Cube | CubeRows]],
    capture: Capture,
    places: Places,
    credits: Credits,
    centroids: Mapping[str, float],
    folder: Path | None = None,
) -> list[Path]:
    """Write the pixels of every part, named by its sensor, their flags and, where known, their sigma; return the files.

    They go into the database unless another `folder` is given.
    """
    layer = Layer(
        capture.object, capture.camera, capture.setup, credits=credits, centroids=centroids
    )
    made = []
    for sensor, rows in parts:
        least = least_bytes(prod(rows.shape), rows.quantity, noisy=rows.has_sigma)
        require_space(places.output, least)
        where = capture.object, capture.camera, capture.setup, sensor
        path = places.native(*where, kind="", folder=folder)
        make_folder(path.parent)
        made += write_tiffs(path, layer, rows)
    return made


TILE = "tile-"


def part_name(capture: Capture, sensor: str) -> str:
    """Return how a part of a layer is called in the names of its native files: ``ccd1``, ``tile-r2c3_ccd1``, or nothing."""
    return "_".join(filter(None, (capture.tile and f"{TILE}{capture.tile}", sensor)))


def read_native(
    capture: Capture,
    places: Places,
    notes: Mapping[str, Any],
    mosaics: Mapping[str, Mosaic],
    folder: Path | None = None,
) -> Native:
    """Read back what `write_native` wrote, sigma when it is needed; `notes` are those of its record."""
    cubes, aligns, sigmas = {}, {}, {}
    for sensor in capture.sensors:
        name, quantity = sensor.name, notes.get("quantity", "counts")
        paths = {
            kind: places.native(
                capture.object,
                capture.camera,
                capture.setup,
                part_name(capture, name),
                kind=f"{kind}.tif",
                folder=folder,
            )
            for kind in ("", ".flags", ".sigma")
        }
        values, flags = (read_tiff_pages(paths[kind]) for kind in ("", ".flags"))
        cubes[name] = Cube(values, flags, None, sensor.bands, quantity)
        aligns[name] = sensor.align
        if paths[".sigma"].is_file():
            sigmas[name] = FiledSigma(paths[".sigma"])
    facts = notes.get("captured"), tuple(notes.get("warnings", ())), notes.get("measured", {})
    return Native(cubes, aligns, *facts, mosaics, {**sigmas})


CUBE_BYTES = 9
"""Of a calibrated value with its flags and its sigma; what is needed beside them comes on top."""


class TooLarge(Refused):
    """A capture that does not fit in memory."""


def require_memory(capture: Capture, kind: str) -> None:
    """Refuse with ``E_MEMORY`` a capture whose calibrated values alone are more than what is free.

    Raises TooLarge.

    Parameters
    ----------
    kind : str
        Of its camera.
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
    except Refused:  # all that is wrong with the frames is reported together, when they are read
        return 0

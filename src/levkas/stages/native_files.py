"""Native pixels in the files of the database, and how much memory and disk a capture takes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.camera_kinds import KINDS
from levkas.core.cube import Cube
from levkas.core.disk import require_space
from levkas.core.files import make_folder
from levkas.core.machine import memory_bound
from levkas.core.problems import Problem, Refused
from levkas.database.layers import Layer, write_tiffs
from levkas.database.tiff_pages import open_pages
from levkas.readers.frames import read_facts
from levkas.stages.parts import SAMPLE_BYTES, Part

if TYPE_CHECKING:
    from collections.abc import Iterable

    from levkas.campaign.discovery.captures import Capture, SensorFrames
    from levkas.core.cube import CubeRows
    from levkas.database.credits import Credits
    from levkas.database.layout import Places
    from levkas.stages.shared_noise import Mosaic

TILE = "tile-"


def part_name(capture: Capture, sensor: str) -> str:
    """Return how a part of a layer is called in the names of its native files: ``ccd1``, ``tile-r2c3_ccd1``, or nothing."""
    return "_".join(filter(None, (capture.tile and f"{TILE}{capture.tile}", sensor)))


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
    """Write pixels, flags and, where known, sigma of every part, named by its sensor, into the database or another `folder`; return the files."""
    where, made = (capture.object, capture.camera, capture.setup), []
    layer = Layer(*where, credits=credits, centroids=centroids)
    for sensor, rows in parts:
        least = least_bytes(prod(rows.shape), rows.quantity, noisy=rows.has_sigma)
        require_space(places.output, least)
        path = places.native(*where, sensor, kind="", folder=folder)
        make_folder(path.parent)
        made += write_tiffs(path, layer, rows)
    return made


def filed_parts(
    capture: Capture,
    places: Places,
    mosaics: Mapping[str, Mosaic],
    quantity: str,
    folder: Path | None,
) -> Iterator[Part]:
    """Yield the tiles of a capture from the files that `write_native` wrote."""
    for tile in capture.tiles:
        for sensor in tile.sensors:
            where = tile.object, tile.camera, tile.setup, part_name(tile, sensor.name)
            paths = [
                places.native(*where, kind=f"{kind}.tif", folder=folder)
                for kind in ("", ".flags", ".sigma")
            ]
            yield _filed(paths, sensor, tile.tile, mosaics.get(sensor.name), quantity)


def _filed(
    paths: list[Path], sensor: SensorFrames, tile: str, mosaic: Mosaic | None, quantity: str
) -> Part:
    values, flags = open_pages(paths[0]), open_pages(paths[1])
    sigma = open_pages(paths[2]) if paths[2].is_file() else None

    def read(start: int, stop: int, noisy: bool) -> Cube:
        known = sigma.read(start, stop) if sigma is not None and noisy else None
        rows = values.read(start, stop), flags.read(start, stop), known
        return Cube(*rows, sensor.bands, quantity)

    known = sigma is not None
    return Part(sensor.name, sensor.bands, values.shape, quantity, known, read, tile, mosaic)


class TooLarge(Refused):
    """A capture that does not fit in memory."""


def require_memory(capture: Capture, kind: str) -> None:
    """Refuse with ``E_MEMORY``, as TooLarge, a capture of a camera of a `kind` whose calibrated values alone are more than what is free."""
    free = memory_bound()
    needed = SAMPLE_BYTES * count_values(capture, kind)
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
    traits, counts = KINDS[kind], [0]
    for sensor in capture.sensors:
        sizes = [_samples_in(frame.path) for frame in sensor.object]
        bands = len(sensor.bands) if traits.bands_in == "files" else 1
        counts.append(sum(sizes) if traits.is_scanned else max(sizes, default=0) * bands)
    return max(counts)


def _samples_in(path: Path) -> int:
    try:
        return prod(int(n) for n in read_facts(path).shape)
    except Refused:  # all that is wrong with the frames is reported together, when they are read
        return 0

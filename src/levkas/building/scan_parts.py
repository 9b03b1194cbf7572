"""Calibrated lines of a scan as files: in one pass, or in parts that several workers make and one joins.

A part is a block of lines. Its files, beside the database, hold strips of the TIFFs as they will be, and what
its lines have shown; joined, parts are the bytes of one pass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import lcm, prod
from typing import TYPE_CHECKING

import numpy as np

from levkas.building.build_records import Written
from levkas.building.native_cubes import least_bytes
from levkas.building.scans import LinesSeen
from levkas.building.strips import JoinedStrips
from levkas.core.disk import require_space
from levkas.core.files import make_folder, together
from levkas.core.threads import made_ahead
from levkas.database.layers import Layer
from levkas.database.spectral_tiff import strip_rows
from levkas.database.streaming_writer import RowsPart, SpooledTiffs

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from levkas.building.scans import Lines, Scan
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.credits import Credits
    from levkas.database.layout import Places

PART_SAMPLES = 500_000_000
"""Of a part, about: 1 GB of codes, some seconds of work."""
MOST_PARTS = 100
"""Of a scan, which are open at once when they are joined."""
PARTS, PICTURES = "calibrate.parts", "pictures.raw"


def cuts_of(scan: Scan) -> tuple[int, ...]:
    """Return the lines at which a scan is cut into parts, the first and the last included; () for one part.

    A denoised scan is one: its subspace is found in a sum over all lines, in their order. So are joined strips, which
    every part would have to look at whole.
    """
    lines, samples, _ = scan.shape
    if scan.context.camera.denoise or isinstance(scan.source, JoinedStrips):
        return ()
    # Neither pixels of the pictures nor strips of the values are cut.
    unit = lcm(scan.factor, strip_rows(samples, np.float32))
    count = min(MOST_PARTS, max(1, round(prod(scan.shape) / PART_SAMPLES)))
    step = unit * max(1, round(lines / count / unit))
    starts = [y for y in range(0, lines, step) if y == 0 or lines - y >= step / 2]
    return (*starts, lines) if len(starts) > 1 else ()


def part_of(places: Places, capture: Capture, lines: Lines) -> RowsPart:
    """Return where a part of a capture is kept until all are joined."""
    folder = places.kept / capture.object / capture.layer / PARTS
    return RowsPart(folder / f"{lines[0]}-{lines[1]}", lines)


def write_part(
    scan: Scan, capture: Capture, places: Places, lines: Lines, before: Callable[[], object]
) -> Written:
    """Calibrate some lines and keep them aside, to be joined; `before` as of `core.files.together`.

    Raises WriteRefused, before a line is calibrated, where there is no room for all parts and what they are
    joined to.
    """
    part, noisy = part_of(places, capture, lines), scan.has_sigma
    make_folder(part.base.parent)
    there = sum(_size_of(path) for path in part.base.parent.iterdir())
    least = least_bytes(prod(scan.shape), scan.quantity, noisy=noisy)
    require_space(places.kept, max(least, 2 * least - there))
    seen = LinesSeen(scan, lines)
    with together(before):
        part.write(made_ahead(seen.blocks()), scan.shape, sigma=noisy, more=seen.arrays)
    return Written((), {}, aside=part.files(sigma=noisy))


def _size_of(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:  # another worker's, which has its name now
        return 0


def write_scan(
    scan: Scan,
    capture: Capture,
    places: Places,
    credits: Credits,
    centroids: Mapping[str, float],
    cuts: Sequence[int],
) -> list[Path]:
    """Write the calibrated lines of a scan as `native_cubes.write_native` would.

    Parameters
    ----------
    cuts : sequence of int
        Where there are parts of them, which are joined; else () and all lines are calibrated.
    """
    sensor = capture.sensors[0].name
    base = places.native(capture.object, capture.camera, capture.setup, sensor, kind="")
    make_folder(base.parent)
    layer = Layer(
        capture.object, capture.camera, capture.setup, credits=credits, centroids=centroids
    )
    with SpooledTiffs(base, scan.shape, sigma=scan.has_sigma) as tiffs:
        if cuts:
            parts = [part_of(places, capture, lines) for lines in pairwise(cuts)]
            scan.joined(_taken(parts, tiffs))
        else:
            for cube in made_ahead(scan.passed()):
                tiffs.write_rows(cube)
        return tiffs.finish(layer, scan.bands, scan.quantity)


def _taken(
    parts: Sequence[RowsPart], tiffs: SpooledTiffs
) -> Iterator[tuple[Lines, Mapping[str, np.ndarray]]]:
    """Hand the strips of parts to the writer one by one; yield their lines and what these have shown."""
    for part in parts:
        with np.load(part.index) as index:
            tiffs.take(part, index)
            yield part.rows, index


def pictures_of(places: Places, capture: Capture) -> Path:
    """Return where the pictures of a scan are kept that was joined from parts."""
    return places.kept / capture.object / capture.layer / PICTURES

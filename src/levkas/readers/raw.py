"""Camera raw: the mosaic as the sensor recorded it, or the colours of a linear DNG; never LibRaw's own rendering."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from itertools import islice
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.digests import Stamp, stamp_of
from levkas.readers.black_levels import BlackLevels, black_facts
from levkas.readers.decoder import decode
from levkas.readers.exif import iso_date, numbers_of, read_exif
from levkas.readers.facts import Facts, decoding, refused, unreadable
from levkas.readers.pictures import SCAN, jpeg_frame, jpeg_segments
from levkas.readers.tiff import check_strips

EXTENSIONS = """
    3fr ari arq arw bay cap cr2 cr3 crw cs1 dc2 dcr dcs dng drf erf fff gpr iiq k25 kdc mdc mef mos
    mrw nef nrw orf ori pef ptx pxn qtk raf raw rdc rw2 rwl rwz sr2 srf srw sti stx x3f
"""
SUFFIXES = frozenset(f".{name}" for name in EXTENSIONS.split())
DNG_VERSION, MOSAIC, LINEAR, LOSSLESS_JPEG = 50706, 32803, 34892, 7
FLOATS, PLANES = 3, 2
FRAMES = (0xC0, 0xC1, 0xC3)
"""Markers of JPEG frames that LibRaw decodes in a mosaic."""
CONVERT_AGAIN = (
    "Convert the camera's own file again, to a DNG of integers, in tiles or without compression."
)
MOST_DIRECTORIES, MOST_SEGMENTS, HEADER_BYTES = 16, 64, 1 << 16

_read: dict[tuple[Path, Stamp], dict[str, Any]] = {}
"""What was found beside the pixels of the last files: their facts need no second decoding."""
MOST_READ = 1 << 10


def read_raw_facts(path: Path) -> Facts:
    """Return size, levels and pattern of the visible area, and the shot's exposure and date.

    LibRaw has the levels of some cameras only when it has unpacked the pixels, so this takes nearly as long as
    `read_raw`.
    """
    found = _read.get((path, stamp_of(path))) or _decode(path, pixels=False)[0]
    white = float(found["white"]) or None
    with decoding(path, "camera raw"), path.open("rb") as handle:
        exif = read_exif(handle)
        levels = {"saturation": white, **_black(path, found, white)}
    for key in ("exposure_s", "iso"):
        exif[key] = exif[key] or found[key] or None
    return Facts(
        path=path,
        kind="raw" if len(found["shape"]) == 2 else "raw-colours",
        shape=tuple(found["shape"]),
        dtype="uint16",
        bits=int(white).bit_length() if white else None,
        pattern=found["pattern"],
        **levels,
        **{**exif, "captured": exif["captured"] or iso_date(found["captured"])},
    )


def read_raw_headers(path: Path) -> Facts:
    """Return what the EXIF of a camera raw states; its size, levels and pattern stay unknown, and nothing is decoded."""
    with decoding(path, "camera raw"), path.open("rb") as handle:
        return Facts(path=path, kind="raw", shape=(), dtype="uint16", **read_exif(handle))


def read_raw(path: Path) -> np.ndarray:
    """Return the visible mosaic, (h, w), uint16, curves of the camera's compression undone.

    Of a raw of colours, such as a linear DNG, (h, w, 3): the camera's own red, green and blue, proportional to light.
    """
    stamp = stamp_of(path)
    found, values = _decode(path, pixels=True)
    _read[path, stamp] = found
    while len(_read) > MOST_READ:
        _read.pop(next(iter(_read)))
    return values


def _decode(path: Path, *, pixels: bool) -> tuple[dict[str, Any], np.ndarray]:
    with decoding(path, "camera raw"):
        _check_parts(path)
    expected = "a camera raw"
    if path.suffix.lower() == ".raw":
        expected = f"{path.stem}.hdr beside it (an ENVI cube), or a camera raw"
    return decode(path, "raw", expected=expected, pixels=pixels)


def _black(path: Path, found: dict[str, Any], white: float | None) -> dict[str, Any]:
    """Return black and, of colours, full scale: of a DNG by its own tags, of which LibRaw has the mean, else LibRaw's.

    Of a black that all colours share LibRaw takes it off the white.
    """
    levels = tuple(float(b) for b in found["blacks"])
    mean, colours = sum(levels) / len(levels), len(found["shape"]) == 3
    with _pages_of_dng(path, LINEAR if colours else MOSAIC) as pages:
        page = max(pages, key=lambda page: page.imagelength * page.imagewidth, default=None)
        if page and not colours:
            (top, left), (height, width) = found["margins"], found["shape"]
            area = (top, left, top + height, left + width)
            declared = black_facts(page, area, top=white, mean=mean)
            return {"black": mean} if declared == {"black": None} else declared
        if page:
            levels = numbers_of(page.tags, "BlackLevel") or (0.0,)
            white = min(numbers_of(page.tags, "WhiteLevel"), default=white)
    if not colours:
        blacks = BlackLevels((levels[:2], levels[2:])) if found["pattern"] else None
        return {"black": mean, "blacks": blacks if blacks and blacks.varies else None}
    if len(set(levels)) == 1:
        return {"black": levels[0], "saturation": white}
    each = ", ".join(f"{level:g}" for level in levels)
    return {"black": None, "black_unclear": f"levels of the colours: {each}", "saturation": white}


# --- DNG: LibRaw leaves zeros where a part of lossless JPEG is none ----------------------------


@contextmanager
def _pages_of_dng(path: Path, *kinds: int) -> Iterator[list[Any]]:
    """Yield the pages of a DNG that are of some kinds (PhotometricInterpretation); none of another file."""
    import tifffile

    with path.open("rb") as handle:
        plain = handle.read(4) in (b"II*\0", b"MM\0*")
    try:
        tiff = tifffile.TiffFile(path) if plain else None
    except Exception:  # whatever damaged directories lead it to
        if path.suffix.lower() == ".dng":
            raise
        tiff = None
    if tiff is None:
        yield []
        return
    with tiff:
        pages: list[Any] = list(islice(tiff.pages, MOST_DIRECTORIES))
        for page in pages:  # directories within directories follow as they are found
            if page.subifds and len(pages) < MOST_DIRECTORIES:
                pages += islice(page.pages or (), MOST_DIRECTORIES - len(pages))
        dng = any(DNG_VERSION in page.tags for page in pages)
        yield [page for page in pages if dng and page.photometric in kinds]


def _check_parts(path: Path) -> None:
    """Refuse a DNG whose raw image LibRaw would change without a word, or of lossless JPEG that lacks a strip or tile.

    Floats LibRaw scales by the most of each file, colours in planes it mixes; of other compressions it complains itself.
    """
    with _pages_of_dng(path, MOSAIC, LINEAR) as pages:
        for page in pages:
            if page.sampleformat == FLOATS:
                raise _unlike(path, "SampleFormat", "floats", "integers")
            if page.planarconfig == PLANES and page.samplesperpixel > 1:
                expected = "the samples of a pixel side by side"
                raise _unlike(path, "PlanarConfiguration", "planes", expected)
            if page.compression == LOSSLESS_JPEG:
                _check_lossless(path, page.parent, page)


def _unlike(path: Path, field: str, found: str, expected: str) -> Exception:
    """Return the refusal of a raw image that LibRaw would change."""
    message = "a raw image of this layout is not read"
    return unreadable(path, message, field=field, found=found, expected=expected, fix=CONVERT_AGAIN)


def _check_lossless(path: Path, tiff: Any, page: Any) -> None:
    """Refuse a page of which a strip or tile is missing, or declares fewer samples than it has to hold."""
    check_strips(path, tiff, page, "the raw image")
    if not page.is_tiled and len(page.dataoffsets) > 1:  # LibRaw reads the first, and leaves zeros
        strips = f"{len(page.dataoffsets)} strips of lossless JPEG"
        raise _unlike(path, "RowsPerStrip", strips, "tiles, or one strip")
    high, wide = page.rowsperstrip, page.imagewidth
    if page.is_tiled:
        high, wide = page.tilelength, page.tilewidth
    across = ceil(page.imagewidth / wide)
    for number, (start, count) in enumerate(
        zip(page.dataoffsets, page.databytecounts, strict=True)
    ):
        left = high if page.is_tiled else page.imagelength - number // across * high
        least = wide * min(high, left) * page.samplesperpixel
        tiff.filehandle.seek(start)
        found, components = _lossless_size(tiff.filehandle.read(min(count, HEADER_BYTES)))
        if found < least:
            words = {"name": "the raw image", "expected": f"{least} in a JPEG"}
            raise refused(path, "strips", f"{found} samples in part {number}", **words)
        if page.photometric == LINEAR and components != page.samplesperpixel:
            mixed = f"{components} components of the JPEG in part {number}"
            raise _unlike(path, "SamplesPerPixel", mixed, f"{page.samplesperpixel}")


def _lossless_size(data: bytes) -> tuple[int, int]:
    """Return how many samples a JPEG declares that LibRaw decodes in a raw image, and of how many components; 0 for any other."""
    segments = list(islice(jpeg_segments(BytesIO(data)), MOST_SEGMENTS))
    if data[:2] != b"\xff\xd8" or not segments or segments[-1][0] != SCAN[1]:
        return 0, 0
    frames = [jpeg_frame(*one) for one in segments if one[0] in FRAMES]
    bits, height, width, components = next(filter(None, reversed(frames)), (0, 0, 0, 0))
    return (height * width * components, components) if 2 <= bits <= 16 else (0, 0)

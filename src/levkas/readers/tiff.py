"""TIFF captures: every declared strip is checked, so that nothing missing reads as zeros."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil, prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.facts import COPY_AGAIN, Facts, check_ratio, check_size, decoding, unreadable
from levkas.readers.tiff_codecs import CODECS, JPEG, OWN_SIZE, SLACK, check_frames
from levkas.readers.tiff_pages import full_pages
from levkas.readers.tiff_tags import colours_of, describe

LARGEST_RATIO = 2000
PLAIN = 1  # tag Compression


def read_tiff_facts(path: Path) -> Facts:
    """Return the facts of a TIFF from its tags, EXIF and XMP; no pixel is decoded."""
    with _opened(path) as (tiff, pages):
        page = tiff.pages[pages[0]]
        shape = _checked(path, tiff, page, 0)
        return Facts(
            path=path,
            kind="tiff",
            shape=shape,
            dtype=page.dtype.newbyteorder("=").name,
            pages=len(pages),
            bits=int(page.bitspersample),
            **describe(page),
        )


def read_tiff_page(path: Path, page: int | None = None) -> np.ndarray:
    """Decode one page (the first by default), (h, w) or (h, w, samples), in its own dtype.

    Where the tags say that zero is white, integers are turned, so that more is always brighter.
    """
    if page is not None and page < 0:
        raise ValueError(f"page {page}; pages count from 0")
    index = page or 0
    with _opened(path) as (tiff, pages):
        if index >= len(pages):
            raise unreadable(
                path,
                f"there is no page {index}",
                code="E_BAND_MISSING",
                field="page",
                found=f"{len(pages)} pages",
                expected=f"at least {index + 1}",
            )
        wanted = tiff.pages[pages[index]]
        shape = _checked(path, tiff, wanted, index)
        if wanted.compression in JPEG:
            _check_endings(path, tiff, wanted)
        # One thread: strips of a frame are small, and builds run frames side by side.
        values = wanted.asarray(maxworkers=1)
        if values.shape != shape:
            values = np.moveaxis(values, 0, -1)
        if values.shape != shape:
            raise unreadable(path, "the TIFF is not what its tags say", found=str(values.shape))
        values = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("="), copy=False)
        if colours_of(wanted) == "zero is white" and values.dtype.kind == "u":
            values = np.subtract(2**wanted.bitspersample - 1, values, dtype=values.dtype)
        return values


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, list[int]]]:
    """Yield the opened TIFF and which of its pages are images."""
    import tifffile

    with decoding(path, "TIFF"):
        pages = full_pages(path)
        with tifffile.TiffFile(path) as tiff:
            yield tiff, pages


def _checked(path: Path, tiff: Any, page: Any, index: int) -> tuple[int, ...]:
    """Return (h, w) or (h, w, samples) of a page whose every strip or tile is there."""
    shape = tuple(int(s) for s in page.shape)
    if page.axes == "SYX":
        shape = (*shape[1:], shape[0])
    elif page.axes not in ("YX", "YXS"):
        raise unreadable(path, f"page {index} is not a plane", code="E_SIZE", found=str(shape))
    check_size(path, shape)
    if page.compression not in CODECS:
        raise unreadable(
            path,
            f"page {index} is compressed in a way that is not read",
            field="Compression",
            found=str(getattr(page.compression, "name", page.compression)),
            expected=", ".join(dict.fromkeys(CODECS.values())),
            fix="Save it again with deflate, or uncompressed.",
        )
    if page.dtype is None or page.dtype.kind not in "uif" or page.dtype.itemsize > 8:
        raise unreadable(
            path,
            f"page {index} has samples of no known kind",
            field="SampleFormat, BitsPerSample",
            found=f"{page.sampleformat}, {page.bitspersample}",
            expected="integers of 2 to 64 bits or floats",
        )
    colours = colours_of(page)
    if colours is None:
        raise unreadable(
            path,
            f"page {index} is in a colour space whose numbers are no counts",
            field="PhotometricInterpretation",
            found=str(page.photometric),
            expected="gray, red-green-blue or a mosaic",
            fix="Export it again as RGB or gray.",
        )
    _check_stack(path, tiff, page)
    _check_strips(path, tiff, page, index)
    if page.compression in OWN_SIZE:
        check_frames(path, tiff, page)
    stored = sum(page.databytecounts)
    check_ratio(path, prod(shape) * page.dtype.itemsize, stored, ratio=LARGEST_RATIO)
    if page.is_tiled:
        tile = int(page.tilewidth) * int(page.tilelength)
        held = prod(page.chunked) * tile * page.samplesperpixel * page.dtype.itemsize
        check_ratio(path, held, stored, ratio=LARGEST_RATIO, field="TileWidth, TileLength")
    return shape


def _check_strips(path: Path, tiff: Any, page: Any, index: int) -> None:
    """Refuse missing strips, and strips that reach past the end of the file."""
    size = tiff.filehandle.size
    offsets, counts = page.dataoffsets, page.databytecounts
    declared = prod(page.chunked)
    there = sum(o > 0 and c > 0 for o, c in zip(offsets, counts, strict=False))
    # Contiguous strips are joined by tifffile into one.
    if there < len(offsets) or (len(offsets) < declared and not page.is_contiguous):
        raise unreadable(
            path,
            f"page {index} lacks a strip or tile",
            code="E_TRUNCATED",
            field="StripOffsets, StripByteCounts",
            found=f"{there} with data",
            expected=f"{declared}",
            fix=COPY_AGAIN,
        )
    end = max(o + c for o, c in zip(offsets, counts, strict=False))
    if end > size:
        raise unreadable(
            path,
            "the file ends before its image does",
            code="E_TRUNCATED",
            field="StripOffsets, StripByteCounts",
            found=f"{size} bytes",
            expected=f"at least {end}",
            fix=COPY_AGAIN,
        )
    stored = sum(counts)
    if stored > size:
        raise unreadable(
            path,
            "the strips or tiles lie over one another",
            field="StripOffsets, StripByteCounts",
            found=f"{stored} bytes of strips in a file of {size}",
            expected="each strip at a place of its own",
            fix=COPY_AGAIN,
        )
    if page.compression == PLAIN:
        _check_plain(path, page, stored)
        return
    most = 2 * prod(page.chunks) * page.dtype.itemsize + SLACK
    if (longest := max(counts)) > most:
        raise unreadable(
            path,
            "a strip or tile holds more than its part of the image",
            code="E_SIZE",
            field="StripByteCounts",
            found=f"{longest} bytes",
            expected=f"at most {most} bytes",
            fix=COPY_AGAIN,
        )


def _check_plain(path: Path, page: Any, stored: int) -> None:
    """Refuse an uncompressed page whose strips together are shorter than its rows."""
    samples = page.samplesperpixel
    width, planes = page.imagewidth * samples, 1
    if page.planarconfig == 2:
        width, planes = page.imagewidth, samples
    needed = planes * page.imagelength * ceil(width * page.bitspersample / 8)
    if stored < needed:
        raise unreadable(
            path,
            "the strips hold less than the image",
            code="E_TRUNCATED",
            field="StripByteCounts",
            found=f"{stored} bytes",
            expected=f"{needed} bytes",
            fix=COPY_AGAIN,
        )


def _check_endings(path: Path, tiff: Any, page: Any) -> None:
    """Refuse JPEG strips that are cut short: decoders fill the rest with gray."""
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        tiff.filehandle.seek(offset + max(count - 16, 0))
        if b"\xff\xd9" not in tiff.filehandle.read(min(count, 16)):
            raise unreadable(
                path,
                "a strip or tile is cut short",
                code="E_TRUNCATED",
                field="StripByteCounts",
                expected="an end-of-image marker in each",
                fix=COPY_AGAIN,
            )


def _check_stack(path: Path, tiff: Any, page: Any) -> None:
    """Refuse stacks that ImageJ or tifffile keep behind a single page: one frame would be read."""
    text = page.description or ""
    if len(tiff.pages) > 1 or not (text.startswith("ImageJ=") or '"truncated"' in text):
        return
    held = int(np.prod(tiff.series[0].shape))
    if held > prod(page.shape):
        raise unreadable(
            path,
            "the pages of this stack have no tags of their own",
            field="ImageDescription",
            found=f"{tuple(tiff.series[0].shape)} behind one page",
            fix="Save it again with one page a frame.",
        )

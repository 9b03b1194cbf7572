"""TIFF captures: every declared strip is checked, so that nothing missing reads as zeros."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import ceil, prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.facts import (
    COPY_AGAIN,
    Facts,
    check_expansion,
    check_memory,
    check_ratio,
    check_size,
    decoding,
    unreadable,
)
from levkas.readers.tiff_codecs import CODECS, JPEG, OWN_SIZE, SLACK, check_frames
from levkas.readers.tiff_pages import full_pages
from levkas.readers.tiff_tags import colours_of, describe

LARGEST_RATIO = 2000
PLAIN = 1  # tag Compression
Span = tuple[int, int]


def read_tiff_facts(path: Path) -> Facts:
    """Return the facts of a TIFF from its tags, EXIF and XMP; no pixel is decoded."""
    with _opened(path) as (tiff, pages):
        page = tiff.pages[pages[0]]
        shape = _checked(path, tiff, page, 0)
        samples, stored = len(pages) * prod(shape), tiff.filehandle.size
        check_expansion(path, samples, page.dtype.itemsize, stored)
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
    with _opened(path) as (tiff, pages):
        return _decode(path, tiff, pages, page or 0)


def read_tiff_pages(path: Path) -> Iterator[np.ndarray]:
    """Decode all pages one after the other, each as `read_tiff_page` does; the file is opened once."""
    with _opened(path) as (tiff, pages):
        for index in range(len(pages)):
            yield _decode(path, tiff, pages, index)


def _decode(path: Path, tiff: Any, pages: list[int], index: int) -> np.ndarray:
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
    check_memory(path, prod(shape), wanted.dtype.itemsize)
    # One thread: strips of a frame are small, and builds run frames side by side.
    values = wanted.asarray(maxworkers=1)
    if values.shape != shape:
        values = np.moveaxis(values, 0, -1)
    if values.shape != shape:
        raise unreadable(path, "the TIFF is not what its tags say", found=str(values.shape))
    return _bright_is_more(wanted, values)


def read_tiff_parts(path: Path, rows: Sequence[Span], columns: Sequence[Span]) -> np.ndarray:
    """Decode parts of the first page, (rows, columns) or (rows, columns, samples), joined.

    Only the strips or tiles that hold them are decoded; samples in planes of their own, or a page in
    one piece, are decoded whole.

    Parameters
    ----------
    path : Path
    rows, columns : sequence of (start, stop)
        In order, not over one another.
    """
    with _opened(path) as (tiff, pages):
        page = tiff.pages[pages[0]]
        shape = _checked(path, tiff, page, 0)
        separate = page.planarconfig == 2 and page.samplesperpixel > 1
        pieces = len(page.dataoffsets)
        if separate or (pieces < 2 and not page.is_contiguous):
            whole = read_tiff_page(path)
            return np.ascontiguousarray(whole[np.ix_(_all_of(rows), _all_of(columns))])
        if page.compression in JPEG:
            _check_endings(path, tiff, page)
        size = tuple(sum(stop - start for start, stop in side) for side in (rows, columns))
        out = np.empty((*size, *shape[2:]), page.dtype.newbyteorder("="))
        pieces_of = _contiguous if page.is_contiguous else _decoded
        for y, x, piece in pieces_of(path, tiff, page, rows, columns):
            _paste(out, piece, y, x, rows, columns)
        return _bright_is_more(page, out)


def _bright_is_more(page: Any, values: np.ndarray) -> np.ndarray:
    """Return samples in native byte order, turned where the tags say that zero is white."""
    values = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("="), copy=False)
    if colours_of(page) == "zero is white" and values.dtype.kind == "u":
        values = np.subtract(2**page.bitspersample - 1, values, dtype=values.dtype)
    return values


def _all_of(spans: Sequence[Span]) -> np.ndarray:
    return np.concatenate([np.arange(start, stop) for start, stop in spans])


def _contiguous(
    path: Path, tiff: Any, page: Any, rows: Sequence[Span], columns: Sequence[Span]
) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield (row, column, samples) of the wanted rows of a page that is stored as it is."""
    samples, stored = page.samplesperpixel, page.dtype.newbyteorder(tiff.byteorder)
    count = page.imagewidth * samples
    for row in _all_of(rows):
        tiff.filehandle.seek(page.dataoffsets[0] + int(row) * count * stored.itemsize)
        line = np.frombuffer(tiff.filehandle.read(count * stored.itemsize), stored, count)
        yield int(row), 0, line.reshape(1, page.imagewidth, samples)


def _decoded(
    path: Path, tiff: Any, page: Any, rows: Sequence[Span], columns: Sequence[Span]
) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield (row, column, samples) of the strips or tiles that hold wanted samples."""
    high = page.tilelength if page.is_tiled else page.rowsperstrip
    wide = page.tilewidth if page.is_tiled else page.imagewidth
    across = ceil(page.imagewidth / wide)
    check_memory(path, prod(page.chunks), page.dtype.itemsize)
    decode, tables = page.decode, page.jpegtables  # which read tags, and so move the handle
    for index, (offset, count) in enumerate(
        zip(page.dataoffsets, page.databytecounts, strict=False)
    ):
        y, x = index // across * high, index % across * wide
        if not _meets(rows, y, y + high) or not _meets(columns, x, x + wide):
            continue
        tiff.filehandle.seek(offset)
        piece = decode(tiff.filehandle.read(count), index, jpegtables=tables)[0]
        if piece is None or piece.ndim != 4:
            raise unreadable(path, "a strip or tile cannot be decoded", field=f"number {index}")
        yield y, x, piece[0]


def _meets(spans: Sequence[Span], start: int, stop: int) -> bool:
    return any(a < stop and start < b for a, b in spans)


def _paste(
    out: np.ndarray,
    piece: np.ndarray,
    y: int,
    x: int,
    rows: Sequence[Span],
    columns: Sequence[Span],
) -> None:
    """Put what is wanted of a piece (h, w, samples), whose corner is at (y, x), where it belongs."""
    piece = piece if out.ndim == 3 else piece[..., 0]
    for to_y, from_y in _shared(rows, y, y + piece.shape[0]):
        for to_x, from_x in _shared(columns, x, x + piece.shape[1]):
            out[to_y, to_x] = piece[from_y, from_x]


def _shared(spans: Sequence[Span], start: int, stop: int) -> Iterator[tuple[slice, slice]]:
    """Yield (place among the joined spans, place in the piece) of what both have."""
    before = 0
    for a, b in spans:
        first, last = max(a, start), min(b, stop)
        if first < last:
            yield slice(before + first - a, before + last - a), slice(first - start, last - start)
        before += b - a


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
    # Counting pages reads all their headers: only where the text says that there may be a stack.
    if not (text.startswith("ImageJ=") or '"truncated"' in text) or len(tiff.pages) > 1:
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

"""TIFF captures: every declared strip is checked, so that nothing missing reads as zeros."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import ceil, isfinite, prod
from pathlib import Path
from typing import Any, BinaryIO

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
from levkas.readers.images import iso_date

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
    if wanted.compression in JPEG_CODES:
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
        if page.compression in JPEG_CODES:
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


JPEG_CODES = (6, 7, 33007)
JPEG_2000 = (33003, 33005, 34712)
JPEG_XL = (50002, 52546)
OWN_SIZE = (*JPEG_CODES, *JPEG_2000, *JPEG_XL)
CODECS = {
    1: "none", 5: "LZW", 8: "deflate", 32946: "deflate", 32773: "PackBits", 34925: "LZMA",
    34926: "Zstandard", 50000: "Zstandard", **dict.fromkeys(JPEG_CODES, "JPEG"),
    **dict.fromkeys(JPEG_2000, "JPEG 2000"), **dict.fromkeys(JPEG_XL, "JPEG XL"),
}  # fmt: skip
"""Codes of the tag Compression that are read."""
SLACK = 4096
"""Bytes by which a strip may exceed twice its pixels: tables of JPEG, tails of writers."""
MOST_SCANS = 64
JXL_RATIOS = ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))
"""Width over height in the short form of a JPEG XL size."""


def check_frames(path: Path, tiff: Any, page: Any) -> None:
    """Refuse strips that say another size than their page does.

    Raises
    ------
    UnreadableCapture
        ``E_SIZE``, before any strip is decoded.
    """
    most = 4 * prod(page.chunks) + SLACK
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        tiff.filehandle.seek(offset)
        samples, scans = frame_of(tiff.filehandle.read(count), page.compression)
        if samples > most or scans > MOST_SCANS:
            raise unreadable(
                path,
                "a strip or tile says another size than its page",
                code="E_SIZE",
                field="StripByteCounts",
                found=f"{samples} samples in {scans} scans",
                expected=f"at most {most} samples in {MOST_SCANS} scans",
                fix=COPY_AGAIN,
            )


def frame_of(data: bytes, compression: int) -> tuple[int, int]:
    """Return the samples and scans that a strip declares; 0 samples where it has no header.

    Examples
    --------
    >>> frame_of(bytes.fromhex("ffd8 ffc0 000b 08 0010 0020 01 011100"), 7)
    (512, 0)
    >>> frame_of(bytes.fromhex("ff0a 4f 00"), 50002)
    (4096, 1)
    """
    if compression in JPEG_2000:
        return _jpeg_2000(data), 1
    if compression in JPEG_XL:
        return _jpeg_xl(data), 1
    at, samples = 2, 0
    while at + 10 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4])
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = (int.from_bytes(data[at + i : at + i + 2]) for i in (5, 7))
            samples = max(samples, height * width * max(1, data[at + 9]))
        at += 1 if marker == 0xFF else 2 + length
    return samples, data.count(b"\xff\xda")


def _jpeg_2000(data: bytes) -> int:
    start = data.find(b"\xff\x4f\xff\x51")
    if start < 0 or len(data) < start + 42:
        return 0
    numbers = [int.from_bytes(data[start + i : start + i + 4]) for i in (8, 12, 16, 20)]
    channels = int.from_bytes(data[start + 40 : start + 42])
    return max(0, numbers[0] - numbers[2]) * max(0, numbers[1] - numbers[3]) * channels


def _jpeg_xl(data: bytes) -> int:
    """Samples of one channel, from the SizeHeader of ISO/IEC 18181-1."""
    start = data.find(b"\xff\x0a")
    if start < 0:
        return 0
    bits, at = int.from_bytes(data[start + 2 : start + 14], "little"), 0

    def take(count: int) -> int:
        nonlocal at
        value = (bits >> at) & ((1 << count) - 1)
        at += count
        return value

    small = take(1)

    def side() -> int:
        return 8 * (take(5) + 1) if small else 1 + take((9, 13, 18, 30)[take(2)])

    height = side()
    ratio = take(3)
    if not ratio:
        return height * side()
    across, down = JXL_RATIOS[ratio - 1]
    return height * (height * across // down)


MOST_PAGES = 4096
MOST_TAGS = 4096
SUBFILE_TYPE = 254  # its value says whether a page is a preview or a mask
REDUCED, MASK = 1, 4


def full_pages(path: Path) -> list[int]:
    """Return which pages of a TIFF are images, as indices into its chain of directories.

    Previews, pyramid levels and masks are left out. The walk reads a few bytes a page.

    Raises
    ------
    UnreadableCapture
        As `kinds_of_pages`, and where there is no image.
    """
    kinds = kinds_of_pages(path)
    pages = [i for i, kind in enumerate(kinds) if not kind & (REDUCED | MASK)]
    if not pages:
        raise unreadable(
            path,
            "the TIFF holds no image",
            field="NewSubfileType",
            found=f"{len(kinds)} previews or masks" if kinds else "no pages",
            expected="at least one full-size page",
        )
    return pages


def kinds_of_pages(path: Path) -> list[int]:
    """Return NewSubfileType of every directory in the chain.

    Raises
    ------
    UnreadableCapture
        Where the chain leaves the file, or turns back on itself: a decoder would follow it for ever.
    """
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        handle.seek(0)
        order = "<" if handle.read(2) == b"II" else ">"
        big = _number(path, handle, order + "H") == 43
        handle.seek(8 if big else 4)
        offset = _number(path, handle, order + ("Q" if big else "I"))
        kinds: list[int] = []
        seen: set[int] = set()
        walked = 0
        while offset:
            # Directories stand side by side: laid over one another, each costs a reader as much
            # of the file again.
            if offset in seen or offset >= size or walked > size:
                raise _broken(path, offset, size)
            if len(kinds) >= MOST_PAGES:
                raise _too_many(path)
            seen.add(offset)
            kind, following = _directory(path, handle, offset, order, big)
            walked += handle.tell() - offset
            offset = following
            kinds.append(kind)
    return kinds


def _directory(path: Path, handle: BinaryIO, offset: int, order: str, big: bool) -> tuple[int, int]:
    """Return NewSubfileType of the directory at `offset`, and where the next one is (0: none)."""
    handle.seek(offset)
    count = _number(path, handle, order + ("Q" if big else "H"))
    if not 0 < count <= MOST_TAGS:
        raise unreadable(
            path,
            "a directory of the TIFF is damaged",
            field="number of tags",
            found=f"{count} tags",
            expected=f"1 to {MOST_TAGS}",
            fix=COPY_AGAIN,
        )
    entry = struct.Struct(order + ("HHQI4x" if big else "HHII"))
    data = handle.read(count * entry.size)
    if len(data) < count * entry.size:
        raise _cut(path, handle)
    # The value stands left in its field: a SHORT there has to be read as one.
    kind = next(
        (
            v >> (16 * (order == ">" and t == 3))
            for c, t, _, v in entry.iter_unpack(data)
            if c == SUBFILE_TYPE
        ),
        0,
    )
    return kind, _number(path, handle, order + ("Q" if big else "I"))


def _number(path: Path, handle: BinaryIO, form: str) -> int:
    data = handle.read(struct.calcsize(form))
    if len(data) < struct.calcsize(form):
        raise _cut(path, handle)
    number: int = struct.unpack(form, data)[0]
    return number


def _cut(path: Path, handle: BinaryIO) -> Exception:
    return unreadable(
        path,
        "the file ends inside a directory of the TIFF",
        code="E_TRUNCATED",
        field="directory",
        found=f"{handle.seek(0, 2)} bytes",
        expected="all tags of the page, and where the next one is",
        fix=COPY_AGAIN,
    )


def _too_many(path: Path) -> Exception:
    return unreadable(
        path,
        "the TIFF has too many pages",
        code="E_SIZE",
        field="pages",
        found=f"over {MOST_PAGES}",
        expected=f"at most {MOST_PAGES}",
        fix="Save the frames in several files.",
    )


def _broken(path: Path, offset: int, size: int) -> Exception:
    past = offset >= size
    return unreadable(
        path,
        "the file ends before its pages do"
        if past
        else "the pages of the TIFF go round in a circle or lie over one another",
        code="E_TRUNCATED" if past else "E_UNREADABLE",
        field="next directory",
        found=f"byte {offset}",
        expected=f"below {size}" if past else "a byte not yet visited",
        fix=COPY_AGAIN,
    )


GRAY = {0: "zero is white", 1: "gray", 2: "colours", 32803: "mosaic", 34892: "linear"}
YCBCR_DECODED = (6, 7, 33007, 34892)
YCBCR = 6
RATIONAL = (5, 10)  # types of tags
MICASENSE_FULL = 65520.0
"""MicaSense cameras count 12 bits and store them times 16; no tag says so."""


def colours_of(page: Any) -> str | None:
    """Return what the samples are, None where they are no counts (palette, CMYK, CIELAB)."""
    if "PhotometricInterpretation" not in page.tags:
        return "gray"
    photometric = int(page.photometric)
    if photometric == YCBCR and page.compression in YCBCR_DECODED:
        return "colours"  # the decoder gives red, green, blue
    return GRAY.get(photometric)


def describe(page: Any) -> dict[str, Any]:
    """Return the levels, pattern, exposure, date, camera and band of a page, as fields of Facts."""
    tags = page.tags
    exif = _value(tags, "ExifTag")
    exif = exif if isinstance(exif, dict) else {}

    def find(*names: str) -> Any:
        for name in names:
            value = _value(tags, name)
            value = exif.get(name) if value is None else value
            if value is not None:
                return value
        return None

    blacks, whites = _levels(tags, "BlackLevel"), _levels(tags, "WhiteLevel")
    model, make = _text(find("Model")), _text(find("Make"))
    wavelength, fwhm, name = camera_band(_value(tags, "XMP") or b"")
    saturation = min(whites) if whites else None
    if make == "MicaSense" and wavelength and saturation is None and page.bitspersample == 16:
        saturation = MICASENSE_FULL
    return {
        "black": sum(blacks) / len(blacks) if blacks else None,
        "blacks": blacks if len(blacks) == 4 and len(set(blacks)) > 1 else None,
        "saturation": saturation,
        "pattern": _bayer(find("CFAPattern"), find("CFARepeatPatternDim")),
        "exposure_s": _positive(find("ExposureTime")),
        "iso": _positive(find("ISOSpeedRatings", "PhotographicSensitivity", "ISOSpeed")),
        "captured": iso_date(find("DateTimeOriginal", "DateTime"), find("OffsetTimeOriginal")),
        "model": model,
        "wavelengths": (wavelength,) if wavelength else None,
        "fwhm": (fwhm,) if fwhm else None,
        "band_names": (name,) if name else None,
    }


def camera_band(xmp: bytes | str) -> tuple[float | None, float | None, str | None]:
    """Return centre and width (nm) and name of the band that MicaSense and others put in XMP.

    Examples
    --------
    >>> camera_band(b"<Camera:CentralWavelength>475</Camera:CentralWavelength>")
    (475.0, None, None)
    """
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else str(xmp)

    def find(name: str) -> str | None:
        found = re.search(rf"Camera:{name}(?:=\"|>)\s*([^<\"]+)", text)
        return found[1].strip() if found else None

    return _positive(find("CentralWavelength")), _positive(find("WavelengthFWHM")), find("BandName")


def _value(tags: Any, name: str) -> Any:
    """Value of a tag, None where it is not there or cannot be read: no pixel depends on these."""
    try:
        return tags[name].value if name in tags else None
    except Exception:  # a damaged EXIF directory leads tifffile to many kinds of errors
        return None


def _levels(tags: Any, name: str) -> tuple[float, ...]:
    value = _value(tags, name)
    if value is None or isinstance(value, str | bytes):
        return ()
    numbers = [float(v) for v in np.atleast_1d(np.asarray(value, float)).ravel()]
    if int(tags[name].dtype) in RATIONAL:
        pairs = zip(numbers[::2], numbers[1::2], strict=False)
        numbers = [top / bottom for top, bottom in pairs if bottom]
    return tuple(n for n in numbers if isfinite(n))


def _positive(value: Any) -> float | None:
    """Return a positive number from a number, a rational, text, or the first of several."""
    try:
        if isinstance(value, tuple | list) and len(value) == 2:
            value = float(value[0]) / float(value[1])
        elif isinstance(value, tuple | list):
            value = value[0]
        number = float(value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError, OverflowError):
        return None
    return number if isfinite(number) and number > 0 else None


def _text(value: Any) -> str | None:
    if isinstance(value, bytes):
        value = value.decode("ascii", "replace")
    return (str(value).strip(" \0") or None) if value else None


def _bayer(pattern: Any, dims: Any) -> str | None:
    """Return a 2x2 pattern as letters; codes are 0 red, 1 green, 2 blue."""
    try:
        if dims is not None and [int(d) for d in np.atleast_1d(dims)] != [2, 2]:
            return None
        codes = [int(c) for c in pattern] if isinstance(pattern, bytes | tuple | list) else []
    except (TypeError, ValueError):
        return None
    return "".join("RGB"[c] for c in codes) if len(codes) == 4 and max(codes) < 3 else None

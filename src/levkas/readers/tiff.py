"""TIFF captures: every declared strip is checked, so that nothing missing reads as zeros."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from math import ceil, prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.black_levels import black_facts
from levkas.readers.encoding import has_curve
from levkas.readers.exif import exif_facts, exif_text
from levkas.readers.facts import (
    Facts,
    check_expansion,
    check_memory,
    check_ratio,
    check_size,
    decoding,
    truncated,
    unreadable,
)
from levkas.readers.images import ALPHA, JPEG_CODES, MOST_SCANS, jpeg_size
from levkas.readers.nodata import nodata_of, without_nodata
from levkas.readers.tiff_bands import band_facts, camera_band
from levkas.readers.tiff_directories import directories_of, images_among
from levkas.readers.tiff_tags import numbers_of, value_of

LARGEST_RATIO = 2000
PLAIN = 1  # tag Compression
CODECS = {
    1: "none", 5: "LZW", 8: "deflate", 32946: "deflate", 32773: "PackBits", 34925: "LZMA",
    34926: "Zstandard", 50000: "Zstandard", **dict.fromkeys(JPEG_CODES, "JPEG"),
}  # fmt: skip
"""Codes of the tag Compression that are read."""
SLACK = 4096
"""Bytes by which a strip may exceed twice its pixels: tables of JPEG, tails of writers."""
COLOURS = {0: "zero is white", 1: "gray", 2: "colours", 32803: "mosaic", 34892: "linear"}
YCBCR, MOSAIC = 6, 32803
SRGB = 1
"""Of the EXIF tag ColorSpace."""
ALPHAS = (1, 2)
"""Of tag ExtraSamples: colours are multiplied by the sample, or not; 0 is any other sample, such as a further band."""
MICASENSE_FULL = 65520.0
"""MicaSense cameras count 12 bits and store them times 16; no tag says so."""


def read_tiff_facts(path: Path) -> Facts:
    """Return the facts of a TIFF from its tags, EXIF and XMP; no pixel is decoded."""
    with _opened(path) as (tiff, pages):
        page = tiff.pages[pages[0]]
        shape = _checked_shape(path, tiff, page, 0)
        samples, stored = len(pages) * prod(shape), tiff.filehandle.size
        check_expansion(path, samples, page.dtype.itemsize, stored)
        kept = _counting(page)
        nodata, notes = _nodata(page, (tiff.pages[i] for i in pages))
        samples = 1 if len(pages) > 1 else len(kept)
        bands = band_facts(tiff, [tiff.pages[i] for i in pages], samples)
        notes += [*bands.pop("notes"), *_previews(path, pages)]
        return Facts(
            path=path,
            kind="tiff",
            shape=shape[:2] if len(kept) == 1 else (*shape[:2], len(kept)),
            dtype=page.dtype.newbyteorder("=").name,
            pages=len(pages),
            bits=int(page.bitspersample),
            nodata=nodata,
            notes=tuple([ALPHA] * (len(kept) < page.samplesperpixel) + notes),
            **{**_describe(page, shape), **bands},
        )


def _previews(path: Path, pages: Sequence[int]) -> list[str]:
    """Report that a page before the first image is none."""
    if not pages[0]:
        return []
    first = directories_of(path)[0]
    return [f"the first page, of {first.width} x {first.height} px, is taken for a preview"]


def read_tiff_page(path: Path, page: int | None = None) -> np.ndarray:
    """Decode one page (the first by default), (h, w) or (h, w, samples), in its own dtype.

    Where the tags say that zero is white, integers are turned, so that more is always brighter.
    """
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
            f"the file has no page {index}",
            code="E_BAND_MISSING",
            field="page",
            found=f"{len(pages)} pages",
            expected=f"at least {index + 1}",
        )
    page = tiff.pages[pages[index]]
    shape = _checked_shape(path, tiff, page, index)
    _check_endings(path, tiff, page)
    check_memory(path, prod(shape), page.dtype.itemsize)
    # One thread: strips of a frame are small, and builds run frames side by side.
    values = page.asarray(maxworkers=1)
    if values.shape != shape:
        values = np.moveaxis(values, 0, -1)
    if values.shape != shape:
        raise unreadable(path, "the TIFF does not match its tags", found=str(values.shape))
    return _as_counts(page, tiff.pages[pages[0]], values)


def _counting(page: Any) -> list[int]:
    """Return which samples of a pixel count: all but those that the tags call alpha."""
    last = page.samplesperpixel - len(page.extrasamples)
    alpha = {last + i for i, kind in enumerate(page.extrasamples) if kind in ALPHAS}
    return [i for i in range(page.samplesperpixel) if i not in alpha] or [0]


def _as_counts(page: Any, first: Any, values: np.ndarray) -> np.ndarray:
    """Return samples without alpha, in native byte order, turned where the tags say that zero is white.

    Where a value holds nothing, by the page's tags or the first page's, they are floats, NaN for it.
    """
    kept, nodata = _counting(page), _nodata(page, [first])[0]
    if values.ndim == 3 and len(kept) < values.shape[2]:
        values = values[..., kept[0] if len(kept) == 1 else kept]
    values = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("="), copy=False)
    if _colours_of(page) == "zero is white" and values.dtype.kind == "u":
        full = 2**page.bitspersample - 1
        values = np.subtract(full, values, dtype=values.dtype)
        return without_nodata(values, None if nodata is None else full - nodata)
    return without_nodata(values, nodata)


def _nodata(page: Any, others: Iterable[Any]) -> tuple[float | None, list[str]]:
    """Return the value of samples that hold nothing, as GDAL's programs write it, and what to say of it.

    A page that has no such tag has that of the first of the others with one: programs write it once for a file.
    """
    found = (exif_text(value_of(each.tags, "GDAL_NODATA")) for each in chain([page], others))
    return nodata_of(next(filter(None, found), None) or "", page.dtype, "GDAL_NODATA")


# --- directories: walked before any library follows them --------------------------------------


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, list[int]]]:
    """Yield the opened TIFF and the indices of its images, as `images_among` its pages."""
    import tifffile

    with decoding(path, "TIFF"):
        directories = directories_of(path)
        pages = images_among(directories)
        if not pages:
            raise unreadable(
                path,
                "the TIFF holds no image",
                field="NewSubfileType",
                found=f"{len(directories)} previews or masks" if directories else "no pages",
                expected="at least one full-size page",
            )
        with tifffile.TiffFile(path) as tiff:
            yield tiff, pages


# --- pages: what they declare, checked before a pixel is decoded ------------------------------


def _checked_shape(path: Path, tiff: Any, page: Any, index: int) -> tuple[int, ...]:
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
            f"the compression of page {index} is not supported",
            field="Compression",
            found=str(getattr(page.compression, "name", page.compression)),
            expected=", ".join(dict.fromkeys(CODECS.values())),
            fix="Save it again with deflate, or uncompressed.",
        )
    if page.dtype is None or page.dtype.kind not in "uif" or page.dtype.itemsize > 8:
        raise unreadable(
            path,
            f"the sample format of page {index} is not supported",
            field="SampleFormat, BitsPerSample",
            found=f"{page.sampleformat}, {page.bitspersample}",
            expected="integers of 2 to 64 bits or floats",
        )
    if _colours_of(page) is None:
        raise unreadable(
            path,
            f"the colour space of page {index} does not hold counts",
            field="PhotometricInterpretation",
            found=str(page.photometric),
            expected="gray, red-green-blue or a mosaic",
            fix="Export it again as RGB or gray.",
        )
    _check_stack(path, tiff, page)
    check_strips(path, tiff, page, f"page {index}")
    _check_frames(path, tiff, page)
    stored = sum(page.databytecounts)
    check_ratio(path, prod(shape) * page.dtype.itemsize, stored, ratio=LARGEST_RATIO)
    if page.is_tiled:
        tile = int(page.tilewidth) * int(page.tilelength)
        held = prod(page.chunked) * tile * page.samplesperpixel * page.dtype.itemsize
        check_ratio(path, held, stored, ratio=LARGEST_RATIO, field="TileWidth, TileLength")
    return shape


def check_strips(path: Path, tiff: Any, page: Any, name: str) -> None:
    """Refuse missing strips or tiles, strips that reach past the end of the file or hold too little."""
    size, where = tiff.filehandle.size, "StripOffsets, StripByteCounts"
    offsets, counts = page.dataoffsets, page.databytecounts
    declared = prod(page.chunked)
    there = sum(o > 0 and c > 0 for o, c in zip(offsets, counts, strict=False))
    # Contiguous strips are joined by tifffile into one.
    if there < len(offsets) or (len(offsets) < declared and not page.is_contiguous):
        message = f"{name} lacks a strip or tile"
        raise truncated(path, message, where, f"{there} with data", f"{declared}")
    end = max(o + c for o, c in zip(offsets, counts, strict=False))
    if end > size:
        message = "the file is truncated"
        raise truncated(path, message, where, f"{size} bytes", f"at least {end}")
    if (stored := sum(counts)) > size:
        raise unreadable(
            path,
            "the strips or tiles overlap",
            field=where,
            found=f"{stored} bytes of strips in a file of {size}",
            expected="strips that do not overlap",
        )
    if page.compression == PLAIN:
        samples = page.samplesperpixel
        width, planes = page.imagewidth * samples, 1
        if page.planarconfig == 2:
            width, planes = page.imagewidth, samples
        needed = planes * page.imagelength * ceil(width * page.bitspersample / 8)
        if stored < needed:
            message, where = "the strips hold less than the whole image", "StripByteCounts"
            raise truncated(path, message, where, f"{stored} bytes", f"{needed} bytes")
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
        )


def _check_frames(path: Path, tiff: Any, page: Any) -> None:
    """Refuse strips that declare another size than their page: 300 bytes of JPEG can declare 4 GB."""
    if page.compression not in JPEG_CODES:
        return
    most = 4 * prod(page.chunks) + SLACK
    for data in strips_of(tiff, page):
        samples, scans = jpeg_size(data)
        if samples > most or scans > MOST_SCANS:
            raise unreadable(
                path,
                "a strip or tile differs in size from its page",
                code="E_SIZE",
                field="StripByteCounts",
                found=f"{samples} samples in {scans} scans",
                expected=f"at most {most} samples in {MOST_SCANS} scans",
            )


def _check_endings(path: Path, tiff: Any, page: Any) -> None:
    """Refuse JPEG strips that are cut short: decoders fill the rest with gray."""
    if page.compression not in JPEG_CODES:
        return
    for data in strips_of(tiff, page):
        if b"\xff\xd9" not in data[-16:]:
            message, expected = "a strip or tile is truncated", "an end-of-image marker in each"
            raise truncated(path, message, "StripByteCounts", f"{len(data)} bytes", expected)


def _check_stack(path: Path, tiff: Any, page: Any) -> None:
    """Refuse stacks that ImageJ or tifffile keep behind a single page: one frame would be read."""
    text = page.description or ""
    # Counting pages reads all their headers: only where the text says that there may be a stack.
    if not (text.startswith("ImageJ=") or '"truncated"' in text) or len(tiff.pages) > 1:
        return
    if int(np.prod(tiff.series[0].shape)) > prod(page.shape):
        raise unreadable(
            path,
            "the pages of this stack have no separate tags",
            field="ImageDescription",
            found=f"{tuple(tiff.series[0].shape)} behind one page",
            fix="Save it again with one page per frame.",
        )


def strips_of(tiff: Any, page: Any) -> Iterator[bytes]:
    """Yield the stored bytes of each strip or tile of a page."""
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        tiff.filehandle.seek(offset)
        yield tiff.filehandle.read(count)


# --- tags: levels, camera, band ---------------------------------------------------------------


def _colours_of(page: Any) -> str | None:
    """Return what the samples are, None where they are no counts (palette, CMYK, CIELAB)."""
    if "PhotometricInterpretation" not in page.tags:
        return "gray"
    photometric = int(page.photometric)
    if photometric == YCBCR and page.compression in (*JPEG_CODES, 34892):
        return "colours"  # the decoder gives red, green, blue
    return COLOURS.get(photometric)


def _describe(page: Any, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return the levels, pattern, exposure, date, camera and band of a page, as fields of Facts."""
    tags = page.tags
    exif = value_of(tags, "ExifTag")
    exif = exif if isinstance(exif, dict) else {}

    codes = {tag.name: tag.code for tag in reversed(list(tags.values()))}

    def find(name: str) -> Any:
        both = (name, f"{name} ")  # tifffile has a blank in the name of ExposureIndex
        own = (value_of(tags, codes[each]) for each in both if each in codes)
        found = chain(own, (exif[each] for each in both if each in exif))
        return next((value for value in found if value is not None), None)

    whites = numbers_of(tags, "WhiteLevel")
    stated = exif_facts(find)
    saturation = min(whites) if whites else None
    micasense = stated["make"] == "MicaSense"
    banded = micasense and camera_band(value_of(tags, "XMP") or b"")[0]
    if banded and saturation is None and page.bitspersample == 16:
        saturation = MICASENSE_FULL
    return {
        **stated,
        **black_facts(page, (0, 0, *shape[:2]), top=saturation),
        "saturation": saturation,
        "pattern": _bayer(find("CFAPattern"), find("CFARepeatPatternDim")),
        "encoded": _encoding(page, find("ColorSpace")),
    }


def _encoding(page: Any, space: Any) -> str | None:
    """Return the tone curve that profile or EXIF state of the codes; of a mosaic they are those of its picture."""
    if page.photometric == MOSAIC:
        return None
    profile = value_of(page.tags, "InterColorProfile")
    if isinstance(profile, bytes) and profile:
        return "an ICC profile with a tone curve" if has_curve(profile) else None
    return "sRGB" if space == SRGB else None


def _bayer(pattern: Any, dims: Any) -> str | None:
    """Return a 2x2 pattern as letters; codes are 0 red, 1 green, 2 blue."""
    try:
        if dims is not None and [int(d) for d in np.atleast_1d(dims)] != [2, 2]:
            return None
        codes = [int(c) for c in pattern] if isinstance(pattern, bytes | tuple | list) else []
    except (TypeError, ValueError):
        return None
    return "".join("RGB"[c] for c in codes) if len(codes) == 4 and max(codes) < 3 else None

"""TIFF captures: every declared strip is checked, so that nothing missing reads as zeros; compressed ones are decoded apart."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from math import ceil, prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.black_levels import black_facts
from levkas.readers.decoder import decode
from levkas.readers.exif import exif_facts, exif_text, numbers_of, value_of
from levkas.readers.facts import (
    Facts,
    check_expansion,
    check_memory,
    check_size,
    decoding,
    refused,
    unreadable,
)
from levkas.readers.nodata import nodata_of, without_nodata
from levkas.readers.pictures import ALPHA, has_curve
from levkas.readers.tiff_bands import band_facts, camera_band
from levkas.readers.tiff_directories import directories_of, images_among

LARGEST_RATIO = 2000
PLAIN, JPEG_CODES = 1, (6, 7, 33007)  # tag Compression
CODECS = {
    PLAIN: "none", 5: "LZW", 8: "deflate", 32946: "deflate", 32773: "PackBits", 34925: "LZMA",
    34926: "Zstandard", 50000: "Zstandard", **dict.fromkeys(JPEG_CODES, "JPEG"),
}  # fmt: skip
"""Codes of the tag Compression that are read."""
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
    with _opened(path) as (tiff, pages, notes):
        page = tiff.pages[pages[0]]
        shape = _checked_shape(path, tiff, page, 0)
        samples, stored = len(pages) * prod(shape), tiff.filehandle.size
        check_expansion(path, samples, page.dtype.itemsize, stored)
        kept = _counting(page)
        nodata, of_nodata = _nodata(page, (tiff.pages[i] for i in pages))
        samples = 1 if len(pages) > 1 else len(kept)
        bands = band_facts(tiff, [tiff.pages[i] for i in pages], samples)
        alpha = [ALPHA] * (len(kept) < page.samplesperpixel)
        return Facts(
            path=path,
            kind="tiff",
            shape=shape[:2] if len(kept) == 1 else (*shape[:2], len(kept)),
            dtype=page.dtype.newbyteorder("=").name,
            pages=len(pages),
            bits=int(page.bitspersample),
            nodata=nodata,
            notes=(*alpha, *of_nodata, *bands.pop("notes"), *notes),
            **{**_describe(page, shape), **bands},
        )


def read_tiff_page(path: Path, page: int | None = None) -> np.ndarray:
    """Decode one page (the first by default), (h, w) or (h, w, samples), in its own dtype.

    Where the tags say that zero is white, integers are turned, so that more is always brighter.
    """
    with _opened(path) as (tiff, pages, _):
        return _decode(path, tiff, pages, page or 0)


def read_tiff_pages(path: Path) -> Iterator[np.ndarray]:
    """Decode all pages one after the other, each as `read_tiff_page` does; the file is opened once."""
    with _opened(path) as (tiff, pages, _):
        for index in range(len(pages)):
            yield _decode(path, tiff, pages, index)


def _decode(path: Path, tiff: Any, pages: list[int], index: int) -> np.ndarray:
    if index >= len(pages):
        raise refused(path, "page", f"{len(pages)} pages", page=index)
    page = tiff.pages[pages[index]]
    shape = _checked_shape(path, tiff, page, index)
    check_memory(path, prod(shape), page.dtype.itemsize)
    if page.compression == PLAIN:
        values = page.asarray(maxworkers=1)
    else:
        needed = prod(shape) * page.dtype.itemsize
        values = decode(path, "tiff", expected="a whole TIFF", needed=needed, page=pages[index])[1]
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
        nodata = None if nodata is None else full - nodata
    return without_nodata(values, nodata)


def _nodata(page: Any, others: Iterable[Any]) -> tuple[float | None, list[str]]:
    """Return the value of samples that hold nothing, as GDAL's programs write it, and what to say of it.

    A page that has no such tag has that of the first of the others with one: programs write it once for a file.
    """
    found = (exif_text(value_of(each.tags, "GDAL_NODATA")) for each in chain([page], others))
    return nodata_of(next(filter(None, found), None) or "", page.dtype, "GDAL_NODATA")


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, list[int], list[str]]]:
    """Yield the opened TIFF, the indices of its images among its pages, and what to say of a page before them."""
    import tifffile

    with decoding(path, "TIFF"):
        directories = directories_of(path)
        pages = images_among(directories)
        if not pages:
            found = f"{len(directories)} previews or masks" if directories else "no pages"
            raise refused(path, "no image", found)
        size = f"{directories[0].width} x {directories[0].height}"
        note = f"the first page, of {size} px, is taken for a preview"
        with tifffile.TiffFile(path) as tiff:
            yield tiff, pages, [note] if pages[0] else []


# --- pages: what they declare, checked before a pixel is decoded ------------------------------


def _checked_shape(path: Path, tiff: Any, page: Any, index: int) -> tuple[int, ...]:
    """Return (h, w) or (h, w, samples) of a page whose every strip or tile is there."""
    shape = tuple(int(s) for s in page.shape)
    if page.axes == "SYX":
        shape = (*shape[1:], shape[0])
    elif page.axes not in ("YX", "YXS"):
        raise unreadable(path, f"page {index} is not a plane", code="E_SIZE", found=str(shape))
    check_size(path, shape)
    wrong = None
    if page.compression not in CODECS:
        found = getattr(page.compression, "name", page.compression)
        wrong = "Compression", found, ", ".join(dict.fromkeys(CODECS.values()))
    elif page.dtype is None or page.dtype.kind not in "uif" or page.dtype.itemsize > 8:
        found = f"{page.sampleformat}, {page.bitspersample}"
        wrong = "SampleFormat, BitsPerSample", found, "integers of 2 to 64 bits or floats"
    elif _colours_of(page) is None:
        expected = "gray, red-green-blue or a mosaic"
        wrong = "PhotometricInterpretation", page.photometric, expected
    if wrong:
        field, found, expected = wrong
        words = {"field": field, "expected": expected, "page": index}
        raise refused(path, "kind of page", found, **words)
    _check_stack(path, tiff, page)
    check_strips(path, tiff, page, f"page {index}")
    check_expansion(path, prod(shape), page.dtype.itemsize, sum(page.databytecounts))
    return shape


def check_strips(path: Path, tiff: Any, page: Any, name: str) -> None:
    """Refuse missing strips or tiles, strips that reach past the end of the file or hold too little."""
    size, offsets, counts = tiff.filehandle.size, page.dataoffsets, page.databytecounts
    declared, stored = prod(page.chunked), sum(counts)
    there = sum(o > 0 and c > 0 for o, c in zip(offsets, counts, strict=False))
    # Contiguous strips are joined by tifffile into one.
    if there < len(offsets) or (len(offsets) < declared and not page.is_contiguous):
        raise refused(path, "strips", f"{there} with data", name=name, expected=declared)
    end = max(o + c for o, c in zip(offsets, counts, strict=False))
    if end > size:
        raise refused(path, "strips", f"{size} bytes", name=name, expected=f"at least {end}")
    if stored > size:
        raise refused(path, "overlap", f"{stored} bytes in a file of {size}")
    if page.compression == PLAIN:
        apart = page.planarconfig == 2
        width = page.imagewidth * (1 if apart else page.samplesperpixel)
        rows = page.imagelength * (page.samplesperpixel if apart else 1)
        needed = rows * ceil(width * page.bitspersample / 8)
        if stored < needed:
            words = {"name": name, "expected": f"{needed} bytes"}
            raise refused(path, "strips", f"{stored} bytes", **words)


def _check_stack(path: Path, tiff: Any, page: Any) -> None:
    """Refuse stacks that ImageJ or tifffile keep behind a single page: one frame would be read."""
    text = page.description or ""
    # Counting pages reads all their headers: only where the text says that there may be a stack.
    if not (text.startswith("ImageJ=") or '"truncated"' in text) or len(tiff.pages) > 1:
        return
    if int(np.prod(tiff.series[0].shape)) > prod(page.shape):
        raise refused(path, "stack", f"{tuple(tiff.series[0].shape)} behind one page")


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
    micasense = stated["make"] == "MicaSense" and page.bitspersample == 16
    if saturation is None and micasense and camera_band(value_of(tags, "XMP") or b"")[0]:
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

"""TIFF captures: declared strips are checked against the file, so that nothing missing reads as zeros."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.facts import Facts, check_size, unreadable

LARGEST_RATIO = 2000
"""Most that a page may expand to, times its stored bytes."""
PLAIN = 1  # tag Compression


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            if not len(tiff.pages):
                raise unreadable(path, "the TIFF holds no image")
            yield tiff
    except (
        tifffile.TiffFileError,
        OSError,
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        AttributeError,
        NotImplementedError,
        OverflowError,
        MemoryError,
        RuntimeError,
        struct.error,
        zlib.error,
    ) as error:
        raise unreadable(
            path,
            "the TIFF cannot be read",
            found=f"{type(error).__name__}: {error}",
            fix="Copy the file again from the camera, or leave it out of the campaign.",
        ) from error


def _checked(path: Path, tiff: Any, page: Any, index: int) -> tuple[int, ...]:
    """Return (h, w) or (h, w, samples) of a page whose every strip is there."""
    shape = tuple(int(s) for s in page.shape)
    if len(shape) == 3 and page.planarconfig == 2 and shape[0] <= 16:
        shape = (shape[1], shape[2], shape[0])
    if len(shape) not in (2, 3):
        raise unreadable(path, f"page {index} is not a plane", code="E_SIZE", found=str(shape))
    check_size(path, shape)
    if page.dtype is None or page.dtype.kind not in "uif" or page.dtype.itemsize > 8:
        raise unreadable(path, f"page {index} has samples of no known kind", found=str(page.dtype))
    size = tiff.filehandle.size
    stored = sum(int(n) for n in page.databytecounts)
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=False):
        if count <= 0 or offset <= 0:
            raise unreadable(
                path,
                f"page {index} lacks a strip",
                code="E_TRUNCATED",
                field="StripOffsets",
                found="an empty strip",
                expected=f"{len(page.dataoffsets)} strips of data",
            )
        if offset + count > size:
            raise unreadable(
                path,
                "the file ends before its image does",
                code="E_TRUNCATED",
                field="StripOffsets",
                found=f"{size} bytes",
                expected=f"at least {offset + count}",
                fix="Copy the file again from the camera.",
            )
    needed = int(np.prod(shape)) * page.dtype.itemsize
    if page.compression == PLAIN and page.bitspersample % 8 == 0 and stored < needed:
        raise unreadable(
            path,
            "the strips hold less than the image",
            code="E_TRUNCATED",
            field="StripByteCounts",
            found=f"{stored} bytes",
            expected=f"{needed} bytes",
        )
    if needed > LARGEST_RATIO * max(stored, 1) + 65536:
        raise unreadable(
            path,
            "the image is larger than its stored bytes can hold",
            code="E_SIZE",
            found=f"{needed} bytes from {stored}",
            expected=f"a ratio of at most {LARGEST_RATIO}",
        )
    return shape


def read_tiff_facts(path: Path) -> Facts:
    """Return the facts of a TIFF; no pixel is decoded."""
    with _opened(path) as tiff:
        page = tiff.pages[0]
        shape = _checked(path, tiff, page, 0)
        tags = page.tags
        exif = tags["ExifTag"].value if "ExifTag" in tags else {}
        exif = exif if isinstance(exif, dict) else {}

        def tag(name: str) -> Any:
            return tags[name].value if name in tags else exif.get(name)

        xmp = tags["XMP"].value if "XMP" in tags else b""
        wavelength, fwhm, name = _camera_band(xmp)
        return Facts(
            path=path,
            kind="tiff",
            shape=shape,
            dtype=str(page.dtype),
            pages=len(tiff.pages),
            bits=int(page.bitspersample),
            black=_mean(tag("BlackLevel")),
            saturation=_mean(tag("WhiteLevel")),
            pattern=_bayer(tag("CFAPattern"), tag("CFARepeatPatternDim")),
            exposure_s=_ratio(tag("ExposureTime")),
            iso=_mean(tag("ISOSpeedRatings") or tag("PhotographicSensitivity")),
            captured=iso_date(tag("DateTimeOriginal") or tag("DateTime")),
            model=str(tag("Model")).strip() if tag("Model") else None,
            wavelengths=(wavelength,) if wavelength else None,
            fwhm=(fwhm,) if fwhm else None,
            band_names=(name,) if name else None,
        )


def read_tiff_page(path: Path, page: int | None) -> np.ndarray:
    """Decode one page (the first by default); float and integer samples in their own dtype."""
    with _opened(path) as tiff:
        index = 0 if page is None else page
        if index >= len(tiff.pages):
            raise unreadable(
                path,
                f"there is no page {index}",
                code="E_BAND_MISSING",
                found=f"{len(tiff.pages)} pages",
                expected=f"more than {index}",
            )
        shape = _checked(path, tiff, tiff.pages[index], index)
        values = tiff.pages[index].asarray()
        if values.shape != shape:
            values = np.moveaxis(values, 0, -1)
        return np.ascontiguousarray(values)


def iso_date(value: Any) -> str | None:
    """Return an EXIF date as ISO 8601: ``2019:02:08 17:43:35`` → ``2019-02-08T17:43:35``."""
    found = re.match(r"(\d{4})[:\-](\d\d)[:\-](\d\d)[ T](\d\d:\d\d:\d\d)", str(value or ""))
    if not found or found.group(1) == "0000":
        return None
    return f"{found.group(1)}-{found.group(2)}-{found.group(3)}T{found.group(4)}"


def _ratio(value: Any) -> float | None:
    if isinstance(value, tuple) and len(value) == 2 and value[1]:
        return float(value[0]) / float(value[1])
    return float(value) if isinstance(value, int | float) else None


def _mean(value: Any) -> float | None:
    if value is None or isinstance(value, str | bytes):
        return None
    numbers = np.atleast_1d(np.asarray(value, float))
    return float(numbers.mean()) if numbers.size else None


def _bayer(pattern: Any, dims: Any) -> str | None:
    if pattern is None or (dims is not None and tuple(np.atleast_1d(dims)) != (2, 2)):
        return None
    codes = list(pattern) if isinstance(pattern, bytes | tuple | list) else []
    return "".join("RGB"[c] for c in codes[:4]) if len(codes) >= 4 and max(codes[:4]) < 3 else None


def _camera_band(xmp: Any) -> tuple[float | None, float | None, str | None]:
    """Centre, width and name that MicaSense and others put in XMP."""
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else str(xmp)

    def find(name: str) -> str | None:
        found = re.search(rf"Camera:{name}(?:=\"|>)\s*([^<\"]+)", text)
        return found.group(1).strip() if found else None

    def number(name: str) -> float | None:
        try:
            return float(find(name) or "")
        except ValueError:
            return None

    return number("CentralWavelength"), number("WavelengthFWHM"), find("BandName")

"""Camera raw: the mosaic as the sensor recorded it, never LibRaw's own rendering."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.facts import Facts, check_size, unreadable
from levkas.readers.tiff import iso_date

SUFFIXES = frozenset(
    [".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef", ".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"]
)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            yield raw
    except (rawpy.LibRawError, OSError, ValueError, RuntimeError) as error:
        raise unreadable(
            path,
            "the camera raw cannot be read",
            found=f"{type(error).__name__}: {error}",
            fix="Copy the file again from the camera; `levkas doctor` says the version of LibRaw.",
        ) from error


def read_raw_facts(path: Path) -> Facts:
    """Return size, levels and pattern of the visible area, and EXIF's exposure and date."""
    with _opened(path) as raw:
        height, width = raw.raw_image_visible.shape[:2]
        check_size(path, (height, width))
        pattern, blacks = _mosaic(path, raw)
        white = raw.white_level
        saturation = float(white) if white else None
    exif = read_exif(path)
    return Facts(
        path=path,
        kind="raw",
        shape=(height, width),
        dtype="uint16",
        bits=int(saturation).bit_length() if saturation else None,
        black=float(np.mean(blacks)),
        blacks=blacks if len(set(blacks)) > 1 else None,
        saturation=saturation,
        pattern=pattern,
        **exif,
    )


def read_raw_mosaic(path: Path) -> np.ndarray:
    """Return the visible mosaic, (h, w), uint16."""
    with _opened(path) as raw:
        check_size(path, raw.raw_image_visible.shape[:2])
        values = np.array(raw.raw_image_visible, dtype=np.uint16)
    if values.ndim != 2:
        raise unreadable(path, "the raw holds no mosaic", found=f"shape {values.shape}")
    return values


def _mosaic(path: Path, raw: Any) -> tuple[str, tuple[float, ...]]:
    """Return the colour letters of the visible 2x2 tile and the black of each of its phases."""
    if raw.raw_pattern is None or raw.raw_pattern.shape != (2, 2):
        raise unreadable(
            path,
            "the sensor has no 2x2 mosaic",
            field="pattern",
            found="none" if raw.raw_pattern is None else f"{raw.raw_pattern.shape}",
            expected="a Bayer pattern",
            fix="Convert the file to a TIFF and declare its `pattern`.",
        )
    letters = raw.color_desc.decode("ascii", "replace")
    indices = np.array(raw.raw_colors_visible[:2, :2]).ravel()
    levels = raw.black_level_per_channel
    return "".join(letters[i] for i in indices), tuple(float(levels[i]) for i in indices)


def read_exif(path: Path) -> dict[str, Any]:
    """Return exposure_s, iso, captured and model as EXIF has them; None where it does not."""
    import exifread

    try:
        with path.open("rb") as handle:
            tags = exifread.process_file(handle, details=False)
    except Exception:  # exifread raises whatever a damaged header leads it to
        tags = {}

    def number(name: str) -> float | None:
        values = getattr(tags.get(name), "values", None)
        try:
            return float(values[0]) if values else None
        except (TypeError, ValueError, ZeroDivisionError):
            return None

    date = tags.get("EXIF DateTimeOriginal") or tags.get("Image DateTime")
    model = tags.get("Image Model")
    return {
        "exposure_s": number("EXIF ExposureTime"),
        "iso": number("EXIF ISOSpeedRatings"),
        "captured": iso_date(date),
        "model": str(model).strip() if model else None,
    }

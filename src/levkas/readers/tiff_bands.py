"""Bands of a TIFF, by what its writer says of pages: spectral TIFF, XMP of cameras, ImageJ, names of pages."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

from levkas.readers.exif import exif_text, numbers_of, positive_number, value_of
from levkas.readers.tiff_directories import WAVELENGTHS
from levkas.readers.wavelengths import centres_in_names, read_centres

METADATA = 65111
REFLECTANCE_CODES = 65535.0
"""Of reflectance 1.0 in 16-bit pages of a spectral TIFF."""
LONGEST_TEXT = 4 << 20
"""Characters of a text that are looked at."""
LONGEST_LABEL = 60
"""Characters of a page's description that may be the label of a band: longer ones are prose."""

Found = dict[str, Any]
"""Some of `wavelengths`, `fwhm`, `band_names`, `page_labels`, `wavelengths_unclear`, `reflectance_scale`, as `Facts` has
them, and `note`."""


def band_facts(tiff: Any, pages: Sequence[Any], samples: int) -> dict[str, Any]:
    """Return what a TIFF says of its bands, as fields of `Facts`, and `notes`.

    Bands are its images `pages` where there are several, else the `samples` of a pixel. Of several lists of them the first
    counts; one of another length than the bands is of something else, and is passed over.
    """
    count = len(pages) if len(pages) > 1 else samples
    labels = (
        _imagej(tiff),
        [exif_text(value_of(page.tags, "PageName")) for page in pages],
        [_short(page.description) for page in pages],
    )
    sources = [_spectral(pages, count), _camera_bands(pages, count)]
    found: Found = {}
    for more in sources + [_labels(each, count) for each in labels]:
        # Wavelengths of one source do not go with the widths of another.
        if _has_centres(more) and _has_centres(found):
            continue
        found = {**more, **{key: value for key, value in found.items() if value}}
    note = found.pop("note", "")
    return {**found, "notes": [note] if note else []}


def _has_centres(found: Found) -> bool:
    return bool(found.get("wavelengths") or found.get("wavelengths_unclear"))


def _of_centres(values: Sequence[float], fwhm: Sequence[float] | None = None) -> Found:
    found = read_centres(values, "nm", fwhm)
    centres = {"wavelengths": found.nm, "fwhm": found.fwhm}
    return {**centres, "wavelengths_unclear": found.unclear or None, "note": found.note}


def _spectral(pages: Sequence[Any], count: int) -> Found:
    """Read tags 65000 and 65111 of a spectral TIFF, whose values are reflectance unless its text says otherwise."""
    values = numbers_of(pages[0].tags, WAVELENGTHS)
    if len(values) != count:
        return {}
    text = exif_text(value_of(pages[0].tags, METADATA)) or ""
    try:
        record = json.loads(text[:LONGEST_TEXT])
    except (ValueError, RecursionError):
        record = {}
    record = record if isinstance(record, dict) else {}
    names = record.get("bands")
    more: Found = {}
    if isinstance(names, list) and len(names) == count:
        more["band_names"] = tuple(map(str, names))
    dtype = pages[0].dtype
    full = {"f": 1.0, "u": REFLECTANCE_CODES}.get(dtype.kind)
    if record.get("quantity", "reflectance") == "reflectance" and dtype.itemsize > 1 and full:
        more = {**more, "reflectance_scale": (full,) * count}
    numbered = all(wavelength is None for wavelength in record.get("wavelength") or [0])
    return more if numbered else {**_of_centres(values), **more}


def _camera_bands(pages: Sequence[Any], count: int) -> Found:
    """Read centre, width (nm) and name of the band that MicaSense and others put in the XMP of each page."""
    if len(pages) != count:
        return {}
    found = [camera_band(value_of(page.tags, "XMP") or b"") for page in pages]
    centres, widths, names = (list(column) for column in zip(*found, strict=True))
    made = _of_centres(centres, widths if all(widths) else None) if all(centres) else {}
    if all(names) and len(set(names)) == count:
        made["band_names"] = tuple(names)
    return made


def camera_band(xmp: bytes | str) -> tuple[float | None, float | None, str | None]:
    """Return centre and width (nm) and name of the band in the XMP of a page.

    >>> camera_band(b"<Camera:CentralWavelength>475</Camera:CentralWavelength>")
    (475.0, None, None)
    """
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else str(xmp)
    names = ("CentralWavelength", "WavelengthFWHM", "BandName")
    found = (re.search(rf"Camera:{name}(?:=\"|>)\s*([^<\"]+)", text) for name in names)
    centre, width, name = (one[1].strip() if one else None for one in found)
    return positive_number(centre), positive_number(width), name


def _imagej(tiff: Any) -> list[str]:
    """Return the labels of slices that ImageJ keeps for all pages in one tag."""
    labels = value_of(tiff.pages[0].tags, "IJMetadata")
    labels = labels.get("Labels") if isinstance(labels, dict) else None
    return [str(label).split("\n")[0] for label in labels] if isinstance(labels, list) else []


def _labels(labels: Sequence[str | None], count: int) -> Found:
    """Return labels of pages, and the wavelengths in them; of a single page only where it is named by nothing else."""
    known = [label.strip() for label in labels if label]
    if len(known) != count or len(labels) != count:
        return {}
    if count == 1:
        sole = re.fullmatch(r"[^\d]{0,20}\d+(?:\.\d+)?\s*[a-zµμ]+\W*", known[0], re.IGNORECASE)
        return {"wavelengths": centres_in_names(known)} if sole else {}
    return {"wavelengths": centres_in_names(known), "page_labels": tuple(known)}


def _short(text: str | None) -> str | None:
    text = (text or "").strip()
    prose = len(text) > LONGEST_LABEL or text.startswith(("{", "<", "ImageJ="))
    return None if prose else text or None

"""Bands of a TIFF, by what its writer says of pages: spectral TIFF, XMP of cameras, ImageJ, names of pages."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from typing import Any

from levkas.readers.exif import exif_text, positive_number
from levkas.readers.tiff_directories import WAVELENGTHS
from levkas.readers.tiff_tags import numbers_of, value_of
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

    Parameters
    ----------
    pages : sequence of tifffile page
        Its images, bands where there are several.
    samples : int
        Of a pixel, bands where there is one page.

    Returns
    -------
    facts : dict
        Of the first way in which the file lists its bands: a list of another length is of something else, and
        is passed over.
    """
    count = len(pages) if len(pages) > 1 else samples
    readers: list[Callable[[], Found]] = [
        lambda: _spectral(pages, count),
        lambda: _camera_bands(pages, count),
        lambda: _labels(_imagej(tiff), count),
        lambda: _labels([exif_text(value_of(p.tags, "PageName")) for p in pages], count),
        lambda: _labels([_short(p.description) for p in pages], count),
    ]
    found: Found = {}
    for read in readers:
        more = read()
        if any(more.get(key) for key in ("wavelengths", "wavelengths_unclear")) and any(
            found.get(key) for key in ("wavelengths", "wavelengths_unclear")
        ):
            continue
        found = {**more, **{key: value for key, value in found.items() if value}}
    note = found.pop("note", "")
    return {**found, "notes": [note] if note else []}


def _of_centres(values: Sequence[float], unit: str, fwhm: Sequence[float] | None = None) -> Found:
    found = read_centres(values, unit, fwhm)
    unclear = found.unclear or None
    centres = {"wavelengths": found.nm, "fwhm": found.fwhm, "wavelengths_unclear": unclear}
    return {**centres, "note": found.note}


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
    known = isinstance(names, list) and len(names) == count
    more: Found = {"band_names": tuple(map(str, names or ()))} if known else {}
    full = {"f": 1.0, "u": REFLECTANCE_CODES}.get(pages[0].dtype.kind)
    if (
        record.get("quantity", "reflectance") == "reflectance"
        and pages[0].dtype.itemsize > 1
        and full
    ):
        more["reflectance_scale"] = (full,) * count
    numbered = all(wavelength is None for wavelength in record.get("wavelength") or [0])
    return more if numbered else {**_of_centres(values, "nm"), **more}


def _camera_bands(pages: Sequence[Any], count: int) -> Found:
    """Read centre, width (nm) and name of the band that MicaSense and others put in the XMP of each page."""
    found = [camera_band(value_of(page.tags, "XMP") or b"") for page in pages]
    if len(found) != count:
        return {}
    centres, widths, names = (list(column) for column in zip(*found, strict=True))
    made: Found = {}
    if all(centres):
        made = _of_centres(centres, "nm", widths if all(widths) else None)
    if all(names) and len(set(names)) == count:
        made["band_names"] = tuple(names)
    return made


def camera_band(xmp: bytes | str) -> tuple[float | None, float | None, str | None]:
    """Return centre and width (nm) and name of the band in the XMP of a page.

    Examples
    --------
    >>> camera_band(b"<Camera:CentralWavelength>475</Camera:CentralWavelength>")
    (475.0, None, None)
    """
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else str(xmp)

    def find(name: str) -> str | None:
        found = re.search(rf"Camera:{name}(?:=\"|>)\s*([^<\"]+)", text)
        return found[1].strip() if found else None

    return (
        positive_number(find("CentralWavelength")),
        positive_number(find("WavelengthFWHM")),
        find("BandName"),
    )


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
    return (
        text
        if 0 < len(text) <= LONGEST_LABEL and not text.startswith(("{", "<", "ImageJ="))
        else None
    )

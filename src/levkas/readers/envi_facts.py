"""What the fields of an ENVI header state, as fields of `Facts`: exposure, camera and settings, bands, values, date."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from levkas.readers.envi_header import UNIT, EnviHeader, check_list, parse_number, squeeze_key
from levkas.readers.exif import ZERO_DAYS
from levkas.readers.nodata import nodata_of
from levkas.readers.wavelengths import centres_in_names, read_centres

MILLISECONDS = ("tint",)
"""Fields of one unit, whoever writes them: Specim's. All names here are those of `squeeze_key`."""
EXPOSURES = (
    *("integrationtime", "integrationtimes", "exposure", "exposures"),
    *("exposuretime", "exposuretimes", "shutter", "shuttertime"),
)
"""Fields of many vendors, in ms by some and in µs by others: read where a unit is with them."""
SECONDS = {
    "s": 1.0, "sec": 1.0, "second": 1.0, "ms": 1e-3, "msec": 1e-3, "millisecond": 1e-3,
    "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "usec": 1e-6, "microsecond": 1e-6,
    "ns": 1e-9, "nanosecond": 1e-9,
}  # fmt: skip
SETTINGS = {
    "gain": re.compile(r".*gains?(?!.*(file|path|date|time)).*|dataoffsetvalues"),
    "binning": re.compile(r".*binning.*"),
    "region": re.compile(r"[xy]start|[hv]img|[hvm]?roi|aoi|regionofinterest"),
}
"""Fields by which vendors state a setting of the sensor; `himg`, `vimg`, `hroi`, `vroi`, `mroi` are Specim's."""
TEXTS = {
    "model": (
        *("sensortype", "imagertype", "cameramodel"),
        *("cameratype", "sensormodel", "imagermodel"),
    ),
    "serial": (
        *("sensorid", "cameraid", "serialnumber", "cameraserialnumber", "sensorserialnumber"),
        *("imagerserialnumber", "cameraserial", "serialno", "cameraserialno"),
    ),
    "lens": ("lens", "lensname", "lensmodel", "lenstype", "objective", "objectivelens"),
}
NUMBERS = {
    "focal_mm": ("mm", "focallength", "lensfocallength"),
    "iso": (
        *("iso", "iso", "isospeed", "isospeedrating", "isospeedratings"),
        *("isosensitivity", "isovalue"),
    ),
}
"""Field of `Facts` → unit, which may stand with the number, and names."""
STOPS = ("fnumber", "fnum", "fno", "fstop", "f", "aperture", "lensaperture", "lensfnumber")
UNKNOWN = frozenset(["", "unknown", "none", "n/a", "undefined", "-", "0"])
"""What stands in a field that its writer had nothing for: ENVI itself writes `sensor type = Unknown`."""
GAINS = (
    *("data gain values", "data offset values"),
    *("data reflectance gain values", "data reflectance offset values"),
)
"""Factors and offsets to radiance or reflectance: raw counts are calibrated by dark and white instead."""
SAME = 0.01
"""Relative: exposures that differ by less are the same."""
_STOP = re.compile(r"(?:f ?[/:]? ?|1 ?: ?)?(\d+(?:[.,]\d+)?)", re.ASCII)
"""``f/2.8``, ``F 2,8``, ``1:2.8``, ``2.8``."""
_VALUE = re.compile(r"(?P<number>[^\sa-zµμ]\S*?) ?(?P<unit>[a-zµμ]+)?")
_DATE = re.compile(r"\d{4}-[01]\d-[0-3]\d(?:[T ]\d\d:\d\d:\d\d(?:\.\d+)?(?:Z|[+-]\d\d:?\d\d)?)?")


def header_facts(
    header: EnviHeader, dtype: np.dtype[Any], samples: int, bands: int
) -> dict[str, Any]:
    """Return all that a header states beside the layout of its data.

    Raises UnreadableCapture: E_BAND_COUNT where a list has another length than the bands.

    >>> from pathlib import Path
    >>> fields = {"data ignore value": "-9999", "bbl": ["1", "0"], "tint": "20"}
    >>> found = header_facts(EnviHeader(Path("a.hdr"), fields), np.dtype("i2"), 9, 2)
    >>> found["nodata"], found["bad_bands"], found["exposure_s"]
    (-9999.0, (1,), 0.02)
    """
    # A spectral library holds a spectrum a line: its samples are the wavelengths.
    library = "library" in header.text("file type").lower()
    centres = _band_facts(header, samples if library else bands)
    names = header.fields.get("band names")
    nodata, notes = nodata_of(header.text("data ignore value"), dtype, "data ignore value")
    if multipliers := header.numbers("bbl"):
        check_list(header, "bbl", len(multipliers), bands)
    return {
        **exposure_facts(header, bands),
        **setting_facts(header),
        **centres,
        "saturation": header.number("data ceiling") or None,
        "captured": _date(header),
        "band_names": tuple(names) if isinstance(names, list) and len(names) == bands else None,
        "nodata": nodata,
        "reflectance_scale": _scale(header, bands),
        "bad_bands": tuple(i for i, number in enumerate(multipliers) if number == 0) or None,
        "notes": (*centres.pop("notes", ()), *notes, *_gains(header)),
    }


# --- exposure ---------------------------------------------------------------------------------


def exposure_facts(header: EnviHeader, bands: int) -> dict[str, Any]:
    """Return `exposure_s`, `band_times_s` and `exposure_unclear`.

    >>> from pathlib import Path
    >>> exposure_facts(EnviHeader(Path("a.hdr"), {"exposure time (ms)": "20"}), 3)
    {'exposure_s': 0.02}
    >>> exposure_facts(EnviHeader(Path("a.hdr"), {"integration time": "20"}), 3)
    {'exposure_unclear': 'integration time = 20'}
    """
    clear: dict[str, list[float]] = {}
    unclear = []
    for key in header.fields:
        name, unit = _exposure_key(key)
        numbers, units = _numbers_with_units(header.fields[key]) if name else ([], set())
        if not numbers:
            continue
        beside = header.named([f"{name}unit", f"{name}units"])
        units |= {unit, *(header.text(other).lower() for other in beside)}
        units -= {None, ""}
        if not units and name in MILLISECONDS:
            units = {"ms"}
        scale = {SECONDS.get(str(unit)) or SECONDS.get(str(unit).rstrip("s")) for unit in units}
        if len(scale) != 1 or (factor := next(iter(scale))) is None:
            unclear.append(key)
            continue
        check_list(header, key, len(numbers), bands, one=True)
        clear[key] = [float(f"{number * factor:.12g}") for number in numbers]
    every = [times * bands if len(times) == 1 else times for times in clear.values()]
    if any(max(same) > min(same) * (1 + SAME) for same in zip(*every, strict=True)):
        unclear, clear = list(clear), {}
    if clear:
        times = next(iter(clear.values()))
        return {"exposure_s": times[0]} if len(set(times)) == 1 else {"band_times_s": tuple(times)}
    lines = "; ".join(f"{key} = {header.text(key)[:40]}" for key in unclear)
    return {"exposure_unclear": lines} if lines else {}


def _exposure_key(key: str) -> tuple[str, str]:
    """Return the name of a field of exposures and its unit; empty of other fields.

    >>> _exposure_key("integration_time_us"), _exposure_key("Exposure Time (ms)"), _exposure_key("exposures")
    (('integrationtime', 'us'), ('exposuretime', 'ms'), ('exposures', ''))
    """
    names = (*MILLISECONDS, *EXPOSURES)
    name, unit = squeeze_key(key)
    if name in names:
        return name, unit
    behind = (u for u in SECONDS if name.endswith(u) and name.removesuffix(u) in names)
    return next(((name.removesuffix(u), u) for u in behind), ("", ""))


def _numbers_with_units(raw: str | list[str]) -> tuple[list[float], set[str | None]]:
    """Return the numbers of a field, none where one is not above 0, and the units behind them."""
    numbers: list[float] = []
    units: set[str | None] = set()
    for text in raw if isinstance(raw, list) else [raw]:
        found = _VALUE.fullmatch(text.strip().lower()[:100])
        value = parse_number(found["number"]) if found else None
        if found is None or value is None or value <= 0:
            return [], set()
        numbers.append(value)
        units.add(found["unit"])
    return numbers, units


# --- camera, lens and settings ----------------------------------------------------------------


def setting_facts(header: EnviHeader) -> dict[str, Any]:
    """Return camera, lens and settings of the sensor.

    >>> from pathlib import Path
    >>> text = {"sensor type": "Unknown", "imager type": "Pika L", "x start": "0", "f-stop": "F 2,8"}
    >>> found = setting_facts(EnviHeader(Path("a.hdr"), {**text, "master_gain (dB)": "6.0"}))
    >>> found["model"], found["region"], found["f_number"], found["gain"]
    ('Pika L', (('x start', '1'),), 2.8, (('master gain', '6 db'),))
    """
    filled = [(key, *squeeze_key(key)) for key in header.fields if header.text(key)]
    found: dict[str, Any] = {}
    for setting, pattern in SETTINGS.items():
        keys = [one for one in filled if pattern.fullmatch(one[1])]
        # Keys as messages have them and headers are compared by: words, without a unit.
        words = (re.sub(r"[\s_-]+", " ", UNIT.sub("", key.lower())).strip() for key, *_ in keys)
        values = (_setting(header, *one) for one in keys)
        found[setting] = tuple(zip(words, values, strict=True)) or None
    for field, keys_of in TEXTS.items():
        said = (" ".join(header.text(key).split()) for key in header.named(keys_of))
        found[field] = next((text for text in said if text.lower() not in UNKNOWN), None)
    for field, (unit, *names) in NUMBERS.items():
        texts = (header.text(key).lower().strip() for key in header.named(names))
        numbers = (parse_number(text.removeprefix(unit).removesuffix(unit)) for text in texts)
        found[field] = next((number for number in numbers if number and number > 0), None)
    # An aperture may be in another unit.
    stops = (
        _STOP.fullmatch(header.text(key).lower()[:40])
        for key in header.named(STOPS)
        if squeeze_key(key)[1] in ("", "f", "f/")
    )
    openings = (parse_number(stop[1].replace(",", ".")) for stop in stops if stop)
    return {**found, "f_number": next((number for number in openings if number), None)}


def _setting(header: EnviHeader, key: str, name: str, unit: str) -> str:
    """Return the value of a setting, numbers in one form; a region begins at 1, as ENVI counts, or at 0."""
    values = []
    for text in (each.strip().lower() for each in header.text(key).split(",")):
        found = _VALUE.fullmatch(text[:100])
        number = parse_number(found["number"]) if found else None
        if found is None or number is None:
            values.append(text)
            continue
        number = max(number, 1.0) if name in ("xstart", "ystart") else number
        values.append(f"{number:.9g} {found['unit'] or unit}".strip())
    return ", ".join(values)


# --- bands, values, date ----------------------------------------------------------------------


def _band_facts(header: EnviHeader, bands: int) -> dict[str, Any]:
    """Return `wavelengths`, `fwhm`, `wavelengths_unclear` and `notes`; without a list they are looked for in names of bands."""
    lists: dict[str, list[float] | None] = {}
    for key in ("wavelength", "fwhm"):
        values = header.numbers(key)
        numbers = [v for v in values if v is not None]
        if values:
            count = len(values) if len(numbers) == bands else len(numbers)
            check_list(header, key, count, bands)
        lists[key] = numbers or None
    found = read_centres(lists["wavelength"] or (), header.text("wavelength units"), lists["fwhm"])
    names = header.fields.get("band names")
    none = found.nm is None and not found.unclear
    if none and isinstance(names, list) and len(names) == bands:
        return {"wavelengths": centres_in_names(names)}
    return {
        "wavelengths": found.nm,
        "fwhm": found.fwhm,
        "wavelengths_unclear": found.unclear or None,
        "notes": (found.note,) if found.note else (),
    }


def _scale(header: EnviHeader, bands: int) -> tuple[float, ...] | None:
    """Return the value of reflectance 1.0 in every band; None where the header has none."""
    key = "reflectance scale factor"
    numbers = header.numbers(key)
    found = [n for n in numbers if n is not None and n > 0]
    if not found or len(found) < len(numbers):
        return None
    check_list(header, key, len(found), bands, one=True)
    return tuple(found * bands if len(found) == 1 else found)


def _gains(header: EnviHeader) -> list[str]:
    """Report which gains and offsets of the header are not applied; nothing of those without effect."""
    neutral = {key: 0.0 if "offset" in key else 1.0 for key in GAINS}
    there = [f"`{key}`" for key in GAINS if {*header.numbers(key)} - {neutral[key]}]
    return [f"{' and '.join(there)} of the header are not applied"] if there else []


def _date(header: EnviHeader) -> str | None:
    for key in ("acquisition time", "acquisition date", "date"):
        found = _DATE.search(header.text(key))
        if found and found[0][:10] not in ZERO_DAYS:
            start = header.text("start time")  # Specim's, beside a date without time
            clock = re.search(r"\d\d:\d\d:\d\d", start) if len(found[0]) == 10 else None
            zone = "+00:00" if "UTC" in start else ""
            return f"{found[0]}T{clock[0]}{zone}" if clock else found[0].replace(" ", "T")
    return None

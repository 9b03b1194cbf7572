"""ENVI headers as vendors really write them, and the files that belong to them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite
from pathlib import Path
from typing import Any

from levkas.core.text import what_stands_at
from levkas.readers.facts import UnreadableCapture, unreadable

LONGEST_HEADER = 4 << 20
MOST_KEYS = 5000
"""The headers of cameras have 20 to 300."""
DATA_SUFFIXES = (
    *(".raw", ".dat", ".img", ".bil", ".bip", ".bsq", ".bin", ".cube", ".float", ".hyspex", ".sli"),
    "",
)
LAYOUT = ("samples", "lines", "bands", "data type", "interleave", "byte order", "header offset")
"""Keys of the place of each number: where one occurs twice, both must agree."""
LONGEST_NUMBER = 400
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?", re.IGNORECASE | re.ASCII)
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
MODELS = ("sensortype", "imagertype", "cameramodel", "cameratype", "sensormodel", "imagermodel")
SERIALS = (
    *("sensorid", "cameraid", "serialnumber", "cameraserialnumber", "sensorserialnumber"),
    *("imagerserialnumber", "cameraserial", "serialno", "cameraserialno"),
)
LENSES = ("lens", "lensname", "lensmodel", "lenstype", "objective", "objectivelens")
STOPS = ("fnumber", "fnum", "fno", "fstop", "f", "aperture", "lensaperture", "lensfnumber")
FOCAL = ("focallength", "lensfocallength")
ISO = ("iso", "isospeed", "isospeedrating", "isospeedratings", "isosensitivity", "isovalue")
UNKNOWN = frozenset(["", "unknown", "none", "n/a", "undefined", "-", "0"])
"""What stands in a field that its writer had nothing for: ENVI itself writes `sensor type = Unknown`."""
SAME = 0.01
"""Relative: exposures that differ by less are the same."""
_UNIT = re.compile(r" *[(\[] *([^()\[\]]{0,20}?) *[)\]]$")
"""Of a key, in brackets behind it."""
_STOP = re.compile(r"(?:f ?[/:]? ?|1 ?: ?)?(\d+(?:[.,]\d+)?)", re.ASCII)
"""``f/2.8``, ``F 2,8``, ``1:2.8``, ``2.8``."""
_VALUE = re.compile(r"(?P<number>[^\sa-zµμ]\S*?) ?(?P<unit>[a-zµμ]+)?")

Fields = dict[str, "str | list[str]"]


@dataclass(frozen=True)
class EnviHeader:
    """A parsed header: its file, and its fields by keys in lower case, text or lists of text."""

    path: Path
    fields: Fields

    def named(self, names: Sequence[str]) -> Iterator[str]:
        """Yield the keys of fields in the order of their names, squeezed, however vendors write these."""
        squeezed = {key: squeeze_key(key)[0] for key in self.fields}
        yield from (key for name in names for key in squeezed if squeezed[key] == name)

    def text(self, key: str) -> str:
        """Return a field as text, ``{ nm }`` like ``nm``; empty where it is absent."""
        value = self.fields.get(key, "")
        return (", ".join(value) if isinstance(value, list) else value).strip()

    def number(self, key: str) -> float | None:
        """Return a field as a finite number, or None."""
        return parse_number(self.text(key))

    def numbers(self, key: str) -> list[float | None]:
        """Return the items of a list as numbers, None for each that is none."""
        raw = self.fields.get(key) or []
        return [parse_number(v) for v in (raw if isinstance(raw, list) else raw.split(","))]

    def whole(self, key: str, *, least: int = 1, default: int | None = None) -> int:
        """Return a whole number of at least `least`; raises UnreadableCapture."""
        if key not in self.fields and default is not None:
            return default
        value = self.number(key)
        if value is None or value != int(value) or value < least:
            raise self.refusal(
                f"the header has no {key}",
                key,
                self.text(key)[:80] or "nothing",
                f"a whole number from {least}",
                f"Write `{key} = …` with the value from the camera's software.",
            )
        return int(value)

    def refusal(
        self, message: str, field: str, found: Any, expected: Any, fix: str
    ) -> UnreadableCapture:
        """Return the refusal of a field, ready to raise."""
        more = {"field": field, "found": found, "expected": expected}
        return unreadable(self.path, message, fix=fix, **more)


@lru_cache(maxsize=1 << 12)
def squeeze_key(key: str) -> tuple[str, str]:
    """Return the letters and digits of a key in lower case, and the unit in brackets behind it.

    >>> squeeze_key("Camera_Gain [dB]"), squeeze_key("f/stop")
    (('cameragain', 'db'), ('fstop', ''))
    """
    key = key[:100].lower()
    unit = _UNIT.search(key)
    return re.sub(r"[\W_]+", "", key[: unit.start()] if unit else key), unit[1] if unit else ""


def parse_number(text: str) -> float | None:
    """Return a finite number, or None.

    Examples
    --------
    >>> parse_number(" 4.5e2"), parse_number("nan"), parse_number("12 bit")
    (450.0, None, None)
    """
    text = text.strip()
    if len(text) > LONGEST_NUMBER or not NUMBER.fullmatch(text):
        return None
    value = float(text)
    return value if isfinite(value) else None


# --- files ------------------------------------------------------------------------------------


def find_header(path: str | Path) -> Path | None:
    """Return the header beside a data file, ``NAME.raw.hdr`` or ``NAME.hdr``; None without one."""
    path = Path(path)
    names = [path.name] + ([path.stem] if path.suffix else [])
    for name in names:
        for suffix in (".hdr", ".HDR"):
            if what_stands_at(header := path.with_name(name + suffix)) == "a file":
                return header
    return None


def find_data(header: EnviHeader, needed: int) -> Path:
    """Return the data file of a header.

    Of several beside it, the one that the header names or the only one of the `needed` bytes.
    Raises UnreadableCapture where there is none, or several fit.
    """
    path = header.path
    stem = path.with_suffix("").name
    named = Path(header.text("data file") or "/").name
    suffixes = [*DATA_SUFFIXES, *(s.upper() for s in DATA_SUFFIXES if s)]
    names = ([named] if named else []) + [stem + s for s in suffixes]
    found: list[Path] = []
    for name in names:
        candidate = path.with_name(name)
        if what_stands_at(candidate) == "a file" and not any(
            candidate.samefile(f) for f in [*found, path]
        ):
            found.append(candidate)
    if not found:
        there = {name: what_stands_at(path.with_name(name)) for name in names}
        odd = [f"{name}: {found}" for name, found in there.items() if found != "no such file"]
        raise header.refusal(
            "the header has no data file beside it",
            "data file",
            "; ".join(odd[:3]) or "no such file",
            f"{stem} with one of {', '.join(DATA_SUFFIXES[:-1])}, or no suffix",
            "Put the data beside their header, with the same name.",
        )
    if found[0].name == named or len(found) == 1:
        return found[0]
    fitting = [f for f in found if f.stat().st_size == needed]
    if len(fitting) == 1:
        return fitting[0]
    raise header.refusal(
        "several files may hold the data of this header",
        "data file",
        ", ".join(f.name for f in found),
        f"one of {needed} bytes",
        "Move the other files, or open the data file by its own name.",
    )


# --- text -------------------------------------------------------------------------------------


def parse_header(path: Path) -> EnviHeader:
    """Parse an ENVI header: keys in lower case, ``{…}`` as lists of text, comments left out.

    Raises UnreadableCapture where it is no ENVI header, a list has no end, or two lines of the layout contradict each
    other.
    """
    header = EnviHeader(path, {})
    rows = _rows(path)
    if not rows or not rows[0].strip().upper().startswith("ENVI"):
        fix = "Name the header of an ENVI cube, or remove the file from `files`."
        found = (rows or [""])[0][:40]
        raise header.refusal(
            "this is not an ENVI header", "header", found, "a first line ENVI", fix
        )
    left = iter(rows[1:])
    for row in left:
        name, equals, text = row.partition("=")
        if not equals:
            continue
        key, text = re.sub(r"\s+", " ", name.strip().lower()), text.strip()
        value = _list(header, key, text, left) if text.startswith("{") else _bare(text)
        if key in LAYOUT and header.fields.get(key, value) != value:
            message, found = (
                f"the header gives its {key} twice",
                f"{header.fields[key]} and {value}",
            )
            raise header.refusal(message, key, found, "one value", "Delete the line that is wrong.")
        header.fields[key] = value
        if len(header.fields) > MOST_KEYS:
            found, expected = f"over {MOST_KEYS}", f"at most {MOST_KEYS}"
            fix = "Name the header of an ENVI cube, or remove foreign lines from it."
            raise header.refusal("the header has too many keys", "header", found, expected, fix)
    return header


def _rows(path: Path) -> list[str]:
    """Return the lines of a header without comments and empty lines."""
    try:
        size = path.stat().st_size
        if size > LONGEST_HEADER:
            raise unreadable(
                path,
                "the header is too long",
                code="E_SIZE",
                field="header",
                found=f"{size} bytes",
                expected=f"at most {LONGEST_HEADER} bytes",
                fix="This may be the data under the name of the header: a header is a short text.",
            )
        text = path.read_bytes().decode("utf-8-sig", "replace")
    except OSError as error:
        raise unreadable(path, "the header cannot be opened", found=str(error)) from error
    return [row for line in re.split(r"[\r\n]+", text) if (row := _uncommented(line)).strip()]


def _uncommented(line: str) -> str:
    """Cut ``; …`` at the start of a line or after a space, but not in quotes or before a ``}``."""
    last, start, quotes = line.rfind("}"), 0, 0
    blank = len(line) - len(line.lstrip())
    # One pass, and no pattern that goes back: a header may be a megabyte of blanks or semicolons.
    while (at := line.find(";", start)) >= 0:
        quotes += line.count('"', start, at)
        apart = at == 0 or line[at - 1].isspace()
        if apart and quotes % 2 == 0 and (last < at or at <= blank):
            return line[:at]
        start = at + 1
    return line


def _list(header: EnviHeader, key: str, text: str, left: Iterator[str]) -> list[str]:
    parts = [text[1:]]
    while "}" not in parts[-1]:
        row = next(left, None)
        if row is None:
            message, fix = "a list in the header is not closed", "Write the } where the list ends."
            raise header.refusal(message, key, "the end of the file", "a closing }", fix)
        parts.append(row)
    inner = "\n".join(parts).rpartition("}")[0]
    return [_bare(v) for v in re.split(r"[,\n]", inner) if v.strip()]


def _bare(text: str) -> str:
    return text.strip().strip("\"'").strip()


# --- exposure ---------------------------------------------------------------------------------


def exposure_facts(header: EnviHeader, bands: int) -> dict[str, Any]:
    """Return `exposure_s`, `band_times_s` and `exposure_unclear`, as `Facts` has them.

    Raises UnreadableCapture: E_BAND_COUNT where a list of exposures has another length than the bands.

    Examples
    --------
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
    lines = "; ".join(f"{key} = {_short(header.fields[key])}" for key in unclear)
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


def setting_facts(header: EnviHeader) -> dict[str, Any]:
    """Return camera, lens and settings of the sensor, as fields of `Facts`.

    Examples
    --------
    >>> text = {"sensor type": "Unknown", "imager type": "Pika L", "x start": "0", "f-stop": "F 2,8"}
    >>> found = setting_facts(EnviHeader(Path("a.hdr"), {**text, "master_gain (dB)": "6.0"}))
    >>> found["model"], found["region"], found["f_number"], found["gain"]
    ('Pika L', (('x start', '1'),), 2.8, (('master gain', '6 db'),))
    """
    filled = [(key, *squeeze_key(key)) for key in header.fields if header.text(key)]
    found: dict[str, Any] = {
        setting: tuple(
            (_spaced(key), _setting(header, key, name, unit))
            for key, name, unit in filled
            if pattern.fullmatch(name)
        )
        or None
        for setting, pattern in SETTINGS.items()
    }
    return {
        **found,
        "model": _named(header, MODELS),
        "serial": _named(header, SERIALS),
        "lens": _named(header, LENSES),
        "f_number": _stop(header),
        "focal_mm": _first_number(header, FOCAL, "mm"),
        "iso": _first_number(header, ISO, "iso"),
    }


def _named(header: EnviHeader, names: tuple[str, ...]) -> str | None:
    texts = (" ".join(header.text(key).split()) for key in header.named(names))
    return next((text for text in texts if text.lower() not in UNKNOWN), None)


def _stop(header: EnviHeader) -> float | None:
    """Return the f-number; None of an aperture in another unit."""
    keys = (key for key in header.named(STOPS) if squeeze_key(key)[1] in ("", "f", "f/"))
    stops = (_STOP.fullmatch(header.text(key).lower()[:40]) for key in keys)
    numbers = (parse_number(stop[1].replace(",", ".")) for stop in stops if stop)
    return next((number for number in numbers if number), None)


def _first_number(header: EnviHeader, names: tuple[str, ...], unit: str) -> float | None:
    """Return the first number above 0 of some fields, with its unit or without."""
    texts = (header.text(key).lower().strip() for key in header.named(names))
    numbers = (parse_number(text.removeprefix(unit).removesuffix(unit)) for text in texts)
    return next((number for number in numbers if number and number > 0), None)


def _spaced(key: str) -> str:
    """Return a key as messages have it and headers are compared by: words, without a unit."""
    return re.sub(r"[\s_-]+", " ", _UNIT.sub("", key.lower())).strip()


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


def check_list(header: EnviHeader, key: str, count: int, bands: int, *, one: bool = False) -> None:
    """Refuse a list that has not a number a band; one number will do where `one`."""
    if count == bands or (one and count == 1):
        return
    raise unreadable(
        header.path,
        f"the list of {key} does not match the bands",
        code="E_BAND_COUNT",
        field=key,
        found=f"{count} numbers",
        expected=f"{bands}, or one" if one else f"{bands}",
        fix="Write one number per band, or one for all."
        if one
        else "Write one number per band, or remove the list.",
    )


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


def _short(value: str | list[str]) -> str:
    return value[:40] if isinstance(value, str) else "{" + ", ".join(value)[:40] + "}"

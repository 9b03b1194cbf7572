"""ENVI headers as vendors really write them, and the files that belong to them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import isfinite
from pathlib import Path
from typing import Any

from levkas.readers.facts import unreadable
from levkas.readers.text import what_stands_at

LONGEST_HEADER = 4 << 20
DATA_SUFFIXES = (
    *(".raw", ".dat", ".img", ".bil", ".bip", ".bsq", ".bin", ".cube", ".float", ".hyspex", ".sli"),
    "",
)
LAYOUT = ("samples", "lines", "bands", "data type", "interleave", "byte order", "header offset")
"""Keys that say where each number lies: said twice, they must agree."""

LONGEST_NUMBER = 400
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?", re.IGNORECASE | re.ASCII)

Fields = dict[str, "str | list[str]"]


def find_header(path: str | Path) -> Path | None:
    """Return the header beside a data file, ``NAME.raw.hdr`` or ``NAME.hdr``; None without one."""
    path = Path(path)
    names = [path.name] + ([path.stem] if path.suffix else [])
    for name in names:
        for suffix in (".hdr", ".HDR"):
            if what_stands_at(header := path.with_name(name + suffix)) == "a file":
                return header
    return None


def find_data(header: Path, fields: Fields, needed: int) -> Path:
    """Return the data file of a header.

    Where several stand beside it, the one that the header names or the only one of the `needed`
    bytes. Raises UnreadableCapture where there is none, or no telling which.
    """
    stem = header.with_suffix("")
    named = Path(text_of(fields, "data file") or "/").name
    suffixes = [*DATA_SUFFIXES, *(s.upper() for s in DATA_SUFFIXES if s)]
    names = ([named] if named else []) + [stem.name + s for s in suffixes]
    found: list[Path] = []
    for name in names:
        candidate = header.with_name(name)
        if what_stands_at(candidate) == "a file" and not any(
            candidate.samefile(f) for f in [*found, header]
        ):
            found.append(candidate)
    if not found:
        raise unreadable(
            header,
            "the header has no data file beside it",
            field="data file",
            found=_beside(header, names),
            expected=f"{stem.name} with one of {', '.join(DATA_SUFFIXES[:-1])}, or no suffix",
            fix="Put the data beside their header, under the same name.",
        )
    if found[0].name == named or len(found) == 1:
        return found[0]
    fitting = [f for f in found if f.stat().st_size == needed]
    if len(fitting) == 1:
        return fitting[0]
    raise unreadable(
        header,
        "several files could be the data of this header",
        found=", ".join(f.name for f in found),
        expected=f"one of {needed} bytes",
        fix="Move the others elsewhere, or open the data file by its own name.",
    )


def _beside(header: Path, names: list[str]) -> str:
    """Say what stands where the data should: a pipe, a folder, or nothing."""
    there = {name: what_stands_at(header.with_name(name)) for name in names}
    odd = [f"{name}: {found}" for name, found in there.items() if found != "no such file"]
    return "; ".join(odd[:3]) if odd else "no such file"


def parse_header(path: Path) -> Fields:
    """Parse an ENVI header: keys in lower case, ``{…}`` as lists of text, comments left out.

    Raises
    ------
    UnreadableCapture
        Where it is no ENVI header, a list has no end, or the layout is said twice and differently.
    """
    rows = _rows(path)
    if not rows or not rows[0].strip().upper().startswith("ENVI"):
        raise unreadable(
            path,
            "this is no ENVI header",
            found=(rows or [""])[0][:40],
            expected="a first line ENVI",
            fix="Name the header of an ENVI cube, or leave the file out of `files`.",
        )
    fields: Fields = {}
    left = iter(rows[1:])
    for row in left:
        name, equals, text = row.partition("=")
        if not equals:
            continue
        key, text = re.sub(r"\s+", " ", name.strip().lower()), text.strip()
        value = _list(path, key, text, left) if text.startswith("{") else _bare(text)
        if key in LAYOUT and fields.get(key, value) != value:
            raise unreadable(
                path,
                f"the header says its {key} twice",
                field=key,
                found=f"{fields[key]} and {value}",
                expected="one value",
                fix="Delete the line that is wrong.",
            )
        fields[key] = value
    return fields


def _rows(path: Path) -> list[str]:
    """Lines of a header without comments and empty lines."""
    try:
        size = path.stat().st_size
        if size > LONGEST_HEADER:
            raise unreadable(
                path,
                "the header is too long to be one",
                code="E_SIZE",
                field="header",
                found=f"{size} bytes",
                expected=f"at most {LONGEST_HEADER} bytes",
                fix="The data may have the name of the header: a header is a page of text.",
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


def _list(path: Path, key: str, text: str, left: Iterator[str]) -> list[str]:
    parts = [text[1:]]
    while "}" not in parts[-1]:
        row = next(left, None)
        if row is None:
            raise unreadable(
                path,
                "a list in the header has no end",
                field=key,
                found="the end of the file",
                expected="a closing }",
                fix="Write the } where the list ends.",
            )
        parts.append(row)
    inner = "\n".join(parts).rpartition("}")[0]
    return [_bare(v) for v in re.split(r"[,\n]", inner) if v.strip()]


def _bare(text: str) -> str:
    return text.strip().strip("\"'").strip()


def text_of(fields: Fields, key: str) -> str:
    """Return a field as text, ``{ nm }`` like ``nm``; empty where it is not there."""
    value = fields.get(key, "")
    return (", ".join(value) if isinstance(value, list) else value).strip()


def number_of(text: str) -> float | None:
    """Return a finite number, or None.

    Examples
    --------
    >>> number_of(" 4.5e2"), number_of("nan"), number_of("12 bit")
    (450.0, None, None)
    """
    text = text.strip()
    if len(text) > LONGEST_NUMBER or not NUMBER.fullmatch(text):
        return None
    value = float(text)
    return value if isfinite(value) else None


def whole_of(
    path: Path, fields: Fields, key: str, *, least: int = 1, default: int | None = None
) -> int:
    """Return a whole number of at least `least`; raises UnreadableCapture."""
    if key not in fields and default is not None:
        return default
    text = text_of(fields, key)
    value = number_of(text)
    if value is None or value != int(value) or value < least:
        raise unreadable(
            path,
            f"the header does not say its {key}",
            field=key,
            found=text[:80] or "nothing",
            expected=f"a whole number from {least}",
            fix=f"Write `{key} = …` as the camera's software gives it.",
        )
    return int(value)


MILLISECONDS = ("tint",)
"""Fields of one unit, whoever writes them: Specim's."""
BARE = (
    "integration time",
    "integration times",
    "exposure",
    "exposures",
    "exposure time",
    "exposure times",
    "shutter",
)
"""Fields of many vendors, in ms by some and in µs by others: understood where a unit stands with them."""
SECONDS = {
    "s": 1.0, "sec": 1.0, "second": 1.0, "ms": 1e-3, "msec": 1e-3, "millisecond": 1e-3,
    "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "usec": 1e-6, "microsecond": 1e-6,
    "ns": 1e-9, "nanosecond": 1e-9,
}  # fmt: skip
SAME = 0.01
"""Relative: fields that differ by less say the same."""
_KEY = re.compile(r"(?P<name>[a-z ]+?) ?(?:[(\[] ?(?P<unit>[a-zµμ]+) ?[)\]])?")
_VALUE = re.compile(r"(?P<number>[^\sa-zµμ]\S*?) ?(?P<unit>[a-zµμ]+)?")


def exposure_facts(path: Path, fields: Fields, bands: int) -> dict[str, Any]:
    """Return `exposure_s`, `band_times_s` and `exposure_unclear`, as `Facts` has them.

    Raises
    ------
    UnreadableCapture
        E_BAND_COUNT where a list of exposures has another length than the bands.

    Examples
    --------
    >>> exposure_facts(Path("a.hdr"), {"exposure time (ms)": "20"}, 3)
    {'exposure_s': 0.02}
    >>> exposure_facts(Path("a.hdr"), {"integration time": "20"}, 3)
    {'exposure_unclear': 'integration time = 20'}
    """
    clear: dict[str, tuple[float, ...]] = {}
    unclear = []
    for key in fields:
        found = _KEY.fullmatch(key[:100].replace("_", " "))
        if found is None or found["name"] not in (*MILLISECONDS, *BARE):
            continue
        numbers, units = _numbers(fields, key)
        if not numbers:
            continue
        units |= {found["unit"]} if found["unit"] else set()
        units |= {text_of(fields, f"{key} {word}").lower() for word in ("unit", "units")} - {""}
        if not units and found["name"] in MILLISECONDS:
            units = {"ms"}
        scale = {SECONDS.get(unit) or SECONDS.get(unit.rstrip("s")) for unit in units}
        if len(scale) != 1 or None in scale:
            unclear.append(f"{key} = {_shown(fields[key])}")
            continue
        if len(numbers) not in (1, bands):
            raise unreadable(
                path,
                f"the list of {key} does not fit the bands",
                code="E_BAND_COUNT",
                field=key,
                found=f"{len(numbers)} numbers",
                expected=f"{bands}, or one",
                fix="Write one number a band, or one for all.",
            )
        factor = float(next(iter(scale)) or 0.0)
        clear[key] = tuple(float(f"{number * factor:.12g}") for number in numbers)
    if clear and not _alike(list(clear.values())):
        unclear, clear = [f"{key} = {_shown(fields[key])}" for key in clear], {}
    if not clear:
        return {"exposure_unclear": "; ".join(unclear)} if unclear else {}
    times = next(iter(clear.values()))
    if len(set(times)) == 1:
        return {"exposure_s": times[0]}
    return {"band_times_s": times}


def _numbers(fields: Fields, key: str) -> tuple[list[float], set[str]]:
    """Return the numbers of a field, none where it is not numbers above 0, and the units behind them."""
    raw = fields[key]
    numbers, units = [], set()
    for text in raw if isinstance(raw, list) else [raw]:
        found = _VALUE.fullmatch(text.strip().lower()[:100])
        value = number_of(found["number"]) if found else None
        if found is None or value is None or value <= 0:
            return [], set()
        numbers.append(value)
        units |= {found["unit"]} if found["unit"] else set()
    return numbers, units


def _alike(stated: list[tuple[float, ...]]) -> bool:
    """Tell whether fields say the same times; one number stands for all bands."""
    longest = max(len(times) for times in stated)
    every = [times * longest if len(times) == 1 else times for times in stated]
    return all(max(same) <= min(same) * (1 + SAME) for same in zip(*every, strict=True))


def _shown(value: str | list[str]) -> str:
    return value[:40] if isinstance(value, str) else "{" + ", ".join(value)[:40] + "}"

"""ENVI headers as vendors really write them, and the files that belong to them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite
from pathlib import Path

from levkas.core.text import what_stands_at
from levkas.readers.facts import refused, unreadable

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
UNIT = re.compile(r" *[(\[] *([^()\[\]]{0,20}?) *[)\]]$")
"""Of a key, in brackets behind it."""

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
            found = self.text(key)[:80] or "nothing"
            raise refused(self.path, "key", found, key=key, least=least)
        return int(value)


def check_list(header: EnviHeader, key: str, count: int, bands: int, *, one: bool = False) -> None:
    """Refuse a list that has not a number a band; one number will do where `one`."""
    if count == bands or (one and count == 1):
        return
    wanted = f"{bands}, or one," if one else f"{bands}"
    raise refused(header.path, "list", f"{count} numbers", key=key, bands=wanted)


@lru_cache(maxsize=1 << 12)
def squeeze_key(key: str) -> tuple[str, str]:
    """Return the letters and digits of a key in lower case, and the unit in brackets behind it.

    >>> squeeze_key("Camera_Gain [dB]"), squeeze_key("f/stop")
    (('cameragain', 'db'), ('fstop', ''))
    """
    key = key[:100].lower()
    unit = UNIT.search(key)
    return re.sub(r"[\W_]+", "", key[: unit.start()] if unit else key), unit[1] if unit else ""


def parse_number(text: str) -> float | None:
    """Return a finite number, or None.

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
    beside = (path.with_name(name + suffix) for name in names for suffix in (".hdr", ".HDR"))
    return next((header for header in beside if what_stands_at(header) == "a file"), None)


def find_data(header: EnviHeader, needed: int) -> Path:
    """Return the data file of a header: of several beside it the one that it names, or the only one of the `needed` bytes.

    Raises UnreadableCapture where there is none, or several fit.
    """
    path = header.path
    stem = path.with_suffix("").name
    named = Path(header.text("data file") or "/").name
    suffixes = [*DATA_SUFFIXES, *(s.upper() for s in DATA_SUFFIXES if s)]
    names = ([named] if named else []) + [stem + s for s in suffixes]
    there = {name: what_stands_at(path.with_name(name)) for name in names}
    found: list[Path] = []
    for candidate in (path.with_name(name) for name in names if there[name] == "a file"):
        if not any(candidate.samefile(f) for f in [*found, path]):
            found.append(candidate)
    if not found:
        odd = [f"{name}: {what}" for name, what in there.items() if what != "no such file"]
        words = {"stem": stem, "suffixes": ", ".join(DATA_SUFFIXES[:-1])}
        raise refused(path, "no data", "; ".join(odd[:3]) or "no such file", **words)
    if found[0].name == named or len(found) == 1:
        return found[0]
    fitting = [f for f in found if f.stat().st_size == needed]
    if len(fitting) == 1:
        return fitting[0]
    raise refused(path, "several data", ", ".join(f.name for f in found), needed=needed)


# --- text -------------------------------------------------------------------------------------


def parse_header(path: Path) -> EnviHeader:
    """Parse an ENVI header: keys in lower case, ``{…}`` as lists of text, comments left out.

    Raises UnreadableCapture where it is no ENVI header, a list has no end, or two lines of the layout contradict each
    other.
    """
    header = EnviHeader(path, {})
    rows = _rows(path)
    if not rows or not rows[0].strip().upper().startswith("ENVI"):
        raise refused(path, "no ENVI", (rows or [""])[0][:40], most=MOST_KEYS)
    left = iter(rows[1:])
    for row in left:
        name, equals, text = row.partition("=")
        if not equals:
            continue
        key, text = re.sub(r"\s+", " ", name.strip().lower()), text.strip()
        value = _list(header, key, text, left) if text.startswith("{") else _bare(text)
        if key in LAYOUT and header.fields.get(key, value) != value:
            found = f"{header.fields[key]} and {value}"
            raise refused(path, "twice", found, key=key)
        header.fields[key] = value
        if len(header.fields) > MOST_KEYS:
            raise refused(path, "no ENVI", f"over {MOST_KEYS} keys", most=MOST_KEYS)
    return header


def _rows(path: Path) -> list[str]:
    """Return the lines of a header without comments and empty lines."""
    try:
        size = path.stat().st_size
        if size > LONGEST_HEADER:
            raise refused(path, "long header", f"{size} bytes", most=LONGEST_HEADER)
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
            raise refused(header.path, "open list", "the end of the file", key=key)
        parts.append(row)
    inner = "\n".join(parts).rpartition("}")[0]
    return [_bare(v) for v in re.split(r"[,\n]", inner) if v.strip()]


def _bare(text: str) -> str:
    return text.strip().strip("\"'").strip()

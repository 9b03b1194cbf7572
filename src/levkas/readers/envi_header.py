"""ENVI headers as vendors really write them, and the files that belong to them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import isfinite
from pathlib import Path

from levkas.readers.facts import unreadable
from levkas.readers.texts import what_stands_at

LONGEST_HEADER = 4 << 20
DATA_SUFFIXES = (
    *(".raw", ".dat", ".img", ".bil", ".bip", ".bsq", ".bin", ".cube", ".float", ".hyspex", ".sli"),
    "",
)
LAYOUT = (
    "samples",
    "lines",
    "bands",
    "data type",
    "interleave",
    "byte order",
    "header offset",
)
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

"""ENVI headers as vendors really write them, and the files that belong to them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import isfinite
from pathlib import Path

from levkas.readers.facts import unreadable

LONGEST_HEADER = 8 << 20
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

Fields = dict[str, "str | list[str]"]


def find_header(path: str | Path) -> Path | None:
    """Return the header beside a data file, ``NAME.raw.hdr`` or ``NAME.hdr``; None without one."""
    path = Path(path)
    names = [path.name] + ([path.stem] if path.suffix else [])
    for name in names:
        for suffix in (".hdr", ".HDR"):
            if (header := path.with_name(name + suffix)).is_file():
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
        if candidate.is_file() and not any(candidate.samefile(f) for f in [*found, header]):
            found.append(candidate)
    if not found:
        raise unreadable(
            header,
            "the header has no data file beside it",
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
                found=f"{size} bytes",
                expected=f"at most {LONGEST_HEADER}",
            )
        text = path.read_bytes().decode("utf-8-sig", "replace")
    except OSError as error:
        raise unreadable(path, "the header cannot be opened", found=str(error)) from error
    return [row for line in re.split(r"[\r\n]+", text) if (row := _uncommented(line)).strip()]


def _uncommented(line: str) -> str:
    """Cut ``; …`` at the start of a line or after a space, but not in quotes or before a ``}``."""
    for found in re.finditer(r"(?:^|(?<=\s))\s*;", line):
        before, after = line[: found.start()], line[found.end() :]
        if before.count('"') % 2 == 0 and ("}" not in after or not before.strip()):
            return before
    return line


def _list(path: Path, key: str, text: str, left: Iterator[str]) -> list[str]:
    parts = [text[1:]]
    while "}" not in parts[-1]:
        row = next(left, None)
        if row is None:
            raise unreadable(
                path, "a list in the header has no end", field=key, expected="a closing }"
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
    if not re.fullmatch(r"\s*[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?\s*", text, re.IGNORECASE):
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
            found=text or None,
            expected=f"a whole number from {least}",
        )
    return int(value)

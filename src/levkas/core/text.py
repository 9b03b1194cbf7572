"""Text that people and programs wrote beside the frames, bounded before a parser sees it."""

from __future__ import annotations

import json
import os
import re
import stat
from contextlib import suppress
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import Any, BinaryIO

from levkas.core.problems import Problem, Refused, closest_match

MOST_BESIDE = 1000
"""Names beside one that does not exist that are looked at."""
LARGEST_TABLE = 16 << 20
"""Bytes of a CSV or a JSON record."""
DEEPEST, MOST_TOKENS = 64, 1_000_000
"""Brackets within brackets of a JSON record, for each of which Python's parser calls itself; texts and brackets: records that
Levkas writes have some thousands."""
LONGEST_PART, LONGEST_PATH = 255, 4095
"""Bytes of a file's name, and of a path: the limits of Linux (limits.h); those of macOS and Windows are no larger."""
KINDS = (
    (stat.S_ISREG, "a file"),
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\ud800-\udfff]")
"""Characters that no text of a person has: controls but tabulator and line ends, halves of characters."""
_BRACKET = re.compile(r'"(?:[^"\\]|\\.)*"|[\[\]{}]', re.DOTALL)


class TooMuch(ValueError):
    """A JSON record that is nested too deeply, or holds too much."""


class TextRefused(Refused):
    """A file of text that cannot be read, is too large, or is not of its format."""


def _refused(
    message: str, file: Any, found: str, expected: str, fix: str, code: str = "E_UNREADABLE"
) -> TextRefused:
    file = None if file is None else str(file)
    return TextRefused(Problem(code, message, file, None, found, expected, fix))


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, plural unless the number is 1.

    >>> counted(1, "band"), counted(31, "band")
    ('1 band', '31 bands')
    """
    return f"{number} {noun}" + ("" if number == 1 else "s")


# --- names ------------------------------------------------------------------------------------


def unusable_name(path: str | Path) -> str:
    """Return in words why no file can bear a path; ``""`` where one can. Bytes that are no UTF-8 are allowed.

    >>> unusable_name("a" * 256 + "/b.tif")
    'a part of the name has 256 bytes; at most 255 are possible'
    """
    text = str(path)
    if why := unusable_text(text):
        return why
    data = os.fsencode(text)
    longest = max(map(len, re.split(rb"[/\\]" if os.name == "nt" else b"/", data)))
    if longest > LONGEST_PART:
        return f"a part of the name has {longest} bytes; at most {LONGEST_PART} are possible"
    if len(data) > LONGEST_PATH:
        return f"the name has {len(data)} bytes; at most {LONGEST_PATH} are possible"
    return ""


def unusable_text(text: str) -> str:
    """Return in words why no file can hold a text, or bear it as its name; ``""`` where one can."""
    if "\0" in text:
        return "it holds a null character"
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        return "it holds half of a character (a lone surrogate)"
    return ""


def what_stands_at(path: Path) -> str:
    """Return ``"a file"``, or in words what else a name leads to; nothing is opened.

    >>> what_stands_at(Path("/nowhere/at/all"))
    'no such file'
    """
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "a broken link" if path.is_symlink() else "no such file"
    except (OSError, ValueError) as error:  # a name that is too long, or holds a null byte
        return getattr(error, "strerror", None) or str(error)
    return next((words for is_one, words in KINDS if is_one(mode)), "no plain file")


def check_file(path: Path, expected: str) -> None:
    """Refuse what is no plain file: opening a pipe waits for ever, a device has no end."""
    if (found := what_stands_at(path)) != "a file":
        fix = "Add the file, or correct its name."
        raise _refused(f"{path.name} cannot be read", path, found, expected, fix)


def missing_path(path: Path, what: str = "folder") -> Problem | None:
    """Return the problem of a folder or file that does not exist, with a name beside it that may be meant; None where it does.

    >>> print(missing_path(Path("/nowhere/at/all")))
    this folder does not exist (file: /nowhere/at/all; found: no such folder). Check the path.
    """
    if path.exists():
        return None
    beside: list[str] = []
    with suppress(OSError):
        beside = sorted(one.name for one in islice(path.parent.iterdir(), MOST_BESIDE))
    fix = closest_match(path.name, beside) or "Check the path."
    message = f"this {what} does not exist"
    return Problem("E_UNREADABLE", message, str(path), found=f"no such {what}", fix=fix)


# --- texts ------------------------------------------------------------------------------------


def read_text(path: Path, expected: str, *, most: int = LARGEST_TABLE) -> str:
    """Read a text in UTF-8 of at most `most` bytes; line ends come as they are.

    `expected` is what it should be, for the refusal: ``"a CSV in UTF-8"``. Raises TextRefused, ``E_UNREADABLE``, or
    ``E_SIZE`` where it is too long; no more than `most` bytes are read.
    """
    check_file(path, expected)
    try:
        with path.open("rb") as file:
            return read_stream(file, path.name, expected, file=str(path), most=most)
    except OSError as error:
        found, fix = error.strerror or str(error), "Make it readable, or copy it again."
        raise _refused(f"{path.name} cannot be read", path, found, expected, fix) from error


def read_stream(
    stream: BinaryIO,
    name: str,
    expected: str,
    *,
    file: str | None = None,
    most: int = LARGEST_TABLE,
) -> str:
    """Read a text in UTF-8 from an open file, such as standard input, as `read_text` does."""
    data = stream.read(most + 1)
    if len(data) > most:
        found, fix = f"over {most >> 20} MiB", "Name the correct file, or remove foreign content."
        message = f"{name}: the file is too large"
        raise _refused(message, file, found, f"at most {most >> 20} MiB", fix, "E_SIZE")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found = f"a byte that is not UTF-8 in line {1 + data.count(10, 0, error.start)}"
        fix = "Save it again as text in UTF-8."
        raise _refused(f"{name} cannot be read", file, found, expected, fix) from error


# --- JSON -------------------------------------------------------------------------------------


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object of at most 16 MiB as `parse_json` does; raises TextRefused."""
    text = read_text(path, "a JSON table in UTF-8")
    try:
        record = parse_json(text)
        if not isinstance(record, dict):
            raise ValueError("it is not a table of keys and values")
    except ValueError as error:
        message, expected = (
            f"{path.name} cannot be read",
            "a JSON table, each key once, finite numbers",
        )
        fix = "Write the file again with its original program."
        code = "E_SIZE" if isinstance(error, TooMuch) else "E_UNREADABLE"
        raise _refused(message, path, str(error)[:200], expected, fix, code) from error
    return record


def parse_json(text: str) -> Any:
    """Parse JSON of an unknown origin: without NaN, infinities, halves of characters or a key twice, nested no deeper than `DEEPEST`.

    Raises ValueError.

    >>> parse_json('{"a": 1, "a": 2}')
    Traceback (most recent call last):
    ValueError: the key 'a' occurs twice
    """
    depth = 0
    for number, token in enumerate(_BRACKET.finditer(text)):
        if number == MOST_TOKENS:
            raise TooMuch(f"it holds over {MOST_TOKENS} texts and brackets")
        if (letter := token[0][0]) != '"':
            depth += 1 if letter in "[{" else -1
            if depth > DEEPEST:
                raise TooMuch(f"it is nested over {DEEPEST} levels deep")
    record = json.loads(
        text, object_pairs_hook=_unique, parse_constant=_finite, parse_float=_finite
    )
    # Halves of characters may come as escapes; those of a pair are one.
    if r"\u" in text and re.search("[\ud800-\udfff]", json.dumps(record, ensure_ascii=False)):
        raise ValueError("it holds half of a character (a lone surrogate)")
    return record


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    record: dict[str, Any] = {}
    for name, value in pairs:
        if name in record:
            raise ValueError(f"the key {name!r} occurs twice")
        record[name] = value
    return record


def _finite(text: str) -> float:
    value = float(text)
    if not isfinite(value):
        raise ValueError(f"{text[:40]} is not a finite number")
    return value

"""Problems (code, file, field, found, expected, fix) and the exception that carries them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from itertools import islice
from typing import Any

LONGEST_VALUE, LONGEST_SHOWN = 2000, 240
"""Characters of a value in a message, and in the lines that people read; the rest of a longer one is left out."""
LONGEST_NAME, MOST_COMPARED = 80, 20_000
"""Characters of a name, and pairs of names, whose likeness is looked at, some 10 µs each."""
SCHEMES = "abfss?|az|dav|file|ftp|gcs|gs|hf|https?|s3a?|sftp|ssh|webdav"
"""Beginnings of addresses: no folder of anybody's is called so, with a colon."""
_ADDRESS = re.compile(rf"(?:.*?[/\\])?((?:{SCHEMES}):)[/\\]([^/\\].*)", re.IGNORECASE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong: what, where, what was found and expected, and what to do.

    `code` is a stable upper-case name, `message` one sentence that says what is wrong, `file` and `field` a path and a key, tag
    or header field in it. Without code and message it raises TypeError.

    >>> print(Problem("E_BAND_COUNT", "the bands do not fit", file="nir/", found=31, expected=33))
    the bands do not fit (file: nir/; found: 31; expected: 33)
    """

    code: str
    message: str
    file: str | None = None
    field: str | None = None
    found: Any = None
    expected: Any = None
    fix: str | None = None

    def __post_init__(self) -> None:
        if self.file is not None:
            object.__setattr__(self, "file", _as_written(self.file))

    def __hash__(self) -> int:
        """Problems are reported once each, also those that found a list."""
        return hash((self.code, self.message, self.file, self.field, str(self.found), self.fix))

    def __str__(self) -> str:
        names = ("file", "field", "found", "expected")
        values = {name: value for name in names if (value := getattr(self, name)) is not None}
        parts = "; ".join(f"{name}: {_shortened(str(value))}" for name, value in values.items())
        text = _shortened(self.message) + (f" ({parts})" if parts else "")
        return f"{text}. {self.fix}" if self.fix else text

    @property
    def lines(self) -> tuple[str, ...]:
        """At most three lines for people: what is wrong, where with what was found, and what to do.

        >>> "; ".join(Problem("E_BAND_COUNT", "the bands do not fit", "nir", None, 31, 33, "Look.").lines)
        'E_BAND_COUNT: the bands do not fit;   where: nir: found 31, expected 33;   do: Look.'
        """
        pairs = (("found", self.found), ("expected", self.expected))
        values = (f"{word} {_one_line(value)}" for word, value in pairs if value is not None)
        parts = (", ".join(filter(None, (self.file, self.field))), ", ".join(values))
        where = ": ".join(filter(None, parts))
        lines = [f"{self.code}: {_one_line(self.message, LONGEST_VALUE)}"]
        lines += [f"  where: {where}"] if where else []
        return (*lines, *([f"  do: {_one_line(self.fix, LONGEST_VALUE)}"] if self.fix else []))

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON-ready values; what is unknown is ``None``."""
        plain = (str, int, float, bool, type(None))
        return {k: v if isinstance(v, plain) else str(v) for k, v in asdict(self).items()}


def _as_written(path: str) -> str:
    """Return an address as a person wrote it, of which a path has one slash and perhaps the working folder.

    >>> _as_written("/home/anna/s3:/museum/icons"), _as_written("file:/srv/icons"), _as_written("a/b")
    ('s3://museum/icons', 'file:///srv/icons', 'a/b')
    """
    if (found := _ADDRESS.fullmatch(path)) is None:
        return path
    slashes = "///" if found[1].lower() == "file:" else "//"
    return found[1] + slashes + found[2].replace("\\", "/")


def _shortened(text: str, most: int = LONGEST_VALUE) -> str:
    return text if len(text) <= most else f"{text[:most]} …"


def _one_line(value: Any, most: int = LONGEST_SHOWN) -> str:
    return _shortened(" ".join(str(value).split()), most)


def closest_match(text: str, known: Iterable[str]) -> str | None:
    """Return ``Did you mean 'files'?`` where a known name is near.

    >>> closest_match("fles", ["files", "kind"])
    "Did you mean 'files'?"
    """
    names = [n for n in islice(known, MOST_COMPARED) if len(n) <= LONGEST_NAME]
    near = difflib.get_close_matches(text[:LONGEST_NAME], names, 1, 0.6)
    return f"Did you mean {near[0]!r}?" if near else None


def unknown_name(
    message: str,
    name: str,
    known: Iterable[str],
    *,
    code: str = "E_VALUE",
    file: str | None = None,
    field: str | None = None,
) -> Problem:
    """Return the problem of a name that is none of those known, with the one that may be meant.

    >>> print(unknown_name("there is no camera 'vsi'", "vsi", ["nir", "vis"], field="--camera"))
    there is no camera 'vsi' (field: --camera; found: vsi; expected: nir, vis). Did you mean 'vis'?
    """
    names = list(known)
    return Problem(code, message, file, field, name, ", ".join(names), closest_match(name, names))


def gathered(problems: Iterable[Problem], *, cut: bool = False) -> list[Problem]:
    """Return problems with those of several files that come of one key as one, with their number.

    It names the first file, and has the largest of the numbers that were found; `cut` says that there may be more. Problems
    of files themselves stay apart: each of these has to be mended.

    >>> alike = (Problem("E_BITS", "codes exceed 12 bits", f"{n}.tif", "bits", n) for n in (5000, 9000))
    >>> print(*gathered(alike))
    codes exceed 12 bits, in 2 files (file: 5000.tif; field: bits; found: 9000)
    """
    groups: dict[tuple[str | None, ...], list[Problem]] = {}
    for problem in dict.fromkeys(problems):
        own = None if problem.field else problem.file
        groups.setdefault((problem.code, problem.message, problem.field, own), []).append(problem)
    found = []
    for alike in groups.values():
        numbers = all(isinstance(problem.found, int) for problem in alike)
        one = max(alike, key=lambda p: p.found) if numbers else alike[0]
        if (files := len({problem.file for problem in alike})) > 1:
            message = f"{one.message}, in {files} files{' or more' if cut else ''}"
            one = replace(one, message=message, file=alike[0].file)
        found += [one] if files > 1 else alike
    return found


class Refused(Exception):
    """Refusal of an input, with every reason as a `Problem`; the base of every error of Levkas that a user can correct.

    Most functions raise it, or one of its kinds: `CalibrationRefused`, `RegistrationRefused`, …

    >>> try:
    ...     raise Refused(Problem("E_VALUE", "the scale is out of range", found=3.0, fix="Give 0 to 1."))
    ... except Refused as refused:
    ...     print(refused.problems[0].code, "-", refused)
    E_VALUE - the scale is out of range (found: 3.0). Give 0 to 1.
    """

    def __init__(self, *problems: Problem) -> None:
        self.problems = problems
        super().__init__("\n".join(str(p) for p in problems))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self.problems

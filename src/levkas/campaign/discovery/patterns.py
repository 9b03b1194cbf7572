"""Names of files as patterns: ``raw/d80/{target}/{wavelength}nm_{exposure}ms_*.tif``."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

from levkas.core.problems import Problem, Refused
from levkas.readers.wavelengths import LENGTHS, bare_centre

_NUMERALS = re.compile("([0-9]+)")


FIELDS = (
    "target", "object", "setup", "band", "wavelength", "exposure", "shot", "sensor", "tile", "row",
    "column",
)  # fmt: skip
SECONDS = {
    "min": 60.0,
    "s": 1.0,
    "sec": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "µs": 1e-6,
    "μs": 1e-6,
    "ns": 1e-9,
}
"""Units that may follow ``{exposure}``; seconds where none of them does."""

_PIECE = re.compile(r"(\{[^{}]*\}|\*\*|\*)")
_NUMBER = r"(?<!\d)(?<!\d\.)\d+(?:\.\d+)?(?!\d)"  # never the tail of a longer number
_BODY = {
    "target": r"[^/]+",  # as much as it can: the rest of a pattern bounds it
    "object": r"[^/]+",
    "setup": r"[^/]+?",
    "band": r"[^/]+?",
    "sensor": r"[^/]+?",
    "shot": r"[^/]*?",
    "tile": r"[^/]+?",
    "row": r"(?<!\d)\d+(?!\d)",
    "column": r"(?<!\d)\d+(?!\d)",
    "wavelength": _NUMBER,
    "exposure": _NUMBER,
}
LONGEST = 4096
"""Letters of a path, as file systems have it."""
MOST_FREE, TAME, LONG = 5, 3, 80
"""Stars and placeholders that share the name of a folder or file; so many that may share a name of more than so many letters:
of 80 letters that are all separators, five have 24 million readings, of 255 three have 3 million, half a second of the processor."""
MOST_FOLDERS = 2
"""``**`` of one pattern."""


class Known(tuple[tuple[str, tuple[str, ...]], ...]):
    """Values by placeholder, hashed once: a name of thousands is a key to what was made of it."""

    @cached_property
    def _hash(self) -> int:
        return tuple.__hash__(self)

    def __hash__(self) -> int:
        return self._hash


NOTHING_KNOWN = Known()


@dataclass(frozen=True)
class Pattern:
    """One pattern, taken apart.

    Parameters
    ----------
    text : str
        As it was declared.
    segments : tuple of str
        Its parts between slashes.
    fields : frozenset of str
        Names of its placeholders.
    """

    text: str
    segments: tuple[str, ...]
    fields: frozenset[str]

    @classmethod
    def parse(cls, text: str) -> Pattern:
        """Check a pattern and take it apart.

        Raises
        ------
        ValueError
            For an unknown placeholder, a brace without its pair, or ``**`` inside a name.

        Examples
        --------
        >>> sorted(Pattern.parse("raw/{target}/{wavelength}nm*.tif").fields)
        ['target', 'wavelength']
        """
        if len(text) > LONGEST:
            raise ValueError(
                f"the pattern is longer than {LONGEST} characters, the limit of a path"
            )
        path = text.replace("\\", "/")
        segments = tuple(s for s in path.split("/") if s not in ("", "."))
        segments = tuple(
            s for i, s in enumerate(segments) if s != "**" or segments[i - 1 : i] != (s,)
        )
        if not segments or path.endswith("/"):
            raise ValueError("the pattern names a folder, not a file")
        fields = set()
        for segment in segments:
            for piece in _PIECE.split(segment):
                if piece.startswith("{") and piece[1:-1] in FIELDS:
                    fields.add(piece[1:-1])
                elif piece.startswith("{") and piece.endswith("}"):
                    known = ", ".join(f"{{{name}}}" for name in FIELDS)
                    raise ValueError(f"unknown placeholder {piece}; known are {known}")
                elif "{" in piece or "}" in piece:
                    raise ValueError("a brace is not closed")
            if "**" in segment and segment != "**":
                raise ValueError("** matches whole folders only: raw/**/{target}.tif")
        if max(map(_free, segments)) > MOST_FREE or segments.count("**") > MOST_FOLDERS:
            raise ValueError(
                f"more than {MOST_FREE} stars and placeholders share a name, or more than {MOST_FOLDERS} ** the path: "
                "write the characters between them"
            )
        if segments[-1] == "**":
            raise ValueError("the pattern ends in **, which matches folders only")
        return cls(
            ("/" if path.startswith("/") else "") + "/".join(segments), segments, frozenset(fields)
        )

    @property
    def absolute(self) -> bool:
        """Whether it starts at the root of the file system."""
        return self.text.startswith("/")

    def with_value(self, field: str, value: str) -> Pattern:
        """Return the pattern with one placeholder filled in."""
        return Pattern.parse(self.text.replace(f"{{{field}}}", value))

    def fits_segment(self, index: int, name: str) -> bool:
        """Whether a file's or folder's name fits one segment of the pattern."""
        last = index == len(self.segments) - 1
        return _match(self.segments[index], NOTHING_KNOWN, last, name, named=False) is not None

    def read(
        self, path: str, known: Mapping[str, Collection[str]] | tuple[Known, ...] | None = None
    ) -> dict[str, Any] | None:
        """Return the values of the fields in a path; None where it does not fit.

        Parameters
        ----------
        path : str
            Relative as the pattern is, with ``/``.
        known : dict of field to values, optional
            Preferred where a name could be read in several ways; else {target} is the longest. For many
            names, as `ways_to_read` gives it.

        Examples
        --------
        >>> Pattern.parse("{target}_{exposure}ms.tif").read("icon_1_250ms.TIF")
        {'target': 'icon_1', 'exposure_s': 0.25}
        >>> Pattern.parse("{target}_{row}_{column}.tif").read("icon_1_02_3.tif")
        {'target': 'icon_1', 'tile': 'r2c3'}
        """
        text = "/".join(self.segments)
        for knowledge in known if isinstance(known, tuple) else ways_to_read(known or {}):
            found = _match(text, knowledge, True, path, named=True)
            if found is not None:
                return self._values(found)
        return None

    def _values(self, texts: dict[str, str]) -> dict[str, Any]:
        values: dict[str, Any] = dict(texts)
        if "wavelength" in values:
            values["wavelength"] = _nanometres(values["wavelength"], self.text)
        if "exposure" in values:
            seconds = float(values.pop("exposure")) * SECONDS[exposure_unit(self.text)]
            values["exposure_s"] = float(f"{seconds:.12g}")
        if "row" in values or "column" in values:
            values["tile"] = _place_in_grid(values.pop("row", None), values.pop("column", None))
        return values


def _place_in_grid(row: str | None, column: str | None) -> str:
    """Return the name of a tile by its place.

    >>> _place_in_grid("02", "3"), _place_in_grid(None, "11")
    ('r2c3', 'c11')
    """
    return "".join(f"{axis}{int(n)}" for axis, n in (("r", row), ("c", column)) if n is not None)


@lru_cache(maxsize=4096)
def _nanometres(number: str, pattern: str) -> float:
    """Return a wavelength in a name, nm: in the unit behind ``{wavelength}``, else by what is plausible.

    >>> _nanometres("0.55", "{wavelength}um.tif"), _nanometres("0.55", "w{wavelength}.tif"), _nanometres("0.55", "{wavelength}nm.tif")
    (550.0, 550.0, 0.55)
    """
    found = re.search(r"\{wavelength\}([^\W\d_]*)", pattern)
    unit = found.group(1).lower() if found else ""
    if unit in ("nm", "um", "µm", "μm"):
        return round(float(number) * LENGTHS[unit], 6)
    return bare_centre(number) or float(number)


def exposure_unit(pattern: str) -> str:
    """Return the unit behind ``{exposure}``: ``"s"`` where the letters there are none.

    >>> exposure_unit("{target}_{exposure}ms_*.tif"), exposure_unit("{exposure}_ms.tif")
    ('ms', 's')
    """
    found = re.search(r"\{exposure\}([^\W\d_]*)", pattern)
    unit = found.group(1).lower() if found else ""
    return unit if unit in SECONDS else "s"


@lru_cache(maxsize=1 << 16)
def natural(text: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key that puts 9 before 10.

    >>> sorted(["b10", "b9", "a"], key=natural)
    ['a', 'b9', 'b10']
    """
    parts = _NUMERALS.split(text)
    return tuple((0, int(p), p) if i % 2 else (1, 0, p) for i, p in enumerate(parts) if p)


def ways_to_read(known: Mapping[str, Collection[str]]) -> tuple[Known, ...]:
    """Return what names are read with: everything known, then all but the object, then neither it nor the target."""
    found = Known((name, tuple(sorted(values))) for name, values in sorted(known.items()) if values)
    but_object = Known(item for item in found if item[0] != "object")
    but_target = Known(item for item in but_object if item[0] != "target")
    return tuple(dict.fromkeys((found, but_object, but_target, NOTHING_KNOWN)))


def _match(text: str, known: Known, ends: bool, name: str, *, named: bool) -> dict[str, str] | None:
    """Return the values of the placeholders in a name; None where it does not fit."""
    longest = max(map(len, name.split("/"))) if len(name) > LONG else 0
    if longest > LONG and max(map(_free, text.split("/"))) > TAME:
        raise Refused(
            Problem(
                "E_VALUE",
                "a long file name matches the pattern in too many ways",
                field="files",
                found=name[:LONG],
                expected=f"a pattern with up to {TAME} stars and placeholders a name",
                fix="Write characters between the placeholders of `files`.",
            )
        )
    found = _compiled(text, known, named, ends).fullmatch(name)
    return found.groupdict() if found else None


@lru_cache(maxsize=4096)
def _free(text: str) -> int:
    """Count what shares a name with something else and may end in more than one place; no numbers."""
    shared = [s for s in text.split("/") if not re.fullmatch(r"\{[^{}]*\}", s)]
    numbers = r"\{(?:wavelength|exposure|row|column)\}"
    return sum(len(re.findall(r"\*\*|\*|\{", re.sub(numbers, "", s))) for s in shared)


def _split(text: str) -> list[str]:
    """Return stars, placeholders and the text between; ``\0`` for any number of folders."""
    pieces = [p for p in _PIECE.split(text) if p]
    if "**" not in pieces:
        return pieces
    return [p for p in re.split(r"(\{[^{}]*\}|\0|\*)", text.replace("**/", "\0")) if p]


@lru_cache(maxsize=4096)
def _compiled(text: str, known: Known, named: bool, ends: bool) -> re.Pattern[str]:
    """Compile a pattern, or one segment of it; upper and lower case differ but in the suffix."""
    values, pieces = dict(known), _split(text)
    out: list[str] = []
    used: set[str] = set()
    for i, piece in enumerate(pieces):
        if piece == "\0":
            out.append(r"(?:[^/]+/)*")
        elif piece == "*":
            out.append(r"[^/]*")
        elif not piece.startswith("{"):
            out.append(_literal(piece, ends and i == len(pieces) - 1))
        else:
            name = piece[1:-1]
            body = _BODY[name]
            if name in values:
                body = _alternatives(values[name], pieces[i - 1 : i], pieces[i + 1 : i + 2])
            if not named:
                out.append(f"(?:{body})")
            else:
                out.append(f"(?P={name})" if name in used else f"(?P<{name}>{body})")
                used.add(name)
    return re.compile("".join(out))


def _literal(text: str, last: bool) -> str:
    stem, dot, suffix = text.rpartition(".") if last else (text, "", "")
    return re.escape(stem) + (f"(?i:{re.escape(dot + suffix)})" if dot else "")


def _alternatives(values: tuple[str, ...], before: list[str], after: list[str]) -> str:
    """Return an expression for known values, longest first; beside a wildcard ``icon1`` is no part of ``icon10``."""
    body = "|".join(re.escape(v) for v in sorted(values, key=lambda v: (-len(v), v)))
    start = r"(?<![^\W_])" if _beside(before) else ""
    stop = r"(?![^\W_])" if _beside(after) else ""
    return f"{start}(?:{body}){stop}"


def _beside(pieces: list[str]) -> bool:
    """Whether the piece beside a placeholder is free itself."""
    return bool(pieces) and pieces[0][0] in "{*"

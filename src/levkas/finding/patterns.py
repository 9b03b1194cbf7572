"""Names of files as patterns: ``raw/d80/{target}/{wavelength}nm_{exposure}ms_*.tif``."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

FIELDS = ("target", "setup", "band", "wavelength", "exposure", "shot", "sensor")
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
    "target": r"[^/]+",  # as much as it can: the rest of a pattern says what is not its
    "setup": r"[^/]+?",
    "band": r"[^/]+?",
    "sensor": r"[^/]+?",
    "shot": r"[^/]*?",
    "wavelength": _NUMBER,
    "exposure": _NUMBER,
}
Known = tuple[tuple[str, tuple[str, ...]], ...]


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
        path = text.replace("\\", "/")
        segments = tuple(s for s in path.split("/") if s not in ("", "."))
        if not segments or path.endswith("/"):
            raise ValueError("the pattern ends in a folder, not in a file")
        fields = set()
        for segment in segments:
            for piece in _PIECE.split(segment):
                if piece.startswith("{") and piece[1:-1] in FIELDS:
                    fields.add(piece[1:-1])
                elif piece.startswith("{") and piece.endswith("}"):
                    known = ", ".join(f"{{{name}}}" for name in FIELDS)
                    raise ValueError(f"unknown placeholder {piece}; known are {known}")
                elif "{" in piece or "}" in piece:
                    raise ValueError("a brace has no pair")
            if "**" in segment and segment != "**":
                raise ValueError("** stands for whole folders: raw/**/{target}.tif")
        if segments[-1] == "**":
            raise ValueError("the pattern ends in **, which stands for folders")
        return cls(
            ("/" if path.startswith("/") else "") + "/".join(segments), segments, frozenset(fields)
        )

    @property
    def absolute(self) -> bool:
        """Whether it starts at the root of the file system."""
        return self.text.startswith("/")

    def given(self, field: str, value: str) -> Pattern:
        """Return the pattern with one placeholder filled in."""
        return Pattern.parse(self.text.replace(f"{{{field}}}", value))

    def fits_segment(self, index: int, name: str) -> bool:
        """Whether a file's or folder's name could stand at one place between slashes."""
        last = index == len(self.segments) - 1
        return _compiled(self.segments[index], (), False, last).fullmatch(name) is not None

    def read(
        self, path: str, known: Mapping[str, Collection[str]] | None = None
    ) -> dict[str, Any] | None:
        """Return what a path says, by field; None where it does not fit.

        Parameters
        ----------
        path : str
            Relative as the pattern is, with ``/``.
        known : dict of field to values, optional
            Preferred where a name could be read in several ways; else {target} is the longest.

        Examples
        --------
        >>> Pattern.parse("{target}_{exposure}ms.tif").read("icon_1_250ms.TIF")
        {'target': 'icon_1', 'exposure_s': 0.25}
        """
        text = "/".join(self.segments)
        for knowledge in _steps(known or {}):
            found = _compiled(text, knowledge, True, True).fullmatch(path)
            if found:
                return self._values(found.groupdict())
        return None

    def _values(self, texts: dict[str, str]) -> dict[str, Any]:
        values: dict[str, Any] = dict(texts)
        if "wavelength" in values:
            values["wavelength"] = float(values["wavelength"])
        if "exposure" in values:
            seconds = float(values.pop("exposure")) * SECONDS[exposure_unit(self.text)]
            values["exposure_s"] = float(f"{seconds:.12g}")
        return values


def exposure_unit(pattern: str) -> str:
    """Return the unit behind ``{exposure}``: ``"s"`` where the letters there are none.

    >>> exposure_unit("{target}_{exposure}ms_*.tif"), exposure_unit("{exposure}_ms.tif")
    ('ms', 's')
    """
    found = re.search(r"\{exposure\}([^\W\d_]*)", pattern)
    unit = found.group(1).lower() if found else ""
    return unit if unit in SECONDS else "s"


def natural(text: str) -> list[tuple[int, int, str]]:
    """Sort key that puts 9 before 10.

    >>> sorted(["b10", "b9", "a"], key=natural)
    ['a', 'b9', 'b10']
    """
    parts = re.split(r"([0-9]+)", text)
    return [(0, int(p), p) if i % 2 else (1, 0, p) for i, p in enumerate(parts) if p]


def _steps(known: Mapping[str, Collection[str]]) -> Iterator[Known]:
    """Everything known, then all but the target, then nothing."""
    told = tuple((name, tuple(sorted(values))) for name, values in sorted(known.items()) if values)
    but_target = tuple(item for item in told if item[0] != "target")
    yield from dict.fromkeys((told, but_target, ()))


@lru_cache(maxsize=4096)
def _compiled(text: str, known: Known, named: bool, ends: bool) -> re.Pattern[str]:
    """Compile a pattern, or one segment of it; upper and lower case differ but in the suffix."""
    values, pieces = dict(known), [p for p in _PIECE.split(text) if p]
    if "**" in pieces:  # any number of folders, none included
        text = text.replace("**/", "\0")
        pieces = [p for p in re.split(r"(\{[^{}]*\}|\0|\*)", text) if p]
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
    """Known values, longest first; beside a wildcard ``icon1`` is no part of ``icon10``."""
    body = "|".join(re.escape(v) for v in sorted(values, key=lambda v: (-len(v), v)))
    start = r"(?<![^\W_])" if before and before[0][0] in "{*" else ""
    stop = r"(?![^\W_])" if after and after[0][0] in "{*" else ""
    return f"{start}(?:{body}){stop}"

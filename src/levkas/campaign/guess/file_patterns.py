"""Patterns of a camera's files: the meaning of the numbers in their names."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from levkas.campaign.discovery.patterns import natural
from levkas.campaign.guess.names import NamedFile
from levkas.campaign.guess.words import BANDS, Token

FEWEST_BANDS = 3
RANGE_NM = (300.0, 2600.0)
FIELDS = ("sensor", "band", "wavelength", "exposure", "shot")
LITERAL, COUNT, ANY = "", "?", "any"
"""Parts of names that are no field: written out; a count, of shots or of nothing; ``*``."""


@dataclass(frozen=True)
class FilePatterns:
    """Patterns of one camera, and what the names say by them.

    Parameters
    ----------
    patterns : tuple of str
    sensors : dict
        Value of ``{sensor}`` → its frames; empty for a camera of one sensor.
    wavelengths : tuple of float
        nm, ascending, from the names; empty where they have none.
    bands : tuple of str
        Values of ``{band}``.
    shots : bool
        Whether there is a ``{shot}``.
    reasons : tuple of str
        Why the parts of the patterns are what they are.
    """

    patterns: tuple[str, ...]
    sensors: dict[str, list[NamedFile]]
    wavelengths: tuple[float, ...] = ()
    bands: tuple[str, ...] = ()
    shots: bool = False
    reasons: tuple[str, ...] = ()

    def of_kind(self, kind: str) -> tuple[str, ...]:
        """Return the patterns with the fields that a camera of some kind has; others become ``*``."""
        fields = {"bands": "sensor", "sensors": "wavelength|band"}.get(
            kind, "sensor|wavelength|band"
        )
        texts = (re.sub(rf"\{{({fields})\}}", "*", text) for text in self.patterns)
        return tuple(dict.fromkeys(re.sub(r"\*{2,}", "*", text) for text in texts))

    def sensor_of(self) -> dict[Path, str]:
        """Return the value of ``{sensor}`` of each file that has one."""
        return {f.path: name for name, frames in self.sensors.items() for f in frames}


def find_patterns(frames: Sequence[NamedFile]) -> FilePatterns:
    """Find the patterns that the files of one camera under one lighting fit."""
    skeletons: dict[object, list[NamedFile]] = defaultdict(list)
    for frame in frames:
        key = tuple(tuple((_literal(t), t.kind) for t in s) for s in frame.segments)
        skeletons[key, frame.path.suffix.lower()].append(frame)
    made = [_Columns(group) for group in skeletons.values()]
    sensors: dict[str, list[NamedFile]] = defaultdict(list)
    bands: set[str] = set()
    centres: set[float] = set()
    for one in made:
        for frame, values in zip(one.frames, one.values(), strict=True):
            if "sensor" in values:
                sensors[values["sensor"]].append(frame)
            if frame.role == "object":
                bands |= {values["band"]} if "band" in values else set()
                centres |= {float(values["wavelength"])} if "wavelength" in values else set()
    return FilePatterns(
        patterns=_merged(made),
        sensors=dict(sorted(sensors.items())) if len(sensors) > 1 else {},
        wavelengths=tuple(sorted(centres)),
        bands=tuple(sorted(bands)),
        shots=any("{shot}" in one.text for one in made),
        reasons=tuple(dict.fromkeys(reason for one in made for reason in one.reasons)),
    )


def _literal(token: Token) -> str:
    if token.kind == "numbered":
        return token.before
    return token.text if token.kind in ("word", "target") else ""


class _Columns:
    """Files whose names differ in numbers only: a column for each part of their names, and its field."""

    def __init__(self, frames: list[NamedFile]) -> None:
        self.frames = frames
        self.roles = {frame.role for frame in frames}
        self.reasons: list[str] = []
        self.segments = frames[0].segments
        places = [(i, j) for i, s in enumerate(self.segments) for j in range(len(s))]
        self.columns = {(i, j): [f.segments[i][j] for f in frames] for i, j in places}
        self.fields: dict[tuple[int, int], str] = {}
        for place, tokens in self.columns.items():
            self.fields[place], reason = _field(tokens, frames)
            self.reasons += [reason] if reason else []
        self._assign_counts([place for place in places if self.fields[place] == COUNT])

    def _assign_counts(self, places: Sequence[tuple[int, int]]) -> None:
        """Make the last count that sets frames of one target and band apart the shot, the others ``*``."""
        groups: dict[object, list[int]] = defaultdict(list)
        typed = [p for p, f in self.fields.items() if f in FIELDS and f != "shot"]
        for n, frame in enumerate(self.frames):
            groups[frame.target, tuple(self.columns[p][n].text for p in typed)].append(n)
        self.fields |= dict.fromkeys(places, ANY)
        if "object" not in self.roles:
            return  # darks and whites are averaged, whatever their number counts
        for place in reversed(places):
            column = self.columns[place]
            if any(len({column[n].text for n in group}) > 1 for group in groups.values()):
                self.fields[place] = "shot"
                texts = sorted({t.text for t in column}, key=natural)
                self.reasons.append(f"{{shot}} counts {texts[0]} … {texts[-1]}")
                return

    @property
    def text(self) -> str:
        """The pattern."""
        folders = [
            "".join(
                re.sub(r"[{}*]+", "*", token.gap) + self._pattern_of((i, j))
                for j, token in enumerate(segment)
            )
            for i, segment in enumerate(self.segments)
        ]
        return re.sub(r"\*{2,}", "*", "/".join(folders)) + self.frames[0].path.suffix

    def _pattern_of(self, place: tuple[int, int]) -> str:
        field, tokens = self.fields[place], self.columns[place]
        first = tokens[0]
        if field == LITERAL:
            return re.sub(r"[{}*]+", "*", first.text)
        if field == ANY:
            return "*"
        if field in ("wavelength", "exposure"):
            return f"{first.before}{{{field}}}{first.after}"
        if field == "shot" and len({t.before for t in tokens}) == 1:
            return f"{first.before}{{shot}}"
        return f"{{{field}}}"

    def values(self) -> list[dict[str, str]]:
        """Return the values of the fields, frame by frame."""
        places = {p: field for p, field in self.fields.items() if field in FIELDS}
        return [
            {field: _value(self.columns[p][n], field) for p, field in places.items()}
            for n in range(len(self.frames))
        ]


def _value(token: Token, field: str) -> str:
    return token.number if field in ("wavelength", "exposure") else token.text


def _field(tokens: Sequence[Token], frames: Sequence[NamedFile]) -> tuple[str, str]:
    """Return the field of one part of the names, `LITERAL` or `COUNT`, and the reason."""
    kind, texts = tokens[0].kind, [t.text for t in tokens]
    varies = len(set(texts)) > 1
    if kind == "target":
        return "target", ""
    if kind in ("wavelength", "exposure"):
        return (COUNT if len({(t.before, t.after) for t in tokens}) > 1 else kind), ""
    if kind == "number" and not varies and _is_constant_count(tokens[0], frames):
        return ("shot" if any(f.role == "object" for f in frames) else ANY), ""
    if kind not in ("number", "numbered", "time") or not varies:
        return LITERAL, ""
    if tokens[0].names_sensor:
        return "sensor", f"{{sensor}}: {tokens[0].before!r} and a number"
    if _headers_differ(texts, frames):
        return "sensor", "{sensor}: the headers give each number its own wavelength"
    banded = kind == "numbered" and tokens[0].before.lower() in BANDS
    if banded and len(set(texts)) >= FEWEST_BANDS:
        return "band", f"{{band}}: {tokens[0].before!r} and a number, the same for every target"
    if kind == "number" and _are_wavelengths(texts, frames):
        return "wavelength", "{wavelength}: numbers in equal steps, the same for every target"
    return COUNT, ""


def _is_constant_count(token: Token, frames: Sequence[NamedFile]) -> bool:
    """Whether a number that is the same everywhere counts all the same: ``_00`` at the end of a name."""
    last = all(f.stem[-1] == token for f in frames)
    return last and len(token.number) > 1 and int(token.number) < 2 and bool(token.gap)


def _headers_differ(texts: Sequence[str], frames: Sequence[NamedFile]) -> bool:
    """Whether headers give each value bands of its own."""
    bands: dict[str, set[object]] = defaultdict(set)
    for text, frame in zip(texts, frames, strict=True):
        bands[text].add(frame.facts.wavelengths or frame.facts.band_names)
    values = [next(iter(v)) for v in bands.values() if len(v) == 1]
    return len(values) == len(bands) == len(set(values)) and None not in values


def _are_wavelengths(texts: Sequence[str], frames: Sequence[NamedFile]) -> bool:
    """Whether numbers are like 400, 420, 440: in range, evenly spaced, the same set for every target."""
    numbers = sorted({float(t) for t in texts})
    if len(numbers) < FEWEST_BANDS or not RANGE_NM[0] <= numbers[0] <= numbers[-1] <= RANGE_NM[1]:
        return False
    steps = {round(b - a, 6) for a, b in pairwise(numbers)}
    by_target: dict[str, set[float]] = defaultdict(set)
    for text, frame in zip(texts, frames, strict=True):
        by_target[frame.target].add(float(text))
    same = all(values == set(numbers) for values in by_target.values())
    return min(steps) >= 2 and len(steps) == 1 and same


def _merged(made: Sequence[_Columns]) -> tuple[str, ...]:
    """Return the patterns, objects' first; templates that only have a number more share theirs by a ``*``."""
    texts = [(one, one.text) for one in made]
    texts.sort(key=lambda pair: ("object" not in pair[0].roles, pair[1]))
    roles: dict[str, set[str]] = defaultdict(set)
    for one, text in texts:
        roles[text] |= one.roles
    merged = list(roles)
    for short in list(merged):
        stem, dot, suffix = short.rpartition(".")
        more = re.compile(re.escape(stem) + r"[-_ .]*(\{shot\}|\*|\d+)" + re.escape(dot + suffix))
        longer = {
            t for t in merged if t != short and more.fullmatch(t) and "object" not in roles[t]
        }
        if longer and short in merged:
            merged[merged.index(short)] = f"{stem}*{dot}{suffix}"
            merged = [t for t in merged if t not in longer]
    return tuple(merged)

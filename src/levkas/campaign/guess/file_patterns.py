"""Patterns of a camera's files: what the numbers in their names count."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from levkas.campaign.discovery.patterns import natural
from levkas.campaign.guess.groups import Frame
from levkas.campaign.guess.names import BANDS, SENSORS, Token

FEWEST_BANDS = 3
RANGE_NM = (300.0, 2600.0)


@dataclass(frozen=True)
class Files:
    """Patterns of one camera, and what was found out by them.

    Parameters
    ----------
    patterns : tuple of str
    sensors : dict
        Value of ``{sensor}`` → its frames; empty for a camera of one sensor.
    wavelengths : tuple of float
        nm, ascending, from the names; empty where they do not say any.
    bands : tuple of str
        Values of ``{band}``.
    shots : bool
        Whether there is a ``{shot}``.
    reasons : tuple of str
        Why the parts of the patterns are what they are.
    """

    patterns: tuple[str, ...]
    sensors: dict[str, list[Frame]]
    wavelengths: tuple[float, ...] = ()
    bands: tuple[str, ...] = ()
    shots: bool = False
    reasons: tuple[str, ...] = ()

    def spelt(self, kind: str) -> tuple[str, ...]:
        """Return the patterns with the fields that a camera of some kind has; others become ``*``."""
        fields = {"bands": "sensor", "sensors": "wavelength|band"}.get(
            kind, "sensor|wavelength|band"
        )
        spelt = (re.sub(rf"\{{({fields})\}}", "*", text) for text in self.patterns)
        return tuple(dict.fromkeys(re.sub(r"\*{2,}", "*", text) for text in spelt))

    def sensor_of(self) -> dict[Path, str]:
        """Return the value of ``{sensor}`` of each file that has one."""
        return {f.named.seen.path: name for name, frames in self.sensors.items() for f in frames}


def find_patterns(frames: Sequence[Frame]) -> Files:
    """Find the patterns that the files of one camera fit.

    Parameters
    ----------
    frames : sequence of Frame
        Of one camera under one lighting.
    """
    skeletons: dict[object, list[Frame]] = defaultdict(list)
    for frame in frames:
        key = tuple(tuple((_literal(t), t.kind) for t in s) for s in frame.segments)
        skeletons[key, frame.named.seen.path.suffix.lower()].append(frame)
    made = [_pattern(group) for group in skeletons.values()]
    sensors: dict[str, list[Frame]] = defaultdict(list)
    bands: set[str] = set()
    centres: set[float] = set()
    for one in made:
        for frame, told in one.values:
            if "sensor" in told:
                sensors[told["sensor"]].append(frame)
            if "band" in told and frame.role == "object":
                bands.add(told["band"])
            if "wavelength" in told and frame.role == "object":
                centres.add(float(told["wavelength"]))
    return Files(
        patterns=_merged(made),
        sensors=dict(sorted(sensors.items())) if len(sensors) > 1 else {},
        wavelengths=tuple(sorted(centres)),
        bands=tuple(sorted(bands)),
        shots=any("{shot}" in one.text for one in made),
        reasons=tuple(dict.fromkeys(reason for one in made for reason in one.reasons)),
    )


@dataclass(frozen=True)
class _Made:
    """One pattern with the frames that fit it, and what each frame's name says."""

    text: str
    values: list[tuple[Frame, dict[str, str]]]
    reasons: list[str]

    @property
    def roles(self) -> set[str]:
        return {frame.role for frame, _ in self.values}


def _literal(token: Token) -> str:
    if token.kind == "numbered":
        return token.before
    return token.text if token.kind in ("word", "target") else ""


def _pattern(frames: list[Frame]) -> _Made:
    """Make the pattern of files whose names differ in numbers only."""
    first = frames[0]
    places = [(i, j) for i, s in enumerate(first.segments) for j in range(len(s))]
    columns = {p: [f.segments[p[0]][p[1]] for f in frames] for p in places}
    fields: dict[tuple[int, int], str] = {}
    reasons: list[str] = []
    for place, tokens in columns.items():
        fields[place], reason = _field(tokens, frames)
        reasons += [reason] if reason else []
    for place in [p for p in places if fields[p] == "count"]:
        fields[place] = "shot" if any(f.role == "object" for f in frames) else "any"
    open_places = [p for p in places if fields[p] == "?"]
    for place, field in zip(open_places, _shots(open_places, columns, fields, frames), strict=True):
        fields[place] = field
        if field == "shot":
            some = sorted({t.text for t in columns[place]}, key=natural)
            reasons.append(f"{{shot}} counts {some[0]} … {some[-1]}")
    text = "/".join(
        "".join(
            re.sub(r"[{}*]+", "*", first.segments[i][j].gap) + _spelt(columns[i, j], fields[i, j])
            for j in range(len(first.segments[i]))
        )
        for i in range(len(first.segments))
    )
    values = [
        (
            frame,
            {
                fields[p]: _value(columns[p][n], fields[p])
                for p in places
                if fields[p] in ("sensor", "band", "wavelength", "exposure", "shot")
            },
        )
        for n, frame in enumerate(frames)
    ]
    return _Made(re.sub(r"\*{2,}", "*", text) + first.named.seen.path.suffix, values, reasons)


def _field(tokens: Sequence[Token], frames: Sequence[Frame]) -> tuple[str, str]:
    """What one part of the names means: a field, "" for what is written out, "?" for a count."""
    kind, texts = tokens[0].kind, [t.text for t in tokens]
    varies = len(set(texts)) > 1
    if kind == "target":
        return "target", ""
    if kind in ("wavelength", "exposure"):
        if len({(t.before, t.after) for t in tokens}) > 1:
            return "?", ""
        return kind, ""
    if kind == "number" and not varies and _is_count(tokens[0], frames):
        return "count", ""
    if kind not in ("number", "numbered", "time") or not varies:
        return "", ""
    prefix = tokens[0].before.lower()
    if kind == "numbered" and prefix in SENSORS:
        return "sensor", f"{{sensor}}: {tokens[0].before!r} and a number"
    if _headers_tell(texts, frames):
        return "sensor", "{sensor}: the headers give each number its own wavelength"
    if kind == "numbered" and prefix in BANDS and len(set(texts)) >= FEWEST_BANDS:
        return "band", f"{{band}}: {tokens[0].before!r} and a number, the same for every target"
    if kind == "number" and _are_wavelengths(texts, frames):
        return "wavelength", "{wavelength}: numbers in equal steps, the same for every target"
    return "?", ""


def _is_count(token: Token, frames: Sequence[Frame]) -> bool:
    """Whether a number that is the same everywhere counts all the same: ``_00`` at the end of a name."""
    last = all(f.segments[-1][-1] == token for f in frames)
    return last and len(token.number) > 1 and int(token.number) < 2 and bool(token.gap)


def _headers_tell(texts: Sequence[str], frames: Sequence[Frame]) -> bool:
    told: dict[str, set[object]] = defaultdict(set)
    for text, frame in zip(texts, frames, strict=True):
        facts = frame.named.seen.facts
        told[text].add(facts.wavelengths or facts.band_names)
    values = [next(iter(v)) for v in told.values() if len(v) == 1]
    return len(values) == len(told) == len(set(values)) and None not in values


def _are_wavelengths(texts: Sequence[str], frames: Sequence[Frame]) -> bool:
    """Numbers like 400, 420, 440: in range, evenly spaced, and the same set for every object."""
    numbers = sorted({float(t) for t in texts})
    if len(numbers) < FEWEST_BANDS or not RANGE_NM[0] <= numbers[0] <= numbers[-1] <= RANGE_NM[1]:
        return False
    steps = {round(b - a, 6) for a, b in pairwise(numbers)}
    by_target: dict[str, set[float]] = defaultdict(set)
    for text, frame in zip(texts, frames, strict=True):
        by_target[frame.target].add(float(text))
    every = set(numbers)
    same = all(values == every for values in by_target.values())
    return min(steps) >= 2 and len(steps) == 1 and same


def _shots(
    places: Sequence[tuple[int, int]],
    columns: dict[tuple[int, int], list[Token]],
    fields: dict[tuple[int, int], str],
    frames: Sequence[Frame],
) -> list[str]:
    """Of the counts the last that tells frames of one target and band apart is the shot, the others ``*``."""
    groups: dict[object, list[int]] = defaultdict(list)
    for n, frame in enumerate(frames):
        told = tuple(
            columns[p][n].text
            for p, field in fields.items()
            if field not in ("?", "target", "shot", "")
        )
        groups[frame.target, told].append(n)
    chosen = ["any"] * len(places)
    if not any(frame.role == "object" for frame in frames):
        return chosen  # darks and whites are averaged, whatever their number counts
    for k in reversed(range(len(places))):
        if any(len({columns[places[k]][n].text for n in g}) > 1 for g in groups.values()):
            chosen[k] = "shot"
            break
    return chosen


def _spelt(tokens: Sequence[Token], field: str) -> str:
    first = tokens[0]
    if field == "":
        return re.sub(r"[{}*]+", "*", first.text)
    if field == "any":
        return "*"
    if field in ("wavelength", "exposure"):
        return f"{first.before}{{{field}}}{first.after}"
    if field == "shot" and len({t.before for t in tokens}) == 1:
        return f"{first.before}{{shot}}"
    return f"{{{field}}}"


def _value(token: Token, field: str) -> str:
    return token.number if field in ("wavelength", "exposure") else token.text


def _merged(made: Sequence[_Made]) -> tuple[str, ...]:
    """Patterns, objects' first; templates that only have a number more share theirs by a ``*``."""
    order = sorted(made, key=lambda m: ("object" not in m.roles, m.text))
    texts = list(dict.fromkeys(m.text for m in order))
    roles: dict[str, set[str]] = defaultdict(set)
    for one in made:
        roles[one.text] |= one.roles
    for short in list(texts):
        stem, dot, suffix = short.rpartition(".")
        longer = [
            t
            for t in texts
            if t != short
            and t.endswith(dot + suffix)
            and re.fullmatch(
                re.escape(stem) + r"[-_ .]*(\{shot\}|\*|\d+)", t.removesuffix(dot + suffix)
            )
            and "object" not in roles[t]
        ]
        if longer and short in texts:
            texts[texts.index(short)] = f"{stem}*{dot}{suffix}"
            texts = [t for t in texts if t not in longer]
    return tuple(texts)

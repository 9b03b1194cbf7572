"""Group captures by camera and by lighting, and find the patterns that their names follow."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from levkas.campaign.camera_kinds import fields_of_others
from levkas.campaign.discovery.patterns import natural
from levkas.campaign.guess.names import NamedFile
from levkas.campaign.guess.words import BANDS, GENERIC, IMAGES, LIGHTS, MILD, TARGET, Token, role_in


@dataclass
class CameraGroup:
    """Captures of one camera.

    Attributes
    ----------
    frames : list of NamedFile
    name : str
        Of the camera.
    setups : dict
        Name of another lighting → its frames.
    notes : list of str
        What a person should know of how it was put together.
    """

    frames: list[NamedFile]
    name: str = ""
    setups: dict[str, list[NamedFile]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def of_role(self, *roles: str) -> list[NamedFile]:
        """Return the frames whose targets have one of some roles."""
        return [f for f in self.frames if f.role in roles]

    def by_target(self, frames: Iterable[NamedFile] | None = None) -> dict[str, list[NamedFile]]:
        """Return frames, all of them by default, by target."""
        found: dict[str, list[NamedFile]] = {}
        for frame in self.frames if frames is None else frames:
            found.setdefault(frame.target, []).append(frame)
        return found

    @property
    def objects(self) -> list[NamedFile]:
        """Frames of objects; of charts where there is none; else all frames."""
        return self.of_role("object") or self.of_role("chart") or self.frames

    @property
    def folders(self) -> tuple[str, ...]:
        """Folders of its first object frame, with ``{target}``."""
        return self.objects[0].folders


def group_cameras(
    frames: Sequence[NamedFile], root_name: str
) -> tuple[list[CameraGroup], list[str]]:
    """Put captures together camera by camera.

    Parameters
    ----------
    frames : sequence of NamedFile
    root_name : str
        Name of the folder that is looked at, for a camera without any other name.

    Returns
    -------
    groups : list of CameraGroup
    left_out : list of str
        What belongs to no camera, each with the reason.
    """
    alike: dict[object, list[NamedFile]] = defaultdict(list)
    for frame in frames:  # the same words at the same places; numbers and units may differ
        *folders, stem = frame.segments
        above = tuple(s[0].word or s[0].kind for s in folders)
        alike[above, tuple(t.word for t in stem if t.word)].append(frame)
    groups = [CameraGroup(part) for group in alike.values() for part in _of_one_size(group)]
    groups, left_out = _attach_templates(groups)
    left_out += [line for group in groups for line in _without_bandless(group)]
    groups = _joined_pictures(_attach_setups(groups))
    _give_names(groups, root_name)
    return groups, left_out


def _of_one_size(frames: list[NamedFile]) -> list[list[NamedFile]]:
    """Part frames whose sizes differ, unless sensors or plain pictures explain it."""
    parts: dict[object, list[NamedFile]] = defaultdict(list)
    for frame in frames:
        parts[frame.file.signature].append(frame)
    whole = len(parts) == 1 or frames[0].sensor or _are_pictures(frames) or _are_grey(frames)
    return [frames] if whole else list(parts.values())


def _are_grey(frames: Sequence[NamedFile]) -> bool:
    """Whether all are bands of one size, some of them saved as three channels: grey, as their names make them."""
    sizes = {(f.facts.shape[:2], f.facts.dtype) for f in frames}
    banded = all(any(t.kind in ("band", "wavelength") for t in f.stem) for f in frames)
    return banded and len(sizes) == 1 and {f.file.channels for f in frames} == {1, 3}


def _are_pictures(frames: Sequence[NamedFile]) -> bool:
    """Whether all are photographs or radiographs of any size, without darks and whites."""
    channels = {f.file.channels for f in frames}
    plain = len(channels) == 1 and channels <= {1, 3}
    cubes = any(f.facts.is_cube or f.facts.kind == "raw" for f in frames)
    wavelengths = any(f.number("wavelength") for f in frames)
    return (
        plain and not cubes and not wavelengths and {f.role for f in frames} <= {"object", "chart"}
    )


def _without_bandless(group: CameraGroup) -> list[str]:
    """Take objects without a wavelength in their names from a camera whose other objects have one."""
    banded = {f.target for f in group.objects if f.number("wavelength")}
    if not banded:
        return []
    lost = [f for f in group.of_role("object") if not f.number("wavelength")]
    group.frames = [f for f in group.frames if f not in lost]
    return [
        f"{f.file.name}: its name has no wavelength, unlike the other files of this camera"
        for f in lost
    ]


# --- darks and whites that lie apart ----------------------------------------------------------


def _attach_templates(groups: list[CameraGroup]) -> tuple[list[CameraGroup], list[str]]:
    """Give groups of darks and whites alone to the camera whose frames have their size."""
    owners = [g for g in groups if g.of_role("object")] or [g for g in groups if g.of_role("chart")]
    left_out = []
    for group in groups:
        if group in owners:
            continue
        size = group.frames[0].file.signature
        fits = [o for o in owners if any(f.file.signature == size for f in o.frames)]
        names = sorted({f.file.name for f in group.frames}, key=natural)
        shown = names[0] if len(names) == 1 else f"{names[0]} … {names[-1]} ({len(names)} files)"
        what = "/".join(sorted({f.role for f in group.frames}))
        if len(fits) == 1:
            fits[0].frames += group.frames
        elif fits:
            left_out.append(f"{shown}: {what}; several cameras have frames of this size")
        elif group.of_role("chart"):
            left_out.append(
                f"{shown}: {what} of a camera without an object; `levkas chart FILE` measures a single file"
            )
        else:
            sides = "x".join(str(n) for n in reversed(group.frames[0].facts.shape[:2]))
            left_out.append(f"{shown}: {what} of {sides}; no frame of an object has this size")
    return owners, left_out


# --- other lightings --------------------------------------------------------------------------


def _attach_setups(groups: list[CameraGroup]) -> list[CameraGroup]:
    """Make a setup of a group that differs from another in one folder that names a lighting."""
    kept: list[CameraGroup] = []
    order = sorted(groups, key=lambda g: (len(g.folders), not MILD.match("/".join(g.folders))))
    for group in order:
        for base in kept:
            name, own = _lighting_folder(base, group)
            if not name:
                continue
            base.setups[name] = group.frames
            if own:
                base.notes.append(f"the lighting in folder {own!r} is assumed to be the default")
            break
        else:
            kept.append(group)
    return sorted(kept, key=groups.index)


def _lighting_folder(base: CameraGroup, other: CameraGroup) -> tuple[str, str]:
    """Return the folder that `other` has more, or another of, and the one in its place in `base`."""
    one, two = base.folders, other.folders
    if base.frames[0].file.signature != other.frames[0].file.signature:
        return "", ""
    if not {f.target for f in base.frames} & {f.target for f in other.frames}:
        return "", ""
    if len(two) == len(one) + 1:
        for i, name in enumerate(two):
            if (*two[:i], *two[i + 1 :]) == one and name != TARGET:
                bare = [f for f in one if f != TARGET and f.lower() not in GENERIC]
                return (name, "") if bare or LIGHTS.fullmatch(name) else ("", "")
    if len(two) == len(one):
        places = [i for i, (a, b) in enumerate(zip(one, two, strict=True)) if a != b]
        if len(places) == 1 and all(LIGHTS.fullmatch(f[places[0]]) for f in (one, two)):
            return two[places[0]], one[places[0]]
    return "", ""


def _joined_pictures(groups: list[CameraGroup]) -> list[CameraGroup]:
    """Make one camera of folders of pictures that have no object in common: none could be registered."""
    kept: list[CameraGroup] = []
    for group in groups:
        twin = next((k for k in kept if _could_be_one(k, group)), None)
        if twin is None:
            kept.append(group)
            continue
        twin.frames += group.frames
        twin.notes = [
            "these folders have no object in common: they are assumed to belong to one camera"
        ]
    return kept


def _could_be_one(one: CameraGroup, other: CameraGroup) -> bool:
    words = {name.lower() for name in (*one.folders, *other.folders)}
    words |= {t.word.lower() for g in (one, other) for t in g.frames[0].stem}
    apart = not {f.target for f in one.frames} & {f.target for f in other.frames}
    return apart and not words & IMAGES and _are_pictures([*one.frames, *other.frames])


# --- names ------------------------------------------------------------------------------------


def _give_names(groups: list[CameraGroup], root_name: str) -> None:
    """Name each camera after a folder, words in its files' names, its model, or the root: one's own first."""
    offered = [[safe_name(name) for name in _possible_names(g, root_name)] for g in groups]
    times = Counter(name.casefold() for names in offered for name in dict.fromkeys(names))
    taken: Counter[str] = Counter()
    for group, names in zip(groups, offered, strict=True):
        name = next((n for n in names if times[n.casefold()] == 1), names[0])
        taken[name.casefold()] += 1
        group.name = name if taken[name.casefold()] == 1 else f"{name}-{taken[name.casefold()]}"


def _possible_names(group: CameraGroup, root_name: str) -> list[str]:
    frames = group.objects
    *folders, stem = frames[0].segments
    single = [s[0] for s in reversed(folders) if len(s) == 1]
    names = [token.text for token in single if token.kind == "word" and "*" not in token.text]
    own = [
        name
        for name in names
        if name.lower() not in GENERIC
        and not LIGHTS.fullmatch(name)
        and name != ".."
        and not role_in(name)
    ]
    shared = set.intersection(*({t.text for t in f.stem} for f in frames))
    words = [t.text for t in stem if t.kind == "word" and t.text in shared and t.word]
    words = [text for text in words if len(text) > 1 and text.lower() not in GENERIC]
    model = frames[0].facts.model
    return [*own, *(["-".join(words)] if words else []), model or root_name or "camera", "camera"]


def safe_name(name: str) -> str:
    """Return a name as a camera or setup can bear it: what file names cannot hold becomes ``-``."""
    kept = "".join(c if c.isalnum() or c in "-_ ." else "-" for c in name).strip("-_. ")
    kept = kept.replace(" ", "-")[:60] or "camera"
    return f"{kept}-camera" if kept.lower() == "grid" else kept


# --- patterns of names ----------------------------------------------------------------------

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
        fields = "|".join(fields_of_others(kind))
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
    shown = {"object"} if any(f.role == "object" for f in frames) else {"chart"}
    skeleton_columns = [_Columns(group, shown) for group in skeletons.values()]
    sensors: dict[str, list[NamedFile]] = defaultdict(list)
    bands: set[str] = set()
    centres: set[float] = set()
    for one in skeleton_columns:
        for frame, values in zip(one.frames, one.values(), strict=True):
            if "sensor" in values:
                sensors[values["sensor"]].append(frame)
            if frame.role in shown:
                bands |= {values["band"]} if "band" in values else set()
                centres |= {float(values["wavelength"])} if "wavelength" in values else set()
    return FilePatterns(
        patterns=_merged(skeleton_columns),
        sensors=dict(sorted(sensors.items())) if len(sensors) > 1 else {},
        wavelengths=tuple(sorted(centres)),
        bands=tuple(sorted(bands, key=natural)),
        shots=any("{shot}" in one.text for one in skeleton_columns),
        reasons=tuple(dict.fromkeys(reason for one in skeleton_columns for reason in one.reasons)),
    )


def _literal(token: Token) -> str:
    if token.kind == "numbered":
        return token.before
    return token.text if token.kind in ("word", "target", "object") else ""


class _Columns:
    """Files whose names differ in numbers only: a column for each part of their names, and its field."""

    def __init__(self, frames: list[NamedFile], shown: set[str]) -> None:
        self.frames = frames
        self.of_objects = not shown.isdisjoint(frame.role for frame in frames)
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
        if not self.of_objects:
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
        if field == "tile":
            return first.text
        if field in ("wavelength", "exposure"):
            after = first.after if len({t.after for t in tokens}) == 1 else "*"
            return f"{first.before}{{{field}}}{after}"
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
    if kind in ("target", "object", "tile"):
        return kind, ""
    if kind in ("band", "sensor"):
        return kind, tokens[0].why
    if kind in ("wavelength", "exposure"):
        units = {(t.before, "" if t.why else t.after) for t in tokens}
        return (COUNT if len(units) > 1 else kind), tokens[0].why
    if kind == "number" and not varies and _is_of_object(frames[0]):
        return COUNT, ""  # of the next object's darks it will be another
    if kind == "number" and not varies and _is_constant_count(tokens[0], frames):
        return ("shot" if any(f.role == "object" for f in frames) else ANY), ""
    if kind not in ("number", "numbered", "time") or not varies:
        return LITERAL, ""
    if tokens[0].names_sensor:
        return "sensor", f"{{sensor}}: {tokens[0].before!r} and a number"
    if _headers_differ(texts, frames):
        return "sensor", "{sensor}: in the headers each number has its own wavelength"
    banded = kind == "numbered" and tokens[0].before.lower() in BANDS
    if banded and len(set(texts)) >= FEWEST_BANDS:
        return "band", f"{{band}}: {tokens[0].before!r} and a number, the same for every target"
    if kind == "number" and _are_wavelengths(texts, frames):
        return "wavelength", "{wavelength}: numbers in equal steps, the same for every target"
    return COUNT, ""


def _is_of_object(frame: NamedFile) -> bool:
    """Whether a frame is a dark or white of one object, which its path names."""
    return any(token.kind == "object" for segment in frame.segments for token in segment)


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


def _merged(skeleton_columns: Sequence[_Columns]) -> tuple[str, ...]:
    """Return the patterns, objects' first; templates that only have a number more share theirs by a ``*``."""
    texts = [(one, one.text) for one in skeleton_columns]
    texts.sort(key=lambda pair: (not pair[0].of_objects, pair[1]))
    of_objects: dict[str, bool] = {}
    for one, text in texts:
        of_objects[text] = of_objects.get(text, False) or one.of_objects
    merged = list(of_objects)
    for short in list(merged):
        stem, dot, suffix = short.rpartition(".")
        more = re.compile(re.escape(stem) + r"[-_ .]*(\{shot\}|\*|\d+)" + re.escape(dot + suffix))
        longer = {t for t in merged if t != short and more.fullmatch(t) and not of_objects[t]}
        if longer and short in merged:
            merged[merged.index(short)] = f"{stem}*{dot}{suffix}"
            merged = [t for t in merged if t not in longer]
    return tuple(merged)

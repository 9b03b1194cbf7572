"""Find the target in the names of files: a folder's name, or a part of the file's own."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

from levkas.campaign.discovery.file_index import composed
from levkas.campaign.discovery.patterns import SECONDS
from levkas.campaign.guess.band_names import Question, Tokens, mark_bands
from levkas.campaign.guess.listing import CaptureFile
from levkas.campaign.guess.pixels import Samples
from levkas.campaign.guess.scan_folders import ScanFolder, find_scan_folders
from levkas.campaign.guess.words import (
    BANDS,
    GENERIC,
    IMAGES,
    OBJECT,
    PLACE,
    PREFIXES,
    SENSORS,
    TARGET,
    TYPED,
    Token,
    joined,
    role_in,
    role_of,
    tokens_of,
)
from levkas.readers.facts import Facts

STEM, PARENT = -1, -2
"""Places of the target that are no folder below the root: in the file's own name; the root's name."""
FEW_GROUPS = 3
"""Groups of files whose first and last are compared to see whether numbers count shots or objects."""


@dataclass(frozen=True)
class NamedFile:
    """A capture whose target is known.

    Parameters
    ----------
    file : CaptureFile
    target : str
    role : str
        ``"dark"``, ``"white"``, ``"chart"`` or ``"object"``.
    folders : tuple of str
        With ``{target}`` where a folder is the target.
    stem : tuple of Token
        With one token of kind ``"target"`` where the name has it.
    tile : str
        The part of the object that it shows, as the path has it.
    """

    file: CaptureFile
    target: str
    role: str
    folders: tuple[str, ...]
    stem: tuple[Token, ...]
    tile: str = ""

    @property
    def facts(self) -> Facts:
        """Facts of the header."""
        return self.file.facts

    @property
    def path(self) -> Path:
        """Of the file."""
        return self.file.path

    @cached_property
    def segments(self) -> tuple[tuple[Token, ...], ...]:
        """The tokens of every folder, then of the name."""
        return (*map(_tokens_of_folder, self.folders), self.stem)

    @cached_property
    def exposures_s(self) -> tuple[float, ...]:
        """Exposure by path or header, s; several of a list by bands."""
        for token in self._of_kind("exposure"):
            return (float(token.number) * SECONDS[token.after.lower()],)
        facts = self.facts
        return facts.band_times_s or (() if facts.exposure_s is None else (facts.exposure_s,))

    @cached_property
    def sensor(self) -> str:
        """The part of the path that names one of several sensors, such as ``ccd1``; "" for none."""
        return next((t.text for s in self.segments for t in s if t.names_sensor), "")

    def number(self, kind: str) -> str | None:
        """Return the number of the wavelength or exposure, as in the path."""
        return next((token.number for token in self._of_kind(kind)), None)

    def with_role(self, role: str) -> NamedFile:
        """Return the file with another role."""
        return replace(self, role=role)

    def _of_kind(self, kind: str) -> Iterator[Token]:
        return (t for segment in self.segments for t in segment if t.kind == kind)


@cache
def _tokens_of_folder(name: str) -> tuple[Token, ...]:
    """Return a folder as one word, but for a target in it, a date, a wavelength, an exposure, or a sensor's number."""
    for mark, kind in ((TARGET, "target"), (OBJECT, "object")):
        if mark in name:
            before, _, after = name.partition(mark)
            parts = (Token(before), Token(mark, "", kind), Token(after))
            return tuple(part for part in parts if part.text)
    if "{row}" in name:
        return (Token(name, "", "tile"),)
    tokens = tokens_of(name)
    typed = tokens[0].kind in ("time", "wavelength", "exposure") or tokens[0].names_channel
    return tokens if len(tokens) == 1 and typed else (Token(name),)


def name_targets(
    captures: Sequence[CaptureFile], samples: Samples, *, undecided_as_bands: bool = False
) -> tuple[list[NamedFile], list[Question]]:
    """Find the target of every capture.

    Returns
    -------
    named : list of NamedFile
    questions : list of Question
        What nothing decides, and was taken for objects.
    """
    tokens = {c.path: tokens_of(composed(c.path.stem)) for c in captures}
    tokens, questions = mark_bands(captures, tokens, samples, undecided_as_bands=undecided_as_bands)
    named: dict[Path, NamedFile] = {}
    for scan in find_scan_folders(captures, tokens, samples):
        named |= {n.path: n for n in _of_scan(scan, captures, tokens)}
    rest = [c for c in captures if c.path not in named]
    places = _places(rest, tokens, samples)
    named |= {
        c.path: _in_folder(c, tokens[c.path], places[c.path])
        for c in rest
        if places[c.path] != STEM
    }
    in_stem = [c for c in rest if places[c.path] == STEM]
    for cluster in _clusters(in_stem, tokens):
        named |= {n.path: n for n in _StemCluster(cluster, tokens, samples).named()}
    return _without_white_light([named[c.path] for c in captures], tokens), questions


def _without_white_light(named: list[NamedFile], tokens: Tokens) -> list[NamedFile]:
    """Return files of which none is a white that shows an object under white light: ``page_white`` beside ``page_uv``."""
    if any(one.role == "dark" for one in named):
        return named
    pictured = [
        one.target
        for one in named
        if one.role == "object" and any(t.text.lower() in IMAGES for t in one.stem)
    ]
    made = []
    for one in named:
        parts = tokens[one.path]
        shown = next((p for p in pictured if _with_target(parts, p) != parts), "")
        if one.role == "white" and shown:
            one = NamedFile(one.file, shown, "object", one.folders, _with_target(parts, shown))
        made.append(one)
    return made


def _of_scan(
    scan: ScanFolder, captures: Sequence[CaptureFile], tokens: Tokens
) -> Iterator[NamedFile]:
    """Name all files in the folder of one object: its frames, its darks and whites, and what lies beside them."""
    deep = len(scan.inside)
    own, templates = ({c.path for c in files} for files in (scan.objects, scan.templates))
    for capture in captures:
        if capture.folders[:deep] != scan.inside:
            continue
        marked = _with_target(tokens[capture.path], scan.object)
        folders = [*scan.folders, *capture.folders[deep:]]
        if capture.path in templates:
            folders[deep - 1] = folders[deep - 1].replace(TARGET, OBJECT)
            yield _template_of(capture, marked, folders)
            continue
        role = "object" if capture.path in own else role_in(capture.path.stem) or "object"
        yield NamedFile(capture, scan.object, role, tuple(folders), marked)


def _template_of(capture: CaptureFile, tokens: tuple[Token, ...], folders: list[str]) -> NamedFile:
    """Name a dark or white of one object: by the folder that it lies in, or by a word of its own name."""
    if folders and (role := role_in(folders[-1])):
        name, folders[-1] = folders[-1], TARGET
        return NamedFile(capture, name, role, tuple(folders), tokens)
    found = [i for i, t in enumerate(tokens) if t.role]
    start, stop = found[0], found[-1] + 1
    target = Token(TARGET, tokens[start].gap, "target")
    before = tuple(
        replace(t, text=OBJECT, kind="object") if t.kind == "target" else t for t in tokens
    )
    stem = (*before[:start], target, *before[stop:])
    return NamedFile(
        capture, joined(tokens[start:stop]), role_of(tokens[start].text), tuple(folders), stem
    )


def _in_folder(capture: CaptureFile, tokens: tuple[Token, ...], place: int) -> NamedFile:
    """Name a capture after the folder at `place`, or the root."""
    if place == PARENT:
        target = capture.path.parent.resolve().name
        role = "chart" if role_in(target) == "chart" else "object"
        return NamedFile(capture, target, role, ("..", TARGET), tokens)
    target = capture.folders[place]
    folders = tuple(TARGET if i == place else name for i, name in enumerate(capture.folders))
    marked = _with_target(tokens, target)
    return NamedFile(capture, target, role_in(target) or "object", folders, marked)


def _with_target(tokens: tuple[Token, ...], target: str) -> tuple[Token, ...]:
    """Mark the words of a name that repeat the folder's."""
    for start in range(len(tokens)):
        for stop in range(len(tokens), start, -1):
            if joined(tokens[start:stop]) == target:
                marked = Token(TARGET, tokens[start].gap, "target")
                return (*tokens[:start], marked, *tokens[stop:])
    return tokens


def _deepest(folders: tuple[str, ...]) -> int:
    """Return the deepest folder that has a name of its own, else the root."""
    levels = [i for i, name in enumerate(folders) if name.lower() not in GENERIC]
    return levels[-1] if levels else PARENT


# --- which part of a path ---------------------------------------------------------------------


def _places(captures: Sequence[CaptureFile], tokens: Tokens, samples: Samples) -> dict[Path, int]:
    """Return the place of each capture's target: the index of a folder, `STEM` or `PARENT`."""
    siblings: dict[tuple[str, ...], set[str]] = defaultdict(set)
    for capture in captures:
        for i, name in enumerate(capture.folders):
            siblings[capture.folders[:i]].add(name)
    places: dict[Path, int] = {}
    for capture in captures:
        levels = [i for i, name in enumerate(capture.folders) if role_in(name)]
        in_stem = any(t.role for t in tokens[capture.path])
        if levels:
            level = levels[-1]
            others = siblings[capture.folders[:level]] - {capture.folders[level]}
            generic = in_stem and any(name.lower() in GENERIC for name in others)
            places[capture.path] = STEM if generic else level
        elif in_stem:
            places[capture.path] = STEM
    templates = [c for c in captures if c.path in places]
    rest = [c for c in captures if c.path not in places]
    beside = {folders: _beside(folders, templates, places) for folders in {c.folders for c in rest}}
    for capture in rest:
        place = beside[capture.folders]
        if place is not None:
            places[capture.path] = place
    for depth in {len(c.folders) for c in rest}:
        group = [c for c in rest if len(c.folders) == depth and c.path not in places]
        if group:
            place = _place_without_templates(group, tokens, samples)
            places |= {c.path: place for c in group}
    return places


def _beside(
    folders: tuple[str, ...], templates: Sequence[CaptureFile], places: dict[Path, int]
) -> int | None:
    """Return the place that darks and whites in the same folders have."""
    levels = {
        level
        for t in templates
        if 0 <= (level := places[t.path]) < len(folders) and t.folders[:level] == folders[:level]
    }
    at_level = defaultdict(set)
    for t in templates:
        if 0 <= places[t.path] == len(t.folders) - 1:
            at_level[places[t.path]].add(t.path.stem.casefold())
    for level in sorted(levels, reverse=True):
        if folders[level].casefold() in at_level[level]:
            return STEM  # flats/camera.tif beside camera/object.tif
        while level < len(folders) and folders[level].lower() in GENERIC:
            level += 1
        if level < len(folders):
            return level
    near = any(places[t.path] == STEM and t.folders[:-1] == folders[:-1] for t in templates)
    return STEM if near else None


def _place_without_templates(group: Sequence[CaptureFile], tokens: Tokens, samples: Samples) -> int:
    """Return the place of files of one depth by what repeats from folder to folder."""
    words = {c.path: _object_words(tokens[c.path]) for c in group}
    folders = group[0].folders
    if not any(words.values()):
        level = _varying_folder(group)
        if level is not None:
            return level
        return STEM if _numbers_are_objects(group, tokens, samples) else _deepest(folders)
    by_folder: dict[tuple[str, ...], set[tuple[str, ...]]] = defaultdict(set)
    for capture in group:
        by_folder[capture.folders].add(words[capture.path])
    if folders and len(by_folder) > 1 and len({frozenset(w) for w in by_folder.values()}) == 1:
        by_word = {w: {c.signature for c in group if words[c.path] == w} for w in words.values()}
        of_images = all(set(w) <= IMAGES for w in words.values())
        differ = len({frozenset(v) for v in by_word.values()}) > 1
        if of_images or (differ and all(len(v) == 1 for v in by_word.values())):
            return _deepest(folders)
    return STEM


def _object_words(tokens: Sequence[Token]) -> tuple[str, ...]:
    """Return the words of a name that may name an object: no numbers, units, or what cameras write."""
    words = [
        t.before.lower() if t.kind == "numbered" else t.text.lower()
        for t in tokens
        if t.kind in ("word", "numbered")
    ]
    numbered = {t.before.lower() for t in tokens if t.kind == "numbered"}
    dull = PREFIXES | (numbered & (SENSORS | BANDS))
    return tuple(w for w in words if w not in dull)


def _varying_folder(group: Sequence[CaptureFile]) -> int | None:
    """Return the deepest folder whose names differ while the sensors' sizes are the same under each."""
    for level in reversed(range(len(group[0].folders))):
        same: dict[tuple[str, ...], dict[str, set[object]]] = defaultdict(lambda: defaultdict(set))
        for capture in group:
            rest = (*capture.folders[:level], *capture.folders[level + 1 :])
            same[rest][capture.folders[level]].add(capture.signature)
        for values in same.values():
            if len(values) > 1 and len({frozenset(v) for v in values.values()}) == 1:
                return level
    return None


def _numbers_are_objects(group: Sequence[CaptureFile], tokens: Tokens, samples: Samples) -> bool:
    """Whether running numbers are all that distinguishes different scenes, in one band where there are several."""
    kinds = [{t.kind for t in tokens[c.path]} for c in group]
    if len(group) < 2 or not all(k & {"number", "numbered"} for k in kinds):
        return False
    band = _bands_in(tokens[group[0].path])
    alike = [
        c
        for c in group[1:]
        if c.signature == group[0].signature and _bands_in(tokens[c.path]) == band
    ]
    if not alike:  # of one scene; what stands before a band that a camera named names it
        before = [t.kind for t in tokens[group[0].path]]
        coded = [i for i, t in enumerate(tokens[group[0].path]) if t.why]
        return not band or (bool(coded) and "number" in before[: coded[0]])
    return bool(samples.difference([group[0], *alike]))


def _bands_in(tokens: Sequence[Token]) -> tuple[str, ...]:
    return tuple(t.text for t in tokens if t.kind in ("wavelength", "band", "sensor"))


# --- which part of a file's name --------------------------------------------------------------


def _clusters(captures: Sequence[CaptureFile], tokens: Tokens) -> list[list[CaptureFile]]:
    """Group captures whose names are made alike: one sensor, one folder or, where darks lie apart, two."""
    by_key: dict[object, dict[tuple[str, ...], list[CaptureFile]]] = defaultdict(dict)
    for capture in captures:
        words = (t for t in tokens[capture.path] if t.kind not in TYPED)
        images = tuple(w for t in words if (w := t.text.lower()) in IMAGES)
        key = (capture.path.suffix.lower(), capture.signature, images)
        by_key[key].setdefault(capture.folders, []).append(capture)
    clusters = []
    for folders in by_key.values():
        apart: dict[tuple[str, ...], list[CaptureFile]] = defaultdict(list)
        for folder, group in folders.items():
            if len({any(t.role for t in tokens[c.path]) for c in group}) == 2:
                clusters.append(group)
            else:
                apart[folder[:-1]] += group
        for group in apart.values():
            if any(t.role for c in group for t in tokens[c.path]):
                clusters.append(group)
                continue
            alone: dict[tuple[str, ...], list[CaptureFile]] = defaultdict(list)
            for capture in group:
                alone[capture.folders].append(capture)
            clusters += alone.values()
    return clusters


class _StemCluster:
    """Names that are made alike; what is no target is taken off both ends, of all of them at a time."""

    def __init__(self, captures: list[CaptureFile], tokens: Tokens, samples: Samples) -> None:
        self.captures, self.samples = captures, samples
        self.tokens = [tokens[c.path] for c in captures]
        self.spans = [_trimmed(t, 0, len(t)) for t in self.tokens]
        self.with_roles = any(t.role for tokens in self.tokens for t in tokens)

    def named(self) -> list[NamedFile]:
        """Return the captures with their targets."""
        while self._peel_constant(0):
            pass
        while self._peel_constant(-1) or self._peel_number():
            pass
        return list(map(_named, self.captures, self.tokens, self.spans))

    def _ends(self, end: int) -> list[Token]:
        """Return the first or last tokens of all names; none where one has no other left."""
        if any(stop - start < 2 for start, stop in self.spans):
            return []
        return [
            t[start:stop][end] for t, (start, stop) in zip(self.tokens, self.spans, strict=True)
        ]

    def _peel(self, end: int) -> None:
        cut = [(start + (end == 0), stop + end) for start, stop in self.spans]
        self.spans = [_trimmed(t, *span) for t, span in zip(self.tokens, cut, strict=True)]

    def _peel_constant(self, end: int) -> bool:
        """Take one part off an end of all names where it is the same in all; False where it is not."""
        ends = self._ends(end)
        if len({t.text for t in ends}) != 1 or ends[0].role:
            return False
        if not self.with_roles and ends[0].text.lower() not in PREFIXES:
            return False
        self._peel(end)
        return all(start < stop for start, stop in self.spans)

    def _peel_number(self) -> bool:
        """Take a running number, or the number of a sensor, off the right end of all names."""
        ends = self._ends(-1)
        if len({(t.kind, t.before.lower()) for t in ends}) != 1:
            return False
        if ends[0].kind not in ("number", "numbered") or self._ends_in_place():
            return False
        groups: dict[object, list[int]] = defaultdict(list)
        for i, (tokens, (start, stop)) in enumerate(zip(self.tokens, self.spans, strict=True)):
            others = tokens[:start] + tokens[stop:]
            rest = joined(tokens[start : stop - 1]), joined(others), self.captures[i].folders
            groups[rest].append(i)
        several = [group for group in groups.values() if len(group) > 1]
        if not ends[0].names_channel and not self._counts_shots(several):
            return False
        self._peel(-1)
        return True

    def _ends_in_place(self) -> bool:
        """Whether all names end in the row and column of a tile."""
        parts = [
            t[start:stop][-2:] for t, (start, stop) in zip(self.tokens, self.spans, strict=True)
        ]
        return all(PLACE.search(joined(part)) for part in parts)

    def _counts_shots(self, groups: list[list[int]]) -> bool:
        """Whether files that differ in a number alone are bands by their headers, or shots of one scene."""
        shots = [g for g in groups if not any(t.role for t in self.tokens[g[0]])][:FEW_GROUPS]
        differ = [self.samples.difference([self.captures[i] for i in g]) for g in shots]
        if self.with_roles:
            return not any(differ)
        if _bands_differ([self.captures[i].facts for i in group] for group in groups):
            return True
        return bool(shots) and not any(differ)


def _trimmed(tokens: Sequence[Token], start: int, stop: int) -> tuple[int, int]:
    """Leave typed parts and kinds of photographs out at both ends, as long as something is left."""

    def dull(token: Token) -> bool:
        return token.kind in TYPED or token.text.lower() in IMAGES

    while start < stop and dull(tokens[start]):
        start += 1
    while stop > start and dull(tokens[stop - 1]):
        stop -= 1
    return start, stop


def _bands_differ(groups: Iterable[Sequence[Facts]]) -> bool:
    """Whether headers give each file of every group bands of its own."""
    bands = [[f.wavelengths or f.band_names for f in group] for group in groups]
    return bool(bands) and all(None not in b and len(set(b)) == len(b) for b in bands)


def _named(capture: CaptureFile, tokens: tuple[Token, ...], span: tuple[int, int]) -> NamedFile:
    start, stop = span
    if start >= stop:
        return _in_folder(capture, tokens, _deepest(capture.folders))
    roles = [i for i in range(start, stop) if tokens[i].role]
    if roles:  # what follows a dark's name in numbers are its shots
        while stop > roles[-1] + 1 and tokens[stop - 1].kind in ("number", *TYPED):
            stop -= 1
    typed = [i for i in range(start, stop) if tokens[i].kind in TYPED]
    stop = typed[0] if typed and typed[0] > start else stop
    role = role_of(tokens[roles[0]].text) if roles else "object"
    marked = Token(TARGET, tokens[start].gap, "target")
    stem = (*tokens[:start], marked, *tokens[stop:])
    return NamedFile(capture, joined(tokens[start:stop]), role, capture.folders, stem)

"""Where in the names of files the target stands: in a folder's name, or in a part of the file's own."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from levkas.campaign.guess.listing import Seen


def name_targets(
    captures: Sequence[Seen], *, same_scene: Callable[[Seen, Seen], bool | None]
) -> list[Named]:
    """Find the target of every capture.

    Parameters
    ----------
    captures : sequence of Seen
    same_scene : callable
        Whether two captures show the same; asked where running numbers may be shots or objects.
    """
    if not captures:
        return []
    tokens = {s.path: tokens_of(s.stem) for s in captures}
    places = _places(captures, tokens, same_scene)
    named = [
        in_folder(s, tokens[s.path], places[s.path]) for s in captures if places[s.path] != STEM
    ]
    in_stem = [s for s in captures if places[s.path] == STEM]
    for cluster in cluster_names(in_stem, tokens):
        named += find_in_stems(cluster, tokens, same_scene)
    order = {s.path: i for i, s in enumerate(captures)}
    return sorted(named, key=lambda n: order[n.seen.path])


# --- which part of a path ---------------------------------------------------------------------


def _places(
    captures: Sequence[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> dict[Path, int]:
    """Return the place of each capture's target: the index of a folder, `STEM` or `PARENT`."""
    siblings: dict[tuple[str, ...], set[str]] = defaultdict(set)
    for seen in captures:
        for i, name in enumerate(seen.folders):
            siblings[seen.folders[:i]].add(name)
    places: dict[Path, int] = {}
    for seen in captures:
        told = [i for i, name in enumerate(seen.folders) if role_in(name)]
        in_stem = any(t.role for t in tokens[seen.path])
        if told:
            others = siblings[seen.folders[: told[-1]]] - {seen.folders[told[-1]]}
            generic = in_stem and any(name.lower() in GENERIC for name in others)
            places[seen.path] = STEM if generic else told[-1]
        elif in_stem:
            places[seen.path] = STEM
    worded = [s for s in captures if s.path in places]
    rest = [s for s in captures if s.path not in places]
    for seen in rest:
        place = _beside(seen, worded, places)
        if place is not None:
            places[seen.path] = place
    for depth in {len(s.folders) for s in rest}:
        group = [s for s in rest if len(s.folders) == depth and s.path not in places]
        if group:
            places |= _untold(group, tokens, same_scene)
    return places


def _beside(seen: Seen, worded: Sequence[Seen], places: dict[Path, int]) -> int | None:
    """The place that darks and whites in the same folders have."""
    levels = [
        places[w.path]
        for w in worded
        if 0 <= places[w.path] < len(seen.folders)
        and w.folders[: places[w.path]] == seen.folders[: places[w.path]]
    ]
    for level in sorted(set(levels), reverse=True):
        while level < len(seen.folders) and seen.folders[level].lower() in GENERIC:
            level += 1
        if level < len(seen.folders):
            return level
    near = [w for w in worded if places[w.path] == STEM and w.folders[:-1] == seen.folders[:-1]]
    return STEM if near else None


def _untold(
    group: Sequence[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> dict[Path, int]:
    """Places where no dark or white says them: by what repeats from folder to folder."""
    depth = len(group[0].folders)
    words = {s.path: _words(tokens[s.path]) for s in group}
    by_folder: dict[tuple[str, ...], set[tuple[str, ...]]] = defaultdict(set)
    for seen in group:
        by_folder[seen.folders].add(words[seen.path])
    if not any(words.values()):
        level = _level(group) if depth else None
        if level is None and _are_numbers(group, tokens, same_scene):
            level = STEM
        if level is None:
            level = deepest(group[0].folders)
        return {s.path: level for s in group}
    level = STEM
    repeats = len(by_folder) > 1 and len({frozenset(w) for w in by_folder.values()}) == 1
    if repeats and depth:
        by_word = {w: {signature(s) for s in group if words[s.path] == w} for w in words.values()}
        of_images = all(set(w) <= IMAGES for w in words.values())
        differ = len({frozenset(v) for v in by_word.values()}) > 1
        if of_images or (differ and all(len(v) == 1 for v in by_word.values())):
            level = deepest(group[0].folders)
    return {s.path: level for s in group}


def _words(tokens: Sequence[Token]) -> tuple[str, ...]:
    """Words of a name that may tell an object: no numbers, units, or what cameras write."""
    words = [t.before.lower() if t.kind == "numbered" else t.text.lower() for t in tokens]
    kept = [w for t, w in zip(tokens, words, strict=True) if t.kind in ("word", "numbered")]
    numbered = {t.before.lower() for t in tokens if t.kind == "numbered"}
    dull = PREFIXES | (numbered & (SENSORS | BANDS))
    return tuple(w for w in kept if w not in dull)


def _level(group: Sequence[Seen]) -> int | None:
    """The deepest folder whose names differ while the sensors' sizes are the same under each."""
    for level in reversed(range(len(group[0].folders))):
        same: dict[tuple[str, ...], dict[str, set[object]]] = defaultdict(lambda: defaultdict(set))
        for seen in group:
            rest = (*seen.folders[:level], *seen.folders[level + 1 :])
            same[rest][seen.folders[level]].add(signature(seen))
        for values in same.values():
            if len(values) > 1 and len({frozenset(v) for v in values.values()}) == 1:
                return level
    return None


def _are_numbers(
    group: Sequence[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> bool:
    """Whether running numbers are all that tells different scenes apart."""
    plain = [s for s in group if not any(t.kind == "wavelength" for t in tokens[s.path])]
    numbers = all(any(t.kind in ("number", "numbered") for t in tokens[s.path]) for s in plain)
    if len(plain) != len(group) or not numbers or len(group) < 2:
        return False
    alike = [s for s in group[1:] if signature(s) == signature(group[0])]
    return any(same_scene(group[0], s) is False for s in (alike[0], alike[-1])) if alike else True


def cluster_names(
    captures: Sequence[Seen], tokens: dict[Path, tuple[Token, ...]]
) -> list[list[Seen]]:
    """Captures whose names are made alike: of one sensor, from one folder or, where darks stand apart, two."""
    by_key: dict[tuple[object, ...], dict[tuple[str, ...], list[Seen]]] = defaultdict(dict)
    for seen in captures:
        images = tuple(t.text.lower() for t in tokens[seen.path] if t.text.lower() in IMAGES)
        key = (seen.path.suffix.lower(), signature(seen), images)
        by_key[key].setdefault(seen.folders, []).append(seen)
    clusters = []
    for folders in by_key.values():
        apart: dict[tuple[str, ...], list[Seen]] = defaultdict(list)
        for folder, group in folders.items():
            roles = {any(t.role for t in tokens[s.path]) for s in group}
            if len(roles) == 2:
                clusters.append(group)
            else:
                apart[folder[:-1]] += group
        for group in apart.values():
            if any(t.role for s in group for t in tokens[s.path]):
                clusters.append(group)
                continue
            alone: dict[tuple[str, ...], list[Seen]] = defaultdict(list)
            for seen in group:
                alone[seen.folders].append(seen)
            clusters += alone.values()
    return clusters


def find_in_stems(
    cluster: list[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> list[Named]:
    """Take from both ends of the names what is no target, in all of them at a time."""
    spans = {s.path: _trimmed(tokens[s.path], 0, len(tokens[s.path])) for s in cluster}
    worded = any(t.role for s in cluster for t in tokens[s.path])
    while _peel(cluster, tokens, spans, worded, left=True):
        pass
    while _peel(cluster, tokens, spans, worded, left=False) or _peel_number(
        cluster, tokens, spans, worded, same_scene
    ):
        pass
    return [_named(s, tokens[s.path], *spans[s.path]) for s in cluster]


def _trimmed(tokens: Sequence[Token], start: int, stop: int) -> tuple[int, int]:
    """Leave typed parts and kinds of photographs out at both ends, as long as something is left."""

    def dull(token: Token) -> bool:
        return token.kind in TYPED or token.text.lower() in IMAGES

    while start < stop and dull(tokens[start]):
        start += 1
    while stop > start and dull(tokens[stop - 1]):
        stop -= 1
    return start, stop


def _peel(
    cluster: list[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    spans: dict[Path, tuple[int, int]],
    worded: bool,
    *,
    left: bool,
) -> bool:
    """Take one part off an end of all names where it is the same in all; False where it is not."""
    ends = []
    for seen in cluster:
        start, stop = spans[seen.path]
        if stop - start < 2:
            return False
        ends.append(tokens[seen.path][start if left else stop - 1])
    texts = {t.text for t in ends}
    constant = len(texts) == 1 and not ends[0].role
    if not constant or (not worded and ends[0].text.lower() not in PREFIXES):
        return False
    for seen in cluster:
        start, stop = spans[seen.path]
        span = (start + 1, stop) if left else (start, stop - 1)
        spans[seen.path] = _trimmed(tokens[seen.path], *span)
    return all(start < stop for start, stop in spans.values())


def _peel_number(
    cluster: list[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    spans: dict[Path, tuple[int, int]],
    worded: bool,
    same_scene: Callable[[Seen, Seen], bool | None],
) -> bool:
    """Take a running number, or the number of a sensor, off the right end of all names."""
    ends, groups = [], defaultdict(list)
    for seen in cluster:
        start, stop = spans[seen.path]
        if stop - start < 2:
            return False
        ends.append(tokens[seen.path][stop - 1])
        others = tokens[seen.path][:start] + tokens[seen.path][stop:]
        rest = joined(tokens[seen.path][start : stop - 1]), joined(others), seen.folders
        groups[rest].append(seen)
    kinds = {(t.kind, t.before.lower()) for t in ends}
    if len(kinds) != 1 or ends[0].kind not in ("number", "numbered"):
        return False
    several = [group for group in groups.values() if len(group) > 1]
    if not (_is_sensor(ends[0]) or worded or _tell_bands(several)):
        if not several or not all(same_scene(g[0], g[-1]) for g in several[:3]):
            return False
    elif worded and not _is_sensor(ends[0]) and _are_scenes(several, tokens, same_scene):
        return False
    for seen in cluster:
        start, stop = spans[seen.path]
        spans[seen.path] = _trimmed(tokens[seen.path], start, stop - 1)
    return True


def _is_sensor(token: Token) -> bool:
    return token.kind == "numbered" and token.before.lower() in SENSORS | BANDS


def _tell_bands(groups: Iterable[list[Seen]]) -> bool:
    """Whether files that differ in a number alone are different bands by their headers."""
    told = [[s.facts.wavelengths or s.facts.band_names for s in group] for group in groups]
    return bool(told) and all(None not in t and len(set(t)) == len(t) for t in told)


def _are_scenes(
    groups: Sequence[list[Seen]],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> bool:
    """Whether numbers tell objects apart, not shots: among frames that are no templates."""
    objects = [g for g in groups if not any(t.role for t in tokens[g[0].path])]
    return any(same_scene(g[0], g[-1]) is False for g in objects[:3])


def _named(seen: Seen, tokens: tuple[Token, ...], start: int, stop: int) -> Named:
    if start >= stop:
        depth = len(seen.folders)
        return in_folder(seen, tokens, deepest(seen.folders) if depth else PARENT)
    roles = [i for i in range(start, stop) if tokens[i].role]
    if roles:  # what follows a dark's name in numbers are its shots
        while stop > roles[-1] + 1 and tokens[stop - 1].kind in ("number", *TYPED):
            stop -= 1
    typed = [i for i in range(start, stop) if tokens[i].kind in TYPED]
    stop = typed[0] if typed and typed[0] > start else stop
    target = joined(tokens[start:stop])
    role = role_of(tokens[roles[0]].text) if roles else "object"
    marked = Token(TARGET, tokens[start].gap, "target")
    return Named(seen, target, role, seen.folders, (*tokens[:start], marked, *tokens[stop:]))


TARGET = "{target}"
STEM, PARENT = -1, -2
"""Places of the target that are no folder below the root: in the file's own name; the root's name."""
TYPED = ("time", "wavelength", "exposure")


@dataclass(frozen=True)
class Named:
    """A capture whose target is known.

    Parameters
    ----------
    seen : Seen
    target : str
    role : str
        ``"dark"``, ``"white"``, ``"chart"`` or ``"object"``.
    folders : tuple of str
        With ``{target}`` where a folder is the target.
    stem : tuple of Token
        With one token of kind ``"target"`` where the name says it.
    """

    seen: Seen
    target: str
    role: str
    folders: tuple[str, ...]
    stem: tuple[Token, ...]


def signature(seen: Seen) -> tuple[object, ...]:
    """What all frames of one sensor share: size (of a scan the width), channels, kind of number."""
    shape = seen.facts.shape
    if seen.facts.kind == "envi":
        return ("envi", shape[1], shape[2], seen.facts.dtype)
    return (shape[:2], seen.channels, seen.facts.dtype, seen.facts.kind == "raw")


def in_folder(seen: Seen, tokens: tuple[Token, ...], place: int) -> Named:
    """Return a capture whose target is the folder at `place`, or the root's own name."""
    if place == PARENT:
        target = seen.path.parent.resolve().name
        return Named(seen, target, "object", ("..", TARGET), tokens)
    target = seen.folders[place]
    folders = tuple(TARGET if i == place else name for i, name in enumerate(seen.folders))
    role = role_in(target) or "object"
    return Named(seen, target, role, folders, _with_target(tokens, target))


def _with_target(tokens: tuple[Token, ...], target: str) -> tuple[Token, ...]:
    """Mark the words of a name that repeat the folder's."""
    for start in range(len(tokens)):
        for stop in range(len(tokens), start, -1):
            if joined(tokens[start:stop]) == target:
                return (*tokens[:start], Token(TARGET, tokens[start].gap, "target"), *tokens[stop:])
    return tokens


def joined(tokens: Sequence[Token]) -> str:
    """The text of some parts as it stood; what stood before the first is left out."""
    text = "".join(t.gap + t.text for t in tokens)
    return text[len(tokens[0].gap) :] if tokens else ""


def deepest(folders: tuple[str, ...]) -> int:
    """The deepest folder that has a name of its own, else the root."""
    levels = [i for i, name in enumerate(folders) if name.lower() not in GENERIC]
    return levels[-1] if levels else PARENT


DARK = frozenset(
    [
        "dark",
        "darks",
        "darkframe",
        "darkref",
        "darkfield",
        "black",
        "blackref",
        "bias",
        "lenscap",
        "dunkel",
        "schwarz",
        "noir",
        "noire",
    ]
)
WHITE = frozenset(
    [
        "white",
        "whites",
        "whiteref",
        "whiteboard",
        "flat",
        "flats",
        "flatfield",
        "ff",
        "spectralon",
        "weiss",
        "blanc",
        "blanche",
    ]
)
CHARTS = {
    "colorchecker": "ColorChecker24",
    "colourchecker": "ColorChecker24",
    "macbeth": "ColorChecker24",
    "passport": "ColorChecker24",
    "ccsg": "ColorCheckerSG",
    "digitalsg": "ColorCheckerSG",
    "colorcheckersg": "ColorCheckerSG",
    "chart": "ColorChecker24",
}
"""Names of charts, and the reference that each most likely is."""
IMAGES = frozenset(
    [
        "photo",
        "photograph",
        "foto",
        "vis",
        "visible",
        "rgb",
        "color",
        "colour",
        "uv",
        "uvf",
        "uvl",
        "uvr",
        "ir",
        "irr",
        "irrgb",
        "irfc",
        "nir",
        "swir",
        "xray",
        "xr",
        "xrr",
        "radiograph",
        "radiography",
        "raking",
        "transmitted",
        "reflected",
        "fluorescence",
        "thermal",
        "reflectogram",
    ]
)
"""Kinds of technical photographs: in a name they tell the camera, not the object."""
SENSORS = frozenset(
    ["ccd", "cam", "camera", "sensor", "lens", "head", "chip", "cmos", "det", "detector"]
)
BANDS = frozenset(["band", "b", "ch", "chan", "channel", "filter", "f", "led"])
LIGHTS = re.compile(
    r"(?i)(\d+[-_ ]?(deg|degree|degrees|°)|.*(polari[sz]ed|polar|diffuse|raking|light|lamp|soft|cross|"
    r"proposed|d50|d65|led|halogen|tungsten|flash|left|right|specular).*|45)"
)
"""Names of lightings."""
MILD = re.compile(r"(?i).*(proposed|diffuse|soft|normal|default|standard|cross).*")
"""Of several lightings the one that is most likely the default."""
GENERIC = frozenset(
    [
        "raw",
        "raws",
        "frame",
        "frames",
        "image",
        "images",
        "img",
        "imgs",
        "data",
        "capture",
        "captures",
        "captured",
        "light",
        "lights",
        "shot",
        "shots",
        "tif",
        "tiff",
        "tiffs",
        "png",
        "jpg",
        "jpeg",
        "nef",
        "dng",
        "cr2",
        "cr3",
        "arw",
        "envi",
        "scans",
        "scan",
        "files",
        "original",
        "originals",
        "picture",
        "pictures",
        "object",
        "objects",
        "sample",
        "samples",
    ]
)
"""Folders that name nothing."""
PREFIXES = frozenset(
    [
        "img",
        "dsc",
        "dscf",
        "dscn",
        "dscn",
        "p",
        "mg",
        "im",
        "image",
        "frame",
        "capture",
        "scan",
        "shot",
        "pict",
        "cimg",
        "sam",
        "raw",
        "file",
        "pic",
    ]
)
"""What cameras write before their running number."""
MODELS = re.compile(
    r"(?i)(lctf|vis|nir|rgb|cam|msi|hsi|multispectral|hyperspectral|kinect|silios|d\d+$)"
)

_UNITS = "ms|us|µs|ns|s|sec|min"
_KINDS = {
    "time": re.compile(
        r"(19|20)\d\d[-.]?[01]\d[-.]?[0-3]\d([-T]?[0-2]\d[-.h]?[0-5]\d([-.m]?[0-5]\d)?)?(-\d+)?"
    ),
    "wavelength": re.compile(
        r"(?P<before>[A-Za-z]*?)(?P<number>\d{3,4}(?:\.\d+)?)(?P<after>[nN][mM])"
    ),
    "exposure": re.compile(
        rf"(?P<before>(?i:exp|exposure|t|it|int|e)?)(?P<number>\d+(?:\.\d+)?)(?P<after>(?i:{_UNITS}))"
    ),
    "number": re.compile(r"(?P<before>)(?P<number>\d+)(?P<after>)"),
    "numbered": re.compile(r"(?P<before>[A-Za-z][A-Za-z-]*?)(?P<number>\d+)(?P<after>)"),
}


@dataclass(frozen=True)
class Token:
    """One part of a name: its text, what stands before it, and what it looks like.

    `kind` is ``"time"``, ``"wavelength"``, ``"exposure"``, ``"number"``, ``"numbered"`` (letters and
    a number) or ``"word"``; `before`, `number` and `after` are the parts of one with a number.
    """

    text: str
    gap: str = ""
    kind: str = "word"
    before: str = ""
    number: str = ""
    after: str = ""

    @property
    def role(self) -> str:
        """``"dark"``, ``"white"``, ``"chart"`` or "", by the word itself."""
        return role_of(self.text)


def role_of(text: str) -> str:
    """Return ``"dark"``, ``"white"`` or ``"chart"`` where a single word says so, else "".

    Examples
    --------
    >>> role_of("Dark01"), role_of("whites"), role_of("macbeth"), role_of("darkness")
    ('dark', 'white', 'chart', '')
    """
    word = re.sub(r"[\d\W_]+$", "", text.lower())
    if word in DARK:
        return "dark"
    if word in WHITE:
        return "white"
    return "chart" if word in CHARTS else ""


def role_in(text: str) -> str:
    """Return the role of the first word of a name that has one: ``"white board"`` is a white."""
    roles = (role_of(word) for word in re.split(r"[\W_]+", text))
    return next((role for role in roles if role), "")


def tokens_of(stem: str) -> tuple[Token, ...]:
    """Take a name apart.

    Examples
    --------
    >>> [(t.text, t.kind) for t in tokens_of("d1_dark_100ms_2019-02-08-171146-0003")]
    [('d1', 'numbered'), ('dark', 'word'), ('100ms', 'exposure'), ('2019-02-08-171146-0003', 'time')]
    >>> [t.text for t in tokens_of("icon1-550nm") + tokens_of("4-22-22_right")]
    ['icon1', '550nm', '4-22-22', 'right']
    """
    tokens: list[Token] = []
    for gap, text in _split(stem, r"[_\s~+,()\[\]]+|\.(?!\d)|(?<!\d)\."):
        parts = _split(text, "-")
        told = [_typed(part, before) for before, part in parts]
        splits = len(parts) > 1 and _KINDS["time"].fullmatch(text) is None
        if splits and any(t.kind in ("wavelength", "exposure") or t.role for t in told):
            first = told[0]
            tokens.append(
                Token(first.text, gap, first.kind, first.before, first.number, first.after)
            )
            tokens += told[1:]
        else:
            tokens.append(_typed(text, gap))
    return tuple(tokens)


def _split(text: str, pattern: str) -> list[tuple[str, str]]:
    """Split into (what stands before, part), so that joining them all gives the text again."""
    found, at, gap = [], 0, ""
    for cut in re.finditer(pattern, text):
        if cut.start() > at:
            found.append((gap, text[at : cut.start()]))
            gap = ""
        gap, at = gap + cut.group(), cut.end()
    found.append((gap, text[at:]))
    return found


def _typed(text: str, gap: str) -> Token:
    for kind, pattern in _KINDS.items():
        told = pattern.fullmatch(text)
        if told is None:
            continue
        parts = told.groupdict()
        if kind == "wavelength" and not 200 <= float(parts["number"]) <= 3000:
            continue
        return Token(text, gap, kind, **{k: v or "" for k, v in parts.items()})
    return Token(text, gap)

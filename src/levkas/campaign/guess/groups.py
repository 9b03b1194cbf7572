"""Which captures are of one camera, and which of them were taken under another lighting."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from levkas.campaign.discovery.patterns import SECONDS, natural
from levkas.campaign.guess.names import (
    BANDS,
    GENERIC,
    IMAGES,
    LIGHTS,
    MILD,
    PREFIXES,
    SENSORS,
    TARGET,
    Named,
    Token,
    role_in,
    signature,
    tokens_of,
)

Segments = tuple[tuple[Token, ...], ...]


@dataclass(frozen=True)
class Frame:
    """A capture with its whole path taken apart: a tuple of tokens for every folder, then the name's."""

    named: Named
    segments: Segments

    @property
    def role(self) -> str:
        """Of its target."""
        return self.named.role

    @property
    def target(self) -> str:
        """What it shows."""
        return self.named.target

    def with_role(self, role: str) -> Frame:
        """Return the frame with another role."""
        return replace(self, named=replace(self.named, role=role))

    @property
    def exposures_s(self) -> tuple[float, ...]:
        """Its exposure as its path or its header states it, s; several of a list by bands."""
        for token in (t for segment in self.segments for t in segment if t.kind == "exposure"):
            return (float(token.number) * SECONDS[token.after.lower()],)
        facts = self.named.seen.facts
        return facts.band_times_s or (() if facts.exposure_s is None else (facts.exposure_s,))

    def number(self, kind: str) -> str | None:
        """The number of its wavelength or exposure, as it stands in the path."""
        tokens = [t for segment in self.segments for t in segment if t.kind == kind]
        return tokens[0].number if tokens else None


@dataclass
class Group:
    """Captures of one camera.

    Attributes
    ----------
    frames : list of Frame
    name : str
        Of the camera.
    setups : dict
        Name of another lighting → its frames.
    notes : list of str
        What a person should know of how it was put together.
    """

    frames: list[Frame]
    name: str = ""
    setups: dict[str, list[Frame]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def of_role(self, *roles: str) -> list[Frame]:
        """Return the frames whose targets have one of some roles."""
        return [f for f in self.frames if f.role in roles]

    @property
    def folders(self) -> tuple[str, ...]:
        """Folders of its first object frame, with ``{target}``."""
        frames = self.of_role("object") or self.frames
        return frames[0].named.folders


def group_cameras(named: Sequence[Named], root_name: str) -> tuple[list[Group], list[str]]:
    """Put captures together camera by camera.

    Parameters
    ----------
    named : sequence of Named
    root_name : str
        Name of the folder that is looked at, for a camera without any other name.

    Returns
    -------
    groups : list of Group
    left_out : list of str
        What belongs to no camera, each with the reason.
    """
    frames = [Frame(n, _segments(n)) for n in named]
    groups = [Group(part) for group in _alike(frames) for part in _of_one_size(group)]
    groups, left_out = _attach_templates(groups)
    groups = _joined_pictures(_attach_setups(groups))
    _give_names(groups, root_name)
    return groups, left_out


def _segments(named: Named) -> Segments:
    return (*(_folder(name) for name in named.folders), named.stem)


def _folder(name: str) -> tuple[Token, ...]:
    """A folder is one word, but for a wavelength, an exposure, or the number of a sensor."""
    if name == TARGET:
        return (Token(TARGET, "", "target"),)
    told = tokens_of(name)
    one = told[0]
    sensor = one.kind == "numbered" and one.before.lower() in SENSORS | BANDS
    if len(told) == 1 and (one.kind in ("wavelength", "exposure") or sensor):
        return told
    return (Token(name),)


def _alike(frames: Iterable[Frame]) -> list[list[Frame]]:
    """Frames whose paths have the same words at the same places; numbers and units may differ."""
    groups: dict[object, list[Frame]] = defaultdict(list)
    for frame in frames:
        *folders, stem = frame.segments
        above = tuple(_word(s[0]) or s[0].kind for s in folders)
        words = tuple(w for w in map(_word, stem) if w)
        groups[above, words].append(frame)
    return list(groups.values())


def _word(token: Token) -> str:
    """What a part of a name says beside its numbers."""
    if token.kind in ("word", "target"):
        return "" if token.text.lower() in PREFIXES else token.text
    if token.kind == "numbered":
        return "" if token.before.lower() in PREFIXES else token.before
    return ""


def _of_one_size(frames: list[Frame]) -> list[list[Frame]]:
    """Part frames whose sizes differ, unless sensors or plain pictures explain it."""
    several = {signature(f.named.seen) for f in frames}
    if len(several) == 1 or sensor_of(frames[0]) or _are_pictures(frames):
        return [frames]
    parts: dict[object, list[Frame]] = defaultdict(list)
    for frame in frames:
        parts[signature(frame.named.seen)].append(frame)
    return list(parts.values())


def sensor_of(frame: Frame) -> str:
    """The part of a path that names one of several sensors, such as ``ccd1``; "" for none."""
    for segment in frame.segments:
        for token in segment:
            if token.kind == "numbered" and token.before.lower() in SENSORS:
                return token.text
    return ""


def _are_pictures(frames: Sequence[Frame]) -> bool:
    """Whether all are photographs or radiographs of any size, without darks and whites."""
    channels = {f.named.seen.channels for f in frames}
    plain = len(channels) == 1 and channels <= {1, 3}
    cubes = any(f.named.seen.facts.kind in ("envi", "raw") for f in frames)
    wavelengths = any(f.number("wavelength") for f in frames)
    roles = {f.role for f in frames}
    return plain and not cubes and not wavelengths and roles <= {"object", "chart"}


# --- darks and whites that stand apart --------------------------------------------------------


def _attach_templates(groups: list[Group]) -> tuple[list[Group], list[str]]:
    """Give groups of darks and whites alone to the camera whose frames have their size."""
    owners = [g for g in groups if g.of_role("object")]
    left_out = []
    for group in groups:
        if group in owners:
            continue
        here = signature(group.frames[0].named.seen)
        fits = [o for o in owners if any(signature(f.named.seen) == here for f in o.frames)]
        best = max((_shared(group, o) for o in fits), default=0)
        fits = [o for o in fits if _shared(group, o) == best]
        names = sorted({f.named.seen.name for f in group.frames}, key=natural)
        told = names[0] if len(names) == 1 else f"{names[0]} … {names[-1]} ({len(names)} files)"
        what = "/".join(sorted({f.role for f in group.frames}))
        if len(fits) == 1:
            fits[0].frames += group.frames
        elif fits:
            left_out.append(f"{told}: {what}, and several cameras have frames of its size")
        else:
            size = "x".join(str(n) for n in reversed(group.frames[0].named.seen.facts.shape[:2]))
            left_out.append(f"{told}: {what} of {size}, and no object's frame has this size")
    return owners, left_out


def _shared(group: Group, owner: Group) -> int:
    """How many parts of their paths two groups have in common."""
    one, other = (
        Counter(_word(t) for s in g.frames[0].segments for t in s if _word(t))
        for g in (group, owner)
    )
    return sum((one & other).values())


# --- other lightings --------------------------------------------------------------------------


def _attach_setups(groups: list[Group]) -> list[Group]:
    """Make a setup of a group that differs from another in one folder that names a lighting."""
    kept: list[Group] = []
    order = sorted(groups, key=lambda g: (len(g.folders), not MILD.match("/".join(g.folders))))
    for group in order:
        for base in kept:
            name, own = _difference(base, group)
            if not name:
                continue
            base.setups[name] = group.frames
            if own:
                base.notes.append(f"the lighting in folder {own!r} is taken for the default one")
            break
        else:
            kept.append(group)
    return sorted(kept, key=groups.index)


def _difference(base: Group, other: Group) -> tuple[str, str]:
    """The folder that `other` has more, or another of, and what stands in its place in `base`."""
    one, two = base.folders, other.folders
    if signature(base.frames[0].named.seen) != signature(other.frames[0].named.seen):
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


def _joined_pictures(groups: list[Group]) -> list[Group]:
    """Make one camera of folders of pictures that have no object in common: none could be registered."""
    kept: list[Group] = []
    for group in groups:
        twin = next((k for k in kept if _could_be_one(k, group)), None)
        if twin is None:
            kept.append(group)
            continue
        twin.frames += group.frames
        twin.notes = ["no two of these folders have an object in common: taken for one camera's"]
    return kept


def _could_be_one(one: Group, other: Group) -> bool:
    frames = [*one.frames, *other.frames]
    told = {name.lower() for name in (*one.folders, *other.folders)} & IMAGES
    words = {w.lower() for g in (one, other) for t in g.frames[0].segments[-1] if (w := _word(t))}
    apart = not {f.target for f in one.frames} & {f.target for f in other.frames}
    return apart and not told and not words & IMAGES and _are_pictures(frames)


# --- names ------------------------------------------------------------------------------------


def _give_names(groups: list[Group], root_name: str) -> None:
    """Name each camera after a folder, words in its files' names, its model, or the root: one's own first."""
    offered = [[safe_name(name) for name in _names(group, root_name)] for group in groups]
    times = Counter(name.casefold() for names in offered for name in dict.fromkeys(names))
    taken: Counter[str] = Counter()
    for group, names in zip(groups, offered, strict=True):
        name = next((n for n in names if times[n.casefold()] == 1), names[0])
        taken[name.casefold()] += 1
        group.name = name if taken[name.casefold()] == 1 else f"{name}-{taken[name.casefold()]}"


def _names(group: Group, root_name: str) -> list[str]:
    frames = group.of_role("object") or group.frames
    *folders, stem = frames[0].segments
    own = [
        s[0].text
        for s in reversed(folders)
        if s[0].kind == "word"
        and s[0].text.lower() not in GENERIC
        and not LIGHTS.fullmatch(s[0].text)
        and s[0].text != ".."
        and not role_in(s[0].text)
    ]
    shared = set.intersection(*({t.text for t in f.segments[-1]} for f in frames))
    words = [t.text for t in stem if t.kind == "word" and t.text in shared and _word(t)]
    model = frames[0].named.seen.facts.model
    return [*own, *(["-".join(words)] if words else []), model or root_name or "camera", "camera"]


def safe_name(name: str) -> str:
    """Return a name as a camera or setup can bear it: what file names cannot hold becomes ``-``."""
    kept = "".join(c if c.isalnum() or c in "-_ ." else "-" for c in name).strip("-_. ")
    kept = kept.replace(" ", "-")[:60] or "camera"
    return f"{kept}-camera" if kept.lower() == "grid" else kept

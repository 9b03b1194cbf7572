"""Group captures by camera, and by the lighting they were taken under."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from levkas.campaign.discovery.patterns import natural
from levkas.campaign.guess.names import NamedFile
from levkas.campaign.guess.words import GENERIC, IMAGES, LIGHTS, MILD, TARGET, role_in


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
        """Frames of objects; all frames where there is none."""
        return self.of_role("object") or self.frames

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
    groups = _joined_pictures(_attach_setups(groups))
    _give_names(groups, root_name)
    return groups, left_out


def _of_one_size(frames: list[NamedFile]) -> list[list[NamedFile]]:
    """Part frames whose sizes differ, unless sensors or plain pictures explain it."""
    parts: dict[object, list[NamedFile]] = defaultdict(list)
    for frame in frames:
        parts[frame.file.signature].append(frame)
    whole = len(parts) == 1 or frames[0].sensor or _are_pictures(frames)
    return [frames] if whole else list(parts.values())


def _are_pictures(frames: Sequence[NamedFile]) -> bool:
    """Whether all are photographs or radiographs of any size, without darks and whites."""
    channels = {f.file.channels for f in frames}
    plain = len(channels) == 1 and channels <= {1, 3}
    cubes = any(f.facts.kind in ("envi", "raw") for f in frames)
    wavelengths = any(f.number("wavelength") for f in frames)
    return (
        plain and not cubes and not wavelengths and {f.role for f in frames} <= {"object", "chart"}
    )


# --- darks and whites that lie apart ----------------------------------------------------------


def _attach_templates(groups: list[CameraGroup]) -> tuple[list[CameraGroup], list[str]]:
    """Give groups of darks and whites alone to the camera whose frames have their size."""
    owners = [g for g in groups if g.of_role("object")]
    left_out = []
    for group in groups:
        if group in owners:
            continue
        size = group.frames[0].file.signature
        fits = [o for o in owners if any(f.file.signature == size for f in o.frames)]
        best = max((_shared_words(group, o) for o in fits), default=0)
        fits = [o for o in fits if _shared_words(group, o) == best]
        names = sorted({f.file.name for f in group.frames}, key=natural)
        shown = names[0] if len(names) == 1 else f"{names[0]} … {names[-1]} ({len(names)} files)"
        what = "/".join(sorted({f.role for f in group.frames}))
        if len(fits) == 1:
            fits[0].frames += group.frames
        elif fits:
            left_out.append(f"{shown}: {what}, and several cameras have frames of its size")
        else:
            sides = "x".join(str(n) for n in reversed(group.frames[0].facts.shape[:2]))
            left_out.append(f"{shown}: {what} of {sides}, and no object's frame has this size")
    return owners, left_out


def _shared_words(group: CameraGroup, owner: CameraGroup) -> int:
    """Count the words that the paths of two groups have in common."""
    one, other = (
        Counter(t.word for s in g.frames[0].segments for t in s if t.word) for g in (group, owner)
    )
    return sum((one & other).values())


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
                base.notes.append(f"the lighting in folder {own!r} is taken for the default one")
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
        twin.notes = ["no two of these folders have an object in common: taken for one camera's"]
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
    names = [s[0].text for s in reversed(folders) if s[0].kind == "word"]
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
    model = frames[0].facts.model
    return [*own, *(["-".join(words)] if words else []), model or root_name or "camera", "camera"]


def safe_name(name: str) -> str:
    """Return a name as a camera or setup can bear it: what file names cannot hold becomes ``-``."""
    kept = "".join(c if c.isalnum() or c in "-_ ." else "-" for c in name).strip("-_. ")
    kept = kept.replace(" ", "-")[:60] or "camera"
    return f"{kept}-camera" if kept.lower() == "grid" else kept

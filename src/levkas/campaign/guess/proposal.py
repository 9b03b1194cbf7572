"""Propose a campaign for a folder of captures: cameras, reference, targets, and a campaign.toml with reasons."""

from __future__ import annotations

import re
import textwrap
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from levkas.campaign.campaign import campaign_of
from levkas.campaign.discovery.file_index import declared_targets, scan_folders
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.discovery.patterns import natural
from levkas.campaign.guess.appearance import infer_roles
from levkas.campaign.guess.band_names import Question
from levkas.campaign.guess.describe import (
    CameraGuess,
    Guess,
    describe_camera,
    with_choices,
)
from levkas.campaign.guess.groups import CameraGroup, group_cameras
from levkas.campaign.guess.leftovers import leave_out_leftovers
from levkas.campaign.guess.listing import CaptureFile, Listing
from levkas.campaign.guess.names import name_targets
from levkas.campaign.guess.pixels import Samples
from levkas.campaign.guess.tiles import mark_tiles
from levkas.campaign.guess.words import chart_in
from levkas.campaign.schema.cross_checks import find_contradictions
from levkas.campaign.schema.names import is_safe_name
from levkas.campaign.schema.tables import Document
from levkas.campaign.schema.toml import to_inline_toml, to_toml_key
from levkas.core.cube import band_labels
from levkas.core.problems import Problem, Refused
from levkas.readers.frames import read_headers
from levkas.readers.orientation import grid_keys

WIDTH = 100
COLUMN = 53
"""Column of the comments beside short keys."""
GREEN_NM = 550.0
"""Eyes and lenses are at their best here; the reference band of the paper."""
VISIBLE_NM, NEAR_NM = (400.0, 720.0), 30.0
PHOTOGRAPHS = r"(.*[-_ ])?(photo|photograph|foto|vis|visible|optical|rgb|color|colour)([-_ ].*)?"
"""Names of cameras that took the picture as one sees it."""
"""Fitness of kinds as the reference: a sharp frame a band, then a sharp mosaic."""
MOST_LISTED = 6
UNKNOWN_WHITE = "the reflectance of the white board: 1 is assumed"


class LookRefused(Refused):
    """A folder holds nothing that a campaign could be made of, or already has one."""


@dataclass(frozen=True)
class Proposal:
    """A whole campaign as it was guessed.

    Parameters
    ----------
    root : Path
        The folder that was looked at, where campaign.toml belongs.
    described : dict
        Keys of [campaign].
    cameras : tuple of CameraGuess
    targets : dict
        Keys of [targets].
    objects : tuple of str
    hints : tuple of str
        Keys of [targets] that may be wanted, as comments.
    unknown : tuple of str
        What a person must fill in; empty where nothing is left open.
    left_out : tuple of str
        FilePatterns that are in no camera, and why.
    grid : dict
        Keys of [grid], by the orientation that the reference camera's files state.
    """

    root: Path
    described: dict[str, Guess]
    cameras: tuple[CameraGuess, ...]
    targets: dict[str, Guess]
    objects: tuple[str, ...]
    hints: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    grid: dict[str, Guess] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The whole campaign.toml."""
        return "\n".join(_document(self)) + "\n"

    def to_dict(self) -> dict[str, Any]:
        """Return the content of campaign.toml, as a parser reads it."""
        return tomllib.loads(self.text)

    def to_report(self) -> dict[str, Any]:
        """Return the report of `--json`: the campaign, its text, what is unknown, what is left out."""
        return {
            "campaign": self.to_dict(),
            "toml": self.text,
            "unknown": list(self.unknown),
            "left_out": list(self.left_out),
        }


def propose(listing: Listing) -> Proposal:
    """Make a proposal of a listing that holds at least one capture."""
    samples = Samples()
    captures, left_out = leave_out_leftovers(listing.captures)
    named, questions = name_targets(captures, samples)
    named = mark_tiles(named)
    tiles = {one.path for one in named if one.tile}
    questions = [one for one in questions if tiles.isdisjoint(f.path for f in one.files)]
    groups, without_camera = group_cameras(named, listing.root.resolve().name)
    left_out += without_camera
    if not groups:
        raise LookRefused(_no_object(listing, left_out))
    by_eye = [f"{g.name}: {reason}" for g in groups for reason in infer_roles(g, samples)]
    unknown = by_eye + _without_conflicts(groups)
    finest = max(max(g.frames[0].facts.shape[:2]) for g in groups)
    cameras = [describe_camera(g, samples, finest) for g in groups]
    if questions:
        cameras = _with_questions(cameras, groups, questions, captures, samples)
    alone = len(cameras) == 1 and not cameras[0].traits.is_calibrated and not cameras[0].choices
    if alone and len(cameras[0].targets) > 1:
        unknown.append(
            "whether some of these pictures show the same object: each is treated as a separate "
            "object, and one camera needs no registration"
        )
    shapes = [group.frames[0].facts.shape for group in groups]
    sizes = [shape[0] * shape[1] for shape in shapes]
    reference, why = _reference(cameras, sizes)
    cameras, unrelated = _without_unrelated(cameras, reference)
    left_out += unrelated
    how = "by their histograms" if by_eye else "by their names"
    targets, objects, more = _targets(cameras, reference.name, how)
    unknown += [text for camera in cameras for text in camera.unknown] + more
    if tables := [name for name in listing.tables if re.search("(?i)white|reflect|sensitiv", name)]:
        unknown.append(f"what {_listed(tables)} hold: `reflectance` of a white, or `sensitivity`")
    unreadable = {**listing.unreadable, **samples.refused}
    left_out += [f"{name}: {reason}" for name, reason in unreadable.items()]
    grid, more = _upright(next(g for g in groups if g.name == reference.name))
    unknown += more
    band = _band(reference)
    keys = {"camera": reference.name} | ({"band": band} if band else {})
    proposal = Proposal(
        root=listing.root,
        described={
            "title": Guess(listing.root.resolve().name.replace("_", " ")),
            "reference": Guess(keys, why),
        },
        cameras=tuple(_with_own_templates(c, targets) for c in cameras),
        targets=targets,
        objects=tuple(objects),
        hints=_hints(targets) if UNKNOWN_WHITE in unknown else (),
        unknown=tuple(_shortened(unknown)),
        left_out=tuple(_shortened(left_out)),
        grid=grid,
    )
    more = _shortened(_read_back(proposal, captures))
    return replace(proposal, unknown=(*proposal.unknown, *more))


def _with_questions(
    cameras: Sequence[CameraGuess],
    groups: Sequence[CameraGroup],
    questions: Sequence[Question],
    captures: Sequence[CaptureFile],
    samples: Samples,
) -> list[CameraGuess]:
    """Leave both ways open for cameras of which nothing decides whether their files are bands or objects."""
    named, _ = name_targets(captures, samples, undecided_as_bands=True)
    named = mark_tiles(named)
    others, _ = group_cameras(named, "")
    open_cameras = list(cameras)
    for question in questions:
        files = {capture.path for capture in question.files}
        shares = [len(files & {f.path for f in group.frames}) for group in groups]
        own = shares.index(max(shares))
        bands = next((g for g in others if files & {f.path for f in g.frames}), None)
        decided = groups[own].of_role("dark", "white")  # by their histograms
        if bands is not None and not decided:
            beside = [g.name for g, share in zip(groups, shares, strict=True) if share]
            beside.remove(groups[own].name)
            open_cameras[own] = with_choices(open_cameras[own], bands, question, beside)
    return open_cameras


def _no_object(listing: Listing, left_out: Sequence[str]) -> Problem:
    return Problem(
        "E_NO_FRAMES",
        "all captures here are darks or whites",
        file=str(listing.root),
        found="; ".join(left_out[:MOST_LISTED]),
        expected="frames of an object or a chart",
        fix="Give the folder that holds the objects' frames too.",
    )


def _without_conflicts(groups: Sequence[CameraGroup]) -> list[str]:
    """Take a target for an object everywhere where cameras disagree; return what was so decided."""
    roles: dict[str, set[str]] = {}
    for frame in (f for g in groups for f in g.frames):
        roles.setdefault(frame.target, set()).add(frame.role)
    doubted = {target for target, shown in roles.items() if len(shown) > 1}
    for group in groups:
        group.frames = [f.with_role("object") if f.target in doubted else f for f in group.frames]
    return [
        f"whether {name} is an object: some cameras' frames do not look like one"
        for name in sorted(doubted)
    ]


def _read_back(proposal: Proposal, captures: Sequence[CaptureFile]) -> list[str]:
    """Read the proposal as a campaign and find its captures; return what would be refused, and why, and what none takes."""
    root = proposal.root.resolve()
    # Of every question the first answer is read.
    cameras = tuple(replace(camera, choices=()) for camera in proposal.cameras)
    proposal = replace(proposal, cameras=cameras)
    document = Document.model_validate(proposal.to_dict())
    if wrong := list(find_contradictions(document, root)):
        return [str(p) for p in wrong]
    try:
        campaign = campaign_of(document, root / "campaign.toml")
        index = scan_folders(campaign)
        _, refusals = find_captures(campaign, index)
    except Refused as refused:
        return [str(p) for p in refused.problems]
    lines = []
    for (name, camera, setup), refusal in refusals.items():
        layer = f"{camera}@{setup}" if setup else camera
        for problem in refusal.problems:
            fix = f". {problem.fix}" if problem.fix else ""
            lines.append(f"{name}/{layer} would be refused: {problem.message}{fix}")
    named = {*index.objects, *declared_targets(campaign)}
    taken = {f.path for frames in index.frames.values() for f in frames if f.target in named}
    lost = (c.name for c in captures if root / c.path.relative_to(proposal.root) not in taken)
    return [*lines, *(f"what {name} shows: no camera here takes it" for name in lost)]


# --- reference --------------------------------------------------------------------------------


def _reference(cameras: Sequence[CameraGuess], sizes: Sequence[int]) -> tuple[CameraGuess, str]:
    """Return the camera to register the others to: it saw most objects, has most bands in the visible."""

    def worth(i: int) -> tuple[float, ...]:
        camera = cameras[i]
        objects = len(_shown(camera))
        visible = [w for w in camera.centres if VISIBLE_NM[0] <= w <= VISIBLE_NM[1]]
        near = bool(visible) and min(abs(w - GREEN_NM) for w in visible) <= NEAR_NM
        plain = not camera.traits.is_calibrated and bool(
            re.fullmatch(PHOTOGRAPHS, camera.name.lower())
        )
        order = camera.traits.rank, len(visible), plain, sizes[i]
        return objects, near or not camera.centres, *order

    best = max(range(len(cameras)), key=worth)
    why = (
        "the only camera"
        if len(cameras) == 1
        else "a guess: all other cameras are registered to it"
    )
    return cameras[best], why


def _shown(camera: CameraGuess) -> set[str]:
    """Return the objects that a camera saw, the charts of one that saw no object."""
    objects = {target for target, role in camera.targets.items() if role == "object"}
    return objects or {target for target, role in camera.targets.items() if role == "chart"}


def _without_unrelated(
    cameras: Sequence[CameraGuess], reference: CameraGuess
) -> tuple[list[CameraGuess], list[str]]:
    """Leave out cameras that saw no object of the reference camera: nothing of them can be registered."""
    known, kept, left_out = _shown(reference), [], []
    theirs = sorted(known, key=natural)
    for camera in cameras:
        own = sorted(_shown(camera), key=natural)
        charts_alone = "object" not in {*reference.targets.values(), *camera.targets.values()}
        if charts_alone or not known.isdisjoint(own):
            kept.append(camera)
            continue
        left_out.append(
            f"{_files_of(camera, own)}: the object is {_listed(own)} by its name, and {_listed(theirs)} by that of the "
            f"reference, {_files_of(reference, theirs)}. Give an object one name in the files of all cameras "
            "(saint_photo.tif, saint_infrared.tif, or photo/saint.tif), or run `levkas look` on the folder of these alone"
        )
    return kept, left_out


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:MOST_LISTED]) + ", …" * (len(names) > MOST_LISTED)


def _files_of(camera: CameraGuess, targets: Sequence[str]) -> str:
    """Return the first pattern of a camera; where it has but one target, with its name."""
    files = camera.keys["files"].value
    pattern = files if isinstance(files, str) else files[0]
    return pattern.replace("{target}", targets[0]) if len(targets) == 1 else pattern


def _band(camera: CameraGuess) -> str:
    """Return the label of the band nearest to green; "" where the default, the middle one, will do."""
    centres = camera.centres
    if not centres or (camera.traits.is_broad and not camera.sensors):
        return ""
    place = min(range(len(centres)), key=lambda i: abs(centres[i] - GREEN_NM))
    if not camera.sensors:
        return band_labels(centres)[place]
    labels = [label for s in camera.sensors for label in s.keys["bands"].value]
    return str(labels[place]) if len(labels) == len(centres) else ""


def _upright(group: CameraGroup) -> tuple[dict[str, Guess], list[str]]:
    """Return the keys of [grid] that show the reference camera's files upright, and what is unknown where they differ."""
    stated = {_orientation(frames[0].path) for frames in group.by_target(group.objects).values()}
    if len(stated) > 1:
        return {}, [
            "how the grid is turned: the files of objects differ in their EXIF orientation, and [grid] turns all alike"
        ]
    turn = stated.pop()
    why = f"EXIF orientation {turn}: so viewers show these files"
    return {key: Guess(value, why) for key, value in (grid_keys(turn) if turn else {}).items()}, []


def _orientation(path: Path) -> int | None:
    try:
        return read_headers(path).orientation
    except Refused:
        return None


# --- targets ----------------------------------------------------------------------------------


def _targets(
    cameras: Sequence[CameraGuess], reference: str, how: str
) -> tuple[dict[str, Guess], list[str], list[str]]:
    """Return the keys of [targets], the objects, and what is unknown of them."""
    gathered: dict[str, dict[str, None]] = {"dark": {}, "white": {}, "chart": {}, "object": {}}
    for camera in cameras:
        for target, role in camera.targets.items():
            gathered[role][target] = None
    by_role = {role: list(names) for role, names in gathered.items()}
    calibrated = {t for c in cameras if c.traits.is_calibrated for t in c.targets}
    unknown: list[str] = []
    keys: dict[str, Guess] = {}
    if dark := sorted(by_role["dark"], key=natural):
        keys["dark"] = Guess(dark[0] if len(dark) == 1 else dark, how)
    if white := sorted(by_role["white"], key=natural):
        one: object = white[0] if len(white) == 1 else white
        keys["white"] = Guess(one, f"{how}; the files do not give its reflectance")
        unknown += [UNKNOWN_WHITE] if set(white) & calibrated else []
        unknown += [
            f"whether {name} is a white, or {one} under white light"
            for name in white
            for one in by_role["object"]
            if name.startswith(one)
        ]
    if len(dark) > 1 or len(white) > 1:
        unknown.append(
            "whether each dark or white serves all objects: {object} in `files` says which one it serves"
        )
    charts = {t: _chart(t) for t in sorted(by_role["chart"], key=natural)}
    if charts:
        keys["charts"] = Guess(charts, "from their names; check the type of each chart")
    registered = next(c.targets for c in cameras if c.name == reference)
    objects = sorted(by_role["object"], key=natural)
    if unsafe := [name for name in objects if not is_safe_name(name)]:
        unknown.append(
            f"a name for {', '.join(unsafe[:MOST_LISTED])}: file names cannot contain these characters"
        )
    objects = [name for name in objects if name not in unsafe]
    lost = [name for name in objects if name not in registered]
    if lost:
        unknown.append(f"the reference camera's image of {', '.join(lost[:MOST_LISTED])}")
    objects = [name for name in objects if name in registered]
    if objects and not any(camera.choices for camera in cameras):
        keys["objects"] = Guess(objects, "all other targets" if dark or white or charts else "")
    return keys, objects, unknown


def _hints(targets: dict[str, Guess]) -> tuple[str, ...]:
    white = to_inline_toml({"names": targets["white"].value, "reflectance": 0.98})
    return (f"white = {white}  # a share, or a CSV over wavelength",)


def _chart(target: str) -> str:
    words = re.split(r"[\W_]+", target)
    named = (
        chart_in("".join(words[i:j])) for i in range(len(words)) for j in range(len(words), i, -1)
    )
    return next((chart for chart in named if chart), "ColorChecker24")


def _with_own_templates(camera: CameraGuess, targets: dict[str, Guess]) -> CameraGuess:
    """Add to a camera that it has no dark or white where others have one, and a chart as a hint in its place."""
    if not camera.traits.is_calibrated:
        return camera
    keys = dict(camera.keys)
    for role in ("dark", "white"):
        if role in targets and role not in camera.targets.values():
            keys[role] = Guess([], f"no {role} of this camera was found")
    charts = [name for name, role in camera.targets.items() if role == "chart"]
    if charts and "white" not in camera.targets.values() and camera.traits.by_chart:
        value = to_inline_toml({"chart": min(charts, key=natural)})
        instead = " instead of the line above" if "white" in keys else ""
        hint = f"white = {value}  # reflectance by the chart{instead}"
        return replace(camera, keys=keys, hints=(*camera.hints, hint))
    return replace(camera, keys=keys)


# --- the campaign -----------------------------------------------------------------------------


def _shortened(lines: Sequence[str]) -> list[str]:
    """Leave out repetitions, and the tail of a long list."""
    shown = list(dict.fromkeys(lines))
    if len(shown) <= 3 * MOST_LISTED:
        return shown
    return [*shown[: 3 * MOST_LISTED], f"… and {len(shown) - 3 * MOST_LISTED} more"]


# --- the text ----------------------------------------------------------------------------------


def _document(proposal: Proposal) -> Iterator[str]:
    yield "# Proposed by `levkas look` from the names, headers and pixels of the files. Check it before you build."
    for title, lines in (
        ("Unknown; please fill in:", proposal.unknown),
        ("Left out:", proposal.left_out),
    ):
        if lines:
            yield f"# {title}"
        for line in lines:
            yield from _wrapped(line, first="# - ", rest="#   ")
    yield "[campaign]"
    yield from _table(proposal.described)
    if proposal.grid:
        yield "\n[grid]"
        yield from _table(proposal.grid)
    for camera in proposal.cameras:
        yield ""
        yield from (line for about in camera.about for line in _wrapped(about))
        yield f"[cameras.{to_toml_key(camera.name)}]"
        chosen = {key for choice in camera.choices for key in choice.keys}
        for choice in camera.choices:
            yield from _commented(choice.what, choice.keys) if choice.keys else ()
        yield from _table({key: guess for key, guess in camera.keys.items() if key not in chosen})
        yield from (f"# {hint}" for hint in camera.hints)
        for sensor in camera.sensors:
            yield f"\n[[cameras.{to_toml_key(camera.name)}.sensors]]"
            yield from _table({"name": Guess(sensor.name), **sensor.keys})
    choices = [choice for camera in proposal.cameras for choice in camera.choices]
    if proposal.targets or choices:
        yield "\n[targets]"
        yield from _table(proposal.targets)
        for choice in choices:
            yield from _commented(choice.what, {"objects": Guess(choice.objects)})
        yield from (f"# {hint}" for hint in proposal.hints)
    for camera in proposal.cameras:
        for name, files in camera.setups.items():
            yield f"\n[setups.{to_toml_key(name)}.cameras.{to_toml_key(camera.name)}]"
            yield from _table({"files": files})
    if proposal.objects:
        yield f"\n# [objects.{to_toml_key(proposal.objects[0])}]"
        yield from _aligned('# title = ""', "facts from the museum's records; all optional")
        yield from _aligned("# size_mm = [width, height]", "gives the sampling in px per mm")


def _commented(what: str, keys: dict[str, Guess]) -> Iterator[str]:
    yield f"# {what}"
    yield from (f"#     {line}" for line in _table(keys))


def _table(keys: dict[str, Guess]) -> Iterator[str]:
    for key, guess in keys.items():
        value = to_inline_toml(guess.value)
        listed = isinstance(guess.value, list | tuple) and len(value) > WIDTH - len(key) - 3
        if not listed:
            yield from _aligned(f"{key} = {value}", guess.why)
            continue
        yield from _aligned(f"{key} = [", guess.why)
        yield from (
            f"    {line}" for line in _filled([f"{to_inline_toml(v)}," for v in guess.value])
        )
        yield "]"


def _aligned(line: str, why: str) -> Iterator[str]:
    """Yield a key with its comment beside it, or above where it is long."""
    if not why:
        yield line
    elif len(line) < COLUMN and COLUMN + 2 + len(why) <= WIDTH + 10:
        yield f"{line:{COLUMN}}# {why}"
    elif len(line) + 4 + len(why) <= WIDTH:
        yield f"{line}  # {why}"
    else:
        yield from _wrapped(why)
        yield line


def _wrapped(text: str, *, first: str = "# ", rest: str = "# ") -> Iterator[str]:
    clean = " ".join(text.split())
    yield from textwrap.wrap(
        clean, WIDTH, initial_indent=first, subsequent_indent=rest, break_long_words=False
    )


def _filled(parts: Sequence[str]) -> Iterator[str]:
    line = ""
    for part in parts:
        if line and len(line) + 1 + len(part) > WIDTH - 4:
            yield line
            line = ""
        line = f"{line} {part}" if line else part
    if line:
        yield line

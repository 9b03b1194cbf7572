"""Cameras put together to a whole campaign: reference, targets, what is left unknown."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from levkas.campaign.discovery.patterns import natural
from levkas.campaign.guess.appearance import find_warmth, tell_roles
from levkas.campaign.guess.describe import describe_camera, find_white_table, with_sensitivity
from levkas.campaign.guess.groups import Group, group_cameras
from levkas.campaign.guess.listing import Listing
from levkas.campaign.guess.names import CHARTS, GENERIC, name_targets
from levkas.campaign.guess.pixels import Samples
from levkas.campaign.guess.proposal import CameraGuess, LookRefused, Proposal, Said, to_toml
from levkas.campaign.schema.cross_checks import find_contradictions, is_safe_name
from levkas.core.cube import band_labels
from levkas.core.problems import Problem, Refused

GREEN_NM = 550.0
"""Where eyes and lenses are at their best; the reference band of the paper."""
VISIBLE_NM, NEAR_NM = (400.0, 720.0), 30.0
PHOTOGRAPHS = r"(.*[-_ ])?(photo|photograph|foto|vis|visible|rgb|color|colour)([-_ ].*)?"
"""Names of cameras that took the picture as one sees it."""
RANKS = {"bands": 4, "mosaic": 3, "cube": 2, "sensors": 2, "image": 1}
"""Which kinds make the better reference: a sharp frame a band, then a sharp mosaic."""
MOST_TOLD = 6
UNKNOWN_WHITE = "what the white board reflects: 1 is taken"


def propose(listing: Listing) -> Proposal:
    """Make a proposal of a listing that holds at least one capture."""
    samples = Samples()
    named = name_targets(listing.seen, same_scene=samples.same_scene)
    groups, left_out = group_cameras(named, listing.root.resolve().name)
    if not groups:
        raise LookRefused(_no_object(listing, left_out))
    unknown: list[str] = []
    by_eye = [f"{g.name}: {told}" for g in groups for told in tell_roles(g, samples)]
    unknown += by_eye
    unknown += _without_conflicts(groups)
    warmth = find_warmth(groups, samples)
    cameras = [
        with_sensitivity(
            describe_camera(group, samples, warmth=warmth), listing.root, listing.tables
        )
        for group in groups
    ]
    if (
        all(c.kind == "image" for c in cameras)
        and len(cameras) == 1
        and len(cameras[0].targets) > 1
    ):
        unknown.append(
            "whether some of these pictures show one object: each is taken for an object of its own, "
            "and with one camera nothing is registered"
        )
    shapes = [group.frames[0].named.seen.facts.shape for group in groups]
    reference, why = _reference(cameras, [shape[0] * shape[1] for shape in shapes])
    how = "by their histograms" if by_eye else "by their names"
    targets, objects, more = _targets(listing, cameras, cameras[reference].name, how)
    unknown += [text for camera in cameras for text in camera.unknown] + more
    unreadable = {**listing.unreadable, **samples.refused}
    left_out += [f"{name}: {reason}" for name, reason in unreadable.items()]
    band = _band(cameras[reference])
    told = {"camera": cameras[reference].name} | ({"band": band} if band else {})
    described = {"title": Said(_title(listing.root)), **_date(listing)}
    described["reference"] = Said(told, why)
    proposal = Proposal(
        root=listing.root,
        described=described,
        cameras=tuple(_with_own_templates(c, targets) for c in cameras),
        targets=targets,
        objects=tuple(objects),
        hints=_hints(targets) if UNKNOWN_WHITE in unknown else (),
        unknown=tuple(_shortened(unknown)),
        left_out=tuple(_shortened(left_out)),
    )
    return replace(proposal, unknown=(*proposal.unknown, *_shortened(check(proposal))))


def _no_object(listing: Listing, left_out: Sequence[str]) -> Problem:
    return Problem(
        "E_NO_FRAMES",
        "all captures here are darks, whites or charts",
        file=str(listing.root),
        found="; ".join(left_out[:MOST_TOLD]),
        expected="frames of an object",
        fix="Give the folder that holds the objects' frames too.",
    )


def _without_conflicts(groups: Sequence[Group]) -> list[str]:
    """Take a target for an object everywhere where cameras disagree; return what was so decided."""
    roles: dict[str, set[str]] = {}
    for frame in (f for g in groups for f in g.frames):
        roles.setdefault(frame.target, set()).add(frame.role)
    doubted = {target for target, told in roles.items() if len(told) > 1}
    for group in groups:
        group.frames = [f.with_role("object") if f.target in doubted else f for f in group.frames]
    return [
        f"whether {name} is an object: not all cameras' frames look it" for name in sorted(doubted)
    ]


def check(proposal: Proposal) -> list[str]:
    """Read the proposal as a campaign and find its captures; return what would be refused, and why."""
    from levkas.campaign.campaign import Camera, Campaign, Document
    from levkas.campaign.discovery.find_captures import find_captures

    root = proposal.root.resolve()
    document = Document.model_validate(tomllib.loads(proposal.text))
    if wrong := list(find_contradictions(document, root)):
        return [str(p) for p in wrong]
    cameras = {
        name: Camera.model_construct(name=name, **dict(keys))
        for name, keys in document.cameras.items()
    }
    fields = {**dict(document), "cameras": cameras}
    campaign = Campaign.model_construct(**fields, path=root / "campaign.toml", root=root)
    try:
        _, refusals = find_captures(campaign)
    except Refused as refused:
        return [str(p) for p in refused.problems]
    told = []
    for (name, camera, setup), why in refusals.items():
        layer = f"{camera}@{setup}" if setup else camera
        for problem in why.problems:
            fix = f". {problem.fix}" if problem.fix else ""
            told.append(f"{name}/{layer} would be refused: {problem.message}{fix}")
    return told


# --- reference --------------------------------------------------------------------------------


def _reference(cameras: Sequence[CameraGuess], sizes: Sequence[int]) -> tuple[int, str]:
    """The camera to register the others to: it saw most objects, has most bands in the visible."""

    def worth(i: int) -> tuple[float, ...]:
        camera = cameras[i]
        objects = sum(role == "object" for role in camera.targets.values())
        visible = [w for w in camera.centres if VISIBLE_NM[0] <= w <= VISIBLE_NM[1]]
        near = bool(visible) and min(abs(w - GREEN_NM) for w in visible) <= NEAR_NM
        plain = camera.kind == "image" and bool(re.fullmatch(PHOTOGRAPHS, camera.name.lower()))
        return (
            objects,
            near or not camera.centres,
            RANKS[camera.kind],
            len(visible),
            plain,
            sizes[i],
        )

    best = max(range(len(cameras)), key=worth)
    why = "the only camera" if len(cameras) == 1 else "a guess: what all else is registered to"
    return best, why


def _band(camera: CameraGuess) -> str:
    """The label of the band nearest to green; "" where the default, the middle one, will do."""
    centres = camera.centres
    if not centres or camera.kind in ("mosaic", "image"):
        return ""
    place = min(range(len(centres)), key=lambda i: abs(centres[i] - GREEN_NM))
    if camera.kind != "sensors":
        return band_labels(centres)[place]
    labels = [label for s in camera.sensors for label in s.keys["bands"].value]
    return str(labels[place]) if len(labels) == len(centres) else ""


# --- targets ----------------------------------------------------------------------------------


def _targets(
    listing: Listing, cameras: Sequence[CameraGuess], reference: str, how: str
) -> tuple[dict[str, Said], list[str], list[str]]:
    """Keys of [targets], the objects, and what is unknown of them."""
    gathered: dict[str, dict[str, None]] = {"dark": {}, "white": {}, "chart": {}, "object": {}}
    for camera in cameras:
        for target, role in camera.targets.items():
            gathered[role][target] = None
    by_role = {role: list(names) for role, names in gathered.items()}
    calibrated = {t for c in cameras if c.kind != "image" for t in c.targets}
    unknown: list[str] = []
    keys: dict[str, Said] = {}
    if dark := sorted(by_role["dark"], key=natural):
        keys["dark"] = Said(dark[0] if len(dark) == 1 else dark, how)
    if white := sorted(by_role["white"], key=natural):
        keys["white"], told = _white(listing, white, how)
        unknown += told if set(white) & calibrated else []
    charts = {t: _chart(t) for t in sorted(by_role["chart"], key=natural)}
    if charts:
        keys["charts"] = Said(charts, "by their names; check which chart each is")
    seen = next(c.targets for c in cameras if c.name == reference)
    objects = sorted(by_role["object"], key=natural)
    if unsafe := [name for name in objects if not is_safe_name(name)]:
        unknown.append(f"how to call {', '.join(unsafe[:MOST_TOLD])}: file names cannot hold this")
    objects = [name for name in objects if name not in unsafe]
    lost = [name for name in objects if name not in seen]
    if lost:
        unknown.append(f"where the reference camera's image of {', '.join(lost[:MOST_TOLD])} is")
    objects = [name for name in objects if name in seen]
    if objects:
        keys["objects"] = Said(objects, "all other targets" if dark or white or charts else "")
    return keys, objects, unknown


def _white(listing: Listing, names: list[str], how: str) -> tuple[Said, list[str]]:
    """The white board, with a table of its reflectance where one stands beside."""
    one: object = names[0] if len(names) == 1 else names
    if table := find_white_table(listing.root, listing.tables):
        return Said({"names": one, "reflectance": table}, "the table that stands beside"), []
    return Said(one, f"{how}; what it reflects is not in the files"), [UNKNOWN_WHITE]


def _hints(targets: dict[str, Said]) -> tuple[str, ...]:
    white = to_toml({"names": targets["white"].value, "reflectance": 0.98})
    return (f"white = {white}  # a share, or a CSV over wavelength",)


def _chart(target: str) -> str:
    word = next((w for w in re.split(r"[\W_\d]+", target.lower()) if w in CHARTS), "chart")
    return CHARTS[word]


def _with_own_templates(camera: CameraGuess, targets: dict[str, Said]) -> CameraGuess:
    """Say of a camera that it has no dark or white where others have one."""
    if camera.kind == "image":
        return camera
    keys = dict(camera.keys)
    for role in ("dark", "white"):
        if role in targets and role not in camera.targets.values():
            keys[role] = Said([], f"no {role} of this camera was found")
    return replace(camera, keys=keys)


# --- the campaign -----------------------------------------------------------------------------


def _title(root: Path) -> str:
    here = root.resolve()
    name = here.parent.name if here.name.lower() in GENERIC and here.parent.name else here.name
    return name.replace("_", " ")


def _date(listing: Listing) -> dict[str, Said]:
    dates = sorted(s.facts.captured for s in listing.seen if s.facts.captured)
    return {"date": Said(dates[0][:10], "of the earliest capture, by its header")} if dates else {}


def _shortened(lines: Sequence[str]) -> list[str]:
    """Leave out what was said before, and the tail of a long list."""
    told = list(dict.fromkeys(lines))
    if len(told) <= 3 * MOST_TOLD:
        return told
    return [*told[: 3 * MOST_TOLD], f"… and {len(told) - 3 * MOST_TOLD} more"]

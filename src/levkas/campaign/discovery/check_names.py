"""Names in campaign.toml against the files that are there, before any stage runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from levkas.campaign.discovery.captures import CaptureRefused
from levkas.campaign.discovery.file_index import declared_targets
from levkas.campaign.discovery.find_captures import near_names
from levkas.campaign.discovery.patterns import natural
from levkas.core.problems import Problem, closest_match

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Refusals
    from levkas.campaign.discovery.file_index import FileIndex


def check_names(campaign: Campaign, index: FileIndex, refusals: Refusals) -> None:
    """Refuse a whole campaign for a name in campaign.toml that nothing bears, before any stage runs.

    Raises
    ------
    CaptureRefused
        For darks or whites that no camera has, an object that no camera has and that is like one that there
        is, and a reference camera that has no object at all; each mistake once.
    """
    there = sorted({f.target for found in index.frames.values() for f in found}, key=natural)
    problems = [*_lost_templates(campaign, there), *_lost_objects(campaign, index, there)]
    if there and problems:
        raise CaptureRefused(*problems)
    leads = [refusals.get((name, campaign.reference.camera, "")) for name in index.objects]
    lost = [refused for refused in leads if refused is not None]
    if lost and len(lost) == len(leads):
        raise CaptureRefused(*lost[0].problems)


def _lost_templates(campaign: Campaign, there: Sequence[str]) -> Iterator[Problem]:
    raw = [(name, camera) for name, camera in campaign.cameras.items() if camera.kind != "image"]
    roles = {f"cameras.{n}.{kind}": getattr(c, kind) for n, c in raw for kind in ("dark", "white")}
    if raw:  # photographs are calibrated by none
        roles["targets.dark"] = campaign.targets.dark
        roles["targets.white"] = campaign.targets.white.names if campaign.targets.white else ()
    for field, names in roles.items():
        if names and not set(names) & set(there):
            yield Problem(
                "E_TEMPLATE_MISSING",
                f"no camera has frames of {' or '.join(map(repr, names))}",
                str(campaign.path),
                field,
                ", ".join(names),
                f"one of {', '.join(there)}",
                fix=near_names(names, there) or "Add the frames.",
            )


def _lost_objects(campaign: Campaign, index: FileIndex, there: Sequence[str]) -> Iterator[Problem]:
    declared, known = declared_targets(campaign), set(there)
    free = [name for name in there if name not in declared]
    for name in (name for name in index.objects if name not in known):
        if near := closest_match(name, free):
            yield Problem(
                "E_NO_FRAMES",
                f"no camera has frames of the object {name!r}",
                str(campaign.path),
                "targets.objects"
                if name in (campaign.targets.objects or ())
                else f"objects.{name}",
                name,
                f"one of {', '.join(there)}",
                fix=near,
            )

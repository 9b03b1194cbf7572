"""Names in campaign.toml against the files that are there, before any stage runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.discovery.captures import Capture, CaptureRefused
from levkas.campaign.discovery.darks_and_whites import near_names
from levkas.campaign.discovery.file_index import declared_targets
from levkas.campaign.discovery.patterns import natural
from levkas.campaign.edits import Edits, EditsInvalid, with_explanation
from levkas.core.internal_errors import InternalError
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
        first = lost[0]
        raise first if isinstance(first, InternalError) else CaptureRefused(*first.problems)


def _lost_templates(campaign: Campaign, there: Sequence[str]) -> Iterator[Problem]:
    raw = [
        (name, camera) for name, camera in campaign.cameras.items() if camera.traits.is_calibrated
    ]
    roles = {f"cameras.{n}.dark": c.dark for n, c in raw}
    roles |= {f"cameras.{n}.white": c.white_names for n, c in raw}
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


# --- corrections by hand ----------------------------------------------------------------------


def check_edits(edits: Edits, captures: Iterable[Capture], path: Path, reference: str = "") -> None:
    """Refuse corrections of what the campaign does not have, and two tables of one sensor.

    A tile of the camera `reference` is named with the neighbour beside which it is placed, others without.

    Raises
    ------
    EditsInvalid
    """
    known: dict[str, dict[str, dict[str, str]]] = {}
    tiles: dict[tuple[str, str], list[str]] = {}
    for capture in captures:
        labels = {band.label: sensor.name for sensor in capture.sensors for band in sensor.bands}
        known.setdefault(capture.object, {})[capture.layer] = labels
        tiles[capture.object, capture.layer] = [part.tile for part in capture.tiles]
    problems = []
    edited: dict[tuple[str, str, str], str] = {}
    for name in sorted(edits.outlines.keys() - known.keys()):
        problem = Problem(
            "E_VALUE", "unknown object", None, f"objects.{name}", name, ", ".join(sorted(known))
        )
        problems.append(with_explanation(problem, path))
    for name, layer in sorted(edits.confirmed):
        if layer not in known.get(name, {}):
            there = ", ".join(f"{n}/{one}" for n, layers in sorted(known.items()) for one in layers)
            problem = Problem("E_VALUE", "unknown layer", None, "confirm", f"{name}/{layer}", there)
            problems.append(with_explanation(problem, path))
    for name, frame in sorted(edits.frames):
        whole, _, band = frame.partition(":")
        layer, *parts = whole.split("#")
        where, layers = f"objects.{name}.cameras.{frame}", known.get(name, {})
        of_layer = tiles.get((name, layer), [])
        for kind, wanted, names in (
            ("object", name, list(known)),
            ("camera", layer, list(layers)),
            *(("tile", part, of_layer) for part in parts),
            ("band", band, list(layers.get(layer, {}))),
        ):
            if wanted and wanted not in names:
                known_names = ", ".join(sorted(names))
                problem = Problem("E_VALUE", f"unknown {kind}", None, where, wanted, known_names)
                problems.append(with_explanation(problem, path))
                break
        else:
            problems += _misnamed(parts, where, path, beside=layer == reference)
            sensors = layers[layer]
            place = (name, whole, sensors[band] if band else next(iter(sensors.values())))
            if (first := edited.setdefault(place, frame)) != frame:
                message = "edits.toml has two tables for this sensor"
                problem = Problem(
                    "E_VALUE", message, None, where, f"{first}, {frame}", "one of them"
                )
                problems.append(with_explanation(problem, path))
    if problems:
        raise EditsInvalid(*problems)


def _misnamed(parts: list[str], where: str, path: Path, *, beside: bool) -> list[Problem]:
    """Return what is wrong with the name of a tile: one `beside` a neighbour has two parts, another has one."""
    if not parts or (len(parts) == 1 + beside and len(set(parts)) == len(parts)):
        return []
    message, expected = "a tile is corrected against the reference", "CAMERA#TILE"
    if beside:
        message = "a tile of the reference is corrected against one of its neighbours"
        expected = "CAMERA#TILE#NEIGHBOUR"
    problem = Problem("E_VALUE", message, None, where, "#".join(parts), expected)
    return [with_explanation(problem, path)]

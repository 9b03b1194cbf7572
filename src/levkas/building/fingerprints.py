"""What every stage depends on: files, parameters and code, by names that a person understands."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building.build_records import Hashes, Key
from levkas.building.control_points import told_points
from levkas.building.sources import code_version

if TYPE_CHECKING:
    from collections.abc import Iterator

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef
    from levkas.core.problems import Problem

STAGES = ("calibrate", "register", "resample")
CALIBRATION_KEYS = (
    "kind", "bits", "black", "saturation", "exposures", "scan", "denoise", "demosaic",
)  # fmt: skip
ROLES = ("object", "dark", "white")
OF_A_FRAME = ("band", "wavelength", "exposure_s", "shot", "page")
ONLY_WRITTEN = {
    "calibrate": ("campaign.", "objects.", "tag 65000"),
    "measure": ("grid.", "objects.", "cameras.", "file "),
    "register": ("grid.", "objects.", "cameras.", "file "),
}
"""Beginnings of what a stage writes beside its numbers: credits, the published frame, a camera's own
channel. What is made of the numbers alone does not depend on it."""


def digest(prints: dict[str, Any], *, numbers_of: str = "") -> str:
    """Hash a fingerprint, so that what depends on it can name it.

    `numbers_of` names a stage of whose products only the numbers are read.

    >>> digest({"campaign.licence": "CC0"}, numbers_of="calibrate") == digest({})
    True
    """
    left_out = ONLY_WRITTEN.get(numbers_of, ())
    prints = {k: v for k, v in prints.items() if not k.startswith(left_out or ("\0",))}
    text = json.dumps(prints, sort_keys=True, ensure_ascii=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def of_calibration(campaign: Campaign, capture: Capture, hashes: Hashes) -> dict[str, Any]:
    """Files, templates, keys of the camera and of its white."""
    camera = campaign.cameras[capture.camera]
    prints: dict[str, Any] = {
        "code": code_version("calibrate"),
        **_credits(campaign, capture.object),
    }
    for key in CALIBRATION_KEYS:
        prints[f"cameras.{camera.name}.{key}"] = getattr(camera, key)
    prints |= _centroids(campaign, capture, hashes)
    white = campaign.targets.white
    if white and any(sensor.white for sensor in capture.sensors):
        prints["targets.white.reflectance"] = white.reflectance
        if isinstance(white.reflectance, str) and (campaign.root / white.reflectance).is_file():
            prints[f"file {white.reflectance}"] = hashes(campaign.root / white.reflectance)
    for sensor in capture.sensors:
        where = (
            f"cameras.{camera.name}.sensors.{sensor.name}"
            if sensor.name
            else f"cameras.{camera.name}"
        )
        prints[f"{where}.pattern"] = (
            [list(row) for row in sensor.pattern] if sensor.pattern else None
        )
        prints[f"{where}.bands"] = [[band.label, str(band.wavelength)] for band in sensor.bands]
    for name, role, frame in frames_of(capture):
        files = {relative(campaign, path): h for path, h in hashes.of_frame(frame.path).items()}
        # A file may be several frames: pages, or a dark of two sensors.
        uses = prints.setdefault(f"frame {next(iter(files))}", [])
        uses.append(use_of(name, role, frame))
        prints |= {f"file {path}": content for path, content in files.items()}
    return plain(prints)


def frames_of(capture: Capture) -> Iterator[tuple[str, str, FrameRef]]:
    """Yield sensor, role and frame of all frames of a capture."""
    for sensor in capture.sensors:
        for role in ROLES:
            for frame in getattr(sensor, role):
                yield sensor.name, role, frame


def use_of(sensor: str, role: str, frame: FrameRef) -> dict[str, Any]:
    """Return what a frame is used for, as its name or a manifest says; all else it says itself."""
    told = {"role": role, "sensor": sensor, **{key: getattr(frame, key) for key in OF_A_FRAME}}
    return {key: value for key, value in told.items() if value not in (None, "")}


def of_registration(
    campaign: Campaign, capture: Capture, hashes: Hashes, calibrated: str, reference: str
) -> dict[str, Any]:
    """The calibrated bands of the capture and of the reference, [registration], what a hand corrected.

    The record of a registration also has the published frame and the channel that the camera's own
    frame means.
    """
    grid, keys = _grid(campaign), campaign.cameras[capture.camera]
    facts = campaign.objects.get(capture.object)
    prints: dict[str, Any] = {
        "code": code_version("register"),
        "calibrated frames": calibrated,
        "frames of the reference": reference,
        "campaign.reference": campaign.reference.model_dump(),
        f"cameras.{keys.name}.reference_band": keys.reference_band,
        f"objects.{capture.object}.size_mm": facts.size_mm if facts else None,
        **grid,
    }
    if isinstance(grid["grid.region"], tuple):  # declared in the turned frame, registered within
        told = ("grid.region", "grid.rotate", "grid.mirror")
        prints["region in the reference"] = [grid[key] for key in told]
    if keys.sensitivity and any(isnan(band.wavelength) for band in capture.bands):
        prints[f"file {keys.sensitivity}"] = hashes(campaign.root / keys.sensitivity)
    for key, value in campaign.registration_of(capture.camera).items():
        prints[f"registration.{key}"] = value
    for sensor in capture.sensors:
        prints[f"sensors.{sensor.name}.align"] = sensor.align
    for band, edits in campaign.edits.of_layer(capture.object, capture.layer).items():
        if told := edits.describe():
            frame = f"{capture.layer}:{band}" if band else capture.layer
            prints[f"edits.toml: correction of {frame}"] = told
    prints |= told_points(campaign, capture)
    return plain(prints)


def of_adjustment(own: str, mates: dict[str, str]) -> dict[str, Any]:
    """The capture's own registration, and those of all that it is adjusted with."""
    prints: dict[str, Any] = {"code": code_version("adjust"), "its own registration": own}
    prints |= {f"registration of {name}": made_of for name, made_of in mates.items()}
    return plain(prints)


def of_resampling(
    campaign: Campaign,
    capture: Capture,
    hashes: Hashes,
    registered: str,
    reference: str,
    *,
    default: str = "",
) -> dict[str, Any]:
    """The registration, the grid, what the files say of the object, and the default lighting's layer."""
    prints: dict[str, Any] = {
        "code": code_version("resample"),
        "registration": registered,
        "registration of the reference": reference,
    }
    if default:
        prints["layer under the default setup"] = default
    prints |= {**_grid(campaign), **_credits(campaign, capture.object)}
    prints |= _centroids(campaign, capture, hashes)
    size = _facts(campaign, capture.object).get("size_mm")
    return plain({**prints, f"objects.{capture.object}.size_mm": size})


def of_report(campaign: Campaign, name: str, layers: dict[str, str]) -> dict[str, Any]:
    """Every layer of the object, and its museum facts."""
    prints: dict[str, Any] = {"code": code_version("report")}
    prints.update({f"layer {layer}": value for layer, value in layers.items()})
    for key, value in _facts(campaign, name).items():
        prints[f"objects.{name}.{key}"] = value
    for key in ("title", "date", "licence", "reference"):
        prints[f"campaign.{key}"] = getattr(campaign.campaign, key)
    return plain(prints)


def _grid(campaign: Campaign) -> dict[str, Any]:
    """The published frame; without a table [grid] what it is then."""
    from levkas.campaign.schema.tables import GridKeys

    return {f"grid.{key}": value for key, value in campaign.grid or GridKeys()}


def _centroids(campaign: Campaign, capture: Capture, hashes: Hashes) -> dict[str, Any]:
    """The sensitivities whose centroids stand in the tags of a broad-band camera's files."""
    declared = campaign.cameras[capture.camera].sensitivity
    if not declared or not any(isnan(band.wavelength) for band in capture.bands):
        return {}
    return {f"tag 65000: file {declared}": hashes(campaign.root / declared)}


def _credits(campaign: Campaign, name: str) -> dict[str, Any]:
    """What stands in the tags of an object's files."""
    facts, described = _facts(campaign, name), campaign.campaign
    told = {f"objects.{name}.{key}": facts.get(key) or "" for key in ("title", "rights")}
    return told | {
        f"campaign.{key}": getattr(described, key) for key in ("creator", "date", "licence")
    }


def _facts(campaign: Campaign, name: str) -> dict[str, Any]:
    facts = campaign.objects.get(name)
    return facts.model_dump() if facts else {}


def relative(campaign: Campaign, path: Any) -> str:
    """Return the name of a file from the campaign's folder; of one elsewhere its last parts."""
    try:
        return str(path.relative_to(campaign.root).as_posix())
    except ValueError:
        return "/".join(path.parts[-3:])


def written(campaign: Campaign, problem: Problem) -> str:
    """Return a problem as a database holds it: wherever the campaign stands, its text is the same."""
    file = problem.file
    if file and Path(file).is_absolute():
        file = relative(campaign, Path(file))
    return str(replace(problem, file=file)).replace(f"{campaign.root}{os.sep}", "")


def plain(prints: dict[str, Any]) -> dict[str, Any]:
    """Return what JSON would make of it, so that a stored fingerprint equals a new one."""
    return dict(json.loads(json.dumps(prints, default=str)))


def keys_of(capture: Capture) -> dict[str, Key]:
    """Return the keys of a capture's stages, by stage."""
    return {s: Key(capture.object, capture.camera, capture.setup, s) for s in STAGES}

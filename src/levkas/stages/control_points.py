"""Pairs that people set for one capture: files of points that campaign.toml names, and corrections in edits.toml."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.edits import BY_HAND
from levkas.core.problems import Problem

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.registration.control_points import ControlPoints
    from levkas.registration.manual_points import ManualPoints


def points_file(campaign: Campaign, capture: Capture) -> Path | None:
    """Return the file of points of a capture; None where none is named, or its object has none.

    A name with {object}, {camera} or {setup} is looked for; one without is there: campaign.toml was refused otherwise.
    """
    own, common = campaign.cameras[capture.camera].registration, campaign.registration
    name = own.points or common.points
    if name is None:
        return None
    for key in ("object", "camera", "setup"):
        name = name.replace("{" + key + "}", getattr(capture, key))
    path = campaign.root / name
    return path if os.path.lexists(path) else None  # one that cannot be read is refused


def use_of(campaign: Campaign, camera: str) -> str:
    """Return what the points of a camera are for: ``"check"`` (default), ``"seeds"`` or ``"start"``."""
    return campaign.cameras[camera].registration.use or campaign.registration.use or "check"


def are_accepted(campaign: Campaign, camera: str) -> bool:
    """Return whether a camera is to be placed by its points alone: seeds, with `accept`."""
    own, common = campaign.cameras[camera].registration, campaign.registration
    return (own.accept or common.accept) == BY_HAND and use_of(campaign, camera) == "seeds"


def placed_in(capture: Capture, band: str, channel: str) -> tuple[str, str]:
    """Return (sensor, band) that a table of points is of; `band` as the table names it, empty for the first sensor's.

    That is `channel`, the capture's reference channel, where the first sensor has it; else the sensor's middle band.
    """
    sensor = next((s for s in capture.sensors if band in [b.label for b in s.bands]), None)
    if band and sensor is not None:
        return sensor.name, band
    first = capture.sensors[0]
    labels = [b.label for b in first.bands]
    return first.name, channel if channel in labels else labels[len(labels) // 2]


def declared_points(
    campaign: Campaign, capture: Capture, channel: str = ""
) -> dict[str, ManualPoints]:
    """Return the points of a capture by sensor, as a registration takes them; `channel` as of `placed_in`.

    Raises PointsRefused where the file cannot be read, or names a band that the camera does not have.
    """
    from levkas.registration.control_points import PointsRefused  # heavy, and not for fingerprints
    from levkas.registration.manual_points import ManualPoints

    path = points_file(campaign, capture)
    if path is None:
        return {}
    labels = [b.label for sensor in capture.sensors for b in sensor.bands]
    use, accepted = use_of(campaign, capture.camera), are_accepted(campaign, capture.camera)
    found: dict[str, ManualPoints] = {}
    for band, points in _of_capture(campaign, capture, path).items():
        if band and band not in labels:
            raise PointsRefused(
                Problem(
                    "E_BAND_MISSING",
                    f"points of an unknown band of {capture.layer}",
                    file=str(path),
                    found=band,
                    expected=", ".join(labels)[:200],
                )
            )
        sensor, placed = placed_in(capture, band, channel)
        rows = np.hstack([points.reference, points.target])
        checks = points.enabled & (points.check | (use == "check"))
        kind = "starts" if use == "start" else "added"
        parts = {kind: rows[points.enabled & ~checks], "checks": rows[checks]}
        pairs = placed_pairs(ManualPoints(**parts, accepted=accepted), placed)
        found[sensor] = found[sensor].joined(pairs) if sensor in found else pairs
    return found


def corrections_of(
    campaign: Campaign, capture: Capture, channel: str = ""
) -> tuple[dict[str, ManualPoints], dict[str, float]]:
    """Return the pairs by hand of a capture, or of a tile, by sensor, and `reject` and `stop` where set by hand.

    Pairs come from edits.toml and from the file of points that campaign.toml names; `channel` is the capture's reference channel.
    """
    from levkas.registration.manual_points import ManualPoints

    given: dict[str, ManualPoints] = {}
    options: dict[str, Any] = {}
    for band, edits in campaign.edits.of_layer(capture.object, capture.frame).items():
        sensor, placed = placed_in(capture, band, channel)
        pairs = ManualPoints(**edits.pairs(), accepted=edits.accept == BY_HAND)
        given[sensor] = placed_pairs(pairs, placed)
        set_by_hand = {"reject": edits.reject, "stop": edits.stop}
        options |= {key: value for key, value in set_by_hand.items() if value is not None}
    declared = {} if capture.tile else declared_points(campaign, capture, channel)
    for sensor, pairs in declared.items():
        given[sensor] = given[sensor].joined(pairs) if sensor in given else pairs
    return given, options


def corrections_beside(campaign: Campaign, capture: Capture) -> dict[tuple[str, str], ManualPoints]:
    """Return the pairs by hand of the tiles of the reference: (neighbour, tile) → px of either."""
    from levkas.registration.manual_points import ManualPoints

    found = {}
    for names, bands in campaign.edits.of_tiles(capture.object, capture.layer).items():
        tile, _, neighbour = names.partition("#")
        edits = next(iter(bands.values()))
        found[neighbour, tile] = ManualPoints(**edits.pairs(), accepted=edits.accept == BY_HAND)
    return found


def fingerprint_points(campaign: Campaign, capture: Capture) -> dict[str, str]:
    """Return what a registration's fingerprint says of the points."""
    from levkas.core.digests import hash_file

    path = points_file(campaign, capture)
    if path is None:
        return {}
    inside = path.is_relative_to(campaign.root)
    name = path.relative_to(campaign.root).as_posix() if inside else path.name
    prints = {
        f"points {name}": hash_file(path)[:16],
        "registration.use": use_of(campaign, capture.camera),
    }
    if are_accepted(campaign, capture.camera):
        prints["registration.accept"] = BY_HAND
    return prints


def placed_pairs(pairs: ManualPoints, band: str) -> ManualPoints:
    """Return pairs whose check points were placed in one band."""
    return replace(pairs, placed=(band,) * len(pairs.checks))


def _of_capture(campaign: Campaign, capture: Capture, path: Path) -> dict[str, ControlPoints]:
    """Return the points of a capture in a file, by band."""
    from levkas.registration import control_points as files

    if files.is_table_of_frames(path):
        rows, own = files.read_table_of_frames(path), (capture.object, capture.layer)
        return {band: points for (*frame, band), points in rows.items() if tuple(frame) == own}
    name = campaign.registration.points or ""
    if not campaign.cameras[capture.camera].registration.points and "{camera}" not in name:
        raise files.PointsRefused(
            Problem(
                "E_VALUE",
                "one file of points cannot belong to every camera",
                file=str(path),
                field="registration.points",
                found=name,
                expected="a name with {camera}, or a CSV with the columns object and camera",
                fix=f"Name it in [cameras.{capture.camera}.registration].",
            )
        )
    return {"": files.read_points(path)}

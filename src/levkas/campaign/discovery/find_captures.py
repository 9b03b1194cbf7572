"""Which files hold which frame of which capture, checked against what the campaign declares."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from levkas.campaign.discovery.captures import (
    Capture,
    CaptureRefused,
    FrameRef,
    Refusals,
    SensorFrames,
)
from levkas.campaign.discovery.file_index import Survey, declared_targets, look, patterns_of
from levkas.campaign.discovery.files import nearest
from levkas.campaign.discovery.patterns import natural
from levkas.campaign.discovery.sensors import frames_of_sensors
from levkas.campaign.schema.cross_checks import is_safe_name, meant
from levkas.core.cube import find_band
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign

__all__ = [
    "Capture",
    "CaptureRefused",
    "FrameRef",
    "Refusals",
    "SensorFrames",
    "find_captures",
    "find_charts",
]


def find_captures(campaign: Campaign) -> tuple[list[Capture], Refusals]:
    """Find every capture of a campaign.

    A camera or setup that has frames of some objects did not take the others: nothing is said. One
    that has frames of none is refused for each; so is an object without a reference image.

    Returns
    -------
    captures : list of Capture
        Object by object, the reference camera first, other setups last.
    refusals : dict
        (object, camera, setup) → what is wrong with that capture alone.

    Raises
    ------
    CaptureRefused
        Where there is no object at all.
    """
    survey = look(campaign)
    survey.objects = _objects(survey)
    reference = campaign.reference.camera
    order = sorted(survey.frames, key=lambda key: (key != (reference, ""), bool(key[1])))
    captures: list[Capture] = []
    refusals: Refusals = {}
    for name in survey.objects:
        for camera_name, setup in order:
            if not _is_promised(survey, name, camera_name, setup):
                continue
            try:
                _require_frames(survey, name, camera_name, setup)
                sensors = frames_of_sensors(survey, name, campaign.cameras[camera_name], setup)
                capture = Capture(name, camera_name, setup, sensors)
                _check_reference_bands(campaign, capture)
                captures.append(capture)
            except Refused as refused:
                refusals[name, camera_name, setup] = refused
    return captures, refusals


def find_charts(campaign: Campaign) -> tuple[list[Capture], Refusals]:
    """Find every capture of a declared chart, by the cameras and setups that took it.

    Returns as `find_captures`; plain images, which are not calibrated, are left out.
    """
    survey = look(campaign)
    captures: list[Capture] = []
    refusals: Refusals = {}
    for name in campaign.targets.charts:
        for camera, setup in survey.frames:
            if campaign.cameras[camera].kind == "image":
                continue
            if not survey.of(name, camera, setup):
                continue
            try:
                sensors = frames_of_sensors(survey, name, campaign.cameras[camera], setup)
                captures.append(Capture(name, camera, setup, sensors))
            except Refused as refused:
                refusals[name, camera, setup] = refused
    return captures, refusals


# --- objects ----------------------------------------------------------------------------------


def _objects(survey: Survey) -> list[str]:
    """Objects as declared; else every target that is nothing else, whichever camera saw it."""
    campaign = survey.campaign
    if campaign.targets.objects:
        return list(campaign.targets.objects)
    others = set(declared_targets(campaign)) - set(campaign.objects)
    seen = {f.target for found in survey.frames.values() for f in found} - others
    names = seen | set(campaign.objects)
    if not names:
        raise _no_objects(survey)
    return sorted(names, key=lambda n: (natural(n), n))


def _no_objects(survey: Survey) -> Refused:
    """Why a campaign is empty: a folder, a pattern, or names that are all templates."""
    reference = survey.campaign.reference.camera
    found = survey.frames[reference, ""]
    if (reference, "") in survey.broken:
        return survey.broken[reference, ""]
    if not found:
        return CaptureRefused(_no_frames(survey, reference, "", "an object", None))
    return CaptureRefused(
        Problem(
            "E_NO_FRAMES",
            f"{reference}: no file fits for an object",
            str(survey.campaign.path),
            f"cameras.{reference}.files",
            f"only {', '.join(sorted({f.target for f in found}, key=natural))}",
            "a {target} that is no dark, white or chart in "
            + " or ".join(p.text for p in patterns_of(survey, reference)),
            "Put the object's frames where the pattern looks, or mend it.",
        )
    )


def _is_promised(survey: Survey, name: str, camera: str, setup: str) -> bool:
    """Whether a camera is expected to have taken an object under a setup."""
    if survey.of(name, camera, setup) or (camera, setup) in survey.broken:
        return True
    if (camera, setup) == (survey.campaign.reference.camera, ""):
        return True
    if survey.has_objects(camera, setup):
        return False
    only_in_setups = not setup and any(
        "{setup}" in t for t in survey.campaign.cameras[camera].patterns
    )
    return not (only_in_setups and any(c == camera and s for c, s in survey.frames))


def _require_frames(survey: Survey, name: str, camera: str, setup: str) -> None:
    if not is_safe_name(name):
        raise CaptureRefused(
            Problem(
                "E_VALUE",
                f"{name!r} cannot be part of a file name",
                field="{target}",
                found=name,
                expected="letters, digits, - and _",
                fix="Rename the frames, or list `targets.objects` to leave it out.",
            )
        )
    if (camera, setup) in survey.broken:
        raise survey.broken[camera, setup]
    frames = survey.frames[camera, setup]
    if survey.of(name, camera, setup):
        return
    if (camera, setup) != (survey.campaign.reference.camera, "") or not frames:
        raise CaptureRefused(_no_frames(survey, camera, setup, repr(name), name))
    others = sorted({c for c, under in survey.frames if survey.of(name, c, under)})
    known = sorted({f.target for f in frames}, key=natural)
    raise CaptureRefused(
        Problem(
            "E_NO_FRAMES",
            f"{name}: the reference camera {camera} has no image of it",
            str(survey.campaign.path),
            f"cameras.{camera}.files",
            f"seen by {', '.join(others)}" if others else f"targets {', '.join(known)}",
            f"{{target}} = {name} in {' or '.join(p.text for p in patterns_of(survey, camera))}",
            meant(name, known)
            if not others
            else "Add the image, or list in `targets.objects` only the objects that have one.",
        )
    )


def _no_frames(survey: Survey, camera: str, setup: str, what: str, target: str | None) -> Problem:
    """No file fits: show the pattern, and the names that came nearest."""
    patterns = patterns_of(survey, camera, setup)
    wanted = patterns[0].given("target", target) if target else patterns[0]
    folder, names = nearest(survey.campaign.root, wanted, folders=survey.folders)
    where = f"setups.{setup}.cameras.{camera}.files" if setup else f"cameras.{camera}.files"
    return Problem(
        "E_NO_FRAMES",
        f"{camera}{f' under {setup}' if setup else ''}: no file fits for {what}",
        file=str(folder),
        field=where,
        found=", ".join(names) if names else "nothing there",
        expected=" or ".join(dict.fromkeys(p.text for p in patterns)),
        fix="Mend the pattern, or put the frames where it looks.",
    )


def _check_reference_bands(campaign: Campaign, capture: Capture) -> None:
    """Refuse a declared reference band that the capture does not have."""
    camera = campaign.cameras[capture.camera]
    declared = {f"cameras.{camera.name}.reference_band": camera.reference_band}
    if capture.camera == campaign.reference.camera:
        declared["campaign.reference.band"] = campaign.reference.band
    for where, band in declared.items():
        if band is None:
            continue
        try:
            find_band([b.label for b in capture.bands], band, [b.wavelength for b in capture.bands])
        except Refused as refused:
            problems = (replace(p, file=str(campaign.path), field=where) for p in refused.problems)
            raise CaptureRefused(*problems) from None

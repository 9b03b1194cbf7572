"""One capture registered to the reference band, and the record of it."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas import __version__
from levkas.campaign.camera_kinds import KINDS
from levkas.core.files import make_folder, remove, together, write_json, write_text
from levkas.core.problems import Problem, Refused
from levkas.database.preview import encode_png
from levkas.database.registrations import describe_lying, describe_size, with_size
from levkas.geometry.transforms import Affine
from levkas.pages.figures import draw_basis, draw_trace
from levkas.pages.page import embed_png
from levkas.readers.frames import read_headers
from levkas.registration import Registration, RegistrationRefused, register
from levkas.registration.manual_points import ManualPoints
from levkas.registration.methods import DEFAULT_METHOD
from levkas.registration.record import COLUMNS, HandMark, Matches
from levkas.registration.reduced import enlarged
from levkas.stages.control_points import corrections_beside, corrections_of
from levkas.stages.native_files import TILE, part_name
from levkas.stages.tile_placement import place_reference
from levkas.stages.tile_registration import TilesToReference
from levkas.stages.tiles import (
    FoundTile,
    placement_of,
    results_of,
    sigma_of_mosaic,
    verdict_of,
)
from levkas.stages.written import Written

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places
    from levkas.geometry.grid import Grid
    from levkas.geometry.transforms import Transform
    from levkas.stages.parts import CalibratedCapture
    from levkas.stages.reference import ReferenceFrame


@dataclass(frozen=True)
class Measured:
    """A capture registered by itself."""

    record: dict[str, Any]
    """Of registration/CAMERA.json."""
    matches: dict[str, Matches] = field(default_factory=dict)
    """By sensor, as tables are written of them: the first sensor's under ""."""
    problems: tuple[Problem, ...] = ()
    """Why it was refused."""
    figures: list[list[str]] = field(default_factory=list)
    """[SVG, caption] of what the map rests on, for the report."""


def measure(
    capture: Capture, native: CalibratedCapture, frame: ReferenceFrame, campaign: Campaign
) -> Measured:
    """Register a capture by itself; `frame` takes the registration of the reference camera's own."""
    if capture.tiles:
        return _measure_tiles(capture, native, frame, campaign)
    leads, channel = capture is frame.capture, frame.channel(capture)
    options = dict(campaign.registration_of(capture.camera))
    method = options.get("method", DEFAULT_METHOD)
    options |= {"one_scan": True} if KINDS[campaign.cameras[capture.camera].kind].one_scan else {}
    given, by_hand = corrections_of(campaign, capture, channel)
    grid, region = frame.layout()
    width, height = grid.size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float) - 0.5
    options |= by_hand | {
        "region": region,
        "outline": frame.outline,
        "layer": grid.transform(corners),
        "prepared": partial(frame.prepared, region, own=leads),
        "align": {
            s: Affine(np.array(a, float)) for s, a in native.aligns.items() if a != "measure"
        },
    }
    found, refused, figures = None, None, []
    try:
        found = _register(native, frame, options, given, own=leads)
    except RegistrationRefused as error:
        refused = _with_outline_named(error, campaign, capture.object)
    if leads and found is not None:
        frame.registered(found)
    frame.rest()
    record = _heading(capture, frame, grid, channel) | {"method": method}
    if (turn := read_headers(capture.sensors[0].object[0].path).orientation) is not None:
        record["target"]["orientation"] = turn
    if found is None:
        record |= _refusal(refused)
        problems = verdict_problems(record, capture, refused)
        return Measured(record, problems=problems, figures=draw_figures(record))
    record |= _results(found, native)
    matches = {"": found.matches, **found.others}
    if pairs := sum(int((m.kept & (m.reason == HandMark.ADDED)).sum()) for m in matches.values()):
        record["pairs_by_hand"] = pairs
    if found.trace is not None:
        figures = [[one.svg, one.caption] for one in draw_trace(found.matches, found.trace)]
    problems = verdict_problems(record, capture, None)
    return Measured(record, matches, problems, figures or draw_figures(record))


def _register(
    native: CalibratedCapture,
    frame: ReferenceFrame,
    options: dict[str, Any],
    given: Mapping[str, ManualPoints],
    *,
    own: bool,
) -> Registration:
    """Register every band of a capture, or of the reference itself; `given` are pairs by hand, by sensor, in native px."""
    reference = frame.images
    if own:
        return register(reference, reference, reference_band=frame.band, given=given, **options)
    known = frame.registration()
    found = register(
        reference, native.images(), reference_band=frame.band,
        given={sensor: pairs.reduced(native.factor) for sensor, pairs in given.items()},
        reference_transforms=known.transforms, reference_sigma=known.sigma, **options,
    )  # fmt: skip
    return found if native.factor == 1 else enlarged(found, native.factor)


def _measure_tiles(
    capture: Capture, native: CalibratedCapture, frame: ReferenceFrame, campaign: Campaign
) -> Measured:
    """Register the tiles of a capture: those of the reference to one another, those of others each to the reference."""
    options = dict(campaign.registration_of(capture.camera))
    refused, extra = None, {}
    found: dict[str, FoundTile] = {}
    try:
        if capture is frame.capture:
            by_hand = corrections_beside(campaign, capture)
            found, placement = place_reference(capture, native, frame.band, campaign, by_hand)
            size = placement.size
            extra = {"placement": placement.to_dict()}
        else:
            size = frame.size
            channel = frame.channel(capture)
            given = {part.tile: corrections_of(campaign, part, channel) for part in capture.tiles}
            found = TilesToReference(capture, native, frame, campaign, options, given).run()
    except RegistrationRefused as error:
        refused = error
    if any(one.is_placed for one in found.values()):
        native.placement = placement_of(found, size)
    if capture is frame.capture and refused is not None:
        problems = verdict_problems({}, capture, refused)
        return Measured(_refusal(refused) | {"object": capture.object}, problems=problems)
    results = _refusal(refused) if refused else results_of(found, native, size)
    if capture is frame.capture:
        maps: dict[str, Transform] = {b.label: Affine.identity() for b in native.bands}
        sigma = dict.fromkeys(maps, sigma_of_mosaic(found, size))
        frame.registered(Registration("", maps, verdict_of(found), {}, Matches.none(), sigma=sigma))
    grid, _ = frame.layout()
    channel = frame.channel(capture)
    record = _heading(capture, frame, grid, channel) | results | extra
    problems = verdict_problems(record, capture, refused)
    tables = {
        part_name(part, sensor): pairs
        for part in capture.tiles
        for sensor, pairs in (found[part.tile].matches if part.tile in found else {}).items()
    }
    return Measured(record, tables, problems=problems, figures=draw_figures(record))


def _with_outline_named(
    refused: RegistrationRefused, campaign: Campaign, name: str
) -> RegistrationRefused:
    """Return a refusal in which an outline that cannot be used is named by its file and key."""
    file = campaign.root / campaign.outline_of(name)[1]
    problems = [
        replace(p, file=str(file), field=f"objects.{name}.outline") if p.field == "outline" else p
        for p in refused.problems
    ]
    return RegistrationRefused(*problems, trace=refused.trace)


def publish_registration(
    measured: Measured,
    capture: Capture,
    places: Places,
    size_mm: tuple[float, float] | None,
) -> Written:
    """Write the record and the matches of a registration."""
    record = with_size(measured.record, size_mm)
    with together():
        files = write_registration(places, capture, record, measured.matches)
    verdict, layer = record["verdict"], f"{capture.object}/{capture.layer}"
    judged = f"{layer}: {' '.join(verdict['reasons'])}"
    lasting = lasting_warnings(record, layer)
    notes = {
        "refused": [p.to_dict() for p in measured.problems],
        "figures": measured.figures,
        "warnings": lasting,
    }
    doubtful = verdict["decision"] == "warn" and not measured.problems
    warnings = (*lasting, *([judged] if doubtful else []))
    return Written(files, notes, warnings=warnings, problems=measured.problems)


def lasting_warnings(record: Mapping[str, Any], layer: str) -> list[str]:
    """Return what every build reports of a registration, by its record."""
    lasting, verdict = [*describe_lying(record), *describe_size(record)], record["verdict"]
    lasting += [" ".join(verdict["reasons"])] if verdict["decision"] == "by hand" else []
    return [f"{layer}: {text}" for text in lasting]


RECORDED_PX = 480
"""Longer side of the picture of a refused capture."""


def draw_recorded(native: CalibratedCapture) -> str:
    """Return a small picture of a capture as it was recorded, the mean of its first sensor's bands, as data address."""
    images = native.images()
    mine = [image for image in images if image.sensor == images[0].sensor]
    step = ceil(max(images[0].values.shape) / RECORDED_PX)
    thin = [np.nan_to_num(image.values[::step, ::step].astype(float)) for image in mine]
    grey = np.mean(thin, axis=0)
    low, high = np.percentile(grey, (1, 99))
    shown = np.clip((grey - low) / max(high - low, 1e-12) * 255, 0, 255).astype(np.uint8)
    return embed_png(encode_png(shown))


def draw_figures(record: dict[str, Any]) -> list[list[str]]:
    """Return the figures, SVG and caption each, of what a map rests on; none where the record does not say."""
    sound = record["verdict"]["decision"] != "refuse"
    figures = draw_basis(record["trace"], record["reference"]["size"], sound=sound)
    return [[figure.svg, figure.caption] for figure in figures]


def verdict_problems(
    record: dict[str, Any], capture: Capture, refused: Refused | None
) -> tuple[Problem, ...]:
    """Return the problems of a registration that is refused; none for one that is accepted."""
    what = f"{capture.object}/{capture.layer} was left out: its registration was refused"
    if refused is not None:
        return tuple(replace(p, message=f"{what}: {p.message}") for p in refused.problems)
    verdict = record["verdict"]
    if verdict["decision"] != "refuse":
        return ()
    reasons = " ".join(verdict["reasons"])
    return (
        Problem(
            "E_VERDICT",
            f"{what}. {reasons}",
            field=f"cameras.{capture.camera}.registration",
            fix=verdict["next_step"] or None,
        ),
    )


def _heading(capture: Capture, frame: ReferenceFrame, grid: Grid, channel: str) -> dict[str, Any]:
    """Return the part of registration/CAMERA.json that says what was registered to what; ``object_px`` are the object's sides, reference px."""
    lead, sides = frame.capture, frame.area.sides
    return {
        "levkas": __version__,
        "object": capture.object,
        "camera": capture.camera,
        "setup": capture.setup,
        "method": "",
        "reference": {"camera": lead.camera, "band": frame.band, "size": list(frame.size)},
        "target": {"camera": capture.camera, "setup": capture.setup, "band": channel},
        "grid": {
            "size": list(grid.size),
            "transform": grid.transform.to_dict(),
            "object_px": sides and [round(frame.step * side, 2) for side in sides],
        },
    }


def _refusal(refused: RegistrationRefused | None) -> dict[str, Any]:
    """Return the part of the record of a registration that came to no answer."""
    problems = refused.problems if refused else ()
    return {
        "verdict": {
            "decision": "refuse",
            "reasons": [str(p.message) for p in problems],
            "next_step": next((p.fix for p in problems if p.fix), ""),
            "numbers": {},
        },
        "model": {"kind": "none"},
        "bands": {},
        "errors": {},
        "trace": refused.trace.to_dict() if refused and refused.trace else {},
    }


def _results(registration: Registration, native: CalibratedCapture) -> dict[str, Any]:
    """Return the part of the record that holds maps, verdict and evidence."""
    record = registration.to_dict()
    bands = {
        label: {"size": list(native.size_of(label)), "transform": transform.to_dict()}
        for label, transform in registration.transforms.items()
    }
    for label, sigma in registration.sigma.items():
        bands[label]["sigma"] = sigma.to_dict()
    keep = ("method", "verdict", "model", "errors", "trace")
    return {**{k: record[k] for k in keep}, "bands": bands}


def write_registration(
    places: Places, capture: Capture, record: dict[str, Any], matches: Mapping[str, Matches]
) -> list[Path]:
    """Write a registration's record and its tables of matches, and take older tables away.

    `matches` are by sensor, the first one's under "". Raises WriteRefused.
    """
    name, layer = capture.object, capture.layer
    path = places.registration(name, layer)
    make_folder(path.parent)
    write_json(path, record)
    tables = {places.matches(name, layer, sensor): pairs for sensor, pairs in matches.items()}
    for place, pairs in tables.items():
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([COLUMNS, *pairs.rows()])
        write_text(place, text.getvalue())
    names = {places.matches(name, layer, sensor.name) for sensor in capture.sensors}
    if capture.tiles:
        names |= {p for p in path.parent.iterdir() if p.name.startswith(f"{layer}.{TILE}")}
    for place in sorted({places.matches(name, layer), *names} - tables.keys()):
        if place.is_file():
            remove(place)
    return [path, *tables]

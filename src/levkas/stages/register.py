"""One capture registered to the reference band, and the record of it."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas import __version__
from levkas.campaign.camera_kinds import KINDS
from levkas.campaign.edits import BY_HAND
from levkas.campaign.methods import DEFAULT_METHOD
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
from levkas.registration.record import COLUMNS, HandMark, Matches
from levkas.registration.reduced import enlarged
from levkas.stages.control_points import declared_points, placed_in, placed_pairs
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
    from levkas.registration import BandImage
    from levkas.registration.predictors import PreparedReference
    from levkas.stages.parts import CalibratedCapture
    from levkas.stages.reference import ReferenceFrame


def measure(
    capture: Capture, native: CalibratedCapture, frame: ReferenceFrame, campaign: Campaign
) -> Measured:
    """Register a capture by itself; `frame` takes the registration of the reference camera's own."""
    if capture.tiles:
        return _measure_tiles(capture, native, frame, campaign)
    leads = capture is frame.capture
    own = None if leads else frame.registration()
    channel = frame.channel(capture)
    options = dict(campaign.registration_of(capture.camera))
    method = options.get("method", DEFAULT_METHOD)
    options |= {"one_scan": True} if KINDS[campaign.cameras[capture.camera].kind].one_scan else {}
    given, by_hand = corrections_of(campaign, capture, channel)
    options |= by_hand
    grid, region = frame.layout()
    prepared = partial(frame.prepared, region, own=leads)
    options |= {"outline": frame.outline, "layer": corners_of_grid(grid)}
    found, refused = None, None
    try:
        found = register_capture(
            native, frame.images, frame.band, own, region, options, given, prepared
        )
    except RegistrationRefused as error:
        refused = _with_outline_named(error, campaign, capture.object)
    if leads and found is not None:
        frame.registered(found)
    frame.rest()
    record = _heading(capture, frame, grid, channel) | {"method": method}
    if (turn := read_headers(capture.sensors[0].object[0].path).orientation) is not None:
        record["target"]["orientation"] = turn
    record |= _refusal(refused) if found is None else _results(found, native)
    if found is not None and (pairs := _pairs_by_hand(found)):
        record["pairs_by_hand"] = pairs
    problems = verdict_problems(record, capture, refused)
    if found is None:
        return Measured(record, problems=problems, figures=draw_figures(record))
    figures = draw_trace(found.matches, found.trace) if found.trace is not None else []
    return Measured(
        record,
        {"": found.matches, **found.others},
        problems,
        [[figure.svg, figure.caption] for figure in figures] or draw_figures(record),
    )


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
            del extra["placement"]["transforms"]
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


def corrections_beside(campaign: Campaign, capture: Capture) -> dict[tuple[str, str], ManualPoints]:
    """Return the pairs by hand of the tiles of the reference: (neighbour, tile) → px of either."""
    found = {}
    for names, bands in campaign.edits.of_tiles(capture.object, capture.layer).items():
        tile, _, neighbour = names.partition("#")
        given = [ManualPoints(**e.pairs(), accepted=e.accept == BY_HAND) for e in bands.values()]
        found[neighbour, tile] = given[0]
    return found


def corners_of_grid(grid: Grid) -> np.ndarray:
    """Return the corners of the published frame, (4, 2) reference px, in order round it."""
    width, height = grid.size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float) - 0.5
    return np.asarray(grid.transform(corners))


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


def register_capture(
    native: CalibratedCapture,
    reference: Sequence[BandImage],
    reference_band: str,
    own: Registration | None,
    region: tuple[float, float, float, float] | None,
    options: dict[str, Any],
    given: Mapping[str, ManualPoints] | None = None,
    prepared: Callable[[], PreparedReference] | None = None,
) -> Registration:
    """Register every band of a capture; `own` is the reference camera's registration, None for itself.

    `given` are pairs by hand, by sensor, in native pixels; `prepared` returns the reference made ready.

    Raises RegistrationRefused where there is no answer at all.
    """
    align = {s: Affine(np.array(a, float)) for s, a in native.aligns.items() if a != "measure"}
    if own is None:
        return register(
            reference, reference, reference_band=reference_band, region=region, given=given,
            prepared=prepared, align=align, **options,
        )  # fmt: skip
    given = {sensor: pairs.reduced(native.factor) for sensor, pairs in (given or {}).items()}
    request: dict[str, Any] = {
        "reference_transforms": own.transforms,
        "reference_sigma": own.sigma,
        "align": align,
        "prepared": prepared,
    }
    found = register(
        reference, native.images(), reference_band=reference_band, region=region, given=given,
        **request, **options,
    )  # fmt: skip
    if native.factor == 1:
        return found
    errors = _with_enlarged_checks(found.errors, Affine.of_box(0, 0, native.factor))
    return replace(enlarged(found, native.factor), errors=errors)


def corrections_of(
    campaign: Campaign, capture: Capture, channel: str = ""
) -> tuple[dict[str, ManualPoints], dict[str, float]]:
    """Return the pairs by hand of a capture, or of a tile, by sensor, and `reject` and `stop` where set by hand.

    Pairs come from edits.toml and from the file of points that campaign.toml names; `channel` is the
    capture's reference channel.
    """
    given, options = {}, {}
    for band, edits in campaign.edits.of_layer(capture.object, capture.frame).items():
        sensor, placed = placed_in(capture, band, channel)
        pairs = ManualPoints(**edits.pairs(), accepted=edits.accept == BY_HAND)
        given[sensor] = placed_pairs(pairs, placed)
        for key in ("reject", "stop"):
            if getattr(edits, key) is not None:
                options[key] = getattr(edits, key)
    declared = {} if capture.tile else declared_points(campaign, capture, channel)
    for sensor, pairs in declared.items():
        given[sensor] = given[sensor].joined(pairs) if sensor in given else pairs
    return given, options


def _with_enlarged_checks(errors: dict[str, Any], grow: Affine) -> dict[str, Any]:
    if "check_points" not in errors:
        return errors
    points = [
        one | {"target": grow(np.array([one["target"]]))[0].tolist()}
        for one in errors["check_points"]
    ]
    return errors | {"check_points": points}


def _heading(capture: Capture, frame: ReferenceFrame, grid: Grid, channel: str) -> dict[str, Any]:
    """Return the part of registration/CAMERA.json that says what was registered to what."""
    return {
        "levkas": __version__,
        "object": capture.object,
        "camera": capture.camera,
        "setup": capture.setup,
        "method": "",
        "reference": frame.description(),
        "target": {"camera": capture.camera, "setup": capture.setup, "band": channel},
        "grid": {
            "size": list(grid.size),
            "transform": grid.transform.to_dict(),
            "object_px": frame.sides,
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


def _pairs_by_hand(found: Registration) -> int:
    """Count the pairs that a person placed and that were used."""
    tables = (found.matches, *found.others.values())
    return sum(int((m.kept & (m.reason == HandMark.ADDED)).sum()) for m in tables)


def table_of(matches: Matches) -> str:
    """Return CAMERA.matches.csv, or that of another sensor than the first."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(matches.rows())
    return text.getvalue()


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
        write_text(place, table_of(pairs))
    names = {places.matches(name, layer, sensor.name) for sensor in capture.sensors}
    if capture.tiles:
        names |= {p for p in path.parent.iterdir() if p.name.startswith(f"{layer}.{TILE}")}
    for place in sorted({places.matches(name, layer), *names} - tables.keys()):
        if place.is_file():
            remove(place)
    return [path, *tables]


@dataclass(frozen=True)
class Measured:
    """A capture registered by itself.

    Parameters
    ----------
    record : dict
        Of registration/CAMERA.json.
    matches : dict of sensor to Matches
        As tables are written of them: the first sensor's under "".
    problems : tuple of Problem
        Why it was refused.
    figures : list of [SVG, caption]
        What the map rests on, for the report.
    """

    record: dict[str, Any]
    matches: dict[str, Matches] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()
    figures: list[list[str]] = field(default_factory=list)

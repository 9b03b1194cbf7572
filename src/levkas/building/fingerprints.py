"""What every stage depends on: files, parameters and code, by names that a person understands."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building.build_records import UNREADABLE, Key, key_of
from levkas.campaign.methods import DEFAULT_METHOD, code_of
from levkas.core.internal_errors import CODE as INTERNAL
from levkas.stages.control_points import fingerprint_points
from levkas.stages.sources import made_with

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from levkas.building.build_records import BuildRecords
    from levkas.building.graph import Task
    from levkas.building.hashes import Hashes
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef
    from levkas.core.problems import Problem

CALIBRATION_KEYS = (
    "kind", "bits", "black", "saturation", "exposures", "scan", "denoise", "demosaic", "overrule",
)  # fmt: skip
ROLES = ("object", "dark", "white", "chart")
OF_A_FRAME = ("band", "wavelength", "exposure_s", "shot", "page", "tile")
FACTS = ("campaign.creator", "campaign.date", "campaign.licence", "objects.", "tag 65000")
"""Beginnings of what a stage writes about its pixels: credits, the object's size, centroids. It is written anew, and
nothing else is done."""


def digest(prints: dict[str, Any]) -> str:
    """Hash what pixels are made of, so that what depends on them can name it: neither facts nor whether native ones are written.

    >>> digest({"campaign.licence": "CC0"}) == digest({"database.native": True})
    True
    """
    prints = without(prints, (*FACTS, "database."))
    text = json.dumps(prints, sort_keys=True, ensure_ascii=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def without(prints: dict[str, Any], beginnings: tuple[str, ...] = FACTS) -> dict[str, Any]:
    """Return a fingerprint without what begins with one of some texts."""
    return {k: v for k, v in prints.items() if not k.startswith(beginnings)}


class Inputs:
    """Fingerprints of the tasks of captures, and digests of them for the tasks that read their products.

    Where `unread`, frames of layers that were never begun need not be read, as for `status`.
    """

    def __init__(self, campaign: Campaign, records: BuildRecords, *, unread: bool = False) -> None:
        self.campaign, self.records, self._unread = campaign, records, unread
        self.digests: dict[Key, str] = {}

    def of(self, task: Task, refused: Collection[tuple[str, str]]) -> dict[str, Any]:
        """Return the fingerprint of a task; those that it reads have had theirs.

        `refused` are layers, (object, layer), that there are none of.
        """
        try:
            prints = self._prints(task, refused)
        except Exception as error:  # the stage meets it again, and is refused for it
            prints = {UNREADABLE: f"{type(error).__name__}: {error}"}
        self.digests[task.key] = digest(prints)
        return prints

    def _prints(self, task: Task, refused: Collection[tuple[str, str]]) -> dict[str, Any]:
        capture, lead = task.capture, task.reference
        assert capture is not None and lead is not None
        campaign, hashes, stage = self.campaign, self.records.hashes, task.key.stage
        if stage == "calibrate":
            never = self._unread and not self.records.is_begun(task.key)
            return {} if never else of_calibration(campaign, capture, hashes)
        if stage == "resample":
            ends = (self.digests[key_of(c, "register")] for c in (capture, lead))
            default = Key(capture.object, capture.camera, "", "resample")
            other = self.digests.get(default, "") if capture.setup else ""
            if (
                capture.setup and (default.object, default.layer) in refused
            ):  # that of an earlier build
                made_of = self.records.fingerprint(default)
                other = digest(made_of) if made_of else ""
            return of_resampling(campaign, capture, hashes, *ends, default=other)
        ends = (self.digests[key_of(c, "calibrate")] for c in (capture, lead))
        prints = of_registration(campaign, capture, hashes, *ends)
        if not task.leads:
            prints["registration of the reference"] = self.digests[key_of(lead, "register")]
        return prints


def of_calibration(campaign: Campaign, capture: Capture, hashes: Hashes) -> dict[str, Any]:
    """Files, templates, keys of the camera and of its white."""
    camera = campaign.cameras[capture.camera]
    prints: dict[str, Any] = made_with("calibrate")
    if campaign.database.native:
        prints |= {"database.native": True, **_credits(campaign, capture.object)}
        prints |= _centroids(campaign, capture, hashes)
    for key in CALIBRATION_KEYS:
        prints[f"cameras.{camera.name}.{key}"] = getattr(camera, key)
    white = campaign.targets.white
    if white and any(sensor.white for sensor in capture.sensors):
        prints["targets.white.reflectance"] = white.reflectance
        if isinstance(white.reflectance, str) and (campaign.root / white.reflectance).is_file():
            prints[f"file {white.reflectance}"] = hashes(campaign.root / white.reflectance)
            prints |= _spectra_of_bands(campaign, capture, hashes)
    prints |= _white_chart(campaign, capture, hashes)
    if traps := capture.boxes(campaign.targets.traps.get(capture.object, {})):
        prints["targets.traps"] = traps
    if len(capture.sensors) > 1:  # bands are in their order, and the first is the others' frame
        prints[f"cameras.{camera.name}.sensors"] = [sensor.name for sensor in capture.sensors]
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
        if sensor.remarks:
            prints[f"{where}: choice of darks and whites"] = list(sensor.remarks)
    for name, role, frame in frames_of(capture):
        files = {relative(campaign, path): h for path, h in hashes.of_frame(frame.path).items()}
        # A file may be several frames: pages, or a dark of two sensors.
        uses = prints.setdefault(f"frame {next(iter(files))}", [])
        uses.append(use_of(name, role, frame))
        prints |= {f"file {path}": content for path, content in files.items()}
    return plain(prints)


def _white_chart(campaign: Campaign, capture: Capture, hashes: Hashes) -> dict[str, Any]:
    """The chart that is a camera's white, what it is, and the tables by which its reflectance is known."""
    camera = campaign.cameras[capture.camera]
    white = camera.white_chart
    if white is None:
        return {}
    where = f"cameras.{camera.name}.white"
    return {
        f"{where}.chart": white.chart,
        f"{where}.corners": white.corners,
        f"targets.charts.{white.chart}": campaign.targets.charts.get(white.chart, ""),
        **_tables(campaign, hashes, {f"{where}.reference": white.reference}),
        **_spectra_of_bands(campaign, capture, hashes),
    }


def _spectra_of_bands(campaign: Campaign, capture: Capture, hashes: Hashes) -> dict[str, Any]:
    """The tables by which it is known what the bands see of every wavelength."""
    camera = campaign.cameras[capture.camera]
    lighting = campaign.setups.get(capture.setup or campaign.campaign.setup or "default")
    tables = {
        f"cameras.{camera.name}.sensitivity": camera.sensitivity,
        "setup's spectrum": lighting.spectrum if lighting else None,
    }
    return _tables(campaign, hashes, tables)


def _tables(campaign: Campaign, hashes: Hashes, tables: dict[str, str | None]) -> dict[str, Any]:
    """Names of declared tables by their keys, and their content."""
    files = [t for t in tables.values() if t and (campaign.root / t).is_file()]
    return {**tables, **{f"file {table}": hashes(campaign.root / table) for table in files}}


def frames_of(capture: Capture) -> Iterator[tuple[str, str, FrameRef]]:
    """Yield sensor, role and frame of all frames of a capture."""
    for sensor in capture.sensors:
        for role in ROLES:
            for frame in getattr(sensor, role):
                yield sensor.name, role, frame


def use_of(sensor: str, role: str, frame: FrameRef) -> dict[str, Any]:
    """Return what a frame is used for, as its name or a manifest says; all else it says itself."""
    use = {"role": role, "sensor": sensor, **{key: getattr(frame, key) for key in OF_A_FRAME}}
    return {key: value for key, value in use.items() if value not in (None, "")}


def of_registration(
    campaign: Campaign, capture: Capture, hashes: Hashes, calibrated: str, reference: str
) -> dict[str, Any]:
    """The calibrated bands of the capture and of the reference, [registration], what a hand corrected.

    The record of a registration also has the published frame and the channel that the camera's own
    frame means.
    """
    grid, keys = _grid(campaign), campaign.cameras[capture.camera]
    prints: dict[str, Any] = {
        **made_with("register"),
        "calibrated frames": calibrated,
        "frames of the reference": reference,
        "campaign.reference": campaign.reference.model_dump(),
        f"cameras.{keys.name}.reference_band": keys.reference_band,
        f"objects.{capture.object}.size_mm": size_of(campaign, capture.object),
        **grid,
    }
    # Not under "objects.": it is no fact that is only written.
    if corners := campaign.outline_of(capture.object)[0]:
        prints["outline of the object"] = [list(corner) for corner in corners]
    if isinstance(grid["grid.region"], tuple):  # declared in the turned frame, registered within
        edited = ("grid.region", "grid.rotate", "grid.mirror")
        prints["region in the reference"] = [grid[key] for key in edited]
    if keys.sensitivity and any(isnan(band.wavelength) for band in capture.bands):
        prints[f"file {keys.sensitivity}"] = hashes(campaign.root / keys.sensitivity)
    if keys.positions:
        # Not under "file ": where tiles lie depends on it, and with it all that follows.
        prints["positions of the tiles"] = hashes(campaign.root / keys.positions)
    options = campaign.registration_of(capture.camera)
    prints |= {f"registration.{key}": value for key, value in options.items()}
    if code := code_of(options.get("method") or DEFAULT_METHOD):
        prints["code of the registration method"] = code
    for sensor in capture.sensors:
        prints[f"sensors.{sensor.name}.align"] = sensor.align
    mine = {capture.layer: campaign.edits.of_layer(capture.object, capture.layer)}
    for tile, corrected in campaign.edits.of_tiles(capture.object, capture.layer).items():
        mine[f"{capture.layer}#{tile}"] = corrected
    for frame, bands in mine.items():
        for band, edits in bands.items():
            if edited := edits.describe():
                prints[f"edits.toml: correction of {frame}{f':{band}' if band else ''}"] = edited
    prints |= fingerprint_points(campaign, capture)
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
        **made_with("resample"),
        "registration": registered,
        "registration of the reference": reference,
    }
    if default:
        prints["layer under the default setup"] = default
    prints |= {**_grid(campaign), **_credits(campaign, capture.object)}
    prints |= _centroids(campaign, capture, hashes)
    prints[f"objects.{capture.object}.size_mm"] = size_of(campaign, capture.object)
    return plain(prints)


def of_report(
    campaign: Campaign,
    name: str,
    layers: dict[str, str],
    captures: Sequence[Capture],
    hashes: Hashes,
) -> dict[str, Any]:
    """Every layer of the object in the order of its captures, what their bands see, and its museum facts."""
    order = [capture.layer for capture in captures]
    prints: dict[str, Any] = {**made_with("report"), "order of layers": order}
    prints.update({f"layer {layer}": value for layer, value in layers.items()})
    for key, value in _facts(campaign, name).items():
        prints[f"objects.{name}.{key}"] = value
    for key in ("title", "creator", "date", "licence", "reference"):
        prints[f"campaign.{key}"] = getattr(campaign.campaign, key)
    for layer in order:
        if word := campaign.edits.confirmed.get((name, layer)):
            prints[f"edits.toml: confirmation of {layer}"] = dict(word)
    prints["database.native"] = campaign.database.native
    for capture in captures:
        prints |= _centroids(campaign, capture, hashes)
    for capture in captures if len(captures) > 1 else ():  # which are compared
        spectra = _spectra_of_bands(campaign, capture, hashes)
        prints |= {f"bands of {capture.layer}: {key}": value for key, value in spectra.items()}
    return plain(prints | uncertainties(campaign))


def uncertainties(campaign: Campaign) -> dict[str, Any]:
    """What is declared of errors that no frame shows: it is in the budgets alone."""
    white = campaign.targets.white
    found: dict[str, Any] = {}
    for name, camera in campaign.cameras.items():
        found |= {f"cameras.{name}.uncertainty.{key}": size for key, size in camera.uncertainty}
    for name, setup in campaign.setups.items():
        for key in ("angle_deg", "angle_uncertainty_deg"):
            found[f"setups.{name}.{key}"] = getattr(setup, key)
    found["targets.white.uncertainty"] = white.uncertainty if white else None
    return {key: size for key, size in found.items() if size is not None}


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
    titles = {f"objects.{name}.{key}": facts.get(key) or "" for key in ("title", "rights")}
    return titles | {
        f"campaign.{key}": getattr(described, key) for key in ("creator", "date", "licence")
    }


def size_of(campaign: Campaign, name: str) -> tuple[float, float] | None:
    """Return the declared size of an object, (width, height) mm."""
    facts = campaign.objects.get(name)
    return facts.size_mm if facts else None


def _facts(campaign: Campaign, name: str) -> dict[str, Any]:
    facts = campaign.objects.get(name)
    return facts.museum_facts() if facts else {}


def relative(campaign: Campaign, path: Any) -> str:
    """Return the name of a file from the campaign's folder; of one elsewhere its last parts."""
    try:
        return str(path.relative_to(campaign.root).as_posix())
    except ValueError:
        return "/".join(path.parts[-3:])


def written(campaign: Campaign, problem: Problem) -> str:
    """Return a problem as a database holds it: its text is the same for any folder of the campaign."""
    file = problem.file
    if file and Path(file).is_absolute():
        file = relative(campaign, Path(file))
    fix = None if problem.code == INTERNAL else problem.fix  # where its report lies on this machine
    return str(replace(problem, file=file, fix=fix)).replace(f"{campaign.root}{os.sep}", "")


def plain(prints: dict[str, Any]) -> dict[str, Any]:
    """Return what JSON would make of it, so that a stored fingerprint equals a new one."""
    return dict(json.loads(json.dumps(prints, default=str)))

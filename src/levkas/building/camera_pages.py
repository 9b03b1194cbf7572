"""What the page of every camera is made of: sensor and light as measured in its captures, and its charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from levkas.building.build_records import BuildRecords, Key, key_of
from levkas.building.graph import cameras_with_pages, page_key
from levkas.building.inputs import digest, of_calibration, plain, read_by, written
from levkas.campaign.discovery.find_captures import find_charts
from levkas.campaign.schema.tables import CALIBRATE, CAMERA
from levkas.core.problems import Problem
from levkas.stages.charts import edges_of
from levkas.stages.sources import made_with

if TYPE_CHECKING:
    from levkas.building.outcomes import Outcomes
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.campaign.discovery.file_index import FileIndex


@dataclass(frozen=True)
class CameraPage:
    """What the page of a camera shows: its captures and charts, and what is wrong with charts that it cannot show."""

    camera: str
    captures: Sequence[Capture]
    charts: Sequence[Capture]
    refused: tuple[Problem, ...]

    @property
    def first(self) -> Capture:
        """A capture that gives bands and sensors."""
        return [*self.captures, *self.charts][0]


def camera_pages(
    campaign: Campaign, captures: Sequence[Capture], index: FileIndex
) -> dict[Key, CameraPage]:
    """Return the pages of a campaign's cameras; plain images without a chart have none."""
    charts, refusals = find_charts(campaign, index) if campaign.targets.charts else ([], {})
    cameras = cameras_with_pages(campaign, captures, charts)
    return {
        page_key(camera): CameraPage(
            camera,
            [c for c in captures if c.camera == camera],
            [c for c in charts if c.camera == camera],
            tuple(p for key, r in refusals.items() if key[1] == camera for p in r.problems),
        )
        for camera in cameras
    }


def prints_of_page(page: CameraPage, outcomes: Outcomes) -> dict[str, Any]:
    """Return the fingerprint of a camera's page."""
    campaign, records = outcomes.campaign, outcomes.records
    refused = [written(campaign, problem) for problem in page.refused]
    prints = {**made_with(), **_measured_in(page, outcomes), "charts refused": refused}
    for capture in (*page.captures, *page.charts):
        bare = replace(capture, object="")
        prints |= read_by((CALIBRATE, CAMERA), campaign, bare, records.hashes)
    prints["bands"] = [[b.label, str(b.wavelength), str(b.fwhm)] for b in page.first.bands]
    prints["order of captures"] = [f"{c.object}/{c.layer}" for c in page.captures]
    prints["sensors"] = [[s.name, s.pattern, len(s.bands)] for s in page.first.sensors]
    return plain(prints | prints_of_charts(page, campaign, records))


def prints_of_charts(page: CameraPage, campaign: Campaign, records: BuildRecords) -> dict[str, Any]:
    """Return what the charts that a camera saw are made of."""
    prints: dict[str, Any] = {}
    for capture in page.charts:
        name = f"chart {capture.object}/{capture.layer}"
        prints[name] = digest(of_calibration(campaign, capture, records.hashes))
        prints[f"{name} kind"] = campaign.targets.charts[capture.object]
        if named := edges_of(campaign, capture):
            prints[f"{name} edges"] = [[s, [list(p.box) for p in e]] for s, e in named.items()]
    return prints


def _measured_in(page: CameraPage, outcomes: Outcomes) -> dict[str, Any]:
    """Return the calibrations that `measured_of` takes its measurements from, and what each is made of.

    A calibration that is to be done again is another one: what it will measure need not be known.
    """
    records, found, known = outcomes.records, dict[str, Any](), set[str]()
    for capture in page.captures:
        key = key_of(capture, "calibrate")
        lost = outcomes.lost.get(key.of)
        made_of = "" if lost and lost.key == key else outcomes.inputs.digests.get(key, "")
        if not made_of and (earlier := records.fingerprint(key)):
            made_of = digest(earlier)
        if capture.setup in known or not made_of:
            continue
        found[f"sensor and light, by {capture.object}/{capture.layer}"] = made_of
        if any(_of_camera(records, key).values()):
            known.add(capture.setup)
    return found


def measured_of(page: CameraPage, records: BuildRecords) -> dict[str, dict[str, Any]]:
    """Return the measurements of sensor and light by the first capture of each setup, by setup."""
    found: dict[str, dict[str, Any]] = {}
    for capture in page.captures:
        of_camera = _of_camera(records, key_of(capture, "calibrate"))
        if capture.setup not in found and any(of_camera.values()):
            found[capture.setup] = of_camera
    return found


def _of_camera(records: BuildRecords, key: Key) -> dict[str, dict[str, Any]]:
    """Return what a calibration measured of sensors and light, by sensor."""
    return {
        sensor: {name: value for name, value in one.items() if name != "sensels"}
        for sensor, one in records.notes(key).get("measured", {}).items()
    }


def stray_light_of(records: BuildRecords, capture: Capture) -> Mapping[str, Any]:
    """Return the stray light that charts showed of a capture's camera, under its setup where they were captured so; empty without any."""
    return of_setup(capture.setup, records.notes(page_key(capture.camera)).get("stray_light", {}))


def of_setup(setup: str, strayed: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the stray light under a setup, else under the first one."""
    return strayed.get(setup) or next(iter(strayed.values()), {})

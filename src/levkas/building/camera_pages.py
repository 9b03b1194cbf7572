"""The report page of every camera: sensor and light as measured in its captures, and its charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas import __version__
from levkas.building.build_records import BuildRecords, Key, key_of
from levkas.building.graph import cameras_with_pages, page_key
from levkas.building.inputs import digest, of_calibration, plain, read_by, written
from levkas.calibration.chart_light import CHART_WHITE
from levkas.campaign.discovery.find_captures import find_charts
from levkas.campaign.schema.tables import CALIBRATE, CAMERA
from levkas.core.disk import WriteRefused
from levkas.core.files import make_folder, write_json, write_text
from levkas.core.internal_errors import as_refusal
from levkas.core.problems import Problem
from levkas.database.layout import LayerId
from levkas.quality.targets.indicators import WhiteEvenness, lightness_spread
from levkas.quality.targets.stray_light import NOT_MEASURED
from levkas.stages.budget import budget_of
from levkas.stages.charts import edges_of
from levkas.stages.measurements import FEW_BANDS, levels_of
from levkas.stages.sources import made_with
from levkas.stages.written import Written

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.building.outcomes import Outcomes
    from levkas.calibration.error_sources import ErrorSource
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.campaign.discovery.file_index import FileIndex
    from levkas.core.cube import Band
    from levkas.pages.budget import UncertaintyBudget
    from levkas.quality.targets.edges import EdgeTargetMeasure
    from levkas.quality.targets.measuring import ChartMeasure
    from levkas.stages.template_cache import TemplateCache


GREY = 0.2
"""Reflectance of an old painting, about; of what is relative in a budget half of it shows half."""


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


def write_camera_page(page: CameraPage, outcomes: Outcomes, templates: TemplateCache) -> Written:
    """Write a camera's page, its description and its charts; raises Refused."""
    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    path = places.output / "cameras" / page.camera / "report.html"
    make_folder(path.parent)
    measured = measured_of(page, records)
    measures, problems, files, strayed = _measured(page, outcomes, templates)
    budgets = budgets_of(page, campaign, measured, strayed)
    shown = [(s, _describe_budget(rows, page.first, measured[s])) for s, rows in budgets.items()]
    write_text(
        path, _page(page.camera, campaign, measured, measures, problems, shown, bool(strayed))
    )
    described = path.parent / "camera.json"
    write_json(described, describe_camera(campaign, page.first, measured, budgets))
    files += [path, described, *write_sensitivity(path.parent, campaign, page.first)]
    stay = _charts_that_stay(page, outcomes, files)
    files += [path for paths in stay.values() for path in paths]
    # A chart that cannot be measured is no fault of the objects: reported, not refused.
    warnings = (
        *(f"charts/{name}: of an earlier build: not measured now" for name in stay),
        *(written(campaign, problem) for problem in problems),
        *(f"{m.name}: {m.stray_light}" for m in measures if m.stray_light),
    )
    return Written(files, {"warnings": list(warnings), "stray_light": strayed}, warnings=warnings)


def _charts_that_stay(
    page: CameraPage, outcomes: Outcomes, files: Sequence[Path]
) -> dict[str, list[Path]]:
    """Return the files of charts that campaign.toml declares, and that this camera's frames do not show now, by their names."""
    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    made = {places.output / name for name in records.products(page_key(page.camera))}
    left = sorted(path for path in made - {*files} if path.is_file())
    setups = ("", *campaign.setups)
    stems = (LayerId(c, page.camera, s).stem for c in campaign.targets.charts for s in setups)
    gone = {s for s in stems if any(path.name == f"{s}.json" for path in left)}
    return {s: [p for p in left if p.name.startswith((f"{s}.", f"{s}_"))] for s in sorted(gone)}


def stray_light_of(records: BuildRecords, capture: Capture) -> Mapping[str, Any]:
    """Return the stray light that charts showed of a capture's camera, under its setup where they were captured so; empty without any."""
    return _under(capture.setup, records.notes(page_key(capture.camera)).get("stray_light", {}))


def _under(setup: str, strayed: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the stray light under a setup, else under the first one."""
    return strayed.get(setup) or next(iter(strayed.values()), {})


def prints_of_page(page: CameraPage, outcomes: Outcomes) -> dict[str, Any]:
    """Return the fingerprint of a camera's page."""
    campaign, records = outcomes.campaign, outcomes.records
    first = page.first
    prints: dict[str, Any] = {
        **made_with(),
        **_measured_in(page, outcomes),
        "charts refused": [written(campaign, p) for p in page.refused],
    }
    for capture in (*page.captures, *page.charts):
        bare = replace(capture, object="")
        prints |= read_by((CALIBRATE, CAMERA), campaign, bare, records.hashes)
    prints["bands"] = [[b.label, str(b.wavelength), str(b.fwhm)] for b in first.bands]
    prints["order of captures"] = [f"{c.object}/{c.layer}" for c in page.captures]
    prints["sensors"] = [[s.name, s.pattern, len(s.bands)] for s in first.sensors]
    return plain(prints | prints_of_charts(page, campaign, records))


def prints_of_charts(page: CameraPage, campaign: Campaign, records: BuildRecords) -> dict[str, Any]:
    """Return what the charts that a camera saw are made of."""
    prints: dict[str, Any] = {}
    for capture in page.charts:
        name = f"chart {capture.object}/{capture.layer}"
        fingerprint = of_calibration(campaign, capture, records.hashes)
        prints[name] = digest(fingerprint)
        prints[f"{name} kind"] = campaign.targets.charts[capture.object]
        if named := edges_of(campaign, capture):
            prints[f"{name} edges"] = [[s, [list(p.box) for p in e]] for s, e in named.items()]
    return prints


def _measured_in(page: CameraPage, outcomes: Outcomes) -> dict[str, str]:
    """Return the calibrations that `measured_of` takes its measurements from, and what each is made of.

    A calibration that is to be done again is another one: what it will measure need not be known.
    """
    records, inputs, lost = outcomes.records, outcomes.inputs, outcomes.lost
    found: dict[str, str] = {}
    known = set()
    for capture in page.captures:
        key = key_of(capture, "calibrate")
        step = lost.get((capture.object, capture.layer))
        made_of = "" if step is not None and step.key == key else inputs.digests.get(key, "")
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
        if capture.setup not in found:
            of_camera = _of_camera(records, key_of(capture, "calibrate"))
            if any(of_camera.values()):
                found[capture.setup] = of_camera
    return found


def budgets_of(
    page: CameraPage,
    campaign: Campaign,
    measured: Mapping[str, Mapping[str, Mapping[str, Any]]],
    strayed: Mapping[str, Mapping[str, Any]],
) -> dict[str, tuple[ErrorSource, ...]]:
    """Return the uncertainty budget of the camera's values under each setup that has one; `strayed` is the stray light of its charts."""
    captures = {capture.setup: capture for capture in reversed(page.captures)}
    found = {
        s: budget_of(campaign, captures[s], facts, _under(s, strayed))
        for s, facts in measured.items()
    }
    return {setup: rows for setup, rows in found.items() if rows}


def _describe_budget(
    rows: Sequence[ErrorSource], first: Capture, measured: Mapping[str, Mapping[str, Any]]
) -> UncertaintyBudget | None:
    """Return table and plot of a budget, of values as bright as the mean of the view, or of `GREY` where that is not known."""
    from levkas.pages.budget import describe_budget

    levels = {band.label: GREY for band in first.bands}
    levels |= {
        label: at for one in measured.values() for label, at in one.get("mean_of_view", {}).items()
    }
    noise = {
        label: float(
            np.linalg.norm([row.size.get(label, 0.0) for row in rows if row.common_to == "pixel"])
        )
        for label in levels
    }
    return describe_budget(rows, first.bands, levels, noise)


def _of_camera(records: BuildRecords, key: Key) -> dict[str, dict[str, Any]]:
    """Return what a calibration measured of sensors and light, by sensor."""
    return {
        sensor: {name: value for name, value in one.items() if name != "sensels"}
        for sensor, one in records.notes(key).get("measured", {}).items()
    }


def _measured(
    page: CameraPage, outcomes: Outcomes, templates: TemplateCache
) -> tuple[
    list[ChartMeasure | EdgeTargetMeasure], list[Problem], list[Path], dict[str, dict[str, Any]]
]:
    """Measure the charts that a camera saw, and write them; return also the stray light that they show, by setup."""
    from levkas.quality.targets.charts import kind_of, reference_of
    from levkas.quality.targets.measuring import ChartMeasure
    from levkas.stages.charts import (
        develop_chart,
        folder_of_frames,
        measure_chart,
        problems_of,
        stray_light_in,
        write_chart,
    )

    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    measured = measured_of(page, records)
    files: list[Path] = []
    measures: list[ChartMeasure | EdgeTargetMeasure] = []
    problems = list(page.refused)
    strayed: dict[str, dict[str, Any]] = {}
    for capture in page.charts:
        name = f"{capture.object}/{capture.layer}"
        key = key_of(capture, f"chart-{capture.object}")
        records.drop_report(key)
        light = _evenness(measured.get(capture.setup, {}))
        try:
            chart = kind_of(campaign.targets.charts[capture.object])
            developed = develop_chart(capture, campaign, templates)
            spectra = reference_of(chart) if chart else None
            found = measure_chart(name, developed, chart, spectra, evenness=light)
            white = campaign.cameras[page.camera].white_chart
            if white is not None and isinstance(found, ChartMeasure):
                found = replace(found, notes=(*found.notes, BY_ITSELF))
            measures.append(found)
            if shown := stray_light_in(developed, found):  # a trap shows more than a chart's black
                strayed[capture.setup] = shown | (
                    strayed.get(capture.setup, {}) if not developed.trapped else {}
                )
            problems += problems_of(name, folder_of_frames(capture), found.edges.problems)
            files += write_chart(places, campaign, capture, developed, found)
        except WriteRefused:
            raise
        except Exception as error:
            refused = as_refusal(error, f"chart {name}", capture.sensors[0].object[0].path)
            reported = records.with_report(key, refused).problems
            problems += problems_of(name, folder_of_frames(capture), reported)
    return measures, problems, files, strayed


def _evenness(measured: Mapping[str, Any]) -> WhiteEvenness | None:
    """Return how even the white is in its worst channel, from the maps that captures of objects left."""
    fields = [
        light for of_sensor in measured.values() for light in of_sensor.get("light", {}).values()
    ]
    drawn = [lightness_spread(levels_of(field)) for field in fields if "levels" in field]
    if not drawn:
        return None
    return WhiteEvenness(min(f["uniformity"] for f in fields if "uniformity" in f), max(drawn))


def _page(
    camera: str,
    campaign: Campaign,
    measured: Mapping[str, Mapping[str, Any]],
    measures: Sequence[ChartMeasure | EdgeTargetMeasure],
    problems: Sequence[Problem],
    budgets: Sequence[tuple[str, UncertaintyBudget | None]],
    strayed: bool,
) -> str:
    """Return the HTML of a camera's page; `strayed` is whether stray light was measured."""
    from levkas.calibration.sensor import spread
    from levkas.pages.charts import describe_chart
    from levkas.pages.page import render_page
    from levkas.pages.radiometry import draw_light

    sensors, lights, figures, notes, whites = [], [], [], [], []
    for setup, of_sensors in measured.items():
        for sensor, of_sensor in of_sensors.items():
            name = " ".join(part for part in (setup, sensor) if part)
            if "sensor" in of_sensor:
                sensors.append((name or "the only one", of_sensor["sensor"]))
            bands = of_sensor.get(CHART_WHITE, {}).get("bands", {})
            whites += [(f"{name} {label}".strip(), band) for label, band in bands.items()]
            fields = of_sensor.get("light", {})
            shown = {*spread(list(fields), FEW_BANDS)}
            shown |= {label for label, light in fields.items() if "refused" in light}
            lights += [(f"{name} {b}".strip(), f) for b, f in fields.items() if b in shown]
            lamps = of_sensor.get("lamp", {}).values()
            if fields:
                known = any(one["white"] is not None for one in lamps)
                notes.append(LAMP_JUMP if known else LAMP_UNKNOWN)
            if drawn := [label for label, light in fields.items() if "levels" in light]:
                label = drawn[len(drawn) // 2]
                what = f"{name} {label}".strip()
                figures += draw_light(fields[label], levels_of(fields[label]), what)
            strayed = strayed or "stray_light" in of_sensor
    if lights and not strayed:
        notes.append(NOT_MEASURED)
    return render_page(
        "camera.html",
        page={
            "title": camera,
            "sensors": sensors,
            "lights": lights,
            "notes": dict.fromkeys(notes),
            "figures": figures,
            "whites": whites,
            "budgets": [one for one in budgets if one[1] is not None],
            "charts": [describe_chart(m) for m in measures],
            "problems": [{"code": p.code, "text": written(campaign, p)} for p in problems],
            "footer": f"Levkas {__version__}. Camera {camera}; coordinates are in its native pixels.",
        },
    )


LAMP_UNKNOWN = (
    "how the lamp changed was not measured, and sigma does not contain it: capture the white more than once, best before and "
    "after the objects, with the time in its files"
)
LAMP_JUMP = (
    "whether the lamp changed all at once between white and object is not known: nothing shows it without whites before and after "
    "the objects, with the time in their files"
)
BY_ITSELF = (
    "the camera's white is a chart: the colours of that chart were fitted to the "
    "published ones, so only their held-out errors are a test"
)
PICTURES = ("levels", "shape", "step", "size")
"""Of a light field: its map, which the camera's page shows."""


def write_sensitivity(folder: Path, campaign: Campaign, capture: Capture) -> list[Path]:
    """Write cameras/CAMERA/sensitivity.csv, where one is declared: wavelength in nm, a column a channel."""
    from levkas.core.files import write_text
    from levkas.stages.spectra import read_sensitivity

    declared = campaign.cameras[capture.camera].sensitivity
    if not declared:
        return []
    labels = [band.label for band in capture.bands]
    wavelengths, table = read_sensitivity(campaign.root / declared, labels)
    lines = [",".join(["wavelength", *labels])]
    for wavelength, row in zip(wavelengths, table, strict=True):
        lines.append(",".join(f"{number:.9g}" for number in (wavelength, *row)))
    path = folder / "sensitivity.csv"
    write_text(path, "\n".join(lines) + "\n")
    return [path]


def describe_camera(
    campaign: Campaign,
    capture: Capture,
    measured: Mapping[str, Mapping[str, Any]],
    budgets: Mapping[str, Sequence[ErrorSource]],
) -> dict[str, Any]:
    """Return cameras/CAMERA/camera.json: bands, sensors, what was measured of them and the uncertainty of values, by setup."""
    keys = campaign.cameras[capture.camera]
    return {
        "camera": capture.camera,
        "kind": keys.kind,
        "bits": keys.bits,
        "black": keys.black,
        "saturation": keys.saturation,
        "bands": _bands(capture.bands),
        "sensors": [
            {
                "name": s.name,
                "pattern": [list(row) for row in s.pattern] if s.pattern else None,
                "bands": [band.label for band in s.bands],
            }
            for s in capture.sensors
        ],
        "measured": {
            setup or "": _without_pictures(of_sensor) for setup, of_sensor in measured.items()
        },
        "uncertainty": {s or "": [row.to_dict() for row in rows] for s, rows in budgets.items()},
    }


def _bands(bands: Sequence[Band]) -> list[dict[str, Any]]:
    return [
        {
            "label": b.label,
            "wavelength_nm": None if isnan(b.wavelength) else b.wavelength,
            "fwhm_nm": None if isnan(b.fwhm) else b.fwhm,
        }
        for b in bands
    ]


def _without_pictures(of_sensor: Mapping[str, Any]) -> dict[str, Any]:
    return {
        sensor: {
            **{k: v for k, v in facts.items() if k != "light"},
            "light": {
                band: {k: v for k, v in light.items() if k not in PICTURES}
                for band, light in facts.get("light", {}).items()
            },
        }
        for sensor, facts in of_sensor.items()
    }

"""The report page of every camera, its description, and the charts that it saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas import __version__
from levkas.building.build_records import key_of
from levkas.building.camera_pages import CameraPage, measured_of, of_setup
from levkas.building.graph import page_key
from levkas.building.inputs import written
from levkas.calibration.chart_light import CHART_WHITE
from levkas.calibration.sensor import spread
from levkas.core.disk import WriteRefused
from levkas.core.files import make_folder, write_json, write_text
from levkas.core.internal_errors import as_refusal
from levkas.core.problems import Problem
from levkas.database.layout import LayerId
from levkas.pages.budget import describe_budget
from levkas.pages.charts import describe_chart
from levkas.pages.page import render_page
from levkas.pages.radiometry import draw_light
from levkas.quality.targets.charts import kind_of, reference_of
from levkas.quality.targets.indicators import WhiteEvenness, lightness_spread
from levkas.quality.targets.measuring import ChartMeasure
from levkas.quality.targets.stray_light import NOT_MEASURED
from levkas.stages.budget import budget_of
from levkas.stages.charts import (
    develop_chart,
    folder_of_frames,
    measure_chart,
    problems_of,
    stray_light_in,
    write_chart,
)
from levkas.stages.measurements import FEW_BANDS, levels_of
from levkas.stages.spectra import read_sensitivity
from levkas.stages.written import Written

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.building.outcomes import Outcomes
    from levkas.calibration.error_sources import ErrorSource
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.pages.budget import UncertaintyBudget
    from levkas.quality.targets.edges import EdgeTargetMeasure
    from levkas.stages.template_cache import TemplateCache


GREY = 0.2
"""Reflectance of an old painting, about; of what is relative in a budget half of it shows half."""


def write_camera_page(page: CameraPage, outcomes: Outcomes, templates: TemplateCache) -> Written:
    """Write a camera's page, its description and its charts; raises Refused."""
    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    folder = places.output / "cameras" / page.camera
    make_folder(folder)
    measured = measured_of(page, records)
    charts = _measure_charts(page, outcomes, templates, measured)
    captures = {capture.setup: capture for capture in reversed(page.captures)}
    found = {
        setup: budget_of(campaign, captures[setup], facts, of_setup(setup, charts.strayed))
        for setup, facts in measured.items()
    }
    budgets = {setup: rows for setup, rows in found.items() if rows}
    write_text(folder / "report.html", _page(page, campaign, measured, budgets, charts))
    described = _describe_camera(campaign, page.first, measured, budgets)
    write_json(folder / "camera.json", described)
    files = [folder / "report.html", folder / "camera.json", *charts.files]
    files += _write_sensitivity(folder, campaign, page.first)
    stay = _charts_that_stay(page, outcomes, files)
    files += [path for paths in stay.values() for path in paths]
    # A chart that cannot be measured is no fault of the objects: reported, not refused.
    warnings = (
        *(f"charts/{name}: of an earlier build: not measured now" for name in stay),
        *(written(campaign, problem) for problem in charts.problems),
        *(f"{m.name}: {m.stray_light}" for m in charts.measures if m.stray_light),
    )
    notes = {"warnings": list(warnings), "stray_light": charts.strayed}
    return Written(files, notes, warnings=warnings)


# --- charts -------------------------------------------------------------------------------------


@dataclass
class _Charts:
    """The charts that a camera saw, measured and written, and the stray light that they show, by setup."""

    problems: list[Problem]
    measures: list[ChartMeasure | EdgeTargetMeasure] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    strayed: dict[str, dict[str, Any]] = field(default_factory=dict)


def _measure_charts(
    page: CameraPage, outcomes: Outcomes, templates: TemplateCache, measured: Mapping[str, Any]
) -> _Charts:

    records, made = outcomes.records, _Charts(list(page.refused))
    for capture in page.charts:
        name = f"{capture.object}/{capture.layer}"
        key = key_of(capture, f"chart-{capture.object}")
        records.drop_report(key)
        light = _evenness(measured.get(capture.setup, {}))
        try:
            _measure_chart(name, capture, outcomes, templates, light, made)
        except WriteRefused:
            raise
        except Exception as error:
            refused = as_refusal(error, f"chart {name}", capture.sensors[0].object[0].path)
            reported = records.with_report(key, refused).problems
            made.problems += problems_of(name, folder_of_frames(capture), reported)
    return made


def _measure_chart(
    name: str,
    capture: Capture,
    outcomes: Outcomes,
    templates: TemplateCache,
    light: WhiteEvenness | None,
    made: _Charts,
) -> None:

    campaign = outcomes.campaign
    chart = kind_of(campaign.targets.charts[capture.object])
    developed = develop_chart(capture, campaign, templates)
    spectra = reference_of(chart) if chart else None
    found = measure_chart(name, developed, chart, spectra, evenness=light)
    if campaign.cameras[capture.camera].white_chart and isinstance(found, ChartMeasure):
        found = replace(found, notes=(*found.notes, BY_ITSELF))
    made.measures.append(found)
    if shown := stray_light_in(developed, found):  # a trap shows more than a chart's black
        before = {} if developed.trapped else made.strayed.get(capture.setup, {})
        made.strayed[capture.setup] = shown | before
    made.problems += problems_of(name, folder_of_frames(capture), found.edges.problems)
    made.files += write_chart(outcomes.places, campaign, capture, developed, found)


def _evenness(measured: Mapping[str, Any]) -> WhiteEvenness | None:
    """Return how even the white is in its worst channel, from the maps that captures of objects left."""
    fields = [light for one in measured.values() for light in one.get("light", {}).values()]
    drawn = [lightness_spread(levels_of(field)) for field in fields if "levels" in field]
    if not drawn:
        return None
    return WhiteEvenness(min(f["uniformity"] for f in fields if "uniformity" in f), max(drawn))


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


# --- the page and the description ---------------------------------------------------------------


def _page(
    page: CameraPage,
    campaign: Campaign,
    measured: Mapping[str, Mapping[str, Any]],
    budgets: Mapping[str, Sequence[ErrorSource]],
    charts: _Charts,
) -> str:
    """Return the HTML of a camera's page."""

    sensors, lights, figures, notes, whites = [], [], [], [], []
    strayed = bool(charts.strayed)
    for setup, sensor, found in (
        (u, s, one) for u, by in measured.items() for s, one in by.items()
    ):
        name = " ".join(part for part in (setup, sensor) if part)
        if "sensor" in found:
            sensors.append((name or "the only one", found["sensor"]))
        bands = found.get(CHART_WHITE, {}).get("bands", {})
        whites += [(f"{name} {label}".strip(), band) for label, band in bands.items()]
        fields = found.get("light", {})
        shown = {
            *spread(list(fields), FEW_BANDS),
            *(b for b, f in fields.items() if "refused" in f),
        }
        lights += [(f"{name} {b}".strip(), f) for b, f in fields.items() if b in shown]
        if fields:
            known = any(one["white"] is not None for one in found.get("lamp", {}).values())
            notes.append(LAMP_JUMP if known else LAMP_UNKNOWN)
        if drawn := [label for label, light in fields.items() if "levels" in light]:
            light = fields[label := drawn[len(drawn) // 2]]
            figures += draw_light(light, levels_of(light), f"{name} {label}".strip())
        strayed = strayed or "stray_light" in found
    if lights and not strayed:
        notes.append(NOT_MEASURED)
    tables = ((s, _describe_budget(rows, page.first, measured[s])) for s, rows in budgets.items())
    return render_page(
        "camera.html",
        page={
            "title": page.camera,
            "sensors": sensors,
            "lights": lights,
            "notes": dict.fromkeys(notes),
            "figures": figures,
            "whites": whites,
            "budgets": [one for one in tables if one[1] is not None],
            "charts": [describe_chart(m) for m in charts.measures],
            "problems": [{"code": p.code, "text": written(campaign, p)} for p in charts.problems],
            "footer": f"Levkas {__version__}. Camera {page.camera}; coordinates are in its native pixels.",
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


def _describe_budget(
    rows: Sequence[ErrorSource], first: Capture, measured: Mapping[str, Mapping[str, Any]]
) -> UncertaintyBudget | None:
    """Return table and plot of a budget, of values as bright as the mean of the view, or of `GREY` where that is not known."""

    levels = {band.label: GREY for band in first.bands}
    for one in measured.values():
        levels |= one.get("mean_of_view", {})
    own = [row.size for row in rows if row.common_to == "pixel"]
    noise = {b: float(np.linalg.norm([size.get(b, 0.0) for size in own])) for b in levels}
    return describe_budget(rows, first.bands, levels, noise)


def _write_sensitivity(folder: Path, campaign: Campaign, capture: Capture) -> list[Path]:
    """Write cameras/CAMERA/sensitivity.csv, where one is declared: wavelength in nm, a column a channel."""

    declared = campaign.cameras[capture.camera].sensitivity
    if not declared:
        return []
    labels = [band.label for band in capture.bands]
    wavelengths, table = read_sensitivity(campaign.root / declared, labels)
    rows = ((w, *row) for w, row in zip(wavelengths, table, strict=True))
    lines = (",".join(f"{number:.9g}" for number in row) for row in rows)
    path = folder / "sensitivity.csv"
    write_text(path, "\n".join([",".join(["wavelength", *labels]), *lines, ""]))
    return [path]


def _describe_camera(
    campaign: Campaign,
    capture: Capture,
    measured: Mapping[str, Mapping[str, Any]],
    budgets: Mapping[str, Sequence[ErrorSource]],
) -> dict[str, Any]:
    """Return cameras/CAMERA/camera.json: bands, sensors, what was measured of them and the uncertainty of values, by setup."""
    keys = campaign.cameras[capture.camera]

    def known(nm: float) -> float | None:
        return None if isnan(nm) else nm

    return {
        "camera": capture.camera,
        **{key: getattr(keys, key) for key in ("kind", "bits", "black", "saturation")},
        "bands": [
            {"label": b.label, "wavelength_nm": known(b.wavelength), "fwhm_nm": known(b.fwhm)}
            for b in capture.bands
        ],
        "sensors": [
            {"name": s.name, "pattern": s.pattern, "bands": [band.label for band in s.bands]}
            for s in capture.sensors
        ],
        "measured": {
            setup or "": {sensor: _without_maps(one) for sensor, one in by_sensor.items()}
            for setup, by_sensor in measured.items()
        },
        "uncertainty": {s or "": [row.to_dict() for row in rows] for s, rows in budgets.items()},
    }


def _without_maps(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return what was measured of a sensor without the maps of its light, which the page shows."""
    maps = ("levels", "shape", "step", "size")
    light = {
        b: {k: v for k, v in f.items() if k not in maps} for b, f in found.get("light", {}).items()
    }
    return {**found, "light": light}

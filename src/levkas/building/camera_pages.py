"""The report page of every camera: what its captures told of sensor and light, and its charts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas import __version__
from levkas.building import fingerprints
from levkas.building.build_records import BuildRecords, Key
from levkas.building.capture_statistics import FEW_BANDS, SENSELS, levels_of
from levkas.building.fingerprints import digest, keys_of, written
from levkas.building.progress import Step
from levkas.building.sources import code_version
from levkas.calibration.sensor_context import spread
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from levkas.building.charts import Developed
    from levkas.building.template_cache import TemplateCache
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.core.cube import Band
    from levkas.database.layout import Places
    from levkas.quality.targets.measuring import ChartMeasure


class CameraPages:
    """The pages of a campaign's cameras; plain images, where nothing is calibrated, have none.

    Parameters
    ----------
    captures : list of Capture
        Of all objects.
    """

    def __init__(
        self, campaign: Campaign, places: Places, ledger: BuildRecords, captures: list[Capture]
    ) -> None:
        from levkas.campaign.discovery.find_captures import find_charts

        self.campaign, self.places, self.ledger = campaign, places, ledger
        self.captures = captures
        self.charts: list[Capture] = []
        self.refusals: dict[str, list[Problem]] = {}
        if campaign.targets.charts:
            self.charts, refusals = find_charts(campaign)
            for (_, camera, _), refused in refusals.items():
                self.refusals.setdefault(camera, []).extend(refused.problems)
        seen = {c.camera for c in captures if campaign.cameras[c.camera].kind != "image"}
        self.cameras = [name for name in campaign.cameras if name in seen]

    def states(self) -> list[Step]:
        """Say of every page whether it is fresh or stale."""
        steps = []
        for camera in self.cameras:
            key = page_key(camera)
            why = self.ledger.why_stale(key, self._prints(camera))
            steps.append(Step(key, "stale" if why else "fresh", why))
        return steps

    def run(self, shelf: TemplateCache) -> Iterator[Step]:
        """Write the pages that are stale."""
        for camera in self.cameras:
            key, prints = page_key(camera), self._prints(camera)
            why = self.ledger.why_stale(key, prints)
            if not why:
                yield Step(key, "fresh", warnings=tuple(self.ledger.told(key).get("warnings", ())))
                continue
            yield Step(key, "running", why)
            yield self._write(camera, key, prints, why, shelf)

    def _write(
        self, camera: str, key: Key, prints: dict[str, Any], why: str, shelf: TemplateCache
    ) -> Step:
        from levkas.core.files import make_folder, write_text

        page = self.places.output / "cameras" / camera / "report.html"
        try:
            self.ledger.forget(key)
            make_folder(page.parent)
            measures, problems, made = self._measured(camera, shelf)
            write_text(page, self._page(camera, measures, problems))
            made += [page, *self._describe(camera, page.parent)]
        except Refused as error:
            return Step(key, "refused", error.problems[0].message, problems=error.problems)
        # A chart that cannot be measured is no fault of the objects: said, not refused.
        warnings = tuple(written(self.campaign, problem) for problem in problems)
        self.ledger.keep(key, prints, made, warnings=list(warnings))
        return Step(key, "done", why, warnings=warnings)

    def _describe(self, camera: str, folder: Path) -> list[Path]:
        from levkas.core.files import write_json

        first = next(c for c in self.captures if c.camera == camera)
        path = folder / "camera.json"
        write_json(path, describe_camera(self.campaign, first, self._learnt(camera)))
        return [path, *write_sensitivity(folder, self.campaign, first)]

    def _measured(
        self, camera: str, shelf: TemplateCache
    ) -> tuple[list[ChartMeasure], list[Problem], list[Path]]:
        from levkas.building.charts import develop_chart, measure_capture, problems_of
        from levkas.core.disk import WriteRefused
        from levkas.quality.targets.charts import chart_of, reference_of

        made_files: list[Path] = []
        measures, problems = [], list(self.refusals.get(camera, ()))
        for capture in self.charts:
            if capture.camera != camera:
                continue
            name = f"{capture.object}/{capture.layer}"
            try:
                chart = chart_of(self.campaign.targets.charts[capture.object])
                made = develop_chart(capture, self.campaign, shelf)
                light = self._uniformity(camera, capture.setup)
                found = measure_capture(name, made, chart, reference_of(chart), uniformity=light)
                measures.append(found)
                made_files += write_chart(self.places, self.campaign, capture, made, found)
            except WriteRefused:
                raise
            except Refused as refused:
                problems += problems_of(name, capture, refused)
        return measures, problems, made_files

    def _page(
        self, camera: str, measures: Sequence[ChartMeasure], problems: Sequence[Problem]
    ) -> str:
        from levkas.pages.camera import CameraReport, light_row, render_camera, sensor_row
        from levkas.pages.charts import describe_chart
        from levkas.pages.radiometry import draw_light

        sensors, lights, figures, notes = [], [], [], []
        for setup, learnt in self._learnt(camera).items():
            for sensor, told in learnt.items():
                name = " ".join(part for part in (setup, sensor) if part)
                if "sensor" in told:
                    sensors.append(sensor_row(name, told["sensor"]))
                fields = told.get("light", {})
                for label in spread(list(fields), FEW_BANDS):
                    lights.append(light_row(f"{name} {label}".strip(), fields[label]))
                notes += [
                    f"{b}: {light['refused']}" for b, light in fields.items() if "refused" in light
                ]
                drawn = [label for label, light in fields.items() if "levels" in light]
                if drawn:
                    label = drawn[len(drawn) // 2]
                    what = f"{name} {label}".strip()
                    figures += draw_light(fields[label], levels_of(fields[label]), what)
        return render_camera(
            CameraReport(
                title=camera,
                subtitle=self.campaign.campaign.title,
                sensors=sensors,
                lights=lights,
                light_notes=notes,
                figures=figures,
                charts=[describe_chart(m) for m in measures],
                problems=[{"code": p.code, "text": written(self.campaign, p)} for p in problems],
                footer=f"Levkas {__version__}. Camera {camera}; places are in its native pixels.",
            )
        )

    def _learnt(self, camera: str) -> dict[str, dict[str, Any]]:
        """What the first capture of each setup told, by setup."""
        found: dict[str, dict[str, Any]] = {}
        for capture in self.captures:
            if capture.camera == camera and capture.setup not in found:
                told = self.ledger.told(keys_of(capture)["calibrate"]).get("learnt", {})
                of_camera = {
                    sensor: {name: v for name, v in one.items() if name != SENSELS}
                    for sensor, one in told.items()
                }
                if any(of_camera.values()):
                    found[capture.setup] = of_camera
        return found

    def _uniformity(self, camera: str, setup: str) -> float | None:
        """Least over greatest light of the worst channel."""
        learnt = self._learnt(camera).get(setup, {})
        fields = [light for told in learnt.values() for light in told.get("light", {}).values()]
        return min((f["uniformity"] for f in fields if "uniformity" in f), default=None)

    def _prints(self, camera: str) -> dict[str, Any]:
        prints: dict[str, Any] = {
            "code": code_version("camera"),
            "campaign.title": self.campaign.campaign.title,
            "campaign.creator": self.campaign.campaign.creator,
            "campaign.date": self.campaign.campaign.date,
            "campaign.licence": self.campaign.campaign.licence,
            "learnt of sensor and light": digest(self._learnt(camera)),
            "charts refused": [written(self.campaign, p) for p in self.refusals.get(camera, ())],
        }
        keys = self.campaign.cameras[camera]
        for key in ("kind", "bits", "black", "saturation"):
            prints[f"cameras.{camera}.{key}"] = getattr(keys, key)
        first = next(c for c in self.captures if c.camera == camera)
        prints["bands"] = [[b.label, str(b.wavelength), str(b.fwhm)] for b in first.bands]
        prints["sensors"] = [[s.name, s.pattern, len(s.bands)] for s in first.sensors]
        if declared := keys.sensitivity:
            prints[f"file {declared}"] = self.ledger.hashes(self.campaign.root / declared)
        for capture in self.charts:
            if capture.camera == camera:
                name = f"chart {capture.object}/{capture.layer}"
                made = fingerprints.of_calibration(self.campaign, capture, self.ledger.hashes)
                prints[name] = digest(made)
                prints[f"{name} kind"] = self.campaign.targets.charts[capture.object]
        return fingerprints.plain(prints)


def page_key(camera: str) -> Key:
    """Return the key of the stage that writes a camera's page."""
    return Key("", camera, stage="camera")


PICTURES = ("levels", "shape", "step", "size")
"""Of a light field: its map, which the camera's page shows."""


def write_sensitivity(folder: Path, campaign: Campaign, capture: Capture) -> list[Path]:
    """Write cameras/CAMERA/sensitivity.csv, where one is declared: wavelength in nm, a column a channel.

    Raises
    ------
    Refused
        Where the declared table cannot be read, or the disk refuses.
    """
    from levkas.building.spectra import read_sensitivity
    from levkas.core.files import write_text

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
    campaign: Campaign, capture: Capture, learnt: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return cameras/CAMERA/camera.json: bands, sensors, and what was learnt of them, by setup."""
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
        "learnt": {setup or "": _without_pictures(told) for setup, told in learnt.items()},
    }


def write_chart(
    places: Places, campaign: Campaign, capture: Capture, made: Developed, measure: ChartMeasure
) -> list[Path]:
    """Write charts/CHART/: calibrated cubes in native pixels, one a sensor, and what was measured."""
    from levkas.building.spectra import broad_centroids
    from levkas.core.files import write_json
    from levkas.database.credits import Credits
    from levkas.database.layers import Layer, write_tiffs

    chart, described = capture.object, campaign.campaign
    folder = places.output / "charts" / chart
    credits = Credits(
        title=f"{measure.chart.name}, {capture.layer}",
        creator=described.creator,
        date=made.captured or described.date or "",
        rights=described.licence,
    )
    centroids = broad_centroids(campaign, capture.camera, capture.bands)
    layer = Layer(chart, capture.camera, capture.setup, credits=credits, centroids=centroids)
    written = []
    for sensor, cube in made.cubes.items():
        stem = "_".join(part for part in (layer.stem, sensor) if part)
        written += write_tiffs(folder / stem, layer, cube)
    record = folder / f"{layer.stem}.json"
    write_json(record, {"chart": measure.chart.name, **measure.to_dict()})
    return [*written, record]


def _bands(bands: Sequence[Band]) -> list[dict[str, Any]]:
    return [
        {
            "label": b.label,
            "wavelength_nm": None if isnan(b.wavelength) else b.wavelength,
            "fwhm_nm": None if isnan(b.fwhm) else b.fwhm,
        }
        for b in bands
    ]


def _without_pictures(told: Mapping[str, Any]) -> dict[str, Any]:
    return {
        sensor: {
            **{k: v for k, v in facts.items() if k != "light"},
            "light": {
                band: {k: v for k, v in light.items() if k not in PICTURES}
                for band, light in facts.get("light", {}).items()
            },
        }
        for sensor, facts in told.items()
    }


def joined_sigma(one: np.ndarray | None, other: np.ndarray | None) -> np.ndarray | None:
    """Return sigma of the mean of two halves; None where it is not known of both."""
    if one is None or other is None:
        return None
    return np.sqrt(one.astype(np.float64) ** 2 + other.astype(np.float64) ** 2).astype(
        np.float32
    ) / np.float32(2)

"""The report page of every camera: what its captures told of sensor and light, and its charts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from levkas import __version__
from levkas.building import fingerprints
from levkas.building.codes import spread
from levkas.building.fingerprints import digest, keys_of, written
from levkas.building.ledger import Key, Ledger
from levkas.building.measuring import FEW_BANDS, SENSELS, levels_of
from levkas.building.sources import code_version
from levkas.building.steps import Step
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.building.shelf import Shelf
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
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
        self, campaign: Campaign, places: Places, ledger: Ledger, captures: list[Capture]
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

    def run(self, shelf: Shelf) -> Iterator[Step]:
        """Write the pages that are stale."""
        for camera in self.cameras:
            key, prints = page_key(camera), self._prints(camera)
            why = self.ledger.why_stale(key, prints)
            if not why:
                yield Step(key, "fresh", warnings=tuple(self.ledger.told(key).get("warnings", ())))
                continue
            yield Step(key, "running", why)
            yield self._write(camera, key, prints, why, shelf)

    def _write(self, camera: str, key: Key, prints: dict[str, Any], why: str, shelf: Shelf) -> Step:
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
        from levkas.building.camera_files import describe_camera, write_sensitivity
        from levkas.core.files import write_json

        first = next(c for c in self.captures if c.camera == camera)
        path = folder / "camera.json"
        write_json(path, describe_camera(self.campaign, first, self._learnt(camera)))
        return [path, *write_sensitivity(folder, self.campaign, first)]

    def _measured(
        self, camera: str, shelf: Shelf
    ) -> tuple[list[ChartMeasure], list[Problem], list[Path]]:
        from levkas.building.camera_files import write_chart
        from levkas.building.charting import develop_chart, measure_capture, problems_of
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

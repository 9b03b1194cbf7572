"""The stages of a capture: each computes, then writes, and says what it has written.

What one reads is calibrated again, or read back, where it is not held already.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import nan
from typing import TYPE_CHECKING

from levkas.building.build_records import BuildRecords, key_of
from levkas.building.graph import Graph, Task, captures_of
from levkas.building.inputs import CALIBRATION, REGISTRATION, limited
from levkas.core.digests import hash_file
from levkas.core.machine import give_back_memory, keep_memory, steady_libraries
from levkas.stages.written import Written

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places
    from levkas.stages.parts import CalibratedCapture
    from levkas.stages.reference import ReferenceFrame
    from levkas.stages.template_cache import TemplateCache


class Stages:
    """Does the tasks of a graph, one at a time; the records are only read.

    Calibrated cubes of one capture and the reference of one object are held for the next stages, else calibrated again.
    """

    def __init__(
        self,
        campaign: Campaign,
        places: Places,
        records: BuildRecords,
        templates: TemplateCache,
        graph: Graph,
    ) -> None:
        self.calibrating, self.campaign = (
            limited(campaign, keys) for keys in (CALIBRATION, REGISTRATION)
        )
        self.places, self.records = places, records
        self.templates, self.graph = templates, graph
        self._capture: Capture | None = None
        self._native: CalibratedCapture | None = None
        self._frame: ReferenceFrame | None = None

    def do(self, task: Task) -> Written:
        """Compute a task and write it. Raises Refused or MemoryError."""
        stages: Mapping[str, Callable[[Task], Written]] = {
            "calibrate": self._calibrate,
            "register": self._register,
            "resample": self._resample,
        }
        keep_memory()
        give_back_memory()
        with steady_libraries():
            return stages[task.key.stage](task)

    def native(self, capture: Capture) -> CalibratedCapture:
        """Return a calibrated capture."""
        if self._native is None or self._capture is not capture:
            self._native = None
            self._capture, self._native = capture, self._read(capture)
        return self._native

    def frame(self, task: Task) -> ReferenceFrame:
        """Return the reference that a capture is registered to."""
        from levkas.stages.reference import ReferenceFrame

        _, lead = captures_of(task)
        if self._frame is None or self._frame.capture is not lead:
            self._frame = None
            tasks = self.graph.values()
            mine = [t.capture for t in tasks if t.key.object == lead.object and t.capture]
            native = self.native(lead) if task.leads else self._read(lead)
            self._frame = ReferenceFrame(self.campaign, self.places, [lead, *mine], native)
        return self._frame

    def _read(self, capture: Capture) -> CalibratedCapture:
        from levkas.stages.calibrate import load_calibrated

        notes = self.records.notes(key_of(capture, "calibrate"))
        return load_calibrated(capture, self.calibrating, self.places, notes, self.templates)

    def _calibrate(self, task: Task) -> Written:
        from levkas.stages.calibrate import calibrate, write_calibrated

        capture, _ = captures_of(task)
        self._native = None
        self.templates.used.clear()
        native = calibrate(capture, self.calibrating, self.templates, self.places)
        self._capture, self._native = capture, native
        used = sorted(self.templates.used)
        written = write_calibrated(native, capture, self.calibrating, self.places)
        return written._replace(notes={**written.notes, "templates": used})

    def _register(self, task: Task) -> Written:
        from levkas.database.registrations import apply_confirmation
        from levkas.stages.register import draw_recorded, measure, publish_registration

        capture, _ = captures_of(task)
        native, frame = self.native(capture), self.frame(task)
        found = measure(capture, native, frame, self.campaign)
        verdict = apply_confirmation(
            found.record, self.campaign.edits.confirmed.get((capture.object, capture.layer))
        )
        found = replace(found, record={**found.record, "verdict": verdict})
        size_mm = size_of(self.campaign, capture.object)
        written = publish_registration(found, capture, self.places, size_mm)
        if not found.problems or capture.tiles:
            return written
        return written._replace(notes={**written.notes, "recorded": draw_recorded(native)})

    def _resample(self, task: Task) -> Written:
        from levkas.core.files import make_folder
        from levkas.stages.reference import record_of
        from levkas.stages.resample import resample

        capture, _ = captures_of(task)
        for folder in (self.places.folder(capture.object), self.places.store(capture.object)):
            make_folder(folder)
        frame, record = self.frame(task), record_of(self.places, capture)
        return resample(capture, self._taken(capture), frame, record)

    def _taken(self, capture: Capture) -> CalibratedCapture:
        """Return a calibrated capture, which is held no longer: its memory goes before the layer is written."""
        native, self._native = self.native(capture), None
        return native


def size_of(campaign: Campaign, name: str) -> tuple[float, float] | None:
    """Return the declared size of an object, (width, height) mm."""
    facts = campaign.objects.get(name)
    return facts.size_mm if facts else None


def describe_anew(task: Task, campaign: Campaign, places: Places, records: BuildRecords) -> Written:
    """Write anew what the files of a task say about their pixels, which stay."""
    from levkas.core.files import together, write_json
    from levkas.database.catalogue import entry_of
    from levkas.database.layers import describe_files
    from levkas.database.registrations import read_registration, with_size
    from levkas.stages.register import lasting_warnings
    from levkas.stages.spectra import broad_centroids, credits_of

    (capture, _), key = captures_of(task), task.key
    files, notes = [places.output / name for name in records.products(key)], records.notes(key)
    record = {}
    if key.stage != "calibrate":  # native pixels have no sampling
        path = places.registration(capture.object, capture.layer)
        record = with_size(read_registration(path), size_of(campaign, capture.object))
    if key.stage == "register":
        notes["warnings"] = lasting_warnings(record, f"{capture.object}/{capture.layer}")
        write_json(path, record)
        return Written(files, notes)
    scale = record["grid"]["px_per_mm"] if record else None
    captured = records.notes(key_of(capture, "calibrate"))["captured"]
    centroids = broad_centroids(campaign, capture.camera, capture.bands)
    with together():
        describe_files(files, credits_of(campaign, capture.object, captured), scale, centroids)
    if record:
        tiff = hash_file(places.layer(capture.object, capture.camera, capture.setup))
        entry = replace(entry_of(notes["entry"]), px_per_mm=scale or nan, sha256=tiff)
        notes["entry"] = entry.to_row()
    return Written(files, notes)

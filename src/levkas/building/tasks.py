"""The stages of a capture as tasks: what one reads is calibrated again, or read back, where it is not held already."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from levkas.building.build_records import BuildRecords, Key, key_of
from levkas.building.graph import Graph, Task, captures_of
from levkas.core.machine import give_back_memory, steady_libraries
from levkas.core.problems import Problem, Refused
from levkas.stages.written import Written

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places
    from levkas.stages.native_cubes import CalibratedCapture
    from levkas.stages.reference import ReferenceFrame
    from levkas.stages.register import Measured
    from levkas.stages.template_cache import TemplateCache

    Write = Callable[[Callable[[], object]], Written]


class Damaged(Refused):
    """What an earlier task has kept cannot be read; `key` is that task's."""

    def __init__(self, key: Key, problem: Problem) -> None:
        super().__init__(problem)
        self.key = key


@dataclass
class ReferenceMemory:
    """The reference of the object that was built last, from one build to the next of a process that lasts longer.

    Parameters
    ----------
    frame : ReferenceFrame, optional
    made_of : object
        Its campaign, and the fingerprints of its calibration and its registration.
    pictures : dict of Key to bytes
        Captures on a coarse grid, PNG, by the key of their registration: drawn before they are resampled.
    """

    frame: ReferenceFrame | None = None
    made_of: object = None
    pictures: dict[Key, bytes] = field(default_factory=dict)


class CalibratedCache:
    """Calibrated cubes of one capture and the reference of one object: in memory, else calibrated again."""

    def __init__(
        self,
        campaign: Campaign,
        places: Places,
        records: BuildRecords,
        templates: TemplateCache,
        memory: ReferenceMemory | None = None,
    ) -> None:
        self.campaign, self.places, self.records = campaign, places, records
        self.templates = templates
        self.memory = memory
        self._capture: Capture | None = None
        self._native: CalibratedCapture | None = None
        self._frame: ReferenceFrame | None = None
        self.streams = False
        """Whether the capture is calibrated as it is written and read."""

    def calibrate(self, capture: Capture) -> CalibratedCapture:
        """Calibrate a capture, which is kept, packed, for the next stages."""
        from levkas.stages.calibrate import calibrate

        self.let_go()
        self.templates.used.clear()
        native = calibrate(capture, self.campaign, self.templates, self.places)
        self._keep(capture, native.packed())
        return native

    def native(self, capture: Capture) -> CalibratedCapture:
        """Return a calibrated capture."""
        if self._native is None or self._capture is not capture:
            self.let_go()
            return self._keep(capture, self._read(capture))
        return self._native

    def _keep(self, capture: Capture, native: CalibratedCapture) -> CalibratedCapture:
        self._capture, self._native, self.streams = capture, native, native.is_streamed
        return native

    def frame(self, task: Task, graph: Graph) -> ReferenceFrame:
        """Return the reference that a capture is registered to."""
        from levkas.stages.reference import ReferenceFrame

        _, lead = captures_of(task)
        if self._frame is None or self._frame.capture is not lead:
            self._frame = None
            mine = [t.capture for t in graph.values() if t.key.object == lead.object and t.capture]
            if not task.leads and (frame := self._remembered(lead, [lead, *mine])):
                self._frame = frame
                return frame
            native = self.native(lead) if task.leads else self._read(lead)
            self._frame = ReferenceFrame(self.campaign, self.places, [lead, *mine], native)
        return self._frame

    def remember(self) -> None:
        """Keep the reference for the build after this one, where such a one is to come."""
        if self.memory is not None and self._frame is not None:
            made_of = self._made_of(self._frame.capture)
            self.memory.frame, self.memory.made_of = self._frame, made_of

    def _remembered(self, lead: Capture, captures: list[Capture]) -> ReferenceFrame | None:
        """Return the reference of the build before this one where it is made of the same."""
        if self.memory is None or self.memory.frame is None:
            return None
        frame = self.memory.frame
        if self.memory.made_of != self._made_of(lead):
            return None
        return frame if frame.serve(self.campaign, self.places, captures) else None

    def _made_of(self, lead: Capture) -> object:
        """Return everything that a reference depends on."""
        stages = ("calibrate", "register", "resample")
        prints = [self.records.fingerprint(key_of(lead, stage)) for stage in stages]
        return (self.campaign, self.places, prints) if all(prints) else object()

    def let_go(self) -> None:
        """Let go of the capture's cubes."""
        self._capture, self._native = None, None

    def _read(self, capture: Capture) -> CalibratedCapture:
        from levkas.stages.calibrate import load_calibrated

        notes = self.records.notes(key_of(capture, "calibrate"))
        return load_calibrated(capture, self.campaign, self.places, notes, self.templates)


class Stages:
    """Computes the tasks of a graph, one at a time; the records are only read.

    Parameters
    ----------
    campaign : Campaign
    places : Places
    records : BuildRecords
    templates : TemplateCache
    graph : Graph
    memory : ReferenceMemory, optional
    """

    def __init__(
        self,
        campaign: Campaign,
        places: Places,
        records: BuildRecords,
        templates: TemplateCache,
        graph: Graph,
        memory: ReferenceMemory | None = None,
    ) -> None:
        self.campaign, self.places, self.records = campaign, places, records
        self.graph = graph
        self.held = CalibratedCache(campaign, places, records, templates, memory)

    def compute(self, task: Task) -> Write:
        """Do what a task computes; return what writes it. Raises Refused or MemoryError."""
        stages: Mapping[str, Callable[[Task], Write]] = {
            "calibrate": self._calibrate,
            "register": self._register,
            "resample": self._resample,
        }
        give_back_memory()
        with steady_libraries():
            return stages[task.key.stage](task)

    def _calibrate(self, task: Task) -> Write:
        from levkas.stages.calibrate import write_calibrated

        capture, _ = captures_of(task)
        native = self.held.calibrate(capture)
        used = sorted(self.held.templates.used)
        write = partial(write_calibrated, native, capture, self.campaign, self.places)
        return lambda before: _with_notes(write(before), templates=used)

    def _register(self, task: Task) -> Write:
        from levkas.stages.register import draw_recorded, measure, publish_registration

        capture, _ = captures_of(task)
        native, frame = self.held.native(capture), self.held.frame(task, self.graph)
        found = measure(capture, native, frame, self.campaign)
        write = partial(publish_registration, found, capture, self.places)
        if self.held.memory is not None and not found.problems:
            self._draw(task, found, self.held.memory)
        if not found.problems or capture.tiles:
            return write
        picture = draw_recorded(self.held.native(capture))
        return lambda before: _with_notes(write(before), recorded=picture)

    def _draw(self, task: Task, found: Measured, memory: ReferenceMemory) -> None:
        """Draw a capture that is registered, for whoever does not wait until it is resampled."""
        from levkas.stages.resample import draw_coarse

        capture, _ = captures_of(task)
        native, frame = self.held.native(capture), self.held.frame(task, self.graph)
        if (picture := draw_coarse(capture, native, frame, found.record)) is not None:
            memory.pictures[task.key] = picture

    def _resample(self, task: Task) -> Write:
        from levkas.core.files import make_folder
        from levkas.stages.reference import record_of
        from levkas.stages.resample import resample, target_of, write_resampled

        capture, _ = captures_of(task)
        frame = self.held.frame(task, self.graph)
        native = self.held.native(capture)
        target = target_of(capture, native, frame, record_of(self.places, capture))
        for folder in (self.places.folder(capture.object), self.places.store(capture.object)):
            make_folder(folder)
        self.held.let_go()
        return partial(write_resampled, resample(native, target, frame), target, frame)


def _with_notes(written: Written, **notes: Any) -> Written:
    return written._replace(notes={**written.notes, **notes})

"""The executor of a graph in this process: one task computes while another's products are written."""

from __future__ import annotations

import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple
from zipfile import BadZipFile

from levkas.building import fingerprints
from levkas.building.build_records import CATALOGUE, BuildRecords, Key, Written, key_of
from levkas.building.fingerprints import Inputs, measured_path
from levkas.building.graph import Graph, Step, Task
from levkas.building.removal import is_of_the_disk, no_reference, put_away, refused_step, withdraw
from levkas.core.machine import give_back_memory, steady_libraries
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.building.native_cubes import FiledSigma, Native, PackedSigma
    from levkas.building.reference import ReferenceFrame
    from levkas.building.register import Measured
    from levkas.building.scans import Scan
    from levkas.building.template_cache import TemplateCache
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places

    Write = Callable[[Callable[[], object]], Written]
    Layer = tuple[str, str]


class Due(NamedTuple):
    """A task with what it is made of, and why it must be done; empty where it need not."""

    task: Task
    prints: dict[str, Any]
    why: str


class Held:
    """Calibrated cubes of one capture and the reference of one object: in memory, else read back."""

    def __init__(
        self, campaign: Campaign, places: Places, records: BuildRecords, templates: TemplateCache
    ) -> None:
        self.campaign, self.places, self.records = campaign, places, records
        self.templates = templates
        self._capture: Capture | None = None
        self._native: Native | Scan | None = None
        self._sigmas: dict[str, PackedSigma] = {}
        self._frame: ReferenceFrame | None = None
        self.streams = False
        """Whether the capture is a scan, which is calibrated as it is written and read."""

    def calibrate(self, capture: Capture) -> Native | Scan:
        """Calibrate a capture; all but sigma, which is packed, is kept for the next stages."""
        from levkas.building.calibrate import calibrate
        from levkas.building.native_cubes import Native, PackedSigma

        self.let_go()
        made = calibrate(capture, self.campaign, self.templates)
        self.streams = not isinstance(made, Native)
        self._capture, self._native = capture, made.without_sigma()
        if isinstance(made, Native):
            self._sigmas = {
                name: PackedSigma(cube.sigma)
                for name, cube in made.cubes.items()
                if cube.sigma is not None
            }
        return made

    def native(self, capture: Capture) -> Native | Scan:
        """Return the calibrated cubes of a capture, without sigma."""
        from levkas.building.native_cubes import Native

        if self._native is None or self._capture is not capture:
            self.let_go()
            self._capture, self._native = capture, self._read(capture)
            self.streams = not isinstance(self._native, Native)
        return self._native

    def sigmas(self, capture: Capture) -> dict[str, PackedSigma | FiledSigma]:
        """Return the sigma of every sensor of a capture that has one."""
        from levkas.building.native_cubes import sigmas_of

        if self._sigmas and self._capture is capture:
            return {**self._sigmas}
        return {**sigmas_of(capture, self.places)}

    def frame(self, task: Task, graph: Graph) -> ReferenceFrame:
        """Return the reference that a capture is registered to."""
        from levkas.building.native_cubes import Native
        from levkas.building.reference import ReferenceFrame

        _, lead = _captures(task)
        if self._frame is None or self._frame.capture is not lead:
            self._frame = None
            native = self.native(lead) if task.leads else self._read(lead)
            assert isinstance(native, Native)
            mine = [t.capture for t in graph.values() if t.key.object == lead.object and t.capture]
            self._frame = ReferenceFrame(self.campaign, self.places, [lead, *mine], native)
        return self._frame

    def let_go(self) -> None:
        """Let go of the capture's cubes."""
        self._capture, self._native, self._sigmas = None, None, {}

    def let_go_of_frame(self) -> None:
        """Let go of the reference, which is read back when it is needed."""
        self._frame = None

    def _read(self, capture: Capture) -> Native | Scan:
        from levkas.building.calibrate import load_calibrated

        notes = self.records.notes(key_of(capture, "calibrate"))
        return load_calibrated(capture, self.campaign, self.places, notes, self.templates)


class Executor:
    """Runs the tasks of captures, and says how each ends.

    A capture ends with the first task that is refused; others go on. Files are hashed ahead and products
    written in a thread each.
    """

    def __init__(
        self,
        campaign: Campaign,
        places: Places,
        records: BuildRecords,
        templates: TemplateCache,
        graph: Graph,
    ) -> None:
        self.campaign, self.places, self.records = campaign, places, records
        self.graph = graph
        self.inputs = Inputs(campaign, records)
        self.ended: dict[Key, Step] = {}
        self._held = Held(campaign, places, records, templates)
        self._lost: dict[Layer, Step] = {}
        self._checked: set[Key] = set()
        self._before: dict[Key, dict[str, str]] = {}
        self._hashing: set[str] = set()
        self._waiting: list[tuple[Task, Future[Step]]] = []

    def run(self, tasks: Sequence[Task]) -> Iterator[Step]:
        """Yield each task of captures as it begins and as it ends, in the order of `tasks`."""
        with (
            ThreadPoolExecutor(1, thread_name_prefix="writing") as self._writer,
            ThreadPoolExecutor(1, thread_name_prefix="hashing") as self._hasher,
        ):
            try:
                for layer, group in groupby(tasks, lambda t: (t.key.object, t.key.layer)):
                    for step in self._capture(layer, list(group)):
                        yield self._noted(step)
                    self._held.let_go()
                for step in self._written():
                    yield self._noted(step)
            finally:
                self._hasher.shutdown(wait=False, cancel_futures=True)

    def _noted(self, step: Step) -> Step:
        if step.finished:
            self.ended[step.key] = step
        return step

    def _capture(self, layer: Layer, tasks: list[Task]) -> Iterator[Step]:
        """Do those of some tasks of one capture that are due."""
        if layer in self._lost:
            return
        if (step := self._without_reference(tasks[0])) is not None:
            yield step
            return
        plan = [self._due(task) for task in tasks]
        due = [one.task for one in plan if one.why]
        for key in dict.fromkeys(key for task in due for key in (*task.needs, *task.uses)):
            if all(task.key != key for task in tasks):
                yield from self._mend(key)
        if (step := self._without_reference(tasks[0])) is not None:
            yield step
            return
        last = tasks.index(due[-1]) if due else 0
        for number, one in enumerate(plan[:last]):
            if not one.why and (name := self._damaged(one.task.key)):
                plan[number] = one._replace(why=f"{name} was damaged")
        yield from self._run(plan)

    def _due(self, task: Task) -> Due:
        prints = self.inputs.of(task, self._lost)
        return Due(task, prints, self.records.why_stale(task.key, prints))

    def _mend(self, key: Key) -> Iterator[Step]:
        """Do a task again whose products are damaged, before another reads them."""
        task = self.graph.get(key)
        done = key in self.ended and self.ended[key].state == "fresh"
        if task is None or task.capture is None or not done or key in self._checked:
            return
        for before in task.needs:
            yield from self._mend(before)
        if name := self._damaged(key):
            yield from self._run([self._due(task)._replace(why=f"{name} was damaged")])

    def _damaged(self, key: Key) -> str:
        if key in self._checked:
            return ""
        self._checked.add(key)
        return self.records.damaged(key)

    def _without_reference(self, task: Task) -> Step | None:
        """Return the step of a capture whose reference was lost; move out what was registered to that."""
        capture, lead = _captures(task)
        failed = self._lost.get((lead.object, lead.layer))
        if failed is None or task.leads:
            return None
        refused = no_reference(lead.object, lead.layer, failed)
        if not refused.of_the_disk:
            put_away(capture.object, capture.camera, capture.setup, self.records)
        step = refused_step(key_of(capture, "calibrate"), refused)
        self._lost[capture.object, capture.layer] = step
        return step

    # --- the tasks of one capture ---------------------------------------------------------------

    def _run(self, plan: Sequence[Due]) -> Iterator[Step]:
        layer = (plan[0].task.key.object, plan[0].task.key.layer)
        for task, prints, why in plan:
            registers = task.key.stage in ("measure", "register")
            if registers:
                # Two cubes at once are enough; the one of the capture before goes first.
                yield from self._written(but=layer)
            if not why:
                yield from self._written(of=layer)
                if layer not in self._lost:
                    yield self._end(task, self._fresh(task.key))
                if layer in self._lost:
                    return
                continue
            self._hash_ahead(task.key.object)
            yield Step(task.key, "running", why)
            started = time.monotonic()
            write = self._compute(task)
            if registers or isinstance(write, Step):
                # A registration of frames that could not be written would stand beside older ones.
                yield from self._written(of=layer)
                if layer in self._lost:
                    return
            if isinstance(write, Step):
                yield self._end(task, write)
                return
            seconds = round(time.monotonic() - started, 2)
            job = self._writer.submit(self._write, Due(task, prints, why), write, seconds)
            self._waiting.append((task, job))
            if self._held.streams:
                job.exception()  # a scan is computed as it is written
            if registers or (task.leads and task.key.stage == "resample"):
                yield from self._written(of=layer)
                if layer in self._lost:
                    return

    def _compute(self, task: Task) -> Write | Step:
        """Do what a task computes; return what writes it, or the step of one that was refused."""
        if task.key.stage == "resample":
            self.records.forget(CATALOGUE)  # a layer that is written drops the index of its store
        self._before.setdefault(task.key, self.records.products(task.key))
        stages: Mapping[str, Callable[[Task], Write]] = {
            "calibrate": self._calibrate,
            "measure": self._measure,
            "register": self._register,
            "resample": self._resample,
        }
        give_back_memory()
        try:
            with steady_libraries():
                return stages[task.key.stage](task)
        except (Refused, MemoryError) as error:
            return self._failed(task, error)

    def _calibrate(self, task: Task) -> Write:
        from levkas.building.calibrate import write_calibrated

        capture, _ = _captures(task)
        made = self._held.calibrate(capture)
        return partial(write_calibrated, made, capture, self.campaign, self.places)

    def _measure(self, task: Task) -> Write:
        from levkas.building.register import write_measured

        path = measured_path(self.records.folder, task.key)
        return partial(write_measured, self._alone(task), path)

    def _alone(self, task: Task) -> Measured:
        """Register a capture by itself."""
        from levkas.building.register import measure

        capture, _ = _captures(task)
        native, frame = self._held.native(capture), self._held.frame(task, self.graph)
        found = measure(capture, native, frame, self.campaign)
        if task.leads and task.key.stage == "measure":
            self._held.let_go_of_frame()  # others are registered to what it is adjusted to
        return found

    def _register(self, task: Task) -> Write:
        from levkas.building.joint import adjust_capture
        from levkas.building.reference import record_of, sigmas_of
        from levkas.building.register import publish_registration

        capture, lead = _captures(task)
        if task.needs[0].stage != "measure":
            return partial(publish_registration, self._alone(task), capture, self.places)
        own = self._read_measured(task.needs[0])
        there = {f"{k.object}/{k.layer}": k for k in task.mates if self.inputs.has(k)}
        others = {name: self._read_measured(key) for name, key in there.items()}
        reference = None if task.leads else sigmas_of(record_of(self.places, lead))
        found = adjust_capture(capture, own, others, reference)
        return partial(publish_registration, found, capture, self.places)

    def _read_measured(self, key: Key) -> Measured:
        """Read a capture's own registration; raises Refused where it is damaged."""
        from levkas.building.register import Measured

        path = measured_path(self.records.folder, key)
        try:
            return Measured.read(path)
        except (OSError, KeyError, ValueError, EOFError, BadZipFile, zlib.error) as error:
            self.records.forget(key)
            problem = Problem(
                "E_DAMAGED",
                "the registration that was kept of a capture cannot be read",
                str(path),
                found=str(error),
                fix="Build again: it is made anew.",
            )
            raise Refused(problem) from error

    def _resample(self, task: Task) -> Write:
        from levkas.building.reference import record_of
        from levkas.building.resample import (
            flag_glare_in,
            mosaics_of,
            resample,
            stream_resampled,
            target_of,
            write_resampled,
        )
        from levkas.building.scans import Scan
        from levkas.core.files import make_folder

        capture, _ = _captures(task)
        frame = self._held.frame(task, self.graph)
        native = self._held.native(capture)
        captured = self.records.notes(key_of(capture, "calibrate")).get("captured", "")
        target = target_of(capture, native, frame, record_of(self.places, capture), captured)
        for folder in (self.places.folder(capture.object), self.places.store(capture.object)):
            make_folder(folder)
        if isinstance(native, Scan):
            return partial(stream_resampled, native, target, frame)
        sigmas = self._held.sigmas(capture)
        mosaics = mosaics_of(capture, self.campaign.cameras[capture.camera])
        self._held.let_go()
        cube = resample(native, target.transforms, target.grid, sigmas, mosaics)
        del native
        return partial(write_resampled, cube, flag_glare_in(cube, target), target, frame)

    # --- what is being written, and what was refused --------------------------------------------

    def _write(self, due: Due, write: Write, seconds: float) -> Step:
        """Write what a task made and record it; runs in the writer's thread."""
        task, prints, why = due
        try:
            made = write(partial(self.records.forget, task.key))
            self.records.keep(
                task.key, prints, made.files, aside=made.aside, seconds=seconds, **made.notes
            )
        except (Refused, MemoryError) as error:
            return self._failed(task, error)
        if made.problems:
            return refused_step(task.key, Refused(*made.problems))
        return Step(task.key, "done", why, warnings=made.warnings)

    def _written(self, *, of: Layer | None = None, but: Layer | None = None) -> Iterator[Step]:
        """Wait for what is being written, and yield how those tasks ended."""
        for waiting in list(self._waiting):
            task, job = waiting
            layer = (task.key.object, task.key.layer)
            if layer == but or (of is not None and layer != of):
                continue
            self._waiting.remove(waiting)
            yield self._end(task, job.result())

    def _end(self, task: Task, step: Step) -> Step:
        return self._lose(task, step) if step.state == "refused" else step

    def _fresh(self, key: Key) -> Step:
        return fresh_step(key, self.records)

    def _failed(self, task: Task, error: Refused | MemoryError) -> Step:
        """Return the step of a refused task; what it made before stays where only the disk refused."""
        from levkas.building.native_cubes import ran_out

        refused = ran_out(_captures(task)[0], error) if isinstance(error, MemoryError) else error
        if not is_of_the_disk(refused.problems):
            self.records.forget(task.key)
        return refused_step(task.key, refused)

    def _lose(self, task: Task, step: Step) -> Step:
        """Withdraw a layer whose task was refused, or say that the older one stays.

        It stays where only the disk refused, and where nothing of this build stands beside it yet.
        """
        capture, lead = _captures(task)
        key = task.key
        self._lost[key.object, key.layer] = step
        if is_of_the_disk(step.problems):
            layers = {(c.camera, c.setup) for c in (lead, capture)}
            keys = [
                k for k in self.graph if k.object == key.object and (k.camera, k.setup) in layers
            ]
            if all(map(self._stands, keys)):
                told = f"{key.object}/{key.layer}: the layer of an earlier build stays"
                return replace(step, warnings=(*step.warnings, told))
            self.records.forget(key)
            withdraw(capture, self.places, self.records)
            return step
        withdraw(capture, self.places, self.records, key.stage)
        # A refused registration has a record; more memory may be there the next time.
        recorded = self.records.notes(key).get("refused")
        if not recorded and all(p.code != "E_MEMORY" for p in step.problems):
            # A campaign may be moved: what is kept names its files from its folder.
            root = f"{self.campaign.root}{os.sep}"
            problems = [
                replace(p, file=p.file and str(p.file).removeprefix(root)) for p in step.problems
            ]
            self.records.refuse(key, self.inputs.of(task, self._lost), problems)
        return step

    def _stands(self, key: Key) -> bool:
        """Tell whether what a task made is what it was before this build, and undamaged.

        A layer that is older than the registration or the reference beside it would be false.
        """
        now = self.records.products(key)
        return bool(now) and self._before.get(key, now) == now and not self.records.damaged(key)

    def _hash_ahead(self, name: str) -> None:
        """Hash the frames of an object beside the work; what fails is met again when it is due."""
        if name not in self._hashing:
            self._hashing.add(name)
            for key, task in self.graph.items():
                if key.object == name and key.stage == "calibrate":
                    hashes = self.records.hashes
                    self._hasher.submit(
                        fingerprints.of_calibration, self.campaign, _captures(task)[0], hashes
                    )


def fresh_step(key: Key, records: BuildRecords) -> Step:
    """Return how a task ended that need not be done again."""
    notes = records.notes(key)
    warnings = tuple(notes.get("warnings", ()))
    problems = tuple(Problem(**p) for p in notes.get("refused", ()))
    if problems:
        return Step(key, "refused", problems[0].message, problems=problems, warnings=warnings)
    return Step(key, "fresh", warnings=warnings)


def _captures(task: Task) -> tuple[Capture, Capture]:
    """Return what a task is done with, and what that is registered to."""
    if task.capture is None or task.reference is None:
        raise ValueError(f"{task.key} is no task of a capture")
    return task.capture, task.reference

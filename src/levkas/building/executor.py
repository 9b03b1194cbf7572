"""The executor of a graph in this process: one task computes while another's products are written."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

from levkas.building import fingerprints
from levkas.building.build_records import Key
from levkas.building.graph import Step, Task, captures_of
from levkas.building.outcomes import Due, Outcomes
from levkas.building.tasks import Stages
from levkas.core.machine import keep_memory

if TYPE_CHECKING:
    from levkas.building.tasks import Write
    from levkas.stages.template_cache import TemplateCache

    Layer = tuple[str, str]


FROM_MEMORY = frozenset(("calibrate", "register", "resample"))
"""Stages that take what they read of their capture from memory, while it may still be written; others wait for the files."""


class Executor:
    """Runs the tasks of captures, and says how each ends.

    A capture ends with the first task that is refused; others go on. Files are hashed ahead and products
    written in a thread each.
    """

    def __init__(
        self,
        outcomes: Outcomes,
        templates: TemplateCache,
    ) -> None:
        self._outcomes, self._records = outcomes, outcomes.records
        self._graph, self._lost = outcomes.graph, outcomes.lost
        self._stages = Stages(
            outcomes.campaign, outcomes.places, outcomes.records, templates, outcomes.graph
        )
        self._held = self._stages.held
        self._checked: set[Key] = set()
        self._calibrations: dict[str, list[Task]] = {}
        for key, task in outcomes.graph.items():
            if key.stage == "calibrate":
                self._calibrations.setdefault(key.object, []).append(task)
        self._hashing: set[str] = set()
        self._waiting: list[tuple[Task, Future[Step]]] = []

    def run(self, tasks: Sequence[Task]) -> Iterator[Step]:
        """Yield each task of captures as it begins and as it ends, in the order of `tasks`."""
        keep_memory()
        note = self._outcomes.note
        with (
            ThreadPoolExecutor(1, thread_name_prefix="writing") as self._writer,
            ThreadPoolExecutor(1, thread_name_prefix="hashing") as self._hasher,
        ):
            try:
                for layer, group in groupby(tasks, lambda t: (t.key.object, t.key.layer)):
                    for step in self._alone(layer, list(group)):
                        yield note(step)
                    self._held.let_go()
                for step in self._written():
                    yield note(step)
            finally:
                self._hasher.shutdown(wait=False, cancel_futures=True)

    def _alone(self, layer: Layer, tasks: list[Task]) -> Iterator[Step]:
        """Do some tasks of one capture; whatever is raised refuses this capture, and no other."""
        try:
            yield from self._capture(layer, tasks)
        except Exception as error:  # outside of what computes and writes, which have their own
            yield from self._written(of=layer)
            if layer not in self._lost:
                task = next(t for t in tasks if t.key not in self._outcomes.ended)
                yield self._outcomes.end(task, self._outcomes.refuse(task, error))

    def _capture(self, layer: Layer, tasks: list[Task]) -> Iterator[Step]:
        """Do those of some tasks of one capture that are due."""
        if layer in self._lost:
            return
        if (step := self._outcomes.without_reference(tasks[0])) is not None:
            yield step
            return
        plan = [self._outcomes.due(task) for task in tasks]
        yield from self._outcomes.describe(plan)
        due = [one.task for one in plan if one.why]
        for key in dict.fromkeys(key for task in due for key in (*task.needs, *task.uses)):
            if all(task.key != key for task in tasks):
                yield from self._mend(key)
        if (step := self._outcomes.without_reference(tasks[0])) is not None:
            yield step
            return
        last = tasks.index(due[-1]) if due else 0
        for number, one in enumerate(plan[:last]):
            if not one.why and (name := self._damaged(one.task.key)):
                plan[number] = one._replace(why=f"{name} was damaged")
        yield from self._run(plan)

    def _mend(self, key: Key) -> Iterator[Step]:
        """Do a task again whose products are damaged, before another reads them."""
        task = self._graph.get(key)
        ended = self._outcomes.ended
        done = key in ended and ended[key].state == "fresh"
        if task is None or task.capture is None or not done or key in self._checked:
            return
        for before in task.needs:
            yield from self._mend(before)
        if name := self._damaged(key):
            yield from self._run([self._outcomes.due(task)._replace(why=f"{name} was damaged")])

    def _damaged(self, key: Key) -> str:
        if key in self._checked:
            return ""
        self._checked.add(key)
        return self._records.damaged(key)

    # --- the tasks of one capture ---------------------------------------------------------------

    def _run(self, plan: Sequence[Due]) -> Iterator[Step]:
        layer = (plan[0].task.key.object, plan[0].task.key.layer)
        for task, prints, why, _ in plan:
            registers = task.key.stage == "register"
            if registers:
                # Two cubes at once are enough; the one of the capture before goes first.
                yield from self._written(but=layer)
            elif task.key.stage not in FROM_MEMORY:
                yield from self._written(of=layer)
                if layer in self._lost:
                    return
            if not why:
                yield from self._written(of=layer)
                if layer not in self._lost:
                    yield self._outcomes.end(task, self._outcomes.fresh(task.key))
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
                yield self._outcomes.end(task, write)
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
        try:
            self._outcomes.begin(task)
            return self._stages.compute(task)
        except Exception as error:
            return self._outcomes.refuse(task, error)

    # --- what is being written ------------------------------------------------------------------

    def _write(self, due: Due, write: Write, seconds: float) -> Step:
        """Write what a task made and record it; runs in the writer's thread."""
        try:
            written = write(partial(self._records.forget, due.task.key))
            return self._outcomes.keep(due, written, seconds=seconds)
        except Exception as error:
            return self._outcomes.refuse(due.task, error)

    def _written(self, *, of: Layer | None = None, but: Layer | None = None) -> Iterator[Step]:
        """Wait for what is being written, and yield how those tasks ended."""
        for waiting in list(self._waiting):
            task, job = waiting
            layer = (task.key.object, task.key.layer)
            if layer == but or (of is not None and layer != of):
                continue
            self._waiting.remove(waiting)
            yield self._outcomes.end(task, job.result())

    def _hash_ahead(self, name: str) -> None:
        """Hash the frames of an object beside the work; what fails is met again when it is due."""
        if name not in self._hashing:
            self._hashing.add(name)
            campaign, hashes = self._outcomes.campaign, self._records.hashes
            for task in self._calibrations.get(name, ()):
                capture = captures_of(task)[0]
                self._hasher.submit(fingerprints.of_calibration, campaign, capture, hashes)


class DryRun:
    """Stands in for the executor where nothing is to be done: `status`."""

    def __init__(self, outcomes: Outcomes) -> None:
        self._outcomes = outcomes

    def run(self, tasks: Sequence[Task]) -> Iterator[Step]:
        """Yield of each task of captures whether it is fresh, stale or refused; none behind one that is refused."""
        outcomes = self._outcomes
        for task in tasks:
            layer = task.key.object, task.key.layer
            due = outcomes.due(task)  # other setups are compared with what this would be
            yield from outcomes.describe([due])
            if layer in outcomes.lost:
                continue
            step = outcomes.without_reference(task) or outcomes.state(due)
            if step.state == "refused":
                outcomes.lost[layer] = step
            yield outcomes.note(step)

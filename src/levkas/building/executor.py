"""The executor of a graph in this process: a layer is written while the next capture is computed."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

from levkas.building.build_records import STAGES, Key
from levkas.building.graph import Step, Task
from levkas.building.outcomes import Due, Outcomes
from levkas.building.tasks import Stages
from levkas.core.machine import keep_memory

if TYPE_CHECKING:
    from levkas.building.tasks import Write
    from levkas.stages.template_cache import TemplateCache

    Layer = tuple[str, str]


class Executor:
    """Runs the tasks of captures, and says how each ends.

    A capture ends with the first task that is refused; others go on.
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
        self._checked: set[Key] = set()
        self._writing: tuple[Task, Future[Step]] | None = None

    def run(self, tasks: Sequence[Task]) -> Iterator[Step]:
        """Yield each task of captures as it begins and as it ends, in the order of `tasks`."""
        keep_memory()
        note = self._outcomes.note
        with ThreadPoolExecutor(1, thread_name_prefix="writing") as self._writer:
            for layer, group in groupby(tasks, lambda t: (t.key.object, t.key.layer)):
                for step in self._alone(layer, list(group)):
                    yield note(step)
                self._stages.let_go()
            for step in self._written():
                yield note(step)

    def _alone(self, layer: Layer, tasks: list[Task]) -> Iterator[Step]:
        """Do some tasks of one capture; whatever is raised refuses this capture, and no other."""
        try:
            yield from self._capture(layer, tasks)
        except Exception as error:  # outside of what computes and writes, which have their own
            yield from self._written()
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

    def _run(self, plan: Sequence[Due]) -> Iterator[Step]:
        """Do those tasks of one capture that are due; the files of a layer are written while the next capture is computed."""
        for task, prints, why, _ in plan:
            last = task.key.stage == STAGES[-1]
            if last or task.key.stage == "register":  # two cubes at once are enough
                yield from self._written()
            if why:
                yield Step(task.key, "running", why)
                started = time.monotonic()
                write = self._compute(task)
                seconds = round(time.monotonic() - started, 2)
                work = partial(self._write, Due(task, prints, why), write, seconds)
                if last and not (task.leads or self._stages.streams):
                    self._writing = task, self._writer.submit(work)
                    continue
                step = work()
                del write, work  # their cubes
            else:
                step = self._outcomes.fresh(task.key)
            yield (step := self._outcomes.end(task, step))
            if step.state == "refused":
                return

    def _compute(self, task: Task) -> Write | Exception:
        """Do what a task computes; return what writes it, or what it was refused for."""
        try:
            self._outcomes.begin(task)
            return self._stages.compute(task)
        except Exception as error:
            return error

    def _write(self, due: Due, write: Write | Exception, seconds: float) -> Step:
        """Write what a task made and record it."""
        try:
            if isinstance(write, Exception):
                raise write
            written = write(partial(self._records.forget, due.task.key))
            return self._outcomes.keep(due, written, seconds=seconds)
        except Exception as error:
            return self._outcomes.refuse(due.task, error)

    def _written(self) -> Iterator[Step]:
        """Wait for the layer that is being written, and yield how that ended."""
        if self._writing is not None:
            (task, job), self._writing = self._writing, None
            yield self._outcomes.end(task, job.result())


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

"""How the tasks of captures end: fresh, recorded, or refused with what an earlier build made withdrawn."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from levkas.building.build_records import CATALOGUE, BuildRecords, Key, Written, key_of
from levkas.building.fingerprints import Inputs
from levkas.building.graph import Graph, Step, Task, captures_of
from levkas.building.removal import is_of_the_disk, no_reference, put_away, refused_step, withdraw
from levkas.building.stages import Damaged
from levkas.core.internal_errors import as_refusal
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Iterable

    from levkas.campaign.campaign import Campaign
    from levkas.database.layout import Places

    Layer = tuple[str, str]


class Due(NamedTuple):
    """A task with what it is made of, and why it must be done; empty where it need not."""

    task: Task
    prints: dict[str, Any]
    why: str


class Endings:
    """Decides what is due, records what was done, and withdraws what was refused.

    The one writer of the records of captures, wherever their tasks are computed.

    Parameters
    ----------
    campaign : Campaign
    places : Places
    records : BuildRecords
    graph : Graph
    """

    def __init__(
        self, campaign: Campaign, places: Places, records: BuildRecords, graph: Graph
    ) -> None:
        self.campaign, self.places, self.records = campaign, places, records
        self.graph = graph
        self.inputs = Inputs(campaign, records)
        self.ended: dict[Key, Step] = {}
        self._by_object: dict[str, dict[Key, Step]] = {}
        self.lost: dict[Layer, Step] = {}
        self._before: dict[Key, dict[str, str]] = {}

    def note(self, step: Step) -> Step:
        """Keep how a task ended."""
        if step.finished:
            self.ended[step.key] = step
            self._by_object.setdefault(step.key.object, {})[step.key] = step
        return step

    def of(self, name: str) -> Iterable[Step]:
        """Return how the tasks of an object ended, each once."""
        return self._by_object.get(name, {}).values()

    def due(self, task: Task) -> Due:
        """Return what a task is made of, and why it must be done; all that it reads has ended."""
        prints = self.inputs.of(task, self.lost)
        return Due(task, prints, self.records.why_stale(task.key, prints))

    def begin(self, task: Task) -> None:
        """Record the existing files before a task is done."""
        if task.key.stage == "resample":
            self.records.forget(CATALOGUE)  # a layer that is written drops the index of its store
        self._before.setdefault(task.key, self.records.products(task.key))

    def fresh(self, key: Key) -> Step:
        """Return how a task ended that need not be done again."""
        return fresh_step(key, self.records)

    def keep(self, due: Due, made: Written, **notes: Any) -> Step:
        """Record what a task made; return how it ended. Raises WriteRefused."""
        key = due.task.key
        self.records.keep(key, due.prints, made.files, aside=made.aside, **notes, **made.notes)
        if made.problems:
            return refused_step(key, Refused(*made.problems))
        return Step(key, "done", due.why, warnings=made.warnings)

    def without_reference(self, task: Task) -> Step | None:
        """Return the step of a capture whose reference was lost; move out what was registered to that."""
        capture, lead = captures_of(task)
        failed = self.lost.get((lead.object, lead.layer))
        if failed is None or task.leads:
            return None
        refused = no_reference(lead.object, lead.layer, failed)
        if not refused.of_the_disk:
            put_away(capture.object, capture.camera, capture.setup, self.records)
        step = refused_step(key_of(capture, "calibrate"), refused)
        self.lost[capture.object, capture.layer] = step
        return step

    def refuse(self, task: Task, error: Exception) -> Step:
        """Return the step of a refused task; what it made before stays where only the disk refused.

        An exception that is no refusal is one of this task alone, and leaves a report beside its record.
        """
        refused = self.records.with_report(task.key, refusal_of(task, error))
        if isinstance(refused, Damaged):
            self.records.forget(refused.key)
        if not is_of_the_disk(refused.problems):
            self.records.forget(task.key)
        return refused_step(task.key, refused)

    def end(self, task: Task, step: Step) -> Step:
        """Withdraw a layer whose task was refused, or say that the older one stays.

        It stays where only the disk refused, and where this build has written nothing beside it yet. What
        cannot be withdrawn is one problem more of the step.
        """
        if step.state != "refused":
            return step
        self.lost[task.key.object, task.key.layer] = step
        try:
            return self._without_older(task, step)
        except Exception as error:
            return replace(step, problems=(*step.problems, *refusal_of(task, error).problems))

    def _without_older(self, task: Task, step: Step) -> Step:
        capture, lead = captures_of(task)
        key = task.key
        if is_of_the_disk(step.problems):
            layers = {(c.camera, c.setup) for c in (lead, capture)}
            keys = [
                k for k in self.graph if k.object == key.object and (k.camera, k.setup) in layers
            ]
            if all(map(self._stands, keys)):
                told = f"{key.object}/{key.layer}: the layer of an earlier build is kept"
                return replace(step, warnings=(*step.warnings, told))
            self.records.forget(key)
            withdraw(capture, self.places, self.records)
            return step
        withdraw(capture, self.places, self.records, key.stage)
        # A refused registration has a record; more memory may be there the next time.
        recorded = self.records.notes(key).get("refused")
        if not recorded and all(p.code not in OF_THE_MACHINES for p in step.problems):
            problems = within(self.campaign, step.problems)
            self.records.refuse(key, self.inputs.of(task, self.lost), problems)
        return step

    def _stands(self, key: Key) -> bool:
        """Tell whether what a task made is what it was before this build, and undamaged.

        A layer that is older than the registration or the reference beside it would be false.
        """
        now = self.records.products(key)
        return bool(now) and self._before.get(key, now) == now and not self.records.damaged(key)


def refusal_of(task: Task, error: Exception) -> Refused:
    """Return why a task of a capture is refused that ended with an exception."""
    capture, _ = captures_of(task)
    what = f"{capture.object}/{capture.layer} {task.key.stage}"
    return as_refusal(error, what, capture.sensors[0].object[0].path)


def within(campaign: Campaign, problems: Iterable[Problem]) -> list[Problem]:
    """Return problems that name files from the campaign's folder, which may be moved with what is kept."""
    root = f"{campaign.root}{os.sep}"
    return [replace(p, file=p.file and str(p.file).removeprefix(root)) for p in problems]


OF_THE_MACHINES = ("E_MEMORY", "E_WORKER")
"""Codes of what another machine, or the same one later, may do."""


def fresh_step(key: Key, records: BuildRecords) -> Step:
    """Return how a task ended that need not be done again."""
    notes = records.notes(key)
    warnings = tuple(notes.get("warnings", ()))
    problems = tuple(Problem(**p) for p in notes.get("refused", ()))
    if problems:
        return Step(key, "refused", problems[0].message, problems=problems, warnings=warnings)
    return Step(key, "fresh", warnings=warnings)

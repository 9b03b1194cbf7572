"""Outcomes of tasks: fresh, done, or refused while the layer of an earlier build stays; and what campaign.toml no longer names.

*Only campaign.toml removes*: a finished layer whose frames cannot be read today, or that is refused, stays as it is, and the
catalogue says of what build it is. What was never finished goes.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from levkas.building.build_records import STAGES, BuildRecords, Key, key_of
from levkas.building.graph import Graph, Step, Task, captures_of
from levkas.building.inputs import Inputs, without
from levkas.building.tasks import Stages, describe_anew
from levkas.campaign.discovery.file_index import declared_targets
from levkas.core.disk import DISK_CODES
from levkas.core.internal_errors import as_refusal
from levkas.core.problems import Problem, Refused
from levkas.core.text import counted
from levkas.database.layout import KINDS

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator, Sequence
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import LayerId, Places
    from levkas.stages.template_cache import TemplateCache

DESCRIBE = "describe"
"""Stage of a step that says that files were described anew; nothing is recorded under it."""


class Due(NamedTuple):
    """A task with what it is made of, and why it must be done, or only described anew; empty where it need not."""

    task: Task
    prints: dict[str, Any]
    why: str
    facts: str = ""


class Outcomes:
    """Does the tasks of captures that are due, one after the other, and keeps how each ended; a `dry` one, for `status`, only says.

    A capture ends with the first task that is refused; others go on. `unread` as of `Inputs`;
    not `again`: what was refused when it was made of the same is not tried once more.
    """

    def __init__(
        self,
        campaign: Campaign,
        places: Places,
        records: BuildRecords,
        graph: Graph,
        templates: TemplateCache,
        *,
        dry: bool = False,
        unread: bool = False,
        again: bool = True,
    ) -> None:
        self.campaign, self.places, self.records = campaign, places, records
        self.graph, self.dry, self.again = graph, dry, again
        self.inputs = Inputs(campaign, records, unread=unread)
        self.ended: dict[Key, Step] = {}
        self.lost: dict[LayerId, Step] = {}
        self.earlier: dict[LayerId, str] = {}
        """Why layers are of an earlier build."""
        self._stages = Stages(campaign, places, records, templates, graph)
        self._checked: set[Key] = set()
        self._described: set[LayerId] = set()
        self._registered: dict[LayerId, tuple[Key, dict[str, Any], dict[str, bytes]]] = {}

    # --- one task -------------------------------------------------------------------------------

    def run(self, task: Task) -> Iterator[Step]:
        """Yield how a task of a capture begins and ends; nothing where its capture was refused before."""
        try:
            for step in self._run(task):
                if step.finished and step.key.stage != DESCRIBE:
                    self.ended[step.key] = step
                yield step
        except Exception as error:  # outside of what computes and writes, which has its own
            self.ended[task.key] = step = self._end(task, self._refused(task, error))
            yield step

    def _run(self, task: Task) -> Iterator[Step]:
        if (step := self._not_begun(task)) or task.key.of in self.lost:
            yield from filter(None, [step])
            return
        due = self.due(task)
        known = not self.again and bool(self.records.refusal(task.key, due.prints))
        if self.dry or known or not due.why:
            yield from self._described_anew(due)
            yield self._end(task, self.state(due))
            return
        for key in (*task.needs, *task.uses):
            yield from self._mend(key)
        if (step := self._not_begun(task)) or task.key.of in self.lost:
            yield from filter(None, [step])
            return
        yield from self._do(due)

    def _not_begun(self, task: Task) -> Step | None:
        """Return how a capture ends whose reference was lost."""
        capture, lead = captures_of(task)
        failed = self.lost.get(key_of(lead, "").of)
        if failed is None or task.leads or task.key.of in self.lost:
            return None
        step = self.lose(no_reference(capture, lead.camera, failed.why))
        self.lost[task.key.of] = step
        return step

    def _mend(self, key: Key) -> Iterator[Step]:
        """Do a task again whose products are damaged, before another reads them."""
        task, ended = self.graph.get(key), self.ended.get(key)
        fresh = ended is not None and ended.state == "fresh"
        if task is None or task.capture is None or not fresh or key in self._checked:
            return
        self._checked.add(key)
        for before in task.needs:
            yield from self._mend(before)
        if name := self.records.damaged(key):
            yield from self._do(self.due(task)._replace(why=f"{name} was damaged"))

    def _do(self, due: Due) -> Iterator[Step]:
        """Compute a task, write it and record it."""
        task, key = due.task, due.task.key
        yield Step(key, "running", due.why)
        try:
            if key.stage == "register" and self.records.finished(key):
                self._registered.setdefault(key.of, (key, *self.records.copied(key)))
            made = self._stages.do(task)
            self.records.keep(key, due.prints, made.files, aside=made.aside, **made.notes)
            step = Step(key, "done", due.why, warnings=made.warnings)
            if made.problems:
                step = refused_step(key, Refused(*made.problems))
        except Exception as error:
            step = self._refused(task, error)
        yield self._end(task, step)

    def _described_anew(self, due: Due) -> Iterator[Step]:
        """Write anew what files say about their pixels, where that alone differs; yield one step a capture."""
        key = due.task.key
        if not due.facts:
            return
        step = Step(replace(key, stage=DESCRIBE), "stale" if self.dry else "done", due.facts)
        try:
            if not self.dry:
                made = describe_anew(due.task, self.campaign, self.places, self.records)
                self.records.keep(key, due.prints, made.files, **made.notes)
        except Exception as error:
            step = replace(self._refused(due.task, error), key=step.key)
        if key.of not in self._described or step.state == "refused":
            yield step
        self._described.add(key.of)

    def due(self, task: Task) -> Due:
        """Return what a task is made of, and why it must be done; all that it reads has ended."""
        key, prints = task.key, self.inputs.of(task, self.lost)
        why, before = self.records.why_stale(key, prints), self.records.fingerprint(key)
        if not why or without(before) != without(prints) or self.records.why_stale(key, before):
            return Due(task, prints, why)
        if not self.dry and (name := self.records.damaged(key)):  # its hash would vouch for it
            return Due(task, prints, f"{name} was damaged")
        return Due(task, prints, "", why)

    def state(self, due: Due) -> Step:
        """Return whether a stage is fresh, stale, or was refused when it was made of the same."""
        key = due.task.key
        if due.why:
            problems = self.records.refusal(key, due.prints)
            root = self.campaign.root
            there = [replace(p, file=p.file and str(root / p.file)) for p in problems]
            return refused_step(key, Refused(*there)) if there else Step(key, "stale", due.why)
        notes = self.records.notes(key)
        refused = Refused(*(Problem(**p) for p in notes.get("refused", ())))
        step = refused_step(key, refused) if refused.problems else Step(key, "fresh")
        return replace(step, warnings=tuple(notes.get("warnings", ())))

    # --- what is refused ------------------------------------------------------------------------

    def _refused(self, task: Task, error: Exception) -> Step:
        """Return the step of a refused task; an exception that is no refusal leaves a report beside its record."""
        capture, _ = captures_of(task)
        what = f"{capture.object}/{capture.layer} {task.key.stage}"
        refused = as_refusal(error, what, capture.sensors[0].object[0].path)
        return refused_step(task.key, self.records.with_report(task.key, refused))

    def _end(self, task: Task, step: Step) -> Step:
        """Return how a task ended: the layer of one that was refused stays where an earlier build finished it, else it is withdrawn.

        What cannot be put back or withdrawn is one problem more of the step.
        """
        if step.state != "refused":
            return step
        self.lost[task.key.of] = step
        try:
            step = self.stay(step)
            if not self.dry:
                if not step.earlier:
                    withdraw(task.key, self.places, self.records)
                self._keep_refusal(task, step)
        except Exception as error:
            return replace(step, problems=(*step.problems, *self._refused(task, error).problems))
        return step

    def stay(self, step: Step) -> Step:
        """Return the step of a refused stage, with why the layer stays that an earlier build finished, where there is one."""
        if self.records.finished(step.key) is None:
            return step
        if step.key.of in self._registered:
            self.records.put_back(*self._registered[step.key.of])
        self.earlier[step.key.of] = why = why_earlier(self.campaign, step)
        note = f"{step.key.object}/{step.key.layer}: of an earlier build: {why}"
        return replace(step, earlier=why, warnings=(*step.warnings, note))

    def lose(self, step: Step, refused: Refused | None = None) -> Step:
        """Return how a capture ends that cannot even be begun; what was never finished of it goes."""
        if refused and not self.dry:
            step = refused_step(step.key, self.records.with_report(step.key, refused))
        step = self.stay(step)
        if not (step.earlier or self.dry):
            withdraw(step.key, self.places, self.records)
        return step

    def _keep_refusal(self, task: Task, step: Step) -> None:
        """Record why a task was refused, unless its own record says it, or the next time may be another."""
        key, codes = task.key, {problem.code for problem in step.problems}
        recorded = self.records.notes(key).get("refused")
        if not (recorded or codes & OF_THE_MACHINES or is_of_the_disk(step.problems)):
            problems = within(self.campaign, step.problems)
            self.records.refuse(key, self.inputs.of(task, self.lost), problems)


def within(campaign: Campaign, problems: Iterable[Problem]) -> list[Problem]:
    """Return problems that name files from the campaign's folder, which may be moved with what is kept."""
    root = f"{campaign.root}{os.sep}"
    return [replace(p, file=p.file and str(p.file).removeprefix(root)) for p in problems]


OF_THE_MACHINES = {"E_MEMORY"}
"""Codes of what another machine, or the same one later, may do."""
NOT_READ = {"E_UNREADABLE", "E_TRUNCATED", "E_MISSING", "E_DAMAGED", "E_IO"}
"""Codes of frames that may be read another day."""


def is_of_the_disk(problems: Iterable[Problem]) -> bool:
    """Return whether nothing but the disk refused: nothing is wrong with frames and parameters."""
    codes = {problem.code for problem in problems}
    return bool(codes) and codes <= DISK_CODES


def why_earlier(campaign: Campaign, step: Step) -> str:
    """Return why a layer could not be made anew, the same wherever the campaign stands."""
    problem = next(iter(within(campaign, step.problems)), None)
    if problem is not None and problem.code in NOT_READ and problem.file:
        return f"{problem.file} cannot be read now"
    why = problem.message if problem else step.why
    return f"{step.key.stage} is refused now: {why}".replace(f"{campaign.root}{os.sep}", "")


def withdraw(key: Key, places: Places, records: BuildRecords) -> None:
    """Take away what builds made of a layer that none has finished, from the stage on that is refused now."""
    from levkas.core.files import remove

    for stage in STAGES[STAGES.index(key.stage) :]:
        one = replace(key, stage=stage)
        if stage == key.stage and records.notes(one).get("refused"):
            continue  # a registration that is refused has a record
        for name in sorted(records.products(one)):
            remove(places.output / name)
        if records.is_begun(one):
            records.drop(one)
    # By name, not by record: an interrupted build has left files without one.
    for name in (*(f"{key.of.path}{end}" for end in (*KINDS.values(), ".png")), key.of.group):
        if os.path.lexists(path := places.output / name):
            remove(path)


def no_reference(capture: Capture, camera: str, why: str) -> Step:
    """Return the step of a capture that there is nothing to register to."""
    problem = Problem(
        "E_NO_REFERENCE",
        f"{capture.object}: the reference camera {camera} has no layer, so no camera can be registered",
        field="campaign.reference",
        found=why,
        fix="Correct the frames of the reference camera first.",
    )
    return refused_step(key_of(capture, "calibrate"), Refused(problem))


def refused_step(key: Key, refused: Refused) -> Step:
    """Return the step of a stage that was refused."""
    why = refused.problems[0].message if refused.problems else str(refused)
    return Step(key, "refused", why, problems=tuple(refused.problems))


# --- what campaign.toml no longer names: found by the records of earlier builds, moved out of the database

REMOVED = Key("", stage="removed")


def is_named(campaign: Campaign, key: Key) -> bool:
    """Whether campaign.toml names the object, the camera and the setup of a stage: what it names stays."""
    targets, camera = campaign.targets, campaign.cameras.get(key.camera)
    roles = {*declared_targets(campaign)} - {*campaign.objects}
    wanted = key.object in targets.objects if targets.objects else key.object not in roles
    if (key.object and not wanted) or camera is None:
        return not key.camera and wanted
    if not key.object:  # its page
        return camera.traits.is_calibrated or bool(targets.charts)
    if key.stage not in STAGES:  # of an older version
        return False
    setup = campaign.setups.get(key.setup) if key.setup != campaign.campaign.setup else None
    in_names = any("{setup}" in pattern for pattern in camera.patterns)
    return not key.setup or (setup is not None and (in_names or key.camera in setup.cameras))


def no_longer_named(
    campaign: Campaign, records: BuildRecords, objects: Container[str] | None = None
) -> list[Key]:
    """Return the recorded stages of what campaign.toml does not name any more; of some objects where they are given."""
    recorded = (k for k in records.recorded() if objects is None or k.object in objects)
    return [key for key in recorded if not is_named(campaign, key)]


def describe(keys: Iterable[Key], records: BuildRecords) -> str:
    """Report what is no longer in the campaign; empty where nothing of it is in the database."""
    there = [key for key in keys if records.products(key)]
    counts = {
        "layer": len({key.of for key in there if key.object and key.camera}),
        "object": sum(key.stage == "report" for key in there),
        "camera": sum(key.stage == "camera" for key in there),
    }
    parts = [counted(n, what) for what, n in counts.items() if n]
    verb = "is" if sum(counts.values()) == 1 else "are"
    return f"{' and '.join(parts)} {verb} no longer in the campaign" if parts else ""


def put_away_stage(key: Key, records: BuildRecords) -> Path | None:
    """Move out what a stage made, and forget it; return where to, None where nothing stood there."""
    where = records.put_away(records.products(key))
    if records.is_begun(key):
        records.drop(key)
    return where


def removal(keys: Sequence[Key], records: BuildRecords) -> list[Step]:
    """Move what is no longer in the campaign out of the database; return one step, or none where there was nothing."""
    text = describe(keys, records)
    moved = [where for key in keys if (where := put_away_stage(key, records))]
    warnings = (f"{text}: moved to {moved[0]}",) if moved else ()
    return [Step(REMOVED, "done", text, warnings=warnings)] if moved else []

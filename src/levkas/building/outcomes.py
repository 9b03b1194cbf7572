"""Outcomes of tasks: fresh, recorded, or refused while the layer of an earlier build stays; and what campaign.toml no longer names.

*Only campaign.toml removes*: a finished layer whose frames cannot be read today, or that is refused, stays as it is, and the
catalogue says of what build it is. What was never finished goes.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from levkas.building.build_records import CATALOGUE, STAGES, BuildRecords, Key, key_of
from levkas.building.fingerprints import Inputs, without
from levkas.building.graph import Graph, Step, Task, captures_of
from levkas.building.tasks import Damaged, describe_anew
from levkas.campaign.discovery.file_index import declared_targets
from levkas.core.disk import DISK_CODES
from levkas.core.internal_errors import as_refusal
from levkas.core.problems import Problem, Refused
from levkas.core.text import counted
from levkas.database.layout import KINDS
from levkas.stages.written import Written

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator, Sequence
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import LayerId, Places

    Layer = tuple[str, str]


DESCRIBE = "describe"
"""Stage of a step that says that files were described anew; nothing is recorded under it."""


class Due(NamedTuple):
    """A task with what it is made of, and why it must be done, or only described anew; empty where it need not."""

    task: Task
    prints: dict[str, Any]
    why: str
    facts: str = ""


class Outcomes:
    """Decides what is due, records what was done, and withdraws what was refused; a `dry` one only says so, for `status`.

    The one writer of the records of captures. `unread` as of `Inputs`.
    """

    def __init__(
        self,
        campaign: Campaign,
        places: Places,
        records: BuildRecords,
        graph: Graph,
        *,
        dry: bool = False,
        unread: bool = False,
    ) -> None:
        self.campaign, self.places, self.records = campaign, places, records
        self.graph, self.dry = graph, dry
        self.inputs = Inputs(campaign, records, unread=unread)
        self.ended: dict[Key, Step] = {}
        self._by_object: dict[str, dict[Key, Step]] = {}
        self.lost: dict[Layer, Step] = {}
        self._stated: Key | None = None
        self.earlier: dict[LayerId, str] = {}
        """Why layers are of an earlier build."""
        self._registered: dict[LayerId, tuple[Key, dict[str, Any], dict[str, bytes]]] = {}

    def note(self, step: Step) -> Step:
        """Keep how a task ended."""
        if step.finished and step.key.stage != DESCRIBE:
            self.ended[step.key] = step
            self._by_object.setdefault(step.key.object, {})[step.key] = step
        return step

    def of(self, name: str) -> Iterable[Step]:
        """Return how the tasks of an object ended, each once."""
        return self._by_object.get(name, {}).values()

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
        if not due.why:
            return self.fresh(key)
        if problems := self.records.refusal(key, due.prints):
            root = self.campaign.root
            there = (replace(p, file=p.file and str(root / p.file)) for p in problems)
            return self.stay(refused_step(key, Refused(*there)))
        return Step(key, "stale", due.why)

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

    def describe(self, dues: Iterable[Due]) -> Iterator[Step]:
        """Write anew what the files of one capture's tasks say about their pixels, where that alone differs; yield how it ended."""
        if not (dues := [due for due in dues if due.facts]):
            return
        key, why = replace(dues[0].task.key, stage=DESCRIBE), dues[0].facts
        if self.dry and key == self._stated:  # of an earlier task of the capture
            return
        self._stated = key
        try:
            for due in () if self.dry else dues:
                before = partial(self.records.forget, due.task.key)
                made = describe_anew(due.task, self.campaign, self.places, self.records, before)
                self.keep(due, made)
            yield Step(key, "stale" if self.dry else "done", why)
        except Exception as error:
            yield refused_step(key, self.records.with_report(key, refusal_of(due.task, error)))

    def begin(self, task: Task) -> None:
        """Note what must be known before a task is done: the registration that a finished layer is of."""
        if task.key.stage == "resample":
            self.records.forget(CATALOGUE)  # a layer that is written drops the index of its store
        elif task.key.stage == "register" and self.records.finished(task.key):
            self._registered.setdefault(task.key.of, (task.key, *self.records.copied(task.key)))

    def fresh(self, key: Key) -> Step:
        """Return how a task ended that need not be done again."""
        notes = self.records.notes(key)
        warnings = tuple(notes.get("warnings", ()))
        problems = tuple(Problem(**p) for p in notes.get("refused", ()))
        if problems:
            return self.stay(replace(refused_step(key, Refused(*problems)), warnings=warnings))
        return Step(key, "fresh", warnings=warnings)

    def keep(self, due: Due, written: Written, **notes: Any) -> Step:
        """Record what a task made; return how it ended. Raises WriteRefused."""
        key = due.task.key
        self.records.keep(
            key, due.prints, written.files, aside=written.aside, **notes, **written.notes
        )
        if written.problems:
            return refused_step(key, Refused(*written.problems))
        return Step(key, "done", due.why, warnings=written.warnings)

    def without_reference(self, task: Task) -> Step | None:
        """Return the step of a capture whose reference was lost."""
        capture, lead = captures_of(task)
        failed = self.lost.get((lead.object, lead.layer))
        if failed is None or task.leads:
            return None
        refused = no_reference(capture, lead.camera, failed.why)
        step = self.lose(refused)
        self.lost[capture.object, capture.layer] = step
        return step

    def refuse(self, task: Task, error: Exception) -> Step:
        """Return the step of a refused task.

        An exception that is no refusal is one of this task alone, and leaves a report beside its record.
        """
        refused = self.records.with_report(task.key, refusal_of(task, error))
        if isinstance(refused, Damaged):
            self.records.forget(refused.key)
        return refused_step(task.key, refused)

    def end(self, task: Task, step: Step) -> Step:
        """Return how a task ended: the layer of one that was refused stays where an earlier build finished it, else it is withdrawn.

        What cannot be put back or withdrawn is one problem more of the step.
        """
        if step.state != "refused":
            return step
        self.lost[task.key.object, task.key.layer] = step
        try:
            step = self.stay(step)
            if not step.earlier:
                withdraw(task.key, self.places, self.records)
            self._keep_refusal(task, step)
        except Exception as error:
            return replace(step, problems=(*step.problems, *refusal_of(task, error).problems))
        return step

    def _keep_refusal(self, task: Task, step: Step) -> None:
        """Record why a task was refused, unless its own record says it, or the next time may be another."""
        key, codes = task.key, {problem.code for problem in step.problems}
        recorded = self.records.notes(key).get("refused")
        if not (recorded or codes & OF_THE_MACHINES or is_of_the_disk(step.problems)):
            problems = within(self.campaign, step.problems)
            self.records.refuse(key, self.inputs.of(task, self.lost), problems)


def refusal_of(task: Task, error: Exception) -> Refused:
    """Return why a task of a capture is refused that ended with an exception."""
    capture, _ = captures_of(task)
    what = f"{capture.object}/{capture.layer} {task.key.stage}"
    return as_refusal(error, what, capture.sensors[0].object[0].path)


def within(campaign: Campaign, problems: Iterable[Problem]) -> list[Problem]:
    """Return problems that name files from the campaign's folder, which may be moved with what is kept."""
    root = f"{campaign.root}{os.sep}"
    return [replace(p, file=p.file and str(p.file).removeprefix(root)) for p in problems]


OF_THE_MACHINES = {"E_MEMORY"}
"""Codes of what another machine, or the same one later, may do."""


def is_of_the_disk(problems: Iterable[Problem]) -> bool:
    """Return whether nothing but the disk refused: nothing is wrong with frames and parameters."""
    codes = {problem.code for problem in problems}
    return bool(codes) and codes <= DISK_CODES


NOT_READ = {"E_UNREADABLE", "E_TRUNCATED", "E_MISSING", "E_DAMAGED", "E_IO"}
"""Codes of frames that may be read another day."""


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

    for stage in STAGES[STAGES.index(key.stage) : -1]:
        one = replace(key, stage=stage)
        if stage == key.stage and records.notes(one).get("refused"):
            continue  # a registration that is refused has a record
        for name in sorted(records.made_by(one)):
            remove(places.output / name)
        records.drop(one)
    # By name, not by record: an interrupted build has dropped the record and left the files.
    records.forget(replace(key, stage=STAGES[-1]))
    endings = (*KINDS.values(), ".png")
    paths = [*(f"{key.of.path}{ending}" for ending in endings), key.of.group]
    there = [path for name in paths if os.path.lexists(path := places.output / name)]
    if there:
        records.forget(CATALOGUE)
    for path in there:
        remove(path)


def put_away_stage(key: Key, records: BuildRecords) -> Path | None:
    """Move out what a stage made, and forget it; return where to, None where nothing stood there."""
    products = records.made_by(key)
    if products:
        records.forget(CATALOGUE)  # what it lists is about to change
    where = records.put_away(products)
    if records.is_begun(key):
        records.drop(key)
    return where


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
    there = [key for key in keys if records.made_by(key)]
    counts = {
        "layer": len({key.of for key in there if key.object and key.camera}),
        "object": sum(key.stage == "report" for key in there),
        "camera": sum(key.stage == "camera" for key in there),
    }
    parts = [counted(n, what) for what, n in counts.items() if n]
    if not parts:
        return ""
    verb = "is" if sum(counts.values()) == 1 else "are"
    return f"{' and '.join(parts)} {verb} no longer in the campaign"


def removal(keys: Sequence[Key], records: BuildRecords) -> list[Step]:
    """Move what is no longer in the campaign out of the database; return one step, or none where there was nothing."""
    text = describe(keys, records)
    moved = [where for key in keys if (where := put_away_stage(key, records))]
    return (
        [Step(REMOVED, "done", text, warnings=(f"{text}: moved to {moved[0]}",))] if moved else []
    )

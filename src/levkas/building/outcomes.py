"""Outcomes of tasks: fresh, recorded, or refused with what an earlier build made withdrawn; and what the campaign no longer has."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from levkas.building.build_records import CATALOGUE, STAGES, BuildRecords, Key, key_of
from levkas.building.fingerprints import Inputs, digest
from levkas.building.graph import Graph, Step, Task, captures_of, keys_of
from levkas.building.tasks import Damaged
from levkas.core.disk import DISK_CODES
from levkas.core.internal_errors import as_refusal
from levkas.core.problems import Problem, Refused
from levkas.core.text import counted
from levkas.stages.written import Written

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, Refusals
    from levkas.database.layout import Places

    Layer = tuple[str, str]


class Due(NamedTuple):
    """A task with what it is made of, and why it must be done; empty where it need not."""

    task: Task
    prints: dict[str, Any]
    why: str


class Outcomes:
    """Decides what is due, records what was done, and withdraws what was refused.

    The one writer of the records of captures, wherever their tasks are computed.

    Parameters
    ----------
    campaign : Campaign
    places : Places
    records : BuildRecords
    graph : Graph
    dry : bool
        Nothing is done, recorded or withdrawn: `status`.
    unread : bool
        As of `Inputs`.
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

    def state(self, due: Due) -> Step:
        """Return whether a stage is fresh, stale, or was refused when it was made of the same."""
        key = due.task.key
        if not due.why:
            return self.fresh(key)
        if problems := self.records.refusal(key, due.prints):
            root = self.campaign.root
            there = (replace(p, file=p.file and str(root / p.file)) for p in problems)
            return refused_step(key, Refused(*there))
        return Step(key, "stale", due.why)

    def lose(self, step: Step, refused: Refused | None) -> Step:
        """Move out what was made of a capture that cannot even be begun; return how it ends."""
        if self.dry:
            return step
        for stage in STAGES:
            put_away_stage(replace(step.key, stage=stage), self.records)
        return (
            refused_step(step.key, self.records.with_report(step.key, refused)) if refused else step
        )

    def begin(self, task: Task) -> None:
        """Record the existing files before a task is done."""
        if task.key.stage == "resample":
            self.records.forget(CATALOGUE)  # a layer that is written drops the index of its store
        self._before.setdefault(task.key, self._made(task.key))

    def fresh(self, key: Key) -> Step:
        """Return how a task ended that need not be done again."""
        notes = self.records.notes(key)
        warnings = tuple(notes.get("warnings", ()))
        problems = tuple(Problem(**p) for p in notes.get("refused", ()))
        if problems:
            return Step(key, "refused", problems[0].message, problems=problems, warnings=warnings)
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
        """Return the step of a capture whose reference was lost; move out what was registered to that."""
        capture, lead = captures_of(task)
        failed = self.lost.get((lead.object, lead.layer))
        if failed is None or task.leads:
            return None
        refused = no_reference(lead.object, lead.layer, failed)
        step = refused_step(key_of(capture, "calibrate"), refused)
        if not refused.of_the_disk:
            self.lose(step, None)
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
                note = f"{key.object}/{key.layer}: the layer of an earlier build is kept"
                return replace(step, warnings=(*step.warnings, note))
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
        """Return whether what a task made is what it was before this build, and undamaged.

        A layer that is older than the registration or the reference beside it would be false.
        """
        now = self._made(key)
        return bool(now) and self._before.get(key, now) == now and not self.records.damaged(key)

    def _made(self, key: Key) -> dict[str, str]:
        """Return the hashes of what a task made; of a calibration that is not written, of what it is made of."""
        products, prints = self.records.products(key), self.records.fingerprint(key)
        return products or ({"numbers": digest(prints, numbers_of=key.stage)} if prints else {})


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


def is_of_the_disk(problems: Iterable[Problem]) -> bool:
    """Return whether nothing but the disk refused: nothing is wrong with frames and parameters."""
    codes = {problem.code for problem in problems}
    return bool(codes) and codes <= DISK_CODES


def withdraw(
    capture: Capture, places: Places, records: BuildRecords, stage: str = "resample"
) -> None:
    """Take away what an earlier build made of a layer from the stage on that is refused now."""
    from levkas.core.files import remove

    keys = [Key(capture.object, capture.camera, capture.setup, s) for s in STAGES]
    for key in keys[STAGES.index(stage) :]:
        if key.stage == stage and records.notes(key).get("refused"):
            continue  # a registration that is refused has a record
        if key.stage == "resample":
            continue  # by name, below
        for name in sorted(records.made_by(key)):
            remove(places.output / name)
        records.drop(key)
    # By name, not by record: an interrupted build has dropped the record and left the files.
    records.forget(key_of(capture, "resample"))
    files = [
        places.layer(capture.object, capture.camera, capture.setup, kind=kind)
        for kind in (".tif", ".flags.tif", ".sigma.tif", ".png")
    ]
    paths = (*files, places.store(capture.object) / capture.layer)
    there = [path for path in paths if os.path.lexists(path)]
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


class NoReference(Refused):
    """Nothing can be registered to a reference that is not there."""

    of_the_disk = False
    """Whether nothing but the disk refused the reference."""


def no_reference(name: str, layer: str, failed: Step) -> NoReference:
    """Return the refusal of all that would be registered to a reference that was lost."""
    refused = NoReference(
        Problem(
            "E_NO_REFERENCE",
            f"{name}: the reference camera could not be built, so no camera can be registered",
            field="campaign.reference",
            found=f"{layer}: {failed.why}",
            fix="Correct the frames of the reference camera first.",
        )
    )
    refused.of_the_disk = is_of_the_disk(failed.problems)
    return refused


def refused_step(key: Key, refused: Refused) -> Step:
    """Return the step of a stage that was refused."""
    why = refused.problems[0].message if refused.problems else str(refused)
    return Step(key, "refused", why, problems=tuple(refused.problems))


# --- what a campaign no longer has: found by the records of earlier builds, moved out of the database

REMOVED = Key("", stage="removed")


def no_longer_there(
    campaign: Campaign,
    records: BuildRecords,
    captures: Sequence[Capture],
    refusals: Refusals,
    pages: Iterable[Key],
    objects: Collection[str] | None,
) -> list[Key]:
    """Return the recorded stages of what the campaign does not have any more.

    A capture that is refused is still one of the campaign's. `objects` are those that are built; None
    for all, and for the pages of cameras.
    """
    known = {key for c in captures for key in keys_of(campaign, c).values()} | {*pages}
    known |= {Key(name, stage="report") for name in _names(captures, refusals)}
    return [
        key
        for key in records.recorded()
        if key not in known
        and (key.object, key.camera, key.setup) not in refusals
        and (objects is None or key.object in objects)
    ]


def describe(keys: Iterable[Key], records: BuildRecords) -> str:
    """Report what is no longer in the campaign; empty where nothing of it is in the database."""
    there = [key for key in keys if records.made_by(key)]
    layers = {(key.object, key.layer) for key in there if key.object and key.camera}
    counts = {
        "layer": len(layers),
        "object": sum(key.stage == "report" for key in there),
        "camera": sum(key.stage == "camera" for key in there),
    }
    parts = [counted(n, what) for what, n in counts.items() if n]
    if not parts:
        return ""
    verb = "is" if sum(counts.values()) == 1 else "are"
    return f"{' and '.join(parts)} {verb} no longer in the campaign"


def removal(keys: Sequence[Key], records: BuildRecords) -> list[Step]:
    """Move what is no longer in the campaign out of the database, unless it is to stay.

    Returns
    -------
    steps : list of Step
        One, or none where there was nothing.
    """
    text = describe(keys, records)
    if records.keep_removed:
        return [Step(REMOVED, "fresh", warnings=(f"{text}, and was kept",))] if text else []
    moved = [where for key in keys if (where := put_away_stage(key, records))]
    return (
        [Step(REMOVED, "done", text, warnings=(f"{text}: moved to {moved[0]}",))] if moved else []
    )


def _names(captures: Sequence[Capture], refusals: Refusals) -> set[str]:
    return {c.object for c in captures} | {name for name, _, _ in refusals}

"""The stages of one object: calibrate, register, resample, report."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from levkas.building import fingerprints
from levkas.building.build_records import BuildRecords, Key
from levkas.building.capture_stages import CaptureStages, default_of
from levkas.building.fingerprints import digest
from levkas.building.native_cubes import ran_out
from levkas.building.progress import Step
from levkas.building.removal import (
    CATALOGUE,
    NoReference,
    Standing,
    is_of_the_disk,
    no_reference,
    put_away,
    refused_step,
    withdraw,
)
from levkas.building.rig_mates import RigMates, joint_keys
from levkas.core.machine import give_back_memory, steady_libraries
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.building.native_cubes import Native
    from levkas.building.scans import Scan
    from levkas.building.template_cache import TemplateCache
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places

    Grey = tuple[np.ndarray, np.ndarray]


#: The rounds of a build where captures are adjusted together; else there is only the last.
Round = Literal["references", "others", "last"]


class Planned(NamedTuple):
    """A stage of a capture, what it hangs on, and why it must be done; empty where it need not."""

    key: Key
    prints: dict[str, Any]
    why: str


@dataclass
class ObjectBuild:
    """What the stages of one object share while they run.

    Parameters
    ----------
    captures : list of Capture
        The reference camera's own first.
    mates : RigMates
        What is adjusted together.
    """

    campaign: Campaign
    places: Places
    ledger: BuildRecords
    shelf: TemplateCache
    name: str
    captures: list[Capture]
    mates: RigMates
    digests: dict[Key, str] = field(default_factory=dict)
    _refused: set[str] = field(default_factory=set)
    _numbers: dict[Key, str] = field(default_factory=dict)
    _hashing: bool = False
    _checked: bool = False
    _standing: Standing = field(init=False)
    _stages: CaptureStages = field(init=False)
    _being_written: list[tuple[Capture, Future[Step]]] = field(default_factory=list)
    _round: Round = "last"

    def __post_init__(self) -> None:
        self._standing = Standing(self.ledger)
        self._stages = CaptureStages(
            self.campaign,
            self.places,
            self.ledger,
            self.shelf,
            self.name,
            self.captures,
            self._write,
            lambda capture: [job for waiting, job in self._being_written if waiting is capture],
            self.mates,
        )

    @property
    def reference(self) -> Capture:
        """The capture that all others are registered to."""
        return self.captures[0]

    def run(self, of: Round = "last") -> Iterator[Step]:
        """Yield every stage as it begins and as it ends.

        What a stage made is compressed and written while the next one computes. Earlier rounds than the
        last do only what others that are adjusted together with these captures have to know: first the
        reference cameras of all objects by themselves, then what is registered to them.
        """
        self._round = of
        with (
            ThreadPoolExecutor(1, thread_name_prefix="writing") as self._writer,
            ThreadPoolExecutor(1, thread_name_prefix="hashing") as self._hasher,
        ):
            try:
                yield from self._all()
            finally:
                self._hasher.shutdown(wait=False, cancel_futures=True)

    def _all(self) -> Iterator[Step]:
        broken: NoReference | None = None
        for capture in self._largest_first():
            if broken is not None and capture is not self.reference:
                yield self._unbegun(capture, broken)
                continue
            failed = None
            plan = self._plan(capture)
            due = any(planned.why for planned in plan.values())
            if due and not self._checked and capture is not self.reference:
                yield from self._check_reference()
            self._checked = self._checked or due
            for step in self._capture(capture, plan):
                yield step
                failed = step if step.state in ("refused", "failed") else failed
            if failed is not None and capture is self.reference:
                broken = no_reference(self.name, capture.layer, failed)
        yield from self._written()

    def without_reference(self, ended: Sequence[Step]) -> Iterator[Step]:
        """Refuse what cannot be registered, the reference camera having been lost before."""
        lost = [s for s in ended if s.state in ("refused", "failed")]
        mine = next(s for s in lost if s.key.layer == self.reference.layer)
        broken = no_reference(self.name, self.reference.layer, mine)
        for capture in self.captures[1:]:
            if all(step.key.layer != capture.layer for step in lost):
                yield self._unbegun(capture, broken)

    def _unbegun(self, capture: Capture, broken: NoReference) -> Step:
        """Move out what was registered to a reference that is lost, unless only the disk refused that."""
        if not broken.of_the_disk:
            put_away(capture.object, capture.camera, capture.setup, self.ledger)
        return refused_step(self.keys(capture)["calibrate"], broken)

    def _largest_first(self) -> list[Capture]:
        """The reference, then the others, most bands first: little is left to write at the end.

        The default lighting comes first: layers of others are compared with it.
        """
        others = sorted(self.captures[1:], key=lambda c: (bool(c.setup), -len(c.bands)))
        if self._round == "references":
            others = []
        elif self._round == "others":
            others = [c for c in others if self.campaign.is_joint(c.camera)]
        return [self.reference, *others]

    def _hash_ahead(self) -> None:
        """Hash the frames of all captures beside the work; what fails is met again when it is due."""
        if not self._hashing:
            self._hashing = True
            for capture in self._largest_first():
                self._hasher.submit(
                    fingerprints.of_calibration, self.campaign, capture, self.ledger.hashes
                )

    def states(self) -> list[Step]:
        """Say of every stage whether it is fresh, stale or refused, and why, without doing any."""
        steps: list[Step] = []
        broken: NoReference | None = None
        for capture in self._largest_first():
            if broken is not None and capture is not self.reference:
                steps.append(refused_step(self.keys(capture)["calibrate"], broken))
                continue
            for stage, key in joint_keys(self.campaign, capture).items():
                prints = self._noted(capture, stage)
                if capture.layer in self._refused:
                    continue  # other setups are compared with what this would be
                why = self.ledger.why_stale(key, prints)
                step = Step(key, "stale", why) if why else self._fresh(key)
                if why and (problems := self.ledger.refusal(key, prints)):
                    root = self.campaign.root
                    there = (replace(p, file=p.file and str(root / p.file)) for p in problems)
                    step = refused_step(key, Refused(*there))
                steps.append(step)
                if step.state == "refused":
                    self._refused.add(capture.layer)
                    if capture is self.reference:
                        broken = no_reference(self.name, capture.layer, step)
        return steps

    def note(self, of: Round) -> None:
        """Tell the mates of all captures of a round what these hang on now."""
        self._round = of
        for capture in self._largest_first():
            for stage in self.keys(capture):
                self._noted(capture, stage)
        self._round = "last"

    def keys(self, capture: Capture) -> dict[str, Key]:
        """Return the keys of a capture's stages, as far as they are to be done now."""
        keys = joint_keys(self.campaign, capture)
        if self._round == "last":
            return keys
        wanted = self._round == "others" and capture is self.reference
        last = "register" if wanted or "measure" not in keys else "measure"
        return {stage: keys[stage] for stage in list(keys)[: list(keys).index(last) + 1]}

    # --- one capture --------------------------------------------------------------------------

    def _plan(self, capture: Capture, *, verify: bool = False) -> dict[str, Planned]:
        """Say what each stage of a capture hangs on, and why it must be done.

        What a stage made is read in full and checked before a later one that is due reads it.
        """
        plan: dict[str, Planned] = {}
        for stage, key in self.keys(capture).items():
            prints = self._noted(capture, stage)
            plan[stage] = Planned(key, prints, self.ledger.why_stale(key, prints))
        due = [stage for stage, planned in plan.items() if planned.why]
        if due or verify:
            for one in (self.reference, capture):
                self._standing.note(self.keys(one).values())
        for stage, planned in plan.items():
            read = verify or (due and list(plan).index(stage) < list(plan).index(due[-1]))
            if read and not planned.why and (name := self.ledger.damaged(planned.key)):
                plan[stage] = planned._replace(why=f"{name} was damaged")
        return plan

    def _check_reference(self) -> Iterator[Step]:
        """Before another capture reads what was kept of the reference, mend what is damaged of it."""
        self._checked = True
        for step in self._capture(self.reference, self._plan(self.reference, verify=True)):
            if step.state != "fresh":
                yield step

    def _capture(self, capture: Capture, plan: dict[str, Planned]) -> Iterator[Step]:
        native: list[Native | Scan] = []
        for stage, (key, prints, why) in plan.items():
            if stage in ("measure", "register"):
                # Two cubes at once are enough; the one of the capture before goes first.
                yield from self._written(but=capture)
            if why:
                self._hash_ahead()
                yield Step(key, "running", why)
            ended = self._attempt(stage, key, prints, capture, native, why) if why else None
            if isinstance(ended, Future):
                self._being_written.append((capture, ended))
                if stage == "calibrate" or capture is not self.reference:
                    continue
            failed = False
            for step in self._written(of=capture):
                yield step
                failed = failed or step.state == "refused"
            if failed or isinstance(ended, Future):
                return
            step = ended or self._fresh(key)
            if step.state in ("refused", "failed"):
                yield self._lost(capture, step)
                return
            yield step

    def _written(self, *, of: Capture | None = None, but: Capture | None = None) -> Iterator[Step]:
        """Wait for what is being written, and yield how those stages ended."""
        for waiting in list(self._being_written):
            capture, job = waiting
            if (of is not None and capture is not of) or capture is but:
                continue
            self._being_written.remove(waiting)
            step = job.result()
            yield self._lost(capture, step) if step.state == "refused" else step

    def _noted(self, capture: Capture, stage: str) -> dict[str, Any]:
        """The fingerprint of a stage; its digests are there for the stages that hang on it."""
        key, prints = joint_keys(self.campaign, capture)[stage], self._prints(capture, stage)
        self.digests[key], self._numbers[key] = digest(prints), digest(prints, numbers_of=stage)
        return prints

    def _prints(self, capture: Capture, stage: str) -> dict[str, Any]:
        if stage == "calibrate":
            return fingerprints.of_calibration(self.campaign, capture, self.ledger.hashes)
        keys, base = (joint_keys(self.campaign, c) for c in (capture, self.reference))
        if stage == "measure" or (stage == "register" and "measure" not in keys):
            ends = self._numbers[keys["calibrate"]], self._numbers[base["calibrate"]]
            prints = fingerprints.of_registration(self.campaign, capture, self.ledger.hashes, *ends)
            if capture is not self.reference:
                prints["registration of the reference"] = self._numbers[base["register"]]
            if stage == "measure":
                self.mates.note(capture, digest(prints, numbers_of=stage))
            return prints
        if stage == "register":
            own = self.digests[keys["measure"]]
            return fingerprints.of_adjustment(own, self.mates.prints(capture))
        ends = self.digests[keys["register"]], self.digests[base["register"]]
        default = default_of(capture, self.captures)
        other = ""
        if default is not None and default.layer not in self._refused:
            other = self.digests[fingerprints.keys_of(default)["resample"]]
        return fingerprints.of_resampling(
            self.campaign, capture, self.ledger.hashes, *ends, default=other
        )

    def _fresh(self, key: Key) -> Step:
        notes = self.ledger.told(key)
        warnings = tuple(notes.get("warnings", ()))
        problems = tuple(Problem(**p) for p in notes.get("refused", ()))
        if problems:
            return Step(key, "refused", problems[0].message, problems=problems, warnings=warnings)
        return Step(key, "fresh", warnings=warnings)

    def _attempt(
        self,
        stage: str,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        native: list[Native | Scan],
        why: str,
    ) -> Step | Future[Step]:
        """Do a stage; what it makes may still be being written when this returns."""
        self.ledger.forget(CATALOGUE)  # what it lists is about to change
        stages: dict[str, Callable[..., Step | Future[Step]]] = {
            "calibrate": self._stages.calibrate,
            "measure": self._stages.measure,
            "register": self._stages.register,
            "resample": self._stages.resample,
        }
        give_back_memory()
        try:
            with steady_libraries():
                return stages[stage](key, prints, capture, native, why)
        except Refused as refused:
            return self._failed(key, refused)
        except MemoryError as error:
            return self._failed(key, ran_out(capture, error))

    def _failed(self, key: Key, refused: Refused) -> Step:
        """Return the step of a refused stage; what it made before stays where only the disk refused."""
        if not is_of_the_disk(refused.problems):
            self.ledger.forget(key)
        return refused_step(key, refused)

    def _write(
        self, key: Key, capture: Capture, write: Callable[[], Step], *, wait: bool = False
    ) -> Future[Step]:
        def attempt() -> Step:
            try:
                return write()
            except Refused as refused:
                return self._failed(key, refused)
            except MemoryError as error:
                return self._failed(key, ran_out(capture, error))

        job = self._writer.submit(attempt)
        if wait:
            job.exception()
        return job

    def _lost(self, capture: Capture, step: Step) -> Step:
        """Withdraw a layer whose stage was refused, or say that the older one stays.

        It stays where only the disk refused, and where nothing of this build stands beside it yet.
        """
        self._refused.add(capture.layer)
        keys = [key for c in (self.reference, capture) for key in self.keys(c).values()]
        if is_of_the_disk(step.problems):
            if self._standing.holds(keys):
                told = f"{self.name}/{capture.layer}: the layer of an earlier build stays"
                return replace(step, warnings=(*step.warnings, told))
            self.ledger.forget(step.key)
            withdraw(capture, self.places, self.ledger)
        else:
            withdraw(capture, self.places, self.ledger, step.key.stage)
            # A refused registration has a record; more memory may be there the next time.
            recorded = self.ledger.told(step.key).get("refused")
            if not recorded and all(p.code != "E_MEMORY" for p in step.problems):
                prints = self._prints(capture, step.key.stage)
                # A campaign may be moved: what is kept names its files from its folder.
                root = f"{self.campaign.root}{os.sep}"
                problems = [
                    replace(p, file=p.file and str(p.file).removeprefix(root))
                    for p in step.problems
                ]
                self.ledger.refuse(step.key, prints, problems)
        return step

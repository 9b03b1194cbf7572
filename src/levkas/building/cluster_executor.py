"""The executor of a graph on a cluster: a task is sent when all that it reads has ended.

It is sent with the memory that it needs as a resource, to the idle worker that holds most of what it reads;
dask finds another one where that is lost. The worker leaves a receipt, and this process alone records
what was made. Frames are hashed ahead, and pages written, in a thread each.
"""

from __future__ import annotations

import queue
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future as Running
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from distributed import Future
from distributed.scheduler import KilledWorker

from levkas.building.build_records import CATALOGUE
from levkas.building.cluster import Cluster, no_workers_s
from levkas.building.fingerprints import digest, of_calibration
from levkas.building.graph import Step, Task, captures_of
from levkas.building.outcomes import Due, Outcomes, refusal_of
from levkas.building.task_queue import TaskQueue, hash_key
from levkas.building.worker import (
    ASKED,
    RECEIPT,
    Job,
    NotShared,
    code_digest,
    digest_of,
    is_refused,
    read_receipt,
    refusal_in,
    written_of,
)
from levkas.core.files import make_folder, remove, write_text
from levkas.core.instructions import instructions_in_use
from levkas.core.problems import Problem, Refused
from levkas.core.progress import FRAMES
from levkas.core.sweeping import sweep
from levkas.core.text import counted
from levkas.stages.native_cubes import CUBE_BYTES, TooLarge, count_values
from levkas.stages.scans import bytes_of_pass, is_streamed

if TYPE_CHECKING:
    from levkas.building.build_records import Key
    from levkas.campaign.campaign import Campaign

RETRIES, LOSSES = 3, 20
"""Times that a task is sent again where it failed or ran out of memory, and where its worker vanished."""
NEAR = 0.8
"""Share of a worker's memory from which its end is put down to want of memory; dask ends it at 0.95."""
BASE, STREAMED = 200e6, 1.5e9
"""Bytes that a process takes before it reads a frame, and those of a scan whose rows are resampled."""
SAID_S = 10.0
"""How long there may be no worker before that is said; a restart takes seconds."""
LOOK_S, STUCK_S = 1.0, 15.0
"""How long to wait for news before the workers are counted, and for a worker that is idle to begin."""


def memory_needed(task: Task, campaign: Campaign) -> float:
    """Return the bytes that a task takes at least: its cube, and that of its reference beside it."""
    calibrates = task.key.stage == "calibrate"
    captures = {id(c): c for c in captures_of(task)[: 1 if calibrates else 2]}
    least = 0.0 if calibrates else STREAMED
    return BASE + sum(
        max(least, bytes_of_pass(c))
        if is_streamed(c, campaign)
        else CUBE_BYTES * count_values(c, campaign.cameras[c.camera].kind)
        for c in captures.values()
    )


@dataclass
class Flight:
    """A task that is sent, or waits for memory, and its attempts: worker, peak of private memory, reason.

    Parameters
    ----------
    due : Due
    need : float
        Bytes of memory.
    """

    due: Due
    need: float
    future: Future | None = None
    to: str = ""
    """The worker that it was sent to; dask may have taken another one."""
    on: str = ""
    """The worker that has begun it."""
    peak: int = 0
    frames: int = 0
    sent: int = 0
    since: float = 0.0
    attempts: list[dict[str, Any]] = field(default_factory=list)
    failed: int = 0
    lost: int = 0

    @property
    def key(self) -> Key:
        """Of the task."""
        return self.due.task.key

    def ended(self, why: str) -> None:
        """Log an attempt."""
        self.attempts.append({"worker": self.on, "peak": self.peak, "why": why})
        self.on, self.peak, self.frames = "", 0, 0

    def is_of(self, name: Iterable[str]) -> bool:
        """Tell whether it is the task of which a worker speaks."""
        key = self.key
        return [key.object, key.camera, key.setup, key.stage] == [*name]


class ClusterExecutor:
    """Runs the tasks of captures on a cluster, and says how each ends; as `Executor` does in one process."""

    def __init__(self, outcomes: Outcomes, cluster: Cluster, path: Path, *, verify: bool) -> None:
        self._outcomes, self._records, self._cluster = outcomes, outcomes.records, cluster
        self._graph, self._places = outcomes.graph, outcomes.places
        self._path, self._verify = path, verify
        self._queue = TaskQueue(self._graph)
        self._flying: dict[Key, Flight] = {}
        self._sent = count(1)
        self._redone: Counter[Key] = Counter()
        self._there: list[str] = []
        self._untidy = False
        self._counted = 0.0
        self._alone_since: float | None = None
        self._said_so = False

    def run(
        self, tasks: Sequence[Task], write_page: Callable[[Task], Iterable[Step]]
    ) -> Iterator[Step]:
        """Yield each task as it begins and as it ends; `tasks` are all, but for the catalogue.

        `write_page` writes the page of an object or of a camera.
        """
        self._write_page = write_page
        with (
            ThreadPoolExecutor(1, thread_name_prefix="pages") as self._pages,
            ThreadPoolExecutor(1, thread_name_prefix="hashing") as self._hasher,
        ):
            try:
                self._lay(tasks)
                self._cluster.greet()
                said = ""
                while self._queue.open:
                    if (waiting := self._waiting_for_workers()) is not None:
                        yield waiting
                    for step in (*self._send_ready(), *self._heard()):
                        said = self.where
                        of_capture = step.key.object and step.key.camera
                        yield replace(step, where=said) if of_capture else step
                    if said != self.where and self._flying:
                        said = self.where
                        first = next(iter(self._flying.values())).due
                        yield Step(first.task.key, "running", first.why, where=said)
            finally:
                for pool in (self._hasher, self._pages):
                    pool.shutdown(wait=False, cancel_futures=True)
                if futures := [f.future for f in self._flying.values() if f.future is not None]:
                    self._cluster.cancel(futures)
        if self._untidy:
            for folder in (self._places.output, self._places.kept):
                sweep(folder)
        ended = self._outcomes.ended
        order = {key: ended[key] for key in self._graph if key in ended}
        ended |= {key: ended.pop(key) for key in order}

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is to be known of the cluster."""
        return self._cluster.warnings

    @property
    def where(self) -> str:
        """How many workers there are, and which task waits for memory while one of them is idle."""
        count = len(self._there)
        told = counted(count, "worker")
        idle = self._idle()
        if not idle:
            return told
        room = max(self._cluster.sizes[worker] for worker in idle)
        names = [
            f"{f.key.object}/{f.key.layer}"
            for f in self._flying.values()
            if f.future is None and f.need > room
        ]
        more = f" and {len(names) - 1} more wait" if len(names) > 1 else " waits"
        return f"{told}, {names[0]}{more} for memory" if names else told

    def _waiting_for_workers(self) -> Step | None:
        """Say, once, that there is no worker; raises ClusterRefused where none has come for too long."""
        now = time.monotonic()
        if self._there or self._alone_since is None:
            self._alone_since, self._said_so = now, False
        alone = now - self._alone_since
        patience = no_workers_s()
        if alone > patience:
            raise self._cluster.without_workers(patience)
        if alone < SAID_S or self._said_so:
            return None
        self._said_so = True
        key = next((k for k in self._graph if k in self._queue.open), CATALOGUE)
        return Step(key, "waiting", f"there is no worker; it ends after {patience:g} s without one")

    def _idle(self) -> list[str]:
        """Return the workers that are there and have no task."""
        busy = {f.on or f.to for f in self._flying.values() if f.future is not None}
        return [worker for worker in self._there if worker not in busy]

    def _lay(self, tasks: Sequence[Task]) -> None:
        """Queue the tasks; a calibration waits until its frames are hashed."""
        for key in self._queue.lay(tasks):
            self._let_go(key)
        for task in tasks:
            if task.key.stage == "calibrate":
                capture, hashes = captures_of(task)[0], self._records.hashes
                job = self._hasher.submit(of_calibration, self._outcomes.campaign, capture, hashes)
                job.add_done_callback(partial(self._report, {"hashed": hash_key(task.key)}))

    def _report(self, event: dict[str, Any], ended: Running[Any]) -> None:
        """Wake the thread that runs the graph."""
        self._cluster.events.put({**event, "ended": ended})

    # --- sending --------------------------------------------------------------------------------

    def _send_ready(self) -> Iterator[Step]:
        """Give every idle worker a task of those that wait for none; what is fresh ends at once."""
        for flight in self._flying.values():
            if flight.future is None:
                self._resend(flight)
        while self._queue.is_ready and self._held() <= 2 * len(self._there):
            idle = self._idle()
            if not idle and self._flying:
                return
            worker, key = self._queue.take(idle, self._there)
            task = self._graph[key]
            if (key.object, key.layer) in self._outcomes.lost:
                self._release(key)
                continue
            if (step := self._outcomes.without_reference(task)) is not None:
                yield self._outcomes.note(step)
                self._release(key)
                continue
            due = self._outcomes.due(task)
            if due.why:
                yield from self._begin(due, worker)
            else:
                yield from self._end(task, self._outcomes.fresh(key))

    def _held(self) -> int:
        """Count the tasks that wait for a worker with the memory."""
        return sum(f.future is None for f in self._flying.values())

    def _begin(self, due: Due, worker: str) -> Iterator[Step]:
        """Send a task, or refuse it where no worker has the memory."""
        task = due.task
        flight = Flight(due, memory_needed(task, self._outcomes.campaign), to=worker)
        self._outcomes.begin(task)
        if refused := self._too_large(flight):
            yield from self._end(task, self._outcomes.refuse(task, refused))
            return
        self._flying[task.key] = flight
        yield Step(task.key, "running", due.why)
        self._resend(flight)

    def _too_large(self, flight: Flight) -> TooLarge | None:
        """Return the refusal of a task that needs more memory than any worker that was seen has."""
        most = max(self._cluster.sizes.values(), default=None)
        if most is None or flight.need <= most:
            return None
        capture, _ = captures_of(flight.due.task)
        return TooLarge(
            Problem(
                "E_MEMORY",
                f"{capture.object}/{capture.layer} {flight.due.task.key.stage} fits on no worker",
                file=str(capture.sensors[0].object[0].path),
                field=f"cameras.{capture.camera}",
                found=f"{most / 1e9:.1f} GB on the largest of {len(self._cluster.sizes)} workers",
                expected=f"at least {flight.need / 1e9:.1f} GB",
                fix="Add a worker with more memory, or start fewer workers per machine.",
            )
        )

    def _resend(self, flight: Flight) -> None:
        """Send a task to an idle worker that has the memory, or wait for one.

        dask looks for a worker when a task comes, and when a worker does, which then has no resources yet.
        """
        if flight.future is not None:
            flight.future.release()
            flight.future = None
        sizes = self._cluster.sizes
        if fit := [worker for worker in self._idle() if flight.need <= sizes[worker]]:
            flight.to = flight.to if flight.to in fit else min(fit, key=sizes.__getitem__)
            self._send(flight)

    def _is_stuck(self, flight: Flight) -> bool:
        """Tell whether a task that was sent is not begun though it could be, or its worker is gone."""
        waited = time.monotonic() - flight.since
        if flight.future is None or waited < STUCK_S:
            return False
        if flight.on:
            return flight.on not in self._there
        return waited > STUCK_S * flight.sent

    def _send(self, flight: Flight) -> None:
        due = flight.due
        key, records = due.task.key, self._records
        made_of = digest(due.prints)
        asked = records.path_of(key, ASKED)
        make_folder(asked.parent)
        write_text(asked, made_of)
        reads = dict.fromkeys(
            k for k in (*due.task.needs, *due.task.uses) if self._graph[k].capture is not None
        )
        job = Job(
            campaign=str(self._path),
            output=str(self._places.output),
            build=self._cluster.build,
            key=(key.object, key.camera, key.setup, key.stage),
            made_of=made_of,
            task=digest_of(due.task),
            reads=tuple(((k.object, k.camera, k.setup, k.stage), records.check(k)) for k in reads),
            code=code_digest(),
            verify=self._verify,
        )
        flight.sent, flight.since = flight.sent + 1, time.monotonic()
        self._queue.note(flight.to, key)
        flight.future = self._cluster.send(job, flight.need, next(self._sent), flight.to)
        flight.future.add_done_callback(lambda _: self._cluster.events.put({"done": flight.key}))

    # --- hearing --------------------------------------------------------------------------------

    def _heard(self) -> Iterator[Step]:
        """Take what workers say and what has ended; wait a second at most for the first of it."""
        try:
            told = [self._cluster.events.get(timeout=LOOK_S)]
        except queue.Empty:
            told = []
        while not self._cluster.events.empty():
            told.append(self._cluster.events.get())
        for one in told:
            if "bytes" in one:
                self._cluster.learn(one)
            elif "begun" in one:
                self._note_begun(one)
            elif "hashed" in one:
                self._release(one["hashed"])
            elif "page" in one:
                yield from one["ended"].result()
                self._release(one["page"])
        now = time.monotonic()
        if now - self._counted > LOOK_S or any("bytes" in one for one in told):
            self._cluster.greet()  # where the scheduler was started again
            self._there = self._cluster.workers()
            self._counted = now
        for flight in list(self._flying.values()):
            refused = None if flight.on else self._too_large(flight)
            if refused:
                if flight.future is not None:
                    self._cluster.cancel([flight.future])
                yield from self._end(
                    flight.due.task, self._outcomes.refuse(flight.due.task, refused)
                )
            elif flight.future is None:
                self._resend(flight)
            elif flight.future.status != "pending":
                yield from self._landed(flight)
            elif self._is_stuck(flight):
                if flight.on:
                    flight.ended("its worker was lost")
                self._cluster.cancel([flight.future])
                self._resend(flight)

    def _note_begun(self, told: dict[str, Any]) -> None:
        for key, flight in self._flying.items():
            if flight.is_of(told["begun"]):
                if flight.on and flight.on != told["on"]:
                    flight.ended("its worker was lost")
                if flight.on != told["on"]:
                    flight.since = time.monotonic()
                flight.on, flight.peak = told["on"], max(flight.peak, told["peak"])
                self._queue.note(flight.on, key)
                self._count_frames(flight, told["frames"])

    def _count_frames(self, flight: Flight, frames: int) -> None:
        """Count the frames that a worker has read since it was last heard of."""
        FRAMES.add(max(0, frames - flight.frames))
        flight.frames = max(frames, flight.frames)

    def _landed(self, flight: Flight) -> Iterator[Step]:
        """Take the result of a task, or send it again."""
        assert flight.future is not None
        future, task = flight.future, flight.due.task
        status, error = future.status, None
        if status == "error":
            error = future.exception()
        told = future.result() if status == "finished" else {}
        future.release()
        if "damaged" in told:
            yield from self._mend(flight, tuple(told["damaged"]), told["name"])
        elif status == "finished":
            flight.on, flight.peak = told["on"], told["peak"]
            self._count_frames(flight, told["frames"])
            yield from self._commit(flight)
        elif refused := self._give_up(flight, error):
            yield from self._end(task, self._outcomes.refuse(task, refused))
        else:
            self._resend(flight)

    def _give_up(self, flight: Flight, error: BaseException | None) -> Refused | None:
        """Log an attempt that failed; return a refusal where it was the last."""
        self._untidy = True
        on, peak = flight.on, flight.peak
        if error is None or isinstance(error, KilledWorker):
            starved = peak > NEAR * self._cluster.sizes.get(on, float("inf"))
            flight.ended("its worker ran out of memory" if starved else "its worker was lost")
            flight.failed, flight.lost = flight.failed + starved, flight.lost + (not starved)
        else:
            flight.ended(f"{type(error).__name__}: {error}"[:200])
            flight.failed += 1
        if flight.failed <= RETRIES and flight.lost <= LOSSES:
            return None
        if isinstance(error, Exception) and not isinstance(
            error, (KilledWorker, NotShared, OSError)
        ):
            return refusal_of(flight.due.task, error)
        key = flight.due.task.key
        return Refused(
            Problem(
                "E_WORKER",
                f"{key.object}/{key.layer} {key.stage} failed on every worker that tried it",
                found="; ".join(
                    f"{one['worker']}, {one['peak'] / 1e9:.1f} GB: {one['why']}"
                    for one in flight.attempts
                ),
                fix="Check those machines, then build again. Finished stages are kept.",
            )
        )

    def _mend(self, flight: Flight, damaged: tuple[str, ...], name: str) -> Iterator[Step]:
        """Do a task again whose products are damaged, and then the one that would read them."""
        key = next(k for k in self._graph if (k.object, k.camera, k.setup, k.stage) == damaged)
        task = flight.due.task
        self._redone[key] += 1
        if self._redone[key] > RETRIES:
            problem = Problem(
                "E_DAMAGED", "a file was damaged at every attempt to write it", found=name
            )
            yield from self._end(task, self._outcomes.refuse(task, Refused(problem)))
            return
        self._queue.wait(task.key, key)
        del self._flying[flight.key]
        if key not in self._flying:
            due = self._outcomes.due(self._graph[key])
            yield from self._begin(due._replace(why=f"{name} was damaged"), "")

    def _commit(self, flight: Flight) -> Iterator[Step]:
        """Record what a task made, as its receipt says."""
        task, records = flight.due.task, self._records
        receipt = read_receipt(records.path_of(task.key, RECEIPT))
        if receipt.get("made of") != digest(flight.due.prints):
            if again := self._give_up(
                flight, NotShared("the result is not visible on this machine")
            ):
                yield from self._end(task, self._outcomes.refuse(task, again))
            else:
                self._resend(flight)
            return
        flight.ended("done")
        try:
            if is_refused(receipt):
                step = self._outcomes.refuse(task, refusal_in(receipt))
            else:
                for part, folder in (
                    ("files", self._places.output),
                    ("aside", self._places.kept),
                ):
                    for name, entry in receipt[part].items():
                        records.hashes.take(folder / name, entry)
                other = receipt["instructions"] != instructions_in_use()
                step = self._outcomes.keep(
                    flight.due,
                    written_of(receipt, self._places),
                    seconds=receipt["seconds"],
                    attempts=flight.attempts,
                    **({"instructions": receipt["instructions"]} if other else {}),
                )
        except Refused as error:
            step = self._outcomes.refuse(task, error)
        for suffix in (RECEIPT, ASKED):
            remove(records.path_of(task.key, suffix))
        yield from self._end(task, step)

    def _end(self, task: Task, step: Step) -> Iterator[Step]:
        yield self._outcomes.note(self._outcomes.end(task, step))
        flight = self._flying.pop(task.key, None)
        if flight is not None and flight.future is not None and flight.future.status == "pending":
            self._cluster.cancel([flight.future])
        self._release(task.key)

    def _release(self, key: Key) -> None:
        """Let go what waited for a task."""
        for other in self._queue.release(key):
            self._let_go(other)

    def _let_go(self, key: Key) -> None:
        """Have a task done when there is a worker; a page is written at once."""
        task = self._graph[key]
        if task.capture is not None:
            self._queue.put(key)
            return
        page = self._pages.submit(lambda: list(self._write_page(task)))
        page.add_done_callback(partial(self._report, {"page": key}))

"""The executor of a graph on a cluster: a task is sent when all that it reads has ended.

It is sent with the memory that it needs as a resource, and dask decides which worker does it; the worker
leaves a receipt, and this process alone records what was made.
"""

from __future__ import annotations

import heapq
import queue
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from distributed import Future
from distributed.scheduler import KilledWorker

from levkas.building import sources
from levkas.building.cluster import Cluster
from levkas.building.endings import OF_THE_MACHINES, Due, Endings
from levkas.building.fingerprints import digest
from levkas.building.graph import Step, Task, captures_of
from levkas.building.native_cubes import CUBE_BYTES, TooLarge, count_values
from levkas.building.scans import bytes_of_pass, is_streamed
from levkas.building.worker import (
    ASKED,
    PARTS,
    RECEIPT,
    Job,
    NotShared,
    code_digest,
    digest_of,
    is_refused,
    part_key,
    read_receipt,
    receipt_path,
    written_of,
)
from levkas.core.disk import DISK_CODES
from levkas.core.files import make_folder, remove, write_text
from levkas.core.problems import Problem, Refused
from levkas.core.sweeping import sweep

if TYPE_CHECKING:
    from levkas.building.build_records import Key
    from levkas.campaign.campaign import Campaign

RETRIES, LOSSES = 3, 20
"""Times that a task is sent again where it failed or ran out of memory, and where its worker vanished."""
NEAR = 0.8
"""Share of a worker's memory from which its end is put down to want of memory; dask ends it at 0.95."""
BASE, STREAMED = 200e6, 1.5e9
"""Bytes that a process takes before it reads a frame, and those of a scan whose rows are resampled."""
MENDED_ELSEWHERE = DISK_CODES | {*OF_THE_MACHINES}
"""Codes of refusals that leave the parts of a task to the next build."""
LOOK_S, STUCK_S = 1.0, 15.0
"""How long to wait for news before the workers are counted, and for a worker that is idle to begin."""


def memory_needed(task: Task, campaign: Campaign, part: tuple[int, ...] = ()) -> float:
    """Return the bytes that a task, or a part, takes at least: its cube, and that of its reference beside it."""
    calibrates = task.key.stage == "calibrate"
    captures = {id(c): c for c in captures_of(task)[: 1 if calibrates else 2]}
    least = 0.0 if calibrates else STREAMED
    return BASE + sum(
        max(least, bytes_of_pass(c, (part[0], part[1]) if part else None))
        if is_streamed(c, campaign)
        else CUBE_BYTES * count_values(c, campaign.cameras[c.camera].kind)
        for c in captures.values()
    )


@dataclass
class Flight:
    """A task that was sent, and its attempts: worker, peak of private memory, why it was not the last.

    Parameters
    ----------
    due : Due
    need : float
        Bytes of memory.
    part : (start, stop)
        Rows of the task that are done; () for all.
    """

    due: Due
    need: float
    part: tuple[int, ...] = ()
    future: Future | None = None
    on: str = ""
    peak: int = 0
    since: float = 0.0
    attempts: list[dict[str, Any]] = field(default_factory=list)
    failed: int = 0
    lost: int = 0

    @property
    def key(self) -> Key:
        """Of the task, or of the part."""
        return part_key(self.due.task.key, self.part)

    def ended(self, why: str) -> None:
        """Log an attempt."""
        self.attempts.append({"worker": self.on, "peak": self.peak, "why": why})
        self.on, self.peak = "", 0


class ClusterExecutor:
    """Runs the tasks of captures on a cluster, and says how each ends; as `Executor` does in one process."""

    takes_all = True

    def __init__(self, endings: Endings, cluster: Cluster, path: Path, *, verify: bool) -> None:
        self._endings, self._records, self._cluster = endings, endings.records, cluster
        self._graph, self._places = endings.graph, endings.places
        self._path, self._verify = path, verify
        self._tasks: list[Task] = []
        self._ahead: dict[Key, set[Key]] = {}
        self._behind: dict[Key, list[Key]] = {}
        self._ready: list[int] = []
        self._flying: dict[Key, Flight] = {}
        self._sent = count(1)
        self._redone: Counter[Key] = Counter()
        self._cuts: dict[Key, tuple[int, ...]] = {}
        self._tried: dict[Key, list[dict[str, Any]]] = {}
        self._there: list[str] = []
        self._untidy = False
        self._counted = 0.0

    def run(self, tasks: Sequence[Task]) -> Iterator[Step]:
        """Yield each task of captures as it begins and as it ends; `tasks` has all of them."""
        self._lay(tasks)
        try:
            sources.keep(self._places.kept / sources.CODE)
            self._cluster.greet(self._places.kept)
            while self._ready or self._flying:
                for step in (*self._send_ready(), *self._heard()):
                    yield replace(self._endings.note(step), where=self.where)
        finally:
            if futures := [f.future for f in self._flying.values() if f.future is not None]:
                with suppress(Exception):  # the scheduler may have gone
                    self._cluster.client.cancel(futures)
        if self._untidy:
            for folder in (self._places.output, self._places.kept):
                sweep(folder)
        ended = self._endings.ended
        order = {key: ended[key] for key in self._graph if key in ended}
        ended |= {key: ended.pop(key) for key in order}

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is to be known of the cluster."""
        return self._cluster.warnings

    @property
    def where(self) -> str:
        """How many workers there are, and how many tasks wait for memory while one of them is idle."""
        count = len(self._there)
        told = f"{count} worker{'' if count == 1 else 's'}"
        room = self._room(self._idle())
        waiting = [f for f in self._flying.values() if not f.on and 0 < room < f.need]
        verb = "waits" if len(waiting) == 1 else "wait"
        return f"{told}, {len(waiting)} {verb} for memory" if waiting else told

    def _idle(self) -> set[str]:
        return {*self._there} - {flight.on for flight in self._flying.values()}

    def _room(self, workers: Iterable[str]) -> float:
        """Return the bytes of the largest of some workers; 0 where there is none."""
        return max((self._cluster.sizes[worker] for worker in workers), default=0.0)

    def _lay(self, tasks: Sequence[Task]) -> None:
        """Note what each task waits for: what it reads, and what comes before it of its object's reference.

        Where the reference is lost nothing else of its object is begun, as in one process.
        """
        self._tasks = list(tasks)
        known = {task.key for task in tasks}
        places = {key: number for number, key in enumerate(self._graph)}
        of_layer: dict[tuple[str, str], list[Key]] = {}
        for task in tasks:
            of_layer.setdefault((task.key.object, task.key.layer), []).append(task.key)
        for number, task in enumerate(tasks):
            first = [k for c in captures_of(task) for k in of_layer.get((c.object, c.layer), ())]
            ahead = {k for k in first if places[k] < places[task.key]}
            ahead |= {k for k in (*task.needs, *task.uses) if k in known}
            self._ahead[task.key] = ahead
            for key in ahead:
                self._behind.setdefault(key, []).append(task.key)
            if not ahead:
                heapq.heappush(self._ready, number)
        self._numbers = {task.key: number for number, task in enumerate(tasks)}

    # --- sending --------------------------------------------------------------------------------

    def _send_ready(self) -> Iterator[Step]:
        """Send what is due of the tasks that wait for none, a few more than there are workers."""
        most = 2 * len(self._there) + 2
        while self._ready and len(self._flying) < most:
            task = self._tasks[heapq.heappop(self._ready)]
            layer = (task.key.object, task.key.layer)
            if layer in self._endings.lost:
                self._release(task.key)
                continue
            if (step := self._endings.without_reference(task)) is not None:
                yield step
                self._release(task.key)
                continue
            due = self._endings.due(task)
            if due.why:
                yield from self._begin(due)
            else:
                yield from self._end(task, self._endings.fresh(task.key))

    def _begin(self, due: Due) -> Iterator[Step]:
        """Send a task, or refuse it where no worker has the memory."""
        task = due.task
        need = memory_needed(task, self._endings.campaign)
        flight = Flight(due, need, attempts=self._tried.pop(task.key, []))
        self._endings.begin(task)
        if refused := self._too_large(flight):
            yield from self._end(task, self._endings.refuse(task, refused))
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
                fix="Give the cluster a worker with more memory, or take fewer workers a machine.",
            )
        )

    def _resend(self, flight: Flight) -> None:
        """Send a task, or wait where no worker that is there has the memory.

        dask looks for a worker when a task comes, and when a worker does, which then has no resources yet.
        """
        if flight.future is not None:
            flight.future.release()
            flight.future = None
        if flight.need <= self._room(self._there):
            self._send(flight)

    def _is_stuck(self, flight: Flight) -> bool:
        """Tell whether a task that was sent is not begun though it could be, or its worker is gone."""
        if flight.future is None or time.monotonic() - flight.since < STUCK_S:
            return False
        if flight.on:
            return flight.on not in self._there
        return flight.need <= self._room(self._idle())

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
            divides=not flight.part and key not in self._cuts and len(self._there) > 1,
            part=flight.part,
            cuts=() if flight.part else self._cuts.get(key, ()),
        )
        flight.since = time.monotonic()
        flight.future = self._cluster.send(job, flight.need, next(self._sent))
        flight.future.add_done_callback(lambda _: self._cluster.events.put({"done": flight.key}))

    # --- hearing --------------------------------------------------------------------------------

    def _heard(self) -> Iterator[Step]:
        """Take what workers say and what has ended; wait a second at most for the first of it."""
        try:
            told = [self._cluster.events.get(timeout=LOOK_S if self._flying else 0)]
        except queue.Empty:
            told = []
        while not self._cluster.events.empty():
            told.append(self._cluster.events.get())
        for one in told:
            if "bytes" in one:
                self._cluster.learn(one)
            elif "begun" in one:
                self._note_begun(one)
        now = time.monotonic()
        if now - self._counted > LOOK_S or any("bytes" in one for one in told):
            self._cluster.greet(self._places.kept)  # where the scheduler was started again
            self._there = self._cluster.workers()
            self._counted = now
        for key, flight in list(self._flying.items()):
            if key not in self._flying:  # a part of what was refused meanwhile
                continue
            refused = None if flight.on else self._too_large(flight)
            if refused:
                if flight.future is not None:
                    self._cluster.client.cancel([flight.future])
                yield from self._end(
                    flight.due.task, self._endings.refuse(flight.due.task, refused)
                )
            elif flight.future is None:
                self._resend(flight)
            elif flight.future.status != "pending":
                yield from self._landed(flight)
            elif self._is_stuck(flight):
                if flight.on:
                    flight.ended("its worker was lost")
                self._cluster.client.cancel([flight.future])
                self._resend(flight)

    def _note_begun(self, told: dict[str, Any]) -> None:
        for key, flight in self._flying.items():
            if [key.object, key.camera, key.setup, key.stage] == list(told["begun"]):
                if flight.on and flight.on != told["on"]:
                    flight.ended("its worker was lost")
                if flight.on != told["on"]:
                    flight.since = time.monotonic()
                flight.on, flight.peak = told["on"], max(flight.peak, told["peak"])

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
        elif told.get("cuts"):
            self._divide(flight, tuple(told["cuts"]))
        elif status == "finished":
            flight.on, flight.peak = told["on"], told["peak"]
            yield from self._commit(flight)
        elif refused := self._give_up(flight, error):
            yield from self._end(task, self._endings.refuse(task, refused))
        else:
            self._resend(flight)

    def _divide(self, flight: Flight, cuts: tuple[int, ...]) -> None:
        """Send the parts of a task; it is sent again when all of them have been done, and joins them."""
        key = flight.key
        del self._flying[key]
        self._cuts[key] = cuts
        for rows in pairwise(cuts):
            need = memory_needed(flight.due.task, self._endings.campaign, rows)
            part = Flight(flight.due, need, rows)
            self._flying[part.key] = part
            self._ahead[key].add(part.key)
            self._behind[part.key] = [key]
            self._resend(part)

    def _give_up(self, flight: Flight, error: BaseException | None) -> Refused | None:
        """Log an attempt that failed; return a refusal where it was the last, raise what is a fault of ours."""
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
        if error is not None and not isinstance(error, (KilledWorker, NotShared, OSError)):
            raise error
        key = flight.due.task.key
        return Refused(
            Problem(
                "E_WORKER",
                f"{key.object}/{key.layer} {key.stage} failed on every worker that it was sent to",
                found="; ".join(
                    f"{one['worker']}, {one['peak'] / 1e9:.1f} GB: {one['why']}"
                    for one in flight.attempts
                ),
                fix="See to those machines, then build again: what is done is kept.",
            )
        )

    def _mend(self, flight: Flight, damaged: tuple[str, ...], name: str) -> Iterator[Step]:
        """Do a task again whose products are damaged, and then the one that would read them."""
        key = next(k for k in self._graph if (k.object, k.camera, k.setup, k.stage) == damaged)
        task = flight.due.task
        self._redone[key] += 1
        if self._redone[key] > RETRIES:
            problem = Problem("E_DAMAGED", "a file is damaged whenever it is written", found=name)
            yield from self._end(task, self._endings.refuse(task, Refused(problem)))
            return
        self._ahead[task.key].add(key)
        self._behind.setdefault(key, []).append(task.key)
        del self._flying[flight.key]
        if flight.part:  # what it lacks is made when all are joined
            self._release(flight.key)
        if key not in self._flying:
            due = self._endings.due(self._graph[key])
            yield from self._begin(due._replace(why=f"{name} was damaged"))

    def _commit(self, flight: Flight) -> Iterator[Step]:
        """Record what a task made, as its receipt says."""
        task, records = flight.due.task, self._records
        receipt = read_receipt(receipt_path(records, task.key, flight.part))
        if receipt.get("made of") != digest(flight.due.prints):
            if again := self._give_up(flight, NotShared("the receipt is not seen here")):
                yield from self._end(task, self._endings.refuse(task, again))
            else:
                self._resend(flight)
            return
        flight.ended("done")
        if flight.part and not is_refused(receipt):
            self._tried.setdefault(task.key, []).extend(flight.attempts)
            del self._flying[flight.key]
            self._release(flight.key)
            return
        try:
            if is_refused(receipt):
                problems = (Problem(**problem) for problem in receipt["refused"])
                step = self._endings.refuse(task, Refused(*problems))
            else:
                for part, folder in (
                    ("files", self._places.output),
                    ("aside", self._places.kept),
                ):
                    for name, entry in receipt[part].items():
                        records.hashes.take(folder / name, entry)
                self._drop_parts(task.key)
                step = self._endings.keep(
                    flight.due,
                    written_of(receipt, self._places),
                    seconds=receipt["seconds"],
                    attempts=flight.attempts,
                )
        except Refused as error:
            step = self._endings.refuse(task, error)
        for suffix in (RECEIPT, ASKED):
            remove(records.path_of(task.key, suffix))
        yield from self._end(task, step)

    def _end(self, task: Task, step: Step) -> Iterator[Step]:
        yield self._endings.end(task, step)
        self._cuts.pop(task.key, None)
        mine = [flight for flight in self._flying.values() if flight.due.task.key == task.key]
        for flight in mine:  # parts too, where one of them was refused
            del self._flying[flight.key]
            if flight.future is not None and flight.future.status == "pending":
                self._cluster.client.cancel([flight.future])
        if step.state == "refused" and not {p.code for p in step.problems} & MENDED_ELSEWHERE:
            self._drop_parts(task.key)
        self._release(task.key)

    def _drop_parts(self, key: Key) -> None:
        folder = self._records.path_of(key, PARTS)
        if folder.is_dir():
            remove(folder)

    def _release(self, key: Key) -> None:
        """Let go what waited for a task."""
        for other in self._behind.pop(key, ()):
            self._ahead[other].discard(key)
            if not self._ahead[other]:
                heapq.heappush(self._ready, self._numbers[other])

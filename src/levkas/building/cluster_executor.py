"""The executor of a graph on a cluster: a task is sent when all that it reads has ended and a worker is idle.

`graphlib` keeps what waits for what. dask chooses the worker, keeps the memory of each, gives a task another
where one is lost, and tries it again where it failed. No more tasks are sent than workers are idle: a worker
begins at once with the next that it has, and would let go of the cubes that one not yet sent reads.
dask's hints (`workers=`, `allow_other_workers`) are not used: where the worker is lost dask overlooks what memory the
task needs, and gives it to no worker that comes later. This process alone records what was made; frames are
hashed ahead, and pages written, in a thread each.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from graphlib import TopologicalSorter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from distributed import Future
from distributed.scheduler import KilledWorker, NoValidWorkerError, NoWorkerError

from levkas.building.build_records import CATALOGUE
from levkas.building.cluster import Cluster, no_workers_s
from levkas.building.fingerprints import of_calibration
from levkas.building.graph import Graph, Step, Task, captures_of
from levkas.building.outcomes import Due, Outcomes
from levkas.building.worker import PATIENCE_S, Job, TaskResult, code_digest, digest_of
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

REDONE = 3
"""Times that a task is done again because its products are damaged."""
NEAR = 0.8
"""Share of a worker's memory from which its end is put down to want of memory; dask ends it at 0.95."""
BASE, STREAMED = 200e6, 1.5e9
"""Bytes that a process takes before it reads a frame, and those of a scan whose rows are resampled."""
WITHOUT_WORKER_S = 10.0
"""How long there may be no worker before that is reported; a restart takes seconds."""
LOOK_S = 1.0
"""How long to wait for news before the workers are counted."""


def memory_needed(task: Task, campaign: Campaign) -> float:
    """Return the bytes that a task takes at least: its cube, and that of its reference beside it."""
    calibrates = task.key.stage == "calibrate"
    captures = {id(c): c for c in captures_of(task)[: 1 if calibrates else 2]}
    least = 0.0 if calibrates else STREAMED
    return BASE + sum(
        max(
            max(least, bytes_of_pass(part))
            if is_streamed(part, campaign)
            else CUBE_BYTES * count_values(part, campaign.cameras[part.camera].kind)
            for part in c.tiles or (c,)
        )
        for c in captures.values()
    )


def hash_key(key: Key) -> Key:
    """Return the key under which a calibration waits for its frames to be hashed."""
    return replace(key, stage="hash")


def sorter_of(graph: Graph, tasks: Iterable[Task]) -> TopologicalSorter[Key]:
    """Return what each task waits for.

    That is what it reads, what comes before it of its capture and of its object's reference, and of a
    calibration `hash_key`. Where the reference is lost nothing else of its object is begun, as in
    one process.
    """
    wanted = {task.key for task in tasks}
    sorter: TopologicalSorter[Key] = TopologicalSorter()
    before: dict[tuple[str, str], list[Key]] = {}
    for key, task in graph.items():
        if key not in wanted:
            continue
        ahead = [k for k in (*task.needs, *task.uses) if k in wanted]
        if task.capture is not None:
            for capture in captures_of(task):
                ahead += before.get((capture.object, capture.layer), ())
            before.setdefault((key.object, key.layer), []).append(key)
        if key.stage == "calibrate":
            ahead.append(hash_key(key))
        sorter.add(key, *ahead)
    sorter.prepare()
    return sorter


@dataclass
class Flight:
    """A task that waits for a worker, or is sent to one.

    Parameters
    ----------
    due : Due
    need : float
        Bytes of memory.
    """

    due: Due
    need: float
    future: Future | None = None
    on: str = ""
    """The worker that has begun it."""
    frames: int = 0
    sent: int = 0
    landed: float = 0.0
    """When its result was first here."""
    attempts: list[dict[str, Any]] = field(default_factory=list)
    """Worker and peak of private memory, bytes, of every time that it was begun."""

    @property
    def key(self) -> Key:
        """Of the task."""
        return self.due.task.key


class ClusterExecutor:
    """Runs the tasks of captures on a cluster, and says how each ends; as `Executor` does in one process."""

    def __init__(self, outcomes: Outcomes, cluster: Cluster, path: Path) -> None:
        self._outcomes, self._records, self._cluster = outcomes, outcomes.records, cluster
        self._graph, self._places = outcomes.graph, outcomes.places
        self._path = path
        self._order = {key: place for place, key in enumerate(self._graph)}
        self._waiting: dict[Key, Flight] = {}
        self._flying: dict[Key, Flight] = {}
        self._behind: dict[Key, list[Key]] = {}
        """Tasks that wait for another to be done again."""
        self._redone: Counter[Key] = Counter()
        self._last: dict[str, Key] = {}
        """What each worker has done last, and may hold cubes of."""
        self._there: list[str] = []
        self._counted = 0.0
        self._alone_since, self._is_reported = time.monotonic(), False

    def run(
        self, tasks: Sequence[Task], write_page: Callable[[Task], Iterable[Step]]
    ) -> Iterator[Step]:
        """Yield each task as it begins and as it ends; `tasks` are all, but for the catalogue.

        `write_page` writes the page of an object or of a camera.
        """
        self._write_page = write_page
        self._sorter = sorter_of(self._graph, tasks)
        with (
            ThreadPoolExecutor(1, thread_name_prefix="pages") as self._pages,
            ThreadPoolExecutor(1, thread_name_prefix="hashing") as self._hasher,
        ):
            try:
                self._alone_since = time.monotonic()
                shown_where = ""
                while self._sorter.is_active():
                    for step in (
                        *self._take_up(),
                        *self._send(),
                        *self._last_events(),
                        *self._alone(),
                    ):
                        shown_where = self.where
                        of_capture = step.key.object and step.key.camera
                        yield replace(step, where=shown_where) if of_capture else step
                    if shown_where != self.where and (
                        first := next(iter(self._flying.values()), None)
                    ):
                        shown_where = self.where
                        yield Step(first.key, "running", first.due.why, where=shown_where)
            finally:
                for pool in (self._hasher, self._pages):
                    pool.shutdown(wait=False, cancel_futures=True)
        for folder in (self._places.output, self._places.kept):
            sweep(folder)  # what lost workers have left
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
        text = counted(len(self._there), "worker")
        room = self._room(self._idle())
        large = [flight.key for flight in self._unbegun() if flight.need > room]
        if not room or not large:
            return text
        more = f" and {len(large) - 1} more wait" if len(large) > 1 else " waits"
        return f"{text}, {large[0].object}/{large[0].layer}{more} for memory"

    def _idle(self) -> list[str]:
        """Return the workers that are there and have no task that has begun."""
        busy = {flight.on for flight in self._flying.values()}
        return [worker for worker in self._there if worker not in busy]

    def _unbegun(self) -> list[Flight]:
        return [f for f in (*self._waiting.values(), *self._flying.values()) if not f.on]

    def _room(self, workers: Iterable[str]) -> float:
        """Return the memory, bytes, of the largest of some workers."""
        return max((self._cluster.sizes[worker] for worker in workers), default=0.0)

    # --- tasks that wait for no other -----------------------------------------------------------

    def _take_up(self) -> Iterator[Step]:
        """Take up what waits for no other any more, until all that is left waits for workers or threads."""
        while ready := self._sorter.get_ready():
            for key in ready:
                if key in self._graph:
                    yield from self._take(key)
                else:
                    self._beside(self._hasher, key, partial(self._hash, key))

    def _beside(self, pool: ThreadPoolExecutor, key: Key, make: Callable[[], Any]) -> None:
        """Do something in a thread and wake the one that runs the graph."""
        put, running = self._cluster.events.put, pool.submit(make)
        running.add_done_callback(lambda steps: put({"ended": key, "steps": steps}))

    def _hash(self, key: Key) -> list[Step]:
        """Hash the frames of a calibration; one that cannot be read is met again by that."""
        capture, _ = captures_of(self._graph[replace(key, stage="calibrate")])
        with suppress(Exception):
            of_calibration(self._outcomes.campaign, capture, self._records.hashes)
        return []

    def _take(self, key: Key) -> Iterator[Step]:
        """Have a task done that waits for no other; a page is written at once, and what is fresh ends."""
        task = self._graph[key]
        if task.capture is None:
            self._beside(self._pages, key, lambda: list(self._write_page(task)))
        elif (key.object, key.layer) in self._outcomes.lost:
            self._done(key)
        elif (step := self._outcomes.without_reference(task)) is not None:
            yield self._outcomes.note(step)
            self._done(key)
        elif (due := self._outcomes.due(task)).why:
            self._await_worker(due)
        else:
            yield from self._end(task, self._outcomes.fresh(key))

    def _await_worker(self, due: Due) -> None:
        """Have a task wait until a worker is idle that has the memory."""
        self._outcomes.begin(due.task)
        need = memory_needed(due.task, self._outcomes.campaign)
        self._waiting[due.task.key] = Flight(due, need)

    def _done(self, key: Key) -> None:
        """Let go what waited for a task; one that is done again was waited for before."""
        if key not in self._redone:
            self._sorter.done(key)

    def _end(self, task: Task, step: Step) -> Iterator[Step]:
        yield self._outcomes.note(self._outcomes.end(task, step))
        self._waiting.pop(task.key, None)
        flight = self._flying.pop(task.key, None)
        if flight is not None and flight.future is not None:
            flight.future.release()
        self._done(task.key)
        for key in self._behind.pop(task.key, ()):
            yield from self._take(key)

    # --- sending --------------------------------------------------------------------------------

    def _send(self) -> Iterator[Step]:
        """Give every idle worker the task of those that fit it of which it holds most; refuse what fits on none."""
        most = max(self._cluster.sizes.values(), default=float("inf"))
        for flight in [f for f in self._waiting.values() if f.need > most]:
            yield from self._refuse(flight, self._too_large(flight, most))
        held = {self._last[worker].object for worker in self._there if worker in self._last}
        idle = self._idle()
        free = len(idle) - sum(not flight.on for flight in self._flying.values())
        for worker in idle[: max(free, 0)]:
            room = self._room([worker])
            if fit := [flight for flight in self._waiting.values() if flight.need <= room]:
                flight = min(fit, key=partial(self._rank, self._last.get(worker), held))
                self._launch(flight)
                if flight.sent == 1:
                    yield Step(flight.key, "running", flight.due.why)

    def _rank(self, last: Key | None, held: set[str], flight: Flight) -> tuple[int, int]:
        """Order tasks for a worker by what it has done last.

        It goes on with the capture whose cubes it holds, then with the object whose reference it
        holds, then with an object that no worker holds; after that it helps the others.
        """
        key = flight.key
        if last is not None and last.object == key.object:
            return int(last.layer != key.layer), self._order[key]
        return 2 + (key.object in held), self._order[key]

    def _launch(self, flight: Flight) -> None:
        task, key = flight.due.task, flight.key
        reads = {k: self._graph[k] for k in (*task.needs, *task.uses)}
        job = Job(
            campaign=str(self._path),
            output=str(self._places.output),
            build=self._cluster.build,
            key=key,
            task=digest_of(task),
            reads={k: self._records.sent(k) for k, one in reads.items() if one.capture is not None},
            code=code_digest(),
        )
        self._flying[key] = self._waiting.pop(key)
        flight.sent += 1
        name = f"levkas-{self._cluster.build}-{self._order[key]}-{flight.sent}"
        flight.future = self._cluster.send(name, job, flight.need, -self._order[key])

    def _take_back(self, flight: Flight) -> None:
        """Have a task that was sent wait for a worker again."""
        flight.future, flight.on = None, ""
        self._waiting[flight.key] = self._flying.pop(flight.key)

    def _refuse(self, flight: Flight, refused: Refused) -> Iterator[Step]:
        yield from self._end(flight.due.task, self._outcomes.refuse(flight.due.task, refused))

    def _too_large(self, flight: Flight, most: float) -> TooLarge:
        capture, _ = captures_of(flight.due.task)
        return TooLarge(
            Problem(
                "E_MEMORY",
                f"{capture.object}/{capture.layer} {flight.key.stage} fits on no worker",
                file=str(capture.sensors[0].object[0].path),
                field=f"cameras.{capture.camera}",
                found=f"{most / 1e9:.1f} GB on the largest of {len(self._cluster.sizes)} workers",
                expected=f"at least {flight.need / 1e9:.1f} GB",
                fix="Add a worker with more memory, or start fewer workers per machine.",
            )
        )

    def _lost(self, flight: Flight, why: str = "", died: int = 0) -> Refused:
        """Return the refusal of a task that failed wherever it was tried.

        Of workers that `died`, some may not have reported yet that they had begun it.
        """
        sizes, tried = self._cluster.sizes, []
        for worker, peak in ((one["worker"], one["peak"]) for one in flight.attempts):
            starved = peak > NEAR * sizes.get(worker, float("inf"))
            end = why or ("it ran out of memory" if starved else "it was lost")
            tried.append(f"{worker}, {peak / 1e9:.1f} GB: {end}")
        tried += ["a worker that had reported nothing: it was lost"] * (died - len(tried))
        key = flight.key
        return Refused(
            Problem(
                "E_WORKER",
                f"{key.object}/{key.layer} {key.stage} failed on every worker that tried it",
                found="; ".join(tried) or why or "workers were lost before they began",
                fix="Check those machines, then build again. Finished stages are kept.",
            )
        )

    # --- hearing --------------------------------------------------------------------------------

    def _last_events(self) -> Iterator[Step]:
        """Take what workers say and what has ended; wait a second at most for the first of it."""
        events = self._cluster.next_events(LOOK_S)
        for one in events:
            if "bytes" in one:
                self._cluster.learn(one)
            elif "begun" in one:
                self._note_begun(one)
            elif "ended" in one:
                yield from one["steps"].result()
                self._sorter.done(one["ended"])
        now = time.monotonic()
        if now - self._counted > LOOK_S or any("bytes" in one for one in events):
            self._there = self._cluster.workers()
            self._counted = now
        for flight in list(self._flying.values()):
            if self._there and flight.on not in self._there:
                flight.on = ""  # dask gives it another worker
            yield from self._look_after(flight, now)

    def _note_begun(self, begun: dict[str, Any]) -> None:
        """Note where a task is done and how far it is; each attempt begins without a frame."""
        for key, flight in self._flying.items():
            if flight.future is not None and flight.future.key == begun["begun"]:
                if not begun["peak"]:
                    flight.attempts.append({"worker": begun["on"], "peak": 0})
                    flight.on, flight.frames = begun["on"], 0
                    self._last[flight.on] = key
                self._note_progress(flight, begun["peak"], begun["frames"])

    def _note_progress(self, flight: Flight, peak: int, frames: int) -> None:
        if flight.attempts:
            flight.attempts[-1]["peak"] = max(flight.attempts[-1]["peak"], peak)
        FRAMES.add(max(0, frames - flight.frames))
        flight.frames = max(frames, flight.frames)

    def _look_after(self, flight: Flight, now: float) -> Iterator[Step]:
        """Take what has ended, and refuse what dask has tried again in vain; have sent again what the scheduler has lost."""
        assert flight.future is not None
        status = flight.future.status
        error = flight.future.exception() if status == "error" else None
        if status == "finished":
            yield from self._landed(flight, now)
        elif error is not None and not isinstance(error, NoWorkerError | NoValidWorkerError):
            if isinstance(error, KilledWorker):
                lost = self._lost(flight, died=error.allowed_failures + 1)
            else:
                lost = self._lost(flight, str(error))
            yield from self._refuse(flight, lost)
        elif status != "pending":
            self._take_back(flight)

    def _landed(self, flight: Flight, now: float) -> Iterator[Step]:
        """Record what a task made, as soon as its files are visible here."""
        assert flight.future is not None
        if (result := self._cluster.result(flight.future)) is None:
            return
        if not result.is_visible:
            flight.landed = flight.landed or now
            if now - flight.landed > PATIENCE_S:
                why = "the result is not visible on this machine"
                yield from self._refuse(flight, self._lost(flight, why))
            return
        task, hashes = flight.due.task, self._records.hashes
        self._note_progress(flight, result.peak, result.frames)
        if result.damaged is not None:
            yield from self._mend(flight, result)
            return
        try:
            if result.refused is not None:
                raise result.refused
            assert result.written is not None
            for path, entry in result.entries.items():
                hashes.take(path, entry)
            other = result.instructions != instructions_in_use()
            notes = {"seconds": result.seconds, "attempts": flight.attempts}
            notes |= {"instructions": result.instructions} if other else {}
            step = self._outcomes.keep(flight.due, result.written, **notes)
        except Refused as error:
            step = self._outcomes.refuse(task, error)
        yield from self._end(task, step)

    def _mend(self, flight: Flight, result: TaskResult) -> Iterator[Step]:
        """Do a task again whose products are damaged, and then the one that would read them."""
        key, refused = result.damaged, result.refused
        assert key is not None and refused is not None
        self._redone[key] += 1
        if self._redone[key] > REDONE:
            yield from self._refuse(flight, refused)
            return
        self._take_back(flight)
        del self._waiting[flight.key]
        self._behind.setdefault(key, []).append(flight.key)
        if key not in self._waiting and key not in self._flying:
            why = f"{refused.problems[0].found} was damaged"
            self._await_worker(self._outcomes.due(self._graph[key])._replace(why=why))

    def _alone(self) -> Iterator[Step]:
        """Report once that no worker can go on; after a time refuse what waits for memory.

        Raises ClusterRefused where there was no worker at all for so long.
        """
        now, room = time.monotonic(), self._room(self._there)
        begun, unbegun = any(f.on for f in self._flying.values()), self._unbegun()
        large = [flight for flight in unbegun if flight.need > room]
        if room and (begun or not large or len(large) < len(unbegun)):
            self._alone_since, self._is_reported = now, False
            return
        alone, patience = now - self._alone_since, no_workers_s()
        if alone > patience and not room:
            raise self._cluster.without_workers(patience)
        if alone > patience:
            for flight in large:
                yield from self._refuse(flight, self._too_large(flight, room))
        elif alone >= WITHOUT_WORKER_S and not self._is_reported:
            self._is_reported = True
            key = next((k for k in self._graph if k not in self._outcomes.ended), CATALOGUE)
            lacking = "there is no worker with the memory" if room else "there is no worker"
            yield Step(key, "waiting", f"{lacking}; it ends after {patience:g} s without one")

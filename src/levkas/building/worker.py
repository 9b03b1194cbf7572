"""A worker of a cluster: does one task by its key, with files on a file system that all share.

What a task made is written under its own names, and listed in what the worker hands back; the client that
sent the task records it. Nothing but keys, records and short texts passes the network.
"""

from __future__ import annotations

import hashlib
import os
import platform
import threading
import time
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

from levkas import __version__
from levkas.building.build_records import BuildRecords, Key
from levkas.building.graph import Graph, Task
from levkas.building.outcomes import refusal_of
from levkas.building.plan import read_plan
from levkas.building.tasks import Damaged, Stages
from levkas.core.digests import hash_file, stamp_of
from levkas.core.instructions import describe_instructions, instructions_in_use
from levkas.core.internal_errors import InternalError
from levkas.core.machine import MEMORY, THREADS, keep_memory, memory_bytes
from levkas.core.problems import Problem, Refused
from levkas.core.progress import FRAMES
from levkas.database.layout import Places
from levkas.stages.sources import STAGES, code_version
from levkas.stages.template_cache import TemplateCache
from levkas.stages.written import Written

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

PATIENCE_S, PAUSE_S = 60.0, 0.5
"""How long a shared file system may take to show what another machine wrote (NFS: up to 60 s)."""
SAMPLED_S, REPORTED_S = 0.05, 1.0
"""Between two looks at the memory of a task, and at most so often its frames are reported."""


class NotShared(Exception):
    """What another machine wrote is not visible here."""


class NotWanted(Exception):
    """Nobody waits for the task any more."""


@dataclass(frozen=True)
class Job:
    """One task as it is sent: some kilobytes.

    Parameters
    ----------
    campaign, output : str
        Paths, the same on all machines.
    build : str
        Name of the build that sends it.
    key : Key
    task : str
        `digest_of` the task.
    reads : dict of Key to record
        Tasks whose products it reads, and what is recorded of each.
    code : str
        `code_digest()` of the client.
    """

    campaign: str
    output: str
    build: str
    key: Key
    task: str
    reads: Mapping[Key, Mapping[str, Any]]
    code: str


@dataclass(frozen=True)
class TaskResult:
    """What a task made, or why it was refused, or whose products it cannot read.

    Parameters
    ----------
    written : Written, optional
    refused : Refused, optional
    damaged : Key, optional
        Of a task whose products must be made anew before this one can be done; `refused` says of which file.
    entries : dict of Path to entry
        Stamp and SHA-256 of every file that was written.
    instructions : str
        That the numerical libraries used.
    seconds : float
    peak : int
        Private bytes.
    frames : int
        That were read.
    """

    written: Written | None = None
    refused: Refused | None = None
    damaged: Key | None = None
    entries: Mapping[Path, list[Any]] = field(default_factory=dict)
    instructions: str = ""
    seconds: float = 0.0
    peak: int = 0
    frames: int = 0

    @property
    def is_visible(self) -> bool:
        """Whether all files are on this machine as they were written."""
        try:
            return all(
                [*stamp_of(path)] == entry[:-1] or hash_file(path) == entry[-1]
                for path, entry in self.entries.items()
            )
        except OSError:
            return False


@cache
def code_digest() -> str:
    """Hash the code of all stages, the versions of the libraries that compute among it."""
    return hashlib.sha256(repr([code_version(stage) for stage in STAGES]).encode()).hexdigest()


def digest_of(task: Task) -> str:
    """Hash what a task is done with: files, roles, bands and what it reads."""
    return hashlib.sha256(repr(task).encode()).hexdigest()


@cache
def facts() -> dict[str, Any]:
    """Return what the numbers of this process rest on."""
    import numpy as np

    used = describe_instructions()
    return {
        "levkas": __version__,
        "code": code_digest(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "BLAS": used["blas"],
        "instruction set": f"{used['level']}: numpy {used['numpy']}, opencv {used['opencv']}",
        "pid": os.getpid(),
    }


def prepare(threads: int, memory: float | None) -> float:
    """Set threads and memory of this process, where the machine's own variables do not; return its bytes."""
    keep_memory()
    os.environ.setdefault(THREADS, str(max(1, threads)))
    if memory:
        os.environ.setdefault(MEMORY, f"{memory / 1e9:.6f}")
    return float(memory or memory_bytes()[0])


# --- one task -----------------------------------------------------------------------------------

_alone = threading.Lock()
_workplaces: dict[str, Workplace] = {}


def work(job: Job, say: Callable[[int, int], object], is_wanted: Callable[[], bool]) -> TaskResult:
    """Do a task.

    Parameters
    ----------
    job : Job
    say : callable
        Called with the peak of private memory, bytes, and the number of frames that were read: as the task
        begins, and then whenever the first has grown by a quarter, or the second at all within the last second.
    is_wanted : callable
        Tells, just before anything is written, whether somebody still waits for the task.

    Raises
    ------
    NotShared, NotWanted, OSError
        Where another attempt may do.
    """
    with _alone, Watch(say) as watch:
        if job.code != code_digest():
            raise NotShared(
                f"levkas {__version__} or its libraries differ from those of the client"
            )
        if job.build not in _workplaces:
            _workplaces.clear()
            _workplaces[job.build] = Workplace.open(job)
        started = time.monotonic()
        try:
            result = _workplaces[job.build].do(job, is_wanted)
        except NotShared:
            _workplaces.clear()  # the campaign is read again
            raise
        seconds = round(time.monotonic() - started, 2)
        return replace(result, seconds=seconds, peak=watch.bytes, frames=watch.frames)


@dataclass
class Workplace:
    """A campaign, its graph and the stages that compute, kept from one task of a build to the next."""

    records: BuildRecords
    graph: Graph
    stages: Stages
    sound: dict[Key, Mapping[str, Any]] = field(default_factory=dict)
    """Paths and hashes of what tasks made that was read whole here, or written."""

    @classmethod
    def open(cls, job: Job) -> Workplace:
        """Read a campaign as the client has read it."""
        plan = read_plan(job.campaign)
        places = Places(Path(job.output))
        # Without what is kept: over a share a worker could undo what the client is just writing.
        records = BuildRecords(places.kept, places.output, verify=True)
        digests = records.hashes.of_frame if len(plan.names) > 1 else None
        templates = TemplateCache(places.kept / "templates", digests)
        return cls(
            records, plan.graph, Stages(plan.campaign, places, records, templates, plan.graph)
        )

    def do(self, job: Job, is_wanted: Callable[[], bool]) -> TaskResult:
        """Do a task and return what it made, or why it was refused."""
        task = self.graph.get(job.key)
        if task is None or digest_of(task) != job.task:
            raise NotShared(f"{job.key}: this worker reads different files than the client")

        def require_wanted() -> None:
            if not is_wanted():
                raise NotWanted(str(job.key))

        try:
            self._take(job.reads)
            written = self.stages.compute(task)(require_wanted)
            written = written._replace(files=list(written.files))
            entries = {p: [*stamp_of(p), hash_file(p)] for p in (*written.files, *written.aside)}
        except (NotShared, NotWanted, OSError):
            raise
        except Exception as error:
            refused = refusal_of(task, error)
            if not isinstance(refused, InternalError):
                refused = Refused(*refused.problems)  # others need not be known where it is read
            return TaskResult(None, refused, error.key if isinstance(error, Damaged) else None)
        self.sound[job.key] = {str(p): entry[-1] for p, entry in entries.items()}
        return TaskResult(written, entries=entries, instructions=instructions_in_use())

    def _take(self, reads: Mapping[Key, Mapping[str, Any]]) -> None:
        """Take the records of what a task reads, and read all of that once; wait until it is visible here."""
        until = time.monotonic() + PATIENCE_S
        for key, record in reads.items():
            self.records.take(key, record)
            recorded = self.records.hashes_of(key)
            while self.sound.get(key) != recorded and (name := self.records.damaged(key)):
                if time.monotonic() > until:
                    raise Damaged(key, Problem("E_DAMAGED", "a file was damaged", found=name))
                time.sleep(PAUSE_S)
            self.sound[key] = recorded


class Watch:
    """Looks every 50 ms how much private memory, bytes, this process has and how many frames it has read."""

    def __init__(self, say: Callable[[int, int], object]) -> None:
        self.bytes = 0
        self._before = FRAMES.count
        self._say = say
        self._ended = threading.Event()

    @property
    def frames(self) -> int:
        """How many were read since the block began."""
        return FRAMES.count - self._before

    def __enter__(self) -> Watch:
        self._say(0, 0)
        self._thread = threading.Thread(target=self._look, name="memory", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        process, reported, counted, when = psutil.Process(), 0, 0, time.monotonic()
        while True:
            found = process.memory_info()
            self.bytes = max(self.bytes, found.rss - getattr(found, "shared", 0))
            frames, now = self.frames, time.monotonic()
            if self.bytes > 1.25 * reported or (frames > counted and now - when >= REPORTED_S):
                reported, counted, when = max(reported, self.bytes), frames, now
                self._say(self.bytes, frames)
            if self._ended.wait(SAMPLED_S):
                return

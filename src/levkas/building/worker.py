"""A worker of a cluster: does one task by its key, with files on a file system that all share.

What a task made is written under its own names, and listed in a receipt beside the records; the client
that sent the task reads that and records it. Nothing but keys and short texts passes the network.
"""

from __future__ import annotations

import hashlib
import os
import platform
import threading
import time
from dataclasses import dataclass, field
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
from levkas.core.files import make_folder, write_json
from levkas.core.instructions import describe_instructions, instructions_in_use
from levkas.core.internal_errors import InternalError
from levkas.core.machine import MEMORY, THREADS, keep_memory, memory_bytes
from levkas.core.problems import Problem, Refused
from levkas.core.progress import FRAMES
from levkas.core.text import read_json
from levkas.database.layout import Places
from levkas.stages.sources import STAGES, code_version
from levkas.stages.template_cache import TemplateCache
from levkas.stages.written import Written

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

ASKED, RECEIPT = ".asked", ".made"
"""Suffixes beside a stage's record: what a client waits for, and what a worker made of it."""
PATIENCE_S, PAUSE_S = 60.0, 0.2
"""How long a shared file system may take to show what another machine wrote (NFS: up to 60 s)."""
SAMPLED_S, TOLD_S = 0.05, 1.0
"""Between two looks at the memory of a task, and at most so often its frames are reported."""


class NotShared(Exception):
    """What another machine wrote is not seen here."""


class NoLongerAsked(Exception):
    """Nobody waits for the task any more, or what it is made of has changed since."""


@dataclass(frozen=True)
class Job:
    """One task as it is sent: a few hundred bytes.

    Parameters
    ----------
    campaign, output : str
        Paths, the same on all machines.
    build : str
        Name of the build that asks.
    key : tuple of str
        Object, camera, setup and stage.
    made_of : str
        Hash of the task's fingerprint.
    task : str
        `digest_of` the task.
    reads : tuple of (key, str)
        Tasks whose products it reads, and the hash of the record of each.
    code : str
        `code_digest()` of the client.
    verify : bool
        Hash frames anew.
    """

    campaign: str
    output: str
    build: str
    key: tuple[str, ...]
    made_of: str
    task: str
    reads: tuple[tuple[tuple[str, ...], str], ...]
    code: str
    verify: bool = False


@cache
def code_digest() -> str:
    """Hash the code of all stages, the versions of the libraries that compute among it."""
    return hashlib.sha256(repr([code_version(stage) for stage in STAGES]).encode()).hexdigest()


def digest_of(task: Task) -> str:
    """Hash what a task is done with: files, roles, bands and what it reads."""
    return hashlib.sha256(repr(task).encode()).hexdigest()


@cache
def facts() -> dict[str, Any]:
    """Return what the numbers of this process rest on, and the bytes that it may take."""
    used = describe_instructions()
    return {
        "levkas": __version__,
        "code": code_digest(),
        "python": platform.python_version(),
        "numpy": _numpy_version(),
        "BLAS": used["blas"],
        "instruction set": f"{used['level']}: numpy {used['numpy']}, opencv {used['opencv']}",
        "pid": os.getpid(),
    }


def _numpy_version() -> str:
    import numpy as np

    return np.__version__


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


def work(job: Job, say: Callable[[int, int], object]) -> dict[str, Any]:
    """Do a task and leave a receipt, unless that is there already.

    Parameters
    ----------
    job : Job
    say : callable
        Called with the peak of private memory, bytes, and the number of frames that were read: whenever
        the first has grown by a quarter, or the second at all within the last second.

    Returns
    -------
    told : dict
        ``peak``: private bytes; ``frames`` that were read; ``damaged``: the key of a task whose products
        must be made anew, and the name of the file, where one was.

    Raises
    ------
    NotShared, NoLongerAsked, OSError
        Where another attempt may do.
    """
    with _alone, Watch(say) as watch:
        if job.code != code_digest():
            raise _other_version(job)
        workplace = _workplace(job)
        try:
            workplace.do(job)
        except Damaged as error:
            return {"damaged": _tuple(error.key), "name": str(error.problems[0].found)}
        return {"peak": watch.bytes, "frames": watch.frames}


def _workplace(job: Job) -> Workplace:
    """Return what all tasks of a build share, read once a build."""
    if job.build not in _workplaces:
        _workplaces.clear()
        _workplaces[job.build] = Workplace.open(job)
    return _workplaces[job.build]


@dataclass
class Workplace:
    """A campaign, its graph and the stages that compute, kept from one task of a build to the next."""

    places: Places
    records: BuildRecords
    graph: Graph
    stages: Stages
    sound: set[tuple[Key, str]]
    """Tasks, by key and record, whose products were read whole here and are what was written."""
    written: dict[Key, dict[str, str]] = field(default_factory=dict)
    """Products that were written here, by name, and their hashes: what is held of them need not be read."""

    @classmethod
    def open(cls, job: Job) -> Workplace:
        """Read a campaign as the client has read it."""
        plan = read_plan(job.campaign)
        places = Places(Path(job.output))
        records = BuildRecords(places.kept, places.output, verify=job.verify)
        digests = records.hashes.of_frame if len(plan.names) > 1 else None
        templates = TemplateCache(places.kept / "templates", digests)
        stages = Stages(plan.campaign, places, records, templates, plan.graph)
        return cls(places, records, plan.graph, stages, set())

    def do(self, job: Job) -> None:
        """Do a task, and leave a receipt of what it made or of why it was refused."""
        task = self.graph.get(Key(*job.key))
        if task is None or digest_of(task) != job.task:
            raise NotShared(
                f"{'/'.join(job.key)}: this worker reads different files than the client"
            )
        path = self.records.path_of(task.key, RECEIPT)
        if is_whole(read_receipt(path), job.made_of, self.places):
            return
        self._await(job)
        started = time.monotonic()
        try:
            write = self.stages.compute(task)
            receipt = receipt_of(write(lambda: self._require_asked(job, task.key)), self.places)
            self.written[task.key] = {n: e[-1] for n, e in receipt.get("files", {}).items()}
        except (Damaged, NotShared, NoLongerAsked, OSError):
            raise
        except Exception as error:
            receipt = receipt_of_refusal(refusal_of(task, error))
        self._require_asked(job, task.key)
        make_folder(path.parent)
        seconds = round(time.monotonic() - started, 2)
        write_json(path, {**receipt, "made of": job.made_of, "seconds": seconds})

    def _await(self, job: Job) -> None:
        """Wait until what the task reads is seen here, and read all of it once."""
        until = time.monotonic() + PATIENCE_S
        for name, check in job.reads:
            key = Key(*name)
            self.records.reread(key)
            while self.records.check(key) != check:
                if time.monotonic() > until:
                    raise NotShared(f"{'/'.join(name)}: its record is not visible on this worker")
                time.sleep(PAUSE_S)
                self.records.reread(key)
            if (key, check) not in self.sound:
                here = self.written.get(key)
                if here and here == self.records.products(key):
                    continue
                if damaged := self.records.damaged(key):
                    raise Damaged(key, Problem("E_DAMAGED", "a file was damaged", found=damaged))
                self.sound.add((key, check))

    def _require_asked(self, job: Job, key: Key) -> None:
        """Raise NoLongerAsked where a later build has taken over, or has done without."""
        try:
            asked = self.records.path_of(key, ASKED).read_text(encoding="utf-8")
        except OSError as error:
            raise NoLongerAsked("/".join(job.key)) from error
        if asked != job.made_of:
            raise NoLongerAsked("/".join(job.key))


def receipt_of(made: Written, places: Places) -> dict[str, Any]:
    """Return what a task made: files with stamp and hash, notes, warnings, problems."""
    return {
        "files": {str(p.relative_to(places.output).as_posix()): _entry(p) for p in made.files},
        "aside": {str(p.relative_to(places.kept).as_posix()): _entry(p) for p in made.aside},
        "notes": made.notes,
        "warnings": list(made.warnings),
        "problems": [problem.to_dict() for problem in made.problems],
        "instructions": instructions_in_use(),
    }


def receipt_of_refusal(refused: Refused) -> dict[str, Any]:
    """Return the receipt of a refused task."""
    report = {"report": refused.report} if isinstance(refused, InternalError) else {}
    return {"refused": [problem.to_dict() for problem in refused.problems], **report}


def refusal_in(receipt: Mapping[str, Any]) -> Refused:
    """Return the refusal that a receipt of a refused task holds."""
    problems = [Problem(**problem) for problem in receipt["refused"]]
    report = receipt.get("report", "")
    return InternalError(*problems, report=report) if report else Refused(*problems)


def is_refused(receipt: Mapping[str, Any]) -> bool:
    """Tell whether a receipt is of a refused task."""
    return "refused" in receipt


def read_receipt(path: Path) -> dict[str, Any]:
    """Read a receipt; empty where there is none that can be read."""
    try:
        found = read_json(path)
    except (Refused, OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def is_whole(receipt: Mapping[str, Any], made_of: str, places: Places) -> bool:
    """Return whether a receipt belongs to the task, and its files are as written."""
    if receipt.get("made of") != made_of or is_refused(receipt):
        return False
    try:
        return all(
            hash_file(folder / name) == entry[-1]
            for part, folder in (("files", places.output), ("aside", places.kept))
            for name, entry in receipt[part].items()
        )
    except OSError:
        return False


def written_of(receipt: Mapping[str, Any], places: Places) -> Written:
    """Return what a task made, of its receipt."""
    return Written(
        [places.output / name for name in receipt["files"]],
        dict(receipt["notes"]),
        tuple(places.kept / name for name in receipt["aside"]),
        tuple(receipt["warnings"]),
        tuple(Problem(**problem) for problem in receipt["problems"]),
    )


def _entry(path: Path) -> list[Any]:
    return [*stamp_of(path), hash_file(path)]


def _tuple(key: Key) -> tuple[str, ...]:
    return key.object, key.camera, key.setup, key.stage


def _other_version(job: Job) -> NotShared:
    return NotShared(f"levkas {__version__} or its libraries differ from those of the client")


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
        self._thread = threading.Thread(target=self._look, name="memory", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        process, said, counted, when = psutil.Process(), 0, 0, time.monotonic()
        while True:
            found = process.memory_info()
            self.bytes = max(self.bytes, found.rss - getattr(found, "shared", 0))
            frames, now = self.frames, time.monotonic()
            if self.bytes > 1.25 * said or (frames > counted and now - when >= TOLD_S):
                said, counted, when = max(said, self.bytes), frames, now
                self._say(self.bytes, frames)
            if self._ended.wait(SAMPLED_S):
                return

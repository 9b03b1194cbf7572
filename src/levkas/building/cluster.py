"""A cluster of dask.distributed: its scheduler, of this machine or another, and what its workers are."""

from __future__ import annotations

import asyncio
import logging
import queue
import secrets
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import dask
from dask.utils import parse_timedelta
from distributed import Client, Future, LocalCluster, Worker, get_worker
from distributed.core import Status, rpc
from distributed.security import Security

from levkas.core.machine import THREADS, count_threads, memory_bound
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.building.worker import Job, TaskResult

SLOT, BYTES = "levkas", "levkas-memory"
"""Resources of a worker: one task of ours at a time, and the memory that it may take, bytes."""
ALONE = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
"""Of workers of this machine: nothing that could be spilled is held, no page is served."""
RETRIES = 3
"""Times that dask does a task again that failed; its own setting, 3, counts the workers that a task may lose."""
NO_WORKERS_S = 300.0
"""How long a build waits for a first or another worker."""
ANSWER_S, LEAVE_S = 30.0, 5.0
"""How long to wait for the scheduler's answer to a question, as dask does for a connection; and at the end."""
LIMITS = (
    THREADS, "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)  # fmt: skip

CERTIFICATES = [
    f"DASK_DISTRIBUTED__COMM__TLS__{part}" for part in ("CA_FILE", "CLIENT__CERT", "CLIENT__KEY")
]
"""Variables of dask's configuration for the files of a client."""


class ClusterRefused(Refused):
    """A cluster that cannot be used."""


# --- where the workers are ----------------------------------------------------------------------


def check_address(address: str, *, insecure: bool = False) -> None:
    """Refuse a scheduler that is reached unencrypted and is not of this machine; raises ClusterRefused.

    dask runs what it is sent: whoever reaches an open scheduler commands all its workers.
    """
    text = address if "://" in address else f"tcp://{address}"
    try:
        parts = urlsplit(text)
        host, port = parts.hostname or "", parts.port
    except ValueError:
        parts, host, port = urlsplit("tcp://"), "", None
    if parts.scheme not in ("tcp", "tls", "ws", "wss", "ucx") or not host or port is None:
        raise ClusterRefused(
            Problem(
                "E_VALUE",
                "this is not the address of a scheduler",
                field="--cluster",
                found=address,
                expected="tcp://HOST:PORT or tls://HOST:PORT",
            )
        )
    if parts.scheme in ("tls", "wss") or insecure or _is_loopback(host):
        return
    raise ClusterRefused(
        Problem(
            "E_INSECURE",
            "the connection to the scheduler is not encrypted; anyone with access to it can run "
            "programs on all its workers",
            field="--cluster",
            found=address,
            expected="an address of this machine (through an ssh tunnel, say), or tls://",
            fix="See docs/howto/cluster.md. On a trusted network, use --insecure.",
        )
    )


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


@contextmanager
def connected(address: str | None, workers: int, *, insecure: bool = False) -> Iterator[Cluster]:
    """Connect to a scheduler, or start `workers` processes on this machine; all ends with the block.

    Raises
    ------
    ClusterRefused
        Where the address may not be used, or nobody answers there.
    """
    from levkas.building.worker import facts

    if address:
        check_address(address, insecure=insecure)
    logging.getLogger("distributed").setLevel(logging.ERROR)
    with ExitStack() as stack:
        if address:
            cluster = Cluster(str(address))
        else:
            with ThreadPoolExecutor(1, thread_name_prefix="starting") as starter:
                starting = starter.submit(_start_here, workers)
                stack.callback(lambda: starting.exception() or starting.result().close())
                facts()  # while the workers load the same
            try:
                here = starting.result()
            except Exception as error:  # whatever ends a process as it starts
                raise ClusterRefused(_not_started(workers, error)) from error
            cluster = Cluster(here.scheduler_address, here.security)
        stack.callback(cluster.close)
        yield cluster


def _start_here(workers: int) -> LocalCluster:
    """Start workers that share this machine; every connection is encrypted with a key of its own.

    The loopback interface is open to all who are logged in, and dask runs what it is sent.
    """
    threads = max(1, count_threads() // workers)
    with dask.config.set(ALONE):
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,  # what dask balances by: a worker does one task at a time
            memory_limit=int(memory_bound() / workers),
            host="127.0.0.1",
            security=Security.temporary(),
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
            silence_logs=logging.ERROR,
            env=dict.fromkeys(LIMITS, str(threads)),
        )


def _not_started(workers: int, error: Exception) -> Problem:
    return Problem(
        "E_CLUSTER",
        "the worker processes of this machine did not start",
        field="--workers",
        found=f"{workers} workers: {type(error).__name__}: {error}"[:300],
        expected="processes that stay",
        fix="Use fewer workers, or --workers 0 for a single process; `levkas doctor` checks the machine.",
    )


def no_workers_s() -> float:
    """Return how long, s, a build waits for a first or another worker: dask's own setting, where it is set."""
    found = dask.config.get("distributed.scheduler.no-workers-timeout", None)
    return NO_WORKERS_S if found is None else float(parse_timedelta(found))


@dataclass
class Cluster:
    """A scheduler and the facts of its workers.

    Parameters
    ----------
    address : str
    security : Security, optional
        Certificates of a scheduler that Levkas has started for this build; else those of dask's own configuration.
    """

    address: str
    security: Security | None = None
    build: str = field(default_factory=lambda: secrets.token_hex(6))
    sizes: dict[str, float] = field(default_factory=dict)
    """Bytes of every worker that ever was there, by address."""
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)
    events: queue.SimpleQueue[dict[str, Any]] = field(default_factory=queue.SimpleQueue)
    """What workers say, and what wakes the thread that waits for that."""
    _client: Client | None = None

    @property
    def client(self) -> Client:
        """The connection, made anew where it was given up; raises ClusterRefused where nobody answers."""
        if self._client is None or self._client.status in ("closed", "closing"):
            try:
                with ThreadPoolExecutor(1) as apart:  # a notebook has a loop of its own
                    apart.submit(asyncio.run, self._greet()).result()
                self._client = Client(
                    self.address, security=self.security, timeout=ANSWER_S, set_as_default=False
                )
            except Exception as error:  # whatever comes of the bytes of another server
                raise ClusterRefused(_no_answer(self.address, error)) from error
        return self._client

    async def _greet(self) -> None:
        """Ask a scheduler who it is: a client would wait for ever for one that holds the connection and says nothing."""
        arguments = (self.security or Security()).get_connection_args("client")
        async with asyncio.timeout(ANSWER_S), rpc(self.address, connection_args=arguments) as other:
            await other.identity()

    def workers(self) -> list[str]:
        """Return the addresses of the workers that are prepared; have the others limit their threads and say what they are.

        Raises ClusterRefused where one cannot.
        """
        client, topic = self.client, f"levkas-{self.build}"
        try:
            identity = client.sync(
                client.scheduler.identity, n_workers=-1, callback_timeout=ANSWER_S
            )
            there = {one: BYTES in of["resources"] for one, of in identity["workers"].items()}
            if new := [one for one, has in there.items() if not has or one not in self.facts]:
                client.subscribe_topic(topic, lambda event: self.events.put(dict(event[1])))
                client.run(_prepare, topic, workers=new, wait=False)
        except (OSError, TimeoutError):
            return []  # it is away: tried again in a second
        except Exception as error:  # whatever a worker raises that cannot load Levkas
            raise ClusterRefused(_not_prepared(self.address, error)) from error
        return [one for one in there if one not in new]

    def learn(self, reported: dict[str, Any]) -> None:
        """Take what a worker says of itself; raises ClusterRefused where its code is another one."""
        from levkas.building.worker import code_digest, facts

        worker = reported["worker"]
        self.sizes[worker], self.facts[worker] = float(reported["bytes"]), reported
        if reported["code"] != code_digest():
            mine = facts()
            unlike = [n for n in ("levkas", "numpy") if reported[n] != mine[n]] or ["levkas"]
            raise ClusterRefused(
                Problem(
                    "E_VERSION",
                    f"the worker {worker} has a different version of Levkas or of its libraries",
                    field="--cluster",
                    found=", ".join(f"{name} {reported[name]}" for name in unlike),
                    expected=", ".join(f"{name} {mine[name]}" for name in unlike),
                    fix="Install the same requirements.lock on all machines.",
                )
            )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What workers and this process differ in, and what they compute may in its last bits."""
        from levkas.building.worker import facts

        differences, mine = [], facts()
        for name in ("python", "numpy", "BLAS", "instruction set"):
            kinds = Counter(str(one[name]) for one in self.facts.values())
            if kinds.keys() - {str(mine[name])}:
                each = "; ".join(f"{count} of {kind}" for kind, count in sorted(kinds.items()))
                differences.append(
                    f"the workers differ in {name}: {each}; this machine has {mine[name]}"
                )
        return tuple(differences)

    def send(self, name: str, job: Job, need: float, priority: int) -> Future:
        """Send a task to a worker that has the memory; dask chooses one that is idle, and another where that is lost."""
        future = self.client.submit(
            _do,
            job,
            key=name,
            resources={SLOT: 1, BYTES: need},
            retries=RETRIES,
            priority=priority,
        )
        future.add_done_callback(lambda _: self.events.put({}))
        return future

    def next_events(self, patience_s: float) -> list[dict[str, Any]]:
        """Return what workers have reported and what has ended; wait for the first of it."""
        try:
            events = [self.events.get(timeout=patience_s)]
        except queue.Empty:
            return []
        while not self.events.empty():
            events.append(self.events.get())
        return events

    def result(self, future: Future) -> TaskResult | None:
        """Return what a task has made; None where the scheduler cannot say it now."""
        try:
            made: TaskResult = future.result(timeout=ANSWER_S)
        except (TimeoutError, CancelledError):
            return None
        return made

    def without_workers(self, patience_s: float) -> ClusterRefused:
        """Return the refusal of a build for which there was no worker for so long."""
        here = self.security is not None
        fix = (
            "Use fewer workers, or --workers 0 for a single process."
            if here
            else f"Start one: dask worker {self.address}; where jobs wait longer in a queue, set "
            "DASK_DISTRIBUTED__SCHEDULER__NO_WORKERS_TIMEOUT=2h."
        )
        return ClusterRefused(
            Problem(
                "E_CLUSTER",
                "there are no workers",
                field="--workers" if here else "--cluster",
                found=f"none at {self.address} for {patience_s:g} s",
                expected="one or more workers",
                fix=f"{fix} Finished stages are kept.",
            )
        )

    def close(self) -> None:
        """Leave the cluster as it was found."""
        if self._client is not None:
            with suppress(Exception):  # it may have gone first
                self._client.close(timeout=LEAVE_S)


def _no_answer(address: str, error: Exception) -> Problem:
    if isinstance(error, TypeError):
        return Problem(
            "E_CLUSTER",
            "a scheduler with TLS needs certificates, and none are set",
            field="--cluster",
            found=address,
            expected=" ".join(CERTIFICATES),
            fix="Set these variables to the files; see docs/howto/cluster.md.",
        )
    first = next(iter(str(error).splitlines()), type(error).__name__)
    return Problem(
        "E_CLUSTER",
        "the scheduler does not answer",
        field="--cluster",
        found=f"{address}: {first}",
        expected="a scheduler of dask",
        fix="Start `dask scheduler` and `dask worker` there. Finished stages are kept.",
    )


def _not_prepared(address: str, error: Exception) -> Problem:
    return Problem(
        "E_VERSION",
        "a worker cannot be prepared",
        field="--cluster",
        found=f"{address}: {type(error).__name__}: {error}"[:300],
        expected="workers on which this version of Levkas is installed",
        fix="Install the same requirements.lock on all machines, and start the workers again.",
    )


# --- on a worker --------------------------------------------------------------------------------


async def _prepare(topic: str, dask_worker: Worker) -> None:
    """Prepare a worker: threads, memory, resources; and have it say what it is."""
    from levkas.building.worker import facts, prepare

    size = prepare(dask_worker.state.nthreads, dask_worker.memory_manager.memory_limit)
    reported = await asyncio.to_thread(facts)
    await dask_worker.set_resources(**{SLOT: 1, BYTES: size})
    if dask_worker.status == Status.running:
        # dask gives a worker what waits for one as it begins to run, which was before it had resources.
        dask_worker.status = Status.paused
        dask_worker.status = Status.running
    dask_worker.log_event(topic, {"worker": dask_worker.address, "bytes": size, **reported})


def _do(job: Job) -> TaskResult:
    """Do a task on a worker, and say there that it has begun and how far it is; raises RuntimeError."""
    from levkas.building.worker import work

    worker = get_worker()
    name = worker.get_current_task()

    def say(peak: int, frames: int) -> None:
        reported = {"begun": name, "on": worker.address, "peak": peak, "frames": frames}
        worker.log_event(f"levkas-{job.build}", reported)

    def is_wanted() -> bool:
        state = worker.state.tasks.get(name)
        return state is not None and state.state == "executing"

    try:
        return work(job, say, is_wanted)
    except Exception as error:
        # As words: an error that cannot be pickled ends the thread of the client that hears of it.
        raise RuntimeError(f"{type(error).__name__}: {error}") from None

"""A cluster of dask.distributed: its scheduler, of this machine or another, and what its workers are."""

from __future__ import annotations

import asyncio
import logging
import queue
import secrets
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import dask
from dask.utils import parse_timedelta
from distributed import Client, Future, LocalCluster, WorkerPlugin, get_worker
from distributed.core import rpc
from distributed.security import Security

from levkas.core.machine import THREADS, count_threads, memory_bound
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.building.worker import Job

SLOT, BYTES = "levkas", "levkas-memory"
"""Resources of a worker: one task of ours at a time, and the memory that it may take, bytes."""
ALONE = {
    "distributed.scheduler.allowed-failures": 0,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
"""Of workers of this machine: every loss is heard of, nothing that could be spilled is held, no page is served."""
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
                _load()  # while the workers load the same
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
            threads_per_worker=threads,
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


def bounded(call: Callable[..., Any], *given: Any, patience_s: float | None = None) -> Any:
    """Return what a call to the scheduler returns; raises TimeoutError where it takes too long.

    dask waits for ever for a scheduler that holds the connection and says nothing.
    """
    answers: queue.SimpleQueue[tuple[bool, Any]] = queue.SimpleQueue()

    def ask() -> None:
        try:
            answers.put((True, call(*given)))
        except BaseException as error:  # raised where it was asked for
            answers.put((False, error))

    threading.Thread(target=ask, name="asking", daemon=True).start()
    try:
        well, answer = answers.get(timeout=ANSWER_S if patience_s is None else patience_s)
    except queue.Empty:
        raise TimeoutError("the scheduler gives no answer") from None
    if not well:
        raise answer
    return answer


def no_workers_s() -> float:
    """Return how long, s, a build waits for a first or another worker: dask's own setting, where it is set."""
    found = dask.config.get("distributed.scheduler.no-workers-timeout", None)
    return NO_WORKERS_S if found is None else float(parse_timedelta(found))


async def _greet(address: str, security: Security | None) -> None:
    """Ask a scheduler who it is; a client that does not come about would hold the process for a minute."""
    arguments = (security or Security()).get_connection_args("client")
    async with rpc(address, connection_args=arguments) as scheduler:
        await scheduler.identity()


def _load() -> None:
    """Load what a client of a cluster needs, and read the code of the stages."""
    from levkas.building.worker import code_digest, facts

    code_digest()
    facts()


@dataclass
class Cluster:
    """A scheduler and the facts of its workers.

    Parameters
    ----------
    address : str
    security : Security, optional
        Certificates; else those of dask's own configuration.
    """

    address: str
    security: Security | None = None
    build: str = field(default_factory=lambda: secrets.token_hex(6))
    sizes: dict[str, float] = field(default_factory=dict)
    """Bytes of every worker that was ever seen, by address."""
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)
    events: queue.SimpleQueue[Any] = field(default_factory=queue.SimpleQueue)
    _client: Client | None = None
    _scheduler: str = ""
    _prepared: set[str] = field(default_factory=set)

    @property
    def is_here(self) -> bool:
        """Whether Levkas has started it, on this machine and for this build."""
        return self.security is not None

    @property
    def client(self) -> Client:
        """The connection, made anew where it was given up; raises ClusterRefused where nobody answers."""
        if self._client is None or self._client.status in ("closed", "closing"):
            try:
                bounded(lambda: asyncio.run(_greet(self.address, self.security)))
                connect = partial(Client, self.address, set_as_default=False)
                self._client = bounded(partial(connect, security=self.security))
            except TypeError as error:
                raise ClusterRefused(
                    Problem(
                        "E_CLUSTER",
                        "a scheduler with TLS needs certificates, and none are set",
                        field="--cluster",
                        found=self.address,
                        expected=" ".join(CERTIFICATES),
                        fix="Set these variables to the files; see docs/howto/cluster.md.",
                    )
                ) from error
            except Exception as error:  # whatever comes of the bytes of another server
                first = next(iter(str(error).splitlines()), type(error).__name__)
                raise ClusterRefused(
                    Problem(
                        "E_CLUSTER",
                        "the scheduler does not answer",
                        field="--cluster",
                        found=f"{self.address}: {first}",
                        expected="a scheduler of dask",
                        fix="Start `dask scheduler` and `dask worker` there. Finished stages are kept.",
                    )
                ) from error
        return self._client

    def greet(self) -> None:
        """Have every worker, also those that come later, limit its threads and say what it is."""
        topic = f"levkas-{self.build}"
        client = self.client
        with suppress(OSError, TimeoutError):  # it is away: asked again in a second
            scheduler = bounded(partial(client.scheduler_info, n_workers=0)).get("id", "")
            if scheduler and scheduler != self._scheduler:
                self._prepared.clear()
                client.subscribe_topic(topic, self._hear)
                try:
                    bounded(partial(client.register_plugin, Greeting(topic), name=topic))
                except (OSError, TimeoutError):
                    raise
                except Exception as error:  # whatever a worker raises that cannot load Levkas
                    raise ClusterRefused(_not_prepared(self.address, error)) from error
                self._scheduler = scheduler

    def _hear(self, event: Any) -> None:
        told = event[1] if isinstance(event, tuple) else event
        self.events.put(dict(told))

    def learn(self, told: dict[str, Any]) -> None:
        """Take what a worker says of itself; raises ClusterRefused where its code is another one."""
        from levkas.building.worker import code_digest, facts

        worker = told["worker"]
        self.sizes[worker], self.facts[worker] = float(told["bytes"]), told
        self._prepared.add(worker)
        if told["code"] != code_digest():
            mine = facts()
            unlike = [n for n in ("levkas", "numpy") if told[n] != mine[n]] or ["levkas"]
            raise ClusterRefused(
                Problem(
                    "E_VERSION",
                    f"the worker {worker} has a different version of Levkas or of its libraries",
                    field="--cluster",
                    found=", ".join(f"{name} {told[name]}" for name in unlike),
                    expected=", ".join(f"{name} {mine[name]}" for name in unlike),
                    fix="Install the same requirements.lock on all machines.",
                )
            )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What workers and this process differ in, and what they compute may in its last bits."""
        from levkas.building.worker import facts

        told, mine = [], facts()
        for name in ("python", "numpy", "BLAS", "instruction set"):
            kinds = Counter(str(one[name]) for one in self.facts.values())
            if kinds.keys() - {str(mine[name])}:
                each = "; ".join(f"{count} of {kind}" for kind, count in sorted(kinds.items()))
                told.append(f"the workers differ in {name}: {each}; this machine has {mine[name]}")
        return tuple(told)

    def workers(self) -> list[str]:
        """Return the addresses of the workers that are there and prepared."""
        try:
            return [one for one in bounded(self.client.nthreads) if one in self._prepared]
        except (OSError, TimeoutError):
            return []

    def send(self, job: Job, need: float, attempt: int, worker: str) -> Future:
        """Send a task to a worker, or another where that one is lost; its result is a few words."""
        name = "-".join(part for part in (*job.key, job.build, str(attempt)) if part)
        return self.client.submit(
            _do,
            job,
            key=name,
            resources={SLOT: 1, BYTES: need},
            workers=[worker],
            allow_other_workers=True,
            retries=0,
            pure=False,
        )

    def without_workers(self, patience_s: float) -> ClusterRefused:
        """Return the refusal of a build for which there was no worker for so long."""
        fix = (
            f"Start one: dask worker {self.address}; where jobs wait longer in a queue, set "
            "DASK_DISTRIBUTED__SCHEDULER__NO_WORKERS_TIMEOUT=2h. Finished stages are kept."
        )
        if self.is_here:
            fix = (
                "Use fewer workers, or --workers 0 for a single process. Finished stages are kept."
            )
        problem = Problem(
            "E_CLUSTER",
            "there are no workers",
            field="--workers" if self.is_here else "--cluster",
            found=f"none at {self.address} for {patience_s:g} s",
            expected="one or more workers",
            fix=fix,
        )
        return ClusterRefused(problem)

    def cancel(self, futures: Iterable[Future]) -> None:
        """Take back tasks that were sent; a scheduler that is gone has none."""
        with suppress(Exception):
            bounded(self.client.cancel, list(futures))

    def close(self) -> None:
        """Leave the cluster as it was found."""
        client = self._client
        if client is not None:
            with suppress(Exception):  # it may have gone first
                bounded(client.unregister_worker_plugin, f"levkas-{self.build}", patience_s=LEAVE_S)
            with suppress(Exception):
                client.close(timeout=LEAVE_S)


def _not_prepared(address: str, error: Exception) -> Problem:
    return Problem(
        "E_VERSION",
        "a worker cannot be prepared",
        field="--cluster",
        found=f"{address}: {type(error).__name__}: {error}"[:300],
        expected="workers on which this version of Levkas is installed",
        fix="Install the same requirements.lock on all machines, and start the workers again.",
    )


class Greeting(WorkerPlugin):  # type: ignore[misc]
    """Prepares a worker: threads, memory, resources; and says what it is."""

    def __init__(self, topic: str) -> None:
        self.topic = topic

    async def setup(self, worker: Any) -> None:
        """Prepare a worker that is there, or that has just come."""
        from levkas.building.worker import facts, prepare

        size = prepare(worker.state.nthreads, worker.memory_manager.memory_limit)
        told = await asyncio.to_thread(facts)
        await worker.set_resources(**{SLOT: 1, BYTES: size})
        worker.log_event(self.topic, {"worker": worker.address, "bytes": size, **told})


def _do(job: Job) -> dict[str, Any]:
    """Do a task on a worker, and say there that it has begun and how far it is."""
    from levkas.building.worker import work

    worker = get_worker()
    topic, name = f"levkas-{job.build}", list(job.key)

    def say(peak: int, frames: int) -> None:
        told = {"begun": name, "on": worker.address, "peak": peak, "frames": frames}
        worker.log_event(topic, told)

    say(0, 0)
    return {**work(job, say), "on": worker.address}

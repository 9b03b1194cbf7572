"""Objects side by side: each worker of dask.distributed does the ordinary build of one object, and its steps come back by value.

Pages that objects share, catalogue and manifest are written by the one that asked for it, who builds once more: of what the
workers did all is fresh. A worker that dies costs its object's present stage; the object is given to another one.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building.claiming import claim, places_of
from levkas.building.plan import Plan, plan_of
from levkas.building.run import build
from levkas.campaign.campaign import load_campaign
from levkas.core.instructions import HELD
from levkas.core.machine import MEMORY, THREADS, count_threads, memory_bound
from levkas.core.problems import Problem, Refused
from levkas.stages.sources import made_with

if TYPE_CHECKING:
    from distributed import Client, Future

    from levkas.building.build_records import Key
    from levkas.building.graph import Step

PATIENCE_S, PAUSE_S = 30.0, 1.0
"""Without a single worker a build ends after so long: a worker that was killed is started again within a few seconds."""
RETRIES = 2
"""Of an object whose worker raised what is no refusal."""
BYTES_OF_ONE = 4.5
"""Of a calibrated value, its flags and its sigma, nine, for a byte of a frame of two bytes a value."""
RESOURCE = "MEMORY"
"""Name of the resource of dask, in bytes, where workers declare it: ``dask worker ADDRESS --resources MEMORY=64e9``."""


def build_on(
    workers: str,
    path: str | Path,
    *,
    output: str | Path | None = None,
    objects: list[str] | None = None,
    verify: bool = False,
) -> Iterator[Step]:
    """Build the database of a campaign as `build` does, its objects on workers; yield the steps of each object when it is done.

    `workers` is a number of processes of this machine, or the address of a scheduler, whose workers reach the same folders by
    the same names. Raises Refused, as `build` does, and where there is no worker or the last one has gone: what was done stays.
    """
    campaign = load_campaign(path)
    places, whole = places_of(campaign, output), plan_of(campaign)
    plan = whole.of(objects) if objects else whole
    claim(campaign, places, whole.captures, whole.names)
    names = sorted({key.object for key, task in plan.graph.items() if task.capture})
    numbers = {key: number for number, key in enumerate(plan.graph, 1)}
    done: dict[Key, Step] = {}
    with _connected(workers, len(names)) as client:
        resources = _resources(client, plan, names)
        wanted = [str(campaign.path), str(places.output), verify]
        jobs = {
            name: client.submit(
                _build_object, *wanted, name,
                key=f"levkas {name} {time.time_ns()}", retries=RETRIES, resources=resources[name],
            )
            for name in names
        }  # fmt: skip
        for steps in _results(client, jobs):
            for step in steps:
                done[step.key] = step
                place = numbers.get(step.key, 0)
                yield replace(step, done=len(done), total=len(numbers), place=place)
    for step in build(path, output=output, objects=objects, again=False):
        known = done.get(step.key)
        if known is None or step.state not in ("fresh", known.state):
            yield step


def _build_object(path: str, output: str, verify: bool, name: str) -> list[Step]:
    """Do on a worker what a build of one object does that no other object reads; return how its stages ended."""
    steps = build(path, output=output, objects=[name], verify=verify, alone=True)
    return [step for step in steps if step.finished]


def _results(client: Client, jobs: Mapping[str, Future]) -> Iterator[list[Step]]:
    """Yield the steps of each object when its worker has done it; raise what was refused when all others are done."""
    from distributed import wait

    waiting, problems = set(jobs.values()), list[Problem]()
    last = time.monotonic()
    while waiting:
        with suppress(TimeoutError):
            wait(waiting, timeout=PAUSE_S, return_when="FIRST_COMPLETED")
        if client.status == "running" and client.scheduler_info(n_workers=-1)["workers"]:
            last = time.monotonic()
        for name, job in jobs.items():
            if job in waiting and job.done() and job.status != "cancelled":
                waiting.discard(job)
                if job.status == "finished":
                    yield job.result()
                else:
                    problems += _problems_of(name, job.exception())
        if waiting and time.monotonic() - last > PATIENCE_S:
            raise _refusal("the last worker has gone", f"{len(waiting)} objects not built", GO_ON)
    if problems:
        raise Refused(*dict.fromkeys(problems))


GO_ON = "Start workers, then run the build again: it goes on where this one ended."


def _problems_of(name: str, error: BaseException) -> list[Problem]:
    if isinstance(error, Refused):
        return list(error.problems)
    found = f"{type(error).__name__}: {error}".splitlines()[0]
    fix = f"Build it by itself to see why: levkas build … --object {name}"
    return list(_refusal(f"{name} was not built: its worker failed", found, fix).problems)


def _refusal(message: str, found: object, fix: str) -> Refused:
    return Refused(Problem("E_REMOTE", message, field="--workers", found=found, fix=fix))


@contextmanager
def _connected(workers: str, most: int) -> Iterator[Client]:
    """Give a client of as many processes as there are objects at most, or of the scheduler at an address, once it has a worker."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        fix = "Run: pip install 'levkas[cluster]'"
        raise _refusal("workers need the package distributed", "not installed", fix) from None
    if not workers.isdecimal():
        with _client_of(Client, workers) as client:
            _require_alike(client)
            yield client
        return
    count = max(1, min(int(workers), most))
    share = {
        THREADS: str(ceil(count_threads() / count)),
        MEMORY: str(memory_bound() / count / 1e9),
    }
    with (
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
            env=share,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def _client_of(client_class: type[Client], address: str) -> Iterator[Client]:
    try:
        client = client_class(address, timeout=PATIENCE_S)
    except (OSError, TimeoutError, ValueError) as error:
        fix = "Give the address that `dask scheduler` prints, such as tcp://HOST:8786."
        raise _refusal("no scheduler answers", f"{address}: {error}", fix) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE_S)
        except TimeoutError:
            raise _refusal("the scheduler has no workers", address, GO_ON) from None
        yield client


def _require_alike(client: Client) -> None:
    """Refuse workers of another version, or with other instruction sets: what they make would be stale here."""
    mine = made_with()
    for worker, theirs in client.run(made_with).items():
        if theirs != mine:
            raise _refusal(
                "a worker has another version of Levkas or of a library, or other instruction sets",
                worker,
                "Install the same versions there, and start it with the variables of this machine: "
                f"{' '.join(f'{k}={os.environ[k]!r}' for k in (*HELD, 'OPENCV_CPU_DISABLE') if k in os.environ)}",
            )


def _resources(client: Client, plan: Plan, names: list[str]) -> dict[str, dict[str, Any] | None]:
    """Return what each object needs of the workers' memory, where they declare any: that of its largest capture."""
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    if not any(RESOURCE in worker.get("resources", {}) for worker in workers):
        return dict.fromkeys(names)
    sizes = {
        (capture.object, capture.layer): sum(
            path.stat().st_size
            for path in {frame.path for sensor in capture.sensors for frame in sensor.object}
            if path.is_file()
        )
        for capture in plan.captures
    }
    return {
        name: {RESOURCE: BYTES_OF_ONE * max(size for (o, _), size in sizes.items() if o == name)}
        for name in names
    }

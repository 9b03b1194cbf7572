"""A build on workers: the database of a build in one process, whatever comes to an end meanwhile."""

import contextlib
import json
import os
import queue
import random
import signal
import socket
import subprocess
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

import dask
import distributed.comm.tcp
import psutil
import pytest
import tifffile
from distributed import Nanny, Scheduler, SpecCluster
from typer.testing import CliRunner

from levkas.building import (
    build,
    cluster,
    cluster_executor,
    summarise,
    worker,
)
from levkas.building.build_records import BuildRecords, Key
from levkas.cli import app
from levkas.core.digests import hash_tree, stamp_of
from levkas.core.files import PARTIAL
from levkas.core.problems import Refused
from levkas.core.progress import FRAMES
from levkas.stages import scans, streaming

LARGEST_MESSAGE = 256_000
"""Bytes: what the page of a registration shows passes, and no pixels."""
BUILD = "from levkas.cli import main; main()"


@pytest.fixture(autouse=True)
def no_scheduler(monkeypatch):
    monkeypatch.delenv("DASK_SCHEDULER_ADDRESS", raising=False)


@pytest.fixture(scope="module")
def campaign(make_plates, tmp_path_factory):
    """A campaign of two objects."""
    return make_plates(tmp_path_factory.mktemp("plates") / "campaign")


@pytest.fixture(scope="module")
def plates(campaign):
    """The campaign; its database as one process builds it, the steps, and the frames read."""
    before, folder = FRAMES.count, campaign
    report = summarise(build(folder, workers=0))
    assert report.ok
    return folder, hash_tree(folder / "database"), report, FRAMES.count - before


@pytest.fixture
def messages(monkeypatch):
    """The bytes of every message that this process, its scheduler's, has sent or received."""
    sizes = []
    write, read = distributed.comm.tcp.to_frames, distributed.comm.tcp.from_frames

    async def written(*args, **options):
        frames = await write(*args, **options)
        sizes.append(sum(memoryview(frame).nbytes for frame in frames))
        return frames

    async def taken(frames, **options):
        sizes.append(sum(memoryview(frame).nbytes for frame in frames))
        return await read(frames, **options)

    monkeypatch.setattr(distributed.comm.tcp, "to_frames", written)
    monkeypatch.setattr(distributed.comm.tcp, "from_frames", taken)
    return sizes


def workers_of(process=None):
    found = (process or psutil.Process()).children(recursive=True)
    return [one for one in found if any("spawn_main" in part for part in one.cmdline())]


def partial_files(folder):
    return [p for p in folder.rglob("*") if PARTIAL.fullmatch(p.name)]


def _waits_for_memory(where):
    """Whether a line says so of an infrared capture, of one object or of both: which, is a matter of moments."""
    return "/infrared" in where and where.endswith(("waits for memory", "more wait for memory"))


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, pytest.param(3, marks=pytest.mark.exhaustive)])
def test_the_bytes_are_those_of_one_process_in_any_order(
    count, plates, messages, tmp_path, monkeypatch
):
    folder, expected, alone, plates_read = plates
    run = cluster_executor.ClusterExecutor.run

    def shuffled(self, tasks, write_page):
        yield from run(self, random.Random(count).sample(tasks, len(tasks)), write_page)

    monkeypatch.setattr(cluster_executor.ClusterExecutor, "run", shuffled)
    steps, listening, frames = [], set(), FRAMES.count
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # of a large graph, among others
        for step in build(folder, output=tmp_path / "database", workers=count):
            steps.append(step)
            if step.state == "running" and step.key.stage == "resample":
                for process in (psutil.Process(), *workers_of()):
                    held = process.net_connections("inet")
                    listening |= {one.laddr.ip for one in held if one.status == "LISTEN"}
    assert hash_tree(tmp_path / "database") == expected
    # No worker reads a frame twice; two may each read one, where the order gives both a part of its capture.
    assert plates_read <= FRAMES.count - frames <= count * plates_read
    assert listening == {"127.0.0.1"}
    assert messages and max(messages) < LARGEST_MESSAGE
    report = summarise(steps)
    assert [s.to_dict() for s in report.stages] == [s.to_dict() for s in alone.stages]
    assert any(s.where.startswith(f"{count} workers") for s in steps)
    assert not partial_files(tmp_path) and not [*tmp_path.rglob("*.asked")]


@pytest.mark.slow
@pytest.mark.parametrize(
    "streamed",
    [
        pytest.param(False, marks=pytest.mark.exhaustive, id="held"),
        pytest.param(True, id="streamed"),
    ],
)
def test_setups_and_scans_are_those_of_one_process(
    make_every_kind, tmp_path, monkeypatch, streamed
):
    folder = make_every_kind(tmp_path / "campaign", cameras=("photo", "filters", "scan"))
    keys = (folder / "campaign.toml").read_text()
    assert "[setups.raking]" in keys and "[cameras.scan]" in keys
    preload = tmp_path / "preload.py"
    preload.write_text("")
    if streamed:
        preload.write_text(
            "from levkas.stages import scans, streaming\n"
            "scans.STREAMED_SAMPLES, streaming.BUFFER_BYTES = 0, 100_000\n"
        )
        monkeypatch.setattr(scans, "STREAMED_SAMPLES", 0)
        monkeypatch.setattr(streaming, "BUFFER_BYTES", 100_000)
    alone = summarise(build(folder, output=tmp_path / "alone", workers=0))
    with dask.config.set({"distributed.worker.preload": [str(preload)]}):
        report = summarise(build(folder, output=tmp_path / "workers", workers=2))
    assert [s.to_dict() for s in report.stages] == [s.to_dict() for s in alone.stages]
    assert report.ok, report.text
    assert hash_tree(tmp_path / "workers") == hash_tree(tmp_path / "alone")


@pytest.mark.exhaustive
def test_the_line_names_what_waits_for_memory_while_a_worker_is_idle(plates, tmp_path, monkeypatch):
    folder, expected, _, _ = plates
    monkeypatch.setattr(
        cluster_executor,
        "memory_needed",
        lambda task, _: 2e9 if task.key.camera == "infrared" else 1e8,
    )
    with machines("1GB", "4GB") as there:
        address = there.scheduler_address
        steps = list(build(folder, output=tmp_path / "database", cluster=address))
    reported = {s.where for s in steps}
    assert any(one.startswith("2 workers, ") and _waits_for_memory(one) for one in reported)
    assert hash_tree(tmp_path / "database") == expected


def test_a_task_reports_its_frames_within_the_second(monkeypatch):
    monkeypatch.setattr(worker, "REPORTED_S", 0.0)
    reported = queue.SimpleQueue()
    with worker.Watch(lambda *said: reported.put(said)) as watch:
        assert reported.get(timeout=10)[1] == 0
        FRAMES.add(3)
        while (said := reported.get(timeout=10))[1] != 3:
            pass
    assert watch.frames == 3 and 0 < said[0] <= watch.bytes


@pytest.mark.slow
def test_a_killed_client_and_a_killed_worker_cost_only_what_they_were_doing(plates, tmp_path):
    folder, expected, _, _ = plates
    output = tmp_path / "database"
    command = [sys.executable, "-c", BUILD, "build", str(folder), "-o", str(output)]
    with subprocess.Popen(
        [*command, "--workers", "2"], stderr=subprocess.PIPE, text=True
    ) as client:
        done = [next(line for line in client.stderr if "register: done" in line)]
        client.send_signal(signal.SIGKILL)
    steps, killed = [], []
    for step in build(folder, output=output, workers=2):
        steps.append(step)
        if step.state == "done" and step.key.object and not killed:
            killed = workers_of()[:1]
            killed[0].kill()
    assert done and killed
    fresh = [s for s in steps if s.state == "fresh"]
    assert {s.key.stage for s in fresh} >= {"calibrate", "register"}
    assert hash_tree(output) == expected
    assert not partial_files(tmp_path)


@pytest.mark.slow
def test_what_fits_on_no_worker_is_refused_by_name_and_the_rest_goes_on(
    make_plates, tmp_path, monkeypatch
):
    folder = make_plates(tmp_path / "campaign")
    keys = (folder / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(
        keys.replace("infrared/{target}.png", "infrared/{target}.*")
    )
    (folder / "infrared/two.png").unlink()
    tifffile.memmap(folder / "infrared/two.tif", shape=(20_000, 20_000), dtype="u1").flush()
    monkeypatch.setenv("LEVKAS_MEMORY", "4")  # GB, of both
    steps = list(build(folder, workers=2))
    ended = {(s.key.object, s.key.layer, s.key.stage): s for s in steps if s.finished}
    (problem,) = ended["two", "infrared", "calibrate"].problems
    assert problem.code == "E_MEMORY" and "two/infrared" in problem.message
    assert "2.0 GB" in problem.found and "3.8 GB" in problem.expected
    assert not [s for s in steps if s.state == "running" and s.key == ended[
        "two", "infrared", "calibrate"].key]  # fmt: skip
    assert ended["one", "infrared", "resample"].state == "done"
    assert ended["two", "photo", "resample"].state == "done"


@pytest.fixture(params=[b"", b"\0", b"\1"], ids=["silent", "zeros", "ones"])
def drips(request):
    """The address of a server that says nothing, or a byte at a time, and never ends."""
    listening = socket.create_server(("127.0.0.1", 0))
    ended = threading.Event()

    def drip():
        held = []
        with contextlib.suppress(OSError):
            while not ended.is_set():
                listening.settimeout(0.1)
                with contextlib.suppress(TimeoutError):
                    held.append(listening.accept()[0])
                for one in held:
                    one.send(request.param)

    thread = threading.Thread(target=drip)
    thread.start()
    yield f"tcp://127.0.0.1:{listening.getsockname()[1]}"
    ended.set()
    thread.join()
    listening.close()


def test_a_scheduler_that_drips_is_refused_in_bounded_time(campaign, drips, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "ANSWER_S", 1.0)
    with pytest.raises(Refused) as refused:
        list(build(campaign, output=tmp_path / "database", cluster=drips))
    (problem,) = refused.value.problems
    assert problem.code == "E_CLUSTER" and "does not answer" in problem.message


@contextlib.contextmanager
def machines(*limits, preload=(), **settings):
    """A scheduler of this machine with a worker for each limit of memory."""
    settings = {f"distributed.{name.replace('_', '-')}": value for name, value in settings.items()}
    host = {"host": "127.0.0.1"}
    scheduler = {"cls": Scheduler, "options": {**host, "dashboard_address": "127.0.0.1:0"}}
    workers = {
        n: {"cls": Nanny, "options": {**host, "nthreads": 1, "memory_limit": limit}}
        for n, limit in enumerate(limits)
    }
    settings["distributed.worker.preload"] = [str(one) for one in preload]
    with dask.config.set(settings), SpecCluster(workers, scheduler, silence_logs=50) as there:
        yield there


@pytest.mark.slow
def test_a_scheduler_whose_workers_have_gone_is_said_to_be_so_and_refused(
    plates, tmp_path, monkeypatch
):
    monkeypatch.setattr(cluster_executor, "WITHOUT_WORKER_S", 0.5)
    steps = []
    with (
        machines("4GB", **{"scheduler.no_workers_timeout": "3s"}) as there,
        pytest.raises(Refused) as refused,
    ):
        address = there.scheduler_address
        for step in build(plates[0], output=tmp_path / "database", cluster=address):
            steps.append(step)
            if step.state == "done":
                there.scale(0)
    (problem,) = refused.value.problems
    assert problem.code == "E_CLUSTER" and f"dask worker {address}" in problem.fix
    assert "waiting" in {step.state for step in steps}
    report = summarise(build(plates[0], output=tmp_path / "database", workers=0))
    assert report.ok and "fresh" in {step.state for step in report.stages}
    assert hash_tree(tmp_path / "database") == plates[1]


def test_a_scheduler_that_never_had_a_worker_is_said_to_be_so_and_refused(
    campaign, tmp_path, monkeypatch
):
    monkeypatch.setattr(cluster_executor, "WITHOUT_WORKER_S", 0.2)
    monkeypatch.setattr(cluster_executor, "LOOK_S", 0.1)
    steps = []
    with (
        machines(**{"scheduler.no_workers_timeout": "1s"}) as there,
        pytest.raises(Refused) as refused,
    ):
        for step in build(campaign, output=tmp_path / "d", cluster=there.scheduler_address):
            steps.append(step)
    (problem,) = refused.value.problems
    assert (problem.code, problem.field) == ("E_CLUSTER", "--cluster")
    assert [step.state for step in steps] == ["waiting"]


@pytest.mark.slow
def test_what_waits_for_a_worker_that_has_gone_is_refused_in_the_end_and_the_rest_goes_on(
    plates, tmp_path, monkeypatch
):
    monkeypatch.setattr(
        cluster_executor,
        "memory_needed",
        lambda task, _: 2e9 if task.key.camera == "infrared" else 1e8,
    )
    steps = []
    with machines("1GB", "4GB", **{"scheduler.no_workers_timeout": "12s"}) as there:
        for step in build(plates[0], output=tmp_path / "d", cluster=there.scheduler_address):
            steps.append(step)
            if step.state == "running" and step.key.camera == "infrared":
                there.sync(there.workers[1].close)
    problems = {p.message: p for step in steps for p in step.problems}
    assert {p.code for p in problems.values()} == {"E_MEMORY"} and len(problems) == 2
    assert all("1.0 GB" in p.found and "2.0 GB" in p.expected for p in problems.values())
    ended = {(s.key.layer, s.key.stage): s.state for s in steps if s.finished}
    assert ended["photo", "resample"] == "done"
    assert any(_waits_for_memory(s.where) for s in steps)


@pytest.mark.slow
def test_two_builds_share_the_workers_of_one_scheduler(plates, tmp_path):
    outputs = [tmp_path / "first", tmp_path / "second"]

    with machines("4GB", "4GB") as there, ThreadPoolExecutor(2) as clients:
        address = there.scheduler_address
        runs = [
            clients.submit(lambda o: summarise(build(plates[0], output=o, cluster=address)), output)
            for output in outputs
        ]
        assert all(run.result().ok for run in runs)
    assert [hash_tree(output) for output in outputs] == [plates[1]] * 2


@pytest.mark.slow
def test_a_task_that_ends_every_worker_is_refused_by_name_and_the_rest_goes_on(plates, tmp_path):
    preload = tmp_path / "preload.py"
    preload.write_text(
        "import os\n"
        "from levkas.building.tasks import Stages\n"
        "Stages.register = getattr(Stages, 'register', Stages._register)  # dask runs this twice\n"
        "def ends(self, task):\n"
        "    if task.key.layer == 'infrared' and task.key.object == 'one':\n"
        "        os._exit(1)\n"
        "    return self.register(task)\n"
        "Stages._register = ends\n"
    )
    output = tmp_path / "database"
    with machines("4GB", preload=[preload], **{"scheduler.allowed_failures": 1}) as there:
        steps = list(build(plates[0], output=output, cluster=there.scheduler_address))
    ended = {(s.key.object, s.key.layer, s.key.stage): s for s in steps if s.finished}
    step = ended["one", "infrared", "register"]
    assert step.state == "refused" and step.problems[0].code == "E_WORKER"
    assert str(step.problems[0].found).count("it was lost") == 2
    assert ended["two", "infrared", "resample"].state == "done"
    assert summarise(build(plates[0], output=output, workers=0)).ok
    assert hash_tree(output) == plates[1]


@pytest.mark.slow
def test_a_worker_that_does_not_see_what_another_wrote_says_so(plates, tmp_path):
    preload = tmp_path / "preload.py"
    preload.write_text(
        "from levkas.building import worker\nworker.digest_of = lambda task: 'another'\n"
    )
    with machines("4GB", preload=[preload]) as there:
        steps = list(build(plates[0], output=tmp_path / "d", cluster=there.scheduler_address))
    problems = [p for s in steps for p in s.problems if p.code != "E_NO_REFERENCE"]
    assert {p.code for p in problems} == {"E_WORKER"}
    assert all(str(p.found).count("reads different files") == 4 for p in problems)


@pytest.mark.slow
def test_workers_that_die_as_they_start_are_a_refusal(plates, tmp_path):
    preload = tmp_path / "dies.py"
    preload.write_text("import os\nos._exit(3)\n")
    with (
        dask.config.set({"distributed.worker.preload": [str(preload)]}),
        pytest.raises(Refused) as refused,
    ):
        list(build(plates[0], output=tmp_path / "database", workers=1))
    (problem,) = refused.value.problems
    assert (problem.code, problem.field) == ("E_CLUSTER", "--workers")


@pytest.mark.slow
def test_a_second_build_beside_one_with_workers_is_refused_at_once_and_the_first_ends_right(
    plates, tmp_path
):
    output = tmp_path / "database"
    steps = build(plates[0], output=output, workers=1)
    next(steps)
    for workers in (0, 1):
        with pytest.raises(Refused) as refused:
            list(build(plates[0], output=output, workers=workers))
        (problem,) = refused.value.problems
        assert problem.code == "E_BUSY" and f"process {os.getpid()}" in problem.found
    assert summarise(steps).ok
    assert hash_tree(output) == plates[1]


@pytest.mark.parametrize(
    ("address", "code"),
    {
        "tcp://10.0.0.7:8786": "E_INSECURE",
        "icons.example.org:8786": "E_INSECURE",
        "tcp://[2001:db8::1]:8786": "E_INSECURE",
        "tcp://0.0.0.0:8786": "E_INSECURE",
        "tcp://127.0.0.1": "E_VALUE",
        "tcp://127.0.0.1:port": "E_VALUE",
        "http://127.0.0.1:8786": "E_VALUE",
        "": "E_VALUE",
    }.items(),
)
def test_an_open_scheduler_of_another_machine_is_refused(address, code):
    with pytest.raises(Refused) as refused:
        cluster.check_address(address)
    assert refused.value.problems[0].code == code


def test_a_scheduler_of_this_machine_or_one_behind_tls_is_taken():
    for address in ("tcp://127.0.0.1:8786", "localhost:8786", "tcp://[::1]:8786", "tls://a.org:1"):
        cluster.check_address(address)
    cluster.check_address("tcp://10.0.0.7:8786", insecure=True)


def test_the_command_refuses_as_every_command_does(campaign, tmp_path, monkeypatch):
    def run(*more):
        found = CliRunner().invoke(
            app, ["build", str(campaign), "-o", str(tmp_path / "d"), "--json", *more]
        )
        return found.exit_code, json.loads(found.stdout)["problems"][0]["code"]

    assert run("--cluster", "tcp://10.0.0.7:8786") == (1, "E_INSECURE")
    with dask.config.set({"distributed.comm.timeouts.connect": "200ms"}):
        assert run("--cluster", "tcp://127.0.0.1:9") == (1, "E_CLUSTER")
    assert run("--cluster", "tls://127.0.0.1:9") == (1, "E_CLUSTER")  # without certificates
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://10.0.0.7:8786")
    assert run() == (1, "E_INSECURE")


def test_unlike_workers_are_said_to_be_so_and_another_levkas_is_refused():
    one = {"worker": "tcp://a:1", "bytes": 4e9, **worker.facts()}
    found = cluster.Cluster("tcp://127.0.0.1:9")
    found.learn(one)
    assert found.warnings == ()
    found.learn({**one, "worker": "tcp://b:1", "BLAS": "mkl 2026.0"})
    assert len(found.warnings) == 1 and "1 of mkl 2026.0" in found.warnings[0]
    free = cluster.Cluster("tcp://127.0.0.1:9")
    free.learn({**one, "instruction set": "native: numpy X86_V2 X86_V3"})
    assert "this machine has x86-64-v2" in free.warnings[0], (
        "all workers alike, but not like this process"
    )
    with pytest.raises(Refused) as refused:
        found.learn({**one, "worker": "tcp://c:1", "code": "0", "levkas": "0.0.9"})
    (problem,) = refused.value.problems
    assert (problem.code, problem.found) == ("E_VERSION", "levkas 0.0.9")


@pytest.mark.slow
def test_what_a_task_reads_and_is_damaged_is_made_again_first(plates, tmp_path):
    preload = tmp_path / "preload.py"
    preload.write_text("from levkas.building import worker\nworker.PATIENCE_S = 0.2\n")
    output = tmp_path / "database"
    assert summarise(build(plates[0], output=output, workers=0)).ok
    records = BuildRecords(output.with_name("database.kept"), output)
    (name,) = [
        n for n in records.products(Key("one", "photo", "", "resample")) if n.endswith("photo.tif")
    ]
    with (output / name).open("r+b") as handle:
        handle.seek(-100, os.SEEK_END)
        handle.write(b"damaged")
    stamp = [*stamp_of(output / name)]
    records.hashes.take(output / name, [*stamp, plates[1][name]])  # as if nobody had noticed
    records.hashes.save()
    infrared = output / "objects/one/one_infrared.tif"
    infrared.unlink()
    with machines("4GB", preload=[preload]) as there:
        steps = list(build(plates[0], output=output, cluster=there.scheduler_address))
    why = {step.why for step in steps if step.key.layer == "photo" and step.state == "done"}
    assert why == {f"{name} was damaged"}
    assert hash_tree(output) == plates[1]

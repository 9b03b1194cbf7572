"""A build on the workers of dask: what it costs and gains, and what it takes to end it.

    python benchmarks/cluster.py speed [CAMPAIGN]
    python benchmarks/cluster.py kinds [CAMPAIGN]
    python benchmarks/cluster.py kills [CAMPAIGN]

``speed``: two objects in one process with one thread, in one process with all, and on one and two workers, in
turns; the databases must be the same, byte for byte, and no message holds pixels. Modules are loaded as
they are installed, compiled. ``kinds``: two objects of five cameras and two setups, adjusted together, in one
process, on two and on three workers; then the same with every scan streamed. ``kills``: a scheduler, and
three workers that are started again whenever they end; a task may lose twenty. While the campaign builds, a
worker is killed every 2 s, thirty in all, one is stopped for 60 s, the scheduler is ended and started again,
and so is the client. CAMPAIGN is simulated where none is given. Other work on the machine is in the times:
see the load, and the seconds of the processors.
"""

import json
import os
import random
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil
from results import record, taken_option

from levkas.building.build_records import BuildRecords
from levkas.core.digests import hash_tree
from levkas.core.files import PARTIAL
from levkas.simulation import simulate_campaign

COMPILED = tempfile.mkdtemp()  # modules, also where PYTHONDONTWRITEBYTECODE is set

PLATES = tuple(f"plate{number:02}" for number in range(48))
EVERY_KIND = Path(__file__).resolve().parents[1] / "tests/building/every_kind.py"
KILLS, EVERY_S, STOPPED_S, WORKERS = 30, 2.0, 60.0, 3
LEVKAS = [sys.executable, "-c", "from levkas.cli import main; main()"]
HELD = "from levkas.core.instructions import hold_instructions; hold_instructions(); "
DASK = [sys.executable, "-c", f"{HELD}from dask.__main__ import main; main()"]
WITH_MESSAGES = """
from levkas.core.instructions import hold_instructions
hold_instructions()
import sys, distributed.comm.tcp as tcp
sizes, write, read = [0], tcp.to_frames, tcp.from_frames
async def written(*args, **options):
    frames = await write(*args, **options)
    sizes.append(sum(memoryview(f).nbytes for f in frames))
    return frames
async def taken(frames, **options):
    sizes.append(sum(memoryview(f).nbytes for f in frames))
    return await read(frames, **options)
tcp.to_frames, tcp.from_frames = written, taken
from levkas.cli import main
try:
    main()
finally:
    print("messages", len(sizes) - 1, max(sizes), sum(sizes), file=sys.stderr)
"""


def simulated(folder):
    for _ in simulate_campaign(folder, preset="small", objects=2):
        pass
    return folder


def plates(folder):
    """Write a campaign of tasks of about a second."""
    return runpy.run_path(str(EVERY_KIND))["make"](folder, PLATES, ("photo", "xray"))


def build(campaign, output, *options, threads=None, program=LEVKAS, **more):
    """Build, with `more` variables; return seconds of the wall, of processors, and the last line that it said."""
    environment = {k: v for k, v in os.environ.items() if k != "LEVKAS_THREADS"}
    environment |= {"LEVKAS_THREADS": str(threads)} if threads else {}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    environment |= {"PYTHONPYCACHEPREFIX": COMPILED, **more}
    started, before = time.monotonic(), os.times()
    done = subprocess.run(
        [*program, "build", str(campaign), "-o", str(output), *options],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    after = os.times()
    busy = after.children_user + after.children_system
    busy -= before.children_user + before.children_system
    return time.monotonic() - started, busy, done.stderr.strip().splitlines()[-1]


def speed(campaign, folder, results):
    counted = [sys.executable, "-c", WITH_MESSAGES]
    ways = {
        "one process, one thread": (("--workers", "0"), 1, LEVKAS),
        "one process": (("--workers", "0"), None, LEVKAS),
        "1 worker": (("--workers", "1"), None, counted),
        "2 workers": (("--workers", "2"), None, counted),
    }
    build(campaign, folder / "warm", "--workers", "0")
    hashes, walls, busies = set(), {}, {}
    for round_ in range(2):
        for name, (options, threads, program) in ways.items():
            output = folder / f"{name} {round_}".replace(" ", "_")
            load = os.getloadavg()[0]
            wall, busy, last = build(campaign, output, *options, threads=threads, program=program)
            walls.setdefault(name, []).append(wall)
            busies.setdefault(name, []).append(busy)
            hashes.add(json.dumps(hash_tree(output)))
            print(
                f"{name}: {wall:.1f} s, load before {load:.1f}, processor {busy:.1f} s; {last}",
                flush=True,
            )
    for what, seconds in (("time", walls), ("processor time", busies)):
        least = {name: min(each) for name, each in seconds.items()}
        print(
            f"{what}: one process with one thread {least['one process, one thread'] / least['2 workers']:.2f} x "
            f"that of two workers; two workers {least['2 workers'] / least['one process'] - 1:+.1%} and "
            f"one worker {least['1 worker'] / least['one process'] - 1:+.1%} of one process"
        )
    figures = {f"cluster: {name}": (min(each), max(each)) for name, each in walls.items()}
    record(results, "speed", figures)
    print("the same bytes" if len(hashes) == 1 else f"{len(hashes)} DIFFERENT DATABASES")


STREAMED = """
from levkas.core.instructions import hold_instructions
hold_instructions()
from levkas.stages import scans, streaming
scans.STREAMED_SAMPLES, streaming.BUFFER_BYTES = 0, 3_000_000
"""


def setups(folder):
    """Simulate two objects of five cameras and two setups, whose captures are adjusted together."""
    for _ in simulate_campaign(folder, preset="small", scale=0.15, objects=2, setups=True):
        pass
    with (folder / "campaign.toml").open("a") as handle:
        handle.write("\n[registration]\njoint = true\n")
    return folder


def kinds(campaign, folder, results):
    streams = folder / "streams.py"
    streams.write_text(STREAMED)
    streamed = [sys.executable, "-c", f"{STREAMED}\nfrom levkas.cli import main; main()"]
    preload = {"DASK_DISTRIBUTED__WORKER__PRELOAD": json.dumps([str(streams)])}
    for how, program, more in (("held", LEVKAS, {}), ("streamed", streamed, preload)):
        expected = None
        for workers in ("0", "2", "3"):
            output = folder / f"{how}{workers}"
            wall, _, last = build(campaign, output, "--workers", workers, program=program, **more)
            found = hash_tree(output)
            expected = expected or found
            same = "the same bytes" if found == expected else "OTHER BYTES"
            print(f"{how}, {workers} workers: {same}, {wall:.0f} s; {last}", flush=True)


class Machines:
    """A scheduler and workers, each started again when it has ended."""

    def __init__(self, port):
        self.address = f"tcp://127.0.0.1:{port}"
        self._port, self._ending = port, False
        self.scheduler = self._start_scheduler()
        self.workers = [self._start_worker() for _ in range(WORKERS)]
        self._thread = threading.Thread(target=self._mind, daemon=True)
        self._thread.start()

    def _start_scheduler(self):
        where = ["--host", "127.0.0.1", "--port", str(self._port), "--no-dashboard"]
        more = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "20"}
        return subprocess.Popen(
            [*DASK, "scheduler", *where], stderr=subprocess.DEVNULL, env=os.environ | more
        )

    def _start_worker(self):
        how = ["--host", "127.0.0.1", "--nthreads", "1", "--memory-limit", "3GB", "--no-dashboard"]
        return subprocess.Popen([*DASK, "worker", self.address, *how], stderr=subprocess.DEVNULL)

    def _mind(self):
        while not self._ending:
            if self.scheduler.poll() is not None:
                self.scheduler = self._start_scheduler()
            for number, worker in enumerate(self.workers):
                if worker.poll() is not None:
                    self.workers[number] = self._start_worker()
            time.sleep(0.2)

    def victims(self):
        """Return the processes that work; each has a nanny of dask above it."""
        found = []
        for nanny in self.workers:
            try:
                inner = psutil.Process(nanny.pid).children()
                found += [p for p in inner if any("spawn_main" in a for a in p.cmdline())]
            except psutil.Error:
                continue
        return found

    def end(self):
        self._ending = True
        self._thread.join()
        for one in (*self.workers, self.scheduler):
            try:
                for inner in psutil.Process(one.pid).children(recursive=True):
                    inner.kill()
            except psutil.Error:
                pass
            one.kill()


def resume(process):
    if process.is_running():
        process.resume()


def kills(campaign, folder, results):
    expected_wall, _, _ = build(campaign, folder / "alone", "--workers", "0")
    expected = hash_tree(folder / "alone")
    machines, rng = Machines(28786), random.Random(1)
    output, started, log = folder / "struck", time.monotonic(), []
    command = [*LEVKAS, "build", str(campaign), "-o", str(output), "--cluster", machines.address]
    killed = clients = 0
    happened = set()

    def client():
        return subprocess.Popen(command, stderr=(folder / "client.log").open("a"))

    building = client()
    try:
        while building.poll() is None and time.monotonic() - started < 800:
            time.sleep(EVERY_S)
            there = machines.victims()
            if killed < KILLS and there:
                rng.choice(there).kill()
                killed += 1
            after = time.monotonic() - started
            if after > 20 and "stop" not in happened and there:
                stopped = there[0]
                stopped.send_signal(signal.SIGSTOP)
                threading.Timer(STOPPED_S, resume, [stopped]).start()
                happened.add("stop")
            if after > 40 and "client" not in happened:
                building.kill()
                building.wait()
                clients += 1
                building = client()
                happened.add("client")
            if after > 60 and "scheduler" not in happened:
                machines.scheduler.kill()
                happened.add("scheduler")
    finally:
        machines.end()
        building.kill()
    records = BuildRecords(output.with_name("struck.kept"), output)
    log = [n["attempts"] for n in map(records.notes, records.recorded()) if n.get("attempts")]
    print(
        f"alone {expected_wall:.0f} s; struck {time.monotonic() - started:.0f} s, exit {building.returncode}"
    )
    print(f"{killed} workers and {clients} client killed, also: {', '.join(sorted(happened))}")
    print(
        f"{len(log)} tasks in {sum(map(len, log))} attempts, at most {max(map(len, log), default=0)} each"
    )
    same = hash_tree(output) == expected
    left = [p for p in folder.rglob("*") if PARTIAL.fullmatch(p.name)]
    print("the same bytes" if same else "OTHER BYTES", f"{len(left)} partial files")
    if killed == KILLS:
        name = f"{KILLS} workers killed: other bytes"
        record(results, "robustness", {name: int(not same)})


if __name__ == "__main__":
    results = taken_option()
    what = sys.argv[1] if sys.argv[1:] else "speed"
    with tempfile.TemporaryDirectory() as place:
        given = Path(sys.argv[2]) if sys.argv[2:] else None
        folder = Path(place) / "campaign"
        make, measure = {
            "speed": (simulated, speed), "kinds": (setups, kinds), "kills": (plates, kills)
        }[what]  # fmt: skip
        chosen = given or make(folder)
        measure(chosen.resolve(), Path(place), results)

"""A build of stages that write a line that is struck at each of its steps on the disk, and then run again.

`Fault` counts the calls of `files.fault` and strikes at the N-th: a full disk stays full for all
that takes space, a failing disk fails once, and a kill ends everything. A kill is an exception that
no `except OSError` and no `except Exception` takes; from then on every step on the disk raises it
again, and so does every call that would take away or rename a file, in every thread. Nothing can be
tidied up, and the folders stay as a killed process leaves them. `test_a_real_kill` ends a process.

The stages are written by one thread while another computes, so the N-th call is not the same in
every run. What is asked for holds wherever it falls.
"""

import contextlib
import errno
import json
import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import toy

from levkas.building import build, build_records, status, summarise
from levkas.building.records_file import NAME, read_rows
from levkas.core import files
from levkas.core.digests import hash_tree
from levkas.core.ownership import MARK
from levkas.core.problems import Refused
from levkas.database import spectral_tiff
from levkas.database.manifest import is_partial, read_manifest
from levkas.database.store import ROOT

POINTS = 10_000 if os.environ.get("LEVKAS_EVERY_CASE") else 6
"""Of every scene and kind in an ordinary run; `make exhaustive` takes all."""
SPACE = {"open", "write", "folder", "fsync"}
TOLD = (
    "catalogue.csv",
    "database.toml",
    "manifest-sha256.txt",
    "report.html",
    "zarr.json",
    "camera.json",
)
"""What a build with a refusal tells otherwise than an undisturbed one."""


class Scene:
    """A campaign of four layers, what stood in the output before its build, and what stands there after it."""

    def __init__(self, root, *, over):
        self.campaign = toy.make(root / "campaign", ("one",), ("photo", "xray", "colour"))
        self.output, self.saved = root / "work/database", root / "saved"
        if over:
            path = self.campaign / "photo/one.png"
            path.write_bytes((data := path.read_bytes()) + b"older")
            list(build(self.campaign, output=self.output))
            path.write_bytes(data)
            shutil.copytree(self.output.parent, self.saved)
        self.before = hash_tree(self.output) if over else {}
        self.steps = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(files, "fault", lambda *step: self.steps.append(step))
            assert self.build() == []
        self.after = hash_tree(self.output)

    def set(self):
        """Put the output in the state before the build."""
        shutil.rmtree(self.output.parent, ignore_errors=True)
        if self.saved.is_dir():
            shutil.copytree(self.saved, self.output.parent)

    def build(self):
        steps = summarise(build(self.campaign, output=self.output)).stages
        return [step.line for step in steps if step.state == "refused"]

    def recorded(self):
        """Return the products of every finished stage by its record."""
        kept = self.output.with_name("database.kept")
        rows = read_rows(kept / NAME, "SELECT * FROM stages WHERE state = 'done'")
        return {" ".join(key): json.loads(record)["products"] for *key, _, record, _ in rows}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Builds into nothing, and over an older database."""
    with pytest.MonkeyPatch.context() as patch:
        toy.install(patch)
        root = tmp_path_factory.mktemp("faults")
        scenes = {name: Scene(root / name, over=name == "over") for name in ("new", "over")}
        assert scenes["new"].after == scenes["over"].after
        yield scenes


class Killed(BaseException):
    """The process is no more."""


class Fault:
    """Strikes at the `at`-th call, counted from 1; `struck` is the step and the path it hit."""

    def __init__(self, at, kind):
        self.at, self.kind, self.count, self.struck = at, kind, 0, None
        self.lock = threading.Lock()

    def __call__(self, step, path):
        with self.lock:
            self.count += 1
            if now := self.count == self.at:
                self.struck = (step, path)
        if self.kind == "kill":
            self.stay_dead()
        elif now or (self.kind == "full" and self.struck and step in SPACE):
            number = errno.EIO if self.kind == "failing" else errno.ENOSPC
            raise OSError(number, os.strerror(number))

    def stay_dead(self):
        if self.struck and self.kind == "kill":
            raise Killed

    def install(self, patch):
        patch.setattr(files, "fault", self)
        for name in ("unlink", "rmdir", "rename", "replace", "mkdir"):
            patch.setattr(os, name, self._guarded(getattr(os, name)))

    def _guarded(self, call):
        def guarded(*args, **more):
            self.stay_dead()
            return call(*args, **more)

        return guarded


def strike(scene, at, kind):
    """Build a scene with a fault at its `at`-th step; return what it struck, what was torn and what a second build left so."""
    scene.set()
    fault = Fault(at, kind)
    with pytest.MonkeyPatch.context() as patch:
        fault.install(patch)
        with contextlib.suppress(Refused, Killed):
            scene.build()
    torn = sorted(find_torn(scene, reported=kind != "kill"))
    return fault.struck, torn, mend(scene) if fault.struck else []


def mend(scene):
    """Build again, and return what is not as after an undisturbed build."""
    left = scene.build()
    found = hash_tree(scene.output)
    left += [n for n in found | scene.after if found.get(n) != scene.after.get(n)]
    around = scene.output.parent.rglob("*")
    return left + [str(path) for path in around if files.PARTIAL.fullmatch(path.name)]


def find_torn(scene, *, reported):
    """Yield every final name that holds neither the old bytes nor the new ones, and each record whose product is not there.

    Where `reported`, the build went on after a refusal and named it in some files of its own.
    """
    found = hash_tree(scene.output) if scene.output.is_dir() else {}
    found = {name: sha for name, sha in found.items() if not is_partial(name)}
    for name, sha in found.items():
        path = scene.output / name
        if sha in (scene.before.get(name), scene.after.get(name)):
            continue
        if name == "database.toml" and path.read_text() == MARK:
            continue
        if name.endswith(".zarr/zarr.json") and json.loads(path.read_text()) == ROOT:
            continue
        if not (reported and name.endswith(TOLD) and path.stat().st_size) or (
            name.endswith(".txt") and read_manifest(path).problems
        ):
            yield name
    for stage, products in scene.recorded().items():
        yield from (f"{stage} without {n}" for n in products.keys() - found)


def spread(count, points):
    """Return `points` numbers from 1 to `count`, evenly spaced, the last one among them."""
    return sorted({int(n) for n in np.linspace(1, count, points)})


@pytest.mark.parametrize("kind", ["full", "failing", "kill"])
@pytest.mark.parametrize("name", ["new", "over"])
def test_after_a_fault_all_is_whole_and_a_second_build_gives_the_same_bytes(scenes, name, kind):
    scene = scenes[name]
    shift = len(kind) + len(name)  # other points for every kind
    for at in spread(len(scene.steps) - 2 * shift, POINTS):
        struck, torn, left = strike(scene, at, kind)
        assert struck and not torn and not left, (at, kind)


CHILD = """
import os, sys
sys.path.insert(0, sys.argv[3])
import pytest, toy
from levkas.building import build
from levkas.core import files
calls = []
def die(step, path):
    calls.append(step)
    if len(calls) == int(sys.argv[4]):
        os._exit(9)
toy.install(pytest.MonkeyPatch())
sys.stdin.readline()
files.fault = die
for step in build(sys.argv[1], output=sys.argv[2]):
    pass
"""


def child(scene, at):
    command = [sys.executable, "-c", CHILD, scene.campaign, scene.output, Path(__file__).parent]
    return subprocess.Popen([*command, str(at)], stdin=subprocess.PIPE)


@pytest.mark.parametrize(
    ("name", "share"), [pytest.param("new", 0.3, marks=pytest.mark.slow), ("over", 0.7)]
)
def test_a_real_kill(scenes, name, share):
    scene = scenes[name]
    scene.set()
    killed = child(scene, int(share * len(scene.steps)))
    killed.communicate(b"go\n")
    assert killed.returncode == 9
    assert not [*find_torn(scene, reported=False)] and not mend(scene)


@pytest.mark.slow
def test_two_processes_at_once_make_what_one_makes(scenes):
    scene = scenes["new"]
    scene.set()
    both = [child(scene, -1) for _ in range(2)]
    for one in both:
        one.stdin.write(b"go\n")
        one.stdin.flush()
    for one in both:
        one.communicate()
    assert [one.returncode for one in both] == [0, 0]
    assert hash_tree(scene.output) == scene.after and not mend(scene)
    assert {s.state for s in status(scene.campaign, output=scene.output).stages} == {"fresh"}


def test_two_builds_step_by_step_in_turn_and_two_threads_make_what_one_makes(scenes):
    scene = scenes["new"]
    scene.set()
    turns = [build(scene.campaign, output=scene.output) for _ in range(2)]
    while turns:
        turns = [steps for steps in turns if next(steps, None) is not None]
    assert hash_tree(scene.output) == scene.after and not mend(scene)
    scene.set()
    with ThreadPoolExecutor(2) as pool:
        assert [job.result() for job in [pool.submit(scene.build) for _ in range(2)]] == [[], []]
    assert hash_tree(scene.output) == scene.after and not mend(scene)


def test_a_failed_write_leaves_no_threads_to_be_collected(tmp_path, monkeypatch):
    # Collected while another thread starts, a pool waits for ever for a lock of its own thread.
    pools = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, *args):
            super().__init__(*args)
            pools.append(self)

    monkeypatch.setattr(spectral_tiff, "ThreadPoolExecutor", Pool)
    monkeypatch.setattr(files, "fault", Fault(3, "failing"))
    cube = np.zeros((40, 50, 5), np.float32)
    with pytest.raises(Refused) as refused:
        header = spectral_tiff.TiffHeader((40, 50), range(5))
        spectral_tiff.write_pages(tmp_path / "a.tif", [cube], header)
    assert refused.value.problems[0].code == "E_IO"
    assert pools and all(pool._shutdown for pool in pools)


def replay(scene, patch):
    """Build, and yield the products of records that a loss of power just after the record may take away."""
    scene.set()
    events, lock = [], threading.RLock()

    def note(where, name, of):
        real = getattr(where, name)

        def noting(*args, **more):
            with lock:
                done = real(*args, **more)
                events.append(of(*args))
                return done

        patch.setattr(where, name, noting)

    def opened(descriptor):
        return "sync", Path(f"/proc/self/fd/{descriptor}").readlink()

    note(os, "fsync", opened)
    note(files, "_sync_file_system", opened)
    for call in ("rename", "replace"):
        note(os, call, lambda old, new: ("name", Path(old), Path(new)))
    note(build_records, "write_rows", lambda *_: ("record", scene.recorded()))
    scene.build()
    synced, unsafe = set(), {}
    for kind, *what in events:
        if kind == "sync":
            synced.add(what[0])
            unsafe = {n: o for n, o in unsafe.items() if n.parent != what[0] or o not in synced}
        elif kind == "name":
            unsafe[what[1]] = what[0]
        else:
            made = {scene.output / name for products in what[0].values() for name in products}
            yield from made & unsafe.keys()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="names of open files are not known")
def test_a_loss_of_power_leaves_no_record_without_its_products(scenes, monkeypatch):
    assert not [*replay(scenes["over"], monkeypatch)]


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="names of open files are not known")
def test_a_build_that_spares_a_sync_is_found_out(scenes, monkeypatch):
    monkeypatch.setattr(files, "_sync_folder", lambda folder: None)
    assert [*replay(scenes["over"], monkeypatch)]

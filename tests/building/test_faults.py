"""A build that is struck at each of its steps on the disk, and then run again.

`Fault` counts the calls of `files.fault` and strikes at the N-th: a full disk stays full for all
that takes space, a failing disk fails once, and a kill ends everything. A kill is an exception that
no `except OSError` and no `except Exception` takes; from then on every step on the disk raises it
again, and so does every call that would take away or rename a file, in every thread. Nothing can be
tidied up, and the folders stay as a killed process leaves them. `test_real_kills` ends processes.

The stages are written by one thread while another computes, so the N-th call is not the same in
every run. What is asked for holds wherever it falls.
"""

import contextlib
import csv
import errno
import hashlib
import importlib
import io
import itertools
import json
import os
import shutil
import stat
import subprocess
import sys
import threading
import tomllib
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from levkas.building import build, build_records, summarise, tasks
from levkas.building.records_file import NAME, read_rows
from levkas.core import files
from levkas.core.digests import hash_tree
from levkas.core.json_safe import to_json
from levkas.core.ownership import MARK
from levkas.core.problems import Refused
from levkas.database import spectral_tiff
from levkas.database.catalogue import COLUMNS
from levkas.database.manifest import is_partial, read_manifest
from levkas.database.store import ROOT
from levkas.database.validation import validate
from levkas.stages import register

KINDS = ("full", "failing", "kill")
SCENES = ("new", "over")
QUICK = (("new", "full"), ("new", "kill"))
"""Those that the fast tests hold."""
POINTS = 10_000 if os.environ.get("LEVKAS_EVERY_CASE") else 4
"""Of every scene and kind in an ordinary run; `make exhaustive` takes all."""
SIZE = (110, 96)
MATRIX = np.array([[1.9, 0.06, 4.0], [-0.06, 1.9, 6.0]])
KEYS = """
[campaign]
title = "A plate"
date = 2019-08-29
reference = { camera = "photo", band = "G" }
[database]
native = true
[cameras.photo]
kind = "image"
files = "photo/{target}.png"
[cameras.irr]
kind = "image"
files = "irr/{target}.tif"
[targets]
objects = ["panel"]
"""
"""Two objects in two rounds: what each saw by itself is kept beside the database."""
SPACE = {"open", "write", "folder", "fsync"}
PLAIN_ROOT = hashlib.sha256(to_json(ROOT).encode()).hexdigest()
MARKED = hashlib.sha256(MARK.encode()).hexdigest()
"""Of database.toml from the beginning of a first build to its end."""
TOLD = {
    "catalogue.csv": lambda data: next(csv.reader(io.StringIO(data.decode()))) == list(COLUMNS),
    "database.toml": lambda data: "reference" in tomllib.loads(data.decode()),
}
for _name in ("panel", "slab"):
    TOLD |= {
        f"objects/{_name}/provenance.json": lambda data: "steps" in json.loads(data),
        f"objects/{_name}/report.html": lambda data: data.rstrip().endswith(b"</html>"),
        f"zarr/{_name}.zarr/zarr.json": lambda data: json.loads(data)["node_type"] == "group",
    }
"""What a build with a refusal tells otherwise than an undisturbed one, and how it is known whole."""


# --- a small campaign -------------------------------------------------------------------------


def painting(seed):
    rng = np.random.default_rng(seed)
    width, height = 2 * SIZE[0], 2 * SIZE[1]
    image = np.full((height, width), 90, np.float32)
    for _ in range(160):
        x, y, r = rng.integers(0, width), rng.integers(0, height), int(rng.integers(6, 60))
        cv2.circle(image, (int(x), int(y)), r, float(rng.integers(20, 235)), -1, cv2.LINE_AA)
    for _ in range(160):
        points = rng.integers(0, [width, height], (3, 2)).astype(np.int32)
        cv2.polylines(image, [points], False, float(rng.integers(20, 235)), 3, cv2.LINE_AA)
    grain = cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), 2)
    return np.clip(image + 60 * grain, 5, 250)


def make(folder, *, gain=1.0, blank=False):
    for part in ("photo", "irr"):
        (folder / part).mkdir(parents=True)
    capture(folder, "panel", painting(0) * gain, blank)
    (folder / "campaign.toml").write_text(KEYS)
    return folder


def capture(folder, name, big, blank):
    photo = cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA).astype(np.uint8)
    size = (SIZE[0] + 10, SIZE[1] + 10)
    how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    irr = cv2.warpAffine(cv2.GaussianBlur(big, (0, 0), 0.8), MATRIX, size, flags=how, borderValue=5)
    cv2.imwrite(str(folder / f"photo/{name}.png"), np.dstack([photo] * 3))
    irr = np.full_like(irr, 128) if blank else 255 - irr
    tifffile.imwrite(folder / f"irr/{name}.tif", irr.clip(0, 255).astype(np.uint8))


def remembered():
    """`register_capture`, which gives what it gave before for the same pixels."""
    real, known = register.register_capture, {}

    def registered(native, *rest):
        key = hashlib.sha256(b"".join(c.values.tobytes() for c in native.cubes.values())).digest()
        if key not in known:
            try:
                known[key] = real(native, *rest)
            except Refused as refused:
                known[key] = refused
        if isinstance(known[key], Refused):
            raise known[key]
        return known[key]

    return registered


@dataclass
class Scene:
    """A campaign, what stood in the output before its build, and what stands there after it.

    `before` and `after` are the hashes of the database, `saved` is a copy of what stood there.
    """

    name: str
    campaign: Path
    output: Path
    saved: Path
    before: dict = field(default_factory=dict)
    after: dict = field(default_factory=dict)
    refused: list = field(default_factory=list)
    steps: list = field(default_factory=list)

    @property
    def kept(self):
        return self.output.with_name(self.output.name + ".kept")

    def set(self):
        """Put the output in the state before the build."""
        shutil.rmtree(self.output.parent, ignore_errors=True)
        if self.saved.is_dir():
            shutil.copytree(self.saved, self.output.parent)

    def states(self):
        """Return every state that is whole."""
        return [self.before, self.after]

    def build(self):
        report = summarise(build(self.campaign, output=self.output))
        return [s.line for s in report.stages if s.state in ("refused", "failed")]

    def learn(self):
        """Build it undisturbed."""
        self.set()
        self.before = hash_tree(self.output) if self.output.is_dir() else {}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(files, "fault", lambda step, path: self.steps.append((step, path)))
            self.refused = self.build()
        self.after = hash_tree(self.output)
        return self


class Scenes(dict):
    """Scenes by name, each built undisturbed when it is first asked for."""

    def __init__(self, root, scenes):
        super().__init__(scenes)
        self.root = root

    def __getitem__(self, name):
        scene = super().__getitem__(name)
        if not scene.steps:
            scene.learn()
        return scene

    def items(self):
        return ((name, self[name]) for name in self)


def make_scenes(root):
    """Builds into nothing, and over an older database."""
    first = make(root / "first", gain=0.96)
    second = make(root / "second")
    work, saved = root / "work", root / "saved"
    Scene("old", first, work / "database", root / "none").learn()
    shutil.copytree(work, saved)
    first.rename(root / "gone")  # as if its frames had been changed: it is the others' database now
    scenes = {
        "new": Scene("new", second, work / "database", root / "none"),
        "over": Scene("over", second, work / "database", saved),
    }
    return Scenes(root, scenes)


@pytest.mark.slow
def test_what_stood_there_before_leaves_no_trace(scenes):
    assert scenes["over"].after == scenes["new"].after


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        hasten(patch)
        yield make_scenes(tmp_path_factory.mktemp("faults"))


def hasten(patch):
    """Spare what a kill does not ask for: registering again, memory, and the syncs themselves."""
    patch.setattr(register, "register_capture", remembered())
    patch.setattr(tasks, "give_back_memory", lambda: None)
    patch.setattr(os, "fsync", lambda descriptor: None)
    patch.setattr(files, "_sync_file_system", lambda descriptor: None)


# --- faults -----------------------------------------------------------------------------------


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
            now = self.count == self.at
            if now:
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
        patch.setattr(files, "_exchange", self._guarded(files._exchange))

    def _guarded(self, call):
        def guarded(*args, **more):
            self.stay_dead()
            return call(*args, **more)

        return guarded


@dataclass(frozen=True)
class Outcome:
    """What a fault left behind, and whether a second build mended it."""

    struck: tuple | None
    torn: tuple
    unmended: tuple

    @property
    def well(self):
        return not self.torn and not self.unmended


def strike(scene, at, kind, *, writer=None):
    """Build a scene with a fault at its `at`-th step, look, and build again."""
    scene.set()
    fault = Fault(at, kind)
    with pytest.MonkeyPatch.context() as patch:
        if writer:
            writer(patch)
        fault.install(patch)
        with contextlib.suppress(Refused, Killed):
            scene.build()
    torn = tuple(find_torn(scene, reported=kind != "kill"))
    return Outcome(fault.struck, torn, tuple(mend(scene)) if fault.struck else ())


def mend(scene):
    """Build again, and yield what is not as after an undisturbed build."""
    try:
        refused = scene.build()
    except Refused as error:
        yield f"refused: {error}"
        return
    if refused != scene.refused:
        yield f"refused: {refused}"
    found = hash_tree(scene.output)
    yield from sorted(n for n in found | scene.after if found.get(n) != scene.after.get(n))
    for folder in (scene.output, scene.kept):
        yield from (str(p) for p in folder.rglob("*") if files.PARTIAL.fullmatch(p.name))


def find_torn(scene, *, reported):
    """Yield every final name that holds neither the old bytes nor the new ones.

    Where `reported`, the build went on after a refusal and named it in some files of its own.
    """
    found = {}
    if scene.output.is_dir():
        found = {n: sha for n, sha in hash_tree(scene.output).items() if not is_partial(n)}
    for name, sha in found.items():
        if sha in [state.get(name) for state in scene.states()]:
            continue
        if (name, sha) == ("database.toml", MARKED):
            continue
        if not (sha == PLAIN_ROOT and name.endswith(".zarr/zarr.json")) and not (
            reported and _is_whole(scene.output, name)
        ):
            yield name
    for layer in layers_of(scene):
        part = below(found, layer)
        if part and part not in [below(state, layer) for state in scene.states()]:
            yield layer
    for stage, products in recorded(scene.kept).items():
        for name, sha in products.items():
            if found.get(name) != sha:
                yield f"{stage} without {name}"


def recorded(kept):
    """Return the products of every finished stage by its record."""
    rows = read_rows(kept / NAME, "SELECT * FROM stages WHERE state = 'done'")
    return {" ".join(key): json.loads(record)["products"] for *key, _, record, _ in rows}


def _is_whole(output, name):
    if name == "manifest-sha256.txt":
        return not read_manifest(output / name).problems
    try:
        return name in TOLD and TOLD[name]((output / name).read_bytes())
    except (ValueError, KeyError, StopIteration):
        return False


def layers_of(scene):
    """The Zarr groups of layers, which are published whole."""
    return sorted(
        {
            "/".join(name.split("/")[:3])
            for name in scene.before | scene.after
            if name.startswith("zarr/") and name.count("/") > 2
        }
    )


def below(tree, folder):
    return {name: sha for name, sha in tree.items() if name.startswith(f"{folder}/")}


def spread(count, points):
    """Return `points` numbers from 1 to `count`, evenly spaced, the last one among them."""
    return sorted({int(n) for n in np.linspace(1, count, points)})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param(name, kind, marks=[pytest.mark.slow] * ((name, kind) not in QUICK))
        for name in SCENES
        for kind in KINDS
    ],
)
def test_after_a_fault_all_is_whole_and_a_second_build_gives_the_same_bytes(scenes, name, kind):
    scene = scenes[name]
    shift = KINDS.index(kind)  # other points for every kind
    for at in spread(len(scene.steps) - 2 * shift - 5, POINTS):
        outcome = strike(scene, at, kind)
        assert outcome.struck and outcome.well, (at, kind, outcome)


def struck_while_written(scene, name, kind, step="write"):
    """Build a scene with a fault where a file is written for the first time; return the report."""
    scene.set()
    fault, reports = Fault(0, kind), []

    def strike(what, path):
        if not fault.struck and what == step and Path(path).name == name:
            fault.at = fault.count + 1
        fault(what, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "fault", strike)
        with contextlib.suppress(Refused):
            reports.append(summarise(build(scene.campaign, output=scene.output)))
    assert fault.struck
    return reports[0] if reports else None


@pytest.mark.parametrize("kind", ["full", "failing"])
def test_a_layer_whose_stage_the_disk_refused_stays_what_it_was(scenes, kind, tmp_path):
    scene = scenes["over"]
    report = struck_while_written(scene, "panel_photo.flags.tif", kind)
    found = hash_tree(scene.output)
    changed = {n for n in found | scene.before if found.get(n) != scene.before.get(n)}
    if kind == "full":  # then nothing can be written any more
        assert not changed
    else:
        assert changed <= {*TOLD, "manifest-sha256.txt"}
        assert any("panel/photo: of an earlier build" in w for w in report.warnings)
        assert not report.ok
    assert validate(scene.output).ok
    assert not list(mend(scene))


def test_a_fault_that_is_never_reached_changes_nothing(scenes):
    outcome = strike(scenes["over"], 100_000, "kill")
    assert outcome == Outcome(None, (), ())
    assert hash_tree(scenes["over"].output) == scenes["over"].after


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


CHILD = """
import os, sys
from levkas.core import files
from levkas.building import build
calls = []
def die(step, path):
    calls.append(step)
    if len(calls) == int(sys.argv[3]):
        os._exit(9)
files.fault = die
for step in build(sys.argv[1], output=sys.argv[2]):
    pass
"""


def strike_for_real(scene, at):
    """End a process at the `at`-th step of its build, look, and build again."""
    scene.set()
    command = [sys.executable, "-c", CHILD, scene.campaign, scene.output, str(at)]
    status = subprocess.run(command, check=False).returncode
    torn = tuple(find_torn(scene, reported=False))
    return Outcome(("exit", status), torn, tuple(mend(scene)))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "share"), [("new", 0.3), ("over", 0.7)])
def test_real_kills(scenes, name, share):
    outcome = strike_for_real(scenes[name], int(share * len(scenes[name].steps)))
    assert outcome.struck == ("exit", 9) and outcome.well, outcome


# --- a careless writer ------------------------------------------------------------------------


def write_carelessly(patch):
    """Write straight under the final names."""

    @contextlib.contextmanager
    def replacing(path, *, bytes_needed=None):
        path = Path(path)
        files.make_folder(path.parent)
        files.fault("open", path)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        with io.BufferedRandom(files._Watched(descriptor, path, path, bytes_needed)) as handle:
            yield handle

    @contextlib.contextmanager
    def publishing(path, *, bytes_needed=None):
        shutil.rmtree(path, ignore_errors=True)
        files.make_folder(path)
        yield files.Folder(Path(path), Path(path))

    for name in (
        "core.files",
        "database.spectral_tiff",
        "database.store",
        "stages.template_cache",
    ):
        module = importlib.import_module(f"levkas.{name}")
        for function in (replacing, publishing):
            if hasattr(module, function.__name__):
                patch.setattr(module, function.__name__, function)


@pytest.mark.slow
def test_a_careless_writer_is_found_out(scenes):
    found = Counter()
    for name in ("new", "over"):
        for at in spread(250, 9):
            outcome = strike(scenes[name], at, "kill", writer=write_carelessly)
            step, path = outcome.struck or ("", None)
            if step == "write" and path.name != NAME:  # that of sqlite is none of ours
                found[bool(outcome.torn)] += 1
    assert found.total() >= 5
    assert found[True] >= 0.9 * found.total(), found


# --- loss of power ----------------------------------------------------------------------------


class Recorder:
    """Writes down what a build does to the disk, in order, for `Disk` to lose some of it.

    Files and folders are known by a number of their own: the system gives those of the dead anew.
    """

    def __init__(self, root, *, without=()):
        self.root, self.without = root, without
        self.log, self.contents, self.numbers = [], {}, {}
        self.count, self.lock = itertools.count(1), threading.RLock()
        self._found(root)
        for path in sorted(root.rglob("*")):
            self._found(path)
            if path.is_file():
                self._told("fsync", self._number(path), self._learn(path.read_bytes()))
        self._told("syncfs")

    def install(self, patch):
        patch.setattr(os, "open", self._opening(os.open))
        for name in ("rename", "replace"):
            patch.setattr(os, name, self._after(getattr(os, name), "rename"))
        for name in ("unlink", "rmdir"):
            patch.setattr(os, name, self._after(getattr(os, name), "gone"))
        patch.setattr(os, "mkdir", self._making(os.mkdir))
        patch.setattr(os, "fsync", self._fsync)
        patch.setattr(files, "_sync_file_system", lambda descriptor: self._synced("syncfs"))
        patch.setattr(files, "_exchange", self._after(files._exchange, "exchange"))
        patch.setattr(files._Watched, "write", self._writing(files._Watched.write))
        patch.setattr(files.Folder, "write_bytes", self._filling(files.Folder.write_bytes))
        patch.setattr(shutil, "rmtree", _remove_tree)
        patch.setattr(build_records, "write_rows", self._recording(build_records.write_rows))

    def _recording(self, real):
        """A transaction of sqlite is on the disk when it ends: what stands in the records before and after it is known."""

        def recording(path, *changes):
            with self.lock:
                real(path, *changes)
                self._told("recorded", recorded(path.parent))

        return recording

    def _told(self, *operation):
        self.log.append(operation)

    def _number(self, path_or_status):
        status = path_or_status
        if isinstance(status, Path):
            status = status.stat()
        return self.numbers.get(status.st_ino)

    def _found(self, path):
        """Number a new file or folder."""
        status = path.stat()
        self.numbers[status.st_ino] = number = next(self.count)
        place = path.relative_to(self.root).parts
        self._told("folder" if stat.S_ISDIR(status.st_mode) else "file", number, place)

    def _learn(self, data):
        digest = hashlib.sha256(data).hexdigest()
        self.contents[digest] = data
        return digest

    def _is_ours(self, path):
        return isinstance(path, str | Path) and Path(path).is_relative_to(self.root)

    def _opening(self, real):
        def opening(path, flags, *rest, **more):
            if not flags & os.O_CREAT or not self._is_ours(path):
                return real(path, flags, *rest, **more)
            with self.lock:
                fresh = not Path(path).exists()
                descriptor = real(path, flags, *rest, **more)
                if fresh:
                    self._found(Path(path))
                return descriptor

        return opening

    def _making(self, real):
        def making(path, *rest, **more):
            with self.lock:
                real(path, *rest, **more)
                if self._is_ours(path):
                    self._found(Path(path))

        return making

    def _after(self, real, kind):
        def doing(*paths, **more):
            with self.lock:
                done = real(*paths, **more)
                if done is not False and self._is_ours(paths[0]) and "dir_fd" not in more:
                    self._told(kind, *(Path(p).relative_to(self.root).parts for p in paths))
                return done

        return doing

    def _writing(self, real):
        def writing(handle, data):
            with self.lock:
                written = real(handle, data)
                self._told("write", self._number(os.fstat(handle.fileno())), None)
                return written

        return writing

    def _filling(self, real):
        def filling(folder, name, data):
            with self.lock:
                target = folder.path / name
                fresh = not target.exists()
                real(folder, name, data)
                if fresh:
                    self._found(target)
                self._told("write", self._number(target), self._learn(target.read_bytes()))

        return filling

    def _fsync(self, descriptor):
        status = os.fstat(descriptor)
        with self.lock:
            if stat.S_ISDIR(status.st_mode):
                self._synced("sync", self._number(status))
            else:
                data = os.pread(descriptor, status.st_size, 0)
                self._synced("fsync", self._number(status), self._learn(data))

    def _synced(self, *operation):
        with self.lock:
            if operation[0] not in self.without:
                self._told(*operation)


def _remove_tree(path, ignore_errors=False, **_):
    """`shutil.rmtree` by whole paths."""
    with contextlib.suppress(OSError) if ignore_errors else contextlib.nullcontext():
        for place, folders, names in os.walk(path, topdown=False):
            for name in names:
                os.unlink(os.path.join(place, name))  # noqa: PTH108, PTH118
            for name in folders:
                os.rmdir(os.path.join(place, name))  # noqa: PTH106, PTH118
        os.rmdir(path)  # noqa: PTH106


TORN = "torn"


@dataclass
class Node:
    """A file with its synced hash, or a folder with its entries.

    `unsure` has, for every entry changed since the folder was synced, all that it may be after a
    loss of power: what it was, and whatever it became since, each with None for no entry.
    """

    digest: str | None = None
    safe: bool = False
    entries: dict = field(default_factory=dict)
    unsure: dict = field(default_factory=dict)


class Disk:
    """A file system that may lose whatever is not synced, each piece for itself."""

    def __init__(self, contents):
        self.contents, self.nodes, self.root = contents, {}, None

    def do(self, kind, *what):
        if kind in ("file", "folder"):
            number, place = what
            self.nodes[number] = Node()
            if place:
                self._enter(place, number)
            else:
                self.root = number
        elif kind == "gone":
            self._enter(what[0], None)
        elif kind == "rename":
            moved = self._now(what[0])
            self._enter(what[1], moved)
            self._enter(what[0], None)
        elif kind == "exchange":
            one, other = self._now(what[0]), self._now(what[1])
            self._enter(what[0], other)
            self._enter(what[1], one)
        elif kind == "write":
            self.nodes[what[0]].digest, self.nodes[what[0]].safe = what[1], False
        elif kind == "fsync":
            self.nodes[what[0]].digest, self.nodes[what[0]].safe = what[1], True
        elif kind == "sync":
            self.nodes[what[0]].unsure.clear()
        elif kind == "syncfs":
            for node in self.nodes.values():
                node.unsure.clear()
                node.safe = node.digest is not None

    def _now(self, place):
        number = self.root
        for name in place:
            number = self.nodes[number].entries[name]
        return number

    def _enter(self, place, number):
        folder = self.nodes[self._now(place[:-1])]
        folder.unsure.setdefault(place[-1], {folder.entries.get(place[-1])}).add(number)
        folder.entries[place[-1]] = number

    def may_be(self, *place):
        """Return all that may stand at a place after a loss: numbers of nodes, None for nothing."""
        found = {self.root}
        for name in place:
            found = {
                candidate
                for number in found
                for candidate in (
                    {None}
                    if number is None
                    else self.nodes[number].unsure.get(name, {self.nodes[number].entries.get(name)})
                )
            }
        return found

    def may_hold(self, *place):
        """Return the hashes of what may stand there, `TORN` where it was not synced."""
        return {None if n is None else self._digest(n) for n in self.may_be(*place)}

    def tree(self, number, start=""):
        """Return the files of a folder by name; `TORN` for all that may or may not be there."""
        node, found = self.nodes[number], {}
        for name, child in node.entries.items():
            if name in node.unsure:
                found[start + name] = TORN
            elif child is not None and self.nodes[child].entries:
                found |= self.tree(child, f"{start}{name}/")
            elif child is not None:
                found[start + name] = self._digest(child)
        return found

    def _digest(self, number):
        node = self.nodes[number]
        return node.digest if node.safe else TORN


def replay(scene, *, without=()):
    """Build a scene, lose power after each operation, and return (operations, what was wrong)."""
    scene.set()
    root = scene.output.parent
    root.mkdir(exist_ok=True)
    recorder = Recorder(root, without=without)
    before = len(recorder.log)
    with pytest.MonkeyPatch.context() as patch:
        recorder.install(patch)
        assert scene.build() == scene.refused
    assert hash_tree(scene.output) == scene.after
    disk, wrong = Disk(recorder.contents), Counter()
    records = recorded(scene.saved / scene.kept.name)
    for number, (kind, *what) in enumerate(recorder.log):
        if kind == "recorded":
            (records,) = what
        else:
            disk.do(kind, *what)
        if number >= before:
            wrong.update(set(lost(scene, disk, records)))
    return len(recorder.log) - before, wrong


def lost(scene, disk, records):
    """Yield each name that may be neither nothing nor whole, and each record without a product."""
    layers, top = layers_of(scene), scene.output.name
    for name in scene.before | scene.after:
        if name.startswith(tuple(f"{layer}/" for layer in layers)):
            continue
        fit = {None, scene.before.get(name), scene.after.get(name)}
        fit |= {PLAIN_ROOT} if name.endswith(".zarr/zarr.json") else set()
        fit |= {MARKED} if name == "database.toml" else set()
        if not disk.may_hold(top, *name.split("/")) <= fit:
            yield name
    for layer in layers:
        fit = [below(tree, layer) for tree in (scene.before, scene.after)]
        for number in disk.may_be(top, *layer.split("/")) - {None}:
            if disk.tree(number, f"{layer}/") not in fit:
                yield layer
    for stage, products in records.items():
        for name, sha in products.items():
            if disk.may_hold(top, *name.split("/")) != {sha}:
                yield f"{stage} without {name}"


@pytest.mark.skipif(os.name == "nt", reason="folders are not synced there")
@pytest.mark.parametrize("name", SCENES)
def test_a_loss_of_power_at_any_moment_leaves_the_old_or_the_new(scenes, name):
    operations, wrong = replay(scenes[name])
    assert operations > 200
    assert not wrong


@pytest.mark.skipif(os.name == "nt", reason="folders are not synced there")
@pytest.mark.parametrize("missing", ["fsync", "sync", "syncfs"])
def test_a_build_that_spares_a_sync_is_found_out(scenes, missing):
    assert replay(scenes["new"], without=(missing,))[1]
    assert replay(scenes["over"], without=(missing,))[1]

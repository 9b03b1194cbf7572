import errno
import json
import os
import threading
from pathlib import Path

import numpy as np
import pytest

from levkas.core import digests, files
from levkas.core.disk import WriteRefused
from levkas.core.files import sweep

OLD, NEW = b"old" * 1000, b"new" * 400_000


class Fail:
    """Fails at the n-th call; counts all of them."""

    def __init__(self, at=None, number=errno.EIO):
        self.at, self.number, self.steps = at, number, []

    def __call__(self, step, path):
        self.steps.append(step)
        if len(self.steps) - 1 == self.at:
            raise OSError(self.number, os.strerror(self.number))


def file_job(folder):
    files.write_bytes(folder / "deep" / "file.bin", NEW)


def folder_job(folder):
    with files.publishing(folder / "deep" / "set") as made:
        for name in ("a", "b/c"):
            made.write_bytes(name, NEW)
        with files.replacing(made.path / "d") as handle:
            handle.write(NEW)


def steps_of(job, folder, monkeypatch):
    count = Fail()
    with monkeypatch.context() as patch:
        patch.setattr(files, "fault", count)
        job(folder)
    return count.steps


def whole(folder, job):
    if job is file_job:
        return {"deep/file.bin": NEW}
    return {f"deep/set/{name}": NEW for name in ("a", "b/c", "d")}


def old_state(folder, job):
    for name in whole(folder, job):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(OLD)


def state(folder):
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


@pytest.mark.parametrize("job", [file_job, folder_job])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EACCES])
@pytest.mark.parametrize("before", [False, True])
def test_a_fault_at_any_step_leaves_the_old_or_the_new_and_nothing_else(
    tmp_path, monkeypatch, job, number, before
):
    count = len(steps_of(job, tmp_path / "count", monkeypatch))
    assert count >= 6
    codes = {errno.ENOSPC: "E_DISK_FULL", errno.EIO: "E_IO", errno.EACCES: "E_UNWRITABLE"}
    for at in range(count + before):
        folder = tmp_path / f"at{at}"
        folder.mkdir()
        if before:
            old_state(folder, job)
        start = state(folder)
        monkeypatch.setattr(files, "fault", Fail(at, number))
        try:
            job(folder)
        except WriteRefused as refusal:
            assert refusal.problems[0].code == codes[number]
            assert state(folder) in (start, whole(folder, job))
        monkeypatch.setattr(files, "fault", files._no_fault)
        job(folder)
        sweep(folder)
        assert state(folder) == whole(folder, job)


def killed_at(job, folder, at):
    """Run `job` in a child that dies just before its step `at`; return its exit status."""
    child = os.fork()
    if child == 0:
        steps = []

        def die(step, path):
            steps.append(step)
            if len(steps) - 1 == at:
                os._exit(9)

        files.fault = die
        job(folder)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("job", [file_job, folder_job])
def test_a_kill_at_any_step_then_a_second_run_gives_the_same_bytes(tmp_path, job):
    for at in range(100):
        folder = tmp_path / f"at{at}"
        folder.mkdir()
        old_state(folder, job)
        start = state(folder)
        status = killed_at(job, folder, at)
        visible = {k: v for k, v in state(folder).items() if ".partial-" not in k}
        assert visible in (start, whole(folder, job))
        if status == 0:
            break
        sweep(folder)
        job(folder)
        assert state(folder) == whole(folder, job)
    assert at >= 5


def test_the_data_are_synced_before_the_name_and_the_name_before_the_end(tmp_path, monkeypatch):
    calls = []
    real = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: calls.append(os.fstat(fd).st_mode) or real(fd))
    files.write_bytes(tmp_path / "a", b"1")
    assert [mode & 0o170000 for mode in calls] == [0o100000, 0o040000]


def test_a_full_disk_is_foreseen_with_bytes_needed_and_free(tmp_path):
    with (
        pytest.raises(WriteRefused) as info,
        files.replacing(tmp_path / "big", bytes_needed=1 << 60),
    ):
        pass
    problem = info.value.problems[0]
    assert problem.code == "E_DISK_FULL"
    assert problem.expected == f"{1 << 60} bytes"
    assert problem.found.endswith("bytes free")
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_the_caller_passes_as_it_is_and_leaves_nothing(tmp_path):
    with pytest.raises(FileNotFoundError), files.replacing(tmp_path / "a") as handle:
        handle.write(b"half")
        Path("/nowhere/at/all").read_bytes()
    with pytest.raises(KeyboardInterrupt), files.publishing(tmp_path / "b") as folder:
        folder.write_bytes("half", b"x")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_sweep_spares_what_is_being_written(tmp_path):
    with files.replacing(tmp_path / "a") as handle, files.publishing(tmp_path / "b") as folder:
        handle.write(b"x")
        folder.write_bytes("c", b"y")
        (tmp_path / "old.levkas.partial-0123abcd").write_bytes(b"left behind")
        (tmp_path / "set.levkas.partial-0123abcd").mkdir()
        (tmp_path / "by another program.partial-0123abcd").write_bytes(b"z")
        assert [p.name for p in sweep(tmp_path)] == [
            "old.levkas.partial-0123abcd",
            "set.levkas.partial-0123abcd",
        ]
    assert state(tmp_path) == {"a": b"x", "b/c": b"y", "by another program.partial-0123abcd": b"z"}


@pytest.mark.parametrize("name", ["../out", "a/../../out", "/out"])
def test_no_name_leads_out_of_a_folder_that_is_written(tmp_path, name):
    (tmp_path / "source").write_bytes(b"x")
    source = tmp_path / "source"
    for write in (lambda f: f.write_bytes(name, b"y"), lambda f: f.copy_file(source, name)):
        with pytest.raises(WriteRefused), files.publishing(tmp_path / "b" / "c") as folder:
            write(folder)
    assert state(tmp_path) == {"source": b"x"}


def joint_job(folder, before=None):
    with files.together(before):
        files.write_bytes(folder / "a", NEW)
        with files.publishing(folder / "set") as made:
            made.write_bytes("b", NEW)
            with files.replacing(made.path / "c") as handle:
                handle.write(NEW)
        files.remove(folder / "gone")
        files.write_bytes(folder / "deep" / "d", NEW)


JOINT = ("a", "set/b", "set/c", "deep/d")


def joint_before(folder):
    for name in (*JOINT, "gone"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(OLD)
    return state(folder)


def test_what_belongs_together_changes_together(tmp_path):
    before, observed = joint_before(tmp_path), []

    def look():
        swept = sweep(tmp_path)
        observed.append((swept, {n: d for n, d in state(tmp_path).items() if "partial" not in n}))

    joint_job(tmp_path, look)
    assert observed == [([], before)]
    assert state(tmp_path) == dict.fromkeys(JOINT, NEW)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_a_disk_that_refuses_one_of_several_files_leaves_all_as_they_were(
    tmp_path, monkeypatch, number
):
    joint_before(tmp_path / "first")
    steps, taking = steps_of(joint_job, tmp_path / "first", monkeypatch), 0
    for at in range(len(steps)):
        folder, names = tmp_path / str(at), []
        before = joint_before(folder)
        with monkeypatch.context() as patch:
            fail = Fail(at, number)
            patch.setattr(files, "fault", fail)
            with pytest.raises(WriteRefused):
                joint_job(folder, lambda names=names: names.append("before"))
        left = state(folder)
        if not names:
            assert left == before
            continue
        taking += 1  # names are being taken: each is the old or the new one
        assert all(left[n] in (OLD, NEW) for n in JOINT)
        assert set(left) <= {*JOINT, "gone"}
    assert 0 < taking < len(steps) / 2


def test_two_writers_of_one_folder_both_succeed(tmp_path):
    def publish(value):
        for _ in range(30):
            with files.publishing(tmp_path / "set") as folder:
                folder.write_bytes("a", value)
                folder.write_bytes("b", value)

    both = [threading.Thread(target=publish, args=(v,)) for v in (b"1", b"2")]
    [t.start() for t in both]
    [t.join() for t in both]
    assert state(tmp_path) in ({"set/a": v, "set/b": v} for v in (b"1", b"2"))


def test_json_holds_no_nan_and_takes_numpy(tmp_path):
    listed = np.array([[1.0, np.inf]])
    record = {"x": np.float32("nan"), "n": np.int64(3), "a": listed, "p": tmp_path}
    files.write_json(tmp_path / "r.json", record)
    read = json.loads((tmp_path / "r.json").read_text("utf-8"))
    assert read == {"x": None, "n": 3, "a": [[1.0, None]], "p": tmp_path.as_posix()}


def test_hashes_are_those_of_the_standard(tmp_path):
    files.write_text(tmp_path / "a" / "one", "abc")
    files.write_text(tmp_path / "two", "abc")
    # The SHA-256 of "abc" is a test vector of FIPS 180-2.
    vector = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert digests.hash_tree(tmp_path) == {"a/one": vector, "two": vector}
    files.remove(tmp_path / "a")
    files.remove(tmp_path / "never")
    assert digests.hash_tree(tmp_path) == {"two": vector}


def test_a_folder_into_which_something_comes_meanwhile_is_taken_away_all_the_same(
    tmp_path, monkeypatch
):
    files.write_text(tmp_path / "left" / "one", "1")
    rmtree, tries = files.shutil.rmtree, []

    def interrupted(path, **more):
        tries.append(path)
        if len(tries) > 1:
            rmtree(path, **more)

    monkeypatch.setattr(files.shutil, "rmtree", interrupted)
    files.remove(tmp_path / "left")
    assert not [*tmp_path.iterdir()] and len(tries) == 2

"""Two builds of one output at once, and builds where nothing changed."""

import json
import os
import subprocess
import sys
import threading
import time

import pytest

from levkas.building import build, status, summarise
from levkas.building.build_records import BuildRecords, Key
from levkas.building.claiming import in_turn
from levkas.core.digests import hash_tree
from levkas.core.files import PARTIAL
from levkas.database.validation import validate

BUILD = """
import sys, time
from levkas.building import build, summarise
sys.stdin.readline()
report = summarise(build(sys.argv[1], output=sys.argv[2], objects=sys.argv[3:] or None))
print(report.text)
sys.exit(not report.ok)
"""


@pytest.fixture(scope="module")
def plates(make_plates, tmp_path_factory):
    """A campaign, and the hashes of its database as a lone build makes it."""
    folder = make_plates(tmp_path_factory.mktemp("plates") / "campaign")
    output = folder.parent / "alone"
    report = summarise(build(folder, output=output))
    assert report.ok, report.text
    return folder, output


def start_together(folder, output, *objects):
    """Run a build a tuple of objects, each in a process of its own, and return what they printed."""
    command = [sys.executable, "-c", BUILD, str(folder), str(output)]
    builders = [
        subprocess.Popen(
            [*command, *names], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for names in objects
    ]
    for builder in builders:
        builder.stdin.write("go\n")
        builder.stdin.flush()
    reported = [builder.communicate(timeout=900)[0] for builder in builders]
    assert [builder.returncode for builder in builders] == [0] * len(objects), reported
    return reported


def left_over(*folders):
    return [p for folder in folders for p in folder.rglob("*") if PARTIAL.fullmatch(p.name)]


def check_whole(folder, output, alone):
    assert hash_tree(output) == hash_tree(alone)
    assert not left_over(output, output.with_name(output.name + ".kept"))
    assert {s.state for s in status(folder, output=output).stages} == {"fresh"}
    assert validate(output).ok


@pytest.mark.slow
def test_two_processes_at_once_make_what_one_makes(plates, tmp_path):
    folder, alone = plates
    start_together(folder, tmp_path / "database", (), ())
    check_whole(folder, tmp_path / "database", alone)


@pytest.mark.slow
def test_two_processes_with_an_object_each_lose_no_row_of_the_catalogue(plates, tmp_path):
    folder, alone = plates
    start_together(folder, tmp_path / "database", ("one",), ("two",))
    check_whole(folder, tmp_path / "database", alone)


@pytest.mark.slow
def test_two_threads_at_once_make_what_one_makes(plates, tmp_path):
    folder, alone = plates
    reports = []
    barrier = threading.Barrier(2)

    def work():
        barrier.wait()
        reports.append(summarise(build(folder, output=tmp_path / "database")))

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(240)
    assert [report.ok for report in reports] == [True, True], [r.text for r in reports]
    check_whole(folder, tmp_path / "database", alone)


@pytest.mark.slow
def test_two_builds_step_by_step_in_turn_make_what_one_makes(plates, tmp_path):
    folder, alone = plates
    output = tmp_path / "database"
    turns = [build(folder, output=output), build(folder, output=output)]
    while turns:
        turns = [steps for steps in turns if next(steps, None) is not None]
    check_whole(folder, output, alone)


def test_what_a_build_noted_outlasts_another_that_does_the_stage_again(tmp_path):
    (tmp_path / "database").mkdir()
    key = Key("one", "photo", stage="calibrate")
    mine, other = (BuildRecords(tmp_path / "kept", tmp_path / "database") for _ in range(2))
    mine.keep(key, {"code": "1"}, [], captured="2019-08-29")
    other.forget(key)
    assert mine.notes(key) == {"captured": "2019-08-29"} and other.notes(key) == {}


def test_turns_are_taken_and_not_waited_for_without_end(tmp_path):
    with in_turn(tmp_path):
        start = time.monotonic()
        with in_turn(tmp_path, patience_s=0.2):
            waited = time.monotonic() - start
        assert 0.1 < waited < 120


def standing(output):
    """Inode, size and time of every file and folder of a database and of what is kept beside it."""
    found = {}
    for root in (output, output.with_name(output.name + ".kept")):
        for path in (root, *root.rglob("*")):
            reported = path.stat()
            found[path] = (reported.st_ino, reported.st_size, reported.st_mtime_ns)
    return found


def test_where_all_is_fresh_nothing_at_all_is_written(plates):
    folder, output = plates
    before = standing(output)
    report = summarise(build(folder, output=output))
    assert {step.state for step in report.stages} == {"fresh"}
    assert status(folder, output=output).ok
    assert standing(output) == before


@pytest.mark.slow
def test_where_all_is_fresh_no_heavy_module_is_loaded(plates):
    folder, output = plates
    heavy = ("cv2", "numba", "rawpy", "tifffile", "zarr", "scipy")
    for call in (
        "summarise(build(*sys.argv[1:2], output=sys.argv[2]))",
        "status(sys.argv[1], output=sys.argv[2])",
    ):
        script = f"""
import json, sys
from levkas.building import build, status, summarise
report = {call}
assert report.ok
print(json.dumps([name for name in {heavy} if name in sys.modules]))
"""
        result = subprocess.run(
            [sys.executable, "-c", script, str(folder), str(output)],
            check=True,
            capture_output=True,
            text=True,
            env=os.environ,
        )
        assert json.loads(result.stdout) == []

"""The index of a large campaign: the answer of a full comparison, none where it does not fit, and every input seen."""

import json
import os
import shutil
import sqlite3
import time
from contextlib import closing

import cv2
import pytest
from typer.testing import CliRunner

from levkas.building import build, status, summarise
from levkas.building.build_index import INDEX
from levkas.building.build_records import Key
from levkas.cli import app
from levkas.core.files import write_bytes


@pytest.fixture(scope="module")
def built(make_plates, tmp_path_factory):
    folder = make_plates(tmp_path_factory.mktemp("index") / "campaign")
    list(build(folder))
    return folder


@pytest.fixture
def large(built, tmp_path, monkeypatch):
    """A built campaign that counts as large, with its index."""
    monkeypatch.setattr("levkas.building.run.LARGE", 1)
    monkeypatch.setattr("levkas.building.build_index.COARSE_TICK_NS", 10**8)
    folder = tmp_path / "campaign"
    shutil.copytree(built, folder)
    rest()
    list(build(folder))
    assert index_of(folder).is_file()
    return folder


def index_of(folder):
    return folder / "database.kept" / INDEX


def rest():
    """Wait until what was written just before is older than a tick of the clock."""
    time.sleep(0.25)


def rewrite(path):
    """Change a picture in place; its time of modification stays."""
    before = path.stat()
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    picture[0, 0] ^= 1
    data = cv2.imencode(path.suffix, picture)[1].tobytes()
    with path.open("r+b") as file:
        file.write(data)
        file.truncate()
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def states(report):
    found = {state: [s.state for s in report.stages].count(state) for state in ("fresh", "stale")}
    return found | {"fresh": found["fresh"] + report.unlisted.get("fresh", 0)}


def stages_done(folder, **options):
    return {(s.key.object, s.key.layer, s.key.stage) for s in build(folder, **options) if s.state == "done"}  # fmt: skip


def test_a_small_campaign_has_none_and_every_stage_is_listed(built):
    assert not index_of(built).exists()
    report = status(built)
    assert len(report.stages) == 15 and not report.compared
    assert set(report.to_dict()) == {"output", "stages", "warnings"}


def test_it_gives_the_answer_of_the_full_comparison_and_says_what_was_compared(large):
    told, whole = status(large), status(large, verify="full")
    assert [s.key.stage for s in told.stages] == ["catalogue"] and len(whole.stages) == 15
    assert states(told) == states(whole) == {"fresh": 15, "stale": 0}
    assert "as of the last build" in told.text and "all 5 files" in told.text
    assert "as of the last build" not in whole.text
    report = json.loads(CliRunner().invoke(app, ["status", str(large), "--json"]).output)
    assert report["unlisted"] == {"fresh": 14} and report["ok"]
    assert "--full" in report["compared"]
    listed = json.loads(CliRunner().invoke(app, ["status", str(large), "--json", "--full"]).output)
    assert len(listed["stages"]) == 15 and "compared" not in listed
    drawn = CliRunner().invoke(app, ["status", str(large), "--graph"]).output
    assert drawn.count(":::fresh") == 15


def test_a_build_with_nothing_to_do_reads_no_record(large, monkeypatch):
    monkeypatch.setattr("levkas.building.run.BuildRecords", None)
    steps = list(build(large))
    assert [(s.key.stage, s.state, s.done, s.total) for s in steps] == [
        ("catalogue", "fresh", 15, 15)
    ]
    report = summarise(steps)
    assert report.ok and "15 fresh" in report.text and report.output == large / "database"


def damaged_facts(path):
    with closing(sqlite3.connect(path)) as index, index:
        index.execute("UPDATE facts SET text = replace(text, '\"fresh\": 15', '\"fresh\": 99')")


def lost_rows(path):
    with closing(sqlite3.connect(path)) as index, index:
        index.execute("DELETE FROM inputs")
        index.execute("DELETE FROM products")


DAMAGES = {
    "gone": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b""),
    "garbage": lambda path: path.write_bytes(b"no index" * 4096),
    "torn": lambda path: path.write_bytes(path.read_bytes()[:4096] + os.urandom(8192)),
    "other words": damaged_facts,
    "fewer rows": lost_rows,
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("by", ["status", "build"])
def test_one_that_is_damaged_is_made_again_with_the_same_answer(large, damage, by):
    before = status(large)
    DAMAGES[damage](index_of(large))
    rest()
    if by == "status":
        report = status(large)
        assert not report.compared and len(report.stages) == 15
    else:
        assert [s.state for s in build(large)] == ["fresh"] * 15
    assert status(large).to_dict() == before.to_dict()


@pytest.mark.parametrize("what", ["in place", "new", "gone", "campaign.toml", "edits.toml"])
def test_a_changed_input_is_seen_by_status_and_by_a_build(large, what):
    frame = large / "infrared/two.png"
    if what == "in place":
        rewrite(frame)
    elif what == "new":
        shutil.copy(frame, large / "infrared/spare.png")
    elif what == "gone":
        frame.unlink()
    elif what == "campaign.toml":
        path = large / "campaign.toml"
        path.write_text(path.read_text().replace('"Plates"', '"Boards"'))
    else:
        (large / "edits.toml").write_text(
            "version = 1\n[objects.two.cameras.infrared]\nreject = 4.0\n"
        )
    report = status(large)
    assert [s.key.stage for s in report.stages if s.state == "stale"] == ["inputs", "catalogue"]
    told = report.stages[0].why
    named = {
        "in place": "infrared: two.png",
        "new": "spare.png",
        "gone": "2 files were here, now 1",
    }
    assert named.get(what, what) in told
    done = stages_done(large)
    if what == "in place":
        assert ("two", "infrared", "calibrate") in done
        assert not any(name == "one" for name, _, _ in done)
    else:
        assert bool(done) == (what != "new")
    rest()
    assert "stale" not in {s.state for s in status(large).stages}


def test_frames_that_are_too_many_for_status_are_compared_by_a_build(large, monkeypatch):
    monkeypatch.setattr("levkas.building.build_index.MOST_STAMPED", 1)
    rewrite(large / "infrared/two.png")
    report = status(large)
    assert states(report)["stale"] == 0 and "names in 3 folders" in report.compared
    rest()
    assert ("two", "infrared", "calibrate") in stages_done(large)
    (large / "infrared/three.png").write_bytes(b"x")
    assert states(status(large))["stale"] == 2


@pytest.mark.parametrize("how", ["gone", "replaced", "record gone"])
def test_a_build_sees_what_was_taken_from_the_database_or_the_records(large, how):
    tiff = large / "database/objects/two/two_infrared.tif"
    if how == "gone":
        tiff.unlink()
    elif how == "replaced":
        write_bytes(tiff, b"II*\0 another")
    else:
        (large / "database.kept/two/infrared/resample.json").unlink()
    assert "no file of the database" in status(large).compared
    assert ("two", "infrared", "resample") in {
        (s.key.object, s.key.layer, s.key.stage)
        for s in status(large, verify="full").stages
        if s.state == "stale"
    }
    assert ("two", "infrared", "resample") in stages_done(large)


def test_a_product_changed_in_place_is_seen_by_the_full_comparison(large):
    rewrite(large / "database/objects/two/two_infrared.png")
    assert stages_done(large) == set()
    assert ("two", "infrared", "resample") in stages_done(large, verify="full")


def test_a_build_of_one_object_or_one_that_was_interrupted_leaves_none(large):
    list(build(large, objects=["one"]))
    assert not index_of(large).exists()
    rest()
    list(build(large))
    assert index_of(large).exists()
    rewrite(large / "infrared/two.png")
    rest()
    steps = build(large)
    next(step for step in steps if step.state == "running")
    steps.close()
    assert not index_of(large).exists()
    assert states(status(large))["stale"] > 0 and not index_of(large).exists()


def test_an_input_that_changes_while_a_build_reads_is_in_no_index(large):
    rewrite(large / "infrared/two.png")
    rest()
    for step in build(large):
        if step.finished and step.key == Key("two", stage="report"):
            rewrite(large / "infrared/one.png")
    assert not index_of(large).exists()
    assert ("one", "infrared", "calibrate") in stages_done(large)


def test_an_input_that_was_changed_just_before_is_in_no_index(large):
    rewrite(large / "infrared/two.png")
    list(build(large))
    assert not index_of(large).exists()
    rest()
    assert not status(large).compared
    assert status(large).compared


def test_refusals_are_said_again_and_those_without_a_record_are_tried_again(large):
    frame = large / "infrared/two.png"
    whole = frame.read_bytes()
    shutil.copy(large / "infrared/one.png", frame)  # another plate: a registration with a record
    rest()
    first = summarise(build(large))
    assert not first.ok and index_of(large).is_file()
    again = list(build(large))
    assert [s.key.stage for s in again] == ["register", "catalogue"]
    assert summarise(again).problems == first.problems == status(large).problems
    frame.write_bytes(whole[: len(whole) // 2])  # cannot be read: each build tries it again
    rest()
    lost = summarise(build(large))
    assert [s.key for s in status(large).stages if s.state == "refused"] == [
        s.key for s in lost.stages if s.state == "refused"
    ]
    assert any(s.state == "running" for s in build(large))


def test_other_code_is_compared_anew(large, monkeypatch):
    assert status(large).compared
    monkeypatch.setattr("levkas.building.build_index.package_stamp", lambda: "other")
    assert not status(large).compared

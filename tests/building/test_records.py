"""The file of records: whole after a kill, on a full disk, where it is damaged, and beside another build."""

import errno
import hashlib
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from levkas.building import records_file
from levkas.building.build_records import BuildRecords, Key
from levkas.building.hashes import Hashes
from levkas.building.records_file import NAME, read_rows
from levkas.core import files
from levkas.core.digests import hash_file, stamp_of
from levkas.core.disk import WriteRefused
from levkas.core.problems import Problem

KEY = Key("one", "photo", stage="calibrate")
PRINTS = {"code": "1"}


@pytest.fixture
def folders(tmp_path):
    """What is kept, and a database with one product, of a stage that is finished."""
    kept, output = tmp_path / "kept", tmp_path / "database"
    kept.mkdir()
    output.mkdir()
    (output / "a.tif").write_bytes(b"pixels")
    BuildRecords(kept, output).keep(KEY, PRINTS, [output / "a.tif"], captured="2019-08-29")
    return kept, output


def change(kept, statement):
    with closing(sqlite3.connect(kept / NAME)) as rows, rows:
        rows.execute(statement)
        assert rows.total_changes


def test_a_finished_stage_is_fresh_for_the_next_build_and_notes_what_it_noted(folders):
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == "" and records.recorded() == [KEY]
    assert records.notes(KEY) == {"captured": "2019-08-29"}
    assert records.why_stale(KEY, {"code": "2"}) == 'code "1" → "2"'
    sha = hashlib.sha256(b"pixels").hexdigest()
    assert list(records.products_that_stand()) == [("a.tif", sha)]


def test_a_refusal_stands_beside_what_was_made_before_and_goes_when_the_stage_is_finished(folders):
    problem = Problem("E_VALUE", "too dark")
    BuildRecords(*folders).refuse(KEY, PRINTS, [problem])
    records = BuildRecords(*folders)
    assert records.refusal(KEY, PRINTS) == (problem,) and records.refusal(KEY, {}) == ()
    records.keep(KEY, PRINTS, [])
    assert BuildRecords(*folders).refusal(KEY, PRINTS) == ()


@pytest.mark.parametrize(
    "flipped",
    [
        "record = replace(record, '2019', '2018')", "record = NULL", "record = x'00ff'", "record = 'x'",
        "sha256 = 'ffff'", "sha256 = NULL",
    ],
)  # fmt: skip
def test_a_damaged_record_is_of_a_stage_that_is_done_again(folders, flipped):
    change(folders[0], f"UPDATE stages SET {flipped}")
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == "its record is damaged"
    assert not records.notes(KEY) and not records.recorded() and not records.products(KEY)
    records.keep(KEY, PRINTS, [])
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == ""


@pytest.mark.parametrize("flipped", ["stage = 'register'", "camera = CAST(x'ff70' AS TEXT)"])
def test_a_record_that_a_flipped_bit_gives_another_stage_is_nobodys(folders, flipped):
    other = Key("two", "photo", stage="calibrate")
    BuildRecords(*folders).keep(other, PRINTS, [])
    change(folders[0], f"UPDATE stages SET {flipped} WHERE object = 'one'")
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == "not yet built" and records.recorded() == [other]


def torn(path):
    data = path.read_bytes()  # the page of the tables' names is whole
    path.write_bytes(data[:4096] + os.urandom(len(data) - 4096))


def other_tables(path):
    path.unlink()
    with closing(sqlite3.connect(path)) as rows, rows:
        rows.execute("CREATE TABLE stages (object, sha256, more INTEGER NOT NULL)")
        rows.execute("CREATE VIEW files AS SELECT 1 AS name")


@pytest.mark.parametrize(
    "damage",
    [Path.unlink, lambda path: path.write_bytes(b"no records" * 1000), torn, other_tables],
    ids=["gone", "garbage", "torn", "other tables"],
)
def test_a_damaged_file_is_as_none_and_is_made_anew(folders, damage):
    damage(folders[0] / NAME)
    records, product = BuildRecords(*folders), folders[1] / "a.tif"
    assert records.why_stale(KEY, PRINTS) == "not yet built" and not records.recorded()
    assert records.hashes.known(product) is None
    records.keep(KEY, PRINTS, [product])
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == ""
    assert Hashes(folders[0] / NAME)(product) == hash_file(product)


KILLED = """
import os, sqlite3, sys
rows = sqlite3.connect(sys.argv[1])
rows.execute("PRAGMA cache_size = 1")  # pages go to the disk before the end
rows.execute("UPDATE stages SET state = 'was'")
rows.executemany("INSERT INTO stages VALUES ('x', ?, '', '', 'done', ?, '')", [(n, "x" * 5000) for n in range(500)])
os._exit(9)
"""


def test_a_transaction_of_a_killed_build_is_undone(folders):
    path = folders[0] / NAME
    killed = subprocess.run([sys.executable, "-c", KILLED, path], check=False)
    assert killed.returncode == 9 and path.with_name(f"{NAME}-journal").stat().st_size
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == ""
    assert BuildRecords(*folders).recorded() == [KEY]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
@pytest.mark.parametrize("at", ["write", "fsync"])
def test_what_the_disk_refuses_is_a_refusal_and_the_record_is_what_it_was(
    folders, monkeypatch, at, number
):
    def fault(step, path):
        if step == at and path.name == NAME:
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(files, "fault", fault)
    with pytest.raises(WriteRefused):
        BuildRecords(*folders).keep(KEY, {"code": "2"}, [folders[1] / "a.tif"])
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == ""


def test_a_record_that_another_build_is_writing_is_waited_for_and_then_refused(
    folders, monkeypatch
):
    monkeypatch.setattr(records_file, "PATIENCE_S", 0.05)
    with closing(sqlite3.connect(folders[0] / NAME)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(WriteRefused):
            BuildRecords(*folders).drop(KEY)
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == ""


def test_reading_makes_no_file(tmp_path):
    records = BuildRecords(tmp_path, tmp_path)
    assert records.why_stale(KEY, PRINTS) == "not yet built" and not records.recorded()
    assert not read_rows(tmp_path / "nowhere" / NAME, "SELECT * FROM files")
    Hashes(tmp_path / NAME).save()
    assert not list(tmp_path.iterdir())


def test_what_a_build_noted_outlasts_another_that_does_the_stage_again(folders):
    mine, other = BuildRecords(*folders), BuildRecords(*folders)
    mine.keep(KEY, PRINTS, [], captured="2019-08-30")
    other.drop(KEY)
    assert mine.notes(KEY) == {"captured": "2019-08-30"} and other.notes(KEY) == {}


# --- hashes of files


@pytest.fixture
def kept(tmp_path):
    """An index of one file, whose hash in it is not its own: so one sees where it comes from."""
    frame, index = tmp_path / "frame \udcff.tif", tmp_path / "a ?#%25&mode=ro é" / NAME
    index.parent.mkdir()
    frame.write_bytes(b"frame")
    hashes = Hashes(index)
    hashes._learn(frame, (*stamp_of(frame), "f" * 64), old_enough=True)
    hashes.save()
    return frame, index


@pytest.mark.parametrize(
    "flipped", ["sha256 = NULL", "sha256 = 'ffff'", "inode = 'one'", "size = NULL"]
)
def test_a_damaged_row_of_the_index_is_read_again(kept, flipped):
    frame, index = kept
    assert Hashes(index)(frame) == "f" * 64  # by its stamp
    change(index.parent, f"UPDATE files SET {flipped}")
    assert Hashes(index)(frame) == hash_file(frame)


def test_two_builds_write_one_index(tmp_path):
    for number in range(2):
        path, hashes = tmp_path / f"{number}", Hashes(tmp_path / NAME)
        path.write_bytes(b"x")
        hashes(path, own=True)
        hashes.save()
    both = Hashes(tmp_path / NAME)
    assert both.known(tmp_path / "0") and both.known(tmp_path / "1")


def test_where_files_cannot_be_locked_records_are_kept_all_the_same(folders, monkeypatch):
    monkeypatch.setattr(records_file, "take", lambda descriptor, shared: None)
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == ""
    records.drop(KEY)
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == "not yet built"

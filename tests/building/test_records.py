"""The file of records: whole after a kill, on a full disk, where it is damaged, and beside another build."""

import errno
import hashlib
import os
import sqlite3
import subprocess
import sys
from contextlib import closing

import pytest

from levkas.building import records_file
from levkas.building.build_records import BuildRecords, Key
from levkas.building.hashes import Hashes
from levkas.building.records_file import NAME, read_rows, sweep_older_records
from levkas.core import files
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
    assert records.why_stale(KEY, {"code": "2"}) == "code changed"
    sha = hashlib.sha256(b"pixels").hexdigest()
    assert list(records.products_that_stand()) == [("a.tif", sha)]


def test_a_stage_that_is_being_done_anew_is_not_finished_and_what_it_made_is_known(folders):
    BuildRecords(*folders).forget(KEY)
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == "not yet built"
    assert records.made_by(KEY) == {"a.tif"} and records.recorded() == [KEY]
    assert not list(records.products_that_stand())


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
    assert not records.notes(KEY) and not records.recorded() and not records.made_by(KEY)
    records.keep(KEY, PRINTS, [])
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == ""


@pytest.mark.parametrize("part", ["object", "camera", "setup", "stage"])
def test_a_record_that_a_flipped_bit_gives_another_stage_is_nobodys(folders, part):
    change(folders[0], f"UPDATE stages SET {part} = 'register'")
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == "not yet built" and not records.recorded()


def test_a_record_under_bytes_that_are_no_text_hides_no_other(folders):
    other = Key("two", "photo", stage="calibrate")
    BuildRecords(*folders).keep(other, PRINTS, [])
    change(folders[0], "UPDATE stages SET camera = CAST(x'ff70' AS TEXT) WHERE object = 'one'")
    assert BuildRecords(*folders).recorded() == [other]


@pytest.mark.parametrize(
    "content", [b"", b"no records" * 1000, None], ids=["empty", "garbage", "torn"]
)
def test_a_damaged_file_is_as_none_and_is_made_anew(folders, content):
    path = folders[0] / NAME
    data = path.read_bytes()
    path.write_bytes(data[:4096] + os.urandom(len(data) - 4096) if content is None else content)
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == "not yet built" and not records.recorded()
    records.keep(KEY, PRINTS, [])
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == ""


def test_tables_of_another_form_are_as_none_and_are_made_anew(folders):
    (folders[0] / NAME).unlink()
    with closing(sqlite3.connect(folders[0] / NAME)) as rows, rows:
        rows.execute("CREATE TABLE stages (object, sha256, more INTEGER NOT NULL)")
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == "not yet built"
    records.keep(KEY, PRINTS, [])
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == ""


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


def test_a_record_is_on_the_disk_before_the_build_goes_on(folders):
    with closing(records_file._connect(folders[0] / NAME, "rw")) as rows:
        assert rows.execute("PRAGMA journal_mode").fetchall() == [("delete",)]
        assert rows.execute("PRAGMA synchronous").fetchall() == [(3,)]  # extra: the folder, too


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
            BuildRecords(*folders).forget(KEY)
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == ""


def test_where_files_cannot_be_locked_records_are_kept_all_the_same(folders, monkeypatch):
    monkeypatch.setattr(records_file, "take", lambda descriptor, shared: None)
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == ""
    records.forget(KEY)
    assert BuildRecords(*folders).why_stale(KEY, PRINTS) == "not yet built"


def test_a_folder_of_any_name_holds_records(tmp_path):
    kept = tmp_path / "a ?#%25&mode=ro é \udcff"
    kept.mkdir()
    BuildRecords(kept, tmp_path).keep(KEY, PRINTS, [])
    assert [path.name for path in kept.iterdir()] == [NAME]
    assert BuildRecords(kept, tmp_path).why_stale(KEY, PRINTS) == ""


def test_reading_makes_no_file(tmp_path):
    records = BuildRecords(tmp_path, tmp_path)
    assert records.why_stale(KEY, PRINTS) == "not yet built" and not records.recorded()
    assert not read_rows(tmp_path / "nowhere" / NAME, "SELECT * FROM files")
    Hashes(tmp_path / NAME).save()
    assert not list(tmp_path.iterdir())


def test_a_database_whose_records_were_taken_away_meanwhile_is_recorded_anew(folders):
    records = BuildRecords(*folders)
    assert records.why_stale(KEY, PRINTS) == ""
    (folders[0] / NAME).unlink()
    other = Key("two", "photo", stage="calibrate")
    records.keep(other, PRINTS, [])
    assert BuildRecords(*folders).recorded() == [other]


def test_records_of_earlier_versions_are_removed_and_nothing_else(tmp_path):
    older = ("hashes.sqlite", "catalogue.json", "one/report.json", "one/photo/register.was")
    stays = (
        "campaign.json",
        "one/photo/measured.npz",
        "one/photo/register.error.txt",
    )
    for name in (*older, *stays, "one/photo/calibrate.refused"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("{}")
    sweep_older_records(tmp_path)
    assert {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()} == {
        *stays
    }
    (tmp_path / "one/mine.json").write_text("{}")
    sweep_older_records(tmp_path)
    assert (tmp_path / "one/mine.json").is_file()

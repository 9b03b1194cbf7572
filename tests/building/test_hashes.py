"""Recorded hashes: found again, made anew where the file is damaged, never taken against a stamp."""

import os
import sqlite3
import time

import pytest

from levkas.building.hashes import Hashes
from levkas.building.records_file import NAME
from levkas.core.digests import hash_file, stamp_of
from levkas.database.catalogue import Entry, read_catalogue, write_catalogue


@pytest.fixture
def kept(tmp_path):
    """An index of one file, whose hash in it is not its own: so one sees where it comes from."""
    frame, index = tmp_path / "frame \udcff.tif", tmp_path / NAME
    frame.write_bytes(b"frame")
    hashes = Hashes(index)
    hashes._learn(frame, (*stamp_of(frame), "f" * 64), old_enough=True)
    hashes.save()
    return frame, index


def test_what_was_read_is_found_again_by_its_stamp(kept):
    frame, index = kept
    assert Hashes(index)(frame) == "f" * 64
    assert Hashes(index, verify=True)(frame) == hash_file(frame)
    frame.write_bytes(b"other")
    assert Hashes(index)(frame) == hash_file(frame)


@pytest.mark.parametrize("damage", ["gone", "empty", "garbage", "torn"])
def test_an_index_that_is_damaged_is_made_anew(kept, damage):
    frame, index = kept
    data = index.read_bytes()
    index.unlink()
    torn = data[:4096] + os.urandom(len(data) - 4096)  # the page of the tables' names is whole
    if damage != "gone":
        index.write_bytes({"empty": b"", "garbage": b"no index" * 1000, "torn": torn}[damage])
    hashes = Hashes(index)
    assert hashes.known(frame) is None
    hashes._learn(frame, (*stamp_of(frame), "e" * 64), old_enough=True)
    hashes.save()
    assert hashes(frame) == Hashes(index)(frame) == "e" * 64


@pytest.mark.parametrize(
    "change",
    ["sha256 = NULL", "sha256 = 'ffff'", "sha256 = x'00ff'", "inode = 'one'", "size = NULL", "size = 'x'"],
)  # fmt: skip
def test_a_damaged_row_of_the_index_is_read_again(kept, change):
    frame, index = kept
    with sqlite3.connect(index) as rows:
        rows.execute(f"UPDATE files SET {change}")
    hashes = Hashes(index)
    assert hashes(frame) == hash_file(frame)
    hashes._learn(frame, (*stamp_of(frame), "e" * 64), old_enough=True)
    hashes.save()
    assert Hashes(index)(frame) == "e" * 64


def test_a_hash_that_another_process_took_late_enough_counts_over_one_of_a_file_just_changed(
    kept, monkeypatch
):
    frame, index = kept
    hashes = Hashes(index, verify=True)
    monkeypatch.setattr("levkas.building.hashes.is_old_enough", lambda stamp, now: False)
    assert hashes(frame) == hash_file(frame)
    hashes._learn(frame, (*stamp_of(frame), "e" * 64), old_enough=True)
    monkeypatch.undo()
    time.sleep(0.2)  # past the tick: a reading by `save` would be recorded
    hashes.save()
    assert hashes(frame) == Hashes(index)(frame) == "e" * 64


@pytest.mark.parametrize(
    "table",
    [
        "CREATE TABLE files (name TEXT, sha256 TEXT)",
        "CREATE TABLE files (name, size, modified, changed, inode, sha256, more INTEGER NOT NULL)",
        "CREATE VIEW files AS SELECT 1 AS name",
        "CREATE TABLE others (name TEXT)",
    ],
)
def test_an_index_of_another_form_is_made_anew(kept, table):
    frame, index = kept
    index.unlink()
    with sqlite3.connect(index) as rows:
        rows.execute(table)
    hashes = Hashes(index)
    assert hashes(frame) == hash_file(frame)
    hashes._learn(frame, (*stamp_of(frame), "e" * 64), old_enough=True)
    hashes.save()
    assert Hashes(index)(frame) == "e" * 64


def test_two_builds_write_one_index(tmp_path):
    one, other = Hashes(tmp_path / NAME), Hashes(tmp_path / NAME)
    for number, hashes in enumerate((one, other)):
        path = tmp_path / f"{number}"
        path.write_bytes(b"x")
        hashes(path, own=True)
        hashes.save()
    both = Hashes(tmp_path / NAME)
    assert both.known(tmp_path / "0") and both.known(tmp_path / "1")


@pytest.mark.slow
def test_a_catalogue_of_many_layers_is_read(tmp_path):
    """More than 16 MiB, by long names."""
    long = "x" * 200
    row = ("", 33, 1392, 1040, 2.0, "reflectance", "accept", "a" * 64)
    entries = [Entry(f"icon{n:06d}{long}", "lctf-vis", *row) for n in range(60_000)]
    path = write_catalogue(tmp_path, entries)
    assert path.stat().st_size > 16 << 20
    assert read_catalogue(tmp_path) == tuple(entries)

"""The bytes of a database do not depend on where, when and with how many threads it was built."""

import os

import pytest
from circumstances import EVERY, run

from levkas.building import build, summarise
from levkas.core.digests import hash_tree
from levkas.core.machine import count_threads, tile_rows

FEW = ("1 threads, 64 rows", "3 threads, 97 rows", "OPENBLAS_CORETYPE = Haswell")
"""One more of each kind are exhaustive."""


@pytest.fixture(scope="module")
def plate(make_plates, tmp_path_factory):
    folder = make_plates(tmp_path_factory.mktemp("plate") / "campaign", ("one",))
    assert summarise(build(folder)).ok
    return folder, hash_tree(folder / "database")


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY if os.environ.get("LEVKAS_EVERY_CASE") else FEW)
def test_the_bytes_are_the_same(name, plate, tmp_path):
    folder, expected = plate
    assert run(folder, tmp_path / "database", name) == expected


def test_one_variable_says_how_many_rows(monkeypatch):
    monkeypatch.setenv("LEVKAS_TILE", "97")
    assert (tile_rows(256, 1000), tile_rows(256, 90)) == (97, 90)
    monkeypatch.setenv("LEVKAS_TILE", "whole")
    assert tile_rows(256, 1000) == 1000
    for nonsense in ("", "0", "-1", "many"):
        monkeypatch.setenv("LEVKAS_TILE", nonsense)
        assert (tile_rows(256, 1000), tile_rows(0, 1000)) == (256, 1)


def test_one_variable_says_how_many_threads(monkeypatch):
    monkeypatch.setenv("LEVKAS_THREADS", "3")
    assert count_threads() == 3 and count_threads(2) == 2
    for nonsense in ("", "0", "-1", "many"):
        monkeypatch.setenv("LEVKAS_THREADS", nonsense)
        assert count_threads() >= 1 and count_threads(1) == 1

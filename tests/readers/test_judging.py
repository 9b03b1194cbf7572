"""What the fuzzers hold files against: sound ones pass it, and a reader that is wrong is seen."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
judging = pytest.importorskip("judging", exc_type=ImportError)  # it counts as Unix does
from small_files import raw_seeds, seeds  # noqa: E402

FILES = {name: (data, beside) for name, data, beside in [*seeds(), *list(raw_seeds())[-1:]]}


def laid(folder, name):
    data, beside = FILES[name]
    for other, content in {**beside, name: data}.items():
        (folder / other).write_bytes(content)
    return folder / name


@pytest.mark.parametrize("name", FILES)
def test_small_files_of_every_kind_are_read_as_what_they_are(tmp_path, name):
    came, _, wrong = judging.judge(laid(tmp_path, name))
    assert (came, wrong) == ("read", "")


def test_every_reader_has_a_small_file():
    assert {judging.reader_of(name) for name in FILES} == set(judging.READERS)


@pytest.mark.parametrize("name", ["plain.tif", "gray.png", "photo.jpg", "scan.hdr"])
def test_a_frame_that_is_not_that_of_its_file_is_complained_of(tmp_path, monkeypatch, name):
    path, read = laid(tmp_path, name), judging.read_frame
    monkeypatch.setattr(judging, "read_frame", lambda path: read(path)[:-1])
    assert "WrongAcceptance" in judging.judge(path)[2]


def test_zeros_in_the_place_of_pixels_are_complained_of(tmp_path, monkeypatch):
    read = judging.read_frame
    monkeypatch.setattr(judging, "read_frame", lambda path: np.zeros_like(read(path)))
    assert "WrongAcceptance" in judging.judge(laid(tmp_path, "gray.png"))[2]


def test_an_exception_of_another_kind_is_complained_of(tmp_path, monkeypatch):
    monkeypatch.setattr(judging, "read_json", lambda path: {}["x"])
    monkeypatch.setitem(judging.READERS, "json", (judging.read_record, "json"))
    assert "KeyError" in judging.judge(laid(tmp_path, "record.json"))[2]

"""Small files of every kind, as they are and with bytes spoilt: a sound value or a refusal of ours, and nothing else."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
judging = pytest.importorskip("judging", exc_type=ImportError)  # it counts as Unix does
from small_files import seeds  # noqa: E402

FILES = {name: (data, beside) for name, data, beside in seeds()}
EVERY = pytest.param(400, marks=pytest.mark.exhaustive)


def laid(folder, name, data=None):
    own, beside = FILES[name]
    for other, content in {**beside, name: data or own}.items():
        (folder / other).write_bytes(content)
    return folder / name


@pytest.mark.parametrize("name", FILES)
def test_small_files_of_every_kind_are_read_as_what_they_are(tmp_path, name):
    came, _, wrong = judging.judge(laid(tmp_path, name))
    assert (came, wrong) == ("read", "")


@pytest.mark.parametrize("count", [12, EVERY])
@pytest.mark.parametrize("name", FILES)
def test_a_spoilt_file_gives_a_sound_value_or_our_refusal(tmp_path, name, count):
    rng, own = np.random.default_rng(len(name)), FILES[name][0]
    for _ in range(count):
        data = bytearray(own)
        for place in rng.integers(len(data), size=rng.integers(1, 7)):
            data[place if rng.random() < 0.5 else place % 200] = rng.integers(256)
        keep = len(data) if rng.random() < 0.7 else rng.integers(1, len(data))
        assert judging.judge(laid(tmp_path, name, bytes(data[:keep])))[2] == ""


def test_a_reader_that_is_wrong_is_complained_of(tmp_path, monkeypatch):
    read = judging.read_frame
    monkeypatch.setattr(judging, "read_frame", lambda path: read(path)[:-1])
    assert "WrongAcceptance" in judging.judge(laid(tmp_path, "plain.tif"))[2]
    monkeypatch.setattr(judging, "read_json", lambda path: {}["x"])
    assert "KeyError" in judging.judge(laid(tmp_path, "record.json"))[2]

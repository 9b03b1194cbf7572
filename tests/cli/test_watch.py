"""`levkas watch --once`: a line a frame that is not well, what is missing, and the exit status."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.cli import app

CAMPAIGN = """
[campaign]
reference = { camera = "grey", band = "550 nm" }
[cameras.grey]
kind = "bands"
files = "raw/{target}_{wavelength}nm_{shot}.tif"
wavelengths = [550, 650]
bits = 12
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.98 }
objects = ["icon"]
"""


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "session" / "raw").mkdir(parents=True)
    (tmp_path / "session" / "campaign.toml").write_text(CAMPAIGN)
    return tmp_path / "session"


def put(home: Path, name: str, level: float, seed: int) -> None:
    codes = np.random.default_rng(seed).normal(level, 8, (120, 160)).clip(0, 4095)
    tifffile.imwrite(home / "raw" / name, codes.astype(np.uint16), metadata=None)


def run(*args: str):
    return CliRunner().invoke(app, ["watch", *args])


def test_a_clipped_white_ends_with_1_and_is_to_be_captured_again(home):
    put(home, "dark_550nm_1.tif", 64, 1)
    put(home, "white_550nm_1.tif", 6000, 2)
    done = run(str(home), "--once")
    assert done.exit_code == 1
    assert "stop" in done.stdout and "full scale" in done.stdout
    assert "grey · white · 550 nm · 1 again" in done.stdout and "grey: icon" in done.stdout
    assert {path.name for path in home.iterdir()} == {"campaign.toml", "raw"}  # nothing of its own


def test_good_frames_end_with_0_and_json_lists_them(home):
    for k, (name, level) in enumerate({"dark": 64, "white": 3000, "icon": 1500}.items()):
        put(home, f"{name}_550nm_1.tif", level, k)
    done = run(str(home), "--json")
    assert done.exit_code == 0, done.stdout
    session = json.loads(done.stdout)["session"]
    assert session["counts"] == {"green": 3, "look": 0, "stop": 0, "waiting": 0}
    assert "grey: icon, 650 nm" in [item["what"] for item in session["missing"]]


@pytest.mark.parametrize("how", ["--once", "--json"])
@pytest.mark.parametrize("what", ["missing", "no picture", "no pattern fits"])
def test_without_a_frame_nothing_is_judged_and_that_at_once(home, how, what):
    folder = home.parent / "there"
    if what == "no pattern fits":
        folder = home
        tifffile.imwrite(home / "raw" / "other.tif", np.zeros((8, 8), np.uint16))
    elif what != "missing":
        folder.mkdir()
    if what == "no picture":
        (folder / "notes.txt").write_text("no picture")
    begun = time.monotonic()
    done = run(str(folder), how)
    assert done.exit_code == 1 and time.monotonic() - begun < 20  # patience is 60 s
    if how == "--json":
        said = json.loads(done.stdout)
        (problem,) = said["problems"]
        assert not said["ok"] and problem["file"] == str(folder)
        assert problem["code"] == ("E_UNREADABLE" if what == "missing" else "E_NO_FRAMES")

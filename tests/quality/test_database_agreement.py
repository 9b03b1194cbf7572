"""Two databases of one panel: sessions that agree, a white that is wrong, a panel that changed."""

import json
import shutil
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from typer.testing import CliRunner

from levkas.building import build, summarise
from levkas.cli import app

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from sigma_of_builds import Camera, write_campaign

pytestmark = pytest.mark.slow
SHAPE = (150, 190)
CHANGED = np.s_[60:72, 100:112]


def panel():
    """Even areas with edges and grain between them."""
    rng = np.random.default_rng(5)
    areas = ndimage.gaussian_filter(rng.standard_normal(SHAPE), 9)
    tones = 0.15 + 0.6 * (np.digitize(areas, np.quantile(areas, (0.25, 0.5, 0.75))) / 3)
    return tones * (1 + 0.03 * ndimage.gaussian_filter(rng.standard_normal(SHAPE), 1.2) / 0.25)


def made(folder, *, seed, truth=None, white=1.0, kind="bands"):
    lamp = lambda name, shot, band=0: white if name == "white" else 1.0  # noqa: E731
    camera = Camera(SHAPE)
    camera.rng = np.random.default_rng(seed)
    write_campaign(folder, kind, camera, panel() if truth is None else truth, lamp=lamp, whites=2)
    assert summarise(build(folder)).ok
    return folder / "database"


@pytest.fixture(scope="module")
def databases(tmp_path_factory):
    """Return a function of the name of a database, which is built when it is asked for."""
    root = tmp_path_factory.mktemp("sessions")
    changed = panel()
    changed[CHANGED] -= 0.03
    sessions = {
        "first": {"seed": 1},
        "again": {"seed": 2},
        "dim": {"seed": 3, "white": 0.92},
        "changed": {"seed": 4, "truth": changed},
    }
    return cache(lambda name: made(root / name, **sessions[name]))


def agree(databases, other, *more):
    words = ["agree", str(databases("first")), str(databases(other)), *map(str, more)]
    result = CliRunner().invoke(app, [*words, "--json"])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.output
    return result.exit_code, json.loads(result.stdout)["objects"][0]


def test_two_sessions_of_one_panel_agree_and_nothing_changed(databases):
    code, found = agree(databases, "again")
    (pair,) = found["pairs"]
    assert code == 0 and found["agrees"] and pair["patches"] >= 8
    assert all(abs(band["ratio"] - 1) < 0.01 for band in pair["bands"])
    assert found["changes"]["share"] < 0.02


def test_colour_cameras_of_unknown_sensitivities_are_not_compared_and_do_not_agree(tmp_path):
    pair = [str(made(tmp_path / name, seed=k, kind="mosaic")) for k, name in enumerate("ab")]
    done = CliRunner().invoke(app, ["agree", *pair, "--json"])
    said = json.loads(done.stdout)
    assert done.exit_code == 1 and not said["ok"]
    assert [problem["code"] for problem in said["problems"]] == ["E_BAND_MISSING"]
    assert said["objects"][0]["agrees"] is None and said["objects"][0]["pairs"] == []
    assert said["objects"][0]["changes"]["share"] < 0.02  # of bands of one name


def test_a_white_that_was_brighter_contradicts_and_is_no_change(databases, tmp_path):
    code, found = agree(databases, "dim", "-o", tmp_path / "out")
    assert code == 1 and not found["agrees"]
    assert all(
        band["ratio"] == pytest.approx(1 / 0.92, rel=0.01) for band in found["pairs"][0]["bands"]
    )
    assert found["changes"]["share"] < 0.02
    assert json.loads((tmp_path / "out/agreement.json").read_text())["objects"][0] == found


def test_what_changed_is_found_where_it_is(databases):
    code, found = agree(databases, "changed", "--false-alarms", 0.001)
    assert code == 0 and found["agrees"] and found["pairs"][0]["patches"] >= 8
    x, y, width, height, size = found["changes"]["areas"][0]
    assert abs(x + width / 2 - 106) < 4 and abs(y + height / 2 - 66) < 4
    assert size < -0.01


def test_databases_without_a_common_object_and_folders_that_are_none_are_refused(
    databases, tmp_path
):
    none, broken = tmp_path / "none", shutil.copytree(databases("changed"), tmp_path / "broken")
    shutil.copytree(databases("first"), none, ignore=lambda *_: ["objects"])
    heading = (none / "catalogue.csv").read_text().splitlines()[0]
    (none / "catalogue.csv").write_text(f"{heading}\n")
    (broken / "objects/panel/provenance.json").write_text("{}")
    for words, named in (
        ([tmp_path], str(tmp_path)),
        ([none], "no object"),  # as where every capture was refused
        ([databases("changed"), "--object", "pannel"], "panel"),
        ([broken], "provenance.json"),
    ):
        done = CliRunner().invoke(app, ["agree", str(databases("first")), *map(str, words)])
        assert done.exit_code == 1 and named in done.output.replace("\n", ""), done.output

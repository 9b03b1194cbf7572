"""What status says after a build in which layers were refused: what a build would do, and no more."""

import json
import shutil

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from levkas.building import build, status, summarise
from levkas.cli import app

THIRD = """
[cameras.uv]
kind = "image"
files = "uv/{target}.png"
"""


def states(report):
    return {
        (s.key.object, s.key.layer, s.key.stage): s.state
        for s in report.stages
        if s.state != "fresh"
    }


@pytest.fixture(scope="module")
def refused(make_plates, tmp_path_factory):
    """A campaign with another painting's picture, a broken file, and two reference images that are lost."""
    folder = make_plates(
        tmp_path_factory.mktemp("refused") / "campaign", ["five", "four", "one", "three", "two"]
    )
    with (folder / "campaign.toml").open("a") as file:
        file.write(THIRD)
    (folder / "uv").mkdir()
    for name in ("one", "two"):
        shutil.copy(folder / f"infrared/{name}.png", folder / f"uv/{name}.png")
    shutil.copy(folder / "infrared/two.png", folder / "infrared/one.png")  # an impostor
    two = np.full((200, 240, 2), 90, np.uint8)  # an image has 1 or 3 channels
    (folder / "uv/two.png").write_bytes(cv2.imencode(".png", np.dstack([two, two]))[1].tobytes())
    half = (folder / "infrared/three.png").read_bytes()
    (folder / "infrared/three.png").write_bytes(half[: len(half) // 2])
    half = (folder / "photo/four.png").read_bytes()
    (folder / "photo/four.png").write_bytes(half[: len(half) // 2])
    (folder / "photo/five.png").unlink()
    return folder, summarise(build(folder))


def test_status_after_a_build_says_the_refusals_and_nothing_is_stale(refused):
    folder, built = refused
    lost = {key for key, state in states(built).items() if state == "refused"}
    assert {key[:2] for key in lost} == {
        ("one", "infrared"), ("two", "uv"), ("three", "infrared"), ("four", "photo"),
        ("four", "infrared"), ("five", "photo"), ("five", "infrared"),
    }  # fmt: skip
    report = status(folder)
    assert states(report) == dict.fromkeys(lost, "refused")
    assert set(report.problems) == set(built.problems)


def test_the_report_of_a_build_has_verdict_errors_and_reasons_of_every_layer(refused):
    folder, _ = refused
    result = CliRunner().invoke(app, ["build", str(folder), "--json"])
    rows = {(row["object"], row["camera"]): row for row in json.loads(result.stdout)["layers"]}
    right = rows["two", "infrared"]
    assert right["verdict"] in ("accept", "warn") and right["reasons"]
    assert right["held_out_px"] < 0.5 and 0 < right["checked_share"] <= 1
    impostor, broken = rows["one", "infrared"], rows["three", "infrared"]
    assert (impostor["verdict"], impostor["stage"]) == ("refuse", "register")
    assert "levkas inspect" in impostor["next_step"] and impostor["reasons"] and impostor["codes"]
    assert (broken["verdict"], broken["stage"]) == ("refuse", "calibrate")


def test_status_lists_the_verdict_of_every_layer_that_was_built(refused, tmp_path):
    folder = shutil.copytree(refused[0], tmp_path / "campaign")
    (folder / "infrared/two.png").write_bytes((folder / "infrared/one.png").read_bytes() + b"x")
    said = CliRunner().invoke(app, ["status", str(folder)]).stdout.splitlines()
    verdicts = dict(line.split(": ", 1) for line in said if line.split(": ")[0].count("/") == 1)
    assert verdicts["one/photo"] == "reference"
    assert verdicts["one/infrared"] == "refused at register"
    assert verdicts["three/infrared"] == "refused at calibrate"
    assert verdicts["two/infrared"].endswith("; stale, verdict of the earlier build")
    result = CliRunner().invoke(app, ["status", str(refused[0]), "--json"])
    built = CliRunner().invoke(app, ["build", str(refused[0]), "--json"])
    assert json.loads(result.stdout)["layers"] == json.loads(built.stdout)["layers"]


def test_a_second_build_does_what_status_says(refused, tmp_path):
    folder = shutil.copytree(refused[0], tmp_path / "campaign")
    said = states(status(folder))
    did = states(summarise(build(folder)))
    assert did == said  # the catalogue, too, is left alone
    assert states(status(folder)) == said


def test_a_file_that_was_mended_is_stale_and_its_neighbours_stay_refused(refused, tmp_path):
    folder = shutil.copytree(refused[0], tmp_path / "campaign")
    shutil.copy(folder / "infrared/two.png", folder / "infrared/three.png")
    said = states(status(folder))
    assert (
        said["three", "infrared", "calibrate"] == said["three", "infrared", "resample"] == "stale"
    )
    assert {state for key, state in said.items() if key[0] in ("one", "two")} == {"refused"}


def test_a_camera_whose_folder_is_missing_is_refused_alike_before_and_after_the_build(
    make_plates, tmp_path
):
    """The names found in its place have no database among them, which the build has made meanwhile."""
    folder = make_plates(tmp_path / "campaign", ["one"])
    shutil.rmtree(folder / "infrared")
    (problem,) = summarise(build(folder)).problems
    assert problem.found == "photo"
    (folder / "database.published").mkdir()
    report = status(folder)
    assert report.problems == [problem]
    assert set(states(report).values()) == {"refused"}

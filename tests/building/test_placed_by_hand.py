"""A layer that a person's pairs place: had where the pictures share nothing, and labelled wherever it is named."""

import csv
import json

import cv2
import numpy as np
import pytest

from levkas import map_points
from levkas.building import build, status, summarise
from levkas.building.layer_verdicts import layer_verdicts
from levkas.campaign.edits import BY_HAND, Edits, FrameEdits, round_pair, write_edits
from levkas.database.registrations import describe_pairs

CAMPAIGN = """
[campaign]
reference = { camera = "vis", band = "G" }
[cameras.vis]
kind = "image"
files = "vis/{target}.png"
[cameras.xray]
kind = "image"
files = "xray/{target}.png"
[targets]
objects = ["icon1"]
"""
PLACES = np.array([[40.0, 40], [320, 50], [310, 250], [50, 260], [180, 150]])
HAND_PX = 0.8


def truth(points):
    """Reference px → px of the radiograph: a little turned, finer, and shifted."""
    turn = 1.3 * np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    return points @ turn.T + [70.0, 10.0]


def blobs(seed, size):
    rng = np.random.default_rng(seed)
    picture = np.full(size[::-1], 90, np.float32)
    for _ in range(250):
        x, y, r = (int(rng.integers(0, m)) for m in (*size, 22))
        cv2.circle(picture, (x, y), r + 3, float(rng.integers(20, 235)), -1, cv2.LINE_AA)
    return picture.astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    """A painting, and a radiograph that shows none of its detail."""
    for part, picture in (
        ("vis", np.dstack([blobs(1, (360, 300))] * 3)),
        ("xray", blobs(2, (560, 470))),
    ):
        (tmp_path / part).mkdir()
        (tmp_path / part / "icon1.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    return tmp_path


def pairs(noise=HAND_PX):
    theirs = truth(PLACES) + np.random.default_rng(4).normal(0, noise, PLACES.shape)
    return tuple(sorted(round_pair(row) for row in np.hstack([PLACES, theirs])))


def correct(folder, **keys):
    write_edits(folder / "edits.toml", Edits({("icon1", "xray"): FrameEdits(**keys)}))


def xray(report):
    return next(row for row in layer_verdicts(report) if row["camera"] == "xray")


@pytest.mark.slow
def test_five_pairs_of_a_shaking_hand_on_a_hard_radiograph_end_in_a_layer(folder):
    first = xray(summarise(build(folder)))
    assert first["verdict"] == "refuse" and "levkas inspect" in first["next_step"]

    correct(folder, added=pairs()[:3], accept=BY_HAND)
    assert xray(summarise(build(folder)))["verdict"] == "refuse"
    correct(folder, added=pairs())
    second = xray(summarise(build(folder)))
    assert second["verdict"] == "refuse" and "four points" not in second["next_step"]
    assert 'accept = "by hand"' in second["next_step"] and "Place by hand" in second["next_step"]

    correct(folder, added=pairs(), accept=BY_HAND)
    waiting = {(s.key.layer, s.key.stage): s for s in status(folder).stages}
    assert waiting["xray", "register"].state == "stale"
    assert "accepted by hand" in waiting["xray", "register"].why
    report = summarise(build(folder))
    assert report.ok, report.text

    database = folder / "database"
    record = json.loads((database / "objects/icon1/registration/xray.json").read_text())
    label = describe_pairs(record)
    assert label.startswith("placed by hand, pairs fit to ")
    assert label.endswith(" px; the pictures do not confirm it")
    verdict = record["verdict"]
    assert verdict["decision"] == xray(report)["verdict"] == "by hand"
    assert verdict["reasons"][0].lower().startswith(label) and verdict["unchecked"] == 1.0
    assert any(label in line.lower() for line in report.warnings)
    assert any(label in line.lower() for line in status(folder).warnings)

    page = (database / "objects/icon1/report.html").read_text()
    assert label in page and "Xray" not in label
    with (database / "catalogue.csv").open() as table:
        rows = {row["camera"]: row["verdict"] for row in csv.DictReader(table)}
    assert rows == {"vis": "accept", "xray": "by hand"}

    points = np.array([[60.0, 60], [200, 200], [300, 80]])
    mapped = map_points(database, "icon1", points, source="grid", target="xray")
    assert np.linalg.norm(mapped - truth(points), axis=1).max() < 2 * HAND_PX

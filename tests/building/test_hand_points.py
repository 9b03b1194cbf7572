"""Control points that campaign.toml names, as checks or seeds; a layer that a person's pairs place, labelled wherever it is named."""

import csv
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from levkas import map_points
from levkas.building import build, status, summarise
from levkas.building.layer_verdicts import layer_verdicts
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.campaign.edits import BY_HAND, Edits, FrameEdits, round_pair, write_edits
from levkas.core.text import read_json
from levkas.database.registrations import describe_pairs
from levkas.quality.evaluation.layer_report import assess
from levkas.registration.control_points import ControlPoints, PointsRefused, format_points
from levkas.stages.control_points import declared_points, fingerprint_points

KEYS = """
[campaign]
reference = {{ camera = "vis", band = "G" }}
[cameras.vis]
kind = "image"
files = "vis/{{target}}.png"
[cameras.xray]
kind = "image"
files = "xray/{{target}}.png"
[targets]
objects = ["icon1", "icon2"]
{more}
"""
PAIRS = ControlPoints(
    [[1, 2], [3, 4], [5, 6]], [[10, 20], [30, 40], [50, 60]], enabled=[1, 1, 0], check=[0, 1, 0]
)


def campaign(folder, more):
    (folder / "campaign.toml").write_text(KEYS.format(more=more))
    return load_campaign(folder)


def capture(name="icon1", camera="xray"):
    bands = [SimpleNamespace(label="grey")]
    return SimpleNamespace(
        object=name, camera=camera, setup="", layer=camera,
        sensors=[SimpleNamespace(name="", bands=bands)],
    )  # fmt: skip


OWN = '[cameras.xray.registration]\npoints = "{object}.points"\n'


def write(folder, points=PAIRS):
    (folder / "icon1.points").write_bytes(format_points(points))


@pytest.mark.parametrize(
    ("use", "checks", "added", "starts"),
    [("check", [1, 3], [], []), ("seeds", [3], [1], []), ("start", [3], [], [1])],
)
def test_points_check_seed_or_start_and_marked_ones_only_check(
    tmp_path, use, checks, added, starts
):
    write(tmp_path)
    one = campaign(tmp_path, f'{OWN}use = "{use}"\n')
    given = declared_points(one, capture())[""]
    for found, expected in ((given.checks, checks), (given.added, added), (given.starts, starts)):
        assert found[:, 0].tolist() == expected
    assert given.reduced(2).checks[-1].tolist() == [3, 4, 14.75, 19.75]
    assert declared_points(one, capture("icon2")) == {} == fingerprint_points(one, capture("icon2"))
    assert declared_points(one, capture("icon1", "vis")) == {}


def test_one_table_serves_every_camera_and_a_band_that_is_not_there_is_refused(tmp_path):
    head, all_ = "object,camera,band,reference_x,reference_y,x,y\n", tmp_path / "all.csv"
    all_.write_text(head + "icon1,xray,grey,1,2,3,4\nicon2,xray,,5,6,7,8\nicon1,vis,,0,0,1,1\n")
    one = campaign(tmp_path, '[registration]\npoints = "all.csv"\n')
    assert declared_points(one, capture())[""].checks.tolist() == [[1, 2, 3, 4]]
    assert declared_points(one, capture("icon2"))[""].checks.tolist() == [[5, 6, 7, 8]]
    all_.write_text(head + "icon1,xray,550 nm,1,2,3,4\n")
    with pytest.raises(PointsRefused):
        declared_points(one, capture())


def test_a_file_of_one_camera_is_not_taken_for_that_of_all(tmp_path):
    write(tmp_path)
    one = campaign(tmp_path, '[registration]\npoints = "{object}.points"\n')
    with pytest.raises(PointsRefused) as refused:
        declared_points(one, capture())
    assert refused.value.problems[0].field == "registration.points"


@pytest.mark.parametrize(
    "keys",
    [
        '[registration]\npoints = "nothing.csv"\n',
        '[registration]\nuse = "seeds"\n',
        OWN + 'use = "start"\nmethod = "mirhashemi2019"\n',
        OWN + 'accept = "by hand"\n',
    ],
)
def test_a_file_that_is_not_there_and_a_use_of_nothing_are_refused(tmp_path, keys):
    write(tmp_path)
    with pytest.raises(CampaignInvalid):
        campaign(tmp_path, keys)


def blobs(seed, size):
    rng = np.random.default_rng(seed)
    picture = np.full(size[::-1], 90, np.float32)
    for _ in range(250):
        x, y, r = (int(rng.integers(0, m)) for m in (*size, 22))
        cv2.circle(picture, (x, y), r + 3, float(rng.integers(20, 235)), -1, cv2.LINE_AA)
    return picture


def write_pictures(folder, vis, xray, more=""):
    for part, picture in (("vis", np.dstack([vis] * 3)), ("xray", xray)):
        (folder / part).mkdir()
        data = cv2.imencode(".png", picture.clip(0, 255).astype(np.uint8))[1]
        (folder / part / "icon1.png").write_bytes(data.tobytes())
    (folder / "campaign.toml").write_text(KEYS.format(more=more).replace(', "icon2"', ""))
    return folder


@pytest.mark.slow
def test_a_build_measures_check_points_and_starts_from_seeds_to_what_was_planted(tmp_path):
    """An X-ray on its side with check points; the planted error of one is found, and it fits nothing."""
    big = blobs(3, (360, 300))
    shift = np.array([[1, 0, 6.0], [0, 1, -4.0]])
    observed = cv2.warpAffine(big, shift, (360, 300), borderValue=90)
    write_pictures(tmp_path, big, 255 - observed, OWN)
    ours = np.array([[60.0, 60], [280, 70], [270, 220], [80, 230], [180, 150]])
    theirs = ours + np.array([6.0, -4.0])
    theirs[4] += [3.0, 4.0]
    write(tmp_path, ControlPoints(ours, theirs))
    list(build(tmp_path))
    folder = tmp_path / "database/objects/icon1"
    record = read_json(folder / "registration/xray.json")
    errors = [one["error"] for one in record["errors"]["check_points"]]
    assert max(errors[:4]) < 0.1 and errors[4] == pytest.approx(5.0, abs=0.1)

    result = assess(tmp_path, points=tmp_path / "icon1.points", frame="icon1/xray").results[-1]
    reported = {one["of"]: one for one in result["check_points"]}
    assert reported["campaign"]["points"] == reported["evaluation"]["points"] == 5
    assert reported["evaluation"]["error_max"] == pytest.approx(5.0, abs=0.1)


# --- a layer placed by hand

PLACES = np.array([[40.0, 40], [320, 50], [310, 250], [50, 260], [180, 150]])
HAND_PX = 0.8


def truth(points):
    """Reference px → px of the radiograph: a little turned, finer, and shifted."""
    turn = 1.3 * np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    return points @ turn.T + [70.0, 10.0]


def pairs():
    theirs = truth(PLACES) + np.random.default_rng(4).normal(0, HAND_PX, PLACES.shape)
    return tuple(sorted(round_pair(row) for row in np.hstack([PLACES, theirs])))


def correct(folder, **keys):
    write_edits(folder / "edits.toml", Edits({("icon1", "xray"): FrameEdits(**keys)}))


def xray(report):
    return next(row for row in layer_verdicts(report) if row["camera"] == "xray")


@pytest.mark.slow
def test_five_pairs_of_a_shaking_hand_on_a_hard_radiograph_end_in_a_layer(tmp_path):
    """The radiograph shows none of the painting's detail."""
    folder = write_pictures(tmp_path, blobs(1, (360, 300)), blobs(2, (560, 470)))
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
    record = read_json(database / "objects/icon1/registration/xray.json")
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

"""Control points that campaign.toml names, read for a capture as check points or as seeds."""

from types import SimpleNamespace

import numpy as np
import pytest

from levkas.campaign.campaign import CampaignInvalid, load_campaign
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


def test_one_table_serves_every_camera(tmp_path):
    (tmp_path / "all.csv").write_text(
        "object,camera,band,reference_x,reference_y,x,y\n"
        "icon1,xray,grey,1,2,3,4\nicon2,xray,,5,6,7,8\nicon1,vis,,0,0,1,1\n"
    )
    one = campaign(tmp_path, '[registration]\npoints = "all.csv"\n')
    assert declared_points(one, capture())[""].checks.tolist() == [[1, 2, 3, 4]]
    assert declared_points(one, capture("icon2"))[""].checks.tolist() == [[5, 6, 7, 8]]


def test_a_file_of_one_camera_is_not_taken_for_that_of_all(tmp_path):
    write(tmp_path)
    one = campaign(tmp_path, '[registration]\npoints = "{object}.points"\n')
    with pytest.raises(PointsRefused) as refused:
        declared_points(one, capture())
    assert refused.value.problems[0].field == "registration.points"


def test_points_of_a_band_that_is_not_there_are_refused(tmp_path):
    (tmp_path / "all.csv").write_text(
        "object,camera,band,reference_x,reference_y,x,y\nicon1,xray,550 nm,1,2,3,4\n"
    )
    with pytest.raises(PointsRefused):
        declared_points(campaign(tmp_path, '[registration]\npoints = "all.csv"\n'), capture())


def test_a_changed_file_or_use_is_noticed(tmp_path):
    write(tmp_path)
    first = fingerprint_points(campaign(tmp_path, OWN), capture())
    write(tmp_path, ControlPoints(PAIRS.reference[:1], PAIRS.target[:1]))
    second = fingerprint_points(campaign(tmp_path, OWN), capture())
    third = fingerprint_points(campaign(tmp_path, OWN + 'use = "seeds"\n'), capture())
    assert first != second and second != third and third != first


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


@pytest.mark.slow
def test_a_build_measures_check_points_and_starts_from_seeds_to_what_was_planted(tmp_path):
    """An X-ray on its side with check points; the planted error of one is found, and it fits nothing."""
    import cv2

    from levkas.building import build
    from levkas.core.text import read_json

    rng = np.random.default_rng(3)
    big = np.full((300, 360), 90, np.float32)
    for _ in range(220):
        x, y, r = (int(rng.integers(0, m)) for m in (360, 300, 22))
        cv2.circle(big, (x, y), r + 3, float(rng.integers(20, 235)), -1, cv2.LINE_AA)
    observed = cv2.warpAffine(
        big, np.array([[1, 0, 6.0], [0, 1, -4.0]]), (360, 300), borderValue=90
    )
    for part, picture in (("vis", np.dstack([big] * 3)), ("xray", 255 - observed)):
        (tmp_path / part).mkdir()
        data = cv2.imencode(".png", picture.clip(0, 255).astype(np.uint8))[1]
        (tmp_path / part / "icon1.png").write_bytes(data.tobytes())
    ours = np.array([[60.0, 60], [280, 70], [270, 220], [80, 230], [180, 150]])
    theirs = ours + np.array([6.0, -4.0])
    theirs[4] += [3.0, 4.0]
    write(tmp_path, ControlPoints(ours, theirs))
    (tmp_path / "campaign.toml").write_text(
        KEYS.format(more=OWN).replace('["icon1", "icon2"]', '["icon1"]')
    )
    list(build(tmp_path))
    folder = tmp_path / "database/objects/icon1"
    record = read_json(folder / "registration/xray.json")
    errors = [one["error"] for one in record["errors"]["check_points"]]
    assert max(errors[:4]) < 0.1 and errors[4] == pytest.approx(5.0, abs=0.1)

    from levkas.quality.evaluation.layer_report import assess

    result = assess(tmp_path, points=tmp_path / "icon1.points", frame="icon1/xray").results[-1]
    reported = {one["of"]: one for one in result["check_points"]}
    assert reported["campaign"]["points"] == reported["evaluation"]["points"] == 5
    assert reported["evaluation"]["error_max"] == pytest.approx(5.0, abs=0.1)

"""The example campaigns on real captures: each number was looked at by a person, its reason beside it."""

import csv
from pathlib import Path

import numpy as np
import pytest

import levkas
from levkas.building import build, summarise

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def built(name, shared, folder, **options):
    """Build an example, its relative paths led to where the data stand."""
    text = (EXAMPLES / name / "campaign.toml").read_text(encoding="utf-8")
    text = text.replace("../../../shared/data", shared.as_posix())
    text = text.replace("../../../shared/campaigns/two-paintings", shared.as_posix())
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return summarise(build(folder, output=folder / "database", **options)), folder / "database"


def table(path):
    lines = [line.lstrip("# ") for line in path.read_text().splitlines()]
    return list(csv.reader(lines))


def test_disks_through_seven_filters_come_together(real_data, tmp_path):
    report, database = built("filterwheel-disks", real_data, tmp_path)
    assert report.ok, report.text
    rows = table(real_data / "filterwheel-disks/disk_centroids_per_band.csv")
    points = np.array([[float(c) for c in row[:14]] for row in rows[1:]]).reshape(-1, 7, 2)
    reference = points[:, 3]
    before, after = [], []
    for i, wavelength in enumerate((400, 450, 500, 550, 600, 650, 700)):
        source = f"flea3:{wavelength} nm"
        mapped = levkas.map_points(
            database, "disks32cmV2", points[:, i], source=source, target="flea3:550 nm"
        )
        before.append(np.linalg.norm(points[:, i] - reference, axis=1).max())
        after.append(np.linalg.norm(mapped - reference, axis=1).mean())
    assert max(before) > 3.5
    # The centroids' own scatter is 0.07 to 0.10 px: what is left is mostly theirs.
    assert max(after) <= 0.2, after


def test_the_board_of_two_cameras_comes_together(real_data, tmp_path):
    report, database = built("silios-kinect", real_data, tmp_path)
    assert report.ok, report.text
    rows = table(real_data / "silios-kinect/sim3_chessboard_corners.csv")
    points = np.array([[float(c) for c in row[:4]] for row in rows[1:]])
    mapped = levkas.map_points(
        database, "board", points[:, 2:], source="kinect", target="silios:B5"
    )
    # Corners found by hand; a homography fits them to 0.29 px.
    assert np.linalg.norm(mapped - points[:, :2], axis=1).mean() <= 1.0


def test_five_lenses_of_a_panel_come_together(real_data, tmp_path):
    report, database = built("rededge", real_data, tmp_path)
    assert report.ok, report.text
    middle = np.array([[640.0, 480.0]])
    shifts = [
        np.linalg.norm(
            levkas.map_points(database, "0000", middle, source="rededge:Red", target=f"rededge:{b}")
            - middle
        )
        for b in ("Blue", "Green", "NIR", "Red edge")
    ]
    # The lenses stand a few centimetres apart: 12 to 52 px on the ground in front of the camera.
    assert min(shifts) > 8 and max(shifts) < 60


def test_a_line_scan_becomes_reflectance(real_data, tmp_path):
    report, database = built("envi-linescan", real_data, tmp_path)
    assert report.ok, report.text
    cube = levkas.open(database)["4-22-22_right_same_B73_top_00"]["scanner"]
    assert cube.shape == (31, 43, 580) and cube.attrs["quantity"] == "reflectance"
    leaf = cube.isel(band=slice(200, 500)).median(("y", "x")).values
    assert leaf.min() > 0.0 and leaf.max() < 1.2


@pytest.mark.parametrize(
    ("method", "mean", "worst"),
    [("levkas", 0.06, 0.4), pytest.param("mirhashemi2019", 0.2, 1.0, marks=pytest.mark.exhaustive)],
)
def test_a_campaign_made_by_other_hands_is_registered(two_paintings, tmp_path, method, mean, worst):
    from levkas.quality.evaluation.layer_report import assess

    text = (EXAMPLES / "two-paintings/campaign.toml").read_text(encoding="utf-8")
    text = text.replace("../../../shared/campaigns/two-paintings", two_paintings.as_posix())
    text = text.partition("\n[registration]")[0] + f'\n[registration]\nmethod = "{method}"\n'
    (tmp_path / "campaign.toml").write_text(text)
    report = summarise(build(tmp_path, output=tmp_path / "database", objects=["icon1"]))
    results = assess(tmp_path / "database", truth=two_paintings / "truth").results
    accepted = [r for r in results if r["verdict"] != "refuse"]
    assert {r["layer"].split("/")[1] for r in accepted} >= {"lctf-vis", "lctf-nir", "msbs", "d80"}
    for result in accepted:
        errors = [b["error_mean"] for b in result["bands"]]
        assert len(errors) == len(result["bands"]) and max(errors) <= 2 * mean, (
            result["layer"],
            errors,
        )
        assert np.mean(errors) <= mean and max(b["error_max"] for b in result["bands"]) <= 3 * worst
    assert report.stages

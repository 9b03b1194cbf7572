"""Tiles of a painting among the files of a campaign."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.campaign.discovery.captures import CaptureRefused
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.discovery.tiles import read_positions

FILES = 'files = ["raw/{target}/r{row}c{column}_{shot}.tif", "raw/{target}_{shot}.tif"]'
PLACES = ("r01c1", "r01c2", "r01c10", "r02c1", "r02c2", "r02c10")


def campaign(folder, files=FILES, more="", kind="mosaic", names=(), places=PLACES):
    listed = [f"raw/icon/{place}_{shot}.tif" for place in places for shot in (1, 2)]
    for name in [*listed, "raw/dark_1.tif", "raw/white_1.tif", *names]:
        path = Path(folder, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(path, np.zeros((4, 6), np.uint16))
    (folder / "campaign.toml").write_text(
        f'[campaign]\nreference = {{ camera = "d80" }}\n[cameras.d80]\nkind = "{kind}"\n{files}\n{more}\n'
        'pattern = "RGGB"\n[targets]\ndark = "dark"\nwhite = "white"\nobjects = ["icon"]\n'
    )
    return load_campaign(folder)


def refusal(folder, **options):
    _, refusals = find_captures(campaign(folder, **options))
    return refusals["icon", "d80", ""].problems


def test_frames_of_rows_and_columns_are_tiles_in_their_order(tmp_path):
    (capture,), refusals = find_captures(campaign(tmp_path))
    assert not refusals
    names = [part.tile for part in capture.tiles]
    assert names == ["r1c1", "r1c2", "r1c10", "r2c1", "r2c2", "r2c10"]
    for part in capture.tiles:
        row, column = part.tile[1:].split("c")
        (sensor,) = part.sensors
        assert [f.path.stem for f in sensor.object] == [
            f"r{int(row):02}c{column}_{n}" for n in (1, 2)
        ]
        assert [f.path.name for f in (*sensor.dark, *sensor.white)] == ["dark_1.tif", "white_1.tif"]
    (whole,) = capture.sensors
    assert len(whole.object) == 12
    assert len(whole.white) == 1
    assert any("r1c3, r1c4" in remark for remark in whole.remarks)  # nothing between 2 and 10


def test_a_name_that_means_something_in_frames_is_refused(tmp_path):
    files = 'files = ["raw/{target}/{tile}_{shot}.tif", "raw/{target}_{shot}.tif"]'
    problems = refusal(tmp_path, files=files, places=("Grid@0 1",))
    assert [p.code for p in problems] == ["E_TILE"]
    files = files.replace("{tile}", "Grid@{row} {column}")
    (capture,), _ = find_captures(campaign(tmp_path, files, places=()))
    assert [part.tile for part in capture.tiles] == ["r0c1"]


def test_a_tile_twice_is_refused_by_its_name(tmp_path):
    files = FILES.replace("_{shot}.tif", "_*.tif", 1)
    problems = refusal(tmp_path, files=files, places=("r1c1", "r1c2"))
    assert {p.code for p in problems} == {"E_TILE_TWICE"}


def test_frames_of_the_whole_object_are_those_of_another_camera(tmp_path):
    (problem,) = refusal(tmp_path, names=["raw/icon_1.tif"])
    assert problem.code == "E_TILE"
    assert problem.found == "icon_1.tif"


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"files": 'files = "raw/{target}_{tile}_{row}.tif"'}, "cameras.d80.files"),
        ({"files": 'files = "raw/{target}.tif"', "more": 'positions = "raw/dark_1.tif"'}, "cameras.d80.positions"),
        ({"more": 'positions = "nothing.csv"'}, "cameras.d80.positions"),
    ],
)  # fmt: skip
def test_keys_of_tiles_are_checked(tmp_path, change, field):
    with pytest.raises(CampaignInvalid) as refused:
        campaign(tmp_path, **change)
    assert [p.field for p in refused.value.problems] == [field]


def test_a_table_of_positions_has_a_row_a_tile(tmp_path):
    path = tmp_path / "stage.csv"
    path.write_text("tile, x, y\nr1c1, 0, -2.5\nr1c2, 80, 0\nr1c1, 1, 1\nr2c2, one, 1\n")
    with pytest.raises(CaptureRefused) as refused:
        read_positions(path)
    assert [p.found.split(",")[0] for p in refused.value.problems] == ["r1c1", "r2c2"]


def test_corrections_of_a_whole_camera_of_tiles_are_said_to_have_no_effect(tmp_path):
    campaign(tmp_path)
    (tmp_path / "edits.toml").write_text(
        "version = 1\n[objects.icon.cameras.d80]\nadded = [[1.0, 2.0, 3.0, 4.0]]\n"
    )
    (warning,) = load_campaign(tmp_path).without_effect
    assert "icon/d80" in warning and "one of its tiles" in warning

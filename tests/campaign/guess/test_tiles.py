"""Tiles found in the names of files."""

import numpy as np
import pytest
import tifffile

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.guess import look


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("photo/icon/r{0:02}c{1}.tif", "photo/{target}/r{row}c{column}.tif"),
        ("photo/icon_row{0}_col{1}.tif", "photo/{target}_row{row}_col{column}.tif"),
        ("photo/icon Grid@{0} {1}.tif", "photo/{target} Grid@{row} {column}.tif"),
        ("photo/icon[Grid@{0} {1}].tif", "photo/{target}[Grid@{row} {column}].tif"),
        ("photo/icon (r{0}_c{1}).tif", "photo/{target} (r{row}_c{column}).tif"),
        ("photo/icon/r{0}c{1}/shot_001.tif", "photo/{target}/r{row}c{column}/shot_*.tif"),
    ],
)
def test_places_in_names_are_rows_and_columns(tmp_path, name, pattern):
    rng = np.random.default_rng(1)
    for row in range(2):
        for column in range(3):
            path = tmp_path / name.format(row, column)
            path.parent.mkdir(parents=True, exist_ok=True)
            picture = rng.integers(200, 60000, (48, 64)).astype(np.uint16)
            tifffile.imwrite(path, picture, photometric="minisblack")
    text = look(tmp_path).text
    (tmp_path / "campaign.toml").write_text(text)
    campaign = load_campaign(tmp_path)
    (camera,) = campaign.cameras.values()
    assert [p.replace("{shot}", "*") for p in camera.files] == [pattern]
    (capture,), refusals = find_captures(campaign)
    assert not refusals
    assert capture.object == "icon"
    assert [part.tile for part in capture.tiles] == [
        f"r{r}c{c}" for r in range(2) for c in range(3)
    ]


def test_one_place_is_a_part_of_a_name(tmp_path):
    for name in ("icon_r2c3.tif", "panel.tif"):
        tifffile.imwrite(tmp_path / name, np.arange(3072, dtype=np.uint16).reshape(48, 64))
    assert "{row}" not in look(tmp_path).text

"""A region of the grid that lies off the frame is refused by its name, and not as an error of ours."""

import json

import pytest
from typer.testing import CliRunner

from levkas.cli import app


@pytest.mark.parametrize(
    "region", ["[500, 500, 50, 50]", "[-100, -100, 20, 20]", "[1e9, 0, 10, 10]", "[0, 0, 1e9, 1e9]"]
)
def test_a_region_off_the_frame_is_refused(make_plates, tmp_path, region):
    folder = make_plates(tmp_path, ["one"])
    with (folder / "campaign.toml").open("a") as file:
        file.write(f"[grid]\nregion = {region}\n")
    result = CliRunner().invoke(app, ["build", str(folder), "--json"])
    assert result.exit_code == 1 and result.exception.__class__ is SystemExit
    problems = json.loads(result.stdout)["problems"]
    problem = next(p for p in problems if p["field"] == "grid.region")
    assert problem["file"] == str(folder / "campaign.toml")
    assert problem["found"] and "240 x 200" in problem["expected"] and problem["fix"]

"""`levkas points convert`."""

import json

from typer.testing import CliRunner

from levkas.cli import app

run = CliRunner().invoke


def test_points_are_converted_and_the_losses_said(tmp_path):
    source, out = tmp_path / "a.csv", tmp_path / "a.points"
    source.write_text('"eye","true","1","2","3","4"\n"ear","false","5","6","7","8"\n')
    result = run(app, ["points", "convert", str(source), str(out), "--to", "qgis", "--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["points"] == 2 and report["losses"] == ["2 names not kept"]
    assert out.read_text().splitlines()[2:] == [
        "3.5,-4.5,1.5,-2.5,1,0,0,0",
        "7.5,-8.5,5.5,-6.5,0,0,0,0",
    ]


def test_a_wrong_dialect_ends_in_status_one(tmp_path):
    source = tmp_path / "a.csv"
    source.write_text("reference_x,reference_y,x,y\n1,2,3,4\n")
    result = run(app, ["points", "convert", str(source), str(tmp_path / "b"), "--to", "word"])
    assert result.exit_code == 1 and "unknown dialect 'word'" in result.output
    assert not (tmp_path / "b").exists()

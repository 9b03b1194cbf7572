"""`levkas methods` on a small built campaign with truth."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from levkas.cli import app
from levkas.quality.comparison import COMPARED, compare
from levkas.quality.comparison.methods import ComparedMethod
from levkas.quality.comparison.table import ComparedLayer, ComparedRow, Comparison, chosen_methods
from levkas.quality.evaluation.native_layers import ComparisonRefused

run = CliRunner().invoke


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """A photograph in three channels and another of half the size, with four planted points."""
    import cv2

    from levkas.building import build

    folder = tmp_path_factory.mktemp("compare")
    rng = np.random.default_rng(3)
    big = np.full((400, 480), 90, np.float32)
    for _ in range(300):
        x, y, r = (int(rng.integers(0, m)) for m in (480, 400, 26))
        cv2.circle(big, (x, y), r + 4, float(rng.integers(20, 235)), -1, cv2.LINE_AA)
    half = cv2.resize(big, (240, 200), interpolation=cv2.INTER_AREA)
    for part, picture in (("vis", half), ("photo", big)):
        (folder / part).mkdir()
        data = cv2.imencode(".png", np.dstack([picture] * 3).clip(0, 255).astype(np.uint8))[1]
        (folder / part / "icon1.png").write_bytes(data.tobytes())
    (folder / "campaign.toml").write_text(
        '[campaign]\nreference = { camera = "vis", band = "G" }\n'
        '[cameras.vis]\nkind = "image"\nfiles = "vis/{target}.png"\n'
        '[cameras.photo]\nkind = "image"\nfiles = "photo/{target}.png"\n'
        "[database]\nnative = true\n"
        '[targets]\nobjects = ["icon1"]\n'
    )
    list(build(folder))
    points = np.array([[40, 40], [200, 50], [180, 160], [60, 150.0]])
    rows = np.hstack([points, points * 2 + 0.5])
    lines = ["reference_x,reference_y,x,y", *(",".join(map(str, row)) for row in rows)]
    (folder / "points.csv").write_text("\n".join(lines))
    return folder


@pytest.mark.slow
def test_methods_are_set_side_by_side_with_errors_maps_and_memory(database, tmp_path):
    names = ["levkas", "mirhashemi2019", "opencv-sift-magsac"]
    arguments = [a for name in names for a in ("--method", name)]
    result = run(app, ["methods", str(database), *arguments, "--json", "--points",
                       str(database / "points.csv"), "-o", str(tmp_path / "out")])  # fmt: skip
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert [m["method"] for m in report["methods"]] == names
    for row in report["comparison"]:
        assert row["failure"] == "" and row["error_mean"] < 0.2 and row["ssim"] > 0.9
        assert row["peak_mib"] > 50 and row["cpu_seconds"] > 0
        assert (tmp_path / "out" / row["map"]).is_file()
    page = (tmp_path / "out/comparison.html").read_text()
    assert page.count("<figure>") == 3 and "GDB-ICP" not in page
    assert "Mean error by layer" in page and page.count('role="img"') == 2
    assert json.loads((tmp_path / "out/comparison.json").read_text())["methods"]


def test_a_method_that_takes_too_long_is_stopped_and_said(database):
    found = compare(database, methods=["opencv-ecc"], time_limit_s=0.05)
    assert found.rows[0].facts["failure"].startswith("stopped after")
    assert found.summary()[0]["failures"] == 1 and found.summary()[0]["error_mean"] is None


def test_a_package_that_is_not_there_is_said_and_its_row_left_out(monkeypatch):
    monkeypatch.setitem(
        COMPARED, "elsewhere", ComparedMethod("Elsewhere", "m", "f", "no_such_package", "nowhere")
    )
    methods, problems = chosen_methods(["levkas", "elsewhere"])
    assert methods == ["levkas"] and "nowhere is not installed" in problems[0].message


def test_a_method_that_does_not_exist_is_refused():
    with pytest.raises(ComparisonRefused, match="no method 'sorcery'"):
        chosen_methods(["sorcery"])


def test_a_summary_leaves_failures_out_of_errors_and_counts_them():
    def row(layer, mean, failure=""):
        bands = [
            {"band": "R", "error_mean": mean, "error_p95": mean, "error_max": 2 * mean, "points": 3}
        ]
        facts = {
            "failure": failure,
            "bands": [] if failure else bands,
            "seconds": 1.0,
            "ssim": None,
        }
        return ComparedRow(ComparedLayer("icon1", layer), "levkas", facts)

    one = Comparison([row("a", 0.1), row("b", 0.3), row("c", 9.0, "lost")]).summary()[0]
    assert one["error_mean"] == pytest.approx(0.2) and one["error_max"] == pytest.approx(0.6)
    assert (one["failures"], one["layers"]) == (1, 3)

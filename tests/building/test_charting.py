"""Charts, edges and light traps before cameras: measured from shots, cubes and photographs; refused where they are cut off."""

import json
import re

import numpy as np
import pytest
from cameras import developed, reshot, text, tones, write
from PIL import Image
from scipy.special import ndtr
from typer.testing import CliRunner

from levkas.building import build, status, summarise
from levkas.cli import app
from levkas.colour.srgb import SRGB_TO_XYZ, encode_srgb, observer_under
from levkas.core.digests import hash_tree
from levkas.core.problems import Refused
from levkas.quality.targets.charts import CHARTS, reference_of
from levkas.stages.charts import measure_charts

CLASSIC = CHARTS["ColorChecker24"]
CORNERS = "72,83,277,83,277,206,72,206"
"""Of the chart of the small world."""


def corners(line=CORNERS):
    return np.array(line.split(","), float).reshape(4, 2)


def test_a_chart_of_a_campaign_is_measured_from_two_shots(world):
    report = measure_charts(world.folder, corners=corners())
    assert report.ok, report.problems
    (made,) = report.measures
    assert made.name == "macbeth/filters" and made.table.temporal
    assert made.sightings[0].located.agreement > 0.99
    # Gain 0.2, read noise 2, two shots of object, white and dark.
    for patch in (18, 21, 23):
        r, light = made.table.mean[patch, 1], 3200.0
        own, white, dark = (4 + 0.2 * r * light, 4 + 0.2 * 0.98 * light, 4.0)
        noise = np.sqrt((own + (r / 0.98) ** 2 * white + (1 - r / 0.98) ** 2 * dark) / 2)
        assert made.table.snr[patch, 1] == pytest.approx(r * light / noise, rel=0.1)
    published = reference_of(CLASSIC).at(np.array([500.0, 600.0]))
    assert np.abs(made.table.mean - published).max() < 0.02


def test_charts_of_a_database_are_measured_again_and_what_is_none_is_refused(world):
    kept = measure_charts(world.database, corners=corners())
    assert kept.ok and [m.name for m in kept.measures] == ["macbeth/filters"]
    none = measure_charts(world.database, objects=["panel"], cameras=["filters"], corners=corners())
    assert [p.code for p in none.problems] == ["E_CHART_ORDER"]
    for more in ({"objects": ["painting"]}, {"cameras": ["nir"]}):
        with pytest.raises(Refused):
            measure_charts(world.database, **more)


@pytest.mark.slow
def test_the_command_reports_a_page_and_a_chart_that_is_cut_off(world, tmp_path):
    page = tmp_path / "chart.html"
    command = ["chart", str(world.folder), "--json", "--corners"]
    result = CliRunner().invoke(app, [*command, CORNERS, "-o", str(page)])
    assert result.exit_code == 0 and len(json.loads(result.stdout)["charts"][0]["patches"]) == 24
    assert page.read_text(encoding="utf-8").count("<path") >= 24
    beyond = ",".join(str(float(v) - 200 * (i % 2 == 0)) for i, v in enumerate(CORNERS.split(",")))
    result = CliRunner().invoke(app, [*command, beyond])
    (problem,) = json.loads(result.stdout)["problems"]
    assert (result.exit_code, problem["code"]) == (1, "E_CHART_FRAME")
    assert problem["fix"] and problem["file"]


@pytest.mark.slow
def test_a_chart_stays_while_its_frames_cannot_be_read(world, tmp_path):
    own = world.copy(tmp_path / "c")
    charts = hash_tree(own.database / "charts")
    frame = own.folder / "filters/macbeth_500nm_0.tif"
    whole = frame.read_bytes()
    frame.write_bytes(whole[:400])
    report = summarise(build(own.folder))
    assert any("charts/macbeth_filters" in warning for warning in report.warnings)
    assert hash_tree(own.database / "charts") == charts
    frame.write_bytes(whole)
    text('charts = { macbeth = "ColorChecker24" }\n', "")(own.folder)
    assert summarise(build(own.folder)).ok
    assert not (own.database / "charts").exists()


# --- photographs --------------------------------------------------------------------------------


def photograph():
    """A photograph of the chart, 8 bits, its colours as sRGB has them."""
    grid, weights = observer_under()
    colours = reference_of(CLASSIC).at(np.clip(grid, 380, 730)) @ weights
    colours = colours @ np.linalg.inv(SRGB_TO_XYZ).T
    picture = np.full((250, 350, 3), 0.15)
    for i, (c, r) in enumerate(CLASSIC.centres.astype(int)):
        y, x = 45 + 40 * r, 55 + 40 * c
        picture[y + 3 : y + 37, x + 3 : x + 37] = colours[i]
    noise = 0.0005 * np.random.default_rng(2).standard_normal(picture.shape)
    return encode_srgb(np.clip(picture + noise, 0, 1))


def test_a_chart_in_a_finished_photograph_is_found_and_gives_no_colours(tmp_path):
    path = tmp_path / "chart.png"
    Image.fromarray(photograph()).save(path)
    places = "75,65,275,65,275,185,75,185"
    result = CliRunner().invoke(app, ["chart", str(path), "--corners", places, "--json"])
    (chart,) = json.loads(result.stdout)["charts"]
    assert result.exit_code == 0 and len(chart["patches"]) == 24
    assert chart["colours"] is None and chart["indicators"] == chart["stray_light"] == []


# --- edges --------------------------------------------------------------------------------------

EDGES = 'charts = { sfr = "edges" }\nedges = { sfr = { cam = [[45, 90, 60, 85], [130, 60, 100, 50]] } }\n'
SHIFTS = {450: 0.0, 550: 0.3, 650: 0.0}


def edged(folder, *changes):
    """A black square on white that leans by 5 degrees, its middle band 0.3 px to the right of the others."""
    shape = (180, 260)
    write(folder, "bands", text("[targets]\n", "[targets]\n" + EDGES), *changes, shape=shape)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    lean, sigma = np.deg2rad(5), 0.7
    for path in [*(folder / "raw").glob("panel*")]:
        (folder / "raw" / path.name.replace("panel", "sfr")).write_bytes(path.read_bytes())
    for nm, shift in SHIFTS.items():
        across = (x - 70 - shift) * np.cos(lean) + (y - 85) * np.sin(lean)
        down = (y - 85) * np.cos(lean) - (x - 70 - shift) * np.sin(lean)
        scene = 0.9 - 0.8 * ndtr(across / sigma) * ndtr(down / sigma)
        reshot(f"sfr_{nm}nm_*", scene)(folder)
    return folder


@pytest.mark.slow
def test_edges_that_a_campaign_names_are_measured(tmp_path):
    report = measure_charts(edged(tmp_path / "c"))
    assert report.ok, report.problems
    upright, level = report.measures[0].edges.tables
    assert (upright.axis, level.axis) == ("x", "y")
    assert upright.largest_shift == pytest.approx(0.3 * np.cos(np.deg2rad(5)), abs=0.02)
    assert upright.shift[1] > upright.shift[0]
    # The Gaussian alone: the scene was sampled at points.
    assert upright.sfr50 == pytest.approx(np.sqrt(np.log(2) / 2) / np.pi / 0.7, rel=0.03)
    result = CliRunner().invoke(app, ["chart", str(tmp_path / "c"), "--json"])
    record = json.loads(result.stdout)["charts"][0]
    assert result.exit_code == 0 and record["chart"] == "edges"
    assert record["edges"][0]["bands"][0]["sampling_efficiency"] > 0.5


@pytest.mark.parametrize(
    ("box", "code"),
    [
        ("0,0,64,100", None), ("0,0,20,100", "E_EDGE_CONTRAST"), ("0,0,999,10", "E_REGION"),
        ("5,5", "E_VALUE"), (None, "E_EDGE_MISSING"),
    ],
)  # fmt: skip
def test_edges_of_a_photograph_are_named_on_the_command_line(tmp_path, box, code):
    y, x = np.mgrid[:100, :64].astype(float)
    lean = np.deg2rad(5)
    light = 0.1 + 0.7 * ndtr(((x - 32) * np.cos(lean) - (y - 50) * np.sin(lean)) / 0.8)
    codes = np.round(255 * encode_srgb(light)).astype(np.uint8)
    Image.fromarray(np.repeat(codes[..., None], 3, 2)).save(tmp_path / "photo.png")
    command = ["chart", str(tmp_path / "photo.png"), "--kind", "edges", "--json"]
    result = CliRunner().invoke(app, [*command, *(["--edge", box] if box else [])])
    found = json.loads(result.stdout)
    assert [p["code"] for p in found["problems"]] == ([code] if code else [])
    assert result.exit_code == bool(code)


# --- stray light --------------------------------------------------------------------------------

VIEW, BOX = (160, 200), (82, 62, 36, 36)
QUIET = {"gain": 0.02, "read": 0.3, "shots": (4, 4, 4), "shape": VIEW}
"""Counts an electron, counts: what strays is to be seen in tiles of 100 pixels."""
TRAPS = text("[cameras.cam]", f"traps = {{ panel = {{ cam = {list(BOX)} }} }}\n[cameras.cam]")


def with_trap():
    """Return tiles, with a light trap among them that reflects nothing."""
    truth = tones(VIEW)[0].copy()
    x, y, width, height = BOX
    truth[y - 2 : y + height + 2, x - 2 : x + width + 2] = 0.0
    return truth


def test_a_trap_gives_the_budget_its_stray_light(tmp_path):
    habits = QUIET | {"truth": with_trap(), "stray": 0.01, "stray_px": 30.0}
    row = developed(write(tmp_path / "c", "bands", TRAPS, **habits)).budget["stray light"]
    assert row.basis == "measured" and row.common_to == "camera"
    for size in row.size.values():
        assert size == pytest.approx(0.01, rel=0.35)


@pytest.mark.slow
def test_greys_of_a_chart_give_the_budget_its_stray_light_and_rebuild_the_report_with_the_chart(
    tmp_path,
):
    """Of charts the black is known to 0.002, of a view whose mean is 0.2: to 1 % of that."""

    def row_of(folder):
        record = json.loads((folder / "database/objects/panel/provenance.json").read_text())
        (step,) = [one for one in record["steps"] if one["stage"] == "calibrate"]
        return {row["source"]: row for row in step["uncertainty"]}["stray light"]

    patches = reference_of(CLASSIC).at(np.array([450.0, 550.0, 650.0]))
    folder = write(tmp_path / "c", chart=patches, stray=0.05, **QUIET)
    assert summarise(build(folder)).ok
    row = row_of(folder)
    assert row["basis"] == "measured"
    assert max(row["size"].values()) == pytest.approx(0.05, abs=0.015)
    said = (folder / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(re.sub(r"(?m)^charts = .*$", "", said))
    stale = {step.key.stage for step in status(folder).stages if step.state == "stale"}
    assert "report" in stale and "calibrate" not in stale
    assert summarise(build(folder)).ok and row_of(folder)["basis"] == "unknown"


DECLARED = text("[targets]\n", "[targets]\n" + EDGES)


@pytest.mark.parametrize(
    ("declared", "old", "new", "field"),
    [
        (DECLARED, "{ cam = ", "{ nir = ", "targets.edges"),
        (DECLARED, "edges = { sfr", "edges = { square", "targets.edges"),
        (DECLARED, "[[45, 90, 60, 85]", "[[45, 90, 60]", "targets.edges"),
        (TRAPS, "{ panel = { cam", "{ panel = { other", "targets.traps.panel"),
        (TRAPS, "{ panel = { cam", "{ flare = { cam", "targets.traps.flare"),
        (TRAPS, "[82, 62, 36, 36]", "[182, 62, 36, 36]", "targets.traps.panel"),
    ],
)
def test_edges_and_traps_that_are_declared_wrongly_are_refused(tmp_path, declared, old, new, field):
    problems = developed(write(tmp_path / "c", "bands", declared, text(old, new), **QUIET)).problems
    assert any(problem.field.startswith(field) for problem in problems)

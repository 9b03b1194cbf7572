"""A chart before two small cameras: declared, found, measured, reported; refused where it is cut off."""

import json
import shutil
import tomllib

import numpy as np
import pytest
import tifffile
from PIL import Image
from typer.testing import CliRunner

import levkas
from levkas.building import build, status, summarise
from levkas.cli import app
from levkas.colour.srgb import SRGB_TO_XYZ, encode_srgb, observer_under
from levkas.core.digests import hash_file, hash_tree
from levkas.core.problems import Refused
from levkas.database.validation import validate
from levkas.quality.targets.charts import CHARTS, reference_of
from levkas.stages.charts import measure_charts

CLASSIC = CHARTS["ColorChecker24"]
NM = np.arange(420, 721, 60)
KEYS = """
[campaign]
title = "A chart"
reference = { camera = "vis", band = "540 nm" }
[cameras.vis]
kind = "bands"
files = "raw/{target}/{wavelength}nm_{shot}.tif"
bits = 12
[targets]
dark = "dark"
white = { names = "white", reflectance = 1.0 }
charts = { macbeth = "ColorChecker24" }
objects = ["panel"]
"""
CORNERS = "75,65,275,65,275,185,75,185"


def chart_picture(shift=0):
    spectra = reference_of(CLASSIC).at(NM.astype(float))
    picture = np.full((250, 350, len(NM)), 0.15)
    for i, (c, r) in enumerate(CLASSIC.centres.astype(int)):
        y, x = 45 + 40 * r, 55 + 40 * c + shift
        picture[y + 3 : y + 37, max(0, x + 3) : max(0, x + 37)] = spectra[i]
    return picture


def panel_picture():
    rng = np.random.default_rng(7)
    blocks = rng.uniform(0.05, 0.8, (25, 35, 1)) * rng.uniform(0.6, 1, (1, 1, len(NM)))
    return np.kron(blocks, np.ones((10, 10, 1)))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("charts"), np.random.default_rng(1)
    y, x = np.mgrid[:250, :350]
    light = 3200 * np.exp(-((x - 175) ** 2 + (y - 125) ** 2) / 2e5)
    scenes = {
        "dark": np.zeros((250, 350, len(NM))),
        "white": np.ones((250, 350, len(NM))),
        "macbeth": chart_picture(),
        "panel": panel_picture(),
    }
    for name, scene in scenes.items():
        (folder / "raw" / name).mkdir(parents=True)
        for i, nm in enumerate(NM):
            for shot in range(2):
                level = 60 + light * scene[..., i]
                noisy = level + np.sqrt(4 + 0.2 * (level - 60)) * rng.standard_normal(level.shape)
                frame = np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)
                tifffile.imwrite(folder / "raw" / name / f"{nm}nm_{shot}.tif", frame)
    (folder / "campaign.toml").write_text(KEYS)
    return folder


@pytest.mark.slow
def test_a_chart_of_a_campaign_is_measured_from_two_shots(campaign):
    corners = np.array(CORNERS.split(","), float).reshape(4, 2)
    report = measure_charts(campaign, corners=corners)
    assert report.ok, report.problems
    (made,) = report.measures
    assert made.table.temporal and made.sightings[0].located.agreement > 0.99
    # Gain 0.2, two shots of object, white and dark; light falls off towards the corners.
    for patch, place in ((18, (75, 185)), (21, (195, 185)), (23, (275, 185))):
        r = made.table.mean[patch, 2]
        light = 3200 * np.exp(-((place[0] - 175) ** 2 + (place[1] - 125) ** 2) / 2e5)
        own, white, dark = 4 + 0.2 * r * light, 4 + 0.2 * light, 4.0
        noise = np.sqrt((own + r**2 * white + (1 - r) ** 2 * dark) / 2)
        assert made.table.snr[patch, 2] == pytest.approx(r * light / noise, rel=0.06)
    # As far as the picture itself is from the truth, white and dark of this one build in it.
    cube = made.sightings[0].cube
    inner = np.s_[179:192, 69:82, 2]
    truth = chart_picture()[inner]
    found = np.std(cube.values[inner] - truth)
    assert made.table.noise[18, 2] == pytest.approx(found, rel=0.15)
    assert not any(p.found for p in made.preblurs)
    assert made.rows[0].value < 6  # five bands of 60 nm cannot do better than a few
    assert "macbeth/vis" in report.text


@pytest.mark.slow
def test_the_command_reports_and_writes_a_page(campaign, tmp_path):
    page = tmp_path / "chart.html"
    result = CliRunner().invoke(
        app, ["chart", str(campaign), "--corners", CORNERS, "--json", "-o", str(page)]
    )
    record = json.loads(result.stdout)
    assert result.exit_code == 0 and record["ok"]
    assert len(record["charts"][0]["patches"]) == 24
    html = page.read_text(encoding="utf-8")
    assert "Chart: macbeth/vis" in html and html.count("<path") >= 24


@pytest.mark.slow
def test_a_chart_half_out_of_frame_is_refused_with_what_to_capture(campaign):
    beyond = ",".join(str(float(v) - 200 * (i % 2 == 0)) for i, v in enumerate(CORNERS.split(",")))
    result = CliRunner().invoke(app, ["chart", str(campaign), "--corners", beyond, "--json"])
    (problem,) = json.loads(result.stdout)["problems"]
    assert result.exit_code == 1 and problem["code"] == "E_CHART_FRAME"
    assert "Capture the whole chart" in problem["fix"] and "macbeth" in problem["file"]


def test_a_campaign_without_charts_and_an_unknown_camera_are_refused(campaign, tmp_path):
    other = tmp_path / "campaign.toml"
    other.write_text("\n".join(line for line in KEYS.splitlines() if "charts" not in line))
    for path, cameras in ((other, ()), (campaign, ("nir",))):
        with pytest.raises(Refused):
            measure_charts(path, cameras=cameras)


@pytest.mark.slow
def test_a_build_writes_a_page_a_camera_and_leaves_it_alone_the_second_time(campaign):
    report = summarise(build(campaign))
    assert report.ok, report.problems
    page = campaign / "database" / "cameras" / "vis" / "report.html"
    html = page.read_text(encoding="utf-8")
    assert "Light field" in html and "stops" in html.lower()
    reported = (campaign / "database/objects/panel/report.html").read_text(encoding="utf-8")
    assert "Noise, glare and focus" in reported
    states = {s.key.stage: s.state for s in status(campaign).stages}
    assert states["camera"] == "fresh"
    again = [s for s in build(campaign) if s.finished]
    assert {s.state for s in again} == {"fresh"}
    assert again[-1].done == again[-1].total


@pytest.mark.slow
def test_a_build_keeps_the_chart_the_light_and_what_was_measured_of_the_camera(campaign, tmp_path):

    folder = shutil.copytree(
        campaign, tmp_path / "more", ignore=shutil.ignore_patterns("database*")
    )
    labels = ",".join(f"{nm} nm" for nm in NM)
    rows = "\n".join(f"{nm},{','.join('0.5' for _ in NM)}" for nm in range(400, 721, 20))
    (folder / "vis.csv").write_text(f"wavelength,{labels}\n{rows}\n")
    (folder / "halogen.csv").write_text("wavelength,power\n400,0.1\n700,1\n")
    more = KEYS.replace("[cameras.vis]", '[cameras.vis]\nsensitivity = "vis.csv"').replace(
        "[campaign]", '[campaign]\nsetup = "proposed"'
    )
    (folder / "campaign.toml").write_text(more + '[setups.proposed]\nspectrum = "halogen.csv"\n')
    report = summarise(build(folder))
    assert report.ok, report.problems
    database = folder / "database"
    cube, wavelengths, _, text = levkas.read_stiff(database / "charts/macbeth/macbeth_vis.tif")
    assert cube.shape == (250, 350, len(NM)) and list(wavelengths) == list(NM)
    assert json.loads(text)["quantity"] == "reflectance"
    white = cube[50:80, 60:90, 2]
    sigma = levkas.read_stiff(database / "charts/macbeth/macbeth_vis.sigma.tif")[0][50:80, 60:90, 2]
    assert white.std() == pytest.approx(float(np.median(sigma)), rel=0.35)
    assert (
        len(json.loads((database / "charts/macbeth/macbeth_vis.json").read_text())["patches"]) == 24
    )
    assert (database / "setups/proposed/spd.csv").read_text().startswith("wavelength,power")
    assert (database / "cameras/vis/sensitivity.csv").read_text().startswith(f"wavelength,{labels}")
    camera = json.loads((database / "cameras/vis/camera.json").read_text())
    assert camera["measured"][""][""]["sensor"]["gain"] == pytest.approx(0.2, rel=0.2)
    record = tomllib.loads((database / "database.toml").read_text())
    assert record["setups"] == {"proposed": {"cameras": ["vis"]}}
    steps = json.loads((database / "objects/panel/provenance.json").read_text())["steps"]
    assert [s["stage"] for s in steps] == ["calibrate", "register", "resample"]
    raw = {n: h for n, h in steps[0]["inputs"].items() if n.startswith("raw/panel/")}
    assert raw["raw/panel/420nm_0.tif"] == hash_file(folder / "raw/panel/420nm_0.tif")
    assert len(raw) == 2 * len(NM)
    (folder / "halogen.csv").write_text("wavelength,power\n400,0.2\n700,1\n")
    assert [s.key.stage for s in build(folder) if s.state == "done"] == ["catalogue"]
    assert "400,0.2" in (database / "setups/proposed/spd.csv").read_text()


@pytest.mark.slow
def test_a_chart_that_campaign_toml_declares_stays_while_its_frames_cannot_be_read(
    campaign, tmp_path
):
    folder = shutil.copytree(
        campaign, tmp_path / "campaign", ignore=shutil.ignore_patterns("database*")
    )
    assert summarise(build(folder)).ok
    charts = hash_tree(folder / "database/charts")
    assert charts
    frame = folder / "raw/macbeth/540nm_0.tif"
    whole = frame.read_bytes()
    frame.write_bytes(whole[:400])
    report = summarise(build(folder))
    assert any(w.startswith("charts/macbeth_vis: of an earlier build") for w in report.warnings)
    (folder / "raw/macbeth").rename(folder / "away")
    for _ in range(2):
        list(build(folder))
        assert hash_tree(folder / "database/charts") == charts
    (folder / "away").rename(folder / "raw/macbeth")
    frame.write_bytes(whole)
    report = summarise(build(folder))
    assert hash_tree(folder / "database/charts") == charts
    assert not any("of an earlier build" in warning for warning in report.warnings)
    text = (folder / "campaign.toml").read_text()
    without = text.replace('charts = { macbeth = "ColorChecker24" }\n', "")
    (folder / "campaign.toml").write_text(without)
    assert summarise(build(folder)).ok
    assert not (folder / "database/charts").exists()


@pytest.mark.slow
def test_charts_of_a_published_database_are_measured_again(campaign, tmp_path):
    database = tmp_path / "published"
    report = summarise(build(campaign))
    assert report.ok, report.problems
    shutil.copytree(campaign / "database", database)
    corners = np.array(CORNERS.split(","), float).reshape(4, 2)
    kept = measure_charts(database, corners=corners)
    assert kept.ok, kept.problems
    assert [m.name for m in kept.measures] == ["macbeth/vis"]
    own = measure_charts(campaign, corners=corners).measures[0]
    np.testing.assert_allclose(
        kept.measures[0].snr_db, own.snr_db, atol=4
    )  # one cube, texture included, against two shots
    none = measure_charts(database, objects=["panel"], corners=corners)
    assert [p.code for p in none.problems] == ["E_CHART_ORDER"]
    shutil.rmtree(database / "charts")
    everywhere = CliRunner().invoke(app, ["chart", str(database), "--json"])
    record = json.loads(everywhere.output)
    assert [p["code"] for p in record["problems"]] in (["E_CHART_MISSING"], ["E_CHART_DETECTOR"])
    with pytest.raises(Refused, match=r"no object of this name.*panel"):
        measure_charts(database, objects=["painting"])


@pytest.mark.slow
def test_black_patches_of_eight_bits_have_no_more_signal_to_noise_than_rounding_leaves(tmp_path):
    rng = np.random.default_rng(5)
    scenes = {
        "dark": 0 * chart_picture(),
        "white": 0 * chart_picture() + 1,
        "macbeth": chart_picture(),
    }
    for name, scene in scenes.items():
        (tmp_path / "raw" / name).mkdir(parents=True)
        for i, nm in enumerate(NM):
            for shot in range(2):
                level = 4.5 + 80 * scene[..., i]
                noisy = np.rint(level + 0.08 * np.sqrt(level) * rng.standard_normal(level.shape))
                path = tmp_path / "raw" / name / f"{nm}nm_{shot}.tif"
                tifffile.imwrite(path, noisy.clip(0, 255).astype(np.uint8))
    (tmp_path / "campaign.toml").write_text(KEYS.replace("bits = 12", "bits = 8"))
    (measure,) = measure_charts(tmp_path).measures
    truth = 80 * reference_of(CLASSIC).at(NM.astype(float))
    most = truth / np.sqrt(1 / 12)  # were there no noise but rounding
    dark = truth < 4  # counts
    assert dark.sum() >= 5
    assert (
        measure.table.snr[dark] < 1.6 * most[dark]
    ).all()  # a code is up to half a count from it
    assert np.median(measure.table.snr[dark] / most[dark]) < 1.1


def photograph(*, encoded=True):
    """A photograph of the chart, 8 bits, its colours as sRGB has them."""
    grid, weights = observer_under()
    reference = reference_of(CLASSIC)
    colours = reference.at(np.clip(grid, 380, 730)) @ weights @ np.linalg.inv(SRGB_TO_XYZ).T
    picture = np.full((250, 350, 3), 0.15)
    for i, (c, r) in enumerate(CLASSIC.centres.astype(int)):
        y, x = 45 + 40 * r, 55 + 40 * c
        picture[y + 3 : y + 37, x + 3 : x + 37] = colours[i]
    noisy = np.clip(
        picture + 0.0005 * np.random.default_rng(2).standard_normal(picture.shape), 0, 1
    )
    return encode_srgb(noisy) if encoded else np.rint(255 * noisy).astype(np.uint8)


@pytest.mark.parametrize("encoded", [True, False])
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_a_chart_is_measured_in_a_finished_photograph(tmp_path, encoded, suffix):
    path = tmp_path / f"chart.{suffix}"
    Image.fromarray(photograph(encoded=encoded)).save(path)
    result = CliRunner().invoke(app, ["chart", str(path), "--corners", CORNERS, "--json"])
    (chart,) = json.loads(result.stdout)["charts"]
    assert result.exit_code == 0
    assert any(("encoded as sRGB" if encoded else "linear") in note for note in chart["notes"])
    assert chart["indicators"][0]["value"] < (
        1.0 if encoded else 2.5
    )  # mean ΔE2000; dark codes are few
    # The black patch of a linear photograph of 8 bits: a step of 1/255 hides its noise of 0.0005.
    assert chart["patches"][23]["limited_by_quantisation"] == [not encoded] * 3


def test_nothing_is_printed_on_the_output_where_nothing_was_measured(tmp_path):
    Image.fromarray(np.full((200, 300, 3), 90, np.uint8)).save(tmp_path / "blank.png")
    result = CliRunner().invoke(app, ["chart", str(tmp_path / "blank.png")])
    assert result.exit_code == 1 and result.stdout == "" and "E_CHART_MISSING" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["image", "bands"])
def test_a_campaign_of_charts_alone_is_built(campaign, tmp_path, kind):
    if kind == "image":
        (tmp_path / "raw" / "macbeth").mkdir(parents=True)
        Image.fromarray(photograph()).save(tmp_path / "raw" / "macbeth" / "1.png")
        (tmp_path / "campaign.toml").write_text(
            '[campaign]\ntitle = "Charts"\nreference = { camera = "vis", band = "G" }\n'
            '[cameras.vis]\nkind = "image"\nfiles = "raw/{target}/{shot}.png"\n'
            '[targets]\ncharts = { macbeth = "Colour Checker" }\n'
        )
    else:
        for name in ("dark", "white", "macbeth"):
            shutil.copytree(campaign / "raw" / name, tmp_path / "raw" / name)
        keys = KEYS.replace('objects = ["panel"]\n', "").replace("ColorChecker24", "Farbkarte")
        (tmp_path / "campaign.toml").write_text(keys)
    made = summarise(build(tmp_path))
    assert made.ok and not made.problems
    page = (tmp_path / "database" / "cameras" / "vis" / "report.html").read_text()
    assert "macbeth/vis" in page  # measured, or named where this OpenCV does not find it
    assert validate(tmp_path / "database").ok


def test_a_target_may_be_chart_and_object_at_once(tmp_path):
    (tmp_path / "macbeth").mkdir()
    Image.fromarray(photograph()).save(tmp_path / "macbeth" / "photo.png")
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\ntitle = "Charts"\nreference = { camera = "photo", band = "G" }\n'
        '[cameras.photo]\nkind = "image"\nfiles = "{target}/photo.png"\n'
        '[targets]\ncharts = { macbeth = "macbeth" }\nobjects = ["macbeth"]\n'
    )
    assert summarise(build(tmp_path)).ok
    corners = np.array(CORNERS.split(","), float).reshape(4, 2)
    layer = measure_charts(tmp_path / "database", objects=["macbeth"], corners=corners)
    assert [m.name for m in layer.measures] == ["macbeth/photo"] and layer.ok
    assert layer.measures[0].colours.difference.mean() < 1  # decoded, as the photograph itself


EDGE_KEYS = """
[campaign]
title = "An edge"
reference = { camera = "vis", band = "540 nm" }
[cameras.vis]
kind = "bands"
files = "raw/{target}/{wavelength}nm_{shot}.tif"
bits = 12
[targets]
dark = "dark"
white = { names = "white", reflectance = 1.0 }
charts = { sfr = "edges" }
edges = { sfr = { vis = [[40, 20, 60, 100], [130, 60, 100, 50]] } }
"""
SHIFTS = {420: 0.0, 540: 0.3, 660: 0.0}


@pytest.fixture(scope="module")
def edged(tmp_path_factory):
    """A black square on white that leans by 5 degrees, its middle band 0.3 px to the right of the others."""
    from scipy.special import ndtr

    folder, rng = tmp_path_factory.mktemp("edges"), np.random.default_rng(4)
    y, x = np.mgrid[:180, :260].astype(float)
    lean, sigma = np.deg2rad(5), 0.7
    for name in ("dark", "white", "sfr"):
        (folder / "raw" / name).mkdir(parents=True)
        for nm, shift in SHIFTS.items():
            across = (x - 70 - shift) * np.cos(lean) + (y - 85) * np.sin(lean)
            down = (y - 85) * np.cos(lean) - (x - 70 - shift) * np.sin(lean)
            square = ndtr(across / sigma) * ndtr(down / sigma)
            scene = {"dark": 0.0, "white": 1.0, "sfr": 0.9 - 0.8 * square}[name]
            for shot in range(2):
                level = 60 + 3200 * scene * np.ones(x.shape)
                noisy = level + np.sqrt(4 + 0.05 * (level - 60)) * rng.standard_normal(x.shape)
                frame = np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)
                tifffile.imwrite(folder / "raw" / name / f"{nm}nm_{shot}.tif", frame)
    (folder / "campaign.toml").write_text(EDGE_KEYS.replace("40, 20, 60, 100", "45, 90, 60, 85"))
    return folder


@pytest.mark.slow
def test_edges_that_a_campaign_names_are_measured_reported_and_kept(edged):
    built = summarise(build(edged))
    assert built.ok, built.problems
    report = measure_charts(edged)
    assert report.ok, report.problems
    (made,) = report.measures
    upright, level = made.edges.tables
    assert (upright.axis, level.axis) == ("x", "y")
    expected = 0.3 * np.cos(np.deg2rad(5))
    assert upright.largest_shift == pytest.approx(expected, abs=0.02)
    assert upright.shift[1] > upright.shift[0]
    # The Gaussian alone: the scene was sampled at points.
    assert upright.sfr50 == pytest.approx(np.sqrt(np.log(2) / 2) / np.pi / 0.7, rel=0.02)
    html = (edged / "database/cameras/vis/report.html").read_text(encoding="utf-8")
    assert "colour misregistration" in html and "Spatial frequency response" in html
    assert html.count("modulation over cycles/px") == 2
    again = measure_charts(edged / "database")
    (kept,) = again.measures
    assert kept.edges.tables[0].sfr50 == pytest.approx(upright.sfr50, rel=1e-5)
    result = CliRunner().invoke(app, ["chart", str(edged), "--json"])
    record = json.loads(result.stdout)
    assert result.exit_code == 0 and record["charts"][0]["chart"] == "edges"
    assert record["charts"][0]["edges"][0]["bands"][0]["sampling_efficiency"] > 0.5


def test_edges_of_a_cube_are_named_on_the_command_line_and_refused_by_name(edged, tmp_path):
    assert summarise(build(edged)).ok
    cube = str(next((edged / "database/charts/sfr").glob("*vis.tif")))
    page = tmp_path / "edge.html"
    good = ["chart", cube, "--kind", "edges", "--edge", "45,90,60,85", "-o", str(page)]
    result = CliRunner().invoke(app, good)
    assert result.exit_code == 0, result.output
    assert "edge 1 (45,90,60,85): 5.0 degrees, along x: SFR50" in result.stdout
    assert "FADGI" in result.stdout and "Chart: sfr_vis.tif" in page.read_text(encoding="utf-8")
    for box, code in (
        ("200,100,40,40", "E_EDGE_CONTRAST"),
        ("0,0,999,10", "E_REGION"),
        ("5,5", "E_VALUE"),
    ):
        result = CliRunner().invoke(
            app, ["chart", cube, "--kind", "edges", "--edge", box, "--json"]
        )
        assert result.exit_code == 1
        assert [p["code"] for p in json.loads(result.stdout)["problems"]] == [code]
    result = CliRunner().invoke(app, ["chart", cube, "--kind", "edges", "--json"])
    assert json.loads(result.stdout)["problems"][0]["code"] == "E_EDGE_MISSING"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("{ vis = ", "{ nir = ", "unknown camera"),
        ("edges = { sfr", "edges = { square", "not listed in targets.charts"),
        ("[[40, 20, 60, 100]", "[[40, 20, 60]", "x, y, width, height"),
        ("{ vis = ", '{ "vis@soft" = ', "unknown setup"),
    ],
)
def test_edges_that_are_declared_wrongly_are_refused(tmp_path, old, new, message):
    assert old in EDGE_KEYS
    (tmp_path / "campaign.toml").write_text(EDGE_KEYS.replace(old, new, 1))
    with pytest.raises(Refused, match=message):
        measure_charts(tmp_path)


def test_edges_of_a_finished_photograph_are_said_to_be_encoded(tmp_path):
    from scipy.special import ndtr

    y, x = np.mgrid[:100, :64].astype(float)
    lean = np.deg2rad(5)
    light = 0.1 + 0.7 * ndtr(((x - 32) * np.cos(lean) - (y - 50) * np.sin(lean)) / 0.8)
    codes = np.round(255 * encode_srgb(light)).astype(np.uint8)
    Image.fromarray(np.repeat(codes[..., None], 3, 2)).save(tmp_path / "photo.png")
    result = CliRunner().invoke(
        app, ["chart", str(tmp_path / "photo.png"), "--kind", "edges", "--edge", "0,0,64,100"]
    )
    assert result.exit_code == 0 and "encoded values" in result.stdout
    assert "colour misregistration, largest" in result.stdout and ": 0.00 px" in result.stdout


@pytest.mark.slow
def test_a_build_names_stray_light_on_a_chart_and_a_page_without_one_says_that_it_was_not_measured(
    campaign, tmp_path
):
    veiled = tmp_path / "veiled"
    shutil.copytree(campaign, veiled, ignore=shutil.ignore_patterns("database*"))
    for path in (veiled / "raw" / "macbeth").glob("*.tif"):
        frame = tifffile.imread(path).astype(float)
        tifffile.imwrite(path, np.rint(frame + 0.02 * 3000).clip(0, 4095).astype(np.uint16))
    said = [text for step in build(veiled) for text in step.warnings]
    assert any("the greys are lifted by" in text and "stray light" in text for text in said)
    page = veiled / "database" / "cameras" / "vis" / "report.html"
    assert "stray light" in page.read_text(encoding="utf-8")
    text = (veiled / "campaign.toml").read_text().replace("charts =", "# charts =")
    (veiled / "campaign.toml").write_text(text)
    assert not any("stray" in text for step in build(veiled) for text in step.warnings)
    assert "stray light was not measured" in page.read_text(encoding="utf-8")

"""Reflectance by a chart in place of a white: a planted light comes back through whole builds, or is refused."""

import json
import shutil

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

import levkas
from levkas.building import build, status, summarise
from levkas.calibration.chart_light import CHART_WHITE as KEY
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.guess import look
from levkas.cli import app
from levkas.core.problems import Refused
from levkas.database.spectral_tiff import read_tiff_pages
from levkas.quality.targets.charts import CHARTS, reference_of
from levkas.quality.targets.locating import locate_chart
from levkas.stages.budget import budget_of
from levkas.stages.calibrate import develop
from levkas.stages.charts import measure_charts
from levkas.stages.template_cache import TemplateCache

CLASSIC = CHARTS["ColorChecker24"]
PUBLISHED = reference_of(CLASSIC)
NM = np.array([450, 540, 630, 850])
HEIGHT, WIDTH = 250, 350
CORNERS = [[70, 60], [270, 60], [270, 180], [70, 180]]
Y, X = np.mgrid[:HEIGHT, :WIDTH]
LIGHT = 3000 * (1 + 0.25 * (X - 175) / 175 - 0.15 * (Y - 125) / 125)
ON_CHART = (X > 60) & (X < 280) & (Y > 50) & (Y < 190)
KEYS = f"""
[campaign]
title = "No white"
reference = {{ camera = "vis", band = "540 nm" }}
[grid]
size = [175, 125]
[database]
native = true
[cameras.vis]
kind = "bands"
files = "raw/{{target}}/{{wavelength}}nm_{{shot}}.tif"
bits = 12
white = {{ chart = "macbeth", corners = {CORNERS} }}
[targets]
dark = "dark"
charts = {{ macbeth = "ColorChecker24" }}
objects = ["panel"]
"""


def spectra_of(nm):
    """Planted: as published, and beyond 730 nm rising by 0.1 per 100 nm, as paints do."""
    inside = PUBLISHED.at(np.minimum(np.asarray(nm, float), 730.0))
    return np.clip(inside + 0.1 * np.maximum(np.asarray(nm) - 730, 0) / 100, 0, 0.95)


def chart_picture(nm):
    picture = np.full((HEIGHT, WIDTH, len(nm)), 0.15)
    for spectrum, (c, r) in zip(spectra_of(nm), CLASSIC.centres.astype(int), strict=True):
        y, x = 40 + 40 * r, 50 + 40 * c
        picture[y + 3 : y + 38, x + 3 : x + 38] = spectrum
    return picture


def panel_picture(bands):
    rng = np.random.default_rng(7)
    blocks = rng.uniform(0.05, 0.8, (25, 35, 1)) * rng.uniform(0.6, 1, (1, 1, bands))
    return np.kron(blocks, np.ones((10, 10, 1)))


def write_frames(folder, scenes, rng, *, fixed=None, full=4095):
    for name, scene in scenes.items():
        (folder / "raw" / name).mkdir(parents=True)
        for i, nm in enumerate(NM):
            for shot in range(2):
                level = LIGHT * scene[..., i] * (1.0 if fixed is None else fixed)
                noisy = 60 + level + np.sqrt(4 + 0.2 * level) * rng.standard_normal(level.shape)
                frame = np.clip(np.rint(noisy), 0, full).astype(np.uint16)
                tifffile.imwrite(folder / "raw" / name / f"{nm}nm_{shot}.tif", frame)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("no-white"), np.random.default_rng(1)
    fixed = 1 + 0.005 * rng.standard_normal((HEIGHT, WIDTH))
    none = np.zeros((HEIGHT, WIDTH, len(NM)))
    scenes = {"dark": none, "macbeth": chart_picture(NM), "panel": panel_picture(len(NM))}
    write_frames(folder, scenes, rng, fixed=fixed)
    (folder / "campaign.toml").write_text(KEYS)
    return folder


@pytest.fixture
def copy(campaign, tmp_path):
    ignored = shutil.ignore_patterns("database*")
    return shutil.copytree(campaign, tmp_path / "copy", ignore=ignored)


def developed(folder, name="panel"):
    read = load_campaign(folder)
    captures, refusals = find_captures(read)
    assert not refusals, refusals
    kept = folder / "kept"
    kept.mkdir(exist_ok=True)
    capture = next(c for c in captures if c.object == name)
    return develop(capture, read, TemplateCache(kept))


def refusals_of(folder):
    report = summarise(build(folder))
    assert not report.ok
    return report.problems


def write_reference(path, *, last=1000):
    nm = np.arange(380, last + 1, 10)
    head = ",".join(("wavelength", *CLASSIC.patches))
    rows = [
        f"{n},{','.join(f'{v:.5f}' for v in s)}" for n, s in zip(nm, spectra_of(nm).T, strict=True)
    ]
    path.write_text("\n".join([head, *rows]) + "\n")


@pytest.mark.slow
def test_a_build_makes_reflectance_by_the_chart_and_says_how_well(campaign):
    report = summarise(build(campaign))
    assert report.ok, report.problems
    truth = panel_picture(len(NM))[..., :3]
    folder = campaign / "database" / "objects" / "panel"
    values, sigma = (read_tiff_pages(folder / f"native/panel_vis{k}.tif") for k in ("", ".sigma"))
    assert values.shape == truth.shape  # 850 nm is left out
    off = values - truth
    assert np.sqrt(np.mean(off[ON_CHART] ** 2)) < 0.008
    # With even light the same pixels would be off by the gradient.
    even = truth * (LIGHT / LIGHT[ON_CHART].mean())[..., None] - truth
    assert np.sqrt(np.mean(even[ON_CHART] ** 2)) > 0.03
    for part in (ON_CHART, ~ON_CHART):
        assert 0.93 < np.mean(np.abs(off[part]) < 1.96 * sigma[part]) <= 1
    assert any("850 nm: no reference in the infrared" in w for w in report.warnings)
    assert any("reflectance by the chart macbeth" in w for w in report.warnings)
    assert any("is beyond the chart" in w for w in report.warnings)
    provenance = json.loads((folder / "provenance.json").read_text())
    (step,) = [s for s in provenance["steps"] if s["stage"] == "calibrate"]
    record = step[KEY][""]
    assert record["reference"] == "BabelColor average" and record["left_out"] == ["850 nm"]
    assert len(record["bands"]["540 nm"]["patches"]) == 24
    assert record["held_out"] < 0.01 < 0.05 < record["held_out_even_light"]
    assert {f["role"] for f in step["frames"]} == {"object", "dark", "chart"}
    page = (campaign / "database/cameras/vis/report.html").read_text(encoding="utf-8")
    assert "Reflectance by a chart" in page and "a plane" in page
    assert "only their held-out errors are a test" in page
    camera = json.loads((campaign / "database/cameras/vis/camera.json").read_text())
    assert camera["measured"][""][""][KEY]["bands"].keys() == record["bands"].keys()


@pytest.mark.slow
def test_what_was_built_is_fresh_and_a_chart_that_changes_is_a_reason_to_redo(campaign, copy):
    assert summarise(build(copy)).ok
    assert {s.state for s in status(copy).stages} == {"fresh"}
    result = CliRunner().invoke(app, ["build", str(copy), "--json"])
    (row,) = json.loads(result.stdout)["layers"]
    assert row[KEY][""]["chart"] == "ColorChecker24" and row[KEY][""]["held_out"] < 0.01
    frame = copy / "raw" / "macbeth" / "540nm_0.tif"
    tifffile.imwrite(frame, tifffile.imread(frame) + np.uint16(1))
    states = {s.key.stage: (s.state, s.why) for s in status(copy).stages if s.key.object}
    assert states["calibrate"][0] == "stale" and "540nm_0.tif" in states["calibrate"][1]


def chart_rows(folder, made):
    """What the budget says of the chart, by unit and band."""
    campaign = load_campaign(folder)
    capture = next(c for c in find_captures(campaign)[0] if c.object == "panel")
    rows = [r for r in budget_of(campaign, capture, made.measured) if r.name == "chart as white"]
    return {row.unit: row.size for row in rows}


@pytest.mark.slow
def test_the_error_of_the_light_is_in_the_budget_and_no_mean_makes_it_smaller(copy):
    """Patches off by 6 %: the light is worse known than a pixel's noise."""
    rng = np.random.default_rng(3)
    scene = chart_picture(NM)
    for c, r in CLASSIC.centres.astype(int):
        scene[40 + 40 * r : 80 + 40 * r, 50 + 40 * c : 90 + 40 * c] *= (
            1 + 0.06 * rng.standard_normal()
        )
    shutil.rmtree(copy / "raw" / "macbeth")
    write_frames(copy, {"macbeth": scene}, rng)
    assert summarise(build(copy)).ok
    layer = levkas.open(copy / "database")["panel"]["vis"]
    few, many = (layer.levkas.uncertainty(rectangle=(20, 20, to, to)) for to in (22, 60))
    light = many.u_by_source.sel(source="chart as white") / many.value
    assert (light > 0.01).all() and (many.u_random < 0.2 * few.u_random).all()
    assert np.allclose(many.u_common / many.value, few.u_common / few.value, rtol=0.2)
    assert float((layer.levkas.sigma / layer).median()) < 0.02


def test_what_held_out_patches_miss_is_in_the_budget(copy):
    rng = np.random.default_rng(8)
    scene = chart_picture(NM)
    for c, r in CLASSIC.centres.astype(int):
        scene[40 + 40 * r : 80 + 40 * r, 50 + 40 * c : 90 + 40 * c] *= rng.normal(1, 0.05)
    shutil.rmtree(copy / "raw" / "macbeth")
    write_frames(copy, {"macbeth": scene}, rng)
    rows = chart_rows(copy, developed(copy))
    for band, relative in rows["relative"].items():
        # Patches are off by 5 %; over a frame of which half lies beyond the chart the light is known less well.
        assert 0.03 < np.hypot(relative, rows["reflectance"][band] / 0.6) < 0.12


def test_a_chart_measured_into_the_infrared_serves_every_band(copy):
    write_reference(copy / "chart.csv")
    text = KEYS.replace('chart = "macbeth",', 'chart = "macbeth", reference = "chart.csv",')
    (copy / "campaign.toml").write_text(text)
    made = developed(copy)
    assert [b.label for b in made.bands] == ["450 nm", "540 nm", "630 nm", "850 nm"]
    off = made.cubes[""].values - panel_picture(len(NM))
    assert np.sqrt(np.mean(off[ON_CHART] ** 2)) < 0.008
    assert made.measured[""][KEY]["reference"] == "chart.csv"


def test_a_chart_in_the_objects_own_frame_is_found_there(copy):
    scene = panel_picture(len(NM))
    scene[ON_CHART] = chart_picture(NM)[ON_CHART]
    shutil.rmtree(copy / "raw" / "panel")
    shutil.rmtree(copy / "raw" / "macbeth")
    write_frames(copy, {"panel": scene}, np.random.default_rng(5))
    text = KEYS.replace('chart = "macbeth"', 'chart = "ColorChecker Classic"')
    (copy / "campaign.toml").write_text(
        text.replace('charts = { macbeth = "ColorChecker24" }\n', "")
    )
    made = developed(copy)
    assert made.measured[""][KEY]["target"] == "panel"
    off = (made.cubes[""].values - scene[..., :3])[~ON_CHART]
    assert np.mean(np.abs(off)) < 0.015


def test_a_leaking_band_is_scaled_by_its_greys_with_the_light_of_another(copy):
    leak = chart_picture(NM)
    rng = np.random.default_rng(6)
    for i, (c, r) in enumerate(CLASSIC.centres.astype(int)):
        if i not in CLASSIC.greys:
            leak[43 + 40 * r : 78 + 40 * r, 53 + 40 * c : 88 + 40 * c, 0] = rng.uniform(0.1, 0.8)
    shutil.rmtree(copy / "raw" / "macbeth")
    write_frames(copy, {"macbeth": leak}, rng)
    made = developed(copy)
    band = made.measured[""][KEY]["bands"]["450 nm"]
    assert band["light_of"] == "540 nm" and len(band["patches"]) == band["greys"] == 6
    assert "a leaking filter" in band["why"]
    # Its greys are right, and colours are off by what a leak does to paints: 0.3 rms.
    assert np.hypot(*band["sigma_of_patches"]) > 0.1
    rows = chart_rows(copy, made)
    leaking, sound = (np.hypot(*(rows[u][b] for u in rows)) for b in ("450 nm", "540 nm"))
    assert leaking > 8 * sound
    off = made.cubes[""].values[..., 0] - panel_picture(len(NM))[..., 0]
    assert np.sqrt(np.mean(off[ON_CHART] ** 2)) < 0.012


MOSAIC = f"""
[campaign]
title = "A colour camera"
reference = {{ camera = "rgb", band = "G" }}
[cameras.rgb]
kind = "mosaic"
pattern = "RGGB"
files = "raw/{{target}}/{{shot}}.tif"
bits = 12
sensitivity = "rgb.csv"
white = {{ chart = "macbeth", corners = {CORNERS} }}
[targets]
dark = "dark"
charts = {{ macbeth = "ColorChecker24" }}
objects = ["panel"]
"""


@pytest.mark.parametrize("known", [True, False])
def test_a_mosaic_is_calibrated_through_its_sensitivities_or_by_its_greys_alone(tmp_path, known):
    rng, nm = np.random.default_rng(2), np.arange(400, 721, 10)
    curves = np.exp(-(((nm[:, None] - np.array([600, 540, 460])) / 40.0) ** 2))
    rows = [f"{n},{a:.6f},{b:.6f},{c:.6f}" for n, (a, b, c) in zip(nm, curves, strict=True)]
    (tmp_path / "rgb.csv").write_text("wavelength,R,G,B\n" + "\n".join(rows) + "\n")
    patches = spectra_of(nm) @ curves / curves.sum(0)
    chart = np.full((HEIGHT, WIDTH, 3), 0.15)
    for patch, (c, r) in zip(patches, CLASSIC.centres.astype(int), strict=True):
        chart[43 + 40 * r : 78 + 40 * r, 53 + 40 * c : 88 + 40 * c] = patch
    panel = np.kron(panel_picture(3)[::20, ::20], np.ones((20, 20, 1)))[:HEIGHT, :WIDTH]
    channel = np.array([[0, 1], [1, 2]])[Y % 2, X % 2]
    for name, scene in (("dark", 0 * chart), ("macbeth", chart), ("panel", panel)):
        (tmp_path / "raw" / name).mkdir(parents=True)
        for shot in range(2):
            level = LIGHT * np.take_along_axis(scene, channel[..., None], 2)[..., 0]
            noisy = 60 + level + np.sqrt(4 + 0.2 * level) * rng.standard_normal(level.shape)
            frame = np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)
            tifffile.imwrite(tmp_path / "raw" / name / f"{shot}.tif", frame)
    text = MOSAIC if known else MOSAIC.replace('sensitivity = "rgb.csv"\n', "")
    (tmp_path / "campaign.toml").write_text(text)
    made = developed(tmp_path)
    cube, flat = made.cubes[""], np.zeros((HEIGHT, WIDTH), bool)
    for y in range(20, HEIGHT - 20, 20):
        flat[y + 5 : y + 15, 25:325] = True
    flat &= ON_CHART & (X % 20 > 4) & (X % 20 < 16)
    off = (cube.values - panel)[flat]
    if known:
        assert np.sqrt(np.mean(off**2)) < 0.01
        assert np.mean(np.abs(off) < 1.96 * cube.sigma[flat]) > 0.9
    else:
        assert np.sqrt(np.mean(off**2)) < 0.1  # the gradient is left
        assert any("declare `sensitivity`" in w for w in made.warnings)
        assert made.measured[""][KEY]["bands"]["G"]["order"] == 0


@pytest.mark.slow
def test_a_mosaic_whose_channels_nobody_knows_is_scaled_by_greys_even_in_the_infrared(tmp_path):
    rng = np.random.default_rng(4)
    deep = np.array([[690.0, 700.0, 710.0], [720.0, 730.0, 690.0], [700.0, 710.0, 720.0]])
    patches = PUBLISHED.at(deep.ravel())
    chart, panel = np.full((HEIGHT, WIDTH, 9), 0.15), np.full((HEIGHT, WIDTH, 9), 0.4)
    for patch, (c, r) in zip(patches, CLASSIC.centres.astype(int), strict=True):
        chart[43 + 40 * r : 78 + 40 * r, 53 + 40 * c : 88 + 40 * c] = patch
    which = (3 * (Y % 3) + X % 3)[..., None]
    for name, scene in (("dark", 0 * chart), ("macbeth", chart), ("panel", panel)):
        (tmp_path / "raw" / name).mkdir(parents=True)
        level = 3000 * np.take_along_axis(scene, which, 2)[..., 0]
        for shot in range(2):
            noisy = 60 + level + np.sqrt(4 + 0.2 * level) * rng.standard_normal(level.shape)
            frame = np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)
            tifffile.imwrite(tmp_path / "raw" / name / f"{shot}.tif", frame)
    rows = [[f"B{3 * row + k + 1}" for k in range(3)] for row in range(3)]
    text = MOSAIC.replace('sensitivity = "rgb.csv"\n', "").replace('"RGGB"', json.dumps(rows))
    (tmp_path / "campaign.toml").write_text(text.replace('band = "G"', 'band = "B5"'))
    made = developed(tmp_path)
    assert np.abs(made.cubes[""].values[ON_CHART].mean(0) / 0.4 - 1).max() < 0.05
    (note,) = [w for w in made.warnings if "no sensitivity is known" in w]
    assert "B1, B2" in note and "`wavelengths`" in note


# --- refusals -----------------------------------------------------------------------------------


def test_a_frame_without_the_chart_is_refused(copy):
    shutil.rmtree(copy / "raw" / "macbeth")
    shutil.copytree(copy / "raw" / "panel", copy / "raw" / "macbeth")
    (problem,) = refusals_of(copy)
    assert problem.code == "E_CHART_ORDER" and problem.field == "cameras.vis.white.chart"
    assert "macbeth" in problem.file and "white of the camera" in problem.message
    shutil.rmtree(copy / "raw" / "macbeth")
    with pytest.raises(Refused) as refused:
        summarise(build(copy))
    problem = refused.value.problems[0]
    assert (
        problem.code == "E_CHART_MISSING"
        and "no frame shows the chart 'macbeth'" in problem.message
    )


def test_unknown_spectra_are_refused(copy):
    (copy / "campaign.toml").write_text(KEYS.replace("ColorChecker24", "ColorCheckerSG"))
    problem = refusals_of(copy)[0]
    assert problem.code == "E_CHART_REFERENCE" and "none are published" in problem.message
    write_reference(copy / "chart.csv", last=400)  # of ultraviolet alone
    keys = KEYS.replace('chart = "macbeth",', 'chart = "macbeth", reference = "chart.csv",')
    (copy / "campaign.toml").write_text(keys)
    with pytest.raises(Refused) as refused:
        summarise(build(copy))
    problem = refused.value.problems[0]
    assert problem.code == "E_CHART_REFERENCE" and "380 to 400 nm" in problem.message


def test_saturated_patches_and_too_few_greys_are_refused(copy):
    rng = np.random.default_rng(8)
    cases = ((12.0, "E_WHITE_SATURATED"), (7.5, "E_WHITE_SATURATED"), (0.0, "E_CHART_ORDER"))
    for scale, code in cases:
        shutil.rmtree(copy / "raw" / "macbeth")
        write_frames(copy, {"macbeth": np.maximum(scale * chart_picture(NM), 0)}, rng)
        problem = refusals_of(copy)[0]
        assert problem.code == code, problem
        assert problem.fix and "macbeth" in problem.file


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('chart = "macbeth"', 'chart = "macbeth", names = "white"', "not both"),
        ('chart = "macbeth"', 'chart = "mcbeth"', "neither a declared chart target"),
        ('chart = "macbeth"', 'reference = "x.csv"', "chart is required"),
        ('kind = "bands"', 'kind = "cube"', "cannot be calibrated by a chart"),
        ('chart = "macbeth"', 'chart = "macbeth", reference = "no.csv"', "does not exist"),
        ("[70, 60], [270, 60]", "[70, 60]", "corners"),
    ],
)
def test_wrong_tables_are_refused(copy, old, new, words):
    (copy / "campaign.toml").write_text(KEYS.replace(old, new))
    with pytest.raises(CampaignInvalid) as refused:
        load_campaign(copy)
    assert words in str(refused.value)


@pytest.mark.slow
def test_a_chart_of_another_size_is_refused(copy):
    for frame in (copy / "raw" / "macbeth").glob("*.tif"):
        tifffile.imwrite(frame, tifffile.imread(frame)[:-10])
    for frame in (copy / "raw" / "dark").glob("*.tif"):
        frame.unlink()
    (copy / "campaign.toml").write_text(
        KEYS.replace('dark = "dark"', "").replace("bits = 12", "bits = 12\nblack = 60")
    )
    problem = refusals_of(copy)[0]
    assert problem.code == "E_SIZE" and problem.found == "350 x 240"


# --- look, and charts in the infrared -----------------------------------------------------------


def test_look_offers_the_chart_where_there_is_no_white(copy):
    (copy / "campaign.toml").unlink()
    text = look(copy).text
    assert '# white = { chart = "macbeth" }  # reflectance by the chart' in text


def test_infrared_bands_of_a_chart_are_compared_with_nothing(copy):
    (copy / "campaign.toml").write_text(
        KEYS.replace(f'white = {{ chart = "macbeth", corners = {CORNERS} }}\n', "")
    )
    corners = np.array(CORNERS, float)
    (made,) = measure_charts(copy, corners=corners).measures
    assert any("no reference in the infrared for 850 nm" in n for n in made.notes)
    assert np.isnan(made.sightings[0].located.bands[3])
    assert np.isfinite(made.snr_db[18, 3])


def test_a_camera_that_sees_the_infrared_alone_knows_the_chart_by_its_greys():
    found = locate_chart(
        chart_picture(NM)[..., 3:],
        NM[3:].astype(float),
        CLASSIC,
        PUBLISHED,
        corners=np.array(CORNERS, float),
    )
    assert found.agreement == pytest.approx(1)

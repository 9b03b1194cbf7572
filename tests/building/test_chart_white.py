"""Reflectance by a chart in place of a white: planted patches give back a planted light, or it is refused."""

import numpy as np
import pytest
from camera import paint_chart
from cameras import developed, drop, errors, frames, reshot, text, tones, write

from levkas.building import build, status, summarise
from levkas.calibration.chart_light import CHART_WHITE as KEY
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.campaign.guess import look
from levkas.quality.targets.charts import CHARTS, reference_of
from levkas.quality.targets.locating import locate_chart

CLASSIC = CHARTS["ColorChecker24"]
PUBLISHED = reference_of(CLASSIC)
SHAPE, NM = (140, 200), np.array([450.0, 550.0, 650.0])
PATCHES = PUBLISHED.at(NM)
CORNERS = [[22, 23], [177, 23], [177, 116], [22, 116]]
"""Of the chart that the camera of `tests/promises` paints at this size."""
VIEW = paint_chart(SHAPE, PATCHES)[..., 1]
WHITE = 'white = { names = "white", reflectance = 1.0 }\n'
TABLE = f'white = {{ chart = "macbeth", corners = {CORNERS} }}'


def make(folder, *changes, kind="bands", table=TABLE, **habits):
    """Write a campaign whose white is a chart; its lamp is uneven."""
    no_white = text(WHITE, ""), text("bits = 12\n", f"bits = 12\n{table}\n"), drop("white*")
    options = {"shape": SHAPE, "chart": PATCHES, "vignette": 0.3, "shots": (4, 1, 2)} | habits
    return write(folder, kind, *no_white, *changes, **options)


def write_reference(path, last=1000):
    nm = np.arange(380, last + 1, 10)
    spectra = PUBLISHED.at(np.clip(np.where(nm > 700, 650, nm), 380, 730).astype(float))
    rows = [f"{n},{','.join(f'{v:.5f}' for v in s)}" for n, s in zip(nm, spectra.T, strict=True)]
    path.write_text("\n".join([",".join(("wavelength", *CLASSIC.patches)), *rows]) + "\n")


def in_the_infrared(folder):
    """The last band, of 650 nm, is said to be that of 850 nm."""
    for path in (folder / "raw").glob("*_650nm_*"):
        path.rename(path.with_name(path.name.replace("650", "850")))


def test_the_light_on_a_chart_makes_reflectance(tmp_path):
    made = developed(make(tmp_path / "c"))
    bias, error, _ = errors(made, "bands")
    assert (
        abs(bias) < 0.015 + 4 * error
    )  # patches of one chart differ by 1.5 % from those published
    tone, inner = tones(SHAPE)
    off = (made.cube.values / tone[..., None] - 1)[inner & (tone > 0.1)]
    assert off.std() < 0.06  # with even light the vignette of up to 30 % would be in it
    record = made.measured[KEY]
    assert record["reference"] == "BabelColor average"
    assert len(record["bands"]["550 nm"]["patches"]) == 24
    assert record["held_out"] < 0.02 < record["held_out_even_light"]


@pytest.mark.parametrize("known", [False, True])
def test_a_band_in_the_infrared_is_left_out_unless_the_chart_was_measured_there(tmp_path, known):
    folder = make(tmp_path / "c", in_the_infrared)
    if known:
        write_reference(folder / "chart.csv")
        text('chart = "macbeth",', 'chart = "macbeth", reference = "chart.csv",')(folder)
    made = developed(folder)
    labels = [band.label for band in made.cube.bands]
    assert labels == ["450 nm", "550 nm", "850 nm"][: 2 + known]
    assert known or made.told("850 nm")
    assert abs(errors(made, "bands")[0]) < 0.02


def test_a_chart_in_the_objects_own_frame_is_found_there(tmp_path):
    view = paint_chart(SHAPE, PATCHES)
    table = TABLE.replace('"macbeth"', '"ColorChecker Classic"')
    made = developed(make(tmp_path / "c", table=table, truth=view, chart=None))
    assert made.measured[KEY]["target"] == "panel"
    assert np.mean(np.abs(made.cube.values - view)[20:120, 15:185]) < 0.02


def test_a_leaking_band_is_scaled_by_its_greys_with_the_light_of_another(tmp_path):
    patches = PATCHES.copy()
    patches[:18, 0] = np.random.default_rng(6).uniform(0.1, 0.8, 18)
    made = developed(make(tmp_path / "c", chart=patches))
    band = made.measured[KEY]["bands"]["450 nm"]
    assert band["light_of"] == "550 nm" or band["light_of"] == "650 nm"
    assert len(band["patches"]) == 6
    sizes = made.budget["chart as white"].size
    assert sizes["450 nm"] > 3 * sizes["550 nm"]
    assert abs(errors(made, "bands")[0]) < 0.03


@pytest.mark.parametrize("known", [True, False])
def test_a_mosaic_is_calibrated_through_its_sensitivities_or_by_its_greys_alone(tmp_path, known):
    folder = make(tmp_path / "c", kind="mosaic", chart=np.repeat(PATCHES[:, 1:2], 3, 1))
    if known:
        nm = np.arange(400, 721, 10)
        narrow = np.exp(-(((nm - 550) / 6.0) ** 2))
        rows = "".join(f"{n},{v:.6f},{v:.6f},{v:.6f}\n" for n, v in zip(nm, narrow, strict=True))
        (folder / "rgb.csv").write_text("wavelength,R,G,B\n" + rows)
        text("bits = 12\n", 'bits = 12\nsensitivity = "rgb.csv"\n')(folder)
    made = developed(folder)
    assert abs(errors(made, "mosaic")[0]) < (0.02 if known else 0.2)
    assert made.told("sensitivity") != known


@pytest.mark.parametrize(
    ("changes", "code", "file"),
    [
        ([reshot("macbeth*", tones(SHAPE)[0])], "E_CHART_ORDER", "macbeth"),
        ([reshot("macbeth*", 12 * VIEW)], "E_WHITE_SATURATED", "macbeth"),
        ([reshot("macbeth*", 0.2 + 0 * VIEW)], "E_CHART_ORDER", "macbeth"),
        ([drop("macbeth*")], "E_CHART_MISSING", ""),
        ([text("ColorChecker24", "ColorCheckerSG")], "E_CHART_REFERENCE", ""),
        ([frames("macbeth*", lambda c: c[:-10])], "E_SIZE", ""),
    ],
    ids=["a panel", "saturated", "a wall", "no frames", "no spectra", "another size"],
)
def test_charts_that_serve_as_no_white_are_refused(tmp_path, changes, code, file):
    problem = developed(make(tmp_path / "c", *changes)).problems[0]
    assert problem.code == code and file in (problem.file or "") and problem.fix


def test_a_reference_of_ultraviolet_alone_is_refused(tmp_path):
    folder = make(tmp_path / "c")
    write_reference(folder / "chart.csv", last=400)
    text('chart = "macbeth",', 'chart = "macbeth", reference = "chart.csv",')(folder)
    assert developed(folder).problems[0].code == "E_CHART_REFERENCE"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('chart = "macbeth"', 'chart = "macbeth", names = "white"'),
        ('chart = "macbeth"', 'chart = "mcbeth"'),
        ('chart = "macbeth"', 'reference = "x.csv"'),
        ('kind = "bands"', 'kind = "cube"'),
        ('chart = "macbeth"', 'chart = "macbeth", reference = "no.csv"'),
        ("[22, 23], [177, 23]", "[22, 23]"),
    ],
)
def test_wrong_tables_are_refused(tmp_path, old, new):
    folder = make(tmp_path / "c", text(old, new), shots=(1, 1, 1))
    with pytest.raises(CampaignInvalid) as refused:
        load_campaign(folder)
    assert any("cameras.cam" in problem.field for problem in refused.value.problems)


def test_look_offers_the_chart_where_there_is_no_white(tmp_path):
    folder = make(tmp_path / "c", shots=(1, 1, 1))
    (folder / "campaign.toml").unlink()
    assert '# white = { chart = "macbeth" }' in look(folder).text


def test_a_camera_that_sees_the_infrared_alone_knows_the_chart_by_its_greys():
    plane, corners = paint_chart(SHAPE, PATCHES[:, 2:]), np.array(CORNERS, float)
    found = locate_chart(plane, np.array([850.0]), CLASSIC, PUBLISHED, corners=corners)
    assert found.agreement == pytest.approx(1, abs=0.02)


@pytest.mark.slow
def test_a_chart_that_changes_makes_the_layer_stale(tmp_path):
    folder = make(tmp_path / "c")
    report = summarise(build(folder))
    assert report.ok, report.text
    assert {step.state for step in status(folder).stages} == {"fresh"}
    frames("macbeth_550nm_0*", lambda c: c + np.uint16(1))(folder)
    states = {s.key.stage: (s.state, s.why) for s in status(folder).stages if s.key.object}
    assert states["calibrate"][0] == "stale" and "macbeth_550nm_0.tif" in states["calibrate"][1]

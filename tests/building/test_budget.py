"""The budget of a build: what is measured, declared and not known, in records, report and in what is read from regions."""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import levkas
from levkas.building import build, status, summarise
from levkas.building.fingerprints import of_report
from levkas.building.hashes import Hashes
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.stages.budget import budget_of
from levkas.stages.calibrate import develop
from levkas.stages.capture_statistics import DARK_FRAMES, PHOTONS, WHITE_FRAMES
from levkas.stages.spectra import read_certificate
from levkas.stages.template_cache import TemplateCache

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from sigma_of_builds import Camera, built, scene, write_campaign

SHAPE = (100, 140)
DECLARED = """
[cameras.cam.uncertainty]
wavelength_nm = 1.0
linearity = 0.005
stray_light = 0.002
[setups.default]
angle_deg = 45
angle_uncertainty_deg = 2
"""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("budget") / "c"
    write_campaign(folder, "bands", Camera(SHAPE), scene(SHAPE)[0], whites=2)
    assert summarise(build(folder)).ok
    return folder


def rows_of(folder):
    record = json.loads((folder / "database/objects/panel/provenance.json").read_text())
    (step,) = [one for one in record["steps"] if one["stage"] == "calibrate"]
    return {row["source"]: row for row in step["uncertainty"]}


def read(folder):
    return levkas.open(folder / "database")["panel"]["cam"]


REGION = (20, 30, 39, 49)


def test_what_nobody_knows_is_named_with_what_would_tell_it(campaign):
    rows = rows_of(campaign)
    unknown = {name for name, row in rows.items() if row["basis"] == "unknown"}
    assert unknown == {
        "white board",
        "linearity",
        "stray light",
        "wavelength",
        "angle of the light",
    }
    assert all(row["advice"] for name, row in rows.items() if name in unknown)
    report = (campaign / "database/objects/panel/report.html").read_text()
    assert "Uncertainty of its values" in report and "not known" in report
    found = read(campaign).uncertainty(rectangle=REGION)
    assert set(found.attrs["not_known"]) == unknown


def test_the_parts_of_the_noise_are_those_of_the_published_sigma(campaign):
    rows = rows_of(campaign)
    layer = read(campaign)
    parts = [
        rows[name]["size"] for name in ("photons and read noise", "white frames", "dark frames")
    ]
    for band in map(str, layer.band.values):
        sigma = float(np.median(layer.levkas.sigma.sel(band=band)))
        assert np.sqrt(sum(part[band] ** 2 for part in parts)) == pytest.approx(sigma, rel=0.15)


@pytest.mark.parametrize("kind", ["cube", "mirror"])
def test_the_parts_of_the_noise_of_a_scan_are_those_of_its_published_sigma(tmp_path, kind):
    """Sigma of the pixels that are about as bright as the mean of the view, before they are interpolated."""
    folder = tmp_path / "c"
    write_campaign(folder, kind, Camera(SHAPE), scene(SHAPE)[0])
    with (folder / "campaign.toml").open("a") as file:
        file.write(DECLARED)
    values, sigma, _ = built(folder)
    rows = rows_of(folder)
    view = rows["stray light"]["zero_at"]
    parts = [rows[name]["size"] for name in (PHOTONS, WHITE_FRAMES, DARK_FRAMES)]
    for k, band in enumerate(parts[0]):
        assert view[band] == pytest.approx(float(np.nanmean(values[..., k], dtype=float)), rel=1e-3)
        near = np.abs(values[..., k] - view[band]) < 0.1 * view[band]
        known = float(np.median(sigma[near, k]))
        assert np.sqrt(sum(part[band] ** 2 for part in parts)) == pytest.approx(known, rel=0.15)


def test_the_page_of_a_camera_has_the_budget_of_its_values(campaign):
    page = (campaign / "database/cameras/cam/report.html").read_text()
    assert "Uncertainty of its values" in page
    described = json.loads((campaign / "database/cameras/cam/camera.json").read_text())
    rows = {row["source"]: row for row in described["uncertainty"][""]}
    assert rows == rows_of(campaign)
    for name in ("photons and read noise", "white board"):  # known and not known
        assert f"<strong>{name}</strong>" in page


def test_what_is_declared_is_in_every_number_and_rebuilds_the_report_alone(campaign, tmp_path):
    folder = shutil.copytree(campaign, tmp_path / "c")
    text = (folder / "campaign.toml").read_text()
    stated = text.replace("[cameras", "WHITE\n[cameras", 1)
    if "white = {" in text:
        stated = text.replace("white = {", "white = { uncertainty = 0.01,", 1)
    else:
        line = next(one for one in text.splitlines() if one.startswith("white = "))
        names = line.partition("=")[2].strip()
        stated = text.replace(line, f"white = {{ names = {names}, uncertainty = 0.01 }}")
    (folder / "campaign.toml").write_text(stated + DECLARED)
    stale = [step.key.stage for step in status(folder).stages if step.state == "stale"]
    assert set(stale) <= {"report", "catalogue", "camera"} and {"report", "camera"} <= set(stale)
    assert summarise(build(folder)).ok
    rows = rows_of(folder)
    assert {row["basis"] for row in rows.values()} == {"measured", "declared"}
    before, after = (read(one).uncertainty(rectangle=REGION) for one in (campaign, folder))
    assert np.allclose(before.value, after.value) and np.allclose(before.u_random, after.u_random)
    by_source = after.u_by_source.to_series().unstack()
    board = rows["white board"]["size"]
    for band, value in zip(after.band.values, after.value.values, strict=True):
        assert by_source.loc["white board", band] == pytest.approx(value * board[band], rel=1e-3)
        assert by_source.loc["angle of the light", band] == pytest.approx(
            value * np.deg2rad(2), rel=1e-3
        )
        mean_of_view = rows["stray light"]["zero_at"][band]  # what the camera's whole frame shows
        assert mean_of_view == pytest.approx(scene(SHAPE)[0].mean(), rel=0.02)
        away = abs(value - mean_of_view)
        assert by_source.loc["stray light", band] == pytest.approx(0.002 * away, rel=0.01, abs=1e-6)
        bent = 0.005 * value * (1 - value)
        assert by_source.loc["linearity", band] == pytest.approx(bent, rel=1e-3)
    (unlit,) = [source for source in ("black level",) if source in rows]
    assert rows[unlit]["common_to"] == "frame"


@pytest.mark.parametrize(
    ("keys", "field"),
    [
        (
            "[cameras.cam.uncertainty]\nwavelength_nm = -1\n",
            "cameras.cam.uncertainty.wavelength_nm",
        ),
        ("[cameras.cam.uncertainty]\nlinearity = 5\n", "cameras.cam.uncertainty.linearity"),
        ("[cameras.cam.uncertainty]\nflat = 0.1\n", "cameras.cam.uncertainty.flat"),
        ("[setups.default]\nangle_deg = 120\n", "setups.default.angle_deg"),
        ("[setups.default]\nangle_uncertainty_deg = 2\n", "setups.default.angle_deg"),
        (
            "[setups.default]\nangle_deg = 85\nangle_uncertainty_deg = 20\n",
            "setups.default.angle_uncertainty_deg",
        ),
        ("[cameras.cam.uncertainty]\nlinearity = 0.5\n", "cameras.cam.uncertainty.linearity"),
        ("[cameras.cam.uncertainty]\nlinearity = nan\n", "cameras.cam.uncertainty.linearity"),
        ('[cameras.cam.uncertainty]\nlinearity = "1 %"\n', "cameras.cam.uncertainty.linearity"),
        ("[cameras.cam.uncertainty]\nstray_light = [0.1]\n", "cameras.cam.uncertainty.stray_light"),
    ],
)
def test_uncertainties_that_are_none_are_refused(campaign, tmp_path, keys, field):
    from levkas.core.problems import Refused

    folder = shutil.copytree(campaign, tmp_path / "c", ignore=shutil.ignore_patterns("database*"))
    with (folder / "campaign.toml").open("a") as file:
        file.write("\n" + keys)
    with pytest.raises(Refused) as refused:
        summarise(build(folder))
    assert [p.field for p in refused.value.problems] == [field]


@pytest.mark.parametrize(
    "rows",
    [
        "400,0.98,0.005\n600,0.98,\n800,0.98,0.005",
        "400,0.98,-0.005\n800,0.98,0.005",
        "400,0.98,0.5\n800,0.98,0.5",
        "400,98,0.005\n800,98,0.005",
        "400,0.98,0.97\n800,0.98,0.96",
    ],
)
def test_a_third_column_that_is_no_uncertainty_refuses_the_white(campaign, tmp_path, rows):
    """Partly empty, negative, per cent beside shares and the other way round, and the spectrum of a second board."""
    folder = shutil.copytree(campaign, tmp_path / "c", ignore=shutil.ignore_patterns("database*"))
    path = folder / "campaign.toml"
    path.write_text(path.read_text().replace("reflectance = 1.0", 'reflectance = "board.csv"'))
    (folder / "board.csv").write_text(f"nm,R,u\n{rows}\n")
    problems = summarise(build(folder)).problems
    assert [p.field for p in problems] == ["targets.white.reflectance"]
    assert problems[0].file.endswith("board.csv")


@pytest.mark.parametrize("rows", ["400,0.98,\n800,0.98,", "400,98,0.49\n800,98,0.49"])
def test_a_third_column_is_used_or_empty(tmp_path, rows):
    path = tmp_path / "board.csv"
    path.write_text(f"nm,R,u\n{rows}\n")
    _, values, errors = read_certificate(path)
    assert values.tolist() == [0.98, 0.98]
    assert errors is None if rows.endswith(",") else errors.tolist() == [0.0049, 0.0049]


def test_the_dataset_of_a_layer_has_the_budget_as_obsarray_reads_it(campaign, tmp_path):
    made = levkas.open(campaign / "database")["panel"].dataset("cam")
    assert made["values"].attrs["unc_comps"][0] == "sigma"
    lamp = made["u_lamp_between_white_and_object"]
    assert lamp.dims == ("band",) and lamp.attrs["units"] == "%"
    rows = rows_of(campaign)["lamp between white and object"]["size"]
    assert lamp.values == pytest.approx([100 * rows[str(b)] for b in made.band.values])
    forms = {lamp.attrs[f"err_corr_{n}_dim"]: lamp.attrs[f"err_corr_{n}_form"] for n in (1, 2, 3)}
    assert forms == {"y": "systematic", "x": "systematic", "band": "random"}
    assert "u_photons_and_read_noise" not in made


@pytest.mark.parametrize(
    ("kind", "own"),
    [
        ("bands", {"wavelength", "lamp between white and object", "black level"}),
        ("mosaic", {"wavelength"}),
        ("sensors", {"wavelength", "black level", "linearity"}),
        ("cube", set()),
    ],
)
def test_bands_share_what_they_have_in_common_by_their_kind(tmp_path, kind, own):
    """Sensors have a black level and a curve each, a tunable filter sees the lamp at other times, a prism moves all bands."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "promises"))
    import camera as promises

    folder = promises.write_campaign(tmp_path / "c", kind, promises.Habits(), (80, 60))
    with (folder / "campaign.toml").open("a") as file:
        file.write(DECLARED)
    campaign = levkas.load_campaign(folder)
    (capture,), _ = levkas.find_captures(campaign)
    rows = {row.name: row for row in budget_of(campaign, capture, {})}
    assert {name for name, row in rows.items() if not row.all_bands} == own


@pytest.mark.slow
@pytest.mark.parametrize("curve", [0.0, 0.002])
def test_exposures_that_lie_on_a_line_give_the_budget_how_straight_it_is(tmp_path, curve):
    """At 3,500 of 4,095 counts a bend of 0.002 takes off 0.17 %: too little to be corrected, and not nothing."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "promises"))
    import camera as promises

    habits = promises.Habits(curve=curve, series=(0.25, 0.5, 1.0))
    folder = promises.write_campaign(tmp_path / "c", "bands", habits, (160, 200))
    campaign = levkas.load_campaign(folder)
    (capture,), _ = levkas.find_captures(campaign)
    measured = develop(capture, campaign, TemplateCache(tmp_path / "kept")).measured
    (row,) = [row for row in budget_of(campaign, capture, measured) if row.name == "linearity"]
    assert row.basis == "measured" and len(row.size) == 3 and row.zero_at
    for size in row.size.values():
        assert size == pytest.approx(curve * 3500 / 4095, rel=0.2, abs=2e-4)


@pytest.mark.slow
def test_values_in_counts_have_a_budget_of_what_needs_no_white(tmp_path):
    folder = tmp_path / "c"
    write_campaign(folder, "bands", Camera(SHAPE), scene(SHAPE)[0], whites=1)
    path = folder / "campaign.toml"
    text = "".join(x for x in path.read_text().splitlines(True) if not x.startswith("white"))
    path.write_text(text)
    assert summarise(build(folder)).ok
    rows = rows_of(folder)
    assert {row["unit"] for row in rows.values()} <= {"counts", "relative", "nm"}
    known = {name for name, row in rows.items() if row.get("size")}
    assert known == {"photons and read noise", "dark frames", "code spacing", "black level"}
    unknown = {name for name, row in rows.items() if row["basis"] == "unknown"}
    assert unknown == {"white board", "linearity", "stray light", "wavelength"}
    sigma = read(folder).sigma
    for band, size in rows["photons and read noise"]["size"].items():
        assert size == pytest.approx(float(np.median(sigma.sel(band=band))), rel=0.2)
    report = (folder / "database/objects/panel/report.html").read_text()
    said = re.search(r"No white: values[^<]*", report)
    assert (
        said and "e+" not in said[0] and report.count("No white: values are relative counts") == 1
    )
    assert read(folder).uncertainty(rectangle=REGION).attrs["not_known"]


@pytest.mark.slow
def test_darks_that_are_clipped_do_not_say_that_the_black_level_is_steady(tmp_path):
    folder = tmp_path / "c"
    write_campaign(folder, "bands", Camera(SHAPE, black=0.0), scene(SHAPE)[0], whites=2)
    campaign = levkas.load_campaign(folder)
    (capture,), _ = levkas.find_captures(campaign)
    measured = develop(capture, campaign, TemplateCache(tmp_path / "kept")).measured
    (row,) = [row for row in budget_of(campaign, capture, measured) if row.name == "black level"]
    assert set(row.size) == {"750 nm"}  # two seconds of dark current lift that one above zero
    assert "clipped at zero" in row.advice


@pytest.mark.parametrize(
    "older",
    [
        lambda step: step.pop("uncertainty"),
        lambda step: [row.pop("all_bands") for row in step["uncertainty"]],
        lambda step: step.update(uncertainty={"rows": []}),
        lambda step: [row.update(size=[0.1]) for row in step["uncertainty"]],
        lambda step: [row.update(size={"450 nm": "x"}) for row in step["uncertainty"]],
        lambda step: [row.update(unit="percent") for row in step["uncertainty"]],
    ],
)
def test_a_budget_of_another_version_is_refused_with_what_to_do(campaign, tmp_path, older):
    from levkas.core.problems import Refused

    folder = shutil.copytree(campaign, tmp_path / "c")
    path = folder / "database/objects/panel/provenance.json"
    record = json.loads(path.read_text())
    for step in record["steps"]:
        if step["stage"] == "calibrate":
            older(step)
    path.write_text(json.dumps(record))
    layer = read(folder)
    for reads in (
        lambda: layer.levkas.uncertainty(rectangle=REGION),
        lambda: levkas.open(folder / "database")["panel"].dataset("cam"),
    ):
        with pytest.raises(Refused, match="Build it again") as refused:
            reads()
        assert refused.value.problems[0].file == str(path)


def test_a_layer_without_provenance_says_that_it_has_no_budget(campaign, tmp_path):
    folder = shutil.copytree(campaign, tmp_path / "c")
    (folder / "database/objects/panel/provenance.json").unlink()
    (said,) = read(folder).uncertainty(rectangle=REGION).attrs["not_known"]
    assert "no budget" in said


def test_a_ratio_of_two_bands_knows_the_slope_of_the_whole_spectrum(campaign):
    layer = read(campaign)
    two = [str(band) for band in layer.band.values[1:3]]
    every = layer.levkas.uncertainty(rectangle=REGION)
    some = layer.levkas.uncertainty(rectangle=REGION, bands=two)
    assert list(some.band.values) == two
    assert np.allclose(some.u, every.u.sel(band=two))
    with pytest.raises(KeyError):
        layer.levkas.uncertainty(rectangle=REGION, bands=["no band"])


def test_what_the_bands_see_is_in_the_fingerprint_of_a_report_that_compares_cameras(
    campaign, tmp_path
):
    folder = shutil.copytree(campaign, tmp_path / "c", ignore=shutil.ignore_patterns("database*"))
    with (folder / "campaign.toml").open("a") as file:
        file.write('\n[setups.default]\nspectrum = "lamp.csv"\n')

    def prints(power, cameras):
        (folder / "lamp.csv").write_text(f"nm,power\n400,{power}\n700,2\n")
        read = load_campaign(folder)
        captures = find_captures(read)[0] * cameras
        hashes = Hashes(tmp_path / "none", verify=True)
        return of_report(read, "panel", {}, captures, hashes)

    assert prints(1, cameras=2) == prints(1, cameras=2) != prints(3, cameras=2)
    assert prints(1, cameras=1) == prints(3, cameras=1)  # nothing is compared

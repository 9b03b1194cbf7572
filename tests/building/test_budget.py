"""The budget of a build: what is measured, declared and not known, in records, report and in what is read from regions."""

import json
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
from levkas.stages.capture_statistics import DARK_FRAMES, PHOTONS, WHITE_FRAMES

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
        sigma = float(np.median(layer.sigma.sel(band=band)))
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


def test_a_ratio_of_two_bands_knows_the_slope_of_the_whole_spectrum(campaign):
    layer = read(campaign)
    two = [str(band) for band in layer.band.values[1:3]]
    every = layer.uncertainty(rectangle=REGION)
    some = layer.uncertainty(rectangle=REGION, bands=two)
    assert list(some.band.values) == two
    assert np.allclose(some.u, every.u.sel(band=two))
    with pytest.raises(KeyError):
        layer.uncertainty(rectangle=REGION, bands=["no band"])


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

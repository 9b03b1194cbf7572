"""The budget of a capture: what is measured, declared and not known, and what is read of it from regions."""

import json

import numpy as np
import pytest
from cameras import KINDS, RGGB, developed, text, write

import levkas
from levkas.building import status
from levkas.building.hashes import Hashes
from levkas.building.inputs import of_report
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.problems import Refused
from levkas.stages.measurements import DARK_FRAMES, PHOTONS, WHITE_FRAMES
from levkas.stages.spectra import read_certificate

UNCERTAINTY = (
    "[cameras.cam.uncertainty]\nwavelength_nm = 1.0\nlinearity = 0.005\nstray_light = 0.002\n"
)
ANGLE = "[setups.default]\nangle_deg = 45\nangle_uncertainty_deg = 2\n"
REGION = (120, 90, 139, 109)


def appended(keys):
    def change(folder):
        with (folder / "campaign.toml").open("a") as file:
            file.write("\n" + keys)

    return change


@pytest.mark.parametrize("kind", KINDS)
def test_the_parts_of_the_noise_are_those_of_the_published_sigma(tmp_path, kind):
    """Of scans the parts are stated for pixels about as bright as the mean of the view."""
    made = developed(write(tmp_path / "c", kind, appended(UNCERTAINTY)))
    view = made.budget["stray light"].zero_at
    parts = [made.budget[name].size for name in (PHOTONS, WHITE_FRAMES, DARK_FRAMES)]
    cube = made.cube
    for k, band in enumerate(parts[0]):
        assert view[band] == pytest.approx(float(np.nanmean(cube.values[..., k])), rel=2e-3)
        near = np.abs(cube.values[..., k] - view[band]) < 0.15 * view[band]
        near |= kind not in ("cube", "mirror")  # of frames it is the median over the view
        if kind == "mosaic":  # between sensels sigma holds the error of interpolation
            y, x = np.indices(near.shape)
            near &= RGGB[y % 2, x % 2] == k
        stated = np.sqrt(sum(part[band] ** 2 for part in parts))
        assert stated == pytest.approx(float(np.median(cube.sigma[near, k])), rel=0.15)


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
    rows = developed(write(tmp_path / "c", kind, appended(UNCERTAINTY + ANGLE))).budget
    assert {name for name, row in rows.items() if not row.all_bands} - {"linearity"} <= own | {
        PHOTONS, WHITE_FRAMES, DARK_FRAMES, "code spacing", "black level", "lamp between white and object",
    }  # fmt: skip
    assert own <= {name for name, row in rows.items() if not row.all_bands}


@pytest.mark.parametrize("curve", [0.0, 0.002])
def test_exposures_that_lie_on_a_line_say_how_straight_it_is(tmp_path, curve):
    """At 3,300 of 4,095 counts a bend of 0.002 takes off 0.16 %: too little to be corrected, and not nothing."""
    series = {"series": (0.25, 0.5, 1.0), "light": 3500.0, "curve": curve, "shape": (160, 200)}
    row = developed(write(tmp_path / "c", **series)).budget["linearity"]
    assert row.basis == "measured" and len(row.size) == 3 and row.zero_at
    for size in row.size.values():
        assert size == pytest.approx(curve * 3500 / 4095, rel=0.3, abs=4e-4)


def test_counts_have_a_budget_of_what_needs_no_white(tmp_path):
    no_white = text('white = { names = "white", reflectance = 1.0 }\n', "")
    rows = developed(write(tmp_path / "c", "bands", no_white)).budget
    assert {row.unit for row in rows.values()} <= {"counts", "relative", "nm"}
    known = {name for name, row in rows.items() if row.size}
    assert known == {PHOTONS, DARK_FRAMES, "code spacing", "black level"}
    assert not developed(write(tmp_path / "d", black=0.0)).budget["black level"].size  # clipped


@pytest.mark.parametrize(
    ("keys", "field"),
    [
        ("[cameras.cam.uncertainty]\nwavelength_nm = -1\n", "cameras.cam.uncertainty.wavelength_nm"),
        ("[cameras.cam.uncertainty]\nlinearity = 5\n", "cameras.cam.uncertainty.linearity"),
        ("[cameras.cam.uncertainty]\nflat = 0.1\n", "cameras.cam.uncertainty.flat"),
        ("[setups.default]\nangle_deg = 120\n", "setups.default.angle_deg"),
        ("[setups.default]\nangle_uncertainty_deg = 2\n", "setups.default.angle_deg"),
        ("[setups.default]\nangle_deg = 85\nangle_uncertainty_deg = 20\n", "setups.default.angle_uncertainty_deg"),
    ],
)  # fmt: skip
def test_uncertainties_that_are_none_are_refused(tmp_path, keys, field):
    folder = write(tmp_path / "c", "bands", appended(keys), shots=(1, 1, 1))
    assert [p.field for p in developed(folder).problems] == [field]


@pytest.mark.parametrize(
    ("rows", "errors"),
    [
        ("400,0.98,0.005\n600,0.98,\n800,0.98,0.005", None),
        ("400,0.98,-0.005\n800,0.98,0.005", None),
        ("400,0.98,0.5\n800,0.98,0.5", None),
        ("400,98,0.005\n800,98,0.005", None),
        ("400,0.98,0.97\n800,0.98,0.96", None),
        ("400,0.98,\n800,0.98,", []),
        ("400,98,0.49\n800,98,0.49", [0.0049, 0.0049]),
    ],
)
def test_a_third_column_of_a_certificate_is_an_uncertainty_or_empty_or_refused(
    tmp_path, rows, errors
):
    """Partly empty, negative, per cent beside shares and the other way round, and the spectrum of a second board."""
    path = tmp_path / "board.csv"
    path.write_text(f"nm,R,u\n{rows}\n")
    if errors is None:
        board = text("reflectance = 1.0", 'reflectance = "../board.csv"')
        (problem,) = developed(write(tmp_path / "c", "bands", board, shots=(1, 1, 1))).problems
        assert problem.field == "targets.white.reflectance" and problem.file.endswith("board.csv")
        return
    _, values, found = read_certificate(path)
    assert values.tolist() == [0.98, 0.98]
    assert found is None if not errors else found.tolist() == errors


# --- of the world that is built -----------------------------------------------------------------


def rows_of(world, camera="filters"):
    record = json.loads((world.database / "objects/panel/provenance.json").read_text())
    (step,) = [s for s in record["steps"] if (s["camera"], s["stage"]) == (camera, "calibrate")]
    return {row["source"]: row for row in step["uncertainty"]}


def read(world):
    return levkas.open(world.database)["panel"]["filters"]


def test_regions_know_their_budget_and_what_is_not_in_it(world):
    found = read(world).levkas.uncertainty(rectangle=REGION)
    rows = rows_of(world)
    assert set(found.attrs["not_known"]) == {n for n, r in rows.items() if r["basis"] == "unknown"}
    lamp = rows["lamp between white and object"]["size"]
    by_source = found.u_by_source.to_series().unstack()
    for band, value in zip(found.band.values, found.value.values, strict=True):
        assert by_source.loc["lamp between white and object", band] == pytest.approx(
            value * lamp[str(band)], rel=1e-3
        )
    described = json.loads((world.database / "cameras/filters/camera.json").read_text())
    assert {row["source"]: row for row in described["uncertainty"][""]} == rows
    two = [str(band) for band in found.band.values[:1]]
    some = read(world).levkas.uncertainty(rectangle=REGION, bands=two)
    assert list(some.band.values) == two and np.allclose(some.u, found.u.sel(band=two))
    with pytest.raises(KeyError):
        read(world).levkas.uncertainty(rectangle=REGION, bands=["no band"])


def test_what_is_declared_makes_pages_stale_and_no_pixels(world, tmp_path):
    own = world.copy(tmp_path / "c")
    text("[targets]", UNCERTAINTY.replace("cam.", "filters.") + ANGLE + "[targets]")(own.folder)
    stale = {step.key.stage for step in status(own.folder).stages if step.state == "stale"}
    assert {"report", "camera"} <= stale <= {"report", "camera", "catalogue"}


def test_a_budget_of_another_version_is_refused_and_one_that_is_gone_is_not_known(world, tmp_path):
    own = world.copy(tmp_path / "c")
    path = own.database / "objects/panel/provenance.json"
    whole = path.read_text()
    for older in (
        lambda step: step.pop("uncertainty"),
        lambda step: [row.pop("all_bands") for row in step["uncertainty"]],
        lambda step: [row.update(unit="percent") for row in step["uncertainty"]],
    ):
        record = json.loads(whole)
        for step in record["steps"]:
            if step["stage"] == "calibrate" and "uncertainty" in step:
                older(step)
        path.write_text(json.dumps(record))
        with pytest.raises(Refused) as refused:
            read(own).levkas.uncertainty(rectangle=REGION)
        assert refused.value.problems[0].file == str(path)
    path.unlink()
    assert len(read(own).levkas.uncertainty(rectangle=REGION).attrs["not_known"]) == 1


def test_what_the_bands_see_is_in_the_fingerprint_of_a_report_that_compares_cameras(tmp_path):
    folder = write(tmp_path / "c", "bands", appended('[setups.default]\nspectrum = "lamp.csv"\n'))

    def prints(power, cameras):
        (folder / "lamp.csv").write_text(f"nm,power\n400,{power}\n700,2\n")
        campaign = load_campaign(folder)
        captures = find_captures(campaign)[0] * cameras
        return of_report(campaign, "panel", {}, captures, Hashes(tmp_path / "none", verify=True))

    assert prints(1, cameras=2) == prints(1, cameras=2) != prints(3, cameras=2)
    assert prints(1, cameras=1) == prints(3, cameras=1)  # nothing is compared

"""A sensor that is full below what its bits allow, or not linear: what its noise shows is flagged, refused and said."""

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from levkas.calibration.reflectance import calibrate
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.cube import Flag
from levkas.core.problems import Refused
from levkas.quality.emva1288 import examine_with_seed
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

GAIN, READ, BLACK, WHITE = 0.25, 2.0, 60.0, 3000.0
SHAPE = (96, 140)
PANEL = np.kron(np.random.default_rng(2).uniform(0.05, 0.9, (6, 7)), np.ones((16, 20)))
GOLD = np.zeros(SHAPE, bool)
GOLD[32:64, 40:100] = True
HEAD = """
[campaign]
reference = "cam"
[targets]
dark = "dark"
white = { names = "white", reflectance = 1.0 }
objects = ["panel"]
[cameras.cam]
"""
KINDS = {
    "bands": 'kind = "bands"\nfiles = "raw/{target}_{wavelength}nm_{shot}.tif"\nwavelengths = [550]',
    "mosaic": 'kind = "mosaic"\nfiles = "raw/{target}_550nm_{shot}.tif"\npattern = [["A", "B"], ["C", "D"]]',
    "cube": 'kind = "cube"\nfiles = "raw/{target}.hdr"',
    "mirror": 'kind = "cube"\nscan = "mirror"\nfiles = "raw/{target}.hdr"',
}


def write(
    folder,
    kind,
    *,
    full=4095,
    bits="bits = 12",
    white=WHITE,
    shots=1,
    wells=False,
    response=lambda counts: counts,
    tremble=0.0,
):
    """Write a campaign of a sensor that is full at some code, of its converter or of its wells; the panel trembles by pixels."""
    rng, raw = np.random.default_rng(5), folder / "raw"
    raw.mkdir(parents=True)
    panel = np.where(GOLD, 1.275, PANEL)
    for name, light in (("dark", 0), ("white", white), ("panel", WHITE * panel)):
        for take in range(shots):
            level = light + np.zeros(SHAPE)
            if tremble and name == "panel":
                level = ndimage.shift(
                    level, tremble * rng.standard_normal(2), order=1, mode="nearest"
                )
            counts = response(GAIN * rng.poisson(level / GAIN))
            counts = np.minimum(counts, full - BLACK) if wells else counts
            codes = np.rint(counts + rng.normal(BLACK, READ, SHAPE)).clip(0, None)
            codes = (codes if wells else codes.clip(0, full)).astype(np.uint16)
            if kind in ("cube", "mirror"):
                (raw / f"{name}.raw").write_bytes(codes.tobytes())
                (raw / f"{name}.hdr").write_text(
                    f"ENVI\nsamples = {SHAPE[1]}\nlines = {SHAPE[0]}\nbands = 1\ninterleave = bil\n"
                    "data type = 12\nbyte order = 0\nwavelength = {550}\n"
                )
            else:
                tifffile.imwrite(raw / f"{name}_550nm_{take}.tif", codes)
    (folder / "campaign.toml").write_text(f"{HEAD}{bits}\n{KINDS[kind]}")
    return folder


def developed(folder):
    campaign = load_campaign(folder)
    captures, _ = find_captures(campaign)
    kept = TemplateCache(folder / "kept")
    return develop(captures[0], campaign, kept)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_full_below_the_bits_is_flagged_said_and_recorded(tmp_path, kind):
    made = developed(write(tmp_path, kind, full=3600))
    flags = made.cubes[""].flags.max(2) & Flag.SATURATED > 0
    assert flags[GOLD].mean() > 0.98 and flags[~GOLD].mean() < 0.02 + 0.1 * (kind == "mosaic")
    (note,) = [w for w in made.warnings if "full at" in w]
    assert "3600" in note and "12 bits" in note
    assert made.measured[""]["full_scale"]["counts"] == 3600


def test_a_full_well_with_noise_behind_it_is_found_by_two_shots(tmp_path):
    made = developed(write(tmp_path, "bands", full=3600, shots=2, wells=True))
    flags = made.cubes[""].flags[..., 0] & Flag.SATURATED > 0
    assert flags[GOLD].mean() > 0.98 and flags[~GOLD].mean() < 0.01


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("full", "bits"), [(4095, ""), (3600, "bits = 12")])
def test_a_white_that_is_full_below_its_container_is_refused(tmp_path, kind, full, bits):
    folder = write(tmp_path, kind, full=full, bits=bits, white=2 * WHITE)
    with pytest.raises(Refused) as refused:
        developed(folder)
    problem = refused.value.problems[0]
    assert problem.code == "E_WHITE_SATURATED" and f"{full} counts" in problem.found


@pytest.mark.parametrize("kind", KINDS)
def test_a_sensor_that_is_full_nowhere_keeps_the_full_scale_that_is_stated(tmp_path, kind):
    made = developed(write(tmp_path, kind, full=4095))
    assert not any("full at" in w for w in made.warnings)
    assert "full_scale" not in made.measured[""]
    assert not (made.cubes[""].flags & Flag.SATURATED).any()


def knee(counts):
    return np.where(counts < 2000, counts, 2000 + (counts - 2000) / 2)


def wells(counts):
    """Full wells that differ by 3 % from sensel to sensel, below the white."""
    return np.minimum(counts, 2500 * (1 + 0.03 * np.random.default_rng(3).standard_normal(SHAPE)))


@pytest.mark.parametrize("kind", ["bands", "mosaic"])
@pytest.mark.parametrize(("response", "share"), [(knee, 0.3), (wells, 0.1)])
def test_a_response_that_flattens_below_its_white_is_named_by_its_shot_noise(
    tmp_path, kind, response, share
):
    made = developed(write(tmp_path, kind, shots=4, response=response))
    (found,) = made.measured[""]["flattening"].values()
    assert found["share"] == pytest.approx(share, abs=0.1)
    (note,) = [w for w in made.warnings if "of the shot noise" in w]
    assert "full" in note and "flattens" in note and "averaged" in note
    assert not (made.cubes[""].flags & Flag.MOVED).any()
    assert made.measured[""]["sensor"]["gain"] == pytest.approx(GAIN, rel=0.05)


@pytest.mark.parametrize("kind", ["bands", "mosaic"])
@pytest.mark.parametrize(
    "more", [{"shots": 2}, {"shots": 6}, {"shots": 4, "tremble": 0.2}], ids=str
)
def test_a_linear_sensor_has_the_shot_noise_of_its_light(tmp_path, kind, more):
    made = developed(write(tmp_path, kind, **more))
    assert "flattening" not in made.measured[""]
    assert not any("shot noise" in warning for warning in made.warnings)


def test_radiometry_takes_the_full_scale_that_the_frames_show(tmp_path):
    found = examine_with_seed(write(tmp_path, "bands", full=3600, shots=3))
    (sensor,) = found.sensors
    (channel,) = sensor.channels.values()
    assert channel.full_well == pytest.approx((3600 - BLACK) / GAIN, rel=0.03)
    assert any("full at 3600" in note for note in sensor.notes)
    assert not any("no shot saturates" in note for note in sensor.notes)


def test_arrays_are_full_where_those_of_a_build_are(tmp_path):
    write(tmp_path, "bands", full=3600)
    panel, dark, white = (
        tifffile.imread(tmp_path / "raw" / f"{name}_550nm_0.tif")
        for name in ("panel", "dark", "white")
    )
    flags = calibrate(panel, dark, white).flags[..., 0] & Flag.SATURATED > 0
    assert flags[GOLD].mean() > 0.98 and flags[~GOLD].mean() < 0.01


@pytest.mark.parametrize("kind", ["cube", "mirror"])
def test_a_white_of_one_scan_that_is_full_everywhere_is_named(tmp_path, kind):
    """No other frame shows the noise of dimmer light; but no light has as little noise as the dark."""
    full = write(tmp_path / "full", kind, full=3000, white=3400.0, wells=True)
    right = write(tmp_path / "right", kind, full=4095, white=2900.0)
    assert any("no more noise than the dark" in note for note in developed(full).warnings)
    assert not any("than the dark" in note for note in developed(right).warnings)


def test_noise_of_single_shots_is_named_as_such(tmp_path):
    single, twice = (write(tmp_path / str(n), "bands", full=4095, shots=n) for n in (1, 2))
    assert any("smooth parts of single shots" in note for note in developed(single).warnings)
    assert not any("single shots" in note for note in developed(twice).warnings)

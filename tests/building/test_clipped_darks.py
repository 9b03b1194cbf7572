"""Cameras whose black level is 0: darks that were clipped make the reflectance of dark paint no darker."""

import numpy as np
import pytest
import tifffile

from levkas.building.hashes import Hashes
from levkas.building.records_file import NAME
from levkas.calibration.reflectance import calibrate
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.cube import Flag
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

GAIN, READ, FIXED, WHITE = 0.25, 2.5, 0.5, 3300.0
"""Counts an electron; counts, of one shot; counts, from sensel to sensel; counts."""
SHAPE = (96, 120)
TONES = np.array([0.002, 0.006, 0.02, 0.1, 0.4, 0.9])
SCENE = np.kron(TONES.reshape(2, 3), np.ones((48, 40)))
HEAD = """
[campaign]
reference = "cam"
[targets]
dark = "dark"
white = { names = "white", reflectance = 1.0 }
objects = ["panel"]
[cameras.cam]
bits = 12
"""
KINDS = {
    "bands": 'kind = "bands"\nfiles = "raw/{target}_{wavelength}nm_{shot}.tif"\nwavelengths = [550]',
    "mosaic": 'kind = "mosaic"\nfiles = "raw/{target}_550nm_{shot}.tif"\npattern = [["A", "B"], ["C", "D"]]',
    "sensors": 'kind = "sensors"\n[[cameras.cam.sensors]]\nname = "one"\nfiles = "raw/{target}_550nm_{shot}.tif"\nbands = ["A"]',
    "cube": 'kind = "cube"\nfiles = "raw/{target}.hdr"',
    "mirror": 'kind = "cube"\nscan = "mirror"\nfiles = "raw/{target}.hdr"',
}


def frames(kind, black, shots):
    """Yield names and codes of darks, whites and shots of the panel; of a mosaic each phase has its own black."""
    rng, line = np.random.default_rng(3), kind in ("cube", "mirror")
    shape = (1, SHAPE[1]) if line else SHAPE
    offsets = black + FIXED * rng.standard_normal(shape)
    if kind == "mosaic":
        offsets[::2, ::2] += 0.8
    for name, light, count in (("dark", 0, 8), ("white", 1, 8), ("panel", SCENE, shots)):
        for shot in range(1 if line else count):
            electrons = rng.poisson(WHITE / GAIN * light + np.zeros(SHAPE))
            codes = np.rint(GAIN * electrons + offsets + rng.normal(0, READ, SHAPE))
            yield name, shot, codes.clip(0, 4095).astype(np.uint16)


def write(folder, kind, black, shots=1):
    (folder / "raw").mkdir(parents=True)
    for name, shot, codes in frames(kind, black, shots):
        if kind in ("cube", "mirror"):
            (folder / "raw" / f"{name}.raw").write_bytes(codes.tobytes())
            (folder / "raw" / f"{name}.hdr").write_text(
                f"ENVI\nsamples = {SHAPE[1]}\nlines = {SHAPE[0]}\nbands = 1\ninterleave = bil\n"
                "data type = 12\nbyte order = 0\nwavelength = {550}\n"
            )
        else:
            tifffile.imwrite(folder / "raw" / f"{name}_550nm_{shot}.tif", codes)
    (folder / "campaign.toml").write_text(HEAD + KINDS[kind])
    return folder


def developed(folder, *, shared=False):
    campaign = load_campaign(folder)
    captures, refused = find_captures(campaign)
    assert not refused
    return develop(
        captures[0],
        campaign,
        TemplateCache(folder / "kept", Hashes(folder / NAME).of_frame if shared else None),
    )


def check(cube):
    """Means of each tone within what chance leaves of them, and sigma as large as the errors are."""
    own = cube.values.mean(2) if cube.values.shape[2] < 4 else own_sensels(cube.values)
    sigma = cube.sigma.mean(2) if cube.values.shape[2] < 4 else own_sensels(cube.sigma)
    inner = np.kron(np.ones((2, 3)), np.pad(np.ones((42, 34)), 3)) > 0
    for tone in TONES:
        part = inner & (tone == SCENE)
        error = sigma[part].mean() / np.sqrt(part.sum())
        assert abs(own[part].mean() - tone) < 4.5 * error + 0.002 * tone, tone
        assert 0.92 < ((own - SCENE) / sigma)[part].std() < 1.08, tone


def own_sensels(cube):
    y, x = np.indices(cube.shape[:2])
    return np.take_along_axis(cube, ((y % 2) * 2 + x % 2)[..., None], 2)[..., 0]


@pytest.mark.parametrize("black", [pytest.param(0.0, marks=pytest.mark.exhaustive), 3.0])
@pytest.mark.parametrize("kind", KINDS)
def test_dark_paint_is_as_bright_as_it_is_where_darks_are_clipped(tmp_path, kind, black):
    made = developed(write(tmp_path, kind, black))
    (cube,) = made.cubes.values()
    check(cube)
    (note,) = [w for w in made.warnings if "clipped at zero" in w]
    assert "fitted as censored" in note


def test_what_was_fitted_is_kept_with_the_template_and_recorded(tmp_path):
    folder = write(tmp_path, "bands", 0.0, shots=2)
    first, again = developed(folder, shared=True), developed(folder, shared=True)
    assert np.array_equal(first.cubes[""].values, again.cubes[""].values)
    assert np.array_equal(first.cubes[""].sigma, again.cubes[""].sigma)
    (found,) = again.measured[""]["clipped_darks"].values()
    assert found["black"][0] == pytest.approx(0.0, abs=0.1)
    assert found["noise"] == pytest.approx(READ, rel=0.05)


def test_a_dark_on_a_pedestal_is_subtracted_sensel_by_sensel_as_before(tmp_path):
    made = developed(write(tmp_path, "bands", 60.0))
    check(made.cubes[""])
    assert not any("clipped" in w for w in made.warnings)
    assert "clipped_darks" not in made.measured[""]


def test_darks_of_nothing_but_zeros_are_said_to_show_no_black_level(tmp_path):
    folder = write(tmp_path, "bands", 0.0)
    for path in (folder / "raw").glob("dark*.tif"):
        tifffile.imwrite(path, np.zeros(SHAPE, np.uint16))
    made = developed(folder)
    (note,) = [w for w in made.warnings if "clipped" in w]
    assert "too strongly" in note and "black level (offset)" in note


def test_hot_sensels_of_clipped_darks_are_defects_still(tmp_path):
    folder = write(tmp_path, "bands", 0.0)
    for path in (folder / "raw").iterdir():
        codes = tifffile.imread(path)
        codes[20, 30] = min(codes[20, 30] + 900, 4095)
        tifffile.imwrite(path, codes)
    flags = developed(folder).cubes[""].flags[..., 0]
    assert flags[20, 30] & Flag.DEFECT
    assert (flags & Flag.DEFECT > 0).sum() == 1


def test_arrays_are_calibrated_as_a_build_does():
    some = {name: [] for name in ("dark", "white", "panel")}
    for name, _, codes in frames("bands", 0.0, 2):
        some[name].append(codes)
    check(calibrate(some["panel"], some["dark"], some["white"], saturation=4095))


def test_means_of_shots_that_were_clipped_are_no_brighter_than_the_object(tmp_path):
    dim = SCENE * (SCENE > 0.5)  # no light at all on five sixths
    folder = write(tmp_path, "bands", 0.0)
    rng = np.random.default_rng(8)
    for shot in range(8):
        codes = rng.poisson(WHITE / GAIN * dim) * GAIN + rng.normal(0, READ, SHAPE)
        codes = np.rint(codes).clip(0, 4095).astype(np.uint16)
        tifffile.imwrite(folder / "raw" / f"panel_550nm_{shot}.tif", codes)
    cube = developed(folder).cubes[""]
    dark = dim == 0
    assert abs((cube.values / cube.sigma)[..., 0][dark].mean()) < 0.4
    assert (cube.flags[..., 0][dark] & Flag.BLACK > 0).mean() > 0.95

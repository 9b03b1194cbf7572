"""An object that is brighter than its white, by more than gold and gloss explain, or has no light at all."""

from dataclasses import replace

import numpy as np
import pytest
import tifffile

from levkas.calibration.templates import CalibrationRefused
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.cube import Band, Cube, Flag
from levkas.stages.above_white import count_above, describe_above
from levkas.stages.calibrate import develop
from levkas.stages.scans import open_scan
from levkas.stages.template_cache import TemplateCache

SIZE, NM = (60, 80), (450, 550, 650)
CAMPAIGN = """
[campaign]
reference = { camera = "cam" }
[cameras.cam]
kind = "KIND"
files = "raw/{target}FILES"
[targets]
dark = "dark"
white = "white"
objects = ["panel"]
"""
PATTERNS = {"bands": "_{wavelength}nm.tif", "cube": ".hdr"}


def make(folder, kind, bright, spots=0.0, noise=2, unlit=()):
    """Write a panel of 0.2 to 0.8 whose middle band is `bright` times as bright, with a share of 1.5 in spots.

    `unlit` are targets that the lamp did not light.
    """
    rng = np.random.default_rng(5)
    panel = np.broadcast_to(np.linspace(0.2, 0.8, SIZE[1])[:, None], (*SIZE, 3)) * [1, bright, 1]
    panel = np.where(rng.random((*SIZE, 1)) < spots, 1.5, panel)
    (folder / "raw").mkdir(parents=True)
    for target, light in (("dark", 0 * panel), ("white", 1 + 0 * panel), ("panel", panel)):
        light = light * (target not in unlit)
        counts = np.rint(1000 + 2000 * light + rng.normal(0, noise, panel.shape)).astype("<u2")
        if kind == "bands":
            for k, nm in enumerate(NM):
                tifffile.imwrite(folder / f"raw/{target}_{nm}nm.tif", counts[..., k])
            continue
        (folder / f"raw/{target}.raw").write_bytes(counts.transpose(0, 2, 1).tobytes())
        (folder / f"raw/{target}.hdr").write_text(
            f"ENVI\nlines = {SIZE[0]}\nsamples = {SIZE[1]}\nbands = 3\ndata type = 12\ninterleave = bil\n"
            "wavelength units = nm\nwavelength = {450, 550, 650}\n"
        )
    text = CAMPAIGN.replace("KIND", kind).replace("FILES", PATTERNS[kind])
    (folder / "campaign.toml").write_text(text)
    campaign = load_campaign(folder)
    (capture,), refused = find_captures(campaign)
    assert not refused
    return capture, campaign, TemplateCache(folder)


def said(warnings):
    return [warning for warning in warnings if "brighter than a perfect white" in warning]


@pytest.mark.parametrize("kind", ["bands", "cube"])
def test_the_share_above_the_white_is_said_with_its_bands(tmp_path, kind):
    (warning,) = said(develop(*make(tmp_path / "c", kind, 1.5)).warnings)
    beyond = np.mean(np.linspace(0.2, 0.8, SIZE[1]) * 1.5 > 1.02)  # 23 per cent
    assert f"{100 * beyond:.3g} % of the object" in warning
    assert "550 nm (1 of 3 bands)" in warning


def test_lines_that_pass_by_say_the_same(tmp_path):
    scan = open_scan(*make(tmp_path / "c", "cube", 1.5))
    assert not said(scan.warnings)
    assert scan.summary.pictures
    assert "550 nm (1 of 3 bands)" in said(scan.warnings)[0]


@pytest.mark.parametrize("kind", ["bands", "cube"])
def test_an_ordinary_object_with_some_gold_is_not_spoken_of(tmp_path, kind):
    assert not said(develop(*make(tmp_path / "c", kind, 1.2, spots=0.02)).warnings)


@pytest.mark.parametrize("kind", ["bands", "cube"])
def test_noise_of_a_weak_band_is_not_spoken_of(tmp_path, kind):
    native = develop(*make(tmp_path / "c", kind, 1.24, noise=200))
    assert np.mean(native.cubes[""].values[..., 1] > 1.02) > 0.03  # of 0.25 to 0.99
    assert not said(native.warnings)


@pytest.mark.parametrize("bright", [1.5, 4.0])
def test_what_is_far_above_the_white_is_no_glare(tmp_path, bright):
    """Glare is white and in most bands at once: one band four times too bright is not, nor is a whole object."""
    (warning,) = said(develop(*make(tmp_path / "c", "bands", bright)).warnings)
    assert "550 nm (1 of 3 bands)" in warning


def test_an_object_of_several_times_its_white_is_named():
    values = np.full((20, 20, 3), 2.5, np.float32)
    flags = np.full(values.shape, Flag.GLARE, np.uint8)
    bands = tuple(Band(label) for label in "RGB")
    cube = Cube(values, flags, np.full(values.shape, 0.01, np.float32), bands)
    assert "100 % of the object is brighter" in describe_above(count_above(cube), cube.labels)[0]
    # A tenth of it is gold under a lamp.
    values[2:] = 0.4
    cube = Cube(values, np.where(values > 1, flags, 0).astype(np.uint8), cube.sigma, bands)
    assert describe_above(count_above(cube), cube.labels) == []


@pytest.mark.parametrize(("dark", "named"), [(0.0, False), (0.01, True)])
def test_a_dark_that_is_too_bright_is_named_by_values_below_it(dark, named):
    rng = np.random.default_rng(2)
    truth = np.geomspace(0.002, 1, 400).reshape(20, 20, 1)
    values = (truth - dark + rng.normal(0, 0.001, (20, 20, 3))).astype(np.float32)
    bands = tuple(Band(label) for label in "RGB")
    flags = np.zeros(values.shape, np.uint8)
    cube = Cube(values, flags, np.full(values.shape, 0.001, np.float32), bands)
    text = " ".join(describe_above(count_above(cube), cube.labels))
    assert ("darker than its dark" in text) == named


@pytest.mark.parametrize(("warm", "named"), [(0.0, False), (0.001, False), (0.003, True)])
def test_a_dark_that_is_slightly_too_warm_is_named_where_dark_paint_lies_below_it(warm, named):
    """By no single value, whose noise is as much, but by the means of dark paint; and in whatever parts of the lines."""
    rng = np.random.default_rng(2)
    truth = np.kron(np.geomspace(0.001, 1, 24).reshape(6, 4, 1), np.ones((20, 80, 1)))
    values = (truth - warm + rng.normal(0, 0.001, truth.shape)).astype(np.float32)
    sigma = np.full(values.shape, 0.001, np.float32)
    cube = Cube(values, np.zeros(values.shape, np.uint8), sigma, (Band("550 nm"),))
    counts = count_above(cube)
    (text,) = describe_above(counts, cube.labels) or ("",)
    assert ("on the mean by a reflectance of 0.001" in text) == named
    halves = [
        replace(cube, values=cube.values[part], flags=cube.flags[part], sigma=sigma[part])
        for part in (np.s_[:7], np.s_[7:])
    ]
    assert np.array_equal(sum(map(count_above, halves)), counts)


@pytest.mark.parametrize("kind", ["bands", "cube"])
@pytest.mark.parametrize(("unlit", "code"), [("panel", "E_NO_LIGHT"), ("white", "E_WHITE_DARK")])
def test_a_target_without_light_is_refused_with_its_files(tmp_path, kind, unlit, code):
    made = make(tmp_path / "c", kind, 1.0, unlit={unlit})
    with pytest.raises(CalibrationRefused) as refused:
        develop(*made)
    (problem,) = refused.value.problems
    assert problem.code == code and "no light" in problem.message
    assert unlit in problem.file and "lens cap" in problem.fix


@pytest.mark.parametrize("kind", ["bands", "cube"])
def test_a_band_without_light_is_named(tmp_path, kind):
    (warning,) = [w for w in develop(*make(tmp_path / "c", kind, 0.0)).warnings if "no light" in w]
    assert "550 nm (1 of 3 bands)" in warning


@pytest.mark.parametrize("target", ["panel", "white"])
def test_a_frame_that_holds_one_value_is_refused(tmp_path, target):
    made = make(tmp_path / "c", "bands", 1.0)
    tifffile.imwrite(tmp_path / f"c/raw/{target}_550nm.tif", np.full(SIZE, 1000, "<u2"))
    with pytest.raises(CalibrationRefused) as refused:
        develop(*made)
    (problem,) = refused.value.problems
    assert f"{target}_550nm.tif" in problem.file and "1000 in every pixel" in str(problem)

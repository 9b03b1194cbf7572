"""Cubes of reflectance as other programs write them: factors, samples that hold nothing, bad bands."""

import numpy as np
import pytest
from cameras import developed, drop, key, read_scan, text, tones, write, write_scan

from levkas.core.cube import Band, Cube, Flag
from levkas.geometry.transforms import Affine
from levkas.stages.parts import CalibratedCapture, Part, on_grid
from levkas.stages.scans import open_scan
from levkas.stages.template_cache import TemplateCache

SIZE = (80, 100)
TRUTH = np.repeat(tones(SIZE)[0][..., None], 3, 2) * np.array([0.6, 0.8, 0.9])
EMPTY = np.zeros(SIZE, bool)
EMPTY[:20] = EMPTY[:, :15] = EMPTY[50:53, 60:63] = True
UNUSED = text('dark = "dark"\nwhite = { names = "white", reflectance = 1.0 }\n', "")


def product(folder, kind="i2", nothing=-9999.0, full=10_000.0, **keys):
    """A finished cube in place of the raw one, without dark and white."""
    write(folder, "cube", UNUSED, drop("dark*", "white*"), shape=SIZE, keys="")
    codes = np.where(EMPTY[..., None], nothing, TRUTH * full)
    codes = codes if kind == "f4" else np.rint(codes)
    said = {"reflectance_scale_factor": full, "data_ignore_value": nothing} | keys
    write_scan(folder / "raw/panel.hdr", codes.astype(kind), **said)
    return folder


@pytest.mark.parametrize(
    ("kind", "nothing"), [("i2", -9999), ("u2", 65535), ("u2", 0), ("f4", np.nan), ("f4", -1.0)]
)
def test_a_product_is_reflectance_with_nothing_where_nothing_was_recorded(tmp_path, kind, nothing):
    made = developed(product(tmp_path / "c", kind, nothing))
    cube = made.cube
    assert cube.quantity == "reflectance" and made.told("10000")
    outside = np.broadcast_to(EMPTY[..., None], cube.flags.shape)
    assert np.array_equal(cube.flags == Flag.OUTSIDE, outside) and not cube.flags[~EMPTY].any()
    assert np.abs(cube.values - TRUTH)[~EMPTY].max() < 6e-5


def test_a_product_read_by_lines_is_the_same(tmp_path):
    made = developed(product(tmp_path / "c"))
    scan = open_scan(made.capture, made.campaign, TemplateCache(tmp_path / "kept"))
    whole = scan.parts[0].whole()
    for name in ("values", "flags"):
        assert np.array_equal(getattr(whole, name), getattr(made.cube, name))
    assert not scan.images()[0].valid[EMPTY].any()


def test_noise_of_a_product_below_zero_is_not_clipped(tmp_path):
    folder = product(tmp_path / "c")
    noisy = np.rint(TRUTH * 100 + np.random.default_rng(2).normal(0, 40, TRUTH.shape))
    write_scan(folder / "raw/panel.hdr", noisy.astype("i2"))
    cube = developed(folder).cube
    assert (cube.values < 0).any() and not cube.flags.any()


@pytest.mark.parametrize("templates", ["dark and white", "dark", "overruled"])
def test_the_factor_is_not_used_beside_templates_or_where_it_is_overruled(tmp_path, templates):
    if templates == "overruled":
        folder = product(tmp_path / "c")
        key('overrule = ["reflectance_scale"]')(folder)
    else:
        folder = write(tmp_path / "c", "cube", shape=SIZE)
        path = folder / "raw/panel.hdr"
        write_scan(path, read_scan(path), reflectance_scale_factor=4095)
        if templates == "dark":
            text('white = { names = "white", reflectance = 1.0 }\n', "")(folder)
    made = developed(folder)
    assert made.cube.quantity == ("reflectance" if "white" in templates else "counts")
    assert made.told("10000" if templates == "overruled" else "4095")


def test_bad_bands_are_kept_and_used_for_nothing(tmp_path):
    folder = product(
        tmp_path / "c", bbl="{1, 0, 1}"
    )  # the middle one, which would be the reference
    made = developed(folder)
    cube = made.cube
    assert [band.label for band in cube.bands if band.bad] == ["550 nm"] and made.told("bbl", "550")
    defect = cube.flags & Flag.DEFECT > 0
    assert defect[..., 1].all() and not defect[..., [0, 2]].any()
    assert np.abs(cube.values - TRUTH)[~EMPTY].max() < 6e-5
    assert [image.valid.any() for image in made.native.images()] == [True, False, True]
    text('reference = "cam"', 'reference = { camera = "cam", band = "550 nm" }')(folder)
    assert developed(folder).problems  # a bad band is no reference


def test_values_of_a_layer_without_sigma_are_not_rounded_by_that_of_one_sensor():
    codes = np.arange(1000, 1400, dtype=np.float32).reshape(20, 20, 1)
    sigma, flags = np.full(codes.shape, 50, np.float32), np.zeros(codes.shape, np.uint8)
    known = Part.held(Cube(codes, flags, sigma, (Band("A"),), "counts"), "known")
    other = Part.held(Cube(codes + 400, flags, None, (Band("B"),), "counts"), "unknown")
    maps = dict.fromkeys("AB", Affine.identity())
    layer = on_grid(CalibratedCapture([known, other]), maps, (20, 20)).cube()
    assert layer.sigma is None
    assert np.array_equal(layer.values, np.concatenate([codes, codes + 400], axis=2))

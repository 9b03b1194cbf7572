"""Cubes of reflectance as other programs write them: factors, samples that hold nothing, bad bands."""

import numpy as np
import pytest

import levkas
from levkas.building import build, summarise
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.cube import Band, Cube, Flag
from levkas.geometry.transforms import Affine
from levkas.stages.calibrate import develop
from levkas.stages.native_cubes import Native
from levkas.stages.scans import open_scan
from levkas.stages.template_cache import TemplateCache

NM = np.arange(400, 1001, 100.0)
SIZE = (100, 90)
CAMPAIGN = """
[campaign]
reference = { camera = "scan" }
[cameras.scan]
kind = "cube"
files = "raw/{target}.hdr"
MORE
[targets]
dark = DARK
white = WHITE
objects = ["panel"]
"""


def truth():
    rng = np.random.default_rng(8)
    made, (y, x) = np.zeros((*SIZE, len(NM))), np.indices(SIZE)
    for _ in range(60):
        cy, cx, s, a = *rng.uniform(0, SIZE), rng.uniform(2, 12), rng.normal()
        blob = a * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * s * s))
        made += blob[..., None] * np.linspace(1, rng.uniform(-0.5, 1.5), len(NM))
    # Grain that all bands share: blobs alone, of other weights in every band, look as if they were displaced.
    made += 0.3 * rng.standard_normal((*SIZE, 1))
    return 0.05 + 0.8 / (1 + np.exp(-2 * made))


TRUTH = truth()
EMPTY = np.zeros(SIZE, bool)
EMPTY[:20] = EMPTY[:, :15] = EMPTY[50:53, 60:63] = True


def write(folder, name, cube, kind, extra=""):
    codes = {"i2": 2, "u2": 12, "f4": 4}
    (folder / "raw").mkdir(parents=True, exist_ok=True)
    stored = np.ascontiguousarray(cube.astype("<" + kind).transpose(0, 2, 1))
    (folder / f"raw/{name}.raw").write_bytes(stored.tobytes())
    lines, samples, bands = cube.shape
    header = (
        f"ENVI\nlines = {lines}\nsamples = {samples}\nbands = {bands}\ninterleave = bil\n"
        f"data type = {codes[kind]}\nbyte order = 0\nwavelength units = nm\n"
        f"wavelength = {{{', '.join(f'{nm:g}' for nm in NM)}}}\n{extra}\n"
    )
    (folder / f"raw/{name}.hdr").write_text(header)


def campaign(folder, *, dark="[]", white="[]", more=""):
    text = CAMPAIGN.replace("DARK", dark).replace("WHITE", white).replace("MORE", more)
    (folder / "campaign.toml").write_text(text)
    return folder


def product(folder, kind="i2", nothing=-9999.0, extra="", full=10_000.0):
    codes = np.where(EMPTY[..., None], nothing, TRUTH * full)
    stored = codes if kind == "f4" else np.rint(codes)
    lines = f"reflectance scale factor = {full:g}\ndata ignore value = {nothing:g}\n{extra}"
    write(folder, "panel", stored, kind, lines)
    return campaign(folder)


def capture_of(folder):
    read = load_campaign(folder)
    (capture,), refused = find_captures(read)
    assert not refused
    return capture, read, TemplateCache(folder)


def developed(folder) -> Native:
    return develop(*capture_of(folder))


@pytest.mark.parametrize(
    ("kind", "nothing"), [("i2", -9999), ("u2", 65535), ("u2", 0), ("f4", np.nan), ("f4", -1.0)]
)
def test_a_product_is_reflectance_with_nothing_where_nothing_was_recorded(tmp_path, kind, nothing):
    native = developed(product(tmp_path / "c", kind, nothing))
    cube = native.cubes[""]
    assert cube.quantity == "reflectance"
    assert np.array_equal(
        cube.flags == Flag.OUTSIDE, np.broadcast_to(EMPTY[..., None], cube.flags.shape)
    )
    assert not cube.flags[~EMPTY].any()
    assert np.abs(cube.values - TRUTH)[~EMPTY].max() < 6e-5
    said = [w for w in native.warnings if "10000" in w]
    assert len(said) == 1 and "taken as reflectance" in said[0]
    assert sum("hold nothing" in w for w in native.warnings) == 1


def test_a_scan_read_by_lines_is_the_same(tmp_path):
    folder = product(tmp_path / "c")
    whole = developed(folder).cubes[""]
    scan = open_scan(*capture_of(folder))
    blocks = list(scan.passed())
    assert scan.quantity == "reflectance"
    for name in ("values", "flags"):
        together = np.concatenate([getattr(block, name) for block in blocks])
        assert np.array_equal(together, getattr(whole, name))
    assert not scan.images()[0].valid[EMPTY].any()


def test_noise_of_a_product_below_zero_is_not_clipped(tmp_path):
    codes = np.rint(TRUTH * 100 + np.random.default_rng(2).normal(0, 40, TRUTH.shape))
    write(tmp_path / "c", "panel", codes, "i2", "reflectance scale factor = 10000")
    cube = developed(campaign(tmp_path / "c")).cubes[""]
    assert (cube.values < 0).any() and not cube.flags.any()


@pytest.mark.parametrize(("kind", "level"), [("f4", 0.0), ("i2", 0.0), ("f4", 60.0)])
def test_noise_of_raw_frames_below_zero_is_not_clipped(tmp_path, kind, level):
    rng, paint = np.random.default_rng(4), TRUTH.copy()
    paint[:40] = 0.0  # black: half of what a camera without offset shows of it is below zero
    lights = ("dark", 0 * TRUTH[:60]), ("white", 1 + 0 * TRUTH[:60]), ("panel", paint)
    for name, light in lights:
        counts = level + 3000 * light + rng.normal(0, np.sqrt(25 + 0.1 * 3000 * light))
        write(tmp_path / "c", name, np.rint(counts), kind)
    native = developed(campaign(tmp_path / "c", dark='"dark"', white='"white"'))
    cube = native.cubes[""]
    off = (cube.values - paint)[:40] / cube.sigma[:40]
    assert not cube.flags[:40].any()
    # 25,000 values; dark and white of 60 lines each are common to a sample's.
    assert np.std(off) == pytest.approx(1, rel=0.03) and abs(np.mean(off)) < 0.03
    assert not any("clipped" in warning for warning in native.warnings)


def test_the_factor_is_not_used_beside_a_white_and_this_is_said(tmp_path):
    rng = np.random.default_rng(3)
    extra = "reflectance scale factor = 4095"
    for name, light in (("dark", 0 * TRUTH[:10]), ("white", 1 + 0 * TRUTH[:10]), ("panel", TRUTH)):
        counts = 60 + 3000 * light + rng.normal(0, 2, light.shape)
        write(tmp_path / "c", name, np.rint(counts), "u2", extra)
    native = developed(campaign(tmp_path / "c", dark='"dark"', white='"white"'))
    cube = native.cubes[""]
    assert cube.quantity == "reflectance" and abs(np.median(cube.values / TRUTH) - 1) < 1e-3
    assert any("4095: this is not used" in warning for warning in native.warnings)


def test_a_dark_of_a_cube_without_white_leaves_counts(tmp_path):
    write(
        tmp_path / "c", "panel", np.rint(60 + 3000 * TRUTH), "u2", "reflectance scale factor = 4095"
    )
    write(tmp_path / "c", "dark", np.full((5, SIZE[1], len(NM)), 60), "u2")
    native = developed(campaign(tmp_path / "c", dark='"dark"'))
    assert native.cubes[""].quantity == "counts"
    assert any("this is not used" in warning for warning in native.warnings)


def test_a_factor_of_a_raw_scan_without_a_white_can_be_overruled(tmp_path):
    folder = product(tmp_path / "c")
    campaign(folder, more='overrule = ["reflectance_scale"]')
    native = developed(folder)
    assert native.cubes[""].quantity == "counts"
    assert any("this is not used" in warning for warning in native.warnings)
    assert not any("no effect" in warning for warning in native.warnings)


def test_bad_bands_are_kept_and_used_for_nothing(tmp_path):
    bbl = "bbl = {1, 1, 1, 0, 1, 1, 1}"  # the middle one, which would be the reference
    folder = product(tmp_path / "c", extra=bbl)
    native = developed(folder)
    cube = native.cubes[""]
    assert [band.label for band in cube.bands if band.bad] == ["700 nm"]
    assert np.array_equal(cube.flags[..., 3] & Flag.DEFECT > 0, np.ones(SIZE, bool))
    assert not (cube.flags[..., [0, 1, 2, 4, 5, 6]] & Flag.DEFECT).any()
    assert np.abs(cube.values - TRUTH)[~EMPTY].max() < 6e-5
    valid = [image.valid.any() for image in native.images()]
    assert valid == [True, True, True, False, True, True, True]
    assert any("1 of 7 bands are bad by the file (bbl: 700 nm)" in w for w in native.warnings)


def test_a_bad_band_is_no_reference(tmp_path):
    folder = product(tmp_path / "c", extra="bbl = {1, 1, 1, 0, 1, 1, 1}")
    text = (folder / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(
        text.replace('camera = "scan"', 'camera = "scan", band = "700 nm"')
    )
    _, refused = find_captures(load_campaign(folder))
    assert "bad by its own file" in str(refused["panel", "scan", ""])


@pytest.mark.slow
def test_a_product_is_published_with_nan_and_its_bad_band_named(tmp_path):
    noise = np.random.default_rng(4).uniform(0, 10_000, SIZE)
    folder = product(tmp_path / "c", extra="bbl = {1, 1, 0, 1, 1, 1, 1}")
    codes = np.where(EMPTY[..., None], -9999, np.rint(TRUTH * 10_000))
    codes[..., 2] = np.where(EMPTY, -9999, np.rint(noise))
    header = (folder / "raw/panel.hdr").read_text()
    write(folder, "panel", codes, "i2")
    (folder / "raw/panel.hdr").write_text(header)
    report = summarise(build(folder))
    assert report.ok, report.text
    cube = levkas.open(folder / "database")["panel"]["scan"]
    values, flags = cube.values, cube.levkas.flags.values
    assert np.array_equal(np.isnan(values), np.broadcast_to(EMPTY[..., None], values.shape))
    assert set(np.unique(flags[..., 0])) == {0, 1} and set(np.unique(flags[..., 2])) == {1 | 8, 8}
    good = [i for i in range(len(NM)) if i != 2]
    assert np.nanmedian(np.abs(values - TRUTH)[..., good]) < 1e-4
    assert cube.attrs["quantity"] == "reflectance" and cube.attrs["bad_bands"] == ["600 nm"]


def test_values_of_a_layer_without_sigma_are_not_rounded_by_that_of_one_sensor():
    codes = np.arange(1000, 1400, dtype=np.float32).reshape(20, 20, 1)
    sigma, flags = np.full(codes.shape, 50, np.float32), np.zeros(codes.shape, np.uint8)
    cubes = {
        "known": Cube(codes, flags, sigma, (Band("A"),), "counts"),
        "unknown": Cube(codes + 400, flags, None, (Band("B"),), "counts"),
    }
    for native in (Native(cubes), Native(cubes).packed()):
        layer = native.on_grid(dict.fromkeys("AB", Affine.identity()), (20, 20))
        assert layer.levkas.sigma is None
        assert np.array_equal(layer.values, np.concatenate([codes, codes + 400], axis=2))

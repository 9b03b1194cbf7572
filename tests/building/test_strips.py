"""Strips of a line scan of a known scene: joined to a twentieth of a pixel, streamed or held, or refused by name."""

from functools import cache

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter

import levkas
from levkas.building import build, summarise
from levkas.calibration.templates import CalibrationRefused
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.problems import Refused
from levkas.geometry.transforms import Affine
from levkas.stages import scan_templates
from levkas.stages.calibrate import develop
from levkas.stages.parts import CalibratedCapture, gathered, on_grid
from levkas.stages.scans import open_scan
from levkas.stages.template_cache import TemplateCache

pytestmark = pytest.mark.slow
LINES, SAMPLES, BANDS = 260, 150, 6
WHITE, DARK = 3000.0, 100.0
KEYS = """
[campaign]
reference = "REFERENCE"
[cameras.scan]
kind = "cube"
files = "{target}_*.hdr"
MORE
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.9 }
objects = ["panel"]
"""


@cache
def paint(seed=0, soft=1.2):
    """Return a scene of 3 x finer sampling than the scanner's, (3·lines, wide, bands), 0.1 to 0.8, as cubic splines."""
    rng = np.random.default_rng(seed)
    base = rng.standard_normal((3 * LINES + 120, 1500, 4))
    layers = [cv2.GaussianBlur(base[..., k], (0, 0), 3 * soft * (k + 1)) for k in range(4)]
    layers = np.stack([layer / layer.std() for layer in layers], -1)
    mixed = layers @ rng.uniform(-1, 1, (4, BANDS)) + 0.5 * layers[..., :1]
    values = np.clip(0.42 + 0.09 * mixed, 0.05, 0.85)
    return np.stack([spline_filter(values[..., b], order=3) for b in range(BANDS)], -1)


def look(scene, x, y):
    """Return the scene at places in px of the first strip, (…, bands)."""
    places = [3 * y + 40.0, 3 * x + 40.0]
    bands = [map_coordinates(scene[..., b], places, order=3, prefilter=False) for b in range(BANDS)]
    return np.stack(bands, -1)


def strip(scene, x0, y0, course=None, lines=LINES):
    """Return what a pass sees that begins at (x0, y0); `course` moves its lines, (line) → (dx, dy)."""
    y, x = np.mgrid[:lines, :SAMPLES].astype(float)
    dx, dy = course(y) if course else (0, 0)
    return look(scene, x + x0 + dx, y + y0 + dy)


def write_cube(path, cube):
    lines, samples, bands = cube.shape
    path.with_suffix(".raw").write_bytes(cube.transpose(0, 2, 1).tobytes())
    path.with_suffix(".hdr").write_text(
        f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\ninterleave = bil\n"
        f"data type = 12\nbyte order = 0\n"
        f"wavelength = {{{', '.join(str(450 + 40 * b) for b in range(bands))}}}\n"
    )


def write_campaign(folder, strips, *, more="", reference="scan", light=1.0, seed=1):
    """Write strips of reflectance as codes with noise, a white and a dark; `light` dims the last pass."""
    rng = np.random.default_rng(seed)
    sensels = 1 + 0.05 * rng.standard_normal((1, SAMPLES, BANDS))

    def coded(reflectance, gain=1.0):
        signal = gain * WHITE * sensels * reflectance / 0.9
        noisy = DARK + signal + rng.normal(0, np.sqrt(9 + 0.05 * signal))
        return np.clip(noisy.round(), 0, 65535).astype(np.uint16)

    folder.mkdir(exist_ok=True)
    for number, cube in enumerate(strips, 1):
        gain = light if number == len(strips) else 1.0
        write_cube(folder / f"panel_{number}", coded(cube, gain))
    write_cube(folder / "white_1", coded(np.full((150, SAMPLES, BANDS), 0.9)))
    write_cube(folder / "dark_1", coded(np.zeros((150, SAMPLES, BANDS))))
    text = KEYS.replace("MORE", more).replace("REFERENCE", reference)
    text += "[database]\nnative = true\n"
    (folder / "campaign.toml").write_text(text)
    return folder


def developed(folder) -> CalibratedCapture:
    campaign = load_campaign(folder)
    capture = next(c for c in find_captures(campaign)[0] if c.camera == "scan")
    return develop(capture, campaign, TemplateCache(folder))


def miss(cube, scene):
    """Return reflectance less the truth, in px of the first strip."""
    y, x = np.mgrid[: cube.values.shape[0], : cube.values.shape[1]].astype(float)
    return cube.values - look(scene, x, y), look(scene, x, y)


def shift_of(left, truth):
    """Return the (x, y) by which a residual shows the truth moved, px: least squares on its slopes."""
    inner = np.s_[6:-6, 6:-6]
    slopes = np.stack([np.gradient(truth, axis=a)[inner].ravel() for a in (1, 0)], 1)
    return np.linalg.lstsq(slopes, -left[inner].ravel(), rcond=None)[0]


@pytest.mark.parametrize(
    "x, y",
    [
        *((120.37, 0.0), (129.8, -3.21)),
        *(pytest.param(*one, marks=pytest.mark.exhaustive) for one in ((111.5, 2.5), (118.0, 4.0))),
    ],
)
def test_strips_are_joined_to_a_twentieth_of_a_pixel(tmp_path, x, y):
    scene = paint()
    folder = write_campaign(tmp_path / "c", [strip(scene, 0, 4), strip(scene, x, 4 + y)])
    native = developed(folder)
    (seam,) = native.measured[""]["strips"]
    assert np.hypot(seam["offset_px"][0] - x, seam["offset_px"][1] - y) < 0.05
    cube = native.cubes[""]
    left, truth = miss(cube, np.roll(scene, -12, 0))
    beyond = np.s_[8:-8, SAMPLES + 2 : 250]
    assert np.abs(shift_of(left[beyond], truth[beyond])).max() < 0.05


def test_a_stage_that_runs_askew_is_followed_and_one_that_wobbles_refused(tmp_path):
    scene = paint(3)

    def wobble(line):
        turn = 2 * np.pi * line / 170
        return 0.6 * np.sin(turn), 0.3 * np.cos(turn)

    strips = [strip(scene, 0, 2), strip(scene, 108.3, 2.1, lambda y: (0.006 * y, 0 * y))]
    native = developed(write_campaign(tmp_path / "c", strips))
    (seam,) = native.measured[""]["strips"]
    assert seam["slope_px"][0] == pytest.approx(0.006 * LINES, abs=0.1)
    left, truth = miss(native.cubes[""], np.roll(scene, -6, 0))
    beyond = np.s_[20:-20, SAMPLES + 2 : 250]
    rows = np.array_split(np.arange(len(left[beyond])), 6)
    found = [shift_of(left[beyond][r], truth[beyond][r]) for r in rows]
    assert np.sqrt(np.mean(np.square(found), 0)).max() < 0.03
    strips[1] = strip(scene, 108.3, 2.1, wobble)
    with pytest.raises(Refused) as refused:
        developed(write_campaign(tmp_path / "w", strips))
    assert refused.value.problems[0].code == "E_STRIPS"


def test_three_strips_are_joined_and_streamed_to_the_same_bytes(tmp_path, monkeypatch):
    scene = paint(4)
    places = [(0, 0), (112.37, 1.3), (223.9, -0.6)]
    folder = write_campaign(tmp_path / "c", [strip(scene, x, 4 + y) for x, y in places])
    native = developed(folder)
    offsets = [seam["offset_px"] for seam in native.measured[""]["strips"]]
    np.testing.assert_allclose(offsets, np.diff(places, axis=0), atol=0.05)
    campaign = load_campaign(folder)
    (capture,), _ = find_captures(campaign)
    cube = native.cubes[""]
    monkeypatch.setattr(scan_templates, "BLOCK_SAMPLES", 7 * SAMPLES * BANDS)
    scan = open_scan(capture, campaign, TemplateCache(folder))
    for part, held in zip(scan.parts, native.parts, strict=True):
        for name in ("values", "flags", "sigma"):
            some, whole = (getattr(one.rows(30, 200), name) for one in (part, held))
            assert np.array_equal(some, whole, equal_nan=name != "flags"), name
    streamed = scan.cubes[""]
    assert streamed.shape == cube.shape
    np.testing.assert_allclose(streamed.values, cube.values, atol=2e-4)
    np.testing.assert_array_equal(streamed.flags, cube.flags)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A photograph of the whole scene as reference, and a scan of two strips 0.37 samples askew."""
    folder, scene = tmp_path_factory.mktemp("built") / "c", paint(5)
    more = '[cameras.photo]\nkind = "image"\nfiles = "{target}.png"'
    strips = [strip(scene, 0, 4), strip(scene, 114.37, 5.6)]
    write_campaign(folder, strips, more=more, reference="photo")
    y, x = np.mgrid[:LINES, :270].astype(float)
    photo = look(scene, x, y + 4)[..., :3]
    cv2.imwrite(str(folder / "panel.png"), (photo * 65535).round().astype(np.uint16))
    assert not summarise(build(folder)).problems
    return folder, scene


def test_a_build_registers_both_strips(built):
    folder, scene = built
    layer = levkas.open(folder / "database")["panel"]["scan"]
    values = np.asarray(layer)
    y, x = np.mgrid[: values.shape[0], : values.shape[1]].astype(float)
    truth = look(scene, x, y + 4)
    for columns in (np.s_[8:105], np.s_[156:255]):
        part = np.s_[10:-10, columns]
        assert np.abs(shift_of((values - truth)[part], truth[part])).max() < 0.05


@pytest.mark.parametrize("second", [(200, 0), (-119.6, 1.2)], ids=["no overlap", "other way round"])
def test_strips_that_do_not_match_are_refused_by_name(tmp_path, second):
    scene = np.roll(paint(), 600, 1)
    folder = write_campaign(
        tmp_path, [strip(scene, 200, 4), strip(scene, 200 + second[0], 4 + second[1])]
    )
    with pytest.raises(CalibrationRefused) as refused:
        developed(folder)
    (problem,) = refused.value.problems
    assert problem.code == "E_STRIPS" and problem.file.endswith("panel_2.hdr")
    assert problem.field == "cameras.scan.files"


@pytest.mark.parametrize(
    "kind", ["bare board", "repeats", pytest.param("lines alone", marks=pytest.mark.exhaustive)]
)
def test_an_overlap_that_does_not_tell_the_offset_is_refused(tmp_path, kind):
    y, x = np.mgrid[:LINES, :SAMPLES].astype(float)
    grey = {
        "bare board": 0.5 + 0 * x,
        "repeats": 0.5 + 0.2 * np.sin(2 * np.pi * x / 15) * np.sin(2 * np.pi * y / 20),
        "lines alone": 0.5 + 0.2 * np.sin(2 * np.pi * y / 37) * np.sin(y / 11),
    }[kind]
    cube = np.repeat(grey[..., None], BANDS, 2)
    with pytest.raises(Refused) as refused:
        developed(write_campaign(tmp_path, [cube, cube]))
    assert refused.value.problems[0].code == "E_STRIPS"


@pytest.mark.parametrize("larger", [pytest.param(1.0, marks=pytest.mark.exhaustive), 0.5])
def test_sigma_of_strips_holds_when_they_are_resampled_again(tmp_path, larger):
    """Half a pixel beside the first strip, then on a grid turned by 5 degrees, as large or half as large."""
    smooth = paint(soft=6.0)
    folder = write_campaign(tmp_path / "c", [strip(smooth, 0, 0), strip(smooth, 110.5, 0.5)])
    native = developed(folder)
    cube = native.cubes[""]
    turn = np.deg2rad(5)
    move = np.array([[np.cos(turn), np.sin(turn), 3.0], [-np.sin(turn), np.cos(turn), 22.0]])
    move[:, :2] /= larger
    there = [Affine(move)] * BANDS
    shape = (int(200 * larger), int(250 * larger))
    maps = dict(zip(cube.labels, there, strict=True))
    made = gathered(on_grid(native, maps, shape[::-1]).cube())
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    places = there[0](np.stack([x.ravel(), y.ravel()], 1)).T.reshape(2, *shape)
    pull = (made.values - look(smooth, *places)) / made.sigma
    inner = (places[0] > 6) & (places[0] < 250) & (places[1] > 6) & (places[1] < LINES - 8)
    for part in (places[0] < 100, (places[0] > 118) & (places[0] < 142), places[0] > 160):
        where = part & inner & (made.flags == 0).all(-1)
        assert pull[where].std() == pytest.approx(1, abs=0.1)  # 1.1 to 1.6 without

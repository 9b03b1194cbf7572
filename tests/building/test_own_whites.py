"""Darks and whites of one object, and of several the nearest in time, through whole builds."""

import json

import numpy as np
import pytest
import tifffile

import levkas
from levkas.building import build

WAVES = np.arange(400, 701, 100.0)
LIGHTS = {"icon1": 2500.0, "icon2": 1600.0}
SCANS = """[campaign]
reference = { camera = "scan" }
[cameras.scan]
kind = "cube"
files = ["{target}/capture/{target}.hdr", "{object}/capture/{target}_*.hdr"]
[targets]
dark = "DARKREF"
white = { names = "WHITEREF", reflectance = 1 }
"""


def painting(seed, shape=(60, 50), bands=4):
    """Smooth reflectance between 0.05 and 0.85, (height, width, bands)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    out = np.zeros((*shape, bands))
    for _ in range(40):
        cy, cx, size = rng.uniform(0, shape[0]), rng.uniform(0, shape[1]), rng.uniform(2, 12)
        shade = np.linspace(1, rng.uniform(-0.5, 1.5), bands) * rng.uniform(-0.6, 0.6)
        out += np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * size**2))[..., None] * shade
    return 0.05 + 0.8 / (1 + np.exp(-2 * out))


def scan(path, cube, **facts):
    path.parent.mkdir(parents=True, exist_ok=True)
    codes = np.random.default_rng(len(str(path))).normal(cube, 2.0).round().astype("<u2")
    path.with_suffix(".raw").write_bytes(codes.transpose(0, 2, 1).tobytes())
    lines, samples, bands = cube.shape
    keys = (
        f"samples = {samples}\nlines = {lines}\nbands = {bands}\ninterleave = bil\ndata type = 12\n"
    )
    keys += f"byte order = 0\ntint = 20\nwavelength = {{{', '.join(f'{w:g}' for w in WAVES)}}}\n"
    path.write_text(f"ENVI\n{keys}" + "".join(f"{k} = {v}\n" for k, v in facts.items()))


def session(folder):
    """Two scans under lights that differ, each with a dark and white of its own."""
    for seed, (icon, light) in enumerate(LIGHTS.items()):
        capture, truth = folder / icon / "capture", painting(seed)
        scan(capture / f"{icon}.hdr", 100 + light * truth)
        scan(capture / f"DARKREF_{seed + 281}.hdr", np.full((20, 50, 4), 100.0))
        scan(capture / f"WHITEREF_{seed + 281}.hdr", np.full((20, 50, 4), 100.0 + light))
    (folder / "campaign.toml").write_text(SCANS)
    return folder


def states(steps):
    """Last state of every stage of calibration, by object."""
    return {s.key.object: s.state for s in steps if s.key.stage == "calibrate" and s.finished}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = session(tmp_path_factory.mktemp("scans"))
    steps = list(build(folder))
    assert not [s for s in steps if s.state in ("refused", "failed")]
    return folder


def test_every_object_is_divided_by_its_own_white(built):
    database = levkas.open(built / "database")
    for seed, icon in enumerate(LIGHTS):
        reflectance = np.asarray(database[icon]["scan"])
        assert np.abs(reflectance - painting(seed)).max() < 0.02  # 10 noises of 2 in 1600 counts
        assert np.median(reflectance / painting(seed)) == pytest.approx(1.0, abs=5e-4)


def test_provenance_lists_only_the_darks_and_whites_that_an_object_was_calibrated_by(built):
    text = (built / "database/objects/icon1/provenance.json").read_text()
    assert "icon1/capture/WHITEREF_281.raw" in text and "icon2/capture" not in text
    assert json.loads(text)


def test_a_white_of_one_object_that_changed_makes_no_other_stale(built):
    white = built / "icon2/capture/WHITEREF_282.hdr"
    codes = np.fromfile(white.with_suffix(".raw"), "<u2")
    (codes + 1).tofile(white.with_suffix(".raw"))
    assert states(build(built)) == {"icon1": "fresh", "icon2": "done"}


FLAT = """[campaign]
reference = { camera = "cam" }
[cameras.cam]
kind = "bands"
bands = ["grey"]
files = "{target}_{shot}.tif"
[targets]
dark = "dark"
white = { names = "white", reflectance = 1 }
"""


def frame(folder, name, level, hour, minute=0):
    shots = np.random.default_rng(hour * 60 + minute)
    codes = shots.normal(level, 2.0, (60, 50)).round().astype(np.uint16)
    when = f"2024:05:31 {hour:02}:{minute:02}:00"
    tifffile.imwrite(folder / f"{name}.tif", codes, datetime=when, photometric="minisblack")


def test_each_object_is_divided_by_the_white_that_is_nearest_in_time(tmp_path):
    (tmp_path / "campaign.toml").write_text(FLAT)
    truths = {name: painting(seed)[..., 0] for seed, name in enumerate(("icon1", "icon2"))}
    frame(tmp_path, "dark_1", 100.0, 8)
    frame(tmp_path, "white_1", 100 + 3000.0, 9)
    frame(tmp_path, "icon1_1", 100 + 3000 * truths["icon1"], 9, 1)
    frame(tmp_path, "white_2", 100 + 2700.0, 12)
    frame(tmp_path, "icon2_1", 100 + 2700 * truths["icon2"], 12, 10)
    steps = list(build(tmp_path))
    assert not [s for s in steps if s.state in ("refused", "failed")]
    made = np.asarray(levkas.open(tmp_path / "database")["icon2"]["cam"])[..., 0]
    assert np.median(made / truths["icon2"]) == pytest.approx(1.0, abs=2e-3)
    warnings = " ".join(w for s in steps for w in s.warnings)
    used = "of 2 whites those nearest to the object are used"
    assert f"icon2/cam: {used}: 10 min before it" in warnings
    assert "icon1/cam: of 2 whites" not in warnings  # both are: before and after it

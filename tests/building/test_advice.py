"""What a refusal advises follows from what was found: once, with the file, and with what mends it."""

import cv2
import numpy as np
import pytest
import tifffile

import levkas
from levkas.building import build, summarise
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.calibration.whites import check_white
from levkas.readers.frames import read_facts, read_frame
from levkas.registration import RegistrationRefused, register

XTRANS = ("GGRGGB", "GGBGGR", "BRGRBG", "GGBGGR", "GGRGGB", "RBGBRG")
"""Fujifilm's pattern, as a DNG states it."""
KEYS = """
[campaign]
reference = { camera = "c" }
[cameras.c]
kind = "KIND"
files = "FILES"
MORE
[targets]
dark = "dark"
white = { names = "white", reflectance = 1.0 }
objects = ["panel"]
"""


def campaign(folder, kind, files, more=""):
    text = KEYS.replace("KIND", kind).replace("FILES", files).replace("MORE", more)
    (folder / "campaign.toml").write_text(text)
    return folder


def scene(shape):
    """A smooth picture of three colours, 0.1 to 0.9, the same detail in each."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    detail = np.sin(x / 17) * np.cos(y / 13) + np.sin((x + 2 * y) / 29)
    return 0.5 + 0.2 * detail[..., None] * [1.0, 0.9, 0.7]


def write_dng(path, mosaic, rows):
    side, codes = len(rows), bytes("RGB".index(c) for row in rows for c in row)
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True), (50708, "s", 0, "Levkas test", True),
        (33421, "H", 2, (side, side), True), (33422, "B", side * side, codes, True),
        (50714, "H", 1, (64,), True), (50717, "I", 1, 4095, True), (50778, "H", 1, 21, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
    ]  # fmt: skip
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None)


def test_an_x_trans_raw_is_read_by_its_own_pattern_and_built_to_the_planted_truth(tmp_path):
    rng, truth = np.random.default_rng(2), scene((180, 240))
    which = np.tile([["RGB".index(c) for c in row] for row in XTRANS], (30, 40))
    for target, light in (("dark", 0.0), ("white", 1.0), ("panel", truth)):
        counts = np.broadcast_to(light, truth.shape) * [1800, 3000, 2200]
        codes = 64 + np.take_along_axis(counts, which[..., None], 2)[..., 0]
        codes = np.rint(codes + rng.normal(0, 2, codes.shape)).astype(np.uint16)
        write_dng(tmp_path / f"{target}.dng", codes, XTRANS)
        if target == "panel":
            assert np.array_equal(read_frame(tmp_path / "panel.dng"), codes)
    assert read_facts(tmp_path / "panel.dng").pattern == "".join(XTRANS)
    report = summarise(build(campaign(tmp_path, "mosaic", "{target}.dng")))
    assert report.ok, report.text
    layer = levkas.open(tmp_path / "database")["panel"]["c"]
    error = layer.values[8:-8, 8:-8] - truth[8:-8, 8:-8]
    assert np.abs(error.mean((0, 1))).max() < 2e-4 and error.std() < 4e-3


def test_a_white_whose_codes_go_on_above_the_saturation_is_of_another_mode():
    ramp, fixes = np.linspace(4000, 15000, 600, dtype=np.float32).reshape(20, 30), set()
    for values in (ramp, np.minimum(ramp, 4095)):
        white = Template(values, None, 1, values >= 4095, values <= 0)
        with pytest.raises(CalibrationRefused) as refused:
            check_white(white, np.float32(64), None, ["550 nm"])
        (problem,) = refused.value.problems
        assert problem.code == "E_WHITE_SATURATED"
        fixes.add(problem.fix)
    assert len(fixes) == 2


@pytest.mark.slow
def test_a_camera_that_samples_much_more_coarsely_is_refused_for_that():
    rng = np.random.default_rng(3)
    big = np.full((1200, 1200), 90, np.float32)
    for _ in range(1500):
        centre = tuple(int(v) for v in rng.integers(0, 1200, 2))
        cv2.circle(big, centre, int(rng.integers(4, 60)), float(rng.integers(20, 235)), -1)
    big += 30 * cv2.GaussianBlur(rng.standard_normal(big.shape).astype(np.float32), (0, 0), 1.5)
    small = cv2.resize(big, (150, 150), interpolation=cv2.INTER_AREA)
    with pytest.raises(RegistrationRefused) as refused:
        register(big, small)
    (problem,) = refused.value.problems
    assert problem.code == "E_SCALE"

"""What a refusal advises follows from what was found: once, with the file, and with what mends it."""

import cv2
import numpy as np
import pytest
import tifffile

import levkas
from levkas.building import build, summarise
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.calibration.whites import check_white
from levkas.core.problems import Problem, Refused, gathered
from levkas.geometry.transforms import Polynomial
from levkas.readers.frames import read_facts, read_frame
from levkas.registration import RegistrationRefused, register
from levkas.registration.initial import implausible
from levkas.registration.verdict_rules import does_not_fold

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


def write_linear_dng(path, colours):
    tags = [(50706, "B", 4, (1, 4, 0, 0), True), (50708, "s", 0, "Levkas test", True),
            (50717, "H", 3, (4095,) * 3, True)]  # fmt: skip
    tifffile.imwrite(path, colours, photometric=34892, extratags=tags, metadata=None)


def test_a_linear_dng_is_a_photograph_whose_picture_is_encoded(tmp_path):
    colours = np.full((64, 96, 3), 900, np.uint16)
    colours[8:40, 8:48] = 4000
    write_linear_dng(tmp_path / "panel.dng", colours)
    report = summarise(build(campaign(tmp_path, "image", "{target}.dng")))
    assert report.ok, report.text
    layer = levkas.open(tmp_path / "database")["panel"]["c"]
    assert np.array_equal(layer.values, colours)
    (picture,) = (tmp_path / "database/objects/panel").glob("panel_c.png")
    dark, bright = (int(read_frame(picture)[y, x, 0]) for y, x in ((50, 80), (20, 20)))
    assert bright == 255 and abs(dark - 131) <= 2  # 900/4000 of light is 0.512 of the sRGB code


def test_a_linear_dng_is_no_mosaic(tmp_path):
    for target in ("dark", "white", "panel"):
        write_linear_dng(tmp_path / f"{target}.dng", np.full((64, 96, 3), 900, np.uint16))
    with pytest.raises(Refused, match=r'holds colours and no mosaic.*kind = "image"'):
        summarise(build(campaign(tmp_path, "mosaic", "{target}.dng")))


def write_bands(folder, levels, dtype=np.uint16):
    rng = np.random.default_rng(1)
    for target, level in levels.items():
        for wavelength in (500, 600, 700):
            codes = rng.normal(level, 2, (64, 64)).clip(0)
            tifffile.imwrite(folder / f"{target}_{wavelength}nm.tif", codes.astype(dtype))


@pytest.mark.parametrize(
    ("levels", "dtype", "found", "fix"),
    [
        ({"dark": 10, "white": 200, "panel": 90}, np.uint8, "9 files", "in 16 bits"),
        ({"dark": 60, "white": 9000, "panel": 5000}, np.uint16, "6 files", "bits = 14"),
    ],
)
def test_wrong_bits_are_said_once_with_the_number_of_files(tmp_path, levels, dtype, found, fix):
    write_bands(tmp_path, levels, dtype)
    report = summarise(
        build(campaign(tmp_path, "bands", "{target}_{wavelength}nm.tif", "bits = 12"))
    )
    (problem,) = report.problems
    assert problem.code == "E_BITS" and found in problem.message and fix in problem.fix


def test_problems_of_one_file_and_unlike_ones_stay_apart():
    problems = [
        Problem("E_A", "one", "a"),
        Problem("E_A", "one", "a", found=2),
        Problem("E_B", "two", "b"),
    ]
    assert gathered(problems) == problems


def template(values, saturation=np.inf):
    values = np.asarray(values, np.float32)
    return Template(values, None, 1, values >= saturation, values <= 0)


def refusal(white, level, labels):
    with pytest.raises(CalibrationRefused) as refused:
        check_white(white, np.float32(level), None, labels)
    (problem,) = refused.value.problems
    return problem


def test_exchanged_dark_and_white_of_many_bands_are_one_refusal_that_says_so():
    labels = [f"{w} nm" for w in range(400, 1001, 50)]
    problem = refusal(template(np.full((20, 30, 13), 60.0)), 2600, labels)
    assert problem.code == "E_WHITE_DARK" and "all 13" in problem.message
    assert "swapped" in problem.fix and "exchange" in problem.fix
    some = np.full((20, 30, 13), 2600.0)
    some[..., 3:5] = 60
    problem = refusal(template(some), 64, labels)
    assert "550 nm, 600 nm" in problem.message and "lamp was off" in problem.fix


def test_a_white_whose_codes_go_on_above_the_saturation_is_of_another_mode():
    ramp = np.linspace(4000, 15000, 600).reshape(20, 30)
    problem = refusal(template(ramp, 4095), 64, ["550 nm"])
    assert problem.code == "E_WHITE_SATURATED" and "mode" in problem.fix
    assert "shorter exposure" not in problem.fix
    clipped = refusal(template(np.minimum(ramp, 4095), 4095), 64, ["550 nm"])
    assert "shorter exposure" in clipped.fix


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [8, pytest.param(10, marks=pytest.mark.exhaustive)])
def test_a_camera_that_samples_much_more_coarsely_is_refused_for_that(ratio):
    rng = np.random.default_rng(3)
    big = np.full((1200, 1200), 90, np.float32)
    for _ in range(1500):
        centre = tuple(int(v) for v in rng.integers(0, 1200, 2))
        cv2.circle(big, centre, int(rng.integers(4, 60)), float(rng.integers(20, 235)), -1)
    big += 30 * cv2.GaussianBlur(rng.standard_normal(big.shape).astype(np.float32), (0, 0), 1.5)
    side = 1200 // ratio
    small = cv2.resize(big, (side, side), interpolation=cv2.INTER_AREA)
    with pytest.raises(RegistrationRefused) as refused:
        register(big, small)
    (problem,) = refused.value.problems
    assert problem.code == "E_SCALE" and f"{ratio}." in problem.found
    assert "sampling" in problem.fix


@pytest.mark.parametrize(
    ("share", "advice"), [(0.12, "more of the reference"), (0.8, "same object")]
)
def test_a_map_that_folds_names_little_in_common_where_that_is_the_cause(share, advice):
    scales = {"scale_min": 0.7, "scale_max": 1.4}
    objection = does_not_fold({"overlap": share, "folded": 0.04, **scales})
    assert advice in objection.next_step and "4 %" in objection.reason
    assert ("polynomial" in objection.on_matches) == (share > 0.5)
    x = np.linspace(0, 900, 40)
    points = np.stack([x, x[::-1] % 97], 1)
    folded = Polynomial.fit(points, np.abs(points - 450), order=2)
    problem = implausible(folded, (0, 0, 900, 97), False, None, share)
    assert (
        problem.code == "E_FOLD" and advice in problem.fix and f"{share:.0%}"[:-1] in problem.found
    )


@pytest.mark.parametrize(
    ("scale", "words"),
    [(5.0, "5.0 of its px to one"), (0.2, "5.0 px of the reference to one of its own")],
)
@pytest.mark.parametrize("share", [0.12, 0.8])
def test_a_map_that_folds_names_unlike_samplings_where_they_may_be_the_cause(scale, words, share):
    scales = {"scale_min": 0.9 * scale, "scale_max": scale / 0.9}
    objection = does_not_fold({"overlap": share, "folded": 0.04, **scales})
    x = np.linspace(0, 900, 40)
    points = np.stack([x, x[::-1] % 97], 1)
    folded = Polynomial.fit(points, scale * np.abs(points - 450), order=2)
    problem = implausible(folded, (0, 0, 900, 97), False, None, share)
    assert problem.code == "E_FOLD" and "to one" in problem.found
    assert words in objection.reason and not objection.on_matches
    for step in (objection.next_step, problem.fix):
        assert "sampling lies between the two" in step and "levkas inspect" in step
        assert ("more of the reference" in step) == (share < 0.5)

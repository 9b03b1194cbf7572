"""`levkas.calibrate`: arrays of one sensor to reflectance, as a build makes it."""

import numpy as np
import pytest

import levkas
from levkas.readers.frames import read_frame
from levkas.stages.calibrate import develop
from levkas.stages.spectra import board_of
from levkas.stages.template_cache import TemplateCache

GAIN, READ, BLACK, FULL = 0.25, 2.0, 64.0, 3000.0
GLARE = np.uint8(levkas.Flag.GLARE)


def shots(light, count, seed=0, shape=(60, 80)):
    """Return 12-bit frames of a sensor of known noise under `light`, 1.0 = the perfect diffuser."""
    rng = np.random.default_rng(seed)
    light = np.broadcast_to(np.asarray(light, float), shape)
    counts = GAIN * rng.poisson(light * FULL / GAIN, (count, *shape))
    counts = counts + rng.normal(BLACK, READ, counts.shape)
    return list(counts.round().clip(0, 4095).astype(np.uint16))


def test_a_mosaic_has_the_values_flags_and_sigma_of_a_build(world, tmp_path):
    campaign = levkas.load_campaign(world.folder)
    capture = next(c for c in levkas.find_captures(campaign)[0] if c.camera == "colour")
    (sensor,) = capture.sensors
    built = develop(capture, campaign, TemplateCache(tmp_path)).cubes[""]
    parts = (sensor.object, sensor.dark, sensor.white)
    frames = [[read_frame(frame.path) for frame in part] for part in parts]
    board = board_of(campaign, capture, sensor).reflectance
    cube = levkas.calibrate(*frames, reflectance=board, pattern="RGGB", saturation=4095)
    assert cube.labels == built.labels
    np.testing.assert_array_equal(cube.flags & ~GLARE, built.flags & ~GLARE)
    np.testing.assert_allclose(cube.values, built.values, rtol=3e-5, atol=1e-6)
    np.testing.assert_allclose(cube.sigma, built.sigma, rtol=0.005)


@pytest.mark.parametrize(("count", "shape"), [(1, (200, 240)), (8, (60, 80))])
@pytest.mark.parametrize("bands", [None, 3])
def test_planted_reflectance_is_recovered_within_its_sigma(count, shape, bands):
    y, x = np.mgrid[: shape[0], : shape[1]]
    scene, lamp = 0.2 + 0.6 * (x > shape[1] / 2), 0.6 + 0.4 * y / shape[0]

    def frames(light, seed):
        made = [shots(light, count, seed + i, shape) for i in range(bands or 1)]
        return made[0] if bands is None else [np.stack(one, -1) for one in zip(*made, strict=True)]

    cube = levkas.calibrate(
        frames(0.98 * lamp * scene, 1), frames(0, 11), frames(0.98 * lamp, 21), saturation=4095
    )
    assert cube.values.shape == (*shape, bands or 1) and cube.quantity == "reflectance"
    away = np.abs(x - shape[1] / 2) > 3
    z = ((cube.values - scene[..., None]) / cube.sigma)[away]
    assert abs(z.mean()) < 0.1
    assert 0.85 < z.std() < 1.15


def test_one_line_of_templates_stands_for_all_lines():
    rng = np.random.default_rng(3)
    shade = rng.uniform(500, 1000, (1, 30, 4))
    raw = np.tile(0.3 * shade + 64, (20, 1, 1)).astype(np.float32)
    cube = levkas.calibrate(
        raw, np.full((1, 30, 4), 64.0), shade + 64, wavelengths=[450, 550, 650, 750]
    )
    np.testing.assert_allclose(cube.values, 0.3, rtol=1e-5)
    assert cube.labels == ["450 nm", "550 nm", "650 nm", "750 nm"]


def test_without_a_white_counts_stay_above_the_black_level():
    raw = np.full((4, 6), 564, np.uint16)
    cube = levkas.calibrate(raw, 64)
    assert cube.quantity == "counts"
    np.testing.assert_array_equal(cube.values[..., 0], 500)
    np.testing.assert_array_equal(levkas.calibrate(raw).values[..., 0], 564)


def test_defects_movement_saturation_and_gaps_are_flagged():
    dark, white = shots(0, 4, 1), shots(1.0, 4, 2)
    for frame in dark:
        frame[10, 10] = 900
    raw = shots(0.5, 4, 3)
    raw[1][30:36, 30:36] += 600
    raw[2][50, 50] = 4095
    cube = levkas.calibrate(raw, dark, white, saturation=4095)
    flags = cube.flags[..., 0]
    assert flags[10, 10] & levkas.Flag.DEFECT and abs(cube.values[10, 10, 0] - 0.5) < 0.05
    assert (flags[31:35, 31:35] & levkas.Flag.MOVED).all()
    assert flags[50, 50] & levkas.Flag.SATURATED
    floats = [frame.astype(np.float32) for frame in raw]
    floats[0][5, 5] = np.nan
    lost = levkas.calibrate(floats, dark[0].astype(float), white[0].astype(float))
    assert lost.flags[5, 5, 0] & levkas.Flag.DEFECT and np.isfinite(lost.values[5, 5, 0])


GREY = np.full((8, 8), 500, np.uint16)


@pytest.mark.parametrize(
    ("arguments", "options", "code", "field"),
    [
        (([],), {}, "E_NO_FRAMES", "raw"),
        (([GREY, GREY[:4]],), {}, "E_SIZE", "raw"),
        ((GREY.astype(complex),), {}, "E_VALUE", "raw"),
        ((GREY, GREY[:4]), {}, "E_SIZE", "dark"),
        ((GREY, 64, GREY[:, :4]), {}, "E_SIZE", "white"),
        ((GREY, GREY, GREY // 2), {}, "E_WHITE_DARK", None),
        ((GREY, 64, GREY), {"saturation": 400}, "E_WHITE_SATURATED", None),
        ((GREY, 64, GREY), {"reflectance": -1.0}, "E_VALUE", "white.reflectance"),
        ((GREY, 64, GREY), {"exposure_s": (0.1, 0.1)}, "E_EXPOSURES", "exposure_s"),
        ((GREY, 64, GREY), {"wavelengths": [450, 550]}, "E_BAND_COUNT", "wavelengths"),
        ((GREY, 64, GREY), {"pattern": [["R", "G"], ["B"]]}, "E_VALUE", "pattern"),
        ((np.dstack([GREY] * 2),), {"pattern": "RGGB"}, "E_SIZE", "raw"),
        ((GREY.tolist(),), {}, "E_VALUE", "raw"),
        ((np.ma.masked_equal(GREY, 1),), {}, "E_VALUE", "raw"),
        ((GREY * np.nan,), {}, "E_VALUE", "raw"),
        ((GREY, float("nan")), {}, "E_VALUE", "dark"),
        ((GREY, 64, 1000), {}, "E_VALUE", "white"),
        ((GREY, 64, GREY), {"reflectance": "high"}, "E_VALUE", "reflectance"),
        ((GREY, 64, GREY), {"saturation": "full"}, "E_VALUE", "saturation"),
        ((GREY, 64, GREY), {"wavelengths": ["red"]}, "E_VALUE", "wavelengths"),
    ],
)  # fmt: skip
def test_frames_and_arguments_that_do_not_fit_are_refused_by_name(arguments, options, code, field):
    with pytest.raises(levkas.Refused) as refused:
        levkas.calibrate(*arguments, **options)
    assert (refused.value.problems[0].code, refused.value.problems[0].field) == (code, field)

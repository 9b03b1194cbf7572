import numpy as np
import pytest

from levkas.calibration.flatfield import flat_field
from levkas.calibration.noise_fit import NoiseModel, fit_noise
from levkas.calibration.templates import CalibrationRefused, Template, average
from levkas.calibration.whites import WhiteBoard
from levkas.core.cube import Flag


def flat(value, *, shape=(4, 6), exposure_s=None):
    return average([np.full(shape, value, np.float32)], exposure_s=exposure_s)


def test_flat_field_by_hand():
    # (300 − 100)/(900 − 100) · 0.98 = 0.245
    made = flat_field(flat(300), flat(100), flat(900), board=WhiteBoard(0.98))
    np.testing.assert_allclose(made.values, 0.245, rtol=1e-6)
    assert made.quantity == "reflectance"
    assert not made.flags.any()


def test_exposures_are_normalised():
    # (300 − 100)/(900 − 100) with the white four times as long: four times the reflectance.
    dark = flat(100)
    made = flat_field(flat(300, exposure_s=0.1), dark, flat(900, exposure_s=0.4))
    np.testing.assert_allclose(made.values, 1.0, rtol=1e-6)


def test_bands_and_channels_have_their_own_white_reflectance():
    cube = flat_field(
        flat(50, shape=(2, 3, 2)), None, flat(100, shape=(1, 3, 2)), board=WhiteBoard([0.9, 0.8])
    )
    np.testing.assert_allclose(cube.values[1, 2], [0.45, 0.4], rtol=1e-6)
    mosaic = flat_field(flat(50), None, flat(100), board=WhiteBoard([0.9, 0.8, 0.6], "GBRG"))
    np.testing.assert_allclose(mosaic.values[:2, :2], [[0.45, 0.4], [0.3, 0.45]], rtol=1e-6)


def test_without_a_white_it_is_counts_above_dark():
    made = flat_field(flat(300), flat(100), noise=NoiseModel(0.5, 4.0))
    assert made.quantity == "counts"
    np.testing.assert_allclose(made.values, 200)
    # read² + gain · 200 of the shot, read² of the one dark
    np.testing.assert_allclose(made.variance, 4 + 0.5 * 200 + 4)


def test_without_a_dark_the_black_level_goes():
    assert flat_field(flat(300), None, flat(900), black=100.0).values[0, 0] == pytest.approx(0.25)


def test_variance_by_hand_with_a_shared_dark():
    # r = 0.25; [vS + r² vW/2 + (1 − r)² vD/4]/800², vS = 2 + 0.1·200, vW = 2 + 0.1·800, vD = 2.
    # The counts of 4 and 2 shots that agree weigh 3 and 1 against 60 of the model.
    white, dark = average([np.full((2, 2), 900)] * 2), average([np.full((2, 2), 100)] * 4)
    made = flat_field(flat(300, shape=(2, 2)), dark, white, noise=NoiseModel(0.1, 2.0))
    v_white, v_dark = 82 * 60 / 61 / 2, 2 * 60 / 63 / 4
    expected = (22 + 0.25**2 * v_white + 0.75**2 * v_dark) / 800**2
    np.testing.assert_allclose(made.variance, expected, rtol=1e-6)


def test_noise_that_is_not_known_is_not_invented():
    assert flat_field(flat(300), flat(100), flat(900)).variance is None


def test_sigma_is_honest(sensor):
    # A ramp of reflectance 0.02–0.95, averages of 2, 3 and 5: (r − truth)/u must be normal.
    rng = np.random.default_rng(7)
    truth = np.linspace(0.02, 0.95, 400) * np.ones((150, 1))
    shot, white, dark = (
        average(sensor.shots(level, n, rng))
        for level, n in ((truth * sensor.white, 2), (0 * truth + sensor.white, 3), (0 * truth, 5))
    )
    noise = fit_noise([shot, white, dark], [dark])
    made = flat_field(shot, dark, white, noise=noise)
    z = (made.values - truth) / np.sqrt(made.variance)
    assert 0.98 < z.std() < 1.02
    assert 0.94 < np.mean(np.abs(z) < 1.96) < 0.96
    assert abs(z.mean()) < 0.02


def test_flags_follow_object_and_white():
    clear = np.zeros((1, 4), bool)
    mark = [np.arange(4)[None] == i for i in range(4)]
    shot = Template(np.full((1, 4), 50, np.float32), None, 1, mark[0], mark[1], None)
    white = Template(np.array([[90, 90, 90, 5]], np.float32), None, 1, mark[2], clear, None)
    made = flat_field(shot, average([np.full((1, 4), 5.0)]), white)
    assert made.flags.tolist() == [[Flag.SATURATED, Flag.BLACK, Flag.SATURATED, Flag.DEFECT]]
    assert np.isnan(made.values[0, 3])
    assert np.isfinite(made.values[0, :3]).all()


def test_the_channel_that_has_no_white_is_named():
    lit = np.full((40, 40), 900, np.float32)
    lit[1::2, ::2] = 60
    with pytest.raises(CalibrationRefused, match="in R") as refused:
        flat_field(
            flat(90, shape=(40, 40)),
            flat(64, shape=(40, 40)),
            average([lit]),
            board=WhiteBoard(pattern="GBRG"),
        )
    assert refused.value.problems[0].code == "E_WHITE_DARK"


@pytest.mark.parametrize(
    ("times", "black"),
    [
        ((1.0, 1.0, 1.0), None),
        ((1.0, 1.0, 1.0), 64.0),
        ((2.0, 1.0, 1.0), 64.0),
        ((2.0, 1.0, 4.0), 64.0),
        ((3.0, 1.0, 5.0), None),
        ((3.0, 1.0, 5.0), 64.0),
    ],
)
@pytest.mark.parametrize("reflectance", [0.1, 1.8])
def test_darks_that_object_and_white_share_are_not_independent(times, black, reflectance):
    """Noise of the dark rules; exposures of object, dark and white, the last of two darks where it is 5 s."""
    rng, shape = np.random.default_rng(4), (150, 200)
    of_object, of_dark, of_white = times
    dark_times = [of_dark] if of_white < 5 else [of_dark, 2 * of_dark]

    def shot(level, time):
        return average(
            [rng.normal(64 + level * time, 5, shape).astype(np.float32)], exposure_s=time
        )

    darks = [shot(10.0, t) for t in dark_times]
    panel, white = shot(10.0 + 300 * reflectance, of_object), shot(310.0, of_white)
    made = flat_field(panel, darks, white, black=black, noise=NoiseModel(0.0, 25.0))
    miss = (made.values - reflectance) / np.sqrt(made.variance)
    assert miss.std() == pytest.approx(1, abs=0.03)

import numpy as np
import pytest

from levkas.calibration.templates import CalibrationRefused, average


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, np.float32, ">u2"])
def test_mean_and_variance_are_those_of_numpy(kind):
    shots = np.random.default_rng(0).integers(0, 200, (7, 12, 11)).astype(kind)
    template = average(shots)
    np.testing.assert_allclose(template.mean, shots.astype(float).mean(0), rtol=1e-6)
    np.testing.assert_allclose(template.variance, shots.astype(float).var(0, ddof=1), rtol=1e-5)
    assert template.mean.dtype == template.variance.dtype == np.float32
    assert template.count == 7


def test_five_shots_with_one_clipped_are_flagged_though_their_mean_is_not():
    shots = [np.full((2, 2), 4000, np.uint16) for _ in range(5)]
    shots[3][0, 1] = 4095
    template = average(shots, saturation=4095)
    assert template.mean[0, 1] < 4095
    assert template.saturated.tolist() == [[False, True], [False, False]]


def test_large_codes_keep_their_variance():
    # Σx² in single precision would lose it: 65000² needs 33 bits.
    shots = [np.full((1, 1), value, np.uint16) for value in (65000, 65002) * 25]
    assert average(shots).variance[0, 0] == pytest.approx(50 / 49, rel=1e-6)


def test_a_reused_buffer_is_not_mistaken_for_the_first_shot():
    buffer = np.empty((1, 1), np.uint16)

    def shots():
        for value in (10, 20, 30):
            buffer[:] = value
            yield buffer

    assert average(shots()).mean[0, 0] == 20


def test_shots_of_other_shapes_are_refused_by_index():
    with pytest.raises(CalibrationRefused) as refused:
        average([np.zeros((2, 2), np.uint16)] * 2 + [np.zeros((2, 3), np.uint16)])
    assert refused.value.problems[0].code == "E_SIZE"

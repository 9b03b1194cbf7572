import numpy as np
import pytest

from levkas.calibration.flatfield import Calibrated
from levkas.calibration.pushbroom import average_lines, join_strips
from levkas.calibration.templates import CalibrationRefused
from levkas.core.cube import Flag


def scene(height=120, width=150):
    rng = np.random.default_rng(0)
    rough = rng.random((height // 6, width // 6, 3))
    return np.kron(rough, np.ones((6, 6, 1)))[:height, :width].astype(np.float32) + 0.1


def strip(values):
    values = np.ascontiguousarray(values, np.float32)
    noise = np.full(values.shape, 0.01, np.float32)
    return Calibrated(values, np.zeros(values.shape, np.uint8), noise, "reflectance")


def test_lines_are_averaged_whatever_the_blocks():
    scan = np.random.default_rng(1).integers(0, 4096, (30, 7, 5)).astype(np.uint16)
    whole = average_lines([scan], saturation=4095)
    parts = average_lines([scan[:11], scan[11:12], scan[12:]], saturation=4095)
    assert whole.mean.shape == (1, 7, 5)
    assert whole.count == 30
    assert whole.mean.tobytes() == parts.mean.tobytes()
    np.testing.assert_allclose(whole.mean[0], scan.mean(0), rtol=1e-6)


@pytest.mark.parametrize("blend", [False, True])
def test_overlapping_strips_join_to_the_scene(blend):
    picture = scene()
    parts = [strip(picture[:, :60]), strip(picture[:, 43:110]), strip(picture[:, 90:])]
    joined, seams = join_strips(parts, blend=blend)
    assert [(s.overlap, s.shift) for s in seams] == [(17, 0), (20, 0)]
    np.testing.assert_allclose(joined.values, picture, rtol=1e-6)
    assert not joined.flags.any()
    assert all(np.abs(s.difference).max() < 1e-6 for s in seams)


def test_a_strip_that_starts_later_is_put_in_its_place():
    picture = scene()
    joined, (seam,) = join_strips([strip(picture[:110, :80]), strip(picture[7:, 60:])])
    assert (seam.overlap, seam.shift) == (20, 7)
    assert joined.values.shape == (110, 150, 3)
    np.testing.assert_array_equal(joined.values[7:], picture[7:110])
    assert np.all(joined.flags[:7, 75:] == Flag.OUTSIDE)
    assert np.isnan(joined.values[:7, 75:]).all()


def test_the_difference_at_a_seam_is_reported_not_hidden():
    picture = scene()
    joined, (seam,) = join_strips([strip(picture[:, :80]), strip(picture[:, 60:] * 1.1)])
    np.testing.assert_allclose(seam.difference, 0.1, atol=1e-5)
    assert seam.rms == pytest.approx(0.1, rel=0.1)
    np.testing.assert_allclose(joined.values[:, 70:] / picture[:, 70:], 1.1, rtol=1e-5)


def test_blending_weighs_variance_by_squares():
    picture = scene()
    parts = [strip(picture[:, :80]), strip(picture[:, 59:])]
    joined, _ = join_strips(parts, overlaps=[21], blend=True)
    # In the middle of the overlap both weigh a half: 0.01 · (¼ + ¼).
    assert joined.variance[0, 69, 0] == pytest.approx(0.005)


def test_strips_that_do_not_meet_are_refused():
    rng = np.random.default_rng(2)
    parts = [strip(rng.random((60, 40, 2))), strip(rng.random((60, 40, 2)))]
    with pytest.raises(CalibrationRefused, match="strips 0 and 1 cannot be joined"):
        join_strips(parts)


def test_strips_of_other_bands_are_refused():
    with pytest.raises(CalibrationRefused) as refused:
        join_strips([strip(np.ones((9, 20, 2))), strip(np.ones((9, 20, 3)))])
    assert refused.value.problems[0].code == "E_SIZE"

import numpy as np

from levkas.calibration.pushbroom import average_lines


def test_lines_are_averaged_whatever_the_blocks():
    scan = np.random.default_rng(1).integers(0, 4096, (30, 7, 5)).astype(np.uint16)
    whole = average_lines([scan], saturation=4095)
    parts = average_lines([scan[:11], scan[11:12], scan[12:]], saturation=4095)
    assert whole.mean.shape == (1, 7, 5)
    assert whole.count == 30
    assert whole.mean.tobytes() == parts.mean.tobytes()
    np.testing.assert_allclose(whole.mean[0], scan.mean(0), rtol=1e-6)

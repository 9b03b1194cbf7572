"""Digits that are kept of values and of their sigma."""

import numpy as np

from levkas.core.rounding import round_root, round_sigma


def test_sigma_is_right_to_four_thousandths():
    sigma = np.geomspace(1e-4, 1e3, 5000).astype(np.float32)
    for found in (round_sigma(sigma), round_root(np.square(sigma))):
        assert np.max(np.abs(found / sigma - 1)) <= 1 / 2**8 + 1e-6

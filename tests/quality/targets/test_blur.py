import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from levkas.quality.targets.patches import find_preblur


def test_white_noise_is_never_taken_for_blur():
    # A thousand in full were tried once: none. Here two hundred.
    rng = np.random.default_rng(1)
    alarms = [find_preblur(rng.standard_normal((4, 25, 25))[i]).found for i in [0] * 200]
    pooled = [find_preblur(list(rng.standard_normal((4, 25, 25)))).found for _ in range(200)]
    assert not any(alarms) and not any(pooled)


@pytest.mark.parametrize("side", [3, 5])
def test_a_box_is_found_and_its_gain_recovered(side):
    rng = np.random.default_rng(2)
    found = find_preblur(uniform_filter(rng.standard_normal((600, 600)), side))
    assert found.found
    assert found.factor == pytest.approx(side, rel=0.02)
    assert found.decibels == pytest.approx(10 * np.log10(side), abs=0.1)


def test_what_a_fitted_plane_takes_is_put_back():
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:30, :30]
    basis = np.column_stack([np.ones(900), x.ravel(), y.ravel()])
    areas = []
    for _ in range(24):
        area = uniform_filter(rng.standard_normal((40, 40)), 3)[5:35, 5:35].ravel()
        left = area - basis @ np.linalg.lstsq(basis, area, rcond=None)[0]
        areas.append(left.reshape(30, 30))
    assert find_preblur(areas, fitted=3).factor == pytest.approx(3, rel=0.08)

"""Changes of a painting: found where they are, and no more false alarms than are stated."""

import numpy as np
import pytest
from scipy import ndimage

from levkas.quality.evaluation.change import apparent_place, find_changes

SHAPE = (160, 200, 6)


def noise(seed, share=0.0, sigma=0.005):
    """Noise of a difference: of each band, smoothed by resampling, and a share that all bands have in common."""
    rng = np.random.default_rng(seed)
    own = rng.standard_normal(SHAPE)
    own = ndimage.uniform_filter(own, (2, 2, 1)) * 2
    common = ndimage.gaussian_filter(rng.standard_normal(SHAPE[:2]), 0.8)[..., None]
    common = common / common.std()
    return sigma * (np.sqrt(1 - share) * own + np.sqrt(share) * common)


KNOWN = np.ones(SHAPE[:2], bool)
VARIANCE = np.full(SHAPE, 0.005**2)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_false_alarms_are_as_many_as_stated(share):
    found = [find_changes(noise(k, share), VARIANCE, KNOWN, rate=0.01).share for k in range(12)]
    assert 0.006 < np.mean(found) < 0.012, np.mean(found)


def test_a_hundredth_of_reflectance_over_five_pixels_is_found_where_it_is():
    apart = noise(3)
    apart[70:75, 110:115] += 0.01
    found = find_changes(apart, VARIANCE, KNOWN, rate=0.001)
    assert found.mask[70:75, 110:115].mean() > 0.9
    x, y, width, height, size = found.areas[0]
    assert 104 <= x <= 110 and 64 <= y <= 70 and width <= 14 and height <= 14
    assert size == pytest.approx(0.01, abs=0.008)


def test_a_painting_of_which_a_tenth_changed_hides_it_not():
    apart = noise(4)
    apart[:50, :64] += 0.03
    found = find_changes(apart, VARIANCE, KNOWN)
    assert found.mask[:50, :64].mean() > 0.98 and found.mask[70:].mean() < 0.02


def test_what_the_uncertainties_allow_is_no_change_and_few_pixels_say_nothing():
    assert not find_changes(0.01 * noise(5), VARIANCE, KNOWN).mask.any()
    few = np.zeros_like(KNOWN)
    few[:5, :5] = True
    assert not find_changes(noise(6) + 1, VARIANCE, few).mask.any()


def test_edges_that_a_registration_misses_are_no_changes():
    """A picture and itself 0.2 px beside it: edges differ by more than the noise."""
    rng = np.random.default_rng(7)
    areas = ndimage.gaussian_filter(rng.standard_normal(SHAPE[:2]), 6)
    paints = np.array([0.7, 0.1, 0.6, 0.2])[np.digitize(areas, [-0.03, 0, 0.03])]
    tones = ndimage.gaussian_filter(paints, 0.8)
    beside = ndimage.shift(tones, (0.14, 0.14), order=3, mode="nearest")
    apart = noise(8) + (beside - tones)[..., None]
    slopes = sum(np.square(np.gradient(tones, axis=axis)) for axis in (0, 1))
    steepness = np.broadcast_to(slopes[..., None], SHAPE)
    assert find_changes(apart, VARIANCE, KNOWN).share > 0.015
    place = apparent_place(apart, VARIANCE, steepness, KNOWN)
    assert place**0.5 == pytest.approx(0.17, abs=0.06)
    assert find_changes(apart, VARIANCE + place * steepness, KNOWN).share < 0.011
    assert apparent_place(noise(9), VARIANCE, steepness, KNOWN) < 0.02**2

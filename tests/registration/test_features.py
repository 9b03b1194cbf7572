"""Key points lie where they are, in an order of their own; matching is exact and one to one."""

import numpy as np
import pytest
from scipy import ndimage

from levkas.registration.features import DETECTORS, KeyPoints, find_key_points
from levkas.registration.matching import MATCHERS, find_neighbours, match


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(3)
    texture = sum(ndimage.gaussian_filter(rng.normal(0, 1, (480, 640)), s) * s for s in (1, 2, 5))
    return texture.astype(np.float32)


def picture(values):
    return np.clip(127 + 60 * values / values.std(), 0, 255).astype(np.uint8)


def everywhere(image):
    return np.ones(image.shape, bool)


def test_matches_have_no_bias_between_pictures_of_different_scale(scene):
    # Half-size by exact 2 x 2 means: x' = (x + 0.5) / 2 - 0.5. OpenCV's default is 0.13 px off.
    small = scene.reshape(240, 2, 320, 2).mean((1, 3))
    a, b = picture(scene), picture(small)
    one, two = find_key_points(a, everywhere(a)), find_key_points(b, everywhere(b))
    rows, columns, _ = match(one, two, ratio=0.8)
    miss = (two.points[columns] + 0.5) * 2 - 0.5 - one.points[rows]
    good = np.hypot(*miss.T) < 2
    assert good.sum() > 100
    assert np.abs(np.median(miss[good], 0)).max() < 0.05


def test_no_key_point_stands_on_what_is_invalid(scene):
    image, valid = picture(scene), np.ones(scene.shape, bool)
    valid[:, 300:340] = False
    x = find_key_points(image, valid).points[:, 0]
    assert not np.any((x > 298) & (x < 341))


@pytest.mark.slow
@pytest.mark.parametrize("detector", sorted(DETECTORS))
def test_every_detector_matches_a_shifted_picture(scene, detector):
    a, b = picture(scene)[:-8, :-12], picture(scene)[8:, 12:]
    one = find_key_points(a, everywhere(a), detector=detector)
    two = find_key_points(b, everywhere(b), detector=detector)
    rows, columns, _ = match(one, two)
    miss = np.hypot(*(one.points[rows] - two.points[columns] - (12, 8)).T)
    # ORB places its points on pixels of a pyramid, up to 1.2^7 = 3.6 px apart.
    assert len(rows) > 50 and (miss < (3 if detector == "orb" else 1)).mean() > 0.9
    assert np.median(miss) < 0.5


def whole(rng, n, d=16):
    return rng.integers(0, 40, (n, d)).astype(np.float32)


def key_points(descriptors, points=None):
    n = len(descriptors)
    points = np.stack([np.arange(n), np.zeros(n)], 1).astype(float) if points is None else points
    zero = np.zeros(n)
    return KeyPoints(points, zero, zero, zero, descriptors)


def test_neighbours_are_those_of_all_distances():
    rng = np.random.default_rng(1)
    a, b = whole(rng, 1500), whole(rng, 700)
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    found = find_neighbours(a, b)
    np.testing.assert_allclose(found.distance, distance.min(1), rtol=1e-6)
    np.testing.assert_allclose(found.second, np.sort(distance, 1)[:, 1], rtol=1e-6)
    np.testing.assert_array_equal(found.nearest, distance.argmin(1))
    np.testing.assert_array_equal(found.back, distance.argmin(0))


@pytest.mark.parametrize("matching", sorted(MATCHERS))
def test_no_place_is_used_twice(matching):
    rng = np.random.default_rng(4)
    a, b = whole(rng, 200), whole(rng, 150)
    places = rng.integers(0, 60, (200, 1)) * np.ones(2)
    one, two = key_points(a, places), key_points(b)
    rows, columns, _ = match(one, two, matching=matching, ratio=1.0)
    assert len(rows) > 10
    assert len(np.unique(places[rows], axis=0)) == len(rows) == len(np.unique(columns))

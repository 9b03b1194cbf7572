import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.geometry import from_dict
from levkas.geometry.transforms import (
    Affine,
    Composed,
    Homography,
    Inverse,
    Lens,
    Polynomial,
    Transform,
)

GRID = np.stack(np.meshgrid(np.linspace(0, 1391, 9), np.linspace(0, 1039, 7)), -1).reshape(-1, 2)


def bent(points):
    u, v = ((points - [700, 500]) / 700).T
    wave = np.stack([3 * u**3 + 2 * u * v, 4 * v**2 - u * v * v], 1)
    return points @ np.array([[1.6, 0.05], [-0.04, 1.58]]) + [12.0, -7.0] + wave


TRANSFORMS = [
    Affine(np.array([[1.6, 0.05, 3], [-0.04, 1.58, -7]])),
    Homography(np.array([[1.6, 0.05, 3], [-0.04, 1.58, -7], [1e-5, -2e-5, 1]])),
    Polynomial.fit(GRID, bent(GRID), order=3),
    Lens(np.array([690.0, 520.0]), 800.0, (0.02, -0.003), (1e-3, -5e-4)),
    Composed(Affine.scaling(0.5), Lens(np.array([350.0, 250.0]), 400.0, (0.01, 0.0))),
    Inverse(Polynomial.fit(GRID, bent(GRID), order=3)),
]
NAMES = [type(t).__name__ for t in TRANSFORMS]


@pytest.mark.parametrize("transform", TRANSFORMS, ids=NAMES)
def test_inverse_after_forward_is_where_we_started(transform):
    assert isinstance(transform, Transform)
    assert np.abs(transform.inverse(transform(GRID)) - GRID).max() < 1e-6


@pytest.mark.parametrize("transform", TRANSFORMS, ids=NAMES)
def test_jacobian_is_the_slope_of_the_map(transform):
    step = 1e-3
    for axis in (0, 1):
        shift = np.eye(2)[axis] * step
        slope = (transform(GRID + shift) - transform(GRID - shift)) / (2 * step)
        assert np.allclose(transform.jacobian(GRID)[:, :, axis], slope, atol=1e-6)


@pytest.mark.parametrize("transform", TRANSFORMS, ids=NAMES)
def test_what_is_stored_is_what_is_read(transform):
    read = from_dict(json.loads(json.dumps(transform.to_dict())))
    assert np.array_equal(read(GRID), transform(GRID))


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_a_polynomial_fit_is_exact_on_its_own_family(order, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform([0, 0], [1391, 1039], (40, 2))
    terms = (order + 1) * (order + 2) // 2
    true = Polynomial(order, np.array([700.0, 500.0]), 700.0, rng.normal(0, 50, (terms, 2)))
    fitted = Polynomial.fit(points, true(points), order=order)
    assert np.allclose(fitted(points), true(points), atol=1e-6)


def test_too_few_points_for_the_terms_are_refused():
    with pytest.raises(ValueError):
        Polynomial.fit(GRID[:6], GRID[:6], order=3)


def test_a_point_past_the_fold_of_a_lens_has_no_inverse():
    lens = Lens(np.zeros(2), 100.0, (-0.3, 0.0))
    assert np.isnan(lens.inverse(np.array([[400.0, 0.0]]))).all()


def test_a_scaling_keeps_the_corner_of_the_first_pixel():
    moved = Affine.scaling(2.0, 3.0)(np.array([[-0.5, -0.5], [0.0, 0.0]]))
    np.testing.assert_allclose(moved, [[-0.5, -0.5], [0.5, 1.0]])

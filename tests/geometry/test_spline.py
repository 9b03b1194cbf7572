import numpy as np

from levkas.geometry import from_dict
from levkas.geometry.spline import SplineShift

RNG = np.random.default_rng(5)
SPLINE = SplineShift(np.array([12.0, 9.0]), 16.0, RNG.normal(0, 1.5, (7, 8, 2)))
POINTS = RNG.uniform(-40, 140, (400, 2))


def test_the_jacobian_is_the_slope_inside_and_beyond_the_lattice():
    step = 1e-4
    for axis in (0, 1):
        shift = np.eye(2)[axis] * step
        slope = (SPLINE(POINTS + shift) - SPLINE(POINTS - shift)) / (2 * step)
        assert np.allclose(SPLINE.jacobian(POINTS)[:, :, axis], slope, atol=1e-5)


def test_the_displacement_has_no_kink_at_its_rim():
    for x in (12.0, 12.0 + 5 * 16.0):
        sides = np.array([[x - 1e-6, 40.0], [x + 1e-6, 40.0]])
        before, after = SPLINE.jacobian(sides)
        assert np.allclose(before, after, atol=1e-5)


def test_inverse_after_forward_is_where_we_started():
    gentle = SplineShift(SPLINE.origin, SPLINE.spacing, SPLINE.coefficients * 0.1)
    assert np.abs(gentle.inverse(gentle(POINTS)) - POINTS).max() < 1e-6


def test_a_record_of_a_spline_along_lines_alone_has_each_line_once():
    course = RNG.normal(0, 1, (30, 1, 2))
    for lattice in (course.repeat(4, 1), course.transpose(1, 0, 2).repeat(4, 0)):
        spline = SplineShift(np.array([3.0, -2.0]), 2.5, lattice)
        record = spline.to_dict()
        assert np.size(record["coefficients"]) == 60
        places = RNG.uniform(-5, 80, (40, 2))
        assert np.array_equal(from_dict(record)(places), spline(places))

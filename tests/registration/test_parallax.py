import numpy as np
import pytest

from levkas.geometry import from_dict
from levkas.geometry.depth_step import DepthStepShift
from levkas.geometry.transforms import Composed, Homography, Lens
from levkas.registration.depth_step import DepthStep, find_depth_step
from levkas.registration.model_selection import LENS, SelectionTerms, select_model
from levkas.registration.models import Observations, fit_projective
from levkas.registration.parallax import fit_parallax

CELL, NOISE = 12.0, 0.02
BORDER, WIDE, DEEP = 70.0, 20.0, -3.0


class View:
    """A pinhole camera with a lens before a panel of 700 x 500 mm that bends, twists and is lowered in its centre."""

    def __init__(self, place, lens=(0.0, 0.0), *, deep=DEEP, bent=1 / 8000):
        self.place, self.lens, self.deep, self.bent = np.array(place, float), lens, deep, bent

    def height(self, s, t):
        edges = np.stack([s - BORDER, 700 - BORDER - s, t - BORDER, 500 - BORDER - t])
        rise = np.clip(edges / WIDE, 0, 1)
        inside = (rise**3 * (rise * (6 * rise - 15) + 10)).prod(0)
        return self.bent * (t - 250) ** 2 + 4e-6 * (s - 350) * (t - 250) + self.deep * inside

    def __call__(self, panel):
        s, t = panel.T
        x, y, z = self.place
        u, v = np.stack([s - 350 - x, t - 250 - y]) / (z - self.height(s, t))
        k1, k2 = self.lens
        r2 = u * u + v * v
        return 1800 * (np.stack([u, v]) * (1 + k1 * r2 + k2 * r2 * r2)).T + 400


def observed(one, other, step=CELL, noise=NOISE, seed=0):
    """What two cameras observe of places on the panel: the first one's px are the reference's."""
    s, t = np.meshgrid(np.arange(10, 695, step), np.arange(10, 495, step))
    panel = np.stack([s, t], -1).reshape(-1, 2)
    points = one(panel)
    target = other(panel) + noise * np.random.default_rng(seed).standard_normal(panel.shape)
    eye = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    return Observations(points, target, eye, eye / NOISE**2)


def error(model, one, other):
    dense = observed(one, other, 7.0, 0.0)
    return np.linalg.norm(model(dense.points) - dense.target, axis=1)


def test_two_cameras_of_a_warped_panel_are_mapped_where_a_homography_with_a_lens_is_not():
    one, other = View((0, 0, 1800), deep=0.0), View((60, -25, 1750), (0.01, 0.02), deep=0.0)
    windows = observed(one, other)
    plane, warped = fit_projective(windows, lens=True), fit_parallax(windows)
    assert error(plane, one, other).mean() > 0.02
    assert error(warped, one, other).mean() < 0.005


def test_a_lowered_centre_is_one_more_height_along_the_same_direction():
    one, other = View((0, 0, 1800)), View((60, -25, 1750), (0.01, 0.02))
    windows = observed(one, other)
    # As the first camera sees the ledge: its slope begins and ends on the border and in the centre.
    centre = one(np.array([[350.0, 250.0]]))[0]
    begins = one(np.array([[BORDER, BORDER], [700 - BORDER, 500 - BORDER]])) - centre
    edges = [begins[0, 0], begins[1, 0], begins[0, 1], begins[1, 1], WIDE, 0.0]
    step = DepthStep(np.array(edges), centre, 350.0, 1e-3)
    with_it, without = fit_parallax(windows, step), fit_parallax(windows)
    assert error(with_it, one, other).mean() < 0.3 * error(without, one, other).mean()
    assert error(with_it, one, other).mean() < 0.006
    shift = with_it.steps[0].shift
    # The centre lies 3 mm deeper; the baseline is 60 and -25 mm at 1.8 m: 1800 px · 3 mm · 60 mm / (1.8 m)².
    assert isinstance(with_it.steps[0], DepthStepShift)
    assert shift[0] == pytest.approx([0.1, -0.042], abs=0.02)


def test_a_plane_is_mapped_as_by_a_homography_with_a_lens():
    one = View((0, 0, 1800), deep=0.0, bent=0.0)
    truth = Composed(
        Homography(np.array([[1.1, 0.02, 5], [-0.01, 1.08, 3], [1e-5, 2e-5, 1]])),
        Lens(np.array([450.0, 420]), 400.0, (0.004, 0.001), (1e-4, -2e-4)),
    )
    points = observed(one, one).points
    eye = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    fitted = fit_parallax(Observations(points, truth(points), truth.jacobian(points), 2500 * eye))
    assert (
        np.abs(fitted(points) - truth(points)).max() < 0.005
    )  # a quarter of the noise under which it was fitted
    again = from_dict(fitted.to_dict())
    assert np.allclose(again(points), fitted(points), atol=1e-9)


def test_the_ladder_takes_parallax_for_a_warped_and_lowered_panel_and_a_lens_for_an_even_one():
    one, other = View((0, 0, 1800)), View((60, -25, 1750), (0.01, 0.02))
    windows = observed(one, other)
    assert find_depth_step(windows, CELL) is not None
    terms = SelectionTerms(120, apart=2 * CELL, cell=CELL, depth_step=True)
    selected = select_model(windows, terms)
    assert selected.name == "parallax+depth_step"
    assert error(selected.transform, one, other).mean() < 0.01
    flat, beside = (
        View((0, 0, 1800), deep=0.0, bent=0.0),
        View((60, -25, 1750), (0.01, 0.02), deep=0.0, bent=0.0),
    )
    assert select_model(observed(flat, beside), terms).spec == LENS

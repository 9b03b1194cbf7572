"""Sigma of position: what it adds up, that it holds, and that it is there for who asks."""

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.registration.chromatic import ChromaticShifts, zero_displacement
from levkas.registration.model_selection import SelectionTerms, select_model
from levkas.registration.models import Observations
from levkas.registration.record import Sigma
from levkas.registration.uncertainty import measure_sigma


def test_a_band_that_was_only_shifted_is_known_alike_everywhere():
    fields = ChromaticShifts(
        "shift", np.array([50.0, 40]), 50.0, np.zeros((2, 2)), np.full((2, 2), 0.01)
    )
    sigma = measure_sigma((80, 100), ["a", "b"], fields)["a"]
    # 1.4 times the standard deviation of the shift along either axis, 0.1 px.
    np.testing.assert_allclose(sigma.values, 1.4 * 0.1, atol=1e-4)


def test_sigma_at_the_rim_is_that_of_the_object_and_not_of_what_lies_beside_it():
    rng, view = np.random.default_rng(3), Affine(np.array([[1.1, 0.02, 4], [-0.01, 1.1, 7]]))
    x, y = np.meshgrid(np.arange(118, 283, 12.0), np.arange(118, 223, 12.0))
    points = np.stack([x, y], -1).reshape(-1, 2)
    target = view(points) + 0.05 * rng.standard_normal(points.shape)
    information = np.broadcast_to(np.eye(2) / 0.05**2, (len(points), 2, 2))
    windows = Observations(points, target, view.jacobian(points), information)
    selected = select_model(windows, SelectionTerms(spacing=48, apart=24.0))
    still = zero_displacement(1, np.array([200.0, 170]), 200.0)
    sigma = measure_sigma((340, 400), ["a"], still, selected)["a"]
    # The object ends 18 px from the last windows' middles, the frame of the picture 100 px farther out.
    at_rim, frame = np.array([[100.0, 170]]), np.array([[0.0, 170]])
    known = 1.4 * np.sqrt(
        (selected.sigma(at_rim)[0] ** 2 + np.median(selected.sigma(points)) ** 2) / 2
    )
    assert sigma(at_rim)[0] == pytest.approx(known, rel=0.25)
    assert sigma(frame)[0] < 2 * sigma(at_rim)[0]


def test_what_is_not_known_of_the_reference_is_not_known_of_what_it_predicts():
    base = measure_sigma((80, 100), ["a"], zero_displacement(1, np.array([50.0, 40]), 50.0))["a"]
    known = {"r": Sigma(base.x, base.y, np.full(base.values.shape, 0.03))}
    sigma = measure_sigma(
        (80, 100), ["a"], zero_displacement(1, np.array([50.0, 40]), 50.0), None, known
    )["a"]
    np.testing.assert_allclose(sigma.values, 0.03)

"""Maps fitted to a person's pairs alone, and what those leave of an error."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.geometry.transforms import Affine, Homography, solve_2x2
from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.manual_points import ManualPoints
from levkas.registration.placed_by_hand import place_by_hand

SHAPE = (700, 900)
NINE_OF_TEN = 2.146  # radius of nine of ten errors, in sigmas of one axis


def camera(rng, tilt, mirrored=False):
    """A plane seen by a camera that is turned, shifted, and tilted so that scale varies by `tilt` over the frame."""
    matrix, angle, scale = np.eye(3), rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix[:2, :2] = scale * turn @ np.diag([-1.0 if mirrored else 1.0, 1.0])
    matrix[2, :2] = tilt * np.array([0.6, -0.8]) / SHAPE[1]
    centre = np.eye(3)
    centre[:2, 2] = -SHAPE[1] / 2, -SHAPE[0] / 2
    whole = matrix @ centre
    return Homography(whole / whole[2, 2])


def pointed(rng, view, n, noise):
    corners = np.array([[60.0, 60], [840, 70], [830, 640], [70, 630]])
    places = np.concatenate([corners, rng.uniform((60, 60), (840, 640), (n - 4, 2))])
    return np.hstack([places, view(places) + rng.normal(0, noise, places.shape)])


def test_each_map_is_recovered_from_exact_pairs_mirrored_or_not():
    rng = np.random.default_rng(1)
    for tilt, mirrored in ((0.0, False), (0.2, False), (0.0, True), (0.2, True)):
        view = camera(rng, tilt, mirrored)
        placed = place_by_hand(ManualPoints(added=pointed(rng, view, 8, 0)), SHAPE)
        points = rng.uniform((0, 0), SHAPE[::-1], (50, 2))
        assert np.abs(placed.transform(points) - view(points)).max() < 1e-5
        assert placed.is_mirrored == mirrored
        assert placed.model == ("homography" if tilt else "similarity")


def test_residuals_without_a_pair_are_those_of_a_fit_without_it():
    rng = np.random.default_rng(2)
    rows = pointed(rng, camera(rng, 0.0), 9, 1.0)
    whole = place_by_hand(ManualPoints(added=rows), SHAPE)
    assert whole.model == "affine"
    for left in range(9):
        rest = Affine.fit(*np.hsplit(np.delete(rows, left, 0), 2))
        p, q = rows[left : left + 1, :2], rows[left : left + 1, 2:]
        missed = solve_2x2(whole.transform.jacobian(p), q - rest(p))
        assert whole.leave_one_out[left] == pytest.approx(np.linalg.norm(missed))


def test_sigma_holds_nine_of_ten_errors_of_hands_that_shake():
    """Over tilted and level cameras, 5 to 12 pairs, 0.8 px of noise: truth in the 90 % circle, 80 to 97 %."""
    rng, inside = np.random.default_rng(3), []
    for _ in range(60):
        view = camera(rng, rng.choice([0.0, 0.02, 0.1]))
        rows = pointed(rng, view, int(rng.integers(5, 13)), 0.8)
        placed = place_by_hand(ManualPoints(added=rows), SHAPE)
        points = rng.uniform((0, 0), SHAPE[::-1], (40, 2))
        apart = solve_2x2(view.jacobian(points), placed.transform(points) - view(points))
        sigma = placed.sigma(SHAPE)(points)
        inside.append((np.linalg.norm(apart, axis=1) < NINE_OF_TEN * sigma).mean())
    assert 0.8 < np.mean(inside) < 0.97


ON_A_LINE = np.linspace(0, 500, 6)[:, None] * [1, 1, 1, 2]


@pytest.mark.parametrize("rows", [np.zeros((0, 4)), np.eye(4)[:3] * 500, ON_A_LINE])
def test_pairs_that_determine_no_map_are_refused(rows):
    with pytest.raises(RegistrationRefused) as refused:
        place_by_hand(ManualPoints(added=rows, accepted=True), SHAPE)
    assert refused.value.problems[0].code == "E_MATCHES"


@pytest.mark.parametrize("method", ["levkas", "mirhashemi2019"])
def test_accepted_pairs_place_the_sensor_whatever_the_method(method):
    rng = np.random.default_rng(8)
    reference, blank = rng.random((80, 100)), np.full((90, 120), 0.5)
    rows = np.array([[5.0, 5, 10, 8], [90, 6, 95, 9], [92, 70, 97, 73], [6, 72, 11, 75]])
    given = {"": ManualPoints(added=rows, deleted=rows[:1] + 20, accepted=True)}
    found = register(reference, blank, method=method, given=given)
    assert found.verdict.decision == "by hand" and found.method == "by hand"
    assert found.transforms["1"](np.array([[50.0, 40]])) == pytest.approx(
        np.array([[55.0, 43.0]]), abs=0.01
    )
    assert found.matches.kept.sum() == 4 and len(found.matches) == 5
    assert set(found.matches.reason.tolist()) == {"added by hand", "deleted by hand"}
    assert found.sigma["1"](np.array([[50.0, 40]]))[0] > 0.1


def test_of_two_sensors_one_is_placed_by_hand_and_the_other_by_its_picture():
    from scipy.ndimage import gaussian_filter

    scene = gaussian_filter(np.random.default_rng(9).random((220, 260)), 2)
    first = BandImage.of("grey", scene[10:210, 10:250])
    second = BandImage.of("blank", np.full((100, 120), 0.5))
    sensors = [replace(first, sensor="a"), replace(second, sensor="b")]
    rows = np.array(
        [[20.0, 20, 10, 10], [220, 20, 110, 10], [220, 190, 110, 95], [20, 190, 10, 95]]
    )
    given = {"b": ManualPoints(added=rows, accepted=True)}
    found = register(scene, sensors, given=given)
    assert found.verdict.decision == "by hand" and found.method == "levkas"
    middle = np.array([[100.0, 100]])
    assert found.transforms["grey"](middle) == pytest.approx(middle - 10, abs=0.1)
    assert found.transforms["blank"](middle) == pytest.approx(middle / 2, abs=0.1)

"""Dual-bootstrap ICP: a planted map is found, one start at a time, and another picture is refused."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from levkas.geometry.transforms import Affine
from levkas.quality.comparison.methods import (
    NoAnswer,
    Pair,
    find_peers,
    opencv_ecc,
    opencv_sift_magsac,
)

find_peers()
from levkas_peers.dual_bootstrap import gdbicp_quadratic, gdbicp_radial  # noqa: E402
from levkas_peers.growing import LADDERS  # noqa: E402
from levkas_peers.structures import find_structures  # noqa: E402

pytestmark = pytest.mark.slow

SHAPE = (180, 230)
CENTRE = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])
SPREAD = float(np.hypot(*SHAPE)) / 2


def painting(seed):
    rng = np.random.default_rng(seed)
    noise = gaussian_filter(rng.standard_normal((SHAPE[0] + 120, SHAPE[1] + 120)), 4)
    patches = (noise > 0) * 1.0 + 0.5 * (gaussian_filter(rng.standard_normal(noise.shape), 9) > 0)
    grain = gaussian_filter(rng.standard_normal(noise.shape), 1.2)
    return gaussian_filter(patches, 0.8) + 0.4 * grain


def planted(name):
    """A map of one family: a degree of rotation, a shift, and what the family can bend."""
    form = LADDERS[name][-1]
    turn = np.deg2rad(1.5)
    linear = 1.01 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    if name == "quadratic":
        rows = np.vstack(
            [[0.012, -0.008], linear.T, [[0.004, -0.003], [0.002, 0.004], [-0.003, 0.002]]]
        )
        parameters = rows.ravel()
    else:
        parameters = np.array([*linear[0], 0.012, *linear[1], -0.008, 0.01, -0.006, 0.006, -0.004])
    return lambda points: form.apply(parameters, (points - CENTRE) / SPREAD) * SPREAD + CENTRE


def pair(function, seed=1, other=None):
    """The reference and a target in which reference points lie where `function` puts them."""
    from levkas.quality.comparison.methods import AnyMap

    big = painting(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    here = np.stack([x.ravel(), y.ravel()], 1)
    back = AnyMap(function).inverse(here)
    target = map_coordinates(
        big if other is None else painting(other), back[:, ::-1].T + 60, order=3
    )
    rng = np.random.default_rng(7)
    images = [big[60 : 60 + SHAPE[0], 60 : 60 + SHAPE[1]], target.reshape(SHAPE)]
    images = [(i + 0.01 * rng.standard_normal(SHAPE)).astype(np.float32) for i in images]
    valid = np.ones(SHAPE, bool)
    return Pair(
        images[0], valid, 1 + 0.5 * images[1], valid, Affine.identity(), (0, 0), Affine.identity()
    )


def lattice():
    x, y = np.meshgrid(np.linspace(15, SHAPE[1] - 16, 9), np.linspace(15, SHAPE[0] - 16, 7))
    return np.stack([x.ravel(), y.ravel()], 1)


def errors(answer, function):
    points = lattice()
    return np.linalg.norm(answer.found(points) - function(points), axis=1)


@pytest.mark.parametrize(
    ("name", "method"), [("quadratic", gdbicp_quadratic), ("radial", gdbicp_radial)]
)
def test_a_planted_map_is_found_between_pictures_of_another_gain(name, method):
    function = planted(name)
    one = pair(function)
    answer = method(one)
    assert answer.decision == "accept" and errors(answer, function).max() < 0.25
    assert answer.note.startswith("quadratic" if name == "quadratic" else "homography and radial")


def test_another_painting_is_not_aligned(monkeypatch):
    monkeypatch.setattr("levkas_peers.dual_bootstrap.MOST_STARTS", 3)
    with pytest.raises(NoAnswer, match="none of 3 starts"):
        gdbicp_radial(pair(planted("radial"), other=99))


def test_a_blank_picture_is_not_aligned():
    one = pair(planted("quadratic"))
    blank = np.ones(SHAPE, np.float32)
    with pytest.raises(NoAnswer):
        gdbicp_quadratic(
            Pair(
                one.reference,
                one.reference_valid,
                blank,
                one.target_valid,
                one.start,
                (0, 0),
                one.back,
            )
        )


@pytest.mark.parametrize("method", [opencv_sift_magsac, opencv_ecc])
def test_a_planted_homography_is_found_by_the_peers(method):
    from levkas.geometry.transforms import Homography

    matrix = np.array([[1.01, -0.02, 4.0], [0.018, 0.99, -3.0], [2e-5, -1e-5, 1.0]])
    one = pair(Homography(matrix))
    assert errors(method(one), Homography(matrix)).max() < 0.5


def test_faces_lie_on_an_edge_with_their_normal_across_it():
    image = np.zeros((60, 80)) + (np.arange(80) > 40.3)
    found = find_structures(gaussian_filter(image, 1.5), np.ones(image.shape, bool))
    strong = np.abs(found.faces[:, 0] - 40.5) < 3
    assert strong.any() and np.abs(found.faces[strong, 0] - 40.5).max() < 0.1
    assert np.abs(found.normals[strong, 0]).min() > 0.999


def test_every_form_lifted_is_the_same_map():
    points = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    for ladder in LADDERS.values():
        parameters = np.array([0.98, 0.05, 0.1, -0.2])
        expected = ladder[0].apply(parameters, points)
        for poorer, richer in pairwise(ladder):
            parameters = richer.lift[poorer.name](parameters)
            np.testing.assert_allclose(richer.apply(parameters, points), expected, atol=1e-12)

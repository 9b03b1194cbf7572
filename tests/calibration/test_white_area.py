"""A white that does not fill the view, or is no white; and whites that only have what sensors and lenses give to every frame."""

import cv2
import numpy as np
import pytest

from levkas.calibration.templates import average
from levkas.calibration.white_area import find_white_area, find_white_line

SHAPE = (240, 320)
DARK = (np.full((1, 1), 60.0), np.full((1, 1), 60.0))


def painting(seed=0, shape=SHAPE):
    """Brush marks on fields of colour."""
    rng = np.random.default_rng(seed)
    fields = np.kron(rng.uniform(0.1, 0.8, (6, 8)), np.ones((40, 40)))[: shape[0], : shape[1]]
    marks = sum(
        cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), s) * s for s in (1.0, 2.0, 4.0)
    )
    return np.clip(fields * (1 + 0.12 * marks / marks.std()), 0.02, 1)


def camera(seed=0, fringes=0.0, shape=SHAPE):
    """PRNU, vignetting, dust, and interference fringes of a thinned sensor."""
    rng, (y, x) = np.random.default_rng(seed), np.indices(shape)
    response = 1 - ((y / shape[0] - 0.5) ** 2 + (x / shape[1] - 0.5) ** 2)
    response = response * (1 + 0.015 * rng.standard_normal(shape))
    for _ in range(25):
        cy, cx, size = rng.integers(0, shape[0]), rng.integers(0, shape[1]), rng.uniform(2, 8)
        spot = np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * size**2))
        response *= 1 - rng.uniform(0.03, 0.2) * spot
    return response * (1 + fringes * np.sin((x + 0.5 * y + 20 * np.sin(y / 60)) / 3))


def shots(reflectance, response, seed, count=2):
    rng, light = np.random.default_rng(seed), 3000 * reflectance * response
    return average([60 + rng.normal(light, np.sqrt(0.25 * light + 4)) for _ in range(count)])


def board(seed=5):
    texture = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(SHAPE), (0, 0), 1.5)
    return 0.95 * (1 + 0.01 * texture / texture.std())


@pytest.mark.parametrize("fringes", [0.0, 0.05])
@pytest.mark.parametrize(
    "scene",
    [painting(), np.full(SHAPE, 0.6), board(7), np.tile(np.linspace(0.1, 1, 320), (240, 1))],
)
def test_dust_fringes_and_texture_are_no_object(scene, fringes):
    response = camera(1, fringes)
    found = find_white_area(shots(scene, response, 1), shots(board(), response, 2), DARK)
    assert found.uncovered is None and not found.notes


@pytest.mark.parametrize(("fringes", "width"), [(0.0, 60), (0.05, 110)])
def test_a_board_that_leaves_a_part_of_the_painting_is_found_out(width, fringes):
    response, scene = camera(2, fringes), painting(3)
    partly = np.where(np.arange(SHAPE[1]) < width, scene, board())
    found = find_white_area(shots(scene, response, 1), shots(partly, response, 2), DARK)
    assert found.uncovered[:, : width - 2].all()
    assert not found.uncovered[:, width + 40 :].any()
    (note,) = found.notes
    assert "columns 0" in note and "239" in note


@pytest.mark.parametrize("side", [np.s_[:1], np.s_[:, :2]])
def test_first_lines_of_a_sensor_that_respond_otherwise_are_no_object(side):
    response, scene = camera(2), painting(3)
    response[side] *= 1.7
    found = find_white_area(shots(scene, response, 1), shots(board(), response, 2), DARK)
    assert found.uncovered is None and not found.notes
    partly = np.where(np.arange(SHAPE[1]) < 110, scene, board())
    found = find_white_area(shots(scene, response, 1), shots(partly, response, 2), DARK)
    assert found.uncovered[:, :108].all() and not found.uncovered[:, 150:].any()


def texture(rms, seed=8):
    marks = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(SHAPE), (0, 0), 1.5)
    return 1 + rms * marks / marks.std()


def specks(seed=3, count=6):
    """Dust of 20 %, 3 px."""
    rng, (y, x) = np.random.default_rng(seed), np.indices(SHAPE)
    made = np.ones(SHAPE)
    for _ in range(count):
        cy, cx = rng.integers(20, SHAPE[0] - 20), rng.integers(20, SHAPE[1] - 20)
        made *= 1 - 0.2 * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / 18)
    return made


def fields(seed=4):
    """Fields of colour with faint brush marks."""
    rng = np.random.default_rng(seed)
    plane = np.kron(rng.uniform(0.05, 0.9, (10, 13)), np.ones((30, 28)))
    y, x = rng.integers(0, 28, 2)
    return plane[y : y + SHAPE[0], x : x + SHAPE[1]] * texture(0.02, seed + 1)


CLEAN = np.ones(SHAPE)


def test_detail_that_object_and_white_share_is_the_sensors():
    for response in (texture(0.05), specks(), specks(count=20) * texture(0.02)):
        found = find_white_area(shots(fields(), response, 1), shots(CLEAN, response, 2), DARK)
        assert not found.notes


def test_samples_of_a_line_that_see_something_move_are_found():
    rng = np.random.default_rng(6)
    lines = 1000 * np.linspace(0.6, 1, 90)[None, :, None] * rng.normal(1, 0.02, (120, 90, 6))
    level = np.zeros((1, 1, 1))
    steady = average(lines[:, None])
    assert find_white_line(steady, level).uncovered is None
    lines[:, 70:] *= painting(shape=(120, 20))[..., None]
    found = find_white_line(average(lines[:, None]), level)
    assert np.flatnonzero(found.uncovered[0]).tolist() == list(range(70, 90))

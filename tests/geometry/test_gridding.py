"""Orientation, crop and scale of the grid, against numbers worked by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from levkas.geometry.grid import Grid, GridRefused

FRAME = (40, 30)
CORNERS = np.array([[0.0, 0], [39, 0], [39, 29], [0, 29]])
"""Top left, top right, bottom right, bottom left of the reference frame."""


def placed(grid, points=CORNERS):
    return grid.transform.inverse(points).round(9).tolist()


@pytest.mark.parametrize(
    ("rotate", "size", "corners"),
    [
        (90, (30, 40), [[29, 0], [29, 39], [0, 39], [0, 0]]),
        (180, (40, 30), [[39, 29], [0, 29], [0, 0], [39, 0]]),
        (270, (30, 40), [[0, 39], [0, 0], [29, 0], [29, 39]]),
        (-90, (30, 40), [[0, 39], [0, 0], [29, 0], [29, 39]]),
        (450, (30, 40), [[29, 0], [29, 39], [0, 39], [0, 0]]),
    ],
)
def test_quarter_turns_are_clockwise_as_seen_and_exact(rotate, size, corners):
    grid = Grid(FRAME, rotate=rotate)
    assert grid.size == size
    assert placed(grid) == corners
    back = grid.transform(np.array(corners, float))
    assert np.array_equal(back, CORNERS)


def test_mirror_comes_before_the_turn():
    assert placed(Grid(FRAME, mirror=True)) == [[39, 0], [0, 0], [0, 29], [39, 29]]
    # Mirrored, the top left corner stands top right; a quarter turn takes it to the bottom right.
    assert placed(Grid(FRAME, mirror=True, rotate=90))[0] == [29, 39]


def test_thirty_degrees_by_hand():
    grid = Grid((40, 30), rotate=30)
    # Corner (40, 0) goes to (34.641, 20), corner (0, 30) to (-15, 25.981): the box begins at -15.
    corner = grid.transform(np.array([[15 + 34.641016 - 0.5, 20 - 0.5]]))
    assert np.allclose(corner, [[39.5, -0.5]], atol=1e-6)


def test_region_is_taken_in_the_turned_frame_at_native_scale():
    grid = Grid(FRAME, rotate=90, region=(10, 5, 12, 20))
    assert grid.size == (12, 20)
    # Turned pixel (10, 5) is reference pixel (y', 29 - x') = (5, 19).
    assert grid.transform(np.array([[0.0, 0.0]])).tolist() == [[5, 19]]


def test_scaling_keeps_pixel_corners():
    grid = Grid(FRAME, region=(10, 5, 20, 10), output=(10, 5))
    points = grid.transform(np.array([[0.0, 0.0], [-0.5, -0.5], [9.5, 4.5]]))
    # x = 10 + (x' + 0.5)·2 − 0.5: pixel 0 covers reference pixels 10 and 11.
    assert np.allclose(points, [[10.5, 5.5], [9.5, 4.5], [29.5, 14.5]])


@given(st.booleans(), st.floats(-720, 720), st.tuples(st.integers(1, 50), st.integers(1, 50)))
def test_every_reference_pixel_is_on_the_whole_grid(mirror, rotate, size):
    grid = Grid(size, mirror=mirror, rotate=rotate)
    w, h = size
    corners = np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]])
    found = grid.transform.inverse(corners)
    assert found.min() > -0.5 - 1e-5
    assert np.all(found.max(0) < np.array(grid.size) - 0.5 + 1e-5)


@pytest.mark.parametrize(
    "keys",
    [
        {"region": (50, 0, 10, 10)},
        {"region": (0, 0, 0, 10)},
        {"region": (0, 0, float("nan"), 10)},
        {"output": (0, 5)},
    ],
)
def test_what_shows_nothing_is_refused(keys):
    with pytest.raises(GridRefused):
        Grid(FRAME, **keys)

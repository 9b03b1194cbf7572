"""Loops of independent registrations come back to where they began, or say why they do not."""

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.quality.evaluation.loop_closure import LoopView, close_loops, loops_text, points_on
from levkas.registration import BandImage


def shifted(scale, x, y):
    return Affine(np.array([[scale, 0.0, x], [0.0, scale, y]]))


def view(studio, name, painting, mapping, *, claimed=None, seed=0):
    picture = studio.photograph(painting, mapping.inverse, seed=seed)
    return LoopView(name, [BandImage.of("grey", picture)], "grey", claimed or mapping)


@pytest.mark.slow
def test_right_maps_close_and_a_wrong_one_shows_by_how_much(studio):
    painting = studio.paint(71)
    one = view(studio, "one", painting, shifted(1.02, 3.0, -2.0), seed=1)
    other = view(studio, "other", painting, shifted(0.97, 1.5, 4.0), seed=2)
    points = points_on(one.images[0])
    (loop,) = close_loops([one, other], points)
    assert len(loop.error) > 0.8 * len(points)
    assert loop.error.mean() < 0.05
    # The same picture, said to lie 0.8 px aside of where it does.
    wrong = LoopView("wrong", other.images, "grey", shifted(0.97, 1.5 + 0.97 * 0.8, 4.0))
    (loop,) = close_loops([one, wrong], points)
    np.testing.assert_allclose(loop.error.mean(), 0.8, atol=0.05)


@pytest.mark.slow
def test_a_pair_that_cannot_be_registered_says_why(studio):
    one = view(studio, "one", studio.paint(72), shifted(1.0, 0, 0), seed=3)
    other = view(studio, "other", studio.paint(73), shifted(1.0, 0, 0), seed=4)
    (loop,) = close_loops([one, other], points_on(one.images[0]))
    assert not len(loop.error) and loop.refused
    assert loop.to_dict()["mean"] is None


def test_a_database_without_loops_is_said_so():
    assert "two registered cameras" in loops_text([])

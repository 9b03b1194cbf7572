"""Figures of a registration."""

import re

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.pages.figures import draw_trace
from levkas.registration.outliers import RemovalTerms, clean, frame_corners
from levkas.registration.record import Matches


def traced(wrong):
    rng = np.random.default_rng(1)
    target = rng.uniform(0, (300, 200), (60, 2))
    reference = target + rng.normal(0, 0.05, target.shape)
    reference[:wrong] += 8.0
    found = clean(
        target, reference, RemovalTerms(Affine.identity(), 30.0, 1.0, order=2), size=(300, 200),
        target_size=(300, 200),
    )  # fmt: skip
    return Matches.of(reference, target), found.trace


@pytest.mark.parametrize(("wrong", "rounds"), [(0, 1), (1, 2), (2, 3)])
def test_the_course_of_a_removal_is_drawn_from_one_round_on(wrong, rounds):
    matches, trace = traced(wrong)
    assert trace.rounds == rounds
    course, largest = draw_trace(matches, trace)
    assert f"round {rounds} of {rounds}: {60 - wrong} pairs" in course.svg
    assert f"round (of {rounds})" in largest.svg


def test_frames_of_one_size_are_drawn_one_on_the_other():
    matches, trace = traced(0)
    np.testing.assert_array_equal(trace.frame, frame_corners((300, 200)))
    outline = {
        ink: re.search(
            r'd="([^"]*)"[^>]*stroke: ' + re.escape(ink), draw_trace(matches, trace)[0].svg
        )[1]
        for ink in ("var(--ref)", "currentColor")
    }
    assert outline["var(--ref)"] == outline["currentColor"]

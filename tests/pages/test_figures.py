"""Figures of a registration."""

import re

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.pages.figures import draw_trace
from levkas.registration.outliers import RemovalTerms, clean
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


NUMBER = r"(-?[\d.]+)"


def paths(svg, ink):
    """Points of every path of one colour, in units of the view box."""
    found = re.findall(r'd="([^"]*)"[^>]*stroke: ' + re.escape(ink), svg)
    return [np.array(re.findall(NUMBER + r"\s" + NUMBER, d), float) for d in found]


def turned(degrees, mirrored):
    """Pairs of a camera that is turned by any angle or mirrored, with two wrong ones."""
    rng = np.random.default_rng(2)
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn = 0.9 * turn @ np.diag([-1.0 if mirrored else 1.0, 1.0])
    start = Affine(np.column_stack([turn, [150, 100] - turn @ [160, 110]]))
    target = rng.uniform(20, (300, 200), (120, 2))
    bent = start(target) + 4 * np.sin(target / 150) + rng.normal(0, 0.4, target.shape)
    bent[:2] += (14.0, 9.0)
    found = clean(
        target, bent, RemovalTerms(start, 30.0, 2.0), size=(300, 200), target_size=(320, 220)
    )
    return Matches.of(bent, target), found


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(
    "degrees",
    [0, 137, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in (40, 90, 180, 300))],
)
def test_error_lines_are_as_long_as_the_residuals_whichever_way_the_camera_is_turned(
    degrees, mirrored
):
    matches, found = turned(degrees, mirrored)
    svg = draw_trace(matches, found.trace)[0].svg
    frame, lines = paths(svg, "currentColor")[-1], paths(svg, "#999999")
    assert len(lines) == 120 + sum(found.trace.kept_at(k).sum() for k in (0, 1, 2))
    assert found.trace.rounds == 3
    scale = np.linalg.norm(frame[1] - frame[0]) / 300
    lengths = [np.linalg.norm(b - a) / scale for a, b in lines[-int(found.kept.sum()) :]]
    np.testing.assert_allclose(lengths, found.residual[found.kept], atol=0.01)
    assert max(lengths) <= found.trace.stop


def test_what_lies_outside_its_panel_is_cut():
    matches, found = turned(40, False)
    matches.target[5] += 4000.0  # scale alone throws this pair far out
    svg = draw_trace(matches, found.trace)[0].svg
    width, height = (float(v) for v in re.search(r'viewBox="0 0 (\S+) (\S+)"', svg).groups())
    outline = np.vstack(paths(svg, "currentColor"))
    assert (outline > 0).all() and (outline < (width, height)).all()
    assert np.ptp(paths(svg, "currentColor")[0][:, 0]) > 0.25 * width / 2  # the frame stays large
    drawn = re.findall(r"<path [^>]*stroke: #999999[^>]*>", svg)
    assert drawn and all("clip-path" in one for one in drawn)

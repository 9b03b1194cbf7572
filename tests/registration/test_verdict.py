"""The verdict: every rule speaks where it should, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.geometry.transforms import Affine, Inverse, Polynomial
from levkas.registration.advice import ACCEPT, LEAST_PAIRS, advise, in_workbench
from levkas.registration.mirhashemi2019 import SensorPicture, measure, measure_held_out
from levkas.registration.outliers import RemovalTerms
from levkas.registration.record import Matches
from levkas.registration.verdict import ONLY, Evidence, judge
from levkas.registration.verification import Overlap, measure_shape
from levkas.registration.window_matching import search_windows

STILL = Affine.identity()
SIZE = (300, 230)
TERMS = RemovalTerms(STILL, reject=24.0, stop=1.0)


def shift(x, y):
    return Affine(np.array([[1.0, 0, x], [0, 1.0, y]]))


def bent(curve):
    """Return a map that bends x as `curve` does."""
    x = np.linspace(0, 299, 12)
    grid = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
    return Polynomial.fit(grid, np.stack([curve(grid[:, 0]), grid[:, 1]], 1), order=4)


def shown(values):
    return SensorPicture(values, np.ones(values.shape, bool))


@pytest.fixture(scope="module")
def pictures(studio):
    painting = studio.paint(21)
    return [shown(studio.photograph(painting, STILL, seed=seed)) for seed in (1, 2)]


def pair(one, other):
    return (one.values, one.valid), (other.values, other.valid)


def scattered(n, seed=0, noise=0.2):
    """Return right matches of an identity all over the picture."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, 0), SIZE, (n, 2))
    return Matches.of(points, points + rng.normal(0, noise, (n, 2)))


def judged(pictures, transform=STILL, matches=None):
    return judge({ONLY: measure(transform, matches or scattered(200), *pictures, TERMS)})


def test_a_right_map_is_accepted_with_its_numbers(pictures):
    verdict = judged(pictures)
    assert verdict.decision == "accept" and verdict.next_step == ""
    numbers = verdict.numbers[ONLY]
    assert numbers["coverage"] == 1 and numbers["overlap"] == 1
    assert verdict == judged(pictures)


def test_the_shift_of_windows_is_measured(pictures):
    observed = search_windows(*pair(*pictures), shift(2.5, -1.25))
    assert observed.found.mean() > 0.9
    # Windows lie where the map puts them less what the map is off by.
    np.testing.assert_allclose(
        np.median(observed.shift[observed.found], 0), (-2.5, 1.25), atol=0.15
    )


def test_windows_are_found_in_the_negative_and_not_in_another_painting(studio, pictures):
    negative = shown(1 - pictures[1].values)
    assert search_windows(*pair(pictures[0], negative), STILL).found.mean() > 0.9
    other = shown(studio.photograph(studio.paint(22), STILL, seed=3))
    observed = search_windows(*pair(pictures[0], other), STILL)
    assert observed.found.mean() < 0.1 and observed.second_peak_ratio > 0.8
    tile = np.random.default_rng(1).uniform(0, 1, (23, 23))
    wall = shown(np.tile(tile, (10, 14)).astype(np.float32))
    assert search_windows(*pair(wall, wall), STILL).second_peak_ratio > 0.95


def wrong(n, spread, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, 0), SIZE, (n, 2))
    return Matches.of(points, points + rng.normal(0, spread, (n, 2)))


@pytest.mark.parametrize(
    ("transform", "matches"),
    [
        (shift(3, 0), None),  # the matches say otherwise: they are taken from a repeated place, say
        (shift(60, 0), None),
        (shift(5000, 0), None),
        (STILL, scattered(25)),
        (STILL, wrong(40, 8, 3)),
        (Affine(np.array([[3.0, 0, -300], [0, 1.0, 0]])), None),
        (Affine(np.array([[8.0, 0, -1000], [0, 8.0, -800]])), None),
        (bent(lambda x: x - x**2 / 400), None),
    ],
)
def test_a_map_that_is_off_or_that_no_camera_makes_is_refused(pictures, transform, matches):
    verdict = judged(pictures, transform, matches)
    assert verdict.decision == "refuse" and verdict.next_step


def test_a_map_that_is_off_in_one_part_is_no_clean_accept(pictures):
    verdict = judged(pictures, bent(lambda x: x + 6 * (x / 299) ** 4))
    assert verdict.decision != "accept"
    assert all(x >= 150 for x, *_ in verdict.numbers[ONLY]["off"]) and verdict.numbers[ONLY]["off"]


def test_held_out_blocks_see_what_residuals_hide():
    chance = wrong(12, 8, 4)
    model = Polynomial.fit(chance.target, chance.reference)
    residual = np.linalg.norm(model(chance.target) - chance.reference, axis=1)
    assert residual.mean() < 5 < measure_held_out(chance, TERMS)[0]


def test_the_shape_of_a_map_is_measured(pictures):
    def shape(transform, region=None):
        return measure_shape(Overlap(transform, pictures[0].valid, pictures[1].valid, region))

    assert shape(Inverse(bent(lambda x: x - x**2 / 400)))["folded"] > 0.3
    mirror = shape(Affine(np.array([[-1.0, 0, 299], [0, 1.0, 0]])))
    assert mirror["mirrored"] and mirror["folded"] == 0 and mirror["overlap"] == 1
    half = shape(shift(210, 0), (0, 0, 180, 230))
    assert half["overlap"] == pytest.approx(0.5, abs=0.03)


def without_a_corner(n):
    matches = scattered(n)
    right = ~np.all(matches.reference < (155, 120), axis=1)
    return Matches.of(matches.reference[right], matches.target[right])


def test_cells_that_nothing_bears_out_are_named(pictures):
    foreign = pictures[1].values.copy()  # a quarter of the target shows something else
    foreign[:115, :150] = np.random.default_rng(0).normal(0.4, 0.05, (115, 150))
    verdict = judged([pictures[0], shown(foreign)], matches=without_a_corner(300))
    # Nothing contradicts the map: it is accepted, and the part is named and counted.
    assert verdict.decision == "accept" and 0.1 < verdict.unchecked < 0.4
    assert all(x < 150 and y < 115 for x, y, _, _ in verdict.numbers[ONLY]["unsupported"])


def test_cells_that_lie_off_make_a_map_doubtful(pictures):
    torn = pictures[1].values.copy()  # a quarter of the target has slipped by 12 px
    torn[:115, :150] = torn[:115, 12:162]
    verdict = judged([pictures[0], shown(torn)], matches=without_a_corner(300))
    assert verdict.decision != "accept" and verdict.numbers[ONLY]["off"]


SOUND = Evidence(
    basis="windows", held_out_px=0.02, share_above_chance=1.0, kept=335, terms=9, light="same",
    tolerance=1.0, overlap=1.0, folded=0.0, mirrored=False, scale_min=2.4, scale_max=2.5, area_ratio=1.02,
    anisotropy=1.01, windows=117, found=117, agreeing=117, contradicting=0, window_median=0.02, second_peak_ratio=0.2, coverage=1.0,
    off_share=0.0, unsupported=[], off=[], checked=0.98, unchecked=[[255.2, 19.0, 20.8, 18.6, 0.02]], box=(0, 0, 300, 230),
)  # fmt: skip
CELL = [10.0, 20.0, 40.0, 30.0]
LINES = {"lines": "rows", "displaced": True, "rms_px": 5.0, "largest_px": 12.0, "step": 1.0}


@pytest.mark.parametrize(
    ("change", "decision", "unchecked"),
    [
        ({}, "accept", 0.02),
        ({"overlap": 0.6}, "accept", 0.41),  # nothing contradicts the map where it can be looked at
        ({"coverage": 0.85, "unsupported": [CELL]}, "accept", 0.15),
        ({"coverage": 0.4, "unsupported": [CELL]}, "warn", 0.6),  # more than half
        ({"checked": 0.7, "unchecked": [[*CELL, 0.2]]}, "warn", 0.3),
        ({"checked": 0.7}, "accept", 0.3),  # in small patches
        ({"off": [CELL], "off_share": 0.05}, "warn", 0.02),
        ({"second_peak_ratio": 0.9}, "warn", 0.02),
        ({"held_out_px": 0.3, "window_sigma_px": 0.1}, "warn", 0.02),
        ({"held_out_px": 0.3, "window_sigma_px": 0.4}, "accept", 0.02),  # noise explains it
        ({"converged": False}, "warn", 0.02),
        ({"align_apart_px": 9.0}, "warn", 0.02),
        ({"line_displacement": LINES}, "refuse", 0.02),
        ({"line_displacement": {**LINES, "rms_px": 0.2}}, "warn", 0.02),
        ({"line_displacement": {**LINES, "rms_px": 0.2}, "scales": (0.03, 9)}, "accept", 0.02),
        ({"off": [CELL], "off_share": 0.3}, "refuse", 0.02),
        ({"overlap": 0.05}, "refuse", 0.95),
        ({"share_above_chance": 0.1}, "refuse", 0.02),
        ({"held_out_px": 9.0}, "refuse", 0.02),
        ({"folded": 0.1}, "refuse", 0.02),
        ({"scale_max": 9.0}, "refuse", 0.02),
        ({"anisotropy": 3.0}, "refuse", 0.02),
        ({"found": 3, "agreeing": 3, "kept": 20}, "refuse", 0.02),
        ({"agreeing": 30, "window_median": 4.0}, "refuse", 0.02),
        ({"second_peak_ratio": 0.97}, "refuse", 0.02),
        ({"coverage": 0.1}, "refuse", 0.9),
    ],
)
def test_what_is_contradicted_is_doubtful_and_what_was_not_checked_is_counted(
    change, decision, unchecked
):
    verdict = judge({ONLY: replace(SOUND, **change)})
    assert verdict.decision == decision
    assert verdict.unchecked == pytest.approx(unchecked, abs=0.01)
    if decision == "refuse":
        for pairs in range(LEAST_PAIRS + 1):
            advice = advise(verdict.next_step, pairs)
            assert "levkas inspect" in advice and ("four points" in advice) <= (pairs == 0)
            assert (ACCEPT[-20:] in advice) == (pairs >= LEAST_PAIRS)
            assert "levkas inspect" not in in_workbench(advice)
            assert "`reject`" not in advice  # no key of the paper's method

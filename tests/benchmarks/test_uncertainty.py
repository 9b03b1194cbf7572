"""Intervals hold the truth of simulated captures with planted errors, and laboratories agree within them."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import uncertainty


@pytest.mark.slow
def test_intervals_hold_the_truth_of_frames_with_all_errors():
    draws = [uncertainty.draw_arrays(seed, shots=2, of_all=10) for seed in range(10)]
    for name, (share, spread) in uncertainty.coverage(draws).items():
        # Ten draws of what bands and pixels share: chance is a fourth of the spread.
        assert 0.6 < spread < 1.4, name
        assert share >= 0.8, name


@pytest.mark.slow
def test_one_wrong_white_is_named_by_every_laboratory_and_few_other_pairs_are():
    pairs = uncertainty.compare_laboratories(3, uncertainty.CAREFUL, wrong=4)
    named = {
        frozenset((p.first.camera[-1], p.second.camera[-1])) for p in pairs if p.contradictions
    }
    assert len(pairs) == 45
    assert {frozenset(("4", str(k))) for k in range(10) if k != 4} <= named
    assert len(named) <= 14  # of 36 other pairs two are named by chance


@pytest.mark.slow
def test_intervals_hold_the_truth_of_whole_builds():
    builds = [uncertainty.draw_build(seed) for seed in (3, 14, 27)]
    found = uncertainty.coverage_of_builds(builds)
    for name, (_, spread) in found.items():
        assert 0.4 < spread < 1.8, name


@pytest.mark.slow
def test_a_painting_that_lies_elsewhere_has_not_changed_and_what_changed_is_marked():
    share, marked = uncertainty.draw_dates(0)
    assert 0.006 < share < 0.014
    assert np.mean(np.array(marked) >= 0.5) > 0.9

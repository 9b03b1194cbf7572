"""No broken assumption of calibration is silent: a build is right within sigma, refuses, or names it."""

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from camera import Habits, outcome_of, write_campaign
from table import CASES, PLAIN, judge, run

from levkas.building.run import build

NIGHTLY = bool(os.environ.get("LEVKAS_NIGHTLY"))
FIRST = {case.name: case for case in reversed(CASES)}
"""One case of each assumption; all of them where $LEVKAS_NIGHTLY is set."""


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES if NIGHTLY else FIRST.values(), ids=lambda case: case.label)
def test_a_broken_assumption_is_never_silent(case, tmp_path):
    verdict, off = judge(case, run(case, tmp_path / "campaign"))
    assert verdict in ("right", "refused", "named", "stated"), off


@pytest.mark.slow
@pytest.mark.parametrize("case", PLAIN, ids=lambda case: case.label)
def test_a_camera_that_keeps_its_promises_is_right_without_a_word(case, tmp_path):
    made = run(case, tmp_path / "campaign")
    verdict, off = judge(case, made)
    assert (verdict, off) == ("right", [])
    assert made.words.count("\n") == 0  # the reflectance of the board is assumed, and nothing else


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drift", "lines", "named"), [(0.02, 480, True), (0.02, 1500, False), (0.0, 480, False)]
)
def test_a_lamp_that_sinks_over_a_scan_longer_than_its_white_is_named_as_far_as_it_shows(
    drift, lines, named, tmp_path
):
    """Of 2 % over 480 lines the white of 64 shows 0.2 %; over 1,500 lines less than its noise."""
    write_campaign(tmp_path / "campaign", "cube", Habits(drift=drift), (lines, 80))
    made = outcome_of(tmp_path / "campaign", build)
    assert ("the lamp changed between white and object" in made.words) == named

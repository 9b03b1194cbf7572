"""What every refusal of a registration tells one to do: it names the workbench, and never wants what was just done."""

import ast
import inspect
from pathlib import Path

import numpy as np
import pytest

import levkas.registration
from levkas.registration import OF_PICTURES
from levkas.registration.advice import (
    ACCEPT,
    COMPARED,
    CONFIRM,
    LEAST_PAIRS,
    REGION,
    advise,
    in_workbench,
)
from levkas.registration.verdict_rules import RULES

FOLDER = Path(levkas.registration.__file__).parent
OF_REQUESTS = {"E_METHOD", 
    "E_BAND_MISSING", "E_BAND_TWICE", "E_SIZE", "E_STRIPS", "E_UNREADABLE", "E_VALUE",
}  # fmt: skip
"""Codes of what is wrong with files or arguments, which no pair by hand mends."""
SHAPE = {"scale_min": 0.9, "scale_max": 1.1, "area_ratio": 1.1, "anisotropy": 1.1}
MAP = {
    "overlap": 0.9, "folded": 0.0, "tolerance": 1.0, "kept": 40, "terms": 10, "alike": True,
    "coverage": 0.9, "off": [], "off_share": 0.0, "unsupported": [], "second_peak_ratio": 0.2, "checked": 1.0,
    "unchecked": [], "held_out_px": 0.2, "step": 1.0, "object": 1.0,
}  # fmt: skip
LINES = {
    "picture": "target", "lines": "rows", "displaced": True, "rms_px": 5.0, "largest_px": 12.0,
    "along_px": 5.0, "across_px": 0.1, "step": 1.0,
}  # fmt: skip
REFUSED = {
    "lines_lie_still": [{"line_displacement": LINES}],
    "enough_matches": [{"kept": 5}],
    "more_than_chance": [{"chance_kept": 30}],
    "better_than_chance": [{"share_above_chance": 0.1}],
    "predicts_windows": [{"held_out_px": np.inf}, {"held_out_px": 9.0}],
    "does_not_fold": [
        {"overlap": 0},
        {"folded": 0.1},
        {"folded": 0.1, "terms": 3},
        {"folded": 0.1, "overlap": 0.1},
        {"folded": 0.1, **SHAPE, "scale_max": 30.0},
    ],
    "has_plausible_shape": [{**SHAPE, "scale_max": 9.0}, {**SHAPE, "anisotropy": 3.0}],
    "predicts_matches": [
        {"held_out_median": 9.0, "held_out_p90": 20.0},
        {"held_out_median": np.inf, "held_out_p90": 20.0, "terms": 3},
    ],
    "windows_agree": [
        {"windows": 400, "found": 3, "agreeing": 3, "window_median": 0.1},
        {"windows": 400, "found": 300, "agreeing": 30, "window_median": 4.0},
    ],
    "fits_nowhere_else": [{"second_peak_ratio": 1.2}, {"second_peak_ratio": 0.97}],
    "shows_the_reference": [{"overlap": 0.05}],
    "matches_cover": [{"off_share": 0.5}, {"coverage": 0.1}],
    "windows_cover": [{"coverage": 0.1}, {"off_share": 0.5, "off": [[0, 0, 9, 9]]}],
    "lies_where_declared": [{"align_apart_px": 9.0, "align_is_map": True}],
}  # fmt: skip


def refuses(rule):
    """Whether a rule has a word for it, or takes its decision from limits."""
    source = inspect.getsource(rule)
    return '"refuse"' in source or "exceeded_by" in source


def steps():
    """Every next step of a rule that refuses, by its rule."""
    for rule in RULES:
        for numbers in REFUSED.get(rule.__name__, ()):
            found = rule({**MAP, **numbers})
            assert found is not None and found.decision == "refuse", (rule.__name__, found)
            yield rule.__name__, found.next_step
            if found.on_matches:
                yield rule.__name__, found.on_matches


def problems_of_code():
    """(code, fix as written, file) of every problem of the package: fixes that are put together are read as far as they are text."""
    for path in sorted(FOLDER.glob("*.py")):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "Problem":
                first = call.args[0]
                if isinstance(first, ast.Constant):
                    yield first.value, path.name


def test_every_rule_that_refuses_is_tested():
    assert {rule.__name__ for rule in RULES if refuses(rule)} == REFUSED.keys()


def test_every_code_is_of_pictures_or_of_requests():
    codes = {code for code, _ in problems_of_code()}
    assert codes <= OF_PICTURES | OF_REQUESTS and codes >= OF_PICTURES
    assert not OF_PICTURES & OF_REQUESTS


@pytest.mark.parametrize(("rule", "step"), sorted(set(steps())))
def test_the_next_step_of_a_refusal_names_the_workbench_and_does_not_want_pairs_that_are_there(
    rule, step
):
    assert "levkas inspect" in advise(step, 0)
    for pairs in range(1, LEAST_PAIRS):
        advice = advise(step, pairs)
        assert "levkas inspect" in advice and "four points" not in advice
        if "four points" in step:
            assert f"mark {LEAST_PAIRS - pairs} more point" in advice
    for pairs in (LEAST_PAIRS, 9):
        advice = advise(step, pairs)
        assert "points that both pictures show" not in advice and ACCEPT[-20:] in advice
    for pairs in (0, 2, 4):
        here = in_workbench(advise(step, pairs))
        assert "levkas inspect" not in here and "edits.toml" not in here and here == here.strip()
        assert ("Place by hand" in here) == (pairs >= LEAST_PAIRS)


def test_where_pairs_were_given_a_part_that_is_not_checked_wants_no_more_of_them():
    assert advise(REGION, 0, "accept") == REGION
    for decision, more in (("accept", ""), ("warn", f" {CONFIRM}")):
        assert advise(REGION, 3, decision) == f"{COMPARED}{more}"
        assert "add pairs" not in advise(REGION, 3, decision)
    assert advise("Check the lamp.", 4, "warn") == f"Check the lamp. {CONFIRM}"
    assert all("levkas" not in in_workbench(step) for step in (REGION, COMPARED, CONFIRM))


def test_the_lowest_order_is_not_to_be_lowered():
    reported = dict(steps_of("predicts_matches"))
    assert "lower the order" in reported[10] and "lower the order" not in reported[3]


def steps_of(name):
    rule = next(rule for rule in RULES if rule.__name__ == name)
    for terms in (3, 10):
        numbers = {**MAP, "held_out_median": 9.0, "held_out_p90": 20.0, "terms": terms}
        yield terms, rule(numbers).next_step

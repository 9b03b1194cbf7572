"""Corrections on planted pairs: what an edit makes of the fit, and undo without end."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.campaign.edits import FrameEdits
from levkas.registration.record import Matches
from levkas.workbench.answer import describe, from_bytes, to_bytes
from levkas.workbench.history import CorrectionStep
from levkas.workbench.session import OPERATIONS, CorrectionSession, OperationRefused, RecordedPairs

SIZE = (1000, 800)


def truth(points):
    u, v = ((points - np.array(SIZE) / 2) / 500).T
    return points + np.stack([3 * u**3 + 2 * v**2 + 5, 4 * v * u**2 - 3], 1)


def plant(n=300, wrong=0, off=4.0, seed=0, stop=6.0):
    """Return pairs under a bent map with 0.1 px of noise; the first `wrong` are `off` px off."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(20, np.array(SIZE) - 20, (n, 2))
    reference = truth(target) + rng.normal(0, 0.1, (n, 2))
    angle = rng.uniform(0, 2 * np.pi, wrong)
    reference[:wrong] += off * np.stack([np.cos(angle), np.sin(angle)], 1)
    return RecordedPairs(Matches.of(reference, target), SIZE, SIZE, None, stop)


def words(column):
    """The words of a column of `describe`."""
    return [column["words"][code] for code in column["codes"]]


def pair_of(session, row):
    matches = session.view.matches
    return [*matches.reference[row], *matches.target[row]]


def test_the_wrong_pair_is_the_worst_and_its_deletion_lets_the_error_fall():
    session = CorrectionSession(plant(wrong=1))
    before = describe(session)
    worst = int(np.nanargmax(session.view.matches.residual))
    assert worst == 0 and before["summary"]["max"] > 3.5
    session.apply("delete", pair_of(session, worst))
    after = describe(session)
    assert after["summary"]["max"] < 0.5
    assert (words(after["state"])[0], words(after["reason"])[0]) == ("removed", "deleted by hand")
    held_out = np.random.default_rng(9).uniform(100, 700, (200, 2))
    miss = session.view.forward(truth(held_out)) - held_out
    assert np.linalg.norm(miss, axis=1).max() < 0.1


def test_a_removed_pair_that_is_pinned_or_restored_stays():
    session = CorrectionSession(plant(wrong=1, stop=1.0))
    assert words(describe(session)["state"])[0] == "removed"
    for operation, reason in (("pin", "pinned by hand"), ("restore", "restored by hand")):
        session.apply(operation, pair_of(session, 0))
        record = describe(session)
        assert (words(record["state"])[0], words(record["reason"])[0]) == ("kept", reason)
        session.undo()
    assert words(describe(session)["state"])[0] == "removed"


def test_a_check_point_measures_and_is_not_fitted():
    session = CorrectionSession(plant())
    before = session.view.cleaned.model.coefficients.copy()
    place = np.array([400.0, 300.0])
    session.apply("check", [*(truth(place[None])[0] + [3.0, 0.0]), *place])
    record = describe(session)
    assert np.array_equal(session.view.cleaned.model.coefficients, before)
    assert words(record["state"])[-1] == "check" and abs(record["residual"][-1] - 3.0) < 0.1
    assert record["summary"]["checks"] == 1


def test_a_found_pair_made_a_check_point_leaves_the_fit():
    session = CorrectionSession(plant(wrong=1))
    session.apply("check", pair_of(session, 0))
    record = describe(session)
    assert words(record["state"]).count("check") == 1 and record["summary"]["max"] < 0.5
    assert record["summary"]["pairs"] == 300


def test_a_moved_pair_is_where_it_was_put_and_undo_brings_it_back():
    session = CorrectionSession(plant(wrong=1))
    pair = pair_of(session, 0)
    better = [*truth(np.array([pair[2:]]))[0], *pair[2:]]
    session.apply("move", pair, better)
    assert describe(session)["summary"]["max"] < 0.5
    assert len(session.edits.moved) == 1
    session.undo()
    assert session.edits == FrameEdits() and describe(session)["summary"]["max"] > 3.5


def test_four_added_pairs_make_a_map_where_there_was_none():
    nothing = RecordedPairs(Matches.of(np.zeros((0, 2)), np.zeros((0, 2))), SIZE, SIZE)
    session = CorrectionSession(nothing)
    assert "at least 3" in describe(session)["refusal"]
    matrix = np.array([[0.3, -0.4], [0.4, 0.3]])
    corners = np.array([[100.0, 100], [900, 120], [880, 700], [120, 690]])
    for corner in corners:
        session.apply("add", [*corner, *(matrix @ corner + [300, 50])])
    record = describe(session)
    assert record["refusal"] == "" and record["summary"]["kept"] == 4
    assert record["summary"]["mean"] is None, "no redundancy"
    assert len(record["residual"]) == 4 and np.isnan(record["residual"]).all()
    inside = np.array([[500.0, 400.0]])
    assert np.allclose(session.view.forward(inside), inside @ matrix.T + [300, 50], atol=0.1)


def test_sliders_replay_the_removal_and_are_one_change_each():
    session = CorrectionSession(plant(wrong=60))
    assert describe(session)["summary"]["kept"] == 300
    for value in (3.0, 2.0, 1.0):
        session.slide("stop", value)
    record = describe(session)
    assert record["summary"]["kept"] == 240 and record["trace"]["largest"][-1] <= 1.0
    assert session.can == {"undo": 1, "redo": 0} and record["overridden"]["stop"]
    session.slide("stop", None)
    assert describe(session)["summary"]["kept"] == 300
    with pytest.raises(OperationRefused):
        session.slide("stop", 1e5)


def test_pictures_are_brought_over_anew_only_where_the_map_has_moved():
    session = CorrectionSession(plant(n=2000, wrong=1, off=90, stop=99))
    first = session.drawn
    session.apply("delete", pair_of(session, 0))
    assert session.drawn == session.version > first
    observed, then = session.drawn, session.view.forward
    spots = np.random.default_rng(1).uniform(0, np.array(SIZE), (200, 2))
    renewed = 0
    for row in range(1, 60):
        session.apply("delete", pair_of(session, row))
        if session.drawn != observed:
            observed, then, renewed = session.drawn, session.view.forward, renewed + 1
        assert np.abs(session.view.forward(spots) - then(spots)).max() < 0.03
    assert renewed < 6


def test_an_answer_comes_back_from_its_bytes():
    session = CorrectionSession(plant(wrong=60, stop=1.0))
    session.apply("delete", describe(session)["pairs"][70])
    plain, record = describe(session), from_bytes(to_bytes(describe(session)))
    for name in ("residual", "leave_one_out", "weight", "round", "pairs"):
        assert np.array_equal(record[name], plain[name], equal_nan=True)
    for name in ("largest", "removed", "models"):
        assert np.array_equal(record["trace"][name], plain["trace"][name])
    for name in ("state", "reason"):
        assert words(record[name]) == words(plain[name])
    same = {"version", "drawn", "places", "summary", "refusal", "reject", "stop", "corrections"}
    assert {name: record[name] for name in same} == {name: plain[name] for name in same}


def test_an_answer_of_no_pairs_comes_back_too():
    record = describe(CorrectionSession(plant(n=0)))
    again = from_bytes(to_bytes(record))
    assert again["pairs"].shape == (0, 4) and again["trace"] is None
    assert again["state"]["words"] == [] and len(again["state"]["codes"]) == 0


def test_the_trace_can_be_drawn_from_what_the_screen_is_sent():
    session = CorrectionSession(plant(wrong=60, stop=1.0))
    record = describe(session)
    trace = record["trace"]
    assert len(trace["largest"]) == 61 and trace["removed"][-1] == -1
    assert trace["largest"][0] > trace["largest"][-1]
    from levkas.geometry.transforms import Polynomial

    centre, spread = np.array(trace["centre"]), trace["spread"]
    last = Polynomial(trace["order"], centre, spread, np.array(trace["models"][-1]))
    pairs = np.array(record["pairs"])
    residual = np.linalg.norm(last(pairs[:, 2:]) - pairs[:, :2], axis=1)
    np.testing.assert_allclose(residual, record["residual"], atol=0.02)


def test_a_layer_is_placed_by_hand_from_four_own_pairs_on_and_undo_takes_that_back():
    session = CorrectionSession(plant(n=6))
    for row in range(3):
        session.apply("pin", pair_of(session, row))
    with pytest.raises(OperationRefused, match="too few pairs"):
        session.accept(True)
    session.apply("add", [10, 10, 20, 20])
    session.accept(True)
    assert describe(session)["accept"] == "by hand"
    assert "accepted by hand" in describe(session)["corrections"]
    step = CorrectionStep.from_dict(json.loads(json.dumps(session.history.done[-1].to_dict())))
    assert step == session.history.done[-1]
    session.undo()
    assert describe(session)["accept"] == "" and len(session.edits.added) == 1


def test_places_that_cannot_be_are_refused():
    session = CorrectionSession(plant())
    size, target_size = plant().size, plant().target_size
    outside = ([-1, 2, 3, 4], [1, 2, 3, -7], [size[0], 2, 3, 4], [1, 2, 3, target_size[1] + 0.5])
    for pair in ([1, 2, 3], [1, 2, 3, float("nan")], [1e7, 2, 3, 4], *outside):
        with pytest.raises(OperationRefused):
            session.apply("add", pair)
    with pytest.raises(OperationRefused):
        session.apply("explode", [1, 2, 3, 4])
    assert session.can == {"undo": 0, "redo": 0}


STEPS = st.lists(st.tuples(st.sampled_from(sorted(OPERATIONS)), st.integers(0, 39)), max_size=25)


@pytest.mark.slow
@settings(max_examples=25)
@given(steps=STEPS)
def test_undo_brings_back_every_state_and_redo_every_later_one(steps):
    saved = []

    def save(before, after):
        assert before == (saved[-1] if saved else FrameEdits())
        saved.append(after)
        return after

    session = CorrectionSession(plant(n=40), save=save)
    observed = [session.edits]
    for name, row in steps:
        pair = pair_of(session, row)
        to = [*pair[:2], pair[2] + 0.5, pair[3]] if name == "move" else None
        session.apply(name, pair, to)
        if session.edits != observed[-1]:
            observed.append(session.edits)
    assert len(saved) == len(observed) - 1 and session.can["undo"] == len(observed) - 1
    for state in observed[-2::-1]:
        session.undo()
        assert session.edits == state
    for state in observed[1:]:
        session.redo()
        assert session.edits == state

"""Corrections on planted pairs: what an edit makes of the fit, and undo."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.campaign.edits import EditsConflict, FrameEdits, read_edits
from levkas.core.problems import Problem, Refused
from levkas.geometry.transforms import Polynomial
from levkas.registration.record import Matches
from levkas.workbench.answer import describe
from levkas.workbench.session import (
    MOST_STATES,
    OPERATIONS,
    CorrectionSession,
    OperationRefused,
    RecordedPairs,
)

SIZE = (1000, 800)
OUTLINE = ((10.0, 10.0), (400.0, 12.0), (390.0, 320.0))


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


def pair_of(session, row):
    matches = session.view.matches
    return [*matches.reference[row], *matches.target[row]]


def test_the_wrong_pair_is_the_worst_and_its_deletion_lets_the_error_fall():
    session = CorrectionSession(plant(wrong=1))
    assert describe(session)["summary"]["max"] > 3.5
    assert int(np.nanargmax(session.view.matches.residual)) == 0
    session.apply("delete", pair_of(session, 0))
    after = describe(session)
    assert after["summary"]["max"] < 0.5
    assert (after["state"][0], after["hand"][0]) == ("removed", "deleted")
    held_out = np.random.default_rng(9).uniform(100, 700, (200, 2))
    miss = session.view.forward(truth(held_out)) - held_out
    assert np.linalg.norm(miss, axis=1).max() < 0.1


def test_a_removed_pair_that_is_pinned_or_restored_stays():
    session = CorrectionSession(plant(wrong=1, stop=1.0))
    assert describe(session)["state"][0] == "removed"
    for operation, hand in (("pin", "pinned"), ("restore", "restored")):
        session.apply(operation, pair_of(session, 0))
        record = describe(session)
        assert (record["state"][0], record["hand"][0]) == ("kept", hand)
        session.undo()
    assert describe(session)["state"][0] == "removed"


def test_a_check_point_measures_and_is_not_fitted():
    session = CorrectionSession(plant(wrong=1))
    before = session.view.cleaned.model.coefficients.copy()
    place = np.array([400.0, 300.0])
    session.apply("check", [*(truth(place[None])[0] + [3.0, 0.0]), *place])
    record = describe(session)
    assert np.array_equal(session.view.cleaned.model.coefficients, before)
    assert record["state"][-1] == "check" and abs(record["residual"][-1] - 3.0) < 0.1
    session.apply("check", pair_of(session, 0))  # a found one leaves the fit
    record = describe(session)
    assert record["summary"]["checks"] == 2 and record["summary"]["max"] < 0.5


def test_a_moved_pair_is_where_it_was_put_and_undo_brings_it_back():
    session = CorrectionSession(plant(wrong=1))
    pair = pair_of(session, 0)
    session.apply("move", pair, [*truth(np.array([pair[2:]]))[0], *pair[2:]])
    assert describe(session)["summary"]["max"] < 0.5 and len(session.edits.moved) == 1
    session.undo()
    assert session.edits == FrameEdits() and describe(session)["summary"]["max"] > 3.5


def test_four_added_pairs_make_a_map_where_there_was_none():
    nothing = RecordedPairs(Matches.of(np.zeros((0, 2)), np.zeros((0, 2))), SIZE, SIZE)
    session = CorrectionSession(nothing)
    empty = describe(session)
    assert empty["refusal"] and empty["map"] is None and empty["pairs"] == []
    matrix = np.array([[0.3, -0.4], [0.4, 0.3]])
    for corner in np.array([[100.0, 100], [900, 120], [880, 700], [120, 690]]):
        session.apply("add", [*corner, *(matrix @ corner + [300, 50])])
    record = describe(session)
    assert record["refusal"] == "" and record["summary"]["kept"] == 4
    assert record["summary"]["mean"] is None and record["residual"] == [None] * 4, "no redundancy"
    inside = np.array([[500.0, 400.0]])
    assert np.allclose(session.view.forward(inside), inside @ matrix.T + [300, 50], atol=0.1)


def test_the_map_that_the_screen_is_sent_is_that_of_the_pairs():
    record = describe(CorrectionSession(plant(wrong=60, stop=1.0)))
    assert record["summary"]["kept"] == 240 and record["number"] == list(range(1, 301))
    sent = record["map"]
    terms = np.array(sent["terms"]).reshape(-1, 2)
    model = Polynomial(sent["order"], np.array(sent["centre"]), sent["spread"], terms)
    pairs = np.array(record["pairs"])
    residual = np.linalg.norm(model(pairs[:, 2:]) - pairs[:, :2], axis=1)
    np.testing.assert_allclose(residual, record["residual"], atol=0.02)


def test_a_layer_is_placed_by_hand_from_four_own_pairs_on_and_undo_takes_that_back():
    session = CorrectionSession(plant(n=6))
    for row in range(3):
        session.apply("pin", pair_of(session, row))
    with pytest.raises(OperationRefused):
        session.accept(True)
    session.apply("add", [10, 10, 20, 20])
    session.accept(True)
    assert describe(session)["accept"] == "by hand"
    session.undo()
    assert describe(session)["accept"] == "" and len(session.edits.added) == 1


@pytest.mark.parametrize(
    "pair", [[1, 2, 3], [1, 2, 3, np.nan], [-1, 2, 3, 4], [1, 2, 3, SIZE[1] + 0.5], [1e7, 2, 3, 4]]
)
def test_places_that_cannot_be_are_refused(pair):
    session = CorrectionSession(plant(n=5))
    for operation in ("add", "explode"):
        with pytest.raises(OperationRefused):
            session.apply(operation, pair)
    assert session.can == {"undo": 0, "redo": 0}


def test_a_pair_keeps_its_number_while_others_come_and_go():
    session = CorrectionSession(plant(n=40))
    own = [(300.0, 250.0, 310.0, 240.0), (20.0, 20.0, 30.0, 25.0), (150.0, 99.0, 160.0, 99.0)]
    for pair in own:
        session.apply("add", pair)
        session.number()

    def numbers():
        matches = session.view.matches
        places = np.round(np.hstack([matches.reference, matches.target]), 2).tolist()
        return dict(zip(map(tuple, places), session.number(), strict=True))

    assert [numbers()[pair] for pair in own] == [41, 42, 43]
    session.apply("delete", own[1])
    session.apply("add", (99.0, 77.0, 90.0, 70.0))
    assert numbers()[own[2]] == 43 and max(numbers().values()) == 44
    to = [*own[0][:2], own[0][2] + 1, own[0][3]]
    session.apply("move", own[0], to)
    found = np.round(pair_of(session, 7), 2).tolist()
    session.apply("move", found, [*found[:2], found[2] + 1, found[3]])
    there = (*found[:2], round(found[2] + 1, 2), found[3])
    assert numbers()[tuple(to)] == 41 and numbers()[there] == 8
    session.undo()
    session.undo()
    assert numbers()[own[0]] == 41
    session.refresh(plant(n=50))
    assert len(set(session.number())) == len(session.number()), "numbered anew after a build"


STEPS = st.lists(st.tuples(st.sampled_from(sorted(OPERATIONS)), st.integers(0, 39)), max_size=25)


@pytest.mark.slow
@settings(max_examples=25)
@given(steps=STEPS)
def test_undo_brings_back_every_state_and_redo_every_later_one(steps):
    saved = [FrameEdits()]

    def save(before, after):
        assert before == saved[-1]
        saved.append(after)
        return after

    session = CorrectionSession(plant(n=40), save=save)
    observed = [session.edits]
    for name, row in steps:
        pair = pair_of(session, row)
        session.apply(name, pair, [*pair[:2], pair[2] + 0.5, pair[3]] if name == "move" else None)
        if session.edits != observed[-1]:
            observed.append(session.edits)
    assert session.can["undo"] == len(observed) - 1
    for state in observed[-2::-1]:
        session.undo()
        assert session.edits == state
    for state in observed[1:]:
        session.redo()
        assert session.edits == state


def test_undo_goes_back_two_hundred_states_and_redo_ends_with_a_change():
    session = CorrectionSession(plant(n=5))
    for x in range(MOST_STATES + 5):
        session.apply("add", (float(x), 1.0, 1.0, 1.0))
    assert session.can == {"undo": MOST_STATES, "redo": 0}
    session.undo()
    session.take_all_back()
    assert session.can["redo"] == 0 and session.edits == FrameEdits()


def test_a_change_that_contradicts_anothers_is_refused_and_theirs_is_shown():
    theirs = FrameEdits(added=((9.0, 9.0, 9.0, 9.0),))

    def save(before, after):
        if before != theirs:
            raise EditsConflict(Problem("E_CONFLICT", "they were first"), present=theirs)
        return after

    session = CorrectionSession(plant(n=5), save=save)
    session.done = [(FrameEdits(), ())]
    with pytest.raises(EditsConflict):
        session.apply("add", (1, 2, 3, 4))
    assert session.edits == theirs and session.can == {"undo": 0, "redo": 0}
    session.apply("add", (1, 2, 3, 4))
    assert len(session.edits.added) == 2


def test_every_change_stands_in_the_file_and_what_another_wrote_ends_undo(
    library, frame, corrected
):
    path = library.edits_path
    path.write_text('version = 1\n[objects.icon.cameras."photo"]\nadded = [[1, 1, 1, 1]]\n')
    pair = describe(frame.session)["pairs"][0]
    frame.session.apply("delete", pair)
    assert len(corrected().deleted) == 1
    assert len(read_edits(path).frames["icon", "photo"].added) == 1
    frame.session.undo()
    assert corrected() == FrameEdits()
    path.write_text("version = 1\n[objects.icon.cameras.xray]\nadded = [[50, 50, 100, 90]]\n")
    library.catch_up(frame)
    assert frame.session.can == {"undo": 0, "redo": 0}
    assert len(describe(frame.session)["pairs"]) == 242


def test_an_outline_is_undone_and_redone_among_other_changes(library, frame, corrected):
    session, second = frame.session, ((9.0, 9.0), (50.0, 9.0), (9.0, 50.0))

    def drawn():
        return read_edits(library.edits_path).outlines.get("icon", ())

    session.draw(OUTLINE)
    session.apply("delete", describe(session)["pairs"][0])
    session.draw(second)
    assert drawn() == second and session.can == {"undo": 3, "redo": 0}
    for outline, deleted in ((OUTLINE, 1), (OUTLINE, 0), ((), 0)):
        session.undo()
        assert drawn() == session.outline == outline and len(corrected().deleted) == deleted
    for _ in range(3):
        session.redo()
    assert drawn() == second and len(corrected().deleted) == 1
    session.draw(())
    assert drawn() == () and describe(session)["outline"] == ()


@pytest.mark.parametrize(
    "corners",
    [((0, 0), (9000, 0), (9, 9)), ((0, 0), (90, 90), (90, 0), (0, 90)), ((0, 0), (90, 90))],
    ids=["outside", "crossing", "two"],
)
def test_an_outline_that_is_no_polygon_of_the_reference_is_refused(library, frame, corners):
    with pytest.raises(Refused) as refused:
        frame.session.draw(corners)
    assert refused.value.problems[0].code == "E_VALUE"
    assert frame.session.outline == () and frame.session.can == {"undo": 0, "redo": 0}
    assert not library.edits_path.exists()

"""What outlives the server: undo, the numbers of pairs, how pictures are turned."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.campaign.edits import FrameEdits, read_edits
from levkas.core.problems import Refused
from levkas.geometry.transforms import Affine
from levkas.registration.record import Matches
from levkas.workbench.answer import describe
from levkas.workbench.history import HISTORY_NAME, CorrectionStep, History
from levkas.workbench.library import Library, id_of
from levkas.workbench.session import CorrectionSession, RecordedPairs

XRAY = id_of("icon", "xray")


@pytest.fixture
def folder(correctable, tmp_path):
    return correctable.make(tmp_path / "campaign")


LIBRARIES = []


def session_of(folder):
    """Open the camera as another server does, once those before have kept all."""
    for library in LIBRARIES:
        library.settle()
    LIBRARIES[:] = [Library(folder)]
    return LIBRARIES[0].open(XRAY).session


def corrected(folder):
    return read_edits(folder / "edits.toml").frames.get(("icon", "xray"), FrameEdits())


def numbers(session):
    record = describe(session)
    places = np.round(np.hstack([session.view.matches.reference, session.view.matches.target]), 2)
    return {
        tuple(place): n for place, n in zip(places.tolist(), record["number"].tolist(), strict=True)
    }


def test_undo_and_redo_reach_back_over_the_end_of_the_server(folder):
    first = session_of(folder)
    pairs = describe(first)["pairs"].tolist()
    for operation, row in (("delete", 0), ("pin", 5), ("delete", 9)):
        first.apply(operation, pairs[row])
    first.slide("stop", 3.0)
    first.undo()
    states = [corrected(folder)]
    later = session_of(folder)
    assert later.can == {"undo": 3, "redo": 1}
    later.redo()
    assert corrected(folder).stop == 3.0
    for _ in range(4):
        later.undo()
        states.append(corrected(folder))
    assert states[-1] == FrameEdits() and states[-2].deleted and not states[-2].pinned
    last = session_of(folder)
    assert last.can == {"undo": 0, "redo": 4}


def test_undo_after_a_restart_leaves_what_an_editor_wrote_meanwhile(folder):
    session = session_of(folder)
    session.apply("delete", describe(session)["pairs"][0].tolist())
    path = folder / "edits.toml"
    path.write_text(path.read_text() + "added = [[50, 50, 100, 90]]\n")
    later = session_of(folder)
    later.undo()
    assert corrected(folder) == FrameEdits(added=((50.0, 50.0, 100.0, 90.0),))


def test_all_is_taken_back_and_comes_back_with_undo(folder):
    session = session_of(folder)
    pairs = describe(session)["pairs"].tolist()
    session.apply("delete", pairs[0])
    session.apply("check", pairs[4])
    before = corrected(folder)
    session.take_all_back()
    assert corrected(folder) == FrameEdits()
    assert session.edits == corrected(folder)
    session.undo()
    assert corrected(folder) == before


def test_a_pair_keeps_its_number_while_others_come_and_go_and_over_a_restart(folder, correctable):
    session = session_of(folder)
    spots = [[300.0, 250.0], [20.0, 20.0], [150.0, 99.0]]
    own = [(*spot, *np.round(correctable.truth(spot), 2).tolist()) for spot in spots]
    given_ = []
    for pair in own:
        session.apply("add", pair)
        given_.append(numbers(session)[tuple(pair)])
    assert given_ == [242, 243, 244]
    assert sorted(numbers(session).values()) == list(range(1, 245))
    session.apply("delete", own[1])
    assert numbers(session)[own[2]] == 244
    session.apply("add", (99.0, 77.0, *np.round(correctable.truth([99.0, 77.0]), 2).tolist()))
    assert max(numbers(session).values()) == 245, "a number that was given is given to no other"
    found = describe(session)["pairs"][7].tolist()
    session.apply("move", found, [*found[:2], found[2] + 1, found[3]])
    to = tuple(np.round([*found[:2], found[2] + 1, found[3]], 2).tolist())
    assert numbers(session)[to] == 8, "a pair that is moved keeps its number"
    session.apply("move", own[0], [*own[0][:2], own[0][2] + 1, own[0][3]])
    later = session_of(folder)
    assert numbers(later) == numbers(session)
    later.undo()
    assert numbers(later)[own[0]] == 242


def test_new_pairs_of_a_later_build_take_no_number_that_a_person_knows():
    nothing = RecordedPairs(Matches.of(np.zeros((0, 2)), np.zeros((0, 2))), (100, 80), (100, 80))
    session = CorrectionSession(nothing)
    for x in (10.0, 50.0, 90.0):
        session.apply("add", (x, 20.0, x, 21.0))
    assert describe(session)["number"].tolist() == [1, 2, 3]
    found = np.array([[30.0, 30.0], [60.0, 60.0]])
    session.refresh(RecordedPairs(Matches.of(found, found), (100, 80), (100, 80)))
    assert describe(session)["number"].tolist() == [4, 5, 1, 2, 3]


@pytest.mark.parametrize(
    "text",
    [
        "no JSON",
        "[]",
        '{"version": 3, "objects": {"icon": {"cameras": {"xray": {}}}}}',
        '{"version": 2, "objects": []}',
        '{"version": 2, "objects": {"icon": {"cameras": {"xray": {"done": 3}}}}}',
        *(
            json.dumps(
                {
                    "version": 2,
                    "objects": {
                        "icon": {
                            "turn": 45,
                            "cameras": {"xray": {"done": [step], "undone": [], "numbers": []}},
                        }
                    },
                }
            )
            for step in (
                {"removed": {"__class__": [[1, 2, 3, 4]]}, "new": {}, "values": {}},
                {"removed": {"added": [[1, 2, 3]]}, "new": {}, "values": {}},
                {"removed": {}, "new": {"stop": [[1, 2, 3, 4]]}, "values": {}},
                {"removed": {}, "new": {}, "values": {"added": [1, 2]}},
                {"removed": {}, "new": {}, "values": {"stop": ["<b>", 2.0]}},
            )
        ),
    ],
)
def test_a_damaged_history_costs_undo_and_nothing_else(folder, text):
    (folder / HISTORY_NAME).write_text(text)
    library = Library(folder)
    frame = library.open(XRAY)
    assert frame.session.can == {"undo": 0, "redo": 0} and library.turn_of(frame) == 0
    frame.session.apply("delete", describe(frame.session)["pairs"][0].tolist())
    library.settle()
    assert session_of(folder).can == {"undo": 1, "redo": 0}


def test_how_an_object_is_turned_is_kept_and_stands_upright_as_on_the_grid_at_first(folder):
    library = Library(folder)
    frame = library.open(XRAY)
    for degrees in (0, 90, 180, 270):
        turn = np.deg2rad(-degrees)  # of the grid back on to the reference
        slope = 2.0 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        frame.record["grid"] = {"transform": Affine(np.column_stack([slope, [3, 4]])).to_dict()}
        assert frame.upright == library.turn_of(frame) == degrees
    library.history.set_turn("icon", 90)
    again = Library(folder)
    assert again.turn_of(again.open(XRAY)) == 90
    assert again.history.turn("another") is None


def test_an_outline_is_undone_and_redone_among_other_changes_also_after_a_restart(folder):
    first, second = (
        ((10.0, 10.0), (400.0, 12.0), (390.0, 320.0)),
        ((9.0, 9.0), (50.0, 9.0), (9.0, 50.0)),
    )
    drawn = lambda: read_edits(folder / "edits.toml").outlines.get("icon", ())  # noqa: E731
    session = session_of(folder)
    session.draw(first)
    session.apply("delete", describe(session)["pairs"][0].tolist())
    session.draw(second)
    assert drawn() == second and session.can == {"undo": 3, "redo": 0}
    later = session_of(folder)
    assert later.outline == second
    for outline, deleted in ((first, 1), (first, 0), ((), 0)):
        later.undo()
        assert drawn() == later.outline == outline and len(corrected(folder).deleted) == deleted
    assert later.can == {"undo": 0, "redo": 3}
    for _ in range(3):
        later.redo()
    assert drawn() == second and len(corrected(folder).deleted) == 1
    later.draw(())
    assert drawn() == () and describe(later)["outline"] == ()


def test_an_outline_that_leaves_the_reference_or_crosses_itself_is_refused(folder):
    session = session_of(folder)
    for corners, code in (
        (((0, 0), (9000, 0), (9, 9)), "E_VALUE"),
        (((0, 0), (90, 90), (90, 0), (0, 90)), "E_VALUE"),
        (((0, 0), (90, 90)), "E_VALUE"),
    ):
        with pytest.raises(Refused) as refused:
            session.draw(corners)
        assert refused.value.problems[0].code == code and refused.value.problems[0].fix
    assert session.outline == () and session.can == {"undo": 0, "redo": 0}
    assert not (folder / "edits.toml").exists()


ROW = st.tuples(*[st.floats(0, 99).map(lambda v: round(v, 2))] * 4)
ROWS = st.lists(ROW, max_size=5).map(lambda rows: tuple(sorted(set(rows))))
STATES = st.builds(
    FrameEdits, deleted=ROWS, added=ROWS, pinned=ROWS, stop=st.none() | st.floats(0.1, 9)
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=60)
@given(before=STATES, after=STATES)
def test_a_step_leads_there_and_back_also_after_json(before, after):
    step = CorrectionStep.between(before, after)
    assert step.onward(before) == after and step.back(after) == before
    drawn = CorrectionStep(outline=((), ((0.0, 0.0), (9.0, 0.0), (9.0, 9.5))))
    history = History([step, drawn], [step], {(1.0, 2.0, 3.0, 4.0): 7})
    assert History.from_dict(json.loads(json.dumps(history.to_dict()))) == history

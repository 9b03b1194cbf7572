"""edits.toml: what is written is read, what is wrong is said, and a build knows what it hangs on."""

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from levkas.campaign.edits import (
    Edits,
    EditsConflict,
    EditsInvalid,
    FrameEdits,
    change_edits,
    change_outline,
    read_edits,
    sweep_corrections,
    write_edits,
)
from levkas.core.locks import locked

PX = st.integers(-5000, 500_000).map(lambda n: n / 100)
PAIR = st.tuples(PX, PX, PX, PX)
NAMES = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=20)


def pairs(kind):
    return st.lists(kind, max_size=4, unique=True).map(lambda rows: tuple(sorted(rows)))


FRAMES = st.builds(
    FrameEdits,
    added=pairs(PAIR),
    moved=pairs(st.tuples(*[PX] * 8)).map(lambda rows: tuple({r[:4]: r for r in rows}.values())),
    reject=st.none() | st.floats(10, 500),
    stop=st.none() | st.floats(0.01, 9),
)


@settings(max_examples=60, deadline=None)
@given(name=NAMES, frame=NAMES.filter(lambda s: ":" not in s), edits=FRAMES)
def test_what_is_written_is_read(tmp_path_factory, name, frame, edits):
    path = tmp_path_factory.mktemp("edits") / "edits.toml"
    assume(not {row[:4] for row in edits.moved} & set(edits.added))
    written = Edits({}).with_frame(name, frame, edits)
    write_edits(path, written)
    read = read_edits(path)
    assert set(read.frames) == set(written.frames)
    for key, one in read.frames.items():
        assert one.pairs()["added"].tolist() == written.frames[key].pairs()["added"].tolist()
        assert one == written.frames[key]


def test_everything_that_is_wrong_is_said_at_once(tmp_path):
    path = tmp_path / "edits.toml"
    path.write_text(
        "version = 1\n"
        "[objects.icon.cameras.nir]\n"
        "adde = [[1, 2, 3, 4]]\n"
        "deleted = [[1, 2, 3]]\n"
        "stop = -1\n"
        "pinned = [[1e9, 0, 0, 0]]\n"
    )
    with pytest.raises(EditsInvalid) as refused:
        read_edits(path)
    reported = {p.field: p for p in refused.value.problems}
    assert len(reported) >= 4 and all(p.file == str(path) and p.fix for p in reported.values())
    assert reported["objects.icon.cameras.nir.adde"].fix == "Did you mean 'added'?"


def test_one_pair_cannot_be_deleted_and_pinned(tmp_path):
    path = tmp_path / "edits.toml"
    path.write_text(
        "version = 1\n[objects.icon.cameras.nir]\n"
        "deleted = [[1, 2, 3, 4]]\npinned = [[1.001, 2, 3, 4]]\nreject = 2.0\nstop = 3.0\n"
    )
    with pytest.raises(EditsInvalid) as refused:
        read_edits(path)
    assert [p.field.rpartition(".")[2] for p in refused.value.problems] == ["pinned", "reject"]


def test_a_link_that_leads_nowhere_is_no_file_without_corrections(tmp_path):
    (tmp_path / "edits.toml").symlink_to(tmp_path / "gone/edits.toml")
    with pytest.raises(EditsInvalid) as refused:
        read_edits(tmp_path / "edits.toml")
    assert refused.value.problems[0].code == "E_UNREADABLE"
    assert str(tmp_path / "edits.toml") in refused.value.problems[0].file


def test_what_a_killed_workbench_left_is_taken_away_and_what_is_held_stays(tmp_path):
    names = [
        "edits.toml.levkas.partial-0123abcd",
        ".edits.toml.lock",
    ]
    others = [
        "edits.toml",
        "edits.toml.partial-0123abcd",
        ".other.lock",
        "notes.levkas.partial-0123abcd",
    ]
    for name in (*names, *others):
        (tmp_path / name).write_text("")
    with locked(tmp_path / ".edits.toml.lock"):
        sweep_corrections(tmp_path)
        assert (tmp_path / ".edits.toml.lock").exists()
    (tmp_path / ".edits.toml.lock").write_text("")
    sweep_corrections(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {*others}


OUTLINE = ((10.0, 10.0), (90.0, 12.25), (50.0, 80.0))


def test_an_outline_is_written_read_and_kept_by_other_changes(tmp_path):
    path = tmp_path / "edits.toml"
    one = FrameEdits(added=((1.0, 2.0, 3.0, 4.0),))
    edits = Edits({("icon", "nir"): one}).with_outline("icon", OUTLINE)
    write_edits(path, edits)
    assert read_edits(path) == edits
    more = FrameEdits(added=(*one.added, (5.0, 6.0, 7.0, 8.0)))
    change_edits(path, "icon", lambda _: "nir", one, more)
    assert read_edits(path) == edits.with_frame("icon", "nir", more)
    assert read_edits(path).with_outline("icon", ()).outlines == {}


@pytest.mark.parametrize(
    "corners",
    [
        "[[0, 0], [9, 9]]",
        "[[0, 0], [9, 9], [0, 0]]",
        "[[0, 0], [9, 9], [9, 0], [0, 9]]",
        "[[0, 0], [9, 0], [9, 9], [9, 0], [0, 9]]",
        "[[0, 0, 1], [9, 0], [9, 9]]",
        '"auto"',
    ],
)
def test_an_outline_that_is_no_polygon_is_refused(tmp_path, corners):
    path = tmp_path / "edits.toml"
    path.write_text(f"version = 1\n[objects.icon]\noutline = {corners}\n")
    with pytest.raises(EditsInvalid) as refused:
        read_edits(path)
    (problem,) = refused.value.problems
    assert problem.field == "objects.icon.outline"


@pytest.mark.parametrize(
    "text",
    [
        "version = 1\n",
        "# ours\nversion = 1\n[objects.icon.cameras.nir] # plate\nstop = 2\n[objects.b.cameras.x]\nstop = 1\n",
        "version = 1\nobjects = {icon = {cameras = {nir = {stop = 2}}}}\n",
    ],
)
def test_a_change_writes_the_file_anew_and_keeps_all_that_it_holds(tmp_path, text):
    path = tmp_path / "edits.toml"
    path.write_text(text)
    before = read_edits(path)
    assert change_outline(path, "icon", (), OUTLINE) == OUTLINE
    assert read_edits(path) == before.with_outline("icon", OUTLINE)
    assert change_outline(path, "icon", OUTLINE, ()) == ()
    write_edits(tmp_path / "plain.toml", before)
    assert path.read_bytes() == (tmp_path / "plain.toml").read_bytes()


def test_corrections_that_another_has_changed_are_not_written_over(tmp_path):
    path = tmp_path / "edits.toml"
    ours, theirs = FrameEdits(added=((1.0, 2.0, 3.0, 4.0),)), FrameEdits(stop=3.0)
    write_edits(path, Edits({("icon", "nir"): theirs}))
    there = path.read_bytes()
    with pytest.raises(EditsConflict) as refused:
        change_edits(path, "icon", lambda _: "nir", FrameEdits(), ours)
    assert refused.value.present == theirs and path.read_bytes() == there
    assert refused.value.problems[0].field == "objects.icon.cameras.nir"
    assert change_edits(path, "icon", lambda _: "xray", FrameEdits(), ours) == ours
    assert read_edits(path).frames[("icon", "nir")] == theirs


def test_an_editor_that_saves_while_a_change_is_made_keeps_what_it_saved(tmp_path):
    path = tmp_path / "edits.toml"

    def frame_of(edits):
        path.write_text("version = 1\n[objects.icon.cameras.nir]\nstop = 2\n")
        return "xray"

    with pytest.raises(EditsInvalid) as refused:
        change_edits(path, "icon", frame_of, FrameEdits(), FrameEdits(stop=3.0))
    assert refused.value.problems[0].code == "E_BUSY"
    assert list(read_edits(path).frames) == [("icon", "nir")]

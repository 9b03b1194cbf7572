"""A camera opened: predicted partners, snapping, tiles, and points in and out."""

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.workbench.correlation import find_partner
from levkas.workbench.library import FrameMissing, id_of
from levkas.workbench.pictures import TILE_PX, ShownPicture, warped_tile
from levkas.workbench.server.routes import describe_frame
from levkas.workbench.session import OperationRefused

PLACES = np.array([[120.0, 90.0], [300.0, 110.0], [150.0, 250.0], [330.0, 260.0]])


def test_every_camera_is_listed_with_its_verdict(library):
    listed = {row["camera"]: row for row in library.list()}
    assert set(listed) == {"photo", "xray"} and listed["photo"]["reference"]
    assert listed["xray"]["decision"] == "accept" and listed["xray"]["corrections"] == ""


def test_an_unknown_id_is_refused(library):
    for key in ("", "..", "../../etc/passwd", "icon/xray", "0" * 12):
        with pytest.raises(FrameMissing):
            library.open(key)


def test_the_partner_of_a_place_is_found_in_an_inverted_turned_picture(frame, correctable):
    for place in PLACES:
        reported = frame.partner(x=place[0], y=place[1], side="reference")
        assert np.linalg.norm(np.array(reported["pair"][2:]) - correctable.truth(place)) < 0.2
        assert reported["score"] > 0.8 and reported["sure"]


def test_the_partner_of_a_place_in_the_target_is_found_in_the_reference(frame, correctable):
    for place in PLACES:
        x, y = correctable.truth(place)
        reported = frame.partner(x=float(x), y=float(y), side="target")
        assert np.linalg.norm(np.array(reported["pair"][:2]) - place) < 0.2
        assert reported["pair"][2:] == pytest.approx([x, y], abs=1e-3)


def test_a_map_that_is_off_shows_by_how_much(frame):
    off = Affine(frame.built.matrix + np.array([[0, 0, 1.3 * 3.0], [0, 0, 0]]))
    pictures = frame.picture("reference"), frame.picture("target")
    for place in PLACES:
        found = find_partner(*pictures, off, place)
        assert abs(np.hypot(*found.shift) - 3.0) < 0.2
    reported = frame.partner(x=200.0, y=150.0, side="reference", which="built")
    assert reported["length"] < 0.2 and reported["length_mm"] == pytest.approx(
        reported["length"] / 2, abs=1e-3
    )


def test_a_blank_place_has_no_score(frame):
    blank = ShownPicture(np.full((340, 420), 90, np.uint8))
    found = find_partner(blank, frame.picture("target"), frame.built, PLACES[0])
    assert found.score == 0 and found.target == pytest.approx(frame.built(PLACES[:1])[0])


def test_a_pair_set_roughly_snaps_to_its_place(frame, correctable):
    place = PLACES[1]
    rough = [*place, *(correctable.truth(place) + np.array([2.5, -2.0]))]
    frame.session.apply("add", rough)
    frame.snap([round(v, 2) for v in rough])
    (snapped,) = frame.session.edits.added
    assert np.linalg.norm(np.array(snapped[2:]) - correctable.truth(place)) < 0.2
    frame.session.undo()
    assert frame.session.edits.added == (tuple(round(float(v), 2) for v in rough),)


def test_tiles_put_together_are_the_picture():
    pixels = np.random.default_rng(0).integers(0, 255, (700, 1100)).astype(np.uint8)
    picture = ShownPicture(pixels)
    rows = [np.hstack([picture.tile(0, c, r) for c in range(5)]) for r in range(3)]
    assert np.array_equal(np.vstack(rows), pixels)
    assert [level.shape for level in picture.levels] == [
        (700, 1100),
        (350, 550),
        (175, 275),
        (88, 138),
    ]
    for place in ((0, 5, 0), (0, -1, 0), (9, 0, 0), (-1, 0, 0), (0, 0, 3)):
        with pytest.raises(IndexError):
            picture.tile(*place)


def test_a_warped_tile_shows_what_the_map_says(frame):
    values, inside = warped_tile(
        frame.picture("target"), frame.built, frame.session.found.size, 0, 1, 0
    )
    reference = frame.picture("reference").pixels[:TILE_PX, TILE_PX : TILE_PX + values.shape[1]]
    good = inside.copy()
    good[:, -8:] = good[:4] = False
    # Both are shown by the roots of their values.
    ours, theirs = (np.square(v[good].astype(float)) for v in (reference, values))
    assert np.corrcoef(ours, theirs)[0, 1] < -0.98


def test_points_come_back_as_they_went(frame):
    for place in PLACES:
        reported = frame.partner(x=place[0], y=place[1], side="reference")
        frame.session.apply("add", reported["pair"])
    _, data = frame.export()
    before = set(frame.session.edits.added)
    while frame.session.can["undo"]:
        frame.session.undo()
    assert frame.session.edits.added == ()
    reported = frame.take(data)
    assert reported == {"imported": 4, "known": 241}
    after = np.array(sorted(frame.session.edits.added))
    np.testing.assert_allclose(after, np.array(sorted(before)), atol=0.011)
    frame.session.undo()
    assert frame.session.edits.added == ()


def test_what_was_never_built_says_how(folder, library):
    for path in (folder / "database/objects/icon/registration").iterdir():
        path.unlink()
    assert {row["decision"] for row in library.list()} == {"not built"}
    with pytest.raises(FrameMissing) as refused:
        library.open(id_of("icon", "xray"))
    assert refused.value.problems[0].code == "E_NOT_BUILT"


def test_nothing_to_snap_to_is_said(frame):
    frame.session.apply("add", [5, 5, 600, 500])
    with pytest.raises(OperationRefused):
        frame.snap([5, 5, 600, 500])


def test_a_refused_camera_has_the_outline_of_the_reference(frame):
    corners = [[10.0, 10.0], [400.0, 12.0], [390.0, 320.0]]
    frame.main_record["model"] = {"mask": {"outline": corners}}
    frame.record["model"] = {"kind": "none"}
    assert describe_frame(frame)["outline"] == corners


def test_an_object_stands_upright_as_on_the_grid_until_a_person_turns_it(library, frame):
    for degrees in (0, 90, 180, 270):
        turn = np.deg2rad(-degrees)  # of the grid back on to the reference
        slope = 2.0 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        frame.record["grid"] = {"transform": Affine(np.column_stack([slope, [3, 4]])).to_dict()}
        assert frame.upright == library.turn_of(frame) == degrees
    library.turns["icon"] = 90
    assert library.turn_of(frame) == 90

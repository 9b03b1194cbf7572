"""The outline of an object through a build: declared, corrected by hand, refused, drawn, and what it makes stale."""

import json

import pytest

from levkas.building import build, status, summarise
from levkas.campaign.edits import Edits, EditsInvalid, write_edits
from levkas.core.text import read_json
from levkas.workbench.library import Library, id_of

HALF = ((10.0, 10.0), (119.0, 10.0), (119.0, 189.0), (10.0, 189.0))
WIDER = ((10.0, 10.0), (200.0, 10.0), (200.0, 189.0), (10.0, 189.0))


def record_of(folder):
    return read_json(folder / "database/objects/one/registration/infrared.json")


def stale(folder):
    return {step.key.stage for step in status(folder).stages if step.state == "stale"}


@pytest.mark.slow
def test_an_outline_is_compared_within_drawn_corrected_by_hand_and_refused_by_its_file(
    make_plates, tmp_path
):
    folder = make_plates(tmp_path / "campaign", ["one"])
    toml = folder / "campaign.toml"
    plain = toml.read_text()
    toml.write_text(f"{plain}\n[objects.one]\noutline = {json.dumps(HALF)}\n")
    report = build(folder)
    assert summarise(report).ok
    record, share = record_of(folder), 110 * 180 / (240 * 200)
    mask, verdict = record["model"]["mask"], record["verdict"]
    assert not mask["automatic"] and mask["outline"] == [list(corner) for corner in HALF]
    assert abs(verdict["outside"] - (1 - share)) < 0.01 < verdict["outside"] <= verdict["unchecked"]
    page = (folder / "database/objects/one/report.html").read_text()
    assert "Outline of the object" in page and "As declared." in page
    assert "lies outside the object&#39;s outline" in page
    checked = f"{round(100 * (1 - verdict['unchecked']))} % of the layer"
    assert page.count(checked) >= 2 and "outline" not in read_text(folder, "object.toml")
    assert stale(folder) == set()
    # By hand it is corrected; what was calibrated stays.
    write_edits(folder / "edits.toml", Edits().with_outline("one", WIDER))
    assert "register" in stale(folder) and "calibrate" not in stale(folder)
    assert summarise(build(folder)).ok
    assert record_of(folder)["model"]["mask"]["outline"] == [list(corner) for corner in WIDER]
    assert record_of(folder)["verdict"]["outside"] < verdict["outside"] - 0.2
    # The workbench knows with which outline that was registered, and draws another.
    library = Library(folder)
    frame = library.open(id_of("one", "infrared"))
    registered = library.registered_with(frame)["registered_outline"]
    assert registered == [list(corner) for corner in frame.session.outline]
    assert frame.session.outline == WIDER and library.declared_outline(frame) == HALF
    assert stale(folder) == set()
    frame.session.draw(())
    assert "register" in stale(folder)
    # One that leaves the frame is refused by the file that has it, and nothing else is.
    write_edits(folder / "edits.toml", Edits().with_outline("one", (*WIDER[:2], (900.0, 189.0))))
    (problem, *_) = [p for step in build(folder) for p in getattr(step, "problems", ())]
    assert problem.file.endswith("edits.toml") and problem.field == "objects.one.outline"
    assert "outside the reference" in problem.message and "(900, 189)" in problem.found


def read_text(folder, name):
    return (folder / "database/objects/one" / name).read_text()


def test_an_outline_of_an_object_that_is_not_there_is_refused(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one"])
    write_edits(folder / "edits.toml", Edits().with_outline("ono", HALF))
    with pytest.raises(EditsInvalid) as refused:
        list(build(folder))
    (problem,) = refused.value.problems
    assert (problem.field, problem.found, problem.expected) == ("objects.ono", "ono", "one")

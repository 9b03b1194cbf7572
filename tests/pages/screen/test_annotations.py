"""Notes are published as they were written, and a file made to break a page is refused."""

import pytest

from levkas.core.problems import Refused
from levkas.publish.annotations import Annotations, read_annotations

from .hostile import ANNOTATIONS, TITLES, fragment, note, page, svg

SIZES = {"icon1": (120, 90), "icon2": (48, 64)}
FULL = {"id": "https://example.org/a/iiif/icon1/canvas", "width": 120, "height": 90}


def read(tmp_path, text, sizes=SIZES):
    path = tmp_path / "notes.json"
    path.write_text(text, encoding="utf-8")
    return read_annotations([path], sizes)


@pytest.mark.parametrize("name", ANNOTATIONS)
def test_a_hostile_file_of_notes_is_refused_with_its_field(tmp_path, name):
    with pytest.raises(Refused) as refused:
        read(tmp_path, ANNOTATIONS[name])
    (problem,) = refused.value.problems
    assert problem.file.endswith("notes.json") and problem.fix
    assert max(map(len, problem.lines)) < 2500


def test_of_sixty_hostile_texts_those_without_markup_are_taken_as_they_are(tmp_path):
    taken = []
    for title in TITLES:
        try:
            found = read(tmp_path, page(note(title)))
        except Refused as refused:
            assert "<" in title or "\\x" in title, refused
        else:
            assert found["icon1"][0]["body"]["value"] == title
            taken.append(title)
    assert 20 < len(taken) < 40 and not any("<script" in title for title in taken)


def test_notes_of_every_shape_are_read_and_scaled_to_the_canvas(tmp_path):
    corners = '<polygon points="1,1 100,1 100.5,60"/>'
    circle = "<circle cx='20' cy='30' r='5.5' />"
    notes = [
        note(source=FULL),
        note(source=FULL, selector=fragment("xywh=pixel:119,89,1,1")),
        note(source=FULL, selector=[svg(corners)], creator="Ada", created="2026-01-02"),
        note(source=FULL, selector=svg(circle, "<svg xmlns='http://www.w3.org/2000/svg'>")),
        note("plain & <3 a < b", target=f"{FULL['id']}#xywh=0,0,120,90"),
    ]
    values = [n["target"]["selector"]["value"] for n in read(tmp_path, page(*notes))["icon1"]]
    head, end = '<svg xmlns="http://www.w3.org/2000/svg">', "</svg>"
    assert values == [
        "xywh=3,4,5,6",
        "xywh=119,89,1,1",
        f"{head}{corners}{end}",
        f'{head}<circle cx="20" cy="30" r="5.5"/>{end}',
        "xywh=0,0,120,90",
    ]
    half = read(tmp_path, page(*notes[:4]), {"icon1": (60, 45)})["icon1"]
    assert [n["target"]["selector"]["value"] for n in half] == [
        "xywh=1.5,2,2.5,3",
        "xywh=59,44,1,1",
        f'{head}<polygon points="0.5,0.5 50,0.5 50.2,30"/>{end}',
        f'{head}<circle cx="10" cy="15" r="2.8"/>{end}',
    ]
    assert half[2]["creator"]["name"] == "Ada" and half[2]["modified"] == "2026-01-02"


def test_a_later_file_replaces_notes_of_one_id_and_adds_others(tmp_path):
    first, second = tmp_path / "a.json", tmp_path / "b.json"
    name = "urn:uuid:0f0e0d0c-0000-4000-8000-000000000000"
    first.write_text(page(note("old", id=name), note("other")))
    second.write_text(page(note("new", id=name)))
    texts = [n["body"]["value"] for n in read_annotations([first, second], SIZES)["icon1"]]
    assert texts == ["other", "new"]
    ids = [
        n["id"] for n in Annotations("https://x/", SIZES, {"icon1": [{"target": {}}]}).of("icon1")
    ]
    assert ids == ["https://x/iiif/icon1/canvas/notes/1"]

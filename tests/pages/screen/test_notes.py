"""Notes in the viewer: written, kept, exported, imported, published; a file made to break the page does nothing."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from levkas.publish.annotations import Annotations, read_annotations

from .database import SIZE, write_database
from .hostile import ANNOTATIONS, CANVAS, TITLES, fragment, note, page, svg
from .test_viewer import click_pixel, drag, open_object

SIZES = {"icon1": SIZE, "icon2": SIZE}
EVIL = """() => ({
  evil: window.evil ?? null,
  tags: [...document.querySelectorAll('#notes *, .stage *')].map(e => e.tagName.toLowerCase())
    .filter(t => ['script', 'iframe', 'img', 'object', 'embed', 'foreignobject', 'animate', 'style', 'a'].includes(t)),
  attributes: [...document.querySelectorAll('#notes *, .stage *')].flatMap(e => [...e.attributes])
    .filter(a => /^on|^srcdoc$|href$/i.test(a.name)).map(a => a.name),
})"""


def take(opened, tmp_path, text, name="notes.json"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    opened.evaluate("document.querySelector('#notes [role=status]').textContent = ''")
    opened.get_by_label("File of notes").set_input_files(path)
    opened.wait_for_function(
        "() => /imported|refused/.test(document.querySelector('#notes [role=status]').textContent)"
    )
    return opened.locator("#notes [role=status]").inner_text()


def texts(opened):
    return opened.locator("#notes textarea").evaluate_all("all => all.map(e => e.value)")


@pytest.mark.slow
def test_notes_are_written_on_places_and_shapes_kept_and_exported_as_annotations(
    browser, address, tmp_path
):
    opened = open_object(browser, address("file"))
    click_pixel(opened, 30, 40)
    opened.keyboard.press("n")
    opened.keyboard.type("A loss, filled.\nSee 2019.")
    opened.get_by_label("Your name").fill("Ada")
    opened.get_by_role("button", name="Note on a rectangle").click()
    drag(opened, (60, 20), (80, 35))
    opened.get_by_label("Text of note 2").fill("Overpaint")
    opened.get_by_role("button", name="Note on a circle").click()
    drag(opened, (90, 90), (100, 90))
    opened.get_by_role("button", name="Note on a polygon").click()
    for x, y in ((20, 80), (70, 85), (45, 110)):
        opened.mouse.click(*opened.evaluate(f"levkasViewer.stage.left.pageOf({x}, {y})"))
    opened.keyboard.press("Enter")
    opened.wait_for_function("() => document.querySelectorAll('#notes textarea').length === 4")
    marks = opened.locator(".cell-a .region-number").all_text_contents()
    assert marks == ["N1 A loss, filled.", "N2 Overpaint", "N3 ", "N4 "]
    assert "stay in this browser" in opened.locator("#notes").inner_text()
    with opened.expect_download() as download:
        opened.get_by_role("button", name="Export notes").click()
    path = Path(download.value.path())
    made = json.loads(path.read_text("utf-8"))
    assert made["@context"] == "http://www.w3.org/ns/anno.jsonld"
    first, second = made["items"][:2]
    assert first["body"] == {
        "type": "TextualBody",
        "value": "A loss, filled.\nSee 2019.",
        "format": "text/plain",
    }
    assert first["target"]["source"]["id"] == CANVAS
    assert first["target"]["selector"]["value"] == "xywh=30,40,1,1"
    assert second["target"]["selector"]["value"] == "xywh=60,20,21,16"
    assert second["creator"] == {"type": "Person", "name": "Ada"} and "creator" not in first
    drawn = [item["target"]["selector"]["value"] for item in made["items"][2:]]
    assert "><circle cx=" in drawn[0] and "><polygon points=" in drawn[1]
    # What the page exports is what is published.
    assert len(read_annotations([path], SIZES)["icon1"]) == 4
    # They are there again, for this object alone.
    shapes = opened.evaluate("levkasViewer.state.notes.value")
    opened.reload()
    opened.wait_for_selector("#notes textarea")
    assert texts(opened) == ["A loss, filled.\nSee 2019.", "Overpaint", "", ""]
    again = opened.evaluate("levkasViewer.state.notes.value")
    assert [one["id"] for one in again] == [one["id"] for one in shapes]
    for old, new in zip(shapes, again, strict=True):
        assert old["shape"]["kind"] == new["shape"]["kind"]
        np.testing.assert_allclose(old["shape"]["points"][0], new["shape"]["points"][0], atol=0.11)
    opened.goto(address("file", "viewer/objects/icon2/index.html"))
    opened.wait_for_selector("#notes button")
    assert opened.locator("#notes textarea").count() == 0
    # A removed note can be put back; an exported file brings all of them to another browser.
    opened.goto(address("file"))
    opened.get_by_role("button", name="Remove note 2").click()
    assert opened.locator("#notes textarea").count() == 3
    opened.get_by_role("button", name="Put the note back").click()
    assert texts(opened)[-1] == "Overpaint"
    other = open_object(browser, address("file"))
    assert "4 notes imported" in take(other, tmp_path, path.read_text("utf-8"))
    assert "4 notes imported" in take(other, tmp_path, path.read_text("utf-8"))
    assert texts(other) == ["A loss, filled.\nSee 2019.", "Overpaint", "", ""]
    assert other.locator("#notes .region-words").nth(1).inner_text().startswith("Ada, 20")


@pytest.mark.slow
def test_every_hostile_file_of_notes_is_refused_with_a_sentence_and_nothing_runs(
    browser, address, tmp_path
):
    opened = open_object(browser, address("file"))
    take(opened, tmp_path, page(note("A crack")))
    for name, text in ANNOTATIONS.items():
        said = take(opened, tmp_path, text, "evil.json")
        assert said.startswith("evil.json was refused: ") and said.endswith("."), name
        assert len(said) < 300, name
        state = opened.evaluate(EVIL)
        assert state == {"evil": None, "tags": [], "attributes": []}, name
        assert texts(opened) == ["A crack"], name
    assert opened.evaluate("Object.prototype.type ?? null") is None


@pytest.mark.slow
def test_sixty_hostile_texts_typed_or_imported_are_text_or_refused(browser, address, tmp_path):
    opened = open_object(browser, address("file"))
    kept = []
    for title in TITLES:
        said = take(opened, tmp_path, page(note(title)))
        if "1 note imported" in said:
            kept.append(title)
        else:
            assert "markup" in said or "control" in said, title
    assert texts(opened) == kept and 20 < len(kept) < 40
    for number, title in enumerate(TITLES):
        opened.get_by_role("button", name="Note here").click()
        opened.get_by_label(f"Text of note {len(kept) + number + 1}", exact=True).fill(title)
    opened.get_by_label("Your name").fill(TITLES[7])
    opened.get_by_role("button", name="Note here").click()
    stored = opened.evaluate("levkasViewer.state.notes.value.map(n => n.text)")[len(kept) :]
    # Kept as typed; in the file an invisible joiner stands behind each < that would begin markup.
    guarded = [re.sub("<(?=[A-Za-z/!?])", "<\u2060", title) for title in TITLES]
    assert stored == [*TITLES, ""] and texts(opened)[len(kept) :] == [*TITLES, ""]
    assert opened.evaluate(EVIL) == {"evil": None, "tags": [], "attributes": []}
    # What was typed is taken by another browser, and published.
    with opened.expect_download() as download:
        opened.get_by_role("button", name="Export notes").click()
    path = Path(download.value.path())
    found = read_annotations([path], SIZES)["icon1"]
    assert [one["body"]["value"] for one in found] == [*kept, *guarded, ""]
    other = open_object(browser, address("file"))
    assert "notes imported" in take(other, tmp_path, path.read_text("utf-8"))
    assert texts(other) == [*kept, *TITLES, ""]
    assert other.evaluate(EVIL) == {"evil": None, "tags": [], "attributes": []}


def test_what_lies_in_the_browser_is_read_as_warily_and_set_aside(browser, address):
    opened = open_object(browser, address("file"))
    key = 'levkas-notes:["A small database, Ada Painter","icon1"]'
    evil = ANNOTATIONS["svg with onload"]
    opened.evaluate("([k, v]) => localStorage.setItem(k, v)", [key, evil])
    opened.reload()
    opened.wait_for_selector("text=They are set aside")
    assert opened.evaluate("k => localStorage.getItem(k + ':unreadable')", key) == evil
    assert opened.evaluate(EVIL) == {"evil": None, "tags": [], "attributes": []}


def test_where_nothing_may_be_stored_notes_work_and_the_page_says_so(browser, address):
    opened = browser.page()
    opened.add_init_script(
        "Object.defineProperty(window, 'localStorage', {get() { throw new DOMException('no'); }})"
    )
    opened.goto(address("file"))
    opened.wait_for_selector("text=This browser stores nothing for this page")
    opened.keyboard.press("n")
    opened.keyboard.type("still here")
    with opened.expect_download() as download:
        opened.get_by_role("button", name="Export notes").click()
    made = json.loads(Path(download.value.path()).read_text("utf-8"))
    assert made["items"][0]["body"]["value"] == "still here"


@pytest.fixture(scope="module")
def published(add_viewer, tmp_path_factory):
    """Folder of a database whose first object has published notes of every shape."""
    root = tmp_path_factory.mktemp("published") / "database"
    write_database(root, {"icon1": "First icon", "icon2": "Second icon"})
    notes = [
        note("Gold, = {{7*7}} javascript:window.evil=1 " + "long " * 30, creator="Ada"),
        note("b", selector=svg('<polygon points="20,80 70,85 45,110"/>')),
        note("c", selector=svg('<circle cx="90.5" cy="90.5" r="10"/>')),
        note("d", selector=fragment("xywh=100,20,1,1")),
    ]
    path = root.with_name("notes.json")
    path.write_text(page(*notes))
    items = read_annotations([path], SIZES)
    return add_viewer(root, notes=Annotations("http://localhost:8000/", SIZES, items))


def test_published_notes_are_shown_and_marked_and_those_of_a_reader_beside_them(browser, published):
    opened = open_object(browser, f"{published.as_uri()}/viewer/objects/icon1/index.html")
    shown = opened.locator(".published-notes .note-text").all_inner_texts()
    assert shown[0].startswith("Gold, = {{7*7}}") and shown[1:] == ["b", "c", "d"]
    assert opened.locator(".cell-a .region-line.dashed").count() == 4
    opened.locator(".published-notes .note-place").nth(2).click()
    opened.wait_for_selector('.place[data-pixel="90,90"]')
    opened.keyboard.press("n")
    opened.keyboard.type("mine")
    marks = opened.locator(".cell-a .region-number").all_text_contents()
    assert marks[-1] == "N1 mine" and marks[1:4] == ["P2 b", "P3 c", "P4 d"]
    opened.keyboard.press("Escape")
    opened.evaluate("document.activeElement.blur()")
    opened.keyboard.press("h")
    assert not opened.locator(".cell-a .region-line").first.is_visible()
    assert opened.evaluate(EVIL) == {"evil": None, "tags": [], "attributes": []}

"""Notes are published with the database, or stop it before anything is written."""

import json

import pytest

from levkas.core.problems import Refused
from levkas.publish import run

FULL = {"id": "https://example.org/a/iiif/icon1/canvas", "width": 120, "height": 90}
OFF = '<svg xmlns="http://www.w3.org/2000/svg" onload="window.evil=1"><polygon points="1,1 9,1 9,9"/></svg>'


def page(text="A loss", source=FULL, selector=None):
    """Return a file of one note, as the viewer exports it."""
    selector = selector or {"type": "FragmentSelector", "value": "xywh=3,4,5,6"}
    body = {"type": "TextualBody", "value": text, "format": "text/plain"}
    target = {"source": source, "selector": selector}
    note = {"type": "Annotation", "motivation": "commenting", "body": body, "target": target}
    return json.dumps({"type": "AnnotationPage", "items": [note]})


def test_notes_are_in_the_manifest_and_on_the_page(database, publish, tmp_path):
    pytest.importorskip("iiif_prezi3")
    files = tmp_path / "notes"
    files.mkdir()
    (files / "from-ada.json").write_text(page())
    subject = run.find_subject(database, notes=files)
    folder = publish(subject, url="https://example.org/icons")
    manifest = json.loads((folder / "iiif/icon1/manifest.json").read_text())
    (canvas,) = manifest["items"]
    (annotation,) = canvas["annotations"][0]["items"]
    assert canvas["annotations"][0]["type"] == "AnnotationPage"
    assert annotation["motivation"] in ("commenting", ["commenting"])
    assert annotation["body"]["value"] == "A loss" and annotation["body"]["format"] == "text/plain"
    assert annotation["target"]["selector"]["value"] == "xywh=3,4,5,6"
    source = annotation["target"]["source"]
    assert source in (canvas["id"], {"id": canvas["id"], "type": "Canvas"})
    assert (
        "annotations"
        not in json.loads((folder / "iiif/icon2/manifest.json").read_text())["items"][0]
    )
    text = (folder / "viewer/objects/icon1/index.html").read_text()
    record = json.loads(text.split('id="record">')[1].split("</script>")[0])
    assert record["notes"][0]["body"]["value"] == "A loss"
    assert record["canvas"]["id"] == canvas["id"] and record["canvas"]["width"] == 120


def test_notes_that_cannot_be_published_stop_check_and_publish_before_anything_is_written(
    database, publish, tmp_path
):
    path = tmp_path / "notes.json"
    path.write_text(page(selector={"type": "SvgSelector", "value": OFF}))
    report = run.check(database, path)
    assert not report.ok and report.problems[0].field == "items[0].target.selector.value"
    with pytest.raises(Refused):
        publish(run.find_subject(database, notes=path), output=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    path.write_text(page(text="half of a \ud83d"))
    with pytest.raises(Refused, match="half of a character"):
        publish(run.find_subject(database, notes=path), output=tmp_path / "out")
    empty = tmp_path / "empty"
    empty.mkdir()
    for missing in (empty, tmp_path / "nowhere.json"):
        with pytest.raises(Refused):
            run.check_notes(run.find_subject(database, notes=missing))
    path.write_text(page(source="x/iiif/icon3/canvas"))
    with pytest.raises(Refused, match="Did you mean 'icon"):
        run.check_notes(run.find_subject(database, notes=path))

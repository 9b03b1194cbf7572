"""Objects of a session built while it lasts: by the build itself, so that a later build finds them done."""

from __future__ import annotations

import time
from multiprocessing import SimpleQueue

import pytest

from levkas.building import build
from levkas.workbench.watching import WatchedSession
from levkas.workbench.watching.cache import MeasureCache
from levkas.workbench.watching.previews import RegisteredPreviews, build_objects, objects_to_build


@pytest.fixture
def session(make_plates, tmp_path):
    return WatchedSession(make_plates(tmp_path / "plates"), MeasureCache(tmp_path / "cache"))


def test_an_object_is_ready_when_the_reference_has_it_and_nothing_is_being_written(session):
    state = session.settle()
    ready = objects_to_build(session.campaign, state)
    assert list(ready) == sorted({f.file.target for f in state.frames})
    path, file = next((p, f) for p, f in session.listing.files.items() if f.camera == "photo")
    path.write_bytes(path.read_bytes()[:100])
    for _ in session.poll(time.monotonic() + 1):
        pass
    assert file.target not in objects_to_build(session.campaign, session.state())


def iter_of(news):
    while not news.empty():
        yield news.get()


@pytest.mark.slow
def test_what_was_built_meanwhile_is_what_a_build_makes(session, make_plates, tmp_path):
    state = session.settle()
    root = session.watch.root
    news = SimpleQueue()
    names = list(objects_to_build(session.campaign, state))
    layers, problems = build_objects(str(root), names, news)
    assert {layer["camera"] for layer in layers} == set(session.campaign.cameras)
    assert problems == []
    assert sorted(early["camera"] for early in iter_of(news)) == sorted(
        layer["camera"] for layer in layers
    )
    assert {step.state for step in build(root) if step.key.stage != "catalogue"} <= {"fresh"}
    alone = make_plates(tmp_path / "alone")
    list(build(alone))
    for path in sorted((root / "database").rglob("*.tif")):
        assert (
            path.read_bytes()
            == (alone / "database" / path.relative_to(root / "database")).read_bytes()
        )
    previews = RegisteredPreviews(session)
    previews.layers = {(la["object"], la["camera"], ""): la for la in layers}
    first = layers[0]
    assert previews.picture_of(first["object"], first["camera"], "").startswith(b"\x89PNG")
    assert previews.picture_of("../..", first["camera"], "") is None

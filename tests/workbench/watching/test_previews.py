"""Objects of a session built while it lasts: by the build itself, so that a later build finds them done."""

from __future__ import annotations

import time
from queue import SimpleQueue

import numpy as np
import pytest

from levkas.building import build
from levkas.building.claiming import places_of
from levkas.building.plan import read_plan
from levkas.building.run import build_layers
from levkas.building.tasks import ReferenceMemory
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


def bytes_of(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.slow
def test_what_was_built_meanwhile_is_what_a_build_makes(session, make_plates, tmp_path):
    state = session.settle()
    root = session.watch.root
    news = SimpleQueue()
    names = list(objects_to_build(session.campaign, state))
    layers, problems = build_objects(str(root), names, news)
    assert {layer["camera"] for layer in layers} == set(session.campaign.cameras)
    assert problems == []
    early = list(iter_of(news))
    assert [(one["camera"], one["verdict"]) for one in early if one["picture"] is None] == [
        (one["camera"], one["verdict"]) for one in early if one["picture"] is not None
    ]
    assert {one["camera"]: one["verdict"] for one in early} == {
        one["camera"]: one["verdict"] for one in layers
    }
    again = [
        step for step in build(root) if step.key.stage in ("calibrate", "register", "resample")
    ]
    assert {step.state for step in again} == {"fresh"}
    alone = make_plates(tmp_path / "alone")
    list(build(alone))
    assert bytes_of(root / "database") == bytes_of(alone / "database")
    previews = RegisteredPreviews(session)
    previews._show(*early)
    previews._show(*layers)
    first = layers[0]
    shown = previews.picture_of(first["object"], first["camera"], "")
    assert (
        shown
        == places_of(session.campaign)
        .layer(first["object"], first["camera"], "", kind=".png")
        .read_bytes()
    )
    assert previews.picture_of("../..", first["camera"], "") is None


@pytest.mark.slow
def test_the_reference_is_calibrated_once_though_cameras_come_one_by_one(
    make_plates, tmp_path, monkeypatch
):
    """Each build but the first would calibrate it again; another campaign or another frame of it does so."""
    from levkas.stages import calibrate

    root, done, develop = make_plates(tmp_path / "plates"), [], calibrate.develop
    monkeypatch.setattr(
        calibrate,
        "develop",
        lambda capture, *a: done.append(capture.camera) or develop(capture, *a),
    )
    plan = read_plan(root)
    reference = plan.campaign.reference.camera
    late = next(one for one in plan.captures if one.camera != reference)
    contents = {f.path: f.path.read_bytes() for f in late.sensors[0].object}
    for path in contents:
        path.unlink()
    memory = ReferenceMemory()
    list(build_layers(root, [late.object], memory))
    for path, data in contents.items():
        path.write_bytes(data)
    done.clear()
    list(build_layers(root, [late.object], memory))
    assert done == [late.camera]
    list(build(root))
    alone = make_plates(tmp_path / "alone")
    list(build(alone))
    assert bytes_of(root / "database") == bytes_of(alone / "database")
    toml, frame = root / "campaign.toml", memory.frame
    toml.write_text(toml.read_text() + "\n[registration]\nstop = 0.9\n")
    list(build_layers(root, [late.object], memory))
    assert frame is not None and memory.frame is not frame


@pytest.mark.slow
def test_a_build_after_a_disorderly_session_has_the_bytes_of_a_batch_build(make_plates, tmp_path):
    """Frames come in any order, every third half at first or as another's, with copies that go away; layers are built in between."""
    alone, root = make_plates(tmp_path / "alone"), make_plates(tmp_path / "plates")
    frames = sorted(f for c in read_plan(root).captures for f in _files_of(c))
    whole = {path: path.read_bytes() for path in frames}
    for path in frames:
        path.unlink()
    rng = np.random.default_rng(4)
    session = WatchedSession(root, MeasureCache(tmp_path / "cache"))
    late = []
    for k in rng.permutation(len(frames)):
        data, other = whole[frames[k]], whole[frames[rng.integers(len(frames))]]
        late += [frames[k]] if k % 3 < 2 else []
        frames[k].write_bytes((data[: len(data) // 2], other, data)[k % 3])
        list(session.poll())
    for name in objects_to_build(session.campaign, session.state()):
        list(build_layers(root, [name], ReferenceMemory()))
    for path in late:
        path.write_bytes(whole[path])
    state = session.settle()
    assert not any(frame.verdict == "waiting" for frame in state.frames)
    build_objects(str(root), list(objects_to_build(session.campaign, state)), SimpleQueue())
    list(build(root))
    list(build(alone))
    assert bytes_of(root / "database") == bytes_of(alone / "database")


def _files_of(capture):
    return {f.path for s in capture.sensors for f in (*s.object, *s.dark, *s.white)}

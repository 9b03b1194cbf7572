"""A stage is added where the page of the architecture says, here one that reads the files of the stage before it."""

from functools import partial

import cv2
import numpy as np
import pytest

from levkas.building import build, build_records, fingerprints, graph, outcomes, summarise, tasks
from levkas.building.build_records import key_of
from levkas.core.files import together, write_text
from levkas.database.layout import LayerId
from levkas.database.opening import open_layer
from levkas.stages import sources
from levkas.stages.sources import NUMBERS, made_with
from levkas.stages.written import Written


def write_means(means, capture, places, before):
    path = places.layer(capture.object, capture.camera, capture.setup, kind=".means.csv")
    with together(before):
        write_text(path, "".join(f"{mean:.6g}\n" for mean in means))
    return Written([path], {})


@pytest.fixture
def means(monkeypatch):
    """Add the stage `means`: the mean of every band of a layer, as a table."""
    tasks_of, prints_of = graph._tasks_of, fingerprints.Inputs._prints
    compute_of, stages_of = tasks.Stages.compute, graph.keys_of

    def keys_of(campaign, capture):
        return {**stages_of(campaign, capture), "means": key_of(capture, "means")}

    def with_means(campaign, capture, mine, captures):
        yield from tasks_of(campaign, capture, mine, captures)
        layer, of = key_of(capture, "resample"), (capture, mine[0])
        yield graph.Task(key_of(capture, "means"), (layer,), (), *of)

    def prints(self, task, refused):
        if task.key.stage != "means":
            return prints_of(self, task, refused)
        return {**made_with("means"), "layer": self.digests[key_of(task.capture, "resample")]}

    def compute(self, task):
        if task.key.stage != "means":
            return compute_of(self, task)
        capture, places = task.capture, self.places
        layer = LayerId(capture.object, capture.camera, capture.setup)
        values = np.asarray(open_layer(places.output, layer))
        return partial(write_means, np.nanmean(values, axis=(0, 1)), capture, places)

    stages = (*build_records.STAGES, "means")
    for module in (build_records, outcomes):
        monkeypatch.setattr(module, "STAGES", stages)
    for module in (graph, outcomes):
        monkeypatch.setattr(module, "keys_of", keys_of)
    monkeypatch.setattr(graph, "_tasks_of", with_means)
    monkeypatch.setattr(fingerprints.Inputs, "_prints", prints)
    monkeypatch.setattr(tasks.Stages, "compute", compute)
    monkeypatch.setitem(sources.STAGES, "means", NUMBERS)


@pytest.mark.slow
def test_a_stage_reads_the_files_of_the_one_before_it(means, make_every_kind, tmp_path):
    folder = make_every_kind(tmp_path / "campaign", ("one",), ("photo", "xray"))
    report = summarise(build(folder))
    assert report.ok, report.text
    there = sorted(path.name for path in (folder / "database").rglob("*.means.csv"))
    assert there == ["one_photo.means.csv", "one_xray.means.csv"]
    again = summarise(build(folder))
    assert [step.line for step in again.stages if step.state != "fresh"] == []
    (path,) = (folder / "xray").iterdir()
    noise = np.random.default_rng(1).integers(0, 255, (200, 240), np.uint8)
    path.write_bytes(cv2.imencode(".png", noise)[1].tobytes())
    assert not summarise(build(folder)).ok
    assert sorted(path.name for path in (folder / "database").rglob("*.means.csv")) == there

"""The graph of a campaign: what each task reads, in which order, and how it is drawn."""

import numpy as np
import pytest
from typer.testing import CliRunner

from levkas.building import build, status
from levkas.building.build_records import CATALOGUE, Key
from levkas.building.graph import graph_of, ordered
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.cli import app


@pytest.fixture(scope="module")
def folder(make_plates, tmp_path_factory):
    return make_plates(tmp_path_factory.mktemp("graph") / "campaign", ["one", "two"])


def tasks_of(folder, more=""):
    path = folder / "campaign.toml"
    text = path.read_text()
    path.write_text(text + more)
    campaign = load_campaign(folder)
    path.write_text(text)
    return graph_of(campaign, find_captures(campaign)[0])


def test_every_task_stands_behind_what_it_reads(folder):
    graph = tasks_of(folder)
    places = {key: place for place, key in enumerate(graph)}
    for key, task in graph.items():
        assert all(places[before] < places[key] for before in (*task.needs, *task.uses))
    assert [*graph][-1] == CATALOGUE


def test_what_is_registered_reads_the_reference(folder):
    infrared = {s: Key("one", "infrared", "", s) for s in ("calibrate", "register")}
    photo = {s: Key("one", "photo", "", s) for s in ("calibrate", "register", "resample")}
    alone = tasks_of(folder)[infrared["register"]]
    assert set(alone.needs) == {infrared["calibrate"], photo["calibrate"], photo["register"]}


def test_one_object_takes_along_only_what_it_reads_of_others(folder):
    graph = tasks_of(folder)
    wanted = [key for key in graph if key.object == "one"]
    assert {task.key.object for task in ordered(graph, wanted)} == {"one"}


def test_no_pixel_is_read_for_it(folder, tmp_path):
    np.save(tmp_path / "spare.npy", np.zeros(1))
    for path in (folder / "infrared").glob("*.png"):
        path.write_bytes(path.read_bytes()[:100])
    assert Key("two", "infrared", "", "resample") in tasks_of(folder)


@pytest.mark.slow
def test_it_is_drawn_with_the_state_of_every_task(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one"])
    drawn = CliRunner().invoke(app, ["status", str(folder), "--graph"]).output
    assert drawn.startswith("flowchart LR\n") and '["photo calibrate"]:::stale' in drawn
    list(build(folder))
    assert ":::stale" not in status(folder).graph
    assert '["infrared resample"]:::fresh' in status(folder).graph

"""Only campaign.toml removes: what cannot be made anew today stays as it is, is marked, and is not published in silence."""

import csv
import json
import shutil

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.building import build, report_pages, status, summarise, tasks
from levkas.cli import app
from levkas.core.digests import hash_tree
from levkas.core.disk import WriteRefused
from levkas.core.problems import Problem
from levkas.database.catalogue import read_catalogue
from levkas.database.reader import Database
from levkas.database.validation import validate

CAMERAS = ("photo", "filters", "colour")


@pytest.fixture(scope="module")
def built(tmp_path_factory, make_every_kind):
    folder = make_every_kind(tmp_path_factory.mktemp("every") / "campaign", cameras=CAMERAS)
    assert summarise(build(folder)).ok
    return folder


@pytest.fixture
def campaign(built, tmp_path):
    return shutil.copytree(built, tmp_path / "campaign")


def cut(folder):
    path = folder / "colour/one.tif"
    path.write_bytes(path.read_bytes()[:500])


def unmount(folder):
    (folder / "filters").rename(folder / "away")


def lose_the_reference(folder):
    (folder / "photo/one.png").rename(folder / "away.png")


def show_something_else(folder):
    rng = np.random.default_rng(8)
    for band in (500, 600):
        picture = rng.integers(80, 3000, (200, 240), np.uint16)
        tifffile.imwrite(folder / f"filters/one_{band}nm.tif", picture)


ALL = {"photo", "filters", "filters@raking", "colour"}
FAULTS = {
    "a picture is cut short": (cut, {"colour"}, "colour/one.tif cannot be read now"),
    "a folder is away": (unmount, {"filters", "filters@raking"}, "calibrate"),
    "the reference is away": (lose_the_reference, ALL, "calibrate"),
    "another painting": (show_something_else, {"filters"}, "register"),
}


def earlier(folder):
    """Return the layers of the catalogue that are of an earlier build, and why."""
    rows = read_catalogue(folder / "database")
    return {e.layer.name: e.earlier for e in rows if e.earlier and e.object == "one"}


def of_layers(folder, layers):
    """Return the hashes of the files of some layers of object one."""
    stems = [f"objects/one/one_{name.replace('@', '_')}." for name in layers]
    stems += [f"objects/one/registration/{name}." for name in layers]
    stems += [f"zarr/one.zarr/{name}/" for name in layers]
    files = hash_tree(folder / "database")
    return {name: sha for name, sha in files.items() if name.startswith(tuple(stems))}


def done(report):
    return {s.key.stage for s in report.stages if s.state == "done"}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_layer_that_cannot_be_made_today_stays_and_is_marked(campaign, fault):
    spoil, layers, why = FAULTS[fault]
    before, whole = of_layers(campaign, layers), hash_tree(campaign / "database")
    away = shutil.copytree(campaign, campaign.parent / "as it was", ignore=_only_frames)
    spoil(campaign)
    report = summarise(build(campaign))
    assert not report.ok
    marks = earlier(campaign)
    assert set(marks) == layers and all(text.startswith(why) for text in marks.values())
    assert of_layers(campaign, layers) == before and validate(campaign / "database").ok
    assert not (campaign / "database.removed").exists()
    ours = [s for s in report.stages if s.key.object == "one"]
    refused = {s.key.layer: s.earlier for s in ours if s.state == "refused"}
    assert refused == marks
    rows = json.loads(CliRunner().invoke(app, ["status", str(campaign), "--json"]).stdout)["layers"]
    assert {r["camera"]: r["earlier"] for r in rows if "earlier" in r and not r["setup"]} == {
        name: text for name, text in marks.items() if "@" not in name
    }
    page = (campaign / "database/objects/one/report.html").read_text("utf-8")
    assert page.count("Of an earlier build") == len(layers)
    steps = json.loads((campaign / "database/objects/one/provenance.json").read_text())["steps"]
    assert {(s["camera"], s["setup"]) for s in steps} >= {
        (*name.split("@"), "")[:2] for name in layers
    }
    for again in (status(campaign), summarise(build(campaign))):
        assert {s.state for s in again.stages} == {"fresh", "refused"}
    for name in {path.parent for path in away.rglob("*") if path.is_file()}:
        shutil.copytree(name, campaign / name.relative_to(away), dirs_exist_ok=True)
    mended = summarise(build(campaign))
    assert mended.ok and not earlier(campaign)
    assert done(mended) <= {"report", "camera", "catalogue", "calibrate"}
    assert hash_tree(campaign / "database") == whole


def _only_frames(folder, names):
    return [name for name in names if name.startswith("database") or name.endswith(".toml")]


@pytest.fixture(scope="module")
def plates_built(make_plates, tmp_path_factory):
    folder = make_plates(tmp_path_factory.mktemp("plates") / "campaign", ["one", "two"])
    text = (folder / "campaign.toml").read_text()
    facts = '[campaign]\ncreator = "Ada"\nlicence = "CC0-1.0"\n'
    (folder / "campaign.toml").write_text(text.replace("[campaign]\n", facts, 1))
    assert summarise(build(folder)).ok
    return folder


@pytest.fixture
def pair(plates_built, tmp_path):
    return shutil.copytree(plates_built, tmp_path / "campaign")


def layers_in(folder):
    return [f"{e.object}/{e.layer.name}" for e in read_catalogue(folder / "database")]


def test_a_frame_that_others_of_its_camera_have_is_missed_until_campaign_toml_drops_it(pair):
    before = layers_in(pair)
    (pair / "infrared/two.png").unlink()
    assert {s.state for s in status(pair).stages if s.key.stage == "calibrate"} >= {"refused"}
    report = summarise(build(pair))
    assert [p.code for p in report.problems] == ["E_NO_FRAMES"]
    assert layers_in(pair) == before and "no longer in the campaign" not in report.text
    text = (pair / "campaign.toml").read_text()
    (pair / "campaign.toml").write_text(text.replace('["one", "two"]', '["one"]'))
    report = summarise(build(pair))
    assert report.ok and layers_in(pair) == before[:2]
    assert (pair / "database.removed/1/objects/two/two_infrared.tif").is_file()


def test_objects_that_no_key_lists_stay_when_all_their_frames_are_away(pair):
    text = (pair / "campaign.toml").read_text()
    (pair / "campaign.toml").write_text(text.replace('objects = ["one", "two"]', ""))
    assert summarise(build(pair)).ok
    before = hash_tree(pair / "database/objects/two")
    for name in ("photo", "infrared"):
        (pair / name / "two.png").unlink()
    assert not summarise(build(pair)).ok
    after = hash_tree(pair / "database/objects/two")
    assert {n for n in before if after.get(n) != before[n]} == {"report.html"}
    assert [e.object for e in read_catalogue(pair / "database") if e.earlier] == ["two", "two"]


def test_a_layer_stays_where_what_is_kept_was_deleted(pair):
    before = layers_in(pair)
    shutil.rmtree(pair / "database.kept")
    path = pair / "infrared/one.png"
    path.write_bytes(path.read_bytes()[:300])
    (pair / "infrared/two.png").unlink()
    assert not summarise(build(pair)).ok
    assert layers_in(pair) == before and validate(pair / "database").ok


def test_a_layer_whose_file_was_deleted_is_no_longer_missed(pair):
    (pair / "infrared/two.png").unlink()
    (pair / "database/objects/two/two_infrared.tif").unlink()
    assert summarise(build(pair)).ok
    assert "two/infrared" not in layers_in(pair)


def test_a_registration_is_put_back_where_the_layer_could_not_be_written(pair, monkeypatch):
    before = hash_tree(pair / "database/objects/one")
    text = (pair / "campaign.toml").read_text()
    (pair / "campaign.toml").write_text(f"{text}\n[registration]\nreject = 7\n")

    def full(*_):
        raise WriteRefused(Problem("E_DISK_FULL", "the disk is full", "database"))

    monkeypatch.setattr(tasks.Stages, "_resample", full)
    assert not summarise(build(pair)).ok
    after = hash_tree(pair / "database/objects/one")
    changed = {n for n in before if after.get(n) != before[n]}
    assert changed <= {"report.html", "provenance.json"}
    assert len(earlier(pair)) == 2 and validate(pair / "database").ok
    monkeypatch.undo()
    assert summarise(build(pair)).ok and not earlier(pair)


def test_a_page_that_cannot_be_drawn_stays_and_its_campaign_is_not_published(pair, monkeypatch):
    page = pair / "database/objects/one/report.html"
    before = page.read_bytes()
    text = (pair / "campaign.toml").read_text()
    (pair / "campaign.toml").write_text(text.replace('"Ada"', '"Eva"'))

    def broken(*_):
        raise TypeError("a page that cannot be drawn")

    monkeypatch.setattr(report_pages, "report_of", broken)
    assert not summarise(build(pair)).ok
    assert page.read_bytes() == before
    result = CliRunner().invoke(app, ["publish", str(pair), "--json"])
    assert [p["code"] for p in json.loads(result.stdout)["problems"]] == ["E_STALE"]


def published(folder, *options):
    without = [] if "--check" in options else ["--no-iiif"]
    result = CliRunner().invoke(app, ["publish", str(folder), "--json", *without, *options])
    return result.exit_code, json.loads(result.stdout)


def test_publish_refuses_a_layer_of_an_earlier_build_until_it_is_left_out(pair):
    path = pair / "infrared/two.png"
    path.write_bytes(path.read_bytes()[:300])
    assert published(pair)[0] == 1  # status alone says it
    list(build(pair))
    for subject in (pair, pair / "database"):
        code, record = published(subject)
        (problem,) = record["problems"]
        assert (code, problem["code"], problem["field"]) == (1, "E_STALE", "earlier")
        assert "two/infrared" in problem["message"]
    assert published(pair, "--without", "uv")[1]["problems"][0]["code"] == "E_VALUE"
    checked = CliRunner().invoke(app, ["publish", str(pair), "--check", "--json"])
    assert "earlier" in [p["field"] for p in json.loads(checked.stdout)["problems"]]
    assert not (pair / "database.published").exists()

    code, record = published(pair, "--without", "two/infrared")
    assert code == 0 and any("two/infrared" in text for text in record["left_out"])
    out = pair / "database.published"
    assert {n: {*Database(out)[n]} for n in Database(out)} == {
        "one": {"photo", "infrared"}, "two": {"photo"},
    }  # fmt: skip
    assert not [*out.rglob("*two_infrared*")] and not (out / "zarr/two.zarr/infrared").exists()
    assert "infrared" not in (out / "zarr/two.zarr/zarr.json").read_text()
    rows = list(csv.DictReader((out / "catalogue.csv").open()))
    assert len(rows) == 3 and "earlier" not in rows[0]
    assert validate(out).ok

    code, record = published(pair, "--without", "infrared")
    assert code == 0 and validate(out).ok
    assert {e.camera for e in read_catalogue(out)} == {"photo"}

"""A stranger builds the database again from the raw frames and the publication alone."""

import json
import shutil
import tomllib

import pytest

from levkas.building import build
from levkas.campaign.schema import tables
from levkas.core.digests import hash_file
from levkas.publish import run
from levkas.publish.declarations import TABLES, find_tables

FACTS = """# the key of the safe is 1234
[campaign]
creator = "Painter, Ada"
licence = "CC-BY-4.0"
"""
MORE = """
[registration]
points = "points/{object}_{camera}.csv"
[setups.default]
spectrum = "light/lamp.csv"
"""
POINTS = "reference_x,reference_y,x,y\n" + "".join(
    f"{(1.9 * x + 0.04 * y + 6.5) / 2 - 0.5},{(1.9 * y - 0.04 * x + 9.5) / 2 - 0.5},{x},{y}\n"
    for x, y in ((60, 50), (180, 60), (70, 150))
)
"""Where `make_plates` draws the infrared picture."""


def write(folder, make_plates, output='output = "other"'):
    make_plates(folder, ["one"])
    text = (folder / "campaign.toml").read_text()
    text = text.replace("[campaign]\n", f"{FACTS}{output}\n", 1) + MORE
    (folder / "campaign.toml").write_text(text)
    (folder / "points").mkdir()
    (folder / "points/one_infrared.csv").write_text(POINTS)
    (folder / "light").mkdir()
    (folder / "light/lamp.csv").write_text("wavelength,lamp\n400,1\n550,2\n700,1\n")
    return folder


def built(folder):
    states = [step.state for step in build(folder)]
    assert not {"refused", "failed"} & set(states)


@pytest.fixture(scope="module")
def campaign(make_plates, tmp_path_factory):
    folder = write(tmp_path_factory.mktemp("declared") / "campaign", make_plates)
    built(folder)
    return folder


@pytest.fixture(scope="module")
def published(campaign, publish):
    return publish(campaign, iiif=False)


@pytest.mark.slow
def test_raw_frames_elsewhere_and_the_declarations_give_the_same_bytes(
    campaign, published, tmp_path
):
    shutil.copytree(published / "declarations", tmp_path / "again")
    for raw in ("photo", "infrared"):
        shutil.copytree(campaign / raw, tmp_path / "again" / raw)
    built(tmp_path / "again")
    manifest = (tmp_path / "again/database/manifest-sha256.txt").read_bytes()
    assert manifest == (campaign / "other/manifest-sha256.txt").read_bytes()
    assert manifest == (published / "declarations/database-sha256.txt").read_bytes()


@pytest.mark.slow
def test_comments_and_the_place_of_the_database_stay_at_home(campaign, published):
    text = (published / "declarations/campaign.toml").read_text()
    declared = tomllib.loads((campaign / "campaign.toml").read_text())
    assert "1234" not in text and "other" not in text
    del declared["campaign"]["output"]
    assert tomllib.loads(text) == declared


def test_the_crate_lists_declarations_as_inputs_of_the_steps(published):
    entities = {
        entity["@id"]: entity
        for entity in json.loads((published / "ro-crate-metadata.json").read_text())["@graph"]
    }
    names = {"campaign.toml", "points/one_infrared.csv", "light/lamp.csv", "database-sha256.txt"}
    files = {f"declarations/{name}" for name in names}
    assert files == {name for name in entities if name[-1] != "/" and name[:13] == "declarations/"}
    for name in files:
        assert entities[name]["sha256"] == hash_file(published / name)
    assert entities["#one-infrared-register"]["object"] == {"@id": "declarations/campaign.toml"}


def test_a_path_of_the_machine_is_never_published(campaign, tmp_path, make_plates):
    folder = tmp_path / "campaign"
    shutil.copytree(campaign, folder)
    lamp = shutil.copy(folder / "light/lamp.csv", tmp_path / "lamp.csv")
    text = (folder / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(text.replace("light/lamp.csv", str(lamp)))
    subject = run.PublishSubject(folder / "other", folder / "campaign.toml")
    report = run.summarise(run.publish(subject, iiif=False))
    assert len(report.left_out) == 1
    assert not (report.output / "declarations").exists()


def test_a_database_published_alone_says_how_its_declarations_come_along(campaign, tmp_path):
    wanted = run.find_subject(campaign / "other")
    report = run.summarise(run.publish(wanted, output=tmp_path / "out", iiif=False))
    assert len(report.left_out) == 1 and not (report.output / "declarations").exists()


def test_every_key_that_names_a_file_is_known():
    keys = {
        key
        for table in vars(tables).values()
        if isinstance(table, type) and hasattr(table, "model_fields")
        for key, field in table.model_fields.items()
        if any("_path" in str(mark) for mark in field.metadata) or "_path" in str(field.annotation)
    }
    assert keys - {"output", "files"} <= set(TABLES)
    assert {"sensitivity", "spectrum", "points"} <= keys


def test_names_with_placeholders_stand_for_every_file(tmp_path):
    for name in ("a [1].csv", "a 1.csv", "b.txt"):
        (tmp_path / name).write_text("x")
    named = {"cameras": {"c": {"sensitivity": "a [1].csv", "files": "*"}}}
    assert find_tables(tmp_path, named) == ("a [1].csv",)
    assert find_tables(tmp_path, {"points": "a {object}.csv"}) == ("a 1.csv", "a [1].csv")

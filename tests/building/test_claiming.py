"""Into which folders a build writes, and that it touches nothing in any other."""

import hashlib
import json
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from levkas.building import build, status, summarise
from levkas.building.records_file import NAME
from levkas.cli import app
from levkas.core.digests import hash_tree
from levkas.core.problems import Refused
from levkas.database.validation import validate


@pytest.fixture(scope="module")
def finished(make_plates, tmp_path_factory):
    folder = make_plates(tmp_path_factory.mktemp("claimed") / "campaign", ["one"])
    assert summarise(build(folder)).ok
    return folder


@pytest.fixture
def campaign(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "campaign", symlinks=True))


def refused(folder, **options):
    with pytest.raises(Refused) as said:
        list(build(folder, **options))
    assert all(p.file and p.found and p.expected and p.fix for p in said.value.problems)
    return said.value.problems


def say_output(folder, text):
    path = folder / "campaign.toml"
    path.write_text(path.read_text().replace("[campaign]", f'[campaign]\noutput = "{text}"'))


def test_a_folder_of_somebody_else_stays_as_it_is(finished, tmp_path):
    other = tmp_path / "other"
    (other / "objects").mkdir(parents=True)
    (other / "catalogue.csv").write_text("object,price\none,12\n")
    (other / "manifest-sha256.txt").write_text("0" * 64 + "  catalogue.csv\n")
    (other / "database.toml").write_text('title = "by hand"\n')
    (other / "picture.tif.partial-0123abcd").write_text("half a picture")
    before = hash_tree(tmp_path)
    (problem,) = refused(finished, output=other)
    assert (problem.code, problem.file) == ("E_UNWRITABLE", str(other))
    assert hash_tree(tmp_path) == before and not other.with_name("other.kept").exists()


def test_what_stands_where_a_build_keeps_its_records_stays(finished, tmp_path):
    (tmp_path / "new.kept").mkdir()
    (tmp_path / "new.kept/thesis.txt").write_text("three years")
    (problem,) = refused(finished, output=tmp_path / "new")
    assert problem.file == str(tmp_path / "new.kept")
    assert hash_tree(tmp_path).keys() == {"new.kept/thesis.txt"}


@pytest.mark.parametrize("text", ["photo", "photo/new", "/", "~", ".."])
def test_an_output_at_raw_frames_a_disk_or_a_home_is_refused(campaign, text, monkeypatch):
    shutil.rmtree(campaign / "database")
    shutil.rmtree(campaign / "database.kept")
    monkeypatch.setenv("HOME", str(campaign.parent / "home"))
    (campaign.parent / "home").mkdir()
    say_output(campaign, str(Path.home()) if text == "~" else text)
    before = hash_tree(campaign)
    refused(campaign)
    assert CliRunner().invoke(app, ["status", str(campaign)]).exit_code == 1
    assert hash_tree(campaign) == before


def test_a_build_goes_on_in_its_own_database_also_moved(campaign, tmp_path):
    assert {s.state for s in build(campaign)} == {"fresh"}
    moved = campaign.rename(tmp_path / "elsewhere")
    assert {s.state for s in build(moved)} == {"fresh"}
    shutil.rmtree(moved / "database.kept")
    assert summarise(build(moved)).ok and validate(moved / "database").ok


@pytest.mark.slow
def test_a_first_build_that_was_killed_at_once_is_gone_on_with(campaign):
    shutil.rmtree(campaign / "database")
    shutil.rmtree(campaign / "database.kept")
    steps = build(campaign)
    next(steps)
    steps.close()
    (campaign / "database/manifest-sha256.txt").unlink(missing_ok=True)
    (campaign / "database/one.tif.levkas.partial-0123abcd").write_bytes(b"x")
    assert summarise(build(campaign)).ok and validate(campaign / "database").ok


@pytest.mark.parametrize("name", ["two", "one"])
def test_the_database_of_another_campaign_is_not_gone_on_with(
    campaign, make_plates, tmp_path, name
):
    other = make_plates(tmp_path / "other", [name])
    before = hash_tree(campaign / "database")
    (problem,) = refused(other, output=campaign / "database")
    assert problem.found == f"the database of {campaign}"
    shutil.rmtree(campaign / "database.kept")  # it may be deleted at any time
    (problem,) = refused(other, output=campaign / "database")
    assert problem.found == f"the database of {campaign}"
    assert not (campaign / "database.kept").exists()
    (campaign / "database").rename(tmp_path / "alone")
    if name == "two":
        (problem,) = refused(other, output=tmp_path / "alone")
        assert problem.found == "objects one"
    assert hash_tree(tmp_path / "alone") == before


def test_a_publication_and_what_is_in_a_database_are_no_place_for_a_build(campaign):
    published = campaign / "published"
    shutil.copytree(campaign / "database", published)
    (published / "ro-crate-metadata.json").write_text("{}")
    assert "a publication" in refused(campaign, output=published)[0].found
    assert refused(campaign, output=campaign / "database/new")[0].code == "E_UNWRITABLE"


@pytest.mark.parametrize("place", ["database/objects/one", "database/zarr", "database.kept/one"])
def test_a_build_writes_through_no_link_that_leads_out(campaign, tmp_path, place):
    path, away = campaign / place, tmp_path / "away"
    path.mkdir(exist_ok=True)  # what is kept of a stage beside its record, where there is any
    path.rename(away)
    path.symlink_to(away)
    photo = campaign / "photo/one.png"
    photo.write_bytes(photo.read_bytes() + b"changed")
    before = hash_tree(away)
    (problem,) = refused(campaign)
    assert (problem.code, problem.file, problem.found) == ("E_LINK", str(path), str(away))
    assert hash_tree(away) == before


def test_a_database_that_is_a_link_itself_is_built(campaign, tmp_path):
    (campaign / "database").rename(tmp_path / "large")
    (campaign / "database.kept").rename(tmp_path / "large.kept")
    (campaign / "database").symlink_to(tmp_path / "large")
    assert summarise(build(campaign)).ok


def with_spectrum(campaign, text):
    (campaign / "lamp.csv").write_text(text)
    path = campaign / "campaign.toml"
    path.write_text(path.read_text() + f'[setups.default]\nspectrum = "{campaign / "lamp.csv"}"\n')


def test_of_a_spectrum_only_its_numbers_are_published(campaign):
    with_spectrum(campaign, "# secret: hunter2\nnm,power (secret)\n400,120.5\n500,80,secret\n")
    assert summarise(build(campaign)).ok
    written = (campaign / "database/setups/default/spd.csv").read_text()
    assert written == "wavelength,power\n400,120.5\n500,80\n"


def test_a_file_that_is_no_spectrum_is_refused_before_any_work(campaign):
    with_spectrum(campaign, "root:x:0:0:root:/root:/bin/bash\n-----BEGIN PRIVATE KEY-----\n")
    before = hash_tree(campaign)
    (problem,) = refused(campaign)
    assert problem.code == "E_UNREADABLE" and problem.file == str(campaign / "lamp.csv")
    assert hash_tree(campaign) == before


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_among_the_frames_is_waited_for_by_nobody(campaign):
    (campaign / "photo/one.png").unlink()
    os.mkfifo(campaign / "photo/one.png")
    for work in (status, lambda path: summarise(build(path))):
        with pytest.raises(Refused, match="no file of 'one' matches the pattern"):
            work(campaign)


def test_a_record_that_names_a_file_elsewhere_costs_nobody_that_file(campaign):
    victim = campaign / "thesis.txt"
    victim.write_text("three years")
    text = json.dumps({"products": {"../thesis.txt": "0" * 64, str(victim): "0" * 64}})
    key = ("one", "infrared", "", "resample")
    sha256 = hashlib.sha256("\n".join([*key, text]).encode()).hexdigest()
    with closing(sqlite3.connect(campaign / "database.kept" / NAME)) as kept, kept:
        where = "WHERE object = ? AND camera = ? AND setup = ? AND stage = ?"
        kept.execute(f"UPDATE stages SET record = ?, sha256 = ? {where}", (text, sha256, *key))
        assert kept.total_changes == 1
    text = (campaign / "campaign.toml").read_text()
    head, _, rest = text.partition("[cameras.infrared]")
    (campaign / "campaign.toml").write_text(head + "[targets]" + rest.partition("[targets]")[2])
    assert summarise(build(campaign)).ok
    assert victim.read_text() == "three years"

"""Into which folders a build writes, and that it touches nothing in any other."""

import hashlib
import json
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
import toy

from levkas.building import build, status, summarise
from levkas.building.records_file import NAME
from levkas.core.digests import hash_tree
from levkas.core.problems import Refused

CAMERAS = ("photo", "xray")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        toy.install(patch)
        folder = toy.make(tmp_path_factory.mktemp("claimed") / "campaign", ("one",), CAMERAS)
        assert summarise(build(folder)).ok
    return folder


@pytest.fixture
def campaign(finished, tmp_path, toys):
    return toy.copied(finished, tmp_path / "campaign")


def refused(folder, **options):
    """Build, and return the problem of the refusal, which has changed nothing."""
    root = options.get("output", folder).parent
    before = hash_tree(root)
    with pytest.raises(Refused) as said:
        list(build(folder, **options))
    assert hash_tree(root) == before
    problem = said.value.problems[0]
    assert problem.file and problem.found and problem.expected and problem.fix
    return problem


def test_a_folder_of_somebody_else_stays_as_it_is(finished, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    for name, text in {
        "catalogue.csv": "object,price\none,12\n",
        "manifest-sha256.txt": "0" * 64 + "  catalogue.csv\n",
        "database.toml": 'title = "by hand"\n',
        "picture.tif.partial-0123abcd": "half a picture",
    }.items():
        (other / name).write_text(text)
    problem = refused(finished, output=other)
    assert (problem.code, problem.file) == ("E_UNWRITABLE", str(other))
    (tmp_path / "new.kept").mkdir()
    (tmp_path / "new.kept/thesis.txt").write_text("three years")
    assert refused(finished, output=tmp_path / "new").file == str(tmp_path / "new.kept")
    with pytest.raises(Refused) as said:
        list(build(finished, output=other / "catalogue.csv/database"))
    assert said.value.problems[0].code == "E_UNWRITABLE"


@pytest.mark.parametrize("text", ["photo", "photo/new", "/", "~", "..", "."])
def test_an_output_at_raw_frames_a_disk_a_home_or_the_campaign_is_refused(
    campaign, text, monkeypatch
):
    for name in ("database", "database.kept"):
        shutil.rmtree(campaign / name)
    monkeypatch.setenv("HOME", str(campaign.parent / "home"))
    (campaign.parent / "home").mkdir()
    text = str(Path.home()) if text == "~" else text
    path = campaign / "campaign.toml"
    path.write_text(path.read_text().replace("[campaign]", f'[campaign]\noutput = "{text}"'))
    refused(campaign)
    with pytest.raises(Refused):
        status(campaign)


def test_a_build_goes_on_in_its_own_database_also_moved_linked_or_without_its_records(
    campaign, tmp_path
):
    moved = campaign.rename(tmp_path / "elsewhere")
    assert {s.state for s in build(moved)} == {"fresh"}
    for name in ("", ".kept"):
        (moved / f"database{name}").rename(tmp_path / f"large{name}")
    (moved / "database").symlink_to(tmp_path / "large")
    assert summarise(build(moved)).ok
    shutil.rmtree(tmp_path / "large.kept")
    assert summarise(build(moved)).ok


def test_a_first_build_that_was_killed_at_once_is_gone_on_with(campaign):
    for name in ("database", "database.kept"):
        shutil.rmtree(campaign / name)
    steps = build(campaign)
    next(steps)
    steps.close()
    (campaign / "database/manifest-sha256.txt").unlink(missing_ok=True)
    (campaign / "database/one.tif.levkas.partial-0123abcd").write_bytes(b"x")
    assert summarise(build(campaign)).ok and not [*campaign.rglob("*.partial-*")]


@pytest.mark.parametrize("name", ["two", "one"])
def test_the_database_of_another_campaign_is_not_gone_on_with(campaign, tmp_path, name):
    other = toy.make(tmp_path / "other", (name,), CAMERAS)
    found = f"the database of {campaign}"
    assert refused(other, output=campaign / "database").found == found
    shutil.rmtree(campaign / "database.kept")  # it may be deleted at any time
    assert refused(other, output=campaign / "database").found == found
    (campaign / "database").rename(tmp_path / "alone")
    if name == "two":
        assert refused(other, output=tmp_path / "alone").found == "objects one"


def test_a_publication_and_what_is_in_a_database_are_no_place_for_a_build(campaign):
    published = campaign / "published"
    shutil.copytree(campaign / "database", published)
    (published / "ro-crate-metadata.json").write_text("{}")
    assert refused(campaign, output=published).found.startswith("a publication")
    assert refused(campaign, output=campaign / "database/new").code == "E_UNWRITABLE"


@pytest.mark.parametrize("place", ["database/objects/one", "database/zarr", "database.kept/one"])
def test_a_build_writes_through_no_link_that_leads_out(campaign, tmp_path, place):
    path, away = campaign / place, tmp_path / "away"
    path.rename(away)
    path.symlink_to(away)
    photo = campaign / "photo/one.png"
    photo.write_bytes(photo.read_bytes() + b"changed")
    problem = refused(campaign)
    assert (problem.code, problem.file, problem.found) == ("E_LINK", str(path), str(away))


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("# secret: hunter2\nnm,power (secret)\n400,120.5\n500,80,secret\n", "400,120.5\n500,80\n"),
        ("root:x:0:0:root:/root:/bin/bash\n-----BEGIN PRIVATE KEY-----\n", None),
    ],
)
def test_of_a_spectrum_only_its_numbers_are_published(campaign, text, written):
    (campaign / "lamp.csv").write_text(text)
    with (campaign / "campaign.toml").open("a") as file:
        file.write(f'[setups.default]\nspectrum = "{campaign / "lamp.csv"}"\n')
    if written is None:
        with pytest.raises(Refused) as said:
            list(build(campaign))
        assert said.value.problems[0].file == str(campaign / "lamp.csv")
        return
    assert summarise(build(campaign)).ok
    table = (campaign / "database/setups/default/spd.csv").read_text()
    assert table == f"wavelength,power\n{written}"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_among_the_frames_is_waited_for_by_nobody(campaign):
    (campaign / "photo/one.png").unlink()
    os.mkfifo(campaign / "photo/one.png")
    for work in (status, lambda path: summarise(build(path))):
        with pytest.raises(Refused):
            work(campaign)


def test_a_record_that_names_a_file_elsewhere_costs_nobody_that_file(campaign):
    victim = campaign / "thesis.txt"
    victim.write_text("three years")
    text = json.dumps({"products": {"../thesis.txt": "0" * 64, str(victim): "0" * 64}})
    key = ("one", "xray", "", "resample")
    sha256 = hashlib.sha256("\n".join([*key, text]).encode()).hexdigest()
    with closing(sqlite3.connect(campaign / "database.kept" / NAME)) as kept, kept:
        where = "WHERE object = ? AND camera = ? AND setup = ? AND stage = ?"
        kept.execute(f"UPDATE stages SET record = ?, sha256 = ? {where}", (text, sha256, *key))
        assert kept.total_changes == 1
    text = (campaign / "campaign.toml").read_text()
    head, _, rest = text.partition("[cameras.xray]")
    (campaign / "campaign.toml").write_text(head + "[targets]" + rest.partition("[targets]")[2])
    assert summarise(build(campaign)).ok
    assert victim.read_text() == "three years"

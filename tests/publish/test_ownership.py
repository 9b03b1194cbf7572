"""What a publication replaces, and what of a foreign database it follows."""

import contextlib
import csv
import hashlib
import os
import shutil

import pytest

from levkas.core.digests import hash_tree
from levkas.core.files import write_json
from levkas.core.problems import Refused
from levkas.database.catalogue import DatabaseRefused
from levkas.database.manifest import NAME, write_manifest
from levkas.database.validation import validate
from levkas.publish import run


@pytest.fixture
def published(database):
    """Return a database and its publication, full and without tiles."""
    return database, run.summarise(run.publish(database, iiif=False)).output


def refused(database, **options):
    """Publish, and return the problems."""
    with pytest.raises(Refused) as said:
        list(run.publish(database, iiif=False, **options))
    return said.value.problems


def a_database(folder, database):
    shutil.copytree(database, folder)


def a_lone_manifest(folder, database):
    folder.mkdir()
    (folder / NAME).write_text(f"{hashlib.sha256(b'x').hexdigest()}  x\n")
    (folder / "x").write_bytes(b"x")


@pytest.mark.parametrize("make", [a_database, a_lone_manifest])
def test_a_folder_with_a_manifest_that_is_no_publication_is_not_replaced(database, tmp_path, make):
    make(tmp_path / "other", database)
    before = hash_tree(tmp_path)
    (problem,) = refused(database, output=tmp_path / "other")
    assert (problem.code, problem.file) == ("E_UNWRITABLE", str(tmp_path / "other"))
    assert hash_tree(tmp_path) == before


def test_a_publication_with_notes_of_somebody_else_in_it_is_not_replaced(published):
    database, output = published
    (output / "notes.txt").write_text("three years")
    (problem,) = refused(database)
    assert "notes.txt" in problem.found
    assert (output / "notes.txt").read_text() == "three years"


def test_the_publication_of_other_objects_is_not_replaced(published, tmp_path):
    database, output = published
    table = (database / "catalogue.csv").read_text().replace("icon", "panel")
    (database / "catalogue.csv").write_text(table)
    write_manifest(database)
    before = hash_tree(output)
    (problem,) = refused(database)
    assert "icon1" in problem.found
    assert hash_tree(output) == before


def test_a_folder_inside_a_database_or_a_publication_is_refused(published, tmp_path):
    database, output = published
    other = shutil.copytree(database, tmp_path / "other")
    assert refused(other, output=output / "new")[0].code == "E_UNWRITABLE"
    assert refused(other, output=database / "new")[0].code == "E_UNWRITABLE"
    assert not (output / "new").exists()


@pytest.mark.parametrize(
    ("column", "name"),
    [("object", "../../../out"), ("camera", "/tmp"), ("setup", "a/b")],
)
def test_names_of_a_catalogue_that_lead_out_are_refused(database, column, name):
    path = database / "catalogue.csv"
    rows = list(csv.DictReader(path.read_text().splitlines()))
    rows[0][column] = name
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)
    write_manifest(database)
    assert {p.file for p in refused(database)} == {str(path)}
    import levkas

    with pytest.raises(DatabaseRefused):
        levkas.open(database)
    assert str(path) in {p.file for p in validate(database).problems}


@pytest.mark.parametrize("what", ["file", "folder"])
def test_links_that_lead_out_of_a_database_are_not_followed(database, tmp_path, what):
    place = database / ("objects/icon1/object.toml" if what == "file" else "objects/icon1")
    secret = tmp_path / "elsewhere"
    place.rename(secret)
    place.symlink_to(secret)
    problems = refused(database)
    assert {(p.code, p.file) for p in problems} == {("E_LINK", str(place))}
    assert all(p.found == str(secret) and p.fix for p in problems)
    found = validate(database).problems
    assert ("E_LINK", str(place)) in {(p.code, p.file) for p in found}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize("name", ["database.toml", "catalogue.csv", "objects/icon1/object.toml"])
def test_a_pipe_in_a_database_is_named_and_never_waited_for(database, name):
    (database / name).unlink()
    os.mkfifo(database / name)
    with contextlib.suppress(Refused):
        assert not run.check(database).ok
    assert [p.file for p in refused(database)] == [str(database / name)]
    assert str(database / name) in {p.file for p in validate(database).problems}


def recorded(database, raw, title=None):
    """List a raw file of each object in a database's provenance, and give it another title."""
    for folder in sorted((database / "objects").iterdir()):
        frames = [{"role": "object", "files": {"a.raw": f"{raw}{folder.name}"}},
                  {"role": "dark", "files": {"dark.raw": "of all cameras"}}]  # fmt: skip
        step = {"stage": "calibrate", "camera": "vis", "setup": "", "code": "", "inputs": {}}
        steps = [step | {"parameters": {}, "products": {}, "frames": frames}]
        record = {"object": folder.name, "levkas": "0.1.0", "steps": steps}
        write_json(folder / "provenance.json", record)
    if title:
        facts = (database / "database.toml").read_text().replace("Icons of Levkas", title)
        (database / "database.toml").write_text(facts)
    write_manifest(database)
    return database


def without(database, name):
    """Take an object out of a database."""
    rows = (database / "catalogue.csv").read_text().splitlines(keepends=True)
    (database / "catalogue.csv").write_text("".join(r for r in rows if not r.startswith(name)))
    shutil.rmtree(database / "objects" / name)
    shutil.rmtree(database / f"zarr/{name}.zarr")
    write_manifest(database)
    return database


@pytest.mark.parametrize("listed", [True, False])
def test_the_publication_of_another_database_with_an_object_of_that_name_is_not_replaced(
    database, tmp_path, listed
):
    other = shutil.copytree(database, tmp_path / "other")
    if listed:
        recorded(database, "ours of "), recorded(other, "theirs of ")
    else:
        facts = (other / "database.toml").read_text().replace("Icons of", "Panels of")
        (other / "database.toml").write_text(facts)
        write_manifest(other)
    place = tmp_path / "place"
    list(run.publish(database, iiif=False, output=place))
    before = hash_tree(tmp_path)
    (problem,) = refused(other, output=place)
    assert (problem.code, problem.file) == ("E_UNWRITABLE", str(place))
    assert "Icons of Levkas" in problem.found and "icon1" in problem.found
    assert hash_tree(tmp_path) == before


@pytest.mark.slow
def test_a_corrected_title_replaces_the_earlier_publication_and_what_is_gone_goes(database):
    for title in (None, "Icons of Lefkada"):
        list(run.publish(recorded(database, "ours of ", title), iiif=False))
    less = without(database, "icon2")
    output = run.summarise(run.publish(less, iiif=False)).output
    assert not (output / "objects/icon2").exists()


def test_a_part_of_a_database_under_another_title_does_not_replace_it(database, tmp_path):
    part = without(shutil.copytree(recorded(database, "ours of "), tmp_path / "part"), "icon2")
    recorded(part, "ours of ", "One icon")
    list(run.publish(database, iiif=False, output=tmp_path / "place"))
    (problem,) = refused(part, output=tmp_path / "place")
    assert "icon2" in problem.found
    assert (tmp_path / "place/objects/icon2").is_dir()


def test_a_file_that_came_into_the_folder_while_it_was_published_stays(published):
    database, output = published
    steps = run.publish(database, iiif=False)
    next(steps)
    (output / "notes.txt").write_text("three years")
    with pytest.raises(Refused):
        list(steps)
    assert (output / "notes.txt").read_text() == "three years"

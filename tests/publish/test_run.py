import tomllib

import pytest

from levkas.core.digests import hash_tree
from levkas.core.disk import WriteRefused
from levkas.database.manifest import NAME, write_manifest
from levkas.database.validation import validate
from levkas.publish import run
from levkas.publish.metadata import licence_of, read_facts
from levkas.publish.publication import PublishRefused


def codes(refused):
    return [p.code for p in refused.value.problems]


def test_the_published_folder_is_whole_and_opens(database, publish):
    import levkas

    folder = publish(database)
    assert folder == database.with_name("database.published")
    given = {name: found for name, found in hash_tree(database).items() if name != NAME}
    assert given.items() <= hash_tree(folder).items()
    report = validate(folder)
    assert report.ok
    assert list(levkas.open(folder)) == ["icon1", "icon2"]
    (folder / "objects/icon1/icon1_vis.tif").unlink()
    (folder / "objects/icon1/new.tif").write_bytes(b"x")
    assert {p.code for p in validate(folder).problems} == {"E_MISSING", "E_EXTRA"}


@pytest.mark.slow
def test_publishing_twice_and_elsewhere_gives_the_same_bytes(database, publish, tmp_path):
    first = hash_tree(publish(database))
    assert hash_tree(publish(database)) == first
    assert hash_tree(publish(database, output=tmp_path / "deep/er/other")) == first


def test_a_damaged_file_is_refused_by_name_and_the_old_publication_stays(database, publish):
    before = hash_tree(publish(database))
    file = database / "objects/icon1/icon1_vis.tif"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)
    with pytest.raises(PublishRefused) as refused:
        publish(database)
    assert refused.value.problems[0].file == str(file)
    assert hash_tree(database.with_name("database.published")) == before
    assert not list(database.parent.glob("*.partial-*"))


def test_a_file_that_the_manifest_does_not_list_is_refused(database, publish):
    (database / "objects/icon1/notes.txt").write_text("mine")
    with pytest.raises(PublishRefused) as refused:
        publish(database)
    assert codes(refused) == ["E_EXTRA"]
    assert refused.value.problems[0].file.endswith("notes.txt")


def test_all_facts_that_are_missing_are_named_at_once(database, publish):
    (database / "database.toml").write_text('title = "Icons"\n')
    write_manifest(database)
    with pytest.raises(PublishRefused) as refused:
        publish(database)
    assert [p.field for p in refused.value.problems] == [
        "campaign.creator",
        "campaign.licence",
        "campaign.date",
    ]
    assert all(p.fix and p.file.endswith("database.toml") for p in refused.value.problems)
    for problem in refused.value.problems:  # what it says to write can be pasted as it is
        line = problem.fix.removeprefix("Write ").partition(" in [campaign]")[0]
        assert tomllib.loads(line)


@pytest.mark.parametrize("where", ["database", "database/inside", "."])
def test_the_database_itself_is_never_written_over(database, publish, where):
    before = hash_tree(database)
    with pytest.raises(PublishRefused) as refused:
        publish(database, output=database.parent / where)
    assert codes(refused) == ["E_UNWRITABLE"]
    assert hash_tree(database) == before


def test_a_target_that_cannot_be_written_is_refused(database, publish, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteRefused) as refused:
        publish(database, output=tmp_path / "file/below")
    assert codes(refused) == ["E_UNWRITABLE"]


def test_hostile_facts_become_plain_lines_and_licences_are_known_in_any_spelling(database):
    (database / "database.toml").write_text('title = "<b>x</b>\\u0000\\u202e\\n\\u0007y"\n')
    assert read_facts(database).title == "<b>x</b> \u202e y"
    known = licence_of("CC-BY-4.0")
    assert known == licence_of("cc by 4.0")
    assert known == licence_of("http://creativecommons.org/licenses/by/4.0/")


def test_the_gamut_of_the_reference_camera_is_published(database, publish):
    folder = publish(database)
    head, *rows = (folder / "colour/gamut.csv").read_text().splitlines()
    assert head == "L,a,b,pixels"
    pixels = 120 * 90 - 4 * 4 - 4 * 3 + 48 * 64 - 4 * 4 - 4 * 3  # outside and saturated left out
    assert sum(int(row.split(",")[3]) for row in rows) == pixels
    assert (folder / "colour/gamut.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize("what", ["missing", "empty", "published"])
def test_what_is_no_database_is_one_clear_problem_to_the_check_too(
    database, publish, tmp_path, what
):
    (tmp_path / "empty").mkdir()
    place = publish(database, iiif=False) if what == "published" else tmp_path / what
    (problem, *_) = run.check(place).problems
    assert problem.code == ("E_VALUE" if what == "published" else "E_UNREADABLE")
    with pytest.raises(PublishRefused):
        publish(place)


def test_names_may_hold_spaces_and_letters_of_any_script(database, publish, tmp_path):
    folder = tmp_path / "Ikonen, größer 名"
    folder.mkdir()
    moved = database.rename(folder / "Daten bank")
    assert publish(moved, iiif=False) == folder / "Daten bank.published"

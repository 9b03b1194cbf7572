"""What an export and other commands with `-o` replace, and what not."""

import csv
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from levkas.cli import app
from levkas.core.digests import hash_tree
from levkas.core.disk import WriteRefused
from levkas.core.ownership import MARK
from levkas.core.problems import Refused
from levkas.publish.export.run import FORMS, export


def exported(database, form, folder, **options):
    return [
        path for step in export(database, form, output=folder, **options) for path in step.files
    ]


@pytest.mark.parametrize(
    "form", [form for form in FORMS if form != "ngff"]
)  # folders: test_ngff.py
def test_an_export_replaces_its_own_files_and_nothing_else(database, tmp_path, form):
    folder = tmp_path / "out"
    files = exported(database, form, folder)
    first = hash_tree(folder)
    (folder / "notes.txt").write_text("three years")
    assert exported(database, form, folder) == files
    assert hash_tree(folder) == {**first, "notes.txt": hash_tree(folder)["notes.txt"]}
    files[-1].write_text("a result of somebody else")
    with pytest.raises(WriteRefused) as refused:
        exported(database, form, folder)
    assert refused.value.problems[0].file == str(files[-1])
    assert "--overwrite" in refused.value.problems[0].fix
    assert files[-1].read_text() == "a result of somebody else"


def test_files_of_somebody_else_in_the_folder_of_an_export_stay(database, tmp_path):
    names = {path.name for path in exported(database, "envi", tmp_path / "names")}
    other = tmp_path / "other"
    other.mkdir()
    for name in names:
        (other / name).write_text("three years")
    before = hash_tree(other)
    arguments = ["export", str(database), "--for", "envi", "-o", str(other)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 1 and "E_UNWRITABLE" in done.output
    assert hash_tree(other) == before
    assert CliRunner().invoke(app, [*arguments, "--overwrite"]).exit_code == 0
    assert hash_tree(other) == hash_tree(tmp_path / "names")


@pytest.mark.parametrize("text", ["a list of my files", '{"files": 3}', "[]"])
def test_a_record_that_is_none_of_ours_stays(database, tmp_path, text):
    (tmp_path / "levkas-files.json").write_text(text)
    with pytest.raises(WriteRefused, match="was not written by Levkas"):
        exported(database, "envi", tmp_path)
    assert hash_tree(tmp_path).keys() == {"levkas-files.json"}
    assert (tmp_path / "levkas-files.json").read_text() == text


def test_names_of_a_catalogue_lead_no_export_out_of_its_folder(database, tmp_path):
    foreign = Path(shutil.copytree(database, tmp_path / "a/b/database"))
    path = foreign / "catalogue.csv"
    rows = list(csv.reader(path.read_text().splitlines()))
    rows[1][0] = "../../../x"
    (tmp_path / "a/x").mkdir()
    shutil.copy(foreign / "objects/icon1/icon1_rgb.tif", tmp_path / "a/x_rgb.tif")
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    before = hash_tree(tmp_path)
    for form in FORMS:
        with pytest.raises(Refused, match="points to another folder"):
            exported(foreign, form, tmp_path / "a/out")
    assert hash_tree(tmp_path) == before


@pytest.mark.parametrize("command", ["map", "chart", "radiometry", "plan light"])
def test_a_page_or_table_replaces_no_file_unless_asked_to(database, tmp_path, command):
    page, table = tmp_path / "page.html", tmp_path / "points.csv"
    page.write_text("three years")
    table.write_text("x,y\n1,1\n")
    arguments = {
        "map": ["map", database, "icon1", table, "-o", page],
        "chart": ["chart", database, "--object", "icon1", "-o", page],
        "radiometry": ["radiometry", tmp_path, "-o", page],
        "plan light": ["plan", "light", tmp_path, "-o", page],
    }[command]
    done = CliRunner().invoke(app, list(map(str, arguments)))
    assert done.exit_code == 1 and f"{page}: found a file" in done.output
    assert "--overwrite" in done.output
    assert page.read_text() == "three years"
    more = CliRunner().invoke(app, [*map(str, arguments), "--overwrite"])
    assert "already exists" not in more.output


def test_nothing_is_written_into_a_database_from_outside(database, tmp_path):
    foreign = Path(shutil.copytree(database, tmp_path / "database"))
    (foreign / "database.toml").write_text(MARK)
    table = tmp_path / "points.csv"
    table.write_text("x,y\n1,1\n")
    before = hash_tree(foreign)
    done = CliRunner().invoke(
        app, ["map", str(foreign), "icon1", str(table), "-o", str(foreign / "new.csv")]
    )
    assert done.exit_code == 1 and "into a folder of Levkas" in done.output
    assert hash_tree(foreign) == before


CONTENTS = {
    "missing": (None, "no such file"),
    "Latin-1": ("x,y\né,1\n".encode("latin-1"), "UTF-8"),
    "empty": (b"", "nothing"),
    "not a table": (b'x,y\n"' + b"1" * 200_000, "field larger"),
}


@pytest.mark.parametrize("what", CONTENTS)
@pytest.mark.parametrize("given", ["file", "standard input"])
def test_a_table_of_points_that_cannot_be_read_is_refused(
    database, tmp_path, what, given, monkeypatch
):
    # The names are checked before points are read, and this database has no maps.
    monkeypatch.setattr("levkas.database.pixel_frames.find_map", lambda *names: None)
    table, (content, said) = tmp_path / "points.csv", CONTENTS[what]
    if content is not None:
        table.write_bytes(content)
    elif given != "file":
        pytest.skip("standard input is always there")
    arguments = ["map", str(database), "icon1", *([str(table)] if given == "file" else [])]
    done = CliRunner().invoke(app, arguments, input=None if given == "file" else content)
    assert done.exit_code == 1 and isinstance(done.exception, SystemExit)
    assert "E_" in done.output and said in done.output
    assert given != "file" or str(table) in done.output

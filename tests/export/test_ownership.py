"""What an export and other commands with `-o` replace, and what not."""

import csv
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from levkas.cli import app
from levkas.core.digests import hash_tree
from levkas.core.disk import WriteRefused
from levkas.core.problems import Refused
from levkas.publish.export.run import FORMS, export


def exported(database, form, folder, **options):
    return [
        path for step in export(database, form, output=folder, **options) for path in step.files
    ]


@pytest.mark.parametrize(
    "form", [form for form in FORMS if form != "ngff"]
)  # folders: test_ngff.py
def test_an_export_replaces_files_only_where_that_is_asked_for(database, tmp_path, form):
    folder = tmp_path / "out"
    before = hash_tree(database)
    files = exported(database, form, folder)
    first = hash_tree(folder)
    (folder / "notes.txt").write_text("three years")
    with pytest.raises(WriteRefused) as refused:
        exported(database, form, folder)
    assert Path(refused.value.problems[0].file).is_relative_to(folder)
    assert exported(database, form, folder, overwrite=True) == files
    assert hash_tree(folder) == {**first, "notes.txt": hash_tree(folder)["notes.txt"]}
    assert hash_tree(database) == before


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
        with pytest.raises(Refused):
            exported(foreign, form, tmp_path / "a/out")
    assert hash_tree(tmp_path) == before

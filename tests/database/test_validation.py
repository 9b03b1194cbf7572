import json
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from levkas.cli import app
from levkas.core.cube import Band, Cube
from levkas.core.digests import hash_file
from levkas.core.files import write_json
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import NAME, write_manifest
from levkas.database.store import write_index
from levkas.database.validation import validate


def cube_of(labels, seed):
    rng = np.random.default_rng(seed)
    values = rng.normal(0.5, 0.2, (40, 50, len(labels))).astype(np.float32)
    flags = rng.integers(0, 128, values.shape, dtype=np.uint8)
    return Cube(values, flags, 0.01 * np.abs(values), tuple(labels))


VIS = [Band(f"{nm} nm", float(nm), 7.0) for nm in (450, 550, 650)]
RGB = [Band(c) for c in "RGB"]


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A small database as a build leaves it."""
    root = tmp_path_factory.mktemp("published") / "db"
    entries = []
    for seed, (name, camera, bands) in enumerate(
        [("icon1", "vis", VIS), ("icon1", "d80", RGB), ("icon2", "vis", VIS)]
    ):
        layer = Layer(name, camera, px_per_mm=2.5)
        entries.append(write_layer(root, layer, cube_of(bands, seed))[0])
        write_json(
            root / "objects" / name / "registration" / f"{camera}.json", {"method": "x", "n": seed}
        )
    for name in ("icon1", "icon2"):
        write_index(root / "zarr" / f"{name}.zarr")
    write_catalogue(root, entries)
    write_manifest(root)
    return root


@pytest.fixture
def database(published, tmp_path):
    return shutil.copytree(published, tmp_path / "db")


def flip(path, place, mask=1):
    data = bytearray(path.read_bytes())
    data[place] ^= mask
    path.write_bytes(data)


def test_what_happened_to_a_file_is_said(database):
    one, other = (database / f"objects/{n}/{n}_vis.sigma.tif" for n in ("icon1", "icon2"))
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)
    cut = database / "objects/icon1/icon1_d80.tif"
    cut.write_bytes(cut.read_bytes()[:100])
    (database / "objects/icon2/icon2_vis.png").rename(database / "lost.png")
    flip(database / "objects/icon1/icon1_vis.png", 50)
    reported = {p.file.removeprefix(f"{database}/"): p for p in validate(database).problems}
    assert len(reported) == 6 and reported["objects/icon1/icon1_vis.png"].code == "E_DAMAGED"
    assert reported["objects/icon1/icon1_vis.sigma.tif"].code == "E_SWAPPED"
    assert "icon2_vis.sigma.tif" in reported["objects/icon1/icon1_vis.sigma.tif"].found
    assert reported["objects/icon1/icon1_d80.tif"].code == "E_TRUNCATED"
    assert reported["objects/icon1/icon1_d80.tif"].found == "100 bytes"
    assert reported["objects/icon2/icon2_vis.png"].found == "its content is at lost.png"
    assert reported["lost.png"].code == "E_EXTRA"


def test_a_catalogue_that_is_stale_is_found_though_every_hash_is_right(database):
    text = (database / "catalogue.csv").read_text()
    wrong = hash_file(database / "objects/icon1/icon1_d80.tif")
    (database / "catalogue.csv").write_text(text.replace(wrong, "0" * 64))
    write_manifest(database)
    (problem,) = validate(database).problems
    assert problem.file == str(database / "catalogue.csv")


def test_files_of_browsers_are_no_damage_and_leftovers_of_a_build_are(database):
    for name in (".DS_Store", "objects/icon1/icon1_vis.tif.aux.xml", "objects/icon1/icon1_vis.qmd"):
        (database / name).write_bytes(b"x")
    assert validate(database).ok
    left = database / "objects/icon1/icon1_vis.tif.partial-0123abcd"
    left.write_bytes(b"x")
    (problem,) = validate(database).problems
    assert (problem.file, problem.code) == (str(left), "E_EXTRA")


@pytest.mark.parametrize("change", [None, lambda data: data[:300] + b"0" + data[301:]])
def test_of_a_manifest_that_is_missing_or_damaged_that_alone_is_reported(database, change):
    data = (database / NAME).read_bytes()
    (database / NAME).unlink()
    if change:
        (database / NAME).write_bytes(change(data))
    (problem,) = validate(database).problems
    assert (problem.code, problem.file) == ("E_DAMAGED", str(database / NAME))


def test_the_command_reports_as_the_contract_says(database):
    run = CliRunner().invoke(app, ["validate", str(database), "--json"])
    report = json.loads(run.stdout)
    assert (run.exit_code, report["ok"], report["problems"]) == (0, True, [])
    assert report["checked"] == sum(1 for p in database.rglob("*") if p.is_file())
    flip(database / "catalogue.csv", 20)
    run = CliRunner().invoke(app, ["validate", str(database), "--json"])
    report = json.loads(run.stdout)
    assert (run.exit_code, report["ok"]) == (1, False)
    assert report["problems"][0]["file"] == str(database / "catalogue.csv")
    assert CliRunner().invoke(app, ["validate", str(database / "objects")]).exit_code == 1

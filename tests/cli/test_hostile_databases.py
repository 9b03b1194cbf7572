"""Damaged and malicious databases through every command that reads them: a refusal, soon, in little memory."""

import csv
import io
import json
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import levkas
from levkas.cli import app
from levkas.core.problems import Refused
from levkas.database.manifest import NAME, list_files

MOST_S = 5.0
"""Of processor time, for all commands together."""
BRACKETS = b"[" * (2 << 20)
PAIRS = b'{"a":[' + b"[]," * (600_000) + b"[]]}"
RECORD = "objects/icon1/registration/d80.json"
VALUES = "zarr/icon1.zarr/d80/values/zarr.json"
BAND = "zarr/icon1.zarr/d80/band/zarr.json"


@pytest.fixture(scope="module")
def sound(made_database):
    """That database, after every command has read it: what they import is in no test's time."""
    outcomes = read_all(made_database)
    assert outcomes == dict.fromkeys(outcomes, "done")
    return made_database


@pytest.fixture
def database(sound, tmp_path):
    shutil.copy(sound.parent / "points.csv", tmp_path)
    return shutil.copytree(sound, tmp_path / "db")


def opened(root):
    database = levkas.open(root)["icon1"]
    layer = database["d80"]
    for array in (layer, layer.flags, layer.sigma):
        if array is not None:
            array[10, 10].values.tolist()
    database.position_sigma("d80")


ALL = ("open", "map", "export", "evaluate", "validate")


def read_all(root, commands=ALL):
    """Open a database and run commands that read it; return what came of each."""
    found = {}
    try:
        if "open" in commands:
            opened(root)
            found["open"] = "done"
    except Refused as refused:
        found["open"] = refused.problems[0].code
    for name, *arguments in (
        ("map", "map", root, "icon1", root.parent / "points.csv", "--from", "d80", "--to", "vis"),
        ("export", "export", root, "--for", "envi", "-o", root.parent / "exported", "--overwrite"),
        ("evaluate", "evaluate", root),
        ("validate", "validate", root),
    ):
        if name not in commands:
            continue
        result = CliRunner().invoke(app, [str(a) for a in arguments])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        found[name] = "done" if result.exit_code == 0 else result.output.split(":")[0]
    return found


def read_soon(root, commands=ALL):
    before = time.process_time()
    outcomes = read_all(root, commands)
    taken = time.process_time() - before
    assert taken < MOST_S, f"{taken:.1f} s of processor time"
    return outcomes


CONTENTS = (BRACKETS, PAIRS, b"", b"[1]", b'{"shape":' + b"9" * (2 << 20) + b"}", b"\xff", b"{}")


@pytest.mark.parametrize(
    "file, refusing",
    [(RECORD, ("map", "evaluate", "open")), (VALUES, ("open",)), (BAND, ("open",)), ("catalogue.csv", ("open",))],
)  # fmt: skip
def test_records_of_a_database_that_are_none_are_refused(file, refusing, database):
    for content in CONTENTS:
        (database / file).write_bytes(content)
        assert "done" not in read_soon(database, refusing).values(), content[:20]


@pytest.mark.parametrize("content", [BRACKETS, PAIRS], ids=["brackets", "pairs"])
@pytest.mark.parametrize("file", [RECORD, VALUES, "zarr/icon1.zarr/zarr.json"])
def test_a_check_without_a_manifest_names_records_that_are_none(file, content, database):
    (database / file).write_bytes(content)
    (database / NAME).unlink()  # else every file would only be hashed
    assert read_soon(database, ("validate",))["validate"] != "done"
    assert Path(file).name in CliRunner().invoke(app, ["validate", str(database)]).output


ODD = {
    "object": "../../..",
    "camera": 7,
    "setup": "a/b",
    "reference": [],
    "reference/camera": "../x",
    "grid": 3,
    "grid/size": [1e9, 1e9],
    "grid/transform": {"kind": "affine", "matrix": [[1, 0, 0]]},
    "verdict": "accept",
    "verdict/decision": [],
    "bands": [1],
    "bands/G": 1,
    "bands/G/size": "large",
    "bands/G/transform/matrix": "x",
    "bands/G/transform/kind": "magic",
    "bands/G/sigma": {"x": [0], "y": []},
    "errors": {"check_points": [{"error": 1}]},
}


@pytest.mark.slow
def test_a_registration_record_with_a_part_that_is_none_is_refused_by_its_name(database):
    path = database / RECORD
    whole = path.read_text()
    for place, value in ODD.items():
        record = json.loads(whole)
        *above, last = place.split("/")
        part = record
        for name in above:
            part = part[name]
        part[last] = value
        path.write_text(json.dumps(record))
        outcomes = read_soon(database, ("map", "evaluate", "open"))
        assert set(outcomes.values()) == {"E_VALUE"}, place
        refused = CliRunner().invoke(app, ["evaluate", str(database)]).output
        assert "d80.json" in refused
        assert (above or [last])[0] in refused


@pytest.mark.parametrize("file", [VALUES, BAND])
@pytest.mark.parametrize("key", ["shape", "chunk"])
def test_an_array_of_billions_is_refused_before_memory_is_taken(file, key, database):
    path = database / file
    record = json.loads(path.read_text())
    large = [10**9] * len(record["shape"])
    if key == "shape":
        record["shape"] = large
    else:
        record["chunk_grid"]["configuration"]["chunk_shape"] = large
    path.write_text(json.dumps(record))
    (database / NAME).unlink()
    outcomes = read_soon(database, ("open", "validate"))
    assert outcomes["validate"] != "done"
    assert outcomes["open"] != "done"


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
@pytest.mark.parametrize(
    "file, refusing",
    [
        ("catalogue.csv", ("open", "export")),
        ("objects/icon1/icon1_d80.tif", ("export", "evaluate")),
        ("objects/icon1/icon1_d80.flags.tif", ("export",)),
        ("objects/icon1", ("export", "map", "evaluate", "open")),
        (RECORD, ("map", "evaluate", "open")),
        (VALUES, ("open",)),
        ("zarr/icon1.zarr/d80/values", ("open",)),
        ("zarr/icon1.zarr/d80/band/c", ("open",)),
        ("zarr", ("open",)),
    ],
)
def test_links_that_lead_out_are_not_followed(file, refusing, database):
    outside = database.parent / "outside"
    (database / file).rename(outside)
    (database / file).symlink_to(outside)
    outcomes = read_soon(database, (*refusing, "validate"))
    assert set(outcomes.values()) == {"E_LINK"}, outcomes


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_shard_behind_a_link_is_not_read(database):
    folder = database / "zarr/icon1.zarr/d80/values"
    shard = next(p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != "zarr.json")
    shard.rename(database.parent / "shard")
    shard.symlink_to(database.parent / "shard")
    layer = levkas.open(database)["icon1"]["d80"]
    with pytest.raises(Refused, match="points outside"):
        layer[10, 10].values.tolist()


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_database_that_is_itself_behind_a_link_is_read(database, tmp_path):
    (tmp_path / "here").symlink_to(database)
    assert set(read_soon(tmp_path / "here").values()) == {"done"}


def test_folders_of_900_levels_are_listed_to_a_bound_and_named(database):
    before = Path.cwd()
    os.chdir(database / "zarr/icon1.zarr/d80/values")
    for _ in range(900):
        Path("d").mkdir()
        os.chdir("d")
    Path("end.txt").write_text("x")
    os.chdir(before)
    try:
        assert max(name.count("/") for name in list_files(database)) == 64
        refused = CliRunner().invoke(app, ["validate", str(database)])
        assert refused.exit_code == 1
        assert "d/d/d" in refused.output
    finally:
        most = sys.getrecursionlimit()
        sys.setrecursionlimit(4000)  # Python 3.11 removes folders by calling itself once a level
        shutil.rmtree(database / "zarr")
        sys.setrecursionlimit(most)


def test_a_small_tiff_that_decodes_to_much_is_not_decoded_by_a_check(database):
    import tifffile

    path = database / "objects/icon1/icon1_d80.tif"
    tifffile.imwrite(path, np.zeros((8000, 8000), np.uint16), compression="zlib", metadata=None)
    (database / NAME).unlink()
    before = time.process_time()
    refused = CliRunner().invoke(app, ["validate", str(database)])
    assert time.process_time() - before < MOST_S
    assert "the file is far smaller than its decoded frame" in refused.output


def test_a_table_whose_rows_differ_is_told_with_the_line_of_the_first(database):
    (database / NAME).unlink()
    text = (database / "catalogue.csv").read_text()
    (database / "catalogue.csv").write_text(text + "a,b\n")
    row = len(list(csv.reader(io.StringIO(text)))) + 1
    refused = CliRunner().invoke(app, ["validate", str(database)]).output
    assert f"row {row}" in refused
    assert "2 cells" in refused

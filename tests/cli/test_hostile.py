"""Texts, names, frames and databases made to break a program, through the commands that people type: a refusal, soon, no traceback.

`tests/readers` asks the readers alone, with more kinds.
"""

import json
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
import typer.main
from typer.testing import CliRunner

import levkas
from levkas.cli import app
from levkas.core.problems import Refused
from levkas.database.manifest import list_files

MOST_S = 6.0
"""Of processor time: three times the 2 s that are promised, since other programs may share the processor and its caches."""
UNIX = pytest.mark.skipif(sys.platform == "win32", reason="links and names of Unix")


def run(*arguments):
    """Run a command; any exception but a refusal or a wrong option is a failure, and so is a long time."""
    before = time.process_time()
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    taken = time.process_time() - before
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code in (0, 1, 2), result.output[-500:]
    assert taken < MOST_S, f"{taken:.1f} s of processor time"
    return result


def codes(*arguments):
    """Return the codes of the problems that a command reports."""
    report = json.loads(run(*arguments, "--json").stdout)
    return {problem["code"] for problem in report["problems"]}


@pytest.fixture(scope="module", autouse=True)
def imported(tmp_path_factory):
    """Import what the commands import, so that no test's time includes it."""
    frame = tmp_path_factory.mktemp("sound") / "frame.tif"
    tifffile.imwrite(frame, np.ones((20, 20), np.uint16))
    for words in (["chart", frame], ["look", frame.parent], ["radiometry", frame]):
        CliRunner().invoke(app, [str(word) for word in words])
    CliRunner().invoke(app, ["plan", "exposure", str(frame), "--bits", "12"])


# --- texts ---------------------------------------------------------------------------------------

HEAD = '[campaign]\nreference = { camera = "vis", band = "G" }\n'
CAMERA = '[cameras.vis]\nkind = "image"\nfiles = "vis/{target}.png"\n'
MONSTERS = {
    "keys": (HEAD + CAMERA, "k{}=1\n", ""),
    "names of objects": (HEAD + CAMERA + "[targets]\nobjects=[", '"o{}",', "]"),
    "brackets": (HEAD + CAMERA + "x=[", "[],", "]"),
    "stars": (HEAD + CAMERA[:-2] + '\nfiles="', "*", '"'),
}


@pytest.mark.parametrize("name", MONSTERS)
def test_a_campaign_file_that_is_far_too_long_is_refused_soon(name, tmp_path):
    before, line, after = MONSTERS[name]
    lines = (line.format(i) for i in range((1 << 20) // len(line.format(10_000))))
    (tmp_path / "campaign.toml").write_text(before + "".join(lines) + after)
    refused = run("status", tmp_path)
    assert refused.exit_code == 1 and len(refused.output) < 8_000_000


EACH = {}
for words, one in typer.main.get_command(app).commands.items():
    inner = getattr(one, "commands", None) or {"": one}
    EACH |= {f"{words} {name}".strip(): command.params for name, command in inner.items()}
UNUSABLE = ("a\0b", "a\ud800b")
TOO_LONG = ("x" * 256, "é" * 128, "a/" * 2100 + "b")


@pytest.mark.parametrize("name", EACH)
def test_no_text_of_a_command_that_no_file_can_bear_ends_in_a_traceback(name):
    arguments = [p for p in EACH[name] if p.param_type_name == "argument" and p.required]
    for param in EACH[name]:
        kind = str(param.type_descriptor.annotation)
        if "Path" not in kind and "str" not in kind:
            continue
        for text in (*UNUSABLE, *(TOO_LONG if "Path" in kind else ())):
            words = [text if p is param else "x" for p in arguments]
            words += [text] if param.param_type_name == "argument" and not param.required else []
            words += [param.opts[0], text] if param.param_type_name == "option" else []
            found = run(*name.split(), *words)
            assert found.exit_code in (1, 2), (param.opts[0], text[:9])
            assert found.exit_code == 2 or len(found.output) < 8000


@pytest.mark.parametrize(
    "words",
    [
        "simulate s3://m/i",
        "build s3://m/i",
        "look https://m.org/a",
        "chart s3://m/i",
        "validate s3://",
    ],
)
def test_an_address_in_place_of_a_folder_is_refused(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(*words.split()).exit_code != 0
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("output", ["x" * 250, "/", "a/" * 2100 + "b"])
def test_an_output_that_no_folder_can_bear_is_refused(tmp_path, output):
    (tmp_path / "campaign.toml").write_text(HEAD + CAMERA)
    assert codes("status", tmp_path, "-o", output) == {"E_VALUE"}


# --- folders and frames ------------------------------------------------------------------------


def deepened(folder):
    """Make folders of 900 levels below a folder."""
    before = Path.cwd()
    os.chdir(folder)
    for _ in range(900):
        Path("d").mkdir()
        os.chdir("d")
    Path("end.txt").write_text("x")
    os.chdir(before)


def without_depth(folder):
    most = sys.getrecursionlimit()
    sys.setrecursionlimit(4000)  # Python 3.11 removes folders by calling itself once a level
    shutil.rmtree(folder / "d")
    sys.setrecursionlimit(most)


@UNIX
def test_folders_of_900_levels_are_left_out_or_refused_and_links_in_a_circle_entered_once(tmp_path):
    tifffile.imwrite(tmp_path / "top.tif", np.arange(400, dtype=np.uint16).reshape(20, 20))
    (tmp_path / "again").symlink_to(tmp_path, target_is_directory=True)
    deepened(tmp_path)
    try:
        looked = json.loads(run("look", tmp_path, "--json").stdout)
        assert looked["ok"] and len(looked["left_out"]) == 1
        text = (HEAD + CAMERA).replace("vis/{target}.png", "**/{target}.tif")
        (tmp_path / "campaign.toml").write_text(text)
        assert codes("status", tmp_path) == {"E_SIZE"}
    finally:
        without_depth(tmp_path)


@UNIX
@pytest.mark.parametrize("name", [b"icon\n1.tif", b"icon\xff.tif", b'icon{"1.tif'])
def test_odd_names_of_frames_end_in_no_traceback(name, tmp_path):
    frame = tmp_path / os.fsdecode(name)
    tifffile.imwrite(frame, np.arange(400, dtype=np.uint16).reshape(20, 20))
    for words in (["look", tmp_path, "--json"], ["radiometry", tmp_path], ["chart", frame]):
        run(*words)


def test_names_that_are_too_long_together_refuse_their_layer_alone(tmp_path):
    """Each fits in a name of 255 bytes: 70 letters of three bytes each with a camera's do not."""
    (tmp_path / "photo").mkdir()
    for name in ("panel", "板" * 70):
        pixels = np.zeros((20, 30, 3), np.uint8)
        tifffile.imwrite(tmp_path / f"photo/{name}.tif", pixels, photometric="rgb")
    text = '[campaign]\nreference = "photo:G"\n[cameras.photo]\nkind = "image"\nfiles = "photo/{target}.tif"\n'
    (tmp_path / "campaign.toml").write_text(text)
    assert codes("status", tmp_path) == {"E_VALUE"}


@pytest.mark.parametrize("value", [-np.inf, np.nan, 1e308])
@pytest.mark.filterwarnings("ignore:overflow")
def test_frames_of_no_numbers_end_in_no_traceback(tmp_path, value):
    values = np.random.default_rng(1).random((30, 40))
    values[... if np.isnan(value) else (3, 4)] = value
    for name in "ab":
        tifffile.imwrite(tmp_path / f"{name}.tif", values, metadata=None)
    assert run("look", tmp_path).exit_code == 0
    run("radiometry", tmp_path / "a.tif")


@pytest.mark.parametrize("content", [b"", b"[" * (2 << 20), b"," * (2 << 20), b"\xff\xfe" * 100])
def test_hostile_tables_of_points_are_refused_soon(content, tmp_path, made_database):
    (tmp_path / "points.csv").write_bytes(content)
    assert run("map", made_database, "icon1", tmp_path / "points.csv").exit_code == 1


# --- databases ---------------------------------------------------------------------------------

RECORD = "objects/icon1/registration/d80.json"
VALUES = "zarr/icon1.zarr/d80/values/zarr.json"
PAIRS = b'{"a":[' + b"[]," * (600_000) + b"[]]}"


@pytest.fixture
def database(made_database, tmp_path):
    shutil.copy(made_database.parent / "points.csv", tmp_path)
    return shutil.copytree(made_database, tmp_path / "db")


def opened(root):
    database = levkas.open(root)["icon1"]
    for array in (database["d80"], database["d80"].levkas.flags, database["d80"].levkas.sigma):
        array[10, 10].values.tolist()
    database.position_sigma("d80")


def came_of(root, command):
    """Return ``"done"``, or the code of the refusal, of opening a database or of a command that reads it."""
    if command == "open":
        try:
            opened(root)
        except Refused as refused:
            return refused.problems[0].code
        return "done"
    words = {
        "map": ["map", root, "icon1", root.parent / "points.csv", "--from", "d80", "--to", "vis"],
        "export": ["export", root, "--for", "envi", "-o", root.parent / "exported", "--overwrite"],
        "evaluate": ["evaluate", root],
        "validate": ["validate", root],
    }[command]
    result = run(*words)
    return "done" if result.exit_code == 0 else result.output.split(":")[0]


READERS = ("open", "map", "export", "evaluate", "validate")


def test_a_sound_database_is_read_by_all_even_behind_a_link(database, tmp_path):
    (tmp_path / "here").symlink_to(database)
    assert {came_of(tmp_path / "here", one) for one in READERS} == {"done"}


@pytest.mark.parametrize(
    ("file", "readers"),
    [
        (RECORD, ("map", "evaluate", "open")),
        (VALUES, ("open",)),
        ("catalogue.csv", ("open", "export")),
    ],
)
def test_records_of_a_database_that_are_none_are_refused(file, readers, database):
    for content in (b"[" * (2 << 20), PAIRS, b"", b"[1]", b"\xff", b"{}"):
        (database / file).write_bytes(content)
        assert "done" not in {came_of(database, one) for one in readers}, content[:20]


ODD = {
    "object": "../../..",
    "camera": 7,
    "reference/camera": "../x",
    "grid/size": [1e9, 1e9],
    "grid/transform": {"kind": "affine", "matrix": [[1, 0, 0]]},
    "verdict/decision": [],
    "bands/G/transform/kind": "magic",
    "bands/G/sigma": {"x": [0], "y": []},
    "errors": {"check_points": [{"error": 1}]},
}


def test_a_registration_record_with_a_part_that_is_none_is_refused(database):
    path = database / RECORD
    whole = path.read_text()
    for place, value in ODD.items():
        record = part = json.loads(whole)
        *above, last = place.split("/")
        for name in above:
            part = part[name]
        part[last] = value
        path.write_text(json.dumps(record))
        assert {came_of(database, one) for one in ("map", "evaluate", "open")} == {"E_VALUE"}, place


def test_an_array_of_billions_is_refused_before_memory_is_taken(database):
    path = database / VALUES
    record = json.loads(path.read_text())
    record["shape"] = [10**9] * len(record["shape"])
    path.write_text(json.dumps(record))
    assert came_of(database, "open") != "done"


@UNIX
@pytest.mark.parametrize(
    ("file", "readers"),
    [
        ("catalogue.csv", ("open", "export")),
        ("objects/icon1/icon1_d80.tif", ("export", "evaluate")),
        ("objects/icon1", ("map", "open")),
        (VALUES, ("open",)),
        ("zarr", ("open",)),
    ],
)
def test_links_that_lead_out_are_not_followed(file, readers, database):
    (database / file).rename(database.parent / "outside")
    (database / file).symlink_to(database.parent / "outside")
    assert {came_of(database, one) for one in (*readers, "validate")} == {"E_LINK"}


def test_what_is_deep_is_listed_to_a_bound(database):
    deepened(database)
    try:
        assert max(name.count("/") for name in list_files(database)) == 64
        assert came_of(database, "validate") != "done"
    finally:
        without_depth(database)

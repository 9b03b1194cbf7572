"""Names and texts that no file can bear or hold, in every option of every command and every key of a campaign: refused, never a traceback."""

import json
import tomllib
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import tifffile
import tomlkit
import typer
import typer.main
from typer.testing import CliRunner

from levkas.cli import app
from levkas.core.problems import Refused


def run(*arguments):
    """Run a command; any exception but a refusal or a wrong option is a failure."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def commands(command=None, name=()):
    """Yield the words and parameters of every command."""
    command = command or typer.main.get_command(app)
    if not hasattr(command, "commands"):
        yield name, command.params
        return
    for word, inner in command.commands.items():
        yield from commands(inner, (*name, word))


EACH = {" ".join(words): params for words, params in commands()}
UNUSABLE = {"null": "a\0b", "half a character": "a\ud800b"}
TOO_LONG = {"long": "x" * 256, "long in bytes": "é" * 128, "deep": "a/" * 2100 + "b"}


def with_value(name, param, text):
    """The words of a command with a text as one of its parameters, and any path where others are required."""
    words = [*name.split(), *("x" for p in EACH[name] if p.required and p is not param)]
    if param.param_type_name == "argument":
        before = [p for p in EACH[name] if p.param_type_name == "argument" and p.required]
        words.insert(
            len(name.split()) + (before.index(param) if param in before else len(before)), text
        )
        return words
    return [*words, param.opts[0], text]


def texts(name):
    """Yield the parameters of a command that take a text, and whether it is a path."""
    for param in EACH[name]:
        kind = str(param.type_descriptor.annotation)
        if "Path" in kind or "str" in kind:
            yield param, "Path" in kind


@pytest.mark.parametrize("name", EACH)
def test_no_text_of_a_command_that_no_file_can_bear_ends_in_a_traceback(name):
    for param, is_path in texts(name):
        for text in (UNUSABLE | (TOO_LONG if is_path else {})).values():
            found = run(*with_value(name, param, text))
            assert found.exit_code in (1, 2), (param.opts[0], text[:9])
            if found.exit_code == 1:
                assert "E_VALUE" in found.output and len(found.output) < 8000


def test_what_the_system_refuses_is_a_problem_and_no_traceback(tmp_path):
    (tmp_path / "file").write_text("x")
    found = run("validate", tmp_path / "file" / "below")
    assert found.exit_code == 1 and found.output.startswith("E_")


@pytest.mark.parametrize("address", ["https://[::1", "s3://"])
def test_an_address_that_is_none_is_refused(address):
    assert run("validate", address).exit_code == 1


@pytest.mark.parametrize(
    ("words", "address"),
    [
        ("simulate ADDRESS", "https://museum.org/a/b"),
        ("simulate ADDRESS", "file:///srv/icons"),
        *((words, "s3://museum/icons.x") for words in (
            "build ADDRESS", "status ADDRESS", "look ADDRESS", "publish ADDRESS", "radiometry ADDRESS", "simulate ADDRESS",
            "radiometry FOLDER -o ADDRESS", "chart ADDRESS")),
    ],
)  # fmt: skip
def test_an_address_in_place_of_a_folder_is_shown_as_it_was_written(
    words, address, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    found = run(*words.replace("ADDRESS", address).replace("FOLDER", str(tmp_path)).split())
    assert found.exit_code != 0
    assert f" {address}" in found.output and str(tmp_path) not in found.output
    assert not [*tmp_path.iterdir()]


# --- keys of a campaign -----------------------------------------------------------------------

CAMPAIGN = """
[campaign]
title = "T"
creator = "A. Maker"
date = "2019"
licence = "CC0-1.0"
setup = "base"
output = "database"
reference = { camera = "photo", band = "G" }
[cameras.photo]
kind = "image"
files = ["photo/{target}.png"]
bands = ["R", "G", "B"]
[cameras.colour]
kind = "mosaic"
files = "colour/{target}.tif"
pattern = [["R", "G"], ["G", "B"]]
sensitivity = "table.csv"
reference_band = "G"
dark = ["dark"]
white = ["white"]
[cameras.twin]
kind = "sensors"
[[cameras.twin.sensors]]
name = "near"
files = ["twin/{target}_near.tif"]
bands = ["N"]
[[cameras.twin.sensors]]
name = "far"
files = ["twin/{target}_far.tif"]
bands = ["F"]
[cameras.filters]
kind = "bands"
files = "filters/{target}_{wavelength}nm.tif"
manifest = "table.csv"
[targets]
dark = "dark"
white = { names = "white", reflectance = "table.csv" }
objects = ["one", "two"]
[objects.one]
title = "The first"
creator = "c"
date = "about 1650"
medium = "m"
owner = "o"
rights = "r"
inventory = "i"
[setups.raking]
title = "Raking light"
description = "d"
spectrum = "table.csv"
cameras = { filters = { files = "raking/{target}_{wavelength}nm.tif" } }
[registration]
points = "table.csv"
[publication]
creators = [{ name = "A B", orcid = "0000-0002-1825-0097", affiliation = "x" }]
description = "d"
keywords = ["k"]
publisher = "p"
date = "2020"
version = "1"
doi = "10.5281/zenodo.1"
url = "https://a.b"
contact = "c"
related = ["https://c.d"]
"""


def leaves(value, place=()):
    """Yield the place of every text of a record, and of every name of a table that a person chooses."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if place and place[-1] in ("cameras", "objects", "setups"):
                yield (*place, key), True
            yield from leaves(inner, (*place, key))
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from leaves(inner, (*place, number))
    elif isinstance(value, str):
        yield place, False


PLACES = list(leaves(tomllib.loads(CAMPAIGN)))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "table.csv").write_text("wavelength,a\n400,1\n")
    (folder / "campaign.toml").write_text(CAMPAIGN)
    assert run("status", folder).exit_code in (0, 1)
    levkas_campaign(folder)
    return folder


def levkas_campaign(folder):
    from levkas.campaign.campaign import load_campaign

    return load_campaign(folder)


@pytest.mark.parametrize("place, is_name", PLACES, ids=[".".join(map(str, p)) for p, _ in PLACES])
def test_a_text_of_a_campaign_without_meaning_to_files_and_pages_is_refused(
    campaign, place, is_name
):
    for text in ("a\0b", "a\x01b", "a\x7fb", "x" * 300, "é" * 200):
        record = deepcopy(tomllib.loads(CAMPAIGN))
        table = record
        for key in place[:-1]:
            table = table[key]
        if is_name:
            table[text] = table.pop(place[-1])
        else:
            table[place[-1]] = text
        (campaign / "campaign.toml").write_text(tomlkit.dumps(record))
        try:
            levkas_campaign(campaign)
            assert len(text) > 3, "control characters were accepted"
        except Refused as refused:
            assert all(p.file and p.field for p in refused.problems)


PATHS = ("campaign.output", "cameras.colour.sensitivity", "targets.white.reflectance",
         "setups.raking.spectrum", "registration.points", "cameras.filters.manifest")  # fmt: skip


@pytest.mark.parametrize("place", PATHS)
@pytest.mark.parametrize("text", ["x" * 300, "a/" * 2100 + "b"], ids=["300", "deep"])
def test_no_path_of_a_campaign_is_too_long_for_a_command(campaign, place, text):
    record = tomllib.loads(CAMPAIGN)
    *above, last = place.split(".")
    table = record
    for key in above:
        table = table[key]
    table[last] = text
    (campaign / "campaign.toml").write_text(tomlkit.dumps(record))
    found = run("status", campaign)
    assert found.exit_code == 1
    assert "E_" in found.output


@pytest.mark.parametrize("output", ["x" * 250, "/", "é" * 125])
def test_an_output_that_no_folder_can_bear_is_refused(campaign, output):
    (campaign / "campaign.toml").write_text(CAMPAIGN)
    found = run("status", campaign, "-o", output)
    assert found.exit_code == 1
    assert "E_VALUE" in found.output


def test_names_that_are_too_long_together_refuse_their_layer_alone(tmp_path):
    """Each fits in a name of 255 bytes: 80 letters of three bytes each with a camera's do not."""
    names = ["panel", "板" * 70]
    for name in names:
        (tmp_path / "photo").mkdir(exist_ok=True)
        tifffile.imwrite(
            tmp_path / f"photo/{name}.tif", np.zeros((20, 30, 3), np.uint8), photometric="rgb"
        )
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nreference = "photo:G"\n[cameras.photo]\nkind = "image"\nfiles = "photo/{target}.tif"\n'
    )
    report = json.loads(run("status", tmp_path, "--json").stdout)
    assert [p["code"] for p in report["problems"]] == ["E_VALUE"]
    assert "too long" in report["problems"][0]["message"]


# --- texts of others --------------------------------------------------------------------------


def test_half_a_character_in_a_record_is_refused(tmp_path):
    from levkas.core.text import parse_bounded, read_json

    path = Path(tmp_path / "a.json")
    path.write_text('{"label": "a\\ud800b"}')
    with pytest.raises(Refused, match="half of a character"):
        read_json(path)
    with pytest.raises(ValueError, match="half of a character"):
        parse_bounded('{"\\uDFFF": 1}')
    assert parse_bounded('{"a": "\\ud83d\\ude00 \\\\ud800"}') == {"a": "😀 \\ud800"}


@pytest.mark.parametrize(
    "kind, value, whole",
    [(np.float32, -np.inf, False), (np.float32, np.nan, True), (np.float64, 1e308, False)],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:overflow")
def test_frames_of_no_numbers_end_in_no_traceback(tmp_path, kind, value, whole):
    values = np.random.default_rng(1).random((30, 40)).astype(kind)
    with np.errstate(over="ignore"):
        values[... if whole else (3, 4)] = value
    for name in "ab":
        tifffile.imwrite(tmp_path / f"{name}.tif", values, metadata=None)
    looked = run("look", tmp_path)
    assert looked.exit_code == 0
    run("radiometry", tmp_path / "a.tif")
    run("plan", "exposure", tmp_path / "a.tif", "--saturation", "2")


def test_an_envi_header_of_very_many_keys_is_refused(tmp_path):
    np.zeros((2, 20, 30), np.uint16).tofile(tmp_path / "a.img")
    head = "ENVI\nsamples = 30\nlines = 20\nbands = 2\ndata type = 12\ninterleave = bsq\n"
    (tmp_path / "a.hdr").write_text(head + "".join(f"k{i} = {i}\n" for i in range(200_000)))
    found = run("chart", tmp_path / "a.hdr")
    assert found.exit_code == 1 and "too many keys" in found.output
    (tmp_path / "a.hdr").write_text(head + "".join(f"k{i} = {i}\n" for i in range(300)))
    assert "too many keys" not in run("chart", tmp_path / "a.hdr").output

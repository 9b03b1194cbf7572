"""Every option of every command acts, or is refused: alone where it needs another, twice where one counts, with a name that is none."""

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import tifffile
import typer.main
from typer.testing import CliRunner

from levkas.cli import app
from levkas.cli.options import EXCLUDES, NEEDS

BENCH = Path(__file__).resolve().parents[2] / "examples" / "plan"


def commands(command=None, name=()):
    """Yield the words of every command, and the command."""
    command = command or typer.main.get_command(app)
    if not hasattr(command, "commands"):
        yield " ".join(name), command
        return
    for word, inner in command.commands.items():
        yield from commands(inner, (*name, word))


EACH = {name: command.params for name, command in commands()}


def named(name, word):
    """The parameter of a command that bears a name."""
    found = [p for p in EACH[name] if word in p.opts]
    assert found, f"{name} has no {word}"
    return found[0]


def words_of(name, word, value="1"):
    """An option with a value where it takes one; an argument is its value."""
    param = named(name, word)
    if param.param_type_name == "argument":
        return [value]
    if getattr(param, "is_flag", False):
        return [word]
    choices = [one for one in get_args(param.type_descriptor.annotation) if isinstance(one, str)]
    return [word, *(choices[:1] or [value])]


def run(name, *words):
    required = ["x" for p in EACH[name] if p.required and p.param_type_name == "argument"]
    for param in EACH[name]:
        if param.required and param.opts[0].startswith("--") and param.opts[0] not in words:
            required += [param.opts[0], "envi"]
    return CliRunner().invoke(app, [*name.split(), *required, *map(str, words)])


@pytest.mark.parametrize("name", NEEDS)
def test_an_option_that_acts_only_with_another_is_refused_alone(name):
    for option, needed in NEEDS[name].items():
        for one in needed:
            assert named(name, one)
        assert run(name, *words_of(name, option)).exit_code == 2, option


@pytest.mark.parametrize("name", EXCLUDES)
def test_an_option_that_would_have_no_effect_beside_another_is_refused(name):
    for option, others in EXCLUDES[name].items():
        for other in others:
            assert run(name, *words_of(name, option), *words_of(name, other)).exit_code == 2, other


@pytest.mark.parametrize("name", EACH)
def test_an_option_is_given_once_or_with_another_value(name):
    for param in (
        p for p in EACH[name] if p.param_type_name == "option" and "--help" not in p.opts
    ):
        word = param.opts[0]
        again = [word, "a"] if param.multiple else words_of(name, word)
        assert run(name, *again, *again).exit_code == 2, word


# --- names that are none ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(tmp_path_factory, made_database):
    """A folder with a campaign, frames, points and a table for the options of all commands."""
    root = tmp_path_factory.mktemp("place")
    (root / "photo").mkdir()
    rng = np.random.default_rng(1)
    pixels = rng.integers(20, 200, (40, 50, 3)).astype(np.uint8)
    tifffile.imwrite(root / "photo/panel.tif", pixels, photometric="rgb", metadata=None)
    tifffile.imwrite(root / "white.tif", rng.integers(2000, 2400, (40, 50)).astype(np.uint16))
    (root / "points.csv").write_text("x,y\n1,2\n")
    (root / "campaign.toml").write_text(
        '[campaign]\nreference = "photo:G"\n[cameras.photo]\nkind = "image"\nfiles = "photo/{target}.tif"\n'
    )
    return root


def test_points_of_layers_that_are_not_there_are_named(made_database, tmp_path):
    table = "object,camera,band,reference_x,reference_y,x,y\n{},d80,{},1,2,1,2\n"
    for name, band, code in (("icon1", "G", 0), ("icon9", "G", 1), ("icon1", "nonsense", 1)):
        (tmp_path / "p.csv").write_text(table.format(name, band))
        found = CliRunner().invoke(
            app, ["evaluate", str(made_database), "--points", str(tmp_path / "p.csv")]
        )
        assert found.exit_code == code, found.output
        assert (name if band == "G" else band) in found.output or code == 0


def test_a_check_of_publish_names_everything_that_is_wrong(made_database, tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.txt").write_text("three years")
    words = ["-o", tmp_path / "other", "--analyse", "ratios", "--url", "nonsense", "--json"]
    found = CliRunner().invoke(app, ["publish", str(made_database), "--check", *map(str, words)])
    assert found.exit_code == 1 and len(json.loads(found.stdout)["problems"]) >= 3


@pytest.mark.parametrize(
    "words, meant",
    [
        (["build", "ROOT", "--object", "pannel"], "panel"),
        (["radiometry", "ROOT", "--camera", "foto"], "photo"),
        (["chart", "DB", "--camera", "d8"], "d80"),
        (["chart", "DB", "--object", "icom1"], "icon1"),
        (["export", "DB", "--for", "envi", "--object", "icom1"], "icon1"),
        (["export", "DB", "--for", "envi", "--camera", "d8"], "d80"),
        (["map", "DB", "icom1", "POINTS"], "icon1"),
        (["map", "DB", "icon1", "POINTS", "--to", "d8"], "d80"),
        (["map", "DB", "icon1", "POINTS", "--to", "vis:550 mm"], "550 nm"),
        (["estimate", "DB", "--from", "d8"], "d80"),
        (["estimate", "DB", "--method", "wienr"], "wiener"),
        (["plan", "light", "BENCH", "--setup-name", "propsed"], "proposed"),
        (["plan", "exposure", "--setup", "BENCH", "--setup-name", "propsed"], "proposed"),
        (["simulate", "OUT", "--preset", "smal"], "small"),
        (["simulate", "OUT", "--setup", "sof"], "soft"),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, list) else v,
)
def test_the_name_that_may_be_meant_is_named(words, meant, place, made_database):
    paths = {"ROOT": place, "DB": made_database, "BENCH": BENCH, "WHITE": place / "white.tif",
             "POINTS": place / "points.csv", "OUT": place / "out"}  # fmt: skip
    refused = CliRunner().invoke(app, [str(paths.get(word, word)) for word in words])
    assert refused.exit_code == 1 and repr(meant) in refused.output

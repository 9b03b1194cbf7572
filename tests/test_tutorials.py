"""The tutorials: every command of docs/tutorials runs in order, in a folder that holds the examples alone."""

import contextlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from levkas.cli import app

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = ROOT / "docs" / "tutorials"
BLOCK = re.compile(r"^```(sh|\{code-block\} \w+\n:caption: (\S+)\n)\n?(.*?)^```$", re.M | re.S)


def run_levkas(arguments, folder):
    """Run a command here, where what it imports is there already; return status and output."""
    with contextlib.chdir(folder):
        ended = CliRunner().invoke(app, arguments)
    return ended.exit_code, ended.stdout or f"{ended.stderr}{ended.exception!r}"


def run_python(arguments, folder):
    """Run a script in a process of its own, as the tutorial says."""
    ended = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src"), "PYTHONUTF8": "1"},
        capture_output=True,
        encoding="utf-8",
    )
    return ended.returncode, ended.stdout + ended.stderr * bool(ended.returncode)


PROGRAMS = {"levkas": run_levkas, "python": run_python}


COUNTED = """
import json
import sys
from numba.core.dispatcher import Dispatcher
from levkas.cli import main
try:
    main()
except SystemExit as ending:
    assert not ending.code
found = {}
for name, module in list(sys.modules.items()):
    for kernel in vars(module).values() if name.startswith("levkas.") else ():
        if isinstance(kernel, Dispatcher) and kernel.stats.cache_path and kernel.signatures:
            name = f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"
            found[name] = len(kernel.signatures)
open("kernels.json", "w").write(json.dumps(found))
"""
MOST_KERNELS = 60
"""Called from Python by `levkas demo`: what a first demo compiles, one kind of arguments each."""


def run_counted(arguments, folder):
    """Run a demo in a process of its own, and leave the kernels that it compiled or loaded in kernels.json."""
    if arguments == ["demo"]:
        return run_python(["-c", COUNTED, *arguments], folder)
    return run_levkas(arguments, folder)


def follow(page, folder, programs=PROGRAMS):
    """Do what a tutorial has: write its files, run its commands; return what they printed."""
    printed = []
    for kind, name, text in BLOCK.findall((TUTORIALS / page).read_text(encoding="utf-8")):
        if kind != "sh":
            (folder / name).write_text(text, encoding="utf-8")
            continue
        for line in text.splitlines():
            program, *arguments = shlex.split(line)
            status, output = programs[program](arguments, folder)
            assert status == 0, f"{line}\n{output}"
            printed.append(output)
    return printed


def studio(folder):
    """Return the folder with the examples that the tutorials use."""
    (folder / "examples").mkdir()
    shutil.copy(ROOT / "examples/three_pictures.py", folder / "examples")
    shutil.copytree(ROOT / "examples/plan", folder / "examples/plan")
    return folder


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    folder = studio(tmp_path_factory.mktemp("first"))
    return folder, follow("first_database.md", folder)


@pytest.mark.slow
def test_the_first_database_is_accepted_and_maps_points(first):
    folder, printed = first
    *_, mapped, validated = printed
    rows = [[float(c) for c in row.split(",")] for row in mapped.splitlines()[1:]]
    # The middle of the photograph by the planted turns, tilts and scales of the script.
    assert rows[0] == pytest.approx([381.5, 491.8], abs=0.5)
    assert "all intact" in validated
    catalogue = (folder / "panel/database/catalogue.csv").read_text()
    assert catalogue.count(",accept,") == 3


@pytest.mark.slow
def test_the_first_database_is_published(first):
    folder, _ = first
    *_, validated, _ = follow("publishing_a_database.md", folder)
    assert "all intact" in validated
    assert (folder / "panel/database.published/viewer").is_dir()
    assert list((folder / "panel-envi").glob("*.hdr"))


@pytest.mark.slow
def test_five_cameras_are_built_with_few_kernels_and_compared_with_the_truth(tmp_path):
    printed = follow("five_cameras.md", tmp_path, PROGRAMS | {"levkas": run_counted})
    assert printed[1].count(" accepted ") == 5
    found = json.loads((tmp_path / "kernels.json").read_text())
    assert {name: count for name, count in found.items() if count > 1} == {}
    assert 0 < len(found) <= MOST_KERNELS

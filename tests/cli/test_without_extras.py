"""Commands where the libraries of an extra are not installed: refused with what to install, or done without them."""

import json
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest

from levkas.core.cube import Band, Cube
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import write_manifest

PYPROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
EXTRAS = {
    extra: tuple(text.partition(">")[0] for text in PYPROJECT["project"]["optional-dependencies"][extra])
    for extra in ("remote", "export")
}  # fmt: skip
ALONE = {"boto3": "remote", "h5py": "export"}
"""Libraries without which the others of their extra are of no use."""
URL, STORE = "http://127.0.0.1:9/icons", "s3://museum/icons"
SCRIPT = """
import json, sys
blocked, lines = json.loads(sys.argv[1])
sys.modules.update(dict.fromkeys(blocked))
from typer.testing import CliRunner
from levkas.cli import app
for line in lines:
    done = CliRunner().invoke(app, [*line, "--json"] if line[0] != "map" else line)
    crash = None if done.exception is None or isinstance(done.exception, SystemExit) else repr(done.exception)
    print(json.dumps([done.exit_code, crash, done.output]))
"""


CASES = [
    *(("remote", (name, *arguments), True) for name, *arguments in (
        ("validate", URL), ("evaluate", URL), ("map", URL, "icon"), ("agree", URL, URL), ("export", URL, "--for", "envi"))),
    ("boto3", ("validate", STORE), True),
    *(("export", ("export", "DATABASE", "--for", form, "-o", f"out-{form}"), needs)
      for form, needs in (("netcdf", True), ("photoshop", True), ("envi", False))),
    ("h5py", ("export", "DATABASE", "--for", "netcdf", "-o", "h5py-netcdf"), True),
    *(("export", line, True) for line in (("look", "CUBES"), ("build", "CUBES"), ("chart", "CUBES/raw/icon.h5"))),
    *((extra, ("validate", "DATABASE"), False) for extra in EXTRAS),
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a database, and a campaign of cubes in HDF5."""
    root = tmp_path_factory.mktemp("extras")
    values = np.random.default_rng(1).random((9, 12, 3), np.float32)
    cube = Cube(values, np.zeros(values.shape, np.uint8), None, tuple(map(Band, "RGB")))
    write_catalogue(
        root / "DATABASE", [write_layer(root / "DATABASE", Layer("icon", "rgb"), cube)[0]]
    )
    write_manifest(root / "DATABASE")
    raw = root / "CUBES/raw"
    raw.mkdir(parents=True)
    for name in ("icon", "white", "dark"):
        with h5py.File(raw / f"{name}.h5", "w") as file:
            file["cube"] = np.full((6, 8, 3), 500, np.uint16)
            file["wavelengths"] = [450.0, 550.0, 650.0]
    (root / "CUBES/campaign.toml").write_text(
        '[campaign]\nreference = "c"\n[cameras.c]\nkind = "cube"\nfiles = "raw/{target}.h5"\nbits = 12\n'
        '[targets]\ndark = "dark"\nwhite = { names = "white", reflectance = 0.98 }\n'
    )
    return root


@pytest.fixture(scope="module")
def run(folder):
    """Return what runs all lines of a case in one process without some libraries."""

    @cache
    def done(missing):
        lines = [line for name, line, _ in CASES if name == missing]
        asked = json.dumps([EXTRAS.get(missing, [missing]), lines])
        command = [sys.executable, "-c", SCRIPT, asked]
        made = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        return dict(zip(lines, map(json.loads, made.stdout.splitlines()), strict=True))

    return done


@pytest.mark.slow
@pytest.mark.parametrize(
    ("missing", "line", "needs"),
    CASES,
    ids=lambda one: " ".join(one) if isinstance(one, tuple) else None,
)
def test_a_command_without_an_extra_says_what_to_install(run, missing, line, needs):
    code, crash, output = run(missing)[line]
    assert crash is None
    assert code == (1 if needs else 0), output
    if needs:
        assert f"levkas[{ALONE.get(missing, missing)}]" in output

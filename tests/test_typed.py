"""A user's script is checked against the types of the package."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import levkas

SCRIPT = """
import numpy as np

import levkas

database = levkas.opn("icons/database")
layer = levkas.open("icons/database")["icon1"]["vis"]
there = levkas.map_points("icons/database", "icon1", np.zeros((1, 2)), source="grid")
for step in levkas.build("icons"):
    print(step.line, step.lines)
spectra = levkas.read_spectra(3)
print(there, layer.levkas.flags, spectra)
"""
PLANTED = {6: "opn", 8: "target", 10: "lines", 11: "int"}
"""Line → what its error names."""


def test_what_checkers_see_is_what_is_there():
    stub = Path(levkas.__file__).with_name("__init__.pyi")
    imports = [
        node for node in ast.parse(stub.read_text()).body if isinstance(node, ast.ImportFrom)
    ]
    seen = {
        name.asname: node.module
        for node in imports
        for name in node.names
        if name.asname == name.name
    }
    assert seen == {name: f"levkas.{home}" for name, home in levkas._HOMES.items()}
    assert Path(levkas.__file__).with_name("py.typed").is_file()


@pytest.mark.slow  # mypy reads all of the package: 15 s
def test_the_errors_of_a_user_s_script_are_found_and_no_others(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    home = str(Path(levkas.__file__).parents[1])
    ran = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--cache-dir", tmp_path / "cache", "script.py"],
        cwd=tmp_path, env={**os.environ, "MYPYPATH": home}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    errors = [line for line in ran.stdout.splitlines() if ": error:" in line]
    lines = {int(line.split(":")[1]): line for line in errors}
    assert set(lines) == set(PLANTED) and len(errors) == len(PLANTED), ran.stdout
    assert all(word in lines[number] for number, word in PLANTED.items())

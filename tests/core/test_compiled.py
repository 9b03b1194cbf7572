"""Kept machine code against changes of its sources."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ADD = """
from levkas.core.compiled import njit
@njit
def add(x):
    return x + {}
"""
USE = """
from typing import NamedTuple
from levkas.core.compiled import njit
from adding import add
class {name}(NamedTuple):
    value: int
@njit(cache=True)
def use(pair):
    return add(pair.value)
print(use({name}(1)))
"""


def answer_of(folder: Path) -> str:
    """Answer of the kernel in a process of its own."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    done = subprocess.run(
        [sys.executable, "-c", "import using"], capture_output=True, text=True, env=env, cwd=folder
    )
    return done.stdout.strip() or done.stderr


def put(folder: Path, number: int, name: str, when: int) -> None:
    (folder / "adding.py").write_text(textwrap.dedent(ADD.format(number)))
    (folder / "using.py").write_text(textwrap.dedent(USE.format(name=name)))
    os.utime(folder / "adding.py", (when, when))
    os.utime(folder / "using.py", (1_000_000_000, 1_000_000_000))


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("Pair", marks=pytest.mark.slow), "Renamed"])
def test_code_of_an_older_source_is_compiled_again(tmp_path, name):
    """What is inlined from another file, and a class of an argument that has another name now."""
    put(tmp_path, 1, "Pair", 1_000_000_000)
    assert answer_of(tmp_path) == "2"
    (kept,) = tmp_path.rglob("using.use-*.nbi")
    before = kept.stat().st_mtime_ns
    assert answer_of(tmp_path) == "2"
    assert kept.stat().st_mtime_ns == before, "code that is not old is loaded"
    put(tmp_path, 5, name, int(before / 1e9) + 10)
    assert answer_of(tmp_path) == "6"

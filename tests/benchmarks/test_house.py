"""The figures of the house: what is counted is what is there."""

import importlib
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def house(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("house")


def test_lines_that_stand_twice_are_counted_without_docstrings_and_imports(house, tmp_path):
    rows = [f"x{n} = f({n})" for n in range(house.WINDOW)]
    one, other = tmp_path / "one.py", tmp_path / "other.py"
    one.write_text("\n".join(['"""One."""', "import a", *rows, "y = 1"]))
    other.write_text("\n".join(["z = 2", "if z:", *(f"    {row}" for row in rows)]))
    assert house.lines_twice([one, other]) == 2 * house.WINDOW
    assert house.lines_twice([one]) == 0


def test_comparisons_of_a_cameras_kind_are_counted_and_no_others(house):
    import ast

    text = 'a.kind == "mosaic"; kind in ("cube", "x"); a.kind == b; a.name == "mosaic"; kind == "x"'
    found = [
        house.is_of_kind(node)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Compare)
    ]
    assert sorted(found) == [False, False, False, True, True]


def test_what_a_dependency_brings_is_in_the_closure(house):
    found = house.closure(["tifffile>=2025", "typer", 'nothing>=1; python_version < "3"'])
    assert {"tifffile", "numpy", "typer"} <= found and "nothing" not in found


def test_a_module_counts_once_its_function_runs_and_the_first_pixel_is_what_a_reader_returns(
    house, tmp_path
):
    import cv2

    from levkas.core.text import what_stands_at
    from levkas.geometry.transforms import Affine
    from levkas.readers.frames import read_frame

    cv2.imwrite(str(tmp_path / "one.png"), np.zeros((8, 9), np.uint8))
    with house.Trace() as trace:
        what_stands_at(tmp_path)
        read_frame(tmp_path / "one.png")
        Affine.identity()
    modules = list(trace.modules)
    assert modules[0] == "levkas.core.text" and "levkas.readers.frames" in modules
    assert trace.before_first_pixel == modules.index("levkas.geometry.transforms")


def test_a_column_is_set_beside_those_that_stand_there(house, tmp_path, monkeypatch):
    monkeypatch.setattr(house, "PAGE", tmp_path / "page.md")
    house.PAGE.write_text("# Title\n\n| figure | before |\n| --- | --: |\n| files | 3 |\n\nEnd.\n")
    house.write_column("after", {"files": 2, "lines": 1000})
    assert house.PAGE.read_text() == (
        "# Title\n\n| figure | before | after |\n| --- | --: | --: |\n"
        "| files | 3 | 2 |\n| lines |  | 1,000 |\n\nEnd.\n"
    )

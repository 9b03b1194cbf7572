"""paper/paper.md quotes what was measured, cites what its bibliography has, and shows what was drawn from the results."""

import importlib
import re
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PAPER = ROOT / "paper"
TEXT = (PAPER / "paper.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def scripts():
    """Return docs/write_benchmarks.py, benchmarks/results.py and paper/figures.py, loaded anew."""
    names = ("write_benchmarks", "results", "figures")
    with pytest.MonkeyPatch.context() as patch:
        for folder in ("benchmarks", "docs", "paper"):
            patch.syspath_prepend(str(ROOT / folder))
        for name in names:
            patch.delitem(sys.modules, name, raising=False)
        yield [importlib.import_module(name) for name in names]


def test_every_figure_and_picture_is_as_measured(scripts):
    writing, results, figures = scripts
    found = results.load()
    assert len(writing.NAMED.findall(TEXT)) > 20
    assert writing.with_figures(TEXT, found) == TEXT, "make reference brings the paper up to date"
    with Image.open(PAPER / "comparison.png") as picture:
        assert picture.text["Description"] == figures.digest(found), "make reference draws it anew"


def test_every_citation_is_in_the_bibliography_and_every_entry_is_cited():
    cited = set(re.findall(r"@(\w+)", re.sub(r"<!--.*?-->", "", TEXT, flags=re.S)))
    keys = re.findall(r"^@\w+\{(\w+),", (PAPER / "paper.bib").read_text(encoding="utf-8"), re.M)
    assert len(keys) == len(set(keys)) and cited == set(keys)

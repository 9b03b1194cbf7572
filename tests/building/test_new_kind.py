"""A camera kind is one row and one function: the example of the docs is added and built."""

import re
import shutil
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import levkas
from levkas.building import build, summarise
from levkas.campaign import camera_kinds

PAGE = Path(__file__).resolve().parents[2] / "docs/howto/add_camera_kind.md"


@pytest.fixture
def film(monkeypatch):
    """The kind of the docs' example."""
    function, row = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    module = types.ModuleType("levkas.stages.films")
    exec(function, module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(camera_kinds.KINDS, "film", None)  # taken away again after the test
    exec(row, camera_kinds.__dict__)


def test_a_kind_is_added_by_a_row_and_a_function(film, plates, tmp_path):
    folder = shutil.copytree(
        plates, tmp_path / "campaign", ignore=shutil.ignore_patterns("database*")
    )
    text = (folder / "campaign.toml").read_text()
    before, _, after = text.partition("[cameras.infrared]")
    (folder / "campaign.toml").write_text(
        before + "[cameras.infrared]" + after.replace('kind = "image"', 'kind = "film"', 1)
    )
    (path,) = (folder / "infrared").iterdir()
    with Image.open(path) as picture:
        codes = np.asarray(picture)
    Image.fromarray(np.iinfo(codes.dtype).max - codes).save(path)
    report = summarise(build(folder))
    assert report.ok, report.text
    layer = levkas.open(folder / "database")["one"]["infrared"]
    there = levkas.open(plates / "database")["one"]["infrared"]
    apart = np.abs(layer.values - there.values)  # registered to the same picture, by its inverse
    assert np.nanmedian(apart) < 0.5 and np.isfinite(apart).sum() > 0.98 * np.isfinite(there).sum()

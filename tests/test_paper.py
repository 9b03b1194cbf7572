"""paper/paper.md is in the journal's form, and quotes what was measured."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from levkas.building import build, summarise

ROOT = Path(__file__).resolve().parents[1]
PAPER = ROOT / "paper"
TEXT = (PAPER / "paper.md").read_text(encoding="utf-8")
FRONT, BODY = TEXT.split("---\n", 2)[1:]
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
FIGURE = re.compile(r"\S+<!--.*?-->")
#: Numbers that are no results: sizes of what was measured, planted numbers, percentages meant, an equation.
GIVEN = {
    "418", "312", "1,000", "320", "524", "905", "215", "2.45", "100", "0.03", "1", "2",
}  # fmt: skip
SECTIONS = [
    "Summary", "Statement of need", "State of the field", "Functionality and what is new", "Limits",
    "Acknowledgements", "References",
]  # fmt: skip


@pytest.fixture(scope="module")
def scripts():
    """Return docs/write_benchmarks.py, benchmarks/results.py and paper/figures.py, loaded anew."""
    with pytest.MonkeyPatch.context() as patch:
        for folder in ("benchmarks", "docs", "paper"):
            patch.syspath_prepend(str(ROOT / folder))
        names = ("write_benchmarks", "results", "figures")
        for name in names:
            sys.modules.pop(name, None)
        yield [importlib.import_module(name) for name in names]
        for name in names:
            sys.modules.pop(name, None)


def plain(text):
    """Return the text without comments, table and figures' paths."""
    text = re.sub(r"^\|.*\n", "", text, flags=re.M)
    return COMMENT.sub("", text)


def test_the_front_matter_is_in_the_form_of_the_journal():
    front = yaml.safe_load(FRONT)
    assert {"title", "tags", "authors", "affiliations", "date", "bibliography"} <= front.keys()
    assert (PAPER / front["bibliography"]).is_file()
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert [a["name"] for a in front["authors"]] == [a["name"] for a in citation["authors"]]
    assert {a["affiliation"] for a in front["authors"]} == {
        a["index"] for a in front["affiliations"]
    }
    assert re.findall(r"^# (.*)$", BODY, re.M) == SECTIONS


def test_the_paper_has_750_to_1750_words():
    words = [word for word in plain(BODY).split() if re.search(r"\w", word)]
    assert 750 <= len(words) <= 1750


def test_every_figure_and_table_is_as_measured(scripts):
    writing, results, _ = scripts
    found = results.load()
    assert len(writing.NAMED.findall(TEXT)) + 1 == len(COMMENT.findall(TEXT)) > 20
    assert writing.TABLE.search(TEXT)
    assert writing.with_figures(TEXT, found) == TEXT, "make reference brings the paper up to date"
    changed = TEXT.replace(
        "2.3<!-- comparison | Levkas | CPU -->", "1.9<!-- comparison | Levkas | CPU -->"
    )
    assert changed != TEXT and writing.with_figures(changed, found) == TEXT
    with pytest.raises(KeyError):
        writing.with_figures("3<!-- comparison | Nobody | CPU -->", found)


def test_no_number_is_quoted_without_its_source():
    prose = FIGURE.sub("", re.sub(r"\[@[^]]*\]|@\w+|\\\w+\{[^}]*\}|\([^)]*\.png\)", "", BODY))
    prose = plain(prose)
    assert set(re.findall(r"(?<!\w)\d[\d,.]*\d|(?<!\w)\d", prose)) <= GIVEN


def test_claims_of_order_hold(scripts):
    found = scripts[1].load()
    errors = {(f.what, f.aspect): f.value for f in found.of("comparison")}
    cameras = {camera for _, camera in errors} - {"CPU"}
    for camera in cameras:  # the smallest mean error for every camera
        best = errors["Levkas", camera]
        assert all(
            v is None or v > best
            for (what, one), v in errors.items()
            if one == camera and what != "Levkas"
        )
    assert errors["Levkas", "CPU"] > errors["the paper's method", "CPU"]
    quoted = {
        ("Levkas", "lctf-nir"): min, ("Levkas", "v10"): max,
        ("the paper's method", "lctf-nir"): min, ("the paper's method", "d80, 45°"): max,
    }  # fmt: skip
    for (method, camera), extreme in quoted.items():
        assert errors[method, camera] == extreme(errors[method, one] for one in cameras)
    sigma = {f.what: f.value for f in found.of("sigma-position") if f.what != "all"}
    assert sigma["msbs"] == min(sigma.values()) and sigma["lctf-vis"] == max(sigma.values())
    full = {f.what: f for f in found.of("full-size") if f.aspect == "mean"}
    assert not full["v10"].met and all(f.met for name, f in full.items() if name != "v10")
    assert all(f.goal == (None, 0.03) for f in full.values())
    disks = {
        f.what: f.value
        for f in found.of("real")
        if f.what.startswith("disks") and f.aspect == "mean"
    }
    assert disks["disks, 500 nm"] == min(disks.values())
    assert disks["disks, 650 nm"] == max(disks.values())
    assert {f.what: f.met for f in found.of("build")} == {"time": False, "memory, peak": True}


def test_every_citation_is_in_the_bibliography_and_every_entry_is_cited():
    cited = set(re.findall(r"@(\w+)", COMMENT.sub("", BODY)))
    records = (PAPER / "paper.bib").read_text(encoding="utf-8")
    keys = re.findall(r"^@\w+\{(\w+),", records, re.M)
    assert len(keys) == len(set(keys)) and cited == set(keys)
    # What the documentation cites too is the same record.
    documented = (ROOT / "docs/references.bib").read_text(encoding="utf-8")
    for record in ("\n" + records).split("\n@")[1:]:
        key = re.search(r"\{(\w+),", record)[1]
        assert f"{{{key}," not in documented or record.strip() in documented, key
        assert "doi = {10." in record or "arXiv:" in record, key


def test_pictures_are_there_small_and_drawn_from_the_results(scripts):
    _, results, figures = scripts
    named = re.findall(r"^!\[[^]]*\]\((\S+)\)", BODY, re.M)
    assert named == ["panel.png", "comparison.png"]
    for name in named:
        assert (PAPER / name).stat().st_size < 700_000
        with Image.open(PAPER / name) as picture:
            assert np.asarray(picture.convert("L")).std() > 5
    for label in re.findall(r"\\autoref\{([^}]*)\}", BODY):
        assert f"\\label{{{label}}}" in BODY, label
    found = results.load()
    with Image.open(PAPER / "comparison.png") as picture:
        assert picture.text["Description"] == figures.digest(found), "make reference draws it anew"
    axes = figures.draw_comparison(found).axes[0]
    methods = [text.get_text() for text in axes.get_yticklabels()]
    drawn = {
        (methods[int(y)], line.get_label()): x
        for line in axes.lines
        for x, y in line.get_xydata()
        if line.get_marker() != "x" and np.isfinite(x)
    }
    measured = {(f.what, f.aspect): f.value for f in found.of("comparison") if f.aspect != "CPU"}
    assert drawn == {key: value for key, value in measured.items() if value is not None}


@pytest.mark.slow
def test_the_panel_is_drawn_from_a_database(scripts, make_plates, tmp_path, monkeypatch):
    figures, plates = scripts[2], make_plates(tmp_path / "plates", ["one"])
    with (plates / "campaign.toml").open("a") as keys:
        keys.write("\n[database]\nnative = true\n")
    assert summarise(build(plates)).ok
    monkeypatch.setattr(figures, "OBJECT", "one")
    monkeypatch.setattr(figures, "CAMERAS_SHOWN", ("photo", "infrared"))
    before, after, right, *_ = figures.draw_panel(plates / "database").axes
    assert before.images[0].get_array().shape == after.images[0].get_array().shape == (200, 240, 3)
    assert 0 < np.nanmin(right.images[0].get_array()) < 0.1

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import typer.main

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results.json"


@pytest.fixture
def modules(monkeypatch):
    """Return benchmarks/results.py and docs/write_benchmarks.py, loaded anew."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    for name in ("results", "write_benchmarks"):
        sys.modules.pop(name, None)
    import results
    import write_benchmarks

    return results, write_benchmarks


def test_the_page_and_the_readme_are_what_the_results_give(modules):
    results, writing = modules
    found = results.load()
    assert (ROOT / "docs/benchmarks.md").read_text(encoding="utf-8") == writing.page(found)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert readme == writing.with_figures(readme, found)
    assert len(writing.NAMED.findall(readme)) >= 5


def test_the_page_has_fewer_than_2000_words():
    words = (ROOT / "docs/benchmarks.md").read_text(encoding="utf-8").split()
    assert sum(bool(re.search(r"\w", word)) for word in words) < 2000


def test_every_figure_has_a_command_that_exists(modules):
    from levkas.cli import app

    commands = typer.main.get_command(app).commands
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    for figure in modules[0].load().figures:
        program, first, *_ = figure.command.split()
        if program == "python":
            assert (ROOT / first).is_file(), figure
        else:
            assert first in (targets if program == "make" else commands), figure
            assert program in ("make", "levkas"), figure


def test_saving_what_was_loaded_gives_the_same_bytes(modules, tmp_path):
    results, _ = modules
    results.save(results.load(), tmp_path / "results.json")
    assert (tmp_path / "results.json").read_bytes() == RESULTS.read_bytes()


def test_a_script_brings_its_figures_up_to_date_and_no_others(modules, tmp_path, monkeypatch):
    results, writing = modules
    path = tmp_path / "results.json"
    path.write_bytes(RESULTS.read_bytes())
    given = ["/home/x/benchmarks/seeds.py", "/data/demo", "--n", "3", "--results", str(path)]
    monkeypatch.setattr(sys, "argv", given)
    results.record(path, "sigma-position", {"d80": 0.9213456, "v10": None})
    before = {f.key: f for f in results.load().figures}
    after = {f.key: f for f in results.load(path).figures}
    assert list(after) == list(before)
    changed = {key for key in after if after[key] != before[key]}
    assert changed == {("sigma-position", "d80", ""), ("sigma-position", "v10", "")}
    one = after["sigma-position", "d80", ""]
    assert (one.value, one.unit, one.goal, one.met) == (0.9213, "", (0.85, 0.95), True)
    assert one.command == "python benchmarks/seeds.py FOLDER --n 3"
    assert one.date > "2026-11-22" and one.version and one.machine
    assert "| v10 | failed | **missed** |" in writing.page(results.load(path))
    with pytest.raises(ValueError, match="has no figure"):
        results.record(path, "sigma-position", {"d80": 0.0, "another": 1.0})
    assert {f.key: f for f in results.load(path).figures} == after


def test_a_goal_is_met_only_where_every_value_lies_within_it(modules):
    results, _ = modules
    one = replace(results.load().figures[0], goal=(None, 4.0))
    assert [replace(one, value=v).met for v in (4.0, (3.0, 4.1), None)] == [True, False, False]
    assert replace(one, goal=(0.85, 0.95), value=(0.85, 0.95)).met
    assert replace(one, goal=None).met is None


@pytest.mark.parametrize(
    ("field", "value"),
    [("command", ""), ("date", "yesterday"), ("value", "3"), ("value", [3, 2]), ("goal", [None, None])],
)  # fmt: skip
def test_a_figure_that_is_not_sound_is_refused_by_name(modules, tmp_path, field, value):
    content = json.loads(RESULTS.read_text(encoding="utf-8"))
    content["figures"][5][field] = value
    path = tmp_path / "results.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ValueError, match=field) as refused:
        modules[0].load(path)
    assert content["figures"][5]["what"] in str(refused.value)

"""docs/benchmarks.md, the README and the paper show the figures of benchmarks/results.json, each with a command that exists."""

import json
import re
import sys
from pathlib import Path

import pytest
import typer.main

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results.json"


@pytest.fixture
def modules(monkeypatch):
    """Return benchmarks/results.py and docs/write_benchmarks.py, loaded anew."""
    for folder in ("benchmarks", "docs"):
        monkeypatch.syspath_prepend(str(ROOT / folder))
    for name in ("results", "write_benchmarks"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    import results
    import write_benchmarks

    return results, write_benchmarks


def test_the_page_and_the_readme_are_what_the_results_give(modules):
    results, writing = modules
    found = results.load()
    assert (ROOT / "docs/benchmarks.md").read_text(encoding="utf-8") == writing.page(found)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert readme == writing.with_figures(readme, found) and writing.NAMED.search(readme)


def test_every_figure_has_a_command_that_exists(modules):
    from levkas.cli import app

    there = {*typer.main.get_command(app).commands}
    targets = {*re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)}
    for figure in modules[0].load().figures:
        program, first, *_ = figure.command.split()
        known = {
            "make": targets,
            "levkas": there,
            "python": {first} if (ROOT / first).is_file() else {},
        }
        assert first in known[program], figure


def test_a_script_brings_its_figures_up_to_date_and_no_others(modules, tmp_path, monkeypatch):
    results, _ = modules
    path = tmp_path / "results.json"
    results.save(results.load(), path)
    assert path.read_bytes() == RESULTS.read_bytes()
    given = ["/home/x/benchmarks/seeds.py", "/data/demo", "--n", "3", "--results", str(path)]
    monkeypatch.setattr(sys, "argv", given)
    results.record(path, "sigma-position", {"d80": 0.9213456, "v10": None})
    before, after = ({f.key: f for f in results.load(*p).figures} for p in ((), (path,)))
    changed = {key for key in after if after[key] != before[key]}
    assert changed == {("sigma-position", "d80", ""), ("sigma-position", "v10", "")}
    one = after["sigma-position", "d80", ""]
    assert (one.value, one.goal, one.met) == (0.9213, (0.85, 0.95), True)
    assert one.command == "python benchmarks/seeds.py FOLDER --n 3"
    assert not after["sigma-position", "v10", ""].met
    with pytest.raises(ValueError):
        results.record(path, "sigma-position", {"d80": 0.0, "another": 1.0})


@pytest.mark.parametrize(
    ("field", "value"), [("command", ""), ("date", "yesterday"), ("value", [3, 2]), ("goal", [None, None])]
)  # fmt: skip
def test_a_figure_that_is_not_sound_is_refused(modules, tmp_path, field, value):
    content = json.loads(RESULTS.read_text(encoding="utf-8"))
    content["figures"][5][field] = value
    path = tmp_path / "results.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ValueError):
        modules[0].load(path)

"""`levkas plan` and its report."""

import json
import re
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from levkas.cli import app
from levkas.pages.plan import write_report
from levkas.planning import load_setup


def run(*words):
    return CliRunner().invoke(app, ["plan", *map(str, words)])


def test_plans_are_told_in_lines_and_as_one_object(rewritten):
    path = rewritten()
    record = json.loads(run("light", path, "--optimise", "--json", "-s", "45-degree").stdout)
    assert record["command"] == "plan light" and record["ok"]
    assert record["light"]["setup"] == "45-degree" and len(record["setups"]) == 5
    assert record["optimum"]["weights"]["varnish"] == 2.0
    record = json.loads(run("exposure", "--setup", path, "--json").stdout)
    assert len(record["cameras"]) == 4
    for words in (("light", path, "--optimise"), ("framing", path), ("exposure", "--setup", path)):
        assert run(*words).exit_code == 0


def test_a_bad_setup_is_refused_with_status_1(rewritten):
    path = rewritten(("distance_mm = 2100", "distance_mm = 2.1"))
    said = run("light", path, "--json")
    assert said.exit_code == 1
    assert json.loads(said.stdout)["problems"][0]["field"].endswith("distance_mm")
    assert run("light", rewritten(), "-s", "no-such").exit_code == 1


def test_the_report_stands_alone_and_escapes_what_a_file_says(rewritten, tmp_path):
    path = rewritten(
        ('title = "The largest icon, on its side"', 'title = "<script>alert(1)</script>"'),
        ("[setups.proposed]", '[setups."<b>proposed"]'),
    )
    page = write_report(tmp_path / "plan.html", load_setup(path)).read_text(encoding="utf-8")
    assert "default-src 'none'" in page and not re.search(r'(?:src|href)="(?!data:|#)', page)
    assert page.count("<svg") == 5 and not re.search(r"\bnan\b", page)
    assert "<script>" not in page and "<b>proposed" not in page


@pytest.mark.parametrize(
    "call",
    [
        "from typer.testing import CliRunner; from levkas.cli import app; CliRunner().invoke(app, ['plan', '--help'])",
        "from levkas.planning.text_report import light_record; light_record('{path}')",
    ],
)
def test_neither_help_nor_a_plan_loads_what_is_heavy(rewritten, call):
    heavy = ("scipy", "colour", "numba") + ("numpy", "jinja2") * ("--help" in call)
    code = f"import sys; {call.format(path=rewritten())}; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"

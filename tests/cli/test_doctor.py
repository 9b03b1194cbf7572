import json
import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from typer.testing import CliRunner

from levkas.cli import app, doctor

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


@pytest.fixture(scope="module")
def examination():
    return doctor.examine()


def finding(examination, name):
    return next(f for f in examination.findings if f.name == name)


def test_the_packages_are_those_of_the_metadata_and_each_has_its_purpose(examination):
    reported = [Requirement(text) for text in metadata.requires("levkas")]
    required = {r.name for r in reported if r.marker is None}
    extras = {r.name for r in reported if any(f'"{e}"' in str(r.marker) for e in doctor.EXTRAS)}
    assert len(required) > 20 and "obstore" in extras
    by_name = {f.name: f for f in examination.findings}
    assert required | extras <= set(by_name)
    assert set(doctor.EXTRAS) <= set(metadata.metadata("levkas").get_all("Provides-Extra"))


def test_what_is_said_of_packages_is_of_packages_that_are_declared():
    texts = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["dependencies"]
    assert {Requirement(text).name for text in texts} == set(doctor.PURPOSES)


def test_every_extra_that_a_command_needs_is_named():
    optional = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]
    assert set(doctor.EXTRAS) == set(optional) - {"test", "lint"}


def test_the_machine_that_runs_the_tests_lacks_nothing_required(examination):
    assert examination.ok, examination.text
    assert finding(examination, "OpenCV").state == "ok"
    assert re.search(r"\d+\.\d GB", finding(examination, "memory").found)
    assert int(finding(examination, "threads").found.split(",")[0]) >= 1


def test_an_old_libraw_is_missing_and_says_how_to_get_another(monkeypatch):
    import rawpy

    monkeypatch.setattr(rawpy, "libraw_version", (0, 22, 0))
    examination = doctor.examine()
    (problem,) = examination.problems
    assert (problem.found, problem.expected) == ("0.22.0", "0.22.1 or newer")
    assert "rawpy" in problem.fix
    assert not examination.ok


def test_what_only_one_feature_needs_is_absent_and_no_problem(monkeypatch):
    require(monkeypatch, "no-such-thing>=2 ; extra == 'export'")
    examination = doctor.examine()
    absent = finding(examination, "no-such-thing")
    assert (absent.state, absent.needed_for) == ("absent", doctor.EXTRAS["export"])
    assert examination.ok
    assert f'for {absent.needed_for}. pip install "no-such-thing>=2"' in examination.text


def test_a_package_that_is_missing_or_too_old_is_a_problem(monkeypatch):
    require(monkeypatch, "no-such-thing>=1.0", "numpy>=999")
    missing, old = doctor.examine().problems
    assert (missing.field, old.field) == ("no-such-thing", "numpy")
    assert missing.fix == 'pip install "no-such-thing>=1.0"'
    assert old.found and "too old" in old.message


def test_what_is_for_developers_or_for_another_system_is_not_asked_for(monkeypatch):
    require(monkeypatch, "pytest-nowhere ; extra == 'test'", "other; sys_platform == 'amiga'")
    names = {f.name for f in doctor.examine().findings}
    assert not names & {"pytest-nowhere", "other"}


def test_sources_that_are_not_installed_are_told_so(monkeypatch):
    require(monkeypatch)
    examination = doctor.examine()
    assert finding(examination, "packages").state == "low" and examination.ok


def require(monkeypatch, *texts):
    """Let the installed package require these."""
    monkeypatch.setattr(metadata, "requires", lambda name: list(texts))


def test_a_cache_that_cannot_be_written_is_slow_and_no_problem(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    examination = doctor.examine(tmp_path / "nowhere" / "yet")
    assert finding(examination, "kernel cache").state == "low"
    assert finding(examination, "disk").state == "low"
    assert examination.ok


def test_the_command_reports_every_check():
    run = CliRunner().invoke(app, ["doctor", "--json"])
    report = json.loads(run.stdout)
    assert (run.exit_code, report["ok"], report["problems"]) == (0, True, [])
    assert {"name", "state", "found", "expected", "needed_for", "fix"} == set(report["checks"][0])
    assert CliRunner().invoke(app, ["doctor"]).exit_code == 0

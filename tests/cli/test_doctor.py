import json
from importlib import metadata

import pytest
from typer.testing import CliRunner

from levkas.cli import app, doctor


def state(examination, name):
    return next(f.state for f in examination.findings if f.name == name)


def test_the_machine_that_runs_the_tests_lacks_nothing_required():
    run = CliRunner().invoke(app, ["doctor", "--json"])
    report = json.loads(run.stdout)
    assert (run.exit_code, report["ok"], report["problems"]) == (0, True, [])
    states = {one["name"]: one["state"] for one in report["checks"]}
    assert states["OpenCV"] == states["LibRaw"] == states["packages"] == "ok"
    assert {"memory", "disk", "threads", "kernel cache", *doctor.EXTRAS} <= set(states)
    assert set(doctor.EXTRAS) <= set(metadata.metadata("levkas").get_all("Provides-Extra"))


def test_an_old_libraw_is_missing_and_says_how_to_get_another(monkeypatch):
    import rawpy

    monkeypatch.setattr(rawpy, "libraw_version", (0, 22, 0))
    (problem,) = doctor.examine().problems
    assert (problem.code, problem.field) == ("E_MISSING", "LibRaw") and "rawpy" in problem.fix


@pytest.mark.parametrize(
    ("required", "problems", "states"),
    [
        (["no-such-thing>=1.0", "numpy>=999"], ["no-such-thing", "numpy"], {}),
        (["no-such-thing>=2 ; extra == 'export'"], [], {"export": "absent", "remote": "ok"}),
        (["pytest-nowhere ; extra == 'test'", "other; sys_platform == 'amiga'"], [], {"packages": "ok"}),
        ([], [], {"packages": "low"}),
    ],
)  # fmt: skip
def test_packages_are_those_that_the_installed_one_requires(
    monkeypatch, required, problems, states
):
    monkeypatch.setattr(metadata, "requires", lambda name: required)
    examination = doctor.examine()
    assert [p.field for p in examination.problems] == problems
    assert {name: state(examination, name) for name in states} == states
    assert all(name in examination.text for name in (*problems, *states))


def test_a_cache_that_cannot_be_written_and_a_folder_that_is_not_there_are_no_problem(
    monkeypatch, tmp_path
):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    examination = doctor.examine(tmp_path / "nowhere" / "yet")
    assert state(examination, "kernel cache") == state(examination, "disk") == "low"
    assert examination.ok

"""An exception that no check foresaw refuses one capture or page, with a report to send; the rest is built."""

import sys
from types import ModuleType

import numpy as np
import pytest

from levkas.building import build, camera_pages, report_pages, run, status, summarise
from levkas.campaign.methods import LevkasOptions
from levkas.core.internal_errors import CODE
from levkas.readers import frames
from levkas.registration import BUILT_IN
from levkas.registration.levkas import register_levkas
from levkas.stages import calibrate

ERRORS = {
    "four": np.linalg.LinAlgError("Singular matrix at 0x7f00deadbeef"),
    "one": RecursionError("maximum recursion depth exceeded"),
    "two": MemoryError("12 GB"),
}
GOOD = "zero"


def ended(report):
    return {
        (s.key.object, s.key.layer, s.key.stage): s
        for s in report.stages
        if s.state in ("refused", "stale")
    }


@pytest.fixture
def faulty(monkeypatch):
    """A registration method that raises the exceptions of a list, one a call."""
    errors = []

    def register(request, options):
        if errors and (error := errors.pop(0)) is not None:
            raise error
        return register_levkas(request, LevkasOptions())

    module = ModuleType("planted_method")
    module.register = register
    monkeypatch.setitem(sys.modules, "planted_method", module)
    monkeypatch.setitem(BUILT_IN, "mirhashemi2019", ("planted_method", "register"))
    return errors


def planted(make_plates, folder, names, method="mirhashemi2019"):
    make_plates(folder, names)
    with (folder / "campaign.toml").open("a") as file:
        file.write(f'[cameras.infrared.registration]\nmethod = "{method}"\n')
    return folder


@pytest.mark.slow
def test_whatever_a_method_raises_refuses_its_capture_and_leaves_a_report(
    make_plates, faulty, tmp_path
):
    folder = planted(make_plates, tmp_path / "campaign", [*ERRORS, GOOD])
    faulty[:] = ERRORS.values()  # objects are built in this order
    report = summarise(build(folder))
    assert not report.ok
    found = ended(report)
    assert {key[:2] for key in found} == {(name, "infrared") for name in ERRORS}
    for name, error in ERRORS.items():
        (problem,) = found[name, "infrared", "register"].problems
        kept = folder / f"database.kept/{name}/infrared/register.error.txt"
        if isinstance(error, MemoryError):
            assert problem.code == "E_MEMORY" and not kept.exists()
            continue
        assert problem.code == CODE and f"{name}/infrared register" in problem.message
        assert type(error).__name__ in problem.message
        assert problem.file == str(folder / f"infrared/{name}.png")
        assert "test_internal_errors.py" in problem.found and "0x7f" not in problem.found
        assert str(kept) in problem.fix
        text = kept.read_text()
        assert "Traceback" in text and "numpy" in text and "in register" in text
        page = (folder / f"database/objects/{name}/report.html").read_text()
        assert CODE in page and str(tmp_path) not in page
    said = ended(status(folder))
    assert {key for key in said if said[key].state == "refused"} == {
        (name, "infrared", "register") for name in ERRORS if name != "two"
    }
    assert (
        said["one", "infrared", "register"].problems
        == found["one", "infrared", "register"].problems
    )

    # It is tried again, and now nothing is raised.
    assert summarise(build(folder, objects=["one"])).ok
    assert {path.parts[-3] for path in folder.rglob("*.error.txt")} == {"four"}


@pytest.mark.slow
def test_whatever_calibration_raises_refuses_its_capture(make_plates, tmp_path, monkeypatch):
    folder = make_plates(tmp_path / "campaign")
    develop = calibrate.develop_image

    def broken(context):
        if context.camera.name == "infrared":
            raise KeyError("infrared")
        return develop(context)

    monkeypatch.setattr(calibrate, "develop_image", broken)
    found = ended(summarise(build(folder)))
    assert set(found) == {(name, "infrared", "calibrate") for name in ("one", "two")}
    monkeypatch.setattr(calibrate, "develop_image", develop)
    assert summarise(build(folder)).ok


@pytest.mark.slow
def test_whatever_a_reader_raises_names_the_file_and_refuses_its_capture(
    make_plates, tmp_path, monkeypatch
):
    folder = make_plates(tmp_path / "campaign", ["one", "two"])
    real = frames.READERS["png"]

    def facts(path):
        if path == folder / "infrared/one.png":
            raise OverflowError("cannot convert float infinity to integer")
        return frames._call("real", "facts", path)

    module = ModuleType("planted_reader")
    module.facts = facts
    monkeypatch.setitem(sys.modules, "planted_reader", module)
    monkeypatch.setitem(frames.READERS, "real", real._replace(signatures=()))
    planted = real._replace(module="planted_reader", facts="facts", frame="frame")
    monkeypatch.setitem(frames.READERS, "png", planted)
    module.frame = lambda path: frames._call("real", "frame", path)
    frames._facts_of.cache_clear()
    report = summarise(build(folder))
    (step,) = ended(report).values()
    (problem,) = step.problems
    assert (step.key.object, step.key.layer, problem.code) == ("one", "infrared", CODE)
    assert problem.file == str(folder / "infrared/one.png")
    assert (folder / "database.kept/one/infrared/calibrate.error.txt").is_file()
    frames._facts_of.cache_clear()
    assert (
        "OverflowError" in ended(status(folder))["one", "infrared", "calibrate"].problems[0].message
    )
    frames._facts_of.cache_clear()


def broken(*args, **options):
    raise TypeError("a page that cannot be drawn")


@pytest.mark.slow
def test_a_page_or_the_catalogue_that_cannot_be_made_is_refused_and_the_rest_is_there(
    make_every_kind, tmp_path, monkeypatch
):
    folder = make_every_kind(tmp_path / "campaign", cameras=("photo", "filters"))
    for module, name in (
        (report_pages, "report_of"),
        (camera_pages, "_page"),
        (run, "write_catalogue_of"),
    ):
        monkeypatch.setattr(module, name, broken)
    found = ended(summarise(build(folder)))
    keys = {
        ("one", "", "report"),
        ("two", "", "report"),
        ("", "filters", "camera"),
        ("", "", "catalogue"),
    }
    assert set(found) == keys
    assert {step.problems[0].code for step in found.values()} == {CODE}
    assert (folder / "database.kept/one/report.error.txt").is_file()
    said = ended(status(folder))
    assert {said[key].state for key in keys if key[2] != "catalogue"} == {"refused"}
    assert (folder / "database/objects/one/one_filters.tif").is_file()
    monkeypatch.undo()
    assert summarise(build(folder)).ok
    assert not [*folder.rglob("*.error.txt")] and not ended(status(folder))

"""The code of a stage is all that it imports, found by reading it."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import levkas
from levkas.building import sources
from levkas.building.sources import ENTRIES, RIM, Sources
from levkas.core import instructions
from levkas.core.instructions import HELD

PACKAGE = Path(levkas.__file__).parent
STAGES = sorted({*ENTRIES} - {"template"})
FOUND = ("campaign/schema/*", "campaign/discovery/*", "core/locks", "core/sweeping", "*__init__")
"""What they find is in the fingerprints themselves."""
CLAIMED = ("publish/publication", "publish/facts")
"""Loaded to see whose a folder is."""


def name_of(module):
    return module.relative_to(PACKAGE).as_posix().removesuffix(".py")


@pytest.fixture(scope="module")
def closures():
    read = Sources()
    return {stage: {name_of(path) for path in read.closure(stage)} for stage in ENTRIES}


def test_no_stage_rests_on_what_only_decides_what_is_done(closures):
    rim = {name.removeprefix("levkas.").replace(".", "/") for name in RIM}
    assert not set().union(*closures.values()) & rim


@pytest.mark.parametrize(
    ("module", "stages"),
    {
        "building/calibrate": {"calibrate", "register", "resample", "camera"},
        "building/resample": {"resample"},
        "building/capture_statistics": {"calibrate", "register", "resample", "camera"},
        "building/native_cubes": {"calibrate", "register", "resample", "camera"},
        "calibration/sensor_context": {"calibrate", "register", "resample", "report", "camera"},
        "building/register": {"register", "adjust"},
        "building/joint": {"adjust"},
        "building/report_pages": {"report"},
        "building/catalogue": {"catalogue"},
        "registration/joint": {"register", "adjust"},
        "quality/targets/locating": {"calibrate", "register", "resample", "camera"},
        "quality/targets/measuring": {"camera"},
        "quality/evaluation/similarity": {"resample"},
        "campaign/edits": {"register", "adjust"},
        "pages/report.html": {"register", "adjust", "report", "camera"},
        "readers/raw": {"calibrate", "register", "adjust", "resample", "report", "camera"},
        "workbench/server/routes": set(),
        "cli/__init__": set(),
    }.items(),
)
def test_a_module_belongs_to_the_stages_that_import_it(closures, module, stages):
    assert {stage for stage in STAGES if module in closures[stage]} == stages


@pytest.mark.slow
def test_a_changed_module_changes_the_code_of_exactly_the_stages_that_rest_on_it(tmp_path):
    package = shutil.copytree(
        PACKAGE, tmp_path / "levkas", ignore=shutil.ignore_patterns("__pycache__", "built")
    )
    read = Sources(package)
    before = {stage: read.version(stage) for stage in ENTRIES}
    used = {stage: read.closure(stage) for stage in ENTRIES}
    for path in sorted(set().union(*used.values()))[::25]:  # all of them: benchmarks/staleness.py
        text = path.read_bytes()
        path.write_bytes(text + b"\n")
        changed = {stage for stage in ENTRIES if read.version(stage) != before[stage]}
        path.write_bytes(text)
        assert changed == {stage for stage in ENTRIES if path in used[stage]}, path


def test_an_import_for_type_checkers_is_none_and_one_in_a_function_is_one(tmp_path):
    package = tmp_path / "levkas"
    (package / "calibration").mkdir(parents=True)
    (package / "calibration" / "sensor_context.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from levkas.types import T\n"
        "class A:\n    def f(self):\n        from levkas.lazy import late\n"
    )
    (package / "__init__.py").write_text("")
    (package / "calibration" / "__init__.py").write_text("from levkas.types import T\n")
    (package / "types.py").write_text("")
    (package / "lazy").mkdir()
    (package / "lazy" / "__init__.py").write_text('_HOMES = {"late": "home", "other": "away"}\n')
    (package / "lazy" / "home.py").write_text("import numba\n")
    (package / "lazy" / "away.py").write_text("")
    found = {p.relative_to(package).as_posix() for p in Sources(package).closure("template")}
    assert found == {"calibration/sensor_context.py", "lazy/home.py"}


def test_every_library_of_a_stage_is_in_its_fingerprint_or_known_to_have_no_effect():
    read = Sources()
    roots = {
        root for stage in ENTRIES for name in read._reached(stage) for root in read._of(name).roots
    }
    others = roots - {*sys.stdlib_module_names, "levkas", ""}
    assert others <= {*sources.LIBRARIES, *sources.WITHOUT_EFFECT}
    assert {"zarr", "PIL", "xarray", "matplotlib", "skimage", "rawpy"} <= others


@pytest.mark.parametrize(
    ("distribution", "stages"),
    {
        "rawpy": {"calibrate", "register", "adjust", "resample", "report", "camera", "template"},
        "numcodecs": {"calibrate", "register", "resample", "camera", "catalogue"},
        "pillow": {"calibrate", "register", "resample", "report", "camera"},
        "matplotlib": {"register", "adjust", "report", "camera"},
        "scikit-image": {"resample", "camera"},
        "jinja2": {"register", "adjust", "report", "camera"},
    }.items(),
)
def test_another_version_of_a_library_changes_the_stages_that_use_it(
    monkeypatch, distribution, stages
):
    read = Sources()
    before = {stage: read.version(stage) for stage in ENTRIES}
    number = sources._version
    monkeypatch.setattr(sources, "_version", lambda n: "0" if n == distribution else number(n))
    assert {stage for stage in ENTRIES if read.version(stage) != before[stage]} == stages


def test_other_instruction_sets_make_every_stage_stale_that_computes(plates):
    free = {k: v for k, v in os.environ.items() if k not in (*HELD, "OPENCV_CPU_DISABLE")}
    script = "from levkas.cli import main; main()"
    command = [sys.executable, "-c", script, "status", str(plates), "--json"]

    def stale(**more):
        env = free | {"PYTHONPATH": os.pathsep.join(sys.path)} | more
        told = subprocess.run(command, capture_output=True, text=True, check=True, env=env)
        steps = json.loads(told.stdout)["stages"]
        return {s["stage"] for s in steps if "instructions" in s["why"]}

    assert stale() == set()
    found = instructions.describe_instructions()  # held, as conftest.py does
    if found["level"] == instructions.BASELINE:
        sets = stale(LEVKAS_INSTRUCTIONS="native")
        assert sets in ({"calibrate", "register", "resample", "report"}, set())
    record = json.loads((plates / "database/objects/one/provenance.json").read_text())
    assert {step["instructions"] for step in record["steps"]} == {
        instructions.instructions_in_use()
    }


@pytest.mark.slow
def test_what_a_build_loads_is_known(tmp_path, make_every_kind, closures):
    """Modules that a build of every kind of camera really imports, against those that were read."""
    folder = make_every_kind(tmp_path / "campaign", ("one",))
    script = (
        "import json, sys\nfrom levkas.building import build, summarise\n"
        "assert summarise(build(sys.argv[1])).ok\n"
        "print(json.dumps([m for m in sys.modules if m.startswith('levkas.')]))"
    )
    told = subprocess.run(
        [sys.executable, "-c", script, str(folder)], check=True, capture_output=True, text=True
    )
    loaded = {name.removeprefix("levkas.").replace(".", "/") for name in json.loads(told.stdout)}
    known = set().union(*closures.values())
    known |= {name.removeprefix("levkas.").replace(".", "/") for name in RIM}
    odd = {n for n in loaded - known if (PACKAGE / f"{n}.py").is_file()}
    assert {n for n in odd if not any(Path(n).match(p) for p in (*FOUND, *CLAIMED))} == set()
    assert len(loaded & known) > 120

"""The code of a stage is all that it may import: whole packages, and the libraries that these compute with."""

import ast
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import levkas
from levkas.stages import sources
from levkas.stages.sources import HERE, NUMBERS, PAGES, PRODUCTS, STAGES, files_of

PACKAGE = Path(levkas.__file__).parent
WITHOUT_EFFECT = {
    *("boto3", "filelock", "h5py", "obstore", "psutil", "pydantic", "threadpoolctl"),
}
"""Locks, memory, threads, remote reading, checks of keys: in no byte of a stage."""
MODULES = {
    "PIL": "pillow", "colour": "colour-science", "cv2": "opencv-python-headless", "skimage": "scikit-image"
}  # fmt: skip


def modules(folders):
    """Yield every import of a stage's files: the file, and the module that it names."""
    for path in files_of(folders):
        if path.suffix == ".py":
            for node in ast.walk(ast.parse(path.read_bytes())):
                if isinstance(node, ast.Import):
                    yield from ((path, alias.name) for alias in node.names)
                elif isinstance(node, ast.ImportFrom):
                    yield path, node.module or ""


def test_the_packages_of_the_numbers_import_nothing_else_of_levkas():
    known = {path.relative_to(HERE).with_suffix("").as_posix() for path in files_of(NUMBERS)}
    known = {name.removesuffix("/__init__") for name in known} | {"levkas"}
    others = {
        (path.name, module)
        for path, module in modules(NUMBERS)
        if module.startswith("levkas.")
        # Figures of a registration and of charts are of the stages of `PAGES`; the last test sees what a build loads.
        if not (module.startswith("levkas.pages") and path.parent.name == "stages")
        if module.removeprefix("levkas.").replace(".", "/") not in known
    }
    assert others == set()


def test_every_library_is_in_the_fingerprint_or_known_to_have_no_effect():
    roots = {module.partition(".")[0] for _, module in modules(PAGES)}
    others = roots - {*sys.stdlib_module_names, "levkas", ""}
    named = {MODULES.get(root, root) for root in others}
    assert named <= {*sources.LIBRARIES, *sources.LIBRARIES_OF_PAGES, *WITHOUT_EFFECT}
    assert {"zarr", "pillow", "xarray", "matplotlib", "scikit-image", "rawpy"} <= named


@pytest.mark.parametrize(
    ("name", "stages"),
    {
        "calibration/flatfield.py": {*STAGES},
        "readers/raw.py": {*STAGES},
        "registration/models.py": {*STAGES} - {"template"},
        "stages/resample.py": {*STAGES} - {"template"},
        "building/camera_pages.py": {"report", "camera", "catalogue"},
        "pages/report.html": {"register", "report", "camera"},
        "building/executor.py": set(),
        "workbench/session.py": set(),
    }.items(),
)
def test_a_changed_file_changes_the_code_of_the_stages_that_may_rest_on_it(tmp_path, name, stages):
    package = tmp_path / "levkas"
    for path in {path for folders in STAGES.values() for path in files_of(folders)} | {
        PACKAGE / name
    }:
        target = package / path.relative_to(PACKAGE)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)
    before = {stage: sources._hash(folders, package) for stage, folders in STAGES.items()}
    with (package / name).open("a") as file:
        file.write("\n")
    sources._hash.cache_clear()
    sources._hash_folder.cache_clear()
    now = {stage: sources._hash(folders, package) for stage, folders in STAGES.items()}
    assert {stage for stage in STAGES if now[stage] != before[stage]} == stages


@pytest.mark.slow
def test_what_a_build_loads_is_known(tmp_path, make_every_kind):
    """Modules that a build of every kind of camera really imports are those of its stages."""
    folder = make_every_kind(tmp_path / "campaign", ("one",))
    script = (
        "import json, sys\nfrom levkas.building import build, summarise\n"
        "assert summarise(build(sys.argv[1])).ok\n"
        "print(json.dumps([m for m in sys.modules if m.startswith('levkas.')]))"
    )
    result = subprocess.run(
        [sys.executable, "-c", script, str(folder)], check=True, capture_output=True, text=True
    )
    loaded = {name.removeprefix("levkas.").replace(".", "/") for name in json.loads(result.stdout)}
    known = {path.relative_to(PACKAGE).with_suffix("").as_posix() for path in files_of(PAGES)}
    known |= {f"building/{name}" for name in PRODUCTS} | {"publish/publication", "publish/facts"}
    others = {name for name in loaded - known if not name.startswith("building/")}
    odd = {name for name in others if (PACKAGE / f"{name}.py").is_file()}
    assert odd == set()
    assert len(loaded & known) > 120

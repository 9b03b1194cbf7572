"""The code is one number: every file of the package but what a browser runs, and the libraries that it requires."""

import shutil
from importlib import metadata

import pytest

from levkas.stages.sources import HERE, code_version, libraries, made_with


@pytest.mark.parametrize(
    ("name", "is_code"),
    {"calibration/flatfield.py": True, "pages/report.html": True, "core/__pycache__/a.pyc": False}.items(),
)  # fmt: skip
def test_a_changed_file_changes_the_code(tmp_path, name, is_code):
    package = tmp_path / "levkas"
    for folder in ("calibration", "pages", "core"):
        kept = shutil.ignore_patterns("*.js", "built")
        shutil.copytree(HERE / folder, package / folder, ignore=kept)
    before = code_version(package)
    (package / name).parent.mkdir(exist_ok=True)
    with (package / name).open("a") as file:
        file.write("\n")
    code_version.cache_clear()
    assert (code_version(package) != before) == is_code


def test_another_version_of_a_library_that_is_required_by_another_changes_the_code(monkeypatch):
    found = libraries()
    assert {"numpy", "numcodecs", "llvmlite", "pillow", "tifffile"} <= {*found}
    assert "pytest" not in found
    before = made_with()
    version = metadata.version
    monkeypatch.setattr(metadata, "version", lambda n: "0" if n == "numcodecs" else version(n))
    for cached in (libraries, code_version):
        cached.cache_clear()
    assert made_with()["code"] != before["code"]
    for cached in (libraries, code_version):
        cached.cache_clear()

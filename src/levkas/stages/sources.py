"""The code that a stage may rest on: the packages that it may import, which `lint-imports` holds it to, and libraries."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from levkas.core.instructions import instructions_in_use

HERE = Path(__file__).resolve().parents[1]
READING = ("core", "readers", "geometry", "colour", "calibration")
NUMBERS = (
    *(*READING, "campaign", "registration", "database", "stages"),
    *("quality/evaluation", "quality/image_quality", "quality/targets"),
)
PAGES = (*NUMBERS, "pages")
STAGES = {
    "calibrate": NUMBERS,
    "register": PAGES,
    "resample": NUMBERS,
    "report": (*PAGES, "building"),
    "camera": (*PAGES, "building"),
    "catalogue": (*NUMBERS, "building"),
    "template": READING,
}
"""The folders of each stage's code; figures of a registration are drawn by `pages`."""
PRODUCTS = frozenset(("camera_pages", "catalogue", "report_pages"))
"""Modules of `building` that write what is published; others decide what is done, with what, and where."""
LIBRARIES = (
    *("exifread", "imagecodecs", "llvmlite", "numba", "numcodecs", "numpy"),
    *("opencv-python-headless", "pillow", "rawpy", "scikit-image", "scipy", "tifffile"),
    *("tomlkit", "xarray", "zarr"),
)
LIBRARIES_OF_PAGES = ("contourpy", "jinja2", "markupsafe", "matplotlib")
"""Distributions whose versions may be in the bytes."""


def code_version(stage: str) -> str:
    """Return the hash of a stage's code and of the versions of the libraries that it computes with."""
    return _hash(STAGES[stage])


def made_with(stage: str) -> dict[str, Any]:
    """Return the part of a fingerprint that says with what a stage is made: its code, and instruction sets.

    >>> sorted(made_with("catalogue"))
    ['code', 'instructions']
    """
    return {"code": code_version(stage), "instructions": instructions_in_use()}


def files_of(folders: tuple[str, ...], package: Path = HERE) -> Iterator[Path]:
    """Yield the files of a package's folders that a stage may rest on: code, tables and page templates."""
    for folder in folders:
        for path in sorted((package / folder).rglob("*")):
            within = path.relative_to(package).parts
            engine = within[0] == "building" and path.stem not in PRODUCTS
            if path.is_file() and not engine and not {"__pycache__", "built", "guess"} & {*within}:
                yield path


@cache
def _hash(folders: tuple[str, ...], package: Path = HERE) -> str:
    digest = hashlib.sha256()
    for folder in folders:
        digest.update(_hash_folder(folder, package))
    names = LIBRARIES + (LIBRARIES_OF_PAGES if "pages" in folders else ())
    digest.update(repr([(name, library_version(name)) for name in names]).encode())
    return digest.hexdigest()[:16]


@cache  # stages share folders
def _hash_folder(folder: str, package: Path) -> bytes:
    digest = hashlib.sha256()
    for path in files_of((folder,), package):
        digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return digest.digest()


@cache  # each has to be read and parsed
def library_version(distribution: str) -> str:
    """Return the version of an installed library; empty where it is not known."""
    try:
        return version(distribution)
    except PackageNotFoundError:  # another build of the same library: its version is not known
        return ""

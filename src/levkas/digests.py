"""SHA-256 of files and of folders."""

from __future__ import annotations

import hashlib
from pathlib import Path


def hash_file(path: str | Path) -> str:
    """Return the SHA-256 of a file, streamed, as 64 hexadecimal digits."""
    with Path(path).open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def hash_tree(folder: str | Path) -> dict[str, str]:
    """Return the SHA-256 of every file below `folder`, by its relative path, in sorted order."""
    root = Path(folder)
    names = sorted(p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file())
    return {name: hash_file(root / name) for name in names}

"""SHA-256 of files and of folders."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from pathlib import Path

Stamp = tuple[int, int, int, int]


def hash_file(path: str | Path) -> str:
    """Return the SHA-256 of a file, streamed, as 64 hexadecimal digits.

    Raises OSError where it cannot be read, or is none: a pipe would be waited for, for ever.
    """
    path = Path(path) if isinstance(path, str) else path  # or one on a server
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    with path.open("rb", buffering=0) as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def hash_tree(folder: str | Path) -> dict[str, str]:
    """Return the SHA-256 of every file below `folder`, by its relative path, in sorted order."""
    root = Path(folder)
    names = sorted(p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file())
    return {name: hash_file(root / name) for name in names}


def stamp_of(path: str | Path) -> Stamp:
    """Return size, times of modification and of change (ns), and inode of a file.

    Whoever replaces a file can set its time of modification back; the system alone sets the time of change (on Windows
    that of creation).
    """
    found = os.stat(path)  # noqa: PTH116 -- thousands of times where all is fresh
    return found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino

"""Free space, and disk failures turned into refusals that say what to do."""

from __future__ import annotations

import contextlib
import errno
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.core.problems import Problem, Refused
from levkas.core.text import unusable_name

if TYPE_CHECKING:
    from collections.abc import Iterator

DISK_FULL = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EFBIG}
REFUSED = {
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR),
    *(errno.EISDIR, errno.ENOENT, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP),
}
DISK_CODES = frozenset({"E_DISK_FULL", "E_IO", "E_UNWRITABLE"})
"""Of the problems of a `WriteRefused`."""


class WriteRefused(Refused):
    """Something could not be written; no half-written file has its name."""


def require_space(folder: str | Path, bytes_needed: int, *, path: str | Path | None = None) -> None:
    """Refuse with ``E_DISK_FULL`` where `folder`'s file system has not `bytes_needed` free."""
    free = _free_bytes(Path(folder))
    if free is not None and free < bytes_needed:
        raise WriteRefused(_disk_full(Path(path or folder), bytes_needed, free))


def _free_bytes(folder: Path) -> int | None:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None


@contextlib.contextmanager
def refusing(
    path: Path, bytes_needed: int | None, *, only_of: Path | None = None
) -> Iterator[None]:
    """Turn OSErrors into refusals; with `only_of`, those alone that surely are of this writing."""
    try:
        yield
    except OSError as error:
        ours = only_of is None or error.errno in DISK_FULL
        if not ours and not str(error.filename or "").startswith(str(only_of)):
            raise
        raise WriteRefused(_problem(path, error, bytes_needed)) from error
    except ValueError as error:  # Python's, before the system is called
        if not (why := unusable_name(path)):
            raise
        raise WriteRefused(_unwritable(path, why)) from error


def _problem(path: Path, error: OSError, bytes_needed: int | None) -> Problem:
    if error.errno in DISK_FULL:
        return _disk_full(path, bytes_needed, _free_bytes(path.parent))
    reason = error.strerror or type(error).__name__
    if error.errno in REFUSED:
        return _unwritable(path, unusable_name(path) or reason)
    message = f"the disk failed while {path.name} was written: {reason}"
    fix = "Check the disk, then run the build again; finished stages are kept."
    return Problem("E_IO", message, str(path), fix=fix)


def _unwritable(path: Path, reason: str) -> Problem:
    message = f"{path.name} cannot be written: {reason}"
    expected = "a folder that can be written to"
    fix = "Give another output folder, or change its permissions."
    return Problem("E_UNWRITABLE", message, str(path), expected=expected, fix=fix)


def _disk_full(path: Path, bytes_needed: int | None, free: int | None) -> Problem:
    found = None if free is None else f"{free} bytes free"
    expected = None if bytes_needed is None else f"{bytes_needed} bytes"
    message = f"the disk is full: {path.name} was not written"
    fix = "Free some space, or give another output folder; then run the build again."
    return Problem("E_DISK_FULL", message, str(path), None, found, expected, fix)

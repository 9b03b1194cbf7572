"""One at a time: a lock between threads, processes and machines, by a file that stands only meanwhile."""

from __future__ import annotations

import contextlib
import errno
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.core.disk import refusing
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Iterator

try:
    import fcntl
except ImportError:
    fcntl = None  # type: ignore[assignment]
try:
    import msvcrt  # Windows
except ImportError:
    msvcrt = None  # type: ignore[assignment]

PATIENCE_S = 20.0
PAUSE_S = 0.005
TAKEN = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)


class Taken(Refused):
    """Another process holds what is asked for."""


@contextlib.contextmanager
def locked(path: Path, *, patience_s: float = PATIENCE_S) -> Iterator[None]:
    """Hold the file `path` alone in the block; it is made for that and taken away after.

    A lock ends with the process that holds it, however that ends. Where a file system has no locks
    the block is entered all the same.

    Raises
    ------
    Taken
        ``E_BUSY``, where another holds it for `patience_s` seconds.
    WriteRefused
        Where the file cannot be made.
    """
    until = time.monotonic() + patience_s
    while (descriptor := _take(path)) is None:
        if time.monotonic() > until:
            raise Taken(
                Problem(
                    "E_BUSY",
                    "another process holds this",
                    str(path),
                    fix="Wait for it, or end it.",
                )
            )
        time.sleep(PAUSE_S)
    try:
        yield
    finally:
        # While it is still held where that can be: whoever waits for this very file looks again.
        if os.name != "nt":
            path.unlink(missing_ok=True)
        os.close(descriptor)
        if os.name == "nt":
            with contextlib.suppress(OSError):
                path.unlink()


def _take(path: Path) -> int | None:
    """Return the descriptor of the file, held; None where another holds it."""
    with refusing(path, None):
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except PermissionError:
            if os.name == "nt" and path.exists():  # it is just being taken away
                return None
            raise
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        elif msvcrt is not None:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        here = path.stat()
        if os.path.samestat(here, os.fstat(descriptor)):
            return descriptor
    except FileNotFoundError:
        pass
    except OSError as error:
        if error.errno not in TAKEN:
            return descriptor
    os.close(descriptor)
    return None

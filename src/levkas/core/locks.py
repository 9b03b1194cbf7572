"""Locks between threads, processes and machines, which end with the process that holds them, however that ends."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.core.disk import refusing
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Iterator

try:
    import fcntl
except ImportError:  # Windows: open files are not locked there
    fcntl = None  # type: ignore[assignment]

PATIENCE_S = 20.0
PAUSE_S = 0.005


class Taken(Refused):
    """Another process holds the lock."""


@contextlib.contextmanager
def locked(path: Path, *, patience_s: float = PATIENCE_S) -> Iterator[None]:
    """Hold the file `path` alone in the block; it is made for that and removed after.

    On a file system without locks the block is entered all the same. Raises Taken, ``E_BUSY``, where another holds it for
    `patience_s` seconds, and WriteRefused where the file cannot be made.
    """
    from filelock import FileLock, Timeout

    with refusing(path, None):
        path.touch()
    lock = FileLock(path, timeout=patience_s, poll_interval=PAUSE_S, is_singleton=False)
    try:
        lock.acquire()
    except Timeout:
        fix = "Wait for it, or stop it."
        busy = Problem("E_BUSY", "another process is using this", str(path), fix=fix)
        raise Taken(busy) from None
    except OSError:  # no locks here
        pass
    try:
        yield
    finally:
        # While it is held: whoever waits for this very file notices that its name is gone.
        if os.name != "nt":
            path.unlink(missing_ok=True)
        lock.release()
        if os.name == "nt":  # which removes no open file
            with contextlib.suppress(OSError):
                path.unlink()


def take(descriptor: int, *, shared: bool = False) -> bool | None:
    """Lock an open file until it is closed, at once: whether that was possible; None without locks here."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True

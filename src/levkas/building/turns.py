"""Turns: what two builds of one database do one after the other."""

from __future__ import annotations

import contextlib
import os
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows has no locks of folders: there, no turns are taken
    fcntl = None  # type: ignore[assignment]

PATIENCE_S = 120.0
PAUSE_S = 0.05


@contextlib.contextmanager
def in_turn(folder: Path, *, patience_s: float = PATIENCE_S) -> Iterator[None]:
    """Let one build at a time into the block, by a lock of `folder` that ends with its process.

    It spares work and keeps two from undoing each other's last words; nothing hangs on it for long:
    whoever waited `patience_s`, or stands on a file system without locks, goes on.
    """
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        until = time.monotonic() + patience_s
        while not _locked(descriptor) and time.monotonic() < until:
            time.sleep(PAUSE_S)
        yield
    finally:
        os.close(descriptor)


def _locked(descriptor: int) -> bool:
    """Whether the lock is ours, or cannot be had here at all."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True

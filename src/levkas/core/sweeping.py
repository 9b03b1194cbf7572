"""Removal of partial files and folders that killed runs left behind."""

from __future__ import annotations

import glob
import os
from pathlib import Path

from levkas.core.disk import refusing
from levkas.core.files import OURS, discard, partial_stem
from levkas.core.locks import take


def sweep(folder: str | Path) -> list[Path]:
    """Take away what killed runs of Levkas left under partial names, in `folder` and below.

    A partial file that a living process still writes is locked by it and stays. `folder` must be
    one that Levkas made. What was removed is returned.
    """
    removed: list[Path] = []
    for place, folders, names in os.walk(folder):
        partial = [n for n in (*folders, *names) if OURS.fullmatch(n)]
        folders[:] = sorted(set(folders) - set(partial))
        for name in sorted(partial):
            path = Path(place, name)
            if _abandoned(path):
                with refusing(path, None):
                    discard(path)
                removed.append(path)
    return removed


def sweep_beside(path: str | Path) -> list[Path]:
    """Take away what killed runs left of one file or folder, beside it; as `sweep` does."""
    path = Path(path)
    removed = []
    start = glob.escape(partial_stem(path))
    for left in sorted(path.parent.glob(f"{start}.levkas.partial-*")):
        if OURS.fullmatch(left.name) and _abandoned(left):
            with refusing(left, None):
                discard(left)
            removed.append(left)
    return removed


def _abandoned(path: Path) -> bool:
    if os.name == "nt":  # nothing is swept where open files are not locked
        return False
    try:
        descriptor = os.open(
            path, os.O_RDONLY | os.O_NONBLOCK
        )  # a pipe of that name keeps none waiting
    except OSError:
        return False
    try:
        return take(descriptor) is True
    finally:
        os.close(descriptor)

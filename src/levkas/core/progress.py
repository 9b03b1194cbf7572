"""Frames decoded and loops being compiled, for whoever draws how far a stage has come."""

from __future__ import annotations

import threading


class Tally:
    """A count that any thread may raise.

    Examples
    --------
    >>> tally = Tally()
    >>> tally.add(); tally.count
    1
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._count = 0

    def add(self, count: int = 1) -> None:
        """Count some more."""
        with self._lock:
            self._count += count

    @property
    def count(self) -> int:
        """How many there were."""
        return self._count


FRAMES = Tally()
"""Frames decoded by `levkas.readers.frames.read_frame`, here or by a worker."""
COMPILING = Tally()
"""Functions that `levkas.core.compiled` is compiling now."""

"""Calibrated lines of a scan in memory: those that a strip of the grid needs, and the next strip's."""

from __future__ import annotations

from typing import TYPE_CHECKING

from levkas.building.scans import rows_of

if TYPE_CHECKING:
    from levkas.building.scans import Scan
    from levkas.core.cube import Cube


class HeldLines:
    """Two stretches of lines in turn: while one is read from, the next one is filled.

    Lines that both have are copied, not calibrated again. What `hold` returned last but one is
    written over.
    """

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self._rooms: list[Cube] = []
        self._last: tuple[int, int, Cube] | None = None

    def hold(self, start: int, stop: int) -> Cube:
        """Return lines `start` to `stop`; in place of sigma stands its square."""
        lines = rows_of(self._room(stop - start), 0, stop - start)
        fresh = start
        if self._last is not None:
            first, end, before = self._last
            if first <= start < end:
                fresh = min(end, stop)
                old = rows_of(before, start - first, fresh - first)
                lines.values[: fresh - start] = old.values
                lines.flags[: fresh - start] = old.flags
                if lines.sigma is not None and old.sigma is not None:
                    lines.sigma[: fresh - start] = old.sigma
        if fresh < stop:
            self._scan.lines(fresh, stop, rows_of(lines, fresh - start, stop - start), squared=True)
        self._last = start, stop, lines
        return lines

    def _room(self, lines: int) -> Cube:
        """Return the room that is free, as large as asked for."""
        room = self._rooms.pop(0) if len(self._rooms) == 2 else None
        if room is None or len(room.values) < lines:
            room = None  # the smaller one goes before the larger one comes
            room = self._scan.room(lines)
        self._rooms.append(room)
        return room

"""SHA-256 of files, kept in an index: size, times and inode spare a second reading of an unchanged one."""

from __future__ import annotations

import os
import re
import sqlite3
import threading
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core.digests import hash_file, stamp_of
from levkas.core.files import remove

if TYPE_CHECKING:
    from collections.abc import Sequence

HASHES = "hashes.sqlite"
"""Among what is kept."""
TICK_NS = 100_000_000
"""Longer than the clocks of file systems that keep parts of a second stand still: at most 16 ms."""
COARSE_TICK_NS = 2_000_000_000
"""As long as those of others stand still: FAT counts in two seconds."""
PATIENCE_S = 30.0
"""While another build writes what it has learnt."""
TABLE = """CREATE TABLE IF NOT EXISTS files (
    name BLOB PRIMARY KEY, size INTEGER, modified INTEGER, changed INTEGER, inode TEXT, sha256 TEXT
) WITHOUT ROWID"""

OF_THE_DISK = (
    *(sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_FULL, sqlite3.SQLITE_READONLY),
    *(sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_IOERR),
)
"""Errors in spite of which the index is sound."""
STAMP = "size, modified, changed, inode, sha256"
Entry = list[Any]
"""Stamp of a file, as `stamp_of` gives it, and its SHA-256."""


class Hashes:
    """Hashes of files by their names, those of earlier builds in an index of sqlite.

    The index may be taken away, or be damaged: files are then read again. A file that was changed
    just before it was read may have been changed again within one tick of the clock of its file
    system: its hash is kept only once that tick is over.

    Parameters
    ----------
    path : Path
        The index; `save` makes it.
    verify : bool
        Read every file anew, whatever is kept of it.
    """

    def __init__(self, path: Path, *, verify: bool = False) -> None:
        self.path = path
        self._kept = None if verify else _opened(path)
        self._read: dict[bytes, Entry] | None = {} if verify else None
        self._new: dict[bytes, Entry] = {}
        self._unsettled: dict[str, Entry] = {}
        self._files: dict[Path, tuple[Path, ...]] = {}
        self._lock = threading.Lock()

    def __call__(self, path: str | Path, *, own: bool = False) -> str:
        """Return the hash of a file; `own` ones were written whole by Levkas just before."""
        name = str(path)
        stamp = [*stamp_of(name)]
        entry = self._unsettled.get(name) or self.known(name)
        if entry is None or entry[:-1] != stamp:
            entry = self._hashed(name, stamp, own=own)
        return str(entry[-1])

    def of_frame(self, path: Path) -> dict[Path, str]:
        """Return the hashes of all files that a frame is read from; raises OSError."""
        from levkas.readers.frames import files_of

        if path not in self._files:
            self._files[path] = files_of(path)
        return {file: self(file) for file in self._files[path]}

    def known(self, path: str | Path) -> Entry | None:
        """Return stamp and hash of a file as they were when it was read."""
        name = os.fsencode(path)
        with self._lock:
            if (entry := self._new.get(name)) is not None or self._kept is None:
                return entry or (self._read or {}).get(name)
            try:
                row = self._kept.execute(f"SELECT {STAMP} FROM files WHERE name = ?", (name,))
                found = row.fetchone()
            except sqlite3.Error:
                return None
        return None if found is None else _entry(found)

    def take(self, path: str | Path, entry: Sequence[Any]) -> None:
        """Take stamp and hash of a file that another process has read, where the file has that stamp still."""
        with suppress(OSError):
            if [*stamp_of(path)] == [*entry[:-1]]:
                with self._lock:
                    self._new[os.fsencode(path)] = [*entry]

    def save(self) -> None:
        """Keep what was learnt; where the disk refuses, files are read again by the next build."""
        for name in list(self._unsettled):
            with suppress(OSError):  # taken away meanwhile
                self._hashed(name, [*stamp_of(name)])
        with self._lock:
            if not self._new:
                return
            rows = [(name, *e[:3], str(e[3]), e[4]) for name, e in self._new.items()]
            try:
                _write(self.path, rows)
            except sqlite3.DatabaseError as error:
                if getattr(error, "sqlite_errorcode", 0) & 0xFF in OF_THE_DISK:
                    return
                self._kept = None  # damaged, or of another form: made anew
                remove(self.path)
                with suppress(sqlite3.OperationalError):
                    _write(self.path, rows)
            if self._read is not None:
                self._read |= self._new
            else:
                self._kept = self._kept or _opened(self.path)
            self._new = {}

    def _hashed(self, name: str, stamp: list[int], *, own: bool = False) -> Entry:
        """Hash a file that had a stamp just before."""
        settled = own or is_settled(stamp, time.time_ns())
        entry = [*stamp, hash_file(name)]
        with self._lock:
            self._unsettled.pop(name, None)
            if settled:
                self._new[os.fsencode(name)] = entry
            else:
                self._unsettled[name] = entry
        return entry


class Unread(Hashes):
    """Placeholder for the hashes of files that need not be read, because their products were never made."""

    def __init__(self) -> None:
        super().__init__(Path(), verify=True)

    def __call__(self, path: str | Path, *, own: bool = False) -> str:
        """Return no hash."""
        return "not read"


def _entry(row: Sequence[Any]) -> Entry | None:
    """Return stamp and hash of a row; None where it was damaged, and the file is read again."""
    try:
        stamp, sha256 = [int(number) for number in row[:4]], str(row[4])
    except (TypeError, ValueError):
        return None
    return [*stamp, sha256] if re.fullmatch("[0-9a-f]{64}", sha256) else None


def _opened(path: Path) -> sqlite3.Connection | None:
    """Open an index for reading from any thread; None where there is none that can be read."""
    if not path.is_file():
        return None
    try:
        kept = sqlite3.connect(path, timeout=PATIENCE_S, check_same_thread=False)
        kept.execute(f"SELECT name, {STAMP} FROM files LIMIT 1")
    except sqlite3.Error:
        return None
    return kept


def _write(path: Path, rows: Sequence[tuple[Any, ...]]) -> None:
    with closing(sqlite3.connect(path, timeout=PATIENCE_S)) as index, index:
        index.execute(TABLE)
        index.executemany("INSERT OR REPLACE INTO files VALUES (?, ?, ?, ?, ?, ?)", rows)


def is_settled(stamp: Sequence[int], now: int) -> bool:
    """Tell whether a file read from `now` on cannot be changed any more without another stamp.

    >>> is_settled((1, 10**18 + 1, 10**18 + 1, 1), 10**18 + TICK_NS)
    False
    """
    times = stamp[1:3]
    coarse = all(one % 1_000_000 == 0 for one in times)
    return now - max(times) > (COARSE_TICK_NS if coarse else TICK_NS)

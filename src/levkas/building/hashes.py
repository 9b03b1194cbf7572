"""SHA-256 of files: size, times and inode spare a second reading of an unchanged one."""

from __future__ import annotations

import hashlib
import os
import re
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.building.records_file import read_rows, write_rows
from levkas.core.digests import hash_file, stamp_of
from levkas.core.disk import WriteRefused

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.building.records_file import Change

TICK_NS = 100_000_000
"""Longer than the clocks of file systems that keep parts of a second stand still: at most 16 ms."""
COARSE_TICK_NS = 2_000_000_000
"""As long as those of others stand still: FAT counts in two seconds."""
KNOWN = "SELECT name, size, modified, changed, inode, sha256 FROM files"
LEARN = "INSERT OR REPLACE INTO files VALUES (?, ?, ?, ?, ?, ?)"
Entry = tuple[int, int, int, int, str]
"""Stamp of a file, as `stamp_of` gives it, and its SHA-256."""


HASHES = "hashes.sqlite"
"""Among what is kept of a session."""


def session_folder(root: Path) -> Path:
    """Return where is kept what was found out of a folder while it was watched: $XDG_CACHE_HOME, or .cache of the home folder."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    name = hashlib.blake2b(str(root).encode(errors="surrogatepass"), digest_size=8).hexdigest()
    return Path(home) / "levkas" / "watch" / name


class Hashes:
    """Hashes of files by their names, those of earlier builds as they were recorded in the file `path`.

    A file that was changed just before it was read may have been changed again within one tick of the clock of its
    file system: its hash is not recorded before it was read once more. To `verify`, every file is read anew. A `session` is a
    file of hashes by others, which count where a file has their stamp still.
    """

    def __init__(self, path: Path, *, verify: bool = False, session: Path | None = None) -> None:
        self.path, self._session = path, None if verify else session
        self._others: dict[bytes, Entry] | None = None
        self._entries: dict[bytes, Entry] | None = {} if verify else None
        self._unsaved: dict[bytes, Entry] = {}
        self._recent: set[bytes] = set()
        self._frames: dict[Path, tuple[Path, ...]] = {}
        self._lock = threading.RLock()

    def __call__(self, path: str | Path, *, own: bool = False) -> str:
        """Return the hash of a file; `own` ones were written whole by Levkas just before."""
        stamp, entry, safe = stamp_of(path), self.known(path), True
        if entry is not None and entry[:-1] == stamp:
            return entry[-1]
        entry = self._of_others(path)
        if entry is None or entry[:-1] != stamp:
            safe = own or is_old_enough(stamp, time.time_ns())
            entry = (*stamp, hash_file(path))
        self._learn(path, entry, old_enough=safe)
        return entry[-1]

    def of_frame(self, path: Path) -> dict[Path, str]:
        """Return the hashes of all files that a frame is read from; raises OSError."""
        from levkas.readers.frames import files_of

        if path not in self._frames:
            self._frames[path] = files_of(path)
        return {file: self(file) for file in self._frames[path]}

    def known(self, path: str | Path) -> Entry | None:
        """Return stamp and hash of a file as they were when it was read."""
        return self._known().get(os.fsencode(path))

    def _known(self) -> dict[bytes, Entry]:
        with self._lock:
            if self._entries is None:
                self._entries = _read_entries(self.path)
            return self._entries

    def _of_others(self, path: str | Path) -> Entry | None:
        with self._lock:
            if self._others is None:
                self._others = _read_entries(self._session) if self._session else {}
            return self._others.get(os.fsencode(path))

    def _learn(self, path: str | Path, entry: Entry, *, old_enough: bool) -> None:
        name = os.fsencode(path)
        with self._lock:
            self._known()[name] = entry
            if old_enough:
                self._unsaved[name] = entry
                self._recent.discard(name)
            else:
                self._unsaved.pop(name, None)
                self._recent.add(name)

    def unsaved(self) -> Change:
        """Return, once, what was read and is not recorded."""
        with self._lock:
            entries, self._unsaved = self._unsaved, {}
        return LEARN, [(name, *e[:3], str(e[3]), e[4]) for name, e in entries.items()]

    def save(self) -> None:
        """Record what was read; where the disk refuses, files are read again by the next build."""
        recent, self._recent = self._recent, set()
        for name in recent:
            self._known().pop(name)
            with suppress(OSError):  # taken away meanwhile
                self(os.fsdecode(name))
        if self._unsaved:
            with suppress(WriteRefused):
                write_rows(self.path, self.unsaved())


def _read_entries(path: Path) -> dict[bytes, Entry]:
    """Return the entries of a file by name but for damaged rows, whose files are read again."""
    found: dict[bytes, Entry] = {}
    for name, *stamp, sha256 in read_rows(path, KNOWN):
        with suppress(TypeError, ValueError):
            size, modified, changed, inode = map(int, stamp)
            if re.fullmatch("[0-9a-f]{64}", sha256):
                found[name] = (size, modified, changed, inode, sha256)
    return found


def is_old_enough(stamp: Sequence[int], now: int) -> bool:
    """Return whether a file read from `now` on cannot be changed any more without another stamp.

    >>> is_old_enough((1, 10**18 + 1, 10**18 + 1, 1), 10**18 + TICK_NS)
    False
    """
    times = stamp[1:3]
    coarse = all(one % 1_000_000 == 0 for one in times)
    return now - max(times) > (COARSE_TICK_NS if coarse else TICK_NS)

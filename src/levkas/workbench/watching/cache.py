"""What frames were measured to, kept in the user's cache folder: a restart reads no frame again, memory holds numbers alone."""

from __future__ import annotations

import sqlite3
import threading
import zlib
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import levkas
from levkas.core.files import make_folder
from levkas.core.problems import Refused
from levkas.quality.frame_checks import FrameMeasures, FramePictures

TABLE = "CREATE TABLE IF NOT EXISTS frames (key TEXT PRIMARY KEY, numbers BLOB, pictures BLOB) WITHOUT ROWID"
IN_MEMORY = 64
"""Frames whose pictures are kept at hand, some 500 kB each."""
DAMAGED = (ValueError, KeyError, TypeError, zlib.error)


class KeptPictures(FramePictures):
    """Pictures of a frame that lie in the cache until they are looked at."""

    def __init__(self, cache: MeasureCache, key: str) -> None:
        object.__setattr__(self, "_place", (cache, key))

    def __getattribute__(self, name: str) -> object:
        if name in ("picture", "patches"):
            cache, key = object.__getattribute__(self, "_place")
            return getattr(cache.pictures(key), name)
        return object.__getattribute__(self, name)


NO_PICTURES = FramePictures(np.zeros((1, 1), np.float32), np.zeros((0, 64, 64), np.uint16))


@dataclass
class MeasureCache:
    """Measures by the key of a frame, in one file of sqlite; one that is damaged, or cannot be written, is done without.

    Parameters
    ----------
    folder : Path
    """

    folder: Path

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._near: OrderedDict[str, FramePictures] = OrderedDict()
        self._connection = self._open()

    def get(self, key: str) -> FrameMeasures | None:
        """Return what is kept of a frame."""
        row = self._row("SELECT numbers FROM frames WHERE key = ?", key)
        with suppress(*DAMAGED):
            return FrameMeasures.from_bytes(row[0], KeptPictures(self, key)) if row else None
        return None

    def put(self, key: str, measures: FrameMeasures) -> FrameMeasures:
        """Keep a frame's measures; return them with pictures that lie in the cache."""
        pictures = measures.pictures
        self._remember(key, pictures)
        row = (key, measures.to_bytes(), pictures.to_bytes())
        with self._lock, suppress(sqlite3.Error):
            with self._connection:
                self._connection.execute("INSERT OR REPLACE INTO frames VALUES (?, ?, ?)", row)
            return FrameMeasures.from_bytes(row[1], KeptPictures(self, key))
        return measures

    def pictures(self, key: str) -> FramePictures:
        """Return the pictures of a frame; empty ones, which are compared with nothing, where they are lost."""
        if (near := self._near.get(key)) is not None:
            return near
        row = self._row("SELECT pictures FROM frames WHERE key = ?", key)
        found = NO_PICTURES
        with suppress(*DAMAGED):
            found = FramePictures.from_bytes(row[0]) if row else NO_PICTURES
        self._remember(key, found)
        return found

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._connection.close()

    def _remember(self, key: str, pictures: FramePictures) -> None:
        self._near[key] = pictures
        while len(self._near) > IN_MEMORY:
            self._near.popitem(last=False)

    def _row(self, query: str, key: str) -> tuple[bytes] | None:
        with self._lock, suppress(sqlite3.Error):
            row: tuple[bytes] | None = self._connection.execute(query, (key,)).fetchone()
            return row
        return None

    def _open(self) -> sqlite3.Connection:
        """Open the file of this version; where it is damaged make it anew, where it cannot be written hold it in memory."""
        path = self.folder / f"measures-{levkas.__version__}.sqlite"
        for attempt in range(2):
            try:
                make_folder(self.folder)
                connection = sqlite3.connect(path, check_same_thread=False)
                connection.execute("PRAGMA synchronous = OFF")
                connection.execute(TABLE)
                return connection
            except (sqlite3.Error, Refused, OSError):
                if attempt == 0:
                    with suppress(OSError):
                        path.unlink()
        connection = sqlite3.connect("", check_same_thread=False)  # in a temporary file of sqlite's
        connection.execute(TABLE)
        return connection

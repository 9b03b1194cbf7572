"""One file of sqlite beside a database: the hashes of files, and what is recorded of every stage.

It may be taken away or damaged: what cannot be read of it is not there, so that files are read and stages done again.
"""

from __future__ import annotations

import errno
import os
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core import files
from levkas.core.disk import refusing
from levkas.core.locks import take

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    Change = tuple[str, Iterable[Sequence[Any]]]

NAME = "records.sqlite"
"""Among what is kept."""
TABLES = (
    """CREATE TABLE IF NOT EXISTS files (
        name BLOB PRIMARY KEY, size INTEGER, modified INTEGER, changed INTEGER, inode TEXT, sha256 TEXT
    ) WITHOUT ROWID""",
    """CREATE TABLE IF NOT EXISTS stages (
        object TEXT, camera TEXT, setup TEXT, stage TEXT, state TEXT, record TEXT, sha256 TEXT,
        PRIMARY KEY (object, camera, setup, stage, state)
    )""",
)
PATIENCE_S = 30.0
"""While another build writes."""
OF_THE_DISK = {
    sqlite3.SQLITE_FULL: errno.ENOSPC,
    sqlite3.SQLITE_READONLY: errno.EROFS,
    sqlite3.SQLITE_CANTOPEN: errno.EACCES,
    sqlite3.SQLITE_BUSY: errno.EBUSY,
    sqlite3.SQLITE_NOMEM: errno.ENOMEM,
    sqlite3.SQLITE_IOERR: errno.EIO,
}
"""Errors in spite of which the file is sound, and what the system calls them."""


def read_rows(path: Path, query: str, *values: str) -> list[tuple[Any, ...]]:
    """Return the rows of a query; none where there is no file, or none that can be read.

    What a killed build has left half-written is undone first.
    """
    try:
        with closing(_connect(path, "rw")) as connection:
            return connection.execute(query, values).fetchall()
    except (sqlite3.Error, OSError):
        return []


def write_rows(path: Path, *changes: Change) -> None:
    """Execute statements, each with some rows, all or none; they are on the disk then, or WriteRefused is raised.

    A file that is damaged, or has other tables, is made anew with these rows alone.
    """
    with refusing(path, None):
        files.make_folder(path.parent)
        files.fault("write", path)
        try:
            _commit(path, changes)
        except sqlite3.DatabaseError as error:
            if number := OF_THE_DISK.get(error.sqlite_errorcode & 0xFF):
                raise OSError(number, os.strerror(number), str(path)) from error
            for suffix in ("", "-journal"):
                Path(f"{path}{suffix}").unlink(missing_ok=True)
            _commit(path, changes)


def _commit(path: Path, changes: Iterable[Change]) -> None:
    with closing(_connect(path, "rwc")) as connection, connection:
        for table in TABLES:
            connection.execute(table)
        for statement, rows in changes:
            connection.executemany(statement, rows)
        files.fault("fsync", path)


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open a file in a mode of sqlite's: "rw", or "rwc" to make it where there is none."""
    if not _has_locks(path.parent):
        # What another build is writing looks there as if a killed one had left it: who only reads leaves it alone.
        mode = f"{'ro' if mode == 'rw' else mode}&nolock=1"
    uri = f"{path.absolute().as_uri()}?mode={mode}"
    connection = sqlite3.connect(uri, uri=True, timeout=PATIENCE_S)
    connection.text_factory = lambda text: text.decode(errors="replace")  # its hash shows it
    connection.execute("PRAGMA synchronous = EXTRA")  # the folder, too, when the journal is gone
    return connection


def _has_locks(folder: Path) -> bool:
    """Return whether files can be locked there: on some file systems of clusters they cannot."""
    if os.name == "nt":
        return True
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        return take(descriptor, shared=True) is not None
    finally:
        os.close(descriptor)

"""A published database: written whole, and opened as labelled arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.database.reader import Database


def open(path: str | Path) -> Database:
    """Open a database: ``open("icons")["icon1"]["lctf-vis"]`` is a lazy array (y, x, band).

    Raises
    ------
    DatabaseRefused
        Where there is no database.
    """
    from levkas.database.reader import Database

    return Database(path)

"""A published database: written whole, and opened as labelled arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.database.reader import Database


def open(path: str | Path) -> Database:
    """Open a database: ``open("icons")["icon1"]["lctf-vis"]`` is a lazy array (y, x, band).

    `path` is the folder of a database or of the campaign that it was built from, or its address (``https://``, ``s3://``).
    Returns a mapping of objects to cameras, or (camera, setup), to `xarray.DataArray` of float32, reflectance or counts as the
    attribute `quantity` says; pixels are read when they are used. ``array.levkas`` has what lies beside them: see
    `levkas.database.accessor.LayerAccessor`. Raises DatabaseRefused, ``E_UNREADABLE``, where there is no database.

    >>> database = open(plates / "database")
    >>> layer = database["one"]["infrared"]
    >>> layer.dims, layer.shape, layer.levkas.flags.dtype.name
    (('y', 'x', 'band'), (200, 240, 1), 'uint8')
    """
    from levkas.database.reader import Database

    return Database(path)

"""Arrays of a remote database, as Zarr requests them."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

from zarr.abc.store import OffsetByteRequest, RangeByteRequest, SuffixByteRequest
from zarr.storage import ObjectStore

if TYPE_CHECKING:
    from zarr.abc.store import ByteRequest
    from zarr.core.buffer import Buffer, BufferPrototype

    from levkas.database.remote import RemotePath


class RemoteArrayStore(ObjectStore[Any]):
    """One array: its description comes from the index, its shards by blocks of bytes.

    A missing shard raises FileNotFoundError: Zarr would take it for one that was never written, and
    give the fill value.
    """

    def __init__(self, path: RemotePath) -> None:
        super().__init__(path.store.objects, read_only=True)
        self._path = path

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return a key's bytes; None for a description that is not there."""
        data = await asyncio.to_thread(self._read, key, byte_range)
        return None if data is None else prototype.buffer.from_bytes(data)

    def _read(self, key: str, wanted: ByteRequest | None) -> bytes | None:
        if key == "zarr.json":
            record = self._path.describe()
            return None if record is None else json.dumps(record).encode()
        place = self._path / key
        store, name = place.store, place.pure.as_posix()
        if isinstance(wanted, SuffixByteRequest):
            return store.read_end(name, wanted.suffix)
        if isinstance(wanted, RangeByteRequest):
            return store.read(name, wanted.start, wanted.end)
        size = store.size(name)
        return store.read(name, wanted.offset if isinstance(wanted, OffsetByteRequest) else 0, size)

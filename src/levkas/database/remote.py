"""Databases on web servers and S3-like stores, read by ranges of bytes: obstore asks, and asks again where an answer is cut off."""

from __future__ import annotations

import io
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import cached_property, total_ordering
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any, BinaryIO, cast
from urllib.parse import urlsplit

from levkas.core.problems import Problem, Refused
from levkas.database.manifest import NAME, read_manifest

SCHEMES = ("s3", "http", "https")
PIECE = 1 << 20
"""Bytes of a request: directories of a TIFF, or one of its strips."""
RETRIES, RETRY_S, TIMEOUT_S = 3, 120, 60
"""How often a request is repeated, and for how long; seconds of a single one."""
THREADS = 16
"""Files that are read at a time: a request waits for the network, not for a core."""
CREDENTIALS = "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile of the AWS tools"


class RemoteRefused(Refused):
    """A server or a store cannot be reached, or does not answer the request."""


def place(path: str | Path) -> Path:
    """Return the path of a folder, or where an address is given, of a database on a server.

    It is a `RemotePath` then, of which all that reads a database needs no more than of a `Path`.

    Raises RemoteRefused where the address is none that is read, or holds a password.

    Examples
    --------
    >>> str(place("s3://museum/icons/") / "catalogue.csv")
    's3://museum/icons/catalogue.csv'
    """
    if isinstance(path, str) and "://" in path:
        return cast(Path, RemotePath(RemoteStore(path)))
    return Path(path) if isinstance(path, str) else path


def is_remote(path: object) -> bool:
    """Whether a path leads to a server."""
    return isinstance(path, RemotePath)


class RemoteStore:
    """Files below one address, ``s3://BUCKET/PATH``, ``https://…`` or ``http://…``."""

    def __init__(self, url: str) -> None:
        try:
            parts = urlsplit(url)
        except ValueError as error:  # brackets that are none of IPv6
            raise _refused("this is not the address of a database", None, str(error)) from None
        if parts.scheme not in SCHEMES or not parts.netloc:
            raise _refused("this is not the address of a database", None, parts.scheme or "nothing")
        if "@" in parts.netloc or parts.query or parts.fragment:
            fix = f"Remove it; give the credentials of a store in {CREDENTIALS}."
            place = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
            raise _refused("an address must not contain a password or a query", place, fix=fix)
        self.url = url.rstrip("/")
        self._sizes: dict[str, int] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.url,)

    def __deepcopy__(self, memo: dict[int, Any]) -> RemoteStore:
        return self  # what was read already serves the copies that xarray makes

    @cached_property
    def objects(self) -> Any:
        """The store, as `obstore` opens it."""
        try:
            from obstore.store import from_url

            credentials = _credentials() if self.url.startswith("s3:") else {}
        except ImportError as error:
            why = "reading from a server needs obstore and boto3, which are not installed"
            fix = "Run: pip install 'levkas[remote]'"
            problem = Problem("E_MISSING", why, self.url, found=f"no {error.name}", fix=fix)
            raise RemoteRefused(problem) from None
        options: dict[str, Any] = {
            "client_options": {"allow_http": True, "timeout": timedelta(seconds=TIMEOUT_S)},
            "retry_config": {"max_retries": RETRIES, "retry_timeout": timedelta(seconds=RETRY_S)},
        }
        return from_url(self.url, **options, **credentials)

    def size(self, name: str) -> int:
        """Return the bytes of a file; raises FileNotFoundError."""
        if name not in self._sizes:
            with self.requesting(name):
                self._sizes[name] = int(self.objects.head(name)["size"])
        return self._sizes[name]

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Return a range of bytes, which ends with the file; raises FileNotFoundError."""
        stop = min(stop, self.size(name))
        if start >= stop:
            return b""
        with self.requesting(name):
            data = bytes(self.objects.get_range(name, start=start, end=stop))
            if len(data) != stop - start:
                raise EOFError(f"{len(data)} bytes of {stop - start}")
        return data

    @contextmanager
    def requesting(self, name: str) -> Iterator[None]:
        """Turn what requests of a block lead to into FileNotFoundError, or a refusal without the server's own words, which may hold a key."""
        try:
            yield
        except Exception as error:
            lost = type(error).__module__.startswith("obstore")
            if not (lost or isinstance(error, FileNotFoundError | EOFError)):
                raise
            place = f"{self.url}/{name}".rstrip("/")
            if isinstance(error, FileNotFoundError) or _status(error) == "404":
                raise FileNotFoundError(place) from None
            why, fix = _reason(error)
            raise _refused(why, place, type(error).__name__, fix=fix) from None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All files, as the manifest lists them."""
        manifest = RemotePath(self, PurePosixPath(NAME))
        if not manifest.is_file():
            why = "a server lists no files, and this database has no manifest"
            raise _refused(why, str(manifest), fix="Copy the database, or build it again.")
        found = read_manifest(cast(Path, manifest))
        if found.problems:
            raise RemoteRefused(*found.problems)
        return (*found.files, NAME)


@total_ordering
class RemotePath:
    """A file or folder of a remote database, with the part of `pathlib.Path` that reading needs."""

    def __init__(self, store: RemoteStore, pure: PurePosixPath | None = None) -> None:
        self.store, self.pure = store, pure or PurePosixPath()

    def __str__(self) -> str:
        return f"{self.store.url}/{self.key}".rstrip("/")

    def __repr__(self) -> str:
        return f"RemotePath({str(self)!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RemotePath) and str(self) == str(other)

    def __lt__(self, other: RemotePath) -> bool:
        return str(self) < str(other)

    def __hash__(self) -> int:
        return hash(str(self))

    def __truediv__(self, name: str | PurePosixPath) -> RemotePath:
        return RemotePath(self.store, self.pure / name)

    @property
    def key(self) -> str:
        """Its name in the store; empty for the database itself."""
        return "" if self.pure == PurePosixPath() else self.pure.as_posix()

    @property
    def name(self) -> str:
        """Last part of the address."""
        return PurePosixPath(str(self)).name

    @property
    def stem(self) -> str:
        """Last part without its ending."""
        return PurePosixPath(self.name).stem

    @property
    def suffix(self) -> str:
        """Ending of the last part."""
        return PurePosixPath(self.name).suffix

    @property
    def parent(self) -> RemotePath:
        """Folder that holds it; of the database that itself."""
        return RemotePath(self.store, self.pure.parent)

    def with_name(self, name: str) -> RemotePath:
        """Return a file or folder beside; raises ValueError for the database itself."""
        return RemotePath(self.store, self.pure.with_name(name))

    def relative_to(self, other: RemotePath) -> PurePosixPath:
        """Return the way from another folder of the database."""
        return self.pure.relative_to(other.pure)

    def stat(self) -> Any:
        """Return size and mode of a file; raises FileNotFoundError."""
        return SimpleNamespace(st_size=self.store.size(self.key), st_mode=stat.S_IFREG)

    def is_file(self) -> bool:
        """Whether the server has such a file; raises RemoteRefused where it does not answer."""
        try:
            return bool(self.key) and self.stat().st_size >= 0
        except FileNotFoundError:
            return False

    exists = is_file

    def is_dir(self) -> bool:
        """Whether the server has files below this name."""
        return next(self.names(), None) is not None

    def is_symlink(self) -> bool:
        """No file of a server is a link."""
        return False

    def glob(self, pattern: str) -> Iterator[RemotePath]:
        """Yield the files, not the folders, that a pattern without ``**`` finds."""
        count = len(PurePosixPath(pattern).parts)
        for name in self.names():
            found = PurePosixPath(name)
            if len(found.parts) == count and found.match(pattern):
                yield self / name

    def names(self) -> Iterator[str]:
        """Yield the names of all files below, relative to it."""
        above = f"{self.key}/" if self.key else ""
        return (n.removeprefix(above) for n in self.store.names if n.startswith(above))

    def read_bytes(self) -> bytes:
        """Return all bytes of a file."""
        return self.store.read(self.key, 0, self.stat().st_size)

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open a file for reading."""
        if mode != "rb":
            raise ValueError(f"a remote file is opened as 'rb', not {mode!r}")
        return cast(BinaryIO, io.BufferedReader(_RemoteFile(self.store, self.key), PIECE))


class _RemoteFile(io.RawIOBase):
    """A file of a store, for `io.BufferedReader`; raises FileNotFoundError."""

    def __init__(self, store: RemoteStore, key: str) -> None:
        self._store, self._key, self._at = store, key, 0
        self._size = store.size(key)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._size}[whence]
        return self._at

    def readinto(self, buffer: Any) -> int:
        data = self._store.read(self._key, self._at, self._at + len(buffer))
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)


def zarr_store(path: RemotePath) -> Any:
    """Return the store of a database as Zarr reads it; a shard that is missing is refused, and no fill value."""
    from zarr.storage import ObjectStore

    class WholeStore(ObjectStore[Any]):
        async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
            found = await super().get(key, prototype, byte_range)
            if found is None and not key.endswith("zarr.json"):
                problem = Problem(
                    "E_TRUNCATED", "a part of the layer is missing", f"{path.store.url}/{key}"
                )
                raise RemoteRefused(problem)
            return found

    return WholeStore(path.store.objects, read_only=True)


def _credentials() -> dict[str, Any]:
    """Return what requests to an S3-like store carry: the credentials of the AWS tools, or none."""
    import boto3
    from obstore.auth.boto3 import Boto3CredentialProvider

    session, config = boto3.Session(), {"checksum_algorithm": "SHA256"}
    if session.get_credentials() is None:
        return {"config": config | {"skip_signature": True}}
    return {"config": config, "credential_provider": Boto3CredentialProvider(session)}


def _status(error: Exception) -> str:
    found = re.search(r"status code: (\d{3})", str(error))
    return found[1] if found else ""


def _reason(error: Exception) -> tuple[str, str]:
    """Return what is wrong, and what to do about it."""
    name, status = type(error).__name__, _status(error)
    if name.startswith(("PermissionDenied", "Unauthenticated")) or status in ("401", "403"):
        return "the server does not allow this", f"Check the address; set {CREDENTIALS}."
    if name.startswith("NotSupported"):
        fix = "Use a server with range requests (nginx, Apache, S3), or copy the database."
        return "the server does not support range requests", fix
    return "the server cannot be reached, or does not answer", "Check the address and the network."


def _refused(why: str, place: str | None, found: str | None = None, *, fix: str = "") -> Refused:
    expected = ", ".join(f"{scheme}://…" for scheme in SCHEMES)
    return RemoteRefused(Problem("E_REMOTE", why, place, None, found, expected, fix or None))

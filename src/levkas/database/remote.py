"""Databases on web servers and S3-like stores, read by ranges of bytes: obstore asks, and asks again where an answer is cut off."""

from __future__ import annotations

import io
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import cached_property
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any, BinaryIO, cast

from levkas.core.problems import Problem, Refused
from levkas.database.manifest import NAME, read_manifest

ADDRESS = re.compile(r"(s3|https?)://[^@/?#\s]+(/[^?#]*)?")
"""Without a password and a query."""
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
    """Return the path of a folder, or of an address, a `RemotePath`; raises RemoteRefused where that is none, or holds a password.

    >>> str(place("s3://museum/icons/") / "catalogue.csv")
    's3://museum/icons/catalogue.csv'
    """
    if not isinstance(path, str) or "://" not in path:
        return Path(path) if isinstance(path, str) else path
    if not ADDRESS.fullmatch(path):
        why, fix = "this is not the address of a database", f"Give credentials in {CREDENTIALS}."
        raise _refused(why, None, path.partition("://")[0], fix)
    root = RemotePath(path)
    _STORES[root] = RemoteStore(str(root))
    return cast(Path, root)


def is_remote(path: object) -> bool:
    """Whether a path leads to a server."""
    return isinstance(path, RemotePath)


class RemoteStore:
    """Files below one address, ``s3://BUCKET/PATH``, ``https://…`` or ``http://…``."""

    def __init__(self, url: str) -> None:
        self.url, self._sizes = url, dict[str, int]()

    @cached_property
    def objects(self) -> Any:
        """The store, as `obstore` opens it; requests to S3 carry the credentials of the AWS tools, or none."""
        client = {"allow_http": True, "timeout": timedelta(seconds=TIMEOUT_S)}
        retry = {"max_retries": RETRIES, "retry_timeout": timedelta(seconds=RETRY_S)}
        options: dict[str, Any] = {"client_options": client, "retry_config": retry}
        try:
            from obstore.store import from_url

            if self.url.startswith("s3:"):
                import boto3
                from obstore.auth.boto3 import Boto3CredentialProvider

                session, config = boto3.Session(), {"checksum_algorithm": "SHA256"}
                if session.get_credentials() is None:
                    options["config"] = config | {"skip_signature": True}
                else:
                    provider = Boto3CredentialProvider(session)
                    options |= {"config": config, "credential_provider": provider}
        except ImportError as error:
            why = "reading from a server needs obstore and boto3, which are not installed"
            found, fix = f"no {error.name}", "Run: pip install 'levkas[remote]'"
            raise RemoteRefused(Problem("E_MISSING", why, self.url, found=found, fix=fix)) from None
        return from_url(self.url, **options)

    def size(self, name: str) -> int:
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
            shown, kind = f"{self.url}/{name}".rstrip("/"), type(error).__name__
            status = (re.findall(r"status code: (\d{3})", str(error)) or [""])[0]
            if isinstance(error, FileNotFoundError) or status == "404":
                raise FileNotFoundError(shown) from None
            why, fix = "the server does not answer", f"Check the address; set {CREDENTIALS}."
            if status in ("401", "403") or kind.startswith(("Permission", "Unauthenticated")):
                why = "the server does not allow this"
            elif kind.startswith("NotSupported"):
                why, fix = "the server does not support range requests", "Copy the database."
            raise _refused(why, shown, kind, fix) from None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All files, as the manifest lists them."""
        manifest = RemotePath(self.url) / NAME
        if not manifest.is_file():
            why = "this database has no manifest, by which a server's files are known"
            raise _refused(why, str(manifest), "no manifest", "Build the database again.")
        found = read_manifest(cast(Path, manifest))
        if found.problems:
            raise RemoteRefused(*found.problems)
        return (*found.files, NAME)


class RemotePath(PurePosixPath):
    """A file or folder of a remote database, with the part of `pathlib.Path` that reading needs."""

    __slots__ = ()

    def __str__(self) -> str:
        return super().__str__().replace(":/", "://", 1)

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self.store.url, self.key)

    @property
    def store(self) -> RemoteStore:
        """What it is read from: the address above it that was opened last."""
        return next(_STORES[above] for above in (self, *self.parents) if above in _STORES)

    @property
    def key(self) -> str:
        """Its name in the store; empty for the database itself."""
        return str(self)[len(self.store.url) + 1 :]

    def stat(self) -> Any:
        return SimpleNamespace(st_size=self.store.size(self.key), st_mode=stat.S_IFREG)

    def is_file(self) -> bool:
        try:
            return bool(self.key) and self.stat().st_size >= 0
        except FileNotFoundError:
            return False

    exists = is_file

    def is_dir(self) -> bool:
        return next(self.names(), None) is not None

    def glob(self, pattern: str) -> Iterator[RemotePath]:
        """Yield the files, not the folders, that a pattern without ``**`` finds."""
        count = pattern.count("/")
        found = (name for name in self.names() if name.count("/") == count)
        return (self / name for name in found if PurePosixPath(name).match(pattern))

    def names(self) -> Iterator[str]:
        above = f"{self.key}/" if self.key else ""
        return (n.removeprefix(above) for n in self.store.names if n.startswith(above))

    def read_bytes(self) -> bytes:
        return self.store.read(self.key, 0, self.stat().st_size)

    def open(self, mode: str = "rb", buffering: int = PIECE) -> BinaryIO:
        return cast(BinaryIO, io.BufferedReader(_RemoteFile(self), PIECE))


_STORES: dict[RemotePath, RemoteStore] = {}


def _restored(url: str, key: str) -> RemotePath:
    root = RemotePath(url)
    return (root if root in _STORES else cast(RemotePath, place(url))) / key


class _RemoteFile(io.RawIOBase):
    """A file of a store, for `io.BufferedReader`; raises FileNotFoundError."""

    def __init__(self, path: RemotePath) -> None:
        self._store, self._key, self._at = path.store, path.key, 0
        self._size = self._store.size(self._key)

    def readable(self) -> bool:
        return True

    seekable = readable

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + (0, self._at, self._size)[whence]
        return self._at

    def readinto(self, buffer: Any) -> int:
        data = self._store.read(self._key, self._at, self._at + len(buffer))
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)


def _refused(why: str, place: str | None, found: str, fix: str) -> RemoteRefused:
    expected = "s3://…, https://… or http://…, without a password and a query"
    return RemoteRefused(Problem("E_REMOTE", why, place, None, found, expected, fix))

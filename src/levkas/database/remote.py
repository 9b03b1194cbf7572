"""Databases on web servers and S3-like stores, read by ranges of bytes.

A file is met with one request, which brings its size and its first or last bytes; more of it comes
in blocks, which are kept. Every answer has the requested length, or is requested again, and is of the file
that was met first: by its size and its tag, or its time where the server gives no tag.
"""

from __future__ import annotations

import io
import os
import re
import stat
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import cached_property, total_ordering
from itertools import islice
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any, BinaryIO, TypeVar, cast
from urllib.parse import urlsplit

from levkas.core.problems import Problem, Refused
from levkas.core.text import read_json
from levkas.database.manifest import NAME, read_manifest

SCHEMES = ("s3", "http", "https")
PIECE = 128 << 10
"""Bytes of the first answer: the whole of most records, the index of any shard."""
BLOCK = 8 << 20
"""Bytes of a request; holds the chunks of one spectrum, which lie within 6 MB of a shard."""
MOST_PIECES, MOST_BLOCKS = 256, 16
"""Pieces and blocks that are kept: 160 MiB at most."""
ATTEMPTS, PAUSE_S = 4, 0.2
"""For an answer that is cut off or comes with an error 5xx; each pause is twice the one before."""
TIMEOUT_S = 60
"""Of a request, and of all its repetitions but the last."""
PATIENCE_S, SECONDS_A_REQUEST, LEAST_RATE = 120.0, 5.0, 10_000
"""Seconds that a server may take for all answers together: so many, and so many for each, and bytes over bytes per
second. A server that sends byte by byte ends there; half of each refuses a satellite link, twice of each is slower."""
MOST_NAMES = 4_000_000
"""Files that a store may list; some 1 GB of names."""
THREADS = 16
"""Files that are read at a time: a request waits for the network, not for a core."""
CREDENTIALS = "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile of the AWS tools"

T = TypeVar("T")


class RemoteRefused(Refused):
    """A server or a store cannot be reached, or does not answer the request."""


def place(path: str | Path) -> Path:
    """Return the path of a folder, or where an address is given, of a database on a server.

    Returns
    -------
    path : Path
        Or a `RemotePath`, of which all that reads a database needs no more than of a `Path`.

    Raises
    ------
    RemoteRefused
        Where the address is none that is read, or holds a password.

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


@dataclass(frozen=True)
class Piece:
    """A part of a file, its first byte's place, and the size of the whole."""

    size: int
    start: int
    data: bytes


class RemoteStore:
    """Files below one address.

    Parameters
    ----------
    url : str
        ``s3://BUCKET/PATH``, ``https://…`` or ``http://…``.
    """

    def __init__(self, url: str) -> None:
        try:
            parts = urlsplit(url)
        except ValueError as error:  # brackets that are none of IPv6
            raise _refused("this is not the address of a database", None, str(error)) from None
        if parts.scheme not in SCHEMES or not parts.netloc:
            found, expected = parts.scheme or "nothing", ", ".join(f"{s}://…" for s in SCHEMES)
            raise _refused("this is not the address of a database", None, found, expected=expected)
        if "@" in parts.netloc or parts.query or parts.fragment:
            fix = f"Remove it; give the credentials of a store in {CREDENTIALS}."
            place = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
            raise _refused("an address must not contain a password or a query", place, fix=fix)
        self.url = url.rstrip("/")
        self._lock = threading.Lock()
        self._pieces: OrderedDict[str, Piece] = OrderedDict()
        self._blocks: OrderedDict[tuple[str, int], bytes] = OrderedDict()
        self._states: dict[str, tuple[int, str]] = {}
        self._waited_s, self._requests, self._received = 0.0, 0, 0

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.url,), {"_states": dict(self._states)}

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
            "retry_config": {"max_retries": 0},  # `again` does it, and compares what comes then
        }
        return from_url(self.url, **options, **credentials)

    def size(self, name: str) -> int:
        """Return the bytes of a file; raises FileNotFoundError."""
        return self._piece(name).size

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Return a range of bytes, which ends with the file; raises FileNotFoundError."""
        piece = self._piece(name)
        start, stop = min(start, piece.size), min(stop, piece.size)
        if piece.start <= start and stop <= piece.start + len(piece.data):
            return piece.data[start - piece.start : stop - piece.start]
        if stop - start > BLOCK:
            return self._fetch(name, (start, stop)).data
        first, last = start // BLOCK, (stop - 1) // BLOCK
        data = b"".join(self._block(name, number, piece) for number in range(first, last + 1))
        return data[start - first * BLOCK : stop - first * BLOCK]

    def read_end(self, name: str, count: int) -> bytes:
        """Return the last bytes of a file; raises FileNotFoundError."""
        with self._lock:
            known = self._pieces.get(name)
        if known is None:
            known = self._keep(name, self._fetch(name, {"suffix": max(count, PIECE)}))
        return self.read(name, max(0, known.size - count), known.size)

    def names(self, prefix: str = "") -> Iterator[str]:
        """Yield the files below a folder: as the store lists them, else as the manifest does."""
        if self.url.startswith("s3:"):
            with suppress(FileNotFoundError):
                yield from (name for name, _ in self.sizes(prefix))
            return
        if self._manifest.problems:
            raise RemoteRefused(*self._manifest.problems)
        for name in (*self._manifest.files, NAME):
            if name.startswith(f"{prefix}/" if prefix else ""):
                yield name

    def sizes(self, prefix: str = "") -> list[tuple[str, int]]:
        """Return name and bytes of the files below a folder, as a store lists them.

        Raises FileNotFoundError where there is no such bucket.
        """

        def listed() -> list[tuple[str, int]]:
            batches = self.objects.list(prefix=prefix or None)
            files = (file for batch in batches for file in batch)
            found = [(str(f["path"]), int(f["size"])) for f in islice(files, MOST_NAMES + 1)]
            if len(found) > MOST_NAMES:
                why, expected = "the store lists too many files", f"at most {MOST_NAMES}"
                raise _refused(why, f"{self.url}/{prefix}".rstrip("/"), expected=expected)
            return found

        return self.again(prefix, listed)

    def again(self, name: str, work: Callable[[], T]) -> T:
        """Return what a request brings, which is repeated where the answer is cut off.

        Raises
        ------
        FileNotFoundError
        RemoteRefused
            Without the words of the server's answer, which may hold a key.
        """
        started = time.monotonic()
        for attempt in range(1, ATTEMPTS + 1):
            self._require_pace()
            began = time.monotonic()
            try:
                return work()
            except Refused:
                raise
            except Exception as error:
                place = f"{self.url}/{name}".rstrip("/")
                if isinstance(error, FileNotFoundError) or _status(error) == "404":
                    raise FileNotFoundError(place) from None
                late = time.monotonic() - started > TIMEOUT_S
                if attempt == ATTEMPTS or late or _is_final(error):
                    why, fix = _reason(error)
                    raise _refused(why, place, type(error).__name__, fix=fix) from None
            finally:
                with self._lock:
                    self._waited_s += time.monotonic() - began
                    self._requests += 1
            time.sleep(PAUSE_S * 2 ** (attempt - 1))
        raise AssertionError

    def _require_pace(self) -> None:
        """Refuse a server that has taken too long for what it sent, all answers together."""
        with self._lock:
            waited, received = self._waited_s, self._received
            most = PATIENCE_S + SECONDS_A_REQUEST * self._requests + received / LEAST_RATE
        if waited > most:
            found = f"{received} bytes in {waited:.0f} s"
            expected = f"at least {LEAST_RATE} bytes a second"
            fix = "Try it again on a faster connection, or copy the database."
            raise _refused("the server is too slow", self.url, found, expected=expected, fix=fix)

    @cached_property
    def _manifest(self) -> Any:
        manifest = RemotePath(self, PurePosixPath(NAME))
        if not manifest.is_file():
            why = "a web server lists no files, and this database has no manifest"
            raise _refused(why, str(manifest), fix="Copy the database, or publish it with Levkas.")
        return read_manifest(cast(Path, manifest))

    def _piece(self, name: str) -> Piece:
        with self._lock:
            if name in self._pieces:
                self._pieces.move_to_end(name)
                return self._pieces[name]
        return self._keep(name, self._fetch(name, (0, PIECE)))

    def _keep(self, name: str, piece: Piece) -> Piece:
        with self._lock:
            self._pieces[name] = piece
            while len(self._pieces) > MOST_PIECES:
                self._pieces.popitem(last=False)
        return piece

    def _block(self, name: str, number: int, piece: Piece) -> bytes:
        key = name, number
        with self._lock:
            if key in self._blocks:
                self._blocks.move_to_end(key)
                return self._blocks[key]
        span = number * BLOCK, min((number + 1) * BLOCK, piece.size)
        data = self._fetch(name, span).data
        with self._lock:
            self._blocks[key] = data
            while len(self._blocks) > MOST_BLOCKS:
                self._blocks.popitem(last=False)
        return data

    def _fetch(self, name: str, span: tuple[int, int] | dict[str, int]) -> Piece:
        """Return a range, of the file as it was when it was met, in the length that it must have."""

        def fetched() -> Piece:
            try:
                answer = self.objects.get(name, options={"range": span})
            except Exception as error:
                if _status(error) != "416":
                    raise
                self._require_same(name, (0, ""))  # the file is empty
                return Piece(0, 0, b"")
            size, tag = int(answer.meta["size"]), answer.meta["e_tag"]
            self._require_same(name, (size, tag or str(answer.meta["last_modified"])))
            data = bytes(answer.bytes())
            wanted = _span_of(span, size)
            if answer.range != wanted or len(data) != wanted[1] - wanted[0]:
                raise EOFError(f"{len(data)} bytes of {wanted[1] - wanted[0]}")
            with self._lock:
                self._received += len(data)
            return Piece(size, wanted[0], data)

        return self.again(name, fetched)

    def _require_same(self, name: str, state: tuple[int, str]) -> None:
        """Refuse an answer from another file than was met: of another size, tag, or time where there is no tag."""
        with self._lock:
            known = self._states.setdefault(name, state)
        if known != state:
            why, fix = "the file was replaced while it was read", "Open the database again."
            raise _refused(why, f"{self.url}/{name}", str(state), expected=str(known), fix=fix)


@total_ordering
class RemotePath:
    """A file or folder of a remote database, with the part of `pathlib.Path` that reading needs."""

    def __init__(self, store: RemoteStore, pure: PurePosixPath | None = None) -> None:
        self.store, self.pure = store, pure or PurePosixPath()

    def __str__(self) -> str:
        return f"{self.store.url}/{self._key}".rstrip("/")

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
    def _key(self) -> str:
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

    def joinpath(self, *names: str) -> RemotePath:
        """Return a file or folder below."""
        return RemotePath(self.store, self.pure.joinpath(*names))

    def with_name(self, name: str) -> RemotePath:
        """Return a file or folder beside; raises ValueError for the database itself."""
        return RemotePath(self.store, self.pure.with_name(name))

    def relative_to(self, other: RemotePath) -> PurePosixPath:
        """Return the way from another folder of the database."""
        return self.pure.relative_to(other.pure)

    def stat(self) -> Any:
        """Return size and mode of a file; raises FileNotFoundError."""
        return SimpleNamespace(st_size=self.store.size(self._key), st_mode=stat.S_IFREG)

    def is_file(self) -> bool:
        """Whether the server has such a file; raises RemoteRefused where it does not answer."""
        try:
            return bool(self._key) and self.stat().st_size >= 0
        except FileNotFoundError:
            return False

    exists = is_file

    def is_dir(self) -> bool:
        """Whether the server has files below this name."""
        return next(self.store.names(self._key), None) is not None

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
        start = len(self._key) + 1 if self._key else 0
        return (name[start:] for name in self.store.names(self._key))

    def iterdir(self) -> Iterator[RemotePath]:
        """Yield the files and folders in a folder."""
        return (self / name for name in dict.fromkeys(n.split("/")[0] for n in self.names()))

    def read_bytes(self) -> bytes:
        """Return all bytes of a file."""
        return self.store.read(self._key, 0, self.stat().st_size)

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open a file for reading."""
        if mode != "rb":
            raise ValueError(f"a remote file is opened as 'rb', not {mode!r}")
        return cast(BinaryIO, io.BufferedReader(_RemoteFile(self.store, self._key), 1 << 16))

    def describe(self) -> dict[str, Any] | None:
        """Return the Zarr metadata of a group or array, from the store's index where it has one."""
        root, found, member = str(self.pure).partition(".zarr/")
        with suppress(FileNotFoundError):
            if found:
                index = self.store_index(f"{root}.zarr")
                if member in index:
                    return cast("dict[str, Any]", index[member])
            if (self / "zarr.json").is_file():
                return read_json(cast(Path, self / "zarr.json"))
        return None

    def store_index(self, root: str) -> dict[str, Any]:
        """Return the members of a Zarr store, as its index describes them; {} where it has none."""
        indices: dict[str, dict[str, Any]] = self.store.__dict__.setdefault("_indices", {})
        if root not in indices:
            place = RemotePath(self.store, PurePosixPath(root) / "zarr.json")
            record = read_json(cast(Path, place)) if place.is_file() else {}
            indices[root] = dict((record.get("consolidated_metadata") or {}).get("metadata") or {})
        return indices[root]


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


def _credentials() -> dict[str, Any]:
    """Return what requests to an S3-like store carry: the credentials of the AWS tools, or none."""
    import boto3
    from obstore.auth.boto3 import Boto3CredentialProvider

    session, config = boto3.Session(), {"checksum_algorithm": "SHA256"}
    if session.get_credentials() is None:
        return {"config": config | {"skip_signature": True}}
    return {"config": config, "credential_provider": Boto3CredentialProvider(session)}


def _span_of(span: tuple[int, int] | dict[str, int], size: int) -> tuple[int, int]:
    if isinstance(span, dict):
        return max(0, size - span["suffix"]), size
    return span[0], min(span[1], size)


def _status(error: Exception) -> str:
    found = re.search(r"status code: (\d{3})", str(error))
    return found[1] if found else ""


def _is_final(error: Exception) -> bool:
    """Whether asking again is of no use."""
    if type(error).__name__.startswith(("PermissionDenied", "Unauthenticated", "NotSupported")):
        return True
    return _status(error).startswith("4") and _status(error) not in ("408", "429")


def _reason(error: Exception) -> tuple[str, str]:
    """Return what is wrong, and what to do about it."""
    name, status = type(error).__name__, _status(error)
    if name.startswith(("PermissionDenied", "Unauthenticated")) or status in ("401", "403"):
        return "the server does not allow this", f"Check the address; set {CREDENTIALS}."
    if name.startswith("NotSupported"):
        fix = "Use a server with range requests (nginx, Apache, S3), or copy the database."
        return "the server does not support range requests", fix
    if status:
        return f"the server answers with an error {status}", "Check the address, or try it again."
    if "kind: Timeout" in str(error):
        fix = "Try it again on a faster connection, or copy the database."
        return f"the server did not answer within {TIMEOUT_S:g} s", fix
    if "kind: Connect" in str(error):
        return "the server cannot be reached", "Check the address and the network."
    return "the server's answer is truncated or missing", "Check the network; try it again."


def _refused(
    why: str, place: str | None, found: str | None = None, *, expected: str = "", fix: str = ""
) -> RemoteRefused:
    return RemoteRefused(
        Problem("E_REMOTE", why, place, None, found, expected or None, fix or None)
    )

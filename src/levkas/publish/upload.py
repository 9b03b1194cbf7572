"""A publication sent to an S3-like store: whole files with their checksums, the manifest last.

Every object bears the SHA-256 of its file in its metadata. By that an upload that was interrupted
goes on where it was, and what Levkas did not send is never replaced.
"""

from __future__ import annotations

import mimetypes
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar, cast

from levkas.core.digests import hash_file
from levkas.core.problems import Problem
from levkas.database.catalogue import NAME as CATALOGUE
from levkas.database.catalogue import DatabaseRefused, read_catalogue
from levkas.database.manifest import NAME, read_manifest
from levkas.database.remote import THREADS, RemoteStore
from levkas.publish.publication import PublishRefused

MARK = "levkas-sha256"
"""Key of an object's metadata."""
T = TypeVar("T")


class UploadTarget:
    """An address that a publication may be sent to.

    Parameters
    ----------
    address : str
        ``s3://BUCKET/PATH``.
    objects : iterable of str
        Those of the database: another one's publication is not replaced.

    Raises
    ------
    RemoteRefused
        Where the store does not answer, or does not allow it.
    PublishRefused
        Where the store has something that Levkas did not send.
    """

    def __init__(self, address: str, objects: Iterable[str] = ()) -> None:
        self.store = RemoteStore(address)
        if not self.store.url.startswith("s3://"):
            raise _not_there(
                address, "it is not the address of an S3 store", "Give s3://BUCKET/PATH."
            )
        try:
            names = [name for name, _ in self.store.sizes()]
        except FileNotFoundError:
            raise _not_there(
                address, "the bucket does not exist", "Create the bucket first."
            ) from None
        with ThreadPoolExecutor(THREADS) as pool:
            self.hashes = dict(zip(names, pool.map(self._hash_there, names), strict=True))
        if strangers := [name for name in names if not self.hashes[name]]:
            why = f"{len(strangers)} files that Levkas did not send, the first: {strangers[0]}"
            raise _not_there(address, why, "Give another path in the bucket.")
        if CATALOGUE in names:
            self._check_objects(set(objects))

    def _check_objects(self, objects: set[str]) -> None:
        try:
            other = {entry.object for entry in read_catalogue(self.store.url)}
        except DatabaseRefused:  # an upload that was interrupted: the next one replaces it
            return
        if objects and other and not objects & other:
            why = f"it holds the publication of {', '.join(sorted(other)[:3])}"
            raise _not_there(self.store.url, why, "Give another path in the bucket.")

    def send(self, folder: Path) -> Iterator[tuple[str, int, int]]:
        """Send what is not there yet, take away what is not published any more, and end with the manifest.

        Parameters
        ----------
        folder : Path
            A publication, whole.

        Yields
        ------
        name, done, total : str, int, int
            Of files, those that were there already among them.

        Raises
        ------
        PublishRefused
            Where a file is not what the manifest says, or not all of it arrived.
        RemoteRefused
            Where the store does not answer; the next call goes on.
        """
        manifest = read_manifest(folder / NAME)
        if manifest.problems:
            raise PublishRefused(*manifest.problems)
        wanted = {name: listed.sha256 for name, listed in manifest.files.items()}
        own = {NAME: hash_file(folder / NAME)}
        missing = [name for name in wanted if self.hashes.get(name) != wanted[name]]
        stale = [name for name in self.hashes if name not in wanted and name != NAME]
        total = len(wanted) + 1
        done = total - 1 - len(missing)
        if not missing and not stale and self.hashes.get(NAME) == own[NAME]:
            yield NAME, total, total
            return
        if NAME in self.hashes:  # what it lists is about to change
            self._delete(NAME)
        for name in stale:
            self._delete(name)
        for name in self._each(missing, lambda name: self._put(folder, name, wanted[name])):
            done += 1
            yield name, done, total
        sizes = {name: listed.size for name, listed in manifest.files.items()}
        wrong = [n for n, size in self.store.sizes() if size != sizes.pop(n, size)] + list(sizes)
        if wrong:
            why = f"{wrong[0]} was not transferred completely"
            raise _not_there(self.store.url, why, "Run the same command to continue.")
        self._put(folder, NAME, own[NAME])
        yield NAME, total, total

    def _each(self, items: list[str], work: Callable[[str], T]) -> Iterator[T]:
        pool = ThreadPoolExecutor(THREADS)
        try:
            yield from pool.map(work, items)
        finally:  # an error or an interrupt does not wait for thousands of files
            pool.shutdown(cancel_futures=True)

    def _hash_there(self, name: str) -> str:
        """Return the SHA-256 that an object bears; "" where it has none."""
        import obstore

        def found() -> str:
            answer = obstore.get(self.store.objects, name, options={"head": True})
            return str(cast("dict[str, Any]", answer.attributes).get(MARK, ""))

        return self.store.again(name, found)

    def _put(self, folder: Path, name: str, sha256: str) -> str:
        """Send a file; the store compares what arrives with a SHA-256 of its own."""
        import obstore

        path = folder / name
        if hash_file(path) != sha256:
            fix = "Run levkas publish again."
            raise PublishRefused(
                Problem("E_DAMAGED", f"{name}: it has changed since", str(path), fix=fix)
            )
        kind, packed = mimetypes.guess_type(name)
        kind = kind if kind and not packed else "application/octet-stream"
        facts = {"Content-Type": kind, MARK: sha256}
        self.store.again(
            name, lambda: obstore.put(self.store.objects, name, path, attributes=facts)
        )
        self.hashes[name] = sha256
        return name

    def _delete(self, name: str) -> None:
        import obstore

        self.store.again(name, lambda: obstore.delete(self.store.objects, name))
        del self.hashes[name]


def _not_there(address: str, why: str, fix: str) -> PublishRefused:
    return PublishRefused(
        Problem(
            "E_UNWRITABLE",
            f"the publication cannot be sent to this address: {why}",
            file=address,
            expected="an empty path, or an earlier publication of this database",
            fix=fix,
        )
    )

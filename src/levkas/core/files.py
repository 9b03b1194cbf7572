"""Atomic writing of files and folders: a final name is taken only by what is whole and synced.

A file is written under a temporary name in its own folder, synced, renamed, and the folder synced. A folder is built
aside under `name.levkas.partial-…`, synced once as a whole, and renamed. What belongs `together` takes its names when all
of it is on the disk. What a killed run leaves behind is never read, and `sweep` takes it away.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import glob
import hashlib
import io
import os
import re
import secrets
import shutil
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core.disk import WriteRefused, refusing, require_space
from levkas.core.json_safe import to_json
from levkas.core.locks import take
from levkas.core.machine import of_libc
from levkas.core.problems import Problem

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

PARTIAL = re.compile(r".*\.partial-[0-9a-f]{8}")
"""Names of what is not finished, by whomever."""
OURS = re.compile(r".*\.levkas\.partial-[0-9a-f]{8}")
"""Those that Levkas gives, and alone takes away."""
DROPPINGS = re.compile(
    r"\._.*|\.(DS_Store|directory)|(eh)?thumbs\.db|desktop\.ini|.*\.(aux\.xml|ovr|qmd|qml|qix|rrd|enp)",
    re.IGNORECASE,
)
"""Names that file browsers (macOS, Windows, KDE) and viewers of pictures (GDAL, QGIS, ArcGIS, ENVI) leave beside what they
show; neither published nor a damage."""
BUFFER_BYTES = 1 << 20
LONGEST_NAME = 200
"""Bytes of a name that stand in its partial name; with ours and eight digits 224."""


def _no_fault(step: str, path: Path) -> None:
    """Do nothing: the fault of every day."""


fault: Callable[[str, Path], None] = _no_fault
"""Called with (step, path) before each step on the disk; a test puts a function here that raises or kills.

The steps: ``open``, ``write``, ``fsync``, ``rename``, ``folder`` (make one), ``sync`` (a folder's entries, or a whole file
system), ``remove``.
"""

_path_check: ContextVar[Callable[[Path], object] | None] = ContextVar("path_check", default=None)


@contextlib.contextmanager
def before_writing(check: Callable[[Path], object]) -> Iterator[None]:
    """Call `check` with the final path of every file and whole folder that this thread writes in the block, before it is.

    What it raises ends the writing; nothing has been touched then.
    """
    token = _path_check.set(check)
    try:
        yield
    finally:
        _path_check.reset(token)


# --- whole files ------------------------------------------------------------------------------


def write_bytes(path: str | Path, data: bytes | bytearray | memoryview) -> None:
    """Write `data` as the whole of `path`, or leave what was there.

    Raises WriteRefused: ``E_UNWRITABLE``, ``E_DISK_FULL`` (with bytes needed and free) or ``E_IO``.
    """
    with replacing(path, bytes_needed=memoryview(data).nbytes) as handle:
        handle.write(data)


def write_changed(path: str | Path, data: bytes) -> None:
    """Write `data` as `write_bytes` does, unless the file says just that already."""
    with contextlib.suppress(OSError):
        if Path(path).read_bytes() == data:
            return
    write_bytes(path, data)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 with its line ends as they are."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: str | Path, record: Any) -> None:
    """Write `record` as `to_json` spells it."""
    write_text(path, to_json(record))


@contextlib.contextmanager
def replacing(path: str | Path, *, bytes_needed: int | None = None) -> Iterator[io.BufferedRandom]:
    """Open a temporary file that becomes `path` when the block ends well; its folder is made where it is missing.

    `bytes_needed` are checked against the free space before anything is written. `handle.name` is the temporary path, for
    libraries that open files themselves. Raises WriteRefused on any failure of the disk; other exceptions of the block pass
    as they are. Either way `path` is what it was and the temporary file is gone.
    """
    path = Path(path)
    with _making(path, bytes_needed) as one, _opened(one, bytes_needed) as handle:
        yield handle
        with refusing(path, bytes_needed):
            handle.flush()
            fault("fsync", path)
            os.fsync(handle.fileno())


@contextlib.contextmanager
def spooling(folder: str | Path, name: str) -> Iterator[io.BufferedRandom]:
    """Open a file for what is needed meanwhile; it bears a partial name and goes with the block; raises as `replacing`."""
    path = Path(folder) / name
    make_folder(path.parent)
    one = _claim(path)
    try:
        with _opened(one, None) as handle:
            yield handle
            handle.raw.discarding = True  # type: ignore[attr-defined]
    finally:
        one.drop()
        one.close()


@contextlib.contextmanager
def publishing(path: str | Path, *, bytes_needed: int | None = None) -> Iterator[Folder]:
    """Build a folder aside that becomes `path`, in place of what was there, when the block ends well; raises as `replacing`.

    The old folder is kept until the new one is whole.
    """
    path = Path(path)
    with _making(path, bytes_needed, folder=True) as one:
        with refusing(path, bytes_needed, only_of=one.partial):
            yield Folder(one.partial, path)
        with refusing(path, bytes_needed):
            fault("sync", path)
            _sync_file_system(one.descriptor)


class Folder:
    """A folder being built under a partial name, `path`.

    What is written here is not synced file by file: the whole folder is, once, before it takes its name. Raises WriteRefused,
    also where a name points outside the folder.
    """

    def __init__(self, path: Path, final: Path) -> None:
        self.path, self.final = path, final

    def write_bytes(self, name: str, data: bytes | bytearray | memoryview) -> None:
        """Write one file of the folder; `name` is relative, with its folders made as needed."""
        self._write(name, [memoryview(data).cast("B")])

    def copy_file(self, source: str | Path, name: str) -> str:
        """Copy a file into the folder and return the SHA-256 of what was read."""
        digest = hashlib.sha256()
        with Path(source).open("rb") as origin:
            blocks = iter(lambda: origin.read(4 * BUFFER_BYTES), b"")
            self._write(name, (digest.update(block) or block for block in blocks))  # type: ignore[func-returns-value]
        return digest.hexdigest()

    def _write(self, name: str, blocks: Iterable[bytes | memoryview]) -> None:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            message = "a name points outside the folder"
            raise WriteRefused(Problem("E_UNWRITABLE", message, str(self.final), found=name))
        target, final = self.path / name, self.final / name
        with refusing(final, None):
            target.parent.mkdir(parents=True, exist_ok=True)
            fault("open", final)
            with target.open("wb", buffering=0) as handle:
                for block in blocks:
                    left = memoryview(block)
                    while left:
                        fault("write", final)
                        left = left[handle.write(left) :]


# --- under a partial name, and then the final one ---------------------------------------------


@dataclass(frozen=True)
class _Partial:
    """A file or a folder that waits for its name; the descriptor holds the lock that keeps `sweep` away."""

    path: Path
    partial: Path
    descriptor: int

    def settle(self) -> None:
        """Take the final name, of whatever stands there; another builder may do so meanwhile: both are whole, the last stays."""
        path, partial = self.path, self.partial
        with refusing(path, None):
            while True:
                fault("rename", path)
                try:
                    partial.replace(path)
                    return
                except OSError as error:
                    folders = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)
                    if error.errno not in folders:
                        raise
                aside = partial
                if not _exchange(partial, path):
                    aside = _partial(path)
                    try:
                        path.rename(aside)
                        partial.rename(path)
                    except FileNotFoundError:
                        continue
                _sync_folder(
                    path.parent
                )  # or a loss of power may undo the exchange, not the removal
                discard(aside)
                return

    def drop(self) -> None:
        if self.partial.is_dir():
            shutil.rmtree(self.partial, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                self.partial.unlink()

    def close(self) -> None:
        os.close(self.descriptor)


def _claim(path: Path, bytes_needed: int | None = None, *, folder: bool = False) -> _Partial:
    """Make an empty partial file or folder, and lock it."""
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    with refusing(path, bytes_needed):
        if not folder and path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "a folder has this name", str(path))
        while True:
            fault("folder" if folder else "open", path)
            partial = _partial(path)
            if folder:
                partial.mkdir()
            descriptor = os.open(partial, os.O_RDONLY if folder else flags, 0o666)
            take(descriptor)  # a file system without locks has nothing swept either
            # A sweep may have come before this lock: then it is made anew.
            with contextlib.suppress(FileNotFoundError):
                if partial.stat().st_ino == os.fstat(descriptor).st_ino:
                    return _Partial(path, partial, descriptor)
            os.close(descriptor)


@contextlib.contextmanager
def _making(path: Path, bytes_needed: int | None, *, folder: bool = False) -> Iterator[_Partial]:
    """Make what takes its name when the block ends well, or waits for that of `together`."""
    if (check := _path_check.get()) is not None:
        check(path)
    make_folder(path.parent)
    if bytes_needed is not None:
        require_space(path.parent, bytes_needed, path=path)
    # What stands in a folder that is partial itself needs no patience.
    within = any(PARTIAL.fullmatch(part) for part in path.parent.parts)
    waiting = None if within else _waiting.get()
    one = _claim(path, bytes_needed, folder=folder)
    try:
        yield one
        if waiting is not None:
            waiting.append(one)
            return
        one.settle()
    except BaseException:
        one.drop()
        raise
    finally:
        if waiting is None or one not in waiting:
            one.close()
    _sync_folder(path.parent)


class _Watched(io.FileIO):
    """A file that announces its writes and turns their failures into refusals."""

    def __init__(self, one: _Partial, bytes_needed: int | None) -> None:
        super().__init__(one.descriptor, "r+b", closefd=False)
        self.final, self.bytes_needed, self.discarding = one.path, bytes_needed, False
        self.name = str(one.partial)

    def write(self, data: Any) -> int:
        if self.discarding:
            return memoryview(data).nbytes
        with refusing(self.final, self.bytes_needed):
            fault("write", self.final)
            return super().write(data)


@contextlib.contextmanager
def _opened(one: _Partial, bytes_needed: int | None) -> Iterator[io.BufferedRandom]:
    raw = _Watched(one, bytes_needed)
    handle = io.BufferedRandom(raw, BUFFER_BYTES)
    try:
        with refusing(one.path, bytes_needed, only_of=one.partial):
            yield handle
    except BaseException:
        raw.discarding = True
        raise
    finally:
        handle.close()


def _partial(path: Path) -> Path:
    return path.with_name(f"{_stem(path)}.levkas.partial-{secrets.token_hex(4)}")


def _stem(path: Path) -> str:
    """Return what the partial names of a file begin with."""
    return os.fsencode(path.name)[:LONGEST_NAME].decode(errors="ignore")


_waiting: ContextVar[list[_Partial | Path] | None] = ContextVar("waiting", default=None)
"""What `together` waits with; paths are to be removed."""


@contextlib.contextmanager
def together(before: Callable[[], object] | None = None) -> Iterator[None]:
    """Let what this thread writes in the block take its names only when the block ends well.

    Whatever may fill the disk is then done: where a file of several fails, all are what they were. What `remove` is given
    in the block goes then too. `before` is called once when all is on the disk and nothing has its name: the place to drop a
    record of what stands there until then. Raises WriteRefused.

    A process that ends while names are taken leaves some of the new and some of the old files.
    """
    waiting: list[_Partial | Path] = []
    token = _waiting.set(waiting)
    try:
        try:
            yield
        finally:
            _waiting.reset(token)
            made = [one for one in waiting if isinstance(one, _Partial)]
        if before is not None:
            before()
        for each in waiting:
            each.settle() if isinstance(each, _Partial) else remove(each)
        for folder in sorted({one.path.parent for one in made}):
            _sync_folder(folder)
    except BaseException:
        for one in made:
            one.drop()  # nothing, where it has its name
        raise
    finally:
        for one in made:
            one.close()


# --- folders made, files removed --------------------------------------------------------------


def make_folder(path: str | Path) -> None:
    """Make a folder and those above it, and sync the entries, so that they outlast a power loss."""
    path = Path(path)
    missing = []
    with refusing(path, None):
        while not path.is_dir():
            missing.append(path)
            path = path.parent
    for folder in reversed(missing):
        with refusing(folder, None):
            fault("folder", folder)
            folder.mkdir(exist_ok=True)
        _sync_folder(folder.parent)


def discard(path: Path) -> None:
    """Remove a file or a folder, once more where something comes into it meanwhile."""
    fault("remove", path)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)  # another builder sweeps it too
        if path.is_dir():
            shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def remove(path: str | Path) -> None:
    """Take a file or a folder away; nothing happens where there is none."""
    path = Path(path)
    if (waiting := _waiting.get()) is not None:
        waiting.append(path)
        return
    with refusing(path, None):
        if path.is_dir() and not path.is_symlink():
            discarded = _partial(path)
            fault("rename", path)
            with contextlib.suppress(FileNotFoundError):
                path.rename(discarded)
                _sync_folder(path.parent)
                discard(discarded)
        else:
            discard(path)
    _sync_folder(path.parent)


def sweep(folder: str | Path) -> list[Path]:
    """Take away what killed runs of Levkas left under partial names, in `folder` and below, and return it.

    What a living process still writes is locked by it and stays. `folder` must be one that Levkas made.
    """
    removed: list[Path] = []
    for place, folders, names in os.walk(folder):
        partial = {name for name in (*folders, *names) if OURS.fullmatch(name)}
        folders[:] = sorted(set(folders) - partial)
        removed += _swept(Path(place, name) for name in sorted(partial))
    return removed


def sweep_beside(path: str | Path) -> list[Path]:
    """Take away what killed runs left of one file or folder, beside it; as `sweep` does."""
    path = Path(path)
    left = sorted(path.parent.glob(f"{glob.escape(_stem(path))}.levkas.partial-*"))
    return _swept(one for one in left if OURS.fullmatch(one.name))


def _swept(paths: Iterable[Path]) -> list[Path]:
    removed = []
    for path in (
        paths if os.name != "nt" else ()
    ):  # where open files are not locked nothing is swept
        try:
            # A pipe of that name keeps none waiting.
            descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError:
            continue
        try:
            abandoned = take(descriptor) is True
        finally:
            os.close(descriptor)
        if abandoned:
            with refusing(path, None):
                discard(path)
            removed.append(path)
    return removed


# --- calls of the system ----------------------------------------------------------------------


def _sync_folder(folder: Path) -> None:
    with refusing(folder, None):
        fault("sync", folder)
        if os.name == "nt":
            return
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _sync_file_system(descriptor: int) -> None:
    call = of_libc("syncfs")
    if call is None:
        getattr(os, "sync", lambda: None)()
    elif call(descriptor) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _exchange(one: Path, other: Path) -> bool:
    """Swap two names in one step, so that no moment is without either; False where it cannot be."""
    call, here, exchange = of_libc("renameat2"), -100, 2
    return call is not None and call(here, bytes(one), here, bytes(other), exchange) == 0

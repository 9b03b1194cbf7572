"""The machine that Levkas runs on: memory, disk, threads, and where compiled kernels are kept."""

from __future__ import annotations

import math
import os
import re
import shutil
import sys
import tempfile
import threading
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Iterator

VARIABLE, TILE, MEMORY = "LEVKAS_THREADS", "LEVKAS_TILE", "LEVKAS_MEMORY"
LEAST_MEMORY, LEAST_DISK = 4e9, 10e9


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Parameters
    ----------
    name : str
    state : str
        ``"ok"``; ``"missing"``, of something required; ``"absent"``, of something that only one
        feature needs; ``"low"``, which is slow or tight but works.
    found : str
    expected : str
    needed_for : str
    fix : str
    """

    name: str
    state: Literal["ok", "missing", "absent", "low"]
    found: str = ""
    expected: str = ""
    needed_for: str = ""
    fix: str = ""

    def to_dict(self) -> dict[str, str]:
        """Return the fields."""
        return asdict(self)


def give_back_memory() -> None:
    """Return freed memory to the system, where the C library keeps it for itself (glibc does)."""
    import ctypes

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


def count_threads(most: int | None = None) -> int:
    """Return how many threads work at a time: $LEVKAS_THREADS, else the processors we may use.

    Parameters
    ----------
    most : int, optional
        More are of no use to the caller.

    Examples
    --------
    >>> count_threads(most=1)
    1
    """
    told = os.environ.get(VARIABLE, "").strip()
    count = int(told) if told.isdecimal() and int(told) > 0 else _processors()
    return count if most is None else min(count, most)


def tile_rows(chosen: int, whole: int) -> int:
    """Return how many rows are worked on at a time: $LEVKAS_TILE, else what the caller has `chosen`.

    Parameters
    ----------
    chosen : int
        By the memory that a block of rows takes.
    whole : int
        All rows there are: what ``LEVKAS_TILE=whole`` gives, and never less than what is returned.

    Examples
    --------
    >>> tile_rows(256, 100)
    100
    """
    told = os.environ.get(TILE, "").strip()
    rows = int(told) if told.isdecimal() and int(told) > 0 else chosen
    return max(1, whole if told == "whole" else min(rows, whole))


def _processors() -> int:
    """Processors that this process may use, those of a container where one limits them."""
    count = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        count = len(os.sched_getaffinity(0))
    return max(1, min(count, _quota() or count))


@cache
def _quota() -> int | None:
    quota = _text("/sys/fs/cgroup/cpu.max").split()
    if len(quota) == 2 and quota[0].isdigit():
        return max(1, round(int(quota[0]) / int(quota[1])))
    return None


_alone = threading.RLock()


@contextmanager
def steady_libraries() -> Iterator[None]:
    """Let one thread at a time into the block, and the libraries have `count_threads()`, linear algebra one.

    Sums of linear algebra depend on its number of threads, and small problems do not wait for one
    another on a busy machine. That number is one for the whole process, and compiled parallel loops
    may end the process where two threads enter them at once: hence one at a time.
    """
    # Read when compiled parallel loops first start: threads that wait must not spin, others work.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    import cv2
    import numba
    from threadpoolctl import threadpool_limits

    with _alone, threadpool_limits(limits=1, user_api="blas"):
        most: int = vars(numba.config)["NUMBA_NUM_THREADS"]
        cv2.setNumThreads(count_threads())
        numba.set_num_threads(count_threads(most))
        yield


def find_memory() -> Finding:
    """Say how much memory there is and is free, of a container where one limits it."""
    total, free = _memory_bytes()
    purpose = "large cubes are streamed; less memory means smaller blocks"
    if total is None:
        return Finding("memory", "ok", "unknown", "", purpose)
    told = f"{total / 1e9:.1f} GB" + (f", {free / 1e9:.1f} GB free" if free is not None else "")
    if (bound := memory_bound()) is not None:
        source = f"by {MEMORY}" if chosen_memory() else f"what is free; {MEMORY} sets another bound"
        told += f"; a command takes up to {bound / 1e9:.1f} GB ({source})"
    return Finding("memory", "low" if total < LEAST_MEMORY else "ok", told, "4 GB or more", purpose)


def chosen_memory() -> float | None:
    """Return the bytes that a command may take as $LEVKAS_MEMORY has them in GB; None without it."""
    try:
        chosen = float(os.environ.get(MEMORY, ""))
    except ValueError:
        return None
    return chosen * 1e9 if 0 < chosen < math.inf else None


def memory_bound() -> float | None:
    """Return the bytes that a command may take: $LEVKAS_MEMORY, else what is free; None where nobody knows."""
    return chosen_memory() or free_memory()


def free_memory() -> float | None:
    """Return bytes that this process may still take; None where nobody knows."""
    free = _memory_bytes()[1]
    try:
        import resource
    except ImportError:  # Windows
        return free
    held = re.search(r"VmData:\s+(\d+) kB", _text("/proc/self/status"))
    for kind in (resource.RLIMIT_DATA, resource.RLIMIT_AS):
        limit = resource.getrlimit(kind)[0]
        if limit != resource.RLIM_INFINITY:
            rest = max(0.0, limit - (float(held.group(1)) * 1024 if held else 0.0))
            free = rest if free is None else min(free, rest)
    return free


def _memory_bytes() -> tuple[float | None, float | None]:
    """Total and free bytes, those of a container where one limits them."""
    total = free = None
    try:
        total = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return None, None
    if found := re.search(r"MemAvailable:\s+(\d+) kB", _text("/proc/meminfo")):
        free = float(found.group(1)) * 1024
    limit = _text("/sys/fs/cgroup/memory.max").strip()
    if limit.isdigit() and float(limit) < total:
        total = float(limit)
        used = _text("/sys/fs/cgroup/memory.current").strip()
        rest = total - float(used) if used.isdigit() else total
        free = rest if free is None else min(free, rest)
    return total, free


def find_disk(folder: Path) -> Finding:
    """Say how much space is free where `folder` stands."""
    purpose = f"databases below {folder}"
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return Finding("disk", "low", str(error.strerror), "a folder that exists", purpose)
    fix = "" if free >= LEAST_DISK else "Free some space, or build with --output on another disk."
    state: Literal["ok", "low"] = "ok" if free >= LEAST_DISK else "low"
    return Finding("disk", state, f"{free / 1e9:.1f} GB free", "10 GB or more", purpose, fix)


def find_threads() -> Finding:
    """Say how many threads can run at a time, and which variables limit the libraries."""
    names = (
        *(VARIABLE, TILE, "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
        "MKL_NUM_THREADS",
    )
    told = [f"{name}={os.environ[name]}" for name in names if name in os.environ]
    return Finding(
        "threads",
        "ok",
        ", ".join([str(count_threads()), *told]),
        "",
        "speed; the bytes are the same",
    )


def find_kernel_cache() -> Finding:
    """Say whether compiled kernels can be kept: beside the package, or where the user's caches are."""
    purpose = "compiled kernels are kept; otherwise every start takes seconds longer"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(chosen)] if chosen else [Path(__file__).parent, _user_cache()]
    writable = [place for place in places if _is_writable(place)]
    if writable:
        return Finding("kernel cache", "ok", "writable", "", purpose)
    fix = "Set NUMBA_CACHE_DIR to a folder that can be written to."
    return Finding("kernel cache", "low", "not writable", "a writable folder", purpose, fix)


def _user_cache() -> Path:
    home = Path.home()
    if sys.platform == "darwin":
        return home / "Library/Caches/numba"
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", home)) / "numba"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "numba"


def _is_writable(folder: Path) -> bool:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""

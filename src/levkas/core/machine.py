"""Memory, processors and threads of the machine, and the variables that limit them."""

from __future__ import annotations

import math
import os
import threading
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

THREADS, TILE, MEMORY = "LEVKAS_THREADS", "LEVKAS_TILE", "LEVKAS_MEMORY"


def of_libc(name: str) -> Any:
    """Return a function of the C library, None where that has none of the name."""
    import ctypes

    return getattr(ctypes.CDLL(None, use_errno=True), name, None) if os.name == "posix" else None


def give_back_memory() -> None:
    """Return freed memory to the system, where the C library keeps it for itself (glibc does)."""
    if (trim := of_libc("malloc_trim")) is not None:
        trim(0)


def keep_memory() -> None:
    """Have the C library keep freed memory for all threads in one place until `give_back_memory` (glibc).

    By itself glibc keeps it thread by thread: what one has freed another cannot use, and takes from the system
    for more, which has to be zeroed. One arena makes the peak of a full-size build 2.2 instead of 2.7 GB.
    """
    if (tune := of_libc("mallopt")) is not None:
        for option, value in (
            (M_TRIM_THRESHOLD, 64 << 20), (M_MMAP_THRESHOLD, 32 << 20), (M_ARENA_MAX, 1)
        ):  # fmt: skip
            tune(option, value)


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Options of mallopt(3); the sizes are the most that glibc chooses by itself."""


def count_threads(most: int | None = None) -> int:
    """Return how many threads work at a time: $LEVKAS_THREADS, else the processors we may use, `most` of them.

    >>> count_threads(most=1)
    1
    """
    count = _stated(THREADS) or _processors()
    return count if most is None else min(count, most)


def tile_rows(chosen: int, whole: int) -> int:
    """Return how many rows are worked on at a time: $LEVKAS_TILE, else what the caller has `chosen` by the memory they take.

    ``LEVKAS_TILE=whole`` gives the `whole`: all rows there are, of which no more are returned.

    >>> tile_rows(256, 100)
    100
    """
    if os.environ.get(TILE, "").strip() == "whole":
        return max(1, whole)
    return max(1, min(_stated(TILE) or chosen, whole))


def _stated(variable: str) -> int:
    text = os.environ.get(variable, "").strip()
    return int(text) if text.isdecimal() else 0


@cache
def _processors() -> int:
    """Processors that this process may use, those of a container where one limits them."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    quota = _text("/sys/fs/cgroup/cpu.max").split()
    if len(quota) == 2 and quota[0].isdigit():
        return max(1, min(count or 1, round(int(quota[0]) / int(quota[1]))))
    return count or 1


_alone = threading.RLock()


@contextmanager
def steady_libraries() -> Iterator[None]:
    """Let one thread at a time into the block, and the libraries have `count_threads()`, linear algebra one.

    Sums of linear algebra depend on its number of threads, which is one for the whole process.
    """
    import cv2
    import scipy.linalg  # noqa: F401  # it brings linear algebra of its own, which is held only if it is there already
    from threadpoolctl import threadpool_limits

    with _alone, threadpool_limits(limits=1, user_api="blas"):
        cv2.setNumThreads(count_threads())
        yield


def chosen_memory() -> float | None:
    """Return the bytes that a command may take as $LEVKAS_MEMORY has them in GB; None without it."""
    try:
        chosen = float(os.environ.get(MEMORY, ""))
    except ValueError:
        return None
    return chosen * 1e9 if 0 < chosen < math.inf else None


def memory_bound() -> float:
    """Return the bytes that a command may take: $LEVKAS_MEMORY, else what is free."""
    return chosen_memory() or free_memory()


def free_memory() -> float:
    """Return bytes that this process may still take."""
    free = memory_bytes()[1]
    try:
        import resource
    except ImportError:  # Windows
        return free
    import psutil

    held = getattr(psutil.Process().memory_info(), "data", 0)
    for kind in (resource.RLIMIT_DATA, resource.RLIMIT_AS):
        limit = resource.getrlimit(kind)[0]
        if limit != resource.RLIM_INFINITY:
            free = min(free, max(0.0, float(limit - held)))
    return free


def memory_bytes() -> tuple[float, float]:
    """Return total and free bytes, those of a container where one limits them."""
    import psutil

    machine = psutil.virtual_memory()
    total, free = float(machine.total), float(machine.available)
    limit = _text("/sys/fs/cgroup/memory.max").strip()
    if limit.isdigit() and float(limit) < total:
        total = float(limit)
        used = _text("/sys/fs/cgroup/memory.current").strip()
        free = min(free, total - float(used) if used.isdigit() else total)
    return total, free


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""

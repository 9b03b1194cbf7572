"""Thread pools shared by the whole process: rows of one picture, or bands side by side.

Threads of our own around kernels without the interpreter's lock: numba's parallel loops take four times
as long to compile, and the first run on a fresh machine is one that people wait for.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextvars import copy_context
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from levkas.core.machine import count_threads

MOST_THREADS, MOST_OF_ROWS = 4, 16
"""Threads that work on a picture each, which all take memory, and on rows of one."""
WORTH_THREADS = 200_000

Made = TypeVar("Made")

_here = threading.local()


def in_threads(
    kernel: Callable[..., Made], rows: int, *arguments: Any, worth: int | None = None
) -> list[Made]:
    """Run ``kernel(start, stop, …)`` on bands of rows, and return what it returns of each.

    Each row is written by one thread only. `worth` is the number of values, where they are not in one of
    the arrays. Within `each` there is one thread for all of them: the others have bands of their own.
    """
    workers = count_threads(MOST_OF_ROWS)
    if worth is None:
        worth = max(a.size for a in arguments if isinstance(a, np.ndarray))
    if rows < 4 * workers or workers == 1 or worth < WORTH_THREADS or _is_one_of_several():
        return [kernel(0, rows, *arguments)]
    edges = np.linspace(0, rows, 2 * workers + 1).astype(int).tolist()
    jobs = [_pool(workers).submit(kernel, a, b, *arguments) for a, b in pairwise(edges)]
    return [job.result() for job in jobs]


def each(work: Callable[..., Made], *items: Iterable[Any]) -> list[Made]:
    """Return ``list(map(work, *items))``; several at a time, a thread each.

    Of several exceptions the one of the first item that has one is raised, once all threads are done.

    >>> each(pow, [-2, 3], [2, 3])
    [4, 27]
    """
    rows, workers = list(zip(*items, strict=True)), count_threads(MOST_THREADS)
    if workers == 1 or len(rows) < 2 or _is_one_of_several():
        return [work(*row) for row in rows]

    def alone(*row: Any) -> Made:
        _here.one_of_several = True
        try:
            return work(*row)
        finally:
            _here.one_of_several = False

    jobs = [_pool(workers).submit(copy_context().run, alone, *row) for row in rows]
    try:
        return [job.result() for job in jobs]
    finally:
        for job in jobs:
            job.cancel()
        wait(jobs)


def made_ahead(items: Iterable[Made]) -> Iterator[Made]:
    """Yield items in their order, each made by a thread while the one before is used; within `each`, where others have work, as they come.

    >>> list(made_ahead(n * n for n in range(3)))
    [0, 1, 4]
    """
    if _is_one_of_several() or count_threads(MOST_THREADS) == 1:
        yield from items
        return
    making, end = iter(items), object()
    with ThreadPoolExecutor(1, thread_name_prefix="ahead") as ahead:
        coming: Future[Any] = ahead.submit(next, making, end)
        while (item := coming.result()) is not end:
            coming = ahead.submit(next, making, end)
            yield item
            del item  # its memory may be wanted for the next


def _is_one_of_several() -> bool:
    return getattr(_here, "one_of_several", False)


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    """Return threads that stay: a registration takes them thousands of times."""
    return ThreadPoolExecutor(workers, thread_name_prefix="rows")

"""Threads of a registration: the same answers in the same order, and never more threads than asked for."""

import threading
import time

import numpy as np
import pytest

from levkas.core.threads import WORTH_THREADS, each, in_threads
from levkas.registration.predictors import principal_components


@pytest.fixture(params=["1", "3"])
def threads(request, monkeypatch):
    monkeypatch.setenv("LEVKAS_THREADS", request.param)
    return int(request.param)


def test_each_keeps_the_order_whoever_is_done_first(threads):
    def slow_first(n):
        time.sleep(0.02 * (n == 0))
        return n * n

    assert each(slow_first, range(6)) == [0, 1, 4, 9, 16, 25]


def test_each_raises_what_the_first_item_raised_once_all_threads_are_done(threads):
    working = set()

    def fail(n):
        working.add(n)
        time.sleep(0.02 * (n == 1))
        working.discard(n)
        if n:
            raise ValueError(n)

    with pytest.raises(ValueError, match="1"):
        each(fail, range(4))
    assert not working


def test_each_asks_for_as_many_of_all_items(threads):
    with pytest.raises(ValueError, match="zip"):
        each(pow, [1, 2], [3])


def test_rows_within_each_are_done_by_the_thread_that_asks(threads):
    found = []

    def rows(start, stop, image):
        found.append(threading.get_ident())
        image[start:stop] += 1

    def work(image):
        in_threads(rows, len(image), image)
        return threading.get_ident()

    images = np.zeros((2, 64, WORTH_THREADS // 64 + 1))
    assert sorted(each(work, images)) == sorted(found)
    assert (images == 1).all()
    found.clear()
    work(images[0])  # and by several again outside
    assert len(found) == (1 if threads == 1 else 2 * threads)
    assert (images[0] == 2).all()


def test_threads_of_each_heed_what_numpy_is_told(threads):
    def divide(n):
        return float(np.float64(n) / np.zeros(1)[0])

    with np.errstate(divide="ignore"):
        assert each(divide, [1, 2]) == [np.inf, np.inf]
    with np.errstate(divide="raise"), pytest.raises(FloatingPointError):
        each(divide, [1, 2])


def test_principal_images_are_the_same_bytes_for_any_number_of_threads(monkeypatch):
    rng = np.random.default_rng(3)
    stack = rng.uniform(0.2, 0.9, (33, 311, 419)).astype(np.float32)
    found = set()
    for count in ("1", "2", "3", "4"):
        monkeypatch.setenv("LEVKAS_THREADS", count)
        found.add(principal_components(stack).images.tobytes())
    assert len(found) == 1

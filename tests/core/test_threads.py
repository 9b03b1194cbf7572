"""Threads: items in their order, errors at their place, one item ahead and no more."""

import threading
import time

import numpy as np
import pytest

from levkas.core.threads import WORTH_THREADS, each, in_threads, made_ahead


def test_no_more_than_one_item_is_made_ahead():
    made = []

    def items():
        for number in range(5):
            made.append(number)
            yield number

    for number in made_ahead(items()):
        assert max(made) <= number + 1


def test_an_error_comes_in_place_of_the_item_that_could_not_be_made():
    def items():
        yield from (1, 2)
        raise ValueError("the third")

    found = []
    with pytest.raises(ValueError, match="the third"):
        for item in made_ahead(items()):
            found.append(item)
    assert found == [1, 2]


def test_who_stops_early_ends_the_thread():
    def items():
        number = 0
        while True:
            yield number
            number += 1

    before = threading.active_count()
    some = made_ahead(items())
    assert next(some) == 0
    assert threading.active_count() == before + 1
    some.close()
    assert threading.active_count() == before


@pytest.fixture(params=["1", "3"])
def threads(request, monkeypatch):
    monkeypatch.setenv("LEVKAS_THREADS", request.param)
    return int(request.param)


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

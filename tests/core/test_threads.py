"""Threads: items in their order, errors at their place, one item ahead and no more."""

import threading

import pytest

from levkas.core.threads import made_ahead


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

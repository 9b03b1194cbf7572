"""Splits of a database into training and test: each painting is left out in turn.

Neighbouring pixels of one painting are the same paint, so that a score on random pixels would say how well a
method remembers: training and test share no painting.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from levkas.core.problems import Problem, closest_match
from levkas.estimation.samples import EstimationRefused


class EstimationFold(NamedTuple):
    """Paintings of one training, and those that it is tested on."""

    name: str
    train: tuple[str, ...]
    test: tuple[str, ...]


def split_paintings(
    names: Sequence[str], *, train: Sequence[str] = (), test: Sequence[str] = ()
) -> tuple[EstimationFold, ...]:
    """Leave one painting out in turn, or take the training and test paintings that are given.

    Examples
    --------
    >>> [(fold.name, fold.train) for fold in split_paintings(["a", "b", "c"])]
    [('a', ('b', 'c')), ('b', ('a', 'c')), ('c', ('a', 'b'))]
    """
    if (train or test) or len(names) == 1:
        return (_given(names, train, test),)
    others = {name: tuple(n for n in names if n != name) for name in names}
    return tuple(EstimationFold(name, others[name], (name,)) for name in names)


def _given(names: Sequence[str], train: Sequence[str], test: Sequence[str]) -> EstimationFold:
    problems = [
        Problem(
            "E_VALUE",
            "there is no such painting with these layers",
            field=option,
            found=name,
            expected=", ".join(names),
            fix=closest_match(name, names),
        )
        for option, chosen in (("--train", train), ("--test", test))
        for name in chosen
        if name not in names
    ]
    if both := set(train) & set(test):
        problems.append(
            Problem(
                "E_SPLIT_LEAK",
                "the split leaks: a painting is on both sides, in training and in test",
                field="--train, --test",
                found=", ".join(sorted(both)),
                expected="paintings on one side only",
                fix="Leave it out of one side.",
            )
        )
    if problems:
        raise EstimationRefused(*problems)
    train = list(train) or [name for name in names if name not in test]
    test = list(test) or [name for name in names if name not in train]
    if not train or not test:
        raise EstimationRefused(
            Problem(
                "E_SPLIT",
                "nothing is left to train on" if not train else "nothing is left to test on",
                field="--train, --test",
                found=", ".join(names),
                expected="two paintings or more with these layers, one at least on each side",
                fix="Capture another painting by the same cameras, into the same database.",
            )
        )
    return EstimationFold(", ".join(test), tuple(train), tuple(test))

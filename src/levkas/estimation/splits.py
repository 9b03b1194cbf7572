"""Splits of a database into training and test: each painting is left out in turn.

Neighbouring pixels of one painting are the same paint, so that a score on random pixels would say how well a
method remembers: training and test share no painting.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from levkas.core.problems import Problem, closest_match
from levkas.estimation.samples import BLOCKS, EstimationRefused, PaintSamples


@dataclass(frozen=True)
class Part:
    """Samples of one painting on one side of a split.

    Parameters
    ----------
    object : str
    sources : tuple of str
        Layers whose channels are the responses.
    group : int, optional
        Group of pixels that is held out; None means all pixels.
    held : bool
        The pixels of the group, else all others.
    """

    object: str
    sources: tuple[str, ...]
    group: int | None = None
    held: bool = False


@dataclass(frozen=True)
class EstimationFold:
    """One training set and what it is tested on."""

    name: str
    train: tuple[Part, ...]
    test: tuple[Part, ...]


@dataclass(frozen=True)
class EstimationSplit:
    """Folds of one way to hold out.

    Parameters
    ----------
    folds : tuple of EstimationFold
    note : str
        What a reader has to know, "" where nothing.
    """

    folds: tuple[EstimationFold, ...]
    note: str = field(default="")


def split_paintings(
    names: Sequence[str],
    sources: tuple[str, ...],
    *,
    train: Sequence[str] = (),
    test: Sequence[str] = (),
) -> EstimationSplit:
    """Leave one painting out, or take the training and test paintings that are given.

    A single painting is cut into spatial blocks, of which a quarter is held out at a time.

    Raises
    ------
    EstimationRefused
        For an unknown painting, or one on both sides.

    Examples
    --------
    >>> split = split_paintings(["a", "b", "c"], ("rgb",))
    >>> [(fold.name, [part.object for part in fold.train]) for fold in split.folds]
    [('a', ['b', 'c']), ('b', ['a', 'c']), ('c', ['a', 'b'])]
    """
    if train or test:
        return _given(names, sources, train, test)
    if len(names) == 1:
        note = (
            f"{names[0]} is the only painting: spatial blocks of it are held out, a quarter at a time. "
            "Training and test have the same paints; the score on another painting will be worse"
        )
        return EstimationSplit(_blocks_of(names[0], sources), note)
    folds = [
        EstimationFold(
            name, _parts([n for n in names if n != name], sources), _parts([name], sources)
        )
        for name in names
    ]
    return EstimationSplit(tuple(folds))


def group_pixels(samples: PaintSamples) -> np.ndarray:
    """Return the group of every pixel, by its spatial block, (n,) int."""
    down, across = divmod(samples.blocks(), BLOCKS)
    return np.asarray((down + 2 * across + down // 2) % BLOCKS)


def _given(
    names: Sequence[str], sources: tuple[str, ...], train: Sequence[str], test: Sequence[str]
) -> EstimationSplit:
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
    if problems:
        raise EstimationRefused(*problems)
    if both := set(train) & set(test):
        raise _leak(both)
    train = list(train) or [name for name in names if name not in test]
    test = list(test) or [name for name in names if name not in train]
    if not train or not test:
        raise EstimationRefused(
            Problem(
                "E_SPLIT",
                "nothing is left to train on" if not train else "nothing is left to test on",
                field="--train, --test",
                expected="at least one painting on each side",
            )
        )
    fold = EstimationFold(", ".join(test), _parts(train, sources), _parts(test, sources))
    return EstimationSplit((fold,))


def _leak(both: Iterable[str]) -> EstimationRefused:
    return EstimationRefused(
        Problem(
            "E_SPLIT_LEAK",
            "the split leaks: a painting is on both sides, in training and in test",
            field="--train, --test",
            found=", ".join(sorted(both)),
            expected="paintings on one side only",
            fix="Leave it out of one side.",
        )
    )


def _parts(names: Sequence[str], sources: tuple[str, ...]) -> tuple[Part, ...]:
    return tuple(Part(name, sources) for name in names)


def _blocks_of(name: str, sources: tuple[str, ...]) -> tuple[EstimationFold, ...]:
    return tuple(
        EstimationFold(
            f"part {group + 1} of {BLOCKS}",
            (Part(name, sources, group),),
            (Part(name, sources, group, held=True),),
        )
        for group in range(BLOCKS)
    )

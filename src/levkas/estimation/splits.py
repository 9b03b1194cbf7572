"""Splits of a database into training and test: by painting, chart, camera, lighting, or at random.

Neighbouring pixels of one painting are the same paint, so that a score on random pixels says how well a
method remembers. Training and test share no painting but in the split that is marked optimistic.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.problems import Problem, closest_match
from levkas.database.layout import LayerId
from levkas.estimation.samples import BLOCKS, EstimationRefused, PaintSamples

if TYPE_CHECKING:
    from levkas.database.reader import Database

SPLITS = {
    "painting": "each painting is estimated from the others",
    "chart": "trained on colour charts, tested on paintings",
    "camera": "trained on one camera's responses, tested on another's, on paintings left out",
    "lighting": "trained under one lighting, tested under another, on paintings left out",
    "random": "random pixels of all paintings are left out: optimistic",
}
"""Name → what it is; the first is the default."""
RANDOM_FOLDS = 2


@dataclass(frozen=True)
class Part:
    """Samples of one painting or chart on one side of a split.

    Parameters
    ----------
    object : str
    sources : tuple of str
        Layers whose channels are the responses.
    group : int, optional
        Group of pixels that is held out; None means all pixels.
    held : bool
        The pixels of the group, else all others.
    chart : bool
        Whether the object is a chart, whose samples are its patches.
    """

    object: str
    sources: tuple[str, ...]
    group: int | None = None
    held: bool = False
    chart: bool = False


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
    kind : str
        Key of `SPLITS`.
    folds : tuple of EstimationFold
    grouping : str
        ``"blocks"`` or ``"random"`` where pixels of one painting are on both sides.
    note : str
        What a reader has to know, "" where nothing.
    """

    kind: str
    folds: tuple[EstimationFold, ...]
    grouping: str = ""
    note: str = field(default="")

    @property
    def optimistic(self) -> bool:
        """Whether training and test share paint."""
        return self.grouping == "random"


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
        return EstimationSplit("painting", _groups(names, sources, BLOCKS), "blocks", note)
    folds = [
        EstimationFold(
            name, _parts([n for n in names if n != name], sources), _parts([name], sources)
        )
        for name in names
    ]
    return EstimationSplit("painting", tuple(folds))


def split_at_random(names: Sequence[str], sources: tuple[str, ...]) -> EstimationSplit:
    """Hold random pixels of all paintings out."""
    note = "optimistic: neighbours of the test pixels, of the same paint, are in the training set"
    return EstimationSplit("random", _groups(names, sources, RANDOM_FOLDS), "random", note)


def split_chart(
    names: Sequence[str], sources: tuple[str, ...], charts: Sequence[str]
) -> EstimationSplit:
    """Train on the patches of the charts, test on every painting."""
    if not charts:
        raise EstimationRefused(
            Problem(
                "E_CHART_MISSING",
                "no chart was measured by all of these cameras",
                field="--split",
                found="chart",
                expected=f"charts/ in the database, captured by {', '.join(sources)} and the target",
                fix="Declare `charts` in [targets] of campaign.toml and build again, or split by painting.",
            )
        )
    train = tuple(Part(chart, sources, chart=True) for chart in charts)
    return EstimationSplit(
        "chart", (EstimationFold("+".join(charts), train, _parts(names, sources)),)
    )


def split_between(
    kind: str, names: Sequence[str], alternatives: Sequence[tuple[str, ...]]
) -> EstimationSplit:
    """Train on the responses of some layers, test on those of others, each painting left out in turn.

    Parameters
    ----------
    kind : str
        ``"camera"`` or ``"lighting"``.
    names : sequence of str
    alternatives : sequence of tuple of str
        Layers that take each other's place; as many channels each.

    Raises
    ------
    EstimationRefused
        Where there is only one of them, or only one painting.
    """
    if len(alternatives) < 2 or len(names) < 2:
        what = "cameras" if kind == "camera" else "lightings"
        few = len(alternatives) < 2
        raise EstimationRefused(
            Problem(
                "E_SPLIT",
                f"a split by {kind} needs two {what} and two paintings",
                field="--split",
                found=f"1 of {what}" if few else f"{len(names)} painting",
                expected=f"two {what} of the same channels" if few else "two paintings",
                fix="Give --from once for each camera." if few and kind == "camera" else None,
            )
        )
    folds = [
        EstimationFold(
            f"{'+'.join(one)} → {'+'.join(other)}, {name}",
            _parts([n for n in names if n != name], one),
            _parts([name], other),
        )
        for one, other in permutations(alternatives, 2)
        for name in names
    ]
    return EstimationSplit(kind, tuple(folds))


def lightings_of(database: Database, sources: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return the layers of the same cameras under each lighting that all of them were used under."""
    known = {LayerId(name, *layer).name for name in database for layer in database[name].layers}
    setups = sorted({LayerId.parse("", layer).setup for layer in known})
    cameras = [LayerId.parse("", source).camera for source in sources]
    found = [tuple(LayerId("", camera, setup).name for camera in cameras) for setup in setups]
    return [layers for layers in found if all(layer in known for layer in layers)]


def require_no_leak(split: EstimationSplit) -> EstimationSplit:
    """Return a split whose training and test share no paint, or that says so.

    Raises
    ------
    EstimationRefused
        With code ``E_SPLIT_LEAK``.
    """
    for fold in split.folds:
        both = {p.object for p in fold.train} & {p.object for p in fold.test}
        if both and not split.grouping:
            raise _leak(both)
    return split


def group_pixels(samples: PaintSamples, grouping: str, seed: int) -> np.ndarray:
    """Return the group of every pixel: its spatial block's, or a random one, (n,) int."""
    if grouping == "random":
        return np.random.default_rng(seed).integers(0, RANDOM_FOLDS, len(samples))
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
    return EstimationSplit("painting", (fold,))


def _leak(both: Iterable[str]) -> EstimationRefused:
    return EstimationRefused(
        Problem(
            "E_SPLIT_LEAK",
            "the split leaks: a painting is on both sides, in training and in test",
            field="--train, --test",
            found=", ".join(sorted(both)),
            expected="paintings on one side only",
            fix="Leave it out of one side; --split random shows what a leak is worth, marked optimistic.",
        )
    )


def _parts(names: Sequence[str], sources: tuple[str, ...]) -> tuple[Part, ...]:
    return tuple(Part(name, sources) for name in names)


def _groups(
    names: Sequence[str], sources: tuple[str, ...], count: int
) -> tuple[EstimationFold, ...]:
    return tuple(
        EstimationFold(
            f"part {group + 1} of {count}",
            tuple(Part(name, sources, group) for name in names),
            tuple(Part(name, sources, group, held=True) for name in names),
        )
        for group in range(count)
    )

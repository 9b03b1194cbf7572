"""Loops of three overlapping tiles: which overlaps do not close theirs, and tiles laid along the strongest ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import sparse

from levkas.geometry.transforms import Affine

Pair = tuple[str, str]


def consistent_pairs(
    maps: Mapping[Pair, Affine],
    weights: Mapping[Pair, float],
    size: tuple[int, int],
    tolerance: float,
) -> tuple[list[Pair], dict[Pair, float]]:
    """Return the overlaps that close their loops, and those that do not, with their least closure, px.

    An overlap of which more loops fail than close is taken out, the worst first, of equals the weakest; until none is left.

    Parameters
    ----------
    maps : mapping of pair to Affine
        Px of the first tile → px of the second.
    weights : mapping of pair to float
        How much stands behind an overlap.
    size : (width, height) of a tile, px
    tolerance : float, px
        Up to which a loop closes.
    """
    kept = sorted(maps)
    refused: dict[Pair, float] = {}
    middle = (np.array(size, float)[None] - 1) / 2
    loops = []
    for a, b in kept:
        for c in (name for one, name in kept if one == b and (a, name) in maps):
            there = maps[a, c].inverse(maps[b, c](maps[a, b](middle)))
            loops.append((((a, b), (b, c), (a, c)), float(np.hypot(*(there - middle)[0]))))
    while True:
        votes = {pair: [0, 0] for pair in kept}
        for edges, off in loops:
            for pair in edges:
                votes[pair][off > tolerance] += 1
        doubtful = [pair for pair in kept if votes[pair][1] > votes[pair][0]]
        if not doubtful:
            return kept, refused
        worst = min(
            doubtful, key=lambda pair: (votes[pair][0] - votes[pair][1], weights[pair], pair)
        )
        refused[worst] = min(off for edges, off in loops if worst in edges)
        kept.remove(worst)
        loops = [one for one in loops if worst not in one[0]]


def lay_along_tree(
    names: Sequence[str], maps: Mapping[Pair, Affine], weights: Mapping[Pair, float]
) -> dict[str, Affine]:
    """Return px of every tile → px of the first, along the fewest overlaps, of these the strongest.

    Every tile must be joined to the first.
    """
    near: dict[str, list[tuple[float, str]]] = {name: [] for name in names}
    for (a, b), weight in weights.items():
        near[a].append((-weight, b))
        near[b].append((-weight, a))
    centre = max(names, key=lambda name: (len(near[name]), -names.index(name)))
    laid, ring = {centre: Affine.identity()}, [centre]
    while ring:
        reached: dict[str, tuple[float, str]] = {}
        for name in ring:
            for weight, other in near[name]:
                if other not in laid:
                    reached[other] = min(reached.get(other, (np.inf, "")), (weight, name))
        for other, (_, name) in sorted(reached.items()):
            laid[other] = _joined_to(laid[name], name, other, maps)
        ring = sorted(reached)
    return laid


def _joined_to(laid: Affine, name: str, other: str, maps: Mapping[Pair, Affine]) -> Affine:
    """Return px of `other` → the frame in which `name` is laid; scales are left at 1, which a chain would drift in."""
    pair = (other, name) if (other, name) in maps else (name, other)
    step = maps[pair].matrix
    linear, shift = step[:, :2], step[:, 2]
    if pair[0] == name:
        linear = np.linalg.inv(linear)
        shift = -linear @ shift
    linear = laid.matrix[:, :2] @ linear
    whole = laid.matrix[:, :2] @ shift + laid.matrix[:, 2]
    return Affine(np.column_stack([linear, whole]))


def components(names: list[str], pairs: list[Pair]) -> list[list[str]]:
    """Return the sets of tiles that pairs join, each in name order.

    >>> components(["a", "b", "c"], [("a", "c")])
    [['a', 'c'], ['b']]
    """
    number = {name: k for k, name in enumerate(names)}
    ends = np.array([[number[a], number[b]] for a, b in pairs], int).reshape(-1, 2).T
    graph = sparse.coo_array((np.ones(len(pairs)), (ends[0], ends[1])), (len(names),) * 2)
    count, part = sparse.csgraph.connected_components(graph, directed=False)
    return [[name for name in names if part[number[name]] == k] for k in range(count)]

"""Loops of overlapping tiles: which overlaps do not close theirs, and tiles laid along the strongest ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from levkas.geometry.transforms import Affine

Pair = tuple[str, str]


def short_loops(pairs: Sequence[tuple[int, int]]) -> list[tuple[int, ...]]:
    """Return the loops of three tiles, and those of four that no overlap cuts short.

    >>> short_loops([(0, 1), (1, 2), (2, 3), (0, 3)])
    [(0, 1, 2, 3)]
    >>> short_loops([(0, 1), (1, 2), (0, 2)])
    [(0, 1, 2)]
    """
    near: dict[int, set[int]] = {}
    for a, b in pairs:
        near.setdefault(a, set()).add(b)
        near.setdefault(b, set()).add(a)
    found = set()
    for a, b in sorted(map(tuple, map(sorted, pairs))):
        found |= {tuple(sorted((a, b, c))) for c in near[a] & near[b]}
        for c in near[b] - near[a] - {a}:
            for d in (near[c] & near[a]) - near[b] - {b}:
                loop = (a, b, c, d)
                at = loop.index(min(loop))
                turned = loop[at:] + loop[:at]
                found.add(turned if turned[1] < turned[3] else (turned[0], *turned[:0:-1]))
    return sorted(found)


def closure(loop: Sequence[str], maps: Mapping[Pair, Affine], size: tuple[int, int]) -> float:
    """Return by how much the middle of a loop's first tile is moved once around it, px, were all scales 1."""
    point = (np.array(size, float)[None] - 1) / 2
    begin = point
    for a, b in zip(loop, (*loop[1:], loop[0]), strict=True):
        point = maps[a, b](point) if (a, b) in maps else maps[b, a].inverse(point)
    return float(np.hypot(*(point - begin)[0]))


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
    names = sorted({name for pair in kept for name in pair})
    number = {name: k for k, name in enumerate(names)}
    loops = []
    for loop in short_loops([(number[a], number[b]) for a, b in kept]):
        around = [names[k] for k in loop]
        edges = [
            (min(a, b), max(a, b)) for a, b in zip(around, (*around[1:], around[0]), strict=True)
        ]
        loops.append((edges, closure(around, maps, size)))
    while True:
        votes = {pair: [0, 0] for pair in kept}
        for edges, off in loops:
            for pair in edges:
                votes[pair][off > tolerance] += 1
        doubtful = [pair for pair in kept if votes[pair][1] > votes[pair][0]]
        if not doubtful:
            return kept, refused
        worst = min(
            doubtful,
            key=lambda pair: (votes[pair][0] - votes[pair][1], weights[pair], pair),
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


def loop_records(joined: Sequence[str], pairs: np.ndarray, off: np.ndarray) -> list[dict[str, Any]]:
    """Return by how much every shortest loop of `pairs`, (m, 2), that are `off`, (m, 2), does not close, px."""
    place = {(int(i), int(j)): off[k] for k, (i, j) in enumerate(pairs)}
    records = []
    for loop in short_loops([tuple(pair) for pair in pairs.tolist()]):
        total = np.zeros(2)
        for i, j in zip(loop, (*loop[1:], loop[0]), strict=True):
            total += place[i, j] if (i, j) in place else -place[j, i]
        records.append({"tiles": [joined[i] for i in loop], "closure": float(np.hypot(*total))})
    return records


def components(names: list[str], pairs: list[Pair]) -> list[list[str]]:
    """Return the sets of tiles that pairs join, each in name order.

    >>> components(["a", "b", "c"], [("a", "c")])
    [['a', 'c'], ['b']]
    """
    root = {name: name for name in names}

    def top(name: str) -> str:
        while root[name] != name:
            root[name] = root[root[name]]
            name = root[name]
        return name

    for a, b in pairs:
        low, high = sorted((top(a), top(b)))
        root[high] = low
    parts: dict[str, list[str]] = {}
    for name in names:
        parts.setdefault(top(name), []).append(name)
    return list(parts.values())

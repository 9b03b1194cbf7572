"""Pairing key points of two pictures by what is around them, whether contrast is inverted or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.registration.key_points import KeyPoints, inverted, mirrored

RATIO = 0.92
WIDELY = 3


@dataclass(frozen=True)
class Pairs:
    """Matched places, and how size, direction and descriptor of the two compare; one row a pair.

    Parameters
    ----------
    p, q : ndarray, (n, 2), px of either picture
    growth : ndarray, (n,)
        Size of q over that of p.
    turn : ndarray, (n,), degrees
        Direction of q less that of p; their sum in the mirror.
    likeness : ndarray, (n,), -1..1
    """

    p: np.ndarray
    q: np.ndarray
    growth: np.ndarray
    turn: np.ndarray
    likeness: np.ndarray

    def __len__(self) -> int:
        return len(self.p)

    @classmethod
    def joined(cls, parts: Sequence[Pairs]) -> Pairs:
        """Return all pairs of all parts, each place once."""
        columns = [
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("p", "q", "growth", "turn", "likeness")
        ]
        rows = unique(columns[0], columns[1])
        return cls(*(column[rows] for column in columns))


_NONE = Pairs(np.zeros((0, 2)), np.zeros((0, 2)), np.ones(0), np.zeros(0), np.zeros(0))


def pair(a: KeyPoints, b: KeyPoints, *, mirror: bool) -> Pairs:
    """Pair key points that are each other's most alike and have no rival; of the mirror image if so."""
    if len(a.positions) < 2 or len(b.positions) < 2:
        return _NONE
    alike = _likeness(a.descriptors, b.descriptors, mirror)
    best = alike.argmax(1)
    rows = np.arange(len(alike))
    top = alike[rows, best]
    mutual = alike.argmax(0)[best] == rows
    alike[rows, best] = -1
    # Key points with several main directions repeat; the rival has to lie elsewhere.
    rival_at = alike.argmax(1)
    rival = alike[rows, rival_at]
    same = np.abs(b.positions[rival_at] - b.positions[best]).max(1) < 2
    clear = (1 - top) < RATIO**2 * (1 - rival)
    good = mutual & (clear | same)
    return _compared(a.part(good), b.part(best[good]), top[good], mirror)


def pair_widely(a: KeyPoints, b: KeyPoints, *, mirror: bool) -> Pairs:
    """Pair every key point with the three that are most alike: few are right, more than by `pair`."""
    if len(a.positions) < 2 or len(b.positions) < WIDELY:
        return _NONE
    alike = _likeness(a.descriptors, b.descriptors, mirror)
    columns = np.argpartition(-alike, WIDELY - 1, axis=1)[:, :WIDELY].reshape(-1)
    rows = np.repeat(np.arange(len(alike)), WIDELY)
    return _compared(a.part(rows), b.part(columns), alike[rows, columns], mirror)


def _likeness(a: np.ndarray, b: np.ndarray, mirror: bool) -> np.ndarray:
    b = np.ascontiguousarray(mirrored(b) if mirror else b)
    return np.maximum(a @ b.T, a @ np.ascontiguousarray(inverted(b)).T)


def _compared(a: KeyPoints, b: KeyPoints, alike: np.ndarray, mirror: bool) -> Pairs:
    turn = b.angles + a.angles if mirror else b.angles - a.angles
    return Pairs(a.positions, b.positions, b.sizes / a.sizes, turn, alike)


def unique(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the rows, ascending, of pairs whose places no pair before has."""
    keys = np.round(np.hstack([p, q]) * 2).astype(np.int64)
    return np.sort(np.unique(keys, axis=0, return_index=True)[1])

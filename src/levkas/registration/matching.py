"""Matching of descriptors: exact, by brute force in blocks, one to one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.problems import Problem
from levkas.registration.record import RegistrationRefused

if TYPE_CHECKING:
    from collections.abc import Callable

    from levkas.registration.features import KeyPoints

RATIO = 0.9
BLOCK_ROWS = 1024


@dataclass(frozen=True)
class Neighbours:
    """The two nearest target descriptors of every reference descriptor, and the way back.

    Parameters
    ----------
    nearest : ndarray of int, (n,)
    distance, second : ndarray, (n,)
        To the nearest and to the next; infinite where there is none.
    back : ndarray of int, (m,)
        Nearest reference descriptor of every target descriptor.
    """

    nearest: np.ndarray
    distance: np.ndarray
    second: np.ndarray
    back: np.ndarray


def match(
    reference: KeyPoints, target: KeyPoints, *, matching: str = "mutual-ratio", ratio: float = RATIO
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pair key points by their descriptors.

    Parameters
    ----------
    reference, target : KeyPoints
    matching : str
        A key of `METHODS`.
    ratio : float
        Largest ratio of nearest to second nearest distance, where the method asks for it.

    Returns
    -------
    rows, columns : ndarray of int, (k,)
        Pairs, ascending by row; no place in either picture stands in two of them.
    distance : ndarray, (k,)
        Of the descriptors.

    Raises
    ------
    RegistrationRefused
        Where there is no such method, or `ratio` is not in (0, 1].
    """
    if matching not in METHODS or not 0 < ratio <= 1:
        name, value = ("matching", matching) if matching not in METHODS else ("ratio", ratio)
        expected = ", ".join(sorted(METHODS)) if name == "matching" else "0 < ratio <= 1"
        raise RegistrationRefused(
            Problem(
                "E_VALUE",
                f"`{name}` cannot be used",
                field=f"registration.{name}",
                found=value,
                expected=expected,
            )
        )
    if not len(reference) or not len(target):
        return np.empty(0, int), np.empty(0, int), np.empty(0)
    found = find_neighbours(reference.descriptors, target.descriptors)
    rows = np.flatnonzero(METHODS[matching](found, ratio))
    columns, distance = found.nearest[rows], found.distance[rows]
    kept = _one_to_one(reference.points[rows], target.points[columns], distance)
    return rows[kept], columns[kept], distance[kept]


def find_neighbours(reference: np.ndarray, target: np.ndarray) -> Neighbours:
    """Return exact nearest neighbours of `reference`, (n, d), among `target`, (m, d).

    Distances of whole-numbered float32 descriptors are exact, so that the answer does not depend
    on the number of threads; among equals the first is taken.
    """
    n, m = len(reference), len(target)
    nearest, distance, second = np.empty(n, int), np.empty(n), np.full(n, np.inf)
    back, back_distance = np.zeros(m, int), np.full(m, np.inf)
    squares = _squares if reference.dtype != np.uint8 else _hamming_squares
    for start in range(0, n, BLOCK_ROWS):
        block = squares(reference[start : start + BLOCK_ROWS], target)
        here = np.arange(len(block))
        best = block.argmin(1)
        nearest[start : start + len(block)] = best
        least = block.min(0)
        closer = least < back_distance
        back[closer] = start + block.argmin(0)[closer]
        back_distance[closer] = least[closer]
        distance[start : start + len(block)] = np.sqrt(block[here, best])
        if m > 1:
            block[here, best] = np.inf
            second[start : start + len(block)] = np.sqrt(block.min(1))
    return Neighbours(nearest, distance, second, back)


def _squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    products = a @ b.T
    products *= -2
    products += np.einsum("ij,ij->i", a, a)[:, None]
    products += np.einsum("ij,ij->i", b, b)[None, :]
    return np.maximum(products, 0, out=products)


def _hamming_squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Squared Hamming distances, so that the root of each is what is compared."""
    bits_a = np.unpackbits(a, axis=1).astype(np.float32)
    bits_b = np.unpackbits(b, axis=1).astype(np.float32)
    different = bits_a.sum(1)[:, None] + bits_b.sum(1)[None, :] - 2 * (bits_a @ bits_b.T)
    return np.asarray(np.square(different, out=different))


def mutual_ratio(found: Neighbours, ratio: float) -> np.ndarray:
    """Pairs that are each other's nearest and clearly nearer than the next: (n,) bool."""
    return mutual(found, ratio) & lowe_ratio(found, ratio)


def mutual(found: Neighbours, ratio: float) -> np.ndarray:
    """Pairs that are each other's nearest: (n,) bool."""
    return np.asarray(found.back[found.nearest] == np.arange(len(found.nearest)))


def lowe_ratio(found: Neighbours, ratio: float) -> np.ndarray:
    """Pairs clearly nearer than the next: (n,) bool. VLFeat's default is 0.816."""
    return np.asarray(found.distance < ratio * found.second)


METHODS: dict[str, Callable[[Neighbours, float], np.ndarray]] = {
    "mutual-ratio": mutual_ratio,
    "mutual": mutual,
    "ratio": lowe_ratio,
}


def _one_to_one(reference: np.ndarray, target: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return sorted rows such that no place is used twice; nearer descriptors go first.

    Key points with two orientations stand at one place and would count twice.
    """
    _, at_reference = np.unique(reference, axis=0, return_inverse=True)
    _, at_target = np.unique(target, axis=0, return_inverse=True)
    at_reference, at_target = at_reference.ravel(), at_target.ravel()
    order = np.lexsort((np.arange(len(distance)), distance))
    taken_reference = np.zeros(len(reference), bool)
    taken_target = np.zeros(len(reference), bool)
    kept = []
    for i in order:
        if not (taken_reference[at_reference[i]] or taken_target[at_target[i]]):
            taken_reference[at_reference[i]] = taken_target[at_target[i]] = True
            kept.append(i)
    return np.sort(np.array(kept, int))

"""Matching of descriptors by brute force, exact and independent of the number of threads.

The paper's method matches one to one by a row of `MATCHERS` (`match`). The default method also accepts inverted
contrast and mirror images, and keeps how size, direction and descriptor of two key points compare
(`match_mutually`, `match_widely`): where most matches are wrong these show which agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np

from levkas.registration.features import KeyPoints, invert_descriptors, mirror_descriptors
from levkas.registration.record import refusal

#: Largest ratio of nearest to second nearest distance ([lowe2004]_ §7.1): one to one, and mutual.
RATIO, MUTUAL_RATIO = 0.9, 0.92
#: Candidates of every key point where matches are sought widely.
WIDELY = 3


@dataclass(frozen=True)
class Neighbours:
    """Two nearest target descriptors of every reference descriptor, and nearest reference descriptors."""

    nearest: np.ndarray
    """(n,)."""
    distance: np.ndarray
    second: np.ndarray
    """`distance`, `second`: (n,). To the nearest and to the next; infinite where there is none."""
    back: np.ndarray
    """(m,). Nearest reference descriptor of every target descriptor."""


def match(
    reference: KeyPoints, target: KeyPoints, *, matching: str = "mutual-ratio", ratio: float = RATIO
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pair key points by their descriptors.

    Raises RegistrationRefused where there is no such method, or `ratio` is not in (0, 1].

    Parameters
    ----------
    matching : str
        A key of `MATCHERS`.
    ratio : float
        Largest ratio of nearest to second nearest distance, where the method uses it.

    Returns
    -------
    rows, columns : ndarray of int, (k,)
        Pairs, ascending by row; no place in either picture is in two of them.
    distance : ndarray, (k,)
        Of the descriptors.
    """
    if matching not in MATCHERS or not 0 < ratio <= 1:
        name, value = ("matching", matching) if matching not in MATCHERS else ("ratio", ratio)
        expected = ", ".join(sorted(MATCHERS)) if name == "matching" else "0 < ratio <= 1"
        raise refusal(
            "E_VALUE",
            f"the value of `{name}` is not valid",
            field=f"registration.{name}",
            found=value,
            expected=expected,
        )
    if not len(reference) or not len(target):
        return np.empty(0, int), np.empty(0, int), np.empty(0)
    found = find_neighbours(reference.descriptors, target.descriptors)
    rows = np.flatnonzero(MATCHERS[matching](found, ratio))
    columns, distance = found.nearest[rows], found.distance[rows]
    kept = _one_to_one(reference.points[rows], target.points[columns], distance)
    return rows[kept], columns[kept], distance[kept]


def find_neighbours(reference: np.ndarray, target: np.ndarray) -> Neighbours:
    """Return exact nearest neighbours of `reference`, (n, d), among `target`, (m, d).

    Distances of whole-numbered float32 descriptors are exact, so that the answer does not depend
    on the number of threads.
    """
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if reference.dtype == np.uint8 else cv2.NORM_L2)
    found = matcher.knnMatch(reference, target, k=2)
    second = [pair[1].distance if len(pair) > 1 else np.inf for pair in found]
    back = [one.trainIdx for one in matcher.match(target, reference)]
    return Neighbours(
        np.array([pair[0].trainIdx for pair in found], int),
        np.array([pair[0].distance for pair in found], float),
        np.array(second, float),
        np.array(back, int),
    )


def mutual_ratio(found: Neighbours, ratio: float) -> np.ndarray:
    """Pairs that are each other's nearest and clearly nearer than the next: (n,) bool."""
    return mutual(found, ratio) & lowe_ratio(found, ratio)


def mutual(found: Neighbours, ratio: float) -> np.ndarray:
    """Pairs that are each other's nearest: (n,) bool."""
    return np.asarray(found.back[found.nearest] == np.arange(len(found.nearest)))


def lowe_ratio(found: Neighbours, ratio: float) -> np.ndarray:
    """Pairs clearly nearer than the next: (n,) bool. VLFeat's default is 0.816."""
    return np.asarray(found.distance < ratio * found.second)


MATCHERS: dict[str, Callable[[Neighbours, float], np.ndarray]] = {
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


# --- matches of either contrast, and of mirror images


@dataclass(frozen=True)
class TentativeMatches:
    """Matched places, and how size, direction and descriptor of the two compare; one row a match."""

    reference: np.ndarray
    target: np.ndarray
    """`reference`, `target`: (n, 2), px of either picture."""
    growth: np.ndarray
    """(n,). Size in the target over that in the reference."""
    turn: np.ndarray
    """(n,), degrees. Direction in the target less that in the reference; their sum in the mirror."""
    likeness: np.ndarray
    """(n,), -1..1. Dot product of the descriptors."""

    def __len__(self) -> int:
        return len(self.reference)

    @classmethod
    def joined(cls, parts: Sequence[TentativeMatches]) -> TentativeMatches:
        """Return all matches of all parts, each place once."""
        columns = [np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)]
        rows = unique_rows(columns[0], columns[1])
        return cls(*(column[rows] for column in columns))


_NONE = TentativeMatches(np.zeros((0, 2)), np.zeros((0, 2)), np.ones(0), np.zeros(0), np.zeros(0))


def match_mutually(a: KeyPoints, b: KeyPoints, *, mirror: bool) -> TentativeMatches:
    """Match key points that are each other's most alike and have no second candidate; of the mirror image if so."""
    if len(a) < 2 or len(b) < 2:
        return _NONE
    alike = _likeness(a.descriptors, b.descriptors, mirror)
    best = alike.argmax(1)
    rows = np.arange(len(alike))
    top = alike[rows, best]
    mutual = alike.argmax(0)[best] == rows
    alike[rows, best] = -1
    # Key points with several main directions repeat; the second candidate has to lie elsewhere.
    second_at = alike.argmax(1)
    second = alike[rows, second_at]
    same = np.abs(b.points[second_at] - b.points[best]).max(1) < 2
    clear = (1 - top) < MUTUAL_RATIO**2 * (1 - second)
    good = mutual & (clear | same)
    return _compared(a[good], b[best[good]], top[good], mirror)


def match_widely(a: KeyPoints, b: KeyPoints, *, mirror: bool) -> TentativeMatches:
    """Match every key point with the three that are most alike: few are right, more than mutual ones."""
    if len(a) < 2 or len(b) < WIDELY:
        return _NONE
    alike = _likeness(a.descriptors, b.descriptors, mirror)
    rows, best = np.arange(len(alike)), []
    for _ in range(WIDELY):
        columns = alike.argmax(1)
        best.append((columns, alike[rows, columns]))
        alike[rows, columns] = -np.inf
    columns, likeness = (np.stack(of, 1).reshape(-1) for of in zip(*best, strict=True))
    return _compared(a[np.repeat(rows, WIDELY)], b[columns], likeness, mirror)


def _likeness(a: np.ndarray, b: np.ndarray, mirror: bool) -> np.ndarray:
    b = np.ascontiguousarray(mirror_descriptors(b) if mirror else b)
    return np.maximum(a @ b.T, a @ np.ascontiguousarray(invert_descriptors(b)).T)


def _compared(a: KeyPoints, b: KeyPoints, alike: np.ndarray, mirror: bool) -> TentativeMatches:
    turn = b.angles + a.angles if mirror else b.angles - a.angles
    return TentativeMatches(a.points, b.points, b.sizes / a.sizes, turn, alike)


def unique_rows(reference: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the rows, ascending, of matches whose places no match before has."""
    keys = np.round(np.hstack([reference, target]) * 2).astype(np.int64)
    return np.sort(np.unique(keys, axis=0, return_index=True)[1])

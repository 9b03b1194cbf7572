"""Matching of descriptors by brute force, exact and independent of the number of threads.

The paper's method matches one to one by a row of `MATCHERS` (`match`). The default method also accepts inverted contrast and mirror
images, and keeps how size, direction and descriptor of two key points compare: where most matches are wrong these show which agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np

from levkas.registration.features import KeyPoints, invert_descriptors, mirror_descriptors
from levkas.registration.record import refusal

RATIO, MUTUAL_RATIO = 0.9, 0.92
"""Largest ratio of nearest to second nearest distance ([lowe2004]_ §7.1): one to one, and mutual. VLFeat's default is 0.816."""
WIDELY = 3
"""Candidates of every key point where matches are sought widely."""


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


def find_neighbours(reference: np.ndarray, target: np.ndarray) -> Neighbours:
    """Return exact nearest neighbours of `reference`, (n, d), among `target`, (m, d).

    Distances of whole-numbered float32 descriptors are exact, so that the answer does not depend on the number of threads.
    """
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if reference.dtype == np.uint8 else cv2.NORM_L2)
    found = matcher.knnMatch(reference, target, k=2)
    return Neighbours(
        np.array([pair[0].trainIdx for pair in found], int),
        np.array([pair[0].distance for pair in found], float),
        np.array([pair[1].distance if len(pair) > 1 else np.inf for pair in found], float),
        np.array([one.trainIdx for one in matcher.match(target, reference)], int),
    )


def _is_mutual(found: Neighbours) -> np.ndarray:
    return np.asarray(found.back[found.nearest] == np.arange(len(found.nearest)))


MATCHERS: dict[str, Callable[[Neighbours, float], np.ndarray]] = {
    "mutual-ratio": lambda f, ratio: _is_mutual(f) & (f.distance < ratio * f.second),
    "mutual": lambda f, ratio: _is_mutual(f),
    "ratio": lambda f, ratio: f.distance < ratio * f.second,
}
"""Which pairs are matches, (n,) bool: each other's nearest, clearly nearer than the next, or both."""


def match(
    reference: KeyPoints, target: KeyPoints, *, matching: str = "mutual-ratio", ratio: float = RATIO
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows and columns of the pairs, ascending by row, and distances of their descriptors, (k,) each.

    No place in either picture is in two of them: key points with two orientations stand at one place, and nearer descriptors go first.
    Raises RegistrationRefused where `matching` is no key of `MATCHERS`, or `ratio` is not in (0, 1].
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
    taken: tuple[set[tuple[float, ...]], ...] = set(), set()
    kept = []
    for i in np.argsort(distance, kind="stable"):
        places = tuple(reference.points[rows[i]]), tuple(target.points[columns[i]])
        if not any(place in used for place, used in zip(places, taken, strict=True)):
            for place, used in zip(places, taken, strict=True):
                used.add(place)
            kept.append(i)
    order = np.sort(np.array(kept, int))
    return rows[order], columns[order], distance[order]


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
    rows, best = np.arange(len(alike)), alike.argmax(1)
    top, mutual = alike[rows, best], alike.argmax(0)[best] == rows
    alike[rows, best] = -1
    # Key points with several main directions repeat; the second candidate has to lie elsewhere.
    second_at = alike.argmax(1)
    same = np.abs(b.points[second_at] - b.points[best]).max(1) < 2
    clear = (1 - top) < MUTUAL_RATIO**2 * (1 - alike[rows, second_at])
    good = mutual & (clear | same)
    return _compared(a[good], b[best[good]], top[good], mirror)


def match_widely(a: KeyPoints, b: KeyPoints, *, mirror: bool) -> TentativeMatches:
    """Match every key point with the three that are most alike: few are right, more than mutual ones."""
    if len(a) < 2 or len(b) < WIDELY:
        return _NONE
    alike = _likeness(a.descriptors, b.descriptors, mirror)
    rows, found = np.arange(len(alike)), []
    for _ in range(WIDELY):
        best = alike.argmax(1)
        found.append((best, alike[rows, best]))
        alike[rows, best] = -np.inf
    columns, likeness = (np.stack(of, 1).reshape(-1) for of in zip(*found, strict=True))
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

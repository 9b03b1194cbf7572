"""The search for overlaps of tiles: from key points, from positions, and from pairs by hand."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from levkas.geometry.transforms import Affine, Transform
from levkas.registration.advice import LEAST_PAIRS
from levkas.registration.bands import BandImage
from levkas.registration.manual_points import ManualPoints
from levkas.registration.tiles.neighbours import (
    STAGE_SHARE,
    TilePictures,
    correlate_tiles,
    match_tiles,
    near_pairs,
    repeats,
    similarity,
)
from levkas.registration.tiles.overlaps import NoOverlap, OverlapWindows, measure_overlap

#: Px by which a tile's place may be wrong before its first adjustment is refined.
PREDICTED_PX = 12.0
#: Of a tile's longer side: how far apart places are looked for that look alike, where no position is known.
REPEAT_SHARE = 0.5
Pair = tuple[str, str]


class OverlapSearch:
    """The overlaps of tiles as far as they are measured: those found, and why others are not.

    Parameters
    ----------
    starts : mapping of name to (x, y), px
        Where the first px of a tile lies, of those where it is known.
    by_hand : mapping of (name, name) to ManualPoints
        Pairs of two tiles, px of the first and of the second; the names in any order.
    """

    def __init__(
        self,
        tiles: Mapping[str, BandImage],
        starts: Mapping[str, tuple[float, float]],
        by_hand: Mapping[Pair, ManualPoints],
    ) -> None:
        self.names = sorted(tiles)
        self.pictures = TilePictures(tiles)
        self.starts = {name: starts[name] for name in self.names if name in starts}
        given = _in_order(by_hand)
        self.by_hand = {pair: one for pair, one in given.items() if set(pair) <= set(self.names)}
        self.found: dict[Pair, OverlapWindows] = {}
        self.missed: dict[Pair, str] = {}

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the first tile."""
        self.pictures[self.names[0]]
        height, width = self.pictures.shapes[self.names[0]]
        return width, height

    def run(self) -> None:
        """Measure every overlap of tiles that may be neighbours."""
        for pair in self._candidates():
            self._measure_from_key_points(pair)
        for pair, given in self.by_hand.items():
            self._measure_by_hand(pair, given)

    def measure_at(self, pair: Pair, onto: Transform) -> bool:
        """Measure an overlap about where it is predicted, px of the first tile → px of the second; return whether it is found."""
        return self._measure(pair, onto, PREDICTED_PX)

    def _candidates(self) -> list[Pair]:
        """Return the pairs that may overlap, in name order."""
        if len(self.starts) == len(self.names):
            return near_pairs(self.starts, self.size)
        return [(a, b) for k, a in enumerate(self.names) for b in self.names[k + 1 :]]

    def _measure_from_key_points(self, pair: Pair) -> None:
        """Measure an overlap from where key points put it, else from where positions do."""
        begin, expected = match_tiles(self.pictures, *pair), self._expected(pair)
        reach = STAGE_SHARE * max(self.size)
        if begin is not None and expected is not None:
            middle = np.array(self.size, float)[None] / 2
            astray = float(np.hypot(*(begin(middle) - expected(middle))[0]))
            begin = begin if astray <= 2 * reach else None
        if begin is not None and self._measure(pair, begin, 4.0):
            around = REPEAT_SHARE * max(self.size) if expected is None else reach
            first, second = (self.pictures[name] for name in pair)
            if not repeats(first, second, self.found[pair].transform, around):
                return
            del self.found[pair]
            self.missed[pair] = "repeats"
        elif expected is not None:
            self._measure_by_detail(pair, expected, reach)

    def _expected(self, pair: Pair) -> Affine | None:
        """Return px of one tile → px of another by their positions, where these are known."""
        if not all(name in self.starts for name in pair):
            return None
        shift = np.subtract(self.starts[pair[0]], self.starts[pair[1]])
        return Affine(np.array([[1.0, 0, shift[0]], [0, 1, shift[1]]]))

    def _measure_by_detail(self, pair: Pair, begin: Transform, reach: float) -> bool:
        first, second = (self.pictures[name] for name in pair)
        found = correlate_tiles(first, second, begin, reach)
        if found is None:
            outcome = measure_overlap(first, second, begin)
            self.missed[pair] = outcome.reason if isinstance(outcome, NoOverlap) else "unlike"
            return False
        return self._measure(pair, *found)

    def _measure(self, pair: Pair, begin: Transform, reach: float) -> bool:
        first, second = (self.pictures[name] for name in pair)
        outcome = measure_overlap(first, second, begin, reach=reach)
        if isinstance(outcome, NoOverlap):
            self.missed[pair] = outcome.reason
            return False
        self.found[pair] = outcome
        self.missed.pop(pair, None)
        return True

    def _measure_by_hand(self, pair: Pair, pairs: np.ndarray) -> None:
        """Measure an overlap from where a person's pairs put it."""
        begin = similarity(pairs[:, :2], pairs[:, 2:])
        before = self.found.get(pair)
        if before is not None:
            apart = begin(pairs[:, :2]) - before.transform(pairs[:, :2])
            if np.hypot(*apart.mean(0)) <= PREDICTED_PX:
                return
            del self.found[pair]
        self._measure(pair, begin, PREDICTED_PX)


def _in_order(by_hand: Mapping[Pair, ManualPoints]) -> dict[Pair, np.ndarray]:
    """Return pairs of two tiles each once, the tiles in name order; those that determine no place are not among them."""
    found: dict[Pair, np.ndarray] = {}
    for (first, second), given in sorted(by_hand.items(), key=lambda item: item[0]):
        pairs = given.fixed if first < second else given.fixed[:, [2, 3, 0, 1]]
        pair = (min(first, second), max(first, second))
        found[pair] = np.concatenate([found.get(pair, pairs[:0]), pairs])
    return {pair: pairs for pair, pairs in found.items() if len(pairs) >= LEAST_PAIRS}

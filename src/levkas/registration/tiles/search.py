"""Which tiles overlap: by given positions, by key points of all, and by pairs by hand; and whether they look alike elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations

import numpy as np
from scipy import fft

from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration.advice import LEAST_PAIRS
from levkas.registration.bands import BandImage, sqrt_images
from levkas.registration.features import CameraFeatures, KeyPoints
from levkas.registration.initial import fit_robustly
from levkas.registration.local_shifts import detail_on_grid
from levkas.registration.manual_points import ManualPoints
from levkas.registration.matching import match_mutually
from levkas.registration.tiles.overlaps import NoOverlap, OverlapWindows, measure_overlap

#: Pictures of tiles that are held at once.
HELD = 4
#: Longer side, px, to which a tile is reduced for key points; how many are kept of each.
LONG_SIDE, KEY_POINTS = 1200, 1500
#: Share of a tile by which a given position may be wrong; least of its narrow side that neighbours share along a side.
STAGE_SHARE, LEAST_SIDE = 0.15, 0.3
#: Px by which a tile's place may be wrong where key points put it, and where a first adjustment or a person does.
FOUND_PX, PREDICTED_PX = 4.0, 12.0
#: Of a tile's longer side: how far apart places are looked for that look alike, where no position is known.
REPEAT_SHARE = 0.5
#: Correlation of an overlap found by its detail alone, and of the second best place over it, up to which it is unique.
LEAST_CORRELATION, MOST_SECOND = 0.2, 0.8
#: Of scatter by chance, up to which a correlation is none; px of detail that are alike.
CHANCE, GRAIN_PX = 5.0, 12
#: Longer side of the pictures of which detail is correlated, and of those in which repetition is looked for; least share of a tile that
#: has to overlap; px apart of a second place.
CORRELATED_SIDE, REPEATED_SIDE, LEAST_COMMON, APART_PX = 512, 320, 0.01, 6
Pair = tuple[str, str]


@dataclass(eq=False)
class OverlapSearch:
    """The overlaps of tiles as far as they are measured: those found, and why others are not.

    `starts` is where the first px of tiles lie, (x, y) px, where that is known; `given` are pairs by hand of two tiles, px of the first
    and of the second, the names in any order.
    """

    tiles: Mapping[str, BandImage]
    starts: Mapping[str, tuple[float, float]]
    given: Mapping[Pair, ManualPoints]
    found: dict[Pair, OverlapWindows] = field(default_factory=dict)
    missed: dict[Pair, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = sorted(self.tiles)
        self.by_hand = {p: one for p, one in _in_order(self.given).items() if {*p} <= {*self.names}}
        height, width = self.tiles[self.names[0]].values.shape
        self.size = width, height
        self.picture = lru_cache(HELD)(self._picture)
        self._key_points = lru_cache(None)(self._find_key_points)

    def _picture(self, name: str) -> np.ndarray:
        """Return the square root of a tile, (h, w), NaN where invalid."""
        band = self.tiles[name]
        return sqrt_images([band])[band.label]

    def _find_key_points(self, name: str) -> KeyPoints:
        found = CameraFeatures([self.picture(name)]).key_points(LONG_SIDE, 0)
        return found[np.arange(min(KEY_POINTS, len(found)))]

    def run(self) -> None:
        """Measure every overlap of tiles that may be neighbours."""
        for pair in combinations(self.names, 2):
            expected = self._expected(pair)
            if expected is None or _may_touch(expected, self.size):
                self._find(pair, expected)
        for pair, pairs in self.by_hand.items():
            begin, before = similarity(pairs[:, :2], pairs[:, 2:]), self.found.get(pair)
            if before is not None:
                apart = begin(pairs[:, :2]) - before.transform(pairs[:, :2])
                if np.hypot(*apart.mean(0)) <= PREDICTED_PX:
                    continue
                del self.found[pair]
            self.measure(pair, begin)

    def measure(self, pair: Pair, begin: Transform, reach: float = PREDICTED_PX) -> bool:
        """Measure an overlap about where it may be, px of the first tile → px of the second; return whether it is found."""
        first, second = map(self.picture, pair)
        outcome = measure_overlap(first, second, begin, reach=reach)
        if isinstance(outcome, NoOverlap):
            self.missed[pair] = outcome.reason
            return False
        self.found[pair] = outcome
        self.missed.pop(pair, None)
        return True

    def _expected(self, pair: Pair) -> Affine | None:
        """Return px of one tile → px of another by their positions, where all are known."""
        if any(name not in self.starts for name in self.names):
            return None
        return Affine.of_box(*np.subtract(self.starts[pair[0]], self.starts[pair[1]]))

    def _find(self, pair: Pair, expected: Affine | None) -> None:
        """Measure an overlap from where key points put it, else from where positions do."""
        first, second = map(self.picture, pair)
        begin, reach = self._by_key_points(pair), STAGE_SHARE * max(self.size)
        if begin is not None and expected is not None:
            middle = np.array(self.size, float)[None] / 2
            astray = float(np.hypot(*(begin(middle) - expected(middle))[0]))
            begin = begin if astray <= 2 * reach else None
        if begin is not None and self.measure(pair, begin, FOUND_PX):
            around = REPEAT_SHARE * max(self.size) if expected is None else reach
            shifts = _Shifts.of(first, second, self.found[pair].transform, around, REPEATED_SIDE)
            if shifts.repeats((0, 0)):
                del self.found[pair]
                self.missed[pair] = "repeats"
        elif expected is not None:
            found = correlate_tiles(first, second, expected, reach)
            if found is not None:
                self.measure(pair, *found)
                return
            outcome = measure_overlap(first, second, expected)
            self.missed[pair] = outcome.reason if isinstance(outcome, NoOverlap) else "unlike"

    def _by_key_points(self, pair: Pair) -> Transform | None:
        matches = match_mutually(*map(self._key_points, pair), mirror=False)
        found = fit_robustly(matches, False, self.picture(pair[0]).shape)
        if found is None:
            return None
        # Few points of a narrow overlap determine no perspective.
        return similarity(found.reference[found.kept], found.target[found.kept])


def similarity(points: np.ndarray, partners: np.ndarray) -> Affine:
    """Return the turned, scaled and moved frame, px → px, that fits best by least squares; never mirrored, however narrow the overlap.

    >>> corners = np.array([[0.0, 0], [2, 0], [0, 2]])
    >>> similarity(corners, corners @ [[0, 1], [-1, 0]] + 5).matrix.round(9).tolist()
    [[0.0, -1.0, 5.0], [1.0, 0.0, 5.0]]
    """
    middle, other = points.mean(0), partners.mean(0)
    z, w = (points - middle) @ (1, 1j), (partners - other) @ (1, 1j)
    turn = (z.conj() @ w) / max(float((z.conj() @ z).real), 1e-12)
    linear = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    return Affine(np.column_stack([linear, other - linear @ middle]))


def _may_touch(expected: Affine, size: tuple[int, int]) -> bool:
    """Return whether boxes of one size touch by more than a corner, if each is wrong by up to `STAGE_SHARE` of it."""
    across = np.array(size) - np.abs(expected.matrix[:, 2])
    return bool(
        (across + STAGE_SHARE * np.array(size) > 0).all() and across.max() > LEAST_SIDE * min(size)
    )


def _in_order(by_hand: Mapping[Pair, ManualPoints]) -> dict[Pair, np.ndarray]:
    """Return pairs of two tiles each once, the tiles in name order; those that determine no place are not among them."""
    found: dict[Pair, np.ndarray] = {}
    for (first, second), given in sorted(by_hand.items(), key=lambda item: item[0]):
        pairs = given.fixed if first < second else given.fixed[:, [2, 3, 0, 1]]
        pair = (min(first, second), max(first, second))
        found[pair] = np.concatenate([found.get(pair, pairs[:0]), pairs])
    return {pair: pairs for pair, pairs in found.items() if len(pairs) >= LEAST_PAIRS}


def correlate_tiles(
    first: np.ndarray, second: np.ndarray, begin: Affine, reach: float
) -> tuple[Transform, float] | None:
    """Return px of the first → px of the second tile by the detail of both, and how far it may be wrong, px; None where no shift stands out.

    `first` and `second` are (h, w), float32, NaN where invalid; `begin` goes px of the first → px of the second, of which shifts up
    to `reach` px are tried.
    """
    found = _Shifts.of(first, second, begin, reach, CORRELATED_SIDE)
    row, column = np.unravel_index(int(found.scores.argmax()), found.scores.shape)
    best = int(found.across[column]), int(found.down[row])
    if found.scores[row, column] < LEAST_CORRELATION or found.repeats(best):
        return None
    moved = Composed(Affine.of_box(*(found.step * np.array(best))), begin)
    return moved, 2.0 * found.step


@dataclass(frozen=True)
class _Shifts:
    """Correlations of the detail of two tiles by shift, (rows, columns), 0 where they are not beyond chance; shifts are in `step` px."""

    scores: np.ndarray
    down: np.ndarray
    across: np.ndarray
    step: int

    @classmethod
    def of(
        cls, first: np.ndarray, second: np.ndarray, begin: Transform, reach: float, side: int
    ) -> _Shifts:
        step = max(1, -(-max(first.shape) // side))
        pad = int(np.ceil(reach / step))
        wide = first.shape[0] // step + 2 * pad, first.shape[1] // step + 2 * pad
        corner = Affine.of_box(-pad * step, -pad * step)
        one = detail_on_grid(first, corner, wide, step=step)
        two = detail_on_grid(second, Composed(corner, begin), wide, step=step)
        shape = [fft.next_fast_len(n + pad + 1, real=True) for n in wide]

        def spectra(image: np.ndarray) -> list[np.ndarray]:
            detail = np.nan_to_num(image).astype(float)
            return [fft.rfft2(v, shape) for v in (detail, detail**2, np.isfinite(image) * 1.0)]

        def against(u: np.ndarray, v: np.ndarray) -> np.ndarray:
            return np.asarray(fft.irfft2(np.conj(u) * v, shape))

        (a, a2, known), (b, b2, other) = spectra(one), spectra(two)
        common = np.maximum(against(known, other), 1.0)
        energy = against(a2, other) * against(known, b2)
        enough = common > LEAST_COMMON * first.size / step**2
        enough &= energy > 1e-6 * float(energy[enough].max(initial=0.0))
        scores = np.where(enough, against(a, b) / np.sqrt(np.where(enough, energy, 1.0)), 0.0)
        scores = np.where(scores > CHANCE / np.sqrt(common / GRAIN_PX), scores, 0.0)
        down, across = (np.fft.fftfreq(n, 1 / n).astype(int) for n in shape)
        scores[(np.abs(down)[:, None] > pad) | (np.abs(across)[None, :] > pad)] = 0
        return cls(scores, down, across, step)

    def repeats(self, shift: tuple[int, int]) -> bool:
        """Whether another shift, (x, y), matches about as well as this one, as a repeated ornament does."""
        apart = np.hypot(self.down[:, None] - shift[1], self.across[None, :] - shift[0])
        here = float(self.scores[apart <= APART_PX / 2].max(initial=0))
        return float(self.scores[apart > APART_PX].max(initial=0)) > MOST_SECOND * here

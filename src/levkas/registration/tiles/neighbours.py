"""Which tiles may overlap, and roughly how: by given positions, or by key points of all."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.spatial import cKDTree

from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration.bands import BandImage, sqrt_images
from levkas.registration.features import CameraFeatures, KeyPoints
from levkas.registration.initial import fit_robustly
from levkas.registration.local_shifts import detail_on_grid
from levkas.registration.matching import match_mutually

#: Pictures of tiles that are held at once.
HELD = 4
#: Longer side, px, to which a tile is reduced for key points; how many are kept of each.
LONG_SIDE, KEY_POINTS = 1200, 1500
#: Share of a tile by which a given position may be wrong.
STAGE_SHARE = 0.15
#: Correlation of an overlap found by its detail alone, and of the second best place over it, up to which it is unique.
LEAST_CORRELATION, MOST_SECOND = 0.2, 0.8
#: Of scatter by chance, up to which a correlation is none; px of detail that are alike.
CHANCE, GRAIN_PX = 5.0, 12
#: Longer side of the pictures of which detail is correlated, and of those in which repetition is looked for; least share of a tile that has to overlap; px apart of a second place.
CORRELATED_SIDE, REPEATED_SIDE, LEAST_COMMON, APART_PX = 512, 320, 0.01, 6


class TilePictures:
    """Pictures of tiles, read when they are needed; few are held, and key points of all."""

    def __init__(self, tiles: Mapping[str, BandImage]) -> None:
        self._tiles = tiles
        self._pictures: OrderedDict[str, np.ndarray] = OrderedDict()
        self._points: dict[str, KeyPoints] = {}
        self.shapes: dict[str, tuple[int, int]] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the square root of a tile, (h, w), NaN where invalid."""
        if name not in self._pictures:
            while len(self._pictures) >= HELD:
                self._pictures.popitem(last=False)
            band = self._tiles[name]
            self._pictures[name] = sqrt_images([band])[band.label]
            height, width = band.values.shape
            self.shapes[name] = height, width
        self._pictures.move_to_end(name)
        return self._pictures[name]

    def key_points(self, name: str) -> KeyPoints:
        """Return the strongest key points of a tile."""
        if name not in self._points:
            found = CameraFeatures([self[name]]).key_points(LONG_SIDE, 0)
            self._points[name] = found[np.arange(min(KEY_POINTS, len(found)))]
        return self._points[name]


def match_tiles(pictures: TilePictures, first: str, second: str) -> Transform | None:
    """Return px of the first → px of the second tile as key points have it, or None."""
    ours, theirs = pictures.key_points(first), pictures.key_points(second)
    matches = match_mutually(ours, theirs, mirror=False)
    found = fit_robustly(matches, False, pictures.shapes[first])
    if found is None:
        return None
    # Few points of a narrow overlap determine no perspective.
    points, partners = found.reference[found.kept], found.target[found.kept]
    return similarity(points, partners)


def similarity(points: np.ndarray, partners: np.ndarray) -> Affine:
    """Return the turned, scaled and moved frame, px → px, that fits best by least squares.

    >>> corners = np.array([[0.0, 0], [2, 0], [0, 2]])
    >>> similarity(corners, corners @ [[0, 1], [-1, 0]] + 5).matrix.round(9).tolist()
    [[0.0, -1.0, 5.0], [1.0, 0.0, 5.0]]
    """
    middle, other = points.mean(0), partners.mean(0)
    (x, y), (u, v) = (points - middle).T, (partners - other).T
    size = max(float((x * x + y * y).sum()), 1e-12)
    a, b = float((x * u + y * v).sum()) / size, float((x * v - y * u).sum()) / size
    linear = np.array([[a, -b], [b, a]])
    return Affine(np.column_stack([linear, other - linear @ middle]))


def near_pairs(
    places: Mapping[str, tuple[float, float]], size: tuple[int, int], slack: float = STAGE_SHARE
) -> list[tuple[str, str]]:
    """Return the pairs of tiles of one size, in name order, whose boxes touch if each is wrong by up to `slack` of its size.

    >>> near_pairs({"a": (0, 0), "b": (90, 0), "c": (180, 0)}, (100, 50))
    [('a', 'b'), ('b', 'c')]
    """
    names = sorted(places)
    box = np.tile(np.array(size, float), (len(names), 1))
    corner = np.array([places[name] for name in names], float)
    reach = float((box * (1 + slack)).max())
    pairs = cKDTree(corner).query_pairs(reach, p=np.inf, output_type="ndarray")
    near = []
    for i, j in sorted(map(tuple, np.sort(pairs, axis=1).tolist())):
        low, high = (
            np.maximum(corner[i], corner[j]),
            np.minimum(corner[i] + box[i], corner[j] + box[j]),
        )
        room = high - low + slack * np.minimum(box[i], box[j])
        across = high - low
        # Corners alone hold too little.
        if (room > 0).all() and across.max() > 0.3 * min(box[i].min(), box[j].min()):
            near.append((names[i], names[j]))
    return near


def correlate_tiles(
    first: np.ndarray, second: np.ndarray, begin: Transform, reach: float
) -> tuple[Transform, float] | None:
    """Return px of the first → px of the second tile by the detail of both, and how far it may be wrong, px; None where no shift stands out.

    Parameters
    ----------
    first, second : ndarray, (h, w), float32
        NaN where invalid.
    begin : Transform
        Px of the first → px of the second.
    reach : float, px
        Shifts that are tried.
    """
    found = _Correlation.of(first, second, begin, reach, CORRELATED_SIDE)
    best = found.best
    if best is None or found.repeats(best):
        return None
    shift = np.array(best) * found.step
    moved = Composed(Affine(np.array([[1.0, 0, shift[0]], [0, 1, shift[1]]])), begin)
    return moved, 2.0 * found.step


def repeats(first: np.ndarray, second: np.ndarray, found: Transform, reach: float) -> bool:
    """Whether two tiles that match under `found` match about as well shifted by up to `reach` px, as a repeated ornament does."""
    correlation = _Correlation.of(first, second, found, reach, REPEATED_SIDE)
    return correlation.repeats((0, 0))


@dataclass(frozen=True)
class _Correlation:
    """Correlations of the detail of two tiles by shift, (rows, columns), 0 where they are not beyond chance, and px per px of these."""

    scores: np.ndarray
    down: np.ndarray
    across: np.ndarray
    step: int

    @classmethod
    def of(
        cls, first: np.ndarray, second: np.ndarray, begin: Transform, reach: float, side: int
    ) -> _Correlation:
        step = max(1, -(-max(first.shape) // side))
        pad = int(np.ceil(reach / step))
        wide = first.shape[0] // step + 2 * pad, first.shape[1] // step + 2 * pad
        corner = Affine(np.array([[1.0, 0, -pad * step], [0, 1, -pad * step]]))
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
        scores = against(a, b)
        enough = common > LEAST_COMMON * first.size / step**2
        floor = 1e-6 * float(energy[enough].max(initial=0.0))
        enough &= energy > floor
        scores = np.where(enough, scores / np.sqrt(np.where(enough, energy, 1.0)), 0.0)
        scores = np.where(scores > CHANCE / np.sqrt(common / GRAIN_PX), scores, 0.0)
        down, across = (np.fft.fftfreq(n, 1 / n).astype(int) for n in shape)
        scores[(np.abs(down)[:, None] > pad) | (np.abs(across)[None, :] > pad)] = 0
        return cls(scores, down, across, step)

    @property
    def best(self) -> tuple[int, int] | None:
        """The shift (x, y) by which the second tile has what the first has, or None."""
        row, column = np.unravel_index(int(self.scores.argmax()), self.scores.shape)
        if self.scores[row, column] < LEAST_CORRELATION:
            return None
        return int(self.across[column]), int(self.down[row])

    def repeats(self, shift: tuple[int, int]) -> bool:
        """Whether another shift matches about as well as this one."""
        apart = np.hypot(self.down[:, None] - shift[1], self.across[None, :] - shift[0])
        here = float(self.scores[apart <= APART_PX / 2].max(initial=0))
        return float(self.scores[apart > APART_PX].max(initial=0)) > MOST_SECOND * here

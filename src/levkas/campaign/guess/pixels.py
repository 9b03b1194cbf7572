"""Statistics of frames, decoded once, and the mosaics that they show."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from levkas.calibration.codes import SceneShots, find_full_scale
from levkas.calibration.patterns import thin_periods
from levkas.calibration.sight import LAMP, Sight, difference_between
from levkas.core.problems import Refused
from levkas.core.transpose import block_means

if TYPE_CHECKING:
    from levkas.calibration.codes import FullScale
    from levkas.campaign.guess.listing import CaptureFile

LARGEST_TILE = 5
LEAST_SPAN = 0.06
"""Phases of a mosaic differ by more of their mean; rows and columns of a plain sensor do not."""
BLOCKS = 24
EVEN, SMOOTH = 0.6, 0.04
"""A white's illumination may fall off by this share; from sensel to sensel it hardly differs."""
GREENS_ALIKE = 0.03
"""The two greens of a Bayer tile differ by less of their mean, other colours by more."""
FIRST = "whether red or blue comes first in the mosaic"
DIAGONALS = (((0, 0), (1, 1)), ((0, 1), (1, 0)))
T = TypeVar("T")
MOST_SAMPLED, FEW_SHOTS = 6, 3
"""Frames of one kind that are decoded, and of one scene that are compared."""
BLOCK, MOST_CODES = 60, 1 << 17
"""Rows that are taken together, whole mosaics', and values of a frame by which the full scale is looked for."""
LINES = 64
"""Of a cube: read from its middle, fewer where they would be more than `LARGEST_SAMPLE` values."""


@dataclass(frozen=True)
class Statistics:
    """Numbers of one frame.

    Parameters
    ----------
    mean, low, high : float
        Mean, and 1st and 99th percentiles, counts.
    top, top_count : int
        Highest code and how many samples have it.
    step : int
        Largest number that divides every code; 16 where 12 bits stand at the upper end of 16.
    unevenness : float
        Spread of block means (5th to 95th percentile) over their median.
    texture : float
        Median spread beside that of the light over the median level, sensels of one phase compared.
    phases : dict
        Tile side p → (p, p) means, for sides 2 to 5.
    """

    mean: float
    low: float
    high: float
    top: int
    top_count: int
    step: int
    unevenness: float
    texture: float
    phases: dict[int, np.ndarray]

    @property
    def is_even(self) -> bool:
        """Whether it may be a white: the light falls off by less than a share, and sensels side by side are alike."""
        return self.unevenness < EVEN and self.texture < SMOOTH


def describe_pixels(values: np.ndarray) -> Statistics:
    """Describe one frame.

    Parameters
    ----------
    values : ndarray, (height, width), any real dtype
        Counts; what is no finite number counts as the median of the others.

    Examples
    --------
    >>> frame = np.full((60, 60), 4080, np.uint16)
    >>> frame[::2, ::2] = 1600
    >>> found = describe_pixels(frame)
    >>> found.top, found.step, find_mosaic(found.phases)
    (4080, 80, 2)
    """
    plane = _finite(np.asarray(values))
    counts = plane.astype(np.float32)
    low, high = (float(v) for v in np.percentile(counts, (1, 99)))
    top = plane.max(initial=0)
    block = block_means(counts.astype(np.float64), 1 + min(counts.shape) // BLOCKS)
    level = float(np.median(block)) or 1.0
    p5, p95 = np.percentile(block, (5, 95))
    return Statistics(
        mean=float(counts.mean(dtype=np.float64)),
        low=low,
        high=high,
        top=int(top),
        top_count=int(np.count_nonzero(plane == top)),
        step=_step(plane),
        unevenness=float(p95 - p5) / abs(level),
        texture=_texture(counts) / abs(level),
        phases={side: phase_means(counts, side) for side in range(2, LARGEST_TILE + 1)},
    )


def _finite(plane: np.ndarray) -> np.ndarray:
    if plane.dtype.kind != "f":
        return plane
    most = float(np.finfo(np.float32).max) / max(plane.size, 1)  # so that their sum is finite too
    good = np.abs(plane.astype(np.float64)) <= most
    return (
        plane if good.all() else np.where(good, plane, np.median(plane[good]) if good.any() else 0)
    )


def phase_means(values: np.ndarray, side: int) -> np.ndarray:
    """Return the mean of each phase of a tile of `side` x `side` sensels, (side, side)."""
    height, width = (n // side * side for n in values.shape)
    tiles = values[:height, :width].reshape(height // side, side, width // side, side)
    return np.asarray(tiles.mean(axis=(0, 2), dtype=np.float64))


def find_mosaic(phases: dict[int, np.ndarray], *, dark: float = 0.0) -> int:
    """Return the side of the mosaic's tile that phase means show, 0 for none.

    Parameters
    ----------
    phases : dict
        As `Statistics.phases`, of a bright frame.
    dark : float
        Level without light, counts.

    Examples
    --------
    >>> flat = {p: np.ones((p, p)) for p in (2, 3, 4, 5)}
    >>> find_mosaic(flat), find_mosaic(flat | {3: np.arange(1.0, 10).reshape(3, 3)})
    (0, 3)
    >>> find_mosaic({p: np.full((p, p), np.nan) for p in (2, 3, 4, 5)})
    0
    """
    spans = {
        # A frame no brighter than its dark shows noise, not colours.
        side: float(np.ptp(means)) / max(means.mean() - dark, 0.1 * means.mean(), 1e-9)
        for side, means in phases.items()
    }
    # A frame smaller than a tile has no mean of every phase.
    spans = {side: span for side, span in spans.items() if np.isfinite(span)}
    best = max(spans.values(), default=0.0)
    if best < LEAST_SPAN:
        return 0
    # A tile of 4 shows what one of 2 is: the smallest that shows nearly all of it is meant.
    return next(side for side in sorted(spans) if spans[side] > 0.8 * best)


def bits_of(top: int, step: int) -> int:
    """Return the fewest bits, of those that sensors have, that hold codes up to `top`.

    >>> bits_of(4095, 1), bits_of(65520, 16), bits_of(5000, 1)
    (12, 12, 14)
    """
    shift = max(step, 1).bit_length() - 1
    return next((bits for bits in (8, 10, 12, 14) if top >> shift < 1 << bits), 16)


def _texture(values: np.ndarray) -> float:
    """Return the median absolute difference of sensels 60 apart, a multiple of every tile's side.

    That of the columns' means is taken off: the light's fall, which a white shows as well.
    """
    step = 60 if min(values.shape) > 180 else 2
    light = values.mean(axis=0, keepdims=True)
    across = np.abs(values[:, step:] - values[:, :-step] - (light[:, step:] - light[:, :-step]))
    return float(np.median(across)) if across.size else 0.0


def _step(values: np.ndarray) -> int:
    if values.dtype.kind not in "ui" or values.dtype.itemsize > 2:
        return 1
    codes = np.unique(values)
    return max(1, int(np.gcd.reduce(codes.astype(np.int64)))) if codes.size > 1 else 1


@dataclass(frozen=True)
class GuessedMosaic:
    """A guessed mosaic: rows of channel names, why, and what remains unknown ("" for nothing)."""

    rows: tuple[tuple[str, ...], ...]
    why: str
    unknown: str = ""

    @property
    def letters(self) -> str:
        """``"RGGB"`` of a Bayer mosaic, else ""."""
        flat = [name for row in self.rows for name in row]
        return "".join(flat) if all(len(name) == 1 for name in flat) else ""


def name_mosaic(
    side: int,
    bright: np.ndarray,
    *,
    dark: float = 0.0,
    shown: Mapping[str, np.ndarray] | None = None,
) -> GuessedMosaic:
    """Name the channels of a mosaic.

    Parameters
    ----------
    side : int
        Of its tile, sensels.
    bright : ndarray, (side, side)
        Phase means of a white, or of an object where there is none; counts.
    dark : float
        Level without light.
    shown : mapping of object to ndarray, optional
        Phase means of objects, where `bright` is a white.

    Examples
    --------
    >>> white = np.array([[2189.0, 3011.0], [3011.0, 1949.0]])
    >>> icon = {"icon": np.array([[455.0, 333.0], [332.0, 177.0]])}
    >>> name_mosaic(2, white, dark=66, shown=icon).letters
    'RGGB'
    """
    diagonal = _greens(bright - dark) if side == 2 else None
    if diagonal is None:
        names = [f"B{i + 1}" for i in range(side * side)]
        rows = tuple(tuple(names[r * side : (r + 1) * side]) for r in range(side))
        unknown = "the sensitivity of each channel of the mosaic: the names are in reading order"
        return GuessedMosaic(rows, f"levels repeat every {side} sensels", unknown)
    greens, ends = (DIAGONALS[diagonal], DIAGONALS[1 - diagonal])
    red, why = _first_is_red(ends, bright - dark, dark, shown or {})
    grid = np.full((2, 2), "B", dtype=object)
    grid[greens[0]] = grid[greens[1]] = "G"
    grid[ends[0] if red else ends[1]] = "R"
    rows = tuple(tuple(str(n) for n in row) for row in grid)
    return GuessedMosaic(rows, f"two phases on a diagonal are alike, so they are green{why}", FIRST)


def _first_is_red(
    ends: tuple[tuple[int, int], tuple[int, int]],
    bright: np.ndarray,
    dark: float,
    shown: Mapping[str, np.ndarray],
) -> tuple[bool, str]:
    """Return whether the first of two phases is assumed to be the red one, and why."""
    votes = []
    for phases in shown.values():
        first, last = (max(phases[p] - dark, 1e-3) / max(bright[p], 1e-3) for p in ends)
        votes.append(float(np.log(first / last)))
    why = (
        "; red is the phase in which the object is brighter relative to the white, as paintings are"
    )
    return sum(votes) >= 0, why if votes else ""


def _greens(levels: np.ndarray) -> int | None:
    """Return which of `DIAGONALS` holds two like phases; None for neither or both."""

    def differ(a: float, b: float) -> float:
        return abs(a - b) / max(0.5 * (a + b), 1e-9)

    main, other = differ(levels[0, 0], levels[1, 1]), differ(levels[0, 1], levels[1, 0])
    if min(main, other) > GREENS_ALIKE or max(main, other) < 2 * min(main, other) + 0.01:
        return None
    return 0 if main < other else 1


# --- frames, decoded once ---------------------------------------------------------------------


def spread(things: Sequence[T], count: int) -> list[T]:
    """Return up to `count` of some things, evenly over all.

    >>> spread("abcdefg", 3)
    ['a', 'd', 'g']
    """
    places = np.linspace(0, len(things) - 1, min(count, len(things))).round()
    return [things[int(i)] for i in np.unique(places)] if things else []


class Framed(Protocol):
    """A frame, whatever it is called."""

    @property
    def file(self) -> CaptureFile:
        """The capture."""


class Samples:
    """Statistics of frames by path, decoded on first use."""

    def __init__(self) -> None:
        self._known: dict[Path, Statistics | None] = {}
        self._codes: dict[Path, np.ndarray] = {}
        self._sights: dict[tuple[Path, int], Sight] = {}
        self.refused: dict[str, str] = {}

    def of(self, capture: CaptureFile) -> Statistics | None:
        """Return the statistics of one frame; None where it cannot be decoded."""
        if capture.path not in self._known:
            try:
                plane = _plane(capture)
                self._known[capture.path] = describe_pixels(plane)
                self._codes[capture.path] = thin_periods(plane, BLOCK, MOST_CODES)
            except Refused as refused:
                self._known[capture.path] = None
                self.refused[capture.name] = str(refused.problems[0])
            except ValueError:
                self._known[capture.path] = None
        return self._known[capture.path]

    def of_some(self, frames: Sequence[Framed], count: int) -> list[Statistics]:
        """Return the statistics of up to `count` frames, spread over all."""
        found = (self.of(frame.file) for frame in spread(frames, count))
        return [statistics for statistics in found if statistics is not None]

    def full_scale(self, of_role: Callable[[str], Sequence[Framed]]) -> FullScale | None:
        """Return the counts at which frames of a camera pile up, by their roles; None where they do not."""
        looked = {
            role: [
                self._codes[frame.file.path]
                for frame in spread(of_role(role), MOST_SAMPLED)
                if self.of(frame.file) is not None
            ]
            for role in ("object", "chart", "white", "dark")
        }
        dark = looked.pop("dark")
        lit = [
            SceneShots([codes], role == "white") for role, some in looked.items() for codes in some
        ]
        return find_full_scale(lit, dark, period=BLOCK)

    def difference(self, captures: Sequence[CaptureFile], black: float = 0.0) -> str:
        """Return in what some frames differ by more than shots do, as `difference_between`; "" in nothing that is known."""
        some = [(c, one) for c in spread(captures, FEW_SHOTS) if (one := self.of(c)) is not None]
        side = max((find_mosaic(one.phases) for _, one in some), default=0) or 1
        for capture, one in some[1:]:
            first, sight = (self._sight(c, side) for c in (some[0][0], capture))
            if found := difference_between(first, sight, black):
                return found[0]
            dim, bright = sorted(max(s.mean - black, 1e-9) for s in (some[0][1], one))
            if bright > (1 + LAMP) * dim:  # of frames too small, or without anything to compare
                return "exposure"
        return ""

    def _sight(self, capture: CaptureFile, side: int) -> Sight:
        if (capture.path, side) not in self._sights:
            self._sights[capture.path, side] = Sight.of(_plane(capture), (side, side))
        return self._sights[capture.path, side]


def _plane(capture: CaptureFile) -> np.ndarray:
    """Read one plane: of a cube the brightest band of a few lines, of a photograph the mean."""
    if capture.facts.is_cube:
        block = _middle_lines(capture)
        return np.asarray(block[:, :, int(block.mean(axis=(0, 1), dtype=np.float64).argmax())])
    from levkas.readers.frames import read_sample

    values = read_sample(capture.path)
    return values if values.ndim == 2 else values[..., :3].mean(axis=2, dtype=np.float32)


def _middle_lines(capture: CaptureFile) -> np.ndarray:
    """Read some lines of a cube, (lines, samples, bands)."""
    from levkas.readers.envi import open_envi
    from levkas.readers.facts import check_memory
    from levkas.readers.frames import LARGEST_SAMPLE, read_frame

    lines, samples, bands = capture.facts.shape
    count = max(1, min(LINES, LARGEST_SAMPLE // (samples * bands)))
    start = max(0, lines // 2 - count // 2)
    stop = min(lines, start + count)
    if capture.facts.kind != "envi":  # its lines cannot be read apart
        return read_frame(capture.path)[start:stop]
    cube = open_envi(capture.path)
    check_memory(capture.path, count * samples * bands, np.dtype(cube.layout).itemsize)
    return cube.read_lines(start, stop)

"""What the codes of raw frames show: their spacing and place in a word, the bits that they have, and the code at which a sensor is full.

The hard end of a converter is one code, at which pixels pile up; a full well with read-out noise behind it is a hill of codes. Noise
never falls with the light, for photons have shot noise: values at the top that differ less than dimmer ones show no light any more.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.calibration.findings import Finding
from levkas.readers.compared_facts import Severity

if TYPE_CHECKING:
    from levkas.readers.facts import Facts

AT_A_TIME, MOST_CODES = 1 << 20, 1 << 16
"""Codes that are counted at a time: NumPy makes whole numbers of 8 bytes of them; codes of 16 bits."""
FEWEST_LEVELS, FILLED, STRAY = 64, 4, 0.01
"""Codes that show a spacing; pixels of each; share of codes between the others: saturated ones, and defects that a camera replaced."""
SHIFTS, LEAST_COUNTS = (2, 4), 16
"""Spacing over another's from which codes stand at the upper end, and where no editor of 15 bits made them; counts that no
fraction of a full scale reaches: gloss is 3 or 4 times a white."""
FEWEST_SPACED, DENSE = (4, 16), 0.25
"""Codes, all even or of another spacing, that are no chance; share of the multiples of a spacing that occur."""
LEAST_LEVELS, EVEN = 16, 0.9
"""Codes that say something of bits; of the spacing of 8 bits that were stretched."""
FEWEST, RARE = 40, 0.02
"""Pixels of a pile; pixels above it, over those in it: cosmic rays, hot sensels."""
STEEP, NEAR, NOISY = 4.0, 0.01, 0.5
"""Pixels at the hard end over those at any code within so much of it: noise of half a code has 4.3; share of neighbours that
differ: noise of half a code."""
ZONES, COMPARED, BINS = (0.94, 0.97, 0.99), (0.3, 0.9), 12
"""Of the brightest, where a hill may begin: full wells vary by some 1 %; of that, levels whose noise it is compared with, and their steps."""
QUIETER, LIKE_DARK, STILL = 0.2, 6.0, 0.002
"""Variance of a hill at most: of the least at these levels (shot noise alone leaves 1 / 0.3 of it), of a dark's (which clipping may
leave a third of), and its deviation, of the brightest, without a dark."""
SPREADS, STEADY = 3.0, 1 / 3
"""Deviations of a hill from its middle to its foot; of one frame's values beyond it: so many all have there, unless noise lifts them."""
QUIET, ROUNDED, BRIGHT = 2.0, 0.5, 100.0
"""Variance of a quiet white over the dark's; deviation, counts, that rounding hides; light of a white over the dark's deviation."""


# --- spacing --------------------------------------------------------------------------------------


def count_codes(frames: Iterable[np.ndarray]) -> np.ndarray:
    """Return how often each code occurs, (65536,) int64; frames of 8- or 16-bit codes, one at a time.

    >>> count_codes([np.array([[0, 3, 3]], np.uint8)])[:4].tolist()
    [1, 0, 0, 2]
    """
    total = np.zeros(MOST_CODES, np.int64)
    for frame in frames:
        if frame.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"codes are counted in uint8 and uint16, got {frame.dtype}")
        codes = frame.ravel()
        for start in range(0, codes.size, AT_A_TIME):
            found = np.bincount(codes[start : start + AT_A_TIME], minlength=1)
            total[: len(found)] += found
    return total


def find_step(frames: Iterable[np.ndarray]) -> float:
    """Return the counts from one code of some frames to the next; 0 where they are no whole numbers.

    1 where that is not plain: of fewer than 64 codes. Bright frames show most.

    >>> find_step([np.arange(4096, dtype=np.uint16).repeat(4) * 16]), find_step([np.ones(4)])
    (16.0, 0.0)
    """
    whole = [frame for frame in frames if frame.dtype.kind in "ui"]
    if not whole:
        return 0.0
    codes, count = _count(whole)
    plain = np.count_nonzero(count >= FILLED) >= FEWEST_LEVELS
    return float((_spacing(codes, count) if plain else None) or 1)


class Alignment(NamedTuple):
    """Where the codes of a frame stand in their words.

    `spacing` of neighbouring codes is 16 where 12 bits stand at the upper end of 16; None where that does not show. `top` is the
    largest code, `capacity` what a word can hold, plus 1; 1 of floats between 0 and 1, fractions of a full scale.
    """

    spacing: int | None
    top: float
    capacity: int

    def describe(self) -> str:
        """Return it in words.

        >>> Alignment(16, 60_000, 65_536).describe(), Alignment(None, 0.82, 1).describe()
        ('codes 16 apart up to 60000', 'fractions up to 0.82')
        """
        if self.spacing is None:
            return f"{'fractions' if self.capacity == 1 else 'values'} up to {self.top:.4g}"
        return f"codes {self.spacing} apart up to {self.top:.0f}"

    def compare(self, other: Alignment) -> Severity:
        """Compare with another frame's: counts by their fractions, one end of a word by the other end, are refused.

        Codes of every value that reach higher than the lower end are averages of codes at the upper end. Codes 2 or 3
        apart that reach beyond half of what words can hold may be those of an image editor of 15 bits, and are noted.

        >>> left, right = Alignment(16, 60_000, 65_536), Alignment(1, 3_700, 65_536)
        >>> left.compare(right), left.compare(Alignment(1, 58_123, 65_536)), Alignment(None, 0.82, 1).compare(right)
        ('refused', 'same', 'refused')
        """
        if (self.capacity == 1) != (other.capacity == 1):
            counts = other if self.capacity == 1 else self
            least = LEAST_COUNTS if counts.spacing is None else 1
            return "refused" if counts.top > least else "same"
        if self.spacing is None or other.spacing is None:
            return "same"
        upper, lower = (self, other) if self.spacing > other.spacing else (other, self)
        shift = (upper.spacing or 1) / (lower.spacing or 1)
        if shift < SHIFTS[0] or lower.top * shift >= lower.capacity:
            return "same"
        return "noted" if shift < SHIFTS[1] and upper.top > upper.capacity / 2 else "refused"


def find_alignment(frames: Iterable[np.ndarray]) -> Alignment | None:
    """Return where the codes of frames stand; None where they hold nothing. Floats that are whole numbers are codes of 16 bits.

    >>> find_alignment([np.arange(100, dtype=np.uint16) * 16])
    Alignment(spacing=16, top=1584, capacity=65536)
    >>> find_alignment([np.arange(1, 100) / 100])
    Alignment(spacing=None, top=0.99, capacity=1)
    """
    values = np.concatenate([frame.ravel() for frame in frames] or [np.empty(0)])
    capacity = MOST_CODES
    if values.dtype.kind == "f":
        values = values[np.isfinite(values)]
        if not values.any():
            return None
        if np.any(values != np.rint(values)):  # fractions of a full scale, or averages of counts
            outside = np.count_nonzero((values < 0) | (values > 1))
            return Alignment(
                None, float(values.max()), capacity if outside > STRAY * values.size else 1
            )
        values = values.astype(np.int64)
    else:
        capacity = int(np.iinfo(values.dtype).max) + 1
    if not values.size:
        return None
    spacing = None if capacity < MOST_CODES // 2 else _spacing(*_count([values]))
    return Alignment(spacing, int(values.max()), capacity)


def _spacing(codes: np.ndarray, count: np.ndarray) -> int | None:
    """Return the distance of neighbouring codes, all but a hundredth of the pixels; None where it is chance."""
    shift, stray = 1, STRAY * count.sum()
    while shift < MOST_CODES and count[codes % (2 * shift) != 0].sum() <= stray:
        shift *= 2
    if np.count_nonzero(codes % shift == 0) < FEWEST_SPACED[0]:
        return None
    rarest = np.argsort(count, kind="stable")
    kept = np.sort(codes[rarest[np.cumsum(count[rarest]) > stray]])
    gap = int(np.diff(kept).min(initial=MOST_CODES))
    dense = len(kept) >= FEWEST_SPACED[1] and len(kept) * gap >= DENSE * (kept[-1] - kept[0])
    return max(shift, gap) if dense else shift


def _count(frames: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the codes that occur, and how often."""
    if all(frame.dtype in (np.uint8, np.uint16) for frame in frames):
        counts = count_codes(frames)
        codes = np.flatnonzero(counts)
        return codes, counts[codes]
    codes, counts = np.unique(np.concatenate([f.ravel() for f in frames]), return_counts=True)
    return codes.astype(np.int64), counts


def doubt_codes(
    frames: Sequence[np.ndarray], bits: int | None, full: float | None
) -> list[Finding]:
    """Return what contradicts the bits that are declared, by bright frames of one sensor.

    >>> stretched = np.round(np.arange(256) * 4095 / 255).astype(np.uint16)
    >>> [(found.code, found.number, found.limit) for found in doubt_codes([stretched], 12, 4095)]
    [('few_codes', 256, 16)]
    """
    whole = [values for values in frames if values.dtype.kind in "ui"]
    if bits is None or bits <= 8 or full is None or not whole:
        return []
    distinct = _count(whole)[0]
    if distinct.size < LEAST_LEVELS:
        return []
    if distinct[-1] <= 255:
        return [Finding("low_codes", str(bits), int(distinct[-1]))]
    gap = int(np.diff(distinct).min())
    if distinct.size <= 256 and gap >= EVEN * full / 255:
        return [Finding("few_codes", str(bits), distinct.size, gap)]
    return []


# --- full scale -----------------------------------------------------------------------------------


class SceneShots(NamedTuple):
    """Shots of one scene at one exposure, codes (h, w) or (h, w, b), thinned by whole rows; `even` is a white."""

    shots: Sequence[np.ndarray]
    even: bool = False


class FullScale(NamedTuple):
    """Counts from which on a sensor is full, where they are known from, and bits of the converter, where they follow from these."""

    counts: float
    source: str
    bits: int | None = None


def stated_full_scale(
    facts: Facts,
    *,
    saturation: float | None = None,
    bits: int | None = None,
    where: object = "campaign.toml",
) -> FullScale | None:
    """Return the full scale by `saturation` as declared in `where`, the white level of the file, `bits`, the bits of its samples; else None.

    >>> from pathlib import Path
    >>> from levkas.readers.facts import Facts
    >>> facts = Facts(Path("a.tif"), "tiff", (4, 6), "uint16", bits=16)
    >>> stated_full_scale(facts, bits=12).counts, stated_full_scale(facts).source
    (4095.0, '16 bits in the file')
    """
    if saturation:
        return FullScale(float(saturation), f"saturation in {where}")
    if facts.saturation:
        return FullScale(float(facts.saturation), "white level in the file")
    if bits:
        return FullScale(2.0**bits - 1, f"{bits} bits in {where}", bits)
    if np.dtype(facts.dtype).kind == "u" and facts.bits:
        return FullScale(2.0**facts.bits - 1, f"{facts.bits} bits in the file", facts.bits)
    return None


def find_full_scale(
    lit: Sequence[SceneShots], darks: Sequence[np.ndarray] = (), *, period: int = 1
) -> FullScale | None:
    """Return the code at which frames of one sensor pile up; None where no frame is full, or that is not plain.

    The pile of a hard end holds four times the pixels of any code close below it, in frames that have noise: from sensel to sensel of a phase of
    `period` columns. Where nothing shows the noise only the highest code of 8 bits or more is full. A hill has about the noise
    of the darks, and a fifth of the variance of dimmer levels, from shot to shot or on a white from sensel to sensel.

    >>> rng = np.random.default_rng(1)
    >>> light = np.linspace(500, 5000, 200) * np.ones((100, 1))
    >>> codes = rng.normal(light, 30).clip(0, 3600).astype(np.uint16)
    >>> find_full_scale([SceneShots([codes])]).counts, find_full_scale([SceneShots([codes[:, :100]])])
    (3600.0, None)
    """
    whole = [frames for frames in lit if all(shot.dtype.kind in "ui" for shot in frames.shots)]
    return (_hard_end(whole, darks, period) or _hill(whole, darks, period)) if whole else None


def _hard_end(
    lit: Sequence[SceneShots], darks: Sequence[np.ndarray], period: int
) -> FullScale | None:
    shots = [shot for frames in lit for shot in frames.shots]
    codes, counts = _count(shots)
    above = counts[::-1].cumsum()[::-1] - counts
    top = int(np.flatnonzero(above <= RARE * counts)[0])
    code, count = float(codes[top]), int(counts[top])
    below = counts[:top][codes[:top] >= (1 - NEAR) * code - 1]
    if code <= 0 or count < FEWEST or count < STEEP * below.max(initial=0):
        return None
    full = [shot for shot in shots if np.count_nonzero(shot == codes[top]) >= FEWEST / 4]
    looked = [*(dark for dark in darks if np.median(dark) > 0), *full]
    known = [share for one in looked if (share := _unlike(one, code, period)) is not None]
    is_top = code >= 255 and (int(code) + 1).bit_count() == 1
    noisy = min(known) >= NOISY if known else is_top
    return FullScale(code, "its codes pile up there") if noisy else None


def _unlike(plane: np.ndarray, code: float, period: int) -> float | None:
    """Return the share of pixels below a code that differ from the next one of their phase; None of too few."""
    below = plane[:, :-period] < code
    if np.count_nonzero(below) < 2 * FEWEST:
        return None
    return float(np.mean((plane[:, :-period] != plane[:, period:])[below]))


def level_of_a_quiet_white(
    lit: Sequence[SceneShots], darks: Sequence[np.ndarray], *, period: int = 1
) -> float | None:
    """Return the level of a white that has no more noise than the dark, which light alone cannot have: full everywhere, or averaged.

    >>> rng = np.random.default_rng(1)
    >>> dark, white = rng.normal(60.5, 2.5, (40, 90)), rng.normal(3300.5, 2.6, (40, 90))
    >>> level_of_a_quiet_white([SceneShots([white.astype(np.uint16)], even=True)], [dark.astype(np.uint16)])
    3300.0
    """
    quiet = [one.spread(one.level >= 0) for one in _over_space(darks, period)]
    known = [variance for variance in quiet if variance > ROUNDED**2]
    if not known:
        return None
    dark = float(np.median([np.median(plane) for plane in darks]))
    for frames in (one for one in lit if one.even and one.shots[0].dtype.itemsize > 1):
        level = float(np.median(frames.shots[0]))
        spreads = [one.spread(one.level >= 0) for one in _over_space(frames.shots[:1], period)]
        if level - dark > BRIGHT * np.sqrt(max(known)) and spreads[0] < QUIET * min(known):
            return float(round(level))
    return None


class _Apart(NamedTuple):
    """Values that were taken alike, their level, and differences of the variance of one value, which do not depend on the level."""

    values: tuple[np.ndarray, ...]
    level: np.ndarray
    difference: np.ndarray
    code: np.ndarray

    def beyond(self, foot: float) -> np.ndarray:
        """Return where all values are at or above a foot; nowhere where noise, not light, brings most of them there."""
        reaching = [values >= foot for values in self.values]
        part = np.logical_and.reduce(reaching)
        least = min(map(np.count_nonzero, reaching))
        return part if np.count_nonzero(part) >= STEADY * least else np.zeros_like(part)

    def spread(self, part: np.ndarray) -> float:
        """Return the variance in a part, by the median: NaN of too few."""
        if np.count_nonzero(part) < 5 * FEWEST:
            return np.nan
        return float((1.4826 * np.median(np.abs(self.difference[part]))) ** 2)


def _hill(lit: Sequence[SceneShots], darks: Sequence[np.ndarray], period: int) -> FullScale | None:
    # Eight bits often went through a tone curve, under which noise does fall with the light.
    lit = [frames for frames in lit if frames.shots[0].dtype.itemsize > 1]
    if not lit:
        return None
    firsts = [frames.shots[0] for frames in lit]
    top = max(float(np.quantile(shot, 0.9995)) for shot in firsts)
    over_time = [_of_two(*frames.shots[:2]) for frames in lit if len(frames.shots) > 1]
    shown = [*over_time, *_over_space([f.shots[0] for f in lit if f.even], period)]
    quiet = [one.spread(one.level >= 0) for one in _over_space(darks, period)]
    read = min((LIKE_DARK * v for v in quiet if v > 0), default=(STILL * top) ** 2)
    for foot in (zone * top for zone in ZONES):
        edges = np.linspace(COMPARED[0] * foot, COMPARED[1] * foot, BINS + 1)
        dimmer = [
            one.spread((one.level >= low) & (one.level < high))
            for one in shown
            for low, high in pairwise(edges)
        ]
        least = min((v for v in dimmer if np.isfinite(v)), default=np.inf)
        for apart in (*over_time, *_over_space(firsts, period)):
            part = apart.beyond(foot)
            if least < np.inf and apart.spread(part) < min(QUIETER * least, read):
                counts = _foot_of(apart.code[part])
                return FullScale(counts, "its values no longer follow the light there")
    return None


def _of_two(first: np.ndarray, second: np.ndarray) -> _Apart:
    """Compare two shots of a scene; of two sizes nothing."""
    if first.shape != second.shape:
        first = second = np.zeros(0, np.float32)
    a, b = first.ravel().astype(np.float32), second.ravel().astype(np.float32)
    level = (a + b) / 2
    return _Apart((a, b), level, (a - b) / np.float32(np.sqrt(2)), level)


def _over_space(planes: Sequence[np.ndarray], period: int) -> list[_Apart]:
    """Compare each sensel with the two beside it of its phase."""
    found = []
    for plane in planes:
        if (width := plane.shape[1] - 2 * period) <= 0:
            continue
        before, own, after = (
            plane[:, start : start + width].astype(np.float32).ravel()
            for start in (0, period, 2 * period)
        )
        rest = (before - 2 * own + after) / np.float32(np.sqrt(6))
        found.append(_Apart((before, own, after), (before + own + after) / 3, rest, own))
    return found


def _foot_of(values: np.ndarray) -> float:
    """Return the foot of a hill, counts, without what lies before it."""
    for _ in range(5):
        middle = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - middle)))
        values = values[np.abs(values - middle) <= 2 * SPREADS * spread]
    return float(np.floor(middle - SPREADS * spread))

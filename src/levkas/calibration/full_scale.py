"""Full scale of a sensor by its frames: the code at which they pile up, below what files or campaign declare.

Noise never falls with the light: photons have shot noise. Where sensels at the top of all codes differ
less than dimmer ones, or than those without light, they show no light any more. A hard end, of the
converter, is one code. A full well with read-out noise behind it, which also differs from sensel to
sensel, is a hill of codes in which each sensel returns to its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, islice, pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.calibration.code_spacing import count_codes

if TYPE_CHECKING:
    from levkas.readers.facts import Facts

FEWEST = 40  # pixels of a pile, and of what it is compared with
RARE = 0.02  # pixels above a pile, over those in it: cosmic rays, hot sensels
STEEP = 4.0  # pixels at the hard end over those at any code within `NEAR` of it below: noise of half a code has 4.3
NEAR = 0.01  # of the code
NOISY = 0.5  # share of neighbours that differ: noise of half a code
ZONES = (0.94, 0.97, 0.99)  # of the brightest, that may be a hill: full wells vary by some 1 %
COMPARED = (0.3, 0.9)  # of a zone's foot: levels whose noise it is compared with
BINS = 12  # of these levels
QUIETER = 0.2  # of the least variance at these levels: shot noise alone leaves 1 / 0.3 of it
LIKE_DARK = 6.0  # of the variance of a dark, which clipping may leave a third of; and where there is no dark
STILL = 0.002  # of the brightest: more noise than a full well has behind it
SPREADS = 3.0  # of a hill, from its middle to its foot
ROUNDS = 5  # of leaving out what is no part of a hill
STEADY = (
    1 / 3
)  # of one frame's values beyond a foot: so many all frames have there, unless noise lifts them
MOST_PAIRS = 40  # of frames that are compared
QUIET = 2.0  # of the dark's variance: at `BRIGHT` shot noise adds as much again where counts an electron are 1 % of the dark's noise
ROUNDED = 0.5  # counts of noise: less is the rounding of means, which white and dark share
BRIGHT = 100.0  # of the dark's noise: a white below is too dim to decide


class SceneShots(NamedTuple):
    """Shots of one scene at one exposure, all scenes thinned alike, by whole rows.

    Parameters
    ----------
    shots : sequence of ndarray, (h, w) or (h, w, b)
        Codes; one or more.
    even : bool
        Whether it is an even surface: a white.
    """

    shots: Sequence[np.ndarray]
    even: bool = False


class FullScale(NamedTuple):
    """Counts from which on a sensor is full.

    Parameters
    ----------
    counts : float
        A value at or above them is saturated.
    source : str
        Where they are known from.
    bits : int, optional
        Of the converter, where they follow from these.
    """

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
    """Return the full scale that campaign or file state; None where neither does.

    Parameters
    ----------
    facts : Facts
        Of a frame.
    saturation, bits : float, int, optional
        Of the camera, as declared.
    where : path or str
        Of the declaration, for the source.

    Notes
    -----
    In this order: `saturation`, white level of the file, `bits`, bits of the file's samples.

    Examples
    --------
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

    Parameters
    ----------
    lit : sequence of SceneShots
        Objects and whites, of any exposure and band.
    darks : sequence of ndarray
        Frames without light: any lit sensel that is not full has as much noise.
    period : int
        Columns of a mosaic.

    Notes
    -----
    A hard end holds four times the pixels of any code close below it, in frames that have noise. A hill has about
    the noise of the darks, and a fifth of the variance that dimmer levels have at least, from shot to shot or on an even
    surface from sensel to sensel; so do scenes that are full at the same sensels. Where nothing shows the noise, nothing can be decided:
    drawn charts and frames of constants have no full scale, but the highest code of 8 bits or more.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> light = np.linspace(500, 5000, 200) * np.ones((100, 1))
    >>> codes = rng.normal(light, 30).clip(0, 3600).astype(np.uint16)
    >>> find_full_scale([SceneShots([codes])]).counts, find_full_scale([SceneShots([codes[:, :100]])])
    (3600.0, None)
    """
    whole = [frames for frames in lit if all(shot.dtype.kind in "ui" for shot in frames.shots)]
    if not whole:
        return None
    return _hard_end(whole, darks, period) or _hill(whole, darks, period)


def level_of_a_quiet_white(
    lit: Sequence[SceneShots], darks: Sequence[np.ndarray], *, period: int = 1
) -> float | None:
    """Return the level of a white that has no more noise than the dark, which light alone cannot have; None of none.

    It is full everywhere, or it was averaged: where no other level shows noise, `find_full_scale` cannot decide.

    Examples
    --------
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
    for frames in lit:
        if not frames.even or frames.shots[0].dtype.itemsize < 2:
            continue
        level = float(np.median(frames.shots[0]))
        spreads = [one.spread(one.level >= 0) for one in _over_space(frames.shots[:1], period)]
        if level - dark > BRIGHT * np.sqrt(max(known)) and spreads[0] < QUIET * min(known):
            return float(round(level))
    return None


# --- a hard end ---------------------------------------------------------------------------------


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
    noise = [_unlike(dark, code, period) for dark in darks if np.median(dark) > 0]
    noise += [_unlike(shot, code, period) for shot in full]
    known = [share for share in noise if share is not None]
    is_top = code >= 255 and (int(code) + 1).bit_count() == 1
    noisy = min(known) >= NOISY if known else is_top
    return FullScale(code, "its codes pile up there") if noisy else None


def _count(shots: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the codes that occur, and how often."""
    if all(shot.dtype in (np.uint8, np.uint16) for shot in shots):
        counts = count_codes(shots)
        codes = np.flatnonzero(counts)
        return codes, counts[codes]
    return np.unique(np.concatenate([shot.ravel() for shot in shots]), return_counts=True)


def _unlike(plane: np.ndarray, code: float, period: int) -> float | None:
    """Return the share of pixels below a code that differ from the next one of their phase; None of too few."""
    below = plane[:, :-period] < code
    if np.count_nonzero(below) < 2 * FEWEST:
        return None
    return float(np.mean((plane[:, :-period] != plane[:, period:])[below]))


# --- a hill -------------------------------------------------------------------------------------


class _Apart(NamedTuple):
    """Values that were taken alike: their level, differences whose variance is that of one value, and the codes that a hill is made of.

    Noise of the level and of the difference do not depend on one another: a level that is picked leaves the difference as it is.
    """

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
    top = max(float(np.quantile(frames.shots[0], 0.9995)) for frames in lit)
    over_time = _over_time(lit)
    shown = [*over_time, *_over_space([f.shots[0] for f in lit if f.even], period)]
    quiet = [one.spread(one.level >= 0) for one in _over_space(darks, period)]
    read = min((LIKE_DARK * v for v in quiet if v > 0), default=(STILL * top) ** 2)
    for foot in (zone * top for zone in ZONES):
        least = _least_variance(shown, foot)
        of_shots = _over_space([frames.shots[0] for frames in lit], period)
        for apart in (*over_time, *of_shots, *_between(lit, foot)):
            part = apart.beyond(foot)
            if least < np.inf and apart.spread(part) < min(QUIETER * least, read):
                return _foot_of(apart.code[part])
    return None


def _least_variance(shown: Sequence[_Apart], foot: float) -> float:
    """Return the least variance at levels well below a zone; infinite where none is shown."""
    edges = np.linspace(COMPARED[0] * foot, COMPARED[1] * foot, BINS + 1)
    found = [
        apart.spread((apart.level >= low) & (apart.level < high))
        for apart in shown
        for low, high in pairwise(edges)
    ]
    return min((v for v in found if np.isfinite(v)), default=np.inf)


def _over_time(lit: Sequence[SceneShots]) -> list[_Apart]:
    """Compare two shots of each scene."""
    pairs = [frames.shots[:2] for frames in lit if len(frames.shots) > 1]
    return [_compare(*pair) for pair in pairs if pair[0].shape == pair[1].shape]


def _between(lit: Sequence[SceneShots], foot: float) -> Iterator[_Apart]:
    """Compare frames of different scenes that both reach a zone: sensels that are full return to their own code."""
    reach = [f.shots[0] for f in lit if np.count_nonzero(f.shots[0] >= foot) >= 5 * FEWEST]
    for first, second in islice(combinations(reach, 2), MOST_PAIRS):
        if first.shape == second.shape:
            yield _compare(first, second)


def _compare(first: np.ndarray, second: np.ndarray) -> _Apart:
    a, b = first.ravel().astype(np.float32), second.ravel().astype(np.float32)
    level = (a + b) / 2
    return _Apart((a, b), level, (a - b) / np.float32(np.sqrt(2)), level)


def _over_space(planes: Sequence[np.ndarray], period: int) -> list[_Apart]:
    """Compare each sensel with the two beside it of its phase."""
    found = []
    for plane in planes:
        if plane.shape[1] <= 2 * period:
            continue
        before, own, after = (
            plane[:, start : plane.shape[1] - 2 * period + start].astype(np.float32).ravel()
            for start in (0, period, 2 * period)
        )
        level = (before + own + after) / 3
        rest = (before - 2 * own + after) / np.float32(np.sqrt(6))
        found.append(_Apart((before, own, after), level, rest, own))
    return found


def _foot_of(values: np.ndarray) -> FullScale:
    """Return the foot of a hill, without what lies before it."""
    for _ in range(ROUNDS):
        middle = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - middle)))
        values = values[np.abs(values - middle) <= 2 * SPREADS * spread]
    foot = float(np.floor(middle - SPREADS * spread))
    return FullScale(foot, "its values no longer follow the light there")

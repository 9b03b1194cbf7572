"""The lamp: how bright each shot of a stack is, shots at one level, and how well the light is known between white and object.

Shot k of a stack has x_k = D + s_k · L + noise, with the light s_k of the lamp over the mean of all shots. It is
measured in cells: s_k is the median over cells of their ratios to the stack's mean, so that something that moved in a
part of the picture does not count. A straight line through it is drift, what is left is flicker. Darks differ by an
offset instead, x_k = D + o_k + noise. What only a part of a shot of a white has, or none of its light, is no lamp.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from levkas.calibration.findings import CalibrationRefused, Finding
from levkas.calibration.patterns import split
from levkas.calibration.sight import SIZES, watch_shots
from levkas.calibration.templates import ShotLevels, Template, average, level_of

CELL, CELLS, DIM = 32, 8, 0.02
"""Pixels a side of a cell, of one phase; cells a side that a small frame has; of the brightest cells: darker ones hold noise alone."""
SIGMAS = 4.0
"""Deviations of a change, to be one: at 2 noise changes the lamp in one of twenty bands of a scanner."""
EXPLAINED, SAMPLE = 0.01, 30_000
"""Of the variance of bright pixels over time, from which on shots are brought to one level; pixels of a channel that are looked at."""
LONG = 10.0
"""Times its change within a stack: lamps settle, and what one did in a second shows little of a day."""
GROUPS, FEWEST = 8, 5
"""Of neighbouring bands whose lamp is alike: with 4 of 580 bands the rms error of Δ is 0.07 %, with 8 0.11 %, with every band by itself
noise passes for a change in 6 of 30 steady scans. Lines of a white that show anything."""
STEADY, LOCAL, CERTAIN = (0.7, 1.4), 0.03, 8.0
"""Least and greatest light of a shot that is a lamp's; of the light of a cell: lamps do less; deviations: one cell of 10⁹ is beyond."""
CONTRADICTED = 0.1
"""Of the light of a cell: the mean of two whites is then wrong by as much."""


# --- the light of each shot ---------------------------------------------------------------------


@dataclass
class CellMeans:
    """Means of the cells of each shot of a stack, filled while frames pass by; a cell holds one phase of a mosaic of `period`.

    >>> light = CellMeans()
    >>> frames = [np.full((512, 512), level) for level in (100, 101)]
    >>> sum(1 for _ in light.watch(frames)), light.channels.shape
    (2, (2, 1, 256))
    """

    period: tuple[int, int] = (1, 1)
    shots: list[np.ndarray] = field(default_factory=list)

    def watch(self, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        """Hand frames on and keep the means of their cells."""
        for frame in frames:
            yield frame  # and whoever takes it refuses what is no frame
            self.shots.append(cell_means(frame, self.period))

    @property
    def channels(self) -> np.ndarray:
        """Mean counts, (shots, channels, cells): a channel is a phase, and a band of it."""
        return np.array(self.shots)


def cell_means(frame: np.ndarray, period: tuple[int, int] = (1, 1)) -> np.ndarray:
    """Return means of squares of `CELL` pixels of one phase, of smaller ones in a small frame, (channels, cells).

    >>> cell_means(np.arange(4).reshape(2, 2), (1, 2)).tolist()
    [[0.0, 2.0], [1.0, 3.0]]
    """
    found = []
    for plane in _phases(frame, period):
        tall, wide = (min(CELL, max(1, n // CELLS)) for n in plane.shape[:2])
        if len(plane) == 1:  # a line of many bands
            wide = max(wide, plane.shape[1] // CELLS)
        rows, columns = plane.shape[0] // tall, plane.shape[1] // wide
        bands, codes = plane.shape[2], plane.dtype in (np.uint8, np.uint16)
        parts = plane[: rows * tall, : columns * wide].reshape(rows, tall, -1)
        # Down first, where neighbours lie in one stretch of memory; codes add up exactly.
        down = np.add.reduce(parts, axis=1, dtype=np.uint32 if codes else np.float64)
        sums = down.reshape(rows * columns, wide, bands).sum(1, dtype=np.float64)
        found.append(sums.T / (tall * wide))
    cells = min(part.shape[1] for part in found)
    return np.concatenate([part[:, :cells] for part in found])


def measure_light(cells: np.ndarray, dark: np.ndarray | float = 0.0) -> ShotLevels:
    """Compare the light of the shots of one scene, channel by channel: cells (shots, channels, cells) over counts without light.

    >>> cells = np.outer([0.99, 1.01], np.linspace(50, 900, 40))[:, None] + 64
    >>> measure_light(cells, 64.0).levels.round(3).tolist()
    [[0.99], [1.01]]
    """
    light = np.asarray(cells, float) - dark
    levels, errors = np.ones(light.shape[:2]), np.full(light.shape[1], np.inf)
    for channel, part in enumerate(np.moveaxis(light, 1, 0)):
        part = part[:, np.isfinite(part).all(0)]
        mean = part.mean(0)
        full = np.quantile(mean, 0.98) if mean.size else 0.0
        bright = mean > DIM * full
        if full > 0:
            found, errors[channel] = _levels(part[:, bright] / mean[bright], mean[bright])
            levels[:, channel] = found / found.mean()
    return ShotLevels(levels, errors)


def measure_offsets(cells: np.ndarray) -> ShotLevels:
    """Compare the darks of a stack, (shots, channels, cells), channel by channel: levels are counts.

    >>> measure_offsets(np.array([[[60.0, 61.0]], [[62.0, 63.0]]])).levels.tolist()
    [[-1.0], [1.0]]
    """
    apart = np.asarray(cells, float) - cells.mean(0)
    levels, errors = np.zeros(apart.shape[:2]), np.full(apart.shape[1], np.inf)
    for channel, part in enumerate(np.moveaxis(apart, 1, 0)):
        part = part[:, np.isfinite(part).all(0)]
        if part.size:
            found, errors[channel] = _levels(part, np.ones(part.shape[1]))
            levels[:, channel] = found - found.mean()
    return ShotLevels(levels, errors)


def _levels(values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the weighted median over cells of each shot, (shots, cells) to (shots,), and its standard deviation."""
    order = np.argsort(values, axis=1, kind="stable")
    passed = np.cumsum(weights[order], axis=1)
    places = np.argmax(passed >= passed[:, -1:] / 2, axis=1)
    levels = np.take_along_axis(values, order, 1)[np.arange(len(values)), places]
    spread = 1.4826 * np.median(np.abs(values - levels[:, None]))
    several = weights.sum() ** 2 / (weights**2).sum()
    return levels, 1.2533 * float(spread) / np.sqrt(several)


# --- shots at one level -------------------------------------------------------------------------


def average_steady(
    read: Callable[[], Iterable[np.ndarray]],
    level: np.ndarray | float | None,
    *,
    period: tuple[int, int] = (1, 1),
    saturation: float | None = None,
    black_clip: float | None = 0.0,
    exposure_s: float | None = None,
    times_s: Sequence[float] | None = None,
    white: bool = False,
) -> Template:
    """Average shots of one scene without what the lamp does to all pixels alike; the template has its `shots`, and the variance of noise.

    `read` returns the frames; it is called a second time where the lamp explains more than 1 % of the variance of bright pixels over
    time: the shots are then brought to their mean level about `level`, the counts without light, each phase of a mosaic of `period` by
    itself; darks, whose `level` is None, by an offset. Saturation is judged on the codes of the file. In a `white` nothing may stand: by
    how much its shots differ is in `shots`; those of an object are compared with the first, and `shots` have what is unlike.

    >>> rng = np.random.default_rng(1)
    >>> frames = [60 + rng.normal(s * 3000, 10, (80, 80)) for s in (0.975, 1.025)]
    >>> made = average_steady(lambda: frames, 60.0)
    >>> round(float(made.variance.mean()) / 10), made.shots.levels.round(3).tolist()
    (10, [[0.975], [1.025]])
    """
    light = CellMeans(period)
    unlike: list[tuple[int, str, float]] = []
    frames = light.watch(read())
    if level is not None and not white:
        frames = watch_shots(frames, unlike, period, level_of(np.asarray(level)), saturation)
    template = average(frames, exposure_s=exposure_s, saturation=saturation, black_clip=black_clip)
    channels = light.channels
    if level is None:
        shots = measure_offsets(channels)
    else:
        level = _as_frame(level, template.mean.shape)
        under = cell_means(level, period)
        shots = measure_light(channels, under)
        if white:
            differing, apart = find_differing_shots(channels - under)
            shots = replace(shots, differing=differing, apart=apart)
    moments = tuple(times_s) if times_s is not None and len(times_s) == template.count else None
    shots = replace(shots, times_s=moments, unlike=tuple(unlike))
    lamp = level is None or STEADY[0] < shots.levels.min() <= shots.levels.max() < STEADY[1]
    if lamp and _explained(template, shots, level, period) > EXPLAINED:
        each = zip(read(), shots.levels, strict=True)
        steadied = (_steadied(frame, found, level, period) for frame, found in each)
        again = average(steadied, exposure_s=exposure_s)
        template = replace(again, saturated=template.saturated, black=template.black)
    return replace(template, shots=shots)


def _as_frame(level: np.ndarray | float, shape: tuple[int, ...]) -> np.ndarray:
    """Return counts without light as a frame, float32: where darks have another size, which is refused later, their median."""
    level = np.asarray(level, np.float32)
    fits = level.ndim in (0, 2, len(shape)) and all(
        n in (1, whole) for n, whole in zip(level.shape, shape, strict=False)
    )
    return np.broadcast_to(level if fits else np.median(level), shape)


def _phases(frame: np.ndarray, period: tuple[int, int]) -> list[np.ndarray]:
    """Return the phases of a frame as views, (rows, columns, bands); one of a frame smaller than its pattern."""
    fits = all(n >= size for n, size in zip(frame.shape, period, strict=False))
    return split(frame.reshape(*frame.shape[:2], -1), *(period if fits else (1, 1)))


def _channels(array: np.ndarray, period: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield views of the phases of a frame, band by band, in the order of `cell_means`."""
    for plane in _phases(array, period):
        yield from np.moveaxis(plane, 2, 0)


def _explained(
    stack: Template, shots: ShotLevels, level: np.ndarray | None, period: tuple[int, int]
) -> float:
    """Return the share of the variance over time that the lamp explains, in the bright pixels of its worst channel."""
    if stack.variance is None:
        return 0.0
    under = np.zeros_like(stack.mean, shape=1) if level is None else level
    common = np.var(shots.levels, axis=0, ddof=1) - shots.error**2
    shares = [0.0]
    frames = stack.mean, np.broadcast_to(under, stack.mean.shape), stack.variance
    channels = (_channels(frame, period) for frame in frames)
    for *planes, of_lamp in zip(*channels, common, strict=True):
        if not of_lamp > 0:
            continue
        step = max(1, int(np.sqrt(planes[0].size / SAMPLE)))
        lit, dark, spread = (plane[::step, ::step].ravel() for plane in planes)
        light = lit - dark
        known = np.isfinite(light) & np.isfinite(spread)
        light, spread = light[known].astype(np.float64), np.maximum(spread[known], 1e-9)
        if not light.size:
            continue
        if level is None:
            shares.append(of_lamp / float(np.mean(spread)))
        else:
            bright = light >= np.median(light)
            shares.append(of_lamp * float(np.median(light[bright] ** 2 / spread[bright])))
    return max(shares)


def _steadied(
    frame: np.ndarray, levels: np.ndarray, level: np.ndarray | None, period: tuple[int, int]
) -> np.ndarray:
    """Return a shot at the mean level of its stack, float32."""
    steadied = frame.astype(np.float32)
    steadied -= 0.0 if level is None else level
    for plane, found in zip(_channels(steadied, period), levels.astype(np.float32), strict=True):
        if level is None:
            plane -= found
        else:
            plane /= found
    steadied += 0.0 if level is None else level
    return steadied


# --- shots that are none ------------------------------------------------------------------------


def find_differing_shots(light: np.ndarray) -> tuple[tuple[int, ...], float]:
    """Find the shots of a white, (shots, channels, cells) above dark, that show something else than most of them, and by how much.

    Nothing is named where no majority agrees. The size is the largest relative deviation of a cell from the median of all shots, or of
    a shot with other light; 0 where none stands out of noise.

    >>> rng = np.random.default_rng(1)
    >>> light = rng.normal(1000, 1, (5, 1, 64)) * np.array([1, 1.01, 1.02, 1.01, 1])[:, None, None]
    >>> light[3, 0, :9] *= 0.4
    >>> differing, apart = find_differing_shots(light)
    >>> differing, round(apart, 1)
    ((3,), 0.6)
    """
    if len(light) < 2:
        return (), 0.0
    away = np.max([_away(light[:, k]) for k in range(light.shape[1])], axis=0)
    found = np.flatnonzero(away > 0)
    return tuple(found.tolist()) if 2 * len(found) < len(light) else (), float(away.max())


def _away(cells: np.ndarray) -> np.ndarray:
    """Return by how much the light of a shot is no lamp's, or that of a part of it differs from the others, (shots,)."""
    cells = cells[:, np.isfinite(cells).all(0)]
    middle = np.median(cells, axis=0)
    full = np.quantile(middle, 0.98) if middle.size else 0.0
    if full <= 0:
        return np.zeros(len(cells))
    bright = middle > DIM * full
    middle, ratio = middle[bright], cells[:, bright] / middle[bright]
    level = np.median(ratio, axis=1)
    level /= np.median(level)
    off = (level < STEADY[0]) | (level > STEADY[1])
    ratio /= np.maximum(level, DIM if off.all() else STEADY[0])[:, None]
    apart = np.abs(ratio - np.median(ratio, axis=0))
    noise = 1.4826 * float(np.median(apart)) * np.maximum(np.median(middle) / middle, 1)
    whole = np.abs(level - 1) * (off & (np.abs(level - 1) > CERTAIN * np.median(noise)))
    parts = np.where(apart > np.maximum(LOCAL, CERTAIN * noise), apart, 0).max(1)
    return np.asarray(np.maximum(whole, parts))


def require_agreement(shots: ShotLevels | None, names: Sequence[str] = ()) -> None:
    """Refuse shots that contradict each other, ``E_UNLIKE_SHOTS``; of an object each that is unlike the first, by its file in `names`."""
    if shots is None:
        return
    found = []
    if shots.apart > CONTRADICTED:
        which = ", ".join(
            Path(names[k]).name if names else f"shot {k + 1}" for k in shots.differing[:3]
        )
        file = names[shots.differing[0]] if names and shots.differing else None
        which = which or "no majority"
        found.append(Finding("unlike_whites", which, shots.apart, CONTRADICTED, file))
    for shot, what, by in shots.unlike if not found else ():
        said, file = f"shot {shot + 1}: {SIZES[what].format(by)}", names[shot] if names else None
        found.append(Finding(f"other_{what}", said, by, file=file))
    if found:
        raise CalibrationRefused(*(one.problem() for one in found))


# --- between white and object -------------------------------------------------------------------


class LampChange(NamedTuple):
    """How far the light of a white is known to be that of an object, channel by channel, relative to the white's mean.

    `sigma` is a standard deviation, which all pixels share; `white` and `shot` the changes from the first shot to the last, NaN of a
    single one; `flicker` the standard deviation from shot to shot about those lines, NaN with fewer than three. Of a scan
    `reach` is the span from the middle of its white to the object's last line over the white's, else 0.
    """

    sigma: np.ndarray
    white: np.ndarray
    shot: np.ndarray
    flicker: np.ndarray
    reach: float = 0.0

    def in_groups(self, which: np.ndarray, count: int) -> LampChange:
        """Return means over channels that belong together: `which` group each is of, 0 to `count` − 1."""
        parts = [which == group for group in range(count)]
        means = (np.array([v[part].mean() for part in parts]) for v in self[:4])
        return LampChange(*means)  # type: ignore[arg-type]


def lamp_between(white: ShotLevels, shot: ShotLevels) -> LampChange:
    """Estimate how the lamp changed between the stacks of a white and of an object; of darks, how the black level did, counts.

    A lamp that changed by Δ within a stack may have changed as much again until the other one: u = |Δ|. Where files
    state when they were captured u = |Δ| √(gap/span), as far as a lamp wanders, between |Δ|/2, which a wandering lamp
    is off by midway between whites, and 10 |Δ|. Flicker f of single shots adds f²/n of each.

    >>> two = ShotLevels(np.array([[1.02], [0.98]]), np.array([1e-5]))
    >>> one = ShotLevels(np.ones((1, 1)), np.array([1e-5]))
    >>> lamp_between(two, one).sigma.round(3).tolist()
    [0.04]
    """
    stacks = white, shot
    trends = [trend_of(one) for one in stacks]
    freedom = np.array([max(len(one.levels) - 2, 0) for one in stacks])
    squares = sum(n * np.nan_to_num(t.flicker) ** 2 for n, t in zip(freedom, trends, strict=True))
    flicker = np.sqrt(squares / max(int(freedom.sum()), 1))
    reaches = [t.reach * _reach(s, white, shot) for t, s in zip(trends, stacks, strict=True)]
    single = flicker**2 * sum(1 / len(one.levels) for one in stacks)
    sigma = np.sqrt(np.maximum(*reaches) ** 2 + single)
    known = flicker if freedom.any() else np.full(len(flicker), np.nan)
    return LampChange(sigma, trends[0].change, trends[1].change, known)


def black_between(dark: ShotLevels, shot: ShotLevels | None = None) -> LampChange:
    """Estimate how the black level changed between darks, whose levels are counts, and one shot of an object, as the lamp does.

    >>> wander = ShotLevels(np.array([[-1.0], [0.5], [0.5]]), np.array([0.01]))
    >>> black_between(wander).sigma.round(2).tolist()
    [0.71]
    >>> timed = ShotLevels(np.array([[-0.5], [0.5]]), np.array([0.01]), (0.0, 10.0))
    >>> later = ShotLevels(np.ones((1, 1)), np.array([0.01]), (45.0,))
    >>> black_between(timed, later).sigma.round(2).tolist()
    [2.0]
    """
    one = np.zeros((1, dark.levels.shape[1]))
    return lamp_between(dark, ShotLevels(one, one[0], None if shot is None else shot.times_s))


def lamp_along(white: ShotLevels, lines: int) -> LampChange:
    """Estimate how the lamp changed from the white of a push-broom camera to the last of `lines` lines of its object.

    A line of the white is a shot, a band a channel. u = |Δ| (n/2 + lines)/n, up to 10 |Δ|: lamps settle. Δ is the change of a
    group of neighbouring bands, where it is beyond what is as rare as four standard deviations (Student's t, by the scatter of the
    lines). Where it is not, u is what noise leaves open within the white.

    >>> rng = np.random.default_rng(1)
    >>> levels = np.linspace(1.001, 0.999, 64)[:, None] * rng.normal(1, 0.0001, (64, 3))
    >>> found = lamp_along(ShotLevels(levels, np.full(3, 0.0001)), 480)
    >>> found.reach, found.sigma.round(3).tolist()
    (8.0, [0.016, 0.016, 0.016])
    """
    from scipy.special import ndtr, stdtrit

    count, bands = white.levels.shape
    none = np.full(bands, np.nan)
    if count < FEWEST:
        return LampChange(np.zeros(bands), none, none, none)
    # As probable by chance as SIGMAS of the normal distribution.
    chance = -float(stdtrit(count - 2, ndtr(-SIGMAS)))
    of_band = np.arange(bands) * min(GROUPS, bands) // bands
    member = of_band[:, None] == np.arange(of_band.max() + 1)
    weights = member / np.maximum(white.error, 1e-9)[:, None] ** 2
    total = np.maximum(weights.sum(0), 1e-300)
    lit = weights.sum(0) > 0
    levels = np.where(lit, white.levels @ weights / total, 1.0)
    group = trend_of(ShotLevels(levels, np.where(lit, 1 / np.sqrt(total), np.inf)))
    known = np.abs(group.change) > chance * group.error
    reach = (count / 2 + lines) / count
    drift = np.where(known, np.hypot(group.change, group.error) * min(reach, LONG), group.reach)
    flicker = trend_of(white).flicker
    sigma = np.hypot(drift[of_band], np.nan_to_num(flicker) * np.sqrt(1 + 1 / count))
    changed = np.where(known, group.change, 0.0)[of_band]
    return LampChange(np.nan_to_num(sigma), changed, none, flicker, reach)


class Trend(NamedTuple):
    """Change of a stack's level from first to last along a line, NaN of one shot; how far it reaches; rms about it.

    Where flicker explains the change, it is 0. `reach` is its size with the error that noise gives it, `error` what
    noise and flicker give it.
    """

    change: np.ndarray
    reach: np.ndarray
    flicker: np.ndarray
    error: np.ndarray


def trend_of(stack: ShotLevels) -> Trend:
    """Fit a straight line to the levels of a stack, channel by channel, over the times of its shots where these are known."""
    count, channels = stack.levels.shape
    none = np.full(channels, np.nan)
    if count < 2:
        return Trend(none, np.zeros(channels), none, none)
    at, levels = np.arange(count, dtype=float), stack.levels
    if stack.times_s is not None and np.ptp(stack.times_s) > 0:
        times = np.array(stack.times_s, float)
        order = np.argsort(times, kind="stable")
        at, levels = times[order], levels[order]
    at = at - at.mean()
    span, spread = at[-1] - at[0], np.sqrt(at @ at)
    change = at @ levels / spread**2 * span
    rest = levels - levels.mean(0) - np.outer(at / span, change)
    noise = np.where(np.isfinite(stack.error), stack.error, 0.0)
    flicker, error = none, noise * span / spread
    if count > 2:
        square = (rest**2).sum(0) / (count - 2)
        flicker = np.where(square > 4 * noise**2, np.sqrt(np.maximum(square - noise**2, 0)), 0.0)
        change = np.where(np.abs(change) > SIGMAS * np.sqrt(square) * span / spread, change, 0.0)
        error = np.sqrt(np.maximum(square, noise**2)) * span / spread
    return Trend(change, np.hypot(change, noise * span / spread), flicker, error)


def _reach(stack: ShotLevels, white: ShotLevels, shot: ShotLevels) -> float:
    """Return by which multiple of its change within a stack a lamp may have changed between the two."""
    if white.times_s is None or shot.times_s is None or len(stack.levels) < 2:
        return 1.0
    span = float(np.ptp(stack.times_s or (0.0,)))
    gap = abs(float(np.mean(white.times_s)) - float(np.mean(shot.times_s)))
    return min(max(float(np.sqrt(gap / span)), 0.5), LONG) if span > 0 else 1.0

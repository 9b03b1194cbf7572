"""Exposure series for scenes that outrun the sensor: how many exposures, which times, which ISO.

A sensel reaches the signal-to-noise ratio W from s counts on, s = (W²K + √(W⁴K² + 4W²σ²))/2, with K counts per
photo-electron and the variance σ² without light, Eqs. (1) and (2) of [mirhashemi2019]_. The shortest exposure
keeps the brightest places below saturation, the longest brings the darkest paint to s, and steps between them
are no larger than the span from s to saturation: what one exposure leaves below W the next one has above it.
ISO amplifies by A and divides what the amplifier adds: σ² = σ_before² + (σ_after/A)² electrons², while the
converter holds 1/A of the full well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, log, log10, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.exposures import USABLE, merge_weight
from levkas.core.blocks import block_means
from levkas.core.problems import Problem
from levkas.planning.exposure_advice import BandAdvice, NoAdvice, Shot, planes_of
from levkas.planning.exposure_levels import safe_mean
from levkas.planning.tables import PlanRefused, value_problem

if TYPE_CHECKING:
    from levkas.planning.tables import StudioCameraKeys

CELL = 4  # sensels a side whose mean gives how dark a place is, noise averaged out
DETECTABLE = 3.0  # deviations of such a mean by which the darkest paint must stand above the dark
SPARE = 0.9  # of the usable range: lamps drift and times are rounded
MOST = 12  # exposures of a series
ROUNDING = 1 / 12  # counts²
WORTH_SNR, WORTH_TIME = (
    0.05,
    0.2,
)  # gain from which a higher ISO is worth the full well that it costs
ALMOST = 0.995
CURVE = 160


@dataclass(frozen=True)
class SeriesWish:
    """What a series must reach.

    Parameters
    ----------
    snr : float
        Linear signal-to-noise ratio of one sensel of the darkest paint.
    quantile : float
        Share of the object that may be darker than what is called the darkest paint.
    longest_s : float, optional
        Longest exposure that can be set.
    region : (x, y, width, height), optional
        Of the object in the frame, sensels.
    """

    snr: float = 20.0
    quantile: float = 0.01
    longest_s: float | None = None
    region: tuple[int, int, int, int] | None = None

    def __post_init__(self) -> None:
        limits = (
            ("snr", self.snr, 0 < self.snr < 1e4, "between 0 and 10000"),
            ("quantile", self.quantile, 0 < self.quantile < 0.5, "between 0 and 0.5"),
            ("longest", self.longest_s, (self.longest_s or 1.0) > 0, "seconds, > 0"),
        )
        for name, found, good, expected in limits:
            if not good:
                raise PlanRefused(
                    Problem("E_VALUE", f"the {name} is out of range", field=name, found=str(found),
                            expected=expected)
                )  # fmt: skip


@dataclass(frozen=True)
class SensorAt:
    """A sensor at one ISO, that amplifies `amplified` times more than the lowest.

    `gain` is in counts per electron, `read_variance` counts², `dark_growth` what dark current adds to it, counts² a
    second.
    """

    gain: float
    read_variance: float
    dark_growth: float = 0.0
    iso: float | None = None
    amplified: float = 1.0

    def weight(self, rate: np.ndarray | float, time_s: float, dark_share: float) -> np.ndarray:
        """Return the weight of one shot in a merge."""
        read = self.read_variance + self.dark_growth * time_s
        return merge_weight(rate, time_s, gain=self.gain, read_variance=read, dark_share=dark_share)

    def counts_for(self, snr: float) -> float:
        """Return the counts above the dark at which one shot reaches a linear SNR."""
        squared = snr * snr
        return (
            squared * self.gain
            + sqrt((squared * self.gain) ** 2 + 4 * squared * self.read_variance)
        ) / 2


@dataclass(frozen=True)
class PlannedExposure:
    """One exposure of a series, and the shares of sensels that it serves.

    `unsaturated`: it counts there; `reaches`: besides, it has the wanted SNR by itself; `decides`: its
    weight in the merge is the largest there.
    """

    time_s: float
    unsaturated: float
    reaches: float
    decides: float


@dataclass(frozen=True, eq=False)
class ExposureSeries:
    """A planned series of one band or one camera.

    Parameters
    ----------
    name : str
    exposures : tuple of PlannedExposure
        Shortest first; one where it suffices.
    sensor : SensorAt
    wish : SeriesWish
    channel : str
        That holds the darkest paint.
    darkest, brightest : float
        Counts a second above the dark, at the ISO of the series.
    snr_single, snr_series : float
        Of the darkest paint: of the shortest exposure alone, of the merge.
    below_single, below_series : float
        Shares of sensels that stay below the wanted SNR.
    iso_words : str
    notes : tuple of str
    curve : ndarray, (3, n)
        Counts a second, SNR of the shortest exposure (NaN where it saturates), SNR of the merge.
    histogram : ndarray, (n,)
        Share of the sensels around each rate of the curve.
    """

    name: str
    exposures: tuple[PlannedExposure, ...]
    sensor: SensorAt
    wish: SeriesWish
    channel: str
    darkest: float
    brightest: float
    snr_single: float
    snr_series: float
    below_single: float
    below_series: float
    iso_words: str
    notes: tuple[str, ...]
    curve: np.ndarray
    histogram: np.ndarray

    @property
    def reached(self) -> bool:
        """Whether the darkest paint gets the wanted SNR."""
        return self.snr_series >= ALMOST * self.wish.snr

    @property
    def suffices(self) -> bool:
        """Whether one exposure is enough."""
        return len(self.exposures) == 1 and self.snr_single >= self.wish.snr

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return {
            "name": self.name,
            "one_suffices": self.suffices,
            "exposures": [dict(e.__dict__) for e in self.exposures],
            "iso": self.sensor.iso,
            "iso_reason": self.iso_words,
            "wanted_snr": self.wish.snr,
            "quantile": self.wish.quantile,
            "darkest_channel": self.channel,
            "darkest_counts_per_s": self.darkest,
            "brightest_counts_per_s": self.brightest,
            "stops": float(np.log2(self.brightest / self.darkest)),
            "snr_darkest_single": self.snr_single,
            "snr_darkest_series": self.snr_series,
            "snr_darkest_series_db": 10 * log10(max(self.snr_series, 1e-9)),
            "share_below_single": self.below_single,
            "share_below_series": self.below_series,
            "gain": self.sensor.gain,
            "read_variance": self.sensor.read_variance,
            "notes": list(self.notes),
        }


def plan_series(
    found: BandAdvice, wish: SeriesWish, keys: StudioCameraKeys | None = None
) -> ExposureSeries:
    """Plan the exposures that bring the darkest paint of an object to the wanted SNR.

    Parameters
    ----------
    found : BandAdvice
        Of frames of the object; the longest unsaturated exposure of each sensel counts.
    wish : SeriesWish
    keys : StudioCameraKeys, optional
        Of the camera in a setup file: its full well and noise in electrons. Left out, noise is what
        shots of the object differ by, and no ISO is chosen.

    Raises
    ------
    NoAdvice
        E_EXPOSURES where no exposure time is known, E_ONE_SHOT where nothing gives the noise, E_WHITE_DARK where the darkest paint cannot be
        distinguished from the dark, E_VALUE where no exposure of the sensor reaches the SNR.
    PlanRefused
        E_VALUE where the region lies outside the frame.
    """
    if any(shot.exposure_s is None for shot in found.shots):
        raise NoAdvice(
            Problem("E_EXPOSURES", f"{found.shot.name}: the exposure is not known",
                    expected="seconds in names or headers", fix="Give it with --time.")
        )  # fmt: skip
    sensors, shown = _sensors(found, keys)
    scene = _scene(found, wish, sensors[0], shown)
    plans = [_times(scene, sensor, wish) for sensor in sensors]
    best = 0
    for k in range(1, len(plans)):
        if _serves_better(scene, wish, (sensors[k], plans[k]), (sensors[best], plans[best])):
            best = k
    words = _iso_words(keys, sensors, best)
    return _judged(scene, sensors[best], plans[best], wish, words)


@dataclass(frozen=True, eq=False)
class _Scene:
    """Light of the object, counts a second at the lowest ISO: maps, and their two ends.

    `usable` is the range of one shot above the dark, counts, and `shortest_s` the time that brings
    the brightest places to its end.
    """

    name: str
    rates: np.ndarray
    smooth: np.ndarray
    channel: str
    darkest: float
    brightest: float
    shortest_s: float
    usable: float
    dark_share: float


def _scene(found: BandAdvice, wish: SeriesWish, lowest: SensorAt, shown: float) -> _Scene:
    """Read the light of the object from frames whose ISO amplifies `shown` times more than the lowest."""
    shots = sorted(zip(found.shots, found.levels, strict=True), key=lambda s: s[0].exposure_s or 0)
    rates = _cut(_rate(*shots[0]), wish.region)
    longest = np.full(rates.shape, shots[0][0].exposure_s or 0.0)
    for shot, level in shots[1:]:
        mean = _cut(shot.stack.mean, wish.region)
        free = ~_cut(shot.stack.saturated, wish.region) & (mean <= USABLE * found.full)
        rates = np.where(free, _cut(_rate(shot, level), wish.region), rates)
        longest = np.where(free, shot.exposure_s or 0.0, longest)
    dark, channel, time = _darkest(rates, longest, found.pattern, wish.quantile)
    read = lowest.read_variance * shown**2
    noise = sqrt(max(lowest.gain * shown * dark * time, 0.0) + read) / CELL / time
    if dark < DETECTABLE * noise:
        raise NoAdvice(
            Problem(
                "E_WHITE_DARK",
                f"{found.shot.name}: these frames do not show how dark the darkest paint is",
                field="quantile",
                found=f"{dark * time:.2f} counts above the dark at quantile {wish.quantile:g}, noise {noise * time:.2f}",
                expected=f"{DETECTABLE:g} times the noise of {CELL} x {CELL} sensels",
                fix="Add a longer exposure of the object, even a saturated one, or give a larger --quantile.",
            )
        )
    room, peak = found.full - _level(found), max(a.reading.peak for a in found.advices)
    bright = peak / (found.shot.exposure_s or 1.0)
    target = safe_mean(room / (lowest.gain * shown), prnu=found.sensor.prnu, unevenness=0.0)
    return _Scene(
        found.shot.name, rates / shown, _smoothed(rates, found.pattern) / shown, channel, dark / shown, bright / shown,
        target * room / bright * shown, USABLE * found.full - _level(found), found.dark_share,
    )  # fmt: skip


def _level(found: BandAdvice) -> float:
    """Return the counts without light of the exposure that was read."""
    time = found.shot.exposure_s
    return next(v for s, v in zip(found.shots, found.levels, strict=True) if s.exposure_s == time)


def _rate(shot: Shot, level: float) -> np.ndarray:
    return (shot.stack.mean - np.float32(level)) / np.float32(shot.exposure_s)


def _cut(values: np.ndarray, region: tuple[int, int, int, int] | None) -> np.ndarray:
    if region is None:
        return values
    x, y, width, height = region
    part = values[max(y, 0) : y + height, max(x, 0) : x + width]
    if min(x, y) < 0 or part.shape[:2] != (height, width) or min(height, width) < 2 * CELL:
        raise PlanRefused(
            value_problem("", "region", "the region does not lie in the frame",
                          f"{x},{y},{width},{height}", f"within {values.shape[1]} x {values.shape[0]} px, "
                          f"at least {2 * CELL} px a side")
        )  # fmt: skip
    return part


def _smoothed(rates: np.ndarray, pattern: Any) -> np.ndarray:
    """Return each sensel's light as the mean of its cell of one channel: shot by shot it is drowned in noise."""
    out = np.empty_like(rates)
    planes = zip(planes_of(rates, pattern), planes_of(out, pattern), strict=True)
    for (_, plane), (_, into) in planes:
        high, wide = plane.shape
        cells = block_means(plane, CELL)
        y, x = (np.minimum(np.arange(n) // CELL, n // CELL - 1) for n in (high, wide))
        into[...] = cells[np.ix_(y, x)]
    return out


def _darkest(
    rates: np.ndarray, longest: np.ndarray, pattern: Any, quantile: float
) -> tuple[float, str, float]:
    """Return the rate of the darkest paint, its channel, and the exposure that shows it."""
    times = [plane for _, plane in planes_of(longest, pattern)]
    found = [
        (float(np.quantile(block_means(plane, CELL), quantile)), name, float(np.max(time)))
        for (name, plane), time in zip(planes_of(rates, pattern), times, strict=True)
    ]
    return min(found)


def _sensors(found: BandAdvice, keys: StudioCameraKeys | None) -> tuple[list[SensorAt], float]:
    """Return the sensor at every ISO that may be set, the lowest first, and how much more the frames' ISO amplifies.

    Without sensor data there is one, as fitted to the frames, at their own ISO.
    """
    if keys is None:
        if found.one_shot:
            raise NoAdvice(_one_shot(found))
        return [SensorAt(found.sensor.gain, found.read_variance, iso=found.shot.iso)], 1.0
    after = keys.read_after_e
    if after is not None and after > keys.read_e:
        raise PlanRefused(
            value_problem("", "read_after_e", "a part of the read noise is larger than the whole",
                          after, f"at most read_e, {keys.read_e:g}")
        )  # fmt: skip
    isos: list[float | None] = [*sorted(set(keys.isos))]
    base = isos[0] if isos else found.shot.iso
    shown = found.shot.iso / base if found.shot.iso and base else 1.0
    gain = (found.full - _level(found)) / keys.full_well_e
    behind = (after or 0.0) ** 2
    sensors = []
    for iso in isos if isos and after is not None else [base]:
        more = iso / base if iso and base else 1.0
        read = ((keys.read_e**2 - behind) * more**2 + behind) * gain**2 + ROUNDING
        growth = keys.dark_e_per_s * (gain * more) ** 2
        sensors.append(SensorAt(gain * more, read, growth, iso, more))
    return sensors, shown


def _one_shot(found: BandAdvice) -> Problem:
    return Problem(
        "E_ONE_SHOT",
        f"{found.shot.name}: one shot of an object cannot separate the sensor's noise from the object's texture",
        found=f"{len(found.shots)} exposure{'s' * (len(found.shots) > 1)}, one shot each",
        expected="two shots of an exposure, or sensor data",
        fix="Name a second shot besides, or a setup file with the camera: --setup FILE --camera NAME.",
    )


def _times(scene: _Scene, sensor: SensorAt, wish: SeriesWish) -> list[float]:
    """Return the exposure times of a series, shortest first."""
    wanted = sensor.counts_for(wish.snr)
    span = SPARE * scene.usable / wanted
    if span <= 1:
        most = scene.usable * sqrt(float(sensor.weight(scene.usable, 1.0, scene.dark_share)))
        raise NoAdvice(
            Problem("E_VALUE", "no exposure of this sensor reaches the wanted SNR", field="snr",
                    found=f"{wish.snr:g}", expected=f"less than {most:.0f}",
                    fix="Average shots, and require what one of them reaches.")
        )  # fmt: skip
    limit = wish.longest_s or float("inf")
    first = _down(min(scene.shortest_s / sensor.amplified, limit))
    alone = _snr(scene, sensor, [first], scene.darkest * sensor.amplified)
    if alone >= wish.snr or first >= limit:
        return [first]
    last = min(_up(_needed(scene, sensor, wish)), limit)
    count = min(MOST, 1 + max(1, ceil(log(last / first) / log(span) - 1e-9)))
    ratio = (last / first) ** (1 / (count - 1))
    return [first, *(_down(first * ratio**k) for k in range(1, count - 1)), last]


def _needed(scene: _Scene, sensor: SensorAt, wish: SeriesWish) -> float:
    """Return the time in which one shot of the darkest paint reaches the wanted SNR, dark current and all."""
    rate = scene.darkest * sensor.amplified
    time = sensor.counts_for(wish.snr) / rate
    for _ in range(60):
        reached = rate * sqrt(float(sensor.weight(rate, time, scene.dark_share)))
        if reached >= wish.snr:
            break
        time *= 1.02
    return time


def _snr(
    scene: _Scene, sensor: SensorAt, times: Sequence[float], rate: np.ndarray | float
) -> np.ndarray:
    """Return the linear SNR of a merge; of the shortest exposure where all saturate."""
    rate = np.asarray(rate, float)
    total = np.zeros(rate.shape)
    for k, time in enumerate(times):
        free = (rate * time <= scene.usable) | (k == 0)
        total += np.where(free, sensor.weight(rate, time, scene.dark_share), 0.0)
    return np.maximum(rate, 0.0) * np.sqrt(total)


def _serves_better(
    scene: _Scene,
    wish: SeriesWish,
    higher: tuple[SensorAt, list[float]],
    lower: tuple[SensorAt, list[float]],
) -> bool:
    """Whether a higher ISO brings more than it costs: the wanted SNR, an exposure less, time, or signal over noise."""
    times, before = higher[1], lower[1]
    snr, snr_before = (
        float(_snr(scene, s, t, scene.darkest * s.amplified)) for s, t in (higher, lower)
    )
    reached, reached_before = (v >= ALMOST * wish.snr for v in (snr, snr_before))
    if reached != reached_before:
        return reached
    if not reached:
        return snr > (1 + WORTH_SNR) * snr_before
    if len(times) != len(before):
        return len(times) < len(before)
    return sum(times) < (1 - WORTH_TIME) * sum(before)


def _judged(
    scene: _Scene, sensor: SensorAt, times: list[float], wish: SeriesWish, iso_words: str
) -> ExposureSeries:
    import cv2

    more = sensor.amplified
    rates, smooth = (a * np.float32(more) for a in (scene.rates, scene.smooth))
    dark, bright = scene.darkest * more, scene.brightest * more
    weights, unsaturated = [], []
    for time in times:
        full = (rates * time > scene.usable).astype(np.uint8).reshape(rates.shape[0], -1)
        free = (cv2.dilate(full, np.ones((3, 3), np.uint8)) == 0).reshape(rates.shape)
        unsaturated.append(free)
        weights.append(np.where(free, sensor.weight(smooth, time, scene.dark_share), 0.0))
    stacked = np.stack(weights)
    lit = np.maximum(smooth, 0.0)
    heaviest = stacked.argmax(0)
    exposures = tuple(
        PlannedExposure(
            time, float(free.mean()), float((lit * np.sqrt(w) >= wish.snr).mean()),
            float(((heaviest == k) & free).mean()),
        )
        for k, (time, free, w) in enumerate(zip(times, unsaturated, weights, strict=True))
    )  # fmt: skip
    curve_rates = np.geomspace(dark / 4, max(bright, dark) * 1.2, CURVE)
    single = _snr(scene, sensor, times[:1], curve_rates)
    single = np.where(curve_rates * times[0] > scene.usable, np.nan, single)
    curve = np.stack([curve_rates, single, _snr(scene, sensor, times, curve_rates)])
    edges = np.concatenate([[0.0], np.sqrt(curve_rates[1:] * curve_rates[:-1]), [np.inf]])
    histogram = np.histogram(lit, edges)[0] / lit.size
    snr_single = float(_snr(scene, sensor, times[:1], dark))
    snr_series = float(_snr(scene, sensor, times, dark))
    return ExposureSeries(
        scene.name, exposures, sensor, wish, scene.channel, dark, bright, snr_single, snr_series,
        float((lit * np.sqrt(weights[0]) < wish.snr).mean()),
        float((lit * np.sqrt(stacked.sum(0)) < wish.snr).mean()),
        iso_words, tuple(_limits(snr_single, snr_series, times, wish)), curve, histogram,
    )  # fmt: skip


def _limits(single: float, series: float, times: list[float], wish: SeriesWish) -> list[str]:
    notes = []
    if series < ALMOST * wish.snr:
        shots = ceil((wish.snr / series) ** 2)
        notes.append(
            f"the longest exposure that can be set, {times[-1]:g} s, leaves the darkest paint at SNR {series:.1f}: "
            f"average {shots} shots of it, or give more light"
        )
    if len(times) > 1:
        shots = ceil((wish.snr / max(single, 1e-9)) ** 2)
        notes.append(
            f"as many photons by the shortest exposure alone would take {shots:,} shots of it"
        )
    return notes


def _iso_words(keys: StudioCameraKeys | None, sensors: list[SensorAt], best: int) -> str:
    if keys is None or keys.read_after_e is None or not keys.isos:
        return (
            "not chosen: that takes the read noise before and after the amplifier (read_e, read_after_e and "
            "isos of the camera in a setup file, --setup with --camera); the times are for the ISO of the frames"
        )
    base, chosen = sensors[0], sensors[best]
    read = [sqrt(s.read_variance) / s.gain for s in (base, chosen)]
    if best == 0:
        return (
            f"{base.iso:g}, the lowest: its full well of {keys.full_well_e:,.0f} e⁻ holds the most photons, "
            f"and read noise of {read[0]:.1f} e⁻ does not rule the darkest paint"
        )
    return (
        f"{chosen.iso:g} instead of {base.iso:g}: read noise {read[0]:.1f} → {read[1]:.1f} e⁻, full well "
        f"{keys.full_well_e:,.0f} → {keys.full_well_e / chosen.amplified:,.0f} e⁻"
    )


def _down(time: float) -> float:
    step = 10.0 ** (floor(log10(time)) - 2)
    return round(floor(time / step + 1e-9) * step, 12)


def _up(time: float) -> float:
    step = 10.0 ** (floor(log10(time)) - 2)
    return round(ceil(time / step - 1e-9) * step, 12)

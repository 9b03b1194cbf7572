"""What averaged frames of a sensor show of its noise, lamp, black level and light: parts of its record; nothing here changes a value."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.calibration.clipped_darks import MANY_ZEROS
from levkas.calibration.darks import level_under
from levkas.calibration.exposures import (
    ALIKE,
    BLACK_ERROR,
    PERIOD,
    Point,
    find_bend,
    find_points,
    hides_offset,
)
from levkas.calibration.findings import Finding
from levkas.calibration.flatfield import pair_darks
from levkas.calibration.lamp import LampChange, black_between, lamp_between
from levkas.calibration.noise_fit import UNLIKE, compare_noise, whole_variance
from levkas.calibration.patterns import channel_names, channel_table
from levkas.calibration.record import LampNumbers, SensorNoise, SensorRecord, WithError
from levkas.calibration.sensor import spread
from levkas.calibration.templates import Template, level_of
from levkas.calibration.whites import reflectance_table
from levkas.stages.capture_statistics import as_number

if TYPE_CHECKING:
    from levkas.calibration.darks import MatchedDark
    from levkas.calibration.flatfield import Calibrated
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.sensor import SensorCapture
    from levkas.calibration.whites import WhiteBoard
    from levkas.core.cube import Cube
    from levkas.quality.image_quality.light import LightField

FEW_BANDS, LEVELS = 5, 65535
"""Bands of a line scan or photograph whose light is looked at; levels of its map."""
PHOTONS, WHITE_FRAMES, DARK_FRAMES = "photons and read noise", "white frames", "dark frames"
Phase = tuple[slice, slice]


def rounded(value: float, digits: int = 4) -> float:
    """Return a number of a few digits."""
    return float(f"{value:.{digits}g}")


@dataclass(frozen=True, eq=False)
class Stacks:
    """Averaged frames of one scene: the object's, its darks, its white, and its board."""

    context: SensorCapture
    shot: Template
    darks: list[Template]
    white: Template | None
    board: WhiteBoard

    @property
    def labels(self) -> list[str]:
        """Of the bands."""
        return list(self.board.labels or ())

    @cached_property
    def pair(self) -> tuple[MatchedDark, MatchedDark, float, tuple[str, ...]]:
        """Darks of object and white, the white's time over the object's, and notes."""
        return pair_darks(self.shot, self.darks or None, self.white, self.context.black_level)

    @cached_property
    def phases(self) -> dict[str, Phase]:
        """Rows and columns of the first sensels of each band of a frame: all of a sensor without a mosaic."""
        pattern, labels = self.board.pattern, self.labels
        table = np.zeros((1, 1), int) if pattern is None else channel_table(pattern, labels)
        rows, columns = table.shape
        firsts = (np.argwhere(table == k)[0].tolist() for k in range(len(labels)))
        return {labels[k]: np.s_[y::rows, x::columns] for k, (y, x) in enumerate(firsts)}

    @cached_property
    def per_count(self) -> dict[str, float]:
        """What a count is of the values of each band, where the light is middling."""
        if self.white is None:
            return dict.fromkeys(self.labels, 1.0)
        scale, found = reflectance_table(self.board, self.shot) * self.pair[2], {}
        for label, phase in self.phases.items():
            light = _level(self.white, phase) - _level(self.pair[1], phase)
            found[label] = float(level_of(_phase(scale, phase)) / max(light, 1e-9))
        return found

    def in_bands(self, change: LampChange) -> LampChange:
        """Return what is known of the channels of stacks, band by band."""
        count = len(change.sigma)
        if self.board.pattern is not None:
            which = channel_table(self.board.pattern, self.labels).ravel()
        else:  # of a tunable filter before a mosaic, all phases see one band
            which = np.arange(count) if count == len(self.labels) else np.zeros(count, int)
        return change.in_groups(which, len(self.labels))


def _phase(frame: np.ndarray, phase: Phase) -> np.ndarray:
    """Return the sensels of one band of a frame, or its one number of a line or of all."""
    parts = zip(phase, frame.shape[:2], strict=True)
    return frame[tuple(part if n > 1 else slice(None) for part, n in parts)]


def _level(frames: Template | MatchedDark, phase: Phase) -> float:
    """Return the middling counts of a band."""
    part = _phase(frames.mean, phase)
    return frames.level if part.size == frames.mean.size else level_of(part)


def measure_stacks(stacks: Stacks, flat: Calibrated, noise: NoiseModel | None) -> SensorRecord:
    """Return what frames and calibrated values say of each band's uncertainty."""
    context, shot, white, board = stacks.context, stacks.shot, stacks.white, stacks.board
    record = SensorRecord()
    if white is None and context.camera.white_chart is not None:
        record.exposures_s = dict.fromkeys(stacks.labels, shot.exposure_s)
    if white is not None and white.shots is not None and shot.shots is not None:
        lamp = stacks.in_bands(lamp_between(white.shots, shot.shots))
        per_count = [*stacks.per_count.values()]
        record.lamp = lamp_numbers(stacks.labels, lamp, _black_change(stacks), per_count)
    if not shot.above_dark:
        units = np.broadcast_to(1.0 if board.unit is None else board.unit, len(stacks.labels))
        steps = zip(stacks.per_count.items(), units, strict=True)
        record.rounding = {b: rounded(context.step * one / float(unit)) for (b, one), unit in steps}
    if white is None and board.unit is None and (wander := _black_change(stacks)) is not None:
        sigmas = zip(stacks.labels, wander.sigma, strict=True)
        record.black_wander = {label: rounded(sigma) for label, sigma in sigmas}
    if noise is not None:
        if white is not None or board.unit is None:
            record.noise_shares = _noise_shares(stacks, noise)
        if board.pattern is not None and context.light is None:
            record.unlike_noise = _unlike_channels(stacks, noise)
    for label, phase in stacks.phases.items():
        values = _phase(flat.values, phase)
        known = np.isfinite(values)
        mean = float(values.mean(where=known, dtype=float)) if known.any() else 0.0
        record.mean_of_view[label] = rounded(mean)
    return record


def _unlike_channels(stacks: Stacks, noise: NoiseModel) -> dict[str, float]:
    """Return the channels of a mosaic whose noise is not that of all: their gain is another one."""
    lit = [s for s in (stacks.shot, stacks.white) if s is not None and s.variance is not None]
    black, found = stacks.context.black_level, {}
    under = [level_under(stack, stacks.darks, black=black) for stack in lit]
    for label, phase in stacks.phases.items():
        parts = [stack.taken(partial(_phase, phase=phase), shots=None) for stack in lit]
        ratio = compare_noise(noise, parts, [_phase(level, phase) for level in under])
        if not 1 / UNLIKE < ratio < UNLIKE:
            found[label] = rounded(ratio, 3)
    return found


def _black_change(stacks: Stacks) -> LampChange | None:
    """Return how the black level changed between darks and object, band by band; None of single and of clipped darks."""
    found = [
        stacks.in_bands(black_between(one.shots, stacks.shot.shots))
        for one in stacks.darks
        if one.shots and one.count > 1 and one.fit is None and np.mean(one.black) <= MANY_ZEROS
    ]
    return max(found, key=lambda one: float(one.sigma.max()), default=None)


def _noise_shares(stacks: Stacks, noise: NoiseModel) -> dict[str, dict[str, float]]:
    """Return what shots, white and darks add to the noise of each band where its signal is middling, in the unit of the values."""
    shot, white, found = stacks.shot, stacks.white, {}
    under, white_under, *_ = stacks.pair
    for label, phase in stacks.phases.items():
        signal = max(_level(shot, phase) - _level(under, phase), 1e-9)
        of_dark, of_other = (d.share * noise.read_under(d) for d in (under, white_under))
        counts = {PHOTONS: _variance_of(shot, phase, noise, signal)}
        if white is None:
            counts[DARK_FRAMES] = of_dark
        else:
            light = max(_level(white, phase) - _level(white_under, phase), 1e-9)
            ratio = signal / light
            if white_under is under:
                of_dark, of_other = (1 - ratio) ** 2 * of_dark, 0.0
            counts[WHITE_FRAMES] = ratio**2 * _variance_of(white, phase, noise, light)
            counts[DARK_FRAMES] = of_dark + ratio**2 * of_other
        each = stacks.per_count[label]
        found[label] = {name: rounded(each * size**0.5) for name, size in counts.items()}
    return found


def _variance_of(frames: Template, phase: Phase, noise: NoiseModel, signal: float) -> float:
    """Return the variance of a mean of frames at a signal, counts²; of merged ones that was worked out."""
    if frames.above_dark and frames.variance is not None:
        return level_of(_phase(frames.variance, phase)) / frames.count
    return float(noise.variance(signal)) / frames.count


# --- exposure series ----------------------------------------------------------------------------


class Series(NamedTuple):
    """What exposures of one scene have in common, the counts without light, and whether clipped darks hide these."""

    points: list[Point]
    level: float | None
    hidden: bool


def series_of(
    context: SensorCapture, shots: Sequence[Template], darks: Sequence[Template]
) -> list[Series]:
    """Return what some exposures of a scene have in common; nothing of one, of unknown times, or without a full scale."""
    full, shapes = context.saturation, {t.mean.shape for t in (*shots, *darks)}
    timed = [shot for shot in shots if shot.exposure_s]
    if len(timed) < 2 or full is None or len(shapes) > 1:
        return []
    period = context.period if context.sensor.pattern else PERIOD
    black = context.black
    points = find_points(timed, darks, saturation=full, black=black, period=period, contrast=ALIKE)
    level = float(np.median(darks[0].mean)) if darks else None
    return [Series(points, level, hides_offset(darks))]


def straightness(context: SensorCapture, series: Sequence[Series]) -> SensorRecord:
    """Return how straight the sensor is, and its counts without light, by the exposure series of objects and whites."""
    record, points = SensorRecord(), list[Point]()
    if context.saturation is None or not series:
        return record
    for which, one in enumerate(series):
        first = points[-1].group + 1 if points else 0
        points += [p._replace(group=p.group + first, series=which) for p in one.points]
    levels = [context.black or 0.0, *(one.level for one in series if one.level is not None)]
    bend = find_bend(points, context.saturation - levels[-1])
    if abs(bend.offset) > BLACK_ERROR and not any(one.hidden for one in series):
        record.offset = WithError(counts=bend.offset, error=bend.offset_error)
    if bend.is_sure:
        record.bend = bend.size
    if np.isfinite(bend.error):
        record.straightness = rounded(float(np.hypot(bend.size, bend.error)), 3)
    return record


# --- the sensor ---------------------------------------------------------------------------------


def sensor_noise(
    noise: NoiseModel | None, dark: Template | None, black: float, saturation: float | None
) -> SensorNoise | None:
    """Return gain, noise in the dark and range of a sensor; None where one is not known."""
    from levkas.quality.image_quality.dynamic_range import sensor_stops

    if noise is None or saturation is None:
        return None
    full = saturation - (float(np.mean(dark.mean)) if dark is not None else black)
    read, gain = _noise_in_the_dark(dark, noise.step), float(noise.gain)
    if read is None and noise.read_variance > noise.step**2 / 12 * 1.01:
        read = float(np.sqrt(noise.read_variance))
    if read is None:  # the fit had one level only, and took rounding for all there is
        return None
    stops = sensor_stops(full, read)
    return SensorNoise(full=full, read_noise=read, gain=gain, stops=stops, source=noise.source)


def _noise_in_the_dark(dark: Template | None, step: float) -> float | None:
    """Standard deviation of one dark shot, rounding included, counts; None where there is none, or it was clipped.

    Of a single dark the neighbours' differences, which leave out what is fixed and smooth.
    """
    if dark is None or dark.mean.size < 1000:
        return None
    if dark.fit is not None:
        return float(np.sqrt(dark.fit.noise**2 + step**2 / 12))
    if float(dark.mean.min()) <= 0 and float(np.mean(dark.black | (dark.mean <= 0))) > MANY_ZEROS:
        return None
    if dark.count > 1 and dark.variance is not None:
        found = float(np.median(dark.variance) if dark.count > 20 else np.mean(dark.variance))
    else:
        apart = np.abs(np.diff(dark.mean.astype(float), axis=1)).ravel()
        near = apart[apart <= np.quantile(apart, 0.995)]  # hot sensels are not noise
        found = float(np.mean(near)) ** 2 * np.pi / 4
    return float(np.sqrt(whole_variance(found, step)))


def sensels_of(
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    pattern: Any,
    labels: Sequence[str],
) -> dict[str, dict[str, float | None]]:
    """Return noise and signal-to-noise of a mosaic's sensels, channel by channel."""
    from levkas.quality.image_quality.dynamic_range import sensel_noise

    if variance is None:
        return {}
    found = sensel_noise(values, flags, variance, channel_table(pattern, labels))
    rows = zip(labels, found, strict=True)
    return {label: {"noise": as_number(n), "snr": as_number(snr)} for label, (n, snr) in rows}


# --- the light ----------------------------------------------------------------------------------


def light_of(
    white: Template | None,
    darks: Sequence[Template],
    pattern: Any,
    labels: Sequence[str],
    *,
    period: tuple[int, int] = (1, 1),
) -> dict[str, dict[str, Any]]:
    """Return how even the light is on the white, channel by channel; where it cannot say, because it saturates, why.

    One that is merged is in counts a second: the bits left in the corners are unknown. Of a cube that is only
    every so-many-th pixel a side, these are the `period`.
    """
    from levkas.quality.image_quality.light import LightRefused, light_field

    light: dict[str, dict[str, Any]] = {}
    for label, plane, saturated, apart in _planes(white, darks, pattern, labels) if white else ():
        try:
            found = light_field(plane, saturated=saturated)
        except LightRefused as refused:
            light[label] = {"refused": str(refused.problems[0])}
            continue
        light[label] = _record_of_light(found, apart[0] * period[0], apart[1] * period[1])
        if white is not None and not white.above_dark:
            light[label]["bits"] = [round(b, 2) for b in found.bits]
    return light


def _planes(
    white: Template, darks: Sequence[Template], pattern: Any, labels: Sequence[str]
) -> Iterator[tuple[str, np.ndarray, np.ndarray, tuple[int, int]]]:
    """Yield (label, counts above dark, saturated, period) of every channel; of a mosaic its first phase."""
    above, full = white.mean - level_under(white, list(darks)), white.saturated
    if white.mean.ndim == 3:
        for i in spread(range(len(labels)), FEW_BANDS):
            yield labels[i], above[..., i], full[..., i], (1, 1)
        return
    table = np.zeros((1, 1), int) if pattern is None else channel_table(pattern)
    rows, columns = table.shape
    for i in range(1 if pattern is None else len(channel_names(pattern))):
        y, x = (int(n) for n in np.argwhere(table == i)[0])
        phase = np.s_[y::rows, x::columns]
        yield labels[i], above[phase], full[phase], (columns, rows)


def _record_of_light(field: LightField, across: int, down: int) -> dict[str, Any]:
    """Return a light field of every so-many-th pixel across and down as a record."""
    levels = np.round(field.levels * LEVELS).astype("<u2")
    x, y, width, height = field.rectangle
    return {
        "levels": base64.b64encode(levels.tobytes()).decode("ascii"),
        "shape": list(levels.shape),
        "step": [field.step * across, field.step * down],
        "size": [field.size[0] * across, field.size[1] * down],
        "rectangle": [x * across, y * down, width * across, height * down],
        **{name: getattr(field, name) for name in ("drop", "uniformity", "share")},
    }


def levels_of(record: Mapping[str, Any]) -> np.ndarray:
    """Return the levels of a recorded light field, (rows, columns), 0 … 1."""
    stored = np.frombuffer(base64.b64decode(record["levels"]), "<u2")
    return stored.reshape(record["shape"]) / LEVELS


def lamp_numbers(
    labels: Sequence[str],
    lamp: LampChange,
    dark: LampChange | None = None,
    per_count: Sequence[float] = (),
) -> dict[str, LampNumbers]:
    """Return how lamp and black level changed between darks, white and object, band by band.

    `dark` is the wander of the black level, counts; `per_count` is the reflectance of a count in each band.
    """
    found: dict[str, LampNumbers] = {}
    for i, label in enumerate(labels):
        names = ("sigma", "white", "object", "flicker")
        numbers = {
            "black": np.nan,
            "black_sigma": 0.0,
            **{n: v[i] for n, v in zip(names, lamp[:4], strict=True)},  # type: ignore[index]
        }
        if dark is not None:
            within = np.hypot(*np.nan_to_num([dark.white[i], dark.flicker[i]])) * per_count[i]
            sigma = dark.sigma[i] * per_count[i]
            numbers |= {"black": dark.white[i], "black_sigma": sigma, "black_within": within}
        if lamp.reach:
            numbers["reach"] = lamp.reach
        found[label] = LampNumbers(**{n: as_number(float(v)) for n, v in numbers.items()})  # type: ignore[typeddict-item]
    return found


def stray_light_by(
    cube: Cube, boxes: Sequence[tuple[int, int, int, int]], target: str
) -> tuple[Mapping[str, Any] | None, list[Finding | str]]:
    """Return the stray light that light traps in a sensor's frames show, and what a person should know of it."""
    from levkas.quality.targets.stray_light import describe_trap, stray_light_of_trap

    height, width = cube.values.shape[:2]
    beyond = [[*box] for box in boxes if box[0] + box[2] > width or box[1] + box[3] > height]
    if beyond:
        return None, [Finding("trap_beyond", target, found=f"{beyond[0]} in {width} x {height}")]
    if not boxes or cube.quantity != "reflectance":
        return None, []
    found = stray_light_of_trap(cube, boxes)
    if found is None:
        return None, [Finding("trap_blind", target)]
    record = found.to_dict(cube.bands)
    return record, [describe_trap(record)]

"""What calibration notes of a sensor's shots for the budget of its layer: lamp, black level, noise, code spacing.

Nothing here changes a value. What is noted stands in `SensorContext.measured`, by band; `levkas.stages.budget` reads it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.clipped_darks import MANY_ZEROS
from levkas.calibration.darks import level_under
from levkas.calibration.drift import black_between, lamp_between
from levkas.calibration.flatfield import pair_darks
from levkas.calibration.noise_fit import UNLIKE, compare_noise
from levkas.calibration.patterns import channel_table
from levkas.calibration.sensor_context import UNLIKE_NOISE
from levkas.calibration.templates import level_of
from levkas.calibration.whites import reflectance_table
from levkas.stages.capture_statistics import (
    BLACK_WANDER,
    DARK_FRAMES,
    NOISE,
    PHOTONS,
    ROUNDING,
    VIEW,
    WHITE_FRAMES,
    note_lamp,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.calibration.darks import MatchedDark
    from levkas.calibration.drift import LampChange
    from levkas.calibration.flatfield import Calibrated
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.sensor_context import SensorContext
    from levkas.calibration.templates import Template
    from levkas.calibration.whites import WhiteBoard

Phase = tuple[slice, slice]


def note_shots(
    context: SensorContext,
    shot: Template,
    dark: list[Template],
    white: Template | None,
    board: WhiteBoard,
    flat: Calibrated,
    noise: NoiseModel | None,
) -> None:
    """Note in `measured` what a sensor's frames and its values, `flat`, say of each band's uncertainty."""
    labels, scanned = board.labels or (), context.camera.traits.is_scanned
    if white is None and context.camera.white_chart is not None:
        taken = dict.fromkeys(labels, shot.exposure_s)
        context.measured.setdefault("exposures_s", {}).update(taken)
    if scanned:
        return
    if not shot.above_dark:
        _note_code_spacing(context, shot, dark, white, board)
    if white is None:
        _note_black(context, shot, dark, board)
    if noise is not None:
        _note_shares(context, shot, dark, white, board, noise)
        if board.pattern is not None and context.light is None:
            _note_unlike_channels(context, (shot, white), dark, board, noise)
    context.measured.setdefault(VIEW, {}).update(
        (label, float(f"{_mean_of(_phase(flat.values, phase)):.4g}"))
        for label, phase in _phases(board).items()
    )


def note_lamp_between(
    context: SensorContext, shot: Template, dark: list[Template], white: Template, board: WhiteBoard
) -> None:
    """Note how the lamp changed between white and object, where that was measured."""
    if white.shots is None or shot.shots is None:
        return
    labels = list(board.labels or ())
    lamp = lamp_between(white.shots, shot.shots)
    lamp = lamp.in_groups(_channels(board, len(lamp.sigma)), len(labels))
    per_count = _per_count(context, shot, dark, white, board).values()
    note_lamp(context.measured, labels, lamp, _black_level(shot, dark, board), [*per_count])


def _note_code_spacing(
    context: SensorContext,
    shot: Template,
    dark: list[Template],
    white: Template | None,
    board: WhiteBoard,
) -> None:
    """Note what one step of the codes is of the values of each band."""
    found = {
        label: float(f"{context.step * one:.4g}")
        for label, one in _per_count(context, shot, dark, white, board).items()
    }
    if board.unit is not None:
        pairs = zip(found.items(), board.unit, strict=True)
        found = {label: step / float(unit) for (label, step), unit in pairs}
    context.measured.setdefault(ROUNDING, {}).update(found)


def _note_unlike_channels(
    context: SensorContext,
    stacks: Sequence[Template | None],
    darks: Sequence[Template],
    board: WhiteBoard,
    noise: NoiseModel,
) -> None:
    """Note in `measured` the channels of a mosaic whose noise is not that of all: their gain is another one."""
    lit = [stack for stack in stacks if stack is not None and stack.variance is not None]
    under = [level_under(stack, darks, black=context.black_level) for stack in lit]
    for label, phase in _phases(board).items():
        parts = [_of_phase(stack, phase) for stack in lit]
        found = compare_noise(noise, parts, [_phase(level, phase) for level in under])
        if not 1 / UNLIKE < found < UNLIKE:
            context.measured.setdefault(UNLIKE_NOISE, {})[label] = float(f"{found:.3g}")


def _of_phase(stack: Template, phase: Phase) -> Template:
    """Return a template of the sensels of one band."""
    arrays: dict[str, Any] = {
        name: _phase(array, phase)
        for name in ("mean", "variance", "saturated", "black", "lost", "absent")
        if (array := getattr(stack, name)) is not None
    }
    return replace(stack, shots=None, **arrays)


def _channels(board: WhiteBoard, channels: int) -> np.ndarray:
    """Return the band of each channel of a stack."""
    labels = list(board.labels or ())
    if board.pattern is not None:
        return channel_table(board.pattern, labels).ravel()
    # Of a tunable filter before a mosaic, all phases see one band.
    return np.arange(channels) if channels == len(labels) else np.zeros(channels, int)


def _black_level(shot: Template, dark: Sequence[Template], board: WhiteBoard) -> LampChange | None:
    """Return how the black level changed between darks and object, band by band; None of single and of clipped darks."""
    found = [
        black_between(one.shots, shot.shots)
        for one in dark
        if one.shots is not None
        and one.count > 1
        and one.fit is None
        and np.mean(one.black) <= MANY_ZEROS
    ]
    wander = [
        one.in_groups(_channels(board, len(one.sigma)), len(board.labels or ())) for one in found
    ]
    return max(wander, key=lambda one: float(one.sigma.max()), default=None)


def _note_black(
    context: SensorContext, shot: Template, dark: Sequence[Template], board: WhiteBoard
) -> None:
    """Note how the black level of values in counts wanders."""
    wander = _black_level(shot, dark, board)
    if wander is not None and board.unit is None:
        context.measured.setdefault(BLACK_WANDER, {}).update(
            (label, float(f"{sigma:.4g}"))
            for label, sigma in zip(board.labels or (), wander.sigma, strict=True)
        )


def _note_shares(
    context: SensorContext,
    shot: Template,
    dark: list[Template],
    white: Template | None,
    board: WhiteBoard,
    noise: NoiseModel,
) -> None:
    """Note in `measured` what shots, white and darks add to the noise of each band where its signal is middling, reflectance."""
    under, white_under, *_ = pair_darks(shot, dark or None, white, context.black_level)
    if white is None and board.unit is not None:
        return
    notes = context.measured.setdefault(NOISE, {})
    per_count = _per_count(context, shot, dark, white, board)
    for label, phase in _phases(board).items():
        signal = _signal(shot, under, phase)
        of_dark, of_other = (d.share * noise.read_under(d) for d in (under, white_under))
        counts = {PHOTONS: _variance_of(shot, phase, noise, signal)}
        if white is None:
            counts[DARK_FRAMES] = of_dark
        else:
            light = _signal(white, white_under, phase)
            ratio = signal / light
            if white_under is under:
                of_dark, of_other = (1 - ratio) ** 2 * of_dark, 0.0
            counts[WHITE_FRAMES] = ratio**2 * _variance_of(white, phase, noise, light)
            counts[DARK_FRAMES] = of_dark + ratio**2 * of_other
        notes[label] = {
            name: float(f"{per_count[label] * found**0.5:.4g}") for name, found in counts.items()
        }


def _signal(frames: Template, under: MatchedDark, phase: Phase) -> float:
    """Return the middling counts of a band above what is under them."""
    return max(_level(frames, phase) - _level(under, phase), 1e-9)


def _level(frames: Template | MatchedDark, phase: Phase) -> float:
    """Return the middling counts of a band."""
    part = _phase(frames.mean, phase)
    return frames.level if part.size == frames.mean.size else level_of(part)


def _variance_of(frames: Template, phase: Phase, noise: NoiseModel, signal: float) -> float:
    """Return the variance of a mean of frames at a signal, counts²; of merged ones that was worked out."""
    if frames.above_dark and frames.variance is not None:
        return level_of(_phase(frames.variance, phase)) / frames.count
    return float(noise.variance(signal)) / frames.count


def _mean_of(values: np.ndarray) -> float:
    """Return the mean of what is known, 0 of nothing."""
    known = np.isfinite(values)
    return float(values.mean(where=known, dtype=float)) if known.any() else 0.0


def _phases(board: WhiteBoard) -> dict[str, Phase]:
    """Return rows and columns of the first sensels of each band of a frame: all of a sensor without a mosaic."""
    labels = list(board.labels or ())
    table = np.zeros((1, 1), int) if board.pattern is None else channel_table(board.pattern, labels)
    firsts = (np.argwhere(table == k)[0].tolist() for k in range(len(labels)))
    rows, columns = table.shape
    return {
        label: (slice(y, None, rows), slice(x, None, columns))
        for label, (y, x) in zip(labels, firsts, strict=True)
    }


def _phase(frame: np.ndarray, phase: Phase) -> np.ndarray:
    """Return the sensels of one band of a frame, or its one number of a line or of all."""
    tall, wide = (
        part if n > 1 else slice(None) for part, n in zip(phase, frame.shape[:2], strict=True)
    )
    return frame[tall, wide]


def _per_count(
    context: SensorContext,
    shot: Template,
    dark: list[Template],
    white: Template | None,
    board: WhiteBoard,
) -> dict[str, float]:
    """Return what a count is of the values of each band, where the light is middling."""
    if white is None:
        return dict.fromkeys(board.labels or (), 1.0)
    pair = pair_darks(shot, dark or None, white, context.black_level)
    scale, found = reflectance_table(board, shot) * pair[2], {}
    for label, phase in _phases(board).items():
        lit, under = (_level(one, phase) for one in (white, pair[1]))
        found[label] = float(level_of(_phase(scale, phase)) / max(lit - under, 1e-9))
    return found

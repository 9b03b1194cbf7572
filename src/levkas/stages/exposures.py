"""Exposures of one sensor: an object's shots as one, its white, and the noise by both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.agreement import facts_of
from levkas.calibration.darks import SAME_TIME, level_under
from levkas.calibration.defects import find_defects
from levkas.calibration.exposures import best_exposure, merge_exposures
from levkas.calibration.flatfield import Calibrated, flat_field
from levkas.calibration.linearity import check_linearity, require_reciprocity
from levkas.calibration.motion import find_moved
from levkas.calibration.noise_fit import fit_noise_of_band, fit_noise_of_frames
from levkas.calibration.sensor_context import (
    UNLIKE_NOISE,
    SensorContext,
    exposure_of,
    placed,
    placing,
)
from levkas.calibration.stated_exposures import doubt_scaling
from levkas.calibration.templates import CalibrationRefused, Template, describe_gaps, gaps_of
from levkas.calibration.white_area import WhiteArea, board_alone, find_white_area
from levkas.calibration.whites import WhiteBoard, check_white
from levkas.campaign.discovery.captures import CaptureRefused
from levkas.core.cube import Cube, Flag, is_flagged
from levkas.core.problems import Problem
from levkas.core.rounding import round_root, round_values
from levkas.quality.image_quality.glare import mark_glare
from levkas.stages.capture_statistics import note_noise
from levkas.stages.shot_notes import note_lamp_between, note_shots

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.calibration.exposures import Merged
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.campaign.discovery.captures import FrameRef


@dataclass(frozen=True)
class Exposed:
    """An object's frames as one; merged exposures are above dark, and say what moved."""

    shot: Template
    moved: np.ndarray | None = None


def average_shots(
    context: SensorContext, frames: Sequence[FrameRef], darks: Sequence[Template]
) -> list[Template]:
    """Average the object's shots, exposure by exposure, as a linear sensor had recorded them."""
    times = sorted({exposure_of(f) for f in frames}, key=lambda t: (t is not None, t or 0.0))
    if len(times) > 1 and context.camera.exposures == "one":
        raise CaptureRefused(
            Problem(
                "E_EXPOSURES",
                f"{context.camera.name}: shots of several exposures",
                str(frames[0].path.parent),
                f"cameras.{context.camera.name}.exposures",
                ", ".join(f"{t:g} s" for t in times if t),
                "one exposure",
                'Write exposures = "best" (the longest unsaturated) or "merge".',
            )
        )
    return [context.average([f for f in frames if exposure_of(f) == t], darks) for t in times]


def expose(
    context: SensorContext, shots: list[Template], darks: list[Template], noise: NoiseModel | None
) -> Exposed:
    """The object's frames as one: averaged, the best exposure, or all merged above dark."""
    if len(shots) == 1:
        return Exposed(shots[0])
    if context.camera.exposures == "merge":
        merged = _merge(context, shots, darks, noise)
        return Exposed(merged.template, merged.moved)
    return Exposed(best_exposure(shots))


def _merge(
    context: SensorContext, shots: list[Template], darks: list[Template], noise: NoiseModel | None
) -> Merged:
    """An exposure series in counts a second above dark."""
    saturation = context.saturation
    if saturation is None:
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                f"{context.camera.name}: merging exposures needs a saturation level",
                field=f"cameras.{context.camera.name}.saturation",
                fix="Declare `bits` or `saturation`.",
            )
        )
    pattern = context.sensor.pattern
    more: dict[str, Any] = {"period": (len(pattern), len(pattern[0]))} if pattern else {}
    return merge_exposures(
        *(shots, darks),
        saturation=saturation,
        black=context.black_level,
        noise=noise,
        **more,
    )


def white_of(
    context: SensorContext,
    whites: list[Template],
    darks: list[Template],
    *,
    noise: NoiseModel | None = None,
    merged: bool = False,
    band: str = "",
) -> Template | None:
    """The white of one exposure, the best one; or several of them merged, above dark; or the light by a chart.

    `whites` are those of `whites_of`; `band` is named where each has frames of its own.
    """
    if context.light is not None:
        height, width = context.facts.shape[:2]
        labels = [band] if band else [one.label for one in context.sensor.bands]
        return context.light.white((height, width), labels)
    if len(whites) < 2:
        return whites[0] if whites else None
    return _merge(context, whites, darks, noise).template if merged else best_exposure(whites)


def check_scaling(
    context: SensorContext,
    exposed: Exposed,
    white: Template | None,
    series: Sequence[list[Template]],
    darks: list[Template],
) -> str:
    """Look whether counts may be scaled from the white's time to the object's, and say if that is not known.

    `series` are exposures of one scene each: the object's, the white's. A merge has been checked already.

    Raises CalibrationRefused, E_EXPOSURES where a series shows that counts do not scale, with exposure and level.
    """
    taken, other = exposed.shot.exposure_s, white.exposure_s if white else None
    if exposed.shot.above_dark or not taken or not other or abs(taken / other - 1) <= SAME_TIME:
        return ""
    pattern = context.sensor.pattern
    more: dict[str, Any] = {"period": (len(pattern), len(pattern[0]))} if pattern else {}
    hidden = bool(darks) and all(np.mean(dark.black) > 0.5 for dark in darks)
    for shots in series:
        saturation = context.saturation
        if len(shots) < 2 or saturation is None:
            continue
        found = check_linearity(
            shots,
            darks,
            saturation=saturation,
            black=context.black_level,
            fit_offset=hidden,
            **more,
        )
        if found.points:
            require_reciprocity(found)
            return ""
    return doubt_scaling(context, taken, other)


def require_white(
    context: SensorContext, white: Template | None, darks: list[Template], labels: Sequence[str]
) -> None:
    """Refuse a white that has no light, or is full, before anything is made of it; raises CalibrationRefused with the files."""
    if white is None or white.above_dark or context.light is not None:
        return
    level = level_under(white, darks, black=context.black_level)
    pattern = context.sensor.pattern if len(labels) == len(context.sensor.bands) else None
    try:
        check_white(white, level, pattern, labels)
    except CalibrationRefused as refused:
        problems = (context.with_full_scale(p) for p in refused.problems)
        raise CalibrationRefused(*(placed(p, context.sensor.white) for p in problems)) from None


def white_area_of(
    context: SensorContext, shot: Template, white: Template | None, darks: list[Template]
) -> WhiteArea:
    """Find where the white shows the object in place of the board; raises CalibrationRefused with the files."""
    if white is None or context.light is not None:
        return WhiteArea()
    levels = [level_under(one, darks, black=context.black_level) for one in (shot, white)]
    with placing(context.sensor.white):
        return find_white_area(shot, white, (levels[0], levels[1]), context.sensor.pattern)


def noise_of(
    context: SensorContext,
    shots: list[Template],
    whites: list[Template | None],
    darks: list[Template],
) -> NoiseModel | None:
    """Noise of the sensor from stacks, darks among them, or from single shots where there are no stacks."""
    if context.light is not None:  # smooth: it shows no noise
        whites = [None] * len(whites)
    pattern, step = context.sensor.pattern, context.step
    black = 0.0 if context.black_level is None else context.black_level
    fitted = fit_noise_of_frames(shots, whites, darks, black=black, pattern=pattern, step=step)
    dark = darks[0] if darks else None
    note_noise(context.measured, fitted, dark, context.black or 0.0, context.saturation)
    return fitted


def noise_of_band(
    context: SensorContext,
    noise: NoiseModel | None,
    shots: list[Template],
    whites: list[Template],
    darks: list[Template],
    label: str,
) -> NoiseModel | None:
    """Return the noise of a band with frames of its own: the sensor's, or where these deny that their own, which is noted."""
    if noise is None:
        return None
    whites = [] if context.light is not None else whites
    black = 0.0 if context.black_level is None else context.black_level
    own, ratio = fit_noise_of_band(noise, shots, whites, darks, black=black, step=context.step)
    if own is not noise:
        context.measured.setdefault(UNLIKE_NOISE, {})[label] = float(f"{ratio:.3g}")
    return own


def _size(shape: tuple[int, ...]) -> str:
    """Return the size of an array in words.

    >>> _size((344, 408)), _size((1, 408, 33))
    ('408 x 344', '408 x 1, 33 bands')
    """
    height, width, *bands = shape
    return f"{width} x {height}" + "".join(f", {count} bands" for count in bands)


def require_same_size(
    context: SensorContext,
    shape: tuple[int, ...],
    darks: Sequence[Template],
    whites: Sequence[Template],
) -> None:
    """Refuse templates of another size than the object, and frames that are smaller than their pattern.

    Raises CalibrationRefused, ``E_SIZE``, before anything is made of them. The templates of a push-broom
    camera are one line.
    """
    lines = shape[0]
    if context.camera.traits.is_scanned and context.camera.scan != "mirror":
        lines = 1
    pattern = context.sensor.pattern
    if pattern is not None and (shape[0] < len(pattern) or shape[1] < len(pattern[0])):
        found, expected = (f"{w} x {h}" for h, w in (shape[:2], (len(pattern), len(pattern[0]))))
        small = Problem(
            "E_SIZE",
            "the frame is smaller than its pattern",
            field="pattern",
            found=found,
            expected=f"at least {expected}",
        )
        raise CalibrationRefused(placed(small, context.sensor.object))
    problems = [
        placed(
            Problem(
                "E_SIZE",
                f"{name} and object differ in size",
                found=_size(template.mean.shape),
                expected=_size((lines, *shape[1:])),
                fix="Capture dark and white in the same mode and with the same crop as the object.",
            ),
            [f for f in frames if facts_of(f).shape[:2] == template.mean.shape[:2]] or frames,
        )
        for name, found, frames in (
            ("dark", darks, context.sensor.dark),
            ("white", whites, context.sensor.white),
        )
        for template in found
        if template.mean.shape != (lines, *shape[1:])
    ]
    if problems:
        raise CalibrationRefused(*problems)


def flatten(
    context: SensorContext,
    shot: Template,
    dark: list[Template],
    white: Template | None,
    *,
    board: WhiteBoard,
    noise: NoiseModel | None = None,
    defects: np.ndarray | None = None,
    moved: np.ndarray | None = None,
) -> Calibrated:
    """Flat-field with the files named in every refusal; `moved` is what the exposures showed already."""
    if white is not None and not context.camera.traits.is_scanned:
        note_lamp_between(context, shot, dark, white, board)
    try:
        flat = flat_field(
            shot, dark or None, white,
            board=board, black=context.black_level, noise=noise, defects=defects,
        )  # fmt: skip
    except CalibrationRefused as refused:
        frames = context.sensor.white or context.sensor.object
        problems = (context.with_full_scale(p) for p in refused.problems)
        raise CalibrationRefused(*(placed(p, frames) for p in problems)) from None
    note_shots(context, shot, dark, white, board, flat, noise)
    if moved is None:
        moved = _moved(context, shot, dark, noise)
    flat = _with_movement(context, flat, moved)
    return _with_gaps(context, flat, (shot, *dark, white), list(board.labels or ()))


def _with_gaps(
    context: SensorContext,
    flat: Calibrated,
    templates: Sequence[Template | None],
    labels: Sequence[str],
) -> Calibrated:
    """Flag as defects what templates have lost, where the object, the first of them, is there."""
    lost, absent = gaps_of(*templates), templates[0].absent if templates[0] else None
    if lost is not None and absent is not None:
        flat = _without(flat, absent)
        lost = lost & ~absent
    if lost is None or not lost.any():
        return flat
    lost = np.broadcast_to(lost, flat.values.shape)
    note = describe_gaps(lost, labels[0] if len(labels) == 1 else context.camera.name)
    values, variance = flat.values, flat.variance
    if context.unmended:  # not replaced from its neighbours: the value is gone
        values = np.where(lost, np.float32(np.nan), values)
        variance = None if variance is None else np.where(lost, np.float32(np.nan), variance)
    flags = np.where(lost, flat.flags | np.uint8(Flag.DEFECT), flat.flags)
    notes = (*flat.notes, note)
    return replace(flat, values=values, variance=variance, flags=flags, notes=notes)


def _without(flat: Calibrated, absent: np.ndarray) -> Calibrated:
    """Return calibrated values with nothing, flagged as outside, where the object is absent."""
    nothing = np.float32(np.nan)
    values, variance = np.where(absent, nothing, flat.values), flat.variance
    variance = None if variance is None else np.where(absent, nothing, variance)
    flags = np.where(absent, np.uint8(Flag.OUTSIDE), flat.flags)
    return replace(flat, values=values, variance=variance, flags=flags)


def _moved(
    context: SensorContext, shot: Template, dark: list[Template], noise: NoiseModel | None
) -> np.ndarray | None:
    """Return what moved between the object's shots; None where that cannot be measured."""
    if shot.count < 2 or noise is None or noise.source != "temporal":
        return None
    rows = context.sensor.pattern or ((None,),)
    # One number for the dark: a hot sensel's current counts as light, as it does for its noise.
    level: float | np.ndarray = 0.0 if context.black_level is None else context.black_level
    if dark:
        level = float(np.median(dark[0].mean))
    return find_moved(shot, noise, level, period=(len(rows), len(rows[0])))


def _with_movement(
    context: SensorContext, flat: Calibrated, moved: np.ndarray | None
) -> Calibrated:
    """Flag what moved, and say how much of it did."""
    if moved is None or not moved.any():
        return flat
    share = float(np.mean(moved))
    note = f"{context.camera.name}: {100 * share:.2g} % of the pixels moved between shots and are flagged"
    flags = np.where(moved, flat.flags | np.uint8(Flag.MOVED), flat.flags)
    return replace(flat, flags=flags, notes=(*flat.notes, note))


def cube_of(
    context: SensorContext,
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    quantity: str,
    uncovered: np.ndarray | None = None,
) -> Cube:
    """Return values, flags and sigma of one sensor, rounded; what is not known is 0 and flagged.

    `uncovered`, (h, w), is where the white does not show the board.
    """
    if uncovered is not None:
        values = np.where(uncovered[..., None], np.float32(np.nan), values)
    sigma = None
    if variance is not None:
        sigma = round_root(variance, out=variance if variance.dtype == np.float32 else None)
    values = round_values(values, out=values if values.dtype == np.float32 else None)
    lost = ~np.isfinite(values)
    if lost.any():
        values = np.where(lost, np.float32(0), values)
        broken = lost & ~is_flagged(flags, Flag.OUTSIDE)
        flags = np.where(broken, flags | (Flag.DEFECT | Flag.OUTSIDE), flags).astype(np.uint8)
    for i, band in enumerate(context.sensor.bands):
        if band.bad:
            flags[..., i] |= np.uint8(Flag.DEFECT)
    return Cube(values, flags, sigma, context.sensor.bands, quantity)


def defects_of(
    darks: list[Template],
    white: Template | None,
    pattern: Any,
    uncovered: np.ndarray | None = None,
) -> np.ndarray | None:
    """Hot sensels of the longest dark and dead ones of the white, where it shows the board."""
    if not darks and white is None:
        return None
    board = None if white is None else board_alone(white, uncovered)
    return find_defects(darks[-1] if darks else None, board, pattern)


def mark_glare_in(cube: Cube) -> Cube:
    """Return reflectance with GLARE in its flags, each value judged by itself."""
    if cube.quantity == "reflectance":
        mark_glare(cube.values, cube.flags, cube.sigma)
    return cube

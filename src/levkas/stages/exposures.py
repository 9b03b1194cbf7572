"""The steps from frames of one sensor to values: opening, an object's shots as one, its white, the noise, the flat field; what files state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.agreement import facts_of
from levkas.calibration.darks import SAME_TIME, level_under
from levkas.calibration.exposures import (
    PERIOD,
    best_exposure,
    check_linearity,
    doubt_scaling,
    hides_offset,
    merge_exposures,
    require_scaling,
)
from levkas.calibration.findings import Finding, refusal
from levkas.calibration.flatfield import Calibrated, flat_field
from levkas.calibration.noise_fit import fit_noise_of_band, fit_noise_of_frames
from levkas.calibration.reflectance import movement, with_marks
from levkas.calibration.sensor import (
    SensorCapture,
    exposure_of,
    listed,
    open_sensor,
    placed,
    placing,
    times_of,
)
from levkas.calibration.templates import CalibrationRefused, Template, gaps_of
from levkas.calibration.white_area import WhiteArea, find_white_area
from levkas.calibration.whites import WhiteBoard, check_white
from levkas.core.cube import Cube, Flag, is_flagged
from levkas.core.rounding import round_root, round_values
from levkas.quality.image_quality.glare import mark_glare
from levkas.readers.frames import read_facts, read_headers
from levkas.stages.spectra import board_of

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.calibration.chart_light import ChartLight
    from levkas.calibration.exposures import Merged
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef, SensorFrames
    from levkas.stages.template_cache import TemplateCache


NAMED = 3
"""Frames, or bands, that a message names."""


@dataclass(frozen=True)
class Exposed:
    """An object's frames as one; merged exposures are above dark, and say what moved."""

    shot: Template
    moved: np.ndarray | None = None


def open_frames(
    capture: Capture,
    campaign: Campaign,
    sensor: SensorFrames,
    templates: TemplateCache,
    light: ChartLight | None = None,
) -> SensorCapture:
    """Decode the frames of a sensor, and return what holds for all of them."""
    board, white = board_of(campaign, capture, sensor), campaign.targets.white
    doubts: list[Finding | str] = [*board.notes]
    if light is None and sensor.white and white and white.reflectance is None:
        doubts.append(Finding("white_unknown"))
    camera, reflectance = campaign.cameras[capture.camera], board.reflectance
    return open_sensor(
        *(camera, sensor, templates), light=light, reflectance=reflectance, doubts=doubts
    )


def average_shots(
    context: SensorCapture, frames: Sequence[FrameRef], darks: Sequence[Template]
) -> list[Template]:
    """Average the object's shots, exposure by exposure."""
    times = sorted({exposure_of(f) or 0.0 for f in frames})
    if len(times) > 1 and context.camera.exposures == "one":
        named = ", ".join(f"{t:g} s" for t in times if t)
        folder = str(frames[0].path.parent)
        raise refusal("exposures_declared", named, file=folder, camera=context.camera.name)
    return context.templates(frames, darks)


def expose(
    context: SensorCapture, shots: list[Template], darks: list[Template], noise: NoiseModel | None
) -> Exposed:
    """The object's frames as one: averaged, the best exposure, or all merged above dark."""
    if len(shots) > 1 and context.camera.exposures == "merge":
        merged = _merge(context, shots, darks, noise)
        return Exposed(merged.template, merged.moved)
    return Exposed(best_exposure(shots) if len(shots) > 1 else shots[0])


def _period(context: SensorCapture) -> tuple[int, int]:
    return context.period if context.sensor.pattern else PERIOD


def _merge(
    context: SensorCapture, shots: list[Template], darks: list[Template], noise: NoiseModel | None
) -> Merged:
    """An exposure series in counts a second above dark."""
    full, black = context.saturation, context.black_level
    if full is None:
        raise refusal("saturation_unknown", camera=context.camera.name)
    period = _period(context)
    return merge_exposures(shots, darks, saturation=full, black=black, noise=noise, period=period)


def white_of(
    context: SensorCapture,
    whites: list[Template],
    darks: list[Template],
    *,
    noise: NoiseModel | None = None,
    merged: bool = False,
    band: str = "",
) -> Template | None:
    """The white of one exposure, the best one; or several of them merged, above dark; or the light by a chart.

    `band` is named where each has frames of its own.
    """
    if context.light is not None:
        height, width = context.facts.shape[:2]
        labels = [band] if band else [one.label for one in context.sensor.bands]
        return context.light.white((height, width), labels)
    if len(whites) < 2:
        return whites[0] if whites else None
    return _merge(context, whites, darks, noise).template if merged else best_exposure(whites)


def check_scaling(
    context: SensorCapture,
    exposed: Exposed,
    white: Template | None,
    series: Sequence[list[Template]],
    darks: list[Template],
) -> list[Finding]:
    """Refuse, E_EXPOSURES, to scale counts from the white's time to the object's where one of `series`, exposures of a scene, denies it; say if none shows it.

    A merge has been checked already.
    """
    taken, other = exposed.shot.exposure_s, white.exposure_s if white else None
    if exposed.shot.above_dark or not taken or not other or abs(taken / other - 1) <= SAME_TIME:
        return []
    for shots in series:
        if len(shots) < 2 or context.saturation is None:
            continue
        found = check_linearity(
            *(shots, darks),
            saturation=context.saturation,
            black=context.black_level,
            fit_offset=hides_offset(darks),
            period=_period(context),
        )
        if found.points:
            require_scaling(found)
            return []
    return doubt_scaling([taken], [other], SAME_TIME)


def require_white(
    context: SensorCapture, white: Template | None, darks: list[Template], labels: Sequence[str]
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
    context: SensorCapture, shot: Template, white: Template | None, darks: list[Template]
) -> WhiteArea:
    """Find where the white shows the object in place of the board; raises CalibrationRefused with the files."""
    if white is None or context.light is not None:
        return WhiteArea()
    levels = [level_under(one, darks, black=context.black_level) for one in (shot, white)]
    with placing(context.sensor.white):
        return find_white_area(shot, white, (levels[0], levels[1]), context.sensor.pattern)


def noise_of(
    context: SensorCapture,
    shots: list[Template],
    whites: list[Template | None],
    darks: list[Template],
) -> NoiseModel | None:
    """Noise of the sensor from stacks, darks among them, or from single shots where there are no stacks."""
    if context.light is not None:  # smooth: it shows no noise
        whites = [None] * len(whites)
    black = 0.0 if context.black_level is None else context.black_level
    pattern, step = context.sensor.pattern, context.step
    return fit_noise_of_frames(shots, whites, darks, black=black, pattern=pattern, step=step)


def noise_of_band(
    context: SensorCapture,
    noise: NoiseModel | None,
    shots: list[Template],
    whites: list[Template],
    darks: list[Template],
) -> tuple[NoiseModel | None, float]:
    """Return the noise of a band with frames of its own, the sensor's unless these deny that; and its variance over the sensor's."""
    if noise is None:
        return None, 1.0
    whites = [] if context.light is not None else whites
    black = 0.0 if context.black_level is None else context.black_level
    return fit_noise_of_band(noise, shots, whites, darks, black=black, step=context.step)


def _size(shape: tuple[int, ...]) -> str:
    height, width, *bands = shape
    return f"{width} x {height}" + "".join(f", {count} bands" for count in bands)


def require_same_size(
    context: SensorCapture,
    shape: tuple[int, ...],
    darks: Sequence[Template],
    whites: Sequence[Template],
) -> None:
    """Refuse templates of another size than the object, one line of a push-broom camera, and frames smaller than their pattern, ``E_SIZE``."""
    sensor, lines = context.sensor, shape[0]
    if context.camera.traits.is_scanned and context.camera.scan != "mirror":
        lines = 1
    if any(n < least for n, least in zip(shape, context.period, strict=False)):
        found, least = _size(shape[:2]), f"at least {_size(context.period)}"
        small = Finding("smaller_than_pattern", found=found, expected=least)
        raise CalibrationRefused(placed(small.problem(), sensor.object))
    expected = (lines, *shape[1:])
    problems = []
    for name, templates, frames in (("dark", darks, sensor.dark), ("white", whites, sensor.white)):
        for size in (one.mean.shape for one in templates if one.mean.shape != expected):
            own = [f for f in frames if facts_of(f).shape[:2] == size[:2]] or frames
            wrong = Finding("size", name, found=_size(size), expected=_size(expected))
            problems.append(placed(wrong.problem(), own))
    if problems:
        raise CalibrationRefused(*problems)


def flatten(
    context: SensorCapture,
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
    try:
        flat = flat_field(
            shot, dark or None, white,
            board=board, black=context.black_level, noise=noise, defects=defects,
        )  # fmt: skip
    except CalibrationRefused as refused:
        frames = context.sensor.white or context.sensor.object
        problems = (context.with_full_scale(p) for p in refused.problems)
        raise CalibrationRefused(*(placed(p, frames) for p in problems)) from None
    if moved is None:
        moved = movement(shot, dark, context.black_level, noise, context.period)
    notes = list(flat.notes)
    if moved is not None and moved.any():
        notes.append(Finding("moved", number=100 * float(np.mean(moved))).describe())
    templates = (shot, *dark, white)
    if (lost := gaps_of(*templates)) is not None:
        lost = lost if shot.absent is None else lost & ~shot.absent
        labels = board.labels or ()
        if lost.any():
            lost = np.broadcast_to(lost, shot.mean.shape)
            notes.append(lost_values(lost, labels[0] if len(labels) == 1 else "all bands"))
    flat = replace(flat, notes=tuple(notes))
    return with_marks(flat, templates, moved, mended=not context.unmended)


def lost_values(lost: np.ndarray, subject: str) -> str:
    """Report how many values were lost."""
    return Finding("lost", subject, int(np.count_nonzero(lost)), lost.size).describe()


def cube_of(
    context: SensorCapture,
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


def mark_glare_in(cube: Cube) -> Cube:
    """Return reflectance with GLARE in its flags, each value judged by itself."""
    if cube.quantity == "reflectance":
        mark_glare(cube.values, cube.flags, cube.sigma)
    return cube


# --- what files state -----------------------------------------------------------------------------


def doubts_of(context: SensorCapture) -> Iterator[Finding | str]:
    """Yield what a person should know before using the values."""
    yield from _notes_of_files(context)
    yield from context.doubts
    if not context.camera.traits.is_calibrated:
        return
    yield from context.sensor.remarks
    scales = (read_facts(frame.path).reflectance_scale for frame in context.sensor.object)
    if scale := next((s for s in scales if s), None):
        shown = " to ".join(f"{value:g}" for value in dict.fromkeys((min(scale), max(scale))))
        yield Finding("scale_used" if context.holds_reflectance else "scale_unused", shown)
    bands = context.sensor.bands
    if bad := [band.label for band in bands if band.bad]:
        names = ", ".join(bad[:NAMED]) + (" …" if len(bad) > NAMED else "")
        yield Finding("bad_bands", names, len(bad), len(bands))
    if context.light is not None:
        yield from context.light.notes
    elif not context.sensor.white and not context.holds_reflectance:
        yield Finding("no_white")


def _notes_of_files(context: SensorCapture) -> Iterator[Finding | str]:
    """Yield what readers take otherwise than files state it, each once with the first file and how many there are."""
    sensor, traits = context.sensor, context.camera.traits
    found: dict[tuple[str, str, float], dict[Path, None]] = {}
    for frame in (*sensor.object, *sensor.white, *sensor.chart, *sensor.dark):
        if read_headers(frame.path).kind == "raw":
            continue
        facts = read_facts(frame.path)
        more = [("", note, 0.0) for note in facts.notes]
        if facts.pages > 1 and frame.page is None and not traits.reads_pages:
            more.append(("pages", "", facts.pages))
        if facts.encoded and traits.is_calibrated:
            more.append(("tone_curve", facts.encoded, 0.0))
        for key in more:
            found.setdefault(key, {})[frame.path] = None
    for (code, said, number), paths in found.items():
        files = next(iter(paths)).name + (f" and {len(paths) - 1} more" if len(paths) > 1 else "")
        subject = f"{said}, in {files}" if said else files
        yield Finding(code, subject, number) if code else f"{said} ({files})"


def require_sound(context: SensorCapture) -> None:
    """Refuse a sensor by what is wrong with single frames, some of which state their exposure and others not, or whose black levels are unclear.

    E_EXPOSURES also where no frame states its exposure in a known unit, and the numbers without one differ. Black levels count where there is neither
    a dark nor a declared black, E_VALUE.
    """
    if context.problems:
        raise CalibrationRefused(*context.problems)
    sensor, facts, camera = context.sensor, context.facts, context.camera
    if not camera.traits.is_calibrated:
        return
    frames = list(dict.fromkeys((*sensor.object, *sensor.white, *sensor.dark)))
    stated = [frame for frame in frames if times_of(frame) is not None]
    silent = [frame for frame in frames if frame not in stated]
    said = {frame: read_facts(frame.path).exposure_unclear for frame in silent}
    if silent and (stated or len(set(said.values())) > 1):
        known = [f"{f.path.name}: {listed(times_of(f))[0]:g} s" for f in stated[:NAMED]]
        unclear = [f"{f.path.name}: {text or 'nothing'}" for f, text in said.items()][:NAMED]
        file = str(silent[0].path)
        raise refusal("times_missing", "; ".join([*known, *unclear]), file=file)
    if facts.black_unclear is not None and not sensor.dark and camera.black is None:
        file = str(facts.path)
        raise refusal("black_unclear", facts.black_unclear, file=file, camera=camera.name)

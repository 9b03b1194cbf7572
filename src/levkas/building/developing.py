"""Raw frames of one capture to calibrated cubes in native pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.building.band_stacks import develop_bands
from levkas.building.bench import Bench, doubts_of, placed, read_cube
from levkas.building.codes import CodesRefused
from levkas.building.exposing import average_shots, check_scaling, expose, noise_of, white_of
from levkas.building.flatfielding import (
    cube_of,
    defects_of,
    flatten,
    mark_glare_in,
    require_same_size,
)
from levkas.building.line_templates import noise_behind_mirror, thinned
from levkas.building.native import Native
from levkas.building.whiteboard import white_reflectance
from levkas.calibration.gaps import describe_gaps
from levkas.calibration.templates import Template, average
from levkas.cube import Cube, Flag
from levkas.problems import Problem, Refused
from levkas.readers.frames import UnreadableCapture, read_facts, read_frame

if TYPE_CHECKING:
    from levkas.building.shelf import Shelf
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.scanning import Seam
    from levkas.campaign import Campaign
    from levkas.discovery import Capture, FrameRef

__all__ = [
    "Bench",
    "cube_of",
    "develop",
    "doubts_of",
    "flatten",
    "line_noise",
    "placed",
    "read_cube",
]
MOST_PROBLEMS = 50


def develop(capture: Capture, campaign: Campaign, shelf: Shelf) -> Native:
    """Calibrate every sensor of a capture.

    Raises
    ------
    Refused
        UnreadableCapture or CalibrationRefused, with the files in question.
    """
    camera = campaign.cameras[capture.camera]
    cubes, notes, captured = {}, [], None
    learnt: dict[str, dict[str, Any]] = {}
    try:
        for sensor in capture.sensors:
            facts = read_facts(sensor.object[0].path)
            captured = captured or facts.captured
            bench = Bench(campaign, camera, sensor, facts, shelf)
            notes += doubts_of(bench)
            cubes[sensor.name] = mark_glare_in(DEVELOPERS[camera.kind](bench, notes))
            learnt[sensor.name] = bench.told
    except (UnreadableCapture, CodesRefused) as refused:
        raise type(refused)(*_all_problems(capture, campaign, shelf, refused)) from None
    aligns = {sensor.name: sensor.align for sensor in capture.sensors}
    where = f"{capture.object}/{capture.layer}"
    told = tuple(dict.fromkeys(f"{where}: {note}" for note in notes if note))
    return Native(cubes, aligns, captured, told, learnt)


def _all_problems(
    capture: Capture, campaign: Campaign, shelf: Shelf, first: Refused
) -> list[Problem]:
    """What is wrong with every frame of a capture: who mends one wants to know of the others."""
    problems = list(first.problems)
    for sensor in capture.sensors:
        for frame in (*sensor.object, *sensor.white, *sensor.dark):
            try:
                facts = read_facts(frame.path)
                bench = Bench(campaign, campaign.cameras[capture.camera], sensor, facts, shelf)
                bench.checked(read_frame(frame.path, page=frame.page), frame)
            except Refused as refused:
                problems += refused.problems
            if len(problems) > MOST_PROBLEMS:
                return list(dict.fromkeys(problems))[:MOST_PROBLEMS]
    return list(dict.fromkeys(problems))


def develop_mosaic(bench: Bench, notes: list[str]) -> Cube:
    """A mosaic: flat field on the mosaic, then demosaic; or a sensor without one."""
    from levkas.building.measuring import note_light
    from levkas.calibration.defects import replace_defects
    from levkas.calibration.mosaic import demosaic

    sensor, camera = bench.sensor, bench.camera
    darks = bench.templates(sensor.dark)
    shots = average_shots(bench, sensor.object)
    whites = bench.templates(sensor.white) if sensor.white else []
    require_same_size(bench, shots[0].mean.shape, darks, whites)
    white = white_of(bench, sensor.white, darks)
    noise = noise_of(bench, shots, [white] * len(shots), darks)
    exposed = expose(bench, shots, darks, noise)
    if exposed.above_dark:
        white = white_of(bench, sensor.white, darks, noise=noise, above_dark=True)
    notes.append(check_scaling(bench, exposed, white, (shots, whites), darks))
    pattern = sensor.pattern
    under = [] if exposed.above_dark else darks
    codes = not (exposed.above_dark and len(whites) > 1)
    note_light(bench.told, white, under, pattern, [b.label for b in sensor.bands], codes=codes)
    defects = defects_of(darks, white, pattern)
    reflectance = white_reflectance(bench.campaign, sensor.bands)
    flat = flatten(
        bench,
        exposed.shot,
        under,
        white,
        moved=exposed.moved,
        white_reflectance=reflectance,
        noise=noise,
        defects=defects,
        pattern=pattern,
        labels=[b.label for b in sensor.bands],
    )
    notes.extend(flat.notes)
    values, flags, variance = replace_defects(
        flat.values, flat.flags, flat.variance, pattern=pattern
    )
    if pattern is None:
        deep = values.shape if values.ndim == 3 else (*values.shape, 1)
        variance = None if variance is None else variance.reshape(deep)
        return cube_of(bench, values.reshape(deep), flags.reshape(deep), variance, flat.quantity)
    method = camera.demosaic or (
        "bilinear" if camera.kind == "sensors" and len(pattern) == 2 else None
    )
    made = demosaic(
        values, flags, variance, pattern, method=method, channels=[b.label for b in sensor.bands]
    )
    return cube_of(bench, *made, flat.quantity)


def develop_cube(bench: Bench, notes: list[str]) -> Cube:
    """A line scan: dark and white averaged along the scan, or frames for a mirror scanner."""
    from levkas.building.measuring import note_light
    from levkas.calibration.scanning import average_lines, join_strips
    from levkas.calibration.whites import thinning

    sensor, mirror = bench.sensor, bench.camera.scan == "mirror"

    def template(frames: Sequence[FrameRef]) -> Template | None:
        if not frames:
            return None
        blocks = (bench.checked(read_cube(frame), frame) for frame in frames)
        join = average if mirror else average_lines
        return bench.whole(join(blocks, saturation=bench.saturation), frames)

    dark, white = template(sensor.dark), template(sensor.white)
    darks = [dark] if dark else []
    require_same_size(bench, _shape_of(sensor.object[0]), darks, [white] if white else [])
    step = thinning(white.mean.shape[:2]) if mirror and white else 1
    note_light(
        bench.told,
        thinned(white, step) if white else None,
        [thinned(d, step) for d in darks],
        None,
        [b.label for b in sensor.bands],
        period=(step, step),
    )
    reflectance = white_reflectance(bench.campaign, sensor.bands)
    noise = noise_behind_mirror(bench) if mirror else line_noise(bench, dark, white)
    strips = []
    for frame in sensor.object:
        block = bench.checked(read_cube(frame), frame)
        shot = bench.whole(average(iter([block]), saturation=bench.saturation), [frame])
        del block
        flat = flatten(
            bench,
            shot,
            darks,
            white,
            white_reflectance=reflectance,
            noise=noise,
            labels=[b.label for b in sensor.bands],
        )
        notes.extend(flat.notes)
        strips.append(flat)
    whole = strips[0]
    if len(strips) > 1:
        whole, seams = join_strips(strips)
        notes.extend(_describe_seam(i, seam) for i, seam in enumerate(seams, 1))
    values = _denoised(bench, whole.values, notes) if bench.camera.denoise else whole.values
    return cube_of(bench, values, whole.flags, whole.variance, whole.quantity)


def _shape_of(frame: FrameRef) -> tuple[int, ...]:
    """(lines, samples, bands) of a cube, from its headers."""
    facts = read_facts(frame.path)
    if facts.pages > 1:
        return (*facts.shape[:2], facts.pages)
    return facts.shape if len(facts.shape) == 3 else (*facts.shape, 1)


def line_noise(bench: Bench, dark: Template | None, white: Template | None) -> NoiseModel | None:
    """Noise of a push-broom camera: its white is one line, seen many times."""
    return noise_of(bench, [], [white] if white else [], [dark] if dark else [])


def _describe_seam(number: int, seam: Seam) -> str:
    worst = float(np.nanmax(np.abs(seam.difference)))
    return (
        f"strips {number} and {number + 1} share {seam.overlap} samples (shift {seam.shift} lines); "
        f"the seam differs by {100 * seam.rms:.1f} % rms, by {100 * worst:.1f} % in its worst band"
    )


def _denoised(bench: Bench, values: np.ndarray, notes: list[str]) -> np.ndarray:
    """Project a cube on its signal subspace (HySime), and say what that took away."""
    from levkas.calibration.denoising import denoise, describe_removed

    made = denoise(values)
    notes.append(describe_removed(made.subspace, made.removed, made.removed_most))
    return made.values


def develop_image(bench: Bench, notes: list[str]) -> Cube:
    """A photograph or radiograph: nothing to calibrate, its codes as they are."""
    shot = bench.average(bench.sensor.object)
    values = shot.mean[..., None] if shot.mean.ndim == 2 else shot.mean
    if shot.lost is not None:
        notes.append(describe_gaps(shot.lost, bench.camera.name))
        values = np.where(shot.lost.reshape(values.shape), np.float32(np.nan), values)
    saturated = shot.saturated.reshape(values.shape)
    flags = np.where(saturated, np.uint8(Flag.SATURATED), np.uint8(0))
    variance = (
        None
        if shot.variance is None
        else (shot.variance / shot.count).reshape(values.shape).astype(np.float32)
    )
    return cube_of(bench, np.ascontiguousarray(values, np.float32), flags, variance, "counts")


DEVELOPERS = {
    "mosaic": develop_mosaic,
    "sensors": develop_mosaic,
    "bands": develop_bands,
    "cube": develop_cube,
    "image": develop_image,
}

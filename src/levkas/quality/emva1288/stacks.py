"""Reduction of the frames of a campaign to the stacks of each sensor: areas and line scanners.

Of a line scanner every line of dark and white is a shot of all samples and bands.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.agreement import compare_facts
from levkas.calibration.clipped_darks import is_clipped
from levkas.calibration.code_spacing import MOST_CODES, count_codes, find_levels
from levkas.calibration.drift import CellMeans, Drift, measure_drift
from levkas.calibration.linearity import RECIPROCAL, Linearity, check_linearity
from levkas.calibration.sensor_context import SensorContext, exposure_of, read_cube
from levkas.calibration.templates import CalibrationRefused, Template, average
from levkas.core.problems import Problem
from levkas.quality.emva1288.blocks import (
    SIDE,
    Blocks,
    block_statistics,
    cut_blocks,
)
from levkas.quality.emva1288.darks import Dark, model_darks
from levkas.quality.emva1288.sensor_stacks import (
    SensorStacks,
    by_exposure,
    level_under,
    measure_dark,
    note_clipped,
    put_black,
    put_darks,
    reduce_stack,
)
from levkas.readers.frames import read_facts

if TYPE_CHECKING:
    from levkas.calibration.templates import Template
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef, SensorFrames

MOST_BANDS = 5  # of a tunable filter: the sensor behind it is the same
MOST_SCENES = 3


def gather(campaign: Campaign, captures: Sequence[Capture], camera: str) -> Iterator[SensorStacks]:
    """Yield the stacks of each sensor of a camera, one sensor at a time.

    Parameters
    ----------
    campaign : Campaign
    captures : sequence of Capture
        Of this camera; templates are those of the first, objects those of all.
    camera : str

    Raises
    ------
    Refused
        UnreadableCapture or CalibrationRefused, with the files in question.
    """
    for number, frames in enumerate(captures[0].sensors):
        objects = [(c.object, c.sensors[number].object) for c in captures]
        facts = read_facts(frames.object[0].path)
        # Nothing is kept from one reading to the next: there is no shelf.
        bench = SensorContext(campaign, campaign.cameras[camera], frames, facts, None)
        sensor = SensorStacks(camera, frames.name, bench)
        together = replace(frames, object=tuple(frame for _, taken in objects for frame in taken))
        sensor.notes += compare_facts(bench.camera, together, bench.alignments)
        if campaign.cameras[camera].traits.is_scanned:
            gather_lines(sensor, frames)
        else:
            _gather_frames(sensor, frames, objects)
        yield sensor


def _gather_frames(
    sensor: SensorStacks, frames: SensorFrames, objects: Sequence[tuple[str, tuple[FrameRef, ...]]]
) -> None:
    bands, bench = _chosen_bands(frames), sensor.bench
    darks = by_exposure(f for f in frames.dark if f.band in (None, *bands))
    levels = {key: measure_dark(sensor, shots) for key, shots in darks.items()}
    put_darks(sensor, levels)
    histogram = np.zeros(MOST_CODES, np.int64)
    for kind, name, shots in (
        *((sensor.whites, "white", f) for f in by_exposure(frames.white).values()),
        *(
            (sensor.scenes, name, f)
            for name, taken in objects[:MOST_SCENES]
            for f in by_exposure(taken).values()
        ),
    ):
        if shots[0].band not in (None, *bands):
            continue
        blocks, counts = _lit(sensor, name, shots)
        histogram += counts
        for channel, found in blocks.items():
            kind.setdefault(channel, []).append(found)
    sensor.levels = find_levels(histogram)
    if not sensor.darks and bench.black is not None:
        put_black(sensor, bench.black)
    _scaling(sensor, objects, bands, hidden=not any(levels.values()))


def _chosen_bands(frames: SensorFrames) -> list[str | None]:
    """Return some bands spread over those of a camera that has a file for each."""
    named = list(dict.fromkeys(f.band for f in frames.object))
    places = np.unique(np.linspace(0, len(named) - 1, min(MOST_BANDS, len(named))).round())
    return [named[int(i)] for i in places]


def _lit(
    sensor: SensorStacks, name: str, shots: Sequence[FrameRef]
) -> tuple[dict[str, Blocks], np.ndarray]:
    """Reduce one lit stack, and count its codes."""
    bench, light, time = sensor.bench, CellMeans(), exposure_of(shots[0])
    histogram = np.zeros(MOST_CODES, np.int64)

    def counted() -> Iterator[np.ndarray]:
        for frame in bench.read(shots):
            if frame.dtype in (np.uint8, np.uint16):
                np.add(histogram, count_codes([frame]), out=histogram)
            yield frame

    frames = light.watch(counted())
    stack = bench.whole(average(frames, saturation=bench.saturation, exposure_s=time), shots)
    sensor.reached |= bool(np.mean(stack.saturated) > 1e-3)
    label = f"{name} {shots[0].band or ''} {f'{time:g} s' if time else ''}".strip()
    drift = measure_drift(light.cells, level_under(sensor, shots[0].band, time))
    if drift is not None:
        sensor.light.append((" ".join(label.split()), drift))
    blocks = reduce_stack(stack, bench, drift)
    return {k: replace(b, band=shots[0].band) for k, b in blocks.items()}, histogram


def _scaling(
    sensor: SensorStacks,
    objects: Sequence[tuple[str, tuple[FrameRef, ...]]],
    bands: Sequence[str | None],
    *,
    hidden: bool,
) -> None:
    """Check linearity on objects that were taken at several exposures, black fitted where darks hide it."""
    bench, pattern = sensor.bench, sensor.bench.sensor.pattern
    more: dict[str, Any] = {"period": (len(pattern), len(pattern[0]))} if pattern else {}
    for name, taken in objects[:1]:
        for band in bands:
            times = {t: f for (b, t), f in by_exposure(taken).items() if b == band and t}
            if len(times) < 3 or bench.saturation is None:
                continue
            shots = [bench.average(frames) for frames in times.values()]
            levels = [0.0 if hidden else level_under(sensor, band, t) for t in times]
            black = min(levels)
            shots = [
                replace(shot, mean=shot.mean - np.float32(level - black))
                for shot, level in zip(shots, levels, strict=True)
            ]
            # A free offset would hide a bend where darks give the black.
            found = check_linearity(
                shots, saturation=bench.saturation, black=black, fit_offset=hidden, **more
            )
            if found.points:
                series = " ".join(f"{name} {band or ''}".split())
                sensor.linearity.append((series, found))
                if found.rms > RECIPROCAL:
                    sensor.notes.append(_no_scaling(series, found))


def _no_scaling(series: str, found: Linearity) -> str:
    return (
        f"{series}: counts do not scale between exposures, {100 * found.rms:.1f} % rms, worst {100 * found.worst:+.1f} % "
        f"at {found.worst_at_s:g} s and {found.worst_level:.0f} counts: take object and white at one time"
    )


CHANNEL = "all"
THIN = 4
"""Side, sensels, of a block where there are fewer than 16 bands."""


def gather_lines(sensor: SensorStacks, frames: SensorFrames) -> None:
    """Gather the stacks of a line scanner: each line of dark and white is a shot of all samples and bands.

    A push-broom camera looks at one place of the white all the time.

    Raises
    ------
    CalibrationRefused
        E_SHOTS of a mirror scanner, whose lines have other light each.
    """
    if sensor.bench.camera.scan == "mirror":
        raise CalibrationRefused(
            Problem(
                "E_SHOTS",
                "the mirror leads the view over the board: no two lines of the white have one light",
                str(frames.object[0].path),
                f"cameras.{sensor.camera}.scan",
                "mirror",
                "a white captured while the mirror stands still",
                'Capture dark and white with the mirror at rest, as a campaign with scan = "push-broom".',
            )
        )
    for (_, time), shots in by_exposure(frames.dark).items():
        if dark := _dark_of(sensor, shots, time):
            sensor.darks.setdefault(CHANNEL, []).append(dark)
    for (_, time), shots in by_exposure(frames.white).items():
        stack, side, light = _averaged(sensor, shots)
        level = level_under(sensor, None, time)
        drift = measure_drift(light.cells, level)
        if drift is not None:
            label = f"white {f'{time:g} s' if time else ''}".strip()
            sensor.light.append((f"{label}, line by line", drift))
        white = _white_of(sensor, stack, side, drift, level)
        sensor.whites.setdefault(CHANNEL, []).append(white)
    if frames.white:
        sensor.levels = find_levels(_codes_of(frames.white))
    if not sensor.darks and sensor.bench.black is not None:
        put_black(sensor, sensor.bench.black)
    sensor.notes.append(
        "line scanner: every line is a shot; texture of the white board counts as noise"
    )


def _dark_of(sensor: SensorStacks, shots: Sequence[FrameRef], time: float | None) -> Dark | None:
    """Reduce the dark of one exposure; None, with a note, where it is clipped at zero."""
    cube = read_cube(shots[0])
    if cube.dtype.kind == "u" and is_clipped(np.asarray(cube[:1]).ravel()):
        note_clipped(sensor, time)
        return None
    stack, side, _ = _averaged(sensor, shots)
    return Dark.of_blocks(block_statistics(stack, clipped=True, side=side)[""])


def _averaged(sensor: SensorStacks, shots: Sequence[FrameRef]) -> tuple[Template, int, CellMeans]:
    """Average all lines of some cubes of one exposure; return them, the side of their blocks, and the light."""
    light, time = CellMeans(), exposure_of(shots[0])
    lines = (line for frame in shots for line in read_cube(frame))
    full = sensor.bench.saturation
    stack = average(light.watch(lines), saturation=full, exposure_s=time)
    sensor.reached |= bool(np.mean(stack.saturated) > 1e-3)
    return *_laid_out(stack), light


def _white_of(
    sensor: SensorStacks, stack: Template, side: int, drift: Drift | None, level: float
) -> Blocks:
    """Reduce the white; the spread is taken along the samples."""
    found = block_statistics(stack, drift=drift, dark=level, side=side)[""]
    centre, darks = found.mean - level, sensor.darks.get(CHANNEL, [])
    fixed = model_darks(darks).fixed(found) if darks else 0.0
    noise = np.nan_to_num(found.temporal) / stack.count + fixed
    return replace(found, spatial=_spread_along_samples(stack.mean - level, centre, noise, side))


def _codes_of(shots: Sequence[FrameRef]) -> np.ndarray:
    """Count the codes of some cubes."""
    histogram = np.zeros(MOST_CODES, np.int64)
    for frame in shots:
        cube = read_cube(frame)
        if cube.dtype in (np.uint8, np.uint16):
            histogram += count_codes([cube])
    return histogram


def _laid_out(stack: Template) -> tuple[Template, int]:
    """Return a line, (samples, bands), as a plane to cut into blocks, and the side of these.

    A block of 16 x 16 sensels needs 16 bands. Of fewer, each block is 16 neighbouring samples of one band, laid in
    four rows of four.
    """
    samples, bands = stack.mean.shape
    if bands >= SIDE:
        return stack, SIDE
    rows = samples // THIN

    def laid(array: np.ndarray) -> np.ndarray:
        folded = array[: rows * THIN].reshape(rows, THIN, bands)
        return np.ascontiguousarray(folded.transpose(0, 2, 1)).reshape(rows, bands * THIN)

    variance = None if stack.variance is None else laid(stack.variance)
    marks = laid(stack.saturated), laid(stack.black)
    return Template(laid(stack.mean), variance, stack.count, *marks, stack.exposure_s), THIN


def _spread_along_samples(
    mean: np.ndarray, centre: np.ndarray, noise: np.ndarray, side: int
) -> np.ndarray:
    """Return the variance of the white about a line along the samples, block by block, (n,).

    Along the bands the white is a spectrum, not an even surface: each band is fitted by itself. What grows with
    the light is brought from the bands' own levels to the block's.

    Parameters
    ----------
    mean : ndarray, (samples, bands)
        Counts above dark, or laid out.
    centre, noise : ndarray, (n,)
        Mean of each block, and the part of its variance that is no response: noise over time, dark pattern.
    side : int
        Of a block.
    """
    ramp = np.arange(SIDE) - (SIDE - 1) / 2
    pixels = cut_blocks(mean, side).astype(np.float64).reshape(-1, SIDE, side * side // SIDE)
    level = pixels.mean(1)
    slope = np.einsum("s,nsb->nb", ramp, pixels) / (ramp @ ramp)
    rest = pixels - level[:, None] - ramp[None, :, None] * slope[:, None]
    spread = np.sum(rest**2, axis=(1, 2)) / ((SIDE - 2) * level.shape[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = (spread - noise) * centre**2 / np.mean(level**2, axis=1) + noise
    return np.where(np.isfinite(spread), spread, np.nan)

"""Reduction of the frames of a campaign to the stacks of each sensor: areas and line scanners.

Of a line scanner every line of dark and white is a shot of all samples and bands.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.agreement import compare_facts
from levkas.calibration.clipped_darks import is_clipped, pairs_of_lines
from levkas.calibration.code_spacing import MOST_CODES, count_codes, find_levels
from levkas.calibration.drift import CellMeans, Drift, measure_drift
from levkas.calibration.linearity import RECIPROCAL, Linearity, check_linearity
from levkas.calibration.sensor_context import SensorContext, exposure_of, read_cube
from levkas.calibration.templates import Template, average
from levkas.quality.emva1288.blocks import (
    SIDE,
    Blocks,
    block_statistics,
    cut_blocks,
    pair_blocks,
)
from levkas.quality.emva1288.darks import Dark, model_darks
from levkas.quality.emva1288.sensor_stacks import (
    SensorStacks,
    by_exposure,
    fit_clipped,
    level_under,
    measure_dark,
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
    hidden = bool(darks) and not any(levels.values())
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
    if not sensor.darks and (hidden or bench.black is not None):
        put_black(sensor, 0.0 if bench.black is None else bench.black)
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
MOST_PAIRS = 64
"""Pairs of neighbouring lines of a mirror scanner's white that are looked at."""


def gather_lines(sensor: SensorStacks, frames: SensorFrames) -> None:
    """Gather the stacks of a line scanner: each line of dark and white is a shot of all samples and bands.

    A push-broom camera looks at one place of the white all the time. A mirror leads the view over the board, so
    that each line has other light; two neighbouring ones, brought to one level block by block, stand in for
    repeats: the sensels of (sample, band) are the same in both.
    """
    mirror = sensor.bench.camera.scan == "mirror"
    for (_, time), shots in by_exposure(frames.dark).items():
        sensor.darks.setdefault(CHANNEL, []).append(_dark_of(sensor, shots, time))
    for (_, time), shots in by_exposure(frames.white).items():
        stack, side, light = _averaged(sensor, shots)
        level = level_under(sensor, None, time)
        drift = measure_drift(light.cells, level)
        if drift is not None and not mirror:
            label = f"white {f'{time:g} s' if time else ''}".strip()
            sensor.light.append((f"{label}, line by line", drift))
        sensor.whites.setdefault(CHANNEL, []).append(
            _white_of(sensor, shots, stack, side, drift, level)
        )
    if frames.white:
        sensor.levels = find_levels(_codes_of(frames.white))
    sensor.notes.append(
        "mirror scanner: neighbouring lines of the white stand in for shots, and texture of the board counts as "
        "noise; drift and flicker of the lamp cannot be separated from the unevenness of its light"
        if mirror
        else "line scanner: every line is a shot; texture of the white board counts as noise"
    )


def _dark_of(sensor: SensorStacks, shots: Sequence[FrameRef], time: float | None) -> Dark:
    """Reduce the dark of one exposure; one that was clipped is fitted, where enough of it is above zero."""
    cube = read_cube(shots[0])
    pairs = [cube[y].ravel() for y in pairs_of_lines(*cube.shape[:2])]
    if pairs[0].dtype.kind == "u" and is_clipped(np.concatenate(pairs)):
        fitted = fit_clipped(sensor, {CHANNEL: pairs}, time)
        if fitted:
            return fitted[CHANNEL]
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
    sensor: SensorStacks,
    shots: Sequence[FrameRef],
    stack: Template,
    side: int,
    drift: Drift | None,
    level: float,
) -> Blocks:
    """Reduce the white; the spread is taken along the samples, of a mirror scanner's mean over the board."""
    mirror = sensor.bench.camera.scan == "mirror"
    found = block_statistics(stack, drift=drift, dark=level, side=side)[""]
    centre, darks = found.mean - level, sensor.darks.get(CHANNEL, [])
    fixed = model_darks(darks).fixed(found) if darks else 0.0
    pairs = [_pair(sensor, *two, level) for two in _neighbours(shots)] if mirror else []
    if not pairs:
        noise = np.nan_to_num(found.temporal) / stack.count + fixed
        spatial = _spread_along_samples(stack.mean - level, centre, noise, side)
        temporal = np.full_like(centre, np.nan) if mirror else found.temporal
        return replace(found, temporal=temporal, spatial=spatial)
    # Each pair has noise of its own level: per signal they can be put together.
    with np.errstate(invalid="ignore"):
        each = np.stack([pair.temporal for pair in pairs])
        known = np.isfinite(each)
        count = known.sum(0)
        sums = [
            np.where(known, part, 0).sum(0) / np.maximum(count, 1)
            for part in (each, np.stack([pair.mean for pair in pairs]))
        ]
    temporal, mean = (np.where(count > 0, part, np.nan) for part in sums)
    scale = mean / centre  # the spread belongs to the mean of all lines
    noise = temporal / scale / stack.count + fixed
    spatial = _spread_along_samples(stack.mean - level, centre, noise, side)
    return Blocks(mean + level, temporal, spatial * scale**2, stack.count, stack.exposure_s)


def _neighbours(shots: Sequence[FrameRef]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs of neighbouring lines, (samples, bands), evenly over all cubes of the white."""
    most = max(1, MOST_PAIRS // len(shots))
    for frame in shots:
        cube = read_cube(frame)
        if len(cube) < 2:
            continue
        starts = np.unique(np.linspace(0, len(cube) - 2, most).round().astype(int))
        for k in starts.tolist():
            yield cube[k], cube[k + 1]


def _pair(sensor: SensorStacks, first: np.ndarray, second: np.ndarray, level: float) -> Blocks:
    full = sensor.bench.saturation
    a, side = _laid_out(average([first], saturation=full))
    b, _ = _laid_out(average([second], saturation=full))
    return pair_blocks(a, b, dark=level, side=side)


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

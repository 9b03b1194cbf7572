"""Line scanners: every line of dark and white is a shot of all samples and bands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.blocks import SIDE, Blocks, block_statistics, cut_blocks
from levkas.calibration.code_spacing import MOST_CODES, count_codes, find_levels
from levkas.calibration.pairing import pair_blocks
from levkas.calibration.sensor_context import exposure_of, read_cube
from levkas.calibration.templates import Template, average
from levkas.quality.emva1288.dark_levels import level_under
from levkas.quality.emva1288.drift import Drift, Light, measure_drift
from levkas.quality.emva1288.gathered import Sensor, by_exposure
from levkas.quality.emva1288.photon_transfer import Dark, model_darks

if TYPE_CHECKING:
    from levkas.campaign.discovery.captures import FrameRef, SensorFrames

CHANNEL = "all"
THIN = 4
"""Side, sensels, of a block where there are fewer than 16 bands."""
MOST_PAIRS = 64
"""Pairs of neighbouring lines of a mirror scanner's white that are looked at."""


def gather_lines(sensor: Sensor, frames: SensorFrames) -> None:
    """A line scanner: each line of dark and white is a shot of all samples and bands.

    A push-broom camera looks at one place of the white all the time. A mirror leads the view over the board, so
    that each line has other light; two neighbouring ones, brought to one level block by block, stand in for
    repeats: the sensels of (sample, band) are the same in both.
    """
    mirror = sensor.bench.camera.scan == "mirror"
    for shots in by_exposure(frames.dark).values():
        stack, side, _ = _averaged(sensor, shots)
        found = block_statistics(stack, clipped=True, side=side)[""]
        sensor.darks.setdefault(CHANNEL, []).append(Dark.of_blocks(found))
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
        "noise; drift and flicker of the lamp cannot be told from the unevenness of its light"
        if mirror
        else "line scanner: every line is a shot; texture of the white board counts as noise"
    )


def _averaged(sensor: Sensor, shots: Sequence[FrameRef]) -> tuple[Template, int, Light]:
    """Average all lines of some cubes of one exposure; return them, the side of their blocks, and the light."""
    light, time = Light(), exposure_of(shots[0])
    lines = (line for frame in shots for line in read_cube(frame))
    full = sensor.bench.saturation
    stack = average(light.watch(lines), saturation=full, exposure_s=time)
    sensor.reached |= bool(np.mean(stack.saturated) > 1e-3)
    return *_laid_out(stack), light


def _white_of(
    sensor: Sensor,
    shots: Sequence[FrameRef],
    stack: Template,
    side: int,
    drift: Drift | None,
    level: float,
) -> Blocks:
    """Reduce the white; the spread is told along the samples, of a mirror scanner's mean over the board."""
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


def _pair(sensor: Sensor, first: np.ndarray, second: np.ndarray, level: float) -> Blocks:
    full = sensor.bench.saturation
    a, side = _laid_out(average([first], saturation=full))
    b, _ = _laid_out(average([second], saturation=full))
    return pair_blocks(a, b, dark=(level, level), side=side)


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

    A block of 16 x 16 sensels wants 16 bands. Of fewer, each block is 16 neighbouring samples of one band, laid in
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

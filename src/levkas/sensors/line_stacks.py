"""Line scanners: every line of dark and white is a shot of all samples and bands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.building.bench import read_cube
from levkas.calibration.blocks import SIDE, Blocks, block_statistics, cut_blocks
from levkas.calibration.curves import MOST_CODES, count_codes, find_levels
from levkas.calibration.drift import Drift, Light, measure_drift
from levkas.calibration.pairing import pair_blocks
from levkas.calibration.photon_transfer import Dark
from levkas.calibration.templates import Template, average
from levkas.sensors.gathered import Sensor

if TYPE_CHECKING:
    from levkas.discovery import FrameRef, SensorFrames

CHANNEL = "all"
MOST_PAIRS = 64
"""Pairs of neighbouring lines of a mirror scanner's white that are looked at."""


def gather_lines(sensor: Sensor, frames: SensorFrames) -> None:
    """A line scanner: each line of dark and white is a shot of all samples and bands.

    A push-broom camera looks at one place of the white all the time. A mirror leads the view over the board, so
    that each line has other light; two neighbouring ones, brought to one level block by block, stand in for
    repeats: the sensels of (sample, band) are the same in both.
    """
    mirror = sensor.bench.camera.scan == "mirror"
    level = 0.0
    if frames.dark:
        stack, _ = _averaged(sensor, frames.dark)
        found = block_statistics(stack, clipped=True)[""]
        sensor.darks[CHANNEL] = [Dark.of_blocks(found)]
        level = float(np.nanmean(found.mean))
    if frames.white:
        stack, light = _averaged(sensor, frames.white)
        drift = measure_drift(light.cells, level)
        if drift is not None and not mirror:
            sensor.light.append(("white, line by line", drift))
        sensor.whites[CHANNEL] = [_white_of(sensor, frames.white, stack, drift, level)]
        sensor.levels = find_levels(_codes_of(frames.white))
    sensor.notes.append(
        "mirror scanner: neighbouring lines of the white stand in for shots, and texture of the board counts as "
        "noise; drift and flicker of the lamp cannot be told from the unevenness of its light"
        if mirror
        else "line scanner: every line is a shot; texture of the white board counts as noise"
    )


def _averaged(sensor: Sensor, shots: Sequence[FrameRef]) -> tuple[Template, Light]:
    """Average all lines of some cubes."""
    light = Light()
    lines = (line for frame in shots for line in read_cube(frame))
    stack = average(light.watch(lines), saturation=sensor.bench.saturation)
    sensor.reached |= bool(np.mean(stack.saturated) > 1e-3)
    return stack, light


def _white_of(
    sensor: Sensor, shots: Sequence[FrameRef], stack: Template, drift: Drift | None, level: float
) -> Blocks:
    """Reduce the white; the spread is told along the samples, of a mirror scanner's mean over the board."""
    mirror = sensor.bench.camera.scan == "mirror"
    found = block_statistics(stack, drift=drift)[""]
    spatial = _spread_along_samples(stack.mean - level, found.mean - level)
    found = replace(found, spatial=spatial)
    pairs = [_pair(sensor, *two, level) for two in _neighbours(shots)] if mirror else []
    if not pairs:
        return replace(found, temporal=np.full_like(found.mean, np.nan)) if mirror else found
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
    scale = (mean / (found.mean - level)) ** 2  # the spread belongs to the mean of all lines
    return Blocks(mean + level, temporal, spatial * scale, stack.count)


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
    a, b = (average([line], saturation=sensor.bench.saturation) for line in (first, second))
    return pair_blocks(a, b, dark=(level, level))


def _codes_of(shots: Sequence[FrameRef]) -> np.ndarray:
    """Count the codes of some cubes."""
    histogram = np.zeros(MOST_CODES, np.int64)
    for frame in shots:
        cube = read_cube(frame)
        if cube.dtype in (np.uint8, np.uint16):
            histogram += count_codes([cube])
    return histogram


def _spread_along_samples(mean: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return the variance of the white about a line along the samples, block by block, (n,).

    Along the bands the white is a spectrum, not an even surface: each band is fitted by itself, relative
    to its own level. `mean` is (samples, bands) above dark, `centre` the mean of each block.
    """
    ramp = np.arange(SIDE) - (SIDE - 1) / 2
    pixels = cut_blocks(mean, SIDE).astype(np.float64).reshape(-1, SIDE, SIDE)
    with np.errstate(divide="ignore", invalid="ignore"):
        even = pixels / pixels.mean(1, keepdims=True)
    slope = np.einsum("s,nsb->nb", ramp, even) / (ramp @ ramp)
    rest = even - 1 - ramp[None, :, None] * slope[:, None]
    spread = np.sum(rest**2, axis=(1, 2)) / (SIDE * (SIDE - 2)) * centre**2
    return np.where(np.isfinite(spread), spread, np.nan)

"""Stacks of one sensor: darks by exposure, whites and scenes, each reduced to blocks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.clipped_darks import is_clipped
from levkas.calibration.sensor import SensorCapture, exposure_of
from levkas.calibration.templates import Template
from levkas.quality.emva1288.blocks import Blocks, block_statistics
from levkas.quality.emva1288.darks import Dark, DarkModel, mean_of
from levkas.quality.emva1288.drift import Drift
from levkas.quality.emva1288.levels import Levels

if TYPE_CHECKING:
    from levkas.campaign.discovery.captures import FrameRef

Key = tuple[str | None, float | None]
"""Band and exposure, s."""


@dataclass
class SensorStacks:
    """Stacks of one sensor, reduced to blocks by channel."""

    camera: str
    name: str
    bench: SensorCapture
    levels: Levels = field(default_factory=lambda: Levels(0, 0, 0))
    darks: dict[str, list[Dark]] = field(default_factory=dict)
    whites: dict[str, list[Blocks]] = field(default_factory=dict)
    scenes: dict[str, list[Blocks]] = field(default_factory=dict)
    light: list[tuple[str, Drift]] = field(default_factory=list)
    reached: bool = False
    notes: list[str] = field(default_factory=list)


def by_exposure(frames: Iterable[FrameRef]) -> dict[Key, list[FrameRef]]:
    """Group shots of one band and exposure; a dark without a band serves all."""
    found: dict[Key, list[FrameRef]] = {}
    for frame in frames:
        found.setdefault((frame.band, exposure_of(frame)), []).append(frame)
    return dict(sorted(found.items(), key=lambda item: (item[0][0] or "", item[0][1] or 0.0)))


def reduce_stack(
    stack: Template, bench: SensorCapture, drift: Drift | None = None, *, dark: bool = False
) -> dict[str, Blocks]:
    """Reduce a stack by the camera's channels; a tunable filter has one, whatever the mosaic.

    A few zeros do not spoil a dark: their share was checked before.
    """
    pattern = bench.sensor.pattern
    level, own = bench.black or 0.0, bench.black_level
    if isinstance(own, np.ndarray):  # black is one number everywhere then
        stack = replace(stack, mean=stack.mean - (own - np.float32(level)))
    if stack.mean.ndim == 3:
        stack = _flat_bands(stack)
    found = block_statistics(stack, pattern, drift=drift, dark=level, clipped=dark)
    if pattern is not None and not bench.camera.traits.is_demosaiced:
        parts = list(found.values())
        mean, temporal, spatial = (
            np.concatenate([getattr(b, n) for b in parts]) for n in ("mean", "temporal", "spatial")
        )
        return {"": Blocks(mean, temporal, spatial, stack.count, stack.exposure_s)}
    return found


def _flat_bands(stack: Template) -> Template:
    """Lay the samples of a pixel side by side: each is a sensel of its own."""
    high = stack.mean.shape[0]

    def flat(array: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(array.transpose(0, 2, 1)).reshape(high, -1)

    variance = None if stack.variance is None else flat(stack.variance)
    marks = flat(stack.saturated), flat(stack.black)
    return Template(flat(stack.mean), variance, stack.count, *marks, stack.exposure_s)


def measure_dark(sensor: SensorStacks, shots: Sequence[FrameRef]) -> dict[str, Dark]:
    """Return the dark of one exposure, channel by channel; none, with a note, where it is clipped at zero."""
    bench = sensor.bench
    first = next(iter(bench.read(shots[:1])))
    if first.dtype.kind == "u" and is_clipped(first):
        note_clipped(sensor, exposure_of(shots[0]))
        return {}
    stack = bench.average(list(shots))
    return {k: Dark.of_blocks(b) for k, b in reduce_stack(stack, bench, dark=True).items()}


def note_clipped(sensor: SensorStacks, time: float | None) -> None:
    """Say that the darks of an exposure are clipped, and what to do."""
    where = f"darks of {time:g} s" if time else "darks"
    sensor.notes.append(
        f"{where} are clipped at zero and not used: raise the camera's offset and capture them again, or state `black` "
        "in campaign.toml"
    )


def put_darks(sensor: SensorStacks, levels: dict[Key, dict[str, Dark]]) -> None:
    """Keep the darks of all exposures and bands: the sensor behind a tunable filter is the same."""
    for (band, _), channels in levels.items():
        for channel, dark in channels.items():
            sensor.darks.setdefault(channel, []).append(replace(dark, band=band))


def put_black(sensor: SensorStacks, black: float) -> None:
    """Take a declared black for darks: the noise without light is then the intercept of the lit stacks."""
    sensor.notes.append(f"no dark can be used: the black level is assumed to be {black:g} DN")
    for channel in dict.fromkeys([*sensor.whites, *sensor.scenes]):
        sensor.darks[channel] = [Dark(black, float("nan"), float("nan"))]


def level_under(sensor: SensorStacks, band: str | None, time: float | None) -> float:
    """Return the counts without light under a band at an exposure; `black` or 0 where there is no dark."""
    darks = next(iter(sensor.darks.values()), [])
    if not darks:
        return sensor.bench.black or 0.0
    return mean_of(DarkModel(darks).under(band, time))

"""The darks of a sensor: levels, exposure by exposure, also where the camera clipped them at zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.clipping import DarkLevel, fit_clipped_dark, is_clipped
from levkas.calibration.patterns import channel_table, split
from levkas.calibration.sensor_context import SensorContext, exposure_of
from levkas.calibration.templates import CalibrationRefused
from levkas.quality.emva1288.gathered import Key, Sensor, reduce_stack
from levkas.quality.emva1288.photon_transfer import Dark, model_darks

if TYPE_CHECKING:
    from levkas.campaign.discovery.captures import FrameRef

MOST_CLIPPED = 1_000_000  # pixels of a dark whose likelihood is asked for


def measure_dark(sensor: Sensor, shots: Sequence[FrameRef]) -> dict[str, Dark]:
    """Return the dark of one exposure, channel by channel."""
    bench, time = sensor.bench, exposure_of(shots[0])
    first = next(iter(bench.read(shots[:1])))
    if first.dtype.kind == "u" and is_clipped(first):
        return _clipped_dark(sensor, shots, time)
    stack = bench.average(list(shots))
    return {k: Dark.of_blocks(b) for k, b in reduce_stack(stack, bench, dark=True).items()}


def _clipped_dark(sensor: Sensor, shots: Sequence[FrameRef], time: float | None) -> dict[str, Dark]:
    """Fit a clipped dark as censored; where it tells nothing, say so and leave it out."""
    frames = list(sensor.bench.read(shots[:4]))
    rows = max(1, min(frames[0].shape[0], MOST_CLIPPED // max(1, frames[0].shape[1])))
    where = f"darks of {time:g} s" if time else "darks"
    found: dict[str, DarkLevel] = {}
    for channel, planes in _channels([f[:rows] for f in frames], sensor.bench).items():
        try:
            found[channel] = fit_clipped_dark(planes)
        except CalibrationRefused as refused:
            problem = refused.problems[0]
            if not any(problem.message in note for note in sensor.notes):
                sensor.notes.append(f"{where}: {problem}")
            return {}
    told = [f"{c} {d.black:.2f} ± {d.black_error:.2f}".strip() for c, d in found.items()]
    sensor.notes.append(
        f"{where} were clipped at zero ({next(iter(found.values())).zeros:.0%} of the pixels) and are "
        f"fitted as censored: black {', '.join(told)}"
    )
    return {channel: Dark.of_clipped(level, time) for channel, level in found.items()}


def _channels(frames: Sequence[np.ndarray], bench: SensorContext) -> dict[str, list[np.ndarray]]:
    """Return the codes of each channel, flat, frame by frame."""
    pattern = bench.sensor.pattern
    if pattern is None or bench.camera.kind == "bands":
        return {"": [f.ravel() for f in frames]}
    names = [name for row in pattern for name in row]
    size = channel_table(pattern).shape
    made: dict[str, list[np.ndarray]] = {name: [] for name in dict.fromkeys(names)}
    for frame in frames:
        phases = split(frame, *size)
        for name, flat in made.items():
            flat.append(
                np.concatenate([p.ravel() for n, p in zip(names, phases, strict=True) if n == name])
            )
    return made


def put_darks(sensor: Sensor, levels: dict[Key, dict[str, Dark]]) -> None:
    """Keep the darks of all exposures and bands: the sensor behind a tunable filter is the same."""
    for (band, _), channels in levels.items():
        for channel, dark in channels.items():
            sensor.darks.setdefault(channel, []).append(replace(dark, band=band))


def put_black(sensor: Sensor, black: float) -> None:
    """Where no dark can be used, the noise without light is the intercept of the lit stacks."""
    sensor.notes.append(f"no dark can be used: black is taken for {black:g} DN")
    for channel in dict.fromkeys([*sensor.whites, *sensor.scenes]):
        sensor.darks[channel] = [Dark(black, float("nan"), float("nan"))]


def level_under(sensor: Sensor, band: str | None, time: float | None) -> float:
    """Return the counts without light under a band at an exposure; `black` or 0 where there is no dark."""
    darks = next(iter(sensor.darks.values()), [])
    if not darks:
        return sensor.bench.black or 0.0
    return float(np.nanmean(model_darks(darks).under(band, time)))

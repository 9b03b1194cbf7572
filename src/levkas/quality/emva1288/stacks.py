"""Reduction of the frames of a campaign to the stacks of each sensor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.agreement import compare_facts
from levkas.calibration.codes import MOST_CODES, count_codes
from levkas.calibration.lamp import CellMeans
from levkas.calibration.sensor import exposure_of, open_sensor
from levkas.calibration.templates import CalibrationRefused, average
from levkas.core.problems import Problem
from levkas.quality.emva1288.blocks import Blocks
from levkas.quality.emva1288.drift import measure_drift
from levkas.quality.emva1288.levels import find_levels
from levkas.quality.emva1288.sensor_stacks import (
    SensorStacks,
    by_exposure,
    level_under,
    measure_dark,
    put_black,
    put_darks,
    reduce_stack,
)

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef, SensorFrames

MOST_BANDS = 5  # of a tunable filter: the sensor behind it is the same
MOST_SCENES = 3


def gather(campaign: Campaign, captures: Sequence[Capture], camera: str) -> Iterator[SensorStacks]:
    """Yield the stacks of each sensor of a camera, one sensor at a time.

    Parameters
    ----------
    captures : sequence of Capture
        Of this camera; templates are those of the first, objects those of all.
    """
    for number, frames in enumerate(captures[0].sensors):
        objects = [(c.object, c.sensors[number].object) for c in captures]
        bench = open_sensor(campaign.cameras[camera], frames)
        sensor = SensorStacks(camera, frames.name, bench)
        together = replace(frames, object=tuple(frame for _, taken in objects for frame in taken))
        sensor.notes += compare_facts(bench.camera, together, bench.alignments)
        if campaign.cameras[camera].traits.is_scanned:
            raise CalibrationRefused(_scanned(frames.object[0].path, camera))
        _gather_frames(sensor, frames, objects)
        yield sensor


def _scanned(path: Path, camera: str) -> Problem:
    return Problem(
        "E_SHOTS",
        "photon transfer needs shots of one place, and a line scanner moves from line to line",
        str(path),
        f"cameras.{camera}.kind",
        fix="Read its noise in the report of its layers, or capture frames of the sensor itself.",
    )


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
    drift = measure_drift(
        light.channels.reshape(len(shots), -1), level_under(sensor, shots[0].band, time)
    )
    if drift is not None:
        sensor.light.append((" ".join(label.split()), drift))
    blocks = reduce_stack(stack, bench, drift)
    return {k: replace(b, band=shots[0].band) for k, b in blocks.items()}, histogram

"""The stacks of one sensor of a campaign, reduced to blocks as the frames pass by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.blocks import Blocks
from levkas.calibration.code_spacing import MOST_CODES, count_codes, find_levels
from levkas.calibration.linearity import RECIPROCAL, Linearity, check_linearity
from levkas.calibration.sensor_context import SensorContext, exposure_of
from levkas.calibration.templates import average
from levkas.quality.emva1288.dark_levels import (
    level_under,
    measure_dark,
    put_black,
    put_darks,
)
from levkas.quality.emva1288.drift import Light, measure_drift
from levkas.quality.emva1288.gathered import Sensor, by_exposure, reduce_stack
from levkas.quality.emva1288.line_stacks import gather_lines
from levkas.quality.emva1288.stand_ins import add_stand_ins
from levkas.readers.frames import read_facts

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef, SensorFrames

MOST_BANDS = 5  # of a tunable filter: the sensor behind it is the same
MOST_SCENES = 3


def gather(campaign: Campaign, captures: Sequence[Capture], camera: str) -> Iterator[Sensor]:
    """Yield what the frames of each sensor of a camera tell, one sensor at a time.

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
        sensor = Sensor(camera, frames.name, bench)
        if campaign.cameras[camera].kind == "cube":
            gather_lines(sensor, frames)
        else:
            _gather_frames(sensor, frames, objects)
        yield sensor


def _gather_frames(
    sensor: Sensor, frames: SensorFrames, objects: Sequence[tuple[str, tuple[FrameRef, ...]]]
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
        blocks, seen = _lit(sensor, name, shots)
        histogram += seen
        for channel, found in blocks.items():
            kind.setdefault(channel, []).append(found)
    sensor.levels = find_levels(histogram)
    add_stand_ins(sensor, frames, objects)
    if not sensor.darks and (hidden or bench.black is not None):
        put_black(sensor, 0.0 if bench.black is None else bench.black)
    _scaling(sensor, objects, bands, hidden=not any(levels.values()))


def _chosen_bands(frames: SensorFrames) -> list[str | None]:
    """Return some bands spread over those of a camera that has a file for each."""
    named = list(dict.fromkeys(f.band for f in frames.object))
    places = np.unique(np.linspace(0, len(named) - 1, min(MOST_BANDS, len(named))).round())
    return [named[int(i)] for i in places]


def _lit(
    sensor: Sensor, name: str, shots: Sequence[FrameRef]
) -> tuple[dict[str, Blocks], np.ndarray]:
    """Reduce one lit stack, and count its codes."""
    bench, light, time = sensor.bench, Light(), exposure_of(shots[0])
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
    sensor: Sensor,
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
            # A free offset would hide a bend where darks tell the black.
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

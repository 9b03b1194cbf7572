"""Single shots: other bands of a tunable filter, and other exposures of a scene, stand in for repeats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.pairing import pair_blocks
from levkas.calibration.sensor_context import exposure_of
from levkas.quality.emva1288.dark_levels import level_under
from levkas.quality.emva1288.gathered import Key, Sensor, by_exposure
from levkas.quality.emva1288.photon_transfer import Dark

if TYPE_CHECKING:
    from levkas.calibration.templates import Template
    from levkas.campaign.discovery.captures import FrameRef, SensorFrames

MOST_PAIRS = 5


def add_stand_ins(
    sensor: Sensor, frames: SensorFrames, objects: Sequence[tuple[str, tuple[FrameRef, ...]]]
) -> None:
    """Pair single frames of a tunable filter where no lit stack has two shots, and say so.

    Whites of neighbouring bands, exposures of the first object, and darks of two bands become stacks of two
    shots in `sensor`. What only true repeats can tell, the lamp's drift and flicker, is left out.
    """
    lit = [b for kind in (sensor.whites, sensor.scenes) for many in kind.values() for b in many]
    if sensor.bench.camera.kind != "bands" or any(b.shots > 1 for b in lit):
        return
    told = [
        (_pair_darks(sensor, frames), "darks of two bands"),
        (_pair_whites(sensor, frames), "whites of neighbouring bands"),
        (_pair_exposures(sensor, frames, objects), "exposures of one scene"),
    ]
    used = [name for count, name in told if count]
    if used:
        sensor.notes.append(
            f"one shot of everything: {', '.join(used)} stand in for repeats; the sensor's fixed pattern is "
            "taken for the same in both. Drift and flicker of the lamp need two shots or more of one scene"
        )


def _pair_darks(sensor: Sensor, frames: SensorFrames) -> int:
    """Let the darks of two bands of one time be the two shots of a dark."""
    kept = sensor.darks.get("", [])
    if not kept or np.isfinite(kept[0].temporal).any():
        return 0
    groups = [shots[0] for shots in by_exposure(frames.dark).values()]
    alike = [f for f in groups if f.exposure_s == groups[0].exposure_s]
    if len(alike) < 2:
        return 0
    first, second = (sensor.bench.average([f]) for f in alike[:2])
    blocks = pair_blocks(
        first, second, pattern=sensor.bench.sensor.pattern, scaled=False, clipped=True
    )
    sensor.darks[""][0] = Dark.of_blocks(blocks)
    return 1


def _pair_whites(sensor: Sensor, frames: SensorFrames) -> int:
    shots = [group[0] for (band, _), group in by_exposure(frames.white).items() if band]
    pairs = list(pairwise(shots))
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(MOST_PAIRS, len(pairs))).round())
    for i in chosen.astype(int).tolist():
        _add(sensor, frames, sensor.whites, pairs[i])
    return len(chosen)


def _pair_exposures(
    sensor: Sensor, frames: SensorFrames, objects: Sequence[tuple[str, tuple[FrameRef, ...]]]
) -> int:
    made = 0
    for _, taken in objects[:1]:
        groups: dict[str | None, list[FrameRef]] = {}
        for (band, time), shots in by_exposure(taken).items():
            if time:
                groups.setdefault(band, []).append(shots[0])
        several = [g for g in groups.values() if len(g) > 1]
        chosen = np.unique(np.linspace(0, len(several) - 1, min(MOST_PAIRS, len(several))).round())
        for i in chosen.astype(int).tolist():
            for pair in pairwise(several[i]):
                _add(sensor, frames, sensor.scenes, pair)
                made += 1
    return made


def _add(
    sensor: Sensor,
    frames: SensorFrames,
    kind: dict[str, list],  # type: ignore[type-arg]
    pair: tuple[FrameRef, FrameRef],
) -> None:
    """Add the blocks of a pair, with the counts without light that belong to both."""
    first, second = (sensor.bench.average([frame]) for frame in pair)
    dark = _level(sensor, frames, pair[0]), _level(sensor, frames, pair[1])
    blocks = pair_blocks(first, second, dark=dark, pattern=sensor.bench.sensor.pattern)
    # The time is left out: between two exposures there is none.
    kind.setdefault("", []).append(
        replace(blocks, mean=blocks.mean + blocks.level, exposure_s=None)
    )


def _level(sensor: Sensor, frames: SensorFrames, frame: FrameRef) -> float:
    """Return the counts without light of a frame: of its own dark, else of others brought to its exposure."""
    darks, time = by_exposure(frames.dark), exposure_of(frame)
    wanted: list[Key] = [(frame.band, time), (frame.band, None), (None, time), (None, None)]
    own = next((darks[key] for key in wanted if key in darks), None)
    if own is None:
        return level_under(sensor, frame.band, time)
    return _middle(sensor.bench.average(own[:1]))


def _middle(dark: Template) -> float:
    """Return the mean of what is no hot sensel."""
    return float(np.mean(dark.mean[dark.mean <= np.quantile(dark.mean, 0.995)]))

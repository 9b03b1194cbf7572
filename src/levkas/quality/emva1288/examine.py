"""Examination of the cameras of a campaign: raw facts, photon transfer, steadiness of the light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.findings import decide
from levkas.calibration.record import findings_of
from levkas.calibration.templates import CalibrationRefused
from levkas.core.problems import Problem, Refused, unknown_name
from levkas.quality.emva1288.facts import FrameFacts, describe_frame
from levkas.quality.emva1288.levels import Levels
from levkas.quality.emva1288.photon_transfer import measure_sensor
from levkas.quality.emva1288.report import Examination, SensorReport

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.quality.emva1288.sensor_stacks import SensorStacks


def examine(
    path: str | Path, *, cameras: Sequence[str] | None = None, rng: np.random.Generator
) -> Examination:
    """Describe the cameras of a campaign.

    Parameters
    ----------
    path : path
        Its folder, or campaign.toml.
    cameras : sequence of str, optional
        Only these.
    rng : Generator
        Of the bootstrap that gives the intervals.

    Raises
    ------
    Refused
        Where there is no campaign, or it has no such camera.
    """
    from levkas.campaign.campaign import load_campaign

    campaign = load_campaign(Path(path))
    _check_names(cameras, list(campaign.cameras), campaign.path)
    return Examination(Path(path), list(_examine_campaign(campaign, cameras, rng)))


def _examine_campaign(
    campaign: Campaign, cameras: Sequence[str] | None, rng: np.random.Generator
) -> Iterator[SensorReport]:
    """Yield the report of each sensor of each camera."""
    from levkas.campaign.discovery.find_captures import find_captures

    captures, refusals = find_captures(campaign)
    for name in cameras or campaign.cameras:
        own = [c for c in captures if c.camera == name]
        if not own:
            problems = [
                p for (_, camera, _), r in refusals.items() if camera == name for p in r.problems
            ]
            yield _unknown(name, problems or [_not_captured(name, campaign.path)])
            continue
        yield from _examine_camera(campaign, [c for c in own if c.setup == own[0].setup], name, rng)


def _examine_camera(
    campaign: Campaign, captures: Sequence[Any], name: str, rng: np.random.Generator
) -> Iterator[SensorReport]:
    from levkas.quality.emva1288.stacks import gather

    if not campaign.cameras[name].traits.is_calibrated:
        facts = describe_frame(captures[0].sensors[0].object[0].path)
        note = ["an image without calibration: its noise cannot be measured"]
        yield SensorReport(name, "", facts, facts.levels or NOTHING, notes=note)
        return
    try:
        for sensor in gather(campaign, captures, name):
            yield _report(sensor, rng)
    except Refused as refused:
        yield _unknown(name, list(refused.problems))


def _report(sensor: SensorStacks, rng: np.random.Generator) -> SensorReport:
    """Measure every channel of a sensor; a refusal of all is listed once."""
    facts = describe_frame(sensor.bench.sensor.object[0].path)
    bits = sensor.bench.camera.bits or facts.bits
    bench, top = sensor.bench, sensor.levels.highest
    stated = bench.camera.saturation or bench.camera.bits or bench.facts.saturation
    if bench.saturation is None or (not stated and 0 < top <= bench.saturation / 4):
        return _unknown(sensor.camera, [_no_full_scale(sensor)])
    facts = replace(
        facts, bits=bits, white=bench.saturation, black=sensor.bench.black, pattern=_pattern(sensor)
    )
    channels, problems = {}, []
    for channel in dict.fromkeys([*sensor.whites, *sensor.scenes]):
        try:
            channels[channel] = measure_sensor(
                sensor.darks.get(channel, []),
                sensor.whites.get(channel, []),
                sensor.scenes.get(channel, []),
                saturation=bench.saturation,
                rng=rng,
                levels=sensor.levels,
                reached=sensor.reached,
            )
        except CalibrationRefused as refused:
            folder = str(sensor.bench.sensor.object[0].path.parent)
            problems += [
                replace(
                    p,
                    message=f"{sensor.camera} {sensor.name}".strip() + f": {p.message}",
                    file=folder,
                )
                for p in refused.problems
            ]
    channel_notes = [note for found in channels.values() for note in found.notes]
    channel_notes += [f"{name}: {drift.note}" for name, drift in sensor.light if drift.note]
    notes = list(
        dict.fromkeys([*sensor.notes, *decide(findings_of(sensor.bench.record)), *channel_notes])
    )
    return SensorReport(
        sensor.camera,
        sensor.name,
        facts,
        sensor.levels,
        channels,
        sensor.light,
        notes,
        list(dict.fromkeys(problems)),
    )


def _pattern(sensor: SensorStacks) -> str | None:
    rows = sensor.bench.sensor.pattern
    return None if rows is None else " / ".join(" ".join(row) for row in rows)


NOTHING = Levels(0, 0, 0)


def _unknown(camera: str, problems: list[Problem]) -> SensorReport:
    return SensorReport(camera, "", FrameFacts("", "no frame", ""), NOTHING, problems=problems)


def _no_full_scale(sensor: SensorStacks) -> Problem:
    return Problem(
        "E_BITS",
        f"{sensor.camera}: the full scale of the camera is unknown",
        str(sensor.bench.sensor.object[0].path.parent),
        f"cameras.{sensor.camera}.bits",
        f"codes up to {sensor.levels.highest}",
        "bits of its converter, or the code at which it saturates",
        "State `bits` or `saturation` of the camera in campaign.toml.",
    )


def _not_captured(camera: str, file: Path) -> Problem:
    return Problem(
        "E_NO_FRAMES", f"{camera}: no frame of any object", str(file), f"cameras.{camera}.files"
    )


def _check_names(wanted: Sequence[str] | None, known: Sequence[str], file: Path) -> None:
    unknown = [name for name in wanted or () if name not in known]
    what = "the campaign has no camera of this name"
    if problems := [
        unknown_name(what, n, known, file=str(file), field="--camera") for n in unknown
    ]:
        raise Refused(*problems)

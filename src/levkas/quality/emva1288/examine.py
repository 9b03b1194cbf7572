"""Examination of the cameras of a campaign: raw facts, photon transfer, steadiness of the light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.sensor_notes import describe_sensor
from levkas.calibration.templates import CalibrationRefused
from levkas.core.problems import Problem, Refused, unknown_name
from levkas.quality.emva1288.facts import FrameFacts, describe_files, describe_frame
from levkas.quality.emva1288.photon_transfer import (
    measure_sensor,
    without_full_scale,
)
from levkas.quality.emva1288.report import Examination, SensorReport

if TYPE_CHECKING:
    from levkas.calibration.code_spacing import Levels
    from levkas.quality.emva1288.sensor_stacks import SensorStacks


def examine(
    path: str | Path, *, cameras: Sequence[str] | None = None, rng: np.random.Generator
) -> Examination:
    """Describe the cameras of a campaign, or the frames at a path.

    Parameters
    ----------
    path : path
        A campaign (folder or campaign.toml), a frame, or a folder of frames.
    cameras : sequence of str, optional
        Only these of a campaign.
    rng : Generator
        Of the bootstrap that gives the intervals.

    Returns
    -------
    found : Examination
        A sensor that cannot be measured has its reasons in `problems`; the others are measured.

    Raises
    ------
    Refused
        Where there is no campaign and no frame, or frames are to be chosen by camera.
    """
    path = Path(path)
    is_campaign = (path / "campaign.toml").is_file() if path.is_dir() else path.suffix == ".toml"
    if not is_campaign:
        if cameras:
            fix = "Give the folder of a campaign, or leave the option out."
            why, expected = "frames have no cameras to choose from", "a campaign"
            raise Refused(
                Problem("E_VALUE", why, str(path), "--camera", ", ".join(cameras), expected, fix)
            )
        frames, levels, problems = describe_files(path)
        return Examination(path, [], frames, levels, problems)
    sensors = list(examine_campaign(path, cameras=cameras, rng=rng))
    problems = [p for sensor in sensors for p in sensor.problems]
    return Examination(path, sensors, [], None, problems)


def examine_campaign(
    path: Path, *, cameras: Sequence[str] | None, rng: np.random.Generator
) -> Iterator[SensorReport]:
    """Yield the report of each sensor of each camera."""
    from levkas.campaign.campaign import load_campaign
    from levkas.campaign.discovery.find_captures import find_captures

    campaign = load_campaign(path)
    _check_names(cameras, list(campaign.cameras), campaign.path)
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
    campaign: Any, captures: Sequence[Any], name: str, rng: np.random.Generator
) -> Iterator[SensorReport]:
    from levkas.quality.emva1288.stacks import gather

    if not campaign.cameras[name].traits.is_calibrated:
        facts = describe_frame(captures[0].sensors[0].object[0].path)
        note = ["an image without calibration: its noise cannot be measured"]
        yield SensorReport(name, "", facts, facts.levels or _no_levels(), notes=note)
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
    white, declared = _white_level(sensor)
    facts = replace(
        facts,
        bits=bits,
        white=white if declared else None,
        black=sensor.bench.black,
        pattern=_pattern(sensor),
    )
    full = white or facts.full
    channels, problems = {}, []
    for channel in dict.fromkeys([*sensor.whites, *sensor.scenes]):
        try:
            found = measure_sensor(
                sensor.darks.get(channel, []),
                sensor.whites.get(channel, []),
                sensor.scenes.get(channel, []),
                saturation=full,
                rng=rng,
                levels=sensor.levels,
                reached=sensor.reached,
            )
            channels[channel] = found if declared else without_full_scale(found)
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
    notes = list(dict.fromkeys([*sensor.notes, *describe_sensor(sensor.bench), *channel_notes]))
    return SensorReport(
        sensor.camera,
        sensor.name,
        facts,
        sensor.levels,
        channels,
        sensor.light,
        sensor.linearity,
        notes,
        list(dict.fromkeys(problems)),
    )


def _white_level(sensor: SensorStacks) -> tuple[float | None, bool]:
    """Return saturation in counts, and whether it is declared: else it is what the top code needs.

    The bits of the top code suffice for the range of the gain, not for a full well.
    """
    bench, top = sensor.bench, sensor.levels.highest
    declared = bench.camera.saturation or bench.camera.bits or bench.facts.saturation
    if declared or not top or top > (bench.saturation or 0) / 4:
        return bench.saturation, True
    sensor.notes.append(
        "neither `bits` nor `saturation` of the camera is in campaign.toml, and the frames do not show it: full well, "
        "SNR at saturation and dynamic range are left out"
    )
    return float(2 ** max(8, top.bit_length()) - 1), False


def _pattern(sensor: SensorStacks) -> str | None:
    rows = sensor.bench.sensor.pattern
    return None if rows is None else " / ".join(" ".join(row) for row in rows)


def _unknown(camera: str, problems: list[Problem]) -> SensorReport:
    return SensorReport(camera, "", _no_facts(), _no_levels(), problems=problems)


def _no_facts() -> FrameFacts:
    return FrameFacts("", "", "no frame", "", *[None] * 11)


def _no_levels() -> Levels:
    from levkas.calibration.code_spacing import Levels

    return Levels(0, 0, 0)


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

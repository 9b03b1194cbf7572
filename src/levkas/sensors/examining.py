"""What each camera of a campaign is: raw facts, photon transfer, steadiness of the light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import log2, log10
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.calibration.drift import Drift
from levkas.calibration.linearity import Linearity
from levkas.calibration.photon_transfer import Interval, PhotonTransfer, measure_sensor
from levkas.calibration.templates import CalibrationRefused
from levkas.problems import Problem, Refused
from levkas.sensors.facts import (
    FrameFacts,
    describe_files,
    describe_frame,
    describe_levels,
    facts_table,
)

if TYPE_CHECKING:
    import numpy as np

    from levkas.calibration.curves import Levels
    from levkas.sensors.stacks import Sensor

ROWS = (
    ("gain", "system gain K", "DN/e⁻", 1.0),
    ("black", "black", "DN", 1.0),
    ("dark_noise", "temporal dark noise", "e⁻", 1.0),
    ("dark_current", "dark current", "e⁻/s", 1.0),
    ("dsnu", "DSNU₁₂₈₈", "e⁻", 1.0),
    ("prnu", "PRNU₁₂₈₈", "%", 100.0),
    ("full_well", "saturation capacity", "e⁻", 1.0),
    ("linearity_error", "linearity error, rms", "%", 100.0),
    ("snr", "SNR at saturation", "1", 1.0),
    ("dynamic_range", "dynamic range", "1", 1.0),
)
"""Field, EMVA 1288's name, unit and factor, in the order of the table."""


@dataclass(frozen=True)
class SensorReport:
    """One sensor.

    Parameters
    ----------
    camera, sensor : str
    facts : FrameFacts
        Of the first frame of the first object.
    levels : Levels
        Of all frames that were looked at.
    channels : dict of PhotonTransfer
        By channel of the mosaic; one without a name for a plain sensor.
    light : list of (str, Drift)
        Stacks of two shots or more, and how steady their light was.
    linearity : list of (str, Linearity)
        Exposure series of an object.
    notes : list of str
    problems : list of Problem
        Why something could not be told.
    """

    camera: str
    sensor: str
    facts: FrameFacts
    levels: Levels
    channels: dict[str, PhotonTransfer] = field(default_factory=dict)
    light: list[tuple[str, Drift]] = field(default_factory=list)
    linearity: list[tuple[str, Linearity]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Camera and sensor: ``msbs ccd1``."""
        return f"{self.camera} {self.sensor}".strip()

    def rows(self) -> list[tuple[str, ...]]:
        """Return the table: a line a quantity, a column a channel."""
        head = ("", *(channel or "all" for channel in self.channels), "unit")
        lines = [head]
        for key, title, unit, factor in ROWS:
            cells = [_cell(getattr(found, key), factor) for found in self.channels.values()]
            lines.append((title, *cells, unit))
        ranges = [found.dynamic_range for found in self.channels.values()]
        told = ["–" if r is None else f"{20 * log10(r.value):.1f}" for r in ranges]
        stops = ["–" if r is None else f"{log2(r.value):.2f}" for r in ranges]
        peak = [f"{10 * log10(found.snr.value):.1f}" for found in self.channels.values()]
        lines += [
            ("dynamic range", *told, "dB, 20·log₁₀"),
            ("dynamic range", *stops, "stops, log₂"),
            ("SNR at saturation", *peak, "dB, 10·log₁₀"),
        ]
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return {
            "camera": self.camera,
            "sensor": self.sensor,
            "facts": self.facts.to_dict(),
            "codes": describe_levels(self.levels, self.facts.full),
            "channels": [
                {"channel": channel, **_plain(found)} for channel, found in self.channels.items()
            ],
            "light": [
                {
                    "stack": name,
                    "shots": len(d.scales),
                    "drift": d.drift,
                    "flicker": d.flicker,
                    "noticed": d.noticed,
                }
                for name, d in self.light
            ],
            "linearity": [{"stack": name, **asdict(found)} for name, found in self.linearity],
            "notes": self.notes,
        }


@dataclass(frozen=True)
class Examination:
    """Sensors of a campaign, or frames of a folder."""

    root: Path
    sensors: list[SensorReport]
    frames: list[FrameFacts]
    levels: Levels | None
    problems: list[Problem]

    @property
    def ok(self) -> bool:
        """Whether nothing was refused."""
        return not self.problems

    @property
    def text(self) -> str:
        """Tables for people."""
        parts = [_sensor_text(sensor) for sensor in self.sensors]
        if self.frames:
            parts.append(facts_table(self.frames, self.root))
        if self.levels is not None and self.frames:
            parts.append(f"all together: {describe_levels(self.levels, self.frames[0].full)}")
        return "\n\n".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return {
            "cameras": [sensor.to_dict() for sensor in self.sensors],
            "frames": [frame.to_dict() for frame in self.frames],
        }


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
        What could not be told of a sensor stands in `problems`, and the others go on.

    Raises
    ------
    Refused
        Where there is no campaign and no frame.
    """
    path = Path(path)
    is_campaign = (path / "campaign.toml").is_file() if path.is_dir() else path.suffix == ".toml"
    if not is_campaign:
        frames, levels, problems = describe_files(path)
        return Examination(path, [], frames, levels, problems)
    sensors = list(examine_campaign(path, cameras=cameras, rng=rng))
    problems = [p for sensor in sensors for p in sensor.problems]
    return Examination(path, sensors, [], None, problems)


def examine_campaign(
    path: Path, *, cameras: Sequence[str] | None, rng: np.random.Generator
) -> Iterator[SensorReport]:
    """Yield the report of each sensor of each camera."""
    from levkas.campaign import load_campaign
    from levkas.discovery import find_captures

    campaign = load_campaign(path)
    _check_names(cameras, list(campaign.cameras), campaign.path)
    captures, refusals = find_captures(campaign)
    for name in cameras or campaign.cameras:
        own = [c for c in captures if c.camera == name]
        if not own:
            said = [
                p for (_, camera, _), r in refusals.items() if camera == name for p in r.problems
            ]
            yield _unknown(name, said or [_unseen(name, campaign.path)])
            continue
        yield from _examine_camera(campaign, [c for c in own if c.setup == own[0].setup], name, rng)


def _examine_camera(
    campaign: Any, captures: Sequence[Any], name: str, rng: np.random.Generator
) -> Iterator[SensorReport]:
    from levkas.sensors.stacks import gather

    if campaign.cameras[name].kind == "image":
        facts = describe_frame(captures[0].sensors[0].object[0].path)
        note = ["a plain image: nothing is calibrated, and noise cannot be told"]
        yield SensorReport(name, "", facts, facts.levels or _no_levels(), notes=note)
        return
    try:
        for sensor in gather(campaign, captures, name):
            yield _report(sensor, rng)
    except Refused as refused:
        yield _unknown(name, list(refused.problems))


def _report(sensor: Sensor, rng: np.random.Generator) -> SensorReport:
    """Measure every channel of a sensor; what is refused for all is said once."""
    facts = describe_frame(sensor.bench.sensor.object[0].path)
    bits = sensor.bench.camera.bits or facts.bits
    white, black = _white_level(sensor), sensor.bench.black
    facts = replace(facts, bits=bits, white=white, black=black, pattern=_pattern(sensor))
    channels, problems = {}, []
    for channel in dict.fromkeys([*sensor.whites, *sensor.scenes]):
        try:
            channels[channel] = measure_sensor(
                sensor.darks.get(channel, []),
                sensor.whites.get(channel, []),
                sensor.scenes.get(channel, []),
                saturation=facts.full,
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
    told = [note for found in channels.values() for note in found.notes]
    told += [f"{name}: {drift.note}" for name, drift in sensor.light if drift.note]
    notes = list(dict.fromkeys([*sensor.notes, *told]))
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


def _white_level(sensor: Sensor) -> float | None:
    """Saturation as declared; where only the storage tells, what the top code needs, and say so."""
    bench, top = sensor.bench, sensor.levels.highest
    declared = bench.camera.saturation or bench.camera.bits or bench.facts.saturation
    if declared or not top or top > (bench.saturation or 0) / 4:
        return bench.saturation
    guess = float(2 ** max(8, top.bit_length()) - 1)
    sensor.notes.append(f"neither `bits` nor `saturation` is declared: taken for {guess:.0f}")
    return guess


def _pattern(sensor: Sensor) -> str | None:
    rows = sensor.bench.sensor.pattern
    return None if rows is None else " / ".join(" ".join(row) for row in rows)


def _cell(interval: Interval | None, factor: float) -> str:
    if interval is None:
        return "–"
    value, half = factor * interval.value, factor * (interval.high - interval.low) / 2
    digits = 0 if half <= 0 else max(0, min(6, 1 - int(log10(half) // 1)))
    return f"{value:.{digits}f} ± {half:.{digits}f}" if half > 0 else f"{value:.4g}"


def _plain(found: PhotonTransfer) -> dict[str, Any]:
    made: dict[str, Any] = {"levels": found.levels, "points": found.points}
    for key, title, unit, factor in ROWS:
        interval = getattr(found, key)
        made[key] = interval and {
            "value": factor * interval.value,
            "low": factor * interval.low,
            "high": factor * interval.high,
            "unit": unit,
            "name": title,
        }
    return made


def _sensor_text(sensor: SensorReport) -> str:
    facts = sensor.facts
    told = [f"{sensor.name}: {facts.size} {facts.dtype}, {facts.bits} bits"]
    for title, value in (
        ("black", facts.black),
        ("white", facts.white),
        ("pattern", facts.pattern),
        ("exposure s", facts.exposure_s),
        ("ISO", facts.iso),
    ):
        if value is not None:
            told.append(f"{title} {value:g}" if isinstance(value, float) else f"{title} {value}")
    lines = [", ".join(told), f"  codes: {describe_levels(sensor.levels, facts.full)}"]
    if sensor.channels:
        rows = sensor.rows()
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        lines += [
            "  " + "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
    for name, drift in sensor.light:
        flicker = (
            "" if drift.flicker != drift.flicker else f", flicker {100 * drift.flicker:.2f} % rms"
        )
        lines.append(
            f"  light of {name}: drift {100 * drift.drift:+.2f} %{flicker}, {len(drift.scales)} shots"
        )
    for name, found in sensor.linearity:
        lines.append(
            f"  linearity of {name}: {100 * found.rms:.2f} % rms, black fitted {found.offset:+.2f} DN "
            f"from the darks, {found.points} points"
        )
    return "\n".join([*lines, *(f"  note: {note}" for note in sensor.notes)])


def _unknown(camera: str, problems: list[Problem]) -> SensorReport:
    return SensorReport(camera, "", _no_facts(), _no_levels(), problems=problems)


def _no_facts() -> FrameFacts:
    return FrameFacts("", "", "no frame", "", *[None] * 11)


def _no_levels() -> Levels:
    from levkas.calibration.curves import Levels

    return Levels(0, 0, 0)


def _unseen(camera: str, file: Path) -> Problem:
    return Problem(
        "E_NO_FRAMES", f"{camera}: no frame of any object", str(file), f"cameras.{camera}.files"
    )


def _check_names(wanted: Sequence[str] | None, known: Sequence[str], file: Path) -> None:
    for name in wanted or ():
        if name not in known:
            raise Refused(
                Problem(
                    "E_VALUE",
                    f"there is no camera {name}",
                    str(file),
                    "cameras",
                    name,
                    ", ".join(known),
                )
            )

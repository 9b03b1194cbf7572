"""Reports on sensors: tables for people, plain values for programs."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from math import log2, log10
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core.problems import Problem
from levkas.quality.emva1288.drift import Drift
from levkas.quality.emva1288.facts import FrameFacts, describe_levels
from levkas.quality.emva1288.photon_transfer import Interval, PhotonTransfer

if TYPE_CHECKING:
    from levkas.quality.emva1288.levels import Levels

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
    """One sensor."""

    camera: str
    sensor: str
    facts: FrameFacts
    levels: Levels
    channels: dict[str, PhotonTransfer] = field(default_factory=dict)
    light: list[tuple[str, Drift]] = field(default_factory=list)
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
        decibels = ["–" if r is None else f"{20 * log10(r):.1f}" for r in ranges]
        stops = ["–" if r is None else f"{log2(r):.2f}" for r in ranges]
        peaks = [found.snr for found in self.channels.values()]
        peak = ["–" if p is None else f"{10 * log10(p):.1f}" for p in peaks]
        lines += [
            ("dynamic range", *decibels, "dB, 20·log₁₀"),
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
            "notes": self.notes,
        }


@dataclass(frozen=True)
class Examination:
    """Sensors of a campaign."""

    root: Path
    sensors: list[SensorReport]

    @property
    def problems(self) -> list[Problem]:
        """Why sensors could not be measured."""
        return [problem for sensor in self.sensors for problem in sensor.problems]

    @property
    def ok(self) -> bool:
        """Whether nothing was refused."""
        return not self.problems

    @property
    def text(self) -> str:
        """Tables for people."""
        return "\n\n".join(sensor_text(sensor) for sensor in self.sensors)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return {"cameras": [sensor.to_dict() for sensor in self.sensors]}


def _cell(found: Interval | float | None, factor: float) -> str:
    if not isinstance(found, Interval):
        return "–" if found is None else f"{factor * found:.4g}"
    value, half = factor * found.value, factor * (found.high - found.low) / 2
    digits = 0 if half <= 0 else max(0, min(6, 1 - int(log10(half) // 1)))
    return f"{value:.{digits}f} ± {half:.{digits}f}" if half > 0 else f"{value:.4g}"


def _plain(found: PhotonTransfer) -> dict[str, Any]:
    content: dict[str, Any] = {"levels": found.levels, "points": found.points}
    for key, title, unit, factor in ROWS:
        value = getattr(found, key)
        parts = {"value": value} if not isinstance(value, Interval) else asdict(value)
        numbers = {part: number and factor * number for part, number in parts.items()}
        content[key] = None if value is None else {**numbers, "unit": unit, "name": title}
    return content


def sensor_text(sensor: SensorReport) -> str:
    """Return the lines of one sensor."""
    facts = sensor.facts
    parts = [f"{sensor.name}: {facts.size} {facts.dtype}, {facts.bits} bits"]
    for title, value in (
        ("black", facts.black),
        ("white", facts.white),
        ("pattern", facts.pattern),
        ("exposure s", facts.exposure_s),
        ("ISO", facts.iso),
    ):
        if value is not None:
            parts.append(f"{title} {value:g}" if isinstance(value, float) else f"{title} {value}")
    lines = [", ".join(parts), f"  codes: {describe_levels(sensor.levels, facts.full)}"]
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
    return "\n".join([*lines, *(f"  note: {note}" for note in sensor.notes)])

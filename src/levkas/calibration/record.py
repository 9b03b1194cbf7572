"""What calibration measured of a sensor and its light: a typed record, and the one place that turns it to JSON."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypedDict

from levkas.calibration.findings import Finding

LAMP_DOUBT, BLACK_DOUBT = 0.005, 0.0002
"""Standard deviation, relative and in reflectance, that is told: half a per cent of the light, a tenth of the darkest paint."""
Numbers = dict[str, float]
"""By the label of a band."""


class WithError(TypedDict):
    """A number of counts and its standard error."""

    counts: float
    error: float


class FullScaleRecord(TypedDict):
    """Counts at which the frames show that a sensor is full, by what, and what was stated instead."""

    counts: float
    source: str
    stated: str | None


class SensorNoise(TypedDict):
    """Counts above dark at which a sensor is full, noise of one shot in the dark, counts an electron, range in stops, and by what."""

    full: float
    read_noise: float
    gain: float
    stops: float
    source: str


class ClippedDark(TypedDict, total=False):
    """Share of pixels at 0, and black and noise, counts, where these could be fitted."""

    zeros: float
    black: list[float]
    noise: float


class LampNumbers(TypedDict, total=False):
    """How lamp and black level changed, as `lamp.LampChange` has it: relative, counts, and reflectance (`black_sigma`, `black_within`)."""

    white: float | None
    object: float | None
    flicker: float | None
    sigma: float | None
    black: float | None
    black_sigma: float | None
    black_within: float | None
    reach: float | None


@dataclass
class SensorRecord:
    """Measurements of one sensor in one capture; those of its bands by their labels.

    `light` is how even the white is (`measurements.light_of`), `noise_shares` what shots, white and darks add to the noise where the
    signal is middling and `rounding` the step of the codes, in the unit of the values; `black_wander`, counts, is how far the black level
    is known, `mean_of_view` the mean reflectance of all that a band shows, `unlike_noise` the variance of bands over that of all,
    `white_shots` by how much parts of the shots of a white differ, relative, `sensels` noise and signal-to-noise of a mosaic's sensels,
    `quiet_white` the level of a white without shot noise, counts. `black` is by an exposure series, `offset` what such a series has
    without light; `bend` by how much the brightest values are off dim ones, relative, `straightness` its size with its error.
    """

    light: dict[str, dict[str, Any]] = field(default_factory=dict)
    lamp: dict[str, LampNumbers] = field(default_factory=dict)
    noise_shares: dict[str, Numbers] = field(default_factory=dict)
    rounding: Numbers = field(default_factory=dict)
    black_wander: Numbers = field(default_factory=dict)
    mean_of_view: Numbers = field(default_factory=dict)
    unlike_noise: Numbers = field(default_factory=dict)
    white_shots: Numbers = field(default_factory=dict)
    exposures_s: dict[str, float | None] = field(default_factory=dict)
    sensels: dict[str, dict[str, float | None]] = field(default_factory=dict)
    clipped_darks: dict[str, ClippedDark] = field(default_factory=dict)
    full_scale: FullScaleRecord | None = None
    quiet_white: float | None = None
    black: WithError | None = None
    offset: WithError | None = None
    bend: float | None = None
    straightness: float | None = None
    sensor: SensorNoise | None = None
    stray_light: Mapping[str, Any] | None = None
    chart_white: Mapping[str, Any] | None = None
    strips: list[dict[str, Any]] = field(default_factory=list)

    def add(self, others: Iterable[SensorRecord]) -> None:
        """Add what others measured, band after band in their order.

        >>> all_bands = SensorRecord()
        >>> all_bands.add([SensorRecord(rounding={"R": 1.0}), SensorRecord(rounding={"G": 2.0}, bend=0.1)])
        >>> all_bands.to_json()
        {'rounding': {'R': 1.0, 'G': 2.0}, 'bend': 0.1}
        """
        for other in others:
            for one in fields(other):
                value = getattr(other, one.name)
                if isinstance(value, dict) and isinstance(own := getattr(self, one.name), dict):
                    own.update(value)
                elif value is not None and value != []:
                    setattr(self, one.name, value)

    def to_json(self) -> dict[str, Any]:
        """Return what was measured, by its name."""
        named = {one.name: getattr(self, one.name) for one in fields(self)}
        return {name: value for name, value in named.items() if value not in (None, {}, [])}


# --- what a person should know of it ------------------------------------------------------------


def findings_of(record: SensorRecord, *, in_files: bool = False) -> Iterator[Finding]:
    """Yield what was measured of a sensor that a person should know; `in_files` is whether its bands have files of their own."""
    if record.white_shots:
        yield Finding("white_shots", number=max(record.white_shots.values()))
    if record.quiet_white is not None:
        yield Finding("quiet_white", number=record.quiet_white)
    elif full := record.full_scale:
        than = f" ({full['stated']} would be more)" if full["stated"] else ""
        yield Finding("full_scale", full["source"] + than, full["counts"])
    darks = record.clipped_darks.values()
    if blacks := [black for one in darks for black in one.get("black", ())]:
        zeros = max(one.get("zeros", 0.0) for one in darks)
        noise = max(one.get("noise", 0.0) for one in darks)
        ends = dict.fromkeys(f"{black:.2f}" for black in (min(blacks), max(blacks)))
        yield Finding("darks_clipped", " to ".join(ends), zeros, noise)
    if lost := {t: one["zeros"] for t, one in record.clipped_darks.items() if "black" not in one}:
        yield Finding("darks_lost", f"in those of {', '.join(lost)}", max(lost.values()))
    if record.bend is not None:
        yield Finding("bend", number=record.bend)
    if record.offset:
        yield Finding("offset", number=record.offset["counts"], limit=record.offset["error"])
    if record.black:
        yield Finding("black_by_series", number=record.black["counts"], limit=record.black["error"])
    if unlike := {b: max(ratio, 1 / ratio) for b, ratio in record.unlike_noise.items()}:
        code = "unlike_bands" if in_files else "unlike_channels"
        worst = max(unlike, key=lambda band: unlike[band])
        yield Finding(code, f"{worst} ({len(unlike)} in all)", unlike[worst])


def findings_of_lamp(records: Iterable[SensorRecord]) -> Iterator[Finding]:
    """Yield how well the light is known between white and object, all sensors together."""
    bands = {label: one for record in records for label, one in record.lamp.items()}
    # Of a weak band noise alone leaves the drift in doubt: that is no change of the lamp.
    changed = {
        label: one["sigma"] or 0.0
        for label, one in bands.items()
        if one["white"] or one["object"] or (one["flicker"] or 0.0) >= LAMP_DOUBT
    }
    worst = max(changed, key=lambda label: changed[label], default="")
    if worst and changed[worst] >= LAMP_DOUBT:
        one = bands[worst]
        parts = [
            f"{100 * part:+.2g} % within the {name}"
            for name in ("white", "object")
            if (part := one[name])
        ]  # type: ignore[literal-required]
        parts = parts or [f"{100 * (one['flicker'] or 0):.2g} % rms from shot to shot"]
        yield Finding("lamp", ", ".join([worst, *parts]), changed[worst])
    wander = {
        label: one["black_sigma"] or 0.0
        for label, one in bands.items()
        if (one.get("black_within") or 0.0) >= BLACK_DOUBT
    }
    worst = max(wander, key=lambda label: wander[label], default="")
    if worst and wander[worst] >= BLACK_DOUBT:
        yield Finding("black_wanders", worst, wander[worst])

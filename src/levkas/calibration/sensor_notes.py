"""What was measured of a sensor that a person should know: where it is full, darks that were clipped, its curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from levkas.calibration.sensor_context import BLACK, CLIPPED_DARKS, FULL_SCALE, NAMED, RESPONSE

if TYPE_CHECKING:
    from levkas.calibration.sensor_context import SensorContext


def describe_sensor(context: SensorContext) -> list[str]:
    """Say what was measured of a sensor that a person should know: where it is full, its black, its curve, darks that were clipped."""
    return [
        *_describe_full_scale(context),
        *_describe_darks(context),
        *_describe_response(context),
        *_describe_black(context),
    ]


def _describe_black(context: SensorContext) -> list[str]:
    found = context.told.get(BLACK)
    if not found:
        return []
    return [
        f"{context.camera.name}: the black level is {found['counts']:.1f} ± {found['error']:.1f} counts, by exposures of one scene: "
        "darks of one time alone do not show it. `black` in campaign.toml states it"
    ]


def _describe_response(context: SensorContext) -> list[str]:
    found = context.told.get(RESPONSE)
    if not found:
        return []
    most = abs(float(sum(found["terms"])))
    return [
        f"{context.camera.name}: the sensor is not linear: its exposure series deviate by {100 * found['rms_line']:.1f} % rms "
        f"from a line, at full scale by {100 * most:.1f} %. Frames of object and white are corrected by the curve that they "
        f"show, which leaves {100 * found['rms']:.2f} % and is known to {100 * found['error']:.2g} %"
    ]


def _describe_full_scale(context: SensorContext) -> list[str]:
    found = context.told.get(FULL_SCALE)
    if not found:
        return []
    counts, stated = f"{found['counts']:g}", found["stated"]
    than = f" ({stated} would be more)" if stated else ""
    return [
        f"{context.camera.name}: the sensor is full at {counts} counts: {found['source']}{than}; values from there on are "
        f"flagged as saturated. `saturation = {counts}` in campaign.toml states it"
    ]


def _describe_darks(context: SensorContext) -> list[str]:
    darks: dict[str, dict[str, Any]] = context.told.get(CLIPPED_DARKS, {})
    if not darks:
        return []
    name, zeros = context.camera.name, max(one["zeros"] for one in darks.values())
    blacks = [black for one in darks.values() for black in one.get("black", ())]
    lost = [time for time, one in darks.items() if "black" not in one]
    notes = []
    if blacks:
        noise = max(one.get("noise", 0.0) for one in darks.values())
        notes.append(
            f"{name}: darks were clipped at zero (up to {zeros:.0%} of the pixels) and are fitted as censored: black "
            f"{_range(blacks, '.2f')} counts, noise {noise:.2g}"
        )
    if lost:
        some = f" of {', '.join(filter(None, lost[:NAMED]))}" if any(lost) else ""
        notes.append(
            f"{name}: darks{some} are clipped too strongly, hardly a value is above zero: what the black level hides is "
            "unknown, and dark values may be wrong by it. Raise the camera's black level (offset)"
        )
    return notes


def _range(numbers: Sequence[float], form: str) -> str:
    low, high = (format(n, form) for n in (min(numbers), max(numbers)))
    return low if low == high else f"{low} to {high}"

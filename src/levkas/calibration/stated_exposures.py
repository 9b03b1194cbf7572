"""Exposures that the frames of a sensor state: for every frame or for none, and scaled from white to object."""

from __future__ import annotations

from typing import TYPE_CHECKING

from levkas.calibration.darks import SAME_TIME
from levkas.calibration.sensor_context import NAMED, Times, listed, times_of
from levkas.calibration.templates import CalibrationRefused
from levkas.core.problems import Problem
from levkas.readers.frames import read_facts

if TYPE_CHECKING:
    from levkas.calibration.sensor_context import SensorContext


def require_exposures(context: SensorContext) -> None:
    """Refuse a sensor some of whose frames state their exposure, and others do not.

    Raises CalibrationRefused, E_EXPOSURES; also where no frame states it in a known unit, and the numbers without one differ.
    """
    sensor = context.sensor
    frames = list(dict.fromkeys((*sensor.object, *sensor.white, *sensor.dark)))
    stated = [frame for frame in frames if times_of(frame) is not None]
    silent = [frame for frame in frames if times_of(frame) is None]
    if not silent:
        return
    statements = {
        frame: facts.exposure_unclear
        for frame in silent
        if (facts := read_facts(frame.path)).exposure_unclear
    }
    if not stated and len({statements.get(frame) for frame in silent}) == 1:
        return
    unclear = [f"{frame.path.name}: {text}" for frame, text in statements.items()][:NAMED]
    found = [f"{frame.path.name}: {_shown(times_of(frame))}" for frame in stated[:NAMED]]
    found += unclear or [f"{frame.path.name}: nothing" for frame in silent[:NAMED]]
    what = (
        "the unit of the exposure is unknown"
        if unclear
        else f"only {len(stated)} of {len(frames)} frames state their exposure"
    )
    raise CalibrationRefused(
        Problem(
            "E_EXPOSURES",
            f"{context.camera.name}: {what}",
            str(silent[0].path),
            "exposure",
            "; ".join(found),
            "an exposure for every frame of object, white and dark, or for none",
            "Put {exposure} with its unit into the names and `files`, or list the files in a `manifest` with exposure_s.",
        )
    )


def require_black(context: SensorContext) -> None:
    """Refuse a file whose black levels cannot be understood where they would be subtracted.

    Raises CalibrationRefused, E_VALUE where there is neither a dark nor a declared black.
    """
    unclear = context.facts.black_unclear
    if unclear is None or context.sensor.dark or context.camera.black is not None:
        return
    raise CalibrationRefused(
        Problem(
            "E_VALUE",
            f"{context.camera.name}: the black levels of the file cannot be understood",
            str(context.facts.path),
            "BlackLevel",
            unclear,
            "levels of every sensel of the frame",
            f"Capture darks, or write `black` under [cameras.{context.camera.name}] where one number serves.",
        )
    )


def doubt_scaling(context: SensorContext, taken: Times, other: Times) -> str:
    """Report that counts are scaled from the white's time to the object's without a series that shows that they scale."""
    object_times, white_times = listed(taken), listed(other)
    if not object_times or not white_times:
        return ""
    wide = max(len(object_times), len(white_times))
    pairs = zip(_spread(object_times, wide), _spread(white_times, wide), strict=True)
    if all(abs(mine / its - 1) <= SAME_TIME for mine, its in pairs):
        return ""
    return (
        f"{context.camera.name}: the white was exposed for {_shown(other)}, the object for "
        f"{_shown(taken)}; without an exposure series the linearity is unknown"
    )


def _spread(times: tuple[float, ...], bands: int) -> tuple[float, ...]:
    return times * bands if len(times) == 1 else times


def _shown(times: Times) -> str:
    if isinstance(times, tuple):
        return f"{min(times):g} to {max(times):g} s, band by band"
    return f"{times:g} s" if times is not None else "nothing"

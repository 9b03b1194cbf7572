"""How long every frame of a sensor was exposed, as names, the manifest or the files themselves say: of all frames, or of none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.calibration.darks import SAME_TIME
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.core.digests import Stamp, stamp_of
from levkas.core.problems import Problem
from levkas.readers.facts import Facts
from levkas.readers.frames import read_facts

if TYPE_CHECKING:
    from levkas.building.bench import Bench
    from levkas.campaign.discovery.captures import FrameRef

Times = float | tuple[float, ...] | None
"""Of a frame, s: one, one a band where a header lists several, or not known."""
NAMED = 3
"""Frames that a message names."""


def times_of(frame: FrameRef) -> Times:
    """Return the exposure that the name or the manifest states, else EXIF or the header of the file."""
    if frame.exposure_s is not None:
        return frame.exposure_s
    facts = _facts(frame.path, stamp_of(frame.path))
    return facts.band_times_s or facts.exposure_s


@lru_cache(maxsize=4096)
def _facts(path: Path, _stamp: Stamp) -> Facts:
    """Facts of one file, read once: of a camera raw they cost half a second."""
    return read_facts(path)


def require_exposures(bench: Bench) -> None:
    """Refuse a sensor some of whose frames state their exposure, and others do not.

    Raises
    ------
    CalibrationRefused
        E_EXPOSURES; also where no frame states it in a known unit, and the numbers without one differ.
    """
    sensor = bench.sensor
    frames = list(dict.fromkeys((*sensor.object, *sensor.white, *sensor.dark)))
    stated = [frame for frame in frames if times_of(frame) is not None]
    silent = [frame for frame in frames if times_of(frame) is None]
    if not silent:
        return
    said = {
        frame: facts.exposure_unclear
        for frame in silent
        if (facts := _facts(frame.path, stamp_of(frame.path))).exposure_unclear
    }
    if not stated and len({said.get(frame) for frame in silent}) == 1:
        return
    unclear = [f"{frame.path.name}: {text}" for frame, text in said.items()][:NAMED]
    found = [f"{frame.path.name}: {_shown(times_of(frame))}" for frame in stated[:NAMED]]
    found += unclear or [f"{frame.path.name}: nothing" for frame in silent[:NAMED]]
    what = (
        "the unit of the exposure is not known"
        if unclear
        else f"only {len(stated)} of {len(frames)} frames state their exposure"
    )
    raise CalibrationRefused(
        Problem(
            "E_EXPOSURES",
            f"{bench.camera.name}: {what}",
            str(silent[0].path),
            "exposure",
            "; ".join(found),
            "the exposure of every frame of object, white and dark, or of none",
            "Put {exposure} with its unit into the names and `files`, or list the files in a `manifest` with exposure_s.",
        )
    )


def by_exposure(frames: Sequence[FrameRef]) -> list[tuple[Times, list[FrameRef]]]:
    """Group frames of equal exposure, shortest first."""
    groups: dict[Times, list[FrameRef]] = {}
    for frame in frames:
        groups.setdefault(times_of(frame), []).append(frame)
    return sorted(groups.items(), key=lambda item: _listed(item[0]))


def timed(template: Template, times: Times) -> Template:
    """Return a template with its exposure."""
    if isinstance(times, tuple):
        return replace(template, exposure_s=None, band_times_s=times)
    return replace(template, exposure_s=times)


def times_in(template: Template) -> Times:
    """Return the exposure of a template."""
    return template.band_times_s or template.exposure_s


def templates_by_exposure(
    frames: Sequence[FrameRef], make: Callable[[list[FrameRef]], Template]
) -> list[Template]:
    """Average frames exposure by exposure, shortest first."""
    return [timed(make(group), times) for times, group in by_exposure(frames)]


def doubt_scaling(bench: Bench, taken: Times, other: Times) -> str:
    """Say that counts are scaled from the white's time to the object's without a series that shows that they scale."""
    object_times, white_times = _listed(taken), _listed(other)
    if not object_times or not white_times:
        return ""
    wide = max(len(object_times), len(white_times))
    pairs = zip(_spread(object_times, wide), _spread(white_times, wide), strict=True)
    if all(abs(mine / its - 1) <= SAME_TIME for mine, its in pairs):
        return ""
    return (
        f"{bench.camera.name}: the white was exposed for {_shown(other)}, the object for {_shown(taken)}: whether "
        "counts scale is not known without an exposure series of one of them"
    )


def _spread(times: tuple[float, ...], bands: int) -> tuple[float, ...]:
    return times * bands if len(times) == 1 else times


def _listed(times: Times) -> tuple[float, ...]:
    if times is None:
        return ()
    return times if isinstance(times, tuple) else (times,)


def _shown(times: Times) -> str:
    if isinstance(times, tuple):
        return f"{min(times):g} to {max(times):g} s, band by band"
    return f"{times:g} s" if times is not None else "nothing"

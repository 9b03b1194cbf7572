"""What the files of a sensor state that a person should know, or by which no values can be made."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from levkas.calibration.findings import CalibrationRefused, Finding, refusal
from levkas.calibration.sensor import listed, times_of
from levkas.readers.frames import read_facts, read_headers

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.calibration.sensor import SensorCapture

NAMED = 3
"""Frames, or bands, that a message names."""


def doubts_of(context: SensorCapture) -> Iterator[Finding | str]:
    """Yield what a person should know before using the values."""
    yield from _notes_of_files(context)
    yield from context.doubts
    if not context.camera.traits.is_calibrated:
        return
    yield from context.sensor.remarks
    scales = (read_facts(frame.path).reflectance_scale for frame in context.sensor.object)
    if scale := next((s for s in scales if s), None):
        shown = " to ".join(f"{value:g}" for value in dict.fromkeys((min(scale), max(scale))))
        yield Finding("scale_used" if context.holds_reflectance else "scale_unused", shown)
    bands = context.sensor.bands
    if bad := [band.label for band in bands if band.bad]:
        names = ", ".join(bad[:NAMED]) + (" …" if len(bad) > NAMED else "")
        yield Finding("bad_bands", names, len(bad), len(bands))
    if context.light is not None:
        yield from context.light.notes
    elif not context.sensor.white and not context.holds_reflectance:
        yield Finding("no_white")


def _notes_of_files(context: SensorCapture) -> Iterator[Finding | str]:
    """Yield what readers take otherwise than files state it, each once with the first file and how many there are."""
    sensor, traits = context.sensor, context.camera.traits
    found: dict[tuple[str, str, float], dict[Path, None]] = {}
    for frame in (*sensor.object, *sensor.white, *sensor.chart, *sensor.dark):
        if read_headers(frame.path).kind == "raw":
            continue
        facts = read_facts(frame.path)
        more = [("", note, 0.0) for note in facts.notes]
        if facts.pages > 1 and frame.page is None and not traits.reads_pages:
            more.append(("pages", "", facts.pages))
        if facts.encoded and traits.is_calibrated:
            more.append(("tone_curve", facts.encoded, 0.0))
        for key in more:
            found.setdefault(key, {})[frame.path] = None
    for (code, said, number), paths in found.items():
        files = next(iter(paths)).name + (f" and {len(paths) - 1} more" if len(paths) > 1 else "")
        subject = f"{said}, in {files}" if said else files
        yield Finding(code, subject, number) if code else f"{said} ({files})"


def require_sound(context: SensorCapture) -> None:
    """Refuse a sensor by what is wrong with single frames, some of which state their exposure and others not, or whose black levels are unclear.

    E_EXPOSURES also where no frame states its exposure in a known unit, and the numbers without one differ. Black levels count where there is neither
    a dark nor a declared black, E_VALUE.
    """
    if context.problems:
        raise CalibrationRefused(*context.problems)
    sensor, facts, camera = context.sensor, context.facts, context.camera
    if not camera.traits.is_calibrated:
        return
    frames = list(dict.fromkeys((*sensor.object, *sensor.white, *sensor.dark)))
    stated = [frame for frame in frames if times_of(frame) is not None]
    silent = [frame for frame in frames if frame not in stated]
    said = {frame: read_facts(frame.path).exposure_unclear for frame in silent}
    if silent and (stated or len(set(said.values())) > 1):
        known = [f"{f.path.name}: {listed(times_of(f))[0]:g} s" for f in stated[:NAMED]]
        unclear = [f"{f.path.name}: {text or 'nothing'}" for f, text in said.items()][:NAMED]
        file = str(silent[0].path)
        raise refusal("times_missing", "; ".join([*known, *unclear]), file=file)
    if facts.black_unclear is not None and not sensor.dark and camera.black is None:
        file = str(facts.path)
        raise refusal("black_unclear", facts.black_unclear, file=file, camera=camera.name)

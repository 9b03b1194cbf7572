"""What the stages of an object were made of: provenance.json."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

from levkas import __version__
from levkas.building.build_records import STAGES, key_of
from levkas.building.inputs import WRITTEN, frames_of, relative, use_of
from levkas.calibration.chart_light import CHART_WHITE
from levkas.calibration.sensor import Times, times_of
from levkas.core.instructions import describe_instructions
from levkas.core.problems import Refused
from levkas.core.text import read_json
from levkas.database.layout import layer_name
from levkas.readers.frames import files_of
from levkas.stages.sources import libraries

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from levkas.building.build_records import BuildRecords, Key
    from levkas.calibration.error_sources import ErrorSource
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import LayerId

PROVENANCE = "provenance.json"
FILE, FRAME, MADE_WITH = "file ", "frame ", ("code", "instructions")
"""Beginnings of what a fingerprint says of a file and of its use as a frame; what it says of the program."""


def provenance_of(
    campaign: Campaign,
    records: BuildRecords,
    captures: Sequence[Capture],
    budgets: Mapping[str, tuple[ErrorSource, ...]],
) -> dict[str, Any]:
    """Return versions, instruction sets of the process that writes, and `steps`: every stage that has ended well, in order.

    Each with ``code`` (hash of sources and libraries), ``parameters``, ``inputs`` and ``products`` (SHA-256 by relative path; not the
    Zarr chunks, which hold the same numbers as the TIFFs). A calibration has ``frames``: of every frame its role, what its name says,
    its exposure in s and the SHA-256 of its files; ``uncertainty``, the budget of the layer; and ``chart_white``, by sensor, where a
    chart is the white.
    """
    steps = []
    for capture in captures:
        for key in (key_of(capture, stage) for stage in STAGES):
            if not (step := _step(records, key)):
                continue
            if key.stage == "calibrate":
                step["frames"] = _frames(campaign, capture, step["inputs"])
                measured = records.notes(key).get("measured", {})
                whites = {s: one[CHART_WHITE] for s, one in measured.items() if CHART_WHITE in one}
                step |= {CHART_WHITE: whites} if whites else {}
                step["uncertainty"] = [row.to_dict() for row in budgets[capture.layer]]
            steps.append(step)
    return {
        "object": captures[0].object,
        "levkas": __version__,
        "libraries": libraries(),
        "instructions": describe_instructions(),
        "steps": steps,
    }


def steps_of(path: Path, earlier: Iterable[LayerId]) -> dict[str, list[dict[str, Any]]]:
    """Return what a provenance that was written before has of some layers, by their names."""
    names, found = {layer.name for layer in earlier}, dict[str, list[dict[str, Any]]]()
    with suppress(Refused, KeyError):
        for step in read_json(path)["steps"] if names else ():
            found.setdefault(layer_name(step["camera"], step["setup"]), []).append(step)
    return {layer: steps for layer, steps in found.items() if layer in names}


def _step(records: BuildRecords, key: Key) -> dict[str, Any]:
    prints, products, notes = records.fingerprint(key), records.products(key), records.notes(key)
    if not prints:
        return {}
    parameters = {
        k.removeprefix(WRITTEN): v
        for k, v in prints.items()
        if not k.startswith((FILE, FRAME)) and k not in MADE_WITH and v is not None
    }
    return {
        "camera": key.camera,
        "setup": key.setup,
        "stage": key.stage,
        "code": prints.get("code", ""),
        "instructions": prints.get("instructions", ""),
        "parameters": parameters,
        "inputs": {k.removeprefix(FILE): v for k, v in prints.items() if k.startswith(FILE)},
        "products": {n: sha for n, sha in products.items() if not n.startswith("zarr/")},
        **{k: v for k, v in notes.items() if k == "noise_correlation"},
    }


def _frames(campaign: Campaign, capture: Capture, inputs: dict[str, str]) -> list[dict[str, Any]]:
    frames = []
    for sensor, role, frame in frames_of(capture):
        names = [relative(campaign, path) for path in files_of(frame.path)]
        seconds: Times = frame.exposure_s
        with suppress(Refused, OSError):
            seconds = times_of(frame)
        use = use_of(sensor, role, frame)
        if seconds is not None:
            use["exposure_s"] = list(seconds) if isinstance(seconds, tuple) else seconds
        frames.append({**use, "files": {name: inputs.get(name, "") for name in names}})
    return frames

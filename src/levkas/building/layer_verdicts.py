"""What a build says of every layer: its verdict, its errors and the reasons."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING, Any

from levkas.building.build_records import STAGES, key_of
from levkas.core.files import write_json
from levkas.core.problems import Refused
from levkas.database.catalogue import entry_of
from levkas.database.layout import LayerId, Places, layer_name
from levkas.database.registrations import (
    apply_confirmation,
    mm_per_px,
    read_registration,
    unchecked_mm2,
    unchecked_share,
)
from levkas.pages.summary import describe_length
from levkas.registration.advice import percent
from levkas.registration.record import DECISIONS, decided

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from levkas.building.build_records import BuildRecords, Key
    from levkas.building.graph import BuildReport, Step
    from levkas.campaign.discovery.captures import Capture
    from levkas.campaign.edits import Edits


def layer_verdicts(report: BuildReport) -> list[dict[str, Any]]:
    """Return a row a layer: object, camera, setup, verdict, camera of the reference, reasons, next step and errors.

    A layer that was refused at any stage has ``"refuse"`` and that stage. Of the reference camera, to
    which the others are registered, there are no errors.
    """
    layers: dict[Key, list[Step]] = {}
    for step in report.stages if report.output else ():
        if step.key.stage in STAGES:
            layers.setdefault(replace(step.key, stage=""), []).append(step)
    return [_row(report, key, steps) for key, steps in sorted(layers.items())]


def confirm_layers(
    captures: Iterable[Capture], edits: Edits, places: Places, records: BuildRecords
) -> None:
    """Write what a person says of layers, or says no more, into records that stand; no pixel depends on it."""
    for capture in captures:
        registered, resampled = (key_of(capture, stage) for stage in ("register", "resample"))
        path = places.registration(capture.object, capture.layer)
        if path.relative_to(places.output).as_posix() not in records.products(registered):
            continue
        record = read_registration(path)
        verdict = apply_confirmation(record, edits.confirmed.get((capture.object, capture.layer)))
        if verdict == record["verdict"]:
            continue
        write_json(path, record | {"verdict": verdict})
        records.keep_again(registered)
        if row := records.notes(resampled).get("entry"):
            entry = replace(entry_of(row), verdict=decided(verdict))
            records.keep_again(resampled, entry=entry.to_row())


def verdict_lines(report: BuildReport) -> list[str]:
    """Return a line for each layer of which this build did a stage, and that was not refused: its verdict, error and doubts."""
    done = {s.key.of for s in report.stages if s.state == "done"}
    new = tuple(s for s in report.stages if s.key.of in done)
    rows = layer_verdicts(replace(report, stages=new))
    return [_line(row) for row in rows if row["verdict"] not in ("refuse", "")]


def standing_lines(report: BuildReport) -> list[str]:
    """Return a line for each layer that the last build published or refused, as `status` lists them.

    A layer that a build would make anew has the verdict that it got before; one that was never built has no line.
    """
    stale = {s.key.of for s in report.stages if s.state == "stale" and s.key.stage != "describe"}
    lines = []
    for row in layer_verdicts(report):
        if "stage" in row:
            lines.append(_line(row, f"refused at {row['stage']}"))
        elif row["verdict"]:
            old = LayerId(row["object"], row["camera"], row["setup"]) in stale
            lines.append(_line(row) + "; stale, verdict of the earlier build" * old)
    return lines


def report_line(report: BuildReport) -> str:
    """Return where the pages of the objects lie that a build has written; "" where it wrote none."""
    written = {s.key.object for s in report.stages if s.key.stage == "report" and s.state == "done"}
    if not written or report.output is None:
        return ""
    name = next(iter(written)) if len(written) == 1 else "OBJECT"
    return f"open in a browser: {report.output / 'objects' / name / 'report.html'}"


def _line(row: Mapping[str, Any], words: str = "") -> str:
    name = f"{row['object']}/{layer_name(row['camera'], row['setup'])}"
    return f"{name}: {words or describe_verdict(row)}"


def describe_verdict(row: Mapping[str, Any]) -> str:
    """Return the verdict of one row of `layer_verdicts` in words.

    >>> row = {"camera": "nir", "setup": "", "reference": "vis", "verdict": "accept", "reasons": [], "checked_share": 0.97}
    >>> describe_verdict(row | {"held_out_px": 0.0631, "held_out_mm": 0.0765})
    'accepted, held-out error 0.063 px = 0.076 mm, checked over 97 % of the layer'
    >>> describe_verdict({"camera": "vis", "setup": "", "reference": "vis", "verdict": "accept", "reasons": []})
    'reference'
    """
    px, mm, checked = (row.get(key) for key in ("held_out_px", "held_out_mm", "checked_share"))
    leads = row["verdict"] == "accept" and row["camera"] == row["reference"] and not row["setup"]
    decision = "reference" if leads else decided({**row, "decision": row["verdict"]})
    parts = [DECISIONS.get(decision, decision)]
    if px is not None:
        parts.append(f"held-out error {describe_length(px, mm / px if mm and px else None)}")
    if checked is not None:
        parts.append(f"checked over {percent(checked)} of the layer")
    doubts = {"warn": row["reasons"], "confirmed": row["reasons"][1:]}.get(row["verdict"], [])
    return ": ".join([", ".join(parts), *(["; ".join(doubts)] if doubts else [])])


def _row(report: BuildReport, key: Key, steps: Sequence[Step]) -> dict[str, Any]:
    row: dict[str, Any] = {"object": key.object, "camera": key.camera, "setup": key.setup}
    if lost := sorted((s for s in steps if s.state == "refused"), key=lambda s: not s.problems):
        first, problems = lost[0], lost[0].problems
        return row | {
            "verdict": "refuse",
            "stage": first.key.stage,
            "codes": [p.code for p in problems],
            "reasons": [p.message for p in problems] or [first.why],
            "next_step": " ".join(dict.fromkeys(p.fix for p in problems if p.fix)),
            **({"earlier": first.earlier} if first.earlier else {}),
        }
    assert report.output is not None
    try:
        record = read_registration(Places(report.output).registration(key.object, key.layer))
    except Refused as refused:
        reasons = [p.message for p in refused.problems]
        return row | {"verdict": "", "reasons": reasons, "next_step": "Build again."}
    verdict = record.get("verdict", {})
    return row | {
        "verdict": verdict.get("decision", ""),
        "reference": record.get("reference", {}).get("camera", ""),
        "reasons": list(verdict.get("reasons", [])),
        "next_step": verdict.get("next_step", ""),
        **{key: verdict[key] for key in ("confirmed",) if key in verdict},
        "method": record.get("method", ""),
        **errors_of(record),
    }


def errors_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the held-out error, px of the reference and mm on the object, and what was not checked, of a registration's record.

    The error is that of the area that was checked, and shares are of the layer; of several sensors it is the largest.
    """
    errors, numbers = record.get("errors", {}), record.get("verdict", {}).get("numbers") or {}
    sensors = (*(errors.get("sensors") or {}).values(), *numbers.values())
    px = [one.get("held_out_px") for one in sensors if isinstance(one, dict)]
    worst = max((float(v) for v in px if isinstance(v, int | float) and isfinite(v)), default=None)
    scale, unchecked = mm_per_px(record), unchecked_share(record)
    return {
        "held_out_px": worst,
        "held_out_mm": None if worst is None or scale is None else worst * scale,
        "checked_share": None if worst is None else 1 - unchecked,
        "unchecked_share": unchecked,
        "outside_share": unchecked_share(record, "outside"),
        "unchecked_mm2": unchecked_mm2(record),
    }

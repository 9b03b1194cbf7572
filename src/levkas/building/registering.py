"""One capture registered to the reference band, and the record of it."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas import __version__
from levkas.building.hand_points import declared_points, joined, placed_in, placed_pairs
from levkas.geometry.transforms import Affine, Composed
from levkas.registration import Registration, RegistrationRefused, register

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from levkas.building.native import Native
    from levkas.building.scans import Scan
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.find_captures import Capture
    from levkas.database.layout import Places
    from levkas.geometry.grid import Grid
    from levkas.registration import BandImage
    from levkas.registration.manual_points import ManualPoints
    from levkas.registration.record import Matches

FEWEST_PX = 16
"""A band smaller than this has nothing to register by."""


def register_capture(
    native: Native | Scan,
    reference: Sequence[BandImage],
    reference_band: str,
    own: Registration | None,
    region: tuple[float, float, float, float] | None,
    options: dict[str, Any],
    given: Mapping[str, ManualPoints] | None = None,
) -> Registration:
    """Register every band of a capture; `own` is the reference camera's registration, None for itself.

    `given` are pairs by hand, by sensor, in native pixels.

    Raises RegistrationRefused where there is no answer at all.
    """
    if own is None:
        return register(
            reference, reference, reference_band=reference_band, region=region, given=given,
            **options,
        )  # fmt: skip
    given = {sensor: pairs.reduced(native.factor) for sensor, pairs in (given or {}).items()}
    if options.get("method", "levkas") == "levkas":
        options = {
            **options,
            "reference_transforms": own.transforms,
            "reference_sigma": own.sigma,
        }
    aligns = {s: a for s, a in native.aligns.items() if a != "measure"}
    if aligns and options.get("method") == "mirhashemi2019":
        options = {**options, "align": {s: Affine(np.array(a, float)) for s, a in aligns.items()}}
    found = register(
        reference, native.images(), reference_band=reference_band, region=region, given=given,
        **options,
    )  # fmt: skip
    return found if native.factor == 1 else _enlarged(found, native.factor)


def corrections_of(
    campaign: Campaign, capture: Capture, channel: str = ""
) -> tuple[dict[str, ManualPoints], dict[str, float]]:
    """Return the pairs by hand of a capture, by sensor, and `reject` and `stop` where set by hand.

    Pairs come from edits.toml and from the file of points that campaign.toml names; `channel` is the
    capture's reference channel.
    """
    given, options = {}, {}
    for band, edits in campaign.edits.of(capture.object, capture.layer).items():
        sensor, placed = placed_in(capture, band, channel)
        given[sensor] = placed_pairs(edits.given(), placed)
        for key in ("reject", "stop"):
            if getattr(edits, key) is not None:
                options[key] = getattr(edits, key)
    for sensor, pairs in declared_points(campaign, capture, channel).items():
        given[sensor] = pairs if sensor not in given else joined(given[sensor], pairs)
    return given, options


def _enlarged(found: Registration, factor: int) -> Registration:
    """Turn a registration of reduced pictures into one of native pixels."""
    middle = (factor - 1) / 2
    grow = Affine(np.array([[factor, 0, middle], [0, factor, middle]], float))
    return replace(
        found,
        transforms={label: Composed(one, grow) for label, one in found.transforms.items()},
        matches=replace(found.matches, target=grow(found.matches.target)),
        others={s: replace(m, target=grow(m.target)) for s, m in found.others.items()},
        errors=_with_enlarged_checks(found.errors, grow),
        trace=None,
        observations=tuple(one.enlarged(grow) for one in found.observations),
    )


def _with_enlarged_checks(errors: dict[str, Any], grow: Affine) -> dict[str, Any]:
    if "check_points" not in errors:
        return errors
    points = [
        one | {"target": grow(np.array([one["target"]]))[0].tolist()}
        for one in errors["check_points"]
    ]
    return errors | {"check_points": points}


def record_of(
    registration: Registration | None,
    refused: RegistrationRefused | None,
    capture: Capture,
    native: Native | Scan,
    grid: Grid,
    reference: dict[str, Any],
    px_per_mm: float | None,
    channel: str,
    method: str,
) -> dict[str, Any]:
    """Return the record of registration/CAMERA.json."""
    record: dict[str, Any] = {
        "levkas": __version__,
        "object": capture.object,
        "camera": capture.camera,
        "setup": capture.setup,
        "method": method,
        "reference": reference,
        "target": {"camera": capture.camera, "setup": capture.setup, "band": channel},
        "grid": {
            "size": list(grid.size),
            "transform": grid.transform.to_dict(),
            "px_per_mm": px_per_mm,
        },
    }
    if registration is None:
        problems = refused.problems if refused else ()
        trace = refused.trace.to_dict() if refused and refused.trace else {}
        verdict = {
            "decision": "refuse",
            "reasons": [str(p.message) for p in problems],
            "next_step": next((p.fix for p in problems if p.fix), ""),
            "numbers": {},
        }
        return {
            **record,
            "verdict": verdict,
            "model": {"kind": "none"},
            "bands": {},
            "errors": {},
            "trace": trace,
        }
    told = registration.to_dict()
    bands = {
        label: {"size": native.size_of(label), "transform": transform.to_dict()}
        for label, transform in registration.transforms.items()
    }
    for label, sigma in registration.sigma.items():
        bands[label]["sigma"] = sigma.to_dict()
    keep = ("method", "verdict", "model", "errors", "trace")
    return {**record, **{k: told[k] for k in keep}, "bands": bands}


def table_of(matches: Matches) -> str:
    """Return CAMERA.matches.csv, or that of another sensor than the first."""
    from levkas.registration.record import COLUMNS

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(matches.rows())
    return text.getvalue()


def write_registration(
    places: Places, capture: Capture, record: dict[str, Any], matches: Mapping[str, Matches]
) -> list[Path]:
    """Write a registration's record and its tables of matches, and take older tables away.

    `matches` are by sensor, the first one's under "". Raises WriteRefused.
    """
    from levkas.core.files import make_folder, remove, write_json, write_text

    name, layer = capture.object, capture.layer
    path = places.registration(name, layer)
    make_folder(path.parent)
    write_json(path, record)
    tables = {places.matches(name, layer, sensor): pairs for sensor, pairs in matches.items()}
    for place, pairs in tables.items():
        write_text(place, table_of(pairs))
    names = [places.matches(name, layer, sensor.name) for sensor in capture.sensors]
    for place in sorted({places.matches(name, layer), *names} - tables.keys()):
        if place.is_file():
            remove(place)
    return [path, *tables]

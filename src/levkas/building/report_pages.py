"""The report page of an object from the records of its layers, and its provenance."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas import __version__
from levkas.building.build_records import STAGES, key_of
from levkas.building.camera_pages import stray_light_of
from levkas.building.graph import is_reference
from levkas.building.inputs import WRITTEN, frames_of, relative, use_of, written
from levkas.calibration.chart_light import CHART_WHITE
from levkas.calibration.error_sources import ErrorSource
from levkas.calibration.sensor import Times, times_of
from levkas.campaign.discovery.captures import Capture, SensorFrames
from levkas.campaign.schema.toml import to_toml
from levkas.core.files import make_folder, together, write_json, write_text
from levkas.core.instructions import describe_instructions
from levkas.core.problems import Refused
from levkas.core.text import counted, read_json
from levkas.core.threads import each
from levkas.database.described import open_tiff
from levkas.database.layout import LayerId, layer_name
from levkas.database.region_uncertainty import LayerBudget
from levkas.database.registrations import (
    describe_lying,
    describe_pairs,
    mm_per_px,
    read_registration,
    shares_light,
    unchecked_mm2,
    unchecked_share,
)
from levkas.pages.agreement import describe_agreement
from levkas.pages.budget import UncertaintyBudget, describe_budget
from levkas.pages.maps import draw_maps
from levkas.pages.page import (
    Figure,
    LayerReport,
    describe_flags,
    describe_model,
    embed_png,
    render_page,
)
from levkas.pages.radiometry import RadiometryRow, describe_layer
from levkas.pages.summary import describe_length, summarise_layers
from levkas.pages.tiles import draw_tiles
from levkas.quality.evaluation.camera_agreement import PairAgreement, agreement_in
from levkas.quality.image_quality.light import choose_places
from levkas.readers.frames import files_of
from levkas.registration.advice import LEAST_OUTSIDE, percent
from levkas.registration.record import decided
from levkas.stages.budget import budget_of
from levkas.stages.sources import libraries
from levkas.stages.spectra import weights_of_bands

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from levkas.building.build_records import BuildRecords, Key
    from levkas.building.graph import Step
    from levkas.building.outcomes import Outcomes
    from levkas.campaign.campaign import Campaign
    from levkas.database.layout import Places

    Budgets = Mapping[str, tuple[ErrorSource, ...]]
    Registrations = Mapping[str, dict[str, Any]]


RADIOMETRY = ("calibrate", "resample")
"""Stages that note noise, glare and focus."""
FRAME = "frame "
"""Begins what a fingerprint says of the use of a file as a frame."""
PROVENANCE = "provenance.json"
MADE_WITH = ("code", "instructions")
FILE = "file "
"""Begins the names of input files in a fingerprint."""


def write_report(
    outcomes: Outcomes, name: str, captures: list[Capture], steps: list[Step]
) -> list[Path]:
    """Write the page of an object, its museum facts and its provenance; return the files.

    What is known of layers of an earlier build stays. Raises WriteRefused.
    """
    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    why = {layer: text for layer, text in outcomes.earlier.items() if layer.object == name}
    captures = _as_layers_stand(campaign, places, captures, why)
    folder = places.folder(name)
    page, facts, made_of = (folder / n for n in ("report.html", "object.toml", PROVENANCE))
    described = campaign.objects.get(name)
    make_folder(folder)
    before = _steps_of(made_of, why)
    budgets = {c.layer: _budget_of(campaign, records, c) for c in captures}
    for layer, own in before.items():
        rows = (row for step in own for row in step.get("uncertainty", ()))
        budgets[layer] = tuple(map(ErrorSource.from_dict, rows))
    registered = _registrations(places, captures)
    compare = partial(_agreement, outcomes, captures, budgets, registered)
    draw = partial(_drawn, outcomes, captures, budgets, registered)
    # Layers are compared in compiled code, and drawn under the interpreter's lock.
    pairs, (layers, rows) = each(lambda make: make(), (compare, draw))
    first = registered.get(captures[0].layer)
    sampling = None if first is None else mm_per_px(first)
    words = {layer.name: text for layer, text in why.items()}
    layers = [replace(one, earlier=words.get(one.name, "")) for one in layers]
    html = report_of(campaign, places, captures, steps, layers, rows, sampling, pairs)
    with together():
        write_text(page, html)
        write_text(
            facts, to_toml({"name": name, **(described.museum_facts() if described else {})})
        )
        record = provenance_of(campaign, records, captures, budgets)
        new = [s for s in record["steps"] if layer_name(s["camera"], s["setup"]) not in before]
        record["steps"] = [*new, *(step for own in before.values() for step in own)]
        write_json(made_of, {**record, "agreement": [pair.to_dict() for pair in pairs]})
    return [page, facts, made_of]


def report_of(
    campaign: Campaign,
    places: Places,
    captures: list[Capture],
    steps: list[Step],
    layers: list[LayerReport],
    rows: list[RadiometryRow],
    sampling: float | None,
    pairs: Sequence[PairAgreement],
) -> str:
    """Return the HTML of an object's report; `pairs` are how its layers agree, `sampling` is in mm a pixel."""
    name = captures[0].object
    facts = campaign.objects.get(name)
    lines: list[str | None] = (
        [facts.creator, facts.date, facts.medium, facts.owner, facts.inventory] if facts else []
    )
    described = campaign.campaign
    lines += [described.title, described.date, facts.rights if facts else "", described.licence]
    own = {layer.name for layer in layers if layer.decision == "refuse"}  # in its own section
    refused = [s for s in steps if s.state == "refused" and s.key.layer not in own]
    reference = campaign.reference
    reported = {"", *(layer.name for layer in layers)}
    lost = [n for n in dict.fromkeys(step.key.layer for step in refused) if n not in reported]
    agreement = describe_agreement(pairs)
    return render_page(
        "report.html",
        page={
            "title": (facts.title if facts else "") or name,
            "facts": [text for text in dict.fromkeys(lines) if text],
            "reference": f"{reference.camera}:{reference.band}"
            if reference.band
            else f"the middle band of {reference.camera}",
            "layers": layers,
            "problems": [
                {"code": p.code, "text": written(campaign, p)} for s in refused for p in s.problems
            ],
            "mm_per_px": sampling and f"{sampling:.3f}",
            "footer": f"Levkas {__version__}. Object {name}; lengths are in pixels of the reference band "
            "unless stated otherwise.",
            "views": [{"name": one.name, "src": one.preview} for one in layers if one.preview],
            "radiometry": rows,
            "short": summarise_layers(
                *(layers, rows, sampling, lost),
                agreement=agreement.short if agreement else (),
            ),
            "agreement": agreement,
            "links": (("museum facts", "object.toml"), ("provenance", PROVENANCE)),
            "viewer": f"../../viewer/objects/{name}/index.html",
            "setups": close_ups(places, captures),
        },
    )


def _as_layers_stand(
    campaign: Campaign, places: Places, captures: Sequence[Capture], earlier: Iterable[LayerId]
) -> list[Capture]:
    """Return the captures of an object, the reference first; those of layers of earlier builds with the bands that these have."""
    found = {LayerId(c.object, c.camera, c.setup): c for c in captures}
    for one in earlier:
        bands = open_tiff(places.output / f"{one.path}.tif").bands
        sensors = (SensorFrames("", None, bands, "measure", ()),)
        found[one] = Capture(one.object, one.camera, one.setup, sensors)
    return sorted(found.values(), key=lambda capture: not is_reference(campaign, capture))


def _steps_of(path: Path, earlier: Iterable[LayerId]) -> dict[str, list[dict[str, Any]]]:
    """Return what a provenance has of some layers, by their names."""
    names, found = {layer.name for layer in earlier}, dict[str, list[dict[str, Any]]]()
    with suppress(Refused, KeyError):
        for step in read_json(path)["steps"] if names else ():
            found.setdefault(layer_name(step["camera"], step["setup"]), []).append(step)
    return {layer: steps for layer, steps in found.items() if layer in names}


def _registrations(places: Places, captures: Sequence[Capture]) -> Registrations:
    """Read the records of the layers of an object, by their names."""
    paths = {c.layer: places.registration(c.object, c.layer) for c in captures}
    return {layer: read_registration(path) for layer, path in paths.items() if path.is_file()}


def _drawn(
    outcomes: Outcomes, captures: Sequence[Capture], budgets: Budgets, registrations: Registrations
) -> tuple[list[LayerReport], list[RadiometryRow]]:
    """Return what the page says of each layer and of its radiometry, with plots and maps."""
    made = (
        _layer(outcomes, c, budgets[c.layer], registrations[c.layer])
        for c in captures
        if c.layer in registrations
    )
    noted = ([outcomes.records.notes(key_of(c, s)) for s in RADIOMETRY] for c in captures)
    rows = [describe_layer(c.layer, *both) for c, both in zip(captures, noted, strict=True)]
    return [one for one in made if one is not None], [row for row in rows if row is not None]


def _budget_of(
    campaign: Campaign, records: BuildRecords, capture: Capture
) -> tuple[ErrorSource, ...]:
    """Return the uncertainty budget of a capture; empty where it was not calibrated."""
    notes = records.notes(key_of(capture, "calibrate"))
    if "measured" not in notes:
        return ()
    strayed = stray_light_of(records, capture) if campaign.targets.charts else {}
    return budget_of(
        campaign, capture, notes["measured"], strayed, quantity=str(notes.get("quantity", ""))
    )


def _agreement(
    outcomes: Outcomes, captures: Sequence[Capture], budgets: Budgets, registrations: Registrations
) -> tuple[PairAgreement, ...]:
    """Compare all layers of an object that hold reflectance, those of the reference first."""
    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    order = sorted(captures, key=lambda c: (c.camera != campaign.reference.camera, c.setup))
    layers, known, weights = [], {}, {}
    for capture in order:
        notes = records.notes(key_of(capture, "calibrate"))
        layer = LayerId(capture.object, capture.camera, capture.setup)
        written = places.layer(capture.object, capture.camera, capture.setup).is_file()
        grids = [registrations.get(one, {}).get("grid") for one in (order[0].layer, capture.layer)]
        if not written or grids[0] != grids[1] or notes.get("quantity") != "reflectance":
            continue
        layers.append(layer)
        shared = records.notes(key_of(capture, "resample")).get("noise_correlation", [[1.0]])
        known[layer.name] = LayerBudget(budgets[capture.layer], np.array(shared))
        bands = [band for sensor in capture.sensors for band in sensor.bands]
        found = weights_of_bands(campaign, capture, bands)
        weights[layer.name] = {
            band.label: (one.wavelengths, one.weights)
            for band, one in zip(bands, found, strict=True)
            if one is not None
        }
    return agreement_in(places.output, layers, known, weights, registrations)


def _layer(
    outcomes: Outcomes, capture: Capture, budget: tuple[ErrorSource, ...], record: dict[str, Any]
) -> LayerReport | None:
    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    calibrated = records.notes(key_of(capture, "calibrate"))
    if not calibrated:
        return None
    registered, resampled = (
        records.notes(key_of(capture, "register")),
        records.notes(key_of(capture, "resample")),
    )
    verdict, errors = record["verdict"], record.get("errors", {})
    preview = places.layer(capture.object, capture.camera, capture.setup, kind=".png")
    shown = preview.is_file() and verdict["decision"] != "refuse"
    is_reference = capture.camera == campaign.reference.camera and not capture.setup
    ssim, ssim_map = resampled.get("ssim"), resampled.get("ssim_map", "")
    if not shares_light(record, [band.wavelength for band in capture.bands]):
        ssim, ssim_map = None, ""
    error, checked = _error(record)
    scale = mm_per_px(record)
    drawn = [Figure(svg, caption) for svg, caption in registered.get("figures", [])]
    removal = record.get("trace", {}).get("kind") == "removal"
    quantity = str(calibrated.get("quantity", ""))
    tiff = places.layer(capture.object, capture.camera, capture.setup)
    return LayerReport(
        name=capture.layer,
        bands=[band.label for band in capture.bands],
        quantity=quantity,
        decision="reference"
        if is_reference and verdict["decision"] == "accept"
        else verdict["decision"],
        decided=decided(verdict),
        method=record["method"],
        model=describe_model(record.get("model", {})),
        reasons=verdict["reasons"],
        next_step=verdict["next_step"],
        warnings=calibrated.get("warnings", []),
        lying=" ".join(describe_lying(record)),
        by_hand=describe_pairs(record),
        unchecked=unchecked_share(record),
        outside=unchecked_share(record, "outside"),
        unchecked_area=_area_within(record),
        error=_describe_error(error, checked, scale),
        error_px=error,
        checked=checked,
        checks=_check_points(errors),
        ssim="–" if ssim is None else f"{ssim:.3f}",
        flags=describe_flags(resampled.get("flags", {})) if shown else "–",
        preview=preview.name if shown else "",
        description=str(resampled.get("description", "")) or counted(len(capture.bands), "band"),
        figures=[*([] if removal else drawn), *draw_tiles(record, resampled.get("seams", ()))],
        history=drawn if removal else [],
        maps=draw_maps(record, tiff, quantity, resampled.get("sigma_map")) if shown else [],
        links=_links_of_layer(campaign, places, capture),
        recorded=registered.get("recorded", ""),
        ssim_map=f"data:image/png;base64,{ssim_map}" if ssim_map else "",
        budget=_describe_budget(capture, budget, resampled) if shown else None,
    )


def _describe_budget(
    capture: Capture, sources: tuple[ErrorSource, ...], resampled: Mapping[str, Any]
) -> UncertaintyBudget | None:
    """Return what the report says of the uncertainty of a layer's values, at its middling pixels."""
    ranges = [r for r in resampled.get("ranges", []) if r.get("snr") and r.get("noise")]
    noise = {r["band"]: float(r["noise"]) for r in ranges}
    levels = {r["band"]: float(r["snr"] * r["noise"]) for r in ranges}
    return describe_budget(sources, capture.bands, levels, noise)


def _area_within(record: Mapping[str, Any]) -> str:
    """Return the area that was not checked, of it what lies in the object's outline; "" where that or the sampling is unknown.

    Of 100 x 100 px at 2 px per mm, 2,500 mm², 15 % are 375 mm², of which all but a fifteenth lie outside.

    >>> from levkas.geometry.transforms import Affine
    >>> grid = {"size": [100, 100], "px_per_mm": 2.0, "transform": Affine.identity().to_dict()}
    >>> _area_within({"grid": grid, "verdict": {"unchecked": 0.15, "outside": 0.14}})
    '25 mm² of the object'
    """
    area, unchecked, outside = (
        unchecked_mm2(record),
        unchecked_share(record),
        unchecked_share(record, "outside"),
    )
    if area is None or not unchecked:
        return ""
    if outside < LEAST_OUTSIDE:
        return f"{area:,.0f} mm²"
    return f"{area * max(0.0, 1 - outside / unchecked):,.0f} mm² of the object"


def _error(record: dict[str, Any]) -> tuple[float | None, float | None]:
    """Return the error, px, on what was not fitted, the worst sensor's, and over which share of the layer.

    None of a layer that was refused: where it was measured is not where it is off.
    """
    verdict, errors = record["verdict"], record.get("errors", {})
    if verdict["decision"] == "refuse":
        return None, None
    sensors = [*(errors.get("sensors") or {}).values(), *(verdict.get("numbers") or {}).values()]
    found = [one.get("held_out_px") for one in sensors if isinstance(one, dict)]
    numbers = [value for value in found if isinstance(value, int | float)]
    return (max(numbers), 1 - unchecked_share(record)) if numbers else (None, None)


def _describe_error(error: float | None, checked: float | None, scale: float | None) -> str:
    over = "" if checked is None else f" over {percent(checked)}"
    return "–" if error is None else f"{describe_length(error, scale)}{over}"


def _links_of_layer(campaign: Campaign, places: Places, capture: Capture) -> list[tuple[str, str]]:
    """Return (words, address from the report) of the files of one layer, and its camera's page."""
    folder, layer = places.folder(capture.object), capture.layer
    kinds = {"layer, TIFF": ".tif", "flags": ".flags.tif", "sigma": ".sigma.tif", "preview": ".png"}
    paths = {
        words: places.layer(capture.object, capture.camera, capture.setup, kind=kind)
        for words, kind in kinds.items()
    }
    paths["registration"] = places.registration(capture.object, layer)
    paths["pairs"] = places.matches(capture.object, layer)
    links = [(w, p.relative_to(folder).as_posix()) for w, p in paths.items() if p.is_file()]
    if campaign.cameras[
        capture.camera
    ].traits.is_calibrated:  # nothing is calibrated: it has no page
        links.append(("report of the camera", f"../../cameras/{capture.camera}/report.html"))
    return links


def _check_points(errors: dict[str, Any]) -> str:
    """Report how far a person's check points are off; empty where there are none."""
    found = errors.get("check_points") or []
    numbers = [one["error"] for one in found if one["error"] is not None]
    if not numbers:
        return ""
    mean, most = sum(numbers) / len(numbers), max(numbers)
    return (
        f"{len(found)} check points, set by hand and not fitted: mean error {mean:.2f} "
        f"reference px, largest error {most:.2f} px."
    )


def close_ups(places: Places, captures: Sequence[Capture]) -> list[dict[str, Any]]:
    """Return close-ups of every camera that has several setups, as the paper's Figure 4."""
    from levkas.database.preview import encode_png

    groups = []
    for camera in dict.fromkeys(c.camera for c in captures):
        paths = {
            c.setup or "default setup": places.layer(c.object, camera, c.setup, kind=".png")
            for c in captures
            if c.camera == camera
        }
        shown = {setup: _read(path) for setup, path in paths.items() if path.is_file()}
        if len(shown) < 2 or len({picture.shape for picture in shown.values()}) > 1:
            continue
        side, corners = choose_places([*shown.values()])
        cut = {
            setup: [
                embed_png(encode_png(np.ascontiguousarray(picture[y : y + side, x : x + side])))
                for x, y in corners
            ]
            for setup, picture in shown.items()
        }
        names = [f"({x + side // 2}, {y + side // 2})" for x, y in corners]
        groups.append({"camera": camera, "places": names, "rows": cut})
    return groups


def _read(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def provenance_of(
    campaign: Campaign, records: BuildRecords, captures: Sequence[Capture], budgets: Budgets
) -> dict[str, Any]:
    """Return what the stages of an object were made of.

    Returns
    -------
    record : dict
        ``levkas`` and ``libraries``: versions. ``instructions``: as of `describe_instructions`, in
        the process that wrote this record. ``steps``: of every stage that has ended well, in order,
        ``camera``, ``setup``, ``stage``, ``code`` (hash of the sources that it rests on, and of the versions of the
        libraries that it uses), ``instructions`` (instruction sets of the libraries), ``parameters``, ``inputs`` and ``products`` (SHA-256 by relative path; of products not the Zarr
        chunks, which hold the same numbers as the TIFFs); of a calibration ``frames`` too: of every
        frame its role, what its name says, its exposure in s, and the SHA-256 of all its files; and of a camera
        whose white is a chart ``chart_white``: by which, and how good, sensor by sensor; and ``uncertainty``, the budget
        of the layer, as of `levkas.stages.budget.budget_of`.
    """
    steps = []
    for capture in captures:
        for key in (key_of(capture, stage) for stage in STAGES):
            if not (step := _step(records, key)):
                continue
            if key.stage == "calibrate":
                step["frames"] = _frames(campaign, capture, step["inputs"])
                step |= _white_of(records.notes(key).get("measured", {}))
                step["uncertainty"] = [row.to_dict() for row in budgets[capture.layer]]
            steps.append(step)
    return {
        "object": captures[0].object,
        "levkas": __version__,
        "libraries": libraries(),
        "instructions": describe_instructions(),
        "steps": steps,
    }


def _white_of(measured: Mapping[str, Any]) -> dict[str, Any]:
    """Return by which chart a calibration made reflectance, sensor by sensor; nothing where a white did."""
    found = {
        sensor: of_sensor[CHART_WHITE]
        for sensor, of_sensor in measured.items()
        if CHART_WHITE in of_sensor
    }
    return {CHART_WHITE: found} if found else {}


def _step(records: BuildRecords, key: Key) -> dict[str, Any]:
    prints, products = records.fingerprint(key), records.products(key)
    if not prints:
        return {}
    inputs = {k.removeprefix(FILE): v for k, v in prints.items() if k.startswith(FILE)}
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
        "instructions": records.notes(key).get("instructions", prints.get("instructions", "")),
        "parameters": parameters,
        "inputs": inputs,
        "products": {n: sha for n, sha in products.items() if not n.startswith("zarr/")},
        **{k: v for k, v in records.notes(key).items() if k == "noise_correlation"},
    }


def _frames(campaign: Campaign, capture: Capture, inputs: dict[str, str]) -> list[dict[str, Any]]:
    """Describe every frame of a capture that was read."""
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

"""The report page of an object from the records of its layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas import __version__
from levkas.building.build_records import key_of
from levkas.building.camera_pages import stray_light_of
from levkas.building.graph import is_reference
from levkas.building.inputs import written
from levkas.building.layer_verdicts import errors_of
from levkas.building.provenance import PROVENANCE, provenance_of, steps_of
from levkas.calibration.error_sources import ErrorSource
from levkas.campaign.discovery.captures import Capture, SensorFrames
from levkas.campaign.schema.toml import to_toml
from levkas.core.files import make_folder, together, write_json, write_text
from levkas.core.text import counted
from levkas.core.threads import each
from levkas.database.described import open_tiff
from levkas.database.layout import LayerId
from levkas.database.region_uncertainty import LayerBudget
from levkas.database.registrations import (
    describe_lying,
    describe_pairs,
    mm_per_px,
    read_registration,
    shares_light,
)
from levkas.pages.agreement import describe_agreement
from levkas.pages.budget import describe_budget
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
from levkas.registration.advice import LEAST_OUTSIDE, percent
from levkas.registration.record import decided
from levkas.stages.budget import budget_of
from levkas.stages.spectra import weights_of_bands

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.building.build_records import BuildRecords
    from levkas.building.graph import Step
    from levkas.building.outcomes import Outcomes
    from levkas.campaign.campaign import Campaign
    from levkas.database.layout import Places


@dataclass(frozen=True)
class _Object:
    """What the page of an object is made of: its captures, the reference first, and by layer the uncertainty budget and the registration.

    `earlier` says of which layers of an earlier build, and why.
    """

    campaign: Campaign
    places: Places
    records: BuildRecords
    captures: list[Capture]
    budgets: Mapping[str, tuple[ErrorSource, ...]]
    registered: Mapping[str, dict[str, Any]]
    earlier: Mapping[str, str]

    def notes(self, capture: Capture, stage: str) -> dict[str, Any]:
        return self.records.notes(key_of(capture, stage))

    def file(self, capture: Capture, kind: str = ".tif") -> Path:
        return self.places.layer(capture.object, capture.camera, capture.setup, kind=kind)


def write_report(
    outcomes: Outcomes, name: str, captures: list[Capture], steps: list[Step]
) -> list[Path]:
    """Write the page of an object, its museum facts and its provenance; return the files.

    What is known of layers of an earlier build stays. Raises WriteRefused.
    """
    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    earlier = {layer: why for layer, why in outcomes.earlier.items() if layer.object == name}
    folder = places.folder(name)
    page, facts, made_of = (folder / n for n in ("report.html", "object.toml", PROVENANCE))
    captures = _as_layers_stand(campaign, places, captures, earlier)
    make_folder(folder)
    before = steps_of(made_of, earlier)
    budgets = {c.layer: _budget_of(campaign, records, c) for c in captures}
    for layer, own in before.items():
        rows = (row for step in own for row in step.get("uncertainty", ()))
        budgets[layer] = tuple(map(ErrorSource.from_dict, rows))
    paths = {c.layer: places.registration(c.object, c.layer) for c in captures}
    registered = {n: read_registration(path) for n, path in paths.items() if path.is_file()}
    words = {layer.name: why for layer, why in earlier.items()}
    one = _Object(campaign, places, records, captures, budgets, registered, words)
    # Layers are compared in compiled code, and drawn under the interpreter's lock.
    pairs, (layers, rows) = each(lambda make: make(one), (_agreement, _drawn))
    described = campaign.objects.get(name)
    museum = described.museum_facts() if described else {}
    record = provenance_of(campaign, records, captures, budgets)
    new = [s for s in record["steps"] if LayerId(name, s["camera"], s["setup"]).name not in before]
    record["steps"] = [*new, *(step for own in before.values() for step in own)]
    html = _html(one, steps, layers, rows, pairs)
    with together():
        write_text(page, html)
        write_text(facts, to_toml({"name": name, **museum}))
        write_json(made_of, {**record, "agreement": [pair.to_dict() for pair in pairs]})
    return [page, facts, made_of]


def _as_layers_stand(
    campaign: Campaign, places: Places, captures: Sequence[Capture], earlier: Mapping[LayerId, str]
) -> list[Capture]:
    """Return the captures of an object, the reference first; those of layers of earlier builds with the bands that these have."""
    found = {LayerId(c.object, c.camera, c.setup): c for c in captures}
    for one in earlier:
        bands = open_tiff(places.output / f"{one.path}.tif").bands
        sensors = (SensorFrames("", None, bands, "measure", ()),)
        found[one] = Capture(one.object, one.camera, one.setup, sensors)
    return sorted(found.values(), key=lambda capture: not is_reference(campaign, capture))


def _budget_of(
    campaign: Campaign, records: BuildRecords, capture: Capture
) -> tuple[ErrorSource, ...]:
    """Return the uncertainty budget of a capture; empty where it was not calibrated."""
    notes = records.notes(key_of(capture, "calibrate"))
    if "measured" not in notes:
        return ()
    strayed = stray_light_of(records, capture) if campaign.targets.charts else {}
    quantity = str(notes.get("quantity", ""))
    return budget_of(campaign, capture, notes["measured"], strayed, quantity=quantity)


def _html(
    one: _Object,
    steps: list[Step],
    layers: list[LayerReport],
    rows: list[RadiometryRow],
    pairs: Sequence[PairAgreement],
) -> str:
    campaign, name = one.campaign, one.captures[0].object
    facts, described, reference = campaign.objects.get(name), campaign.campaign, campaign.reference
    museum = (
        (facts.creator, facts.date, facts.medium, facts.owner, facts.inventory) if facts else ()
    )
    rights = facts.rights if facts else ""
    lines = (*museum, described.title, described.date, rights, described.licence)
    own = {layer.name for layer in layers if layer.decision == "refuse"}  # in its own section
    refused = [s for s in steps if s.state == "refused" and s.key.layer not in own]
    reported = {"", *(layer.name for layer in layers)}
    lost = [n for n in dict.fromkeys(step.key.layer for step in refused) if n not in reported]
    first = one.registered.get(one.captures[0].layer)
    sampling = mm_per_px(first) if first else None
    agreement = describe_agreement(pairs)
    short = agreement.short if agreement else ()
    problems = [p for step in refused for p in step.problems]
    return render_page(
        "report.html",
        page={
            "title": (facts.title if facts else "") or name,
            "facts": [str(text) for text in dict.fromkeys(lines) if text],
            "reference": f"{reference.camera}:{reference.band}"
            if reference.band
            else f"the middle band of {reference.camera}",
            "layers": layers,
            "problems": [{"code": p.code, "text": written(campaign, p)} for p in problems],
            "mm_per_px": sampling and f"{sampling:.3f}",
            "footer": f"Levkas {__version__}. Object {name}; lengths are in pixels of the reference band "
            "unless stated otherwise.",
            "views": [{"name": one.name, "src": one.preview} for one in layers if one.preview],
            "radiometry": rows,
            "short": summarise_layers(layers, rows, sampling, lost, agreement=short),
            "agreement": agreement,
            "links": (("museum facts", "object.toml"), ("provenance", PROVENANCE)),
            "viewer": f"../../viewer/objects/{name}/index.html",
            "setups": _close_ups(one),
        },
    )


def _drawn(one: _Object) -> tuple[list[LayerReport], list[RadiometryRow]]:
    """Return what the page says of each layer and of its radiometry, with plots and maps."""
    layers = [
        _layer(one, capture, one.registered[capture.layer], calibrated)
        for capture in one.captures
        if capture.layer in one.registered and (calibrated := one.notes(capture, "calibrate"))
    ]
    noted = ((c.layer, one.notes(c, "calibrate"), one.notes(c, "resample")) for c in one.captures)
    return layers, [row for each in noted if (row := describe_layer(*each)) is not None]


def _agreement(one: _Object) -> tuple[PairAgreement, ...]:
    """Compare all layers of an object that hold reflectance, those of the reference first."""
    lead = one.campaign.reference.camera
    order = sorted(one.captures, key=lambda c: (c.camera != lead, c.setup))
    layers, known, weights = [], {}, {}
    for capture in order:
        layer = LayerId(capture.object, capture.camera, capture.setup)
        grids = [one.registered.get(c.layer, {}).get("grid") for c in (order[0], capture)]
        quantity = one.notes(capture, "calibrate").get("quantity")
        if not one.file(capture).is_file() or grids[0] != grids[1] or quantity != "reflectance":
            continue
        layers.append(layer)
        shared = one.notes(capture, "resample").get("noise_correlation", [[1.0]])
        known[layer.name] = LayerBudget(one.budgets[capture.layer], np.array(shared))
        bands = list(capture.bands)
        found = zip(bands, weights_of_bands(one.campaign, capture, bands), strict=True)
        weights[layer.name] = {
            b.label: (w.wavelengths, w.weights) for b, w in found if w is not None
        }
    return agreement_in(one.places.output, layers, known, weights, one.registered)


def _layer(
    one: _Object, capture: Capture, record: dict[str, Any], calibrated: Mapping[str, Any]
) -> LayerReport:
    registered, resampled = (one.notes(capture, stage) for stage in ("register", "resample"))
    verdict, tiff, preview = record["verdict"], one.file(capture), one.file(capture, ".png")
    refused = verdict["decision"] == "refuse"
    shown = preview.is_file() and not refused
    leads = is_reference(one.campaign, capture) and verdict["decision"] == "accept"
    alike = shares_light(record, [band.wavelength for band in capture.bands])
    ssim, ssim_map = (resampled.get(key) if alike else None for key in ("ssim", "ssim_map"))
    errors = errors_of(record)
    error, checked = errors["held_out_px"], errors["checked_share"]
    if refused:  # where it was measured is not where it is off
        error = checked = None
    over = "" if checked is None else f" over {percent(checked)}"
    drawn = [Figure(svg, caption) for svg, caption in registered.get("figures", [])]
    removal = record.get("trace", {}).get("kind") == "removal"
    quantity = str(calibrated.get("quantity", ""))
    ranges = [r for r in resampled.get("ranges", []) if r.get("snr") and r.get("noise")]
    noise = {r["band"]: float(r["noise"]) for r in ranges}
    levels = {r["band"]: float(r["snr"] * r["noise"]) for r in ranges}
    budget = one.budgets[capture.layer]
    return LayerReport(
        name=capture.layer,
        bands=[band.label for band in capture.bands],
        quantity=quantity,
        decision="reference" if leads else verdict["decision"],
        decided=decided(verdict),
        method=record["method"],
        model=describe_model(record.get("model", {})),
        reasons=verdict["reasons"],
        next_step=verdict["next_step"],
        warnings=calibrated.get("warnings", []),
        earlier=one.earlier.get(capture.layer, ""),
        lying=" ".join(describe_lying(record)),
        by_hand=describe_pairs(record),
        unchecked=errors["unchecked_share"],
        outside=errors["outside_share"],
        unchecked_area=_area_within(errors),
        error="–" if error is None else f"{describe_length(error, mm_per_px(record))}{over}",
        error_px=error,
        checked=checked,
        checks=_check_points(record.get("errors", {})),
        ssim="–" if ssim is None else f"{ssim:.3f}",
        flags=describe_flags(resampled.get("flags", {})) if shown else "–",
        preview=preview.name if shown else "",
        description=str(resampled.get("description", "")) or counted(len(capture.bands), "band"),
        figures=[*([] if removal else drawn), *draw_tiles(record, resampled.get("seams", ()))],
        history=drawn if removal else [],
        maps=draw_maps(record, tiff, quantity, resampled.get("sigma_map")) if shown else [],
        links=_links(one, capture),
        recorded=registered.get("recorded", ""),
        ssim_map=f"data:image/png;base64,{ssim_map}" if ssim_map else "",
        budget=describe_budget(budget, capture.bands, levels, noise) if shown else None,
    )


def _area_within(errors: Mapping[str, Any]) -> str:
    """Return the area that was not checked, of it what lies in the object's outline; "" where that or the sampling is unknown.

    Of 2,500 mm² 15 % are 375 mm², of which all but a fifteenth lie outside.

    >>> _area_within({"unchecked_mm2": 375.0, "unchecked_share": 0.15, "outside_share": 0.14})
    '25 mm² of the object'
    """
    area, unchecked, outside = (
        errors[key] for key in ("unchecked_mm2", "unchecked_share", "outside_share")
    )
    if area is None or not unchecked:
        return ""
    if outside < LEAST_OUTSIDE:
        return f"{area:,.0f} mm²"
    return f"{area * max(0.0, 1 - outside / unchecked):,.0f} mm² of the object"


def _links(one: _Object, capture: Capture) -> list[tuple[str, str]]:
    """Return (words, address from the report) of the files of one layer, and its camera's page."""
    kinds = {"layer, TIFF": ".tif", "flags": ".flags.tif", "sigma": ".sigma.tif", "preview": ".png"}
    paths = {words: one.file(capture, kind) for words, kind in kinds.items()}
    paths["registration"] = one.places.registration(capture.object, capture.layer)
    paths["pairs"] = one.places.matches(capture.object, capture.layer)
    folder = one.places.folder(capture.object)
    links = [(w, p.relative_to(folder).as_posix()) for w, p in paths.items() if p.is_file()]
    if one.campaign.cameras[capture.camera].traits.is_calibrated:  # others have no page
        links.append(("report of the camera", f"../../cameras/{capture.camera}/report.html"))
    return links


def _check_points(errors: Mapping[str, Any]) -> str:
    """Report how far a person's check points are off; empty where there are none."""
    found = errors.get("check_points") or []
    numbers = [one["error"] for one in found if one["error"] is not None]
    if not numbers:
        return ""
    return (
        f"{len(found)} check points, set by hand and not fitted: mean error {sum(numbers) / len(numbers):.2f} "
        f"reference px, largest error {max(numbers):.2f} px."
    )


def _close_ups(one: _Object) -> list[dict[str, Any]]:
    """Return close-ups of every camera that has several setups, as the paper's Figure 4."""
    from PIL import Image

    from levkas.database.preview import encode_png

    groups = []
    for camera in dict.fromkeys(c.camera for c in one.captures):
        mine = {c.setup or "default setup": one.file(c, ".png") for c in one.captures if c.camera == camera}  # fmt: skip
        there = {setup: path for setup, path in mine.items() if path.is_file()}
        if len(there) < 2:
            continue
        shown = {s: np.asarray(Image.open(path).convert("RGB")) for s, path in there.items()}
        if len({picture.shape for picture in shown.values()}) > 1:
            continue
        side, corners = choose_places([*shown.values()])
        rows = {
            setup: [
                embed_png(encode_png(np.ascontiguousarray(picture[y : y + side, x : x + side])))
                for x, y in corners
            ]
            for setup, picture in shown.items()
        }
        names = [f"({x + side // 2}, {y + side // 2})" for x, y in corners]
        groups.append({"camera": camera, "places": names, "rows": rows})
    return groups

"""The record, tiles, spectra and lattices of one object in the viewer."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.schema.toml import read_toml
from levkas.core.cube import Band
from levkas.core.flags import describe_marks
from levkas.core.problems import Refused
from levkas.core.text import counted
from levkas.database.catalogue import ESTIMATED
from levkas.database.described import channel_shapes, describe_pages
from levkas.database.layers import MADE
from levkas.database.layout import LayerId, layer_name
from levkas.database.pixel_frames import Frame
from levkas.database.region_uncertainty import OTHER_BUDGET, position_sigmas, read_budget
from levkas.database.registrations import describe_pairs, read_registration, unchecked_share
from levkas.database.spectral_tiff import WAVELENGTHS
from levkas.database.tiff_pages import open_pages
from levkas.pages.page import describe_decision
from levkas.publish.viewer.pages import address, worst
from levkas.publish.viewer.pictures import Source, analyses_of, pictures_of
from levkas.publish.viewer.pyramid import encode_jpeg, fit_within, write_pyramid
from levkas.publish.viewer.spectra import write_lattices, write_spectra
from levkas.registration.record import DECISIONS, decided

if TYPE_CHECKING:
    from levkas.database.tiff_pages import TiffPages
    from levkas.publish.viewer.pyramid import Write

THUMBNAIL_PX = {"card": 400, "layer": 96}
FACTS = {
    **{"creator": "Maker", "date": "Date", "medium": "Medium", "size_mm": "Size"},
    **{"owner": "Owner", "inventory": "Inventory", "rights": "Rights"},
}
"""Keys of object.toml, and what a page calls them."""
LEFT_OUT = "Left out: its registration was refused."
KINDS = {".tif": "spectral TIFF", ".flags.tif": "flags", ".sigma.tif": "sigma", ".png": "preview"}
UP = ("..", "..", "..")
LATTICE = 9
"""Places a side of the grid at which it is written how well places are known; between them it changes by a few parts in a hundred."""
NOISE = "noise of the pixels"


@dataclass
class Item:
    """An object of the database, with its layers and facts for the pages."""

    database: Path
    name: str
    layers: list[tuple[str, str]]
    reference: str = ""
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        """Folder of the object's files."""
        return self.database / "objects" / self.name

    @property
    def title(self) -> str:
        """Title, else the name."""
        return str(self.facts.get("title") or self.name)

    @property
    def subtitle(self) -> str:
        """Maker, date and medium in a line."""
        return ", ".join(str(self.facts[k]) for k in ("creator", "date", "medium") if _has(self, k))

    def registration(self, layer: str) -> dict[str, Any]:
        """Return a layer's registration record, {} where it has none."""
        path = self.folder / "registration" / f"{layer}.json"
        try:
            return read_registration(path)
        except Refused:
            return {}

    def tiff(self, camera: str, setup: str) -> Path:
        """Return the path of a layer's TIFF."""
        stem = LayerId(self.name, camera, setup).stem
        return self.folder / f"{stem}.tif"


def _has(item: Item, key: str) -> bool:
    return bool(item.facts.get(key))


def find_items(database: Path) -> list[Item]:
    """Return the objects of a database in order, each with its layers, the reference's first."""
    from levkas.database.catalogue import NAME, read_catalogue
    from levkas.database.pixel_frames import parse_frame

    found: dict[str, list[tuple[str, str]]] = {}
    if (database / NAME).is_file():
        for entry in read_catalogue(database):
            found.setdefault(entry.object, []).append((entry.camera, entry.setup))
    items = []
    for folder in sorted(p for p in (database / "objects").iterdir() if p.is_dir()):
        layers = found.get(folder.name, [])
        for record in sorted((folder / "registration").glob("*.json")):
            frame = parse_frame(record.stem)
            if (frame.camera, frame.setup) not in layers:
                layers.append((frame.camera, frame.setup))
        item = Item(database, folder.name, layers, facts=_read_facts(folder / "object.toml"))
        records = [item.registration(layer_name(*layer)) for layer in layers]
        named = (r.get("reference", {}).get("camera", "") for r in records if r)
        item.reference = next((camera for camera in named if camera), "")
        item.layers = sorted(layers, key=lambda layer: (layer != (item.reference, ""), layer))
        items.append(item)
    return items


def write_object(write: Write, item: Item) -> Iterator[dict[str, Any]]:
    """Write all that the page of one object shows, yielding a layer's record after each layer."""
    home = f"viewer/objects/{item.name}"
    for number, (camera, setup) in enumerate(item.layers):
        name = layer_name(camera, setup)
        record = item.registration(name)
        verdict = record.get("verdict", {})
        decision = str(verdict.get("decision", "accept"))
        # What to do about a layer that was left out is for those who build, not for readers.
        reasons = verdict.get("reasons", []) if decision != "refuse" else [LEFT_OUT]
        layer = {
            **{"id": str(number), "name": name, "camera": camera, "setup": setup},
            **{"decision": decision, "verdict": _say(item, camera, setup, record)},
            "unchecked": unchecked_share(record),
            "reasons": [str(reason) for reason in reasons],
            "by_hand": describe_pairs(record).capitalize(),
            **{"quantity": "", "rendering": "", "bands": [], "pictures": []},
            **{"thumbnail": "", "spectra": None, "lattice": None, "downloads": []},
            "reference_band": 0,
        }
        if item.tiff(camera, setup).is_file():
            layer |= _write_layer(write, item, home, str(number), (camera, setup), record)
        yield layer


def card_of(item: Item, layers: list[dict[str, Any]], thumbnail: Any) -> dict[str, Any]:
    """Return what the contact sheet shows of an object; `thumbnail` is (name, width, height) or None."""
    decision = worst([layer["decision"] for layer in layers])
    refused = sum(layer["decision"] == "refuse" for layer in layers)
    words = f"{refused} of {len(layers)} refused" if refused else DECISIONS[decision]
    bands = sum(len(layer["bands"]) for layer in layers)
    count = len(layers)
    source, width, height = thumbnail or ("", 0, 0)
    return {
        **{"title": item.title, "subtitle": item.subtitle, "decision": decision, "verdict": words},
        "href": address("viewer", "objects", item.name, "index.html"),
        "layers": f"{counted(count, 'layer')}, {counted(bands, 'band')}",
        "cameras": sorted({layer["camera"] for layer in layers}),
        **{"thumbnail": source, "width": width, "height": height},
    }


def write_thumbnail(write: Write, item: Item) -> tuple[str, int, int] | None:
    """Write the contact sheet's picture: of the first layer that has colour, else of the first."""
    tiffs = [t for layer in item.layers if (t := item.tiff(*layer)).is_file()]
    renders = ((open_pages(tiff).read_render(), tiff) for tiff in tiffs)
    image = next((render for render, _ in renders if render is not None), None)
    if image is None:
        return None
    small = fit_within(image, THUMBNAIL_PX["card"])
    write(f"viewer/objects/{item.name}/thumbnail.jpg", encode_jpeg(small))
    height, width = small.shape[:2]
    return address("viewer", "objects", item.name, "thumbnail.jpg"), width, height


def object_record(
    item: Item, layers: list[dict[str, Any]], links: dict[str, Any]
) -> dict[str, Any]:
    """Return what an object's page reads: plain JSON."""
    shown = next((p for layer in layers for p in layer["pictures"]), None)
    records = [item.registration(layer["name"]) for layer in layers]
    sampling = next((r["grid"].get("px_per_mm") for r in records if r.get("grid")), None)
    report = item.folder / "report.html"
    width, height = (shown["width"], shown["height"]) if shown else (0, 0)
    return {
        "object": {
            **{"name": item.name, "title": item.title, "subtitle": item.subtitle},
            "facts": _say_facts(item, width, height, sampling),
        },
        "grid": {
            **{"width": width, "height": height},
            "px_per_mm": sampling if sampling and math.isfinite(sampling) else None,
        },
        "reference": item.reference,
        "flags": describe_marks(),
        "layers": layers,
        "downloads": [
            {
                "label": path.name,
                "href": address(*UP, "objects", item.name, path.name),
                "bytes": path.stat().st_size,
            }
            for path in sorted(item.folder.glob("object.toml"))
        ],
        "links": {
            "sheet": "../../../index.html",
            "report": address(*UP, "objects", item.name, report.name) if report.is_file() else "",
            **links,
        },
    }


# --- one layer ----------------------------------------------------------------------------------


def _write_layer(
    write: Write,
    item: Item,
    home: str,
    number: str,
    layer: tuple[str, str],
    record: dict[str, Any],
) -> dict[str, Any]:
    tiff = item.tiff(*layer)
    pages = open_pages(tiff)
    described, centroids = describe_pages(pages), _centroids(pages)
    attrs, bands = described.facts, described.bands
    shapes = channel_shapes(item.database, layer[0], [band.label for band in bands])
    if not np.isfinite(centroids).any():
        centroids = [centroid for centroid, _ in shapes]
    reference = item.tiff(item.reference, "") if item.reference else tiff
    source = Source(
        *(item.database, item.name, tiff, bands, str(attrs.get("quantity", "")), record),
        rendering=str(attrs.get("rendering", "")),
        reference=reference if reference.is_file() else None,
    )
    pictures, thumbnail = [], ""
    for picture in pictures_of(source):
        folder = f"layers/{number}/{picture.key}"
        if not thumbnail:
            thumbnail = f"layers/{number}/thumbnail.jpg"
            small = fit_within(picture.image, THUMBNAIL_PX["layer"])
            write(f"{home}/{thumbnail}", encode_jpeg(small))
        pyramid = write_pyramid(
            write, f"{home}/{folder}", picture.image, key=folder, palette=picture.palette
        )
        pictures.append(
            {
                **{"key": picture.key, "label": picture.label, "kind": picture.kind},
                **{"note": picture.note, "white": picture.white},
                "legend": picture.legend.to_dict() if picture.legend else None,
                **{"folder": folder, **pyramid},
            }
        )
    key = f"{number}/spectra"
    spectra = write_spectra(write, f"{home}/layers/{number}/spectra", tiff, key=key)
    script = f"layers/{number}/native.js"
    lattice = write_lattices(
        *(write, f"{home}/{script}", item.database, item.name, Frame(*layer)),
        [band.label for band in bands],
        key=f"{number}/native",
    )
    return {
        **_say_made_of(attrs),
        "quantity": source.quantity,
        "rendering": source.rendering,
        "bands": [
            {
                "label": band.label,
                "wavelength": _known(band.wavelength),
                "centroid": _known(centroid),
                "fwhm": _known(width if math.isnan(band.fwhm) else band.fwhm),
            }
            for band, centroid, (_, width) in zip(bands, centroids, shapes, strict=True)
        ],
        "pictures": pictures,
        "thumbnail": thumbnail,
        "spectra": {**spectra, "folder": f"layers/{number}/spectra"},
        **_budget_of(item, layer, [band.label for band in bands], spectra),
        "lattice": {**lattice, "file": script} if lattice else None,
        "reference_band": _reference_band(record, bands),
        "downloads": _downloads(item, tiff),
    }


def _budget_of(
    item: Item, layer: tuple[str, str], labels: list[str], spectra: dict[str, Any]
) -> dict[str, Any]:
    """Return what a page needs for the uncertainty of a layer's values; {} where its errors are not recorded.

    ``rows`` have unit, size of each band, whether one draw holds for one line of a scan alone (``line``),
    and at which value of each band the error is nil (``zero``), where it is at one; parts of sigma, whether each pixel has its own
    (``pixel``). ``unknown`` names what is in no row, ``place`` has how well places are known.
    """
    try:
        budget = read_budget(item.database, LayerId(item.name, *layer))
    except Refused:  # a damaged file is refused by the crate, which is made of it too, by the name that its author gave
        return {"budget": {"rows": [], "unknown": [OTHER_BUDGET], "correlation": [[1.0]]}}
    if not budget.sources:
        return {}
    rows: list[dict[str, Any]] = []
    for source in budget.sources:
        of_pixel = source.common_to == "pixel"
        if (of_pixel and source.unit != "sigma") or source.unit == "px" or not source.size:
            continue
        row = {"unit": source.unit, "line": source.common_to == "line"}
        row |= {"pixel": True} if of_pixel else {}
        size, zero = (
            [float(f"{known.get(label, 0.0):.4g}") for label in labels]
            for known in (source.size, source.zero_at)
        )
        rows.append({**row, "size": size, **({"zero": zero} if any(zero) else {})})
    unknown = list(dict.fromkeys(s.name for s in budget.sources if s.basis == "unknown"))
    if not spectra["sigma"]:
        unknown.append(NOISE)
    made = {"rows": rows, "unknown": unknown, "correlation": budget.correlation.round(4).tolist()}
    return {"budget": {**made, **_places_of(item, layer, labels, spectra)}}


def _places_of(
    item: Item, layer: tuple[str, str], labels: list[str], spectra: dict[str, Any]
) -> dict[str, Any]:
    """Return how well the places of every band are known, on a lattice over the grid; {} where that is not known of any.

    Bands of one table share it; where a table does not reach, it has its nearest number.
    """
    sides = (max(1, spectra[side] - 1) for side in ("width", "height"))
    x, y = np.meshgrid(*(np.linspace(0.0, side, LATTICE) for side in sides))
    places = np.stack([x.ravel(), y.ravel()], 1)
    known = position_sigmas(item.database, LayerId(item.name, *layer), labels, places)
    tables: dict[tuple[float, ...], int] = {}
    of = []
    for sigma in known.T:
        there = np.isfinite(sigma)
        if not there.any() or not sigma[there].any():
            of.append(-1)
            continue
        apart = np.square(places[:, None] - places[there]).sum(2)
        near = sigma[there][apart.argmin(1)]
        table = tuple(float(f"{one:.3g}") for one in near)
        of.append(tables.setdefault(table, len(tables)))
    if not tables:
        return {}
    return {"place": {"columns": LATTICE, "rows": LATTICE, "tables": [*tables], "of": of}}


def _say_made_of(attrs: dict[str, Any]) -> dict[str, Any]:
    """Words for a layer that was made from others, in place of a verdict on its registration; nothing of one that was measured."""
    if attrs.get("kind") != ESTIMATED:
        return {}
    facts = attrs.get(MADE)
    facts = facts if isinstance(facts, dict) else {}
    sources, training = (", ".join(map(str, facts.get(key) or [])) for key in ("from", "training"))
    why = f"Estimated from {sources} by {facts.get('method')}, fitted on {training}: not a measurement."
    return {"decision": "warn", "verdict": "estimated", "reasons": [why]}


def _centroids(pages: TiffPages) -> list[float]:
    """Return the centroids that the tag of wavelengths holds, nm; NaN where it numbers the bands."""
    centres: Any = next((t for t in pages.tags(WAVELENGTHS) if t is not None), [])
    known = np.atleast_1d(np.asarray(centres, float)).tolist()
    count = len(pages)
    numbered = len(known) != count or known == list(range(count))
    return [math.nan] * count if numbered else known


def _reference_band(record: dict[str, Any], bands: tuple[Band, ...]) -> int:
    """Number of the camera's reference channel, whose native pixel a page shows; else the middle one."""
    label = record.get("target", {}).get("band")
    labels = [band.label for band in bands]
    return labels.index(label) if label in labels else len(labels) // 2


def _downloads(item: Item, tiff: Path) -> list[dict[str, Any]]:
    files = [(tiff.with_name(tiff.stem + suffix), words) for suffix, words in KINDS.items()]
    for record in analyses_of(tiff):
        files += [(record.with_suffix(".tif"), "computed"), (record, "how it was computed")]
    return [
        {
            "label": f"{path.name}, {words}",
            "href": address(*UP, "objects", item.name, *path.relative_to(tiff.parent).parts),
            "bytes": path.stat().st_size,
        }
        for path, words in files
        if path.is_file()
    ]


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _say(item: Item, camera: str, setup: str, record: dict[str, Any]) -> str:
    decision = decided(record.get("verdict") or {}) or "accept"
    if camera == item.reference and not setup and decision == "accept":
        return "reference"
    return describe_decision(decision, unchecked_share(record))


def _say_facts(item: Item, width: int, height: int, sampling: float | None) -> list[list[str]]:
    facts = [
        [words, _say_size(item.facts[key]) if key == "size_mm" else str(item.facts[key])]
        for key, words in FACTS.items()
        if _has(item, key)
    ]
    if width:
        facts.append(["Grid", f"{width} × {height} px"])
    if sampling and math.isfinite(sampling):
        facts.append(["Sampling", f"{sampling:.3g} px/mm"])
    if item.reference:
        facts.append(["Reference camera", item.reference])
    return facts


def _say_size(size: Any) -> str:
    try:
        return " × ".join(f"{float(side):g}" for side in size) + " mm"
    except (TypeError, ValueError):
        return str(size)


def _read_facts(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path)
    except Refused:
        return {}

"""OME-Zarr 0.6: a scene an object, of the native pixels of its cameras and the coordinate transformations that register them.

Axes are c, y, x; pixel centres at integers, as everywhere in Levkas. Specification: https://ngff.openmicroscopy.org/0.6/, transformations
of RFC-5.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.cube import Band
from levkas.core.files import before_writing, publishing
from levkas.core.problems import Problem
from levkas.database.catalogue import MEASURED
from levkas.database.described import describe_pages
from levkas.database.layout import layer_name
from levkas.database.pixel_frames import Frame, Records
from levkas.database.tiff_pages import TiffPages, open_pages
from levkas.geometry.transforms import Affine, Composed, Inverse, Transform
from levkas.publish.export.layer import ExportLayer, ExportRefused
from levkas.publish.export.ngff_fields import Field, FittedMap, Size, fit_map, lattice
from levkas.publish.viewer.pyramid import halve

VERSION = "0.6"
NATIVE, GRID, OBJECT = "native", "grid", "object"
"""Coordinate systems: px of an image, px of the published grid, mm on the object."""
FIELDS = "coordinateTransformations"
SIDE, SHARD_BYTES = 512, 64 << 20
"""Of a chunk, px; of a shard, whole rows of chunks of one band."""
CHANNEL = {"name": "c", "type": "channel", "discrete": True}
COLOURS = ("FF0000", "00FF00", "0000FF")


def write_ngff(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write nothing yet: `finish` writes a scene an object."""
    return []


def finish(layers: Sequence[ExportLayer], folder: Path) -> list[Path]:
    """Write OBJECT.ome.zarr for every object: native pixels not resampled, and where they lie on the grid.

    Bands that share a map are one image; layers that were made from others have no native pixels and are left out.

    Raises
    ------
    ExportRefused
        Where a frame and the grid have nothing in common.
    ComparisonRefused
        Where the database holds no native pixels, and its campaign was not given.
    MappingRefused
        Where a registration record is not there.
    """
    names = dict.fromkeys(layer.object for layer in layers)
    return [_write_scene(name, [x for x in layers if x.object == name], folder) for name in names]


@dataclass(frozen=True)
class _Image:
    """Bands of one native file that share one map."""

    path: str
    title: str
    pages: TiffPages
    picked: tuple[int, ...]
    bands: tuple[Band, ...]
    quantity: str
    fitted: FittedMap


def _write_scene(name: str, layers: Sequence[ExportLayer], folder: Path) -> Path:
    import zarr

    from levkas.database.store import folder_store

    database = layers[0].path.parents[2]
    records = Records(database, name)
    images = [i for layer in layers for i in _images(database, layer, records)]
    if not images:
        raise ExportRefused(
            Problem(
                "E_MISSING", f"{name} has no layer that was measured", str(database), "--camera"
            )
        )
    path = folder / f"{name}.ome.zarr"
    with publishing(path) as made:
        store = folder_store(made)
        root = zarr.create_group(store, zarr_format=3)
        for image in images:
            _write_image(root, image)
        for image in images:
            for way, field in _ways(image):
                _write_field(root, f"{FIELDS}/{image.path}-{way}", field)
        scene = _scene(images, layers[0].px_per_mm)
        root.attrs.put({"ome": {"version": VERSION, "scene": scene}})
    return path


def _images(database: Path, layer: ExportLayer, records: Records) -> Iterator[_Image]:
    if layer.facts.get("kind", MEASURED) != MEASURED:
        return
    stem = "_".join(filter(None, (layer.camera, layer.setup)))
    grid = records.pixels(Frame())
    tiles = records.tiles(Frame(layer.camera, layer.setup))
    for part, file in _native_files(database, layer).items():
        tile = next((t for t in tiles if f"{part}_".startswith(f"tile-{t}_")), "")
        if part.startswith("tile-") and not tile:  # it was left out of the layer
            continue
        pages = open_pages(file)
        described = describe_pages(pages)
        size = (float(pages.shape[1]), float(pages.shape[0]))
        maps: list[Composed] = []
        groups: dict[bytes, list[int]] = {}
        for index, band in enumerate(described.bands):
            frame = Frame(layer.camera, layer.setup, band.label, tile)
            maps.append(
                Composed(Inverse(grid.from_reference), records.pixels(frame).from_reference)
            )
            groups.setdefault(_positions(maps[-1], grid.size or size), []).append(index)
        name = "_".join(filter(None, (stem, part)))
        title = layer_name(layer.camera, layer.setup) + (f"#{tile}" if tile else "")
        for picked in groups.values():
            first = described.bands[picked[0]]
            whole = len(groups) == 1
            yield _Image(
                name if whole else f"{name}_band-{picked[0] + 1:03d}",
                title if whole else f"{title}:{first.label}",
                pages,
                tuple(picked),
                tuple(described.bands[i] for i in picked),
                described.quantity,
                _fitted(maps[picked[0]], grid.size or size, size, file),
            )


def _native_files(database: Path, layer: ExportLayer) -> dict[str, Path]:
    """Return the files with a layer's native pixels: the database's, else those calibrated anew where its campaign is known."""
    from levkas.building.run import calibrate_aside
    from levkas.campaign.campaign import load_campaign
    from levkas.campaign.discovery.find_captures import find_captures
    from levkas.database.layout import Places
    from levkas.quality.evaluation.native_layers import ComparisonRefused, native_files

    where = layer.object, layer.camera, layer.setup
    try:
        return native_files(database, *where)
    except ComparisonRefused:
        if layer.campaign is None:
            raise
    campaign, places = load_campaign(layer.campaign), Places(database)
    captures, _ = find_captures(campaign)
    capture = next((c for c in captures if (c.object, c.camera, c.setup) == where), None)
    if capture is None:
        return native_files(database, *where)
    if capture.tiles:  # they are kept in any case
        return native_files(database, *where, places.kept_native(layer.object, capture.layer))
    with before_writing(lambda _: None):  # beside the database, not into the folder of the export
        return native_files(database, *where, calibrate_aside(capture, campaign, places))


def _positions(to_native: Transform, size: Size) -> bytes:
    """Return where a lattice over the grid lies in an image, to 1e-6 px: maps are the same where these are."""
    places = to_native(lattice(size)).round(6) + 0.0
    return places.tobytes()


def _fitted(to_native: Transform, grid_size: Size, size: Size, file: Path) -> FittedMap:
    fitted = fit_map(to_native, grid_size, size)
    if fitted is None:
        raise ExportRefused(
            Problem(
                "E_VALUE",
                "this frame and the grid have nothing in common",
                str(file),
                fix="Leave the camera out: name the others by --camera.",
            )
        )
    return fitted


# --- metadata ---------------------------------------------------------------------------------


def _space(*first: dict[str, Any], unit: str | None = None) -> list[dict[str, Any]]:
    axes: list[dict[str, Any]] = [{"name": n, "type": "space", "discrete": False} for n in "yx"]
    return [*first, *({**axis, "unit": unit} if unit else axis for axis in axes)]


def _scene(images: Sequence[_Image], px_per_mm: float | None) -> dict[str, Any]:
    """Return the coordinate systems of a scene, and how its images lie in them: every path leads to the grid."""
    systems: list[dict[str, Any]] = [{"name": GRID, "axes": _space(CHANNEL)}]
    steps: list[dict[str, Any]] = [
        {
            "type": "byDimension",
            "name": f"{image.title} to {GRID}",
            "input": {"path": image.path, "name": NATIVE},
            "output": {"name": GRID},
            "transformations": [
                {"inputAxes": [0], "outputAxes": [0], "transformation": {"type": "identity"}},
                {
                    "inputAxes": [1, 2],
                    "outputAxes": [1, 2],
                    "transformation": _transformation(image),
                },
            ],
        }
        for image in images
    ]
    if px_per_mm:
        systems.append({"name": OBJECT, "axes": _space(CHANNEL, unit="millimeter")})
        steps.append(
            {
                "type": "scale",
                "name": f"{GRID} to {OBJECT}",
                "input": {"name": GRID},
                "output": {"name": OBJECT},
                "scale": [1.0, 1 / px_per_mm, 1 / px_per_mm],
            }
        )
    return {"coordinateSystems": systems, "coordinateTransformations": steps}


def _transformation(image: _Image) -> dict[str, Any]:
    """Return the way of (y, x) from an image to the grid, and back where a field does not tell it."""
    fitted = image.fitted
    back = _affine(Affine(_inverse_matrix(fitted.affine)))
    if fitted.onto_grid is None:
        return back
    fields = {
        way: {
            "type": "displacements",
            "path": f"{FIELDS}/{image.path}-{way}",
            "interpolation": "linear",
        }
        for way, _ in _ways(image)
    }
    return {
        "type": "bijection",
        "forward": {"type": "sequence", "transformations": [back, fields["onto-grid"]]},
        "inverse": {
            "type": "sequence",
            "transformations": [fields["onto-native"], _affine(fitted.affine)],
        },
    }


def _affine(affine: Affine) -> dict[str, Any]:
    """Return an affine map of (x, y) as one of (y, x)."""
    return {"type": "affine", "affine": affine.matrix[::-1][:, [1, 0, 2]].tolist()}


def _inverse_matrix(affine: Affine) -> np.ndarray:
    linear = np.linalg.inv(affine.matrix[:, :2])
    return np.column_stack([linear, -linear @ affine.matrix[:, 2]])


def _ways(image: _Image) -> Iterator[tuple[str, Field]]:
    for way, field in (
        ("onto-grid", image.fitted.onto_grid),
        ("onto-native", image.fitted.onto_native),
    ):
        if field is not None:
            yield way, field


def _multiscale(
    name: str, system: str, axes: Sequence[dict[str, Any]], levels: Sequence[tuple[Any, Any]]
) -> dict[str, Any]:
    """Return the metadata of an image: `levels` are (scale, shift) of y and x, of pixel centres."""
    datasets = [
        {
            "path": str(number),
            "coordinateTransformations": [
                {
                    "type": "sequence",
                    "input": {"path": str(number)},
                    "output": {"name": system},
                    "transformations": [
                        {"type": "scale", "scale": [1.0, *scale]},
                        {"type": "translation", "translation": [0.0, *shift]},
                    ],
                }
            ],
        }
        for number, (scale, shift) in enumerate(levels)
    ]
    one = {
        "name": name,
        "coordinateSystems": [{"name": system, "axes": list(axes)}],
        "datasets": datasets,
    }
    return {"version": VERSION, "multiscales": [one]}


def _channels(image: _Image, white: float) -> dict[str, Any]:
    """Return how viewers show the bands: in the colours of the published picture, or one in grey."""
    from levkas.colour.srgb import find_rendering

    shown = np.abs(find_rendering(image.bands).matrix).argmax(0).tolist()
    grey = len(set(shown)) < 3
    window = {"min": 0.0, "max": white, "start": 0.0, "end": white}
    channels = [
        {
            "label": band.label,
            "active": index in shown,
            "color": "FFFFFF" if grey or index not in shown else COLOURS[shown.index(index)],
            "window": window,
        }
        for index, band in enumerate(image.bands)
    ]
    return {"channels": channels}


# --- arrays -----------------------------------------------------------------------------------


def _write_image(root: Any, image: _Image) -> None:
    shapes = [image.pages.shape[:2]]
    while max(shapes[-1]) > SIDE:
        shapes.append((-(-shapes[-1][0] // 2), -(-shapes[-1][1] // 2)))
    group = root.create_group(image.path)
    dtype = np.dtype(np.float32)
    arrays = [_array(group, str(n), len(image.picked), s, dtype) for n, s in enumerate(shapes)]
    white = 0.0
    for number, index in enumerate(image.picked):
        plane = np.asarray(image.pages.read_page(index), dtype)
        for level, array in enumerate(arrays):
            plane = halve(plane) if level else plane
            array[number] = plane
        white = max(white, float(np.max(plane, initial=0.0, where=np.isfinite(plane))))
    levels = [((2.0**n,) * 2, ((2.0**n - 1) / 2,) * 2) for n in range(len(shapes))]
    ome = _multiscale(image.title, NATIVE, _space(CHANNEL), levels)
    ome["omero"] = _channels(image, 1.0 if image.quantity == "reflectance" else white or 1.0)
    group.attrs.put({"ome": ome, "levkas": {"quantity": image.quantity}})


def _write_field(root: Any, path: str, field: Field) -> None:
    rows, columns = field.vectors.shape[:2]
    group = root.create_group(path)
    array = _array(group, "0", 2, (rows, columns), np.dtype(np.float32))
    array[:] = np.moveaxis(field.vectors, -1, 0)[::-1]  # y first, as the axes
    axes = _space({"name": "c", "type": "displacement", "discrete": True})
    levels = [((field.step,) * 2, field.start[::-1])]
    ome = _multiscale(path.rpartition("/")[2], GRID, axes, levels)
    group.attrs.put({"ome": ome, "levkas": {"largest_error_px": field.largest_error_px}})


def _array(group: Any, name: str, depth: int, shape: tuple[int, int], dtype: np.dtype) -> Any:
    from levkas.database.store import codecs_of

    height, width = shape
    chunk = (1, min(SIDE, height), min(SIDE, width))
    across = -(-width // chunk[2])
    unit = dtype.itemsize * chunk[1] * chunk[2] * across
    down = min(-(-height // chunk[1]), max(1, SHARD_BYTES // unit))
    return group.create_array(
        name,
        shape=(depth, height, width),
        dtype=dtype,
        chunks=chunk,
        shards=(1, chunk[1] * down, chunk[2] * across),
        filters=[],
        compressors=codecs_of(dtype),
        fill_value=float("nan"),
        dimension_names=("c", "y", "x"),
        config={"write_empty_chunks": True},
    )

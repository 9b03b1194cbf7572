"""Editions of a publication: full size, and a medium one of at most 640 x 480 pixels.

Every layer is resampled as the build resamples: the kernel is widened to the coarser grid, so that
nothing aliases, sigma and flags go with the values, and the registration records lead to the new
grid. A layer that is no larger is copied.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import Cube
from levkas.core.digests import hash_file
from levkas.core.json_safe import to_json
from levkas.core.problems import Problem
from levkas.database.catalogue import Entry, read_catalogue, write_catalogue
from levkas.database.registrations import read_registration
from levkas.database.splits import NAME as SPLITS
from levkas.database.splits import split_objects
from levkas.database.store import write_index
from levkas.publish.publication import PublishRefused

if TYPE_CHECKING:
    from levkas.database.credits import Credits
    from levkas.geometry.transforms import Affine
    from levkas.publish.publication import Publication

LONGEST, SHORTEST = 640, 480
"""Px of the longer and of the shorter side, at most."""
GROUP_BYTES = 1 << 28
"""Of the planes that are read at a time."""
BESIDE = ("object.toml", "provenance.json")
SMALL = ("cameras/", "setups/", "database.toml")
REPORT = "report.html"


def write_medium(publication: Publication) -> Iterator[str]:
    """Write the medium edition, where it is wanted: a database of its own.

    Raises
    ------
    PublishRefused
        Where a file of the database is not what was built.
    """
    root = publication.roots.get("medium")
    if root is None:
        return
    entries = []
    for entry in read_catalogue(publication.source):
        yield f"{entry.object}/{entry.layer.name}"
        entries.append(_write_layer(publication, root, entry))
    yield "catalogue"
    write_catalogue(root, entries)
    sizes = {entry.object: (entry.width, entry.height) for entry in entries}
    for name, size in sizes.items():
        if (root / f"zarr/{name}.zarr").is_dir():
            write_index(root / f"zarr/{name}.zarr")
        _write_records(publication, root, name, size)
    for name in publication.manifest.files:
        parts = name.split("/")
        kept = parts[0] == "objects" and len(parts) == 3 and parts[2] in BESIDE
        if kept or (name.startswith(SMALL) and parts[-1] != REPORT):
            _copy(publication, root, name)


def seal_medium(publication: Publication) -> Iterator[str]:
    """Write the manifest of the medium edition, where it has a folder of its own."""
    from levkas.database.manifest import write_manifest

    if publication.editions == "both":
        yield "medium"
        start = f"{_place(publication, publication.roots['medium']).as_posix()}/"
        hashes = publication.hashes.items()
        known = {n.removeprefix(start): sha for n, sha in hashes if n.startswith(start)}
        write_manifest(publication.roots["medium"], known)


def fit_size(width: int, height: int) -> tuple[int, int]:
    """Return the size within 640 x 480, or 480 x 640 where it stands upright; never a larger one.

    Examples
    --------
    >>> fit_size(1392, 1040), fit_size(2000, 2400), fit_size(261, 347)
    ((640, 478), (480, 576), (261, 347))
    """
    scale = min(1.0, LONGEST / max(width, height), SHORTEST / min(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def map_of(size: tuple[int, int], full: tuple[int, int]) -> Affine:
    """Return the map from pixels of a smaller grid to those of the full one, (width, height) each."""
    from levkas.geometry.transforms import Affine

    steps = [f / s for f, s in zip(full, size, strict=True)]
    return Affine(np.array([[steps[0], 0, (steps[0] - 1) / 2], [0, steps[1], (steps[1] - 1) / 2]]))


def shrink(source: Path, size: tuple[int, int]) -> Cube:
    """Resample a layer of a database on to a smaller grid.

    Parameters
    ----------
    source : Path
        The layer's TIFF; flags and sigma lie beside it.
    size : (width, height)

    Returns
    -------
    cube : Cube
        Values of 16 significant bits, as the build writes them.
    """
    from levkas.core.rounding import round_root, round_values
    from levkas.database.described import open_tiff
    from levkas.database.tiff_pages import open_pages
    from levkas.geometry.resample import warp

    opened = open_tiff(source)
    pages = {
        kind: open_pages(path)
        for kind in ("", ".flags", ".sigma")
        if (path := source.with_name(f"{source.stem}{kind}.tif")).is_file()
    }
    height, width, count = pages[""].shape
    transform = map_of(size, (width, height))
    step = max(1, GROUP_BYTES // (9 * width * height))
    found: dict[str, list[np.ndarray]] = {"values": [], "flags": [], "sigma": []}
    for start in range(0, count, step):
        bands = list(range(start, min(start + step, count)))
        read = {kind: file.read(0, height, bands) for kind, file in pages.items()}
        variance = np.square(read[".sigma"]) if ".sigma" in read else None
        values = np.ascontiguousarray(read[""], np.float32)
        flags = read.get(".flags")
        warped = warp(values, transform, (size[1], size[0]), flags=flags, variance=variance)
        deep = (size[1], size[0], len(bands))
        found["values"].append(round_values(warped.values).reshape(deep))
        found["flags"].append(warped.flags.reshape(deep))
        if warped.variance is not None:
            found["sigma"].append(round_root(warped.variance).reshape(deep))
    joined = {kind: np.concatenate(parts, axis=2) for kind, parts in found.items() if parts}
    return Cube(
        joined["values"], joined["flags"], joined.get("sigma"), opened.bands, opened.quantity
    )


def _write_layer(publication: Publication, root: Path, entry: Entry) -> Entry:
    from levkas.database.layers import Layer, write_layer

    size = fit_size(entry.width, entry.height)
    source = publication.source / f"{entry.layer.path}.tif"
    _check(publication, source)
    if size == (entry.width, entry.height):
        group = f"{entry.layer.group}/"
        stem = entry.layer.path
        for name in publication.manifest.files:
            if name.startswith((f"{stem}.", group)):
                _copy(publication, root, name)
        if (publication.source / f"zarr/{entry.object}.zarr").is_dir():
            from levkas.database.store import write_root

            write_root(root / f"zarr/{entry.object}.zarr")
        return entry
    layer = Layer(
        entry.object,
        entry.camera,
        entry.setup,
        entry.px_per_mm * size[0] / entry.width,
        credits_of(source),
        centroids_of(source),
    )
    kind = publication.facts.cameras.get(entry.camera, {}).get("kind")
    written, _ = write_layer(
        root, layer, shrink(source, size), verdict=entry.verdict, encoded=kind == "image"
    )
    return replace(written, quantity=entry.quantity)


def centroids_of(path: Path) -> dict[str, float]:
    """Return the centroids that tag 65000 of a TIFF holds of channels without a centre wavelength, by label."""
    from levkas.database.described import describe_pages
    from levkas.database.spectral_tiff import WAVELENGTHS
    from levkas.database.tiff_pages import open_pages

    pages = open_pages(path)
    values = next((tag for tag in pages.tags(WAVELENGTHS) if tag is not None), ())
    centres, bands = np.atleast_1d(np.asarray(values, float)).tolist(), describe_pages(pages).bands
    if len(centres) != len(bands) or centres == list(range(len(bands))):
        return {}
    return {b.label: c for b, c in zip(bands, centres, strict=True) if math.isnan(b.wavelength)}


def credits_of(path: Path) -> Credits:
    """Return title, maker, date and rights from a TIFF's tags."""
    import tifffile

    from levkas.database.credits import Credits

    with tifffile.TiffFile(path) as tiff:
        tags: Any = tiff.pages[0].tags  # type: ignore[union-attr]
        found = {n: tags[n].value for n in ("Artist", "Copyright", "DateTime") if n in tags}
        title = str(tags["ImageDescription"].value) if "ImageDescription" in tags else ""
    day, _, hour = str(found.get("DateTime", "")).partition(" ")
    date = f"{day.replace(':', '-')}T{hour}" if day else ""
    return Credits(title, str(found.get("Artist", "")), date, str(found.get("Copyright", "")))


def _write_records(publication: Publication, root: Path, name: str, size: tuple[int, int]) -> None:
    """Registration records whose grid is the smaller one; the matches are of native pixels and stay."""
    from levkas.geometry import from_dict
    from levkas.geometry.transforms import Affine

    for path in sorted((publication.source / f"objects/{name}/registration").glob("*")):
        place = path.relative_to(publication.source).as_posix()
        if place not in publication.manifest.files:
            continue
        if path.suffix != ".json":
            _copy(publication, root, place)
            continue
        _check(publication, path)
        record = read_registration(path)
        grid = record.get("grid")
        if grid and tuple(grid["size"]) != size:
            smaller = map_of(size, tuple(grid["size"]))
            outer = from_dict(grid["transform"])
            points = outer(smaller(np.array([[0.0, 0], [1, 0], [0, 1]])))
            matrix = np.column_stack([points[1] - points[0], points[2] - points[0], points[0]])
            scale = size[0] / grid["size"][0]
            record["grid"] = {
                **grid,
                "size": list(size),
                "transform": Affine(matrix).to_dict(),
                "px_per_mm": grid["px_per_mm"] * scale if grid.get("px_per_mm") else None,
            }
        publication.write_text((_place(publication, root) / place).as_posix(), to_json(record))


def _copy(publication: Publication, root: Path, name: str) -> None:
    copied = publication.copy_file(
        publication.source / name, (_place(publication, root) / name).as_posix()
    )
    if copied != publication.manifest.files[name].sha256:
        raise PublishRefused(not_whole(publication.source / name, "it has changed since the build"))


def _check(publication: Publication, path: Path) -> None:
    """Refuse a file that is not what was built, and flags and sigma beside a layer."""
    for beside in (path, *(path.with_name(f"{path.stem}.{k}.tif") for k in ("flags", "sigma"))):
        name = beside.relative_to(publication.source).as_posix()
        listed = publication.manifest.files.get(name)
        if listed is not None and (not beside.is_file() or hash_file(beside) != listed.sha256):
            raise PublishRefused(not_whole(beside, "it has changed since the build"))


def _place(publication: Publication, root: Path) -> Path:
    return root.relative_to(publication.folder)


def write_content(publication: Publication) -> Iterator[str]:
    """Copy every file that the database's manifest lists, where the full edition is wanted.

    Raises
    ------
    PublishRefused
        Where files are missing or differ from the manifest: all of them, at most ten.
    """
    if publication.editions == "medium":
        return
    problems = []
    for name, listed in publication.manifest.files.items():
        yield name
        try:
            found = publication.copy_file(publication.source / name, name)
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            problems.append(not_whole(publication.source / name, "it is missing"))
            continue
        if found != listed.sha256:
            problems.append(not_whole(publication.source / name, "it has changed since the build"))
    if problems:
        raise PublishRefused(*problems[:10])


def not_whole(path: Path, why: str) -> Problem:
    """Return the problem of a file that cannot be published."""
    return Problem(
        "E_DAMAGED",
        f"{path.name} cannot be published: {why}",
        file=str(path),
        fix="Build the database again; `levkas validate` lists all damage.",
    )


def write_splits(publication: Publication) -> Iterator[str]:
    """Write splits.csv of every edition."""
    yield SPLITS
    names = dict.fromkeys(entry.object for entry in publication.entries())
    lines = "".join(f"{name},{split}\n" for name, split in split_objects(names).items())
    for root in publication.roots.values():
        place = root.relative_to(publication.folder)
        publication.write_text((place / SPLITS).as_posix(), "object,split\n" + lines)

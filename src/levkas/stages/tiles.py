"""A capture of tiles: each calibrated by itself, in files of its own, and joined on the grid in the one resampling."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil, sqrt
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np

from levkas.core.cube import UNRELIABLE, Cube, CubeRows, is_flagged
from levkas.core.problems import Problem
from levkas.core.rounding import round_root, round_values
from levkas.database.registrations import read_registration
from levkas.database.tiff_pages import TiffPages, open_pages
from levkas.geometry import from_dict
from levkas.geometry.joining import Box, Seams, TilePart, box_on_grid, depth_in_frame, join
from levkas.geometry.pixel_maps import PixelMap, lay
from levkas.geometry.resample import source_rows, warp
from levkas.geometry.transforms import Affine, Composed
from levkas.quality.image_quality.glare import setup_gains
from levkas.registration.bands import BandImage, share_of_most
from levkas.registration.record import RegistrationRefused
from levkas.stages.native_cubes import Native, part_name, read_native
from levkas.stages.shared_noise import neighbour_correlation, shared_noise

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.campaign.discovery.captures import Capture
    from levkas.core.cube import Band
    from levkas.database.layout import Places
    from levkas.geometry.transforms import Transform
    from levkas.stages.capture_statistics import DefaultLayer
    from levkas.stages.scans import Scan
    from levkas.stages.shared_noise import Mosaic

    CalibratedCapture: TypeAlias = "Native | Scan | TiledCapture"
    """One capture, calibrated and not resampled: held whole, calibrated whenever its lines are needed, or in tiles."""

BLOCK_SAMPLES = 6_000_000
"""Values of the grid that are joined at a time; with two tiles about each, and flags and sigma, 0.2 GB."""
MOST_ROWS = 128
MOST_SAMPLES = 100_000_000
"""Of the pictures of a mosaic as registration takes them, half a gigabyte; of a larger one there are fewer bands."""
THINNED_SAMPLES, THINNED = 100_000_000, 16
"""Of a layer of more values every sixteenth pixel a side makes its range and noise."""
COMPARED_BLOCKS = 12
"""Of rows, over the layer, in which two setups are compared."""


@dataclass(frozen=True)
class TilePlace:
    """Where a tile lies: reference px → native px of every band, and how well that is known, reference px."""

    maps: Mapping[str, Transform]
    sigma: float = 0.0


@dataclass(frozen=True)
class Placement:
    """Where the tiles of a capture lie in the frame of the reference, (width, height) `size`; those left out are not among them."""

    tiles: Mapping[str, TilePlace]
    size: tuple[int, int]

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Placement:
        """Read it from the registration record of a layer."""
        width, height = record["reference"]["size"]
        tiles = {
            name: TilePlace(
                {label: from_dict(band["transform"]) for label, band in one["bands"].items()},
                float(one.get("sigma_px") or 0.0),
            )
            for name, one in record["tiles"].items()
            if one.get("bands")
        }
        return cls(tiles, (int(width), int(height)))


@dataclass(eq=False)
class TiledCapture:
    """A capture of tiles.

    Its native px are those of the reference, in which tiles are placed; each tile has its own beneath.

    Parameters
    ----------
    capture : Capture
        With its tiles.
    folder : Path or None
        Of the tiles' files; None where the database holds them.
    mosaics : dict of str to Mosaic
        By sensor.
    developed : iterator of Native
        Its tiles as they are calibrated, one after another, in their order; taken once. Empty where they are in files.
    notes : dict
        As `stages.calibrate.write_calibrated` returned them; filled while tiles are calibrated.
    placement : Placement, optional
        Else that of the layer's registration record.
    seams : Seams or None
        What tiles differ by where they meet, of the rows that were joined.
    """

    capture: Capture
    places: Places
    folder: Path | None
    mosaics: Mapping[str, Mosaic]
    developed: Iterator[Native] = field(default_factory=lambda: iter(()))
    notes: dict[str, Any] = field(default_factory=dict)
    placement: Placement | None = None
    seams: Seams | None = None
    factor: ClassVar[int] = 1
    white: ClassVar[float | None] = None
    is_streamed: ClassVar[bool] = True

    @property
    def bands(self) -> tuple[Band, ...]:
        """All bands, sensor by sensor."""
        return self.capture.bands

    @property
    def quantity(self) -> str:
        """``"reflectance"`` where every tile has it, else ``"counts"``."""
        return str(self.notes.get("quantity", "counts"))

    @property
    def aligns(self) -> Mapping[str, object]:
        """Native px of the first sensor → each, as declared."""
        return {sensor.name: sensor.align for sensor in self.capture.sensors}

    @property
    def captured(self) -> str | None:
        """Date of the first frame that states one, ISO 8601."""
        return self.notes.get("captured") or None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Complete when all tiles have been calibrated."""
        return tuple(self.notes.get("warnings", ()))

    @property
    def measured(self) -> Mapping[str, dict[str, Any]]:
        """What was measured of each sensor and its light: in the first tile."""
        found: Mapping[str, dict[str, Any]] = self.notes.get("measured", {})
        return found

    @property
    def focus(self) -> list[dict[str, Any]]:
        """Blur of the sharpest edges, band by band: the median of the tiles."""
        found: list[dict[str, Any]] = self.notes.get("focus", [])
        return found

    @property
    def thinning(self) -> int:
        """Every so-many-th pixel a side of the layer makes its range and noise."""
        width, height = self.placed.size
        return THINNED if width * height * len(self.bands) > THINNED_SAMPLES else 1

    @property
    def placed(self) -> Placement:
        """Where the tiles lie, from the record of the registration where nothing else was said."""
        if self.placement is None:
            path = self.places.registration(self.capture.object, self.capture.layer)
            self.placement = Placement.of(read_registration(path))
        return self.placement

    def size_of(self, label: str) -> list[int]:
        """Return [width, height] of the frame that tiles are placed in."""
        return list(self.placed.size)

    def packed(self) -> TiledCapture:
        """Return the capture itself: its tiles are in files."""
        return self

    # --- calibrated tile by tile

    def sensors(self) -> Iterator[tuple[str, Cube | CubeRows]]:
        """Take the tiles as they are calibrated; yield the name of each part of a file, and its pixels."""
        warnings, focus = list(self.warnings), []
        quantities = set()
        for tile, native in zip(self.capture.tiles, self.developed, strict=True):
            for sensor, pixels in native.sensors():
                yield part_name(tile, sensor), pixels
                del pixels
            quantities.add(native.quantity)
            warnings += native.warnings
            focus.append(native.focus)
            self.notes.setdefault("measured", dict(native.measured))
            del native  # its memory goes before the next one is made
        quantity = "reflectance" if quantities == {"reflectance"} else "counts"
        kept = tuple(dict.fromkeys(warnings))
        self.notes |= {"quantity": quantity, "warnings": kept, "focus": _median_focus(focus)}

    def tile(self, name: str) -> Native:
        """Return a tile, held whole."""
        part = next(one for one in self.capture.tiles if one.tile == name)
        return read_native(part, self.places, self.notes, self.mosaics, self.folder)

    def size_of_tile(self, name: str, label: str) -> tuple[int, int]:
        """Return (width, height) of the frame in which a tile has a band."""
        sensor = next(s for s in self.capture.sensors if any(b.label == label for b in s.bands))
        height, width, _ = self.pages(name, sensor.name)[0].shape
        return width, height

    def pages(self, tile: str, sensor: str) -> tuple[TiffPages, TiffPages, TiffPages | None]:
        """Return the files of a tile: values, flags and, where it is known, sigma."""
        capture = self.capture
        part = part_name(replace(capture, tile=tile), sensor)
        where = capture.object, capture.camera, capture.setup, part
        paths = [
            self.places.native(*where, kind=f"{kind}.tif", folder=self.folder)
            for kind in ("", ".flags", ".sigma")
        ]
        sigma = open_pages(paths[2]) if paths[2].is_file() else None
        return open_pages(paths[0]), open_pages(paths[1]), sigma

    # --- joined

    @property
    def step(self) -> int:
        """Px of the mosaic in one of its overview, along a side: 1 where a band of it can be held whole."""
        return coarseness(*self.placed.size)

    def images(self, anchor: str = "", box: Box | None = None, step: int = 1) -> list[BandImage]:
        """Return the bands of the mosaic as registration takes them; of many px some of them, `anchor` among them.

        Raises RegistrationRefused, ``E_SIZE`` where even one band is more than `MOST_SAMPLES`.

        Parameters
        ----------
        box : (left, top, behind the right, behind the bottom), px of the mosaic, optional
            The part of it; default all.
        step : int
            Px of the mosaic in one of the picture's, along a side.
        """
        left, top, right, bottom = box or (0, 0, *self.placed.size)
        width, height = (right - left) // step, (bottom - top) // step
        labels = [band.label for band in self.bands]
        most = MOST_SAMPLES // (width * height)
        if not most:
            raise self._too_large()
        chosen = {*np.linspace(0, len(labels) - 1, min(most, len(labels))).round().astype(int)}
        if anchor and labels.index(anchor) not in chosen:
            first = labels.index(anchor)
            chosen = {*sorted(chosen, key=lambda n: abs(n - first))[1:], first}
        numbers = sorted(chosen)
        values = np.full((len(numbers), height, width), np.nan, np.float32)
        valid = np.zeros(values.shape, bool)
        onto = Affine.of_box(left, top, step)
        row = 0
        for cube in self.on_grid(dict.fromkeys(labels, onto), (width, height)).blocks:
            rows = slice(row, row + len(cube.values))
            row = rows.stop
            for place, number in enumerate(numbers):
                plane, flags = cube.values[..., number], cube.flags[..., number]
                values[place, rows] = plane
                valid[place, rows] = np.isfinite(plane) & ~is_flagged(flags, UNRELIABLE)
        images = []
        for place, number in enumerate(numbers):
            band, picture = self.bands[number], values[place]
            picture = share_of_most(picture) if self.quantity == "counts" else picture
            known = valid[place] & (not band.bad)
            images.append(BandImage(band.label, band.wavelength, picture, known))
        return images

    def _too_large(self) -> RegistrationRefused:
        width, height = self.placed.size
        return RegistrationRefused(
            Problem(
                "E_SIZE",
                "the mosaic of the reference camera is too large to register a single frame to it",
                field=f"cameras.{self.capture.camera}",
                found=f"{width} x {height} px",
                expected=f"at most {MOST_SAMPLES / 1e6:g} million px",
                fix="Declare the single frame as the only tile of its camera, by {tile} in its pattern, or bin the frames of the mosaic.",
            )
        )

    def joined(self) -> Iterator[tuple[str, CubeRows]]:
        """Yield the mosaic, all bands, in px of the reference; the name of its part is empty."""
        maps = dict.fromkeys([band.label for band in self.bands], Affine.identity())
        yield "", self.on_grid(maps, self.placed.size)

    def setup_gains(self, default: DefaultLayer, maps: Mapping[str, Transform]) -> np.ndarray:
        """Return the gains of this setup over the default one, by band, from some rows over the layer."""
        height, width, _ = default.values.shape
        joiner = _Joiner(self, maps, (width, height))
        blocks = joiner.blocks()
        chosen = np.unique(np.linspace(0, len(blocks) - 1, COMPARED_BLOCKS).round().astype(int))
        ours, theirs = [], []
        for number in chosen:
            start, stop = blocks[number]
            ours.append(joiner.rows(start, stop))
            theirs.append(default.rows(start, stop))
        values, flags = (np.concatenate([getattr(c, n) for c in ours]) for n in ("values", "flags"))
        return setup_gains(
            values, flags, *(np.concatenate(parts) for parts in zip(*theirs, strict=True))
        )

    def noise_correlation(self, maps: Mapping[str, Transform], size: tuple[int, int]) -> np.ndarray:
        """Return the correlation of the noise of neighbours on the grid, by the first sensor of the tile in the middle."""
        joiner = _Joiner(self, maps, size)
        middle = min(
            joiner.tiles,
            key=lambda t: abs(t.box[0] + t.box[2] - size[0]) + abs(t.box[1] + t.box[3] - size[1]),
        )
        sensor = self.capture.sensors[0].name
        own = [middle.maps[band.label] for band in self.capture.sensors[0].bands]
        x, y = (int(n) for n in middle.box[:2])
        corner = Affine(np.array([[1.0, 0, x], [0, 1, y]]))
        shape = (middle.box[3] - y, middle.box[2] - x)
        return neighbour_correlation(
            [Composed(corner, one) for one in own], shape, self.mosaics.get(sensor)
        )

    def on_grid(
        self,
        maps: Mapping[str, Transform],
        size: tuple[int, int],
        *,
        spool: Path | None = None,
    ) -> CubeRows:
        """Return the layer, joined as its rows are taken."""
        joiner = _Joiner(self, maps, size)
        self.seams = joiner.seams
        blocks = (joiner.rows(start, stop) for start, stop in joiner.blocks())
        shape = (size[1], size[0], len(self.bands))
        return CubeRows(blocks, shape, self.bands, self.quantity, joiner.has_sigma)


def coarseness(width: int, height: int) -> int:
    """Return how many px a side make one of a picture that can be held whole."""
    return ceil(sqrt(width * height / MOST_SAMPLES))


def _median_focus(found: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return the tile of the median blur for each band."""
    by_band: dict[str, list[Mapping[str, Any]]] = {}
    for one in found:
        for row in one:
            by_band.setdefault(str(row["band"]), []).append(row)
    chosen = []
    for rows in by_band.values():
        known = sorted((r for r in rows if r["blur_px"] is not None), key=lambda r: r["blur_px"])
        chosen.append(dict(known[len(known) // 2] if known else rows[0]))
    return chosen


@dataclass(frozen=True, eq=False)
class _LaidSensor:
    """A sensor of a tile on the grid: its files, its maps on the pixels of the tile's box, and the factor of its noise."""

    pages: tuple[TiffPages, TiffPages, TiffPages | None]
    pixel_map: PixelMap
    shared: np.ndarray | None


@dataclass(eq=False)
class _LaidTile:
    """A tile on the grid."""

    name: str
    box: Box
    size: tuple[int, int]
    maps: Mapping[str, Transform]
    sigma: float
    laid: list[_LaidSensor] = field(default_factory=list)


class _Joiner:
    """Joins tiles on a grid, block by block; the same blocks always, so that the bytes are the same."""

    def __init__(
        self,
        source: TiledCapture,
        maps: Mapping[str, Transform],
        size: tuple[int, int],
    ) -> None:
        self._source, self._size = source, size
        self.seams = Seams(tuple(band.label for band in source.bands))
        self.tiles: list[_LaidTile] = []
        tiles = source.placed.tiles
        for part in source.capture.tiles:
            if part.tile not in tiles:
                continue
            place, first = tiles[part.tile], source.bands[0].label
            own = {label: Composed(onto, place.maps[label]) for label, onto in maps.items()}
            height, width = source.pages(part.tile, source.capture.sensors[0].name)[0].shape[:2]
            box = box_on_grid(own[first], (width, height), size)
            if box is not None:
                tile = _LaidTile(part.tile, box, (width, height), own, place.sigma)
                self.tiles.append(tile)
        noisy = [
            source.pages(t.name, s.name)[2] for t in self.tiles for s in source.capture.sensors
        ]
        self.has_sigma = bool(noisy) and all(page is not None for page in noisy)

    def blocks(self) -> list[tuple[int, int]]:
        """Return the first row of every block, and the one behind its last."""
        width, height = self._size
        rows = int(np.clip(BLOCK_SAMPLES // (width * len(self._source.bands)), 4, MOST_ROWS))
        return [(top, min(top + rows, height)) for top in range(0, height, rows)]

    def rows(self, start: int, stop: int) -> Cube:
        """Return some rows of the layer."""
        shape = (stop - start, self._size[0], len(self._source.bands))
        parts = []
        for tile in self.tiles:
            if tile.box[1] < stop and tile.box[3] > start:
                parts.append(self._part(tile, start, stop))
            elif tile.box[3] <= start:
                tile.laid.clear()
        joined = join(parts, shape, self.seams)
        sigma = None
        if self.has_sigma:
            noise = joined.variance
            sigma = round_root(np.full(shape, np.nan, np.float32) if noise is None else noise)
        values = round_values(joined.values, sigma, out=joined.values)
        return Cube(values, joined.flags, sigma, self._source.bands, self._source.quantity)

    def _part(self, tile: _LaidTile, start: int, stop: int) -> TilePart:
        left, top, right, bottom = tile.box
        low, high = max(start, top), min(stop, bottom)
        if not tile.laid:
            tile.laid = [self._lay(tile, sensor.name) for sensor in self._source.capture.sensors]
        arrays = [self._warped(one, (low - top, high - top)) for one in tile.laid]
        values, flags = (np.concatenate([a[n] for a in arrays], axis=2) for n in (0, 1))
        variance = np.concatenate([a[2] for a in arrays], axis=2) if self.has_sigma else None
        first = tile.maps[self._source.bands[0].label]
        depth = depth_in_frame(first, tile.size, tile.box, (low, high))
        missing = (low - start, stop - high)
        if any(missing):
            wide = (missing, (0, 0), (0, 0))
            values = np.pad(values, wide, constant_values=np.nan)
            flags = np.pad(flags, wide)
            variance = None if variance is None else np.pad(variance, wide)
            depth = np.pad(depth, wide[:2], constant_values=-np.inf)
        return TilePart(tile.name, slice(left, right), values, flags, variance, depth, tile.sigma)

    def _lay(self, tile: _LaidTile, sensor: str) -> _LaidSensor:
        left, top, right, bottom = tile.box
        corner = Affine(np.array([[1.0, 0, left], [0, 1, top]]))
        bands = next(s.bands for s in self._source.capture.sensors if s.name == sensor)
        own: dict[int, Transform] = {}
        maps = [
            own.setdefault(id(m), Composed(corner, m)) for m in (tile.maps[b.label] for b in bands)
        ]
        shape = (bottom - top, right - left)
        mosaic, shared = self._source.mosaics.get(sensor), None
        if mosaic is not None:
            shared = shared_noise(mosaic, maps, shape)
        return _LaidSensor(self._source.pages(tile.name, sensor), lay(maps, shape), shared)

    def _warped(self, one: _LaidSensor, rows: tuple[int, int]) -> tuple[np.ndarray, ...]:
        values, flags, sigma = one.pages
        height = values.shape[0]
        low, high = source_rows(one.pixel_map, one.pixel_map.shape, rows, height)
        high = max(high, low + 1)
        variance = None
        if self.has_sigma and sigma is not None:
            variance = np.square(sigma.read(low, high))
            if one.shared is not None:
                variance *= one.shared
        warped = warp(
            values.read(low, high),
            one.pixel_map,
            one.pixel_map.shape,
            flags=flags.read(low, high),
            variance=variance,
            rows=rows,
            held=(low, height),
        )
        if warped.variance is None:
            return warped.values, warped.flags
        return warped.values, warped.flags, warped.variance

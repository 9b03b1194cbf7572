"""A calibrated capture as parts, whose native rows are taken when they are needed, and the one loop that puts them on a grid.

A part is what one sensor saw at once: a sensor of a camera, a tile of a painting, a strip of a scan. Its rows are held in memory, lie in
a file, or are calibrated whenever they are taken. Parts of one sensor are joined on the grid, where each pixel is interpolated once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from levkas.calibration.patterns import channel_table
from levkas.calibration.templates import CalibrationRefused
from levkas.core.cube import UNRELIABLE, Band, Cube, CubeRows, Flag, is_flagged
from levkas.core.files import spooling
from levkas.core.machine import tile_rows
from levkas.core.problems import Problem
from levkas.core.rounding import round_root, round_sigma, round_values
from levkas.geometry import from_dict
from levkas.geometry.joining import Box, Seams, TilePart, box_on_grid, depth_in_frame, join
from levkas.geometry.pixel_maps import PixelMap, lay
from levkas.geometry.resample import Warped, source_rows, warp
from levkas.geometry.transforms import Affine, Composed
from levkas.registration.bands import BandImage, Sites, share_of_most
from levkas.stages.shared_noise import Mosaic, neighbour_correlation, shared_noise

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.geometry.transforms import Transform

BUFFER_BYTES, ASKEW_BYTES = 300_000_000, 3_600_000_000
"""Of native rows and of grid rows, together, that are worked on at a time; and of a scan that lies askew."""
SAMPLE_BYTES = 9
"""Of a value with its flags and its sigma."""
MOST_ROWS, LEAST_ROWS, TURNED_ROWS = 256, 8, 32
"""Of the grid: whose maps are laid at once, at most and at least, and in a piece on the disk."""
SWAP = Affine(np.array([[0.0, 1, 0], [1, 0, 0]]))


class ScanRefused(CalibrationRefused):
    """A scan that lies so that it cannot be streamed."""


@dataclass(frozen=True, eq=False)
class Part:
    """Native pixels of one sensor, one tile, or one strip."""

    sensor: str
    bands: tuple[Band, ...]
    shape: tuple[int, int, int]
    """(height, width, bands)."""
    quantity: str
    has_sigma: bool
    read: Callable[[int, int, bool], Cube]
    """First row, the one behind the last, and whether sigma is wanted → these rows; what cannot be written to is kept for the next call."""
    name: str = ""
    """Of its tile or strip."""
    mosaic: Mosaic | None = None
    is_held: bool = True
    """Whether any number of rows may be read at once: in memory, or in a file."""

    @classmethod
    def held(
        cls, cube: Cube, sensor: str = "", *, name: str = "", mosaic: Mosaic | None = None
    ) -> Part:
        """Return a cube in memory; its sigma, which only resampling needs, in half of it."""
        sigma = None if cube.sigma is None else PackedSigma(cube.sigma)
        whole = replace(cube, sigma=None)

        def read(start: int, stop: int, noisy: bool) -> Cube:
            found = sigma.rows(start, stop) if sigma is not None and noisy else None
            return replace(_part(whole, np.s_[start:stop]), sigma=found)

        known = cube.sigma is not None
        return cls(sensor, cube.bands, cube.shape, cube.quantity, known, read, name, mosaic)

    def rows(self, start: int, stop: int, *, noisy: bool = True) -> Cube:
        """Return calibrated native rows `start` to `stop`."""
        return self.read(start, stop, noisy)

    def whole(self, *, noisy: bool = True) -> Cube:
        """Return all rows."""
        return self.read(0, self.shape[0], noisy)

    def by_blocks(self) -> CubeRows:
        """Return all rows, some at a time."""
        height, width, bands = self.shape
        step = tile_rows(max(1, BUFFER_BYTES // (4 * SAMPLE_BYTES * width * bands)), height)
        blocks = (self.rows(y, min(y + step, height)) for y in range(0, height, step))
        return CubeRows(blocks, self.shape, self.bands, self.quantity, self.has_sigma)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.shape[1], self.shape[0]


class PackedSigma:
    """Sigma of a cube in half of its memory: the lower half of a float32 has none of its 8 significant bits.

    Examples
    --------
    >>> sigma = np.float32([[[0.75, np.nan]]])
    >>> PackedSigma(sigma).rows(0, 1).tolist()
    [[[0.75, nan]]]
    """

    def __init__(self, sigma: np.ndarray) -> None:
        self._upper = _halves(np.ascontiguousarray(round_sigma(sigma), "<f4")).copy()

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Return rows of sigma, rounded as `round_sigma` does, float32, in memory of their own."""
        upper = self._upper[start:stop]
        sigma = np.zeros(upper.shape, "<f4")
        _halves(sigma)[...] = upper
        return sigma


def _halves(numbers: np.ndarray) -> np.ndarray:
    """Return the upper 16 bits of float32, in their memory."""
    return numbers.view("<u2")[..., 1::2]


@dataclass(frozen=True)
class PartPlace:
    """Where a part lies: native px of its capture → px of the part, band by band, and how well that is known, px."""

    maps: Mapping[str, Transform]
    sigma: float = 0.0


@dataclass(frozen=True)
class Placement:
    """Where the parts of a capture lie in its native frame of (width, height) `size`; those left out are not among them."""

    parts: Mapping[str, PartPlace]
    size: tuple[int, int]

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Placement:
        """Read that of tiles, in px of the reference, from the registration record of their layer."""
        width, height = record["reference"]["size"]
        tiles = {
            name: PartPlace(
                {label: from_dict(band["transform"]) for label, band in one["bands"].items()},
                float(one.get("sigma_px") or 0.0),
            )
            for name, one in record["tiles"].items()
            if one.get("bands")
        }
        return cls(tiles, (int(width), int(height)))


@dataclass(eq=False)
class CalibratedCapture:
    """One capture, calibrated and not resampled."""

    parts: Sequence[Part]
    aligns: Mapping[str, object] = field(default_factory=dict)
    """Native px of the first sensor → each, as declared: ``"measure"`` or a matrix."""
    captured: str | None = None
    """Date of the first frame that states one, ISO 8601."""
    warnings: tuple[str, ...] = ()
    measured: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    """Of each sensor and its light."""
    focus: list[dict[str, Any]] = field(default_factory=list)
    """Blur of the sharpest edges, band by band."""
    placement: Placement | None = None
    """Of several parts a sensor."""
    pictures: list[BandImage] | None = None
    """The bands, gathered while rows passed that are not held: a pixel is the mean of `factor` x `factor` px."""
    factor: int = 1
    survey: Callable[[CalibratedCapture], None] | None = None
    """Passes over all rows, and fills in warnings, focus and pictures."""
    coming: Iterator[CalibratedCapture] = field(default_factory=lambda: iter(()))
    """Tiles as they are calibrated, one after another, before they are written; taken once."""

    def complete(self) -> None:
        """Know what all rows have to pass for."""
        if self.survey is not None:
            survey, self.survey = self.survey, None
            survey(self)

    @property
    def by_sensor(self) -> dict[str, list[Part]]:
        """Its parts."""
        found: dict[str, list[Part]] = {}
        for part in self.parts:
            found.setdefault(part.sensor, []).append(part)
        return found

    @property
    def bands(self) -> tuple[Band, ...]:
        """All bands, sensor by sensor."""
        return tuple(band for parts in self.by_sensor.values() for band in parts[0].bands)

    @property
    def quantity(self) -> str:
        """``"reflectance"`` where every part has it, else ``"counts"``."""
        return "reflectance" if {p.quantity for p in self.parts} == {"reflectance"} else "counts"

    @property
    def is_held(self) -> bool:
        """Whether rows need not be calibrated when they are taken."""
        return all(part.is_held for part in self.parts)

    def size_of(self, label: str) -> tuple[int, int]:
        """Return (width, height) of the native frame that a band has."""
        if self.placement is not None:
            return self.placement.size
        return next(p.size for p in self.parts if any(b.label == label for b in p.bands))

    def tile(self, name: str) -> CalibratedCapture:
        """Return a tile by itself."""
        parts = [part for part in self.parts if part.name == name]
        return replace(self, parts=parts, placement=None)

    def sensor(self, name: str) -> Cube | CubeRows:
        """Return all native pixels of a sensor; its parts joined."""
        parts = self.by_sensor[name]
        if self.placement is None:
            (part,) = parts
            return part.whole() if part.is_held else part.by_blocks()
        maps = dict.fromkeys([band.label for band in parts[0].bands], Affine.identity())
        size = self.placement.size
        return on_grid(replace(self, parts=parts), maps, size).cube()

    @property
    def cubes(self) -> dict[str, Cube]:
        """All native pixels in memory, sensor by sensor."""
        return {name: gathered(self.sensor(name)) for name in self.by_sensor}

    def images(self) -> list[BandImage]:
        """Return every band as registration takes it; reflectance that is held in its memory."""
        self.complete()
        if self.pictures is not None:
            return self.pictures
        if self.placement is None:
            return [image for part in self.parts for image in _pictures(part)]
        return self.view(Affine.identity(), self.placement.size)

    def view(
        self, onto: Transform, size: tuple[int, int], labels: Sequence[str] | None = None
    ) -> list[BandImage]:
        """Return bands, by default all, on a grid of `onto`, its px → native px, and (width, height) `size`."""
        numbers = [n for n, b in enumerate(self.bands) if labels is None or b.label in labels]
        values = np.full((len(numbers), size[1], size[0]), np.nan, np.float32)
        valid, row = np.zeros(values.shape, bool), 0
        maps = dict.fromkeys([band.label for band in self.bands], onto)
        for cube in on_grid(self, maps, size, noisy=False).cube().blocks:
            rows = slice(row, row + len(cube.values))
            row = rows.stop
            for place, number in enumerate(numbers):
                values[place, rows] = cube.values[..., number]
                valid[place, rows] = _reliable(cube, number)
        shown = share_of_most if self.quantity == "counts" else np.asarray
        bands = [self.bands[number] for number in numbers]
        return [
            BandImage(band.label, band.wavelength, shown(picture), known)
            for band, picture, known in zip(bands, values, valid, strict=True)
        ]


def _reliable(cube: Cube, number: int) -> np.ndarray:
    """Return where a band of a cube can be relied on, (height, width): nowhere in a bad one."""
    sound = ~is_flagged(cube.flags[..., number], UNRELIABLE) & (not cube.bands[number].bad)
    return np.asarray(np.isfinite(cube.values[..., number]) & sound)


def gathered(rows: Cube | CubeRows) -> Cube:
    """Return rows as one cube."""
    return stacked(list(rows.blocks), axis=0)


def stacked(cubes: Sequence[Cube], axis: int) -> Cube:
    """Return cubes one below another (0), or beside one another (1); with sigma where all have it."""
    if len(cubes) == 1:
        return cubes[0]
    known = [cube.sigma for cube in cubes if cube.sigma is not None]
    return replace(
        cubes[0],
        values=np.concatenate([cube.values for cube in cubes], axis),
        flags=np.concatenate([cube.flags for cube in cubes], axis),
        sigma=np.concatenate(known, axis) if len(known) == len(cubes) else None,
    )


def median_focus(found: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return the part of the median blur for each band."""
    by_band: dict[str, list[Mapping[str, Any]]] = {}
    for one in found:
        for row in one:
            by_band.setdefault(str(row["band"]), []).append(row)
    chosen = []
    for rows in by_band.values():
        known = sorted((r for r in rows if r["blur_px"] is not None), key=lambda r: r["blur_px"])
        chosen.append(dict(known[len(known) // 2] if known else rows[0]))
    return chosen


def _pictures(part: Part) -> Iterator[BandImage]:
    """Yield the bands of a part."""
    cube, table = part.whole(noisy=False), None
    if part.mosaic is not None:
        table = channel_table(part.mosaic.pattern, part.mosaic.channels)
    shown = share_of_most if cube.quantity == "counts" else np.asarray
    for number, band in enumerate(cube.bands):
        sites = None if table is None else Sites.in_pattern(table, number)
        values, known = shown(cube.values[..., number]), _reliable(cube, number)
        yield BandImage(band.label, band.wavelength, values, known, part.sensor, sites)


# --- on a grid ------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Laid:
    """A part on the grid: the pixels that it may cover, and its maps, which are laid on `strip` rows of these at a time."""

    part: Part
    maps: list[Transform]
    box: Box
    sigma: float
    strip: int = 0
    shared: np.ndarray | None = None
    laid: dict[int, PixelMap] = field(default_factory=dict)

    def sections(self, start: int, stop: int) -> Iterator[tuple[int, PixelMap, tuple[int, int]]]:
        """Yield the strips that rows of the grid lie in: first row of the grid, maps, and the rows within them."""
        left, top, right, bottom = self.box
        strip = self.strip or bottom - top
        for first in range(start - (start - top) % strip, stop, strip):
            shape = (min(strip, bottom - first), right - left)
            if first not in self.laid:
                self.laid[first] = self.lay(first, shape)
            yield first, self.laid[first], (max(start, first) - first, min(stop - first, shape[0]))
        for passed in [one for one in self.laid if one < first]:
            del self.laid[passed]

    def lay(self, first: int, shape: tuple[int, int], bands: int | None = None) -> PixelMap:
        """Lay the maps, by default of all bands, on rows of the grid from `first` on."""
        return lay(self.moved(first, bands), shape)

    def moved(self, first: int, bands: int | None = None) -> list[Transform]:
        """Return the maps, of px of the box from row `first` of the grid on."""
        corner = Affine.of_box(self.box[0], first)
        moved: dict[int, Transform] = {}
        for one in self.maps[:bands]:
            moved.setdefault(id(one), Composed(corner, one) if any((self.box[0], first)) else one)
        return [moved[id(one)] for one in self.maps[:bands]]

    def warped(self, start: int, stop: int, *, noisy: bool) -> Warped:
        """Return rows of the grid, and the columns of the box; nothing where the part shows none of them."""
        height = self.part.shape[0]
        shape = (stop - start, self.box[2] - self.box[0], self.part.shape[2])
        sections = list(self.sections(start, stop))
        spans = [source_rows(one, one.shape, rows, height) for _, one, rows in sections]
        spans = [span for span in spans if span[0] < span[1]]
        if not spans:
            empty = np.full(shape, np.nan, np.float32)
            flags = np.full(shape, Flag.OUTSIDE, np.uint8)
            return Warped(empty, flags, empty.copy() if noisy else None)
        low, high = min(span[0] for span in spans), max(span[1] for span in spans)
        lines = self.part.rows(low, high, noisy=noisy)
        variance = None
        if noisy and lines.sigma is not None:
            own = lines.sigma.flags.writeable
            variance = np.square(lines.sigma, out=lines.sigma if own else None)
            if self.part.mosaic is not None:
                variance *= self._shared()
        found = Warped(
            np.empty(shape, np.float32),
            np.empty(shape, np.uint8),
            None if variance is None else np.empty(shape, np.float32),
        )
        for first, pixel_map, rows in sections:
            here = slice(first + rows[0] - start, first + rows[1] - start)
            noise = None if found.variance is None else found.variance[here]
            warp(
                lines.values,
                pixel_map,
                pixel_map.shape,
                flags=lines.flags,
                variance=variance,
                rows=rows,
                held=(low, height),
                out=Warped(found.values[here], found.flags[here], noise),
            )
        return found

    def part_on_rows(self, start: int, stop: int, *, noisy: bool) -> TilePart:
        """Return rows of the grid as they are joined; nothing in those beyond the box."""
        left, top, right, bottom = self.box
        low, high = max(start, top), min(stop, bottom)
        found = self.warped(low, high, noisy=noisy)
        values, flags, variance = found.values, found.flags, found.variance
        depth = depth_in_frame(self.maps[0], self.part.size, self.box, (low, high))
        missing = (low - start, stop - high)
        if any(missing):
            wide = (missing, (0, 0), (0, 0))
            values = np.pad(values, wide, constant_values=np.nan)
            flags = np.pad(flags, wide)
            variance = None if variance is None else np.pad(variance, wide)
            depth = np.pad(depth, wide[:2], constant_values=-np.inf)
        columns = slice(left, right)
        return TilePart(self.part.name, columns, values, flags, variance, depth, self.sigma)

    def samples(self, rows: int) -> int:
        """Return how many native values so many rows of the grid need, by the map of the first band."""
        left, top, right, bottom = self.box
        rows, (height, width, bands) = min(rows, bottom - top), self.part.shape
        spans = []
        for first in {top, (top + bottom - rows) // 2, bottom - rows}:
            shape = (rows, right - left)
            low, high = source_rows(self.lay(first, shape, 1), shape, (0, rows), height)
            spans.append(high - low)
        return max(spans) * width * bands

    def _shared(self) -> np.ndarray:
        if self.shared is None:
            left, top, right, bottom = self.box
            assert self.part.mosaic is not None
            self.shared = shared_noise(
                self.part.mosaic, self.moved(top), (bottom - top, right - left)
            )
        return self.shared


class GridRows:
    """Rows of a capture on a grid; orientation, crop, scale and registration are one map.

    Parameters
    ----------
    maps : mapping of label to Transform
        Grid px → native px.
    size : (width, height) of the grid
    noisy : bool
        Whether sigma is wanted. It is known, and values are rounded by it, where that of every part is.
    turned_in : path, optional
        Rows are columns of what is wanted, and turned by way of a file in this folder.
    """

    def __init__(
        self,
        native: CalibratedCapture,
        maps: Mapping[str, Transform],
        size: tuple[int, int],
        *,
        noisy: bool = True,
        turned_in: Path | None = None,
    ) -> None:
        self._native, self._size, self._turned_in = native, size, turned_in
        self.has_sigma = noisy and all(part.has_sigma for part in native.parts)
        self.seams: dict[str, Seams] = {}
        """What parts of a sensor differ by where they meet, of the rows that have passed."""
        self._laid = {name: self._lie(parts, maps) for name, parts in native.by_sensor.items()}
        self._step = size[1]
        if native.placement is not None:
            row = size[0] * len(native.bands) * SAMPLE_BYTES
            self._step = min(size[1], MOST_ROWS, max(LEAST_ROWS, BUFFER_BYTES // (6 * row)))

    def _lie(self, parts: Sequence[Part], maps: Mapping[str, Transform]) -> list[_Laid]:
        """Return the parts of a sensor that show something of the grid."""
        placement, (width, height) = self._native.placement, self._size
        labels = [band.label for band in parts[0].bands]
        if placement is None:
            (part,) = parts
            return [_Laid(part, [maps[label] for label in labels], (0, 0, width, height), 0.0)]
        self.seams[parts[0].sensor] = Seams(tuple(labels))
        lying = []
        for part in parts:
            if part.name not in placement.parts:
                continue
            place = placement.parts[part.name]
            own: dict[tuple[int, int], Transform] = {}
            pairs = [(maps[label], place.maps[label]) for label in labels]
            composed = [own.setdefault((id(a), id(b)), Composed(a, b)) for a, b in pairs]
            box = box_on_grid(composed[0], part.size, self._size)
            if box is not None:
                lying.append(_Laid(part, composed, box, place.sigma))
        return lying

    def fit(self, most: int) -> bool:
        """Take as many rows at a time as need no more than `most` bytes, native rows among them; return whether some do."""
        (width, height), bands = self._size, len(self._native.bands)
        laid = [one for some in self._laid.values() for one in some]
        rows = min(MOST_ROWS, height)
        while sum(one.samples(rows) for one in laid) + rows * width * bands > most // SAMPLE_BYTES:
            if rows <= LEAST_ROWS:
                return False
            rows = ceil(rows / 2)
        for one in laid:
            one.strip = rows
        self._step = tile_rows(rows, height)
        return True

    def blocks(self) -> list[tuple[int, int]]:
        """Return the first row of every block, and the one behind its last."""
        height = self._size[1]
        return [(top, min(top + self._step, height)) for top in range(0, height, self._step)]

    def cube(self) -> Cube | CubeRows:
        """Return all rows: now where they are one block, else as they are taken."""
        (width, height), native, blocks = self._size, self._native, self.blocks()
        if len(blocks) == 1 and self._turned_in is None:
            return self.rows(*blocks[0])
        rows: Iterator[Cube] = (self.rows(*block) for block in blocks)
        shape = (height, width)
        if self._turned_in is not None:
            rows, shape = _turned(rows, width, self._turned_in), (width, height)
        size = (*shape, len(native.bands))
        return CubeRows(rows, size, native.bands, native.quantity, self.has_sigma)

    def rows(self, start: int, stop: int) -> Cube:
        """Return some rows of the grid."""
        native = self._native
        found = [self._joined(name, laid, start, stop) for name, laid in self._laid.items()]
        values, flags = _beside([one[0] for one in found]), _beside([one[1] for one in found])
        sigma = None
        if self.has_sigma:
            sigma = _beside([one[2] for one in found if one[2] is not None])
            sigma = round_root(sigma, out=sigma)
        return Cube(
            round_values(values, sigma, out=values), flags, sigma, native.bands, native.quantity
        )

    def _joined(
        self, sensor: str, laid: Sequence[_Laid], start: int, stop: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return values, flags and variance of a sensor; its parts are joined."""
        if self._native.placement is None:
            whole = laid[0].warped(start, stop, noisy=self.has_sigma)
            return whole.values, whole.flags, whole.variance
        parts = []
        for one in laid:
            if one.box[1] < stop and one.box[3] > start:
                parts.append(one.part_on_rows(start, stop, noisy=self.has_sigma))
            elif one.box[3] <= start:
                one.laid.clear()
        bands = len(self._native.by_sensor[sensor][0].bands)
        shape = (stop - start, self._size[0], bands)
        joined = join(parts, shape, self.seams[sensor])
        variance = joined.variance
        if self.has_sigma and variance is None:
            variance = np.full(shape, np.nan, np.float32)
        return joined.values, joined.flags, variance


def on_grid(
    native: CalibratedCapture,
    maps: Mapping[str, Transform],
    size: tuple[int, int],
    *,
    noisy: bool = True,
    spool: Path | None = None,
) -> GridRows:
    """Return the rows of a capture on a grid; columns, by way of a file in `spool`, of a scan that lies on its side.

    The strips that maps are laid on follow from sizes and maps alone, never from the machine: so the values are
    the same for any number of rows that are worked on at a time ($LEVKAS_TILE).

    Raises ScanRefused, ``E_SIZE``, where a few rows, or columns, of the grid need more lines than may be held.
    """
    upright = GridRows(native, maps, size, noisy=noisy)
    if native.is_held or upright.fit(BUFFER_BYTES):
        return upright
    same = {id(one): Composed(SWAP, one) for one in maps.values()}
    swapped = {label: same[id(one)] for label, one in maps.items()}
    if spool is not None:
        across = GridRows(native, swapped, size[::-1], noisy=noisy, turned_in=spool)
        if across.fit(BUFFER_BYTES):
            return across
    if upright.fit(ASKEW_BYTES):
        return upright
    raise ScanRefused(
        Problem(
            "E_SIZE",
            "the scan is tilted relative to the grid: some rows or columns of the grid need too many of its lines",
            field="grid.rotate",
            fix="Rotate the grid so that the lines of the scan follow its rows or columns.",
        )
    )


def noise_correlation(
    native: CalibratedCapture, maps: Mapping[str, Transform], size: tuple[int, int]
) -> np.ndarray:
    """Return the correlation of the noise of neighbours on the grid, by the part of the first sensor that lies in the middle."""
    laid = next(iter(GridRows(native, maps, size)._laid.values()))
    middle = min(
        laid,
        key=lambda one: (
            abs(one.box[0] + one.box[2] - size[0]) + abs(one.box[1] + one.box[3] - size[1])
        ),
    )
    left, top, right, bottom = middle.box
    return neighbour_correlation(
        middle.moved(top), (bottom - top, right - left), middle.part.mosaic
    )


def _beside(arrays: Sequence[np.ndarray]) -> np.ndarray:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays, axis=2)


def _turned(columns: Iterator[Cube], height: int, spool: Path) -> Iterator[Cube]:
    """Put columns, `height` px long, on the disk in pieces, and yield rows."""
    step = tile_rows(TURNED_ROWS, height)
    tops = range(0, height, step)
    with spooling(spool, "turned.spool") as handle:
        pieces: list[tuple[Cube, list[int]]] = []
        for block in columns:
            starts = []
            for top in tops:
                starts.append(handle.tell())
                for array in _arrays(block):
                    part = array[:, top : top + step].transpose(1, 0, 2)
                    handle.write(np.ascontiguousarray(part).data)
            pieces.append((_part(block, np.s_[:, :0]), starts))
            del block
        for number, top in enumerate(tops):
            rows = min(step, height - top)
            yield stacked([_read_piece(handle, one, at[number], rows) for one, at in pieces], 1)


def _part(cube: Cube, part: Any) -> Cube:
    """Return a part of a cube, in its memory."""
    sigma = None if cube.sigma is None else cube.sigma[part]
    return replace(cube, values=cube.values[part], flags=cube.flags[part], sigma=sigma)


def _arrays(cube: Cube) -> list[np.ndarray]:
    return [a for a in (cube.values, cube.flags, cube.sigma) if a is not None]


def _read_piece(handle: BinaryIO, like: Cube, start: int, rows: int) -> Cube:
    """Read rows of a piece of columns from the disk, of which `like` is an empty part."""
    handle.seek(start)
    shape = (rows, like.values.shape[0], like.values.shape[2])
    found = []
    for array in _arrays(like):
        data = handle.read(int(np.prod(shape)) * array.itemsize)
        found.append(np.frombuffer(data, array.dtype).reshape(shape))
    values, flags, *sigma = found
    return replace(like, values=values, flags=flags, sigma=sigma[0] if sigma else None)

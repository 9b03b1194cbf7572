"""What a build notes of layers on their way to their files: flags, glare, ranges, sigma, focus."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import Cube, CubeRows, Flag, is_flagged

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from levkas.core.cube import Band
    from levkas.database.tiff_pages import TiffPages


def flag_and_count(
    cube: Cube,
    other: tuple[np.ndarray, np.ndarray] | None = None,
    gains: np.ndarray | None = None,
) -> dict[str, int]:
    """Set GLARE and VEILED in the flags of reflectance; return pixels by sign.

    `other` are values and flags of the same pixels of the same camera under its default setup. Pixels are
    judged one by one: rows give what the whole layer gives, for the same `gains` of the setups.
    """
    from levkas.quality.image_quality.glare import find_glare, flag_glare

    if cube.quantity != "reflectance":
        return {}
    glare = find_glare(cube.values, cube.flags, cube.sigma, other=other, gains=gains)
    flag_glare(cube.flags, glare)
    return glare.counts()


def count_flags(flags: np.ndarray) -> np.ndarray:
    """Return how often each of the 256 codes occurs."""
    counts = np.zeros(256, np.int64)
    for row in flags:  # bincount turns what it counts into 64-bit numbers
        counts += np.bincount(row.reshape(-1), minlength=256)
    return counts


def describe_flags(counts: np.ndarray) -> dict[str, float]:
    """Return the share of pixels and bands under each flag, by its name, from `count_flags`."""
    codes = np.arange(256)
    total = max(int(counts.sum()), 1)
    return {
        flag.name.lower(): float(counts[(codes & flag.value) != 0].sum() / total)
        for flag in Flag
        if flag.name
    }


@dataclass(frozen=True)
class DefaultLayer:
    """A published layer on the same grid, read some rows at a time."""

    values: TiffPages
    flags: TiffPages

    @classmethod
    def open(cls, values: Path, flags: Path, shape: tuple[int, int, int]) -> DefaultLayer | None:
        """Open a layer's files; None where there is none of that (height, width, bands)."""
        from levkas.database.tiff_pages import open_pages

        if not (values.is_file() and flags.is_file()):
            return None
        layer = cls(open_pages(values), open_pages(flags))
        return layer if layer.values.shape == layer.flags.shape == shape else None

    def rows(self, start: int = 0, stop: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return values and flags of some rows, (rows, width, bands)."""
        return self.values.read(start, stop), self.flags.read(start, stop)


@dataclass
class LayerStatistics:
    """What is noted of a layer's rows on their way to its files: grey, where all was observed, flags, glare, ranges.

    `default` is the same camera under its default setup, with the `gains` of both, by band; None where they are found in the rows, which
    are then all in one block. Every `step`-th pixel a side is kept in mind for range and noise.
    """

    default: DefaultLayer | None = None
    gains: np.ndarray | None = None
    step: int = 1
    mean: list[np.ndarray] = field(default_factory=list)
    valid: list[np.ndarray] = field(default_factory=list)
    flags: np.ndarray = field(default_factory=lambda: np.zeros(256, np.int64))
    glare: dict[str, int] = field(default_factory=dict)
    thin: list[Cube] = field(default_factory=list)
    sigma: list[np.ndarray] = field(default_factory=list)
    _rows: int = 0

    def flagged(self, rows: Cube | CubeRows) -> CubeRows:
        """Return the rows as they are taken, with glare flagged and noted."""
        blocks = self._flagged(rows.blocks, rows.shape[:2])
        return CubeRows(blocks, rows.shape, rows.bands, rows.quantity, rows.has_sigma)

    def _flagged(self, blocks: Iterable[Cube], shape: tuple[int, int]) -> Iterator[Cube]:
        from levkas.database.grey import grey_of, grey_step

        step = grey_step(*shape)
        apart = -(-max(shape) // LONGEST_SIGMA)

        for cube in blocks:
            first, self._rows = self._rows, self._rows + len(cube.values)
            other = self.default.rows(first, self._rows) if self.default else None
            mean, valid = grey_of(cube.values, cube.flags, first, step)
            counts = flag_and_count(cube, other, self.gains)
            for name, count in {"inside": int(np.count_nonzero(valid)), **counts}.items():
                self.glare[name] = self.glare.get(name, 0) + count
            self.thin.append(self._thinned(cube, first))
            self.mean.append(mean)
            self.valid.append(valid)
            self.flags += count_flags(cube.flags)
            if cube.sigma is not None:
                self.sigma.append(_mean_sigma(cube.sigma[-first % apart :: apart, ::apart]))
            yield cube

    def _thinned(self, cube: Cube, first: int) -> Cube:
        """Return every so-many-th pixel a side of some rows, of which the layer's row `first` is the first."""
        if self.step == 1:
            return cube
        part = np.s_[-first % self.step :: self.step, :: self.step]
        sigma = None if cube.sigma is None else cube.sigma[part].copy()
        values, flags = cube.values[part].copy(), cube.flags[part].copy()
        return replace(cube, values=values, flags=flags, sigma=sigma)

    @property
    def grey(self) -> tuple[np.ndarray, np.ndarray]:
        """As `database.grey.read_grey` gives it of the layer's files."""
        return np.concatenate(self.mean), np.concatenate(self.valid)

    def ranges(self) -> list[dict[str, Any]]:
        """Return range, noise and signal-to-noise of every band of the layer."""
        from levkas.quality.image_quality.dynamic_range import scene_ranges

        one = self.thin[0] if len(self.thin) == 1 else _stacked(self.thin)
        counts = one.quantity == "counts"
        found = scene_ranges(one.values, one.flags, one.sigma, one.labels, counts=counts)
        return [{name: as_number(value) for name, value in r._asdict().items()} for r in found]

    def sigma_map(self) -> dict[str, Any]:
        """Return sigma, mean over bands, of every so-many-th pixel a side, for the report: PNG text and the ends of its scale; nothing where noise is not known.

        Levels 1 to 255 are `least` to `most`, the ends beyond which one pixel of a hundred lies; 0 is not known.
        """
        from levkas.database.preview import encode_png

        mean = np.concatenate(self.sigma or [np.empty((0, 0))])
        known = np.isfinite(mean)
        if not known.any():
            return {}
        least, most = np.percentile(mean[known], ENDS_OF_SIGMA)
        place = np.clip((mean - least) / max(most - least, 1e-12), 0, 1)
        levels = np.where(known, 1 + np.round(254 * place), 0).astype(np.uint8)
        picture = base64.b64encode(encode_png(levels)).decode("ascii")
        return {"sigma_map": {"png": picture, "least": float(least), "most": float(most)}}


LONGEST_SIGMA, BANDS_OF_SIGMA = 360, 24
"""Longest side of the map of sigma that a layer's record holds, px, and the most bands of which it is the mean: it is smooth in wavelength."""
ENDS_OF_SIGMA = (1.0, 99.0)
"""Of the scale of that map, per cent of its pixels."""


def _mean_sigma(sigma: np.ndarray) -> np.ndarray:
    """Return the mean over every n-th of many bands, (h, w, bands) → (h, w); NaN where sigma is known in none."""
    every = -(-sigma.shape[2] // BANDS_OF_SIGMA)
    some = sigma[:, :, every // 2 :: every]
    known = np.isfinite(some)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sum(some, -1, dtype=float, where=known) / known.sum(-1))


def _stacked(parts: Sequence[Cube]) -> Cube:
    values, flags = (np.concatenate([getattr(c, n) for c in parts]) for n in ("values", "flags"))
    known = [cube.sigma for cube in parts if cube.sigma is not None]
    sigma = np.concatenate(known) if known else None
    return replace(parts[0], values=values, flags=flags, sigma=sigma)


def as_number(value: Any) -> Any:
    """Return what JSON has a word for; of floats five digits."""
    if isinstance(value, float):
        return float(f"{value:.5g}") if isfinite(value) else None
    return value


MOST_BANDS = 24
"""Bands of a camera whose focus is measured, evenly over all; neighbours are alike."""
LOST = Flag.GLARE | Flag.SATURATED | Flag.OUTSIDE


def focus_of(cubes: Iterable[Cube]) -> list[dict[str, Any]]:
    """Return the blur of the sharpest edges, band by band, before anything is resampled."""
    return [
        one
        for cube in cubes
        for one in _focus_of(cube.values, cube.flags, cube.labels, _apart(len(cube.bands)))
    ]


def _apart(bands: int) -> int:
    return max(1, -(-bands // MOST_BANDS))


class Middle:
    """The middle of a scan of (lines, samples, bands), of the bands whose focus is measured, taken from its lines as they pass."""

    def __init__(self, shape: tuple[int, int, int], bands: Sequence[Band]) -> None:
        from levkas.quality.image_quality.sharpness import middle_of

        self._rows, self._columns = middle_of(shape[:2])
        self._step = _apart(len(bands))
        self._labels = [band.label for band in bands][:: self._step]
        size = (self._rows.stop - self._rows.start, self._columns.stop - self._columns.start)
        self._values = np.empty((*size, len(self._labels)), np.float32)
        self._flags = np.empty(self._values.shape, np.uint8)
        self._line = 0

    def add(self, cube: Cube) -> None:
        """Take the next lines."""
        first, self._line = self._line, self._line + len(cube.values)
        low, high = max(first, self._rows.start), min(self._line, self._rows.stop)
        if low >= high:
            return
        part = np.s_[low - first : high - first, self._columns, :: self._step]
        here = slice(low - self._rows.start, high - self._rows.start)
        self._values[here], self._flags[here] = cube.values[part], cube.flags[part]

    def focus(self) -> list[dict[str, Any]]:
        """Return what `focus_of` gives of the whole scan."""
        return _focus_of(self._values, self._flags, self._labels, 1)


def _focus_of(
    values: np.ndarray, flags: np.ndarray, labels: Sequence[str], step: int
) -> list[dict[str, Any]]:
    from levkas.quality.image_quality.sharpness import band_sharpness, middle_of

    middle = middle_of((values.shape[0], values.shape[1]))
    values, flags = values[middle][..., ::step], flags[middle][..., ::step]
    found = band_sharpness(values, labels[::step], left_out=is_flagged(flags, LOST))
    return [{"band": f.band, "blur_px": as_number(f.blur_px), "edges": f.edges} for f in found]

"""Images of bands: averages, contrast stretches, square roots, resampling.

Dense registration compares square roots of the bands (noise becomes even, [anscombe1948]_) with small
holes inpainted; key points are looked for in averages over bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, nan

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Transform
from levkas.registration.local_shifts_kernel import LATTICE_PX

LEAST_BANDS_SHARE, LEAST_PRESENT = 0.5, 0.5
"""Share of the bands that must be valid where their mean is; share of the pixels of the fullest band that a band must have: half of it, or
1.5 times, separates the same bands where some are bad as a whole and others lack glints."""
#: Rows that are interpolated at once; share of an interpolated pixel that has to be valid.
PULLED_ROWS, WHOLE_SHARE = 256, 0.999
#: Sampled values of which the range of an image is estimated.
SAMPLED_PX = 100_000
#: Added before the square root, in units of the 99th percentile: noise about zero stays finite.
TOE = 0.02
#: Pixels of a band in a period of a mosaic, of which one picture is made.
MOST_SITES = 2
#: Side, px, of the smallest square of invalid pixels that is not inpainted.
LARGE_HOLE = 7


@dataclass(frozen=True)
class Sites:
    """Pixels of a mosaic that recorded one band; between them it is interpolated, by the detail of other bands too."""

    period: int
    """In px: side of the square that repeats."""
    places: tuple[tuple[int, int], ...]
    """Of the band's pixels in it."""

    @classmethod
    def in_pattern(cls, table: np.ndarray, channel: int) -> Sites | None:
        """Return the sites of a channel in a pattern, (rows, columns) of channels; None without a picture of theirs.

        One or two in a square lie point-symmetrically about their mean, so that it is where their mean value is measured.

        >>> Sites.in_pattern(np.array([[0, 1], [1, 2]]), 1)
        Sites(period=2, places=((0, 1), (1, 0)))
        """
        places = tuple((int(y), int(x)) for y, x in np.argwhere(table == channel))
        square = table.shape[0] == table.shape[1] > 1
        return cls(len(table), places) if square and len(places) <= MOST_SITES else None

    def picture(self, image: np.ndarray) -> np.ndarray:
        """Return what was measured of a band's image, (h, w): the mean over the sites of each whole period."""
        height, width = (n // self.period * self.period for n in image.shape)
        n = self.period
        parts = [image[y:height:n, x:width:n] for y, x in self.places]
        return np.asarray(sum(parts[1:], parts[0]) / np.float32(len(parts)))

    def filled(self, image: np.ndarray) -> np.ndarray:
        """Return a band's image, (h, w), interpolated anew from its own sites alone, under a tent as wide as two periods."""
        n, measured = self.period, np.zeros(image.shape, np.float32)
        for y, x in self.places:
            measured[y::n, x::n] = 1.0
        tent = (1 - np.abs(np.arange(1 - n, n)) / n).astype(np.float32)
        total, weight = (
            cv2.sepFilter2D(part, -1, tent, tent, borderType=cv2.BORDER_CONSTANT)
            for part in (np.where(measured > 0, image, np.float32(0.0)), measured)
        )
        return np.asarray(np.where(measured > 0, image, total / weight))

    @property
    def transform(self) -> Affine:
        """Px of the band → px of `picture`."""
        y, x = np.mean(self.places, axis=0)
        return Affine(np.array([[1.0, 0.0, -x], [0.0, 1.0, -y]]) / self.period)


@dataclass(frozen=True)
class BandImage:
    """Image of one band."""

    label: str
    wavelength: float
    """In nm: naN where the channel is broad."""
    values: np.ndarray
    """(h, w), float32. Native px of the band's sensor."""
    valid: np.ndarray
    """(h, w), bool. False where the value must not be relied on."""
    sensor: str = ""
    """Name of the sensor; bands of one sensor share its native px."""
    sites: Sites | None = None
    """Of a band of a mosaic, where it was measured; None where all px were, or nobody knows."""
    one_scan: bool = False
    """Whether the bands of its sensor are pictures of one scan, which lie on one another: they share one map."""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape != self.valid.shape:
            raise ValueError(
                f"band {self.label!r} has values {self.values.shape} and valid {self.valid.shape}; "
                "both must be (height, width)"
            )

    @classmethod
    def of(cls, label: str, values: np.ndarray, wavelength: float = nan) -> BandImage:
        """Return a band of which every finite value is valid.

        Codes, integers, become shares of the greatest of them.
        """
        codes = np.issubdtype(np.asarray(values).dtype, np.integer)
        values = np.asarray(values, np.float32)
        return cls(
            label, wavelength, share_of_most(values) if codes else values, np.isfinite(values)
        )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.values.shape[1], self.values.shape[0]


def share_of_most(counts: np.ndarray) -> np.ndarray:
    """Return counts as shares of the greatest finite one; 8 and 16 bits of one picture are then the same numbers.

    >>> share_of_most(np.array([3.0, 51.0, 255.0])) == share_of_most(257 * np.array([3.0, 51.0, 255.0]))
    array([ True,  True,  True])
    """
    most = np.max(counts, where=np.isfinite(counts), initial=0)
    return counts / most if most > 0 else counts


def by_wavelength(bands: Sequence[BandImage]) -> list[BandImage]:
    """Return the bands by wavelength where all are known, else as they come."""
    known = all(np.isfinite(band.wavelength) for band in bands)
    return sorted(bands, key=lambda band: band.wavelength) if known else list(bands)


def present_bands(bands: Sequence[BandImage], also: BandImage | None = None) -> list[BandImage]:
    """Return the bands of a sensor that hold a picture; all where wavelengths, from which the others' maps follow, are not known.

    One that the file calls bad, or that lacks more than half of what the fullest band has, is left out, but for `also`.

    >>> full, empty = np.ones((2, 2)), np.full((2, 2), np.nan)
    >>> [band.label for band in present_bands([BandImage.of("a", full, 400), BandImage.of("b", empty, 500)])]
    ['a']
    """
    if not all(np.isfinite(band.wavelength) for band in bands):
        return list(bands)
    counts = [int(np.count_nonzero(band.valid)) for band in bands]
    least = max(1.0, LEAST_PRESENT * max(counts, default=0))
    return [b for b, n in zip(bands, counts, strict=True) if n >= least or b is also] or [*bands]


def region_mask(region: Sequence[float] | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return which pixels of a frame, (h, w) bool, lie in (x, y, width, height), px; all without a region."""
    inside = np.ones(shape, bool)
    if region is not None:
        x, y, width, height = (round(float(v)) for v in region)
        inside[:] = False
        inside[max(y, 0) : max(y + height, 0), max(x, 0) : max(x + width, 0)] = True
    return inside


def grey(images: Sequence[BandImage]) -> tuple[np.ndarray, np.ndarray]:
    """Average the bands of one sensor, all of one size: the paper's grey picture of a camera, (h, w) float32, and where half of the bands are valid.

    The mean over the bands that are valid at the pixel, each brought to the level of all bands: one that is missing leaves no step. Raises
    ValueError with no band, or bands of different sizes.

    Examples
    --------
    >>> a, b = BandImage.of("a", np.ones((2, 2))), BandImage.of("b", np.full((2, 2), 3.0))
    >>> float(grey([a, b])[0][0, 0])
    2.0
    """
    sizes = {image.size for image in images}
    if len(sizes) != 1:
        raise ValueError(f"a grey picture needs bands of one size, got {sorted(sizes)}")
    total, count = np.zeros(images[0].values.shape), np.zeros(images[0].values.shape, np.float32)
    for image in images:
        good = image.valid & np.isfinite(image.values)
        level = float(image.values.sum(dtype=np.float64, where=good)) / max(int(good.sum()), 1)
        total += np.where(good, image.values, level)
        count += good
    mean = np.where(count > 0, total / len(images), 0.0)
    return mean.astype(np.float32), count >= LEAST_BANDS_SHARE * len(images)


def area_average(
    values: np.ndarray, valid: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, Affine]:
    """Reduce an image, (h, w), to `scale` times its size, 0 < scale <= 1, rounded to whole px, by area averages over what is valid.

    Returns values, where at least half of their area is valid, and reduced px → px of the image, with the exact ratio of the two sizes on
    each axis. Raises ValueError of another scale.
    """
    if not 0 < scale <= 1:
        raise ValueError(f"scale must be in (0, 1], got {scale}")
    h, w = values.shape
    new_w, new_h = max(1, round(w * scale)), max(1, round(h * scale))
    if (new_w, new_h) == (w, h):
        return values, valid, Affine.identity()
    weight = valid.astype(np.float32)
    filled = np.where(valid, values, np.float32(0)).astype(np.float32)
    total = cv2.resize(filled, (new_w, new_h), interpolation=cv2.INTER_AREA)
    share = cv2.resize(weight, (new_w, new_h), interpolation=cv2.INTER_AREA)
    mean = np.divide(total, share, out=np.zeros_like(total), where=share > 0)
    return mean, share >= 0.5, Affine.scaling(w / new_w, h / new_h)


def pull(
    values: np.ndarray, valid: np.ndarray, transform: Transform, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate an image, (h, w), linearly on a grid of `shape`, some rows at a time; `transform` is grid px → px of the image.

    Returns values, float32, and where all that is interpolated is valid.
    """
    h, w = shape
    filled = np.where(valid, values, 0).astype(np.float32)
    weight = valid.astype(np.float32)
    out, inside = np.zeros((h, w), np.float32), np.zeros((h, w), bool)
    lattice = evaluate_lattice(transform, (h, w))
    for start in range(0, h, PULLED_ROWS):
        block = slice(start, min(start + PULLED_ROWS, h))
        places = _between_nodes(lattice, np.arange(h)[block], 0)
        places = _between_nodes(places, np.arange(w), 1)
        known = np.isfinite(places).all(-1, keepdims=True)
        places = np.moveaxis(np.where(known, places, -9.0), -1, 0)[::-1]
        out[block] = map_coordinates(filled, places, order=1)
        inside[block] = map_coordinates(weight, places, order=1) > WHOLE_SHARE
    return out, inside


def evaluate_lattice(transform: Transform, shape: tuple[int, int], step: float = 1.0) -> np.ndarray:
    """Return where every 8th px of a grid of `shape`, `step` source px a px, lies under a map, (rows, columns, 2).

    Between them a map is interpolated linearly: to 1e-4 px for lenses with up to one per cent of distortion.
    """
    rows, columns = (ceil((n - 1) / LATTICE_PX) + 1 for n in shape)
    x, y = np.meshgrid(np.arange(columns) * LATTICE_PX, np.arange(rows) * LATTICE_PX)
    points = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * step - 0.5
    return np.ascontiguousarray(transform(points).reshape(rows, columns, 2))


def _between_nodes(lattice: np.ndarray, places: np.ndarray, axis: int) -> np.ndarray:
    """Interpolate a lattice linearly along one axis at px `places`, (n,)."""
    before = places // LATTICE_PX
    after = np.minimum(before + 1, lattice.shape[axis] - 1)
    share = ((places - before * LATTICE_PX) / LATTICE_PX).reshape(
        (-1, 1, 1) if axis == 0 else (-1, 1)
    )
    low, high = np.take(lattice, before, axis), np.take(lattice, after, axis)
    return np.asarray((1 - share) * low + share * high)


def stretch(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Stretch the 0.5–99.5 percentile range of what is valid to 0–255, uint8; mid-grey elsewhere, and everywhere where nothing varies.

    >>> stretch(np.array([[0.0, 1.0]]), np.array([[True, True]])).tolist()
    [[0, 255]]
    """
    picture = np.full(values.shape, 127, np.uint8)
    good = valid & np.isfinite(values)
    if not good.any():
        return picture
    low, high = np.percentile(values[good], (0.5, 99.5))
    if not high > low:
        return picture
    levels = (values[good].astype(np.float64) - low) * (255.0 / (high - low))
    picture[good] = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    return picture


def sqrt_images(bands: Sequence[BandImage]) -> dict[str, np.ndarray]:
    """Return label → square root of the image, NaN where invalid."""
    return dict(zip([band.label for band in bands], each(_sqrt_image, bands), strict=True))


def _sqrt_image(band: BandImage) -> np.ndarray:
    return sqrt_transform(_inpaint(np.where(band.valid, band.values, np.float32(np.nan))))


def sqrt_transform(image: np.ndarray) -> np.ndarray:
    """Return square roots of an image in units of its 99th percentile; shot noise becomes even.

    Counts below zero are the noise of the dark; an image that is negative for good is shifted.
    """
    image = np.ascontiguousarray(image, np.float32)
    known = image[np.isfinite(image)]
    known = known[:: max(len(known) // SAMPLED_PX, 1)]
    if not len(known):
        return image
    low, high = np.percentile(known, (2, 99))
    low = min(float(low), 0.0)
    scale = 1.0 / max(float(high) - low, 1e-12)
    roots = (image - np.float32(low)) * np.float32(scale)
    np.maximum(roots, np.float32(-0.5 * TOE), out=roots)
    roots += np.float32(TOE)
    return np.asarray(np.sqrt(roots, out=roots))


def _inpaint(image: np.ndarray) -> np.ndarray:
    """Fill holes that are too small to hide a place: sparks of gold, single defects.

    A window counts only where all of it is valid, so that a few scattered pixels would blind
    whole regions. What contains a block of `LARGE_HOLE` px stays NaN.
    """
    hole = np.isnan(image)
    if not hole.any() or hole.all():
        return image
    side = LARGE_HOLE
    framed = np.pad(hole.view(np.uint8), side, constant_values=1)
    opened = cv2.morphologyEx(framed, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    small = hole & (opened[side:-side, side:-side] == 0)
    taps = cv2.getGaussianKernel(3 * side | 1, side / 2)
    total, weight = (
        cv2.sepFilter2D(part.astype(np.float32), -1, taps, taps, borderType=cv2.BORDER_CONSTANT)
        for part in (np.where(np.isfinite(image), image, 0), np.isfinite(image))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(small, total / weight, image)

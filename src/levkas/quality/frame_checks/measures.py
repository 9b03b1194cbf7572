"""What a frame is reduced to before it is judged: levels, noise, focus, a coarse table, a small picture.

Nothing depends on other frames, so that each is decoded once, in whatever order they come.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from io import BytesIO

import numpy as np

from levkas.calibration.patterns import channel_names, channel_table, split
from levkas.calibration.sight import (
    PATCH,
    PICTURE,
    SAMPLE,
    Sight,
    noise_of,
    patches_of,
    picture_of,
    reduced,
)
from levkas.quality.image_quality.sharpness import edge_blur, middle_of

ROWS, COLUMNS = 12, 16
"""Cells of a frame, whose means tell how even and how bright it is."""
MOST_TABLES = 16
"""Bands of a cube of which cells are kept."""
LOW, HIGH = 0.001, 0.999
PASSED = 0.0358
"""Variance that white noise of variance 1 has between blurs of 1 and 2 px."""
HARD = 0.001
"""Share of a channel at its highest code from which that code counts as its full scale."""


@dataclass(frozen=True, eq=False)
class FramePictures:
    """What of a frame is compared as a picture; a program with thousands of frames keeps it on the disk.

    Parameters
    ----------
    picture : ndarray, (h, w), float32
        One channel, reduced to 320 px.
    patches : ndarray, (9, 64, 64), uint16
        Of the same channel at full size; none, (0, 64, 64), of a small frame or a scan.
    """

    picture: np.ndarray
    patches: np.ndarray

    def to_bytes(self) -> bytes:
        """Return the pictures as they are kept in a file, the picture in 16 bits: to 1 in 2,000 of each value."""
        scale = np.float32(2.0 ** max(0, np.frexp(np.nanmax(self.picture, initial=0.0))[1] - 15))
        picture = (self.picture / scale).astype(np.float16)
        return _packed(picture=picture, scale=np.array(scale), patches=self.patches)

    @classmethod
    def from_bytes(cls, data: bytes) -> FramePictures:
        """Return pictures that were kept; raises as `FrameMeasures.from_bytes`."""
        found = _unpacked(data, ("picture", "scale", "patches"))
        return cls(found["picture"].astype(np.float32) * found["scale"], found["patches"])


@dataclass(frozen=True, eq=False)
class FrameMeasures:
    """Numbers of one frame, counts unless said otherwise.

    Parameters
    ----------
    shape : ndarray of int, (2,)
        Height and width, native px.
    level, low, high, full_share, noise : ndarray, (channels,)
        Median, 0.1 % and 99.9 % quantile; share at full scale; standard deviation from pixel to pixel, by the median.
    cells : ndarray, (channels, 12, 16), float32
        Means of cells; of a cube of up to 16 of its bands.
    blur_px : ndarray, ()
        Blur of the sharpest edges in the middle, native px; NaN where there are none.
    fine : ndarray, ()
        Relative variance of detail of 1 to 2 px in the middle, without that of noise; NaN where noise hides it.
    period : ndarray of int, (2,)
        Rows and columns of the mosaic.
    digest : ndarray of uint8, (16,)
        Equal where the frames are.
    """

    shape: np.ndarray
    level: np.ndarray
    low: np.ndarray
    high: np.ndarray
    full_share: np.ndarray
    noise: np.ndarray
    cells: np.ndarray
    blur_px: np.ndarray
    fine: np.ndarray
    period: np.ndarray
    digest: np.ndarray
    pictures: FramePictures

    @cached_property
    def key(self) -> str:
        """The digest as text."""
        return self.digest.tobytes().hex()

    @property
    def picture(self) -> np.ndarray:
        """The small picture."""
        return self.pictures.picture

    @property
    def sight(self) -> Sight:
        """What is compared with the other shots of its scene."""
        noise = max(float(np.nanmedian(self.noise)), 0.5)
        return Sight(self.shape, self.period, self.picture, self.pictures.patches, noise)

    def to_bytes(self) -> bytes:
        """Return the numbers as they are kept in a file, without the pictures."""
        return _packed(**{name: getattr(self, name) for name in NUMBERS})

    @classmethod
    def from_bytes(cls, data: bytes, pictures: FramePictures) -> FrameMeasures:
        """Return measures that were kept; raises ValueError, KeyError or zlib.error where they were not."""
        return cls(**_unpacked(data, NUMBERS), pictures=pictures)


NUMBERS = tuple(f.name for f in fields(FrameMeasures) if f.name != "pictures")


def _packed(**arrays: np.ndarray) -> bytes:
    """Return arrays as an archive of numpy's, compressed."""
    buffer = BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return zlib.compress(buffer.getvalue(), 1)


def _unpacked(data: bytes, names: Sequence[str]) -> dict[str, np.ndarray]:
    with np.load(BytesIO(zlib.decompress(data))) as found:
        return {name: found[name] for name in names}


def measure_frame(
    values: np.ndarray,
    *,
    full: float | None = None,
    pattern: str | Sequence[Sequence[str]] | None = None,
    detail: np.ndarray | None = None,
) -> FrameMeasures:
    """Reduce a frame to its measures.

    Parameters
    ----------
    values : ndarray, (h, w) or (h, w, bands)
        Raw codes.
    full : float, optional
        Full scale, counts. Codes that pile up at the top below it are full as well.
    pattern : str or rows of names, optional
        Of a mosaic.
    detail : ndarray, (h, w), optional
        Of a scan of which `values` are some lines: some that lie side by side, for the focus.

    Examples
    --------
    >>> codes = np.random.default_rng(1).normal(1000, 5, (240, 320)).clip(0, 1010).astype(np.uint16)
    >>> found = measure_frame(codes, full=1010)
    >>> found.level.tolist(), found.full_share.round(2).tolist(), found.noise.round(0).tolist()
    ([999.0], [0.02], [5.0])
    """
    table = np.zeros((1, 1), int) if pattern is None else channel_table(pattern)
    planes = _channels(values, table)
    thin = [plane[:: max(1, plane.size // SAMPLE)].astype(np.float32) for plane in planes]
    shown = _shown(values, table, pattern)
    levels = np.array([np.quantile(plane, (0.5, LOW, HIGH)) for plane in thin])
    tops = [_full_scale(plane, full) for plane in thin]
    share = [float(np.mean(p >= top)) for p, top in zip(thin, tops, strict=True)]
    kept = np.linspace(0, len(planes) - 1, min(MOST_TABLES, len(planes))).astype(int)
    side = max(table.shape)
    patches = patches_of(shown) if detail is None else np.zeros((0, PATCH, PATCH), np.uint16)
    sharp = shown[middle_of(shown.shape)] if detail is None else detail
    cells = np.stack([reduced(planes[k], (ROWS, COLUMNS)) for k in kept])
    picture = picture_of(shown, PICTURE)
    return FrameMeasures(
        shape=np.array(values.shape[:2]),
        level=levels[:, 0],
        low=levels[:, 1],
        high=levels[:, 2],
        full_share=np.array(share),
        noise=np.array([noise_of(plane) for plane in thin]),
        cells=cells,
        blur_px=np.array(edge_blur(sharp)[0] * side),
        fine=np.array(_fine_detail(sharp)),
        period=np.array(table.shape),
        digest=_digest(values),
        pictures=FramePictures(picture, patches),
    )


def _channels(values: np.ndarray, table: np.ndarray) -> list[np.ndarray]:
    """Return one plane a channel, (h, w): of a channel with several phases the first."""
    if values.ndim == 3:
        return list(np.moveaxis(values, 2, 0))
    phases = split(values, *table.shape)
    firsts = [int(np.flatnonzero(table == k)[0]) for k in range(int(table.max()) + 1)]
    return [phases[place] for place in firsts]


def _shown(
    values: np.ndarray, table: np.ndarray, pattern: str | Sequence[Sequence[str]] | None
) -> np.ndarray:
    """Return the plane of the picture: the channel with the most sensels, the middle one of equals; of a cube the mean."""
    if values.ndim == 3 and values.shape[2] > 3:
        bands = np.linspace(0, values.shape[2] - 1, min(MOST_TABLES, values.shape[2])).astype(int)
        return values[..., bands].mean(2, dtype=np.float32)
    if values.ndim == 3:
        return values[..., values.shape[2] // 2]
    if pattern is None:
        return values
    counts = np.bincount(table.ravel())
    most = np.flatnonzero(counts == counts.max())
    return _channels(values, table)[int(most[len(most) // 2])]


def _full_scale(plane: np.ndarray, full: float | None) -> float:
    """Return the code from which on a channel is full: the stated one, or the highest where pixels pile up at it."""
    top = float(plane.max())
    at, below = np.count_nonzero(plane == top), np.count_nonzero((plane < top) & (plane >= top - 2))
    piled = at >= max(HARD * plane.size, 16) and at > 4 * below and top > 16
    return top if piled and (full is None or top < full) else np.inf if full is None else full


def _fine_detail(plane: np.ndarray) -> float:
    """Return the relative variance between blurs of 1 and 2 px, less what the noise of the plane has there.

    White noise of variance 1 has 1/4π + 1/16π − 1/5π = 0.0358 of it.
    """
    import cv2

    if min(plane.shape) < 16:
        return float("nan")
    values = np.ascontiguousarray(plane, np.float32)
    between = cv2.GaussianBlur(values, (0, 0), 1.0) - cv2.GaussianBlur(values, (0, 0), 2.0)
    own, noise = float(between.var()), PASSED * noise_of(values) ** 2
    mean = float(values.mean())
    return (own - noise) / mean**2 if own > 2 * noise and mean > 0 else float("nan")


def _digest(values: np.ndarray) -> np.ndarray:
    """Return a digest of about a million samples, rows spread over the frame."""
    rows = values[:: max(1, values.size // (2 * SAMPLE))]
    found = hashlib.blake2b(np.ascontiguousarray(rows).data, digest_size=16)
    found.update(repr((values.shape, values.dtype.str)).encode())
    return np.frombuffer(found.digest(), np.uint8)


def names_of(pattern: str | Sequence[Sequence[str]] | None, bands: Sequence[str]) -> Sequence[str]:
    """Return the names of the channels as messages give them."""
    return channel_names(pattern) if pattern is not None else bands

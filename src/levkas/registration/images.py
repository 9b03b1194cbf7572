"""Band images, and the grey pictures in which key points are looked for."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING

import numpy as np

from levkas.geometry.transforms import Affine

if TYPE_CHECKING:
    from collections.abc import Sequence

STRETCH_PERCENT = (0.5, 99.5)
LEAST_BANDS = 0.5


@dataclass(frozen=True)
class BandImage:
    """One band as registration sees it.

    Parameters
    ----------
    label : str
    wavelength : float, nm
        NaN where the channel is broad.
    values : ndarray, (h, w), float32
        Native px of the band's sensor.
    valid : ndarray, (h, w), bool
        False where the value must not be relied on.
    sensor : str
        Name of the sensor; bands of one sensor share its native px.
    """

    label: str
    wavelength: float
    values: np.ndarray
    valid: np.ndarray
    sensor: str = ""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape != self.valid.shape:
            raise ValueError(
                f"band {self.label!r} has values {self.values.shape} and valid {self.valid.shape}; "
                "both must be (height, width)"
            )

    @classmethod
    def of(cls, label: str, values: np.ndarray, wavelength: float = nan) -> BandImage:
        """Return a band of which every finite value is valid."""
        values = np.asarray(values, np.float32)
        return cls(label, wavelength, values, np.isfinite(values))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.values.shape[1], self.values.shape[0]


def grey(images: Sequence[BandImage]) -> tuple[np.ndarray, np.ndarray]:
    """Average the bands of one sensor: the paper's grey picture of a camera.

    Parameters
    ----------
    images : sequence of BandImage
        All of one size.

    Returns
    -------
    values : ndarray, (h, w), float32
        Mean over the bands that are valid at the pixel, each brought to the level of all bands; 0
        where none is.
    valid : ndarray, (h, w), bool
        At least half of the bands are valid there.

    Raises
    ------
    ValueError
        With no band, or bands of different sizes.

    Examples
    --------
    >>> a, b = BandImage.of("a", np.ones((2, 2))), BandImage.of("b", np.full((2, 2), 3.0))
    >>> float(grey([a, b])[0][0, 0])
    2.0
    """
    sizes = {image.size for image in images}
    if len(sizes) != 1:
        raise ValueError(f"a grey picture needs bands of one size, got {sorted(sizes)}")
    total = np.zeros(images[0].values.shape, np.float64)
    count = np.zeros(images[0].values.shape, np.float32)
    levels = np.zeros(images[0].values.shape, np.float64)
    for image in images:
        good = image.valid & np.isfinite(image.values)
        values = np.where(good, image.values, np.float32(0))
        total += values
        count += good
        # A band that is missing at a pixel must not leave a step there: it counts as its mean.
        level = float(values.sum(dtype=np.float64)) / max(int(good.sum()), 1)
        levels += np.where(good, 0.0, level)
    valid = count >= LEAST_BANDS * len(images)
    mean = np.where(count > 0, (total + levels) / len(images), 0.0)
    return mean.astype(np.float32), valid


def area_average(
    values: np.ndarray, valid: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, Affine]:
    """Reduce an image to `scale` times its size by area averages over what is valid.

    Parameters
    ----------
    values, valid : ndarray, (h, w), float32 and bool
    scale : float
        0 < scale <= 1; the size is rounded to whole pixels.

    Returns
    -------
    values, valid : ndarray
        Reduced; a pixel is valid where at least half of its area is.
    back : Affine
        Reduced px → px of `values`, with the exact ratio of the two sizes on each axis.

    Raises
    ------
    ValueError
        Where `scale` is not within (0, 1].
    """
    import cv2

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


def stretch(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Stretch the 0.5–99.5 percentile range of what is valid to 0–255.

    Parameters
    ----------
    values, valid : ndarray, (h, w), float and bool

    Returns
    -------
    picture : ndarray, (h, w), uint8
        Mid-grey where `valid` is false, and everywhere where nothing varies.

    Examples
    --------
    >>> picture = stretch(np.array([[0.0, 1.0]]), np.array([[True, True]]))
    >>> int(picture[0, 0]), int(picture[0, 1])
    (0, 255)
    """
    picture = np.full(values.shape, 127, np.uint8)
    good = valid & np.isfinite(values)
    if not good.any():
        return picture
    low, high = np.percentile(values[good], STRETCH_PERCENT)
    if not high > low:
        return picture
    levels = (values[good].astype(np.float64) - low) * (255.0 / (high - low))
    picture[good] = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    return picture

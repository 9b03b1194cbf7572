"""The reference camera made ready for the default method, once for all cameras that are registered to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.bands import describe_mask, segment_foreground, sqrt_images
from levkas.registration.coarse_to_fine import by_wavelength
from levkas.registration.features import CameraFeatures
from levkas.registration.predictors import ReferenceStack, resample_bands

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform
    from levkas.registration.bands import BandImage

#: Bands of the reference that predict others, and means of parts of its spectrum that are searched for key points.
MOST_PREDICTING, MOST_GREYS = 12, 4


class PreparedReference:
    """The reference camera made ready, once for all cameras that are registered to it.

    Parameters
    ----------
    bands : sequence of BandImage
    band : str
        Label of the band that defines reference px.
    region : (x, y, width, height), reference px, optional
        Where the object lies; nothing outside is used.
    """

    def __init__(
        self, bands: Sequence[BandImage], band: str, region: Sequence[float] | None = None
    ) -> None:
        self.anchor = next(image for image in bands if image.label == band)
        self.own_bands = [image for image in bands if image.sensor == self.anchor.sensor]
        self.images = sqrt_images(bands)
        greys = GreyImages([self.images[image.label] for image in self.own_bands])
        inside, body = _inside(region, self.anchor.values.shape), segment_foreground(greys[0])
        self._mask = inside & body
        self.mask = describe_mask(body, region)
        self.keys, self._greys = CameraFeatures(greys, self._mask), greys
        self._stack: ReferenceStack | None = None

    def object_in(self, band: BandImage) -> np.ndarray:
        """Return a band's picture, NaN where the object is not."""
        return np.where(self._mask, self.images[band.label], np.float32(np.nan))

    def predicting(self) -> list[BandImage]:
        """Return at most 12 bands, evenly over the wavelengths, the anchor among them."""
        bands = by_wavelength(self.own_bands)
        count = min(MOST_PREDICTING, len(bands))
        picks = np.linspace(0, len(bands) - 1, count).round().astype(int)
        return [bands[i] for i in sorted({*picks.tolist(), bands.index(self.anchor)})]

    def stack(self, transforms: Mapping[str, Transform]) -> ReferenceStack:
        """Return the predictors of other bands; `transforms` of the reference camera's own bands."""
        if self._stack is None:
            bands = self.predicting()
            masked = {band.label: self.object_in(band) for band in bands}
            known = {band.label: transforms[band.label] for band in bands}
            stack = resample_bands(masked, known, self.anchor.values.shape)
            self._stack = ReferenceStack(stack, [band.wavelength for band in bands])
        return self._stack

    def release(self) -> None:
        """Free what one camera alone needs and the next one can make again."""
        if self._stack is not None:
            self._stack.release()

    def freeze(self, transforms: Mapping[str, Transform]) -> None:
        """Compute all that other cameras need of the single bands, then free these."""
        self.stack(transforms)
        self._greys.freeze()
        self.images, self.own_bands = {}, []
        # Bands share their memory with others that are not needed any more.
        values, valid = self.anchor.values.copy(), self.anchor.valid.copy()
        self.anchor = replace(self.anchor, values=values, valid=valid)


def _inside(region: Sequence[float] | None, shape: tuple[int, int]) -> np.ndarray:
    inside = np.ones(shape, bool)
    if region is not None:
        x, y, width, height = (round(float(v)) for v in region)
        inside[:] = False
        inside[max(y, 0) : max(y + height, 0), max(x, 0) : max(x + width, 0)] = True
    return inside


class GreyImages(Sequence[np.ndarray]):
    """The mean of all bands brought to one contrast, and up to four others, computed when first used.

    Those are the bands themselves where they are few, else means of parts of the spectrum.
    """

    def __init__(self, images: Sequence[np.ndarray]) -> None:
        self._images = images
        parts = np.array_split(np.arange(len(images)), min(MOST_GREYS, len(images)))
        self._groups = [range(len(images)), *(parts if len(images) > 1 else ())]
        self._made: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._groups)

    def freeze(self) -> None:
        """Compute all of them, and free the bands."""
        for i in range(len(self)):
            self[i]
        self._images = []

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(len(self)))]
        if i not in self._made:
            self._made[i] = _mean([self._images[k] for k in self._groups[i]])
        return self._made[i]


def _mean(images: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of images, each in units of its standard deviation, over what is finite."""
    total, count = np.zeros((2, *images[0].shape), np.float32)
    for image in images:
        known = np.isfinite(image)
        some = image[::2, ::2][known[::2, ::2]]
        if not some.size:
            continue
        spread = np.float32(max(float(np.std(some)), 1e-12))
        total += np.where(known, image / spread, np.float32(0))
        count += known
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(total / count)

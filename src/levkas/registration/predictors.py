"""Predictors: principal components of the reference's bands, from which any band is predicted.

A painting has few pigments in any one place: a handful of images span what every band shows there, and a band is their linear combination,
with gains of its own in each window. Paint is mixed neither as light is added nor as absorption is: images of the square root of reflectance
are predicted from combinations of reflectance and of its logarithm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from threading import RLock

import cv2
import numpy as np

from levkas.core.threads import each, in_threads
from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration.bands import (
    SAMPLED_PX,
    BandImage,
    by_wavelength,
    present_bands,
    sqrt_images,
)
from levkas.registration.features import CameraFeatures, grey_pictures
from levkas.registration.foreground import Corners, ObjectArea
from levkas.registration.local_shifts import (
    RIDGE,
    Predictor,
    WindowShifts,
    highpass,
    reduce,
    smoothing_warp,
)
from levkas.registration.record import refusal

#: Principal components of reflectance, and of its logarithm; how many of the first are added blurred.
LINEAR, LOGARITHMIC, BLURRED = 5, 3, 2
#: Share of the largest eigenvalue below which a component is left out.
LEAST_SHARE = 1e-6
#: Rows that are mixed at once.
LINES = 32
#: Light so far, nm, beyond the outermost of at least three bands is predicted as well as what lies between.
NEAR_NM, LEAST_BANDS = 20.0, 3
#: Correlation of the detail of two bands from which on they are one grey picture.
GREY = 0.98
#: Bands of the reference that predict others.
MOST_PREDICTING = 12


@dataclass(frozen=True)
class PredictorBasis:
    """Images from which others are predicted."""

    images: np.ndarray
    """(k, h, w), float32. Principal images in their natural size, so that a ridge weighs on what varies little."""
    loadings: np.ndarray
    """(k, bands). Share of each band in each image."""
    groups: np.ndarray
    """(k,). Images of one group are principal images of one stack."""

    def high_passed(self) -> PredictorBasis:
        """Return the images without their slow parts, and blurred copies of the first: combined, they are as soft as the target."""
        soft = min(BLURRED, len(self.images))
        sharp = np.stack([highpass(image) for image in self.images])
        images = np.concatenate([sharp, [blur(blur(image)) for image in sharp[:soft]]])
        return PredictorBasis(
            images,
            np.concatenate([self.loadings, self.loadings[:BLURRED]]),
            np.concatenate([self.groups, np.full(soft, self.groups.max() + 1)]),
        )

    def position_sensitivity(self, shifts: WindowShifts) -> np.ndarray:
        """Return the derivative of a prediction's position by that of each band, (bands,); sums to one."""
        same = self.groups[:, None] == self.groups
        mean = np.where(same, shifts.position_sensitivity, 0.0)
        shares = np.einsum("ij,ib,jb->b", mean, self.loadings, self.loadings)
        return shares / shares.sum() if abs(shares.sum()) > 0.1 else np.zeros(len(shares))


def principal_components(
    stack: np.ndarray, counts: tuple[int, int] = (LINEAR, LOGARITHMIC)
) -> PredictorBasis:
    """Return the principal images of reflectance and of its logarithm, at most `counts` of either.

    `stack`, (bands, h, w) float32, are square roots of reflectance as `sqrt_transform` gives them, NaN where invalid in a band.
    """
    skip = 1 + int(np.sqrt(stack[0].size / SAMPLED_PX))
    far, near = stack[:, ::skip, 4::skip], stack[:, ::skip, :-4:skip]
    loadings = [
        _principal(measure(far) - measure(near), count)
        for measure, count in ((np.square, counts[0]), (_logarithm, counts[1]))
    ]
    images = np.empty((sum(map(len, loadings)), *stack.shape[1:]), np.float32)
    shares = [vectors.astype(np.float32) for vectors in loadings]
    in_threads(_mix, -(-stack.shape[1] // LINES), stack, *shares, images)
    groups = np.repeat([0, 1], [len(vectors) for vectors in loadings])
    for group in (0, 1):
        part = images[groups == group]
        images[groups == group] = part / max(float(np.nanstd(part[0, ::4, ::4])), 1e-12)
    return PredictorBasis(images, np.concatenate(loadings), groups)


def _mix(
    start: int, stop: int, stack: np.ndarray, linear: np.ndarray, bent: np.ndarray, out: np.ndarray
) -> None:
    """Mix the bands of blocks of rows, the same for any number of threads: last bits of a product of matrices depend on their width."""
    for block in range(start, stop):
        rows = slice(block * LINES, min((block + 1) * LINES, stack.shape[1]))
        part = stack[:, rows].reshape(len(stack), -1)
        shape = (-1, *stack[0, rows].shape)
        out[: len(linear), rows] = (linear @ np.square(part)).reshape(shape)
        out[len(linear) :, rows] = (bent @ _logarithm(part)).reshape(shape)


def _logarithm(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.log(np.maximum(values, np.float32(1e-3))))


def _principal(rough: np.ndarray, count: int) -> np.ndarray:
    """Return orthonormal loadings, (<= count, bands), of differences between neighbours."""
    flat = rough[:, np.isfinite(rough).all(0)].astype(np.float64)
    values, vectors = np.linalg.eigh(flat @ flat.T)
    order = np.argsort(-values)[:count]
    order = order[values[order] > LEAST_SHARE * max(values[order[0]], 1e-300)]
    if not len(order):
        order = np.argsort(-values)[:1]
    vectors = vectors[:, order]
    return (vectors * np.sign(vectors[np.abs(vectors).argmax(0), np.arange(len(order))])).T


def resample_band(
    image: np.ndarray, transform: Transform, size: tuple[int, int], step: int, *, count: int | None = None,
) -> np.ndarray:  # fmt: skip
    """Warp one band on to a grid of `step` reference px, averaged over blocks of `count` px of the target, by default `step`."""
    factor = step if count is None else count
    if factor == 1:
        return smoothing_warp(image, transform, size, step=step)
    return smoothing_warp(
        reduce(image, factor), Composed(transform, Affine.scaling(1 / factor)), size, step=step
    )


def resample_all(
    images: Sequence[np.ndarray], transforms: Sequence[Transform], size: tuple[int, int], step: int
) -> list[np.ndarray]:
    """Return `resample_band` of every band through a map of its own, several at a time."""
    return each(lambda image, t: resample_band(image, t, size, step), images, transforms)


def measure_shifts(
    predictor: Predictor, image: np.ndarray, *, ridge: float = RIDGE
) -> WindowShifts:
    """Return the shifts of `image`, sampled in the predictor's frame, once its slow part is out."""
    return predictor.compare(highpass(image), ridge=ridge)


def blur(image: np.ndarray, taps: Sequence[int] = (1, 4, 6, 4, 1)) -> np.ndarray:
    """Blur an image, (h, w), on both axes, by default by one pixel of sigma; NaN spreads."""
    kernel = np.array(taps, np.float32) / sum(taps)
    return cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)


def cell_px(shape: Sequence[int]) -> int:
    """Return the cell of the windows for a frame: 12 px for small frames, 16 for large ones."""
    return 12 if min(shape) < 600 else 16


def has_colours(bands: Sequence[np.ndarray]) -> bool:
    """Return whether three or more bands, (h, w), NaN where invalid, are more than one grey picture stored as colours.

    >>> rng = np.random.default_rng(1)
    >>> grey, other = rng.normal(size=(2, 40, 50)).astype(np.float32)
    >>> has_colours([grey] * 3), has_colours([grey, 2 * grey, other])
    (False, True)
    """
    if len(bands) < LEAST_BANDS:
        return False
    first, *others = (highpass(band) for band in bands)
    for other in others:
        both = np.isfinite(first) & np.isfinite(other)
        if both.any() and np.corrcoef(first[both], other[both])[0, 1] < GREY:
            return True
    return False


class ReferenceStack:
    """Predictors at any step of bands of the reference, (bands, h, w) by `sqrt_transform`, NaN where invalid; wavelengths, nm, NaN where not known."""

    def __init__(self, stack: np.ndarray, wavelengths: Sequence[float] = ()) -> None:
        self.palette = principal_components(stack)
        self._wavelengths = tuple(wavelengths)
        picks = np.linspace(0, len(stack) - 1, min(len(stack), LEAST_BANDS)).astype(int)
        self.has_colours = has_colours([stack[k] for k in picks])
        self._predictors: dict[int, Predictor] = {}
        self._lock = RLock()  # sensors are registered side by side

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the reference frame."""
        return self.palette.images.shape[1], self.palette.images.shape[2]

    def covers(self, wavelength: float) -> bool:
        """Return whether a wavelength, nm, lies among those of the reference's bands; not where any is unknown."""
        if len(self._wavelengths) < LEAST_BANDS or not np.isfinite(self._wavelengths).all():
            return False
        low, high = min(self._wavelengths) - NEAR_NM, max(self._wavelengths) + NEAR_NM
        return bool(low <= wavelength <= high)

    def release(self) -> None:
        """Free the predictors, which are larger than what they are computed from."""
        self._predictors.clear()

    def predictor(self, step: int = 1) -> Predictor:
        """Return the predictor on a grid of `step` reference px."""
        with self._lock:
            if step not in self._predictors:
                palette = self.palette
                if step > 1:
                    # The target's samples are averages taken through the spline; so are these.
                    small = [blur(reduce(image, step), (1, 4, 1)) for image in palette.images]
                    palette = replace(palette, images=np.stack(small))
                images = palette.high_passed().images
                cell = cell_px(images.shape[1:])
                self._predictors[step] = Predictor(images, step=step, cell=cell)
            return self._predictors[step]


class PreparedReference:
    """Reference camera with its predictors and key points, prepared once for all cameras registered to it.

    The `band` of that label defines reference px; outside `region`, (x, y, width, height), nothing is used. The object lies in `area`, else
    within `outline`, (n, 2) corners, else it is segmented from an even ground.
    """

    def __init__(
        self, bands: Sequence[BandImage], band: str, region: Sequence[float] | None = None,
        outline: Corners | None = None, area: ObjectArea | None = None,
    ) -> None:  # fmt: skip
        self.anchor = next(image for image in bands if image.label == band)
        if not self.anchor.valid.any():
            raise refusal(
                "E_VALUE",
                f"the reference band {band} holds nothing",
                field="campaign.reference.band", expected="a picture", fix="Name another band of this camera as the reference.",
                found=f"{self.anchor.valid.size} pixels that are outside, saturated or of a bad band",
            )  # fmt: skip
        self.own_bands = [image for image in bands if image.sensor == self.anchor.sensor]
        self.images = sqrt_images(bands)
        greys = grey_pictures([self.images[image.label] for image in self.own_bands])
        self.area = area or ObjectArea.of(greys[0], region, outline)
        self._mask = self.area.compared
        self.keys = CameraFeatures(greys, self._mask)
        self._stack: ReferenceStack | None = None

    def object_in(self, band: BandImage) -> np.ndarray:
        """Return a band's picture, NaN where the object is not."""
        return np.where(self._mask, self.images[band.label], np.float32(np.nan))

    def predicting(self) -> list[BandImage]:
        """Return at most 12 bands, evenly over the wavelengths, the anchor among them."""
        bands = by_wavelength(present_bands(self.own_bands, self.anchor))
        count = min(MOST_PREDICTING, len(bands))
        picks = np.linspace(0, len(bands) - 1, count).round().astype(int)
        return [bands[i] for i in sorted({*picks.tolist(), bands.index(self.anchor)})]

    def stack(self, transforms: Mapping[str, Transform]) -> ReferenceStack:
        """Return the predictors of other bands; `transforms` of the reference camera's own bands."""
        if self._stack is None:
            bands = self.predicting()
            masked, maps = [self.object_in(b) for b in bands], [transforms[b.label] for b in bands]
            height, width = self.anchor.values.shape
            stack = np.stack(resample_all(masked, maps, (height, width), 1))
            self._stack = ReferenceStack(stack, [band.wavelength for band in bands])
        return self._stack

    def release(self) -> None:
        """Free what one camera alone needs and the next one can make again."""
        if self._stack is not None:
            self._stack.release()

    def freeze(self, transforms: Mapping[str, Transform]) -> None:
        """Compute all that other cameras need of the single bands, then free these."""
        self.stack(transforms)
        self.images, self.own_bands = {}, []
        # Bands share their memory with others that are not needed any more.
        values, valid = self.anchor.values.copy(), self.anchor.valid.copy()
        self.anchor = replace(self.anchor, values=values, valid=valid)

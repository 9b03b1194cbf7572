"""What all captures of an object are registered to, made ready once for all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from levkas.campaign.methods import method_of
from levkas.core.cube import find_band
from levkas.database.registrations import read_registration
from levkas.geometry import from_dict
from levkas.geometry.grid import Grid, GridRefused
from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration import Matches, Registration, Verdict
from levkas.registration.record import Sigma
from levkas.stages.spectra import middle_band, reference_channel
from levkas.stages.tiles import TiledCapture, coarseness

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.campaign.schema.tables import GridKeys
    from levkas.database.layout import Places
    from levkas.geometry.joining import Box
    from levkas.registration import BandImage
    from levkas.registration.predictors import PreparedReference
    from levkas.stages.native_cubes import CalibratedCapture

    Grey = tuple[np.ndarray, np.ndarray]
    Region = tuple[float, float, float, float]

SMALLEST_SHARE = 0.05
"""Below this share of the frame a bright region is no painting."""


class ReferenceFrame:
    """The reference camera's bands of one object, its registration, and the grid that they lay out.

    Parameters
    ----------
    campaign : Campaign
    places : Places
    captures : sequence of Capture
        Of the object, the reference camera's own first.
    native : CalibratedCapture
        Its calibrated bands.
    """

    def __init__(
        self,
        campaign: Campaign,
        places: Places,
        captures: Sequence[Capture],
        native: CalibratedCapture,
    ) -> None:
        self.campaign, self.places, self.captures = campaign, places, captures
        self.capture = captures[0]
        self._native: CalibratedCapture | None = native
        self._tiled = native if isinstance(native, TiledCapture) else None
        self._images: Sequence[BandImage] | None = None
        self._own: Registration | None = None
        self._prepared: PreparedReference | None = None
        self._grid: tuple[Grid, float | None, Region | None] | None = None
        self.grey: Grey | None = None
        """Of its layer, where that was drawn or read already."""

    @property
    def images(self) -> Sequence[BandImage]:
        """Its bands; those of tiles joined, once they are placed. Raises RegistrationRefused (``E_SIZE``) of a mosaic too large for that."""
        if self._images is None:
            if self._tiled is not None:
                self._images = self._tiled.images(self.band)
            else:
                assert self._native is not None
                native, self._native = self._native, None
                self._images = native.images()
        return self._images

    @images.setter
    def images(self, images: Sequence[BandImage]) -> None:
        self._images = images

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the reference band."""
        return self._tiled.placed.size if self._tiled is not None else self._image().size

    @property
    def step(self) -> int:
        """Reference px in one of the overview, along a side."""
        return self._tiled.step if self._tiled is not None else 1

    @cached_property
    def overview(self) -> Sequence[BandImage]:
        """Its bands, or of a large mosaic those that show it whole with `step` px a side in one."""
        if self._tiled is None or self.step == 1:
            return self.images
        return self._tiled.images(self.band, step=self.step)

    def part(self, box: Box) -> tuple[Sequence[BandImage], dict[str, Transform], int]:
        """Return the bands in a box, and the maps from px of the box to those of each band's picture.

        The box is left, top, and behind the right and the bottom, reference px. Of a mosaic too large to be held, the box too may be: the
        third value says how many reference px a side make one of it.
        """
        if self.step > 1:
            assert self._tiled is not None
            step = coarseness(box[2] - box[0], box[3] - box[1])
            cut = self._tiled.images(self.band, box, step)
            return cut, {image.label: Affine.identity() for image in cut}, step
        return *cropped(self.images, self.registration().transforms, box), 1

    @cached_property
    def band(self) -> str:
        """Label of the reference band."""
        bands = self.capture.bands
        wanted = self.campaign.reference.band
        labels = [band.label for band in bands]
        if wanted is None:
            return middle_band(bands)
        return labels[find_band(labels, wanted, [band.wavelength for band in bands])]

    @property
    def outline(self) -> tuple[tuple[float, float], ...] | None:
        """The declared corners of the object, reference px; None where none are declared."""
        return self.campaign.outline_of(self.capture.object)[0] or None

    def prepared(self, region: Region | None, *, own: bool) -> PreparedReference:
        """Return the bands as the default method takes them, prepared once for all captures.

        `own` where the reference camera itself is registered: all its bands are held until then.
        """
        from levkas.registration.predictors import PreparedReference

        if self._prepared is None:
            self._prepared = PreparedReference(self.images, self.band, region, self.outline)
            if not own:
                self._release()
        return self._prepared

    def registered(self, own: Registration) -> None:
        """Take the reference camera's own registration; its single bands go."""
        self._own = own
        self._release()

    def rest(self) -> None:
        """Let go what is prepared again for the next capture."""
        if self._prepared is not None:
            self._prepared.release()

    def _release(self) -> None:
        if self._prepared is not None and self._anchor_suffices():
            self._prepared.freeze(self.registration().transforms)
            self.images = [self._prepared.anchor]

    def _anchor_suffices(self) -> bool:
        """Whether no capture is registered to single bands: tiles are, to parts of all of them."""
        keys = (self.campaign.registration_of(capture.camera) for capture in self.captures)
        tiled = any(capture.tiles for capture in self.captures)
        return not tiled and all(method_of(one).prepared for one in keys)

    def registration(self) -> Registration:
        """Return the reference camera's own registration, from this run or from its record."""
        if self._own is None:
            record = record_of(self.places, self.capture)
            self._own = Registration(
                "",
                maps_of(record),
                Verdict("accept"),
                {},
                Matches.none(),
                sigma=sigmas_of(record),
            )
        return self._own

    def description(self) -> dict[str, Any]:
        """Return the reference of a registration's record."""
        return {"camera": self.capture.camera, "band": self.band, "size": list(self.size)}

    def layout(self) -> tuple[Grid, float | None, Region | None]:
        """Return the grid, its sampling in px per mm where known, and the object's region in reference px."""
        if self._grid is None:
            facts = self.campaign.objects.get(self.capture.object)
            size_mm = facts.size_mm if facts else None
            try:
                self._grid = frame_object(
                    self._image(), self.campaign.grid, size_mm, self.size, self.step
                )
            except GridRefused as refused:
                file = str(self.campaign.path)
                raise GridRefused(*(replace(p, file=file) for p in refused.problems)) from None
        return self._grid

    def _image(self) -> BandImage:
        return next(image for image in self.overview if image.label == self.band)

    def channel(self, capture: Capture) -> str:
        wanted = next(b for b in self.capture.bands if b.label == self.band)
        return reference_channel(self.campaign, capture.camera, capture.bands, wanted.wavelength)


def record_of(places: Places, capture: Capture) -> dict[str, Any]:
    """Return the registration record of a capture."""
    return read_registration(places.registration(capture.object, capture.layer))


def sigmas_of(record: dict[str, Any]) -> dict[str, Sigma]:
    """Return the uncertainty of the maps of a record's bands, by label, where it is recorded."""
    bands = record["bands"].items()
    return {label: Sigma.from_dict(band["sigma"]) for label, band in bands if "sigma" in band}


def maps_of(record: dict[str, Any]) -> dict[str, Transform]:
    """Return the maps of a record's bands, reference px to native px, by label."""
    return {label: from_dict(band["transform"]) for label, band in record["bands"].items()}


def cropped(
    images: Sequence[BandImage], transforms: Mapping[str, Transform], box: Box
) -> tuple[list[BandImage], dict[str, Transform]]:
    """Return a box of the bands, each cut out in its own px, and the maps from px of the box to those."""
    x, y, right, bottom = box
    corner, back = Affine.of_box(x, y), Affine.of_box(-x, -y)
    part = np.s_[y:bottom, x:right]
    # A mosaic's sites repeat from the corner: of a box that begins elsewhere they are not known.
    cut = [replace(i, values=i.values[part], valid=i.valid[part], sites=None) for i in images]
    labels = [image.label for image in images if image.label in transforms]
    return cut, {label: Composed(corner, transforms[label], back) for label in labels}


# --- the object in the reference's frame, and the grid that follows from it ---------------------


def bounding_box(grey: np.ndarray, valid: np.ndarray | None = None) -> tuple[int, int, int, int]:
    """Bounding box of the object on a plain background.

    A painting has contrast of its own, a background has not: the brightness and the local
    contrast are both thresholded by Otsu's method, small islands are dropped, and the box
    around the largest connected region is taken.

    Parameters
    ----------
    grey : ndarray, (h, w)
        Mean of bands, any unit.
    valid : ndarray of bool, (h, w), optional

    Returns
    -------
    region : (x, y, width, height)
        The whole frame where no object stands out from a background.

    Examples
    --------
    >>> image = np.zeros((60, 80)); image[10:50, 20:70] = 1.0
    >>> bounding_box(image)
    (20, 10, 50, 40)
    """
    height, width = grey.shape
    whole = (0, 0, width, height)
    image = np.nan_to_num(np.asarray(grey, np.float64))
    if valid is not None:
        image = np.where(valid, image, 0.0)
    low, high = np.percentile(image, (0.5, 99.5))
    if not high > low:
        return whole
    tone = np.sqrt(np.clip((image - low) / (high - low), 0, 1))
    bytes_ = np.round(255 * tone).astype(np.uint8)
    cut, _ = cv2.threshold(bytes_, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    border = np.concatenate([bytes_[0], bytes_[-1], bytes_[:, 0], bytes_[:, -1]])
    # A dark painting on a dark cloth: what is clearly above the border's own spread is object too.
    floor = np.median(border) + 4 * max(1.0, 1.4826 * np.median(np.abs(border - np.median(border))))
    mask = (bytes_ > min(cut, floor)).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    mask = cv2.morphologyEx(
        cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel, iterations=3
    )
    count, _, statistics, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return whole
    best = 1 + int(
        np.argmax(statistics[1:, cv2.CC_STAT_WIDTH] * statistics[1:, cv2.CC_STAT_HEIGHT])
    )
    x, y, w, h = (int(v) for v in statistics[best, :4])
    return (x, y, w, h) if w * h >= SMALLEST_SHARE * width * height else whole


def frame_object(
    image: BandImage,
    keys: GridKeys | None,
    size_mm: tuple[float, float] | None,
    size: tuple[int, int] | None = None,
    step: int = 1,
) -> tuple[Grid, float | None, tuple[float, float, float, float] | None]:
    """Return the grid, its sampling in px per mm where known, and the region to register by.

    Parameters
    ----------
    image : BandImage
        The reference band.
    keys : GridKeys, optional
        The table [grid]; None: the reference band's own frame, whole.
    size_mm : (width, height), optional
        Of the object, upright; with its bounding box it gives the sampling.
    size : (width, height), px, optional
        Of the reference band where `image` is an overview of it; default that of `image`.
    step : int
        Px of the reference band in one of `image`, along a side.

    Returns
    -------
    grid : Grid
    sampling : float or None
        Grid px per mm.
    region : (x, y, width, height), reference px, or None
        The declared region, turned back; None where none is declared.
    """
    width, height = size or image.size
    mirror, rotate = (keys.mirror, keys.rotate) if keys else (False, 0.0)
    turned = Grid((width, height), mirror=mirror, rotate=rotate)
    region = keys.region if keys else None
    box = None
    if region == "auto" or size_mm is not None:
        box = _box_in(turned, image, step)
    chosen = box if region == "auto" else region
    grid = Grid(
        (width, height),
        mirror=mirror,
        rotate=rotate,
        region=chosen,
        output=keys.size if keys else None,
    )
    sampling = (
        _sampling(grid, turned, box, size_mm) if box is not None and size_mm is not None else None
    )
    return grid, sampling, _turned_back(turned, region) if isinstance(region, tuple) else None


def _box_in(turned: Grid, image: BandImage, step: int) -> tuple[float, float, float, float]:
    """The object's bounding box in the turned frame at native scale."""
    x, y, w, h = (step * side for side in bounding_box(image.values, image.valid))
    corners = np.array([[x, y], [x + w - 1, y], [x + w - 1, y + h - 1], [x, y + h - 1]], float)
    placed = turned.transform.inverse(corners)
    low, high = np.floor(placed.min(0)), np.ceil(placed.max(0))
    return float(low[0]), float(low[1]), float(high[0] - low[0] + 1), float(high[1] - low[1] + 1)


def _turned_back(
    turned: Grid, region: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """The box in reference px around a region of the turned frame."""
    x, y, w, h = region
    corners = np.array([[x, y], [x + w - 1, y], [x + w - 1, y + h - 1], [x, y + h - 1]], float)
    placed = turned.transform(corners)
    low, high = placed.min(0), placed.max(0)
    return float(low[0]), float(low[1]), float(high[0] - low[0] + 1), float(high[1] - low[1] + 1)


def _sampling(
    grid: Grid, turned: Grid, box: tuple[float, float, float, float], size_mm: tuple[float, float]
) -> float:
    """Grid px per mm from the object's box and its size; the longer sides belong together."""
    sides, real = np.sort(np.array(box[2:])), np.sort(np.array(size_mm, float))
    native = float(np.exp(np.log(sides / real).mean()))
    step = grid.transform.jacobian(np.zeros((1, 2)))[0]
    return native / float(np.sqrt(abs(np.linalg.det(step))))

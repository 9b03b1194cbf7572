"""What all captures of an object are registered to, made ready once for all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import find_band
from levkas.database.registrations import read_registration
from levkas.geometry import from_dict
from levkas.geometry.grid import Grid, GridRefused
from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration import Matches, Registration, Verdict
from levkas.registration.bands import sqrt_images
from levkas.registration.features import mean_picture
from levkas.registration.foreground import ObjectArea
from levkas.registration.methods import method_of
from levkas.registration.record import Sigma
from levkas.stages.parts import Placement
from levkas.stages.spectra import middle_band, reference_channel
from levkas.stages.tiles import coarseness, view_of_mosaic

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.campaign.schema.tables import GridKeys
    from levkas.database.layout import Places
    from levkas.geometry.joining import Box
    from levkas.registration import BandImage
    from levkas.registration.predictors import PreparedReference
    from levkas.stages.parts import CalibratedCapture

    Grey = tuple[np.ndarray, np.ndarray]
    Region = tuple[float, float, float, float]


class ReferenceFrame:
    """The reference camera's bands of one object, its registration, and the grid that they lay out.

    `captures` are the object's, the reference camera's own first, and `native` is that one calibrated.
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
        self._tiled = native if self.capture.tiles else None
        self._images: Sequence[BandImage] | None = None
        self._own: Registration | None = None
        self._prepared: PreparedReference | None = None
        self.grey: Grey | None = None
        """Of its layer, where that was drawn or read already."""

    @property
    def images(self) -> Sequence[BandImage]:
        """Its bands; those of tiles joined, once they are placed. Raises RegistrationRefused (``E_SIZE``) of a mosaic too large for that."""
        if self._images is None:
            if self._tiled is not None:
                self._images = view_of_mosaic(self._placed(), self.capture, self.band)
            else:
                assert self._native is not None
                native, self._native = self._native, None
                self._images = native.images()
        return self._images

    @images.setter
    def images(self, images: Sequence[BandImage]) -> None:
        self._images = images

    def _placed(self) -> CalibratedCapture:
        """Return its tiles, once they are placed."""
        assert self._tiled is not None
        if self._tiled.placement is None:
            self._tiled.placement = Placement.of(record_of(self.places, self.capture))
        return self._tiled

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the reference band."""
        return self._image().size if self._tiled is None else self._placed().size_of(self.band)

    @property
    def step(self) -> int:
        """Reference px in one of the overview, along a side."""
        return coarseness(*self.size) if self._tiled is not None else 1

    @cached_property
    def overview(self) -> Sequence[BandImage]:
        """Its bands, or of a large mosaic those that show it whole with `step` px a side in one."""
        if self._tiled is None or self.step == 1:
            return self.images
        return view_of_mosaic(self._placed(), self.capture, self.band, step=self.step)

    def part(self, box: Box) -> tuple[Sequence[BandImage], dict[str, Transform], int]:
        """Return the bands in a box, and the maps from px of the box to those of each band's picture.

        The box is left, top, and behind the right and the bottom, reference px. Of a mosaic too large to be held, the box too may be: the
        third value says how many reference px a side make one of it.
        """
        if self.step > 1:
            step = coarseness(box[2] - box[0], box[3] - box[1])
            cut = view_of_mosaic(self._placed(), self.capture, self.band, box, step)
            return cut, {image.label: Affine.identity() for image in cut}, step
        return *cropped(self.images, self.registration().transforms, box), 1

    @cached_property
    def band(self) -> str:
        """Label of the reference band."""
        bands, wanted = self.capture.bands, self.campaign.reference.band
        if wanted is None:
            return middle_band(bands)
        labels = [band.label for band in bands]
        return labels[find_band(labels, wanted, [band.wavelength for band in bands])]

    @property
    def outline(self) -> tuple[tuple[float, float], ...] | None:
        """The declared corners of the object, reference px; None where none are declared."""
        return self.campaign.outline_of(self.capture.object)[0] or None

    @cached_property
    def area(self) -> ObjectArea:
        """Where the object lies in the overview: all that needs the object takes it from here."""
        anchor = self._image()
        own = [image for image in self.overview if image.sensor == anchor.sensor]
        grey = mean_picture([*sqrt_images(own).values()])
        outline = (np.array(self.outline or ()) + 0.5) / self.step - 0.5
        return ObjectArea.of(grey, outline=outline)

    def prepared(self, region: Region | None, *, own: bool) -> PreparedReference:
        """Return the bands as the default method takes them, prepared once for all captures.

        `own` where the reference camera itself is registered: all its bands are held until then.
        """
        from levkas.registration.predictors import PreparedReference

        if self._prepared is None:
            area = replace(self.area, region=region)
            self._prepared = PreparedReference(self.images, self.band, area=area)
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
            bands = record["bands"].items()
            sigma = {
                label: Sigma.from_dict(band["sigma"]) for label, band in bands if "sigma" in band
            }
            self._own = Registration(
                "", maps_of(record), Verdict("accept"), {}, Matches.none(), sigma=sigma
            )
        return self._own

    def layout(self) -> tuple[Grid, Region | None]:
        """Return the grid, and the declared region in reference px."""
        edge = (self.area.edge + 0.5) * self.step - 0.5
        try:
            return lay_grid(self.size, self.campaign.grid, edge)
        except GridRefused as refused:
            file = str(self.campaign.path)
            raise GridRefused(*(replace(p, file=file) for p in refused.problems)) from None

    def _image(self) -> BandImage:
        return next(image for image in self.overview if image.label == self.band)

    def channel(self, capture: Capture) -> str:
        wanted = next(b for b in self.capture.bands if b.label == self.band)
        return reference_channel(self.campaign, capture.camera, capture.bands, wanted.wavelength)


def record_of(places: Places, capture: Capture) -> dict[str, Any]:
    """Return the registration record of a capture."""
    return read_registration(places.registration(capture.object, capture.layer))


def maps_of(record: dict[str, Any]) -> dict[str, Transform]:
    """Return the maps of a record's bands, reference px to native px, by label."""
    return {label: from_dict(band["transform"]) for label, band in record["bands"].items()}


def maps_on_grid(record: dict[str, Any]) -> dict[str, Transform]:
    """Return the maps of a record's bands, grid px to native px, by label."""
    to_reference = from_dict(record["grid"]["transform"])
    return {label: Composed(to_reference, one) for label, one in maps_of(record).items()}


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


def lay_grid(
    size: tuple[int, int], keys: GridKeys | None, edge: np.ndarray
) -> tuple[Grid, Region | None]:
    """Return the grid of a reference band, and the declared region in reference px, (x, y, width, height).

    ``region = "auto"`` is the bounding box of `edge`, corners of the object, (n, 2) reference px; without any the whole
    frame.
    """
    if keys is None:
        return Grid(size), None
    turned = Grid(size, mirror=keys.mirror, rotate=keys.rotate)
    region, declared = keys.region, None
    if region == "auto":
        region = _box_around(turned.transform.inverse(edge), whole_px=True) if len(edge) else None
    elif region is not None:
        x, y, w, h = region
        corners = np.array([[x, y], [x + w - 1, y], [x + w - 1, y + h - 1], [x, y + h - 1]], float)
        declared = _box_around(turned.transform(corners))
    grid = Grid(size, mirror=keys.mirror, rotate=keys.rotate, region=region, output=keys.size)
    return grid, declared


def _box_around(points: np.ndarray, *, whole_px: bool = False) -> Region:
    """Return the box, (x, y, width, height) px, around centres of pixels, (n, 2)."""
    low, high = points.min(0), points.max(0)
    if whole_px:
        low, high = np.floor(low), np.ceil(high)
    return float(low[0]), float(low[1]), float(high[0] - low[0] + 1), float(high[1] - low[1] + 1)

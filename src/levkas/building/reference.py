"""What all captures of an object are registered to, made ready once for all of them."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.database.registrations import read_registration

if TYPE_CHECKING:
    from collections.abc import Callable

    from levkas.building.native import Native
    from levkas.building.scans import Scan
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.find_captures import Capture
    from levkas.database.layout import Places
    from levkas.geometry.grid import Grid
    from levkas.registration import BandImage, Registration
    from levkas.registration.levkas import PreparedReference

    Grey = tuple[np.ndarray, np.ndarray]
    Region = tuple[float, float, float, float]


@dataclass
class ReferenceFrame:
    """The reference camera's images, registration, grid and grey picture, found when they are asked for.

    Parameters
    ----------
    campaign : Campaign
    places : Places
    name : str
        Of the object.
    captures : list of Capture
        The reference camera's own first.
    calibrated : callable
        Gives the calibrated cubes of a capture; it keeps them in the list that it is given.
    """

    campaign: Campaign
    places: Places
    name: str
    captures: list[Capture]
    calibrated: Callable[[Capture, list[Native | Scan]], Native | Scan]
    own: Registration | None = None
    made_ready: PreparedReference | None = None
    _images: list[BandImage] | None = None
    _grid: tuple[Grid, float | None, Region | None] | None = None
    _grey: Grey | None = field(default=None, repr=False)

    @property
    def capture(self) -> Capture:
        """The reference camera's own."""
        return self.captures[0]

    def band(self) -> str:
        from levkas.core.cube import find_band

        bands = self.capture.bands
        wanted = self.campaign.reference.band
        labels = [band.label for band in bands]
        if wanted is None:
            return labels[len(labels) // 2]
        return labels[find_band(labels, wanted, [band.wavelength for band in bands])]

    def images(self, native: list[Native | Scan]) -> list[BandImage]:
        if self._images is None:
            self._images = self.calibrated(self.capture, native).images()
        return self._images

    def ready(
        self,
        native: list[Native | Scan],
        region: Region | None,
        own: Registration | None,
    ) -> PreparedReference:
        """The reference made ready for all captures; its single bands go once it is registered."""
        from levkas.registration.levkas import PreparedReference

        if self.made_ready is None:
            images = self.images(native if own is None else [])
            self.made_ready = PreparedReference(images, self.band(), region)
            if own is not None:
                self.settle()
        return self.made_ready

    def settle(self) -> None:
        methods = {self.campaign.registration_of(c.camera).get("method") for c in self.captures}
        if self.made_ready is not None and methods <= {None, "levkas"}:
            self.made_ready.freeze(self.registration().transforms)
            self._images = [self.made_ready.anchor]

    def registration(self) -> Registration:
        """The reference camera's own registration, from this run or from its record."""
        if self.own is None:
            from levkas.registration import Matches, Registration, Verdict
            from levkas.registration.record import Sigma

            record = record_of(self.places, self.name, self.capture)
            bands = record["bands"]
            self.own = Registration(
                "",
                maps_of(record),
                Verdict("accept"),
                {},
                Matches.none(),
                sigma={
                    label: Sigma.from_dict(band["sigma"])
                    for label, band in bands.items()
                    if "sigma" in band
                },
            )
        return self.own

    def description(self) -> dict[str, Any]:
        image = next(i for i in self.images([]) if i.label == self.band())
        return {"camera": self.capture.camera, "band": image.label, "size": list(image.size)}

    def layout(self, native: list[Native | Scan]) -> tuple[Grid, float | None, Region | None]:
        """The grid, its sampling in px per mm where known, and the object's region in reference px."""
        if self._grid is None:
            from levkas.building.framing import frame_object
            from levkas.geometry.grid import GridRefused

            image = next(i for i in self.images(native) if i.label == self.band())
            facts = self.campaign.objects.get(self.name)
            size_mm = facts.size_mm if facts else None
            try:
                self._grid = frame_object(image, self.campaign.grid, size_mm)
            except GridRefused as refused:
                file = str(self.campaign.path)
                raise GridRefused(*(replace(p, file=file) for p in refused.problems)) from None
        return self._grid

    def channel(self, capture: Capture) -> str:
        from levkas.building.channels import reference_channel

        wanted = next(b for b in self.capture.bands if b.label == self.band())
        return reference_channel(self.campaign, capture.camera, capture.bands, wanted.wavelength)

    def similarity(self, capture: Capture, grey: Grey) -> dict[str, Any]:
        """SSIM against the reference layer, and its map as PNG text, for the report."""
        from levkas.building.resampling import read_grey, shrink_map
        from levkas.database.preview import encode_png
        from levkas.quality.evaluation.similarity import structural_similarity

        if capture is self.capture:
            self._grey = grey
            return {"ssim": None, "ssim_map": ""}
        if self._grey is None:
            self._grey = read_grey(self.places.layer(self.name, self.capture.camera))
        score, full = structural_similarity(self._grey[0], grey[0], self._grey[1] & grey[1])
        if np.isnan(score):
            return {"ssim": None, "ssim_map": ""}
        return {
            "ssim": score,
            "ssim_map": base64.b64encode(encode_png(shrink_map(full))).decode("ascii"),
        }


def record_of(places: Places, name: str, capture: Capture) -> dict[str, Any]:
    """Return the registration record of a capture."""
    path = places.registration(name, capture.layer)
    return read_registration(path)


def transforms_of(places: Places, name: str, capture: Capture) -> dict[str, Any]:
    """Return the maps of a capture's bands, reference px to native px, by label."""
    return maps_of(record_of(places, name, capture))


def maps_of(record: dict[str, Any]) -> dict[str, Any]:
    """Return the maps of a record's bands, reference px to native px, by label."""
    from levkas.geometry.transforms import from_dict

    return {label: from_dict(band["transform"]) for label, band in record["bands"].items()}

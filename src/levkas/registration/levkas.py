"""The default method: key points for the start, dense prediction for every band, models by held-out blocks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Transform
from levkas.registration.record import Registration

if TYPE_CHECKING:
    from levkas.registration.images import BandImage
    from levkas.registration.manual_points import Given
    from levkas.registration.predictors import Scene
    from levkas.registration.uncertainty import Sigma

MOST_PREDICTING = 12
MOST_GREYS = 4


class Reference:
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
        from levkas.registration.foreground import describe_mask, find_object
        from levkas.registration.key_points import KeyPictures
        from levkas.registration.pictures import images_of

        self.anchor = next(image for image in bands if image.label == band)
        self.siblings = [image for image in bands if image.sensor == self.anchor.sensor]
        self.images = images_of(bands)
        greys = _Greys([self.images[image.label] for image in self.siblings])
        asked, body = _inside(region, self.anchor.values.shape), find_object(greys[0])
        self._within = asked & body
        self.mask = describe_mask(body, region)
        self.keys, self._greys = KeyPictures(greys, self._within), greys
        self._scene: Scene | None = None

    def object_in(self, band: BandImage) -> np.ndarray:
        """Return a band's picture, NaN where the object is not."""
        return np.where(self._within, self.images[band.label], np.float32(np.nan))

    def predicting(self) -> list[BandImage]:
        """Return at most 12 bands, evenly over the wavelengths, the anchor among them."""
        return _spread(self.siblings, self.anchor)

    def scene(self, transforms: Mapping[str, Transform]) -> Scene:
        """Return what predicts other bands; `transforms` of the reference camera's own bands."""
        from levkas.registration.predictors import Scene, registered

        if self._scene is None:
            bands = self.predicting()
            masked = {band.label: self.object_in(band) for band in bands}
            known = {band.label: transforms[band.label] for band in bands}
            stack = registered(masked, known, self.anchor.values.shape)
            self._scene = Scene(stack, [band.wavelength for band in bands])
        return self._scene

    def rest(self) -> None:
        """Let go of what one camera alone needs and the next one can make again."""
        if self._scene is not None:
            self._scene.forget()

    def settle(self, transforms: Mapping[str, Transform]) -> None:
        """Make all that other cameras need of the single bands, and let go of these."""
        self.scene(transforms)
        self._greys.settle()
        self.images = {}


def register_levkas(
    reference: Sequence[BandImage],
    target: Sequence[BandImage],
    *,
    reference_band: str,
    reject: float | None = None,
    stop: float = 1.0,
    region: Sequence[float] | None = None,
    rng: np.random.Generator | None = None,
    reference_transforms: Mapping[str, Transform] | None = None,
    reference_sigma: Mapping[str, Sigma] | None = None,
    ready: Callable[[], Reference] | None = None,
    given: Mapping[str, Given] | None = None,
) -> Registration:
    """Register every band of `target` to the reference band.

    Parameters
    ----------
    reference, target : sequence of BandImage
        Of either camera; the same sequence for the reference camera's own bands.
    reference_band : str
        Label of the band of `reference` that defines reference px.
    reject, stop : float, reference px
        Of the paper's method; nothing here depends on them.
    region : (x, y, width, height), reference px, optional
        Where the object lies; nothing outside is used.
    rng : numpy.random.Generator, optional
        Not drawn from: the method is deterministic.
    reference_transforms : mapping of label to Transform, optional
        Of the reference camera's own bands, from its own registration: saves measuring them again.
    reference_sigma : mapping of label to Sigma, optional
        How well those are known.
    ready : callable, optional
        Returns the reference made ready: saves preparing it for every camera.
    given : mapping of sensor name to Given, optional
        Pairs by hand; four of them start a sensor that key points do not.

    Returns
    -------
    registration : Registration

    Raises
    ------
    RegistrationRefused
        Where no start is found (``E_MATCHES``), or too little of the frames can be compared
        (``E_WINDOWS``).
    """
    from levkas.registration.assessment import assess
    from levkas.registration.key_points import KeyPictures
    from levkas.registration.pictures import images_of
    from levkas.registration.reference_bands import align_own
    from levkas.registration.sensors import align_sensor

    base = ready() if ready else Reference(reference, reference_band, region)
    own, anchor = target is reference, base.anchor
    first = None
    if reference_transforms is None or own:
        bands = base.siblings if own else base.predicting()
        first = align_own(bands, {band.label: base.object_in(band) for band in bands}, anchor)
        reference_transforms, reference_sigma = first.transforms, first.sigma
    sensors = [first] if own and first is not None else []
    names = dict.fromkeys(i.sensor for i in target if not own or i.sensor != anchor.sensor)
    if names:
        scene = base.scene(reference_transforms)
        pictures = base.images if own else images_of(target)
        for name in names:
            bands = [image for image in target if image.sensor == name]
            theirs = KeyPictures(_Greys([pictures[band.label] for band in bands]))
            hand = (given or {}).get(name)
            sensors.append(
                align_sensor(bands, pictures, scene, base.keys, theirs, hand, reference_sigma)
            )
    return assess(sensors, [image.label for image in target], base.mask)


def _inside(region: Sequence[float] | None, shape: tuple[int, int]) -> np.ndarray:
    inside = np.ones(shape, bool)
    if region is not None:
        x, y, width, height = (round(float(v)) for v in region)
        inside[:] = False
        inside[max(y, 0) : max(y + height, 0), max(x, 0) : max(x + width, 0)] = True
    return inside


def _spread(bands: Sequence[BandImage], anchor: BandImage) -> list[BandImage]:
    """Return at most 12 bands, evenly over the wavelengths, the anchor among them."""
    from levkas.registration.sensors import ordered

    bands = ordered(bands)
    picks = np.linspace(0, len(bands) - 1, min(MOST_PREDICTING, len(bands))).round().astype(int)
    places = sorted({*picks.tolist(), bands.index(anchor)})
    return [bands[i] for i in places]


class _Greys(Sequence[np.ndarray]):
    """The mean of all bands brought to one contrast, and up to four others, made when asked for.

    Those are the bands themselves where they are few, else means of parts of the spectrum.
    """

    def __init__(self, images: Sequence[np.ndarray]) -> None:
        self._images = images
        parts = np.array_split(np.arange(len(images)), min(MOST_GREYS, len(images)))
        self._groups = [range(len(images)), *(parts if len(images) > 1 else ())]
        self._made: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._groups)

    def settle(self) -> None:
        """Make all of them, and let go of the bands."""
        for i in range(len(self)):
            self[i]
        self._images = []

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(len(self)))]
        if i not in self._made:
            total = np.zeros(self._images[0].shape, np.float32)
            count = np.zeros(self._images[0].shape, np.float32)
            for k in self._groups[i]:
                image = self._images[k]
                known = np.isfinite(image)
                some = image[::2, ::2][known[::2, ::2]]
                if not some.size:
                    continue
                spread = np.float32(max(float(np.std(some)), 1e-12))
                total += np.where(known, image / spread, np.float32(0))
                count += known
            with np.errstate(divide="ignore", invalid="ignore"):
                self._made[i] = total / count
        return self._made[i]

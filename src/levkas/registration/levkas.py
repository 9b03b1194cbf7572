"""The default method: key points for the initial transform, dense shifts for every band, models by held-out blocks.

`docs/explanation/registration.md` describes it on one page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Transform
from levkas.registration.bands import describe_mask, segment_foreground, sqrt_images
from levkas.registration.coarse_to_fine import RegisteredSensor, by_wavelength, register_sensor
from levkas.registration.features import CameraFeatures
from levkas.registration.joint import SensorObservations
from levkas.registration.predictors import ReferenceStack, resample_bands
from levkas.registration.record import (
    Matches,
    MatchState,
    Registration,
    Sigma,
    describe_windows,
)
from levkas.registration.reference_bands import register_own_bands
from levkas.registration.verdict import ONLY, judge_windows

if TYPE_CHECKING:
    from levkas.campaign.methods import LevkasOptions
    from levkas.registration.bands import BandImage
    from levkas.registration.request import Request

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
        greys = _Greys([self.images[image.label] for image in self.own_bands])
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


def register_levkas(request: Request, _options: LevkasOptions) -> Registration:
    """Register every band of the target to the reference band; deterministic, without options.

    Raises
    ------
    RegistrationRefused
        Where no initial transform is found (``E_MATCHES``), or too little of the frames can be compared
        (``E_WINDOWS``).
    """
    base = (
        request.prepared()
        if request.prepared
        else PreparedReference(request.reference, request.reference_band, request.region)
    )
    own, anchor, target = request.is_own, base.anchor, request.target
    transforms, sigma = request.reference_transforms, request.reference_sigma
    sensors = []
    if transforms is None or own:
        bands = base.own_bands if own else base.predicting()
        images = {band.label: base.object_in(band) for band in bands}
        first = register_own_bands(bands, images, anchor)
        transforms, sigma = first.transforms, first.sigma
        sensors = [first] if own else []
    names = dict.fromkeys(i.sensor for i in target if not own or i.sensor != anchor.sensor)
    if names:
        stack = base.stack(transforms)
        pictures = base.images if own else sqrt_images(target)
        for name in names:
            bands = [image for image in target if image.sensor == name]
            theirs = CameraFeatures(_Greys([pictures[band.label] for band in bands]))
            by_hand = request.given.get(name)
            sensors.append(
                register_sensor(bands, pictures, stack, base.keys, theirs, by_hand, sigma)
            )
    return _assemble(sensors, [image.label for image in target], base.mask)


def _inside(region: Sequence[float] | None, shape: tuple[int, int]) -> np.ndarray:
    inside = np.ones(shape, bool)
    if region is not None:
        x, y, width, height = (round(float(v)) for v in region)
        inside[:] = False
        inside[max(y, 0) : max(y + height, 0), max(x, 0) : max(x + width, 0)] = True
    return inside


class _Greys(Sequence[np.ndarray]):
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


# --- the record


def _assemble(
    sensors: Sequence[RegisteredSensor], labels: Sequence[str], mask: dict[str, Any]
) -> Registration:
    """Return the registration of a camera with `sensors`, bands in the order of `labels`."""
    transforms: dict[str, Transform] = {}
    sigma: dict[str, Sigma] = {}
    for sensor in sensors:
        transforms.update(sensor.transforms)
        sigma.update(sensor.sigma)
    return Registration(
        method="levkas",
        transforms={label: transforms[label] for label in labels},
        verdict=judge_windows({s.name or ONLY: _numbers(s) for s in sensors}),
        errors={"bands": _band_errors(sensors), "sensors": {s.name: _numbers(s) for s in sensors}},
        matches=_matches(sensors[0]),
        model={"kind": "levkas", "mask": mask, "sensors": [_model(s) for s in sensors]},
        sigma={label: sigma[label] for label in labels},
        others={s.name: _matches(s) for s in sensors[1:] if s.initial is not None},
        observations=tuple(_observations(sensor) for sensor in sensors),
        basis={"kind": "windows", "sensors": [_basis(s) for s in sensors]},
    )


def _model(sensor: RegisteredSensor) -> dict[str, Any]:
    found = sensor.refined
    return {
        "sensor": sensor.name,
        "base": found.selected.name if found else "identity",
        "ladder": found.selected.scores if found else {},
        "climbs": found.selections if found else [],
        "chromatic": sensor.chromatic.kind,
        "mirrored": bool(sensor.initial.mirrored) if sensor.initial else False,
        "step": found.step if found else 1,
        "rounds": found.course["rounds"] if found else None,
        "settled": found.course["settled"] if found else None,
    }


def _numbers(sensor: RegisteredSensor) -> dict[str, Any]:
    """Return the evidence on a sensor; of the reference's own, which is registered to nothing, nearly none."""
    found, initial = sensor.refined, sensor.initial
    course = found.course if found else {}
    evidence = found.evidence if found else {}
    verification = found.verification if found else {}
    selected = found.selected if found else None
    return {
        "held_out_px": selected.held_out_error if selected else None,
        "windows": len(selected.weights) if selected else None,
        "share_above_chance": evidence.get("share_above_chance"),
        "cover": evidence.get("cover"),
        "step": found.step if found else 1,
        "key_points_kept": int(initial.kept.sum()) if initial else None,
        "key_points": len(initial.kept) if initial else None,
        "rounds": course.get("rounds"),
        "settled": course.get("settled"),
        "moved": course.get("moved"),
        "checked": verification.get("checked"),
        "alike": bool(found and found.shares_light),
        "terms": selected.spec.coefficients if selected and selected.spec else None,
        "borne_out": verification,
    }


def _basis(sensor: RegisteredSensor) -> dict[str, Any]:
    """Return the windows on which a sensor's base map rests; of the reference's own, which has none, its name."""
    found = sensor.refined
    if found is None:
        return {"sensor": sensor.name}
    labels = list(sensor.windows)
    source = labels[0] if len(labels) == 1 else "fused"
    return describe_windows(sensor.name, source, found.course["band"], found.selected, found.checks)


def _band_errors(sensors: Sequence[RegisteredSensor]) -> dict[str, dict[str, float]]:
    result = {}
    for sensor in sensors:
        for label, windows in sensor.windows.items():
            used = np.trace(windows.information, axis1=1, axis2=2) > 0
            result[label] = {
                "windows": int(used.sum()),
                "explained": float(np.median(windows.r2[used])) if used.any() else 0.0,
            }
    return result


def _matches(sensor: RegisteredSensor) -> Matches:
    """Return the matches of the initial transform with their residuals under the base map."""
    initial, found = sensor.initial, sensor.refined
    if initial is None or found is None:
        return Matches.none()
    miss = initial.target - found.base(initial.reference)
    jacobian = found.base.jacobian(initial.reference)
    residual = np.linalg.norm(np.linalg.solve(jacobian, miss[..., None])[..., 0], axis=1)
    kept = initial.kept
    reason = np.where(kept, "", "does not agree with the map of the others").astype(object)
    if initial.reason is not None:
        reason = np.where(initial.reason == "", reason, initial.reason)
    return Matches.of(
        initial.reference,
        initial.target,
        residual=residual,
        # The map rests on windows, not on pairs: each pair measures what it did not see.
        leave_one_out=residual,
        weight=kept.astype(float),
        state=np.where(kept, MatchState.KEPT, MatchState.REMOVED).astype(object),
        reason=reason,
        round=np.where(kept, -1, 0),
    )


def _observations(sensor: RegisteredSensor) -> SensorObservations:
    """Return what is kept of a registered sensor to adjust it with other captures."""
    labels, found = tuple(sensor.sigma), sensor.refined
    if found is None:
        return SensorObservations.of_reference(sensor.name, labels, sensor.chromatic)
    selected = found.selected
    return SensorObservations(
        sensor.name, labels, found.base, sensor.chromatic, selected.held_out_error,
        selected.observations, selected.terms,
    )  # fmt: skip

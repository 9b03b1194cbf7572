"""Default method: key points for the initial transform, dense shifts for every band, models by held-out blocks.

`docs/explanation/registration.md` describes it on one page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Transform, solve_2x2
from levkas.registration.bands import by_wavelength, present_bands, sqrt_images
from levkas.registration.chromatic import measured_bands, zero_displacement
from levkas.registration.coarse_to_fine import (
    Begin,
    RegisteredSensor,
    frame_centre,
    register_sensor,
)
from levkas.registration.features import CameraFeatures, grey_pictures
from levkas.registration.initial import find_coarse_transform, find_initial_transform
from levkas.registration.manual_points import ManualPoints
from levkas.registration.map_stack import gather_signal
from levkas.registration.placed_by_hand import place_by_hand
from levkas.registration.predictors import PreparedReference
from levkas.registration.record import (
    Matches,
    MatchState,
    Registration,
    RegistrationRefused,
    Sigma,
    describe_windows,
)
from levkas.registration.reference_bands import lie_together, register_own_bands
from levkas.registration.starts import (
    agreeing_pairs,
    begin_with,
    begin_with_pairs,
    declared_map,
    distance_between,
    read_alignments,
    start_candidates,
)
from levkas.registration.verdict import ALIGN_PX, ONLY, judge
from levkas.registration.window_fusion import has_information

if TYPE_CHECKING:
    from levkas.registration.methods import LevkasOptions
    from levkas.registration.predictors import ReferenceStack
    from levkas.registration.request import Request


def register_levkas(request: Request, options: LevkasOptions) -> Registration:
    """Register every band of the target to the reference band; deterministic.

    Raises RegistrationRefused where no initial transform is found (``E_MATCHES``), or too little of the frames can be
    compared (``E_WINDOWS``).
    """
    base = (
        request.prepared()
        if request.prepared
        else PreparedReference(
            request.reference, request.reference_band, request.region, request.outline
        )
    )
    own, anchor = request.is_own, base.anchor
    transforms, sigma = request.reference_transforms, request.reference_sigma
    sensors = []
    if transforms is None or own:
        bands = base.own_bands if own else base.predicting()
        images = {band.label: base.object_in(band) for band in bands}
        lying = own and request.one_scan
        first = lie_together(bands, anchor) if lying else register_own_bands(bands, images, anchor)
        transforms, sigma = first.transforms, first.sigma
        sensors = [first] if own else []
    sensors_of = (i.sensor for i in request.target if not own or i.sensor != anchor.sensor)
    names = list(dict.fromkeys(sensors_of))
    share = base.area.share_of(request.layer)
    if names:
        target = _Target(request, base, base.stack(transforms), sigma, share)
        sensors += target.register_all(names)
    return _assemble(sensors, [i.label for i in request.target], base.area.to_dict(), share)


@dataclass(frozen=True)
class _Target:
    """A camera to be registered, and the reference made ready for it."""

    request: Request
    base: PreparedReference
    stack: ReferenceStack
    reference_sigma: Mapping[str, Sigma] | None
    object_share: float
    """Share of the layer that shows the object."""

    def register_all(self, names: Sequence[str]) -> list[RegisteredSensor]:
        """Register every sensor by itself; where a declared alignment helps or contradicts, begin with it too, and where the verdict refuses, with pairs.

        Raises RegistrationRefused of the first sensor without a map. Of two registered sensors the distance from the declared
        alignment is the second's alone.
        """
        request, shape = self.request, self.stack.shape
        leader = request.target[0].sensor
        align = {leader: Affine.identity()} | read_alignments(request.align)
        known: dict[str, Transform] = (
            {self.base.anchor.sensor: Affine.identity()} if request.is_own else {}
        )
        tried = dict(zip(names, each(self.attempt, names), strict=True))
        found = []
        for name, one in tried.items():
            others = known | {
                other: sensor.base
                for other, sensor in tried.items()
                if other != name and isinstance(sensor, RegisteredSensor) and sensor.base
            }
            declared = declared_map(name, align, others)
            if declared is not None:
                one = self.begin_anew(name, one, declared)
            one = self.begin_with_pairs(name, one)
            if isinstance(one, RegistrationRefused):
                raise one
            if declared is not None and (
                name != leader or declared_map(name, align, known) is not None
            ):
                one = one.knowing(align_apart_px=_apart(one, declared, shape))
            found.append(one)
        return found

    def attempt(
        self, name: str, begin: Begin | None = None
    ) -> RegisteredSensor | RegistrationRefused:
        """Register one sensor, or return its refusal."""
        try:
            return self.register_one(name, begin)
        except RegistrationRefused as refusal:
            return refusal

    def register_one(self, name: str, begin: Begin | None) -> RegisteredSensor:
        """Register one sensor, from key points where `begin` is none; where a person's pairs are to place it, by these alone."""
        request, base = self.request, self.base
        by_hand = request.given.get(name) or ManualPoints()
        mine = [image for image in request.target if image.sensor == name]
        bands, labels, shape = (
            by_wavelength(mine),
            [image.label for image in mine],
            self.stack.shape,
        )
        if by_hand.accepted:
            placed = place_by_hand(by_hand, shape, name)
            one = RegisteredSensor(
                name,
                {},
                zero_displacement(1, *frame_centre(shape)),
                {},
                base=placed.transform,
                placed=placed,
            )
            return _with_one_map(one, labels, placed.sigma(shape), shape)
        there = present_bands(bands)
        if request.one_scan:
            bands = there = gather_signal(there)
        shown = [there[i] for i in measured_bands(there)]
        pictures = (
            {band.label: base.images[band.label] for band in shown}
            if request.is_own
            else sqrt_images(shown)
        )
        start = find_coarse_transform if request.one_scan else find_initial_transform
        found = register_sensor(
            bands, pictures, self.stack, base.keys, CameraFeatures(grey_pictures(list(pictures.values()))),
            by_hand, self.reference_sigma, begin or start,
        ).knowing(object_share=self.object_share)  # fmt: skip
        if not request.one_scan:
            return found
        return _with_one_map(found, labels, next(iter(found.sigma.values())), shape)

    def begin_anew(
        self, name: str, one: RegisteredSensor | RegistrationRefused, declared: Transform
    ) -> RegisteredSensor | RegistrationRefused:
        """Register again from where a declared alignment puts a sensor, if its own map is not there; return what more windows confirm."""
        if isinstance(one, RegisteredSensor) and (
            one.placed or _apart(one, declared, self.stack.shape) <= ALIGN_PX
        ):
            return one
        other = self.attempt(name, partial(begin_with, declared))
        return other if _agreeing(other) > _agreeing(one) else one

    def begin_with_pairs(
        self, name: str, one: RegisteredSensor | RegistrationRefused
    ) -> RegisteredSensor | RegistrationRefused:
        """Register a refused sensor again from where pairs put it; return the first map that is not refused, else what it was.

        Where there is a map, how many of the pairs agree with it is counted.
        """
        shape = self.stack.shape
        pairs = (self.request.given.get(name) or ManualPoints()).starts
        if _is_refused(one):
            for candidate in start_candidates(pairs, shape):
                other = self.attempt(name, partial(begin_with_pairs, candidate))
                if not _is_refused(other):
                    return _counted(other, pairs, shape, used=True)
        return _counted(one, pairs, shape, used=False)


def _counted(
    one: RegisteredSensor | RegistrationRefused,
    pairs: np.ndarray,
    shape: tuple[int, int],
    *,
    used: bool,
) -> RegisteredSensor | RegistrationRefused:
    """Return a sensor with how many pairs of another program agree with its map."""
    if isinstance(one, RegistrationRefused) or not len(pairs) or one.base is None:
        return one
    agreeing = int(agreeing_pairs(one.base, pairs, shape).sum())
    return one.knowing(start_pairs={"given": len(pairs), "agreeing": agreeing, "used": used})


def _is_refused(one: RegisteredSensor | RegistrationRefused) -> bool:
    """Whether there is no map, or the verdict refuses it."""
    if isinstance(one, RegistrationRefused):
        return True
    return one.evidence is not None and judge({ONLY: one.evidence}).decision == "refuse"


def _agreeing(one: RegisteredSensor | RegistrationRefused) -> int:
    """Return how many windows confirm a map, -1 without one."""
    if isinstance(one, RegistrationRefused):
        return -1
    return one.evidence.agreeing if one.evidence else 0


def _apart(sensor: RegisteredSensor, declared: Transform, shape: tuple[int, int]) -> float:
    """Return how far a sensor's map lies from its declared alignment, px of the sensor."""
    return 0.0 if sensor.base is None else distance_between(sensor.base, declared, shape)


def _with_one_map(
    one: RegisteredSensor, labels: Sequence[str], sigma: Sigma, shape: tuple[int, int]
) -> RegisteredSensor:
    """Return a sensor all of whose bands have its base map."""
    assert one.base is not None, "a sensor that was registered or placed has a map"
    return replace(
        one,
        transforms=dict.fromkeys(labels, one.base),
        sigma=dict.fromkeys(labels, sigma),
        chromatic=zero_displacement(len(labels), *frame_centre(shape)),
    )


# --- the record


def _assemble(
    sensors: Sequence[RegisteredSensor],
    labels: Sequence[str],
    mask: dict[str, Any],
    object_share: float,
) -> Registration:
    """Return the registration of a camera with `sensors`, bands in the order of `labels`."""
    placed = {s.name or ONLY: s.placed.to_dict() for s in sensors if s.placed}
    verdict = judge({s.name or ONLY: s.evidence for s in sensors}, object_share, placed)
    transforms: dict[str, Transform] = {}
    sigma: dict[str, Sigma] = {}
    for sensor in sensors:
        transforms.update(sensor.transforms)
        sigma.update(sensor.sigma)
    numbers = zip((s.name for s in sensors), verdict.numbers.values(), strict=True)
    return Registration(
        method="by hand" if all(s.placed for s in sensors) else "levkas",
        transforms={label: transforms[label] for label in labels},
        verdict=verdict,
        errors={"bands": _band_errors(sensors), "sensors": dict(numbers)},
        matches=_matches(sensors[0]),
        model={"kind": "levkas", "mask": mask, "sensors": [_model(s) for s in sensors]},
        sigma={label: sigma[label] for label in labels},
        others={s.name: _matches(s) for s in sensors[1:] if s.base is not None},
        basis={"kind": "windows", "sensors": [_basis(s) for s in sensors]},
    )


def _model(sensor: RegisteredSensor) -> dict[str, Any]:
    found, placed = sensor.refined, sensor.placed
    return {
        "sensor": sensor.name,
        "base": found.selected.name if found else placed.model if placed else "identity",
        "scores": found.selected.scores if found else {},
        "chromatic": sensor.chromatic.kind,
        "mirrored": bool(sensor.initial.mirrored)
        if sensor.initial
        else bool(placed and placed.is_mirrored),
    }


def _basis(sensor: RegisteredSensor) -> dict[str, Any]:
    """Return the windows on which a sensor's base map rests; of the reference's own, which has none, its name."""
    found = sensor.refined
    if found is None:
        return {"sensor": sensor.name}
    labels = list(sensor.windows)
    source = labels[0] if len(labels) == 1 else "fused"
    windows = describe_windows(sensor.name, source, found.band, found.selected, found.checks)
    lines = sensor.correction.before if sensor.correction else sensor.lines
    return windows | {"lines": lines and lines.drawn()}


def _band_errors(sensors: Sequence[RegisteredSensor]) -> dict[str, dict[str, float | None]]:
    """Return windows and explained share of every band, in the order of the maps; 0 and None of one not measured."""
    result: dict[str, dict[str, float | None]] = {}
    for sensor in sensors:
        for label in sensor.transforms if sensor.windows else ():
            result[label] = {"windows": 0, "explained": None}
            if label in sensor.windows:
                windows = sensor.windows[label]
                used = has_information(windows.information)
                explained = float(np.median(windows.r2[used])) if used.any() else 0.0
                result[label] = {"windows": int(used.sum()), "explained": explained}
    return result


def _matches(sensor: RegisteredSensor) -> Matches:
    """Return the matches of the initial transform with their residuals under the base map, or a person's pairs."""
    if sensor.placed:
        return sensor.placed.matches()
    initial, base = sensor.initial, sensor.base
    if initial is None or base is None:
        return Matches.none()
    miss = initial.target - base(initial.reference)
    jacobian = base.jacobian(initial.reference)
    residual = np.linalg.norm(solve_2x2(jacobian, miss), axis=1)
    kept = initial.kept
    reason = np.where(kept, "", "contradicts the map of the other pairs").astype(object)
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

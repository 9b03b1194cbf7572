"""Default method: key points for the initial transform, dense shifts for every band, models by held-out blocks.

`docs/explanation/registration.md` describes it on one page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Transform, solve_2x2
from levkas.registration.alignment import declared_map, distance_between, read_alignments
from levkas.registration.bands import by_wavelength, present_bands, sqrt_images
from levkas.registration.chromatic import zero_displacement
from levkas.registration.coarse_to_fine import (
    Begin,
    RegisteredSensor,
    frame_centre,
    register_sensor,
)
from levkas.registration.features import CameraFeatures, GreyImages
from levkas.registration.initial import (
    StartPairs,
    agreeing_pairs,
    begin_with,
    begin_with_pairs,
    find_coarse_transform,
    find_initial_transform,
    start_candidates,
)
from levkas.registration.manual_points import ManualPoints
from levkas.registration.map_stack import gather_signal
from levkas.registration.measured_bands import measured_bands
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
from levkas.registration.verdict import judge_windows
from levkas.registration.verdict_rules import ONLY
from levkas.registration.verdict_rules import SETTINGS as VERDICT

if TYPE_CHECKING:
    from levkas.campaign.methods import LevkasOptions
    from levkas.registration.bands import BandImage
    from levkas.registration.model_selection import SelectedModel
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
    own, anchor, target = request.is_own, base.anchor, request.target
    transforms, sigma = request.reference_transforms, request.reference_sigma
    sensors = []
    if transforms is None or own:
        bands = base.own_bands if own else base.predicting()
        images = {band.label: base.object_in(band) for band in bands}
        lying = own and request.one_scan
        first = lie_together(bands, anchor) if lying else register_own_bands(bands, images, anchor)
        transforms, sigma = first.transforms, first.sigma
        sensors = [first] if own else []
    names = list(dict.fromkeys(i.sensor for i in target if not own or i.sensor != anchor.sensor))
    if names:
        stack, one_scan = base.stack(transforms), request.one_scan
        by_key_points = find_coarse_transform if one_scan else find_initial_transform

        def pictures_of(name: str) -> tuple[list[BandImage], dict[str, np.ndarray], CameraFeatures]:
            bands = by_wavelength([image for image in target if image.sensor == name])
            there = present_bands(bands)
            if one_scan:
                bands = there = gather_signal(there)
            shown = [there[i] for i in measured_bands(there)]
            pictures = {b.label: base.images[b.label] for b in shown} if own else sqrt_images(shown)
            return bands, pictures, CameraFeatures(GreyImages(list(pictures.values())))

        def register_one(name: str, begin: Begin = by_key_points) -> RegisteredSensor:
            by_hand = request.given.get(name)
            if by_hand and by_hand.accepted:
                bands = by_wavelength([image for image in target if image.sensor == name])
                return _placed(name, bands, by_hand, stack.shape)
            bands, pictures, theirs = pictures_of(name)
            found = register_sensor(
                bands, pictures, stack, base.keys, theirs, by_hand, sigma, begin
            )
            labels = [image.label for image in target if image.sensor == name]
            return _of_all_maps(found, labels, stack.shape) if one_scan else found

        pairs = {name: (request.given.get(name) or ManualPoints()).starts for name in names}

        known: dict[str, Transform] = {anchor.sensor: Affine.identity()} if own else {}
        align = {target[0].sensor: Affine.identity()} | read_alignments(request.align)
        sensors += _register_sensors(names, register_one, align, known, pairs, stack.shape)
    labels, object_share = [image.label for image in target], base.area.share_of(request.layer)
    return _assemble(sensors, labels, base.area.to_dict(), object_share)


def _register_sensors(
    names: Sequence[str],
    register_one: Callable[..., RegisteredSensor],
    align: Mapping[str, Transform],
    known: Mapping[str, Transform],
    pairs: Mapping[str, np.ndarray],
    shape: tuple[int, int],
) -> list[RegisteredSensor]:
    """Register every sensor by itself; where a declared alignment helps or contradicts, begin with it too, and where the verdict refuses, with pairs.

    `align` are declared maps from the first sensor's px, the first one's identity among them; `known` are maps of
    sensors that are not registered; `pairs` are the candidates of a sensor's start; `shape` is the reference's. Raises RegistrationRefused of the first sensor without
    a map. Of two registered sensors the distance from the declared alignment is the second's alone.
    """
    first = next(iter(align))

    def attempt(name: str) -> RegisteredSensor | RegistrationRefused:
        try:
            return register_one(name)
        except RegistrationRefused as refusal:
            return refusal

    tried = dict(zip(names, each(attempt, names), strict=True))
    found = []
    for name, one in tried.items():
        others = dict(known) | {
            other: sensor.base
            for other, sensor in tried.items()
            if other != name and isinstance(sensor, RegisteredSensor) and sensor.base
        }
        declared = declared_map(name, align, others)
        if declared is not None:
            again = partial(register_one, name, partial(begin_with, declared))
            one = _begun_anew(one, again, declared, shape)
        one = _begun_with_pairs(one, partial(register_one, name), pairs[name], shape)
        checked = name != first or declared_map(name, align, known) is not None
        if declared is not None and checked and isinstance(one, RegisteredSensor):
            one = replace(one, apart_px=_apart(one, declared, shape))
        if isinstance(one, RegistrationRefused):
            raise one
        found.append(one)
    return found


def _begun_anew(
    one: RegisteredSensor | RegistrationRefused,
    again: Callable[[], RegisteredSensor],
    declared: Transform,
    shape: tuple[int, int],
) -> RegisteredSensor | RegistrationRefused:
    """Register again from where a declared alignment puts a sensor, if its own map is not there; return what more windows confirm."""
    if isinstance(one, RegisteredSensor) and (
        one.placed or _apart(one, declared, shape) <= VERDICT.align_px
    ):
        return one
    try:
        other = again()
    except RegistrationRefused:
        return one
    better = isinstance(one, RegistrationRefused) or _agreeing(other) > _agreeing(one)
    return other if better else one


def _begun_with_pairs(
    one: RegisteredSensor | RegistrationRefused,
    again: Callable[[Begin], RegisteredSensor],
    pairs: np.ndarray,
    shape: tuple[int, int],
) -> RegisteredSensor | RegistrationRefused:
    """Register a refused sensor again from where pairs put it; return the first map that is not refused, else what it was.

    Where there is a map, how many of the pairs agree with it is counted.
    """
    if isinstance(one, RegisteredSensor) and (one.placed or not _is_refused(one)):
        return _counted(one, pairs, shape, used=False)
    for candidate in start_candidates(pairs, shape):
        try:
            other = again(partial(begin_with_pairs, candidate))
        except RegistrationRefused:
            continue
        if not _is_refused(other):
            return _counted(other, pairs, shape, used=True)
    return _counted(one, pairs, shape, used=False) if isinstance(one, RegisteredSensor) else one


def _counted(
    one: RegisteredSensor, pairs: np.ndarray, shape: tuple[int, int], *, used: bool
) -> RegisteredSensor:
    """Return a sensor with how many pairs of another program agree with its map."""
    if not len(pairs) or one.base is None:
        return one
    agreeing = int(agreeing_pairs(one.base, pairs, shape).sum())
    return replace(one, pairs=StartPairs(len(pairs), agreeing, used))


def _is_refused(sensor: RegisteredSensor) -> bool:
    """Whether the verdict refuses a sensor's map by itself; the object's share of the layer has no part in that."""
    return judge_windows({ONLY: _numbers(sensor) | {"object_share": 1.0}}).decision == "refuse"


def _agreeing(sensor: RegisteredSensor) -> int:
    return int(sensor.refined.verification["agreeing"]) if sensor.refined else 0


def _apart(sensor: RegisteredSensor, declared: Transform, shape: tuple[int, int]) -> float:
    """Return how far a sensor's map lies from its declared alignment, px of the sensor."""
    return 0.0 if sensor.base is None else distance_between(sensor.base, declared, shape)


def _of_all_maps(
    found: RegisteredSensor, labels: Sequence[str], shape: tuple[int, int]
) -> RegisteredSensor:
    """Return a sensor of which pictures with the signal of its maps were registered, with the one map for all of these."""
    assert found.base is not None, "a sensor that was registered has a map"
    return replace(
        found,
        transforms=dict.fromkeys(labels, found.base),
        sigma=dict.fromkeys(labels, next(iter(found.sigma.values()))),
        chromatic=zero_displacement(len(labels), *frame_centre(shape)),
    )


def _placed(
    name: str, bands: Sequence[BandImage], by_hand: ManualPoints, shape: tuple[int, int]
) -> RegisteredSensor:
    """Return a sensor that a person placed: one map for all of its bands."""
    placed = place_by_hand(by_hand, shape, name)
    still = zero_displacement(len(bands), *frame_centre(shape))
    labels = [band.label for band in bands]
    transforms = dict.fromkeys(labels, placed.transform)
    sigma = dict.fromkeys(labels, placed.sigma(shape))
    return RegisteredSensor(name, transforms, still, {}, sigma, placed=placed)


# --- the record


def _assemble(
    sensors: Sequence[RegisteredSensor],
    labels: Sequence[str],
    mask: dict[str, Any],
    object_share: float,
) -> Registration:
    """Return the registration of a camera with `sensors`, bands in the order of `labels`.

    `object_share` is the share of the layer that shows the object.
    """
    numbers = {s.name: _numbers(s) | {"object_share": object_share} for s in sensors}
    transforms: dict[str, Transform] = {}
    sigma: dict[str, Sigma] = {}
    others = {s.name: _matches(s) for s in sensors[1:] if s.base is not None}
    by_hand = all(s.placed for s in sensors)
    for sensor in sensors:
        transforms.update(sensor.transforms)
        sigma.update(sensor.sigma)
    return Registration(
        method="by hand" if by_hand else "levkas",
        transforms={label: transforms[label] for label in labels},
        verdict=judge_windows({name or ONLY: one for name, one in numbers.items()}),
        errors={"bands": _band_errors(sensors), "sensors": numbers},
        matches=_matches(sensors[0]),
        model={"kind": "levkas", "mask": mask, "sensors": [_model(s) for s in sensors]},
        sigma={label: sigma[label] for label in labels},
        others=others,
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
        "step": found.step if found else 1,
        "rounds": found.course["rounds"] if found else None,
        "converged": found.course["converged"] if found else None,
    }


def _numbers(sensor: RegisteredSensor) -> dict[str, Any]:
    """Return the evidence on a sensor; of the reference's own, which is registered to nothing, nearly none."""
    found, initial = sensor.refined, sensor.initial
    course = found.course if found else {}
    evidence = found.evidence if found else {}
    verification = found.verification if found else {}
    selected = found.selected if found else None
    placed = {"placed_by_hand": sensor.placed.to_dict()} if sensor.placed else {}
    return {
        "held_out_px": selected.held_out_error if selected else None,
        "window_sigma_px": _window_sigma(selected) if selected else None,
        "windows": len(selected.weights) if selected else None,
        "share_above_chance": evidence.get("share_above_chance"),
        "cover": evidence.get("cover"),
        "step": found.step if found else 1,
        "key_points_kept": int(initial.kept.sum()) if initial else None,
        "key_points": len(initial.kept) if initial else None,
        "by_outlines": bool(initial and initial.by_outlines),
        "by_pairs": bool(initial and initial.by_pairs),
        "start_pairs": sensor.pairs and asdict(sensor.pairs),
        "rounds": course.get("rounds"),
        "converged": course.get("converged"),
        "moved": course.get("moved"),
        "checked": verification.get("checked"),
        "alike": bool(found and found.light == "same"),
        "light": found.light if found else "unknown",
        "align_apart_px": sensor.apart_px,
        "terms": selected.spec.coefficients if selected and selected.spec else None,
        "verification": verification,
    } | placed


def _window_sigma(selected: SelectedModel) -> float | None:
    """Return the median sigma of the windows' shifts, either axis, reference px; None where none is known."""
    known = np.trace(selected.observations.information, axis1=1, axis2=2) / 2
    known = known[known > 0]
    return float(np.median(known) ** -0.5) if known.size else None


def _basis(sensor: RegisteredSensor) -> dict[str, Any]:
    """Return the windows on which a sensor's base map rests; of the reference's own, which has none, its name."""
    found = sensor.refined
    if found is None:
        return {"sensor": sensor.name}
    labels = list(sensor.windows)
    source = labels[0] if len(labels) == 1 else "fused"
    band, selected = found.course["band"], found.selected
    windows = describe_windows(sensor.name, source, band, selected, found.checks)
    lines = sensor.correction.before if sensor.correction else sensor.lines
    return windows | {"lines": lines and lines.drawn()}


def _band_errors(sensors: Sequence[RegisteredSensor]) -> dict[str, dict[str, float | None]]:
    """Return windows and explained share of every band, in the order of the maps; 0 and None of one not measured."""
    result: dict[str, dict[str, float | None]] = {}
    for sensor in sensors:
        for label in sensor.transforms if sensor.windows else ():
            if label not in sensor.windows:
                result[label] = {"windows": 0, "explained": None}
                continue
            windows = sensor.windows[label]
            used = np.trace(windows.information, axis1=1, axis2=2) > 0
            result[label] = {
                "windows": int(used.sum()),
                "explained": float(np.median(windows.r2[used])) if used.any() else 0.0,
            }
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

"""A capture's registration adjusted with what others of its camera saw: the record of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.building.measured import Measured
from levkas.registration.rig import Adjusted, adjust
from levkas.registration.uncertainty import Sigma, measure_sigma
from levkas.transforms import Affine, Composed, Transform, from_dict

if TYPE_CHECKING:
    from levkas.registration.record import Matches
    from levkas.registration.sightings import Sighting

GRID = (25, 19)


def adjusted(
    mine: Measured, others: Mapping[str, Measured], reference: Mapping[str, Sigma] | None
) -> Measured:
    """Return a capture's registration, adjusted with those of others by the same camera.

    Parameters
    ----------
    mine : Measured
    others : mapping of name to Measured
        What else the camera saw, by the name that the record gives it; refused ones say nothing.
    reference : mapping of label to Sigma or None
        How well the reference's own bands are known; None for the reference camera itself.

    Returns
    -------
    adjusted : Measured
        With the maps, sigmas, residuals and the model told anew; as it was where it was refused.
    """
    if mine.problems or not mine.sightings:
        return mine
    record, matches = deepcopy(mine.record), dict(mine.matches)
    for place, sighting in enumerate(mine.sightings):
        mates = [
            (name, seen)
            for name, other in sorted(others.items())
            for seen in other.sightings
            if seen.sensor == sighting.sensor
        ]
        if not mates:
            continue
        found = adjust(sighting, [seen for _, seen in mates])
        if not found.mates:
            continue
        transforms = _transforms(sighting, found)
        told = _told(record, sighting, found, [mates[k][0] for k in found.mates], transforms)
        _write_bands(record, sighting, found, transforms, reference)
        _write_model(record, place, sighting, found, told)
        sensor = sighting.sensor if place else ""
        if sensor in matches:
            first = next(iter(transforms.values()))
            matches[sensor] = _measured_anew(matches[sensor], found.base, first)
    _write_checks(record, matches)
    return replace(mine, record=record, matches=matches)


def _transforms(sighting: Sighting, found: Adjusted) -> dict[str, Transform]:
    own = sighting.seen is None
    return {
        label: Affine.identity()
        if own and not found.chromatic.amounts[i].any()
        else found.chromatic.transform(i)
        if own
        else Composed(found.chromatic.transform(i), found.base)
        for i, label in enumerate(sighting.labels)
    }


def _told(
    record: dict[str, Any],
    sighting: Sighting,
    found: Adjusted,
    names: Sequence[str],
    transforms: Mapping[str, Transform],
) -> dict[str, Any]:
    """What is said of the adjustment: with whom, and how far it moved the bands."""
    width, height = record["reference"]["size"]
    x, y = (np.linspace(0, n - 1, k) for n, k in zip((width, height), GRID, strict=True))
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    if sighting.seen is not None:
        low, high = sighting.seen.points.min(0), sighting.seen.points.max(0)
        points = points[((points >= low) & (points <= high)).all(1)]
    moved: list[float] = []
    for label, transform in transforms.items():
        before = from_dict(record["bands"][label]["transform"])
        miss = transform(points) - before(points)
        shift = np.linalg.solve(before.jacobian(points), miss[..., None])[..., 0]
        moved += np.linalg.norm(shift, axis=1).tolist()
    told: dict[str, Any] = {
        "with": list(names),
        "moved_px": {"mean": round(float(np.mean(moved)), 4), "max": round(float(max(moved)), 4)},
    }
    if found.rung is not None:
        told["alone"] = {"held_out_px": round(sighting.held_out, 5)}
        told["held_out_px"] = round(float(found.rung.scores[found.rung.name]), 5)
    return told


def _write_bands(
    record: dict[str, Any],
    sighting: Sighting,
    found: Adjusted,
    transforms: Mapping[str, Transform],
    reference: Mapping[str, Sigma] | None,
) -> None:
    width, height = record["reference"]["size"]
    sigma: dict[str, Sigma] = {}
    if found.rung is not None or sighting.seen is None:
        sigma = measure_sigma(
            (height, width), sighting.labels, found.chromatic, found.rung, reference, found.behind
        )
    for label, transform in transforms.items():
        band = record["bands"][label]
        band["transform"] = transform.to_dict()
        if label in sigma:
            band["sigma"] = sigma[label].to_dict()


def _write_model(
    record: dict[str, Any], place: int, sighting: Sighting, found: Adjusted, told: dict[str, Any]
) -> None:
    model = record["model"]["sensors"][place]
    model["joint"] = told
    model["chromatic"] = found.chromatic.kind
    verdict = record["verdict"]
    where = f"sensor {sighting.sensor}: " if sighting.sensor else ""
    moved, names = told["moved_px"], ", ".join(told["with"])
    said = f"{where}adjusted together with {names}, which moved it by {moved['mean']:.3f} px in the mean and {moved['max']:.3f} at most"
    if found.rung is not None and found.behind is not None:
        told["alone"]["base"], model["base"] = model["base"], found.rung.name
        told["alone"]["ladder"], model["ladder"] = model["ladder"], found.rung.scores
        for numbers in (record["errors"]["sensors"], verdict["numbers"]):
            for name in (sighting.sensor, "sensor"):
                if name in numbers:
                    numbers[name]["held_out_px"] = told["held_out_px"]
        said += f"; blocks left out are predicted to {told['held_out_px']:.3f} px, {told['alone']['held_out_px']:.3f} by itself"
    verdict["reasons"] = [*verdict["reasons"], f"{said}."]


def _measured_anew(pairs: Matches, base: Transform, first: Transform) -> Matches:
    """Return pairs with their distances from other maps; check points are measured by a band's."""
    if not len(pairs):
        return pairs
    residual = _distances(pairs, base)
    checks = pairs.state == "check"
    residual[checks] = _distances(pairs, first)[checks]
    return replace(
        pairs, residual=residual, leave_one_out=np.where(checks, pairs.leave_one_out, residual)
    )


def _distances(pairs: Matches, transform: Transform) -> np.ndarray:
    miss = pairs.target - transform(pairs.reference)
    jacobian = transform.jacobian(pairs.reference)
    return np.linalg.norm(np.linalg.solve(jacobian, miss[..., None])[..., 0], axis=1)


def _write_checks(record: dict[str, Any], matches: Mapping[str, Matches]) -> None:
    """Tell the errors of check points as they are now; their order is that of the pairs."""
    told = record["errors"].get("check_points")
    found = np.concatenate([m.residual[m.state == "check"] for m in matches.values()])
    if told and len(told) == len(found):
        for one, error in zip(told, found, strict=True):
            one["error"] = float(error)

"""A capture's registration adjusted with what others of its camera saw: the record of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry import from_dict
from levkas.geometry.transforms import Affine, Composed, Transform, solve_2x2
from levkas.registration.advice import advise
from levkas.registration.coarse_detail import hold_coarse_detail
from levkas.registration.joint import JointResult, SensorObservations, adjust_jointly
from levkas.registration.manual_points import measure_checks, nearest_rows
from levkas.registration.record import Matches, Sigma, describe_windows
from levkas.registration.uncertainty import measure_sigma, with_chromatic, with_lines
from levkas.registration.verdict import judge_windows
from levkas.registration.verdict_rules import ONLY
from levkas.registration.verification import SETTINGS as VERIFICATION
from levkas.registration.verification import (
    grid_points,
    measure_cells,
    measure_map,
    measure_windows,
)
from levkas.registration.window_matching import CheckWindows
from levkas.stages.register import Measured, draw_figures, verdict_problems

if TYPE_CHECKING:
    from levkas.campaign.discovery.captures import Capture
    from levkas.registration.record import Matches

GRID = (25, 19)
#: A map is never known better than this, whatever its windows say, when what moves it is judged.
LEAST_SIGMA_PX = 0.02


def adjust_capture(
    capture: Capture,
    mine: Measured,
    others: Mapping[str, Measured],
    reference: Mapping[str, Sigma] | None,
) -> Measured:
    """Return a capture's registration as `adjusted` gives it, with problems and figures."""
    found = adjusted(mine, others, reference)
    problems = found.problems or verdict_problems(found.record, capture, None)
    return replace(found, problems=problems, figures=draw_figures(found.record))


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
        With maps, sigmas, residuals, model and verdict of what is written now: windows that were free to be
        found lie in the target where they were found, whatever map is judged by them. As it was where it
        was refused.
    """
    if mine.problems or not mine.observations:
        return mine
    record, matches = deepcopy(mine.record), dict(mine.matches)
    for observed in mine.observations:
        place = _place(record, observed)
        companions = [
            (name, observed_there)
            for name, other in sorted(others.items())
            for observed_there in other.observations
            if observed_there.sensor == observed.sensor
        ]
        if not companions:
            continue
        found = adjust_jointly(observed, [observed_there for _, observed_there in companions])
        if not found.companions:
            continue
        transforms = _transforms(observed, found)
        summary = _summary(
            record, observed, found, [companions[k][0] for k in found.companions], transforms
        )
        basis = record["trace"]["sensors"][place]
        checks = _checked_anew(record, basis, transforms)
        excess = _excess(record, observed, transforms)
        _write_bands(record, observed, found, transforms, reference, checks)
        _write_model(record, place, observed, found, summary)
        _write_evidence(record, observed, found, summary, checks, transforms, excess)
        if checks is not None:
            selected = found.selected
            again = selected and describe_windows(
                observed.sensor, basis["source"], basis["band"], selected, checks
            )
            record["trace"]["sensors"][place] = basis | (again or {"checks": checks.to_dict()})
        sensor = observed.sensor if place else ""
        if sensor in matches:
            matches[sensor] = _measured_anew(matches[sensor], found.base)
    if record["model"]["sensors"] != mine.record["model"]["sensors"]:
        _write_verdict(record)
        _write_checks(record, matches)
    return replace(mine, record=record, matches=matches)


def _checked_anew(
    record: dict[str, Any], basis: Mapping[str, Any], transforms: Mapping[str, Transform]
) -> CheckWindows | None:
    """Return the windows that were free to be found, as they lie under the new map; None where there are none."""
    if not basis.get("checks"):
        return None
    before = from_dict(record["bands"][basis["band"]]["transform"])
    return CheckWindows.from_dict(basis["checks"]).through(before, transforms[basis["band"]])


def _excess(
    record: dict[str, Any], observed: SensorObservations, transforms: Mapping[str, Transform]
) -> dict[str, Any]:
    """Return the band that moved farthest for what its own windows allow: its name, px and sigmas, in the mean."""
    points = _points(record, observed)
    worst: dict[str, Any] = {"band": "", "px": 0.0, "sigmas": 0.0}
    for label, transform in transforms.items():
        band = record["bands"][label]
        if "sigma" not in band:
            continue
        moved = float(_shifts(from_dict(band["transform"]), transform, points).mean())
        sigma = float(Sigma.from_dict(band["sigma"])(points).mean())
        sigmas = moved / max(sigma, LEAST_SIGMA_PX)
        if sigmas > worst["sigmas"]:
            worst = {"band": label, "px": round(moved, 4), "sigmas": round(sigmas, 2)}
    return worst


def _points(record: dict[str, Any], observed: SensorObservations) -> np.ndarray:
    """Return places over what a sensor saw, (n, 2) reference px."""
    width, height = record["reference"]["size"]
    x, y = (np.linspace(0, n - 1, k) for n, k in zip((width, height), GRID, strict=True))
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    if observed.observations is not None:
        low, high = observed.observations.points.min(0), observed.observations.points.max(0)
        points = points[((points >= low) & (points <= high)).all(1)]
    return points


def _shifts(before: Transform, after: Transform, points: np.ndarray) -> np.ndarray:
    """Return by how many reference px a map moves, (n,)."""
    shift = solve_2x2(before.jacobian(points), after(points) - before(points))
    return np.asarray(np.linalg.norm(shift, axis=1))


def _transforms(observed: SensorObservations, found: JointResult) -> dict[str, Transform]:
    own = observed.observations is None
    return {
        label: Affine.identity()
        if own and not found.chromatic.amounts[i].any()
        else found.chromatic.transform(i)
        if own
        else Composed(found.chromatic.transform(i), found.base)
        for i, label in enumerate(observed.labels)
    }


def _summary(
    record: dict[str, Any],
    observed: SensorObservations,
    found: JointResult,
    names: Sequence[str],
    transforms: Mapping[str, Transform],
) -> dict[str, Any]:
    """The record of the adjustment: with whom, and how far it moved the bands."""
    points = _points(record, observed)
    moved: list[float] = []
    for label, transform in transforms.items():
        before = from_dict(record["bands"][label]["transform"])
        moved += _shifts(before, transform, points).tolist()
    summary: dict[str, Any] = {
        "with": list(names),
        "moved_px": {"mean": round(float(np.mean(moved)), 4), "max": round(float(max(moved)), 4)},
    }
    if found.selected is not None:
        summary["alone"] = {"held_out_px": round(observed.held_out, 5)}
        summary["held_out_px"] = round(found.selected.held_out_error, 5)
    return summary


def _write_bands(
    record: dict[str, Any],
    observed: SensorObservations,
    found: JointResult,
    transforms: Mapping[str, Transform],
    reference: Mapping[str, Sigma] | None,
    checks: CheckWindows | None,
) -> None:
    """Write the maps, and how well they are known now."""
    width, height = record["reference"]["size"]
    sigma: dict[str, Sigma] = {}
    if found.selected is not None or observed.observations is None:
        sigma = measure_sigma(
            (height, width), observed.labels, found.chromatic, found.selected, reference, found.shared,
            checks,
        )  # fmt: skip
        known = _numbers(record, observed).get("verification", {})
        displaced = [known.get(f"{what}_displacement") or {} for what in ("line", "fine")]
        sigma = with_lines(sigma, max(one.get("sigma_px", 0.0) for one in displaced))
        sigma = hold_coarse_detail(sigma, known.get("coarse_detail"))
    else:
        for number, label in enumerate(observed.labels):
            known = Sigma.from_dict(record["bands"][label]["sigma"])
            sigma[label] = with_chromatic(known, number, observed.chromatic, found.chromatic)
    for label, transform in transforms.items():
        band = record["bands"][label]
        band["transform"] = transform.to_dict()
        if label in sigma:
            band["sigma"] = sigma[label].to_dict()


def _write_model(
    record: dict[str, Any],
    place: int,
    observed: SensorObservations,
    found: JointResult,
    summary: dict[str, Any],
) -> None:
    """Write which model was taken, and with whom the capture was adjusted."""
    model = record["model"]["sensors"][place]
    model["joint"] = summary
    model["chromatic"] = found.chromatic.kind
    if found.selected is not None and found.shared is not None:
        summary["alone"]["base"], model["base"] = model["base"], found.selected.name
        summary["alone"]["scores"], model["scores"] = model["scores"], found.selected.scores


def _write_evidence(
    record: dict[str, Any],
    observed: SensorObservations,
    found: JointResult,
    summary: dict[str, Any],
    checks: CheckWindows | None,
    transforms: Mapping[str, Transform],
    excess: dict[str, Any],
) -> None:
    """Measure what the verdict rests on through the new map."""
    numbers = _numbers(record, observed)
    numbers["joint_excess"] = excess
    if found.selected is not None and found.selected.spec is not None:
        numbers["held_out_px"] = summary["held_out_px"]
        numbers["terms"] = found.selected.spec.coefficients
    if checks is not None:
        verification = numbers["verification"]
        box = tuple(verification["box"])
        map_ = transforms[record["trace"]["sensors"][_place(record, observed)]["band"]]
        points, fine = grid_points(box, VERIFICATION.grid), grid_points(box, VERIFICATION.fine)
        in_view, shown = (_shown(verification["outside"], places) for places in (points, fine))
        verification |= measure_windows(checks) | measure_map(map_, points, in_view)
        verification |= measure_cells(box, shown, checks, np.empty((0, 2)))
        numbers["checked"] = verification["checked"]


def _numbers(record: dict[str, Any], observed: SensorObservations) -> dict[str, Any]:
    """Return the evidence on a sensor."""
    numbers: dict[str, Any] = record["verdict"]["numbers"][observed.sensor or ONLY]
    return numbers


def _place(record: dict[str, Any], observed: SensorObservations) -> int:
    names = [sensor["sensor"] for sensor in record["trace"]["sensors"]]
    return names.index(observed.sensor)


def _shown(outside: Sequence[Sequence[float]], points: np.ndarray) -> np.ndarray:
    """Return which points, (n, 2), lie in none of the cells (x, y, width, height) that the target does not show."""
    shown = np.ones(len(points), bool)
    for x, y, width, height in outside:
        low, high = np.array([x, y]) - 0.5, np.array([x + width, y + height]) - 0.5
        shown &= ~((points >= low) & (points < high)).all(1)
    return shown


def _write_verdict(record: dict[str, Any]) -> None:
    """Judge the adjusted maps, and add to the reasons which captures each sensor was adjusted with."""
    verdict = judge_windows(_whole(record["verdict"]["numbers"])).to_dict()
    pairs = record.get("pairs_by_hand", 0)
    verdict["next_step"] = advise(verdict["next_step"], pairs, verdict["decision"])
    reasons = []
    for sensor in record["model"]["sensors"]:
        summary = sensor.get("joint")
        if summary is None:
            continue
        where = f"sensor {sensor['sensor']}: " if sensor["sensor"] else ""
        moved, names = summary["moved_px"], ", ".join(summary["with"])
        text = f"{where}the joint adjustment with {names} moved the map by {moved['mean']:.3f} px in the mean, at most {moved['max']:.3f} px"
        if "base" in summary.get("alone", {}):
            text += f"; the held-out error is {summary['held_out_px']:.3f} px, without the adjustment {summary['alone']['held_out_px']:.3f} px"
        reasons.append(f"{text}.")
    record["verdict"] = verdict | {"reasons": [*verdict["reasons"], *reasons]}
    for name, numbers in verdict["numbers"].items():
        record["errors"]["sensors"]["" if name == ONLY else name] = numbers


def _whole(numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Return numbers as they were measured: JSON has no infinity."""
    endless = ("window_median", "window_p90", "second_peak_ratio")
    return {
        name: one
        | {
            "verification": {
                key: np.inf if value is None and key in endless else value
                for key, value in one["verification"].items()
            }
        }
        for name, one in numbers.items()
    }


def _measured_anew(pairs: Matches, base: Transform) -> Matches:
    """Return pairs with their distances from another base map; check points stay as they are."""
    checks = pairs.state == "check"
    residual = np.where(checks, pairs.residual, _distances(pairs, base))
    return replace(
        pairs, residual=residual, leave_one_out=np.where(checks, pairs.leave_one_out, residual)
    )


def _distances(pairs: Matches, transform: Transform) -> np.ndarray:
    miss = pairs.target - transform(pairs.reference)
    shift = solve_2x2(transform.jacobian(pairs.reference), miss)
    return np.asarray(np.linalg.norm(shift, axis=1))


def _write_checks(record: dict[str, Any], matches: dict[str, Matches]) -> None:
    """Measure check points anew, each by the band that it was placed in, and write that into the pairs too."""
    for one in record["errors"].get("check_points") or ():
        pair = np.array([[*one["reference"], *one["target"]]])
        transform = from_dict(record["bands"][one["band"]]["transform"])
        one["error"] = float(measure_checks(pair, transform)[0])
        for sensor, pairs in matches.items():
            there = np.hstack([pairs.reference, pairs.target]).reshape(-1, 4)
            here = (nearest_rows(there, pair) >= 0) & (pairs.state == "check")
            matches[sensor] = replace(pairs, residual=np.where(here, one["error"], pairs.residual))

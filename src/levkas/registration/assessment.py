"""From aligned sensors to a registration: errors, evidence, verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.ladder import RUNGS
from levkas.registration.pyramid import GOOD_PX
from levkas.registration.record import Matches, Registration, Verdict
from levkas.registration.sightings import Sighting
from levkas.registration.verdict import (
    COVERAGE,
    LOOK,
    OFF_SHARE,
    OTHER,
    REGION,
    Finding,
    check_fold,
    check_overlap,
    check_rival,
    check_shape,
    check_windows,
)

if TYPE_CHECKING:
    from levkas.registration.sensors import Sensor
    from levkas.registration.uncertainty import Sigma
    from levkas.transforms import Transform

#: Share of windows that are predicted better than windows that cannot match (19 of 20 of those).
BELIEVED, DOUBTED = 0.5, 0.2
#: Held-out error, reference px and px of the grid that was compared.
BAD_PX, BAD_STEPS = 1.0, 0.3
LEAST_COVER = 0.5
LEAST_BORNE_OUT = 0.15


def assess(sensors: Sequence[Sensor], labels: Sequence[str]) -> Registration:
    """Return the registration of a camera whose sensors are `sensors`, bands in order of `labels`."""
    transforms: dict[str, Transform] = {}
    sigma: dict[str, Sigma] = {}
    for sensor in sensors:
        transforms.update(sensor.transforms)
        sigma.update(sensor.sigma)
    return Registration(
        method="levkas",
        transforms={label: transforms[label] for label in labels},
        verdict=judge(sensors),
        errors={"bands": _band_errors(sensors), "sensors": {s.name: _numbers(s) for s in sensors}},
        matches=_matches(sensors[0]),
        trace=None,
        model={
            "kind": "levkas",
            "sensors": [
                {
                    "sensor": s.name,
                    "base": s.rung.name if s.rung else "identity",
                    "ladder": s.rung.scores if s.rung else {},
                    "climbs": s.climbs,
                    "chromatic": s.chromatic.kind,
                    "mirrored": bool(s.start.mirrored) if s.start else False,
                    "step": s.step,
                }
                for s in sensors
            ],
        },
        sigma={label: sigma[label] for label in labels},
        others={s.name: _matches(s) for s in sensors[1:] if s.start is not None},
        sightings=tuple(Sighting.of(sensor) for sensor in sensors),
    )


def judge(sensors: Sequence[Sensor]) -> Verdict:
    """Weigh the evidence of every sensor; the worst decides."""
    found = [(sensor, _findings(sensor)) for sensor in sensors]
    numbers = {sensor.name or "sensor": _numbers(sensor) for sensor in sensors}
    for decision in ("refuse", "warn"):
        spoken = [(s.name, one) for s, all_ in found for one in all_ if one.decision == decision]
        if spoken:
            reasons = (
                f"sensor {name}: {one.reason}" if name else one.reason for name, one in spoken
            )
            return Verdict(decision, tuple(reasons), spoken[0][1].next_step, numbers)
    return Verdict("accept", tuple(_praise(s) for s in sensors if s.rung), "", numbers)


def _findings(sensor: Sensor) -> list[Finding]:
    """Return what the rules have against a sensor; nothing is known of the reference's own."""
    if sensor.rung is None or sensor.start is None:
        return []
    plain = sensor.rung.name.partition("+spline")[0].partition("+ledge")[0]
    terms = RUNGS[plain][0] // 4
    known = {"kept": int(sensor.start.kept.sum()), "terms": max(3, terms), **_numbers(sensor)}
    known |= sensor.borne_out
    return [one for rule in RULES if (one := rule(known))]


def _praise(sensor: Sensor) -> str:
    rung, n = sensor.rung, sensor.borne_out
    where = f"sensor {sensor.name}: " if sensor.name else ""
    miss = rung.scores[rung.name] if rung else 0.0
    return (
        f"{where}{n.get('agreeing', 0)} of {n.get('found', 0)} windows that are recognised lie where "
        f"the map puts them; blocks left out of the fit are predicted to {miss:.2f} px."
    )


def _better_than_chance(n: dict[str, Any]) -> Finding | None:
    share = n["share_above_chance"]
    if share is None or share >= BELIEVED:
        return None
    return Finding(
        "refuse" if share < DOUBTED else "warn",
        f"{share:.0%} of the windows are predicted better than windows that cannot match.",
        OTHER + "." if share < DOUBTED else LOOK,
    )


def _predicts_blocks(n: dict[str, Any]) -> Finding | None:
    error, step = n["held_out_px"], n["step"]
    if error is None or error < GOOD_PX * step:
        return None
    # Where the target is coarse, single windows scatter more than the map is off.
    bad = not error < max(BAD_PX, BAD_STEPS * step)
    return Finding(
        "refuse" if bad else "warn",
        f"Windows that the model did not see are {error:.2f} px off: no one map fits all of them.",
        f"{OTHER}; what has been bent or cut has no one map." if bad else LOOK,
    )


def _compared(n: dict[str, Any]) -> Finding | None:
    if n["cover"] is None or n["cover"] >= LEAST_COVER:
        return None
    return Finding("warn", f"Only {n['cover']:.0%} of the reference could be compared.", LOOK)


def _borne_out(n: dict[str, Any]) -> Finding | None:
    if "coverage" not in n or not (n["off"] or n["coverage"] < COVERAGE["warn"]):
        return None
    if n["off_share"] > OFF_SHARE or n["coverage"] < LEAST_BORNE_OUT:
        return Finding(
            "refuse",
            f"Of what both pictures show, {n['coverage']:.0%} is borne out by comparison, and the "
            f"map is off in {n['off_share']:.0%}.",
            f"{OTHER}.",
        )
    bad = n["unsupported"] + n["off"]
    where = "; ".join(", ".join(f"{v:.0f}" for v in cell) for cell in bad[:4])
    return Finding(
        "warn",
        f"The map is off or not borne out in {1 - n['coverage']:.0%} of what both pictures show "
        f"(x, y, width, height: {where}{'; …' if len(bad) > 4 else ''}).",
        REGION,
    )


RULES: tuple[Callable[[dict[str, Any]], Finding | None], ...] = (
    _better_than_chance,
    _predicts_blocks,
    check_fold,
    check_shape,
    check_windows,
    check_rival,
    check_overlap,
    _borne_out,
    _compared,
)


def _numbers(sensor: Sensor) -> dict[str, Any]:
    rung = sensor.rung
    return {
        "held_out_px": float(rung.scores[rung.name]) if rung else None,
        "windows": len(rung.weights) if rung else None,
        "share_above_chance": sensor.evidence.get("share_above_chance"),
        "cover": sensor.evidence.get("cover"),
        "step": sensor.step,
        "key_points_kept": int(sensor.start.kept.sum()) if sensor.start else None,
        "key_points": len(sensor.start.kept) if sensor.start else None,
        "borne_out": sensor.borne_out,
    }


def _band_errors(sensors: Sequence[Sensor]) -> dict[str, dict[str, float]]:
    result = {}
    for sensor in sensors:
        for label, windows in sensor.windows.items():
            used = np.trace(windows.information, axis1=1, axis2=2) > 0
            result[label] = {
                "windows": int(used.sum()),
                "explained": float(np.median(windows.r2[used])) if used.any() else 0.0,
            }
    return result


def _matches(sensor: Sensor) -> Matches:
    begun, base = sensor.start, sensor.base
    if begun is None:
        return Matches.of(np.zeros((0, 2)), np.zeros((0, 2)))
    miss = begun.target - base(begun.reference)
    jacobian = base.jacobian(begun.reference)
    residual = np.linalg.norm(np.linalg.solve(jacobian, miss[..., None])[..., 0], axis=1)
    kept = begun.kept
    n = len(kept)
    reason = np.where(kept, "", "does not agree with the map of the others").astype(object)
    if begun.reason is not None:
        reason = np.where(begun.reason == "", reason, begun.reason)
    return Matches.of(
        begun.reference,
        begun.target,
        residual=residual,
        # The map rests on windows, not on pairs: each pair measures what it did not see.
        leave_one_out=residual,
        weight=kept.astype(float),
        state=np.where(kept, "kept", "removed").astype(object),
        reason=reason,
        round=np.where(kept, -1, np.zeros(n, int)),
    )

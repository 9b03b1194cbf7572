"""From aligned sensors to a registration: errors, evidence, verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.basis import describe_basis
from levkas.registration.coarse_to_fine import GOOD_PX
from levkas.registration.model_selection import RUNGS
from levkas.registration.observations import Sighting
from levkas.registration.record import Matches, Registration, Verdict
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
    from levkas.geometry.transforms import Transform
    from levkas.registration.sensors import Sensor
    from levkas.registration.uncertainty import Sigma

#: Share of windows that are predicted better than windows that cannot match (19 of 20 of those).
BELIEVED, DOUBTED = 0.5, 0.2
#: Held-out error, reference px and px of the grid that was compared.
BAD_PX, BAD_STEPS = 1.0, 0.3
LEAST_COVER = 0.5
#: What a sensor without a name is called among numbers.
ONLY = "sensor"
LEAST_BORNE_OUT = 0.15
LEAST_CHECKED = 0.75
#: By so many of its sigmas others may move a band: three of a normal error are one in three hundred.
MOST_SIGMAS = 3.0
#: Share of detail that only one of two pictures has. Views of one painting in light of the same wavelengths:
#: 0.01 to 0.17; copies by one pattern: 0.30 to 0.55, of whose windows 0.6 to 0.91 are recognised
#: (`benchmarks/replicas.py`).
STRANGE = {"warn": 0.22, "refuse": 0.28}
MOST_FOUND_OF_A_COPY = 0.95


def assess(
    sensors: Sequence[Sensor], labels: Sequence[str], mask: dict[str, Any] | None = None
) -> Registration:
    """Return the registration of a camera whose sensors are `sensors`, bands in order of `labels`.

    `mask`, of `describe_mask`, is what of the reference was compared.
    """
    transforms: dict[str, Transform] = {}
    sigma: dict[str, Sigma] = {}
    for sensor in sensors:
        transforms.update(sensor.transforms)
        sigma.update(sensor.sigma)
    return Registration(
        method="levkas",
        transforms={label: transforms[label] for label in labels},
        verdict=judge({s.name or ONLY: _numbers(s) for s in sensors}),
        errors={"bands": _band_errors(sensors), "sensors": {s.name: _numbers(s) for s in sensors}},
        matches=_matches(sensors[0]),
        trace=None,
        model={
            "kind": "levkas",
            "mask": mask or {},
            "sensors": [
                {
                    "sensor": s.name,
                    "base": s.rung.name if s.rung else "identity",
                    "ladder": s.rung.scores if s.rung else {},
                    "climbs": s.climbs,
                    "chromatic": s.chromatic.kind,
                    "mirrored": bool(s.start.mirrored) if s.start else False,
                    "step": s.step,
                    "rounds": s.course.get("rounds"),
                    "settled": s.course.get("settled"),
                }
                for s in sensors
            ],
        },
        sigma={label: sigma[label] for label in labels},
        others={s.name: _matches(s) for s in sensors[1:] if s.start is not None},
        sightings=tuple(Sighting.of(sensor) for sensor in sensors),
        basis={"kind": "windows", "sensors": [_basis(s) for s in sensors]},
    )


def judge(numbers: Mapping[str, Mapping[str, Any]]) -> Verdict:
    """Weigh the evidence of every sensor; the worst decides.

    Parameters
    ----------
    numbers : mapping of a sensor's name to its numbers
        As `Verdict.numbers` holds them; of the reference's own sensor, which is registered to nothing,
        nothing is asked.
    """
    asked = {name: n for name, n in numbers.items() if n["held_out_px"] is not None}
    found = [(name, one) for name, n in asked.items() for one in _findings(n)]
    for decision in ("refuse", "warn"):
        spoken = [(name, one) for name, one in found if one.decision == decision]
        if spoken:
            reasons = (_where(name) + one.reason for name, one in spoken)
            return Verdict(decision, tuple(reasons), spoken[0][1].next_step, dict(numbers))
    praise = tuple(_where(name) + _praise(n) for name, n in asked.items())
    return Verdict("accept", praise, "", dict(numbers))


def _where(name: str) -> str:
    return "" if name == ONLY else f"sensor {name}: "


def _findings(numbers: Mapping[str, Any]) -> list[Finding]:
    """Return what the rules have against a sensor."""
    known = {"kept": numbers["key_points_kept"], **numbers, **numbers["borne_out"]}
    return [one for rule in RULES if (one := rule(known))]


def _praise(numbers: Mapping[str, Any]) -> str:
    n = numbers["borne_out"]
    return (
        f"{n.get('agreeing', 0)} of {n.get('found', 0)} windows that are recognised lie where "
        f"the map puts them; blocks left out of the fit are predicted to {numbers['held_out_px']:.2f} px, "
        f"over the {_percent(n['checked'])} of the object that is checked."
    )


def terms_of(model: str) -> int:
    """Return the coefficients, of x and y each, of a model by its name; of a rig's the most there are.

    >>> terms_of("cubic+spline(0.01)+ledge"), terms_of("rig+affine")
    (10, 21)
    """
    plain = model.partition("+spline")[0].partition("+ledge")[0]
    least = RUNGS[plain][0] if plain in RUNGS else max(least for least, _ in RUNGS.values())
    return max(3, least // 4)


def _basis(sensor: Sensor) -> dict[str, Any]:
    """Return what a sensor's base map rests on; of the reference's own, which has none, its name."""
    if sensor.rung is None:
        return {"sensor": sensor.name}
    labels = list(sensor.windows)
    source = labels[0] if len(labels) == 1 else "fused"
    return describe_basis(sensor.name, source, sensor.course["band"], sensor.rung, sensor.checks)


def _percent(share: float) -> str:
    """Return a share as text, never rounded up to all of it.

    >>> _percent(1.0), _percent(0.998), _percent(0.375)
    ('100 %', '99 %', '38 %')
    """
    return f"{min(round(100 * share), 100 if share >= 1 else 99)} %"


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


def _checked(n: dict[str, Any]) -> Finding | None:
    """Warn where the map reaches over more than a quarter of what both pictures show."""
    share = n.get("checked", 1.0)
    if share >= LEAST_CHECKED or not n["unchecked"]:
        return None
    *box, part = n["unchecked"][0]
    return Finding(
        "warn",
        f"Blocks left out of the fit are predicted to {n['held_out_px']:.2f} px over the {_percent(share)} of "
        f"the object that could be checked; nothing confirms the map in {_percent(part)} of it (x, y, width, "
        f"height: {', '.join(f'{v:.0f}' for v in box)}), where it only reaches over.",
        REGION,
    )


def _at_rest(n: dict[str, Any]) -> Finding | None:
    if n["settled"] is not False:
        return None
    return Finding(
        "warn",
        f"The map had not come to rest in the last of {n['rounds']} rounds: it still moved by {n['moved']:.2f} px.",
        LOOK,
    )


def _allowed(n: dict[str, Any]) -> Finding | None:
    """Warn where captures that a band was adjusted with move it by more than its own windows allow."""
    excess = n.get("joint_excess")
    if excess is None or excess["sigmas"] < MOST_SIGMAS:
        return None
    return Finding(
        "warn",
        f"Adjusted with other captures, {excess['band']} moves by {excess['px']:.2f} px in the mean, "
        f"{excess['sigmas']:.0f} times what its own windows leave open.",
        "Look at the other captures of this camera, or build without `joint`.",
    )


def _same_painting(n: dict[str, Any]) -> Finding | None:
    """Refuse or warn where outlines agree and what lies between them does not."""
    strange = n.get("strange")
    if strange is None or strange < STRANGE["warn"]:
        return None
    found = n["found"] / max(n["windows"], 1)
    told = f"Where windows are recognised, {strange:.0%} of their detail (strokes, cracks) is not in the reference"
    if n["alike"] and strange >= STRANGE["refuse"] and found < MOST_FOUND_OF_A_COPY:
        return Finding(
            "refuse",
            f"{told}, which sees the same light: it is another painting by the same pattern.",
            f"{OTHER}.",
        )
    return Finding(
        "warn",
        f"{told}: it may be another painting by the same pattern, or one seen in quite another light.",
        LOOK,
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
    _checked,
    _same_painting,
    _allowed,
    _compared,
    _at_rest,
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
        "rounds": sensor.course.get("rounds"),
        "settled": sensor.course.get("settled"),
        "moved": sensor.course.get("moved"),
        "checked": sensor.borne_out.get("checked"),
        "alike": sensor.alike,
        "terms": terms_of(rung.name) if rung else None,
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

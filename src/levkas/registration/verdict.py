"""Verdict: rules on evidence decide whether a registration is accepted, and give the reasons.

A rule that finds a contradiction makes a map doubtful (``"warn"``) or refuses it. Where nothing contradicts a
map and nothing confirms it either, it is accepted, and the part that was not checked is named and counted: most
correct maps have such a part, and a warning on most maps would be ignored. `benchmarks/verdict.py classes`
measures how often each class is correct.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from levkas.registration.advice import (
    LEAST_OUTSIDE,
    LOOK,
    Numbers,
    checked_share,
    describe_placement,
    object_share,
    percent,
)
from levkas.registration.record import Decision, Verdict
from levkas.registration.verdict_rules import MATCHES, ONLY, RULES, SETTINGS, WINDOWS, Objection


def judge_matches(numbers: dict[str, Any]) -> Verdict:
    """Decide on a map that rests on matches, by the numbers of `mirhashemi2019.measure`."""
    praise = (
        f"{numbers['kept']} of {numbers['matches']} matches were kept. {numbers['agreeing']} of the "
        f"{numbers['found']} check windows that were found agree with the map; their median error is "
        f"{numbers['window_median']:.2f} px. The held-out error is {numbers['held_out_median']:.2f} px."
    )
    objections = objections_to(numbers, MATCHES)
    objections += _outside_of_outline(1 - object_share(numbers))
    verdict = _decide(objections, (praise,), numbers, _unchecked(numbers))
    return replace(verdict, outside=1 - object_share(numbers))


def judge_windows(numbers: Mapping[str, Numbers]) -> Verdict:
    """Decide on a map that rests on windows; the sensor with the worst evidence decides.

    Parameters
    ----------
    numbers : mapping of a sensor's name to its numbers
        As `Verdict.numbers` holds them. The reference's own sensor, which is registered to nothing,
        is not judged.
    """
    judged = {name: n for name, n in numbers.items() if n["held_out_px"] is not None}
    objections = [
        replace(one, reason=_where(name) + one.reason)
        for name, n in judged.items()
        for one in objections_to({"kept": n["key_points_kept"], **n, **n["verification"]}, WINDOWS)
    ]
    praise = (_where(name) + _praise(n) for name, n in judged.items())
    unchecked = max((_unchecked({**n, **n["verification"]}) for n in judged.values()), default=0.0)
    outside = max((1 - object_share(n) for n in numbers.values()), default=0.0)
    objections += _outside_of_outline(outside if judged else 0.0)
    verdict = _decide(objections, tuple(praise), dict(numbers), unchecked)
    verdict = replace(verdict, outside=outside)
    placed = {name: n["placed_by_hand"] for name, n in numbers.items() if "placed_by_hand" in n}
    if not placed or verdict.decision == "refuse":
        return verdict
    reasons = tuple(_where(name) + _describe_pairs(one) for name, one in placed.items())
    return replace(
        verdict,
        decision="by hand",
        reasons=reasons + verdict.reasons,
        next_step=LOOK,
        unchecked=1.0,
    )


def worst_of(verdicts: Mapping[str, Verdict]) -> Verdict:
    """Return the verdict on a camera by those on its sensors: the worst decision, with the reasons of all that have it."""
    if len(verdicts) == 1:
        return next(iter(verdicts.values()))
    worst = max((v.decision for v in verdicts.values()), key=("accept", "warn", "refuse").index)
    chosen = {name: v for name, v in verdicts.items() if v.decision == worst}
    return Verdict(
        worst,
        tuple(_where(name) + reason for name, one in chosen.items() for reason in one.reasons),
        next(iter(chosen.values())).next_step,
        {name: one.numbers for name, one in verdicts.items()},
        max(one.unchecked for one in verdicts.values()),
        max(one.outside for one in verdicts.values()),
    )


def _decide(
    objections: Sequence[Objection],
    praise: tuple[str, ...],
    numbers: dict[str, Any],
    unchecked: float,
) -> Verdict:
    """Refuse where one rule refuses; the next step is that of the first rule of the decision.

    Accepted and doubtful maps list what was not checked, after the reasons for the decision.
    """
    kinds: tuple[Decision, ...] = ("refuse", "warn")
    found = (k for k in kinds if any(one.decision == k for one in objections))
    decision: Decision = next(found, "accept")
    deciding = [one for one in objections if one.decision == decision]
    open_ones = [one for one in objections if one.decision == "unchecked"]
    listed = deciding if decision == "refuse" else [*deciding, *open_ones]
    reasons = (*(() if deciding else praise), *(one.reason for one in listed))
    steps = (one.next_step for one in deciding or open_ones if deciding or one.next_step)
    return Verdict(decision, reasons, next(steps, ""), numbers, unchecked)


def objections_to(numbers: Numbers, basis: frozenset[str]) -> list[Objection]:
    """Return the objections of the rules on maps that rest on `basis`, in the order of the rules.

    Where little could be compared window by window, and outlines agree all over, want of evidence makes a
    map doubtful only.
    """
    found = [one for rule, on in RULES.items() if basis <= on and (one := rule(numbers))]
    lacking = [one for one in found if one.lacks_evidence and one.decision == "refuse"]
    outlines = numbers.get("outlines")
    if not lacking or not outlines or not _agree(outlines):
        return found
    text = (
        f"The outlines of {outlines['agreeing']} of {outlines['blocks']} large blocks agree with the map "
        f"within {outlines['px']:.1f} px. A finer check was not possible."
    )
    doubted = [replace(one, decision="warn") if one in lacking else one for one in found]
    return [Objection("warn", text, LOOK), *doubted]


def _agree(outlines: Numbers) -> bool:
    """Whether enough blocks lie where the map puts them, in number and as a share."""
    least = max(SETTINGS.least_outlines, SETTINGS.least_outlines_share * outlines["blocks"])
    return bool(outlines["agreeing"] >= least)


def _unchecked(n: Numbers) -> float:
    """Return the share of the layer that does not show the object, or where nothing confirms the map."""
    return 1 - checked_share(n)


def _outside_of_outline(outside: float) -> list[Objection]:
    """Say, once for all sensors, how much of the layer lies outside the object's outline; that requires nothing."""
    if outside < LEAST_OUTSIDE:
        return []
    text = f"{percent(outside)} of the layer lies outside the object's outline and was not checked."
    return [Objection("unchecked", text, "")]


def _where(name: str) -> str:
    return "" if name == ONLY else f"sensor {name}: "


def _describe_pairs(placed: Numbers) -> str:
    """Return the label of a sensor that was placed by hand, and on which pairs its map rests."""
    label = describe_placement(placed)
    text = f"{label[0].upper()}{label[1:]}. The {placed['model']} rests on {placed['pairs']} pairs"
    if placed["worst"] is None:
        return f"{text}; a fifth would show how far they are off."
    x, y, error = placed["worst"]
    return f"{text}; the worst, at {x:.0f}, {y:.0f} of the reference, lies {error:.1f} px from a map of the others."


def _praise(numbers: Numbers) -> str:
    n = numbers["verification"]
    return (
        f"{n.get('agreeing', 0)} of the {n.get('found', 0)} check windows that were found agree with the map. "
        f"The held-out error is {numbers['held_out_px']:.2f} px over the {percent(checked_share({**numbers, **n}))} of the "
        f"layer that was checked."
    )

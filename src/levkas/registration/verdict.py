"""Verdict: rules on evidence decide whether a registration is accepted, and give the reasons.

A rule that finds a contradiction makes a map doubtful (``"warn"``) or refuses it. Where nothing contradicts a
map and nothing confirms it either, it is accepted, and the part that was not checked is named and counted: most
correct maps have such a part, and a warning on most maps would be ignored. `benchmarks/verdict_classes.py`
measures how often each class is correct.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from levkas.registration.advice import LOOK, describe_placement
from levkas.registration.record import Decision, Verdict
from levkas.registration.verdict_rules import (
    MATCHES,
    ONLY,
    WINDOWS,
    Finding,
    Numbers,
    objections_to,
    percent,
)


def judge_matches(numbers: dict[str, Any]) -> Verdict:
    """Decide on a map that rests on matches, by the numbers of `mirhashemi2019.measure`."""
    praise = (
        f"{numbers['kept']} of {numbers['matches']} matches were kept. {numbers['agreeing']} of the "
        f"{numbers['found']} check windows that were found agree with the map; their median error is "
        f"{numbers['window_median']:.2f} px. The held-out error is {numbers['held_out_median']:.2f} px."
    )
    objections = [
        (one.reason, one.on_matches or one.next_step, one.decision)
        for one in objections_to(numbers, MATCHES)
    ]
    return _decide(objections, (praise,), numbers, _unchecked(numbers))


def judge_windows(numbers: Mapping[str, Numbers]) -> Verdict:
    """Decide on a map that rests on windows; the sensor with the worst evidence decides.

    Parameters
    ----------
    numbers : mapping of a sensor's name to its numbers
        As `Verdict.numbers` holds them. The reference's own sensor, which is registered to nothing,
        is not judged.
    """
    judged = {name: n for name, n in numbers.items() if n["held_out_px"] is not None}
    objections = []
    for name, n in judged.items():
        known = {"kept": n["key_points_kept"], **n, **n["borne_out"]}
        objections += [
            (_where(name) + one.reason, one.next_step, one.decision)
            for one in objections_to(known, WINDOWS)
        ]
    praise = (_where(name) + _praise(n) for name, n in judged.items())
    unchecked = max((_unchecked({**n, **n["borne_out"]}) for n in judged.values()), default=0.0)
    verdict = _decide(objections, tuple(praise), dict(numbers), unchecked)
    placed = {name: n["placed_by_hand"] for name, n in numbers.items() if "placed_by_hand" in n}
    if not placed or verdict.decision == "refuse":
        return verdict
    reasons = tuple(_where(name) + _describe_pairs(one) for name, one in placed.items())
    return Verdict("by hand", reasons + verdict.reasons, LOOK, dict(numbers), 1.0)


def _decide(
    objections: Sequence[tuple[str, str, Finding]],
    praise: tuple[str, ...],
    numbers: dict[str, Any],
    unchecked: float,
) -> Verdict:
    """Refuse where one rule refuses; the next step is that of the first rule of the decision.

    Accepted and doubtful maps list what was not checked, after the reasons for the decision.
    """
    open_ones = [(reason, step) for reason, step, one in objections if one == "unchecked"]
    decisions: tuple[Decision, ...] = ("refuse", "warn")
    for decision in decisions:
        found = [(reason, step) for reason, step, one in objections if one == decision]
        if found:
            listed = found if decision == "refuse" else [*found, *open_ones]
            reasons = tuple(reason for reason, _ in listed)
            return Verdict(decision, reasons, found[0][1], numbers, unchecked)
    reasons = (*praise, *(reason for reason, _ in open_ones))
    step = next((step for _, step in open_ones if step), "")
    return Verdict("accept", reasons, step, numbers, unchecked)


def _unchecked(n: Numbers) -> float:
    """Return the share of the object that the other picture does not show, or where nothing confirms the map."""
    return 1 - n["overlap"] * min(n.get("checked", 1.0), max(n.get("coverage", 1.0), 0.0))


def _where(name: str) -> str:
    return "" if name == ONLY else f"sensor {name}: "


def _describe_pairs(placed: Numbers) -> str:
    """Return the label of a sensor that was placed by hand, and on which pairs its map rests."""
    label = describe_placement(placed)
    told = f"{label[0].upper()}{label[1:]}. The {placed['model']} rests on {placed['pairs']} pairs"
    if placed["worst"] is None:
        return f"{told}; a fifth would show how far they are off."
    x, y, error = placed["worst"]
    return f"{told}; the worst, at {x:.0f}, {y:.0f} of the reference, lies {error:.1f} px from a map of the others."


def _praise(numbers: Numbers) -> str:
    n = numbers["borne_out"]
    return (
        f"{n.get('agreeing', 0)} of the {n.get('found', 0)} check windows that were found agree with the map. "
        f"The held-out error is {numbers['held_out_px']:.2f} px over the {percent(n['checked'])} of the object "
        "that was checked."
    )

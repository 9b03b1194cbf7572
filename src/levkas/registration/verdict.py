"""Whether a registration can be believed: rules on evidence, with reasons in a user's words.

No rule looks at the residuals of the matches that were kept: the removal of outliers makes those
small whether the map is right or not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.agreement import WINDOW_PX, compare
from levkas.registration.checks import Checks
from levkas.registration.evidence import (
    Evidence,
    measure_chance,
    measure_held_out,
    measure_shape,
    measure_support,
    measure_windows,
)
from levkas.registration.record import Verdict

if TYPE_CHECKING:
    from collections.abc import Callable

    from levkas.geometry.transforms import Transform

SEED = 20190817
MATCHES_PER_TERM = 4
SURE_MATCHES_PER_TERM = 10
CHANCE_FACTOR = 2
SCALES = (0.15, 6.7)
ANISOTROPY = {"warn": 1.5, "refuse": 2.0}
AREA_RATIO = {"warn": 1.8, "refuse": 3.0}
OVERLAP = {"warn": 0.8, "refuse": 0.1}
COVERAGE = {"warn": 0.9, "refuse": 0.6}
OFF_SHARE = 0.2
RIVAL = {"warn": 0.85, "refuse": 0.95}
LEAST_FOUND = 6
LEAST_FOUND_SHARE = 0.05
LEAST_AGREEING_SHARE = 0.6

OTHER = "Check that both pictures show the same object, the same way up and framed alike"
POINTS = "give control points to start from"
LOOK = "Look at both pictures in the report with the flicker before you rely on this camera."
REGION = "Use nothing from there, or give control points there."


@dataclass(frozen=True)
class Finding:
    """What one rule found against a registration.

    Parameters
    ----------
    decision, reason, next_step : str
    of_the_paper : str
        The next step under the paper's method, where it has keys that the default method has not.
    """

    decision: str
    reason: str
    next_step: str
    of_the_paper: str = ""


def judge(
    evidence: Evidence,
    *,
    fit: Callable[[np.ndarray, np.ndarray], Transform] | None = None,
    rng: np.random.Generator | None = None,
) -> Verdict:
    """Decide whether a registration is accepted, accepted with a warning, or refused.

    Parameters
    ----------
    evidence : Evidence
    fit : callable, (target, reference) → Transform target → reference, optional
        How the map was fitted, for the held-out blocks; the polynomial of `evidence.order`.
    rng : numpy.random.Generator, optional
        For the random pairings; a fixed seed without it, so that a verdict can be repeated.

    Returns
    -------
    verdict : Verdict
        Refused where one rule refuses; the next step is that of the first rule that spoke loudest.
    """
    numbers = measure(evidence, fit=fit, rng=rng)
    findings = [found for rule in RULES if (found := rule(numbers))]
    refusals = [f for f in findings if f.decision == "refuse"]
    if refusals:
        first = refusals[0]
        step = first.of_the_paper or first.next_step
        return Verdict("refuse", _reasons(refusals), step, numbers)
    if findings:
        return Verdict("warn", _reasons(findings), findings[0].next_step, numbers)
    return Verdict("accept", (_praise(numbers),), "", numbers)


def measure(
    evidence: Evidence,
    *,
    fit: Callable[[np.ndarray, np.ndarray], Transform] | None = None,
    rng: np.random.Generator | None = None,
) -> dict[str, Any]:
    """Gather all numbers that the rules look at; keys as the functions of `evidence` say."""
    matches = evidence.matches
    agreement = compare(
        evidence.reference, evidence.target, evidence.transform, region=evidence.region
    )
    # What a working pixel of the comparison cannot show is not held against the map.
    tolerance = max(evidence.stop, agreement.step)
    checks = Checks(
        agreement.centres, agreement.shift, agreement.found, tolerance, WINDOW_PX * agreement.step
    )
    return {
        "matches": len(matches),
        "kept": int(matches.kept.sum()),
        "terms": evidence.terms,
        "stop": evidence.stop,
        "tolerance": tolerance,
        **measure_chance(evidence, rng or np.random.default_rng(SEED)),
        **measure_held_out(evidence, fit),
        **measure_shape(evidence),
        **measure_windows(checks),
        "rival": float(agreement.rival),
        **measure_support(evidence, checks),
    }


def _reasons(findings: list[Finding]) -> tuple[str, ...]:
    return tuple(f.reason for f in findings)


def _praise(n: dict[str, Any]) -> str:
    return (
        f"{n['kept']} of {n['matches']} matches are kept, {n['agreeing']} of {n['found']} windows "
        f"that are recognised lie where the map puts them, {n['window_median']:.2f} px off in the "
        f"median; blocks left out of the fit are predicted to {n['held_out_median']:.2f} px."
    )


def _enough_matches(n: dict[str, Any]) -> Finding | None:
    least = MATCHES_PER_TERM * n["terms"]
    if n["kept"] >= least:
        return None
    return Finding(
        "refuse",
        f"Only {n['kept']} matches are left for a map with {n['terms']} coefficients for each of "
        f"x and y; at least {least} are needed.",
        f"{OTHER}; if they do, raise `reject` or try the method `levkas`.",
    )


def _more_than_chance(n: dict[str, Any]) -> Finding | None:
    if n["kept"] > CHANCE_FACTOR * n["chance_kept"]:
        return None
    return Finding(
        "refuse",
        f"{n['kept']} matches are kept, but {n['chance_kept']} are kept too when places are paired "
        "at random: the map may be chance.",
        f"{OTHER}; if they do, lower `reject` or try the method `levkas`.",
    )


def check_fold(n: dict[str, Any]) -> Finding | None:
    """Refuse a map that folds over, has no answer, or leads wholly outside."""
    if n["overlap"] == 0:
        return Finding(
            "refuse",
            "The map puts the reference wholly outside the other picture.",
            f"{OTHER}.",
        )
    if n["folded"] == 0:
        return None
    return Finding(
        "refuse",
        f"The map folds over or has no answer in {100 * n['folded']:.0f} % of the overlap.",
        f"{OTHER}; if they do, {POINTS}.",
        f"{OTHER}; if they do, lower the order of the polynomial.",
    )


def check_shape(n: dict[str, Any]) -> Finding | None:
    """Refuse or warn of scales and stretches that no camera makes."""
    if "area_ratio" not in n:
        return None
    if n["scale_min"] < SCALES[0] or n["scale_max"] > SCALES[1]:
        return Finding(
            "refuse",
            f"The map scales by {n['scale_min']:.2g} to {n['scale_max']:.2g}, beyond "
            f"{SCALES[0]:g} to {SCALES[1]:g}.",
            f"{OTHER}.",
        )
    for decision in ("refuse", "warn"):
        if n["anisotropy"] > ANISOTROPY[decision] or n["area_ratio"] > AREA_RATIO[decision]:
            return Finding(
                decision,
                f"The map stretches one way {n['anisotropy']:.2f} times as much as across, and "
                f"areas {n['area_ratio']:.2f} times as much in one place as in another.",
                f"{OTHER}; a camera that looks very aslant should be set up anew."
                if decision == "refuse"
                else LOOK,
            )
    return None


def _predicts(n: dict[str, Any]) -> Finding | None:
    if n["held_out_median"] > n["tolerance"]:
        miss = n["held_out_median"]
        text = f"off by {miss:.2f} px in the median" if np.isfinite(miss) else "not predicted"
        return Finding(
            "refuse",
            f"Blocks of matches that are left out of the fit are {text}: the map fits its matches "
            "and says nothing of the rest.",
            f"{OTHER}; if they do, lower the order of the polynomial.",
        )
    if n["held_out_p90"] > 3 * n["tolerance"]:
        return Finding(
            "warn",
            f"One match in ten that is left out of the fit is off by more than "
            f"{n['held_out_p90']:.1f} px.",
            LOOK,
        )
    return None


def check_windows(n: dict[str, Any]) -> Finding | None:
    """Refuse a map at which windows are not recognised, or not where it puts them."""
    least = max(LEAST_FOUND, LEAST_FOUND_SHARE * n["windows"])
    if n["found"] < least:
        sure = n["kept"] >= SURE_MATCHES_PER_TERM * n["terms"]
        return Finding(
            "warn" if sure else "refuse",
            f"Of {n['windows']} windows of the reference only {n['found']} are recognised where "
            "the map puts them: there is nothing to check the map by.",
            LOOK if sure else f"{OTHER}.",
        )
    if n["agreeing"] < LEAST_AGREEING_SHARE * n["found"] or n["window_median"] > n["tolerance"]:
        return Finding(
            "refuse",
            f"Of {n['found']} windows of the reference that are recognised, {n['agreeing']} lie "
            f"where the map puts them; they are {n['window_median']:.1f} px off in the median.",
            f"{OTHER}; if they do, {POINTS}.",
            f"{OTHER}; if they do, raise `reject` or try the method `levkas`.",
        )
    return None


def check_rival(n: dict[str, Any]) -> Finding | None:
    """Refuse or warn where the pictures agree as well when shifted elsewhere."""
    if n["rival"] > 1:
        return Finding(
            "refuse",
            "Shifted elsewhere, the pictures agree better than here: this is not the place.",
            f"{OTHER}; if they do, {POINTS}.",
            f"{OTHER}; if they do, try the method `levkas`, or {POINTS}.",
        )
    for decision in ("refuse", "warn"):
        if n["rival"] > RIVAL[decision]:
            return Finding(
                decision,
                f"Shifted elsewhere, the pictures agree {100 * n['rival']:.0f} % as well as here: "
                "the picture repeats itself.",
                "Give `region` so that something that does not repeat is in it, or control points.",
            )
    return None


def _covered(n: dict[str, Any]) -> Finding | None:
    bad = n["unsupported"] + n["off"]
    if n["off_share"] > OFF_SHARE:
        return Finding(
            "refuse",
            f"The map is off in {100 * n['off_share']:.0f} % of what both pictures show.",
            f"{OTHER}; if they do, raise `reject` or try the method `levkas`.",
        )
    if n["coverage"] < COVERAGE["refuse"]:
        return Finding(
            "refuse",
            f"Only {100 * n['coverage']:.0f} % of what both pictures show is borne out by matches "
            "or by comparison.",
            f"{OTHER}.",
        )
    if n["off"] or n["coverage"] < COVERAGE["warn"]:
        where = "; ".join(_place(cell) for cell in bad[:4])
        return Finding(
            "warn",
            f"The map is off or not borne out in {100 * (1 - n['coverage']):.0f} % of what both "
            f"pictures show (x, y, width, height: {where}{'; …' if len(bad) > 4 else ''}).",
            REGION,
        )
    return None


def check_overlap(n: dict[str, Any]) -> Finding | None:
    """Refuse or warn where the target shows little of the reference."""
    for decision in ("refuse", "warn"):
        if n["overlap"] < OVERLAP[decision]:
            return Finding(
                decision,
                f"This camera shows {100 * n['overlap']:.0f} % of the reference; nothing is known "
                "of the rest.",
                f"{OTHER}." if decision == "refuse" else "Use nothing outside the overlap.",
            )
    return None


def _place(cell: list[float]) -> str:
    return ", ".join(f"{v:.0f}" for v in cell)


RULES: tuple[Callable[[dict[str, Any]], Finding | None], ...] = (
    _enough_matches,
    _more_than_chance,
    check_fold,
    check_shape,
    _predicts,
    check_windows,
    check_rival,
    check_overlap,
    _covered,
)

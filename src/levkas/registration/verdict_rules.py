"""Rules of the verdict: decision, reason and next step for each piece of evidence on a registration.

A rule that finds a contradiction makes a map doubtful (``"warn"``) or refuses it; what only was not checked is
``"unchecked"``. No rule looks at the residuals of the matches that were kept: the removal of outliers makes those
small whether the map is right or not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from levkas.registration.advice import (
    BY_HAND,
    LOOK,
    OTHER,
    POINTS,
    REGION,
    Numbers,
    checked_share,
    object_share,
    overlap_share,
    percent,
)
from levkas.registration.line_displacement import describe_correction, describe_displacement

Finding = Literal["refuse", "warn", "unchecked"]
"""Result of one rule: refused, contradicted somewhere, or not checked somewhere, which is only reported."""


class Limits(NamedTuple):
    """Value beyond which a rule warns, and beyond which it refuses."""

    warn: float
    refuse: float

    def exceeded_by(self, *values: float) -> Finding | None:
        """Return the decision on the largest of `values`."""
        largest = max(values)
        return "refuse" if largest > self.refuse else "warn" if largest > self.warn else None


ANISOTROPY, AREA_RATIO, SECOND_PEAK_RATIO = Limits(1.5, 2.0), Limits(1.8, 3.0), Limits(0.85, 0.95)
OVERLAP, COVERAGE, PREDICTED = Limits(0.8, 0.1), Limits(0.9, 0.6), Limits(0.5, 0.2)
LINES = Limits(0.1, 1.0)
SCAN_LINES = Limits(0.35, 1.0)


@dataclass(frozen=True)
class VerdictSettings:
    """Limits of the rules."""

    matches_per_term: int = 4
    sure_matches_per_term: int = 10
    """`matches_per_term`, `sure_matches_per_term`: matches for each coefficient of a polynomial that are needed; that make
    up for missing windows."""
    scales: tuple[float, float] = (0.15, 6.7)
    """Target px per reference px that a camera can have."""
    anisotropy: Limits = ANISOTROPY
    area_ratio: Limits = AREA_RATIO
    second_peak_ratio: Limits = SECOND_PEAK_RATIO
    """`anisotropy`, `area_ratio`, `second_peak_ratio`: stretch one way over across; largest to smallest local area;
    correlation of the pictures at the best place elsewhere, relative to here."""
    overlap: Limits = OVERLAP
    """Least share of the reference that the target shows."""
    coverage: Limits = COVERAGE
    """Least share of the cells that matches or windows confirm, of a map on matches."""
    least_coverage: float = 0.15
    off_share: float = 0.2
    """`least_coverage`, `off_share`: share of cells confirmed by windows below which, and share of cells off above which, a
    dense map is refused."""
    least_found: int = 6
    least_found_share: float = 0.05
    least_agreeing_share: float = 0.6
    """`least_found`, `least_found_share`, `least_agreeing_share`: windows that have to be found, in number and as a share;
    share of them that have to agree."""
    sure_share: float = 0.75
    """Share of all check windows that agree, from which it does not matter how the search was begun."""
    predicted: Limits = PREDICTED
    """Least share of check windows that match better than 19 of 20 unrelated windows."""
    good_steps: float = 0.25
    bad_px: float = 1.0
    bad_steps: float = 0.3
    """`good_steps`, `bad_px`, `bad_steps`: held-out error: px of the compared grid that are a warning; reference px, and px
    of the grid, that are refused. Where the target is coarse, single windows scatter more than the map is off."""
    scatter: float = 1.0
    """Held-out error over the sigma of single windows up to which their own noise explains it: 0.6 to 1.05 of right maps of
    infrared pictures, 0.8 to 11 of maps that are wrong somewhere."""
    least_cover: float = 0.5
    least_checked: float = 0.75
    """`least_cover`, `least_checked`: share of the reference below which the compared share is stated; share of what both
    show below which a map only reaches over too much, and is doubtful."""
    marks: float = 0.25
    """Correlation of marks in one light that it is not above: of copies by one pattern (`benchmarks/verdict.py classes`)."""
    least_outlines: int = 14
    least_outlines_share: float = 0.75
    """`least_outlines`, `least_outlines_share`: large blocks that have to agree by their outlines, in number and as a share,
    where windows are not recognised."""
    lines: Limits = LINES
    """In reference px, or px of the grid where it is coarser: displacement of single lines, the root mean square of both
    axes. Honest pictures have 0.04 at most that is more than chance."""
    scan_lines: Limits = SCAN_LINES
    """In px of the grid: the same of maps of a scan, of which a line is known to lie up to a third of a px aside: it is
    reported."""
    align_px: float = 3.0
    """In px of a sensor: from a declared alignment; refocusing moves the sensors of a camera against one another by a px or
    two."""


SETTINGS = VerdictSettings()
UNEVEN = (
    "A scan that moved unevenly does this, lost lines, interlaced halves, and a program that bent or turned the picture by "
    "whole pixels: use the file as the camera wrote it, or capture it again."
)
TRY_LEVKAS = "try the method `levkas`"
#: Name among the numbers of a sensor without one.
ONLY = "sensor"


@dataclass(frozen=True)
class Objection:
    """One rule's objection to a registration."""

    decision: Finding
    reason: str
    next_step: str
    lacks_evidence: bool = False
    """Whether nothing contradicts the map, and little could be compared."""


def _error_text(error: float) -> str:
    """Return an error as text.

    >>> _error_text(0.5), _error_text(float("inf"))
    ('0.50 px', 'not measurable')
    """
    return f"{error:.2f} px" if np.isfinite(error) else "not measurable"


def _places(cells: Sequence[Sequence[float]]) -> str:
    """Return the first four of (x, y, width, height) as text."""
    where = "; ".join(", ".join(f"{v:.0f}" for v in cell) for cell in cells[:4])
    return f"(x, y, width, height: {where}{'; …' if len(cells) > 4 else ''})"


# --- rules; each returns an objection, or None


def enough_matches(n: Numbers) -> Objection | None:
    """Refuse a polynomial on few matches for each coefficient."""
    least = SETTINGS.matches_per_term * n["terms"]
    if n["kept"] >= least:
        return None
    return Objection(
        "refuse",
        f"Only {n['kept']} matches were kept. A map with {n['terms']} coefficients for each of x and y "
        f"needs at least {least}.",
        f"{OTHER}; if they do, raise `reject` or {TRY_LEVKAS}.",
    )


def begins_with_key_points(n: Numbers) -> Objection | None:
    """Warn of a map that was begun from outlines alone, or from pairs of another program, unless windows confirm it nearly everywhere."""
    confirmed = n.get("windows", 0) > 0 and n["agreeing"] >= SETTINGS.sure_share * n["windows"]
    if confirmed or not (n.get("by_outlines") or n.get("by_pairs")):
        return None
    begun = "their outlines" if n.get("by_outlines") else "pairs of another program"
    return Objection(
        "warn",
        f"No key points match between the two pictures. The search started from {begun}.",
        LOOK,
    )


def better_than_chance(n: Numbers) -> Objection | None:
    """Refuse or warn where check windows match hardly better than unrelated windows."""
    share = n["share_above_chance"]
    if share is None or share >= SETTINGS.predicted.warn:
        return None
    refused = share < SETTINGS.predicted.refuse
    return Objection(
        "refuse" if refused else "warn",
        f"Only {percent(share)} of the check windows match better than unrelated places do (permutation test, 95 % limit).",
        BY_HAND if refused else LOOK,
        lacks_evidence=refused,
    )


def predicts_windows(n: Numbers) -> Objection | None:
    """Refuse or warn where blocks of windows that were not fitted are off by more than their own noise."""
    error, step = n["held_out_px"], n["step"]
    if error is None or error < SETTINGS.good_steps * step:
        return None
    scatter = n.get("window_sigma_px") or 0.0
    if error < SETTINGS.bad_px and error < SETTINGS.scatter * scatter:
        return None
    if np.isinf(error):
        return Objection(
            "refuse",
            "Too few windows were found to measure a held-out error.",
            BY_HAND,
            lacks_evidence=True,
        )
    bad = not error < max(SETTINGS.bad_px, SETTINGS.bad_steps * step)
    return Objection(
        "refuse" if bad else "warn",
        f"The held-out error is {_error_text(error)}: no single map fits all windows.",
        f"{OTHER}; an object that was bent or cut between the captures has no single map."
        if bad
        else LOOK,
    )


def does_not_fold(n: Numbers) -> Objection | None:
    """Refuse a map that folds over, has no answer, or leads wholly outside."""
    if n["overlap"] == 0:
        return Objection(
            "refuse", "The map places the whole reference outside the other picture.", BY_HAND
        )
    if n["folded"] == 0:
        return None
    return Objection(
        "refuse",
        f"The map folds or is undefined in {percent(n['folded'])} of the overlap.",
        BY_HAND,
    )


def has_plausible_shape(n: Numbers) -> Objection | None:
    """Refuse or warn of scales and stretches that no camera makes."""
    if "area_ratio" not in n:
        return None
    low, high = n.get("scales") or SETTINGS.scales
    if n["scale_min"] < low or n["scale_max"] > high:
        return Objection(
            "refuse",
            f"The scale of the map is {n['scale_min']:.3g} to {n['scale_max']:.3g}; a camera gives {low:g} to {high:g}.",
            BY_HAND,
        )
    decisions = (
        SETTINGS.anisotropy.exceeded_by(n["anisotropy"]),
        SETTINGS.area_ratio.exceeded_by(n["area_ratio"]),
    )
    if decisions == (None, None):
        return None
    refused = "refuse" in decisions
    return Objection(
        "refuse" if refused else "warn",
        f"The map stretches one direction {n['anisotropy']:.2f} times as much as the other, and its scale of "
        f"area varies by a factor of {n['area_ratio']:.2f}.",
        f"{OTHER}; if the camera was strongly tilted, set it up again." if refused else LOOK,
    )


def predicts_matches(n: Numbers) -> Objection | None:
    """Refuse or warn where blocks of matches that were not fitted are off."""
    miss = n["held_out_median"]
    if miss > n["tolerance"]:
        text = f"{miss:.2f} px in the median" if np.isfinite(miss) else "not measurable"
        return Objection(
            "refuse",
            f"The held-out error is {text}: nothing confirms the map between its matches."
            if np.isinf(miss)
            else f"The held-out error is {text}: the map fits its own matches and is wrong between them.",
            f"{OTHER}; if they do, lower `order` or {TRY_LEVKAS}.",
        )
    if n["held_out_p90"] > 3 * n["tolerance"]:
        return Objection(
            "warn",
            f"The held-out error exceeds {n['held_out_p90']:.1f} px at one match in ten.",
            LOOK,
        )
    return None


def windows_agree(n: Numbers) -> Objection | None:
    """Refuse a map at which windows are not found, or not where it puts them."""
    least = max(SETTINGS.least_found, SETTINGS.least_found_share * n["windows"])
    if n["found"] < least:
        sure = n["kept"] >= SETTINGS.sure_matches_per_term * n["terms"]
        return Objection(
            "warn" if sure else "refuse",
            f"Only {n['found']} of {n['windows']} check windows were found: too few to check the map.",
            LOOK if sure else BY_HAND,
            lacks_evidence=not sure,
        )
    few = n["agreeing"] < SETTINGS.least_agreeing_share * n["found"]
    if few or n["window_median"] > n["tolerance"]:
        off = n["window_median"] > n["tolerance"]
        median = f"; the median error is {n['window_median']:.1f} px" if off else ""
        return Objection(
            "refuse",
            f"Only {n['agreeing']} of the {n['found']} check windows that were found agree with the map{median}.",
            BY_HAND,
        )
    return None


def fits_nowhere_else(n: Numbers) -> Objection | None:
    """Refuse or warn where the pictures agree as well when shifted elsewhere."""
    if n["second_peak_ratio"] > 1:
        return Objection(
            "refuse",
            "The pictures agree better at another shift: the map is in the wrong place.",
            BY_HAND,
        )
    decision = SETTINGS.second_peak_ratio.exceeded_by(n["second_peak_ratio"])
    if decision is None:
        return None
    return Objection(
        decision,
        f"The pictures agree {100 * n['second_peak_ratio']:.0f} % as well at another shift: the pattern repeats.",
        f"Choose a `region` with detail that does not repeat{f', or {POINTS}' if decision == 'refuse' else ''}.",
    )


def shows_the_reference(n: Numbers) -> Objection | None:
    """Refuse or warn where the target shows little of the reference."""
    if n["overlap"] >= SETTINGS.overlap.warn:
        return None
    refused = n["overlap"] < SETTINGS.overlap.refuse
    return Objection(
        "refuse" if refused else "unchecked",
        f"This camera has no data in {percent(object_share(n) - overlap_share(n))} of the layer.",
        f"{OTHER}; if this camera shows only a part of it, capture the rest too."
        if refused
        else "Do not use the layer where this camera has no data.",
    )


def matches_cover(n: Numbers) -> Objection | None:
    """Refuse or warn where neither matches nor windows confirm parts of a map on matches."""
    if n["off_share"] > SETTINGS.off_share:
        return Objection(
            "refuse",
            f"Check windows lie beside the map in {percent(n['off_share'])} of the overlap.",
            f"{OTHER}; if they do, raise `reject` or {TRY_LEVKAS}.",
        )
    if n["coverage"] < SETTINGS.coverage.refuse:
        return Objection(
            "refuse",
            f"Matches and check windows confirm the map in only {percent(n['coverage'])} of the overlap.",
            BY_HAND,
        )
    return _off_or_unconfirmed(n)


def windows_cover(n: Numbers) -> Objection | None:
    """Refuse or warn where windows do not confirm parts of a dense map."""
    if "coverage" not in n or not (n["off"] or n["coverage"] < SETTINGS.coverage.warn):
        return None
    if n["off_share"] > SETTINGS.off_share or n["coverage"] < SETTINGS.least_coverage:
        return Objection(
            "refuse",
            f"Check windows confirm the map in only {percent(n['coverage'])} of the overlap"
            + (f" and lie beside it in {percent(n['off_share'])}." if n["off_share"] else "."),
            BY_HAND,
            lacks_evidence=n["off_share"] <= SETTINGS.off_share,
        )
    return _off_or_unconfirmed(n)


def _off_or_unconfirmed(n: Numbers) -> Objection | None:
    """Doubt a map that is off in cells, or not confirmed in more than a quarter of them; else say what was not checked."""
    if n["off"]:
        # A window agrees up to twice the tolerance: only beyond that does it contradict the map.
        shifts = n.get("off_shift") or [(np.inf, 0.0)] * len(n["off"])
        far = [
            c for c, s in zip(n["off"], shifts, strict=True) if np.hypot(*s) > 2 * n["tolerance"]
        ]
        part = _part(n, n["off_share"] * len(far or n["off"]) / len(n["off"]))
        what = "The map is wrong" if far else "Check windows do not confirm the map"
        where = f"{_places(far or n['off'])}"
        return Objection("warn", f"{what} in {part} {where}.", REGION)
    if n["coverage"] >= SETTINGS.coverage.warn:
        return None
    return Objection(
        "warn" if n["coverage"] < SETTINGS.least_checked else "unchecked",
        f"The map was not checked in {_part(n, 1 - n['coverage'])} {_places(n['unsupported'])}.",
        REGION,
    )


def _part(n: Numbers, share: float) -> str:
    """Return a share of what both pictures show of the object as one of the layer, in words."""
    return f"{percent(share * overlap_share(n))} of the layer"


def is_checked(n: Numbers) -> Objection | None:
    """Warn where the map reaches over more than a quarter of what both pictures show."""
    share = n.get("checked", 1.0)
    if share >= SETTINGS.least_checked or not n["unchecked"]:
        return None
    *box, part = n["unchecked"][0]
    return Objection(
        "warn",
        (
            f"The held-out error is {n['held_out_px']:.2f} px over the {percent(checked_share(n))} of the layer that was checked"
            if np.isfinite(n["held_out_px"])
            else f"Only {percent(checked_share(n))} of the layer was checked"
        )
        + f". In {_part(n, part)} the map is extrapolated {_places([box])}.",
        REGION,
    )


def bears_the_same_marks(n: Numbers) -> Objection | None:
    """Warn where pictures of one light hold marks that two hands cannot share, and these lie at other places.

    Other light may show other marks: film has grain, an X-ray the wood. Nothing is reported where lines are displaced, which
    takes marks apart.
    """
    marks, lines = n.get("marks"), lines_lie_still(n)
    if not marks or not n["alike"] or (lines and lines.decision != "unchecked"):
        return None
    if marks["at_most"] >= SETTINGS.marks:
        return None
    return Objection(
        "warn",
        "Outlines agree; fine marks between them (cracks, losses, strokes, weave) do not: their correlation is "
        f"{marks['correlation']:.2f} in {marks['windows']} windows, at most {marks['at_most']:.2f}, and 0.30 or more in "
        "pictures of one object. The pictures may show two objects by one pattern.",
        LOOK,
    )


def lines_lie_still(n: Numbers) -> Objection | None:
    """Refuse or warn where whole lines of a picture are displaced against one another, or neighbours that a map follows lie apart.

    Less than the limit is named, and so are lines that the map follows.
    """
    lines, followed = n.get("line_displacement"), n.get("line_correction")
    found: list[tuple[Finding | None, str]] = []
    if lines and lines["displaced"]:
        limits = SETTINGS.scan_lines if n.get("scales") else SETTINGS.lines
        decision = limits.exceeded_by(lines["rms_px"] / lines["step"])
        found.append((decision, describe_displacement(lines)))
    if followed:
        decision = SETTINGS.lines.exceeded_by(followed["uneven_px"] / followed["before"]["step"])
        found.append((decision, describe_correction(followed)))
    if not found:
        return None
    decision = max((one for one, _ in found), key=(None, "warn", "refuse").index)
    reasons = " ".join(text for _, text in reversed(found))
    return Objection(decision or "unchecked", reasons, UNEVEN if decision else "")


def lies_where_declared(n: Numbers) -> Objection | None:
    """Warn of a sensor that lies elsewhere than its declared alignment puts it."""
    apart = n.get("align_apart_px")
    if apart is None or apart <= SETTINGS.align_px:
        return None
    return Objection(
        "warn",
        f"The sensor lies {apart:.1f} of its px from where the declared `align` puts it.",
        "Correct this sensor's `align` in campaign.toml, or take it out to have it measured.",
    )


def is_compared(n: Numbers) -> Objection | None:
    """Report where less than half of the reference's windows could be compared."""
    if n["cover"] is None or n["cover"] >= SETTINGS.least_cover:
        return None
    return Objection(
        "unchecked", f"Only {percent(n['cover'])} of the reference's windows were compared.", LOOK
    )


def has_converged(n: Numbers) -> Objection | None:
    """Warn where the map still moved in the last round."""
    if n["converged"] is not False:
        return None
    return Objection(
        "warn",
        f"The map did not converge in {n['rounds']} rounds: the last round moved it by {n['moved']:.2f} px.",
        LOOK,
    )


Rule = Callable[[Numbers], Objection | None]
MATCHES, WINDOWS = frozenset({"matches"}), frozenset({"windows"})
BOTH = MATCHES | WINDOWS

#: Rules in the order of their reasons, and whether the maps that they judge rest on matches or windows.
RULES: dict[Rule, frozenset[str]] = {
    lines_lie_still: WINDOWS,
    enough_matches: MATCHES,
    begins_with_key_points: WINDOWS,
    better_than_chance: WINDOWS,
    predicts_windows: WINDOWS,
    does_not_fold: BOTH,
    has_plausible_shape: BOTH,
    predicts_matches: MATCHES,
    windows_agree: BOTH,
    fits_nowhere_else: BOTH,
    shows_the_reference: BOTH,
    matches_cover: MATCHES,
    windows_cover: WINDOWS,
    is_checked: WINDOWS,
    bears_the_same_marks: WINDOWS,
    lies_where_declared: BOTH,
    is_compared: WINDOWS,
    has_converged: WINDOWS,
}

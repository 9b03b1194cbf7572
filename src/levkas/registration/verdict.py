"""Verdict: rules on evidence decide whether a registration is accepted, and give the reasons.

A rule that finds a contradiction makes a map doubtful (``"warn"``) or refuses it. What nothing contradicts is accepted, and the
part that was not checked is named and counted: most correct maps have one. No rule looks at the residuals of matches that were kept: the
removal of outliers makes those small whether the map is right or not. `benchmarks/verdict.py classes` measures how often each class is correct.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf, isfinite
from typing import Any, Literal, NamedTuple

from levkas.core.text import counted
from levkas.registration.advice import (
    BY_HAND,
    LEAST_OUTSIDE,
    LOOK,
    OTHER,
    POINTS,
    REGION,
    describe_placement,
    percent,
)
from levkas.registration.record import Decision, Verdict

Basis = Literal["windows", "matches"]
Light = Literal["same", "other", "unknown"]
Finding = Literal["note", "warn", "refuse"]
#: Name among the numbers of a sensor without one.
ONLY = "sensor"
SCALES = (0.15, 6.7)
"""Target px per reference px that a camera can have."""
ALIGN_PX = 3.0
"""In px of a sensor, from a declared alignment: refocusing moves it by a px or two."""
GOOD_STEPS, BAD_PX, BAD_STEPS = 0.25, 1.0, 0.3
"""Held-out error: px of the compared grid that are a doubt; reference px, and px of the grid, the larger, that are refused."""
LEAST_FOUND, LEAST_FOUND_SHARE = 6, 0.05
"""Check windows that have to be found, in number and as a share."""
LEAST_OUTLINES, LEAST_OUTLINES_SHARE = 14, 0.75
"""Large blocks that have to agree by their outlines, in number and as a share, where windows are not recognised."""
MOST_CONTRADICTING = 0.4
"""Share of the telling windows."""
SURE_MATCHES = 10
"""Matches for each coefficient of a polynomial that make up for missing windows."""


@dataclass(frozen=True)
class Evidence:
    """What is known of the map of one sensor, complete before it is judged; distances in reference px, shares 0..1."""

    basis: Basis
    """What the map was fitted to."""
    kept: int
    """Matches, or key points of the start, that agree with the map."""
    terms: int
    """Coefficients of the map, of x and y each."""
    held_out_px: float
    """In blocks to which the map was not fitted; infinite where too little was left to fit."""
    overlap: float
    """Share of the object that the target shows."""
    folded: float
    """Share of the overlap where the map has no or a flipped Jacobian."""
    mirrored: bool
    tolerance: float
    windows: int
    found: int
    agreeing: int
    contradicting: int
    """Check windows, those recognised beyond chance, those of these within twice the `tolerance` of where the map puts them, and those
    that fit elsewhere better than their own noise explains."""
    window_median: float
    """How far the last two are off, infinite without any."""
    second_peak_ratio: float
    """Correlation of the pictures at the best place elsewhere, relative to here."""
    box: tuple[float, ...]
    """(x, y, width, height) of what is judged."""
    coverage: float
    """Of the cells that both pictures show and that have structure, the share that is confirmed."""
    off_share: float
    """Of these cells, the share that windows contradict."""
    unsupported: list[list[float]]
    off: list[list[float]]
    """Cells, (x, y, width, height), where nothing confirms the map, and where windows contradict it."""
    checked: float
    """Of what both pictures show, the share no farther than a window's side from windows that confirm the map."""
    unchecked: list[list[float]]
    """Rectangles about the largest parts of the rest, each with its share at the end."""
    scale_min: float = 1.0
    scale_max: float = 1.0
    """Target px per reference px."""
    area_ratio: float = 1.0
    """Largest to smallest local area."""
    anisotropy: float = 1.0
    """Largest ratio of the two principal scales."""
    step: int = 1
    """Reference px per px of the grid on which it was judged."""
    scales: tuple[float, float] = SCALES
    """Of a plausible map; maps of one scan may be coarser."""
    object_share: float = 1.0
    """Share of the layer that shows the object."""
    held_out_p90: float | None = None
    """Of matches: error that one in ten exceeds."""
    window_sigma_px: float | None = None
    """Median sigma of the shifts of single windows, either axis."""
    share_above_chance: float | None = None
    """Of those windows, the share that matches better than 19 of 20 unrelated ones."""
    begun: Literal["key points", "outlines", "pairs"] = "key points"
    rounds: int | None = None
    converged: bool = True
    moved: float = 0.0
    """By which the last round moved the map, the median over windows."""
    light: Light = "unknown"
    """Whether the band by which the map was judged sees light that the reference sees too."""
    align_apart_px: float | None = None
    """How far the map lies from a declared alignment, px of the sensor."""
    start_pairs: dict[str, Any] | None = None
    """How many pairs of another program agree with the map."""
    outlines: dict[str, float] | None = None
    """Large blocks compared by their outlines, where windows say little: how many, ``agreeing``, within ``px``."""
    line_displacement: dict[str, Any] | None = None
    line_correction: dict[str, Any] | None = None
    """How single lines lie beside the map, and those that it follows."""

    @property
    def confirmed(self) -> float:
        """Share of the layer where windows or matches confirm the map."""
        return self.visible * min(self.checked, max(self.coverage, 0.0))

    @property
    def telling(self) -> int:
        """Check windows that say something."""
        return self.agreeing + self.contradicting

    @property
    def visible(self) -> float:
        """Share of the layer in which the camera shows the object."""
        return self.object_share * self.overlap

    @property
    def agree_by_outlines(self) -> bool:
        """Whether enough blocks lie where the map puts them."""
        found = self.outlines
        return found is not None and found["agreeing"] >= max(
            LEAST_OUTLINES, LEAST_OUTLINES_SHARE * found["blocks"]
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers of a record; ``alike`` says that pictures may be compared by likeness (SSIM)."""
        return asdict(self) | {"alike": self.light == "same"}


# --- rules


class Rule(NamedTuple):
    """One number of the evidence, the larger the worse, with the limits above which it is noted, doubted, refused."""

    name: str
    number: Callable[[Evidence], float]
    note: float
    warn: float
    refuse: float
    sentence: Callable[[Evidence], str]
    doubted: str = LOOK
    refused: str = BY_HAND
    noted: str = ""
    """`doubted`, `refused`, `noted`: what to do then."""
    on: tuple[Basis, ...] = ("windows", "matches")
    lacks_evidence: bool = False
    """Whether nothing contradicts the map, and little could be compared."""


class Objection(NamedTuple):
    """One rule's objection to a registration."""

    decision: Finding
    reason: str
    next_step: str


def _places(cells: Sequence[Sequence[float]]) -> str:
    """Return the first four of (x, y, width, height) as text."""
    where = "; ".join(", ".join(f"{v:.0f}" for v in cell[:4]) for cell in cells[:4])
    return f"(x, y, width, height: {where}{'; …' if len(cells) > 4 else ''})"


def _lines(e: Evidence) -> float:
    """Return by how much lines are displaced, and neighbours apart that the map follows, px of the grid; -1 where none are."""
    lines, followed, found = e.line_displacement, e.line_correction, [-1.0]
    if lines and lines["displaced"]:
        # Of maps of a scan a line is known to lie up to a third of a px aside.
        size = lines["rms_px"] / lines["step"]
        found.append(size if e.scales == SCALES or size > 1 else 0.28 * size)
    if followed:
        found.append(followed["uneven_px"] / followed["before"]["step"])
    return max(found)


def _describe_lines(e: Evidence) -> str:
    lines, followed, texts = e.line_displacement, e.line_correction, []
    if followed:
        apart = max(followed["uneven_px"], followed["error_px"])
        texts = [_displaced(followed["before"]), f"The map follows them to {apart:.2f} px."]
    if lines and lines["displaced"]:
        texts.append(_displaced(lines))
    return " ".join(texts)


def _displaced(numbers: Mapping[str, Any]) -> str:
    line = "line" if numbers["lines"] == "rows" else "column"
    return (
        f"The {line}s are displaced against one another: {numbers['rms_px']:.2f} px (root mean square), "
        f"{numbers['largest_px']:.2f} px at most."
    )


def _unsure_start(e: Evidence) -> float:
    return 0.0 if e.begun == "key points" else 1 - e.agreeing / max(e.windows, 1)


def _held_out(e: Evidence) -> float:
    """Return the held-out error over the one that is refused; 0 where it is small, or the noise of single windows explains it."""
    error = e.held_out_px
    if e.basis == "matches":
        scattered = (e.held_out_p90 or 0.0) > 3 * e.tolerance
        return error / e.tolerance if scattered or error > e.tolerance else 0.0
    noise = error < min(BAD_PX, e.window_sigma_px or 0.0)
    if error < GOOD_STEPS * e.step or noise or not isfinite(error):
        return 0.0
    return error / max(BAD_PX, BAD_STEPS * e.step)


def _few_found(e: Evidence) -> float:
    """Return 1 where too few windows are found, or nothing was held out, 0.5 where many matches make up for missing windows."""
    if not isfinite(e.held_out_px):
        return 1.0
    if e.telling >= max(LEAST_FOUND, LEAST_FOUND_SHARE * e.windows):
        return 0.0
    return 0.5 if e.kept >= SURE_MATCHES * e.terms else 1.0


def _contradicted(e: Evidence) -> float:
    """Return the share of the cells that windows contradict; 1 where they do everywhere: many of them, or by their median."""
    enough = e.telling >= max(LEAST_FOUND, LEAST_FOUND_SHARE * e.windows)
    everywhere = e.contradicting > MOST_CONTRADICTING * e.telling or e.window_median > e.tolerance
    return 1.0 if enough and everywhere else e.off_share


def _describe_contradiction(e: Evidence) -> str:
    if not e.off_share:
        return (
            f"Only {e.agreeing} check windows agree with the map, {e.contradicting} contradict it; "
            f"the median error is {e.window_median:.1f} px."
        )
    return f"The map is wrong in {percent(e.off_share * e.visible)} of the layer {_places(e.off)}."


def _beyond_windows(e: Evidence) -> float:
    """Return the share of what both pictures show that is far from windows that confirm the map, in patches of which the largest is 15 % at
    least where that is a quarter: beyond windows a map is extrapolated. 22 to 58 % lie in one patch where bent pictures have a blank part."""
    if e.basis == "matches" or not e.unchecked:
        return 0.0
    return min(1 - e.checked, e.unchecked[0][-1] / 0.6)


def _unchecked(e: Evidence) -> float:
    """Return the share of the cells that nothing confirms, by matches twice, which err together; at least 0.6 where a quarter is extrapolated."""
    share = (1 - e.coverage) * (2 if e.basis == "matches" else 1)
    return max(share, 0.6) if _beyond_windows(e) > 0.25 else share


def _describe_unchecked(e: Evidence) -> str:
    if 1 - e.coverage > 0.5 or not _beyond_windows(e) > 0.25:
        return f"The map was not checked in {percent((1 - e.coverage) * e.visible)} of the layer {_places(e.unsupported)}."
    *box, part = e.unchecked[0]
    return (
        f"Only {percent(e.confirmed)} of the layer was checked. In {percent(part * e.visible)} of the layer "
        f"the map is extrapolated {_places([box])}."
    )


def _impossible(e: Evidence) -> float:
    """Return by which factor a map's scale lies beyond those of a camera; infinite where it folds or shows nothing."""
    if e.folded or not e.overlap:
        return inf
    return max(e.scales[0] / e.scale_min, e.scale_max / e.scales[1])


def _describe_impossible(e: Evidence) -> str:
    if not e.overlap:
        return "The map places the whole reference outside the other picture."
    if e.folded:
        return f"The map folds or is undefined in {percent(e.folded)} of the overlap."
    return f"The scale of the map is {e.scale_min:.3g} to {e.scale_max:.3g}; a camera gives {e.scales[0]:g} to {e.scales[1]:g}."


UNEVEN = (
    "A scan that moved unevenly does this, lost lines, interlaced halves, and a program that bent or turned the picture by "
    "whole pixels: use the file as the camera wrote it, or capture it again."
)
BENT = f"{OTHER}; an object that was bent or cut between the captures has no single map."
TILTED = f"{OTHER}; if the camera was strongly tilted, set it up again."

RULES = (
    Rule("lines", _lines, -0.5, 0.1, 1.0, _describe_lines, UNEVEN, UNEVEN),
    Rule(
        "matches", lambda e: 4 - e.kept / e.terms, inf, inf, 0.0,
        lambda e: f"Only {e.kept} matches were kept for a map with {e.terms} coefficients for each of x and y.",
        refused=f"{OTHER}; if they do, raise `reject` or try the method `levkas`.", on=("matches",),
    ),
    Rule(
        "start", _unsure_start, inf, 0.25, inf,
        lambda e: f"No key points match between the two pictures. The search started from {e.begun} alone.", on=("windows",),
    ),
    Rule(
        "chance", lambda e: 1 - (e.share_above_chance or 0.0), inf, 0.5, 0.8,
        lambda e: f"Only {percent(e.share_above_chance or 0.0)} of the windows match better than unrelated places do (permutation test, 95 % limit).",
        on=("windows",), lacks_evidence=True,
    ),
    Rule(
        "held-out error", _held_out, inf, 0.0, 1.0,
        lambda e: f"The held-out error is {e.held_out_px:.2f} px: no single map fits everywhere.", refused=BENT,
    ),
    Rule("impossible", _impossible, inf, inf, 1.0, _describe_impossible),
    Rule(
        "stretch", lambda e: e.anisotropy, inf, 1.5, 2.0,
        lambda e: f"The map stretches one direction {e.anisotropy:.2f} times as much as the other.", refused=TILTED,
    ),
    Rule(
        "area", lambda e: e.area_ratio, inf, 1.8, 3.0,
        lambda e: f"The scale of area varies by a factor of {e.area_ratio:.2f}.", refused=TILTED,
    ),
    Rule(
        "found", _few_found, inf, 0.4, 0.9,
        lambda e: f"Only {e.telling} of {e.windows} check windows were found: too few to check the map."
        if isfinite(e.held_out_px) else "Too little was found to measure a held-out error.", lacks_evidence=True,
    ),
    Rule(
        "elsewhere", lambda e: e.second_peak_ratio, inf, 0.85, 0.95,
        lambda e: f"The pictures agree {100 * e.second_peak_ratio:.0f} % as well at another shift: the pattern repeats, or the map is in the wrong place.",
        "Choose a `region` with detail that does not repeat.",
        f"Choose a `region` with detail that does not repeat, or {POINTS}.",
    ),
    Rule(
        "overlap", lambda e: 1 - e.overlap, 0.2, inf, 0.9,
        lambda e: f"This camera has no data in {percent(e.object_share - e.visible)} of the layer.",
        refused=f"{OTHER}; if this camera shows only a part of it, capture the rest too.",
        noted="Do not use the layer where this camera has no data.",
    ),
    Rule("contradicted", _contradicted, inf, 0.0, 0.2, _describe_contradiction, REGION),
    Rule(
        "unchecked", _unchecked, 0.1, 0.5, 0.85, _describe_unchecked, REGION, noted=REGION, lacks_evidence=True,
    ),
    Rule(
        "align", lambda e: e.align_apart_px or 0.0, inf, ALIGN_PX, inf,
        lambda e: f"The sensor lies {e.align_apart_px:.1f} of its px from where the declared `align` puts it.",
        "Correct this sensor's `align` in campaign.toml, or take it out to have it measured.",
    ),
    Rule(
        "converged", lambda e: float(not e.converged), inf, 0.5, inf,
        lambda e: f"The map did not converge in {e.rounds} rounds: the last round moved it by {e.moved:.2f} px.",
    ),
)  # fmt: skip
"""In the order of their reasons. `lines`: honest pictures have 0.04 px at most that is more than chance. `held-out error`: 0.6 to
1.05 of the windows' sigma on right maps of infrared pictures, 0.8 to 11 on maps that are wrong somewhere."""


def objections_to(evidence: Evidence) -> list[Objection]:
    """Return the objections of the rules to a map, in their order; where outlines agree all over, want of evidence is a doubt only."""
    found, unsure, outlines = [], False, evidence.outlines
    for rule in RULES:
        number = rule.number(evidence) if evidence.basis in rule.on else -inf
        limits: tuple[tuple[Finding, float, str], ...] = (
            ("refuse", rule.refuse, rule.refused), ("warn", rule.warn, rule.doubted), ("note", rule.note, rule.noted),
        )  # fmt: skip
        for decision, limit, step in limits:
            if number > limit:
                unsure |= rule.lacks_evidence
                by_outlines = rule.lacks_evidence and evidence.agree_by_outlines
                kind = "warn" if decision == "refuse" and by_outlines else decision
                found.append(Objection(kind, rule.sentence(evidence), step))
                break
    if outlines and evidence.agree_by_outlines and unsure:
        text = (
            f"The outlines of {outlines['agreeing']} of {outlines['blocks']} large blocks agree with the map "
            f"within {outlines['px']:.1f} px. A finer check was not possible."
        )
        found.insert(0, Objection("warn", text, LOOK))
    return found


# --- the decision


def judge(
    sensors: Mapping[str, Evidence | None],
    object_share: float = 1.0,
    placed: Mapping[str, dict[str, Any]] | None = None,
) -> Verdict:
    """Decide on a camera by its worst sensor; None is one that is registered to nothing.

    `object_share` of the layer shows the object; sensors that a person `placed`, by `PlacedByHand.to_dict`, are neither accepted nor refused.
    """
    placed, known = placed or {}, {name: one for name, one in sensors.items() if one is not None}
    objections = [
        one._replace(reason=_where(name) + one.reason)
        for name, evidence in known.items()
        for one in objections_to(evidence)
    ]
    outside = 1 - object_share
    if known and outside >= LEAST_OUTSIDE:
        text = f"{percent(outside)} of the layer lies outside the object's outline and was not checked."
        objections.append(Objection("note", text, ""))
    decisions = {one.decision for one in objections}
    decision: Decision = (
        "refuse" if "refuse" in decisions else "warn" if "warn" in decisions else "accept"
    )
    deciding = [one for one in objections if one.decision == decision]
    open_ones = [one for one in objections if one.decision == "note"]
    praise = () if deciding else [_where(name) + _praise(one) for name, one in known.items()]
    listed = deciding if decision == "refuse" else [*deciding, *open_ones]
    reasons = (*praise, *(one.reason for one in listed))
    steps = (one.next_step for one in deciding or open_ones if deciding or one.next_step)
    step = next(steps, "")
    unchecked = max((1 - one.confirmed for one in known.values()), default=0.0)
    if placed and decision != "refuse":
        labels = [_where(name) + _describe_pairs(one) for name, one in placed.items()]
        decision, reasons, step, unchecked = "by hand", (*labels, *reasons), LOOK, 1.0
    nothing = {"held_out_px": None, "alike": False}
    numbers = {name: one.to_dict() if one else nothing for name, one in sensors.items()}
    for name in placed.keys() & numbers.keys():
        numbers[name] = numbers[name] | {"placed_by_hand": placed[name]}
    return Verdict(decision, reasons, step, numbers, unchecked, outside)


def _where(name: str) -> str:
    return "" if name == ONLY else f"sensor {name}: "


def _describe_pairs(placed: Mapping[str, Any]) -> str:
    label = describe_placement(placed)
    text = f"{label[0].upper()}{label[1:]}. The {placed['model']} rests on {counted(placed['pairs'], 'pair')}"
    if placed["worst"] is None:
        return f"{text}; a fifth would show how far they are off."
    x, y, error = placed["worst"]
    return f"{text}; the worst, at {x:.0f}, {y:.0f} of the reference, lies {error:.1f} px from a map of the others."


def _praise(e: Evidence) -> str:
    return (
        f"{e.agreeing} check windows agree with the map, {e.contradicting} contradict it. The held-out error is "
        f"{e.held_out_px:.2f} px over the {percent(e.confirmed)} of the layer that was checked."
    )

"""What to do about a registration that is refused or doubtful, in the words of report and workbench."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from levkas.core.text import counted

OTHER = "Check that both pictures show the same object, with the same side up and the same framing"
POINTS = (
    "run `levkas inspect CAMPAIGN`, open this camera and mark four points that both pictures show"
)
BY_HAND = f"{OTHER}; if they do, {POINTS}."
LEAST_PAIRS = 4
"""Pairs by hand from which a registration can begin, or a layer can be placed by hand: a homography has eight parameters."""
ACCEPT = (
    'to place this layer by your pairs alone, choose "Place by hand" in `levkas inspect CAMPAIGN`, or write `accept = "by hand"` '
    "beside them in edits.toml"
)
SCREEN = "`levkas inspect CAMPAIGN` shows both pictures side by side, and takes pairs that you place by hand."
BETWEEN = (
    "Choose a reference camera whose sampling lies between the two (`reference` in campaign.toml), or bin the frames of "
    "the finer camera"
)
LOOK = "Compare both pictures in the report, with the flicker, before you use this layer."
REGION = "Do not use the layer there, or add pairs there in `levkas inspect CAMPAIGN`."
COMPARED = "Do not use the layer there before you have compared both pictures there."
"""In place of `REGION` where pairs were given: they move the map, and confirm none of it."""
CONFIRM = "If both pictures agree, confirm the layer in `levkas inspect CAMPAIGN`."
IN_WORKBENCH = (
    (f" {SCREEN}", ""),
    (SCREEN, ""),
    (POINTS.partition("mark")[0], ""),
    (ACCEPT.partition(", ")[2], 'press "Place by hand"'),
    (" in `levkas inspect CAMPAIGN`", ""),
)
"""Words of a step, and what stands for them where the workbench is open already."""


def advise(step: str, pairs: int, decision: str = "refuse") -> str:
    """Return the next step of a decision, as it does not want the `pairs` that were given; of a refusal, as it names the workbench.

    >>> advise("Check the focus.", 0)[:41], advise(BY_HAND, 4).count("four points")
    ('Check the focus. `levkas inspect CAMPAIGN', 0)
    >>> advise(f"{POINTS}.", 3)
    'run `levkas inspect CAMPAIGN`, open this camera and mark 1 more point that both pictures show.'
    >>> advise(REGION, 0, "accept") == REGION, advise(REGION, 1, "warn") == f"{COMPARED} {CONFIRM}"
    (True, True)
    """
    if decision != "refuse":
        step = step.replace(REGION, COMPARED) if pairs else step
        return f"{step} {CONFIRM}".strip() if decision == "warn" else step
    if pairs >= LEAST_PAIRS:
        if POINTS in step:
            return step.replace(POINTS, ACCEPT)
        return f"{step} {ACCEPT[0].upper()}{ACCEPT[1:]}.".strip()
    if pairs:
        more = counted(LEAST_PAIRS - pairs, "more point")
        step = step.replace("four points", more)
    return step if "levkas inspect" in step else f"{step} {SCREEN}".strip()


def in_workbench(step: str) -> str:
    """Return a next step for a person who has the workbench open.

    >>> in_workbench(f"{POINTS}."), in_workbench(f"Check the focus. {SCREEN}")
    ('mark four points that both pictures show.', 'Check the focus.')
    """
    for words, here in IN_WORKBENCH:
        step = step.replace(words, here)
    return step


def describe_placement(found: Mapping[str, Any]) -> str:
    """Return the label of a layer that was placed by hand, of `PlacedByHand.to_dict`.

    >>> describe_placement({"pairs": 5, "fit_px": 0.71})
    'placed by hand, pairs fit to 0.7 px; the pictures do not confirm it'
    >>> describe_placement({"pairs": 4, "fit_px": None})
    'placed by hand, 4 pairs leave no error to measure; the pictures do not confirm it'
    """
    fit = found["fit_px"]
    text = (
        f"{found['pairs']} pairs leave no error to measure"
        if fit is None
        else f"pairs fit to {fit:.1f} px"
    )
    return f"placed by hand, {text}; the pictures do not confirm it"


def percent(share: float) -> str:
    """Return a share as text, never rounded up to all or down to nothing of it.

    >>> percent(1.0), percent(0.998), percent(0.375), percent(0.002), percent(0.0)
    ('100 %', '99 %', '38 %', 'less than 1 %', '0 %')
    """
    if 0 < share < 0.005:
        return "less than 1 %"
    return f"{min(round(100 * share), 100 if share >= 1 else 99)} %"


LEAST_OUTSIDE = 0.005
"""Share of the layer from which on it is reported that the outline leaves it out; less is no percent."""

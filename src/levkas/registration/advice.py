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
LITTLE = 0.25
"""Share of the reference; where pictures have less in common, that is named as why a map folds. Half or twice changes
advice alone."""
MORE = (
    "Capture this camera again with more of the reference in view: both show too little in common for the shape of "
    "a map"
)
LOOK = "Compare both pictures in the report, with the flicker, before you use this layer."
REGION = "Do not use the layer there, or add pairs there in `levkas inspect CAMPAIGN`."


def advice_on_folds(share: float) -> str:
    """Return what to do about a map that folds where pictures have a `share` of the reference in common.

    >>> advice_on_folds(0.1)[:25], advice_on_folds(0.8) == BY_HAND
    ('Capture this camera again', True)
    """
    return f"{MORE}, or {POINTS}." if share < LITTLE else BY_HAND


def advise(step: str, pairs: int) -> str:
    """Return the next step after a refusal, as it names the workbench and does not want the `pairs` that were given.

    >>> advise("Check the focus.", 0)[:41], advise(BY_HAND, 4).count("four points")
    ('Check the focus. `levkas inspect CAMPAIGN', 0)
    >>> advise(f"{POINTS}.", 3)
    'run `levkas inspect CAMPAIGN`, open this camera and mark 1 more point that both pictures show.'
    """
    if pairs >= LEAST_PAIRS:
        if POINTS in step:
            return step.replace(POINTS, ACCEPT)
        return f"{step} {ACCEPT[0].upper()}{ACCEPT[1:]}.".strip()
    if pairs:
        more = counted(LEAST_PAIRS - pairs, "more point")
        step = step.replace("four points", more)
    return step if "levkas inspect" in step else f"{step} {SCREEN}".strip()


def describe_placement(found: Mapping[str, Any]) -> str:
    """Return the label of a layer that was placed by hand, of `PlacedByHand.to_dict`.

    >>> describe_placement({"pairs": 5, "fit_px": 0.71})
    'placed by hand, pairs fit to 0.7 px; the pictures do not confirm it'
    >>> describe_placement({"pairs": 4, "fit_px": None})
    'placed by hand, 4 pairs leave no error to measure; the pictures do not confirm it'
    """
    fit = found["fit_px"]
    told = (
        f"{found['pairs']} pairs leave no error to measure"
        if fit is None
        else f"pairs fit to {fit:.1f} px"
    )
    return f"placed by hand, {told}; the pictures do not confirm it"


def percent(share: float) -> str:
    """Return a share as text, never rounded up to all or down to nothing of it.

    >>> percent(1.0), percent(0.998), percent(0.375), percent(0.002), percent(0.0)
    ('100 %', '99 %', '38 %', 'less than 1 %', '0 %')
    """
    if 0 < share < 0.005:
        return "less than 1 %"
    return f"{min(round(100 * share), 100 if share >= 1 else 99)} %"

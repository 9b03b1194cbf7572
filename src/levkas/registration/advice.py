"""What to do about a registration that is refused or doubtful, in the words of report and workbench."""

from __future__ import annotations

OTHER = "Check that both pictures show the same object, with the same side up and the same framing"
POINTS = (
    "run `levkas inspect CAMPAIGN`, open this camera and mark four points that both pictures show"
)
BY_HAND = f"{OTHER}; if they do, {POINTS}."
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


def percent(share: float) -> str:
    """Return a share as text, never rounded up to all or down to nothing of it.

    >>> percent(1.0), percent(0.998), percent(0.375), percent(0.002), percent(0.0)
    ('100 %', '99 %', '38 %', 'less than 1 %', '0 %')
    """
    if 0 < share < 0.005:
        return "less than 1 %"
    return f"{min(round(100 * share), 100 if share >= 1 else 99)} %"

"""Answers to the screen after each change: the pairs, their statistics, the map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.manual_points import MARKS

if TYPE_CHECKING:
    from levkas.registration.outliers import Cleaned
    from levkas.registration.record import Matches
    from levkas.workbench.session import CorrectionSession

NEEDED_PAIRS = 4
"""A homography goes through any four pairs: only a fifth shows how far off it is."""
BY_HAND = {mark: kind for kind, mark in MARKS.items()}


def describe(session: CorrectionSession) -> dict[str, Any]:
    """Return everything that a screen shows of the pairs, JSON-ready; columns are of one length, None where a number is not known.

    ``hand`` is what a person did to a pair: a key of `MARKS`, or empty. ``map`` is the polynomial target → reference
    of the pairs, None where there are too few.
    """
    view = session.view
    matches = _without_residuals(view.matches)
    return {
        "version": session.version,
        "pairs": np.round(np.hstack([matches.reference, matches.target]), 3).tolist(),
        "residual": _numbers(matches.residual),
        "leave_one_out": _numbers(matches.leave_one_out),
        "weight": _numbers(matches.weight),
        "state": matches.state.tolist(),
        "hand": [BY_HAND.get(reason, "") for reason in matches.reason.tolist()],
        "reason": matches.reason.tolist(),
        "number": session.number(),
        "summary": _summary(matches, matches.kept),
        "refusal": view.refusal,
        "map": None if view.cleaned is None else _map(view.cleaned),
        "stop": session.edits.stop or session.found.stop,
        "corrections": session.edits.describe(),
        "outline": session.outline,
        "accept": session.edits.accept,
        "can": session.can,
    }


def _numbers(values: np.ndarray) -> list[float | None]:
    known = np.isfinite(values)
    rounded = zip(known.tolist(), np.round(values, 3).tolist(), strict=True)
    return [value if here else None for here, value in rounded]


def _without_residuals(matches: Matches) -> Matches:
    """Take the residuals from kept pairs that are no more than a map needs: they say nothing of it."""
    kept = matches.kept
    if kept.sum() > NEEDED_PAIRS:
        return matches
    unknown = np.where(kept, np.nan, matches.residual)
    return replace(
        matches, residual=unknown, leave_one_out=np.where(kept, np.nan, matches.leave_one_out)
    )


def _summary(matches: Matches, kept: np.ndarray) -> dict[str, Any]:
    errors = matches.residual[kept]
    checks = matches.residual[matches.state == "check"]

    def of(values: np.ndarray, statistic: Callable[[np.ndarray], Any]) -> float | None:
        good = values[np.isfinite(values)]
        return round(float(statistic(good)), 4) if len(good) else None

    return {
        "pairs": len(matches),
        "kept": int(kept.sum()),
        "mean": of(errors, np.mean),
        "max": of(errors, np.max),
        "checks": len(checks),
        "check_mean": of(checks, np.mean),
    }


def _map(cleaned: Cleaned) -> dict[str, Any]:
    model = cleaned.model
    return {
        "order": model.order,
        "centre": [float(v) for v in model.centre],
        "spread": float(model.spread),
        "terms": np.round(model.coefficients, 5).ravel().tolist(),
    }

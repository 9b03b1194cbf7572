"""What a screen is told of a session after each change: columns of one length, a sum, the trace.

Thousands of pairs are told with every edit, so that columns may be packed: little-endian numbers in
base64, words by their number.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.replay import reject_of

if TYPE_CHECKING:
    from levkas.registration.outliers import Cleaned
    from levkas.registration.record import Matches
    from levkas.transforms import Transform
    from levkas.workbench.session import Session

SAMPLED_ROUNDS = 120


def describe(session: Session, known: str = "", *, packed: bool = False) -> dict[str, Any]:
    """Return everything that a screen shows of the pairs, JSON-ready and short.

    Parameters
    ----------
    session : Session
    known : str
        What `places` said when the screen was last told them: ``pairs`` is None where they are the same.
    packed : bool
        Whether long columns are packed (`pack`, `pack_words`) rather than lists.

    Returns
    -------
    told : dict
        Columns are of one length; ``trace.models`` holds the polynomial of some rounds, so that a
        screen can draw any moment of the removal itself.
    """
    view = session.view
    matches = view.matches
    numbers, words = (pack, pack_words) if packed else (_list, _words)
    pairs = np.round(np.hstack([matches.reference, matches.target]), 3)
    places = sha256(pairs.tobytes()).hexdigest()[:16]
    return {
        "version": session.version,
        "places": places,
        "pairs": None if places == known else numbers(pairs, "f8"),
        "residual": numbers(np.round(matches.residual, 3), "f4"),
        "leave_one_out": numbers(np.round(matches.leave_one_out, 3), "f4"),
        "weight": numbers(np.round(matches.weight, 3), "f4"),
        "state": words(matches.state),
        "reason": words(matches.reason),
        "round": numbers(matches.round, "i4"),
        "summary": _summary(matches, matches.kept),
        "refusal": view.refusal,
        "trace": None if view.cleaned is None else _trace(view.cleaned, numbers),
        "reject": session.edits.reject or session.found.reject or reject_of(session.found.size),
        "stop": session.edits.stop or session.found.stop,
        "overridden": {k: getattr(session.edits, k) is not None for k in ("reject", "stop")},
        "corrections": session.edits.told(),
        "note": session.edits.note,
        "can": session.can,
    }


def pack(values: np.ndarray, kind: str) -> dict[str, Any]:
    """Return numbers as little-endian `kind` (``"f4"``, ``"f8"``, ``"i4"``) in base64, with their shape.

    >>> pack(np.array([1, -1]), "i4")
    {'kind': 'i4', 'shape': [2], 'data': 'AQAAAP////8='}
    """
    data = np.ascontiguousarray(values, f"<{kind}").tobytes()
    shape = [int(n) for n in np.shape(values)]
    return {"kind": kind, "shape": shape, "data": base64.b64encode(data).decode("ascii")}


def pack_words(words: np.ndarray) -> dict[str, Any]:
    """Return words, each once, and the number of each in its place, packed.

    >>> pack_words(np.array(["kept", "removed", "kept"], object))["words"]
    ['kept', 'removed']
    """
    listed = words.tolist()
    number = {word: i for i, word in enumerate(dict.fromkeys(listed))}
    return {"words": list(number), "codes": pack(np.array([number[w] for w in listed], int), "i4")}


def _list(values: np.ndarray, kind: str) -> list[Any]:
    if values.ndim > 1 or np.isfinite(values).all():
        return list(values.tolist())
    return [v if v == v and abs(v) != np.inf else None for v in values.tolist()]


def _words(words: np.ndarray) -> list[str]:
    return list(words.tolist())


def _summary(matches: Matches, kept: np.ndarray) -> dict[str, Any]:
    errors, without = matches.residual[kept], matches.leave_one_out[kept]
    checks = matches.residual[matches.state == "check"]

    def of(values: np.ndarray, statistic: Callable[[np.ndarray], Any]) -> float | None:
        good = values[np.isfinite(values)]
        return round(float(statistic(good)), 4) if len(good) else None

    return {
        "pairs": len(matches),
        "kept": int(kept.sum()),
        "mean": of(errors, np.mean),
        "rms": of(errors, lambda v: np.sqrt(np.square(v).mean())),
        "max": of(errors, np.max),
        "leave_one_out": of(without, np.mean),
        "checks": len(checks),
        "check_mean": of(checks, np.mean),
        "check_max": of(checks, np.max),
    }


def _trace(cleaned: Cleaned, numbers: Callable[[np.ndarray, str], Any]) -> dict[str, Any]:
    trace = cleaned.trace
    last = trace.rounds - 1
    chosen = np.unique(np.linspace(0, last, min(SAMPLED_ROUNDS, last + 1)).round().astype(int))
    model = cleaned.model
    # Numbers on coordinates that are centred and scaled: five decimals are a hundredth of what is drawn.
    return {
        "largest": numbers(np.round(trace.largest, 3), "f4"),
        "removed": numbers(trace.removed, "i4"),
        "cut": int((~trace.kept_at(0)).sum()),
        "scale": _affine(trace.scale),
        "order": model.order,
        "centre": [float(v) for v in model.centre],
        "spread": float(model.spread),
        "rounds": chosen.tolist(),
        "models": numbers(np.round(cleaned.models[chosen], 5), "f4"),
        "size": list(trace.size),
    }


def _affine(transform: Transform) -> list[list[float]]:
    origin = transform(np.zeros((1, 2)))[0]
    slope = transform.jacobian(np.zeros((1, 2)))[0]
    return [[*slope[i].tolist(), float(origin[i])] for i in (0, 1)]

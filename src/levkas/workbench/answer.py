"""Answers to the screen after each change: columns, statistics, the trace.

Thousands of pairs travel with every edit. Columns are sent as they are in memory: little-endian numbers
behind a JSON text with the place of each, words by their number.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.manual_points import MARKS
from levkas.workbench.session import reject_of

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform
    from levkas.registration.outliers import Cleaned
    from levkas.registration.record import Matches
    from levkas.workbench.session import CorrectionSession

SAMPLED_ROUNDS = 120
ALIGNED = 8
NEEDED_PAIRS = 4
"""A homography goes through any four pairs: only a fifth shows how far off it is."""
MOST_OF_A_BYTE = 256
BY_HAND = {mark: kind for kind, mark in MARKS.items()}


def describe(session: CorrectionSession, known: str = "") -> dict[str, Any]:
    """Return everything that a screen shows of the pairs; long columns are arrays, as `to_bytes` takes them.

    Parameters
    ----------
    session : CorrectionSession
    known : str
        `places` of the last answer that held pairs: ``pairs`` is None where they are the same.

    Returns
    -------
    answer : dict
        Columns are of one length; ``trace.models`` holds the polynomial of some rounds, so that a
        screen can draw any moment of the removal itself. ``hand`` is what a person did to a pair: a key
        of `MARKS`, or empty.
    """
    view = session.view
    matches = _without_residuals(view.matches)
    pairs = np.round(np.hstack([matches.reference, matches.target]), 3)
    places = sha256(pairs.tobytes()).hexdigest()[:16]
    return {
        "version": session.version,
        "drawn": session.drawn,
        "places": places,
        "pairs": None if places == known else _array(pairs, "f8"),
        "residual": _array(np.round(matches.residual, 3), "f4"),
        "leave_one_out": _array(np.round(matches.leave_one_out, 3), "f4"),
        "weight": _array(np.round(matches.weight, 3), "f4"),
        "state": number_words(matches.state),
        "hand": number_words(
            np.array([BY_HAND.get(r, "") for r in matches.reason.tolist()], object)
        ),
        "reason": number_words(matches.reason),
        "round": _array(matches.round, "i4"),
        "number": _array(session.number(), "i4"),
        "summary": _summary(matches, matches.kept),
        "refusal": view.refusal,
        "trace": None if view.cleaned is None else _trace(view.cleaned),
        "reject": session.edits.reject or session.found.reject or reject_of(session.found.size),
        "stop": session.edits.stop or session.found.stop,
        "overridden": {k: getattr(session.edits, k) is not None for k in ("reject", "stop")},
        "corrections": session.edits.describe(),
        "outline": session.outline,
        "accept": session.edits.accept,
        "can": session.can,
    }


def to_bytes(answer: dict[str, Any]) -> bytes:
    """Return an answer with arrays in it as one body.

    Four bytes, little-endian, hold the length of a JSON text; arrays in it are ``{"kind", "shape", "at"}``, and
    stand behind it, `at` bytes from its end, each from a multiple of eight bytes of the body.

    >>> to_bytes({"round": np.array([1, -1], "<i4")})[-8:]
    b'\\x01\\x00\\x00\\x00\\xff\\xff\\xff\\xff'
    """
    parts: list[bytes] = []
    length = 0

    def place(values: Any) -> dict[str, Any]:
        nonlocal length
        if not isinstance(values, np.ndarray):
            raise TypeError(type(values).__name__)
        at, data = length, values.tobytes()
        parts.extend((data, b"\0" * (-len(data) % ALIGNED)))
        length += len(data) + len(parts[-1])
        return {"kind": values.dtype.str[1:], "shape": list(values.shape), "at": at}

    text = json.dumps(answer, default=place, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-(4 + len(text)) % ALIGNED)
    return b"".join((len(text).to_bytes(4, "little"), text, *parts))


def from_bytes(body: bytes) -> dict[str, Any]:
    """Return what `to_bytes` was given.

    >>> from_bytes(to_bytes({"round": np.array([1, -1], "<i4")}))
    {'round': array([ 1, -1], dtype=int32)}
    """
    start = 4 + int.from_bytes(body[:4], "little")

    def column(record: dict[str, Any]) -> Any:
        if set(record) != {"kind", "shape", "at"}:
            return record
        count = int(np.prod(record["shape"]))
        values = np.frombuffer(body, f"<{record['kind']}", count, start + record["at"])
        return values.reshape(record["shape"])

    return dict(json.loads(body[4:start], object_hook=column))


def number_words(words: np.ndarray) -> dict[str, Any]:
    """Return words, each once, and the number of each in its place.

    >>> number_words(np.array(["kept", "removed", "kept"], object))
    {'words': ['kept', 'removed'], 'codes': array([0, 1, 0], dtype=uint8)}
    """
    listed = words.tolist()
    number = {word: i for i, word in enumerate(dict.fromkeys(listed))}
    kind = "u1" if len(number) <= MOST_OF_A_BYTE else "<i4"
    codes = np.fromiter(map(number.__getitem__, listed), kind, len(listed))
    return {"words": list(number), "codes": codes}


def _array(values: np.ndarray, kind: str) -> np.ndarray:
    return np.ascontiguousarray(values, f"<{kind}")


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


def _trace(cleaned: Cleaned) -> dict[str, Any]:
    trace = cleaned.trace
    last = trace.rounds - 1
    chosen = np.unique(np.linspace(0, last, min(SAMPLED_ROUNDS, last + 1)).round().astype(int))
    model = cleaned.model
    # Numbers on coordinates that are centred and scaled: five decimals are a hundredth of what is drawn.
    return {
        "largest": _array(np.round(trace.largest, 3), "f4"),
        "removed": _array(trace.removed, "i4"),
        "cut": int((~trace.kept_at(0)).sum()),
        "scale": _affine(trace.scale),
        "order": model.order,
        "centre": [float(v) for v in model.centre],
        "spread": float(model.spread),
        "rounds": chosen.tolist(),
        "models": _array(np.round(cleaned.models[chosen], 5), "f4"),
        "size": list(trace.size),
    }


def _affine(transform: Transform) -> list[list[float]]:
    origin = transform(np.zeros((1, 2)))[0]
    slope = transform.jacobian(np.zeros((1, 2)))[0]
    return [[*slope[i].tolist(), float(origin[i])] for i in (0, 1)]

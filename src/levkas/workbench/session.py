"""Corrections of one registration: operations on pairs, refit, undo.

An operation is a function from corrections to corrections. A session holds what the method found, the
corrections so far and the states before them, which undo goes back to. Outliers are removed from the
corrected pairs by the paper's way, whatever method found them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.edits import (
    BY_HAND,
    EditsConflict,
    FrameEdits,
    Outline,
    Pair,
    round_corners,
    round_pair,
)
from levkas.core.problems import Problem, Refused
from levkas.geometry.transforms import Affine, Inverse, Transform
from levkas.registration.advice import LEAST_PAIRS
from levkas.registration.manual_points import (
    FIXED,
    ManualPoints,
    MarkedMatches,
    measure_checks,
    nearest_rows,
)
from levkas.registration.mirhashemi2019 import REJECT_SHARE, scale_only
from levkas.registration.outliers import Cleaned, RemovalTerms, clean, cut
from levkas.registration.record import HandMark, Matches, MatchState, RegistrationRefused
from levkas.registration.request import check_outline

if TYPE_CHECKING:
    from collections.abc import Sequence

KINDS = ("deleted", "restored", "pinned", "added", "checks")

MOST_STATES = 200
"""States that undo goes back to at most; the oldest go."""


class OperationRefused(Refused):
    """Something that cannot be done to this pair."""


def delete(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """Delete a pair: no fit uses it any more; a pair of one's own is removed altogether.

    >>> mine = add(FrameEdits(), (1, 2, 3, 4))
    >>> delete(mine, (1, 2, 3, 4)) == FrameEdits()
    True
    """
    pair = round_pair(pair)
    if pair in edits.added or pair in edits.checks:
        return _without(edits, pair)
    for move in edits.moved:
        if move[4:] == pair:
            rest = tuple(m for m in edits.moved if m != move)
            return _with(replace(edits, moved=rest), "deleted", move[:4])
    return _with(_without(edits, pair), "deleted", pair)


def restore(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """Take back a deletion; a pair that the removal of outliers dropped stays from now on."""
    pair = round_pair(pair)
    if pair in edits.deleted:
        return _without(edits, pair)
    for move in edits.moved:
        if pair in (move[:4], move[4:]):
            return replace(edits, moved=tuple(m for m in edits.moved if m != move))
    return _with(_without(edits, pair), "restored", pair)


def pin(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """Pin a pair, which is then never removed; pinned again, it is let go."""
    pair = round_pair(pair)
    if pair in edits.pinned:
        return _without(edits, pair)
    if _is_own(edits, pair):
        return edits
    return _with(_without(edits, pair), "pinned", pair)


def add(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """Add a pair of one's own."""
    return _with(_without(edits, round_pair(pair)), "added", round_pair(pair))


def move(edits: FrameEdits, pair: Pair, to: Pair) -> FrameEdits:
    """Put a pair elsewhere; it is then a person's own.

    >>> moved = move(FrameEdits(), (1, 2, 3, 4), (1, 2, 3, 4.5))
    >>> moved.moved, move(moved, (1, 2, 3, 4.5), (1, 2, 3, 4)) == FrameEdits()
    (((1.0, 2.0, 3.0, 4.0, 1.0, 2.0, 3.0, 4.5),), True)
    """
    pair, to = round_pair(pair), round_pair(to)
    if pair == to:
        return edits
    for kind in ("added", "checks"):
        if pair in getattr(edits, kind):
            return _with(_without(edits, pair), kind, to)
    first = next((m[:4] for m in edits.moved if m[4:] == pair), pair)
    kept = tuple(m for m in edits.moved if m[:4] != first)
    edits = replace(_without(edits, first), moved=kept)
    if first == to:
        return edits
    return replace(edits, moved=tuple(sorted((*kept, (*first, *to)))))


def check(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """Keep a pair as a check point, which measures and is never fitted; or let it go again."""
    pair = round_pair(pair)
    if pair in edits.checks:
        return _without(edits, pair)
    return _with(_without(edits, pair), "checks", pair)


OPERATIONS: dict[str, Callable[..., FrameEdits]] = {
    "delete": delete,
    "restore": restore,
    "pin": pin,
    "add": add,
    "move": move,
    "check": check,
}


def refused(message: str, found: object, expected: str) -> OperationRefused:
    """Return the refusal of an operation."""
    return OperationRefused(Problem("E_VALUE", message, found=found, expected=expected))


def _is_own(edits: FrameEdits, pair: Pair) -> bool:
    return pair in edits.added or any(m[4:] == pair for m in edits.moved)


def _without(edits: FrameEdits, pair: Pair) -> FrameEdits:
    for kind in KINDS:
        pairs = getattr(edits, kind)
        if pair in pairs:
            edits = _set(edits, kind, tuple(p for p in pairs if p != pair))
    return edits


def _with(edits: FrameEdits, kind: str, pair: Pair) -> FrameEdits:
    return _set(edits, kind, tuple(sorted({*getattr(edits, kind), pair})))


def _set(edits: FrameEdits, name: str, value: Any) -> FrameEdits:
    return replace(edits, **{name: value})


LEAST_FITTED = 3

ORDERS = ((20, 3), (12, 2), (3, 1))
"""Least number of pairs, order of the polynomial that they carry."""

LEAST_STARTED = 0.9
"""Share of the kept pairs that the paper's start, scale alone, must bring within `reject`."""

CUT = "farther than `reject` at the start"


@dataclass(frozen=True)
class RecordedPairs:
    """State before any correction.

    Parameters
    ----------
    matches : Matches
        Of the method, without a person's own pairs and check points.
    size, target_size : (width, height)
    reject : float or None, reference px
        Of the campaign; the paper's without one.
    stop : float, reference px
    """

    matches: Matches
    size: tuple[int, int]
    target_size: tuple[int, int]
    reject: float | None = None
    stop: float = 1.0

    @classmethod
    def of(cls, matches: Matches, **more: Any) -> RecordedPairs:
        """Take what a build recorded, and leave out what came from a person."""
        own = (matches.reason == HandMark.ADDED) | (matches.state == MatchState.CHECK)
        names = Matches.__dataclass_fields__
        return cls(Matches(**{n: getattr(matches, n)[~own] for n in names}), **more)


@dataclass(frozen=True)
class CorrectionResult:
    """What corrections make of the pairs.

    Parameters
    ----------
    matches : Matches
        With residual, leave-one-out error, weight, state and reason; check points last.
    cleaned : Cleaned or None
        None where fewer than three pairs are left to fit.
    forward : Transform
        Reference px → target px by these pairs alone.
    refusal : str
        Why nothing could be fitted; empty where it could.
    """

    matches: Matches
    cleaned: Cleaned | None
    forward: Transform
    refusal: str = ""


State = tuple[FrameEdits, Outline]
"""Corrections of a camera, and the outline of its object."""


@dataclass
class CorrectionSession:
    """Corrections of one frame, with undo and redo.

    Parameters
    ----------
    found : FoundPartner
    edits : FrameEdits
    save : callable, optional
        Writes a change, (before, after); returns what stands there then. Where it raises, nothing was changed.
    outline : (n, 2) corners, reference px
        Of the object, as edits.toml has it for all its cameras; none where nobody drew it.
    save_outline : callable, optional
        Writes it, as `save` does.
    """

    found: RecordedPairs
    edits: FrameEdits = field(default_factory=FrameEdits)
    save: Callable[[FrameEdits, FrameEdits], FrameEdits] | None = None
    outline: Outline = ()
    save_outline: Callable[[Outline, Outline], Outline] | None = None
    version: int = 0
    done: list[State] = field(default_factory=list)
    undone: list[State] = field(default_factory=list)
    """States before and after, the next last."""
    numbers: dict[Pair, int] = field(default_factory=dict)
    """By which a person's own pairs are known, wherever they stand in the table."""
    _view: CorrectionResult | None = None

    @property
    def view(self) -> CorrectionResult:
        """What the corrections make of the pairs, computed once a change."""
        if self._view is None:
            self._view = apply_corrections(self.found, self.edits)
        return self._view

    @property
    def can(self) -> dict[str, int]:
        """How many changes can be undone and redone."""
        return {"undo": len(self.done), "redo": len(self.undone)}

    def number(self) -> list[int]:
        """Return the number of each pair of the view: those that the method found in their order, then a person's own.

        A pair of one's own keeps its number while others come and go; a found pair that was moved has its own one.
        """
        matches, found = self.view.matches, self.found.matches
        rows = np.hstack([matches.reference, matches.target])[len(found) :]
        origins: dict[Pair, int] = {}
        if self.edits.moved:
            moves = np.array(self.edits.moved, float)
            at = nearest_rows(moves[:, :4], np.hstack([found.reference, found.target]))
            moved = zip(self.edits.moved, at.tolist(), strict=True)
            origins = {move[4:]: row + 1 for move, row in moved if row >= 0}
        own = [round_pair(row) for row in rows.tolist()]
        for pair in own:
            if pair not in self.numbers and pair not in origins:
                self.numbers[pair] = max([len(found), *self.numbers.values()]) + 1
        return [
            *range(1, len(found) + 1),
            *(origins[pair] if pair in origins else self.numbers[pair] for pair in own),
        ]

    def apply(self, name: str, pair: Sequence[float], to: Sequence[float] | None = None) -> None:
        """Do one of `OPERATIONS` to a pair.

        Raises
        ------
        OperationRefused
            Where there is no such operation, or the places cannot be.
        """
        if name not in OPERATIONS:
            raise refused("there is no such operation", name, ", ".join(OPERATIONS))
        places = [_place(pair, self.found)]
        if name == "move":
            places.append(_place(to or (), self.found))
            first, last = map(round_pair, places)
            if first in self.numbers:
                self.numbers.setdefault(last, self.numbers[first])
        self._change(OPERATIONS[name](self.edits, *places))

    def add_all(self, added: Sequence[Pair], checks: Sequence[Pair]) -> None:
        """Add many pairs as one change: what an import brings."""
        edits = self.edits
        for kind, pairs in (("add", added), ("check", checks)):
            for pair in pairs:
                if kind == "check" and pair in edits.checks:
                    continue
                edits = OPERATIONS[kind](edits, _place(pair, self.found))
        self._change(edits)

    def take_all_back(self) -> None:
        """Take back all corrections, as one change that can be undone."""
        self._change(FrameEdits())

    def accept(self, by_hand: bool) -> None:
        """Place the layer by the person's pairs alone, or by the pictures again."""
        own = sum(len(rows) for kind, rows in self.edits.pairs().items() if kind in FIXED)
        if by_hand and own < LEAST_PAIRS:
            raise refused("too few pairs are set by hand", own, f"at least {LEAST_PAIRS}")
        self._change(replace(self.edits, accept=BY_HAND if by_hand else ""))

    def draw(self, corners: Outline) -> None:
        """Replace the outline of the object, reference px; without corners it is again what the campaign declares, or what is found.

        Raises
        ------
        OperationRefused, EditsInvalid
            Where corners lie outside the reference, or are no polygon.
        """
        if corners and (problems := check_outline(corners, self.found.size)):
            raise OperationRefused(*problems)
        self._change(self.edits, round_corners(corners))

    def undo(self) -> None:
        """Take the last change back; nothing where there is none."""
        self._go(self.done, self.undone)

    def redo(self) -> None:
        """Do again what was undone last."""
        self._go(self.undone, self.done)

    def refresh(self, found: RecordedPairs) -> None:
        """Go on from what a new build found; corrections and undo stay, one's own pairs are numbered anew."""
        self.found, self._view, self.numbers = found, None, {}
        self.version += 1

    def take(self, present: FrameEdits, outline: Outline) -> None:
        """Go on from what others made of the corrections and of the outline; what was done here before cannot be undone then."""
        if (present, outline) != (self.edits, self.outline):
            self.done, self.undone = [], []
            self._become((present, outline))

    def _become(self, state: State) -> None:
        self.edits, self.outline = state
        self._view = None
        self.version += 1

    def _go(self, source: list[State], into: list[State]) -> None:
        if not source:
            return
        now = self.edits, self.outline
        self._write(*source[-1])
        source.pop()
        into.append(now)

    def _change(self, edits: FrameEdits, outline: Outline | None = None) -> None:
        now = self.edits, self.outline
        if (edits, self.outline if outline is None else outline) == now:
            return
        self._write(edits, self.outline if outline is None else outline)
        self.done = [*self.done, now][-MOST_STATES:]
        self.undone = []

    def _write(self, edits: FrameEdits, outline: Outline) -> None:
        """Save a state and take it over; where another writes too, take over what stands there."""
        try:
            if outline != self.outline and self.save_outline is not None:
                outline = self.save_outline(self.outline, outline)
            if edits != self.edits and self.save is not None:
                edits = self.save(self.edits, edits)
        except EditsConflict as conflict:
            present = conflict.present
            if isinstance(present, FrameEdits):
                self.take(present, self.outline)
            else:
                self.take(self.edits, present)
            raise
        self._become((edits, outline))


def apply_corrections(found: RecordedPairs, edits: FrameEdits) -> CorrectionResult:
    """Replay the removal of outliers on what was found and corrected."""
    given = ManualPoints(**edits.pairs())
    marked = given.mark(found.matches.reference, found.matches.target)
    kept = np.concatenate([found.matches.kept, np.ones(len(marked.reason), bool)])
    kept = kept[: len(marked.reason)]
    fitted, refusal = _fit(found, edits, marked, kept)
    if fitted is None:
        forward = _stiff(found, marked)
        matches = _unfitted(marked)
    else:
        forward = Inverse(fitted.model)
        matches = _described(marked, fitted, edits.stop or found.stop)
    return CorrectionResult(_with_checks(matches, given.checks, forward), fitted, forward, refusal)


def _fit(
    found: RecordedPairs, edits: FrameEdits, marked: MarkedMatches, kept: np.ndarray
) -> tuple[Cleaned | None, str]:
    """Remove outliers anew from pairs of which the method kept `kept`, by the paper's way; or return the reason why not."""
    free = ~marked.dropped
    if free.sum() < LEAST_FITTED:
        return None, f"{int(free.sum())} pairs: a map needs at least {LEAST_FITTED}"
    reject = edits.reject or found.reject or reject_of(found.size)
    try:
        start = _start(found, marked, (kept | marked.fixed) & free, reject)
        near = cut(marked.target, marked.reference, start, reject)[1]
        count = int(((near | marked.fixed) & free).sum())
        terms = RemovalTerms(start, reject, edits.stop or found.stop, max(order_of(count), 1))
        cleaned = clean(
            marked.target, marked.reference, terms, size=found.size,
            target_size=found.target_size, pinned=marked.fixed, dropped=marked.dropped,
        )  # fmt: skip
    except RegistrationRefused as refusal:
        return None, str(refusal.problems[0].message)
    return cleaned, ""


def _start(
    found: RecordedPairs, marked: MarkedMatches, kept: np.ndarray, reject: float
) -> Transform:
    """Return the map target → reference under which pairs are cut.

    The paper's scale alone where nearly all kept pairs lie within `reject` under it; else, for a
    camera on its side, for example, the affine map of the kept pairs.
    """
    scale = scale_only(found.size, found.target_size)
    reference, target = marked.reference[kept], marked.target[kept]
    if len(target) < 3 or cut(target, reference, scale, reject)[1].mean() >= LEAST_STARTED:
        return scale
    return Affine.fit(target, reference)


def reject_of(size: tuple[int, int]) -> float:
    """Return the paper's T1 for a reference of `size`: 1/16 of its diagonal, px.

    >>> round(reject_of((1392, 1040)), 1)
    108.6
    """
    return float(np.hypot(*size)) * REJECT_SHARE


def order_of(count: int) -> int:
    """Return the order of the polynomial that `count` pairs carry, 0 for none.

    >>> [order_of(n) for n in (2, 4, 15, 400)]
    [0, 1, 2, 3]
    """
    return next((order for least, order in ORDERS if count >= least), 0)


def _stiff(found: RecordedPairs, marked: MarkedMatches) -> Transform:
    """Scale alone, shifted on to the pairs that there are."""
    back = scale_only(found.size, found.target_size)
    use = ~marked.dropped
    shift = np.zeros(2)
    if use.any():
        shift = (marked.reference[use] - back(marked.target[use])).mean(0)
    return Inverse(Affine(np.column_stack([back.matrix[:, :2], back.matrix[:, 2] + shift])))


def _described(marked: MarkedMatches, fitted: Cleaned, stop: float) -> Matches:
    # A reason for every pair of thousands would cost more than the fit: the round says it all.
    reasons = np.full(len(marked.reason), "", object)
    reasons[fitted.round == 0] = CUT
    reasons[fitted.round > 0] = f"worst of its round, above {stop:g} px"
    return Matches(
        reference=marked.reference,
        target=marked.target,
        residual=fitted.residual,
        leave_one_out=fitted.leave_one_out,
        weight=fitted.kept.astype(float),
        state=np.where(fitted.kept, "kept", "removed").astype(object),
        reason=np.where(marked.reason == "", reasons, marked.reason),
        round=np.where(marked.dropped, -1, fitted.round),
    )


def _unfitted(marked: MarkedMatches) -> Matches:
    state = np.where(marked.dropped, "removed", "kept").astype(object)
    return Matches.of(marked.reference, marked.target, state=state, reason=marked.reason)


def _with_checks(matches: Matches, checks: np.ndarray, forward: Transform) -> Matches:
    from levkas.registration.manual_points import with_checks

    if not len(checks):
        return matches
    return with_checks(matches, checks, measure_checks(checks, forward))


def _place(pair: Sequence[float], found: RecordedPairs) -> Pair:
    """Check that a pair can be: four finite numbers, a place within each picture."""
    values = np.asarray(pair, float).reshape(-1)
    if values.shape != (4,) or not np.isfinite(values).all():
        raise refused("a pair is four numbers", str(pair)[:80], "x, y, x, y")
    for part, size in ((values[:2], found.size), (values[2:], found.target_size)):
        if (part < -0.5).any() or (part > np.array(size) - 0.5).any():
            raise refused("the place is outside the picture", part.tolist(), f"within {size}")
    return tuple(values.tolist())

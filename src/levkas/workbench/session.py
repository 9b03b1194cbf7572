"""Corrections of one registration: operations on pairs, refit, undo.

An operation is a function from corrections to corrections. A session holds what the method found, the
corrections so far and the steps that led there, so that undo has no end. Outliers are removed from the
corrected pairs by the paper's way, whatever method found them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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
from levkas.workbench.history import CorrectionStep, History, number_pairs

if TYPE_CHECKING:
    from collections.abc import Sequence

KINDS = ("deleted", "restored", "pinned", "added", "checks")


THRESHOLDS = {"reject": (0.1, 1e6), "stop": (0.001, 1e6)}


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


def set_threshold(edits: FrameEdits, name: str, value: float | None) -> FrameEdits:
    """Set `reject` or `stop`, reference px; None gives the campaign's back.

    Raises OperationRefused where the value makes no sense.
    """
    if name not in THRESHOLDS:
        raise refused("there is no such slider", name, ", ".join(THRESHOLDS))
    if value is None:
        return _set(edits, name, None)
    low, high = THRESHOLDS[name]
    if not low <= value <= high:
        raise refused(f"`{name}` cannot be that", value, f"{low:g} to {high:g} reference px")
    return _set(edits, name, round(float(value), 3))


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


STILL_PX = 0.02
"""Target px that a map may move before pictures are brought over anew: less than is visible."""


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


@dataclass
class CorrectionSession:
    """Corrections of one frame, with undo and redo.

    Parameters
    ----------
    found : FoundPartner
    edits : FrameEdits
    save : callable, optional
        Writes a change, (before, after), on top of what others wrote meanwhile; returns what stands
        there then. Where it raises, nothing was changed.
    history : History, optional
        Steps that can be undone and redone.
    remember : callable, optional
        Keeps the history after each change.
    outline : (n, 2) corners, reference px
        Of the object, as edits.toml has it for all its cameras; none where nobody drew it.
    save_outline : callable, optional
        Writes it, as `save` does.
    """

    found: RecordedPairs
    edits: FrameEdits = field(default_factory=FrameEdits)
    save: Callable[[FrameEdits, FrameEdits], FrameEdits] | None = None
    history: History = field(default_factory=History)
    remember: Callable[[History], object] | None = None
    outline: Outline = ()
    save_outline: Callable[[Outline, Outline], Outline] | None = None
    version: int = 0
    _view: CorrectionResult | None = None
    _drawn: tuple[int, np.ndarray] | None = None

    @property
    def drawn(self) -> int:
        """The version by whose map pictures are brought over: the present one only where that map has moved."""
        places = self.view.forward(_over(self.found.size))
        if self._drawn is not None:
            moved = np.abs(places - self._drawn[1]) > STILL_PX
            moved |= np.isnan(places) != np.isnan(self._drawn[1])
            if not moved.any():
                return self._drawn[0]
        self._drawn = (self.version, places)
        return self.version

    @property
    def view(self) -> CorrectionResult:
        """What the corrections make of the pairs, computed once a change."""
        if self._view is None:
            self._view = apply_corrections(self.found, self.edits)
        return self._view

    @property
    def can(self) -> dict[str, int]:
        """How many changes can be undone and redone."""
        return {"undo": len(self.history.done), "redo": len(self.history.undone)}

    def number(self) -> np.ndarray:
        """Return the number of each pair of the view, (n,) int; it stays while others come and go."""
        matches, found = self.view.matches, self.found.matches
        rows = np.hstack([matches.reference, matches.target])[len(found) :]
        origins: dict[Pair, int] = {}
        if self.edits.moved:
            moves = np.array(self.edits.moved, float)
            at = nearest_rows(moves[:, :4], np.hstack([found.reference, found.target]))
            moved = zip(self.edits.moved, at.tolist(), strict=True)
            origins = {move[4:]: row for move, row in moved if row >= 0}
        own = [round_pair(row) for row in rows.tolist()]
        return np.array(number_pairs(len(found), own, self.history.numbers, origins), int)

    def apply(self, name: str, pair: Sequence[float], to: Sequence[float] | None = None) -> None:
        """Do one of `OPERATIONS` to a pair.

        Raises
        ------
        OperationRefused
            Where there is no such operation, or the places cannot be.
        """
        changed = self.changed(name, pair, to)
        numbers = self.history.numbers
        if name == "move" and to is not None and round_pair(pair) in numbers:
            numbers.setdefault(round_pair(to), numbers[round_pair(pair)])
        self._change(changed)

    def changed(
        self, name: str, pair: Sequence[float], to: Sequence[float] | None = None
    ) -> FrameEdits:
        """Return what the corrections would be after `apply`."""
        if name not in OPERATIONS:
            raise refused("there is no such operation", name, ", ".join(OPERATIONS))
        places = [_place(pair, self.found)]
        if name == "move":
            places.append(_place(to or (), self.found))
        return OPERATIONS[name](self.edits, *places)

    def add_all(self, added: Sequence[Pair], checks: Sequence[Pair]) -> None:
        """Add many pairs as one change: what an import brings."""
        edits = self.edits
        for kind, pairs in (("add", added), ("check", checks)):
            for pair in pairs:
                if kind == "check" and pair in edits.checks:
                    continue
                edits = OPERATIONS[kind](edits, _place(pair, self.found))
        self._change(edits)

    def slide(self, name: str, value: float | None) -> None:
        """Set `reject` or `stop`, or give the campaign's back; sliding is one change."""
        edits = set_threshold(self.edits, name, value)
        reject = edits.reject or self.found.reject or reject_of(self.found.size)
        if reject <= (edits.stop or self.found.stop):
            raise refused("`reject` must be above `stop`", reject, "more than `stop`")
        last = self.history.done[-1] if self.history.done else CorrectionStep()
        if (
            edits != self.edits
            and not (last.removed or last.outline)
            and set(last.values) == {name}
        ):
            # A slider that is drawn along is one change, not one for each place it passed.
            written = self._set(edits)
            self.history.done.pop()
            self._keep(
                CorrectionStep(values={name: (last.values[name][0], getattr(edits, name))}), written
            )
            return
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
        before, after = self.outline, round_corners(corners)
        if before != after:
            self._set_outline(before, after)
            self._keep(CorrectionStep(outline=(before, after)), self.edits)

    def undo(self) -> None:
        """Take the last change back; nothing where there is none."""
        self._step(self.history.done, self.history.undone, CorrectionStep.reversed)

    def redo(self) -> None:
        """Do again what was undone last."""
        self._step(self.history.undone, self.history.done, replace)

    def refresh(self, found: RecordedPairs) -> None:
        """Go on from what a new build found; corrections and undo stay."""
        self.found, self._view = found, None
        self.version += 1

    def take(self, present: FrameEdits, outline: Outline | None = None) -> None:
        """Go on from what others made of the corrections, and of the outline; undo takes back what was done here alone."""
        drawn = self.outline if outline is None else outline
        if (present, drawn) == (self.edits, self.outline):
            return
        for steps, walk in (
            (self.history.done, CorrectionStep.reversed),
            (self.history.undone, replace),
        ):
            while steps and not walk(steps[-1]).changes(present, drawn):
                steps.pop()
        if present != self.edits:
            self._view = None
        self.edits, self.outline = present, drawn
        self.version += 1

    def _step(
        self,
        source: list[CorrectionStep],
        into: list[CorrectionStep],
        walk: Callable[[CorrectionStep], CorrectionStep],
    ) -> None:
        if not source:
            return
        step, written = walk(source[-1]), self.edits
        if step.outline is None:
            written = self._set(step.onward(self.edits))
        elif step.changes(self.edits, self.outline):
            self._set_outline(*step.outline)
        into.append(source.pop())
        self.take(written)
        self._remember()

    def _change(self, edits: FrameEdits) -> None:
        if edits != self.edits:
            step = CorrectionStep.between(self.edits, edits)
            self._keep(step, self._set(edits))

    def _keep(self, step: CorrectionStep, written: FrameEdits) -> None:
        """Note a step that was saved; a slider that came back to where it was is none."""
        if step.reversed().changes(self.edits, self.outline):
            self.history.done.append(step)
        self.history.undone.clear()
        self.take(written)
        self._remember()

    def _remember(self) -> None:
        if self.remember is not None:
            self.number()
            self.remember(self.history)

    def _set_outline(self, before: Outline, after: Outline) -> None:
        if self.save_outline is not None:
            try:
                after = self.save_outline(before, after)
            except EditsConflict as conflict:
                self.take(self.edits, conflict.present)
                raise
        self.outline = after
        self.version += 1

    def _set(self, edits: FrameEdits) -> FrameEdits:
        """Save and take over; return what is saved, others' changes included."""
        if edits == self.edits:
            return edits
        if self.save is None:
            view, written = None, edits
        else:
            with ThreadPoolExecutor(1) as beside:  # the disk is waited for while the fit is made
                saving = beside.submit(self.save, self.edits, edits)
                view = apply_corrections(self.found, edits)
                try:
                    written = saving.result()
                except EditsConflict as conflict:
                    self.take(conflict.present)
                    raise
        self.edits, self._view = edits, view
        self.version += 1
        return written


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


def _over(size: tuple[int, int]) -> np.ndarray:
    """Places all over a picture, its corners too, (n, 2)."""
    along, down = (np.linspace(-0.5, n - 0.5, 9) for n in size)
    return np.stack(np.meshgrid(along, down), -1).reshape(-1, 2)


def _place(pair: Sequence[float], found: RecordedPairs) -> Pair:
    """Check that a pair can be: four finite numbers, a place within each picture."""
    values = np.asarray(pair, float).reshape(-1)
    if values.shape != (4,) or not np.isfinite(values).all():
        raise refused("a pair is four numbers", str(pair)[:80], "x, y, x, y")
    for part, size in ((values[:2], found.size), (values[2:], found.target_size)):
        if (part < -0.5).any() or (part > np.array(size) - 0.5).any():
            raise refused("the place is outside the picture", part.tolist(), f"within {size}")
    return tuple(values.tolist())

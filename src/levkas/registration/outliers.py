"""Iterative removal of outliers, section 3.5 of [mirhashemi2019]_: one cut, then the worst pair at a time.

The fit is updated, not solved anew, when a pair leaves. With orthonormal rows q of the design,
G = Σ q qᵀ over the pairs that are kept, z = G⁻¹ q_j and h = q_j·z of the pair j that leaves,

    r_i ← r_i + (q_i·z) r_j / (1 − h),    G⁻¹ ← G⁻¹ + z zᵀ / (1 − h)

([sherman1950]_). A factorisation from scratch, every thousand rounds and whenever too much has left, keeps
rounding below what could change the order in which pairs leave.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.compiled import njit
from levkas.core.problems import Problem
from levkas.geometry.transforms import Polynomial, design_matrix, frame_of
from levkas.registration.record import RegistrationRefused, Trace
from levkas.registration.request import check_thresholds

if TYPE_CHECKING:
    from collections.abc import Iterator

    from levkas.geometry.transforms import Transform

#: Errors that differ by less, px, are equal.
TIE_PX = 1e-9
#: Rounds, growth of the inverse, and freedom of a pair in the fit, at which it is factored anew.
ROUNDS, LARGEST_INVERSE, LEAST_FREEDOM = 1024, 50.0, 1e-3


@dataclass(frozen=True)
class RemovalTerms:
    """Map and thresholds of a removal.

    Parameters
    ----------
    scale : Transform
        The scale-only map target → reference.
    reject, stop : float, reference px
        T1 and T2: pairs farther apart than `reject` under `scale` are cut at once, then the worst
        pair leaves until none is worse than `stop`.
    order : int
        Of the polynomial.

    Raises
    ------
    RegistrationRefused
        Where a threshold is not finite and positive, or `stop` not below `reject`.
    """

    scale: Transform
    reject: float
    stop: float
    order: int = 3

    def __post_init__(self) -> None:
        problems = check_thresholds(self.reject, self.stop)
        if problems:
            raise RegistrationRefused(*problems)

    @property
    def coefficients(self) -> int:
        """Coefficients of the polynomial, for x′ and y′ each."""
        return (self.order + 1) * (self.order + 2) // 2


@dataclass(frozen=True, slots=True)
class RemovalRound:
    """One fit on the way.

    Parameters
    ----------
    number : int
        From 0; round 0 is the first fit after the cut under scale alone.
    model : Polynomial
        Target → reference, fitted to the pairs that were kept.
    worst : int
        Index of the pair with the largest error.
    largest : float, reference px
        That error.
    removed : bool
        Whether `worst` leaves after this round; False only in the last.
    """

    number: int
    model: Polynomial
    worst: int
    largest: float
    removed: bool


def cut(
    target: np.ndarray, reference: np.ndarray, scale: Transform, reject: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return (errors, kept) of all pairs under scale alone: the first, one-step removal.

    Examples
    --------
    >>> from levkas.geometry.transforms import Affine
    >>> target, reference = np.array([[1.0, 1.0], [2.0, 2.0]]), np.array([[2.5, 2.5], [94.5, 4.5]])
    >>> cut(target, reference, Affine.scaling(2.0), 10.0)
    (array([ 0., 90.]), array([ True, False]))
    """
    errors = np.linalg.norm(scale(target) - reference, axis=1)
    return errors, errors < reject


def remove_outliers(
    target: np.ndarray, reference: np.ndarray, terms: RemovalTerms
) -> Iterator[RemovalRound]:
    """Yield a `RemovalRound` for every fit until the largest error is at most ``terms.stop``.

    Parameters
    ----------
    target, reference : ndarray, (n, 2)
        Native px of the target; reference px.
    terms : RemovalTerms

    Raises
    ------
    RegistrationRefused
        Where fewer pairs than coefficients are left after the cut, or where they lie so that they do
        not determine the polynomial (on a line, say).

    Notes
    -----
    Errors that differ by less than 1e-9 px are equal; of these the pair that comes first by
    reference x, y, target x, y leaves, so that the order of the pairs does not matter.
    """
    number = 0
    kept = cut(target, reference, terms.scale, terms.reject)[1]
    for many in _remove(target, reference, terms, kept, np.zeros(len(kept), bool)):
        for k, error in enumerate(many.largest.tolist()):
            model = Polynomial(terms.order, many.centre, many.spread, many.models[k])
            yield RemovalRound(number, model, int(many.worst[k]), error, not error <= terms.stop)
            number += 1


@dataclass(frozen=True)
class Cleaned:
    """Result of a removal.

    Parameters
    ----------
    model : Polynomial
        Target → reference.
    kept : ndarray of bool, (n,)
    round : ndarray of int, (n,)
        Iteration after which a pair left: 0 in the cut, k + 1 after the fit of round k, -1 kept.
    residual, leave_one_out : ndarray, (n,), reference px
        Under `model`, and under the fit without the pair (equal for pairs that were removed).
    trace : Trace
    models : ndarray, (rounds, terms, 2)
        Coefficients of the polynomial of every round; order, centre and spread are `model`'s.
    """

    model: Polynomial
    kept: np.ndarray
    round: np.ndarray
    residual: np.ndarray
    leave_one_out: np.ndarray
    trace: Trace
    models: np.ndarray


def clean(
    target: np.ndarray,
    reference: np.ndarray,
    terms: RemovalTerms,
    *,
    size: tuple[int, int],
    target_size: tuple[int, int],
    pinned: np.ndarray | None = None,
    dropped: np.ndarray | None = None,
) -> Cleaned:
    """Run `remove_outliers` to its end and keep its trace.

    Parameters
    ----------
    target, reference, terms
        As `remove_outliers` takes them.
    size, target_size : (width, height)
        Of the reference and of the target, for the frames of the paper's Figure 9.
    pinned, dropped : ndarray of bool, (n,), optional
        Pairs that never leave, whatever their error, and pairs that are never used.

    Raises
    ------
    RegistrationRefused
        As `remove_outliers`, with the trace so far.
    """
    stays = np.zeros(len(target), bool) if pinned is None else np.asarray(pinned, bool)
    errors, kept = cut(target, reference, terms.scale, terms.reject)
    kept = kept | stays
    if dropped is not None:
        errors, kept = np.where(dropped, np.inf, errors), kept & ~dropped
    frames = size, frame_corners(target_size)
    rounds: list[_Many] = []
    try:
        rounds.extend(_remove(target, reference, terms, kept, stays))
    except RegistrationRefused as refusal:
        refusal.trace = _trace(rounds, terms, errors, frames, pinned)
        raise
    trace = _trace(rounds, terms, errors, frames, pinned)
    kept = trace.kept_at(-1)
    left = np.where(trace.kept_at(0), -1, 0)
    gone = trace.removed[trace.removed >= 0]
    left[gone] = np.arange(1, len(gone) + 1)
    models = np.concatenate([many.models for many in rounds])
    model = Polynomial(terms.order, rounds[-1].centre, rounds[-1].spread, models[-1])
    residual = np.linalg.norm(model(target) - reference, axis=1)
    design = design_matrix(target[kept], terms.order, model.centre, model.spread)
    q = orthonormalise(np.ascontiguousarray(design.T))[0]
    without = residual.copy()
    without[kept] /= np.maximum(1 - np.square(q).sum(0), 1e-12)
    return Cleaned(model, kept, left, residual, without, trace, models)


def frame_corners(size: tuple[int, int]) -> np.ndarray:
    """Return the outer corners of a frame, (4, 2), clockwise from the top left.

    >>> frame_corners((2, 1)).tolist()
    [[-0.5, -0.5], [1.5, -0.5], [1.5, 0.5], [-0.5, 0.5]]
    """
    w, h = size
    return np.array([[0, 0], [w, 0], [w, h], [0, h]], float) - 0.5


@dataclass(frozen=True, slots=True)
class _Many:
    """Rounds that one factorisation carried: their models, the pairs that leave, their errors."""

    centre: np.ndarray
    spread: float
    models: np.ndarray
    worst: np.ndarray
    largest: np.ndarray


def _remove(
    target: np.ndarray,
    reference: np.ndarray,
    terms: RemovalTerms,
    kept: np.ndarray,
    stays: np.ndarray,
) -> Iterator[_Many]:
    """Yield the rounds from the pairs `kept`, (n,) bool, on, many at a time; those of `stays` never leave."""
    target, reference = np.asarray(target, float), np.asarray(reference, float)
    rows = np.flatnonzero(kept)
    if len(rows) < terms.coefficients:
        raise _too_few(len(rows), terms, len(kept))
    rank = np.empty(len(target), np.int64)
    rank[_sorted_rows(reference, target)] = np.arange(len(target))
    frame = frame_of(target[rows])
    middle = reference[rows].mean(0)
    while True:
        design = design_matrix(target[rows], terms.order, *frame)
        q, r = orthonormalise(np.ascontiguousarray(design.T))
        if r[-1, -1] == 0:
            raise _undetermined(len(rows), terms.order)
        solved, residual = fit_rows(q, np.ascontiguousarray((reference[rows] - middle).T))
        history, worst, largest = remove_worst(
            q, residual, solved, rank[rows], float(terms.stop), stays[rows]
        )
        models = solve_triangular(r, history)
        models[:, 0] += middle
        yield _Many(frame[0], frame[1], models, rows[worst], largest)
        if largest[-1] <= terms.stop:
            return
        rows = np.delete(rows, worst)


def _sorted_rows(reference: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return rows by reference x, y, target x, y; the first alone decides where no two pairs share it."""
    rows = np.argsort(reference[:, 0], kind="stable")
    along = reference[rows, 0]
    if (along[1:] > along[:-1]).all():
        return rows
    return np.lexsort((*target.T[::-1], *reference.T[::-1]))


def _trace(
    rounds: list[_Many],
    terms: RemovalTerms,
    errors: np.ndarray,
    frames: tuple[tuple[int, int], np.ndarray],
    pinned: np.ndarray | None,
) -> Trace:
    """Return the trace of some rounds; `frames` are the reference's size and the target's corners."""
    size, corners = frames
    shapes = np.empty((0, 4, 2))
    largest, removed = np.empty(0), np.empty(0, int)
    if rounds:
        models = np.concatenate([many.models for many in rounds])
        design = design_matrix(corners, terms.order, rounds[0].centre, rounds[0].spread)
        columns = np.ascontiguousarray(models.transpose(1, 0, 2)).reshape(len(design.T), -1)
        shapes = sum(design[:, [i]] * column for i, column in enumerate(columns))
        shapes = shapes.reshape(len(corners), -1, 2).transpose(1, 0, 2).copy()
        largest = np.concatenate([many.largest for many in rounds])
        removed = np.concatenate([many.worst for many in rounds])
        removed = np.where(largest <= terms.stop, -1, removed)
    return Trace(
        reject=float(terms.reject),
        stop=float(terms.stop),
        scale=terms.scale,
        scale_errors=errors,
        largest=largest,
        removed=removed,
        corners=shapes,
        frame=terms.scale(corners),
        size=size,
        pinned=pinned,
        order=terms.order,
    )


def _too_few(found: int, terms: RemovalTerms, before: int) -> RegistrationRefused:
    return RegistrationRefused(
        Problem(
            "E_MATCHES",
            f"order-{terms.order} polynomial needs at least {terms.coefficients} matches, got {found}",
            field="registration",
            found=f"{found} of {before} matches are closer than `reject` under scale alone",
            expected=f"at least {terms.coefficients}",
            fix="Check that both cameras show the same object with the same side up; if they do, raise `reject`.",
        )
    )


def _undetermined(found: int, order: int) -> RegistrationRefused:
    return RegistrationRefused(
        Problem(
            "E_MATCHES",
            f"{found} matches lie on too few lines to determine an order-{order} polynomial",
            field="registration",
            found=found,
            expected="matches spread over the picture",
            fix="Check that both pictures have detail over the whole object.",
        )
    )


# --- compiled loops


@njit(cache=True)
def orthonormalise(columns):  # type: ignore[no-untyped-def]
    """Factor the transposed design, (terms, n), into orthonormal rows q and triangular r.

    Gram–Schmidt, twice: as orthonormal as Householder's, and the same on any number of threads.
    ``columns = rᵀ q``; a zero on r's diagonal says that the pairs do not determine the fit.
    """
    q = columns.copy()
    terms, n = q.shape
    r = np.zeros((terms, terms))
    for a in range(terms):
        start = _dot(q[a], q[a])
        for _ in range(2):
            for b in range(a):
                share = _dot(q[b], q[a])
                r[b, a] += share
                for i in range(n):
                    q[a, i] -= share * q[b, i]
        norm = np.sqrt(_dot(q[a], q[a]))
        if norm <= 1e-10 * np.sqrt(start):
            return q, r
        r[a, a] = norm
        q[a] /= norm
    return q, r


@njit(cache=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    s0 = s1 = s2 = s3 = 0.0
    whole = len(a) - len(a) % 4
    for i in range(0, whole, 4):
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
    for i in range(whole, len(a)):
        s0 += a[i] * b[i]
    return (s0 + s1) + (s2 + s3)


@njit(cache=True)
def fit_rows(q, values):  # type: ignore[no-untyped-def]
    """Return (solved, residual), (terms, 2) and (2, n), of `values`, (2, n), on orthonormal q."""
    terms, n = q.shape
    solved = np.empty((terms, 2))
    residual = values.copy()
    for a in range(terms):
        for axis in range(2):
            solved[a, axis] = _dot(q[a], residual[axis])
            for i in range(n):
                residual[axis, i] -= solved[a, axis] * q[a, i]
    return solved, residual


@njit(cache=True)
def solve_triangular(r, history):  # type: ignore[no-untyped-def]
    """Return x, (rounds, terms, 2), of r x = each of `history`; r is upper triangular."""
    solved = np.empty_like(history)
    terms = len(r)
    for i in range(len(history)):
        for axis in range(2):
            for a in range(terms - 1, -1, -1):
                rest = history[i, a, axis]
                for b in range(a + 1, terms):
                    rest -= r[a, b] * solved[i, b, axis]
                solved[i, a, axis] = rest / r[a, a]
    return solved


@njit(cache=True)
def remove_worst(q, residual, solved, rank, stop, pinned):  # type: ignore[no-untyped-def]
    """Remove the worst pair until `stop`, or until the factorisation should be made anew.

    Parameters
    ----------
    q : (terms, n), residual : (2, n), solved : (terms, 2)
        Of `orthonormalise` and `fit_rows`.
    rank : (n,) int
        Among equals within `TIE_PX` the lowest rank leaves.
    stop : float
    pinned : (n,) bool
        Pairs that never leave, whatever their error.

    Returns
    -------
    history : (rounds, terms, 2)
        Coefficients on q before each removal.
    worst : (rounds,) int, largest : (rounds,)
        The last has ``largest <= stop`` where the work is done; its pair is -1 where all are pinned.
    """
    terms, n = q.shape
    history = np.empty((ROUNDS, terms, 2))
    worst = np.empty(ROUNDS, np.int64)
    largest = np.empty(ROUNDS)
    here, inverse = solved.copy(), np.eye(terms)
    z, squares = np.empty(terms), np.empty(n)
    for i in range(n):  # pairs that cannot leave have a square of -1
        squares[i] = -1.0 if pinned[i] else residual[0, i] ** 2 + residual[1, i] ** 2
    count = 0
    while True:
        j = _worst(squares, rank)
        error = np.sqrt(squares[j]) if j >= 0 else 0.0
        history[count], worst[count], largest[count] = here, j, error
        count += 1
        if error <= stop or count == ROUNDS or n - count <= terms:
            break
        free = _direction(inverse, q[:, j], z)
        if free < LEAST_FREEDOM:
            break
        fx, fy = residual[0, j] / free, residual[1, j] / free
        grown = 0.0
        for a in range(terms):
            here[a, 0] -= z[a] * fx
            here[a, 1] -= z[a] * fy
            for b in range(terms):
                inverse[a, b] += z[a] * z[b] / free
            grown = max(grown, inverse[a, a])
        if grown > LARGEST_INVERSE:
            break
        squares[j] = -1.0
        _move(q, residual, squares, z, fx, fy)
    return history[:count], worst[:count], largest[:count]


@njit(cache=True)
def _worst(squares, rank):  # type: ignore[no-untyped-def]
    """Return the row with the largest square; among equals, that of the lowest rank; -1 where all are negative."""
    floor = max(np.sqrt(max(squares.max(), 0.0)) - TIE_PX, 0.0) ** 2
    j = -1
    for i in range(len(squares)):
        if squares[i] >= floor and (j < 0 or rank[i] < rank[j]):
            j = i
    return j


@njit(cache=True)
def _direction(inverse, row, z):  # type: ignore[no-untyped-def]
    """Set z = G⁻¹ q_j and return 1 − h, the freedom that the pair has in the fit."""
    free = 1.0
    for a in range(len(z)):
        z[a] = 0.0
        for b in range(len(z)):
            z[a] += inverse[a, b] * row[b]
    for a in range(len(z)):
        free -= z[a] * row[a]
    return free


@njit(cache=True)
def _move(q, residual, squares, z, fx, fy):  # type: ignore[no-untyped-def]
    """Move the residuals to the fit without the pair that left."""
    part = z[0] * q[0]
    for a in range(1, len(q)):
        for i in range(len(part)):
            part[i] += z[a] * q[a, i]
    for i in range(len(part)):
        residual[0, i] += part[i] * fx
        residual[1, i] += part[i] * fy
        if squares[i] >= 0.0:
            squares[i] = residual[0, i] ** 2 + residual[1, i] ** 2

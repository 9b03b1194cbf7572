"""Iterative removal of outliers, section 3.5 of [mirhashemi2019]_: one cut, then the worst at a time.

The fit is updated, not solved anew, when a pair leaves (`downdating`). A factorisation from
scratch, every thousand rounds and whenever too much has left, keeps rounding below what could
change the order in which pairs leave.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Polynomial, design_matrix, frame_of
from levkas.registration.downdating import (
    fit_rows,
    orthonormalise,
    remove_worst,
    solve_triangular,
)
from levkas.registration.record import RegistrationRefused, Trace
from levkas.registration.request import check_thresholds

if TYPE_CHECKING:
    from collections.abc import Iterator

    from levkas.geometry.transforms import Transform


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
    target: np.ndarray,
    reference: np.ndarray,
    *,
    scale: Transform,
    reject: float,
    stop: float,
    order: int = 3,
    pinned: np.ndarray | None = None,
    dropped: np.ndarray | None = None,
) -> Iterator[RemovalRound]:
    """Yield a `RemovalRound` for every fit until the largest error is at most `stop`.

    Parameters
    ----------
    target, reference : ndarray, (n, 2)
        Native px of the target; reference px.
    scale : Transform
        The scale-only map target → reference.
    reject, stop : float, reference px
        T1 and T2: pairs farther apart than `reject` under `scale` are cut at once, then the worst
        pair leaves until none is worse than `stop`.
    order : int
        Of the polynomial.
    pinned, dropped : ndarray of bool, (n,), optional
        Pairs that never leave, whatever their error, and pairs that are never used.

    Yields
    ------
    round : Round

    Raises
    ------
    RegistrationRefused
        Where fewer pairs than coefficients are left after the cut, where they lie so that they do
        not determine the polynomial (on a line, say), or a threshold is wrong.

    Notes
    -----
    Errors that differ by less than 1e-9 px are equal; of these the pair that comes first by
    reference x, y, target x, y leaves, so that the order of the pairs does not matter.
    """
    number = 0
    for many in _remove(
        target, reference, scale, reject, stop, order=order, pinned=pinned, dropped=dropped
    ):
        for k, error in enumerate(many.largest.tolist()):
            done = error <= stop
            model = Polynomial(order, many.centre, many.spread, many.models[k])
            yield RemovalRound(number, model, int(many.worst[k]), error, not done)
            number += 1


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
    scale: Transform,
    reject: float,
    stop: float,
    *,
    order: int,
    pinned: np.ndarray | None,
    dropped: np.ndarray | None,
) -> Iterator[_Many]:
    """Do the work of `remove_outliers`, many rounds at a time."""
    problems = check_thresholds(reject, stop)
    if problems:
        raise RegistrationRefused(*problems)
    target, reference = np.asarray(target, float), np.asarray(reference, float)
    _, kept = _cut_but(target, reference, scale, reject, pinned, dropped)
    stays = np.zeros(len(target), bool) if pinned is None else np.asarray(pinned, bool)
    terms = (order + 1) * (order + 2) // 2
    rows = np.flatnonzero(kept)
    if len(rows) < terms:
        raise _too_few(len(rows), terms, order, len(kept))
    rank = np.empty(len(target), np.int64)
    rank[_sorted_rows(reference, target)] = np.arange(len(target))
    frame = frame_of(target[rows])
    middle = reference[rows].mean(0)
    while True:
        design = design_matrix(target[rows], order, *frame)
        q, r = orthonormalise(np.ascontiguousarray(design.T))
        if r[-1, -1] == 0:
            raise _undetermined(len(rows), order)
        solved, residual = fit_rows(q, np.ascontiguousarray((reference[rows] - middle).T))
        history, worst, largest = remove_worst(
            q, residual, solved, rank[rows], float(stop), stays[rows]
        )
        models = solve_triangular(r, history)
        models[:, 0] += middle
        yield _Many(frame[0], frame[1], models, rows[worst], largest)
        if largest[-1] <= stop:
            return
        rows = np.delete(rows, worst)


def _sorted_rows(reference: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Rows by reference x, y, target x, y; the first alone decides where no two pairs share it."""
    rows = np.argsort(reference[:, 0], kind="stable")
    along = reference[rows, 0]
    if (along[1:] > along[:-1]).all():
        return rows
    return np.lexsort((*target.T[::-1], *reference.T[::-1]))


def _cut_but(
    target: np.ndarray,
    reference: np.ndarray,
    scale: Transform,
    reject: float,
    pinned: np.ndarray | None,
    dropped: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """`cut`, but a pinned pair stays and a dropped one, its error infinite, goes."""
    errors, kept = cut(target, reference, scale, reject)
    if pinned is not None:
        kept = kept | pinned
    if dropped is not None:
        errors, kept = np.where(dropped, np.inf, errors), kept & ~dropped
    return errors, kept


@dataclass(frozen=True)
class Cleaned:
    """What is left when the removal is done.

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
    *,
    scale: Transform,
    reject: float,
    stop: float,
    size: tuple[int, int],
    target_size: tuple[int, int],
    order: int = 3,
    pinned: np.ndarray | None = None,
    dropped: np.ndarray | None = None,
) -> Cleaned:
    """Run `remove_outliers` to its end and keep its trace.

    Parameters
    ----------
    size, target_size : (width, height)
        Of the reference and of the target, for the frames of the paper's Figure 9.
    target, reference, scale, reject, stop, order, pinned, dropped
        As `remove_outliers` takes them.

    Raises
    ------
    RegistrationRefused
        As `remove_outliers`, with the trace so far.
    """
    errors, kept = _cut_but(target, reference, scale, reject, pinned, dropped)
    corners = frame_corners(target_size)
    rounds: list[_Many] = []
    try:
        for many in _remove(
            target, reference, scale, reject, stop, order=order, pinned=pinned, dropped=dropped
        ):
            rounds.append(many)
    except RegistrationRefused as refusal:
        refusal.trace = _trace(rounds, scale, errors, reject, stop, corners, size, pinned)
        raise
    trace = _trace(rounds, scale, errors, reject, stop, corners, size, pinned)
    kept = trace.kept_at(-1)
    left = np.where(trace.kept_at(0), -1, 0)
    gone = trace.removed[trace.removed >= 0]
    left[gone] = np.arange(1, len(gone) + 1)
    models = np.concatenate([many.models for many in rounds])
    model = Polynomial(order, rounds[-1].centre, rounds[-1].spread, models[-1])
    residual = np.linalg.norm(model(target) - reference, axis=1)
    design = design_matrix(target[kept], order, model.centre, model.spread)
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


def _trace(
    rounds: list[_Many],
    scale: Transform,
    errors: np.ndarray,
    reject: float,
    stop: float,
    corners: np.ndarray,
    size: tuple[int, int],
    pinned: np.ndarray | None,
) -> Trace:
    shapes = np.empty((0, 4, 2))
    largest, removed = np.empty(0), np.empty(0, int)
    if rounds:
        first, models = rounds[0], np.concatenate([many.models for many in rounds])
        order = int(np.sqrt(2 * models.shape[1])) - 1
        design = design_matrix(corners, order, first.centre, first.spread)
        terms = np.ascontiguousarray(models.transpose(1, 0, 2)).reshape(len(design.T), -1)
        shapes = sum(design[:, [i]] * term for i, term in enumerate(terms))
        shapes = shapes.reshape(len(corners), -1, 2).transpose(1, 0, 2).copy()
        largest = np.concatenate([many.largest for many in rounds])
        removed = np.concatenate([many.worst for many in rounds])
        removed = np.where(largest <= stop, -1, removed)
    return Trace(
        reject=float(reject),
        stop=float(stop),
        scale=scale,
        scale_errors=errors,
        largest=largest,
        removed=removed,
        corners=shapes,
        frame=scale(corners),
        size=size,
        pinned=pinned,
    )


def _too_few(found: int, terms: int, order: int, before: int) -> RegistrationRefused:
    return RegistrationRefused(
        Problem(
            "E_MATCHES",
            f"order-{order} polynomial needs at least {terms} matches, got {found}",
            field="registration",
            found=f"{found} of {before} matches are closer than `reject` under scale alone",
            expected=f"at least {terms}",
            fix="Check that both cameras show the same object the same way up; else raise `reject`.",
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
            fix="Check that both pictures show structure all over the object.",
        )
    )

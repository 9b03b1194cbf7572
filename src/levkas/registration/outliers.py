"""Iterative removal of outliers, section 3.5 of [mirhashemi2019]_: one cut, then the worst pair at a time.

With orthonormal rows q of the design, the normal matrix Σ q qᵀ over the pairs that are kept loses one term when a pair
leaves, and is solved anew: as many unknowns as a polynomial has terms. Where little of it is left, the design is made orthonormal anew.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.geometry.transforms import Polynomial, design_matrix, frame_of
from levkas.registration.record import RegistrationRefused, Trace, refusal
from levkas.registration.request import check_thresholds

if TYPE_CHECKING:
    from collections.abc import Iterator

    from levkas.geometry.transforms import Transform

#: Errors that differ by less, px, are equal.
TIE_PX = 1e-9
#: Least eigenvalue of the normal matrix, 1 at first, below which the design is made orthonormal anew.
LEAST_LEFT = 0.02


@dataclass(frozen=True)
class RemovalTerms:
    """Map and thresholds of a removal.

    Raises RegistrationRefused where a threshold is not finite and positive, or `stop` not below `reject`.
    """

    scale: Transform
    """The scale-only map target → reference."""
    reject: float
    stop: float
    """`reject`, `stop`: in reference px: t1 and T2: pairs farther apart than `reject` under `scale` are cut at once, then
    the worst pair leaves until none is worse than `stop`."""
    order: int = 3
    """Of the polynomial."""

    def __post_init__(self) -> None:
        problems = check_thresholds(self.reject, self.stop)
        if problems:
            raise RegistrationRefused(*problems)

    @property
    def coefficients(self) -> int:
        """Coefficients of the polynomial, for x′ and y′ each."""
        return (self.order + 1) * (self.order + 2) // 2


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


@dataclass(frozen=True)
class Cleaned:
    """Result of a removal."""

    model: Polynomial
    """Target → reference."""
    kept: np.ndarray
    """(n,)."""
    round: np.ndarray
    """(n,). Iteration after which a pair left: 0 in the cut, k + 1 after the fit of round k, -1 kept."""
    residual: np.ndarray
    leave_one_out: np.ndarray
    """`residual`, `leave_one_out`: (n,), reference px. Under `model`, and under the fit without the pair (equal for pairs
    that were removed)."""
    trace: Trace
    models: np.ndarray
    """(rounds, terms, 2). Coefficients of the polynomial of every round; order, centre and spread are `model`'s."""


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
    """Remove the worst pair, fit by fit, until the largest error is at most ``terms.stop``, and keep the trace.

    Raises RegistrationRefused where fewer pairs than coefficients are left after the cut, or where they lie so that they do
    not determine the polynomial (on a line, say); with the trace so far.

    Parameters
    ----------
    target, reference : ndarray, (n, 2)
        Native px of the target; reference px.
    size, target_size : (width, height)
        Of the reference and of the target, for the frames of the paper's Figure 9.
    pinned, dropped : ndarray of bool, (n,), optional
        Pairs that never leave, whatever their error, and pairs that are never used.

    Notes
    -----
    Errors that differ by less than 1e-9 px are equal; of these the pair that comes first by
    reference x, y, target x, y leaves, so that the order of the pairs does not matter.
    """
    stays = np.zeros(len(target), bool) if pinned is None else np.asarray(pinned, bool)
    errors, kept = cut(target, reference, terms.scale, terms.reject)
    kept = kept | stays
    if dropped is not None:
        errors, kept = np.where(dropped, np.inf, errors), kept & ~dropped
    frames = size, frame_corners(target_size)
    rounds: list[_Round] = []
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
    model = rounds[-1][0]
    residual = np.linalg.norm(model(target) - reference, axis=1)
    design = design_matrix(target[kept], terms.order, model.centre, model.spread)
    without = residual.copy()
    leverage = np.square(np.linalg.qr(design)[0]).sum(1)
    without[kept] /= np.maximum(1 - leverage, 1e-12)
    models = np.stack([one.coefficients for one, _, _ in rounds])
    return Cleaned(model, kept, left, residual, without, trace, models)


def frame_corners(size: tuple[int, int]) -> np.ndarray:
    """Return the outer corners of a frame, (4, 2), clockwise from the top left.

    >>> frame_corners((2, 1)).tolist()
    [[-0.5, -0.5], [1.5, -0.5], [1.5, 0.5], [-0.5, 0.5]]
    """
    w, h = size
    return np.array([[0, 0], [w, 0], [w, h], [0, h]], float) - 0.5


_Round = tuple[Polynomial, int, float]
"""Model of a round, the pair that leaves, and its error."""


def _remove(
    target: np.ndarray,
    reference: np.ndarray,
    terms: RemovalTerms,
    kept: np.ndarray,
    stays: np.ndarray,
) -> Iterator[_Round]:
    """Yield the rounds from the pairs `kept`, (n,) bool, on; those of `stays` never leave."""
    target, reference = np.asarray(target, float), np.asarray(reference, float)
    # In the order in which equals leave.
    rows = np.lexsort((*target.T[::-1], *reference.T[::-1]))
    rows = rows[kept[rows]]
    if len(rows) < terms.coefficients:
        raise _too_few(len(rows), terms, len(kept))
    frame = frame_of(target[rows])
    middle = reference[rows].mean(0)
    while True:
        design = design_matrix(target[rows], terms.order, *frame)
        q, r = np.linalg.qr(design)
        if (np.abs(np.diag(r)) <= 1e-10 * np.linalg.norm(design, axis=0)).any():
            raise _undetermined(len(rows), terms.order)
        values, here = reference[rows] - middle, np.ones(len(rows), bool)
        normal, right = q.T @ q, q.T @ values
        while np.linalg.eigvalsh(normal)[0] >= LEAST_LEFT:
            solved = np.linalg.solve(normal, right)
            may_leave = here & ~stays[rows]
            error = np.where(may_leave, np.hypot(*(values - q @ solved).T), 0.0)
            j = int(np.argmax(may_leave & (error >= error.max() - TIE_PX)))
            coefficients = np.linalg.solve(r, solved)
            coefficients[0] += middle
            yield Polynomial(terms.order, *frame, coefficients), int(rows[j]), float(error[j])
            if error[j] <= terms.stop:
                return
            here[j] = False
            normal, right = normal - np.outer(q[j], q[j]), right - np.outer(q[j], values[j])
        rows = rows[here]


def _trace(
    rounds: list[_Round],
    terms: RemovalTerms,
    errors: np.ndarray,
    frames: tuple[tuple[int, int], np.ndarray],
    pinned: np.ndarray | None,
) -> Trace:
    """Return the trace of some rounds; `frames` are the reference's size and the target's corners."""
    size, corners = frames
    shapes = np.array([model(corners) for model, _, _ in rounds]).reshape(-1, 4, 2)
    largest = np.array([error for _, _, error in rounds])
    worst = np.array([number for _, number, _ in rounds], int)
    return Trace(
        reject=float(terms.reject),
        stop=float(terms.stop),
        scale=terms.scale,
        scale_errors=errors,
        largest=largest,
        removed=np.where(largest <= terms.stop, -1, worst),
        corners=shapes,
        frame=terms.scale(corners),
        size=size,
        pinned=pinned,
        order=terms.order,
    )


def _too_few(found: int, terms: RemovalTerms, before: int) -> RegistrationRefused:
    return refusal(
        "E_MATCHES",
        f"order-{terms.order} polynomial needs at least {terms.coefficients} matches, got {found}",
        field="registration",
        found=f"{found} of {before} matches are closer than `reject` under scale alone",
        expected=f"at least {terms.coefficients}",
        fix="Check that both cameras show the same object with the same side up; if they do, raise `reject`.",
    )


def _undetermined(found: int, order: int) -> RegistrationRefused:
    return refusal(
        "E_MATCHES",
        f"{found} matches lie on too few lines to determine an order-{order} polynomial",
        field="registration",
        found=found,
        expected="matches spread over the picture",
        fix="Check that both pictures have detail over the whole object.",
    )

"""Iterative removal of outliers, section 3.5 of [mirhashemi2019]_: one cut, then the worst pair at a time.

With orthonormal rows q of the design, the normal matrix Σ q qᵀ over the pairs that are kept loses one term when a pair leaves, and is
solved anew: as many unknowns as a polynomial has terms. Where little of it is left, the design is made orthonormal anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from levkas.geometry.transforms import Polynomial, Transform, design_matrix, frame_of
from levkas.registration.record import RegistrationRefused, Trace, refusal
from levkas.registration.request import check_thresholds

TIE_PX = 1e-9
"""Errors that differ by less, px, are equal."""
LEAST_LEFT, LEAST_ROWS = 0.02, 0.8
"""Least eigenvalue of the normal matrix, 1 at first, and share of the pairs, from which on the design is made orthonormal anew."""


@dataclass(frozen=True)
class RemovalTerms:
    """Map and thresholds of a removal, T1 and T2 of the paper.

    Raises RegistrationRefused where a threshold is not finite and positive, or `stop` not below `reject`.
    """

    scale: Transform
    """The scale-only map target → reference."""
    reject: float
    stop: float
    """`reject`, `stop`: in reference px: pairs farther apart than `reject` under `scale` are cut at once, then the worst pair leaves until
    none is worse than `stop`."""
    order: int = 3
    """Of the polynomial."""

    def __post_init__(self) -> None:
        if problems := check_thresholds(self.reject, self.stop):
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

    `target` and `reference` are (n, 2) native and reference px; the sizes, (width, height), are for the frames of the paper's Figure 9.
    Pairs of the mask `pinned` never leave, whatever their error; those of `dropped` are never used. Of errors that are equal the pair that comes first by
    reference x, y, target x, y leaves, so that the order of the pairs does not matter.

    Raises RegistrationRefused, with the trace so far, where fewer pairs than coefficients are left after the cut, or where they lie so
    that they do not determine the polynomial (on a line, say).
    """
    stays = np.zeros(len(target), bool) if pinned is None else np.asarray(pinned, bool)
    errors, kept = cut(target, reference, terms.scale, terms.reject)
    kept = kept | stays
    if dropped is not None:
        errors, kept = np.where(dropped, np.inf, errors), kept & ~dropped
    corners = frame_corners(target_size)
    frame = frame_of(target[kept]) if kept.any() else (np.zeros(2), 1.0)
    rounds: list[tuple[np.ndarray, int, float]] = []

    shape = design_matrix(corners, terms.order, *frame)

    def trace() -> Trace:
        largest = np.array([error for _, _, error in rounds])
        worst = np.array([number for _, number, _ in rounds], int)
        return Trace(
            reject=float(terms.reject),
            stop=float(terms.stop),
            scale=terms.scale,
            scale_errors=errors,
            largest=largest,
            removed=np.where(largest <= terms.stop, -1, worst),
            corners=np.array([shape @ one for one, _, _ in rounds]).reshape(-1, 4, 2),
            frame=terms.scale(corners),
            size=size,
            pinned=pinned,
            order=terms.order,
        )

    try:
        rounds.extend(_remove(target, reference, terms, kept, stays, frame))
    except RegistrationRefused as refused:
        refused.trace = trace()
        raise
    centre, spread = frame
    model = Polynomial(terms.order, centre, spread, rounds[-1][0])
    left = np.where(kept, -1, 0)
    gone = [number for _, number, _ in rounds[:-1]]
    left[gone] = np.arange(1, len(gone) + 1)
    kept = left < 0
    residual = np.linalg.norm(model(target) - reference, axis=1)
    design = design_matrix(target[kept], terms.order, model.centre, model.spread)
    without, leverage = residual.copy(), np.square(np.linalg.qr(design)[0]).sum(1)
    without[kept] /= np.maximum(1 - leverage, 1e-12)
    return Cleaned(model, kept, left, residual, without, trace())


def frame_corners(size: tuple[int, int]) -> np.ndarray:
    """Return the outer corners of a frame, (4, 2), clockwise from the top left.

    >>> frame_corners((2, 1)).tolist()
    [[-0.5, -0.5], [1.5, -0.5], [1.5, 0.5], [-0.5, 0.5]]
    """
    w, h = size
    return np.array([[0, 0], [w, 0], [w, h], [0, h]], float) - 0.5


def _remove(
    target: np.ndarray,
    reference: np.ndarray,
    terms: RemovalTerms,
    kept: np.ndarray,
    stays: np.ndarray,
    frame: tuple[np.ndarray, float],
) -> Iterator[tuple[np.ndarray, int, float]]:
    """Yield the coefficients of each round, the pair that leaves and its error, from the pairs `kept` on; those of `stays` never leave."""
    target, reference = np.asarray(target, float), np.asarray(reference, float)
    # In the order in which equals leave.
    rows = np.lexsort((*target.T[::-1], *reference.T[::-1]))
    rows = rows[kept[rows]]
    if len(rows) < terms.coefficients:
        raise _too_few(len(rows), terms, len(kept))
    middle = reference[rows].mean(0)
    while True:
        design = design_matrix(target[rows], terms.order, *frame)
        q, r = np.linalg.qr(design)
        if (np.abs(np.diag(r)) <= 1e-10 * np.linalg.norm(design, axis=0)).any():
            raise refusal(
                "E_MATCHES",
                f"{len(rows)} matches lie on too few lines to determine an order-{terms.order} polynomial",
                field="registration",
                found=len(rows),
                expected="matches spread over the picture",
                fix="Check that both pictures have detail over the whole object.",
            )
        # What leaves is set to zero, and so is its error.
        columns, values = (
            np.ascontiguousarray(q.T),
            np.ascontiguousarray((reference[rows] - middle).T),
        )
        pinned, here, inverse = stays[rows], np.ones(len(rows), bool), np.linalg.inv(r)
        normal, right = columns @ q, columns @ values.T
        while (
            np.count_nonzero(here) > LEAST_ROWS * len(rows)
            and np.linalg.eigvalsh(normal)[0] >= LEAST_LEFT
        ):
            solved = np.linalg.solve(normal, right)
            along, down = values - solved.T @ columns
            error = along * along + down * down
            error[pinned] = 0.0
            worst = float(np.sqrt(error.max()))
            j = int(np.argmax(error >= max(worst - TIE_PX, 0.0) ** 2))
            coefficients = inverse @ solved
            coefficients[0] += middle
            yield coefficients, int(rows[j]), worst
            if worst <= terms.stop:
                return
            normal = normal - np.outer(columns[:, j], columns[:, j])
            right = right - np.outer(columns[:, j], values[:, j])
            here[j], columns[:, j], values[:, j] = False, 0.0, 0.0
        rows = rows[here]


def _too_few(found: int, terms: RemovalTerms, before: int) -> RegistrationRefused:
    return refusal(
        "E_MATCHES",
        f"order-{terms.order} polynomial needs at least {terms.coefficients} matches, got {found}",
        field="registration",
        found=f"{found} of {before} matches are closer than `reject` under scale alone",
        expected=f"at least {terms.coefficients}",
        fix="Check that both cameras show the same object with the same side up; if they do, raise `reject`.",
    )

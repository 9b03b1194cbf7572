"""Downdating: a least-squares fit that is updated when its worst pair leaves; the kernel of `outliers`.

With orthonormal rows q of the design, G = Σ q qᵀ over the pairs that are kept, z = G⁻¹ q_j and
h = q_j·z of the pair j that leaves,

    r_i ← r_i + (q_i·z) r_j / (1 − h),    G⁻¹ ← G⁻¹ + z zᵀ / (1 − h).

After some rounds the coefficients have moved by P, and r_i by q_i·P: by Cauchy and Schwarz at most ‖q_i‖‖P‖. A pair whose
error is far below the largest cannot become the worst for many rounds: only the `HOT` worst pairs are followed until
that bound no longer excludes the rest.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit

#: Errors that differ by less, px, are equal.
TIE_PX = 1e-9
#: Rounds after which the fit is factored anew, pairs that are followed.
ROUNDS, HOT = 1024, 512
#: Growth of the inverse, and freedom of a pair in the fit, at which it is factored anew.
LARGEST_INVERSE, LEAST_FREEDOM = 50.0, 1e-3


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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
    norms = np.zeros(n)
    for i in range(n):
        for a in range(terms):
            norms[i] += q[a, i] ** 2
        norms[i] = np.sqrt(norms[i])
    here, inverse = solved.copy(), np.eye(terms)
    pending, z = np.zeros((terms, 2)), np.empty(terms)
    gone = np.zeros(n, np.bool_)
    squares, part = np.empty(n), np.empty(n)
    count, left, hot_size = 0, n, HOT
    while True:
        _bring_up(q, residual, pending, squares, gone, pinned)
        pending[:] = 0.0
        hot, cold_error, cold_norm = _choose(squares, norms, hot_size)
        if len(hot) == 0:
            history[count], worst[count], largest[count] = here, -1, 0.0
            return history[: count + 1], worst[: count + 1], largest[: count + 1]
        hot_q, hot_residual = q[:, hot].copy(), residual[:, hot].copy()
        hot_squares, hot_rank = squares[hot].copy(), rank[hot].copy()
        drift = 0.0
        followed, here_left = 0, len(hot)
        while True:
            j = _worst(hot_squares, hot_rank, here_left)
            error = np.sqrt(hot_squares[j]) if j >= 0 else -np.inf
            if error - 2 * TIE_PX <= cold_error + cold_norm * drift:
                break
            followed += 1
            history[count] = here
            worst[count], largest[count] = hot[j], error
            count += 1
            if error <= stop:
                return history[:count], worst[:count], largest[:count]
            free = _direction(inverse, hot_q[:, j], z)
            if free < LEAST_FREEDOM or count == ROUNDS or left - 1 <= terms:
                return history[:count], worst[:count], largest[:count]
            fx, fy = hot_residual[0, j] / free, hot_residual[1, j] / free
            grown, drift = 0.0, 0.0
            for a in range(terms):
                pending[a, 0] += z[a] * fx
                pending[a, 1] += z[a] * fy
                here[a, 0] -= z[a] * fx
                here[a, 1] -= z[a] * fy
                drift += pending[a, 0] ** 2 + pending[a, 1] ** 2
                for b in range(terms):
                    inverse[a, b] += z[a] * z[b] / free
                grown = max(grown, inverse[a, a])
            if grown > LARGEST_INVERSE:
                return history[:count], worst[:count], largest[:count]
            drift = np.sqrt(drift)
            gone[hot[j]] = True
            left -= 1
            here_left -= 1
            _close_gap(j, here_left, hot, hot_q, hot_residual, hot_rank)
            _move(hot_q, hot_residual, hot_squares, z, fx, fy, part, here_left)
        # A bound that excludes too little is no use: follow more pairs, in the end all of them.
        hot_size = HOT if followed > 8 else 4 * hot_size


@njit(cache=True)
def _bring_up(q, residual, pending, squares, gone, pinned):  # type: ignore[no-untyped-def]
    """Apply the change of coefficients to all pairs; squares of those that cannot leave become -1."""
    terms, n = q.shape
    for a in range(terms):
        for i in range(n):
            residual[0, i] += pending[a, 0] * q[a, i]
            residual[1, i] += pending[a, 1] * q[a, i]
    for i in range(n):
        squares[i] = residual[0, i] ** 2 + residual[1, i] ** 2
        if gone[i] or pinned[i]:
            squares[i] = -1.0


@njit(cache=True)
def _choose(squares, norms, size):  # type: ignore[no-untyped-def]
    """Return the pairs to follow, and the largest error and norm among the others."""
    n = len(squares)
    floor = -0.5
    if size < (squares >= 0).sum():
        floor = np.partition(squares, n - size)[n - size]
    hot = np.flatnonzero(squares >= floor)
    cold_error, cold_norm = -np.inf, 0.0
    for i in range(n):
        if 0 <= squares[i] < floor:
            cold_error = max(cold_error, np.sqrt(squares[i]))
            cold_norm = max(cold_norm, norms[i])
    return hot, cold_error, cold_norm


@njit(cache=True)
def _worst(squares, rank, count):  # type: ignore[no-untyped-def]
    """Return the row with the largest square of the first `count`; among equals, that of the lowest rank."""
    peak = -1.0
    for i in range(count):
        if squares[i] > peak:
            peak = squares[i]
    floor = max(np.sqrt(max(peak, 0.0)) - TIE_PX, 0.0) ** 2
    j = -1
    for i in range(count):
        if squares[i] >= floor and (j < 0 or rank[i] < rank[j]):
            j = i
    return j


@njit(cache=True)
def _close_gap(j, last, hot, q, residual, rank):  # type: ignore[no-untyped-def]
    """Put the last of the pairs that are followed in the place of one that left."""
    hot[j], rank[j] = hot[last], rank[last]
    for a in range(len(q)):
        q[a, j] = q[a, last]
    for axis in range(2):
        residual[axis, j] = residual[axis, last]


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
def _move(q, residual, squares, z, fx, fy, part, count):  # type: ignore[no-untyped-def]
    """Move the residuals of the first `count` to the fit without the pair that left."""
    for i in range(count):
        part[i] = z[0] * q[0, i]
    for a in range(1, len(q)):
        for i in range(count):
            part[i] += z[a] * q[a, i]
    for i in range(count):
        residual[0, i] += part[i] * fx
        residual[1, i] += part[i] * fy
        squares[i] = residual[0, i] ** 2 + residual[1, i] ** 2

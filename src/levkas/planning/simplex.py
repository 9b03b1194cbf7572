"""A small dense linear program, so that a plan need not load a library of optimisers for one."""

from __future__ import annotations

import numpy as np

NUDGE = 1e-10
"""Added to the bounds, a little more to each: at corners where many bounds meet at once the method
could else go round in a circle."""


def maximise(goal: np.ndarray, table: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Return the x >= 0 with table·x <= bound that makes goal·x greatest.

    Parameters
    ----------
    goal : ndarray, (n,)
    table : ndarray, (m, n)
    bound : ndarray, (m,)
        >= 0, so that x = 0 is allowed; units of the order of 1.

    Returns
    -------
    x : ndarray, (n,)
        Keeps within the bounds to `NUDGE` times m.

    Raises
    ------
    ValueError
        Where a bound is negative, or goal·x can grow without end.

    Notes
    -----
    Dantzig's simplex method on the condensed tableau (Dantzig 1951): the steepest column enters, the
    tightest row leaves.

    Examples
    --------
    >>> maximise(np.array([3.0, 5.0]), np.array([[1.0, 0], [0, 2], [3, 2]]), np.array([4.0, 12, 18])).round(6)
    array([2., 6.])
    """
    if np.min(bound) < 0:
        raise ValueError("bounds must be 0 or more, so that x = 0 is allowed")
    m, n = table.shape
    t = np.zeros((m + 1, n + 1))
    t[:m, :n], t[m, :n] = table, -np.asarray(goal, float)
    t[:m, n] = bound + NUDGE * np.arange(1, m + 1)
    inside, outside = np.arange(n, n + m), np.arange(n)
    for _ in range(100 * (m + n)):
        column = int(t[m, :n].argmin())
        if t[m, column] > -1e-11:
            x = np.zeros(n + m)
            x[inside] = t[:m, n]
            return x[:n]
        rises = t[:m, column] > 1e-9
        if not rises.any():
            raise ValueError("the linear program has no greatest value")
        room = np.full(m, np.inf)
        room[rises] = t[:m, n][rises] / t[:m, column][rises]
        row = int(room.argmin())
        _exchange(t, row, column)
        inside[row], outside[column] = outside[column], inside[row]
    raise ValueError("the linear program goes round in a circle")


def _exchange(t: np.ndarray, row: int, column: int) -> None:
    """Let one variable enter the basis at `column` for the one that leaves at `row`."""
    pivot, across, down = t[row, column], t[row].copy(), t[:, column].copy()
    t -= np.outer(down, across / pivot)
    t[row], t[:, column] = across / pivot, -down / pivot
    t[row, column] = 1 / pivot

"""Pose clustering: the similarity on which most of many doubtful matches agree ([stockman1987]_).

A key point has a size and a direction. Two matches determine a similarity, and most pairs of wrong ones contradict the sizes and
directions of their own key points; so do most wrong matches that lie near a wrong similarity by chance. One right match in two
hundred is found where random samples of four are not: without it 3 of 13 pairs in unlike light are lost.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit

MOST_MATCHES, MOST_PROPOSING, MOST_PROPOSALS = 8000, 500, 6000
"""Matches that vote, the most alike ones; matches of which pairs propose; pairs that are tried."""
GROWTH, SLOPE = 1.5, float(np.tan(np.deg2rad(20)))
"""Factor of size, and slope of the angle (20 degrees), by which a key point may differ from a similarity."""
LEAST_APART, REACH = 0.05, 0.025
"""Shares of the reference's longer side: least distance of a pair, and how far a vote may lie off."""
LEAST_VOTES = 8
"""Places that have to agree."""


def find_pose_cluster(
    reference: np.ndarray,
    target: np.ndarray,
    growth: np.ndarray,
    turn: np.ndarray,
    likeness: np.ndarray,
    side: float,
) -> np.ndarray | None:
    """Return which matches, (n, 2) px each, agree with the similarity that has most votes, (n,) bool; None without one.

    `growth`, `turn` (degrees, modulo 180, for a negative turns it) and `likeness`, (n,), are as of `TentativeMatches`; of a mirrored pair y of the
    reference is negated. A place of either picture votes once. `side` is the reference's longer side, px.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> p, q = rng.uniform(0, 500, (2, 200, 2))
    >>> q[:14] = 2 * p[:14][:, ::-1] * (-1, 1) + (40, 7)     # two times, a quarter turn
    >>> found = find_pose_cluster(p, q, np.full(200, 2.0), np.full(200, 90.0), np.ones(200), 500)
    >>> bool(found[:14].all()), int(found.sum()) < 30
    (True, True)
    """
    if len(reference) < LEAST_VOTES:
        return None
    every = reference @ (1, 1j), target @ (1, 1j), np.exp(-1j * np.deg2rad(turn)) / growth
    chosen = np.sort(np.argsort(-likeness, kind="stable")[:MOST_MATCHES])
    p, q, own = (np.ascontiguousarray(one[chosen]) for one in every)
    compatible = _count_compatible(p, q, own, LEAST_APART * side)
    among = np.sort(np.argsort(-compatible, kind="stable")[:MOST_PROPOSING])
    first, second = (among[k] for k in np.triu_indices(len(among), 1))
    apart = np.abs(p[second] - p[first]) >= LEAST_APART * side
    first, second = first[apart], second[apart]
    factor = (q[second] - q[first]) / (p[second] - p[first])
    fits = np.flatnonzero(_is_alike(factor * own[first]) & _is_alike(factor * own[second]))
    if not len(fits):
        return None
    fits = fits[np.linspace(0, len(fits) - 1, min(len(fits), MOST_PROPOSALS)).astype(int)]
    factor, start = factor[fits], q[first[fits]] - factor[fits] * p[first[fits]]
    here, there = (np.unique(np.round(places), return_inverse=True)[1] for places in (p, q))
    votes = _count_votes((p, q, own), factor, start, here, there, REACH * side)
    best = int(votes.argmax())
    if votes[best] < LEAST_VOTES:
        return None
    off = np.abs(factor[best] * every[0] + start[best] - every[1])
    near = off < 1.5 * REACH * side * abs(factor[best])
    return np.asarray(near & _is_alike(factor[best] * every[2]))


def _is_alike(ratio: np.ndarray) -> np.ndarray:
    """Return whether similarities, over those of key points themselves, differ by less than 1.5 times and 20 degrees, modulo 180."""
    size = np.abs(ratio)
    steep = np.abs(ratio.imag) >= SLOPE * np.abs(ratio.real)
    return np.asarray((size > 1 / GROWTH) & (size < GROWTH) & ~steep)


@njit(inline="always")
def _alike(real, imag, own, unit):  # type: ignore[no-untyped-def]
    """Do as `_is_alike` for one similarity, given in units of `unit`, and a key point's own; no branch: several go at once."""
    x, y = real * own.real - imag * own.imag, real * own.imag + imag * own.real
    size, one = x * x + y * y, unit * unit
    within = (size > one / (GROWTH * GROWTH)) & (size < one * (GROWTH * GROWTH))
    return within & (abs(y) < SLOPE * abs(x))


@njit(cache=True)
def _count_compatible(p, q, own, apart):  # type: ignore[no-untyped-def]
    """Return with how many others each match makes a similarity that fits both."""
    compatible = np.zeros(len(p), np.int64)
    for i in range(len(p)):
        count = 0
        for j in range(i):
            span, other = p[j] - p[i], q[j] - q[i]
            square = span.real * span.real + span.imag * span.imag
            along = other.real * span.real + other.imag * span.imag
            across = other.imag * span.real - other.real * span.imag
            fits = (square >= apart * apart) & _alike(along, across, own[i], square)
            fits &= _alike(along, across, own[j], square)
            count += fits
            compatible[j] += fits
        compatible[i] += count
    return compatible


@njit(cache=True)
def _count_votes(matches, factors, starts, here, there, reach):  # type: ignore[no-untyped-def]
    """Return how many places of either picture agree with each similarity."""
    p, q, own = matches
    votes = np.zeros(len(factors), np.int64)
    ours, theirs = np.full(len(p), -1), np.full(len(p), -1)
    for k in range(len(factors)):
        factor = factors[k]
        limit = reach * abs(factor)
        m = n = 0
        for i in range(len(p)):
            off = factor * p[i] + starts[k] - q[i]
            if abs(off.real) > limit or abs(off.imag) > limit:
                continue
            if _alike(factor.real, factor.imag, own[i], 1.0):
                m += ours[here[i]] != k
                n += theirs[there[i]] != k
                ours[here[i]], theirs[there[i]] = k, k
        votes[k] = min(m, n)
    return votes

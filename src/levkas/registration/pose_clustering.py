"""Pose clustering: the similarity on which most of many doubtful matches agree ([stockman1987]_).

Pairs of matches propose similarities, and all matches vote.

A key point has a size and a direction. Two matches determine a similarity, and most pairs of
wrong ones contradict the sizes and directions of their own key points; so do most wrong matches that
lie near a wrong similarity by chance. One right match in two hundred is found where random samples
of four are not.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit

#: Matches that vote, the most similar ones; matches of which pairs propose; pairs that are tried.
MOST_MATCHES, MOST_PROPOSING, MOST_PROPOSALS = 8000, 500, 6000
#: Factor of size, and angle, by which a key point may differ from a similarity.
GROWTH, TURN = 1.5, np.deg2rad(20)
LEAST_SIZE, MOST_SIZE, SLOPE = GROWTH**-2, GROWTH**2, float(np.tan(TURN))
#: Shares of the reference's longer side: least distance of a pair, and how far a vote may lie off.
LEAST_APART, REACH = 0.05, 0.025
#: Places that have to agree.
LEAST_VOTES = 8


def find_pose_cluster(
    reference: np.ndarray,
    target: np.ndarray,
    growth: np.ndarray,
    turn: np.ndarray,
    likeness: np.ndarray,
    side: float,
) -> np.ndarray | None:
    """Return which matches agree with the similarity that has most votes, (n,) bool; None without one.

    Parameters
    ----------
    reference, target : ndarray, (n, 2)
        Matches; of a mirrored pair with y of `reference` negated. A place may have several.
    growth : ndarray, (n,)
        Size of the key point in the target over that in the reference.
    turn : ndarray, (n,), degrees
        Direction in the target less that in the reference; counts modulo 180, for a negative turns it.
    likeness : ndarray, (n,)
        Where there are too many matches, the most alike vote.
    side : float, px
        Of the reference: votes count within 2.5 % of it, and each place of either picture once.

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
    chosen = np.sort(np.argsort(-likeness, kind="stable")[:MOST_MATCHES])
    p, q = (np.ascontiguousarray(places[chosen] @ (1, 1j)) for places in (reference, target))
    own = growth[chosen] * np.exp(1j * np.deg2rad(turn[chosen]))
    compatible = _count_compatible(p, q, own, LEAST_APART * side)
    proposing = np.sort(np.argsort(-compatible, kind="stable")[:MOST_PROPOSING])
    first, second = _pair_up(p, q, own, proposing, LEAST_APART * side)
    if not len(first):
        return None
    here, there = (np.unique(np.round(places), return_inverse=True)[1] for places in (p, q))
    votes = _count_votes(p, q, own, first, second, here, there, REACH * side)
    best = int(votes.argmax())
    if votes[best] < LEAST_VOTES:
        return None
    factor = (q[second[best]] - q[first[best]]) / (p[second[best]] - p[first[best]])
    start = q[first[best]] - factor * p[first[best]]
    off = np.abs(factor * (reference @ (1, 1j)) + start - target @ (1, 1j))
    ratio = factor / (growth * np.exp(1j * np.deg2rad(turn)))
    alike = (np.abs(np.log(np.abs(ratio))) < np.log(GROWTH)) & (
        np.abs(ratio.imag) < np.tan(TURN) * np.abs(ratio.real)
    )
    return np.asarray((off < 1.5 * REACH * side * abs(factor)) & alike)


@njit(inline="always")
def _alike(ratio):  # type: ignore[no-untyped-def]
    """Return whether two similarities differ by less than 1.5 times and 20 degrees, modulo 180."""
    size = ratio.real * ratio.real + ratio.imag * ratio.imag
    return LEAST_SIZE < size < MOST_SIZE and abs(ratio.imag) < SLOPE * abs(ratio.real)


@njit(cache=True)
def _count_compatible(p, q, own, apart):  # type: ignore[no-untyped-def]
    """Return with how many others each match makes a similarity that fits both.

    In real numbers and without a branch, so that the compiler does several matches at a time.
    """
    px, py, qx, qy = p.real.copy(), p.imag.copy(), q.real.copy(), q.imag.copy()
    gx, gy = (1 / own).real.copy(), (1 / own).imag.copy()
    compatible = np.zeros(len(p), np.int64)
    for i in range(len(p)):
        count = 0
        for j in range(i):
            x, y, u, v = px[j] - px[i], py[j] - py[i], qx[j] - qx[i], qy[j] - qy[i]
            square = x * x + y * y
            along, across = u * x + v * y, v * x - u * y  # the similarity, times `square`
            fits = square >= apart * apart
            fits &= _is_alike(along, across, gx[i], gy[i], square * square)
            fits &= _is_alike(along, across, gx[j], gy[j], square * square)
            count += fits
            compatible[j] += fits
        compatible[i] += count
    return compatible


@njit(inline="always")
def _is_alike(along, across, gx, gy, unit):  # type: ignore[no-untyped-def]
    """Do as `_alike` for the product of two complex numbers given by their parts, in units of √`unit`."""
    real, imag = along * gx - across * gy, along * gy + across * gx
    size = real * real + imag * imag
    within = (size > LEAST_SIZE * unit) & (size < MOST_SIZE * unit)
    return within & (abs(imag) < SLOPE * abs(real))


@njit(cache=True)
def _pair_up(p, q, own, among, apart):  # type: ignore[no-untyped-def]
    """Return pairs of matches, evenly drawn, that make a similarity that fits the size and direction of both."""
    every = 1
    first, second = np.empty(MOST_PROPOSALS, np.int64), np.empty(MOST_PROPOSALS, np.int64)
    n = visited = 0
    for gap in range(1, len(among)):
        for a in range(len(among) - gap):
            i, j = among[a], among[a + gap]
            span = p[j] - p[i]
            if span.real * span.real + span.imag * span.imag < apart * apart:
                continue
            factor = (q[j] - q[i]) / span
            if not (_alike(factor / own[i]) and _alike(factor / own[j])):
                continue
            visited += 1
            if visited % every:
                continue
            if n == MOST_PROPOSALS:  # keep every second one, and go on half as densely
                n = MOST_PROPOSALS // 2
                first[:n], second[:n] = first[1::2].copy(), second[1::2].copy()
                every *= 2
            first[n], second[n] = i, j
            n += 1
    return first[:n], second[:n]


@njit(cache=True)
def _count_votes(p, q, own, first, second, here, there, reach):  # type: ignore[no-untyped-def]
    """Return how many places of either picture agree with the similarity of each pair."""
    votes, inverse = np.zeros(len(first), np.int64), 1 / own
    ours, theirs = np.full(len(p), -1), np.full(len(p), -1)
    for k in range(len(first)):
        factor = (q[second[k]] - q[first[k]]) / (p[second[k]] - p[first[k]])
        start = q[first[k]] - factor * p[first[k]]
        limit = reach * abs(factor)
        m = n = 0
        for i in range(len(p)):
            off = factor * p[i] + start - q[i]
            if abs(off.real) > limit or abs(off.imag) > limit or not _alike(factor * inverse[i]):
                continue
            m += ours[here[i]] != k
            n += theirs[there[i]] != k
            ours[here[i]], theirs[there[i]] = k, k
        votes[k] = min(m, n)
    return votes

"""The paper's removal of outliers replayed on pairs that are there already, by whatever method found.

What a build draws as Figures 9 and 10, and what the workbench answers each edit with.
"""

from __future__ import annotations

import numpy as np

from levkas.geometry.transforms import Affine, Transform
from levkas.registration.mirhashemi2019 import SETTINGS, scale_only
from levkas.registration.outliers import Cleaned, RemovalTerms, clean, cut

ORDERS = ((20, 3), (12, 2), (3, 1))
"""Least number of pairs, order of the polynomial that they carry."""
LEAST_STARTED = 0.9


def reject_of(size: tuple[int, int]) -> float:
    """Return the paper's T1 for a reference of `size`: 1/16 of its diagonal.

    >>> round(reject_of((1392, 1040)), 1)
    108.6
    """
    return float(np.hypot(*size)) * SETTINGS.reject_share


def order_of(count: int) -> int:
    """Return the order of the polynomial that `count` pairs carry, 0 for none.

    >>> [order_of(n) for n in (2, 4, 15, 400)]
    [0, 1, 2, 3]
    """
    return next((order for least, order in ORDERS if count >= least), 0)


def start_of(
    reference: np.ndarray,
    target: np.ndarray,
    kept: np.ndarray,
    *,
    size: tuple[int, int],
    target_size: tuple[int, int],
    reject: float,
) -> Transform:
    """Return the map target → reference under which pairs are cut.

    The paper's scale alone where nearly all kept pairs lie within `reject` under it; else, for a
    camera on its side, say, the affine map of the kept pairs.
    """
    scale = scale_only(size, target_size)
    if kept.sum() < 3:
        return scale
    near = cut(target[kept], reference[kept], scale, reject)[1]
    if near.mean() >= LEAST_STARTED:
        return scale
    return Affine.fit(target[kept], reference[kept])


def replay(
    reference: np.ndarray,
    target: np.ndarray,
    kept: np.ndarray,
    *,
    size: tuple[int, int],
    target_size: tuple[int, int],
    reject: float | None = None,
    stop: float = 1.0,
    sure: np.ndarray | None = None,
    dropped: np.ndarray | None = None,
) -> Cleaned:
    """Remove outliers anew from pairs, and keep the trace.

    Parameters
    ----------
    reference, target : ndarray, (n, 2)
        Reference px; native px of the target's sensor.
    kept : ndarray of bool, (n,)
        Pairs that the method kept: by them the start is chosen.
    size, target_size : (width, height)
    reject, stop : float, reference px
        T1 and T2 of the paper; its own T1 without one.
    sure, dropped : ndarray of bool, (n,), optional
        Pairs that never leave, and that are never used.

    Raises
    ------
    RegistrationRefused
        Where fewer than three pairs are left to fit.
    """
    reject = reject or reject_of(size)
    sure = np.zeros(len(kept), bool) if sure is None else sure
    dropped = np.zeros(len(kept), bool) if dropped is None else dropped
    begun = start_of(
        reference, target, (kept | sure) & ~dropped,
        size=size, target_size=target_size, reject=reject,
    )  # fmt: skip
    near = cut(target, reference, begun, reject)[1]
    count = int(((near | sure) & ~dropped).sum())
    return clean(
        target, reference, RemovalTerms(begun, reject, stop, max(order_of(count), 1)), size=size,
        target_size=target_size, pinned=sure, dropped=dropped,
    )  # fmt: skip

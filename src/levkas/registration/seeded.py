"""A start from pairs given by hand: where key points find none, or find another one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.geometry.transforms import Affine, Homography, Transform
from levkas.registration.initial import LONG_SIDE_PX, REACH_PX, Start, polish, rematch
from levkas.registration.manual_points import LEAST_TO_START, Given

if TYPE_CHECKING:
    from levkas.registration.key_points import KeyPictures

CONTRADICTION_SHARE = 0.01
LEAST_CONTRADICTION_PX = 8.0


def guide(
    found: Start | None, given: Given, reference: KeyPictures, target: KeyPictures
) -> Start | None:
    """Return the start that given pairs and key points together make.

    Parameters
    ----------
    found : Start or None
        By key points alone.
    given : Given
        Of this sensor.
    reference, target : KeyPictures

    Returns
    -------
    start : Start or None
        None where neither key points nor `LEAST_TO_START` given pairs say anything. Where most of
        the given pairs contradict what key points found, the person is believed.
    """
    sure = given.sure
    shape = reference.greys[0].shape
    if found is None or _contradicts(found, sure, shape):
        if len(sure) < LEAST_TO_START:
            return found
        found = _rematched(start_from(sure), reference, target)
    marked = given.mark(found.reference, found.target)
    if not (marked.reason != "").any():
        return found
    kept = np.zeros(len(marked.reason), bool)
    kept[: len(found.kept)] = found.kept
    kept = kept & ~marked.dropped | marked.sure
    p, q = marked.reference, marked.target
    first = replace(found, reference=p, target=q, kept=kept)
    return replace(polish(first, p, q, marked.sure, marked.dropped), reason=marked.reason)


def start_from(pairs: np.ndarray) -> Start:
    """Fit a start to pairs alone: the stiffest of similarity, affine and homography that fits.

    Parameters
    ----------
    pairs : ndarray, (n, 4), n >= 4
        Reference x, y and target x, y.

    Examples
    --------
    >>> corners = np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]])
    >>> begun = start_from(np.hstack([corners, 2 * corners + 1]))
    >>> begun.transform(np.array([[4.0, 5.0]])).round(6).tolist(), begun.mirrored
    ([[9.0, 11.0]], False)
    """
    p, q = pairs[:, :2], pairs[:, 2:]
    mirrored = bool(np.linalg.det(Affine.fit(p, q).matrix[:, :2]) < 0)
    chosen: Transform = _similarity(p, q, mirrored)
    scale = float(np.sqrt(abs(np.linalg.det(chosen.jacobian(p[:1])[0]))))
    for fit in (lambda: _similarity(p, q, mirrored), lambda: Affine.fit(p, q)):
        chosen = fit()
        if np.linalg.norm(chosen(p) - q, axis=1).max() <= REACH_PX * scale:
            return Start(chosen, p, q, np.ones(len(p), bool), mirrored)
    bent = _homography(p, q)
    return Start(bent or chosen, p, q, np.ones(len(p), bool), mirrored)


def _rematched(first: Start, reference: KeyPictures, target: KeyPictures) -> Start:
    """Let key points near where the pairs put them refine the start; most agreeing ones win."""
    best = first
    for side in (LONG_SIDE_PX, 2 * LONG_SIDE_PX):
        ours, theirs = reference.at(side), target.at(side)
        for i in range(len(reference.greys)):
            for j in range(len(target.greys)):
                tried = rematch(first, ours[i], theirs[j], ours.shape)
                if int(tried.kept.sum()) > max(int(best.kept.sum()), 3 * len(first.kept)):
                    best = tried
        if best is not first:
            break
    return best


def _contradicts(found: Start, sure: np.ndarray, shape: tuple[int, ...]) -> bool:
    if not len(sure):
        return False
    miss = np.linalg.norm(found.transform(sure[:, :2]) - sure[:, 2:], axis=1)
    scale = np.sqrt(np.abs(np.linalg.det(found.transform.jacobian(sure[:, :2]))))
    off = np.nan_to_num(miss / np.maximum(scale, 1e-9), nan=np.inf)
    return bool(np.median(off) > max(LEAST_CONTRADICTION_PX, CONTRADICTION_SHARE * max(shape)))


def _similarity(p: np.ndarray, q: np.ndarray, mirrored: bool) -> Affine:
    sign = -1.0 if mirrored else 1.0
    centre, middle = p.mean(0), q.mean(0)
    u, v = (p - centre).T
    one = np.stack([np.stack([u, -v * sign], 1), np.stack([v * sign, u], 1)], 1).reshape(-1, 2)
    a, b = np.linalg.lstsq(one, (q - middle).reshape(-1), rcond=None)[0]
    linear = np.array([[a, -b * sign], [b, a * sign]])
    return Affine(np.column_stack([linear, middle - linear @ centre]))


def _homography(p: np.ndarray, q: np.ndarray) -> Homography | None:
    """Direct linear transform on centred, scaled coordinates; None where it does not determine one."""

    def frame(points: np.ndarray) -> np.ndarray:
        centre = points.mean(0)
        spread = max(float(np.abs(points - centre).max()), 1e-9)
        return np.array(
            [[1 / spread, 0, -centre[0] / spread], [0, 1 / spread, -centre[1] / spread], [0, 0, 1]]
        )

    a, b = frame(p), frame(q)
    x, y = (p @ a[:2, :2].T + a[:2, 2]).T
    u, v = (q @ b[:2, :2].T + b[:2, 2]).T
    one, nil = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, nil, nil, nil, -u * x, -u * y, -u], 1),
            np.stack([nil, nil, nil, x, y, one, -v * x, -v * y, -v], 1),
        ]
    )
    matrix = np.linalg.inv(b) @ np.linalg.svd(rows)[2][-1].reshape(3, 3) @ a
    return Homography(matrix / matrix[2, 2]) if abs(matrix[2, 2]) > 1e-9 else None

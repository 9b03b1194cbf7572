"""What the windows of all bands of a sensor agree on, and the model that it supports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Transform
from levkas.registration.depth_steps import averaged
from levkas.registration.local_shifts import Windows
from levkas.registration.manual_points import HAND_PX
from levkas.registration.model_selection import Rung, climb
from levkas.registration.models import Observations, solve_pairs
from levkas.registration.predictors import cell_px
from levkas.registration.record import RegistrationRefused
from levkas.registration.task import Task

LEAST_WINDOWS = 12
#: Windows are three cells wide: those two cells apart still share one.
OVERLAP_CELLS = 2.01
#: The next window that shares no pixel with a window.
APART = 3


def fit_base(
    task: Task,
    base: Transform,
    seen: Sequence[Windows],
    step: int,
    *,
    coarse: bool = False,
    stiff: bool = False,
    among: np.ndarray | None = None,
    ledge: bool = False,
) -> Rung:
    """Return the base map that the windows of all bands support.

    Parameters
    ----------
    task : Task
    base : Transform
        Through which they were seen.
    seen : sequence of Windows
        One a band.
    step : int
        Reference px per px of the grid.
    coarse, stiff : bool
        As `coarse` and `reaching` of `climb`.
    among : ndarray of bool, (n,), optional
        Only of these windows.
    ledge : bool
        Whether a ledge may be looked for.

    Raises
    ------
    RegistrationRefused
        ``E_WINDOWS``, with fewer than 12.
    """
    common, information = combine(seen)
    centres = seen[0].centres
    used = usable(information) & (True if among is None else among)
    if used.sum() < LEAST_WINDOWS:
        raise RegistrationRefused(
            Problem(
                "E_WINDOWS",
                "too few windows of this sensor can be compared with the reference",
                found=int(used.sum()),
                expected=f"at least {LEAST_WINDOWS}",
                fix="The frames overlap too little, or the picture is too small.",
            )
        )
    points = centres[used]
    jacobian = base.jacobian(points)
    cell = float(task.scene.predictor(step).cell * step)
    target = averaged(base, points, cell) - np.einsum("nab,nb->na", jacobian, common[used])
    finite = np.isfinite(target).all(1)
    observations = Observations(points, target, jacobian, information[used]).part(finite)
    hand = _by_hand(task.given.sure, base)
    return climb(
        observations.joined(hand), spacing=4.0 * step * cell_px((0, 0)), apart=OVERLAP_CELLS * cell,
        cell=cell if ledge else 0.0, coarse=coarse, reaching=stiff, sure=len(hand),
        standing=base if coarse else None,
    )  # fmt: skip


def _by_hand(pairs: np.ndarray, base: Transform) -> Observations:
    """Given pairs as observations: they weigh as a place that a person points at is known."""
    jacobian = base.jacobian(pairs[:, :2])
    # A hand errs in either picture: by a px of the coarser one.
    scale = np.sqrt(np.abs(np.linalg.det(jacobian)))
    known = 1 / (HAND_PX**2 * (1 + 1 / np.maximum(scale, 1e-6) ** 2))
    information = known[:, None, None] * np.eye(2)
    finite = np.isfinite(jacobian).all((1, 2)) & np.isfinite(known)
    return Observations(pairs[:, :2], pairs[:, 2:], jacobian, information).part(finite)


def correction(before: Transform, after: Transform, centres: np.ndarray) -> np.ndarray:
    """Shift, reference px, that the step from one base map to the next takes care of."""
    miss = before(centres) - after(centres)
    return solve_pairs(before.jacobian(centres), miss)


def combine(seen: Sequence[Windows]) -> tuple[np.ndarray, np.ndarray]:
    """Return the shift of each window that all bands agree on, (n, 2), and its information.

    Bands are weighted by what they know; one that contradicts the others is turned down.
    """
    shifts = np.stack([w.shift for w in seen])
    information = np.stack([w.information for w in seen])
    weights = np.ones(shifts.shape[:2])
    for _ in range(4 if len(seen) > 2 else 1):
        scaled = information * weights[..., None, None]
        total = scaled.sum(0)
        common = np.einsum(
            "nab,nb->na",
            np.linalg.inv(total + 1e-9 * np.eye(2)),
            np.einsum("bnac,bnc->na", scaled, shifts),
        )
        apart = shifts - common
        distance = np.einsum("bna,bnac,bnc->bn", apart, information, apart)
        used = np.trace(information, axis1=2, axis2=3) > 0
        typical = np.median(distance[used]) / 1.386 + 1e-12 if used.any() else 1.0
        weights = 1 / (1 + distance / (4 * typical))
    return common, total


def knowledge(seen: Sequence[Windows]) -> float | None:
    """Return what the windows of all bands know together, 1/px², by how neighbours scatter.

    A window is compared with the mean of those on either side of it that share no pixel with it: what
    is smooth cancels, whatever model would follow it, and the median takes no notice of a ledge. None
    where the picture is too small for that.
    """
    common, information = combine(seen)
    x, y = (np.unique(seen[0].centres[:, axis], return_inverse=True)[1] for axis in (0, 1))
    lattice = (int(y.max()) + 1, int(x.max()) + 1)
    shifts, known = np.zeros((*lattice, 2)), np.zeros((*lattice, 2, 2))
    shifts[y, x], known[y, x] = common, information
    distances = []
    for axis in (0, 1):
        there = usable(known.reshape(-1, 2, 2)).reshape(lattice)
        middle, low, high = (
            tuple(part if k == axis else slice(None) for k in (0, 1))
            for part in (slice(APART, -APART), slice(-2 * APART), slice(2 * APART, None))
        )
        every = there[middle] & there[low] & there[high]
        miss = (shifts[middle] - (shifts[low] + shifts[high]) / 2)[every]
        variances = [
            np.linalg.inv(known[of][every] + 1e-9 * np.eye(2)) for of in (middle, low, high)
        ]
        doubt = variances[0] + (variances[1] + variances[2]) / 4
        distances.append(np.einsum("na,na->n", miss, solve_pairs(doubt, miss)))
    found = np.concatenate(distances)
    if len(found) < LEAST_WINDOWS:
        return None
    typical = np.median(found) / 1.386 + 1e-12
    return float(np.trace(information, axis1=1, axis2=2).sum() / typical)


def usable(information: np.ndarray) -> np.ndarray:
    """Tell which windows know anything, (n,) bool."""
    return np.asarray(np.trace(information, axis1=1, axis2=2) > 0)


def noted(rung: Rung, step: int) -> dict[str, Any]:
    """What the ladder saw in one step: held-out error of every model, reference px."""
    return {
        "step": step,
        "windows": len(rung.observations),
        "model": rung.name,
        "held_out_px": {name: round(float(score), 5) for name, score in rung.scores.items()},
    }

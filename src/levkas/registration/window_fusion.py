"""Fusing the windows of all bands of a sensor, and the base map that the fused shifts support."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from levkas.geometry.transforms import Transform, solve_2x2
from levkas.registration.advice import POINTS
from levkas.registration.depth_step import average_over_windows
from levkas.registration.local_shifts import WindowShifts
from levkas.registration.manual_points import HAND_PX
from levkas.registration.model_selection import SelectedModel, SelectionTerms, select_model
from levkas.registration.models import Observations
from levkas.registration.predictors import cell_px
from levkas.registration.record import refusal

#: Median of a χ² distribution with two degrees of freedom.
CHI2_MEDIAN = 1.386


@dataclass(frozen=True)
class FusionSettings:
    """Constants of the fusion."""

    least_windows: int = 12
    """Fewer windows determine no base map."""
    overlap: float = 2.01
    """In cells: windows are three cells wide: those two cells apart still share one."""
    apart: int = 3
    """In cells: the next window that shares no pixel with a window."""
    rounds: int = 4
    """Of re-weighting bands against one another, where there are more than two."""
    spacing: float = 4.0
    """In cells: of the knots of a spline."""


SETTINGS = FusionSettings()


def fit_base(
    base: Transform,
    windows: Sequence[WindowShifts],
    by_hand: np.ndarray,
    step: int,
    cell: float,
    terms: SelectionTerms,
    among: np.ndarray | None = None,
) -> SelectedModel:
    """Return the base map that the windows of all bands support.

    They were measured through `base` on a grid of `step` reference px, `cell` reference px a cell; one `WindowShifts` a band.
    `by_hand`, (n, 4), are pairs that are never removed; `among`, (n,) bool, leaves windows out. Raises RegistrationRefused
    (``E_WINDOWS``) with fewer than 12.
    """
    common, information = fuse_windows(windows)
    used = has_information(information) & (True if among is None else among)
    if used.sum() < SETTINGS.least_windows:
        raise refusal(
            "E_WINDOWS",
            "too few windows of this sensor match the reference",
            found=int(used.sum()),
            expected=f"at least {SETTINGS.least_windows}",
            fix=f"Check that the frames overlap and that the picture is large enough; if so, {POINTS}.",
        )
    points = windows[0].centres[used]
    jacobian = base.jacobian(points)
    target = average_over_windows(base, points, cell) - np.einsum(
        "nab,nb->na", jacobian, common[used]
    )
    finite = np.isfinite(target).all(1)
    observations = Observations(points, target, jacobian, information[used]).part(finite)
    hand = _observed_by_hand(by_hand, base)
    terms = replace(
        terms, spacing=SETTINGS.spacing * step * cell_px((0, 0)), apart=SETTINGS.overlap * cell,
        cell=cell if terms.depth_step else 0.0, fixed=len(hand),
    )  # fmt: skip
    return select_model(observations.joined(hand), terms, standing=base if terms.coarse else None)


def _observed_by_hand(pairs: np.ndarray, base: Transform) -> Observations:
    """Return pairs by hand as observations, weighted by how exactly a person points at a place."""
    jacobian = base.jacobian(pairs[:, :2])
    # A hand errs in either picture: by a px of the coarser one.
    scale = np.sqrt(np.abs(np.linalg.det(jacobian)))
    known = 1 / (HAND_PX**2 * (1 + 1 / np.maximum(scale, 1e-6) ** 2))
    information = known[:, None, None] * np.eye(2)
    finite = np.isfinite(jacobian).all((1, 2)) & np.isfinite(known)
    return Observations(pairs[:, :2], pairs[:, 2:], jacobian, information).part(finite)


def base_change(before: Transform, after: Transform, centres: np.ndarray) -> np.ndarray:
    """Return the shift, (n, 2) reference px, by which one base map differs from the next."""
    miss = before(centres) - after(centres)
    return solve_2x2(before.jacobian(centres), miss)


def fuse_windows(windows: Sequence[WindowShifts]) -> tuple[np.ndarray, np.ndarray]:
    """Return the fused shift of each window, (n, 2) reference px, and its information, (n, 2, 2) 1/px².

    The bands' shifts are averaged with their information as weights, re-weighted (Cauchy) so that a
    band which contradicts the others counts less.
    """
    shifts = np.stack([w.shift for w in windows])
    information = np.stack([w.information for w in windows])
    moments = np.einsum("bnac,bnc->bna", information, shifts)
    p, q, r = information[..., 0, 0], information[..., 0, 1], information[..., 1, 1]
    used, weights = p + r > 0, np.ones(shifts.shape[:2])
    for _ in range(SETTINGS.rounds if len(windows) > 2 else 1):
        total = np.einsum("bn,bnac->nac", weights, information)
        moment = np.einsum("bn,bna->na", weights, moments)
        common = solve_2x2(total + 1e-9 * np.eye(2), moment)
        x, y = np.moveaxis(shifts - common, -1, 0)
        distance = p * x * x + 2 * q * x * y + r * y * y
        typical = np.median(distance[used]) / CHI2_MEDIAN + 1e-12 if used.any() else 1.0
        weights = 1 / (1 + distance / (4 * typical))
    return common, total


def total_information(windows: Sequence[WindowShifts]) -> float | None:
    """Return the information of all windows and bands together, 1/px², by how neighbours scatter.

    A window is compared with the mean of those on either side of it that share no pixel with it: what
    is smooth cancels, whatever model would follow it, and the median is blind to a step in depth. None
    where the picture is too small for that.
    """
    common, information = fuse_windows(windows)
    x, y = (np.unique(windows[0].centres[:, axis], return_inverse=True)[1] for axis in (0, 1))
    lattice = (int(y.max()) + 1, int(x.max()) + 1)
    shifts, known = np.zeros((*lattice, 2)), np.zeros((*lattice, 2, 2))
    shifts[y, x], known[y, x] = common, information
    distances, apart = [], SETTINGS.apart
    for turn in (False, True):
        if turn:
            shifts, known = shifts.swapaxes(0, 1), known.swapaxes(0, 1)
        parts = slice(apart, -apart), slice(-2 * apart), slice(2 * apart, None)
        middle, low, high = (shifts[part] for part in parts)
        every = np.logical_and.reduce([known[part].any((2, 3)) for part in parts])
        miss = (middle - (low + high) / 2)[every]
        variances = [np.linalg.inv(known[part][every] + 1e-9 * np.eye(2)) for part in parts]
        expected = variances[0] + (variances[1] + variances[2]) / 4
        distances.append(np.einsum("na,na->n", miss, solve_2x2(expected, miss)))
    found = np.concatenate(distances)
    if len(found) < SETTINGS.least_windows:
        return None
    typical = np.median(found) / CHI2_MEDIAN + 1e-12
    return float(np.trace(information, axis1=1, axis2=2).sum() / typical)


def has_information(information: np.ndarray) -> np.ndarray:
    """Return which windows, (n, 2, 2), carry any information, (n,) bool."""
    return np.asarray(np.trace(information, axis1=1, axis2=2) > 0)

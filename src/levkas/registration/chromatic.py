"""The bands of one camera against its base map: low-order fields, smooth in wavelength.

A lens magnifies every wavelength a little differently, a filter wheel shifts every band by its
own wedge. Each band gets the same few displacement fields; how many is chosen on held-out blocks,
and their amounts are drawn to what the neighbouring wavelengths say as far as the data allow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.registration.models import temper
from levkas.registration.refinement import Windows
from levkas.transforms import Polynomial, design_matrix

FOLDS = 4
BLOCKS = 8
LENGTHS_NM = (60.0, 120.0, 240.0, 480.0)
GAIN = 0.002

# Columns of a cubic polynomial: 1 u v uu uv vv uuu uuv uvv vvv; rows below are (x′, y′) of each.
_FIELDS: list[tuple[str, list[dict[tuple[int, int], float]]]] = [
    ("shift", [{(0, 0): 1}, {(0, 1): 1}]),
    ("similarity", [{(1, 0): 1, (2, 1): 1}, {(2, 0): -1, (1, 1): 1}]),
    ("affine", [{(1, 0): 1, (2, 1): -1}, {(2, 0): 1, (1, 1): 1}]),
    ("radial", [{(6, 0): 1, (8, 0): 1, (7, 1): 1, (9, 1): 1}]),
    ("quadratic", [{(k, a): 1} for k in (3, 4, 5) for a in (0, 1)]),
    ("cubic", [{(k, a): 1} for k in (6, 7, 8) for a in (0, 1)] + [{(9, 0): 1}]),
]
KINDS = [name for name, _ in _FIELDS]


@dataclass(frozen=True)
class Chromatic:
    """Displacements of every band, in one frame.

    Parameters
    ----------
    kind : str
        The richest fields that were taken, a key of the ladder of this file.
    centre, spread : (2,) and float, reference px
    amounts : ndarray, (bands, fields), px
    scores : dict of str to float
        Held-out error of each kind, reference px.
    """

    kind: str
    centre: np.ndarray
    spread: float
    amounts: np.ndarray
    scores: dict[str, float]

    def transform(self, band: int) -> Polynomial:
        """Return reference px ↦ where the base map has to be asked for this band."""
        coefficients = np.einsum("f,fka->ka", self.amounts[band], _tensor(self.amounts.shape[1]))
        coefficients[1:3] += self.spread * np.eye(2)
        coefficients[0] += self.centre
        return Polynomial(3, self.centre, self.spread, coefficients)


def still(bands: int, centre: np.ndarray, spread: float) -> Chromatic:
    """Return no displacement at all."""
    return Chromatic("shift", centre, spread, np.zeros((bands, 2)), {})


def fit_chromatic(
    seen: Sequence[Windows],
    before: Chromatic,
    wavelengths: Sequence[float],
    *,
    common: np.ndarray | None = None,
    highest: str = "cubic",
    fixed: int | None = None,
) -> Chromatic:
    """Return `before` corrected by what the windows of each band saw.

    Parameters
    ----------
    seen : one `Windows` a band, all on the same lattice
    before : Chromatic
        What the windows were warped with.
    wavelengths : nm, NaN where unknown
    common : ndarray, (n, 2), px, optional
        Shift of each window that the base map takes care of.
    highest : str
        The richest kind that may be tried.
    fixed : int, optional
        The band that all else is relative to: its own amounts are taken from every band.
    """
    names = KINDS[: KINDS.index(highest) + 1]
    count = sum(len(f) for name, f in _FIELDS if name in names)
    earlier = np.zeros((len(seen), count))
    width = min(count, before.amounts.shape[1])
    earlier[:, :width] = before.amounts[:, :width]
    systems = [_system(w, before, count, earlier[i], common) for i, w in enumerate(seen)]
    kind, scores = _choose(systems, names)
    size = _size(kind)
    amounts, covariances = _amounts(systems, size)
    if fixed is not None:
        amounts = amounts - amounts[fixed]
    return Chromatic(
        kind,
        before.centre,
        before.spread,
        _smooth(amounts, covariances, wavelengths, fixed),
        scores,
    )


def _size(kind: str) -> int:
    return sum(len(fields) for _, fields in _FIELDS[: KINDS.index(kind) + 1])


def _tensor(count: int) -> np.ndarray:
    fields = [field for _, group in _FIELDS for field in group][:count]
    tensor = np.zeros((count, 10, 2))
    for f, field in enumerate(fields):
        for (k, axis), value in field.items():
            tensor[f, k, axis] = value
    return tensor


def _system(
    windows: Windows, before: Chromatic, count: int, earlier: np.ndarray, common: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and right side of each fold: (folds, f, f) and (folds, f), amounts in total."""
    terms = design_matrix(windows.centres, 3, before.centre, before.spread)
    design = np.einsum("nk,fka->naf", terms, _tensor(count))
    shift = windows.shift if common is None else windows.shift - common
    goal = np.einsum("naf,f->na", design, earlier) - shift
    used = np.trace(windows.information, axis1=1, axis2=2) > 0
    matrix, right = np.zeros((FOLDS, count, count)), np.zeros((FOLDS, count))
    if used.sum() < 12:
        return matrix, right
    design, goal = design[used], goal[used]
    information = _reweighted(design, goal, windows.information[used])
    folds = _folds(windows.centres)[used]
    for fold in range(FOLDS):
        here = folds == fold
        matrix[fold] = np.einsum("naf,nab,nbg->fg", design[here], information[here], design[here])
        right[fold] = np.einsum("naf,nab,nb->f", design[here], information[here], goal[here])
    return matrix, right


def _reweighted(design: np.ndarray, goal: np.ndarray, information: np.ndarray) -> np.ndarray:
    current = information
    for _ in range(5):
        matrix = np.einsum("naf,nab,nbg->fg", design, current, design)
        right = np.einsum("naf,nab,nb->f", design, current, goal)
        residual = goal - design @ _solve(matrix, right)
        floored, weights = temper(residual, information)
        current = floored * weights[:, None, None]
    return current


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    solved = np.linalg.lstsq(matrix * scale[:, None] * scale, right * scale, rcond=1e-10)[0]
    return solved * scale


def _folds(points: np.ndarray) -> np.ndarray:
    low, high = points.min(0), points.max(0)
    block = ((points - low) / max(float((high - low).max()) / BLOCKS, 1e-9)).astype(int)
    return (block[:, 0] + 2 * block[:, 1]) % FOLDS


def _choose(
    systems: Sequence[tuple[np.ndarray, np.ndarray]], names: Sequence[str]
) -> tuple[str, dict[str, float]]:
    """Held-out gain of each kind over no displacement, from the normal systems alone."""
    scores: dict[str, float] = {}
    best, taken = np.inf, names[0]
    for name in names:
        size, loss = _size(name), 0.0
        for matrix, right in systems:
            whole_matrix, whole_right = matrix.sum(0), right.sum(0)
            for fold in range(FOLDS):
                rest = (whole_matrix - matrix[fold])[:size, :size]
                amounts = _solve(rest, (whole_right - right[fold])[:size])
                loss += amounts @ matrix[fold][:size, :size] @ amounts
                loss -= 2 * amounts @ right[fold][:size]
        scores[name] = float(loss)
        if loss < best - GAIN * abs(best if np.isfinite(best) else 0.0):
            best, taken = loss, name
    return taken, scores


def _amounts(
    systems: Sequence[tuple[np.ndarray, np.ndarray]], size: int
) -> tuple[np.ndarray, np.ndarray]:
    amounts = np.zeros((len(systems), size))
    covariances = np.full((len(systems), size), np.inf)
    for band, (matrix, right) in enumerate(systems):
        whole = matrix.sum(0)[:size, :size]
        if not whole.any():
            continue
        amounts[band] = _solve(whole, right.sum(0)[:size])
        scale = 1 / np.sqrt(np.maximum(np.diag(whole), 1e-30))
        inverse = np.linalg.pinv(whole * scale[:, None] * scale, rcond=1e-10, hermitian=True)
        covariances[band] = np.diag(inverse) * scale**2
    return amounts, covariances


def _smooth(
    amounts: np.ndarray, variances: np.ndarray, wavelengths: Sequence[float], fixed: int | None
) -> np.ndarray:
    """Draw each amount to what the other bands say: Gaussian process, its scales from the data."""
    places = np.asarray(wavelengths, float)
    smooth = np.isfinite(places).all() and len(np.unique(places)) >= 4
    result = amounts.copy()
    if fixed is not None:
        variances = variances.copy()
        variances[fixed] = 1e-12
    for column in range(amounts.shape[1]):
        y, noise = amounts[:, column], np.minimum(variances[:, column], 1e6)
        if len(y) >= 4:
            result[:, column] = _posterior(y, noise, places if smooth else None)
        elif not np.isfinite(variances[:, column]).all():
            known = np.isfinite(variances[:, column])
            result[~known, column] = y[known].mean() if known.any() else 0.0
    if fixed is not None:
        result = result - result[fixed]
    return result


def _posterior(y: np.ndarray, noise: np.ndarray, places: np.ndarray | None) -> np.ndarray:
    known = noise < 1e5
    if known.sum() < 3:
        return np.where(known, y, y[known].mean() if known.any() else 0.0)
    size = max(float(np.var(y[known])), 1e-12)
    common = 100 * size * np.ones((len(y), len(y)))
    best, answer = -np.inf, y
    lengths: tuple[float, ...] = LENGTHS_NM if places is not None else (0.0,)
    for length in lengths:
        if places is not None:
            apart = (places[:, None] - places) / length
            bend = np.exp(-0.5 * apart**2)
        else:
            bend = np.zeros((len(y), len(y)))
        for smooth in (0.0, 0.3, 1.0, 3.0, 10.0) if places is not None else (0.0,):
            for rough in (0.0, 0.01, 0.1, 0.5, 1.0):
                prior = common + size * (smooth * bend + rough * np.eye(len(y)))
                total = prior + np.diag(noise)
                part = total[np.ix_(known, known)]
                solved = np.linalg.solve(part, y[known])
                likelihood = -0.5 * (y[known] @ solved + np.linalg.slogdet(part)[1])
                if likelihood > best:
                    best, answer = likelihood, prior[:, known] @ solved
    return answer

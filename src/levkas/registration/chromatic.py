"""Lateral chromatic aberration: the bands of one camera against its base map.

A lens magnifies every wavelength a little differently, a filter wheel shifts every band by its own wedge.
Each band is displaced by the same few fields, shift and magnification freely, others with a prior that
they are small. The amounts of each field are a Gaussian process over wavelength ([rasmussen2006]_): a constant,
a squared exponential and a part of each band's own, with scales of the highest marginal likelihood.

Lateral colour is smooth in wavelength, so that every n-th of many bands predicts those between. That is not taken on trust: a band that
was moved between two shots is found by the bands beside it, and where measured bands do not predict one another all are measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from levkas.core.threads import each
from levkas.geometry.transforms import Polynomial, design_matrix
from levkas.registration.bands import BandImage
from levkas.registration.local_shifts import Predictor, WindowShifts, reduce
from levkas.registration.models import inflate_covariance
from levkas.registration.predictors import measure_shifts, principal_components

BLOCKS = 8
"""Across the longer side, in which the gradients of windows are summed."""
LEAST_WINDOWS, ROUNDS = 12, 6
"""Windows of a band, with fewer of which it takes its shift from the other bands; rounds of re-weighting them."""
LENGTHS, SMOOTH, OWN = (80.0, 200.0, 500.0), (1.0, 10.0), (0.0, 0.01, 0.1, 1.0)
"""Scales that are tried: correlation lengths over wavelength, nm; variances of the smooth part, beside none at all, and of each band's
own, in units of the amounts' mean square."""
LEAST_BANDS = 4
"""Of different wavelengths from which amounts are smoothed."""
LEAST_VARIANCE = 1e-10
"""Of an amount, px²."""
LEAST_MEASURED = 25
"""Bands that are measured at the least, where there are twice as many."""
SMOOTH_PX, STRAY_PX = 0.02, 0.1
"""Largest error, reference px, at which neighbours predict a measured band, so that others need not be; distance, native px, from the
bands beside it at which a band is measured itself."""
SMALL_PX, CELL_PX = 256, 12
"""Longer side, px, of the pictures in which such bands are looked for, and the cell of their windows."""
FIELDS: dict[str, list[dict[tuple[int, int], int]]] = {
    "shift": [{(0, 0): 1}, {(0, 1): 1}],
    "similarity": [{(1, 0): 1, (2, 1): 1}, {(2, 0): -1, (1, 1): 1}],
    "affine": [{(1, 0): 1, (2, 1): -1}, {(2, 0): 1, (1, 1): 1}],
    "radial": [{(6, 0): 1, (8, 0): 1, (7, 1): 1, (9, 1): 1}],
    "quadratic": [{(k, a): 1} for k in (3, 4, 5) for a in (0, 1)],
    "cubic": [{(k, a): 1} for k in (6, 7, 8) for a in (0, 1)] + [{(9, 0): 1}],
}
"""Kind → its fields, each by (column of a cubic polynomial 1 u v uu uv vv uuu uuv uvv vvv, x′ or y′) → coefficient."""
KINDS = list(FIELDS)
SHARES = {"affine": 0.1, "radial": 0.2, "quadratic": 0.03, "cubic": 0.03}
"""How large a field is expected to be beside shift and magnification, which are as the data say."""


@dataclass(frozen=True)
class ChromaticShifts:
    """Displacements of every band, in one frame."""

    kind: str
    """The richest fields that were taken, of `KINDS`."""
    centre: np.ndarray
    spread: float
    """`centre`, `spread`: reference px."""
    amounts: np.ndarray
    """(bands, fields), px."""
    variances: np.ndarray | None = None
    """(bands, fields), px², or None. Of the amounts; None where nothing was fitted."""

    def variance(self, band: int, points: np.ndarray) -> np.ndarray:
        """Return the variance of a band's displacement at `points`, (n,) px², mean of both axes."""
        if self.variances is None:
            return np.zeros(len(points))
        terms = design_matrix(points, 3, self.centre, self.spread)
        fields = np.einsum("nk,fka->anf", terms, _tensor(self.variances.shape[1]))
        return np.asarray((fields**2).mean(0) @ self.variances[band])

    def transform(self, band: int) -> Polynomial:
        """Return the map from reference px to where the base map is evaluated for this band."""
        coefficients = np.einsum("f,fka->ka", self.amounts[band], _tensor(self.amounts.shape[1]))
        coefficients[1:3] += self.spread * np.eye(2)
        coefficients[0] += self.centre
        return Polynomial(3, self.centre, self.spread, coefficients)


def zero_displacement(bands: int, centre: np.ndarray, spread: float) -> ChromaticShifts:
    """Return no displacement at all."""
    return ChromaticShifts("shift", centre, spread, np.zeros((bands, 2)))


def fit_chromatic(
    windows: Sequence[WindowShifts],
    before: ChromaticShifts,
    wavelengths: Sequence[float],
    *,
    common: np.ndarray | None = None,
    highest: str = "cubic",
    fixed: int | None = None,
    sensitivity: np.ndarray | None = None,
) -> ChromaticShifts:
    """Return `before`, with which they were warped, corrected by what the windows of each band, all on one lattice, saw.

    `wavelengths` are nm, NaN where unknown; `common`, (n, 2) px, is the shift of each window that the base map takes care of; `highest` is the
    richest kind of fields; the band `fixed` stays where it is, and all else is relative to it. `sensitivity`, (bands, bands), says how the
    position of each band's prediction hangs on those of the bands: what a window sees is the band's shift less theirs. Without it
    predictions are taken to be where they should.
    """
    names = KINDS[: KINDS.index(highest) + 1]
    count = _size(names[-1])
    earlier = np.zeros((len(windows), count))
    width = min(count, before.amounts.shape[1])
    earlier[:, :width] = before.amounts[:, :width]
    terms = design_matrix(windows[0].centres, 3, before.centre, before.spread)
    design = np.einsum("nk,fka->naf", terms, _tensor(count))
    systems = each(lambda w, e: _system(w, design, e, common), windows, earlier)
    free = min(count, _size("similarity"))
    apart = np.eye(len(windows)) - (0.0 if sensitivity is None else sensitivity)
    # Bands differ by shift and magnification first; other fields are small beside them.
    prior = np.zeros(free)
    for _ in range(1 + (count > free)):
        measured, variances = _amounts(systems, prior, earlier, apart)
        amounts, doubts = _smooth(measured, variances, wavelengths, fixed, apart, prior)
        size = float(np.sqrt(np.mean(amounts**2) * free))
        prices = {name: (share * size + 1e-4) ** -2 for name, share in SHARES.items()}
        prior = np.array([prices.get(name, 0.0) for name in names for _ in FIELDS[name]])
    return ChromaticShifts(names[-1], before.centre, before.spread, amounts, doubts)


def interpolate_chromatic(
    shifts: ChromaticShifts, measured: Sequence[float], wanted: Sequence[float]
) -> ChromaticShifts:
    """Return the displacements of bands at the `wanted` wavelengths, nm, from those of the `measured` ones, by the same process over wavelength.

    Examples
    --------
    >>> nm = np.arange(400.0, 701.0, 20.0)
    >>> one = ChromaticShifts("shift", np.zeros(2), 1.0, np.stack([nm / 1000, nm / 500], 1), np.full((16, 2), 1e-6))
    >>> interpolate_chromatic(one, nm, [450.0]).amounts.round(3)
    array([[0.45, 0.9 ]])
    """
    places = np.concatenate([np.asarray(measured, float), np.asarray(wanted, float)])
    selection = np.eye(len(measured), len(places))
    bends = _correlations(selection, places)
    known = shifts.variances if shifts.variances is not None else np.zeros_like(shifts.amounts)
    amounts, doubts = np.zeros((2, len(wanted), shifts.amounts.shape[1]))
    for column, y in enumerate(shifts.amounts.T):
        noise = LEAST_VARIANCE + known[:, column]
        mean, variance = _posterior(y, noise, selection, bends, 0.0)
        amounts[:, column], doubts[:, column] = mean[len(y) :], variance[len(y) :]
    return replace(shifts, amounts=amounts, variances=doubts)


def error_between_bands(shifts: ChromaticShifts, wavelengths: Sequence[float]) -> float:
    """Return the error, px, of predicting every other band from its neighbours.

    The root mean square over the frame, of the band that lies farthest. What remains is twice as coarse as what
    was measured: bands between measured ones are known better than that.
    """
    nm = np.asarray(wavelengths, float)
    kept, left = np.arange(len(nm)) % 2 == 0, np.arange(len(nm)) % 2 == 1
    left[-1], kept[-1] = False, True
    variances = None if shifts.variances is None else shifts.variances[kept]
    half = replace(shifts, amounts=shifts.amounts[kept], variances=variances)
    between = interpolate_chromatic(half, nm[kept], nm[left])
    x, y = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    points = shifts.centre + shifts.spread * np.stack([x, y], -1).reshape(-1, 2)
    apart = [
        shifts.transform(band)(points) - between.transform(i)(points)
        for i, band in enumerate(np.flatnonzero(left).tolist())
    ]
    return max(float(np.sqrt((one**2).sum(1).mean())) for one in apart)


def _size(kind: str) -> int:
    return sum(len(FIELDS[name]) for name in KINDS[: KINDS.index(kind) + 1])


def _tensor(count: int) -> np.ndarray:
    """Return the coefficients of the first fields, (fields, 10, 2)."""
    tensor = np.zeros((count, 10, 2))
    for f, field in enumerate([field for group in FIELDS.values() for field in group][:count]):
        for place, value in field.items():
            tensor[f][place] = value
    return tensor


def _system(
    windows: WindowShifts, design: np.ndarray, earlier: np.ndarray, common: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return normal matrix (f, f) and right side (f,) of a band's total amounts; `design` is (n, 2, f).

    What a prediction gets wrong pulls all windows along a stroke or a patch the same way. The
    matrix is deflated until the gradients of whole blocks scatter as it says they should.
    """
    count = len(earlier)
    used = np.trace(windows.information, axis1=1, axis2=2) > 0
    if used.sum() < LEAST_WINDOWS:
        return np.zeros((count, count)), np.zeros(count)
    design = design[used]
    shift = windows.shift if common is None else windows.shift - common
    goal = design @ earlier - shift[used]
    size = min(count, _size("similarity"))
    lean, given = design[..., :size], windows.information[used]
    information, residual = given, goal
    for _ in range(ROUNDS):
        matrix, right = _normal(lean, information, goal)
        residual = goal - lean @ (_inverse(matrix) @ right)
        floored, weights = inflate_covariance(residual, given)
        information = floored * weights[:, None, None]
    matrix, right = _normal(design, information, goal)
    gradients = np.einsum("naf,nab,nb->nf", lean, information, residual)
    points = windows.centres[used]
    low, high = points.min(0), points.max(0)
    cell = ((points - low) / max(float((high - low).max()) / BLOCKS, 1e-9)).astype(int)
    summed = np.zeros(((BLOCKS + 1) ** 2, size))
    np.add.at(summed, cell @ (1, BLOCKS + 1), gradients)
    scatter = np.trace(np.linalg.pinv(matrix[:size, :size]) @ (summed.T @ summed))
    deflate = max(float(scatter) / size, 1.0)
    return matrix / deflate, right / deflate


def _normal(
    design: np.ndarray, information: np.ndarray, goal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return normal matrix and right side of `design`, (n, 2, count), under weights, (n, 2, 2)."""
    weighted = (information @ design).reshape(-1, design.shape[2])
    return weighted.T @ design.reshape(weighted.shape), weighted.T @ goal.reshape(-1)


def _inverse(matrix: np.ndarray) -> np.ndarray:
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    scale = scale[:, None] * scale
    return np.asarray(np.linalg.pinv(matrix * scale, rcond=1e-10, hermitian=True) * scale)


def _amounts(
    systems: Sequence[tuple[np.ndarray, np.ndarray]],
    price: np.ndarray,
    earlier: np.ndarray,
    apart: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return amounts of each band less those of its prediction, and variances; infinite where not measured.

    The price is on the squares of what is returned: what a band is apart from its prediction.
    """
    size, moved = len(price), apart @ earlier - earlier
    amounts = np.zeros((len(systems), size))
    variances = np.full((len(systems), size), np.inf)
    for band, (matrix, right) in enumerate(systems):
        if matrix.any():
            matrix = matrix[:size, :size]
            inverse = _inverse(matrix + np.diag(price))
            amounts[band] = inverse @ (right[:size] + matrix @ moved[band, :size])
            variances[band] = np.diag(inverse)
    return amounts, variances


def _smooth(
    measured: np.ndarray,
    variances: np.ndarray,
    wavelengths: Sequence[float],
    fixed: int | None,
    apart: np.ndarray,
    price: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth each amount over the bands by a Gaussian process, its scales from the data.

    `measured` are amounts measured against predictions: ``apart @ amounts``; a `price` is the inverse of
    the variance that is expected of a field. Returns the amounts and their variances.
    """
    places = np.asarray(wavelengths, float)
    smooth = np.isfinite(places).all() and len(np.unique(places)) >= LEAST_BANDS
    result, doubts = np.zeros_like(measured), np.zeros_like(measured)
    for column in range(measured.shape[1]):
        known = np.isfinite(variances[:, column])
        selection, noise = apart[known], variances[known, column] + LEAST_VARIANCE
        y = measured[known, column]
        if fixed is not None:
            selection = np.vstack([selection, np.eye(len(apart))[fixed]])
            y, noise = np.append(y, 0.0), np.append(noise, LEAST_VARIANCE)
        if len(y):
            bends = _correlations(selection, places) if smooth else []
            result[:, column], doubts[:, column] = _posterior(
                y, noise, selection, bends, price[column]
            )
    return result if fixed is None else result - result[fixed], doubts


Correlations = list[tuple[np.ndarray, np.ndarray]]
"""Of what was measured with all amounts, (measured, bands), and with itself, for each of `LENGTHS`."""


def _correlations(selection: np.ndarray, places: np.ndarray) -> Correlations:
    """Return the squared exponentials over `places`, (bands,) nm; `selection`, (measured, bands), is as of `_posterior`."""
    apart = (places[:, None] - places) ** 2
    across = [selection @ np.exp(-0.5 * apart / nm**2) for nm in LENGTHS]
    return [(one, one @ selection.T) for one in across]


def _posterior(
    y: np.ndarray, noise: np.ndarray, selection: np.ndarray, bends: Correlations, price: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of the amounts, (bands,), given ``y = selection @ amounts`` with variances `noise`.

    Algorithm 2.1 of [rasmussen2006]_ for each combination of scales; that of the highest marginal likelihood is taken. Scales
    are compared on what was measured alone, which is less than all that is wanted.
    """
    plain = np.linalg.lstsq(selection, y, rcond=1e-3)[0]
    size = max(float(np.mean(plain**2)), float(np.median(noise)), LEAST_VARIANCE)
    if price > 0:
        size = min(size, 1 / price)
    common = (1 if price > 0 else 100) * size
    rows, single = selection.sum(1), selection @ selection.T
    still = common * np.outer(rows, rows) + np.diag(noise)
    none = (np.zeros(selection.shape), np.zeros(single.shape)), 0.0
    best, chosen = -np.inf, None
    scales = [none, *product(bends, SMOOTH)]
    for ((across, within), share), own in product(scales, OWN):
        factor, failed = dpotrf(still + size * (share * within + own * single), lower=1)
        if failed:
            continue
        white, _ = dtrtrs(factor, y, lower=1)
        likelihood = -0.5 * (white @ white) - np.log(np.diag(factor)).sum()
        if likelihood > best:
            shared = common * rows[:, None] + size * (share * across + own * selection)
            best, chosen = likelihood, (factor, white, shared, common + size * (share + own))
    if chosen is None:
        return plain, np.full(selection.shape[1], size)
    factor, white, across, before = chosen
    known, _ = dtrtrs(factor, across, lower=1)
    return known.T @ white, np.maximum(before - (known**2).sum(0), 0.0)


# --- which of many bands are measured, and what the others follow from


def measured_bands(bands: Sequence[BandImage], also: int | None = None) -> list[int]:
    """Return the numbers of bands of a sensor, in the order of wavelength, whose shifts are measured; `also` whatever its number.

    All are where wavelengths are not known, or there are fewer than twice `LEAST_MEASURED` (25). Otherwise every
    n-th, and bands between these that lie `STRAY_PX` (0.1) or more from where the two beside them show the same detail.

    Examples
    --------
    >>> from levkas.registration.bands import BandImage
    >>> scan = [BandImage.of(f"{nm} nm", np.ones((9, 9)), nm) for nm in range(400, 1001, 5)]
    >>> len(scan), len(measured_bands(scan)), measured_bands(scan)[:3], measured_bands(scan)[-1]
    (121, 31, [0, 4, 8], 120)
    """
    count = len(bands)
    every = count // LEAST_MEASURED
    if every < 2 or not all(np.isfinite(band.wavelength) for band in bands):
        return list(range(count))
    evenly = np.linspace(0, count - 1, -(-count // every)).round().astype(int).tolist()
    picks = sorted({*evenly, *([] if also is None else [also])})
    strays = each(lambda ends: _strays(bands[ends[0] : ends[1] + 1]), list(pairwise(picks)))
    return sorted({*picks, *(a + i for a, some in zip(picks, strays, strict=False) for i in some)})


def _strays(bands: Sequence[BandImage]) -> list[int]:
    """Return the numbers of bands that do not lie where the first and the last show the same detail."""
    by = max(1, max(bands[0].size) // SMALL_PX)
    first, *between, last = (
        reduce(np.where(b.valid, np.sqrt(np.maximum(b.values, 0)), np.nan), by) for b in bands
    )
    if not between or not np.isfinite(first + last).any():
        return list(range(1, len(bands) - 1))
    basis = principal_components(np.stack([first, last])).high_passed()
    predictor = Predictor(basis.images, step=by, cell=CELL_PX)
    apart = [_distance(measure_shifts(predictor, picture)) for picture in between]
    return [number for number, px in enumerate(apart, 1) if px >= STRAY_PX]


def _distance(windows: WindowShifts) -> float:
    """Return the mean shift, px, of that quarter of the frame which is shifted most: a turn shifts each otherwise."""
    weights = np.trace(windows.information, axis1=1, axis2=2)
    quarter = (windows.centres > np.median(windows.centres, axis=0)) @ [1, 2]
    parts = [weights * (quarter == number) for number in range(4)]
    shifts = (np.hypot(*(w @ windows.shift / w.sum())) for w in parts if w.any())
    return float(max(shifts, default=0.0))


def is_smooth_in_wavelength(
    chromatic: ChromaticShifts, shown: Sequence[BandImage], bands: Sequence[BandImage]
) -> bool:
    """Return whether measured bands predict those between them: each lies where its neighbours predict it."""
    nm = [band.wavelength for band in shown]
    return len(shown) == len(bands) or error_between_bands(chromatic, nm) <= SMOOTH_PX


def chromatic_of_all(
    chromatic: ChromaticShifts, shown: Sequence[BandImage], bands: Sequence[BandImage]
) -> ChromaticShifts:
    """Return the displacements of all bands from those of the measured ones."""
    if len(shown) == len(bands):
        return chromatic
    measured, wanted = ([band.wavelength for band in some] for some in (shown, bands))
    return interpolate_chromatic(chromatic, measured, wanted)

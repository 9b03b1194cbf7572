"""Models of a map, fitted to shifts that are known in one direction better than another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg import solveh_banded

from levkas.geometry.pixel_maps_kernel import spline_sums
from levkas.geometry.spline import SplineShift, spline_weights
from levkas.geometry.transforms import (
    Affine,
    Composed,
    Homography,
    Lens,
    Polynomial,
    Transform,
    design_matrix,
    frame_of,
    solve_2x2,
)

#: Spans of a spline along the longer side, at most.
MOST_SPANS = 12
#: Rounds of Gauss-Newton, at most; share of the squares that a round takes without which it is the last.
MOST_ROUNDS, CONVERGED = 5, 1e-9
#: Degrees of freedom of Student's t: of 2 to 10 maps differ by a twentieth of their error.
FREEDOM = 4.0
#: Variance of normal residuals over what Student's t of that many takes for it.
NORMAL = 1.38
#: Windows by which a covariance is scaled, at most about.
MOST_SCALED = 1000


@dataclass(frozen=True, eq=False)
class Observations:
    """Positions of reference points in the target, with their information."""

    points: np.ndarray
    """(n, 2), reference px."""
    target: np.ndarray
    """(n, 2), native px of the target."""
    jacobian: np.ndarray
    """(n, 2, 2). d(target)/d(reference) there, to quote residuals in reference px."""
    information: np.ndarray
    """(n, 2, 2), 1/reference px²."""

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def native(self) -> np.ndarray:
        """Information in native px: J⁻ᵀ Λ J⁻¹, (n, 2, 2)."""
        back = np.linalg.inv(self.jacobian)
        return np.asarray(back.swapaxes(1, 2) @ self.information @ back)

    def part(self, mask: np.ndarray) -> Observations:
        """Return the observations that `mask` selects."""
        return Observations(
            self.points[mask], self.target[mask], self.jacobian[mask], self.information[mask]
        )

    def joined(self, other: Observations) -> Observations:
        """Return these observations, then the others."""
        columns = ((getattr(self, n), getattr(other, n)) for n in Observations.__annotations__)
        return Observations(*map(np.concatenate, columns))

    def residuals(self, model: Transform) -> np.ndarray:
        """Return (n, 2) residuals in reference px."""
        return solve_2x2(self.jacobian, self.target - model(self.points))

    def weighted(self, weights: np.ndarray) -> Observations:
        """Return the observations with their information scaled."""
        return replace(self, information=self.information * weights[:, None, None])


def inflate_covariance(
    residuals: np.ndarray, information: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return information with a floor of common variance, and robust weights.

    Windows err by more than their own noise: what the prediction cannot explain pulls. A variance
    that is common to all is added so that the median normalised residual is as it should be.
    """
    a, b, c = _inverse(information[:, 0, 0], information[:, 0, 1], information[:, 1, 1], 1e-9)
    x, y = residuals.T
    a, b, c = _inverse(a, b, c, _common_variance(a, b, c, x, y))
    floored = np.moveaxis(np.array([[a, b], [b, c]]), 2, 0)
    return floored, 1 / (1 + (a * x * x + 2 * b * x * y + c * y * y) / 8) ** 2


def scale_covariance(
    residuals: np.ndarray, information: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return information as residuals scatter, and robust weights, by Student's t ([lange1989]_).

    Each window's covariance times a factor that is common to all, plus a variance that is: what a prediction does not
    explain pulls a window by as much as it is uncertain, what bends a map between windows pulls all alike. Residuals, (n, 2), are in px,
    information, (n, 2, 2), in 1/px².
    """
    a, b, c = _inverse(information[:, 0, 0], information[:, 0, 1], information[:, 1, 1], 1e-9)
    x, y = residuals.T
    every = 1 + len(x) // MOST_SCALED
    factor, common = _most_likely(*(values[::every] for values in (a, b, c, x, y)))
    a, b, c = _inverse(a * factor, b * factor, c * factor, common)
    scaled = np.moveaxis(np.array([[a, b], [b, c]]), 2, 0) / NORMAL
    return scaled, 1 / (1 + (a * x * x + 2 * b * x * y + c * y * y) / FREEDOM)


def _most_likely(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[float, float]:
    """Return factor and common variance of the highest likelihood, by ever smaller steps of their logarithms."""
    size = float(np.median(x * x + y * y)) + 1e-12
    least = np.log(1e-6 * size)

    def unlikeliness(spot: np.ndarray) -> float:
        factor, common = np.exp(spot)
        p, q, r = factor * a + common, factor * b, factor * c + common
        determinant = p * r - q * q
        along = (r * x * x - 2 * q * x * y + p * y * y) / determinant
        total = 0.5 * np.log(determinant) + (FREEDOM + 2) / 2 * np.log1p(along / FREEDOM)
        return float(total.sum())

    spot, step = np.array([0.0, np.log(0.1 * size)]), 3.0
    best = unlikeliness(spot)
    while step > 0.1:
        moved = False
        for way in step * np.array([[-1.0, 0], [1, 0], [0, -1], [0, 1]]):
            tried = np.where(way == 0, spot, np.clip(spot + way, least, 20.0))
            value = unlikeliness(tried)
            if value < best - 1e-9:
                spot, best, moved = tried, value, True
        step = step if moved else step / 2
    factor, common = np.exp(spot)
    return float(factor), float(common)


def _common_variance(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, x: np.ndarray, y: np.ndarray
) -> float:
    """Return what variance, at most the median square, leaves half of all distances above those of chance."""
    low, high, middle = 0.0, float(np.median(x * x + y * y)) + 1e-12, 0.0
    for tried in range(13):
        p, q = a + middle, c + middle
        along = q * x * x - 2 * b * x * y + p * y * y
        enough = 2 * int((along > 2 * np.log(2.0) * (p * q - b * b)).sum()) > len(x)
        if tried == 0 and not enough:
            return 0.0
        low, high = (middle, high) if enough else (low, middle)
        middle = (low + high) / 2
    return high


def _inverse(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, extra: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Invert symmetric 2 x 2 matrices (a b; b c) with `extra` on the diagonal."""
    a, c = a + extra, c + extra
    determinant = a * c - b * b
    return c / determinant, -b / determinant, a / determinant


def fit_linear(design: np.ndarray, weight: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return coefficients (terms, 2) of target ≈ design @ coefficients under weights, (n, 2, 2)."""
    terms = design.shape[1]
    normal, right = np.empty((2, terms, 2, terms)), np.zeros((2, terms))
    for a in range(2):
        for b in range(2):
            normal[a, :, b] = design.T @ (design * weight[:, a, b][:, None])
            right[a] += design.T @ (weight[:, a, b] * target[:, b])
    matrix = normal.reshape(2 * terms, 2 * terms)
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled, goal = matrix * scale[:, None] * scale, right.reshape(-1) * scale
    try:
        solved = np.linalg.solve(scaled, goal)
    except np.linalg.LinAlgError:
        solved = np.linalg.lstsq(scaled, goal, rcond=1e-13)[0]
    return np.asarray((solved * scale).reshape(2, terms).T)


def fit_polynomial(observations: Observations, order: int) -> Polynomial:
    """Fit a polynomial of `order` in coordinates that are centred on the observations."""
    centre, spread = frame_of(observations.points)
    design = design_matrix(observations.points, order, centre, spread)
    offset = observations.target.mean(0)
    coefficients = fit_linear(design, observations.native, observations.target - offset)
    coefficients[0] += offset
    return Polynomial(order, centre, spread, coefficients)


def fit_similarity(observations: Observations) -> Affine:
    """Fit rotation, scale and shift, mirrored where the Jacobian says so."""
    sign = np.sign(np.median(np.linalg.det(observations.jacobian)))
    centre, spread = frame_of(observations.points)
    u, v = ((observations.points - centre) / spread).T
    one, nil = np.ones_like(u), np.zeros_like(u)
    rows = np.stack([u, -v * sign, one, nil, v * sign, u, nil, one], 1).reshape(-1, 4)
    weighted = (observations.native @ rows.reshape(-1, 2, 4)).reshape(-1, 4)
    normal, right = rows.T @ weighted, observations.target.reshape(-1) @ weighted
    a, b, x, y = np.linalg.lstsq(normal, right, rcond=1e-13)[0]
    linear = np.array([[a, -b * sign], [b, a * sign]]) / spread
    return Affine(np.column_stack([linear, np.array([x, y]) - linear @ centre]))


def fit_plane(model: str, p: np.ndarray, q: np.ndarray) -> Transform:
    """Fit a "similarity", an "affine" map or a "homography" to pairs p → q, (n, 2) each, all of one weight."""
    if model == "homography":
        return Homography.fit(p, q)
    affine = Affine.fit(p, q)
    if model == "affine":
        return affine
    sign = np.sign(np.linalg.det(affine.matrix[:, :2]))
    unit = np.broadcast_to(np.eye(2), (len(p), 2, 2))
    turned = np.broadcast_to(np.diag([1.0, sign]), unit.shape)
    return fit_similarity(Observations(p, q, turned, unit))


def fit_projective(observations: Observations, *, lens: bool) -> Transform:
    """Fit a homography, with the radial and tangential terms of [brown1966]_ behind it if `lens`, by Gauss-Newton.

    Points and targets are centred and scaled to about -1..1 ([hartley1997]_).

    >>> p = np.stack(np.meshgrid(np.arange(0.0, 90, 15), np.arange(0.0, 70, 15)), -1).reshape(-1, 2)
    >>> q = (p + 4) / (1 + 1e-4 * p[:, :1])
    >>> unit = np.broadcast_to(np.eye(2), (len(p), 2, 2))
    >>> found = fit_projective(Observations(p, q, unit, unit), lens=False)
    >>> bool(np.abs(found(p) - q).max() < 1e-9)
    True
    """
    centre, spread = frame_of(observations.points)
    out_centre, unit = frame_of(observations.target)
    places = (observations.points - centre) / spread
    goals = (observations.target - out_centre) / unit
    # R with RᵀR = J⁻ᵀ Λ J⁻¹: the square of R times a residual in the target is its weighted square.
    known = observations.information + 1e-9 * np.eye(2)
    roots = np.linalg.cholesky(known).swapaxes(1, 2) @ np.linalg.inv(observations.jacobian) * unit
    affine, p = fit_polynomial(observations, 1), np.zeros(12 if lens else 8)
    p[:6] = ((affine.coefficients - [out_centre, [0, 0], [0, 0]]) / unit).T.reshape(-1)
    p = _least_squares(places, goals, roots, p)
    (x, y), into = centre, np.array([[1 / spread, 0, 0], [0, 1 / spread, 0], [0, 0, 1.0]])
    into[:2, 2] = -x / spread, -y / spread
    out = np.array([[unit, 0, out_centre[0]], [0, unit, out_centre[1]], [0, 0, 1]])
    matrix = np.array([[p[1], p[2], p[0]], [p[4], p[5], p[3]], [p[6], p[7], 1.0]])
    plane = Homography(out @ matrix @ into)
    if not lens:
        return plane
    return Composed(plane, Lens(out_centre, unit, (p[8], p[9]), (p[10], p[11])))


def _least_squares(
    places: np.ndarray, goals: np.ndarray, roots: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Return the parameters of `_linearise` for which the weighted squares of the residuals are least."""
    best = start
    residual, slopes = _linearise(places, goals, roots, best)
    for _ in range(MOST_ROUNDS):
        normal = slopes.T @ slopes
        if not np.isfinite(normal).all():
            break
        scale = 1 / np.maximum(np.sqrt(np.diag(normal)), 1e-150)
        normal = normal * scale[:, None] * scale
        move = -scale * np.linalg.lstsq(normal, scale * (slopes.T @ residual), rcond=1e-13)[0]
        tried, after = _linearise(places, goals, roots, best + move)
        before, now = float(residual @ residual), float(tried @ tried)
        if not (np.isfinite(tried).all() and now < before):
            break
        best, residual, slopes = best + move, tried, after
        if before - now < CONVERGED * before:
            break
    return best


def _linearise(
    places: np.ndarray, goals: np.ndarray, roots: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted residuals, (2n,), and their derivatives by the parameters x: 1, u, v; y: 1, u, v; w: u, v; k1, k2, p1, p2."""
    u, v = places.T
    with np.errstate(all="ignore"):
        w = 1 / (1 + p[6] * u + p[7] * v)
        a, b = (p[0] + p[1] * u + p[2] * v) * w, (p[3] + p[4] * u + p[5] * v) * w
        terms = np.stack([w, u * w, v * w], 1)
        x, y, xa, xb, yb = a, b, np.ones_like(a), np.zeros_like(a), np.ones_like(a)
        bent = np.empty((len(a), 2, 0))
        if len(p) > 8:
            k1, k2, t1, t2 = p[8:]
            r2 = a * a + b * b
            gain, slope = 1 + k1 * r2 + k2 * r2 * r2, k1 + 2 * k2 * r2
            x = a * gain + 2 * t1 * a * b + t2 * (r2 + 2 * a * a)
            y = b * gain + 2 * t2 * a * b + t1 * (r2 + 2 * b * b)
            xa = gain + 2 * a * a * slope + 2 * t1 * b + 6 * t2 * a
            xb = 2 * a * b * slope + 2 * t1 * a + 2 * t2 * b
            yb = gain + 2 * b * b * slope + 2 * t2 * a + 6 * t1 * b
            along = np.stack([a * r2, a * r2 * r2, 2 * a * b, r2 + 2 * a * a], 1)
            down = np.stack([b * r2, b * r2 * r2, r2 + 2 * b * b, 2 * a * b], 1)
            bent = np.stack([along, down], 1)
        lens = np.stack([np.stack([xa, xb], 1), np.stack([xb, yb], 1)], 1)
        depth = -(lens @ np.stack([a, b], 1)[..., None]) * terms[:, None, 1:]
        straight = lens[..., None] * terms[:, None, None]
        change = np.concatenate([straight[:, :, 0], straight[:, :, 1], depth, bent], 2)
        residual = roots @ (goals - np.stack([x, y], 1))[..., None]
        return residual.reshape(-1), -(roots @ change).reshape(-1, len(p))


def fit_spline(
    observations: Observations, under: Transform, spacing: float, price: float
) -> Transform:
    """Fit a smooth displacement of the reference before `under`, bending at a `price`."""
    low, high = observations.points.min(0), observations.points.max(0)
    spacing = max(spacing, float((high - low).max()) / MOST_SPANS)
    columns, rows = np.maximum(np.ceil((high - low) / spacing), 1).astype(int) + 3
    origin = (low + high) / 2 - (np.array([columns, rows]) - 3) * spacing / 2
    place = (observations.points - origin) / spacing
    whole = np.clip(place.astype(int), 0, np.array([columns, rows]) - 4)
    bx, by = (spline_weights(place[:, k] - whole[:, k]) for k in (0, 1))
    shift = observations.residuals(under)
    plain = replace(
        observations, target=shift, jacobian=np.broadcast_to(np.eye(2), (len(shift), 2, 2))
    )
    weight = price * np.trace(observations.information, axis1=1, axis2=2).sum() / (rows * columns)
    normal, right = weight * _bending(rows, columns), np.zeros(2 * rows * columns)
    spline_sums(whole, bx, by, plain.native, shift, columns, normal, right)
    solved = solveh_banded(normal, right, lower=True, overwrite_ab=True, check_finite=False)
    return Composed(SplineShift(origin, spacing, solved.reshape(rows, columns, 2)), under)


@lru_cache(maxsize=8)
def _bending(rows: int, columns: int) -> np.ndarray:
    """Return the sum of squares of second differences of a lattice as a matrix, its diagonals from the main one on, (6 columns + 8, 2 rows columns).

    x and y of each coefficient follow one another. A thousandth of the coefficients' own squares is in it, so that it has an inverse.
    """

    def squares(n: int, order: int) -> np.ndarray:
        d = np.diff(np.eye(n), n=order, axis=0)
        return d.T @ d

    whole = (
        np.kron(np.eye(rows), squares(columns, 2))
        + np.kron(squares(rows, 2), np.eye(columns))
        + 2 * np.kron(squares(rows, 1), squares(columns, 1))
        + 1e-3 * np.eye(rows * columns)
    )
    bands = np.zeros((6 * columns + 8, 2 * len(whole)))
    for apart in range(2 * columns + 1):
        line = np.diag(whole, -apart)
        bands[2 * apart, : 2 * len(line)] = np.repeat(line, 2)
    return bands

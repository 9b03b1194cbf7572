"""Models of a map, fitted to shifts that are known in one direction better than another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg import solveh_banded

from levkas.core.compiled import njit
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
        a, b, c, d = (self.jacobian[:, i, j] for i in (0, 1) for j in (0, 1))
        determinant = a * d - b * c
        p, q, r = (self.information[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        a, b, c, d = d / determinant, -b / determinant, -c / determinant, a / determinant
        native = np.empty((len(self), 2, 2))
        native[:, 0, 0] = a * a * p + 2 * a * c * q + c * c * r
        native[:, 0, 1] = native[:, 1, 0] = a * b * p + (a * d + b * c) * q + c * d * r
        native[:, 1, 1] = b * b * p + 2 * b * d * q + d * d * r
        return native

    def part(self, mask: np.ndarray) -> Observations:
        """Return the observations that `mask` selects."""
        return Observations(
            self.points[mask], self.target[mask], self.jacobian[mask], self.information[mask]
        )

    def joined(self, other: Observations) -> Observations:
        """Return these observations, then the others."""
        names = ("points", "target", "jacobian", "information")
        return Observations(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))

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
    high = _common_variance(a, b, c, x, y, float(np.median(x * x + y * y)) + 1e-12)
    a, b, c = _inverse(a, b, c, high)
    floored = np.stack([np.stack([a, b], 1), np.stack([b, c], 1)], 1)
    return floored, 1 / (1 + (a * x * x + 2 * b * x * y + c * y * y) / 8) ** 2


def scale_covariance(
    residuals: np.ndarray, information: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return information as residuals scatter, and robust weights, by Student's t ([lange1989]_).

    Each window's covariance times a factor that is common to all, plus a variance that is: what a prediction does not
    explain pulls a window by as much as it is uncertain, what bends a map between windows pulls all alike.

    Parameters
    ----------
    residuals : ndarray, (n, 2), px
    information : ndarray, (n, 2, 2), 1/px²

    Returns
    -------
    information : ndarray, (n, 2, 2), 1/px²
    weights : ndarray, (n,), 0..1
    """
    a, b, c = _inverse(information[:, 0, 0], information[:, 0, 1], information[:, 1, 1], 1e-9)
    x, y = residuals.T
    every = 1 + len(x) // MOST_SCALED
    part = [np.ascontiguousarray(values[::every]) for values in (a, b, c, x, y)]
    size = float(np.median(part[3] ** 2 + part[4] ** 2)) + 1e-12
    factor, common = _most_likely(*part, size)
    a, b, c = _inverse(a * factor, b * factor, c * factor, common)
    scaled = np.stack([np.stack([a, b], 1), np.stack([b, c], 1)], 1) / NORMAL
    return scaled, 1 / (1 + (a * x * x + 2 * b * x * y + c * y * y) / FREEDOM)


@njit(cache=True)
def _most_likely(a, b, c, x, y, size):  # type: ignore[no-untyped-def]
    """Return factor and common variance of the highest likelihood, by ever smaller steps of their logarithms."""
    spot = np.array([0.0, np.log(0.1 * size)])
    least = _unlikeliness(a, b, c, x, y, spot)
    step = 3.0
    while step > 0.1:
        moved = False
        for k in range(2):
            for sign in (-1.0, 1.0):
                tried = spot.copy()
                tried[k] = min(max(tried[k] + sign * step, np.log(1e-6 * size)), 20.0)
                value = _unlikeliness(a, b, c, x, y, tried)
                if value < least - 1e-9:
                    spot, least, moved = tried, value, True
        if not moved:
            step /= 2
    return np.exp(spot[0]), np.exp(spot[1])


@njit(cache=True)
def _unlikeliness(a, b, c, x, y, spot):  # type: ignore[no-untyped-def]
    factor, common, total = np.exp(spot[0]), np.exp(spot[1]), 0.0
    for n in range(len(x)):
        p, q, r = factor * a[n] + common, factor * b[n], factor * c[n] + common
        determinant = p * r - q * q
        along = (r * x[n] * x[n] - 2 * q * x[n] * y[n] + p * y[n] * y[n]) / determinant
        total += 0.5 * np.log(determinant) + (FREEDOM + 2) / 2 * np.log1p(along / FREEDOM)
    return total


@njit(cache=True)
def _common_variance(a, b, c, x, y, most):  # type: ignore[no-untyped-def]
    """Return what variance, at most `most`, leaves half of all distances above those of chance."""
    low, high, middle = 0.0, most, 0.0
    expected = 2 * np.log(2.0)
    for tried in range(13):
        above = 0
        for n in range(len(x)):
            p, q = a[n] + middle, c[n] + middle
            along = q * x[n] * x[n] - 2 * b[n] * x[n] * y[n] + p * y[n] * y[n]
            above += along > expected * (p * q - b[n] * b[n])
        enough = 2 * above > len(x)
        if tried == 0 and not enough:
            return 0.0
        if enough:
            low = middle
        else:
            high = middle
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
    normal = np.empty((2, terms, 2, terms))
    right = np.zeros((2, terms))
    for a in range(2):
        for b in range(2):
            if b >= a:
                normal[a, :, b] = design.T @ (design * weight[:, a, b][:, None])
                normal[b, :, a] = normal[a, :, b]
            right[a] += design.T @ (weight[:, a, b] * target[:, b])
    return _solve_normal(normal, right)


def _solve_normal(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return (terms, 2) that solve normal equations, (2, terms, 2, terms) and (2, terms)."""
    terms = right.shape[1]
    matrix = normal.reshape(2 * terms, 2 * terms)
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale[:, None] * scale
    try:
        solved = np.linalg.solve(scaled, right.reshape(-1) * scale) * scale
    except np.linalg.LinAlgError:
        solved = np.linalg.lstsq(scaled, right.reshape(-1) * scale, rcond=1e-13)[0] * scale
    return solved.reshape(2, terms).T


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


@dataclass(frozen=True)
class Normalisation:
    """Coordinates of about -1..1, of points and of their targets ([hartley1997]_), in which a homography with a lens is fitted."""

    centre: np.ndarray
    spread: float
    out_centre: np.ndarray
    out_spread: float

    @classmethod
    def of(cls, observations: Observations) -> Normalisation:
        """Return the coordinates of observations."""
        return cls(*frame_of(observations.points), *frame_of(observations.target))

    def places(self, observations: Observations) -> np.ndarray:
        """Return where the points lie, (n, 2)."""
        return (observations.points - self.centre) / self.spread

    def goals(self, observations: Observations) -> tuple[np.ndarray, np.ndarray]:
        """Return where the targets lie, (n, 2), and the roots of their weights, (n, 2, 2)."""
        information, jacobian = (
            np.ascontiguousarray(a) for a in (observations.information, observations.jacobian)
        )
        roots = weight_roots(information, jacobian, self.out_spread)
        return (observations.target - self.out_centre) / self.out_spread, roots

    def projective(self, p: np.ndarray) -> Transform:
        """Return the homography, of 12 parameters with a lens behind it."""
        (x, y), spread, unit = self.centre, self.spread, self.out_spread
        matrix = np.array([[p[1], p[2], p[0]], [p[4], p[5], p[3]], [p[6], p[7], 1.0]])
        into = np.array([[1 / spread, 0, -x / spread], [0, 1 / spread, -y / spread], [0, 0, 1]])
        out = np.array([[unit, 0, self.out_centre[0]], [0, unit, self.out_centre[1]], [0, 0, 1]])
        plane = Homography(out @ matrix @ into)
        if len(p) == 8:
            return plane
        return Composed(plane, Lens(self.out_centre, unit, (p[8], p[9]), (p[10], p[11])))


def fit_projective(observations: Observations, *, lens: bool) -> Transform:
    """Fit a homography, with the radial and tangential terms of [brown1966]_ if `lens`, by Gauss-Newton."""
    frames = Normalisation.of(observations)
    return frames.projective(projective_parameters(observations, frames, 12 if lens else 8))


def projective_parameters(
    observations: Observations, frames: Normalisation, count: int
) -> np.ndarray:
    """Return the parameters of a homography, 8, or of one with a lens, 12, as `fit_parameters` orders them."""
    affine, start = fit_polynomial(observations, 1), np.zeros(count)
    start[:6] = (
        (affine.coefficients - [frames.out_centre, [0, 0], [0, 0]]) / frames.out_spread
    ).T.reshape(-1)
    return fit_parameters(frames.places(observations), *frames.goals(observations), start)


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
def roughness(rows: int, columns: int) -> np.ndarray:
    """Return the matrix, (rows x columns, rows x columns), by which coefficients of a lattice give the sum of squares of their second differences."""

    def second(n: int) -> np.ndarray:
        d = np.diff(np.eye(n), n=2, axis=0)
        return d.T @ d

    def first(n: int) -> np.ndarray:
        d = np.diff(np.eye(n), axis=0)
        return d.T @ d

    return (
        np.kron(np.eye(rows), second(columns))
        + np.kron(second(rows), np.eye(columns))
        + 2 * np.kron(first(rows), first(columns))
    )


@lru_cache(maxsize=8)
def _bending(rows: int, columns: int) -> np.ndarray:
    """Return `roughness` for x and y of each coefficient in turns, its diagonals from the main one on, (6 columns + 8, 2 rows columns).

    A thousandth of the coefficients' own squares is in it, so that it has an inverse.
    """
    whole = roughness(rows, columns) + 1e-3 * np.eye(rows * columns)
    bands = np.zeros((6 * columns + 8, 2 * len(whole)))
    for apart in range(2 * columns + 1):
        line = np.diag(whole, -apart)
        bands[2 * apart, : 2 * len(line)] = np.repeat(line, 2)
    return bands


def fit_parameters(
    places: np.ndarray, goals: np.ndarray, roots: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Return the parameters for which the weighted squares of the residuals are least, by Gauss-Newton.

    Parameters
    ----------
    places : ndarray, (n, 2)
        Points, centred and scaled to about -1..1.
    goals : ndarray, (n, 2)
        Their positions in the target, centred and scaled in the same way.
    roots : ndarray, (n, 2, 2)
        Weights: the product of a residual with them is squared.
    start : ndarray, (8,) or (12,)
        Of the homography x: 1, u, v; y: 1, u, v; w: u, v; then, with a lens, k1, k2, p1, p2.

    Returns
    -------
    parameters : ndarray, (8,) or (12,)

    Examples
    --------
    >>> u, v = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    >>> places = np.stack([u.ravel(), v.ravel()], 1)
    >>> goals = (places + 0.1) / (1 + 0.05 * places[:, :1])
    >>> start = np.array([0.0, 1, 0, 0, 0, 1, 0, 0])
    >>> found = fit_parameters(places, goals, np.tile(np.eye(2), (25, 1, 1)), start)
    >>> np.abs(found - [0.1, 1, 0, 0.1, 0, 1, 0.05, 0]).max() < 1e-9
    np.True_
    """
    best = np.array(start, float)
    residual, slopes = np.empty(2 * len(places)), np.empty((2 * len(places), len(best)))
    linearise(places, goals, roots, best, residual, slopes)
    tried, after = np.empty_like(residual), np.empty_like(slopes)
    for _ in range(MOST_ROUNDS):
        normal = slopes.T @ slopes
        if not np.isfinite(normal).all():
            break
        scale = 1 / np.maximum(np.sqrt(np.diag(normal)), 1e-150)
        normal = normal * scale[:, None] * scale
        move = -scale * np.linalg.lstsq(normal, scale * (slopes.T @ residual), rcond=1e-13)[0]
        linearise(places, goals, roots, best + move, tried, after)
        before, now = float(residual @ residual), float(tried @ tried)
        if not (np.isfinite(tried).all() and now < before):
            break
        best = best + move
        residual, tried, slopes, after = tried, residual, after, slopes
        if before - now < CONVERGED * before:
            break
    return best


@njit(cache=True)
def weight_roots(information, jacobian, unit):  # type: ignore[no-untyped-def]
    """Return roots, (n, 2, 2), that weigh residuals in the target, in `unit`, by information in the reference."""
    out = np.empty_like(information)
    for n in range(len(information)):
        p, q, r = information[n, 0, 0] + 1e-9, information[n, 0, 1], information[n, 1, 1] + 1e-9
        first = np.sqrt(p)
        cross, second = q / first, np.sqrt(r - q * q / p)
        a, b, c, d = jacobian[n, 0, 0], jacobian[n, 0, 1], jacobian[n, 1, 0], jacobian[n, 1, 1]
        whole = unit / (a * d - b * c)
        out[n, 0, 0], out[n, 0, 1] = (
            (first * d - cross * c) * whole,
            (cross * a - first * b) * whole,
        )
        out[n, 1, 0], out[n, 1, 1] = -second * c * whole, second * a * whole
    return out


@njit(cache=True)
def linearise(places, goals, roots, p, residual, slopes):  # type: ignore[no-untyped-def]
    """Fill the weighted residuals, and their derivatives by the parameters."""
    lens = len(p) > 8
    along, down = np.zeros(12), np.zeros(12)
    for n in range(len(places)):
        u, v = places[n, 0], places[n, 1]
        w = 1 / (1 + p[6] * u + p[7] * v)
        a, b = (p[0] + p[1] * u + p[2] * v) * w, (p[3] + p[4] * u + p[5] * v) * w
        x, y = a, b
        xa, xb, yb = 1.0, 0.0, 1.0
        if lens:
            k1, k2, t1, t2 = p[8], p[9], p[10], p[11]
            r2 = a * a + b * b
            gain, slope = 1 + k1 * r2 + k2 * r2 * r2, k1 + 2 * k2 * r2
            x = a * gain + 2 * t1 * a * b + t2 * (r2 + 2 * a * a)
            y = b * gain + 2 * t2 * a * b + t1 * (r2 + 2 * b * b)
            xa = gain + 2 * a * a * slope + 2 * t1 * b + 6 * t2 * a
            xb = 2 * a * b * slope + 2 * t1 * a + 2 * t2 * b
            yb = gain + 2 * b * b * slope + 2 * t2 * a + 6 * t1 * b
            along[8], down[8] = a * r2, b * r2
            along[9], down[9] = a * r2 * r2, b * r2 * r2
            along[10], down[10] = 2 * a * b, r2 + 2 * b * b
            along[11], down[11] = r2 + 2 * a * a, 2 * a * b
        for k, term in enumerate((w, u * w, v * w)):
            along[k], down[k] = xa * term, xb * term
            along[3 + k], down[3 + k] = xb * term, yb * term
        for k, term in enumerate((u * w, v * w)):
            along[6 + k] = -(xa * a + xb * b) * term
            down[6 + k] = -(xb * a + yb * b) * term
        dx, dy = goals[n, 0] - x, goals[n, 1] - y
        for row in range(2):
            q, r = roots[n, row, 0], roots[n, row, 1]
            residual[2 * n + row] = q * dx + r * dy
            for k in range(len(p)):
                slopes[2 * n + row, k] = -(q * along[k] + r * down[k])

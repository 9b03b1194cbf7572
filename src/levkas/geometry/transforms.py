"""Maps between pixel frames: values that can be called, inverted, differentiated and stored.

Points are (n, 2) float64 arrays of (x, y), pixel centres at integers. A registration's transform
maps reference pixels to native pixels of a band, the direction in which a resampling pulls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

INVERSE_TOLERANCE_PX = 1e-9
INVERSE_ROUNDS = 60


@runtime_checkable
class Transform(Protocol):
    """What every map can do; all that algorithms may know of one."""

    def __call__(self, points: np.ndarray) -> np.ndarray: ...
    def inverse(self, points: np.ndarray) -> np.ndarray: ...
    def jacobian(self, points: np.ndarray) -> np.ndarray: ...
    def to_dict(self) -> dict[str, Any]: ...


def invert(transform: Transform, points: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Solve ``transform(p) = points`` by damped Newton from `start`.

    Parameters
    ----------
    points, start : ndarray, (n, 2), px

    Returns
    -------
    solution : ndarray, (n, 2)
        To 1e-9 px; NaN where it does not converge (a fold, or outside what the map covers).
    """
    p, goal = np.array(start, float), np.asarray(points, float)
    for _ in range(INVERSE_ROUNDS):
        miss = transform(p) - goal
        if not np.any(np.abs(miss) > INVERSE_TOLERANCE_PX):
            break
        p = p - solve_2x2(transform.jacobian(p), miss)
    else:
        miss = transform(p) - goal
    with np.errstate(invalid="ignore"):
        good = np.all(np.abs(miss) <= 1e-7, axis=1)
    return np.where(good[:, None], p, np.nan)


def solve_2x2(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve n systems of two equations, (n, 2, 2) and (n, 2); infinite where one is singular.

    Examples
    --------
    >>> solve_2x2(np.array([[[2.0, 1.0], [0.0, 4.0]]]), np.array([[4.0, 8.0]])).tolist()
    [[1.0, 2.0]]
    """
    a, b, c, d = (matrices[:, i, j] for i in (0, 1) for j in (0, 1))
    x, y = right.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([d * x - b * y, a * y - c * x], 1) / (a * d - b * c)[:, None]


@dataclass(frozen=True, eq=False)
class Affine:
    """Affine map, ``p ↦ matrix[:, :2] p + matrix[:, 2]``, of points (x, y) in px.

    Parameters
    ----------
    matrix : ndarray, (2, 3)
        Linear part, no unit, and shift, px.

    Raises
    ------
    numpy.linalg.LinAlgError
        By `inverse` where the linear part is singular.

    Examples
    --------
    >>> Affine(np.array([[2.0, 0, 1], [0, 2, -1]]))(np.array([[3.0, 4]]))
    array([[7., 7.]])
    """

    matrix: np.ndarray

    @classmethod
    def identity(cls) -> Affine:
        """Return the map that leaves every point where it is."""
        return cls(np.eye(2, 3))

    @classmethod
    def scaling(cls, scale_x: float, scale_y: float | None = None) -> Affine:
        """Return a scaling about pixel corners: x′ = (x + 0.5)·s − 0.5."""
        s = np.array([scale_x, scale_x if scale_y is None else scale_y], float)
        return cls(np.column_stack([np.diag(s), s / 2 - 0.5]))

    @classmethod
    def of_box(cls, left: float, top: float, step: int = 1) -> Affine:
        """Return the map from px of a part of a picture to those of the whole, of which `step` a side make one.

        Examples
        --------
        >>> Affine.of_box(10, 20, 2)(np.zeros((1, 2)))
        array([[10.5, 20.5]])
        """
        middle = (step - 1) / 2
        return cls(np.array([[step, 0, left + middle], [0, step, top + middle]], float))

    @classmethod
    def fit(
        cls, source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None
    ) -> Affine:
        """Return the least-squares affine map of `source` to `target`, both (n, 2), n >= 3."""
        centre = source.mean(0)
        spread = np.abs(source - centre).max() or 1.0
        columns = np.column_stack([(source - centre) / spread, np.ones(len(source))])
        w = np.ones(len(source)) if weights is None else np.sqrt(weights)
        solved = np.linalg.lstsq(columns * w[:, None], target * w[:, None], rcond=None)[0].T
        linear = solved[:, :2] / spread
        return cls(np.column_stack([linear, solved[:, 2] - linear @ centre]))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(points, float) @ self.matrix[:, :2].T + self.matrix[:, 2]

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back, exactly."""
        return (np.asarray(points, float) - self.matrix[:, 2]) @ np.linalg.inv(self.matrix[:, :2]).T

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2)."""
        return np.broadcast_to(self.matrix[:, :2], (len(points), 2, 2))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {"kind": "affine", "matrix": np.asarray(self.matrix, float).tolist()}


@dataclass(frozen=True, eq=False)
class Homography:
    """Projective map of points (x, y) in px by a matrix: ``(x′, y′, 1) ∝ matrix (x, y, 1)``.

    Parameters
    ----------
    matrix : ndarray, (3, 3)
        Of homogeneous coordinates, px; any scale.

    Raises
    ------
    ValueError
        By `fit` where the points determine none.
    numpy.linalg.LinAlgError
        By `inverse` where the matrix is singular.

    Notes
    -----
    `fit` is the normalised direct linear transform ([hartley1997]_, doi:10.1109/34.601246).

    Examples
    --------
    >>> Homography(np.array([[1.0, 0, 0], [0, 1, 0], [0.1, 0, 1]]))(np.array([[10.0, 4]])).tolist()
    [[5.0, 2.0]]
    """

    matrix: np.ndarray

    @classmethod
    def fit(cls, source: np.ndarray, target: np.ndarray) -> Homography:
        """Return the map of `source` to `target`, both (n, 2), n >= 4, by the direct linear transform.

        Coordinates are centred and scaled first ([hartley1997]_).

        Raises
        ------
        ValueError
            Where the points determine none.

        Examples
        --------
        >>> corners = np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]])
        >>> Homography.fit(corners, 2 * corners + 1)(np.array([[4.0, 5.0]])).round(9).tolist()
        [[9.0, 11.0]]
        """
        frames = [_centred(points) for points in (source, target)]
        (x, y), (u, v) = (
            (points @ frame[:2, :2].T + frame[:2, 2]).T
            for points, frame in zip((source, target), frames, strict=True)
        )
        one, nil = np.ones_like(x), np.zeros_like(x)
        rows = np.concatenate(
            [
                np.stack([x, y, one, nil, nil, nil, -u * x, -u * y, -u], 1),
                np.stack([nil, nil, nil, x, y, one, -v * x, -v * y, -v], 1),
            ]
        )
        centred = np.linalg.svd(rows)[2][-1].reshape(3, 3)
        matrix = np.linalg.inv(frames[1]) @ centred @ frames[0]
        if not abs(matrix[2, 2]) > 1e-9:
            raise ValueError("these points determine no homography")
        return cls(matrix / matrix[2, 2])

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return _project(self.matrix, points)

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back, exactly."""
        return _project(np.linalg.inv(self.matrix), points)

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2)."""
        lifted = np.asarray(points, float) @ self.matrix[:, :2].T + self.matrix[:, 2]
        flat, w = lifted[:, :2] / lifted[:, 2:], lifted[:, 2]
        change = self.matrix[None, :2, :2] - flat[:, :, None] * self.matrix[None, 2:, :2]
        return change / w[:, None, None]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {"kind": "homography", "matrix": np.asarray(self.matrix, float).tolist()}


def _centred(points: np.ndarray) -> np.ndarray:
    """Return the similarity, (3, 3), that centres points and scales them to -1..1."""
    centre = points.mean(0)
    spread = max(float(np.abs(points - centre).max()), 1e-9)
    return np.array(
        [[1 / spread, 0, -centre[0] / spread], [0, 1 / spread, -centre[1] / spread], [0, 0, 1]]
    )


def _project(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    lifted = np.asarray(points, float) @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return lifted[:, :2] / lifted[:, 2:]


def exponents(order: int) -> list[tuple[int, int]]:
    """Return (i, j) of the terms u^i v^j of a polynomial, lowest total degree first.

    >>> exponents(1)
    [(0, 0), (1, 0), (0, 1)]
    """
    return [(d - j, j) for d in range(order + 1) for j in range(d + 1)]


@dataclass(frozen=True, eq=False)
class Polynomial:
    """Polynomial map in centred, scaled coordinates: u = (x − cx)/s, v = (y − cy)/s.

    Parameters
    ----------
    order : int, >= 1
        Total degree; the paper's is 3.
    centre : ndarray, (2,), px
    spread : float, px
        Order 3 on raw pixels has a condition number of 1e11; on these it is below 100.
    coefficients : ndarray, (terms, 2)
        Rows as `exponents` orders them, columns x′ and y′ in px.

    Raises
    ------
    ValueError
        By `fit` with fewer points than terms.

    Notes
    -----
    Section 3.5 of [mirhashemi2019]_, doi:10.3390/computation7030047, has order 3.

    Examples
    --------
    >>> p = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    >>> t = Polynomial.fit(p, p**2, order=2)
    >>> np.allclose(t(np.array([[1.5, 2.5]])), [[2.25, 6.25]])
    True
    """

    order: int
    centre: np.ndarray
    spread: float
    coefficients: np.ndarray

    @classmethod
    def fit(
        cls,
        source: np.ndarray,
        target: np.ndarray,
        *,
        order: int = 3,
        weights: np.ndarray | None = None,
        frame: tuple[np.ndarray, float] | None = None,
    ) -> Polynomial:
        """Fit `source` to `target`, both (n, 2), by least squares through QR.

        `frame` fixes (centre, spread), so that fits on subsets share their coordinates.
        Raises ValueError with fewer points than terms.
        """
        terms = (order + 1) * (order + 2) // 2
        if len(source) < terms:
            raise ValueError(
                f"order-{order} polynomial needs at least {terms} matches, got {len(source)}"
            )
        centre, spread = frame or frame_of(source)
        design = design_matrix(source, order, centre, spread)
        w = np.ones(len(source)) if weights is None else np.sqrt(weights)
        solved = np.linalg.lstsq(design * w[:, None], np.asarray(target) * w[:, None], rcond=None)[
            0
        ]
        return cls(order, np.asarray(centre, float), float(spread), solved)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        from levkas.geometry.pixel_maps_kernel import polynomial

        return np.asarray(
            polynomial(
                np.ascontiguousarray(points, float),
                self.order,
                np.asarray(self.centre, float),
                float(self.spread),
                np.ascontiguousarray(self.coefficients, float),
            )
        )

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back by Newton from the affine part; NaN where there is no answer."""
        linear = self.coefficients[1:3].T / self.spread
        rough = Affine(np.column_stack([linear, self.coefficients[0] - linear @ self.centre]))
        return invert(self, points, rough.inverse(points))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2)."""
        from levkas.geometry.pixel_maps_kernel import polynomial_slopes

        return np.asarray(
            polynomial_slopes(
                np.ascontiguousarray(points, float),
                self.order,
                np.asarray(self.centre, float),
                float(self.spread),
                np.ascontiguousarray(self.coefficients, float),
            )
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "kind": "polynomial",
            "order": self.order,
            "centre": np.asarray(self.centre, float).tolist(),
            "spread": float(self.spread),
            "coefficients": np.asarray(self.coefficients, float).tolist(),
        }


def frame_of(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the (centre, spread) that bring `points`, (n, 2), into [-1, 1]."""
    sides = np.ascontiguousarray(np.transpose(points))
    low, high = sides.min(1), sides.max(1)
    return (low + high) / 2, float((high - low).max() / 2) or 1.0


def design_matrix(points: np.ndarray, order: int, centre: np.ndarray, spread: float) -> np.ndarray:
    """Return the (n, terms) matrix of u^i v^j, terms as `exponents` orders them."""
    u, v = ((np.asarray(points, float) - centre) / spread).T
    us, vs = _powers(u, order), _powers(v, order)
    design = np.empty((len(u), (order + 1) * (order + 2) // 2))
    for term, (i, j) in enumerate(exponents(order)):
        np.multiply(us[i], vs[j], out=design[:, term])
    return design


def _powers(base: np.ndarray, most: int) -> list[np.ndarray]:
    powers = [np.ones_like(base)]
    for _ in range(most):
        powers.append(powers[-1] * base)
    return powers


@dataclass(frozen=True, eq=False)
class Lens:
    """Lens distortion in centred, scaled coordinates: radial k1, k2 and tangential p1, p2.

    With (u, v) = (p − centre)/spread and r² = u² + v²:
    u′ = u(1 + k1 r² + k2 r⁴) + 2 p1 u v + p2 (r² + 2u²), and v′ alike; then back to pixels.

    Parameters
    ----------
    centre : ndarray, (2,), px
        Centre of distortion (x, y).
    spread : float, px, > 0
        Length that is 1 in (u, v), such as half of the longer side.
    radial, tangential : (float, float)
        (k1, k2) and (p1, p2), no unit; usually within ±0.1.

    Raises
    ------
    ValueError
        Where points are not (n, 2). `inverse` gives NaN past the fold of the lens.

    Notes
    -----
    Model of [brown1966]_, which has no DOI.

    Examples
    --------
    A corner 100 px from the centre moves outwards by one per cent:

    >>> Lens(np.array([100.0, 100.0]), 100.0, radial=(0.01, 0.0))(np.array([[200.0, 100.0]])).tolist()
    [[201.0, 100.0]]
    """

    centre: np.ndarray
    spread: float
    radial: tuple[float, float] = (0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        u, v = ((np.asarray(points, float) - self.centre) / self.spread).T
        (k1, k2), (p1, p2) = self.radial, self.tangential
        r2 = u * u + v * v
        gain = 1 + k1 * r2 + k2 * r2 * r2
        x = u * gain + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
        y = v * gain + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
        return np.stack([x, y], 1) * self.spread + self.centre

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back by Newton; NaN past the fold of the lens."""
        found = invert(self, points, np.asarray(points, float))
        change = self.jacobian(found)
        # Past the fold the lens turns its picture over or about: another sheet, not an inverse.
        upright = (change[:, 0, 0] > 0) & (np.linalg.det(change) > 0)
        return np.where(upright[:, None], found, np.nan)

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2)."""
        u, v = ((np.asarray(points, float) - self.centre) / self.spread).T
        (k1, k2), (p1, p2) = self.radial, self.tangential
        r2 = u * u + v * v
        gain, slope = 1 + k1 * r2 + k2 * r2 * r2, k1 + 2 * k2 * r2
        cross = 2 * u * v * slope + 2 * p1 * u + 2 * p2 * v
        xx = gain + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u
        yy = gain + 2 * v * v * slope + 2 * p2 * u + 6 * p1 * v
        return np.stack([np.stack([xx, cross], 1), np.stack([cross, yy], 1)], 1)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "kind": "lens",
            "centre": np.asarray(self.centre, float).tolist(),
            "spread": float(self.spread),
            "radial": [float(k) for k in self.radial],
            "tangential": [float(p) for p in self.tangential],
        }


class Composed:
    """Maps applied one after another, left to right; nested ones are laid flat.

    Parameters
    ----------
    *steps : Transform
        Each takes the points (n, 2), px, that the one before it gives.

    Raises
    ------
    Exception
        What the steps raise.

    Examples
    --------
    >>> Composed(Affine.scaling(2.0), Affine(np.array([[1.0, 0, 10], [0, 1, 0]])))(np.array([[1.0, 1]])).tolist()
    [[12.5, 2.5]]
    """

    def __init__(self, *steps: Transform) -> None:
        flat: list[Transform] = []
        for step in steps:
            flat.extend(step.steps if isinstance(step, Composed) else (step,))
        self.steps: tuple[Transform, ...] = tuple(flat)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        result = np.asarray(points, float)
        for step in self.steps:
            result = step(result)
        return result

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back through the steps in reverse."""
        result = np.asarray(points, float)
        for step in reversed(self.steps):
            result = step.inverse(result)
        return result

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2), by the chain rule."""
        result, here = np.broadcast_to(np.eye(2), (len(points), 2, 2)), np.asarray(points, float)
        for step in self.steps:
            result = step.jacobian(here) @ result
            here = step(here)
        return result

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {"kind": "composed", "steps": [step.to_dict() for step in self.steps]}


class Inverse:
    """Inverse of a map, as a map.

    Parameters
    ----------
    of : Transform
        Points (n, 2), px, to points (n, 2), px.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where an affine or projective map has no inverse; other maps give NaN where there is none.

    Examples
    --------
    >>> Inverse(Affine(np.array([[2.0, 0, 1], [0, 2, -1]])))(np.array([[7.0, 7]])).tolist()
    [[3.0, 4.0]]
    """

    def __init__(self, of: Transform) -> None:
        self.of = of

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self.of.inverse(points)

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back: the map itself."""
        return self.of(points)

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2)."""
        return np.linalg.inv(self.of.jacobian(self.of.inverse(points)))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {"kind": "inverse", "of": self.of.to_dict()}

"""Maps between pixel frames: values that can be called, inverted, differentiated and stored.

Points are (n, 2) float64 arrays of (x, y), pixel centres at integers; a jacobian is d(x′, y′)/d(x, y), (n, 2, 2).
A registration's transform maps reference pixels to native pixels of a band, the direction in which a resampling pulls.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
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
    """Solve ``transform(p) = points`` by Newton from `start`, to 1e-9 px; NaN where it does not converge (a fold)."""
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

    >>> solve_2x2(np.array([[[2.0, 1.0], [0.0, 4.0]]]), np.array([[4.0, 8.0]])).tolist()
    [[1.0, 2.0]]
    """
    a, b, c, d = (matrices[:, i, j] for i in (0, 1) for j in (0, 1))
    x, y = right.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([d * x - b * y, a * y - c * x], 1) / (a * d - b * c)[:, None]


def stored(value: Any) -> Any:
    """Return a number, array, map, or several of them as JSON has them."""
    if isinstance(value, np.ndarray):
        return np.asarray(value, float).tolist()
    if isinstance(value, tuple | list):
        return [stored(one) for one in value]
    if isinstance(value, int | np.integer):
        return int(value)
    return value.to_dict() if isinstance(value, Transform) else float(value)


class _Stored:
    """A map that is stored as its kind, the name of its class, and its fields."""

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        values = {one.name: stored(getattr(self, one.name)) for one in fields(self)}  # type: ignore[arg-type]
        return {"kind": type(self).__name__.lower(), **values}


@dataclass(frozen=True, eq=False)
class Affine(_Stored):
    """Affine map, ``p ↦ matrix[:, :2] p + matrix[:, 2]``, of points (x, y) in px; `matrix` is (2, 3).

    `inverse` raises LinAlgError where the linear part is singular.

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
        return (np.asarray(points, float) - self.matrix[:, 2]) @ np.linalg.inv(self.matrix[:, :2]).T

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        return np.broadcast_to(self.matrix[:, :2], (len(points), 2, 2))


@dataclass(frozen=True, eq=False)
class Homography(_Stored):
    """Projective map of points (x, y) in px: ``(x′, y′, 1) ∝ matrix (x, y, 1)``; `matrix` is (3, 3), of any scale.

    `fit` is the normalised direct linear transform ([hartley1997]_, doi:10.1109/34.601246). `inverse` raises LinAlgError
    where the matrix is singular.

    >>> Homography(np.array([[1.0, 0, 0], [0, 1, 0], [0.1, 0, 1]]))(np.array([[10.0, 4]])).tolist()
    [[5.0, 2.0]]
    """

    matrix: np.ndarray

    @classmethod
    def fit(cls, source: np.ndarray, target: np.ndarray) -> Homography:
        """Return the map of `source` to `target`, both (n, 2), n >= 4; raises ValueError where they determine none.

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
        across = np.stack([x, y, one, nil, nil, nil, -u * x, -u * y, -u], 1)
        rows = np.concatenate([across, np.stack([nil, nil, nil, x, y, one, -v * x, -v * y, -v], 1)])
        centred = np.linalg.svd(rows)[2][-1].reshape(3, 3)
        matrix = np.linalg.inv(frames[1]) @ centred @ frames[0]
        if not abs(matrix[2, 2]) > 1e-9:
            raise ValueError("these points determine no homography")
        return cls(matrix / matrix[2, 2])

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return _project(self.matrix, points)

    def inverse(self, points: np.ndarray) -> np.ndarray:
        return _project(np.linalg.inv(self.matrix), points)

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        lifted = np.asarray(points, float) @ self.matrix[:, :2].T + self.matrix[:, 2]
        flat, w = lifted[:, :2] / lifted[:, 2:], lifted[:, 2]
        change = self.matrix[None, :2, :2] - flat[:, :, None] * self.matrix[None, 2:, :2]
        return change / w[:, None, None]


def _centred(points: np.ndarray) -> np.ndarray:
    """Return the similarity, (3, 3), that centres points and scales them to -1..1."""
    x, y = points.mean(0)
    spread = max(float(np.abs(points - (x, y)).max()), 1e-9)
    return np.array([[1 / spread, 0, -x / spread], [0, 1 / spread, -y / spread], [0, 0, 1]])


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
class Polynomial(_Stored):
    """Polynomial map in centred, scaled coordinates: u = (x − cx)/s, v = (y − cy)/s.

    `order` is the total degree, `centre` (2,) and `spread` are px (order 3 on raw pixels has a condition number of
    1e11, on these below 100), `coefficients` (terms, 2) px, rows as `exponents` orders them. Section 3.5 of
    [mirhashemi2019]_, doi:10.3390/computation7030047, has order 3. `fit` raises ValueError with fewer points than terms.

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
        """Fit `source` to `target`, both (n, 2), by least squares.

        `frame` fixes (centre, spread), so that fits on subsets share their coordinates.
        """
        terms = len(exponents(order))
        if len(source) < terms:
            raise ValueError(
                f"order-{order} polynomial needs at least {terms} matches, got {len(source)}"
            )
        centre, spread = frame or frame_of(source)
        design = design_matrix(source, order, centre, spread)
        w = (np.ones(len(source)) if weights is None else np.sqrt(weights))[:, None]
        solved = np.linalg.lstsq(design * w, np.asarray(target) * w, rcond=None)[0]
        return cls(order, np.asarray(centre, float), float(spread), solved)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        us, vs = _powers(points, self.order, self.centre, self.spread)
        out = np.zeros((2, len(us[0])))
        for (i, j), c in zip(exponents(self.order), self.coefficients, strict=True):
            out += us[i] * vs[j] * c[:, None]
        return np.ascontiguousarray(out.T)

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back by Newton from the affine part; NaN where there is no answer."""
        linear = self.coefficients[1:3].T / self.spread
        rough = Affine(np.column_stack([linear, self.coefficients[0] - linear @ self.centre]))
        return invert(self, points, rough.inverse(points))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        us, vs = _powers(points, self.order, self.centre, self.spread)
        out = np.zeros((2, 2, len(us[0])))
        for (i, j), c in zip(exponents(self.order), self.coefficients / self.spread, strict=True):
            if i:
                out[:, 0] += i * us[i - 1] * vs[j] * c[:, None]
            if j:
                out[:, 1] += j * us[i] * vs[j - 1] * c[:, None]
        return np.ascontiguousarray(np.moveaxis(out, -1, 0))


def frame_of(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the (centre, spread) that bring `points`, (n, 2), into [-1, 1]."""
    sides = np.ascontiguousarray(np.transpose(points))
    low, high = sides.min(1), sides.max(1)
    return (low + high) / 2, float((high - low).max() / 2) or 1.0


def design_matrix(points: np.ndarray, order: int, centre: np.ndarray, spread: float) -> np.ndarray:
    """Return the (n, terms) matrix of u^i v^j, terms as `exponents` orders them."""
    us, vs = _powers(points, order, centre, spread)
    design = np.empty((len(us[0]), len(exponents(order))))
    for term, (i, j) in enumerate(exponents(order)):
        np.multiply(us[i], vs[j], out=design[:, term])
    return design


def _powers(
    points: np.ndarray, most: int, centre: np.ndarray, spread: float
) -> list[list[np.ndarray]]:
    """Return the powers 0 to `most` of u, and of v."""
    found = []
    for base in ((np.asarray(points, float) - centre) / spread).T:
        powers = [np.ones_like(base)]
        for _ in range(most):
            powers.append(powers[-1] * base)
        found.append(powers)
    return found


@dataclass(frozen=True, eq=False)
class Lens(_Stored):
    """Lens distortion in centred, scaled coordinates: radial (k1, k2) and tangential (p1, p2), usually within ±0.1.

    With (u, v) = (p − centre)/spread and r² = u² + v²:
    u′ = u(1 + k1 r² + k2 r⁴) + 2 p1 u v + p2 (r² + 2u²), and v′ alike; then back to pixels. `centre` (2,) and `spread`,
    such as half of the longer side, are px. Past the fold of the lens `inverse` gives NaN, and raises nothing. Model of [brown1966]_, which has no DOI.

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
        u, v = ((np.asarray(points, float) - self.centre) / self.spread).T
        (k1, k2), (p1, p2) = self.radial, self.tangential
        r2 = u * u + v * v
        gain, slope = 1 + k1 * r2 + k2 * r2 * r2, k1 + 2 * k2 * r2
        cross = 2 * u * v * slope + 2 * p1 * u + 2 * p2 * v
        xx = gain + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u
        yy = gain + 2 * v * v * slope + 2 * p2 * u + 6 * p1 * v
        return np.stack([np.stack([xx, cross], 1), np.stack([cross, yy], 1)], 1)


class Composed:
    """Maps applied one after another, left to right; nested ones are laid flat. Raises what they do.

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
        result = np.asarray(points, float)
        for step in reversed(self.steps):
            result = step.inverse(result)
        return result

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        result, here = np.broadcast_to(np.eye(2), (len(points), 2, 2)), np.asarray(points, float)
        for step in self.steps:
            result = step.jacobian(here) @ result
            here = step(here)
        return result

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "composed", "steps": stored(self.steps)}


@dataclass(frozen=True, eq=False)
class Inverse(_Stored):
    """Inverse of a map, as a map; raises what the map's own inverse does, NaN where there is none.

    >>> Inverse(Affine(np.array([[2.0, 0, 1], [0, 2, -1]])))(np.array([[7.0, 7]])).tolist()
    [[3.0, 4.0]]
    """

    of: Transform

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self.of.inverse(points)

    def inverse(self, points: np.ndarray) -> np.ndarray:
        return self.of(points)

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.inv(self.of.jacobian(self.of.inverse(points)))

"""Map of one sensor fitted to pairs that a person placed, and to nothing else.

A map T moves a little by a displacement of the reference before it: T∘(1 + ε), ε = D(p) a. The fields of a homography are
(1, 0), (0, 1), (x, 0), (y, 0), (0, x), (0, y), (x², xy) and (xy, y²), the generators of the projective group; an affine map
has the first six, a similarity the first two and (x, y), (−y, x). Residuals, leverages and sigma of all three follow from
one linear problem in reference px.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine, Homography, Transform, solve_2x2
from levkas.registration.advice import LEAST_PAIRS
from levkas.registration.manual_points import HAND_PX, ManualPoints
from levkas.registration.models import Observations, fit_similarity
from levkas.registration.record import HandMark, Matches, MatchState, RegistrationRefused, Sigma
from levkas.registration.uncertainty import SETTINGS as UNCERTAINTY

PARAMETERS = {"similarity": 4, "affine": 6, "homography": 8}
"""Parameters of each map that may be fitted, from the stiffest to the most yielding."""
BEYOND_A_HAND = 4.0
"""Residual of an affine map through four pairs, in standard deviations of a hand, from which a homography is taken: chance
gives it in one set of four in 3000. Between 3 and 6, maps of tilted cameras and of careless hands are distinguished as well."""
LEAST_ACROSS = 0.02
"""Spread of the pairs across over that along; below, they lie on one line and determine no map."""
POLISHING = 4
"""Rounds of Gauss-Newton after the direct linear transform, which minimises no distance; two settle within 1e-6 px."""


@dataclass(frozen=True)
class PlacedByHand:
    """Map through a person's pairs, with what they leave of an error.

    Parameters
    ----------
    model : {"similarity", "affine", "homography"}
    transform : Transform
        Reference px → native px of the target.
    given : ManualPoints
        The person's pairs; the map is fitted to those that are never removed, n of them.
    residual, leave_one_out : ndarray, (n,), reference px
        How far each pair lies from the map; from a map without this pair, infinite where the others determine none.
    spread : float, reference px
        Standard deviation of a pair, either axis; never less than a hand's.
    alternatives : tuple of (Transform, float)
        The other maps that the pairs allow, each with its weight, 0 … 1.
    """

    model: str
    transform: Transform
    given: ManualPoints
    residual: np.ndarray
    leave_one_out: np.ndarray
    spread: float
    alternatives: tuple[tuple[Transform, float], ...] = ()

    @property
    def pairs(self) -> np.ndarray:
        """The pairs that are fitted, (n, 4)."""
        return self.given.fixed

    @property
    def fit_px(self) -> float | None:
        """Root mean square distance of a pair from the map, reference px, by the freedom that is left; None where none is."""
        free = len(self.pairs) - PARAMETERS[self.model] / 2
        return float(np.sqrt(np.square(self.residual).sum() / free)) if free > 0 else None

    @property
    def is_mirrored(self) -> bool:
        """Whether the map turns the picture over."""
        return bool(np.linalg.det(self.transform.jacobian(self.pairs[:1, :2])[0]) < 0)

    def sigma(self, shape: tuple[int, ...]) -> Sigma:
        """Return one standard deviation of the position over a frame (height, width), reference px.

        Variance of a pair times leverage of the place, and the spread between the maps that the pairs allow ([buckland1997]_).
        """
        x, y = (
            np.round(np.linspace(0, n - 1, k), 2)
            for n, k in zip(shape[1::-1], UNCERTAINTY.lattice, strict=True)
        )
        points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        lever = leverage(points, self.pairs[:, :2], self.model)
        variance = self.spread**2 * np.trace(lever, axis1=1, axis2=2) / 2
        total = 1 + sum(weight for _, weight in self.alternatives)
        jacobian, here = self.transform.jacobian(points), self.transform(points)
        for other, weight in self.alternatives:
            apart = solve_2x2(jacobian, other(points) - here)
            variance += weight / total * np.square(apart).sum(1) / 2
        values = np.sqrt(variance).reshape(UNCERTAINTY.lattice[::-1])
        return Sigma(x, y, np.round(values, UNCERTAINTY.decimals))

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers of a verdict, JSON-ready; ``worst`` is the place and the error of the worst pair."""
        fit, worst = self.fit_px, int(np.argmax(self.leave_one_out))
        known = np.isfinite(self.leave_one_out).all()
        return {
            "pairs": len(self.pairs),
            "model": self.model,
            "fit_px": None if fit is None else round(fit, 3),
            "worst": [
                round(float(v), 2) for v in (*self.pairs[worst, :2], self.leave_one_out[worst])
            ]
            if known
            else None,
        }

    def matches(self) -> Matches:
        """Return the table of the pairs, each with its mark; deleted ones last."""
        marked = self.given.mark(self.pairs[:, :2], self.pairs[:, 2:])
        deleted = self.given.deleted
        found = Matches.of(
            self.pairs[:, :2],
            self.pairs[:, 2:],
            residual=self.residual,
            leave_one_out=np.where(np.isfinite(self.leave_one_out), self.leave_one_out, np.nan),
            reason=marked.reason,
        )
        left = Matches.of(
            deleted[:, :2],
            deleted[:, 2:],
            weight=np.zeros(len(deleted)),
            state=np.full(len(deleted), MatchState.REMOVED, object),
            reason=np.full(len(deleted), HandMark.DELETED, object),
        )
        names = Matches.__dataclass_fields__
        return Matches(**{n: np.concatenate([getattr(found, n), getattr(left, n)]) for n in names})


def place_by_hand(given: ManualPoints, shape: tuple[int, ...], sensor: str = "") -> PlacedByHand:
    """Fit the map that a person's pairs support: a similarity, an affine map or a homography.

    Parameters
    ----------
    given : ManualPoints
        With at least four pairs that are never removed.
    shape : (height, width) of the reference
        A homography must not fold within it.
    sensor : str
        Named in a refusal.

    Raises
    ------
    RegistrationRefused
        ``E_MATCHES`` with fewer than four pairs, or with pairs on one line.

    Notes
    -----
    The map with the least leave-one-out error is taken: of linear least squares the residual r of a pair with leverage H
    becomes (1 − H)⁻¹ r without it ([belsley1980]_).

    Examples
    --------
    >>> corners = np.array([[0.0, 0], [90, 0], [90, 90], [0, 90], [40, 50]])
    >>> given = ManualPoints(added=np.hstack([corners, 2 * corners + 1]))
    >>> placed = place_by_hand(given, (100, 100))
    >>> placed.model, placed.transform(np.array([[4.0, 5.0]])).round(6).tolist(), placed.fit_px < 1e-9
    ('similarity', [[9.0, 11.0]], True)
    """
    pairs = given.fixed
    _check(pairs, sensor)
    p, q = pairs[:, :2], pairs[:, 2:]
    affine = Affine.fit(p, q)
    fitted: dict[str, Transform] = {"similarity": _similarity(p, q, affine), "affine": affine}
    if (plane := _homography(p, q, shape)) is not None:
        fitted["homography"] = plane
    missed = {name: _missed(transform, p, q) for name, transform in fitted.items()}
    without = {name: _left_out(missed[name], p, name) for name in fitted}
    errors = {name: float(np.sqrt(np.square(one).sum(1).mean())) for name, one in without.items()}
    slope = float(np.sqrt(abs(np.linalg.det(affine.matrix[:, :2]))))
    hand = HAND_PX * float(np.hypot(1, 1 / max(slope, 1e-9)))
    sound = [name for name in fitted if _deviation(missed[name], name) <= BEYOND_A_HAND * hand]
    best = min(sound or errors, key=lambda name: (round(errors[name], 6), PARAMETERS[name]))
    weights = {
        name: min(1.0, errors[best] / error) ** len(p) if error else 1.0
        for name, error in errors.items()
    }
    others = [(fitted[n], w) for n, w in weights.items() if n != best and (w or n == "affine")]
    return PlacedByHand(
        best,
        fitted[best],
        given,
        np.linalg.norm(missed[best], axis=1),
        np.linalg.norm(without[best], axis=1),
        max(hand, _deviation(missed[best], best)),
        tuple(others),
    )


def leverage(points: np.ndarray, among: np.ndarray, model: str) -> np.ndarray:
    """Return the covariance, (n, 2, 2), of a map at `points`, (n, 2), for unit variance of the pairs at `among`, (m, 2).

    The trace over all pairs is the number of parameters:

    >>> corners = np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]])
    >>> [round(float(np.trace(leverage(corners, corners, m).sum(0))), 6) for m in PARAMETERS]
    [4.0, 6.0, 8.0]
    """
    centre, size = among.mean(0), float(np.abs(among - among.mean(0)).max()) or 1.0
    here = _fields((points - centre) / size, model)
    fields = _fields((among - centre) / size, model)
    inverse = np.linalg.pinv(np.einsum("nak,nal->kl", fields, fields))
    return np.asarray(np.einsum("nak,kl,nbl->nab", here, inverse, here))


def _fields(points: np.ndarray, model: str) -> np.ndarray:
    """Return the displacements, (n, 2, parameters), by which a model of map can move."""
    x, y = points.T
    one, nil = np.ones_like(x), np.zeros_like(x)
    shift = [(one, nil), (nil, one)]
    if model == "similarity":
        fields = [*shift, (x, y), (-y, x)]
    else:
        fields = [*shift, (x, nil), (y, nil), (nil, x), (nil, y)]
    if model == "homography":
        fields += [(x * x, x * y), (x * y, y * y)]
    return np.stack([np.stack(field, -1) for field in fields], -1)


def _check(pairs: np.ndarray, sensor: str) -> None:
    """Refuse pairs that determine no map."""
    field = sensor or None
    if len(pairs) < LEAST_PAIRS:
        raise RegistrationRefused(
            Problem(
                "E_MATCHES",
                "too few pairs by hand to place this sensor by them",
                field=field,
                found=len(pairs),
                expected=f"at least {LEAST_PAIRS}",
                fix="Add pairs in `levkas inspect CAMPAIGN`, or take `accept` out of edits.toml.",
            )
        )
    for points in (pairs[:, :2], pairs[:, 2:]):
        along, across = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if across > LEAST_ACROSS * along:
            continue
        raise RegistrationRefused(
            Problem(
                "E_MATCHES",
                "the pairs by hand lie on one line, which determines no map",
                field=field,
                found=f"{along:.1f} px along and {across:.1f} px across",
                fix="Add pairs beside that line in `levkas inspect CAMPAIGN`, far apart and near the corners of the object.",
            )
        )


def _similarity(p: np.ndarray, q: np.ndarray, affine: Affine) -> Affine:
    unit = np.broadcast_to(np.eye(2), (len(p), 2, 2))
    mirrored = np.linalg.det(affine.matrix[:, :2]) < 0
    turned = np.broadcast_to(np.diag([1.0, -1.0 if mirrored else 1.0]), unit.shape)
    return fit_similarity(Observations(p, q, turned, unit))


def _homography(p: np.ndarray, q: np.ndarray, shape: tuple[int, ...]) -> Homography | None:
    """Fit a homography in the least squares of reference px; None where there is none, or it folds in the frame."""
    try:
        plane = Homography.fit(p, q)
        centre, size = p.mean(0), float(np.abs(p - p.mean(0)).max())
        into = np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, size]]) / size
        design = _fields((p - centre) / size, "homography").reshape(-1, 8)
        for _ in range(POLISHING):
            missed = _missed(plane, p, q) / size
            a = np.linalg.lstsq(design, missed.reshape(-1), rcond=None)[0]
            turn = np.array([[1 + a[2], a[3], a[0]], [a[4], 1 + a[5], a[1]], [-a[6], -a[7], 1]])
            matrix = plane.matrix @ np.linalg.inv(into) @ turn @ into
            plane = Homography(matrix / matrix[2, 2])
    except (ValueError, np.linalg.LinAlgError):
        return None
    height, width = shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    below = np.concatenate([p, corners]) @ plane.matrix[2, :2] + plane.matrix[2, 2]
    sound = np.isfinite(plane.matrix).all() and (np.sign(below) == np.sign(below[0])).all()
    return plane if sound else None


def _missed(transform: Transform, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return (n, 2) residuals in reference px."""
    return solve_2x2(transform.jacobian(p), q - transform(p))


def _left_out(missed: np.ndarray, p: np.ndarray, model: str) -> np.ndarray:
    """Return the residuals, (n, 2), of maps without the pair itself; infinite where the others determine none."""
    if 2 * (len(p) - 1) < PARAMETERS[model]:
        return np.full(missed.shape, np.inf)
    rest = np.eye(2) - leverage(p, p, model)
    known = np.linalg.eigvalsh(rest)[:, 0] > 1e-9
    result = np.full(missed.shape, np.inf)
    result[known] = np.linalg.solve(rest[known], missed[known][..., None])[..., 0]
    return result


def _deviation(missed: np.ndarray, model: str) -> float:
    """Return the standard deviation of a pair, either axis, by the freedom that is left; 0 where none is."""
    free = missed.size - PARAMETERS[model]
    return float(np.sqrt(np.square(missed).sum() / free)) if free > 0 else 0.0

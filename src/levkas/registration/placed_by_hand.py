"""Map of one sensor fitted to pairs that a person placed, and to nothing else: a similarity, an affine map or a homography."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from levkas.geometry.transforms import Affine, Homography, Transform, solve_2x2
from levkas.registration.advice import LEAST_PAIRS
from levkas.registration.manual_points import HAND_PX, ManualPoints
from levkas.registration.models import fit_plane
from levkas.registration.record import HandMark, Matches, MatchState, Sigma, refusal
from levkas.registration.uncertainty import DECIMALS, LATTICE, lattice_over

PARAMETERS = {"similarity": 4, "affine": 6, "homography": 8}
"""Parameters of each map that may be fitted, from the stiffest to the most yielding."""
BEYOND_A_HAND = 4.0
"""Residual of an affine map through four pairs, in standard deviations of a hand, from which a homography is taken: chance
gives it in one set of four in 3000. Between 3 and 6, maps of tilted cameras and of careless hands are distinguished as well."""
LEAST_ACROSS = 0.02
"""Spread of the pairs across over that along; below, they lie on one line and determine no map."""
MOVED_PX = 0.1
"""By which pairs are moved, one after another, to see how much the map follows."""


@dataclass(frozen=True)
class PlacedByHand:
    """Map through a person's pairs, with what they leave of an error."""

    model: str
    transform: Transform
    """Reference px → native px of the target."""
    given: ManualPoints
    """The person's pairs; the map is fitted to those that are never removed, n of them."""
    residual: np.ndarray
    leave_one_out: np.ndarray
    """`residual`, `leave_one_out`: (n,), reference px. How far each pair lies from the map; from a map without this pair,
    infinite where the others determine none."""
    spread: float
    """In reference px: standard deviation of a pair, either axis; never less than a hand's."""
    alternatives: tuple[tuple[Transform, float], ...] = ()
    """The other maps that the pairs allow, each with its weight, 0 … 1."""

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

        Variance of a pair times how much the place follows it, over all pairs, and the spread between the maps that the pairs allow ([buckland1997]_).
        """
        x, y, points = lattice_over(shape)
        jacobian, here = self.transform.jacobian(points), self.transform(points)

        def squares(other: Transform) -> np.ndarray:
            return np.asarray(np.square(solve_2x2(jacobian, other(points) - here)).sum(1) / 2)

        p, q = self.pairs[:, :2], self.pairs[:, 2:]
        steps, variance = MOVED_PX * self.transform.jacobian(p), np.zeros(len(points))
        for pair, axis in np.ndindex(len(p), 2):
            moved = q.copy()
            moved[pair] += steps[pair, :, axis]
            follows = squares(fit_plane(self.model, p, moved)) / MOVED_PX**2
            variance += self.spread**2 * follows
        total = 1 + sum(weight for _, weight in self.alternatives)
        for other, weight in self.alternatives:
            variance += weight / total * squares(other)
        values = np.sqrt(variance).reshape(LATTICE[::-1])
        return Sigma(x, y, np.round(values, DECIMALS))

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers of a verdict, JSON-ready; ``worst`` is the place and the error of the worst pair."""
        fit, worst = self.fit_px, int(np.argmax(self.leave_one_out))
        place = (*self.pairs[worst, :2], self.leave_one_out[worst])
        known = np.isfinite(self.leave_one_out).all()
        return {
            "pairs": len(self.pairs),
            "model": self.model,
            "fit_px": None if fit is None else round(fit, 3),
            "worst": [round(float(v), 2) for v in place] if known else None,
        }

    def matches(self) -> Matches:
        """Return the table of the pairs, each with its mark; deleted ones last."""
        p, q = np.hsplit(self.pairs, 2)
        found = Matches.of(
            p, q,
            residual=self.residual,
            leave_one_out=np.where(np.isfinite(self.leave_one_out), self.leave_one_out, np.nan),
            reason=self.given.mark(p, q).reason,
        )  # fmt: skip
        deleted = self.given.deleted
        left = Matches.of(
            *np.hsplit(deleted, 2),
            weight=np.zeros(len(deleted)),
            state=np.full(len(deleted), MatchState.REMOVED, object),
            reason=np.full(len(deleted), HandMark.DELETED, object),
        )
        both = (
            np.concatenate([getattr(part, column.name) for part in (found, left)])
            for column in fields(Matches)
        )
        return Matches(*both)


def place_by_hand(given: ManualPoints, shape: tuple[int, ...], sensor: str = "") -> PlacedByHand:
    """Fit the map with the least leave-one-out error to a person's pairs: a similarity, an affine map or a homography.

    A homography must not fold within the reference, (height, width). Raises RegistrationRefused (``E_MATCHES``), naming `sensor`, with
    fewer than four pairs that are never removed, or with pairs on one line.

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
    p, q = np.hsplit(pairs, 2)
    affine = Affine.fit(p, q)
    fitted: dict[str, Transform] = {"similarity": fit_plane("similarity", p, q), "affine": affine}
    plane = _tried("homography", p, q)
    if isinstance(plane, Homography) and _is_sound(plane, p, shape):
        fitted["homography"] = plane
    missed = {name: solve_2x2(t.jacobian(p), q - t(p)) for name, t in fitted.items()}
    without = {name: _left_out(t, name, p, q) for name, t in fitted.items()}
    errors = {name: float(np.sqrt(np.square(one).sum(1).mean())) for name, one in without.items()}
    slope = float(np.sqrt(abs(np.linalg.det(affine.matrix[:, :2]))))
    hand = HAND_PX * float(np.hypot(1, 1 / max(slope, 1e-9)))
    free = {name: max(2 * len(p) - PARAMETERS[name], 0) for name in fitted}
    spread = {
        name: float(np.sqrt(np.square(one).sum() / free[name])) if free[name] else 0.0
        for name, one in missed.items()
    }
    sound = [name for name in fitted if spread[name] <= BEYOND_A_HAND * hand]
    best = min(sound or errors, key=lambda name: (round(errors[name], 6), PARAMETERS[name]))
    weights = {
        name: min(1.0, errors[best] / error) ** len(p) if error else 1.0
        for name, error in errors.items()
    }
    others = [(fitted[n], w) for n, w in weights.items() if n != best and (w or n == "affine")]
    return PlacedByHand(
        best, fitted[best], given,
        np.linalg.norm(missed[best], axis=1), np.linalg.norm(without[best], axis=1),
        max(hand, spread[best]), tuple(others),
    )  # fmt: skip


def _check(pairs: np.ndarray, sensor: str) -> None:
    """Refuse pairs that determine no map."""
    if len(pairs) < LEAST_PAIRS:
        raise refusal(
            "E_MATCHES",
            "too few pairs by hand to place this sensor by them",
            field=sensor or None,
            found=len(pairs),
            expected=f"at least {LEAST_PAIRS}",
            fix="Add pairs in `levkas inspect CAMPAIGN`, or take `accept` out of edits.toml.",
        )
    for points in np.hsplit(pairs, 2):
        along, across = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if across <= LEAST_ACROSS * along:
            raise refusal(
                "E_MATCHES",
                "the pairs by hand lie on one line, which determines no map",
                field=sensor or None,
                found=f"{along:.1f} px along and {across:.1f} px across",
                fix="Add pairs beside that line in `levkas inspect CAMPAIGN`, far apart and near the corners of the object.",
            )


def _tried(model: str, p: np.ndarray, q: np.ndarray) -> Transform | None:
    """Fit a map; None where the pairs determine none."""
    try:
        return fit_plane(model, p, q)
    except (ValueError, np.linalg.LinAlgError):
        return None


def _is_sound(plane: Homography, p: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Return whether a homography does not fold in the frame (height, width), nor at the pairs."""
    height, width = shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    below = np.concatenate([p, corners]) @ plane.matrix[2, :2] + plane.matrix[2, 2]
    return bool(np.isfinite(plane.matrix).all() and (np.sign(below) == np.sign(below[0])).all())


def _left_out(whole: Transform, model: str, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the residuals, (n, 2) reference px, of maps without the pair itself; infinite where the others determine none."""
    result = np.full(p.shape, np.inf)
    for left in range(len(p) if 2 * (len(p) - 1) >= PARAMETERS[model] else 0):
        rest = _tried(model, np.delete(p, left, 0), np.delete(q, left, 0))
        if rest is not None:
            here = p[left : left + 1]
            result[left] = solve_2x2(whole.jacobian(here), q[left : left + 1] - rest(here))[0]
    return np.where(np.isfinite(result), result, np.inf)

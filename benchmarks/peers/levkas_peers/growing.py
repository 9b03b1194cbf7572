"""The models that dual-bootstrap ICP climbs, from one match to the whole picture.

Each is a function of coordinates that are centred and divided by half the diagonal, with its
derivatives by the parameters. The quadratic ladder is that of [stewart2003]_ (similarity, affine,
quadratic), the other that of [yang2007]_ (similarity, affine, homography, homography with a radial
distortion of either picture).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

DIFFERENCE = 1e-6


@dataclass(frozen=True)
class Form:
    """One kind of map: `apply(parameters, points)` and the parameters of no map at all.

    Parameters
    ----------
    name : str
    apply : callable
        (k,), (n, 2) → (n, 2).
    identity : ndarray, (k,)
    lift : dict of str to callable
        Parameters of a poorer form, by its name → parameters of this one.
    """

    name: str
    apply: Callable[[np.ndarray, np.ndarray], np.ndarray]
    identity: np.ndarray
    lift: dict[str, Callable[[np.ndarray], np.ndarray]]

    def derivatives(self, parameters: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(parameters), (n, 2, k), by differences."""
        columns = [
            (self.apply(parameters + step, points) - self.apply(parameters - step, points))
            / (2 * DIFFERENCE)
            for step in np.eye(len(parameters)) * DIFFERENCE
        ]
        return np.stack(columns, axis=2)


def _similarity(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    a, b, x, y = p
    return np.stack([a * q[:, 0] - b * q[:, 1] + x, b * q[:, 0] + a * q[:, 1] + y], 1)


def _affine(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return np.asarray(q @ p.reshape(2, 3)[:, :2].T + p.reshape(2, 3)[:, 2])


def _quadratic(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    u, v = q.T
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], 1) @ p.reshape(6, 2)


def _homography(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    matrix = np.append(p, 1.0).reshape(3, 3)
    lifted = q @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(lifted[:, :2] / lifted[:, 2:])


def _radial(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    straight = _homography(p[:8], q * (1 + p[8] * np.sum(q * q, axis=1, keepdims=True)))
    return np.asarray(straight * (1 + p[9] * np.sum(straight**2, axis=1, keepdims=True)))


def _affine_of(p: np.ndarray) -> np.ndarray:
    a, b, x, y = p
    return np.array([a, -b, x, b, a, y])


def _quadratic_of(p: np.ndarray) -> np.ndarray:
    a, b, x, c, d, y = p
    return np.array([x, y, a, c, b, d, 0, 0, 0, 0, 0, 0])


def _homography_of(p: np.ndarray) -> np.ndarray:
    return np.append(p, [0.0, 0.0])


def _radial_of(p: np.ndarray) -> np.ndarray:
    return np.append(p, [0.0, 0.0])


SIMILARITY = Form("similarity", _similarity, np.array([1.0, 0, 0, 0]), {})
AFFINE = Form("affine", _affine, np.array([1.0, 0, 0, 0, 1, 0]), {"similarity": _affine_of})
QUADRATIC = Form("quadratic", _quadratic, _quadratic_of(AFFINE.identity), {"affine": _quadratic_of})
HOMOGRAPHY = Form(
    "homography", _homography, _homography_of(AFFINE.identity), {"affine": _homography_of}
)
RADIAL = Form(
    "homography and radial", _radial, _radial_of(HOMOGRAPHY.identity), {"homography": _radial_of}
)
LADDERS: dict[str, tuple[Form, ...]] = {
    "quadratic": (SIMILARITY, AFFINE, QUADRATIC),
    "radial": (SIMILARITY, AFFINE, HOMOGRAPHY, RADIAL),
}


@dataclass(frozen=True)
class Fitted:
    """A form with its parameters, their covariance, and how well it stands.

    Parameters
    ----------
    form : Form
    parameters : ndarray, (k,)
    covariance : ndarray, (k, k)
    score : float
        Of [bubna2000]_: d/2·log 2π − ½ Σ w·e²/σ² + ½ log det Σ; the largest is chosen.
    sigma : float
        Robust scale of the distances, in the coordinates of the form.
    """

    form: Form
    parameters: np.ndarray
    covariance: np.ndarray
    score: float
    sigma: float

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self.form.apply(self.parameters, points)

    def transfer(self, points: np.ndarray) -> np.ndarray:
        """Return the covariance of where points are mapped to, (n, 2, 2)."""
        d = self.form.derivatives(self.parameters, points)
        return d @ self.covariance @ d.transpose(0, 2, 1)

"""Dual-bootstrap iterative closest points, written from the papers [stewart2003]_ [yang2007]_.

One match of key points gives a similarity that holds in a small region around it. Then, in turns:
faces and corners inside the region are matched to the closest of the other picture and the map is
refitted robustly; a richer model is taken where the region supports it; the region grows, each side
by as much as the map is certain there. When the region has grown over the picture, the alignment is
accepted if it is accurate, stable and consistent, else the next match is tried. (US 7,177,486.)

Ours, where the papers leave a choice or their code is not to be had: SIFT key points in order of
their ratio, derivatives by differences, matching in one direction only, and the thresholds below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from levkas.registration.bands import stretch
from levkas.registration.features import KeyPoints, find_key_points
from levkas.registration.matching import find_neighbours
from levkas_peers.growing import LADDERS, Fitted, Form
from levkas_peers.pair import Answer, NoAnswer
from levkas_peers.structures import Structures, find_structures

if TYPE_CHECKING:
    from collections.abc import Callable

    from levkas_peers.pair import Pair

MOST_STARTS = 60
ROUNDS = 60
REFITS = 4
"""Robust least squares a round of matching."""
START_SIDE_PX = 60.0
GROWTH = np.sqrt(2.0) - 1
TUKEY = 4.0
CORNER_WEIGHT = 1.0
LEAST_SIGMA_PX = 0.1
FEWEST_MATCHES = 24
ACCURATE_PX, STABLE_PX, CONSISTENT = 1.0, 1.0, 0.7
LEAST_OVERLAP = 0.3
FOLD_LATTICE, MOST_AREAS = 15, 4.0
NORMALS = 0.9
"""Cosine above which two normals agree: 26 degrees; by chance 0.29 of all do."""


@dataclass(frozen=True)
class Side:
    """One picture in the models' coordinates.

    Parameters
    ----------
    centre, spread : ndarray (2,) and float
        px = coordinates · spread + centre.
    structures : Structures
        In those coordinates.
    key_points : KeyPoints
        In px.
    size : (width, height)
    """

    centre: np.ndarray
    spread: float
    structures: Structures
    key_points: KeyPoints
    size: tuple[int, int]

    @classmethod
    def of(cls, values: np.ndarray, valid: np.ndarray, spread: float) -> Side:
        """Find the structures and key points of a picture."""
        h, w = values.shape
        centre = np.array([(w - 1) / 2, (h - 1) / 2])
        found = find_structures(values, valid)
        picture = stretch(values, valid)
        return cls(
            centre,
            spread,
            Structures(
                (found.faces - centre) / spread, found.normals, (found.corners - centre) / spread
            ),
            find_key_points(picture, valid),
            (w, h),
        )

    def inward(self, points: np.ndarray) -> np.ndarray:
        """px → coordinates."""
        return (points - self.centre) / self.spread

    def outward(self, points: np.ndarray) -> np.ndarray:
        """Coordinates → px."""
        return points * self.spread + self.centre

    @property
    def box(self) -> np.ndarray:
        """Left, top, right and bottom edge in coordinates."""
        return np.concatenate([self.inward(np.zeros(2)), self.inward(np.array(self.size) - 1.0)])


def gdbicp_quadratic(pair: Pair) -> Answer:
    """GDB-ICP up to a quadratic map: "GDB-ICP-2" of the paper's Figure 14."""
    return dual_bootstrap(pair, "quadratic")


def gdbicp_radial(pair: Pair) -> Answer:
    """GDB-ICP up to a homography with radial distortion: "GDB-ICP-3" of the paper's Figure 14."""
    return dual_bootstrap(pair, "radial")


def dual_bootstrap(pair: Pair, ladder: str) -> Answer:
    """Register a pair; NoAnswer where no start grows into an alignment that is accepted."""
    from scipy.spatial import cKDTree

    spread = float(np.hypot(*pair.reference.shape)) / 2
    ours = Side.of(pair.reference, pair.reference_valid, spread)
    theirs = Side.of(pair.target, pair.target_valid, spread)
    trees = (cKDTree(theirs.structures.faces), cKDTree(theirs.structures.corners))
    tried = 0
    best = ""
    for start, box in _starts(ours, theirs):
        tried += 1
        grown = _grow(start, box, ours, theirs, trees, LADDERS[ladder])
        if grown is None:
            continue
        said, good = _judge(grown, ours, theirs, trees)
        if good:
            note = f"{grown.form.name}, start {tried}, {said}"
            return Answer(_whole(grown, ours, theirs), note, "accept")
        best = said
    raise NoAnswer(f"none of {tried} starts grew into an alignment that is accepted. {best}")


def _whole(fitted: Fitted, ours: Side, theirs: Side) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: theirs.outward(fitted(ours.inward(points)))


def _starts(ours: Side, theirs: Side):  # type: ignore[no-untyped-def]
    """Yield (similarity, box) of single matches, the most distinctive first."""
    a, b = ours.key_points, theirs.key_points
    if min(len(a), len(b)) < 2:
        return
    near = find_neighbours(a.descriptors, b.descriptors)
    ratio = near.distance / np.maximum(near.second, 1e-12)
    for row in np.argsort(ratio, kind="stable")[:MOST_STARTS]:
        column = int(near.nearest[row])
        turn = np.deg2rad(b.angles[column] - a.angles[row])
        scale = b.sizes[column] / max(a.sizes[row], 1e-6)
        c, s = scale * np.cos(turn), scale * np.sin(turn)
        p, q = ours.inward(a.points[row]), theirs.inward(b.points[column])
        shift = q - np.array([c * p[0] - s * p[1], s * p[0] + c * p[1]])
        half = max(START_SIDE_PX, 6 * a.sizes[row]) / 2 / ours.spread
        form = LADDERS["quadratic"][0]
        parameters = np.array([c, s, *shift])
        # The match is good to about a pixel in place, a tenth in scale and turn.
        covariance = np.diag([0.01, 0.01, 1e-4, 1e-4])
        start = Fitted(form, parameters, covariance, -np.inf, 2.0 / ours.spread)
        yield start, np.concatenate([p - half, p + half])


def _grow(
    fitted: Fitted,
    box: np.ndarray,
    ours: Side,
    theirs: Side,
    trees: tuple,  # type: ignore[type-arg]
    ladder: tuple[Form, ...],
) -> Fitted | None:
    """Refit, choose the model and grow the region until it covers the picture; None where lost."""
    whole = ours.box
    settled = 0
    for _ in range(ROUNDS):
        matches = _match(fitted, box, ours, theirs, trees)
        if len(matches) < max(FEWEST_MATCHES, 3 * len(fitted.parameters)):
            return None
        chosen = _choose(fitted, matches, ladder, LEAST_SIGMA_PX / ours.spread)
        if chosen is None:
            return None
        covered = np.allclose(box, whole)
        moved = np.abs(chosen(_corners(box)) - fitted(_corners(box))).max() * ours.spread
        same = chosen.form is fitted.form
        fitted = chosen
        settled = settled + 1 if covered and same and moved < 0.02 else 0
        if settled >= 2:
            return fitted
        box = _larger(box, fitted, whole, ours.spread)
    return fitted if np.allclose(box, whole) else None


@dataclass(frozen=True)
class Closest:
    """Structures and the closest ones of the other picture, a row a measured direction.

    Parameters
    ----------
    source, goal : ndarray, (n, 2)
    along : ndarray, (n, 2)
        Unit vector in which the distance counts.
    """

    source: np.ndarray
    goal: np.ndarray
    along: np.ndarray

    def __len__(self) -> int:
        return len(self.source)

    def distances(self, fitted: Fitted) -> np.ndarray:
        """Signed distances, (n,), in coordinates."""
        return np.asarray(np.sum((fitted(self.source) - self.goal) * self.along, axis=1))


def _match(fitted: Fitted, box: np.ndarray, ours: Side, theirs: Side, trees: tuple) -> Closest:  # type: ignore[type-arg]
    rows = []
    reach = max(3 * TUKEY * fitted.sigma, 6.0 / ours.spread)
    for kind, tree in zip(("faces", "corners"), trees, strict=True):
        source = getattr(ours.structures, kind)
        source = source[np.all((source >= box[:2]) & (source <= box[2:]), axis=1)]
        if not len(source) or not tree.n:
            continue
        away, index = tree.query(fitted(source), distance_upper_bound=reach)
        found = np.isfinite(away)
        source, index = source[found], index[found]
        goal = tree.data[index]
        if kind == "faces":
            rows.append((source, goal, theirs.structures.normals[index]))
        else:
            rows += [(source, goal, np.tile(axis, (len(source), 1))) for axis in np.eye(2)]
    if not rows:
        return Closest(*(np.zeros((0, 2)),) * 3)
    return Closest(*(np.concatenate(parts) for parts in zip(*rows, strict=True)))


def _choose(
    fitted: Fitted, matches: Closest, ladder: tuple[Form, ...], least: float
) -> Fitted | None:
    """Refit the model and every richer one that the matches support; the best score is taken."""
    place = [form.name for form in ladder].index(fitted.form.name)
    first = best = _refit(fitted, matches, least, None)
    if first is None or best is None:
        return None
    parameters = first.parameters
    for poorer, richer in pairwise(ladder[place:]):
        parameters = richer.lift[poorer.name](parameters)
        if len(matches) < 6 * len(parameters):
            break
        start = Fitted(richer, parameters, np.eye(len(parameters)), -np.inf, first.sigma)
        other = _refit(start, matches, least, first.sigma)
        if other is None:
            break
        parameters = other.parameters
        best = other if other.score > best.score else best
    return best


def _refit(fitted: Fitted, matches: Closest, least: float, sigma: float | None) -> Fitted | None:
    """Iteratively reweighted least squares under Tukey's biweight [stewart2003]_."""
    form, parameters = fitted.form, fitted.parameters
    current = fitted
    # The map hardly moves within a round: its slopes are taken once, as in a chord method.
    slopes = np.einsum("ni,nik->nk", matches.along, form.derivatives(parameters, matches.source))
    for _ in range(REFITS):
        errors = matches.distances(current)
        scale = sigma or max(1.4826 * float(np.median(np.abs(errors))), least)
        weights = np.maximum(0.0, 1 - (errors / (TUKEY * scale)) ** 2) ** 2
        normal = (slopes * weights[:, None]).T @ slopes
        try:
            step = np.linalg.solve(
                normal + 1e-12 * np.trace(normal) * np.eye(len(normal)),
                slopes.T @ (weights * errors),
            )
        except np.linalg.LinAlgError:
            return None
        parameters = parameters - step
        current = replace(current, parameters=parameters)
    if not np.isfinite(parameters).all() or weights.sum() < 2 * len(parameters):
        return None
    covariance = scale**2 * np.linalg.pinv(normal)
    sign, log_det = np.linalg.slogdet(covariance)
    if sign <= 0:
        return None
    cost = float(np.sum(weights * (matches.distances(current) / scale) ** 2))
    score = len(parameters) / 2 * np.log(2 * np.pi) - cost / 2 + log_det / 2
    return Fitted(form, parameters, covariance, score, scale)


def _corners(box: np.ndarray) -> np.ndarray:
    left, top, right, bottom = box
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def _larger(box: np.ndarray, fitted: Fitted, whole: np.ndarray, spread: float) -> np.ndarray:
    """Move every side outwards by as much as the map is certain at its middle [stewart2003]_."""
    left, top, right, bottom = box
    middle = np.array([(left + right) / 2, (top + bottom) / 2])
    sides = np.array([[left, middle[1]], [middle[0], top], [right, middle[1]], [middle[0], bottom]])
    outward = np.array([[-1.0, 0], [0, -1], [1, 0], [0, 1]])
    linear = fitted.transfer(sides)
    doubt = np.sqrt(np.einsum("ni,nij,nj->n", outward, linear, outward)) * spread
    reach = np.abs(np.sum((sides - middle) * outward, axis=1))
    grown = GROWTH * reach / np.maximum(1.0, doubt)
    larger = box + grown * np.array([-1, -1, 1, 1])
    return np.concatenate([np.maximum(larger[:2], whole[:2]), np.minimum(larger[2:], whole[2:])])


def _folded(fitted: Fitted, ours: Side) -> bool:
    """Tell whether the map turns a part of the picture over, or scales parts of it very unlike."""
    x, y = (np.linspace(ours.box[k], ours.box[k + 2], FOLD_LATTICE) for k in (0, 1))
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    step = 1e-4
    across, down = (fitted(places + step * axis) - fitted(places) for axis in np.eye(2))
    area = across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]
    return bool(
        not np.isfinite(area).all() or area.min() <= 0 or area.max() > MOST_AREAS * area.min()
    )


def _judge(fitted: Fitted, ours: Side, theirs: Side, trees: tuple) -> tuple[str, bool]:  # type: ignore[type-arg]
    """Accurate, stable and consistent, over all of the overlap [yang2007]_."""
    faces = ours.structures.faces
    mapped = fitted(faces)
    inside = np.all((mapped >= theirs.box[:2]) & (mapped <= theirs.box[2:]), axis=1)
    if inside.mean() < LEAST_OVERLAP or inside.sum() < FEWEST_MATCHES:
        return "the pictures hardly overlap", False
    if _folded(fitted, ours):
        return "the map folds", False
    away, index = trees[0].query(mapped[inside])
    near = away * ours.spread < 3 * ACCURATE_PX
    across = theirs.structures.normals[index]
    error = np.abs(np.sum((mapped[inside] - trees[0].data[index]) * across, axis=1)) * ours.spread
    step = 1e-4
    turned = fitted(faces[inside] + step * ours.structures.normals[inside]) - mapped[inside]
    cosine = np.abs(np.sum(turned * across, axis=1)) / np.maximum(
        np.linalg.norm(turned, axis=1), 1e-12
    )
    accuracy = float(np.mean(error[near])) if near.any() else np.inf
    agreement = float(np.mean(cosine[near] > NORMALS)) if near.any() else 0.0
    doubt = (
        float(np.sqrt(np.trace(fitted.transfer(_corners(ours.box)), axis1=1, axis2=2).max()))
        * ours.spread
    )
    good = accuracy < ACCURATE_PX and doubt < STABLE_PX and agreement > CONSISTENT
    return (
        f"error {accuracy:.2f} px, stable to {doubt:.2f} px, {agreement:.0%} of normals agree",
        good,
    )

"""How one strip of a line scan lies to the next: found in what both saw, to a fraction of a pixel.

A strip is the scan of one pass of the stage; the next pass begins some samples to the right. Each line is
exposed at once, so that a stage that runs askew moves lines as a whole: the offset of two strips is a function of the line
alone, p ↦ p + t + c·y. Where it wobbles they are not joined: each is registered by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from levkas.geometry.transforms import Affine, Composed
from levkas.registration.local_shifts import CELL_PX, Predictor, smoothing_warp
from levkas.registration.record import RegistrationRefused, refusal

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from levkas.geometry.transforms import Transform

LEAST_OVERLAP = 8
"""Samples of the right strip that are looked for in the left one."""
NARROWEST = 16
"""Samples of an overlap; in fewer no window of Lucas-Kanade is usable."""
LEAST_CORRELATION = 0.7
LARGEST_ERROR_PX = 0.15
"""Standard error of the offset; beyond it the overlap shows too little."""
MOST_SCATTER_PX, NOISE = 0.2, 4.0
"""Of rows of windows about the course: of strips of a stage that wobbles it is more, and more than so many times their own
noise; they are not joined."""
MOST_SHIFT = 16
"""Lines that one strip may begin later than the next, at most, and an eighth of them."""
SCOUT_LINES = 2048
PEAKS = 6
"""Places at which the first samples of the right strip look like the left one, that are looked at whole."""
SECOND_PLACE = 1.5
"""A second place is as likely as the best where it leaves less than this times what the best one leaves unexplained."""
WHOLE_PX = 0.03
"""Offsets so near to whole pixels are taken as whole: nothing is resampled."""
GAIN = 0.75
"""A richer course has to lower the squared error at bands that were left out to this share."""
ROUNDS, CONVERGED_PX = 8, 0.002
Greys = tuple[np.ndarray, np.ndarray]
"""Means of the even and of the odd bands, (lines, samples) each, float32, NaN where nothing can be relied on."""


@dataclass(frozen=True, eq=False)
class StripJoint:
    """Where the right one of two strips lies."""

    transform: Transform
    """Px of the left strip → px of the right one."""
    offset: tuple[float, float]
    """In px: where the right strip's first pixel lies in the left one, the mean over the common lines."""
    overlap: float
    """Samples that both saw."""
    course: str
    """``"whole pixels"``, ``"constant"`` or ``"slope"``: how the offset goes along the scan."""
    swing: float
    """In px: largest departure of the offset from its mean."""
    error: float
    """In px: standard error of the offset."""
    correlation: float
    """Of the greys over the overlap, joined."""


class _Windows(NamedTuple):
    """Residual offsets by rows of windows: lines, (n,), offsets, (n, 2), and their information, (n, 2, 2)."""

    line: np.ndarray
    shift: np.ndarray
    information: np.ndarray


@dataclass(frozen=True)
class _Course:
    """An offset along the scan, c₀ + c₁ y/`height`: coefficients, (1, 2) or (2, 2) px."""

    height: int
    coefficients: np.ndarray

    def __call__(self, line: np.ndarray) -> np.ndarray:
        return np.asarray(_design(line / self.height, len(self.coefficients)) @ self.coefficients)

    @property
    def name(self) -> str:
        return "constant" if len(self.coefficients) == 1 else "slope"

    def transform(self, start: tuple[int, int]) -> Affine:
        """Return px of the left strip → px of the right one, whose first pixel lies at `start` and the course."""
        c = -self.coefficients
        slope = c[1] / self.height if len(c) == 2 else np.zeros(2)
        mean = c[0] - start
        return Affine(np.array([[1.0, slope[0], mean[0]], [0.0, 1 + slope[1], mean[1]]]))


def find_joint(left: Greys, right: Greys) -> StripJoint:
    """Find where the right one of two strips lies.

    Raises RegistrationRefused e_STRIPS where the offset is not certain: no place matches, two places match, or the overlap
    has too little detail.

    Parameters
    ----------
    left, right : pair of ndarray, (lines, samples), float32
        Means of the even and of the odd bands of each; of one band twice the same.

    Returns
    -------
    joint : StripJoint

    Notes
    -----
    The first 8 samples of the right strip are looked for in the left one; the best places are compared over the
    whole overlap. From there Lucas-Kanade, window by window, as registration has it. A slope is taken where it predicts the
    offsets of the bands left out better than a constant.
    """
    overlap, shift = _search(*(_filled(np.mean(pair, 0)) for pair in (left, right)))
    start = left[0].shape[1] - overlap, shift
    course = _Course(left[0].shape[0], np.zeros((1, 2)))
    for _ in range(ROUNDS):
        halves = [
            _measure(a, b, course.transform(start), start[0])
            for a, b in zip(left, right, strict=True)
        ]
        line = halves[0].line
        absolute = [half._replace(shift=half.shift + course(line)) for half in halves]
        before, course = course, _chosen(absolute, left[0].shape[0])
        if np.abs(course(line) - before(line)).max() < CONVERGED_PX:
            break
    error, scatter = _error(absolute, course)
    if scatter > MOST_SCATTER_PX:
        raise _apart(
            f"lines of the strips lie ± {scatter:.2f} px beside one another", "lines that lie still"
        )
    if course.name == "constant" and np.abs(_fraction(course.coefficients[0])).max() < WHOLE_PX:
        course = _Course(course.height, np.round(course.coefficients))
        name = "whole pixels"
    else:
        name = course.name
    joint = _described(left, right, course, start, name, error)
    if not joint.error <= LARGEST_ERROR_PX:
        raise _apart(
            f"the offset has an uncertainty of ± {joint.error:.2f} px", "more detail in the overlap"
        )
    if not joint.correlation >= LEAST_CORRELATION:
        raise _apart(_best(joint.overlap, joint.correlation))
    return joint


def _described(
    left: Greys, right: Greys, course: _Course, start: tuple[int, int], name: str, error: float
) -> StripJoint:
    transform = course.transform(start)
    height = min(left[0].shape[0], right[0].shape[0])
    along = course(np.arange(0.0, height, max(1, height // 500)))
    offset = along.mean(0) + start
    views = _resampled_pair(np.mean(left, 0), np.mean(right, 0), transform, start[0])
    return StripJoint(
        transform,
        (float(offset[0]), float(offset[1])),
        float(left[0].shape[1] - offset[0]),
        name,
        float(np.abs(along - along.mean(0)).max()),
        error,
        _correlation(*views),
    )


# --- whole pixels


def _search(a: np.ndarray, b: np.ndarray) -> tuple[int, int]:
    """Return (overlap, shift) in whole px: line y of `a` is line y − shift of `b`."""
    lines = min(a.shape[0], b.shape[0])
    room, tall = min(MOST_SHIFT, lines // 8), min(lines, SCOUT_LINES)
    if min(a.shape[1], b.shape[1]) < LEAST_OVERLAP or tall - 2 * room < LEAST_OVERLAP:
        raise _apart(f"{a.shape[1]} and {b.shape[1]} samples of {lines} lines")
    first = (lines - tall) // 2
    patch = b[first + room : first + tall - room, :LEAST_OVERLAP]
    scores = cv2.matchTemplate(a[first : first + tall], patch, cv2.TM_CCOEFF_NORMED)
    scores = np.nan_to_num(scores, nan=-1.0, posinf=-1.0)
    found = []
    for down, across in _peaks(scores):
        overlap, shift = a.shape[1] - across, down - room
        if overlap <= b.shape[1]:
            pair = _common_lines(a[:, -overlap:], b[:, :overlap], shift)
            found.append((_correlation(*pair), overlap, shift))
    found.sort(key=lambda one: -one[0])
    if not found:
        raise _apart("the first samples of the second strip were not found in the first")
    best, *others = found
    second_places = [one for one in others if 1 - one[0] < SECOND_PLACE * (1 - best[0])]
    if second_places and best[0] >= LEAST_CORRELATION:
        places = " and ".join(str(one[1]) for one in (best, second_places[0]))
        raise _apart(
            f"overlaps of {places} samples match equally well",
            "an overlap without repeating detail",
        )
    return best[1], best[2]


def _peaks(scores: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield rows and columns of the highest places that are higher than all around them, best first."""
    highest = scores >= cv2.dilate(scores, np.ones((5, 5), np.uint8))
    rows, columns = np.nonzero(highest)
    order = np.argsort(-scores[rows, columns], kind="stable")[:PEAKS]
    yield from ((int(rows[n]), int(columns[n])) for n in order)


def _filled(grey: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(grey), grey, np.nanmean(grey)).astype(np.float32)


def _common_lines(a: np.ndarray, b: np.ndarray, shift: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lines of `a` and `b` that show the same, a[y] beside b[y − shift]."""
    first, last = max(0, shift), min(a.shape[0], b.shape[0] + shift)
    return a[first:last], b[first - shift : last - shift]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    both = np.isfinite(a) & np.isfinite(b)
    one, two = a[both].astype(float), b[both].astype(float)
    if one.size < LEAST_OVERLAP**2:
        return -1.0
    one, two = one - one.mean(), two - two.mean()
    scale = np.sqrt(np.sum(one**2) * np.sum(two**2))
    return float(np.sum(one * two) / scale) if scale > 0 else -1.0


# --- fractions of a pixel


def _resampled_pair(
    a: np.ndarray, b: np.ndarray, transform: Transform, left: int
) -> tuple[np.ndarray, ...]:
    """Return both strips over the overlap, resampled with one kernel in px of the left one."""
    corner = Affine(np.array([[1.0, 0, left], [0, 1, 0]]))
    shape = a.shape[0], a.shape[1] - left
    maps: tuple[Transform, ...] = (corner, Composed(corner, transform))
    return tuple(smoothing_warp(g, m, shape) for g, m in zip((a, b), maps, strict=True))


def _measure(a: np.ndarray, b: np.ndarray, transform: Transform, left: int) -> _Windows:
    """Return how far the right strip still lies off, by rows of windows."""
    one, two = _resampled_pair(a, b, transform, left)
    cell = int(np.clip(one.shape[1] // 3, 4, CELL_PX))
    predictor = Predictor(one[None], cell=cell)
    found = predictor.compare(two)
    rows = predictor.shape[0] // predictor.cell
    shift, information = found.shift.reshape(rows, -1, 2), found.information.reshape(rows, -1, 2, 2)
    # target(map(x)) = scene(x + e): the right strip's content lies e too far left.
    share = 3 * min(3, shift.shape[1])  # windows share pixels with those beside and below
    total = information.sum(1) / share
    goal = np.einsum("rcij,rcj->ri", information, shift) / share
    usable = np.linalg.det(total) > 1e-9 * np.maximum(np.trace(total, axis1=1, axis2=2), 1e-30) ** 2
    if usable.sum() < 2:
        raise _apart(
            f"an overlap of {one.shape[1]} samples without detail both along and across the scan",
            f"detail in an overlap of at least {NARROWEST} samples",
        )
    line = found.centres.reshape(rows, -1, 2)[usable, 0, 1]
    return _Windows(
        line, np.linalg.solve(total[usable], goal[usable][..., None])[..., 0], total[usable]
    )


def _design(place: np.ndarray, count: int) -> np.ndarray:
    """Return the weights of `count` coefficients at lines, as shares of the scan, (n, count)."""
    return np.stack([np.ones(len(place)), place], 1)[:, :count]


def _fit(windows: _Windows, height: int, count: int) -> _Course:
    """Fit offsets by weighted least squares with Huber's weights, both axes with their own."""
    design = _design(windows.line / height, count)
    coefficients = np.empty((count, 2))
    for axis in range(2):
        weight = 1 / np.linalg.inv(windows.information)[:, axis, axis]
        goal, robust = windows.shift[:, axis], np.ones(len(weight))
        for _ in range(10):
            root = np.sqrt(weight * robust)
            solved = np.linalg.lstsq(root[:, None] * design, root * goal, rcond=None)[0]
            miss = np.abs(goal - design @ solved) * np.sqrt(weight)
            robust = np.minimum(
                1.0, 1.5 * 1.4826 * max(np.median(miss), 1e-12) / np.maximum(miss, 1e-12)
            )
        coefficients[:, axis] = solved
    return _Course(height, coefficients)


def _chosen(halves: Sequence[_Windows], height: int) -> _Course:
    """Return a constant, or a slope where it predicts the other half of the bands better."""
    errors = []
    for count in (1, 2):
        error = 0.0
        for one, other in (halves, halves[::-1]):
            miss = other.shift - _fit(one, height, count)(other.line)
            size = np.einsum("ni,nij,nj->n", miss, other.information, miss)
            error += float(np.minimum(size, 9 * max(np.median(size), 1e-12)).sum())
        errors.append(error)
    return _fit(_together(halves), height, 2 if errors[1] < GAIN * errors[0] else 1)


def _together(halves: Sequence[_Windows]) -> _Windows:
    one, two = halves
    total = one.information + two.information
    goal = sum(np.einsum("nij,nj->ni", h.information, h.shift) for h in halves)
    return _Windows(one.line, np.linalg.solve(total, goal[..., None])[..., 0], total / 2)


def _error(halves: Sequence[_Windows], course: _Course) -> tuple[float, float]:
    """Return the standard error of the offset, px, by the windows' scatter and by what they promise; and that scatter where it is more than noise, else 0."""
    both = _together(halves)
    scatter = 1.4826 * np.median(np.abs(both.shift - course(both.line)), 0)
    share = np.sqrt(min(1.0, 3 * len(course.coefficients) / len(both.line)))
    promised = np.sqrt(np.diag(np.linalg.inv(both.information.sum(0))))
    noise = np.sqrt(np.median(np.diagonal(np.linalg.inv(both.information), 0, 1, 2), 0))
    beyond = np.where(scatter > NOISE * noise, scatter, 0.0)
    return float(np.maximum(scatter * share, promised).max()), float(beyond.max())


def _fraction(offset: np.ndarray) -> np.ndarray:
    return np.asarray(offset - np.round(offset))


def _best(overlap: float, correlation: float) -> str:
    return f"at best {overlap:.1f} samples at a correlation of {correlation:.2f}"


def _apart(
    found: str, expected: str = f"an overlap with a correlation of at least {LEAST_CORRELATION}"
) -> RegistrationRefused:
    return refusal(
        "E_STRIPS",
        "two strips of a scan cannot be joined",
        found=found,
        expected=expected,
        fix="Check that the names order the strips from left to right and that each overlaps the next. "
        "Where the stage wobbles, write {column} where their numbers stand in `files`: each is then registered by itself.",
    )

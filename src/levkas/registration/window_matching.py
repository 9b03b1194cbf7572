"""Window matching: windows of one picture searched in another around where a map puts them.

Every window of the reference is searched near its place under the map by normalised cross-correlation
([lewis1995]_). The height of the peak says whether it was found, its place how far the map is off. Which
height is chance is measured on the same pair, with windows searched where they cannot be.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy import fft
from scipy.spatial import cKDTree

from levkas.core.threads import each
from levkas.geometry.transforms import Composed, Inverse
from levkas.registration.bands import area_average, pull, region_mask
from levkas.registration.foreground import nearest_within

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform


@dataclass(frozen=True)
class WindowSettings:
    """Constants of the search; lengths in px of the pictures as they are compared."""

    long_side: int = 800
    """Of the pictures that are compared; larger ones are reduced."""
    window: int = 40
    reach: int = 12
    apart: int = 4
    """`window`, `reach`, `apart`: side of a window; how far it is searched; how far another peak has to lie."""
    stride: tuple[int, int] = (8, 24)
    """Least and largest distance of windows, of which about `windows` are searched."""
    windows: int = 150
    farthest: float = 0.4
    """Shifts, as a share of the frame, up to which whole pictures are compared."""
    band: tuple[float, float] = (1.0, 5.0)
    """Scales between which detail is compared."""
    least_cover: float = 0.9
    """Share of a window that has to be valid."""
    chance_percent: float = 99.0
    """Percentile of the peaks of unrelated windows above which a window is found."""
    reach_cells: float = 2.0
    """A window of the dense registration is three cells wide, and a frame's rim may be short of one."""


SETTINGS = WindowSettings()
AGREES = 2.0
"""In px: a window that is found so near to its place agrees with the map."""
AGAINST = 10.0
"""Twice the logarithm of the likelihood of another place over that of the map's, from which a window contradicts the map."""
LEAST_CHANCES = 20
"""Unrelated windows by which chance is measured."""


@dataclass(frozen=True)
class WindowSearch:
    """Windows searched under a map; one row a window inside the overlap that has structure."""

    centres: np.ndarray
    shift: np.ndarray
    """`centres`, `shift`: (n, 2), reference px: middle, and from where the map puts the window to where it is found."""
    peak: np.ndarray
    """(n,), 0..1. Correlation there, whatever its sign."""
    against: np.ndarray
    """(n,). By how much likelier the window lies there than where the map puts it: twice the logarithm of the ratio of likelihoods."""
    chance: float
    """The peak that 1 % of unrelated windows reach."""
    second_peak_ratio: float
    """0... Correlation of the whole pictures at the best place that is not here, relative to here; near 1 where the picture
    repeats itself."""
    step: float
    """Reference px per working px."""

    @property
    def found(self) -> np.ndarray:
        """Mask of the windows that are found, beyond chance, (n,) bool."""
        return np.asarray(self.peak > self.chance)


@dataclass(frozen=True)
class CheckWindows:
    """Windows of one sensor, searched freely around where its map puts them; one row a window.

    Examples
    --------
    >>> checks = CheckWindows(np.array([[0.0, 0], [8, 0]]), np.zeros((2, 2)), np.ones(2, bool), 1.0, 10.0)
    >>> checks.beyond(np.array([[4.0, 0], [30, 0]])).tolist()
    [0.0, 20.0]
    """

    centres: np.ndarray
    shift: np.ndarray
    """`centres`, `shift`: (n, 2), reference px, as of `WindowSearch`."""
    found: np.ndarray
    """(n,). Whether it is recognised beyond chance."""
    tolerance: float
    """In reference px: a window that is found within twice that of its place confirms the map."""
    side: float
    """In reference px: of a window; places up to so far from confirmed ones are checked."""
    predicted: np.ndarray | None = None
    """(m, 2), reference px. Windows of the dense registration that are predicted beyond chance, as most around them are.
    They are smaller and closer, and show more exactly where detail ends."""
    cell: float = 0.0
    """In reference px: how far apart those are."""
    outline: np.ndarray | None = None
    """(k, 2), reference px. Corners of the object: places beside it are as far as the nearest of its own."""
    against: np.ndarray | None = None
    """(n,). As of `WindowSearch`; without it all that lie elsewhere contradict the map."""

    @property
    def contradicting(self) -> np.ndarray:
        """Mask of the windows that are found elsewhere, and fit there better than their own noise explains, (n,) bool."""
        elsewhere = self.found & ~self.confirmed
        return elsewhere if self.against is None else elsewhere & (self.against > AGAINST)

    @property
    def confirmed(self) -> np.ndarray:
        """Mask of the windows that are found where the map puts them, (n,) bool."""
        return np.asarray(self.found & (np.hypot(*self.shift.T) <= 2 * self.tolerance))

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Return how far beyond what is checked `points`, (n, 2), lie: (n,) reference px, 0 within.

        Infinite where fewer than two windows confirm anything: one may be found by chance.
        """
        places = self.centres[self.confirmed]
        if len(places) < 2:
            return np.full(len(points), np.inf)
        if self.outline is not None:
            points = nearest_within(self.outline, points)
        far = np.asarray(cKDTree(places).query(points, k=2)[0])[:, -1] - self.side
        if self.predicted is not None and len(self.predicted):
            near = np.asarray(cKDTree(self.predicted).query(points)[0])
            far = np.maximum(far, near - SETTINGS.reach_cells * self.cell)
        return np.asarray(np.maximum(far, 0.0))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record, a list a column."""
        return {
            "x": np.round(self.centres[:, 0], 1).tolist(),
            "y": np.round(self.centres[:, 1], 1).tolist(),
            "shift_x": np.round(self.shift[:, 0], 3).tolist(),
            "shift_y": np.round(self.shift[:, 1], 3).tolist(),
            "found": self.found.tolist(),
            "tolerance": self.tolerance,
            "side": self.side,
            "predicted": [] if self.predicted is None else np.round(self.predicted, 1).tolist(),
            "cell": self.cell,
            "outline": None if self.outline is None else np.round(self.outline, 2).tolist(),
            "against": None if self.against is None else np.round(self.against, 1).tolist(),
        }

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> CheckWindows:
        """Read what `to_dict` wrote."""
        return cls(
            np.array([record["x"], record["y"]], float).T,
            np.array([record["shift_x"], record["shift_y"]], float).T,
            np.array(record["found"], bool),
            float(record["tolerance"]),
            float(record["side"]),
            np.array(record["predicted"], float).reshape(-1, 2),
            float(record["cell"]),
            *(
                None if record[key] is None else np.array(record[key], float)
                for key in ("outline", "against")
            ),
        )


def search_windows(
    reference: tuple[np.ndarray, np.ndarray],
    target: tuple[np.ndarray, np.ndarray],
    transform: Transform,
    *,
    region: tuple[float, ...] | None = None,
) -> WindowSearch:
    """Search windows of the reference in the target near where `transform`, reference px → target px, puts them.

    Pictures are (values, valid), (h, w) float32 and bool, grey. Values may be (k, h, w), pictures of one object that have one map: their
    correlations are averaged, each weighted by how well both agree under the map. `region` is (x, y, width, height), reference px.
    """
    valid = reference[1] & region_mask(region, reference[1].shape)
    enlargement = _sampling(transform, valid.shape)
    step = max(1.0, max(valid.shape) / SETTINGS.long_side, 1.0 / max(enlargement, 0.2))
    finer = min(1.0, 1.0 / (step * enlargement)) if enlargement > 0 else 1.0
    details, shown = [], valid
    for values, other in zip(
        *(p.reshape(-1, *p.shape[-2:]) for p, _ in (reference, target)), strict=True
    ):
        ours, ours_valid, back = area_average(values, valid, 1.0 / step)
        theirs, theirs_valid, theirs_back = area_average(other, target[1], max(finer, 0.02))
        pulled = Composed(back, transform, Inverse(theirs_back))
        warped, warped_valid = pull(theirs, theirs_valid, pulled, ours.shape)
        details.append(each(_band_pass, (ours, warped), (ours_valid, warped_valid)))
        shown = ours_valid & warped_valid
    a, b = _weighted([one for one, _ in details], [other for _, other in details])
    places = _places(shown, a, b)
    peak, shift, against = _search(a, b, places)
    chance = _chance(a, b, places)
    # Where some pigments invert, detail cancels itself out, its strength does not.
    strengths = [np.stack([_strength(one) for one in stack]) for stack in (a, b)]
    second_peak_ratio = min(each(_second_peak_ratio, (a, strengths[0]), (b, strengths[1])))
    centres = back(places + (SETTINGS.window - 1) / 2)
    scale = float(back.matrix[0, 0])
    return WindowSearch(centres, shift * scale, peak, against, chance, second_peak_ratio, scale)


def _weighted(a: list[np.ndarray], b: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return details of several pictures, (k, h, w), each times the root of its weight, the correlation of both; the weights' sum is 1."""
    if len(a) == 1:
        return a[0][None], b[0][None]
    agreed = [np.corrcoef(u.ravel(), v.ravel())[0, 1] for u, v in zip(a, b, strict=True)]
    shares = np.maximum(np.nan_to_num(agreed), 0.0)
    shares = shares / shares.sum() if shares.any() else np.full(len(a), 1 / len(a))
    roots = np.sqrt(shares).astype(np.float32)[:, None, None]
    return np.stack(a) * roots, np.stack(b) * roots


def _sampling(transform: Transform, shape: tuple[int, ...]) -> float:
    """Return target px per reference px, the median over the frame."""
    h, w = shape
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 7) * w, np.linspace(0.1, 0.9, 7) * h)
    change = transform.jacobian(np.stack([x.ravel(), y.ravel()], 1))
    known = np.isfinite(change).all((1, 2))
    return float(np.sqrt(np.median(np.abs(np.linalg.det(change[known]))))) if known.any() else 0.0


def _band_pass(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Keep detail between two scales, 0 where invalid, at equal contrast everywhere."""
    weight = valid.astype(np.float32)
    filled = np.where(valid, values, 0).astype(np.float32)

    def smooth(image: np.ndarray, sigma: float) -> np.ndarray:
        total = cv2.GaussianBlur(image * weight, (0, 0), sigma)
        share = cv2.GaussianBlur(weight, (0, 0), sigma)
        return np.divide(total, share, out=np.zeros_like(total), where=share > 1e-3)

    detail = smooth(filled, SETTINGS.band[0]) - smooth(filled, SETTINGS.band[1])
    power = smooth(np.square(detail), 2 * SETTINGS.band[1])
    floor = 1e-3 * float(np.median(power[valid])) if valid.any() else 0.0
    return np.where(valid, detail / np.sqrt(power + floor + 1e-20), 0).astype(np.float32)


def _places(valid: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return top left corners, (n, 2) of x, y, of windows with enough valid px and structure."""
    h, w = valid.shape
    stride = int(np.clip(np.sqrt(valid.sum() / SETTINGS.windows), *SETTINGS.stride))
    x = np.arange(0, w - SETTINGS.window + 1, stride)
    y = np.arange(0, h - SETTINGS.window + 1, stride)
    if not len(x) or not len(y):
        return np.empty((0, 2), int)
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    area = SETTINGS.window**2
    good = _box(cv2.integral(valid.astype(np.uint8)), grid) >= SETTINGS.least_cover * area
    for stack in (a, b):
        good &= _box(cv2.integral(np.square(stack).sum(0)), grid) > 0.05 * area
    return grid[good]


def _box(integral: np.ndarray, places: np.ndarray) -> np.ndarray:
    x, y = places.T
    far, low = x + SETTINGS.window, y + SETTINGS.window
    return np.asarray(integral[low, far] - integral[y, far] - integral[low, x] + integral[y, x])


def _correlations(a: np.ndarray, b: np.ndarray, at: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return |correlation| of the window of `a`, (k, h, w), at `at` with `b` around `near`, the mean over k by weight."""
    (x, y), (u, v) = at, near
    reach, side = SETTINGS.reach, SETTINGS.window
    left, top = max(u - reach, 0), max(v - reach, 0)
    around = np.s_[top : v + reach + side, left : u + reach + side]
    scores = np.zeros((1, 1), np.float32)
    for one, other in zip(a, b, strict=True):
        template = one[y : y + side, x : x + side]
        found = cv2.matchTemplate(other[around], template, cv2.TM_CCOEFF_NORMED)
        # Detail of unit variance was multiplied by the root of its weight.
        scores = scores + (found if len(a) == 1 else found * np.square(template).mean())
    full = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    dy, dx = top - (v - reach), left - (u - reach)
    full[dy : dy + scores.shape[0], dx : dx + scores.shape[1]] = np.abs(scores)
    full[~np.isfinite(full) | (full > 1.0001)] = 0
    return full


def _search(a: np.ndarray, b: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return peak, shift and `against` of every window.

    What a window correlates with by chance, away from its peak, is its own noise: of n independent values a correlation r by chance has
    the variance 1/n, and residuals of a fit with r have a likelihood of (1 − r²)^(−n/2).
    """
    peak, shift, against = np.zeros(len(places)), np.zeros((len(places), 2)), np.zeros(len(places))
    y, x = np.mgrid[-SETTINGS.reach : SETTINGS.reach + 1, -SETTINGS.reach : SETTINGS.reach + 1]
    here = np.hypot(x, y) <= AGREES
    for i, place in enumerate(places):
        scores = _correlations(a, b, place, place)
        row, column = (int(k) for k in np.unravel_index(int(scores.argmax()), scores.shape))
        peak[i] = scores[row, column]
        offset = peak_offset(scores[row], column), peak_offset(scores[:, column], row)
        shift[i] = np.array([column, row]) - SETTINGS.reach + offset
        away = np.hypot(x - x[row, column], y - y[row, column]) > SETTINGS.apart
        chance = max(float(np.mean(np.square(scores[away & (scores > 0)]))), 1e-4)
        squares = np.square([scores[here].max(), peak[i]])
        against[i] = -np.diff(np.log1p(-np.minimum(squares, 0.9999)))[0] / chance
    return peak, shift, against


def peak_offset(line: np.ndarray, k: int) -> float:
    """Return the fraction by which a parabola through three samples moves the peak at `k`."""
    if not 0 < k < len(line) - 1:
        return 0.0
    before, here, after = (float(v) for v in line[k - 1 : k + 2])
    bend = before - 2 * here + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def _chance(a: np.ndarray, b: np.ndarray, places: np.ndarray) -> float:
    """Return the peak that 1 % of unrelated windows reach."""
    if len(places) < 2:
        return 1.0
    peaks, n = [], len(places)
    for i, part in product(range(n), (3, 2)):
        other = places[(i + n // part + i % 7) % n]
        if np.abs(other - places[i]).max() > SETTINGS.window + SETTINGS.reach:
            peaks.append(float(_correlations(a, b, places[i], other).max()))
    if len(peaks) < LEAST_CHANCES:
        # In a small picture no two windows are far apart: it is turned and mirrored instead.
        for turned in (b[:, ::-1, ::-1], b[:, ::-1], b[:, :, ::-1]):
            c = np.ascontiguousarray(turned)
            peaks += [float(_correlations(a, c, place, place).max()) for place in places]
    return float(np.percentile(peaks, SETTINGS.chance_percent))


def _strength(detail: np.ndarray) -> np.ndarray:
    """Return how strong detail is, whatever its sign, about its mean; 0 where invalid."""
    known = detail != 0
    strength = cv2.GaussianBlur(np.abs(detail), (0, 0), SETTINGS.band[0])
    mean = float(strength[known].mean()) if known.any() else 0.0
    return np.where(known, strength - mean, 0).astype(np.float32)


def _second_peak_ratio(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest |correlation| at a shift of more than `SETTINGS.apart`, relative to none."""
    reach = [round(SETTINGS.farthest * n) for n in a.shape[1:]]
    shape = [fft.next_fast_len(n + r, real=True) for n, r in zip(a.shape[1:], reach, strict=True)]

    def against(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        product = np.conj(fft.rfft2(u, shape)) * fft.rfft2(v, shape)
        return np.asarray(fft.irfft2(product.sum(0), shape))

    shared = against(np.square(a), (b != 0).astype(np.float32))
    shared *= against((a != 0).astype(np.float32), np.square(b))
    # Strips of overlap at the far shifts say nothing: they must hold a quarter of the energy.
    enough = shared > 0.25**2 * max(float(shared[0, 0]), 1e-9)
    scores = np.abs(against(a, b))
    scores = np.where(enough, scores / np.sqrt(np.where(enough, shared, 1)), 0)
    dy, dx = (np.minimum(np.arange(n), n - np.arange(n)) for n in shape)
    distance = np.hypot(dy[:, None], dx[None, :])
    within = (dy[:, None] <= reach[0]) & (dx[None, :] <= reach[1])
    here = float(scores[distance <= SETTINGS.apart].max())
    away = float(scores[(distance > 2 * SETTINGS.apart) & within].max(initial=0.0))
    return away / here if here > 0 else np.inf

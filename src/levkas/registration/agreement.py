"""Whether two pictures agree under a map: windows compared where they should match and where not.

Every window of the reference is looked for near the place that the map gives it. The height of the
peak says whether it was found, its place how far the map is off there. What height is chance is
measured on the same pair: windows looked for where they cannot be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.registration.images import area_average

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

LONG_SIDE_PX = 800
WINDOW_PX = 40
STRIDE_PX = (8, 24)
WINDOWS = 150
REACH_PX = 12
APART_PX = 4
LATTICE_PX = 8
FARTHEST_SHARE = 0.4
BAND_PX = (1.0, 5.0)
LEAST_COVER = 0.9
CHANCE_PERCENT = 99.0


@dataclass(frozen=True)
class Agreement:
    """What windows say of a map; one row a window inside the overlap that has structure.

    Parameters
    ----------
    centres : ndarray, (n, 2), reference px
    shift : ndarray, (n, 2), reference px
        From where the map puts the window to where it is found.
    peak : ndarray, (n,), 0..1
        Correlation there, whatever its sign.
    second : ndarray, (n,), 0..1
        Largest correlation elsewhere within reach.
    chance : float
        The peak that 1 % of windows reach where they cannot match.
    rival : float, 0..
        Correlation of the whole pictures at the best place that is not here, relative to here;
        near 1 where the picture repeats itself.
    reach : float, reference px
    step : float, reference px per working px
    """

    centres: np.ndarray
    shift: np.ndarray
    peak: np.ndarray
    second: np.ndarray
    chance: float
    rival: float
    reach: float
    step: float

    @property
    def found(self) -> np.ndarray:
        """Mask of the windows that are found, beyond chance, (n,) bool."""
        return np.asarray(self.peak > self.chance)


def compare(
    reference: tuple[np.ndarray, np.ndarray],
    target: tuple[np.ndarray, np.ndarray],
    transform: Transform,
    *,
    region: tuple[float, ...] | None = None,
) -> Agreement:
    """Look for windows of the reference in the target near where `transform` puts them.

    Parameters
    ----------
    reference, target : (values, valid), each (h, w), float32 and bool
        Grey pictures in reference px and in px of the target.
    transform : Transform
        Reference px → target px.
    region : (x, y, width, height), reference px, optional
        Where to look.
    """
    values, valid = reference
    if region is not None:
        valid = valid & _inside(valid.shape, region)
    enlargement = _sampling(transform, values.shape)
    step = max(1.0, max(values.shape) / LONG_SIDE_PX, 1.0 / max(enlargement, 0.2))
    ours, ours_valid, back = area_average(values, valid, 1.0 / step)
    finer = min(1.0, 1.0 / (step * enlargement)) if enlargement > 0 else 1.0
    theirs, theirs_valid, theirs_back = area_average(*target, max(finer, 0.02))
    warped, seen = _warp(theirs, theirs_valid, ours.shape, back, transform, theirs_back)
    a, b = _band_pass(ours, ours_valid), _band_pass(warped, seen)
    places = _places(ours_valid & seen, a, b)
    peak, second, shift = _search(a, b, places)
    chance = _chance(a, b, places)
    # Where some pigments invert, detail cancels itself out, its strength does not.
    rival = min(_rival(a, b), _rival(_strength(a), _strength(b)))
    centres = back(places + (WINDOW_PX - 1) / 2)
    scale = float(back.matrix[0, 0])
    return Agreement(centres, shift * scale, peak, second, chance, rival, REACH_PX * scale, scale)


def _inside(shape: tuple[int, ...], region: tuple[float, ...]) -> np.ndarray:
    x, y, w, h = region
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return np.asarray((columns >= x - 0.5) & (columns < x + w) & (rows >= y - 0.5) & (rows < y + h))


def _sampling(transform: Transform, shape: tuple[int, ...]) -> float:
    """Return target px per reference px, the median over the frame."""
    h, w = shape
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 7) * w, np.linspace(0.1, 0.9, 7) * h)
    change = transform.jacobian(np.stack([x.ravel(), y.ravel()], 1))
    known = np.isfinite(change).all((1, 2))
    return float(np.sqrt(np.median(np.abs(np.linalg.det(change[known]))))) if known.any() else 0.0


def _warp(
    values: np.ndarray,
    valid: np.ndarray,
    shape: tuple[int, ...],
    back: Transform,
    transform: Transform,
    theirs_back: Transform,
) -> tuple[np.ndarray, np.ndarray]:
    """Pull the target on to the working grid; the map is interpolated between every 8th px."""
    import cv2

    h, w = shape
    x = np.arange(0, w + LATTICE_PX, LATTICE_PX, dtype=float)
    y = np.arange(0, h + LATTICE_PX, LATTICE_PX, dtype=float)
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    lattice = theirs_back.inverse(transform(back(grid))).reshape(len(y), len(x), 2)
    rows, columns = np.meshgrid(
        np.arange(h, dtype=np.float32), np.arange(w, dtype=np.float32), indexing="ij"
    )
    maps = [
        cv2.remap(
            np.ascontiguousarray(lattice[..., k], np.float32),
            columns / LATTICE_PX, rows / LATTICE_PX, cv2.INTER_LINEAR,
        )
        for k in (0, 1)
    ]  # fmt: skip
    known = np.isfinite(maps[0]) & np.isfinite(maps[1])
    maps = [np.where(known, m, np.float32(-10)) for m in maps]
    filled = np.where(valid, values, 0).astype(np.float32)
    weight: np.ndarray = valid.astype(np.float32)
    warped: np.ndarray = cv2.remap(filled, maps[0], maps[1], cv2.INTER_LINEAR, borderValue=0)
    weight = cv2.remap(weight, maps[0], maps[1], cv2.INTER_LINEAR, borderValue=0)
    return np.asarray(warped), known & (np.asarray(weight) > 0.99)


def _band_pass(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Keep detail between two scales, 0 where invalid, at equal contrast everywhere."""
    import cv2

    weight = valid.astype(np.float32)
    filled = np.where(valid, values, 0).astype(np.float32)

    def smooth(image: np.ndarray, sigma: float) -> np.ndarray:
        total = cv2.GaussianBlur(image * weight, (0, 0), sigma)
        share = cv2.GaussianBlur(weight, (0, 0), sigma)
        return np.divide(total, share, out=np.zeros_like(total), where=share > 1e-3)

    detail = smooth(filled, BAND_PX[0]) - smooth(filled, BAND_PX[1])
    power = smooth(np.square(detail), 2 * BAND_PX[1])
    floor = 1e-3 * float(np.median(power[valid])) if valid.any() else 0.0
    return np.where(valid, detail / np.sqrt(power + floor + 1e-20), 0).astype(np.float32)


def _places(valid: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return top left corners, (n, 2) of x, y, of windows with enough valid px and structure."""
    import cv2

    h, w = valid.shape
    stride = int(np.clip(np.sqrt(valid.sum() / WINDOWS), *STRIDE_PX))
    x = np.arange(0, w - WINDOW_PX + 1, stride)
    y = np.arange(0, h - WINDOW_PX + 1, stride)
    if not len(x) or not len(y):
        return np.empty((0, 2), int)
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    counts = cv2.integral(valid.astype(np.uint8))
    total = _box(counts, grid)
    good = total >= LEAST_COVER * WINDOW_PX**2
    for image in (a, b):
        energy = _box(cv2.integral(np.square(image)), grid)
        good &= energy > 0.05 * WINDOW_PX**2
    return grid[good]


def _box(integral: np.ndarray, places: np.ndarray) -> np.ndarray:
    x, y = places.T
    far_x, far_y = x + WINDOW_PX, y + WINDOW_PX
    return np.asarray(
        integral[far_y, far_x] - integral[y, far_x] - integral[far_y, x] + integral[y, x]
    )


def _correlations(a: np.ndarray, b: np.ndarray, at: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return |correlation| of the window of `a` at `at` with `b` around `near`."""
    import cv2

    h, w = b.shape
    (x, y), (u, v) = at, near
    left, top = max(u - REACH_PX, 0), max(v - REACH_PX, 0)
    right, bottom = min(u + REACH_PX + WINDOW_PX, w), min(v + REACH_PX + WINDOW_PX, h)
    scores = cv2.matchTemplate(
        b[top:bottom, left:right], a[y : y + WINDOW_PX, x : x + WINDOW_PX], cv2.TM_CCOEFF_NORMED
    )
    full = np.zeros((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.float32)
    dy, dx = top - (v - REACH_PX), left - (u - REACH_PX)
    full[dy : dy + scores.shape[0], dx : dx + scores.shape[1]] = np.abs(scores)
    full[~np.isfinite(full) | (full > 1.0001)] = 0
    return full


def _search(
    a: np.ndarray, b: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (peak, second, shift) of every window."""
    n = len(places)
    peak, second, shift = np.zeros(n), np.zeros(n), np.zeros((n, 2))
    offsets = np.arange(-REACH_PX, REACH_PX + 1)
    for i, place in enumerate(places):
        scores = _correlations(a, b, place, place)
        row, column = np.unravel_index(int(scores.argmax()), scores.shape)
        peak[i] = scores[row, column]
        shift[i] = (
            offsets[column] + _vertex(scores[row], int(column)),
            offsets[row] + _vertex(scores[:, column], int(row)),
        )
        far = np.hypot(*np.meshgrid(offsets - offsets[column], offsets - offsets[row])) > APART_PX
        second[i] = scores[far].max()
    return peak, second, shift


def _vertex(line: np.ndarray, k: int) -> float:
    """Return the fraction by which a parabola through three samples moves the peak at `k`."""
    if not 0 < k < len(line) - 1:
        return 0.0
    before, here, after = (float(v) for v in line[k - 1 : k + 2])
    bend = before - 2 * here + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def _chance(a: np.ndarray, b: np.ndarray, places: np.ndarray) -> float:
    """Return the peak that 1 % of windows reach where they cannot match."""
    if len(places) < 2:
        return 1.0
    peaks = []
    n = len(places)
    for i in range(n):
        for part in (3, 2):
            other = places[(i + n // part + i % 7) % n]
            if np.abs(other - places[i]).max() > WINDOW_PX + REACH_PX:
                peaks.append(float(_correlations(a, b, places[i], other).max()))
    return float(np.percentile(peaks, CHANCE_PERCENT)) if len(peaks) >= 8 else 1.0


def _strength(detail: np.ndarray) -> np.ndarray:
    """Return how strong detail is, whatever its sign, about its mean; 0 where invalid."""
    import cv2

    known = detail != 0
    strength = cv2.GaussianBlur(np.abs(detail), (0, 0), BAND_PX[0])
    mean = float(strength[known].mean()) if known.any() else 0.0
    return np.where(known, strength - mean, 0).astype(np.float32)


def _rival(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest |correlation| at a shift of more than `APART_PX`, relative to none."""
    from scipy import fft

    reach = [round(FARTHEST_SHARE * n) for n in a.shape]
    shape = [fft.next_fast_len(n + r, real=True) for n, r in zip(a.shape, reach, strict=True)]

    def against(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        product = np.conj(fft.rfft2(u, shape)) * fft.rfft2(v, shape)
        return np.asarray(fft.irfft2(product, shape))

    shared = against(np.square(a), (b != 0).astype(np.float32))
    shared *= against((a != 0).astype(np.float32), np.square(b))
    # Strips of overlap at the far shifts say nothing: they must hold a quarter of the energy.
    enough = shared > 0.25**2 * max(float(shared[0, 0]), 1e-9)
    scores = np.abs(against(a, b))
    scores = np.where(enough, scores / np.sqrt(np.where(enough, shared, 1)), 0)
    dy, dx = (np.minimum(np.arange(n), n - np.arange(n)) for n in shape)
    distance = np.hypot(dy[:, None], dx[None, :])
    within = (dy[:, None] <= reach[0]) & (dx[None, :] <= reach[1])
    here = float(scores[distance <= APART_PX].max())
    away = float(scores[(distance > 2 * APART_PX) & within].max(initial=0.0))
    return away / here if here > 0 else np.inf

"""Marks that two hands cannot share: do craquelure, wormholes, losses, weave and strokes lie at the same places?

Two panels by one pattern have the same outlines, so that windows of both match; what age, tools and support left between
the outlines differs. In the quarter of either picture in which its smoothed structure changes least, fine detail between
0.7 and 2 px is divided by its local strength and correlated, squared, so that marks may be dark in one picture and bright
in the other, pooled over windows i for a displacement u:

    r²(u) = Σᵢ [Σₓ aᵢ(x) bᵢ(x + u)]² / Σᵢ [Σₓ aᵢ²(x) Σₓ bᵢ²(x + u)]

Chance is r² at displacements of 6 to 14 px, where the marks of one object cannot meet: the permutation test of
[muhlich2022]_ within a window. What r² has above its mean there, at most 2 px from the map, is the share in common.

Pictures that show little correlate little. Noise is shared by no two pictures; its share n of the power of fine detail is
measured by the Laplacian of [immerkaer1996]_, to which what a smooth picture has at all is added, and r is divided by the
correlation that identical marks would have, √((1 − n₁)(1 − n₂)): Spearman's correction for attenuation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from levkas.registration.window_matching import CheckWindows

#: Scales of fine detail and of the drawing, standard deviations of Gaussians, px of the compared grid.
FINE, DRAWING, STRENGTH = (0.7, 2.0), 2.5, 6.0
#: Share of a picture that is off the drawing: with 0.35 outlines of copies correlate up to 0.30, as marks of X-rays do, with 0.25 up to 0.20.
GROUND = 0.25
#: Side of a window, displacements that a right map leaves and that are chance, and px beyond them that filters reach.
WINDOW, NEAR, AWAY, MARGIN = 48, 2, (6, 14), 24
REACH = AWAY[1] + NEAR
#: Share of a window that is off the drawing; windows that are needed, and that are looked at.
LEAST_COVER, LEAST_WINDOWS, MOST_WINDOWS = 0.07, 8, 300
#: Fine detail over the contrast of smooth pictures kept as JPEG; of pictures with marks it is 0.012 and more.
SMOOTH = 0.005
#: What the measured share of noise is of noise alone, by its quietest tenth.
NOISE_ALONE = 0.8
#: Of one degree of freedom.
MEDIAN_OF_CHI_SQUARE = 0.455
LAPLACIAN = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32) / 6


@dataclass(frozen=True)
class Marks:
    """Correlation of the marks of two pictures, beyond chance, whatever its sign."""

    correlation: float
    """0..1. Without noise."""
    at_most: float
    """0..1. The same, one standard deviation above what was measured: 0.30 and more of one object, 0.00 to 0.25 of copies by
    one pattern, 1 where either picture shows nothing that could be compared."""
    windows: int

    def to_dict(self) -> dict[str, float | int]:
        """Return a JSON-ready record."""
        at_most = round(self.at_most, 4)
        return {
            "correlation": round(self.correlation, 4),
            "at_most": at_most,
            "windows": self.windows,
        }


class _Detail(NamedTuple):
    """Parts of a picture in windows with their margin, (n, side, side): fine detail, Laplacian, drawing, and 1 where valid."""

    fine: np.ndarray
    laplacian: np.ndarray
    drawing: np.ndarray
    valid: np.ndarray

    @classmethod
    def of(cls, parts: np.ndarray) -> _Detail:
        return cls(*map(np.stack, zip(*map(_separate, parts), strict=True)))

    def noise(self, ground: np.ndarray, white: float, contrast: float) -> float:
        """Return the share of power of fine detail on the ground that is noise, or no more than a smooth picture has.

        Square roots of reflectance have as much shot noise in one place as in another: the quietest tenth has that of all.
        """
        power = np.stack(list(map(_smooth, np.square(self.laplacian), self.valid)))
        quiet = float(np.quantile(power[self.valid > 0], 0.1))
        fine = float(np.median(np.square(self.fine[ground]))) / MEDIAN_OF_CHI_SQUARE
        noise = white * quiet / NOISE_ALONE + (SMOOTH * contrast) ** 2
        return min(noise / max(fine, 1e-20), 1.0)


def compare_marks(
    reference: np.ndarray,
    target: np.ndarray,
    where: np.ndarray,
    white: tuple[float | None, float | None] = (None, None),
) -> Marks | None:
    """Compare the marks of two pictures that lie on one another; return None where too few windows are off the drawing.

    Parameters
    ----------
    reference, target : ndarray, (h, w)
        The target through its map; NaN where invalid.
    where : ndarray of bool, (h, w)
        Places that confirm the map by their outlines.
    white : (float or None, float or None)
        `whiteness` of noise that came to the grid as each picture did; None of a picture in its own px.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> one, other = rng.normal(size=(2, 500, 600))
    >>> everywhere = np.ones(one.shape, bool)
    >>> same, two = compare_marks(one, 1 - one, everywhere), compare_marks(one, other, everywhere)
    >>> same.correlation > 0.9, two.correlation < 0.1
    (True, True)
    """
    height, width = (min(n) for n in zip(reference.shape, target.shape, strict=True))
    edge = REACH + MARGIN
    reference, target = (
        np.pad(image[:height, :width], MARGIN, constant_values=np.nan)
        for image in (reference, target)
    )
    where = np.pad(where[:height, :width], MARGIN)
    height, width = where.shape
    places = [
        (y, x)
        for y in range(edge, height - WINDOW - edge + 1, WINDOW)
        for x in range(edge, width - WINDOW - edge + 1, WINDOW)
        if where[y : y + WINDOW, x : x + WINDOW].mean() >= LEAST_COVER
    ]
    if len(places) < LEAST_WINDOWS:
        return None
    picks = np.linspace(0, len(places) - 1, min(len(places), MOST_WINDOWS)).round().astype(int)
    around = [tuple(slice(v - edge, v + WINDOW + edge) for v in places[k]) for k in picks]
    confirmed = np.stack([where[at] for at in around])
    details = [_Detail.of(np.stack([image[at] for at in around])) for image in (reference, target)]
    both = confirmed & (details[0].valid > 0) & (details[1].valid > 0)
    if not both.any():
        return None
    ground = both.copy()
    for one in details:
        ground &= one.drawing <= np.quantile(one.drawing[both], GROUND)
    inner = np.s_[:, edge:-edge, edge:-edge]
    kept = np.flatnonzero(ground[inner].mean((1, 2)) >= LEAST_COVER)
    if len(kept) < LEAST_WINDOWS:
        return None
    a, b = (_normalised(one.fine[kept], ground[kept]) for one in details)
    shared, sigma = _correlate(a, b, ground[kept].astype(np.float32))
    ceiling = 1.0
    for one, image, factor in zip(details, (reference, target), white, strict=True):
        contrast = float(np.nanstd(image))
        ceiling *= 1 - one.noise(ground, whiteness() if factor is None else factor, contrast)
    ceiling = max(ceiling, 1e-12) ** 0.5
    correlation, at_most = (min(v**0.5 / ceiling, 1.0) for v in (shared, shared + sigma))
    return Marks(correlation, at_most, len(kept))


def confirmed_places(checks: CheckWindows, shape: tuple[int, ...], step: int) -> np.ndarray:
    """Return where windows confirm a map, (h, w) bool, on a grid of `step` reference px."""
    where, half = np.zeros(shape, bool), checks.side / 2
    corners = (checks.centres[checks.confirmed, None] + np.array([[-half], [half]])) / step
    for (left, top), (right, bottom) in np.maximum(np.rint(corners), 0).astype(int):
        where[top:bottom, left:right] = True
    return where


def whiteness(noise: np.ndarray | None = None) -> float:
    """Return the power of fine detail over that of the Laplacian in white noise, (h, w), as it came to a grid.

    >>> round(whiteness(), 2)  # in a picture's own px
    0.11
    """
    fine, laplacian, _, valid = _separate(white_noise((256, 256)) if noise is None else noise)
    powers = [float(np.median(np.square(v[valid > 0]))) for v in (fine, laplacian)]
    return powers[0] / max(powers[1], 1e-20)


def white_noise(shape: tuple[int, int]) -> np.ndarray:
    """Return white noise, the same for the same shape, (h, w), float32."""
    return np.random.default_rng(0).standard_normal(shape, np.float32)


def _separate(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return fine detail, Laplacian, how much the smoothed structure changes, and 1 where valid, (h, w) float32."""
    weight = np.isfinite(image).astype(np.float32)
    values = np.where(weight > 0, image, 0).astype(np.float32)
    sharp, soft, coarse, ground = (
        _smooth(values, weight, sigma) for sigma in (*FINE, DRAWING, 2.5 * DRAWING)
    )
    slope = np.hypot(*(cv2.Sobel(coarse, cv2.CV_32F, *axis) / 8 for axis in ((1, 0), (0, 1))))
    drawing = cv2.dilate(np.maximum(slope, np.abs(coarse - ground) / DRAWING), np.ones((3, 3)))
    valid = cv2.erode(weight, np.ones((5, 5)), borderValue=1)
    return (sharp - soft) * weight, cv2.filter2D(values, -1, LAPLACIAN), drawing, valid


def _smooth(values: np.ndarray, weight: np.ndarray, sigma: float = STRENGTH) -> np.ndarray:
    """Return the Gaussian mean over what is valid, 0 where nothing is."""
    total, share = (cv2.GaussianBlur(v, (0, 0), sigma) for v in (values * weight, weight))
    return np.divide(total, share, out=np.zeros_like(total), where=share > 1e-2)


def _normalised(fine: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Return fine detail over its local strength, at most 2.5; 0 off the ground. 1 to 2.5 make no difference."""
    weight = ground.astype(np.float32)
    strength = np.sqrt(np.stack(list(map(_smooth, np.square(fine), weight))))
    floor = 0.2 * float(np.median(strength[ground]))
    return np.clip(fine / (strength + floor + 1e-12), -2.5, 2.5) * weight


def _correlate(a: np.ndarray, b: np.ndarray, ground: np.ndarray) -> tuple[float, float]:
    """Return r² beyond chance at the map, and its standard deviation by chance, over windows with their margin."""
    inner = slice(REACH + MARGIN, -REACH - MARGIN)
    products, powers = np.zeros((2, 2 * REACH + 1, 2 * REACH + 1))
    for mine, wide, there in zip(a, b, ground, strict=True):
        here, theirs = there[inner, inner], wide[MARGIN:-MARGIN, MARGIN:-MARGIN]
        mine = mine[inner, inner]
        mine = (mine - mine.sum() / here.sum()) * here
        products += np.square(_slide(mine, theirs))
        around = there[MARGIN:-MARGIN, MARGIN:-MARGIN]
        powers += _slide(here, np.square(theirs)) * _slide(np.square(mine), around)
    shared = products / np.maximum(powers, 1e-9)
    distance = np.abs(np.arange(-REACH, REACH + 1))
    apart = np.maximum(distance[:, None], distance)
    chance = shared[(apart >= AWAY[0]) & (apart <= AWAY[1])]
    mean = float(chance.mean())
    excess = (float(shared[apart <= NEAR].max()) - mean) / max(1 - mean, 1e-9)
    return min(max(excess, 0.0), 1.0), float(chance.std())


def _slide(window: np.ndarray, over: np.ndarray) -> np.ndarray:
    """Return the sum of products of a window with every place of a larger picture that it fits in."""
    return np.asarray(cv2.matchTemplate(over, window, cv2.TM_CCORR))

"""Marks that two hands cannot share: do craquelure, wormholes, losses, weave and strokes lie at the same places?

Two panels by one pattern have the same outlines, so that windows of both match; what age, tools and support left between
the outlines differs. The test has four steps.

1. *Off the drawing.* The quarter of either picture in which its smoothed structure changes least is kept: there, no
   outline predicts fine detail.
2. *Fine detail* there, between 0.7 and 2 px, is divided by its local strength, so that a strong mark counts as a faint one.
3. *Correlation*, squared, so that marks may be dark in one picture and bright in the other, pooled over windows i for
   a displacement u of one picture:

       r²(u) = Σᵢ [Σₓ aᵢ(x) bᵢ(x + u)]² / Σᵢ [Σₓ aᵢ²(x) Σₓ bᵢ²(x + u)]

4. *Chance* is r² at displacements of 6 to 14 px, where the marks of one object cannot meet: the permutation test of
   [muhlich2022]_ within a window. What r² has above its mean there, at most 2 px from the map, is the share that marks
   have in common. Its standard deviation there says how large a share would have been overlooked.

Sensor noise is shared by no two pictures. It is measured, by the Laplacian of [immerkaer1996]_, which has more of white
noise than of a mark imaged by an optic, and r is divided by the correlation that identical marks would have below so
much noise, √((1 − n₁)(1 − n₂)): Spearman's correction for attenuation, for the shares n of noise in the power.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from levkas.registration.window_matching import CheckWindows


@dataclass(frozen=True)
class MarkSettings:
    """Constants of the test; lengths in px of the grid on which both pictures are compared.

    Parameters
    ----------
    fine : (float, float)
        Scales, standard deviations of Gaussians, between which detail is fine.
    drawing : float
        Scale of the drawing, the same.
    ground : float
        Share of either picture that is off the drawing. With 0.35 outlines of copies correlate up to 0.30, as marks of
        X-rays do; with 0.25 up to 0.20.
    window, near, away : int, int, (int, int)
        Side of a window; displacements that a right map leaves; displacements that are chance.
    least_cover, least_windows, most_windows : float, int, int
        Share of a window that is off the drawing; windows that are needed, and that are looked at.
    least_contrast : float
        Fine detail off the drawing over the contrast of the picture: 0.012 and more where a picture holds marks; below
        0.005 of smooth pictures that were kept as JPEG.
    most_noise : float
        Share of noise in the power of fine detail, beyond which a picture holds no marks that could be compared: noise
        alone has 0.82 and more by the measure that is used here, which is of the quietest tenth.
    strength_px : float
        Within which the strength of fine detail is measured.
    clip : float
        Strengths beyond which a mark counts no more; 1 to 2.5 make no difference.
    """

    fine: tuple[float, float] = (0.7, 2.0)
    drawing: float = 2.5
    ground: float = 0.25
    window: int = 48
    near: int = 2
    away: tuple[int, int] = (6, 14)
    least_cover: float = 0.07
    least_windows: int = 8
    most_windows: int = 300
    least_contrast: float = 0.01
    most_noise: float = 0.8
    strength_px: float = 6.0
    clip: float = 2.5


SETTINGS = MarkSettings()
#: Correlation of marks that is found in every pair of pictures of one object that both hold marks.
DISTINCTIVE = 0.25
#: Of one degree of freedom.
MEDIAN_OF_CHI_SQUARE = 0.455
#: Rows that are separated at once, and rows beyond them that the widest Gaussian and what follows it reach.
ROWS, REACH = 512, 40
LAPLACIAN = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32) / 6


@dataclass(frozen=True)
class Marks:
    """Comparison of the marks of two pictures.

    Parameters
    ----------
    measured : float, 0..1
        Correlation of fine detail at the same place, beyond chance, whatever its sign.
    sigma : float
        Standard deviation, by chance, of its square.
    windows : int
    contrast, noise : (float, float)
        Of reference and target: fine detail off the drawing over the contrast of the picture; noise in its power.
    """

    measured: float
    sigma: float
    windows: int
    contrast: tuple[float, float]
    noise: tuple[float, float]

    @property
    def ceiling(self) -> float:
        """Correlation of identical marks below the noise of both pictures; noise beyond `most_noise` counts as that."""
        return float(np.prod([1 - min(n, SETTINGS.most_noise) for n in self.noise]) ** 0.5)

    @property
    def correlation(self) -> float:
        """Correlation of the marks without the noise, 0..1."""
        return min(self.measured / self.ceiling, 1.0)

    @property
    def at_most(self) -> float:
        """The same, one standard deviation above what was measured, which is the largest at 25 displacements already."""
        return min(float(np.sqrt(self.measured**2 + self.sigma)) / self.ceiling, 1.0)

    @property
    def held(self) -> tuple[bool, bool]:
        """Whether reference and target hold marks: fine detail that is neither faint nor noise."""
        first, second = (
            contrast >= SETTINGS.least_contrast and noise <= SETTINGS.most_noise
            for contrast, noise in zip(self.contrast, self.noise, strict=True)
        )
        return first, second

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "correlation": round(self.correlation, 4),
            "at_most": round(self.at_most, 4),
            "windows": self.windows,
            "held": list(self.held),
            "contrast": [round(v, 4) for v in self.contrast],
            "noise": [round(v, 3) for v in self.noise],
        }


@dataclass(frozen=True)
class _Detail:
    """Fine detail and what separates it from noise, each (h, w), float32, of one picture."""

    fine: np.ndarray
    laplacian: np.ndarray
    valid: np.ndarray
    contrast: float

    @classmethod
    def of(cls, image: np.ndarray) -> _Detail:
        """Separate the scales of a picture, (h, w), NaN where invalid, some rows at a time."""
        known = np.isfinite(image)
        spread = float(image[known].std()) if known.any() else 0.0
        fine, laplacian = (np.empty(image.shape, np.float32) for _ in range(2))
        valid = np.empty(image.shape, bool)
        for rows, around, inner in _row_blocks(len(image)):
            parts = _separate(image[around])
            for whole, part in zip((fine, laplacian, valid), parts, strict=True):
                whole[rows] = part[inner]
        return cls(fine, laplacian, valid, spread)

    def contrast_in(self, where: np.ndarray) -> float:
        """Return fine detail at the places of a mask, (h, w), over the contrast of the whole picture; both robust to outlines."""
        return float(1.4826 * np.median(np.abs(self.fine[where])) / max(self.contrast, 1e-12))

    def noise_in(self, where: np.ndarray, white: float) -> float:
        """Return the share of noise in the power of fine detail at the places of a mask, (h, w).

        Square roots of reflectance have as much shot noise in one place as in another, so that the quietest tenth of
        the picture has the noise of all.
        """
        weight = self.valid.astype(np.float32)
        power = _smooth(np.square(self.laplacian), weight, SETTINGS.strength_px)[self.valid]
        fine = float(np.median(np.square(self.fine[where]))) / MEDIAN_OF_CHI_SQUARE
        return white * float(np.quantile(power, 0.1)) / max(fine, 1e-20) if fine > 0 else 0.0


def compare_marks(
    reference: np.ndarray,
    target: np.ndarray,
    where: np.ndarray,
    *,
    white: tuple[float | None, float | None] = (None, None),
    own: np.ndarray | None = None,
) -> Marks | None:
    """Compare the marks of two pictures that lie on one another.

    Parameters
    ----------
    reference, target : ndarray, (h, w)
        The target through its map; NaN where invalid.
    where : ndarray of bool, (h, w)
        Places that confirm the map by their outlines.
    white : (float or None, float or None)
        `whiteness` of noise that came to the grid as each picture did; None of a picture in its own px.
    own : ndarray, (h, w), optional
        The target in its own px, in which its noise is white, where it is coarser than the grid.

    Returns
    -------
    marks : Marks or None
        None where fewer than `least_windows` windows have enough that is off the drawing.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> one, other = rng.normal(size=(2, 300, 400))
    >>> everywhere = np.ones(one.shape, bool)
    >>> same, two = compare_marks(one, 1 - one, everywhere), compare_marks(one, other, everywhere)
    >>> round(same.correlation, 2), two.correlation < 0.1, two.held
    (1.0, True, (False, False))
    """
    height, width = (min(n) for n in zip(reference.shape, target.shape, strict=True))
    images = [image[:height, :width] for image in (reference, target)]
    first, second = (_Detail.of(image) for image in images)
    both = first.valid & second.valid & where[:height, :width]
    if both.sum() < SETTINGS.window**2:
        return None
    ground = both.copy()
    for image in images:
        drawing = _drawing(image)
        ground &= drawing <= np.quantile(drawing[both], SETTINGS.ground)
    if not ground.any():
        return None
    a, b = (_normalised(one.fine, ground) for one in (first, second))
    found = _correlate(a, b, ground.astype(np.float32))
    if found is None:
        return None
    excess, sigma, windows = found
    del a, b
    noise = [
        one.noise_in(ground, whiteness() if w is None else w)
        for one, w in zip((first, second), white, strict=True)
    ]
    contrast = first.contrast_in(ground), second.contrast_in(ground)
    if own is not None:
        del first, second  # a third of these would be the most that is held
        noise[1] = _noise_of(own)
    return Marks(float(np.sqrt(excess)), sigma, windows, contrast, (noise[0], noise[1]))


def _noise_of(own: np.ndarray) -> float:
    """Return the share of noise in the power of fine detail of a picture in its own px."""
    detail = _Detail.of(own)
    return detail.noise_in(detail.valid, whiteness())


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
    if noise is None:
        noise = white_noise((256, 256))
    one = _Detail.of(noise)
    powers = [float(np.median(np.square(v[one.valid]))) for v in (one.fine, one.laplacian)]
    return powers[0] / max(powers[1], 1e-20)


def white_noise(shape: tuple[int, int]) -> np.ndarray:
    """Return white noise, the same for the same shape, (h, w), float32."""
    return np.random.default_rng(0).standard_normal(shape, np.float32)


def describe_want_of_marks(record: Mapping[str, Any] | None) -> str:
    """Report why marks could not be compared, of what `Marks.to_dict` wrote; empty where they could.

    >>> marks = Marks(0.0, 0.001, 40, (0.002, 0.05), (0.1, 0.1)).to_dict()
    >>> describe_want_of_marks(marks)[-62:]
    'the reference shows no cracks, losses, strokes or weave there.'
    """
    if record is None:
        why = "too little lies beside the outlines"
    elif record["correlation"] >= DISTINCTIVE:
        return ""
    elif not all(record["held"]):
        names = ("the reference", "this picture")
        lacking = [name for name, held in zip(names, record["held"], strict=True) if not held]
        shows = "show" if len(lacking) > 1 else "shows"
        why = f"{' and '.join(lacking)} {shows} no cracks, losses, strokes or weave there"
    elif record["at_most"] >= DISTINCTIVE:
        why = "too little of them lies beside the outlines"
    else:  # the verdict says it
        return ""
    return (
        "Another panel by the same pattern would have the same outlines. Marks beside the outlines would show it, but "
        f"{why}."
    )


def _row_blocks(height: int) -> Iterator[tuple[slice, slice, slice]]:
    """Yield blocks of rows, the same with `REACH` more on either side, and where in these the block is."""
    for start in range(0, height, ROWS):
        stop, above = min(start + ROWS, height), max(start - REACH, 0)
        yield slice(start, stop), slice(above, stop + REACH), slice(start - above, stop - above)


def _values(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture with 0 where it is invalid, and 1 where it is valid, (h, w) float32."""
    weight = np.isfinite(image).astype(np.float32)
    return np.where(weight > 0, image, 0).astype(np.float32), weight


def _separate(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return fine detail, Laplacian and what is valid; of `REACH` rows at the edges only where the picture ends there."""
    import cv2

    values, weight = _values(image)
    sharp, soft = (_smooth(values, weight, sigma) for sigma in SETTINGS.fine)
    return (
        (sharp - soft) * weight,
        cv2.filter2D(values, -1, LAPLACIAN),
        cv2.erode(weight, np.ones((5, 5)), borderValue=1) > 0,
    )


def _drawing(image: np.ndarray) -> np.ndarray:
    """Return how much the smoothed structure of a picture changes, (h, w), some rows at a time."""
    import cv2

    drawing = np.empty(image.shape, np.float32)
    for rows, around, inner in _row_blocks(len(image)):
        values, weight = _values(image[around])
        coarse = _smooth(values, weight, SETTINGS.drawing)
        slope = np.hypot(*(cv2.Sobel(coarse, cv2.CV_32F, *axis) / 8 for axis in ((1, 0), (0, 1))))
        ridge = np.abs(coarse - _smooth(values, weight, 2.5 * SETTINGS.drawing)) / SETTINGS.drawing
        drawing[rows] = cv2.dilate(np.maximum(slope, ridge), np.ones((3, 3)))[inner]
    return drawing


def _smooth(values: np.ndarray, weight: np.ndarray, sigma: float) -> np.ndarray:
    """Return the Gaussian mean over what is valid, 0 where nothing is."""
    import cv2

    total, share = (cv2.GaussianBlur(v, (0, 0), sigma) for v in (values * weight, weight))
    return np.divide(total, share, out=np.zeros_like(total), where=share > 1e-2)


def _normalised(fine: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Return fine detail over its local strength, clipped; 0 off the ground."""
    weight = ground.astype(np.float32)
    strength = np.sqrt(_smooth(np.square(fine), weight, SETTINGS.strength_px))
    floor = 0.2 * float(np.median(strength[ground]))
    return np.clip(fine / (strength + floor + 1e-12), -SETTINGS.clip, SETTINGS.clip) * weight


def _correlate(a: np.ndarray, b: np.ndarray, ground: np.ndarray) -> tuple[float, float, int] | None:
    """Return r² beyond chance at the map, its standard deviation by chance, and the windows; None for too few."""
    side, reach = SETTINGS.window, SETTINGS.away[1] + SETTINGS.near
    places = [
        (y, x)
        for y in range(reach, a.shape[0] - side - reach + 1, side)
        for x in range(reach, a.shape[1] - side - reach + 1, side)
        if ground[y : y + side, x : x + side].mean() >= SETTINGS.least_cover
    ]
    if len(places) < SETTINGS.least_windows:
        return None
    picks = np.linspace(0, len(places) - 1, min(len(places), SETTINGS.most_windows)).round()
    products, powers = np.zeros((2, 2 * reach + 1, 2 * reach + 1))
    for y, x in (places[int(k)] for k in picks):
        rows, columns = slice(y, y + side), slice(x, x + side)
        wide = slice(y - reach, y + side + reach), slice(x - reach, x + side + reach)
        here, there = ground[rows, columns], ground[wide]
        mine = a[rows, columns]
        mine = (mine - mine.sum() / here.sum()) * here
        products += np.square(_slide(mine, b[wide]))
        powers += _slide(here, np.square(b[wide])) * _slide(np.square(mine), there)
    shared = products / np.maximum(powers, 1e-9)
    distance = np.abs(np.arange(-reach, reach + 1))
    apart = np.maximum(distance[:, None], distance)
    chance = shared[(apart >= SETTINGS.away[0]) & (apart <= SETTINGS.away[1])]
    mean = float(chance.mean())
    excess = (float(shared[apart <= SETTINGS.near].max()) - mean) / max(1 - mean, 1e-9)
    return min(max(excess, 0.0), 1.0), float(chance.std()), len(picks)


def _slide(window: np.ndarray, over: np.ndarray) -> np.ndarray:
    """Return the sum of products of a window with every place of a larger picture that it fits in."""
    import cv2

    return np.asarray(cv2.matchTemplate(over, window, cv2.TM_CCORR))

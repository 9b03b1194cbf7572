"""Location of a chart in a cube by OpenCV's `mcc`, verified by the rank correlation of its patches."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.colour.srgb import SRGB_TO_XYZ
from levkas.core.problems import Problem
from levkas.quality.targets.charts import (
    Chart,
    ChartReference,
    ChartRefused,
    pixels_of,
    place_patches,
    turned_corners,
)

if TYPE_CHECKING:
    from levkas.core.cube import Cube

LEAST_AGREEMENT = 0.9
"""Rank correlation of a band's patches with the published ones; a band below it sees another light than it says."""
LEAST_OF_ALL = 0.3
"""The same of all patches in a band in which the greys alone are known: paints in the infrared reach 0.4 to 0.7."""
LONG_SIDES = (900, 1400, 2000)
"""Sizes, px, at which the detector is tried: it wants patches 30 px apart or more."""
STEPS = (0.1, 0.05, 0.02)
"""Of the refinement, in pitches."""
NEAR = 0.5
"""How far, in pitches, one sensor of a camera may see a chart from where another does."""
NEARLY_ALL = 0.75
"""Side of the areas that are made even, over the pitch: most of a patch, so that edges show."""


class Located(NamedTuple):
    """A chart in a picture.

    `corners` (4, 2) px: centres of the corner patches clockwise from the first; `areas` (n, 4, 2)
    px; `agreement`: rank correlation with the published values, the mean of the bands that fit;
    `means` (n, bands); `bands` (bands,): the rank correlation of each band, NaN where nothing is
    published of it.
    """

    corners: np.ndarray
    areas: np.ndarray
    agreement: float
    means: np.ndarray
    bands: np.ndarray

    @property
    def fits(self) -> np.ndarray:
        """(bands,) whether a band ranks the patches as its wavelength should."""
        return np.nan_to_num(self.bands, nan=-1.0) >= LEAST_AGREEMENT

    @property
    def unfit(self) -> np.ndarray:
        """(bands,) whether a band ranks them otherwise; False where nothing is published of it."""
        return np.isfinite(self.bands) & ~self.fits


def locate_chart(
    values: np.ndarray,
    wavelengths: np.ndarray,
    chart: Chart,
    reference: ChartReference | None = None,
    *,
    corners: np.ndarray | None = None,
) -> Located:
    """Find a chart, or check the corners that are given.

    Parameters
    ----------
    values : ndarray, (h, w, bands)
        Reflectance, or counts above dark.
    wavelengths : ndarray, (bands,), nm
        NaN for broad channels.
    reference : Reference, optional
        Spectra to compare with, band by band where wavelengths are known.
    corners : (4, 2), optional
        Centres of the corner patches, px, clockwise from the first patch.
    """
    known = corners is not None
    found = np.asarray(corners, float).reshape(4, 2) if known else find_corners(values, chart)
    size = (values.shape[1], values.shape[0])
    place_patches(found, chart, size)
    # Grey pictures do not say which way up a chart lies: of corners that were found the patches decide.
    compare = partial(rank_agreement, wavelengths=wavelengths, chart=chart, reference=reference)
    best = _best_way(values, found, chart, compare, known=known)
    if best.agreement < LEAST_AGREEMENT and np.isnan(wavelengths).all():
        # Channels of unknown wavelength may be infrared, where paints look otherwise.
        compare = partial(grey_agreement, chart=chart)
        best = _best_way(values, found, chart, compare, known=known)
    if not best.agreement >= LEAST_AGREEMENT:
        raise ChartRefused(_disagrees(best.agreement, chart, known))
    if known:
        return best
    return _located(values, refine_corners(values, best.corners, chart), chart, compare)


Compare = Callable[[np.ndarray], tuple[float, np.ndarray]]
"""From means of patches, (n, bands), to how well they rank, of all and of each band."""


def _best_way(
    values: np.ndarray, corners: np.ndarray, chart: Chart, compare: Compare, *, known: bool
) -> Located:
    """Return the order of four corners in which the patches agree best; of those that were given, as they are."""
    if known:
        return _located(values, corners, chart, compare)
    ways = []
    for way in turned_corners(corners):
        try:
            ways.append(_located(values, way, chart, compare))
        except ChartRefused:  # turned by a right angle, the patches are too narrow to be sampled
            continue
    return max(ways, key=lambda way: (np.count_nonzero(way.fits), way.agreement))


def _located(values: np.ndarray, corners: np.ndarray, chart: Chart, compare: Compare) -> Located:
    areas = place_patches(corners, chart, (values.shape[1], values.shape[0]))
    means = patch_means(values, areas)
    agreement, bands = compare(means)
    return Located(corners, areas, agreement, means, bands)


def locate_in_cube(
    cube: Cube,
    chart: Chart,
    reference: ChartReference | None,
    *,
    corners: np.ndarray | None = None,
    near: np.ndarray | None = None,
) -> Located:
    """Locate a chart in the cube of one sensor."""
    wavelengths = np.array([band.wavelength for band in cube.bands], float)
    try:
        return locate_chart(cube.values, wavelengths, chart, reference, corners=corners)
    except ChartRefused as refused:
        if near is None or corners is not None or refused.problems[0].code != "E_CHART_ORDER":
            raise
        # An infrared channel ranks the patches otherwise than the eye: the place must be the same.
        ways = turned_corners(find_corners(cube.values, chart))
        way = min(ways, key=lambda c: float(np.abs(c - near).max()))
        pitch = float(np.linalg.norm(near[1] - near[0])) / (chart.columns - 1)
        if float(np.abs(way - near).max()) > NEAR * pitch:
            raise
        areas = place_patches(way, chart, (cube.values.shape[1], cube.values.shape[0]))
        nothing = np.full(len(cube.bands), np.nan)
        return Located(way, areas, 1.0, patch_means(cube.values, areas), nothing)


def _disagrees(agreement: float, chart: Chart, known: bool) -> Problem:
    return Problem(
        "E_CHART_ORDER",
        f"what was {'given' if known else 'found'} does not look like a {chart.name}",
        field="--corners" if known else None,
        found=f"rank correlation {agreement:.2f} of its patches with the published ones, the best of bands",
        expected=f"{LEAST_AGREEMENT} or more in a band",
        fix=(
            "Check on the picture that these are the centres of its four corner patches, clockwise from the first "
            f"(dark skin), and that it is a {chart.name} without glare or shadow. Else capture it again, or capture a white."
            if known
            else "Give its four corners with --corners x,y,x,y,x,y,x,y, or capture the chart "
            "flat, whole and free of glare."
        ),
    )


def refine_corners(values: np.ndarray, corners: np.ndarray, chart: Chart) -> np.ndarray:
    """Move the four corners until the patches are as even within as they can be.

    The detector is off by up to a fifth of the pitch on charts of many small patches.
    """
    grey = np.sqrt(np.maximum(values.mean(2, dtype=np.float32), 0))[..., None]
    size = (grey.shape[1], grey.shape[0])
    pitch = float(np.linalg.norm(corners[1] - corners[0])) / (chart.columns - 1)
    best, least = corners.copy(), _unevenness(grey, corners, chart, size)
    for step in STEPS:
        for _ in range(2):
            for corner, axis, sign in np.ndindex(4, 2, 2):
                tried = best.copy()
                tried[corner, axis] += step * pitch * (1 if sign else -1)
                found = _unevenness(grey, tried, chart, size)
                if found < least:
                    best, least = tried, found
    return best


def _unevenness(
    grey: np.ndarray, corners: np.ndarray, chart: Chart, size: tuple[int, int]
) -> float:
    """Mean variance within areas that nearly fill the patches; infinite where these leave the frame."""
    try:
        areas = place_patches(corners, chart, size, sampled=NEARLY_ALL)
    except ChartRefused:
        return float("inf")
    return float(np.mean([grey[pixels_of(area)].var() for area in areas]))


def patch_means(values: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Return the mean of every area and band, (n, bands)."""
    return np.array([values[pixels_of(area)].mean(0) for area in areas], float)


def rank_agreement(
    means: np.ndarray, wavelengths: np.ndarray, chart: Chart, reference: ChartReference | None
) -> tuple[float, np.ndarray]:
    """Return the rank correlation of patches with what is published, -1 … 1, and that of each band.

    Bands whose wavelength is known are compared with the reference, each by itself: a filter that
    leaks must not hide what the others see. The first number is the mean of the bands that fit
    (`LEAST_AGREEMENT`), or the best of all where none does. Broad channels are compared with the
    patches' luminance, the best of them and their mean. Where all bands lie beyond the reference, in the
    infrared, the grey patches alone are compared.
    """
    bands = np.full(len(wavelengths), np.nan)
    wanted = None if reference is None else reference.at(wavelengths)
    if wanted is not None:
        for i in np.flatnonzero(np.isfinite(wanted).all(0)):
            bands[i] = _rank_correlation(means[:, i], wanted[:, i])
    if np.isfinite(bands).any():
        fit = bands >= LEAST_AGREEMENT
        return float(np.mean(bands[fit]) if fit.any() else np.nanmax(bands)), bands
    if reference is not None and len(wavelengths) and np.isfinite(wavelengths).all():
        # All bands lie beyond what is published, where paints look otherwise: only greys stay grey.
        return grey_agreement(means, chart)
    # Infrared channels see other things than the eye does: the best of channels and mean.
    tried = [means.mean(1), *means.T]
    if means.shape[1] == 3:
        tried.append(means @ SRGB_TO_XYZ[1])
    return max(_rank_correlation(column, chart.luminances) for column in tried), bands


def grey_agreement(means: np.ndarray, chart: Chart) -> tuple[float, np.ndarray]:
    """Return the rank correlation of the grey patches with their luminances, the median of bands, and NaN for each band.

    -1 where the other patches have nothing to do with the chart's: six greys rank rightly by chance now and then.
    """
    greys, luminances = list(chart.greys), chart.luminances
    found = [_rank_correlation(column[greys], luminances[greys]) for column in means.T]
    whole = max(_rank_correlation(column, luminances) for column in means.T)
    agreement = float(np.median(found)) if whole > LEAST_OF_ALL else -1.0
    return agreement, np.full(means.shape[1], np.nan)


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    from scipy.stats import rankdata

    if not np.isfinite(a).all() or np.ptp(a) == 0:
        return -1.0
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def find_corners(values: np.ndarray, chart: Chart) -> np.ndarray:
    """Return the centres of the corner patches as OpenCV's detector sees them, in some order."""
    import cv2

    if not hasattr(cv2, "mcc"):
        raise ChartRefused(
            Problem(
                "E_CHART_DETECTOR",
                "this OpenCV cannot find charts",
                found=f"OpenCV {cv2.__version__} without mcc",
                expected="OpenCV 5, or 4 with contrib",
                fix="Give the chart's four corners with --corners x,y,x,y,x,y,x,y.",
            )
        )
    for picture in pictures_of(values):
        for side in LONG_SIDES:
            if (found := _detected(picture, side, chart)) is not None:
                return found
    raise ChartRefused(
        Problem(
            "E_CHART_MISSING",
            f"no {chart.name} was found in the picture",
            found="nothing like it",
            expected=f"a {chart.columns} x {chart.rows} chart, whole, patches 30 px apart or more",
            fix="Capture the whole chart flat and evenly lit, or give its corners with "
            "--corners x,y,x,y,x,y,x,y.",
        )
    )


def pictures_of(values: np.ndarray) -> list[np.ndarray]:
    """Return what the detector is shown, (h, w, 3) uint8 each: pseudo-colour, and the mean, as square roots."""
    bands = values.shape[2]
    thirds = [values[..., part].mean(2) for part in np.array_split(np.arange(bands), min(3, bands))]
    grey = np.repeat(values.mean(2)[..., None], 3, 2)
    shown = [np.stack(thirds, -1)] if bands >= 3 else []
    return [_eight_bits(picture) for picture in (*shown, grey)]


def _eight_bits(picture: np.ndarray) -> np.ndarray:
    picture = np.nan_to_num(picture)
    white = np.maximum(np.percentile(picture, 99.5, axis=(0, 1)), 1e-9)
    level = np.sqrt(np.clip(picture / white, 0, 1))
    return np.ascontiguousarray(np.round(255 * level), dtype=np.uint8)


def _detected(picture: np.ndarray, side: int, chart: Chart) -> np.ndarray | None:
    import cv2

    scale = side / max(picture.shape[:2])
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    shown = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=how)
    detector = cv2.mcc.CCheckerDetector.create()
    kind = cv2.mcc.SG140 if chart.rows == 10 else cv2.mcc.MCC24
    detector.setColorChartType(kind)
    if not detector.process(shown, 1):
        return None
    quads = np.asarray(detector.getBestColorChecker().getColorCharts(), float).reshape(-1, 4, 2)
    if len(quads) != len(chart.patches):
        return None
    centres = quads.mean(1)
    if len(np.unique(centres.round(), axis=0)) < len(centres):
        return None  # some of its finds have every patch in one place
    last = chart.columns * (chart.rows - 1)
    corners = centres[[0, chart.columns - 1, last + chart.columns - 1, last]]
    return (corners + 0.5) / scale - 0.5

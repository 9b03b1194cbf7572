"""Methods of registration that are compared: their table, their input and output, and those of OpenCV.

A method gets a grey picture of either camera and a start by scale alone, and returns a map."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from levkas.campaign.methods import METHODS
from levkas.geometry.transforms import Affine, Composed, Homography, invert
from levkas.registration.bands import area_average, stretch
from levkas.registration.features import KeyPoints, find_key_points
from levkas.registration.matching import find_neighbours
from levkas.registration.mirhashemi2019 import AlignedCamera, scale_only

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from levkas.registration.bands import BandImage

    Map = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class ComparedMethod:
    """One row of the comparison.

    Parameters
    ----------
    title : str
        For people.
    module, function : str
        Where it is; of `levkas.registration.METHODS` where `module` is empty.
    package : str
        What must be installed, as it is imported; empty where Levkas has it anyway.
    distribution : str
        Its name for a package manager.
    """

    title: str
    module: str = ""
    function: str = ""
    package: str = ""
    distribution: str = ""

    @property
    def missing(self) -> str:
        """What the method needs and is not there, for a message; empty where it can run."""
        if self.package and find_spec(self.package) is None:
            return f"{self.distribution} is not installed"
        folder = self.module.partition(".")[0]
        if folder and find_spec(folder) is None:
            return f"{folder} is part of the repository alone"
        return ""

    @property
    def version(self) -> str:
        """Version of the package; empty for what is written here."""
        try:
            return version(self.distribution) if self.distribution else ""
        except PackageNotFoundError:
            return ""


_OURS, _PEERS = "levkas.quality.comparison.methods", "levkas_peers."
COMPARED: dict[str, ComparedMethod] = {
    "levkas": ComparedMethod("Levkas"),
    "mirhashemi2019": ComparedMethod("Mirhashemi 2019"),
    "surf-projective": ComparedMethod(
        "SURF, projective", _PEERS + "surf", "surf_projective", "mahotas", "mahotas"
    ),
    "gdbicp-quadratic": ComparedMethod(
        "GDB-ICP, quadratic", _PEERS + "dual_bootstrap", "gdbicp_quadratic"
    ),
    "gdbicp-radial": ComparedMethod(
        "GDB-ICP, homography and radial", _PEERS + "dual_bootstrap", "gdbicp_radial"
    ),
    "opencv-sift-magsac": ComparedMethod(
        "OpenCV SIFT, MAGSAC", _OURS, "opencv_sift_magsac", "cv2", "opencv-python-headless"
    ),
    "opencv-ecc": ComparedMethod(
        "OpenCV ECC", _OURS, "opencv_ecc", "cv2", "opencv-python-headless"
    ),
    "elastix": ComparedMethod("elastix", _PEERS + "intensities", "elastix", "itk", "itk-elastix"),
    "simpleitk": ComparedMethod(
        "SimpleITK", _PEERS + "intensities", "simpleitk", "SimpleITK", "simpleitk"
    ),
    "ants": ComparedMethod("ANTs SyN", _PEERS + "intensities", "ants", "ants", "antspyx"),
}
COMPARED |= {name: ComparedMethod(name) for name in METHODS if name not in COMPARED}
"""Last those of installed packages."""


def find_peers() -> None:
    """Let `levkas_peers` be imported where this is a checkout: its folder is `benchmarks/peers`."""
    folder = Path(__file__).parents[4] / "benchmarks" / "peers"
    if folder.is_dir() and str(folder) not in sys.path:
        sys.path.append(str(folder))


@dataclass(frozen=True)
class Pair:
    """Two grey pictures of one scene at about one sampling.

    Parameters
    ----------
    reference, target : ndarray, (h, w), float32
        Mean of all bands; the reference cut to the object's region, the target area-averaged to the
        sampling of the reference.
    reference_valid, target_valid : ndarray of bool
    start : Affine
        Scale alone, centre upon centre: px of `reference` → px of `target`.
    origin : (x, y)
        Of `reference` in reference px.
    back : Affine
        px of `target` → native px of the target's first sensor.
    """

    reference: np.ndarray
    reference_valid: np.ndarray
    target: np.ndarray
    target_valid: np.ndarray
    start: Affine
    origin: tuple[int, int]
    back: Affine

    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the target on the reference's pixels by `start` alone, and what of it is valid.

        What the intensity-based peers are given; pixels without a value are the mean of the rest.
        """
        from levkas.geometry.resample import warp

        filled = np.where(self.target_valid, self.target, np.float32(np.nan))
        values = warp(filled.astype(np.float32), self.start, self.reference.shape).values
        valid = np.isfinite(values)
        level = float(values[valid].mean()) if valid.any() else 0.0
        return np.where(valid, values, np.float32(level)), valid

    def whole(self, found: Map) -> Map:
        """Return a map between the pictures as one from reference px to native px of the target."""
        shift = np.array(self.origin, float)
        return lambda points: self.back(found(np.asarray(points, float) - shift))


def pair_of(
    reference: Sequence[BandImage],
    target: Sequence[BandImage],
    reference_band: str,
    region: Sequence[float] | None = None,
) -> tuple[Pair, AlignedCamera]:
    """Make the pair of two cameras; the target's other sensors are aligned to its first.

    Returns
    -------
    pair : Pair
    target : AlignedCamera
        With the alignment of every sensor.
    """
    sensor = next(image.sensor for image in reference if image.label == reference_band)
    ours = AlignedCamera.of([i for i in reference if i.sensor == sensor], sensor, None)
    theirs = AlignedCamera.of(target, target[0].sensor, None)
    x, y, w, h = _cut(region, ours.size)
    pull = scale_only(ours.size, theirs.size)  # target → reference
    scale = min(1.0, float(pull.matrix[0, 0]))
    values, valid, back = area_average(theirs.values, theirs.valid, scale)
    corners = np.array([[0, 0], [w, 0], [0, h]], float)
    start = Affine.fit(corners, back.inverse(pull.inverse(corners + np.array([x, y]))))
    box = np.s_[y : y + h, x : x + w]
    pair = Pair(
        np.ascontiguousarray(ours.values[box], np.float32),
        np.ascontiguousarray(ours.valid[box]),
        np.ascontiguousarray(values, np.float32),
        np.ascontiguousarray(valid),
        start,
        (x, y),
        back,
    )
    return pair, theirs


def spread(camera: AlignedCamera, found: Map) -> dict[str, Map]:
    """Give every band the map of its camera's first sensor, then that of its own sensor."""
    maps: dict[str, Map] = {}
    for image in camera.images:
        own: Any = camera.alignments[image.sensor]
        same = image.sensor == camera.sensor
        maps[image.label] = found if same else _after(found, own)
    return maps


def _after(first: Map, then: Map) -> Map:
    return lambda points: then(first(points))


def _cut(region: Sequence[float] | None, size: tuple[int, int]) -> tuple[int, int, int, int]:
    x, y, w, h = (round(float(v)) for v in region or (0, 0, *size))
    left, top = min(max(x, 0), size[0] - 1), min(max(y, 0), size[1] - 1)
    return left, top, min(x + w, size[0]) - left, min(y + h, size[1]) - top


Decision = Literal["accept", "warn", "refuse", "none"]


class NoAnswer(Exception):
    """A pair for which a method finds no map, with the reason."""


@dataclass(frozen=True)
class Answer:
    """The map that a method found, with its verdict.

    Parameters
    ----------
    found : callable
        (n, 2) px of the pair's reference → px of its target.
    note : str
        Matches kept, final cost, and the like.
    decision : {"accept", "warn", "refuse", "none"}
        ``"none"``: the method does not judge its own result.
    """

    found: Callable[[np.ndarray], np.ndarray]
    note: str = ""
    decision: Decision = "none"


STEP_PX = 0.5


@dataclass(frozen=True, eq=False)
class AnyMap:
    """A function of points as a `Transform`: differentiated by differences, inverted by Newton."""

    function: Callable[[np.ndarray], np.ndarray]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self.function(np.asarray(points, float))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(x′, y′)/d(x, y), (n, 2, 2), by differences over a pixel."""
        points = np.asarray(points, float)
        columns = [
            (self(points + step) - self(points - step)) / (2 * STEP_PX)
            for step in np.eye(2) * STEP_PX
        ]
        return np.stack(columns, axis=2)

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map target points back; NaN where Newton does not converge."""
        return invert(self, points, np.asarray(points, float))

    def to_dict(self) -> dict[str, Any]:
        """Refuse: a function cannot be stored."""
        raise NotImplementedError("a map of another program is not stored")


SIFT_RATIO = 0.8
MAGSAC_DISTANCE = 3.0
"""Largest residual of an inlier, px."""
FEWEST = 8
LEVELS = 4
"""Of the pyramid of ECC."""
LEAST_SIDE = 32
"""Of a level of the pyramid, px."""


def opencv_sift_magsac(pair: Pair) -> Answer:
    """Match SIFT key points by Lowe's ratio test and fit a homography by MAGSAC."""
    import cv2

    sides = [
        find_key_points(stretch(values, valid), valid, contrast=0.02, root=False)
        for values, valid in (
            (pair.reference, pair.reference_valid),
            (pair.target, pair.target_valid),
        )
    ]
    source, goal = ratio_matches(sides, SIFT_RATIO)
    options = {"maxIters": 10_000, "confidence": 0.9999}
    return fit_homography(
        source, goal, "MAGSAC",
        method=cv2.USAC_MAGSAC, ransacReprojThreshold=MAGSAC_DISTANCE, **options,
    )  # fmt: skip


def opencv_ecc(pair: Pair) -> Answer:
    """Fit a homography by ECC [evangelidis2008]_, coarse to fine; images are blurred here, for ECC's own blur biases."""
    import cv2

    ecc: Any = cv2.findTransformECC
    moved, valid = pair.moved()
    warp = np.eye(3)
    cost: float = float("nan")
    for level in reversed(range(LEVELS)):
        scale = 0.5**level
        if min(moved.shape) * scale < LEAST_SIDE:
            continue
        a, b = (_reduced(cv2, p, scale) for p in (pair.reference, moved))
        mask = _reduced(cv2, valid.astype(np.float32), scale) > 0.99
        shrink = np.array([[scale, 0, scale / 2 - 0.5], [0, scale, scale / 2 - 0.5], [0, 0, 1]])
        guess = (shrink @ warp @ np.linalg.inv(shrink)).astype(np.float32)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60 if level else 30, 1e-6)
        try:
            cost, guess = ecc(a, b, guess, cv2.MOTION_HOMOGRAPHY, stop, mask.astype(np.uint8), 1)
        except cv2.error as error:
            raise NoAnswer(str(error).splitlines()[-1][-120:]) from error
        warp = np.linalg.inv(shrink) @ guess.astype(float) @ shrink
    return Answer(Composed(Homography(warp), pair.start), f"correlation {cost:.3f}")


def ratio_matches(sides: list[KeyPoints], ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of matches in reference and target, (n, 2) px each, by Lowe's ratio test [lowe2004]_."""
    reference, target = sides
    if min(len(reference), len(target)) < 2:
        raise NoAnswer(f"{len(reference)} and {len(target)} key points")
    near = find_neighbours(reference.descriptors, target.descriptors)
    rows = np.flatnonzero(near.distance < ratio * near.second)
    columns = near.nearest[rows]
    _, first = np.unique(columns, return_index=True)
    return reference.points[rows[first]], target.points[columns[first]]


def fit_homography(source: np.ndarray, goal: np.ndarray, sampler: str, **options: Any) -> Answer:
    """Fit a homography to matches, (n, 2) px each, by `cv2.findHomography` under `options`.

    Raises
    ------
    NoAnswer
        With fewer than 8 matches, or where OpenCV finds none.
    """
    import cv2

    if len(source) < FEWEST:
        raise NoAnswer(f"{len(source)} matches, a homography by {sampler} wants {FEWEST}")
    cv2.setRNGSeed(0)
    matrix, inside = cv2.findHomography(source, goal, **options)
    if matrix is None:
        raise NoAnswer(f"{sampler} found no homography in {len(source)} matches")
    return Answer(Homography(matrix), f"{int(np.sum(inside))} of {len(source)} matches kept")


def _reduced(cv2: Any, picture: np.ndarray, scale: float) -> np.ndarray:
    size = tuple(max(1, round(side * scale)) for side in picture.shape[::-1])
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if scale < 1 else picture
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), np.float32)

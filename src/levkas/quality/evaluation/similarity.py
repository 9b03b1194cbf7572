"""Quality of a registration: errors against truth or check points, and SSIM with its map."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.text import read_json
from levkas.geometry import from_dict
from levkas.readers.arrays import read_npy

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from levkas.geometry.transforms import Transform

SSIM_SIGMA = 1.5
SSIM_WINDOW, SSIM_ROWS = 11, 512
"""Side of the window, px; rows that are compared at a time."""
RANGE_PERCENTILES = (0.1, 99.9)
BLOCKS = 6
"""Parts a side of a picture, whose means scatter independently where what errs alike is smaller than they are. Intervals (k = 2) hold 94 %
where errors are alike over a fortieth of the picture, 92 % over a twentieth and 88 % over a twelfth; with four parts 93, 91 and 89 %."""


@dataclass(frozen=True)
class BandError:
    """Errors of one band in reference pixels, over the points that lie on the grid; `mean_u` is the standard uncertainty of the mean."""

    band: str
    mean: float
    p95: float
    max: float
    points: int
    mean_u: float = nan

    def to_dict(self) -> dict[str, Any]:
        """Return the record of `evaluate --json`."""
        return {
            "band": self.band,
            "error_mean": self.mean,
            "error_mean_u": self.mean_u,
            "error_p95": self.p95,
            "error_max": self.max,
            "points": self.points,
        }


def position_errors(transform: Transform, reference: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the errors of a map at points that are known in both frames, reference px.

    Parameters
    ----------
    transform : Transform
        Reference px to native px of the band.
    reference, target : ndarray, (n, 2)
        The same points of the scene in reference px and in native px of the band.

    Returns
    -------
    errors : ndarray, (n,)
        Distance in reference px; NaN where the map has no inverse.

    Raises
    ------
    ValueError
        Where the two arrays are not both (n, 2).

    Examples
    --------
    >>> from levkas.geometry.transforms import Affine
    >>> twice = Affine(np.array([[2.0, 0, 0], [0, 2, 0]]))
    >>> position_errors(twice, np.array([[1.0, 1]]), np.array([[2.0, 4]]))
    array([1.])
    """
    reference, target = np.asarray(reference, float), np.asarray(target, float)
    if reference.ndim != 2 or reference.shape[1] != 2 or target.shape != reference.shape:
        raise ValueError(
            f"points of shapes {reference.shape} and {target.shape}; both must be (n, 2)"
        )
    return np.asarray(np.linalg.norm(transform.inverse(target) - reference, axis=1))


def summarise_errors(band: str, errors: np.ndarray, places: np.ndarray) -> BandError:
    """Return mean, 95th percentile and maximum of `errors` at `places`, (n, 2), NaN (no answer) counting as infinite."""
    if not len(errors):
        return BandError(band, nan, nan, nan, 0)
    worst = np.where(np.isnan(errors), np.inf, errors)
    with np.errstate(invalid="ignore"):
        p95 = float(np.sort(worst)[min(len(worst) - 1, int(np.ceil(0.95 * len(worst))) - 1)])
    mean, most = float(worst.mean()), float(worst.max())
    return BandError(band, mean, p95, most, len(worst), uncertainty_of_mean(worst, places))


def uncertainty_of_mean(values: np.ndarray, places: np.ndarray) -> float:
    """Return the standard uncertainty of the mean of values at places, whose neighbours err alike.

    Parameters
    ----------
    values : ndarray, (n,)
    places : ndarray, (n, 2)
        x and y of each, of the picture that they are a sample of.

    Returns
    -------
    u : float
        NaN of fewer than two parts of the picture, and where a value is not finite.

    Notes
    -----
    By the scatter of the sums of spatial blocks about the mean, as that of a ratio, [cochran1977]_, Eq. (6.13): another picture of that kind
    would have another mean. Values that have nothing in common give their standard deviation over √n.

    Examples
    --------
    >>> places = np.array([[0.0, 0], [9, 0], [0, 9], [9, 9]])
    >>> round(uncertainty_of_mean(np.array([0.1, 0.2, 0.3, 0.4]), places), 4)
    0.0645
    """
    if len(values) < 2 or not np.isfinite(values).all():
        return nan
    low, high = places.min(0), places.max(0)
    cells = (BLOCKS * (places - low) / np.maximum(high - low, 1e-9)).astype(int)
    names = np.minimum(cells, BLOCKS - 1) @ (BLOCKS, 1)
    sums, counts = (np.bincount(names, weights=w) for w in (values - values.mean(), None))
    some = int(np.count_nonzero(counts))
    if some < 2:
        return nan
    return float(np.sqrt(np.square(sums).sum() * some / (some - 1)) / len(values))


@dataclass(frozen=True)
class Truth:
    """Where points of the reference band lie in every band of one camera."""

    reference: np.ndarray
    bands: dict[str, np.ndarray]


def read_truth(
    folder: Path, name: str, camera: str, points: np.ndarray | None = None
) -> Truth | None:
    """Read the truth of one object and camera, or one of its tiles, CAMERA#TILE; None where there is none.

    `points`, (n, 2), is where the points lie in reference px, where that is no single frame (`places_by_tiles`).
    """
    reference, target = folder / f"{name}_ref_px.npy", folder / f"{name}_{camera}_px.npy"
    known = target.is_file() and (folder / "truth.json").is_file()
    if not known or (points is None and not reference.is_file()):
        return None
    record = read_json(folder / "truth.json")
    labels = list(record.get("cameras", {}).get(camera, {}).get("bands", []))
    points = read_npy(reference, (None, 2)) if points is None else points
    rows = read_npy(target, (1 + len(labels), len(points), 2))
    return Truth(points, dict(zip(labels, rows[1:], strict=True)))


def places_by_tiles(folder: Path, name: str, record: Mapping[str, Any]) -> np.ndarray | None:
    """Return where the points of a truth lie in the frame that the reference camera's tiles were placed in, (n, 2) px.

    Each by the tile in whose frame it lies deepest, which is the one that is published; NaN where no tile shows it.
    """
    camera, band = record["reference"]["camera"], record["reference"]["band"]
    places: np.ndarray | None = None
    deepest = np.zeros(0)
    for tile, one in record["tiles"].items():
        path = folder / f"{name}_{camera}#{tile}_px.npy"
        if not (one.get("bands") and path.is_file() and (folder / "truth.json").is_file()):
            continue
        cameras = read_json(folder / "truth.json").get("cameras", {})
        labels = list(cameras.get(f"{camera}#{tile}", {}).get("bands", []))
        pixels = read_npy(path, (1 + len(labels), None, 2))[1 + labels.index(band)]
        if places is None:
            places, deepest = np.full(pixels.shape, np.nan), np.zeros(len(pixels))
        low, high = pixels + 0.5, np.array(one["size"]) - 0.5 - pixels
        depth = np.nan_to_num(np.minimum(low, high).min(1), nan=-1.0)
        here = depth > deepest
        places[here] = from_dict(one["bands"][band]["transform"]).inverse(pixels[here])
        deepest[here] = depth[here]
    return places


def inside(points: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """Return which points, (n, 2), lie in a picture of size (width, height); NaN lies in none.

    >>> inside(np.array([[-0.5, 3.4], [4.0, 1.0]]), (4, 4)).tolist()
    [True, False]
    """
    with np.errstate(invalid="ignore"):
        return np.all((points >= -0.5) & (points <= np.array(size) - 0.5), axis=1)


def structural_similarity(
    reference: np.ndarray, target: np.ndarray, valid: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the SSIM of two registered grey images, as [wang2004]_ through scikit-image.

    The target is brought to the reference's mean and spread over `valid` first; the range is the
    joint 0.1 to 99.9 percentile range; the mean is over `valid`.

    Parameters
    ----------
    reference, target : ndarray, (h, w)
        Values in any unit.
    valid : ndarray of bool, (h, w)
        Pixels valid in both.

    Returns
    -------
    ssim : float
        −1 … 1; NaN where fewer than 121 pixels are valid or an image is flat.
    map : ndarray, (h, w), float32
        SSIM about each pixel, −1 … 1; NaN outside `valid`.

    Raises
    ------
    ValueError
        Where the three arrays differ in shape.

    Notes
    -----
    [wang2004]_, doi:10.1109/TIP.2003.819861: Gaussian window of σ 1.5 over 11 px.

    Examples
    --------
    >>> y, x = np.mgrid[:32, :32]
    >>> picture = np.sin(x / 3.0) + np.sin(y / 5.0)
    >>> ssim, _ = structural_similarity(picture, 2 * picture + 1, np.ones((32, 32), bool))
    >>> round(ssim, 3)
    1.0
    """
    from skimage.metrics import structural_similarity as ssim

    if reference.ndim != 2 or not reference.shape == target.shape == valid.shape:
        shapes = ", ".join(str(a.shape) for a in (reference, target, valid))
        raise ValueError(f"pictures and mask of shapes {shapes}; all must be the same (h, w)")
    found = np.full(reference.shape, np.nan, np.float32)
    if valid.sum() < SSIM_WINDOW**2 or min(reference.shape) < SSIM_WINDOW:
        return float("nan"), found
    a, b = (image[valid] for image in (reference, target))
    mean, spread = a.mean(dtype=float), b.std(dtype=float)
    if spread == 0 or a.std(dtype=float) == 0:
        return float("nan"), found
    gain = float(a.std(dtype=float) / spread)
    offset = float(mean - gain * b.mean(dtype=float))
    low, high = np.percentile(np.concatenate([a, gain * b + offset]), RANGE_PERCENTILES)
    del a, b
    height, margin = len(reference), SSIM_WINDOW // 2  # beyond which no pixel of a window lies
    for top in range(0, height, SSIM_ROWS):
        bottom = min(top + SSIM_ROWS, height)
        first, last = max(top - margin, 0), min(bottom + margin, height)
        if last - first < SSIM_WINDOW:
            first = height - SSIM_WINDOW
        known = valid[first:last]
        ours, theirs = (image[first:last].astype(float) for image in (reference, target))
        _, part = ssim(
            np.where(known, ours, mean),
            np.where(known, gain * theirs + offset, mean),
            data_range=high - low,
            gaussian_weights=True,
            sigma=SSIM_SIGMA,
            win_size=SSIM_WINDOW,
            full=True,
        )
        found[top:bottom] = np.where(known, part, np.nan)[top - first : bottom - first]
    return float(np.mean(found, where=valid, dtype=float)), found

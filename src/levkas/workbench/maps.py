"""Maps over the reference frame: predicted sigma, leave-one-out error, SSIM, flags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem, Refused
from levkas.workbench.pictures import ShownPicture, place_on_lattice

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform
    from levkas.registration.record import Matches

LONGEST_PX = 480
NODES = 48
RAMP = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], float)
"""Five colours of matplotlib's viridis: readable without red and green."""
KINDS = {
    "sigma": "predicted uncertainty of the map, px (one standard deviation)",
    "leave-one-out": "error of the kept pairs by a fit without them, px",
    "ssim": "structural similarity of both pictures, 1 is alike",
    "flags": "share of pixels flagged in this band",
}


class MapMissing(Refused):
    """There is nothing to draw such a map from."""


@dataclass(frozen=True)
class Map:
    """A map as a picture over the reference frame.

    Parameters
    ----------
    pixels : ndarray, (h, w, 4), uint8
        Transparent where nothing is known.
    low, high : float
        What the ends of the ramp mean.
    """

    pixels: np.ndarray
    low: float
    high: float


def find_kinds(record: dict[str, Any], band: str) -> list[str]:
    """Return the maps that there are for a band of a registration's record."""
    return [kind for kind in KINDS if kind != "sigma" or _lattice(record, band)]


def draw_sigma(record: dict[str, Any], band: str, size: tuple[int, int]) -> Map:
    """Draw the uncertainty that the registration predicted for a band, from the lattice of its record."""
    lattice = _lattice(record, band)
    if lattice is None:
        raise _missing("sigma", "this method predicts no uncertainty")
    values = np.array(lattice["sigma_px"], float)
    x, y = (np.array(lattice[k], float) for k in "xy")
    across, down = _axes(size)
    along = np.stack([np.interp(across, x, line) for line in values])
    full = np.stack([np.interp(down, y, line) for line in along.T], 1)
    inside = ((across >= x[0]) & (across <= x[-1]))[None] & ((down >= y[0]) & (down <= y[-1]))[
        :, None
    ]
    return _coloured(np.where(inside, full, np.nan), low=0.0)


def draw_leave_one_out(matches: Matches, size: tuple[int, int]) -> Map:
    """Draw the mean leave-one-out error of kept pairs around each place."""
    good = matches.kept & np.isfinite(matches.leave_one_out)
    if good.sum() < 3:
        raise _missing("leave-one-out", "too few pairs are fitted")
    points, errors = matches.reference[good], matches.leave_one_out[good]
    across, down = _axes(size)
    reach = max(size) / 24
    full = np.empty((len(down), len(across)))
    for i, y in enumerate(down):
        apart = np.square(points[:, 0][None] - across[:, None])
        weight = np.exp(-(apart + np.square(points[:, 1] - y)[None]) / (2 * reach**2))
        total = weight.sum(1)
        with np.errstate(invalid="ignore", divide="ignore"):
            full[i] = np.where(total > 0.05, (weight * errors).sum(1) / total, np.nan)
    return _coloured(full, low=0.0)


def draw_ssim(reference: ShownPicture, target: ShownPicture, forward: Transform) -> Map:
    """Draw the structural similarity of the reference and of the target brought into its frame."""
    from levkas.quality.evaluation.similarity import structural_similarity

    step = max(1.0, max(reference.size) / LONGEST_PX)
    across, down = _axes(reference.size, LONGEST_PX)
    here = np.stack(np.meshgrid(across, down), -1)
    ours, known = reference.sample(here, step)
    placed = place_on_lattice(forward, across, down)
    theirs, seen = target.sample(placed, step)
    score, full = structural_similarity(ours, theirs, known & seen)
    if not np.isfinite(score):
        raise _missing("ssim", "the pictures do not overlap")
    return _coloured(full.astype(float), low=0.0, high=1.0)


def draw_flags(flags: np.ndarray, forward: Transform, size: tuple[int, int]) -> Map:
    """Draw the share of flagged pixels of one band, (h, w) uint8, in the reference frame."""
    flagged = ShownPicture(np.where(flags != 0, 255, 0).astype(np.uint8))
    across, down = _axes(size, LONGEST_PX)
    placed = place_on_lattice(forward, across, down)
    step = max(1.0, max(size) / LONGEST_PX)
    share, seen = flagged.sample(placed, step)
    return _coloured(np.where(seen, share / 255.0, np.nan), low=0.0, high=1.0)


def to_png(drawn: Map) -> bytes:
    """Encode a map as PNG."""
    import imagecodecs

    return bytes(imagecodecs.png_encode(np.ascontiguousarray(drawn.pixels), level=6))


def _lattice(record: dict[str, Any], band: str) -> dict[str, Any] | None:
    found = record.get("bands", {}).get(band, {}).get("sigma")
    return found if isinstance(found, dict) and found.get("sigma_px") else None


def _axes(size: tuple[int, int], most: int = NODES * 4) -> tuple[np.ndarray, np.ndarray]:
    """Reference px of the columns and rows of a map."""
    width, height = size
    step = max(1.0, max(size) / most)
    counts = [max(1, round(side / step)) for side in (width, height)]
    return tuple(
        (np.arange(n) + 0.5) * side / n - 0.5 for n, side in zip(counts, size, strict=True)
    )  # type: ignore[return-value]


def _coloured(values: np.ndarray, *, low: float, high: float | None = None) -> Map:
    known = np.isfinite(values)
    if high is None:
        high = float(np.percentile(values[known], 98)) if known.any() else 1.0
    high = max(high, low + 1e-6)
    share = np.clip((np.where(known, values, low) - low) / (high - low), 0, 1)
    stops = np.linspace(0, 1, len(RAMP))
    colour = np.stack([np.interp(share, stops, RAMP[:, c]) for c in range(3)], -1)
    alpha = np.where(known, 255, 0)
    return Map(np.dstack([np.rint(colour), alpha]).astype(np.uint8), low, high)


def _missing(kind: str, why: str) -> MapMissing:
    return MapMissing(Problem("E_NO_MAP", f"there is no map of {KINDS[kind]}", found=why))

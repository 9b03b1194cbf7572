"""Strips of a line scan, the passes of a stage from left to right: placed beside one another as tiles of one row are.

Each line is exposed at once, so that a stage that runs askew moves lines as a whole: where a strip lies is a function of the line alone,
p ↦ p − t − c·y. Where a stage wobbles, strips are not joined: each is registered by itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.sensor import by_exposure, placed
from levkas.calibration.templates import CalibrationRefused
from levkas.core.cube import UNRELIABLE, Flag, is_flagged
from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration.models import scale_covariance
from levkas.registration.record import RegistrationRefused, refusal
from levkas.registration.tiles import NoOverlap, OverlapWindows, correlate_tiles, measure_overlap
from levkas.stages.parts import PartPlace, Placement
from levkas.stages.scan_templates import blocks_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.calibration.sensor import SensorCapture
    from levkas.stages.scan_lines import Strip
    from levkas.stages.scan_templates import ScanTemplates

SCOUT_LINES, WEIGHED_LINES = 2048, 64
"""In the middle of strips, by which they are found; whose noise gives how much a band counts."""
LARGEST_ERROR_PX = 0.15
"""Standard error of where a strip lies, beyond which the overlap shows too little."""
MOST_SCATTER_PX, NOISE = 0.2, 4.0
"""Of windows about where the strip lies: where it is more, and more than so many times their own noise, the stage wobbles."""
GAIN = 0.75
"""A slope has to lower the squared error at windows that were left out to this share."""
UNTRUSTED = UNRELIABLE | Flag.DEFECT


def place_strips(strips: Sequence[Strip]) -> tuple[Placement, list[str]]:
    """Find how strips lie, in px of the first, in one pass over each; return notes, too, and note the joints in what was measured.

    Raises CalibrationRefused, ``E_STRIPS``, which names the files, where the offset of two is not certain.
    """
    context, (lines, samples, _) = strips[0].context, strips[0].shape
    labels = [band.label for band in context.sensor.bands]
    weights = _band_weights(strips[0])
    left, whole, width = _grey(strips[0], weights), Affine.identity(), samples
    places, notes, joints = {"1": PartPlace(dict.fromkeys(labels, whole))}, [], []
    onto: Transform = whole
    for number, strip in enumerate(strips[1:], 2):
        right = _grey(strip, weights)
        try:
            step, joint = find_joint(left, right)
        except RegistrationRefused as refused:
            raise _named(refused, strips, number) from None
        onto = Composed(*([] if onto is whole else [onto]), step)
        places[str(number)] = PartPlace(dict.fromkeys(labels, onto), joint["error_px"])
        ends = np.array([[strip.shape[1] - 0.5, y] for y in (0.0, strip.shape[0] - 1.0)])
        width = max(width, int(np.floor(onto.inverse(ends)[:, 0].max())) + 1)
        joints.append(joint)
        notes.append(
            f"strips {number - 1} and {number} share {joint['overlap_px']:.2f} samples "
            f"(shift {joint['offset_px'][1]:.2f} lines, ± {joint['error_px']:.2f} px)"
        )
        left = right
    context.record.strips = joints
    return Placement(places, (width, lines)), notes


def find_joint(left: np.ndarray, right: np.ndarray) -> tuple[Affine, dict[str, Any]]:
    """Return px of the left one of two strips → px of the right one, and what is recorded of it.

    Raises RegistrationRefused, ``E_STRIPS``: no place matches, several match, or the overlap has too little detail.

    Parameters
    ----------
    left, right : ndarray, (lines, samples), float32
        NaN where nothing can be relied on.
    """
    windows = _overlap(left, right)
    height, offset = left.shape[0], windows.points - windows.partners
    line = windows.points[:, 1] / height
    half = np.arange(len(line)) % 2 == 0
    errors = []
    for count in (1, 2):
        misses = [
            (
                offset
                - _design(line, count)
                @ _fit(line[one], offset[one], windows.information[one], count)
            )[~one]
            for one in (half, ~half)
        ]
        squares = (np.concatenate(misses) ** 2).sum(1)
        errors.append(float(np.minimum(squares, 9 * max(np.median(squares), 1e-12)).sum()))
    count = 2 if errors[1] < GAIN * errors[0] else 1
    course = _fit(line, offset, windows.information, count)
    miss = offset - _design(line, count) @ course
    scatter = 1.4826 * np.median(np.abs(miss), 0)
    noise = np.sqrt(np.median(np.diagonal(np.linalg.inv(windows.information), 0, 1, 2), 0))
    wobble = float(np.where(scatter > NOISE * noise, scatter, 0.0).max())
    information, _ = scale_covariance(miss, windows.information)
    error = float(np.sqrt(count * np.diag(np.linalg.inv(information.sum(0)))).max())
    if wobble > MOST_SCATTER_PX:
        found = f"lines of the strips lie ± {wobble:.2f} px beside one another"
        raise _apart(found, "lines that lie still")
    if not error <= LARGEST_ERROR_PX:
        raise _apart(f"the offset is known to ± {error:.2f} px", "more detail in the overlap")
    slope = course[1] / height if count == 2 else np.zeros(2)
    mean = course[0] + (course[1] / 2 if count == 2 else 0.0)
    transform = Affine(
        np.array([[1.0, -slope[0], -course[0][0]], [0.0, 1 - slope[1], -course[0][1]]])
    )
    return transform, {
        "offset_px": mean.round(3).tolist(),
        "error_px": round(error, 4),
        "slope_px": (slope * height).round(3).tolist(),
        "overlap_px": round(float(left.shape[1] - mean[0]), 2),
        "explained": round(windows.explained, 4),
    }


def _overlap(left: np.ndarray, right: np.ndarray) -> OverlapWindows:
    """Return what two strips show both: found by their middle lines, wherever the right one begins in the left one."""
    lines, samples = min(len(left), len(right)), left.shape[1]
    first, tall = max(0, (lines - SCOUT_LINES) // 2), min(lines, SCOUT_LINES)
    begin = Affine.of_box(-(samples // 2), 0)
    middle = [picture[first : first + tall] for picture in (left, right)]
    found = correlate_tiles(middle[0], middle[1], begin, samples / 2)
    if found is None:
        raise _apart(
            "no place at which they match, or several", "detail that does not repeat itself"
        )
    down = Affine.of_box(0, first)
    outcome = measure_overlap(
        left, right, Composed(Affine.of_box(0, -first), found[0], down), reach=found[1]
    )
    if isinstance(outcome, NoOverlap):
        raise _apart(f"their overlap: {outcome.reason}", "an overlap that shows the same in both")
    return outcome


def _design(line: np.ndarray, count: int) -> np.ndarray:
    """Return the weights of `count` coefficients at lines, as shares of the scan, (n, count)."""
    return np.vander(line, count, increasing=True)


def _fit(line: np.ndarray, offset: np.ndarray, information: np.ndarray, count: int) -> np.ndarray:
    """Fit offsets (n, 2) along the scan by robust least squares; return coefficients, (count, 2)."""
    design, course = _design(line, count), np.zeros((count, 2))
    course[0] = np.median(offset, 0)
    for _ in range(8):
        scaled, weight = scale_covariance(offset - design @ course, information)
        for axis in range(2):
            root = np.sqrt(weight / np.linalg.inv(scaled)[:, axis, axis])
            solved = np.linalg.lstsq(root[:, None] * design, root * offset[:, axis], rcond=None)
            course[:, axis] = solved[0]
    return course


def _band_weights(strip: Strip) -> np.ndarray:
    """Return how much each band counts in the pictures that strips are matched by, (bands,): noisy ones little."""
    variance = strip.flat(0, min(strip.shape[0], WEIGHED_LINES)).flat.variance
    if variance is None:
        return np.ones(strip.shape[2], np.float32)
    noise = np.nan_to_num(np.nanmean(variance, (0, 1), dtype=np.float64), nan=np.inf)
    weights = 1 / np.maximum(noise, np.median(noise) / 4)
    return np.asarray(weights / weights.max() if weights.any() else weights + 1, np.float32)


def _grey(strip: Strip, weights: np.ndarray) -> np.ndarray:
    """Return the mean over the bands of a strip, (lines, samples); NaN where less than half of them can be relied on."""
    lines, samples, _ = strip.shape
    grey = np.full((lines, samples), np.nan, np.float32)
    for start, stop in blocks_of(strip.shape, 0, lines):
        flat = strip.flat(start, stop).flat
        sound = np.isfinite(flat.values) & ~is_flagged(flat.flags, UNTRUSTED)
        count = sound @ weights
        sums = np.where(sound, flat.values, np.float32(0)) @ weights
        np.divide(sums, count, out=grey[start:stop], where=count > weights.sum() / 2)
    return grey


def _apart(found: str, expected: str) -> RegistrationRefused:
    return refusal(
        "E_STRIPS",
        "two strips of a scan cannot be joined",
        found=found,
        expected=expected,
        fix="Check that the names order the strips from left to right and that each overlaps the next. "
        "Where the stage wobbles, write {column} where their numbers stand in `files`: each is then registered by itself.",
    )


def _named(
    refused: RegistrationRefused, strips: Sequence[Strip], number: int
) -> CalibrationRefused:
    """Return the refusal of strip `number`, counted from 1, and the one before it, with their files."""
    names = [strips[n].file.frame.path for n in (number - 2, number - 1)]
    (problem,) = refused.problems
    return CalibrationRefused(
        replace(
            problem,
            message=f"strips {number - 1} and {number}, {names[0].name} and {names[1].name}, cannot be joined",
            file=str(names[1]),
            field=f"cameras.{strips[0].context.camera.name}.files",
        )
    )


def require_one_time(context: SensorCapture, templates: ScanTemplates) -> None:
    """Refuse strips of several exposures where there is no white: their counts cannot be joined."""
    strips = by_exposure(context.sensor.object)
    if templates.white is None and len(strips) > 1 and not context.holds_reflectance:
        problem = Problem(
            "E_EXPOSURES",
            f"{context.camera.name}: strips of several exposures, and no white",
            field="targets.white",
            found=", ".join(frames[0].path.name for _, frames in strips),
            expected="strips of one exposure, or a white",
            fix="Capture a white, or remove the other exposures from `files`.",
        )
        raise CalibrationRefused(placed(problem, context.sensor.object))

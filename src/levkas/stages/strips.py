"""Strips of a line scan, joined at fractions of a pixel and averaged where they overlap.

Strips are the passes of a stage, left to right. Each is calibrated by itself, some lines at a time, and resampled to the
pixels of the first; where two overlap, their values are averaged by their noise. No strip is held whole.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.flatfield import Calibrated
from levkas.calibration.sensor_context import (
    SensorContext,
    by_exposure,
    placed,
)
from levkas.calibration.templates import (
    CalibrationRefused,
)
from levkas.core.cube import UNRELIABLE, Flag, is_flagged
from levkas.core.problems import Problem
from levkas.geometry.pixel_maps import PixelMap, lay
from levkas.geometry.resample import source_rows, warp
from levkas.geometry.transforms import Affine, Composed, Transform
from levkas.registration.record import RegistrationRefused
from levkas.registration.strip_joints import find_joint
from levkas.stages.scan_lines import FlatLines, Strip, describe_loss
from levkas.stages.scan_templates import (
    ScanFile,
    ScanTemplates,
    block_lines,
    templates_of_scan,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from levkas.registration.strip_joints import Greys, StripJoint

SAMPLED, SIDE = 64, 4
"""Of an overlap: stretches of lines over the whole scan in which strips are compared, and side, px, of the blocks of
which means are compared. Single pixels would show what interpolation takes from fine detail, blocks do not."""
WEIGHED_LINES = 64
"""Whose noise gives how much a band counts where strips are matched."""
MOST_RATIO = 1.5
"""Of the difference of two strips to what their sigmas predict; beyond it there is a warning. Noise alone is 1.0."""
TAPER = 4
"""In the outer fourths of an overlap the strip that ends there fades out, so that no difference makes a step."""
UNTRUSTED = UNRELIABLE | Flag.DEFECT


def lines_of_scan(context: SensorContext) -> Strip | JoinedStrips:
    """Open the file of a line scan, or its strips, which are looked at once to be joined.

    Raises CalibrationRefused, E_STRIPS where strips cannot be joined, E_EXPOSURES where counts of several exposures would be.
    """
    files = [ScanFile.open(frame) for frame in context.sensor.object]
    templates = templates_of_scan(context, files[0].shape)
    strips = [Strip(context, file, templates) for file in files]
    _require_one_time(context, templates)
    return strips[0] if len(strips) == 1 else JoinedStrips.of(strips)


@dataclass(frozen=True, eq=False)
class _PlacedStrip:
    """A strip in the pixels of the joined scan, on the columns `first` to `stop` that it reaches.

    `transform` goes from px of the joined scan to px of the strip. Where it moves whole pixels, `start` is the strip's
    first pixel, (x, y), and nothing is resampled.
    """

    strip: Strip
    transform: Transform
    start: tuple[int, int] | None
    first: int
    stop: int
    height: int

    @classmethod
    def of(cls, strip: Strip, transform: Transform, height: int, *, whole: bool) -> _PlacedStrip:
        lines, samples, _ = strip.shape
        y = np.linspace(0, lines - 1, 200)
        edges = [
            transform.inverse(np.stack([0 * y + x, y], 1))[:, 0] for x in (-0.5, samples - 0.5)
        ]
        first, stop = max(0, int(np.ceil(edges[0].min()))), int(np.floor(edges[1].max())) + 1
        origin = np.round(transform.inverse(np.zeros((1, 2)))[0]).astype(int)
        start = (int(origin[0]), int(origin[1])) if whole else None
        if whole:
            first, stop = int(origin[0]), int(origin[0]) + samples
        return cls(strip, transform, start, first, stop, height)

    @cached_property
    def _map(self) -> PixelMap:
        corner = Affine(np.array([[1.0, 0, self.first], [0, 1, 0]]))
        return lay(Composed(corner, self.transform), (self.height, self.stop - self.first))

    def noise_gain(self, line: float) -> float:
        """Return the share of a pixel's variance that interpolation leaves about a line of the joined scan."""
        if self.start is not None:
            return 1.0
        place = self.transform(np.array([[self.first + 2.0, line]]))
        shift = Affine(np.array([[1.0, 0, place[0, 0] % 1], [0, 1, place[0, 1] % 1]]))
        ones = np.ones((8, 8), np.float32)
        spread = warp(ones, shift, (8, 8), variance=ones).variance
        return 1.0 if spread is None else float(spread[3, 3])

    def rows(self, start: int, stop: int) -> Calibrated:
        """Return lines `start` to `stop` of the joined scan; NaN and OUTSIDE where the strip has none."""
        lines = self.strip.shape[0]
        shape = self._map.shape if self.start is None else (self.height, self.stop - self.first)
        if self.start is None:
            low, high = source_rows(self._map, shape, (start, stop), lines)
        else:
            low, high = (int(np.clip(y - self.start[1], 0, lines)) for y in (start, stop))
        if low >= high:
            return _nothing(self.strip, (stop - start, shape[1]))
        flat = self.strip.flat(low, high).flat
        if self.start is not None:
            return _padded(flat, low + self.start[1] - start, stop - start)
        warped = warp(
            flat.values,
            self._map,
            shape,
            flags=flat.flags,
            variance=flat.variance,
            rows=(start, stop),
            held=(low, lines),
        )
        return Calibrated(warped.values, warped.flags, warped.variance, flat.quantity)


def _nothing(strip: Strip, shape: tuple[int, int]) -> Calibrated:
    one = strip.flat(0, 1).flat
    empty = replace(one, values=one.values[:0], flags=one.flags[:0])
    empty = replace(empty, variance=None if one.variance is None else one.variance[:0])
    return _padded(empty, 0, shape[0], shape[1])


def _padded(flat: Calibrated, top: int, height: int, width: int | None = None) -> Calibrated:
    """Return `height` lines of which `flat` are those from `top` on."""
    shape = (height, width or flat.values.shape[1], flat.values.shape[2])
    if flat.values.shape == shape:
        return flat
    values = np.full(shape, np.nan, np.float32)
    flags = np.full(shape, Flag.OUTSIDE.value, np.uint8)
    variance = None if flat.variance is None else np.full(shape, np.nan, np.float32)
    here = slice(top, top + len(flat.values))
    if len(flat.values):
        values[here], flags[here] = flat.values, flat.flags
        if variance is not None:
            variance[here] = flat.variance
    return Calibrated(values, flags, variance, flat.quantity)


@dataclass(frozen=True, eq=False)
class Seam:
    """What two strips show where they overlap.

    Parameters
    ----------
    ratio : float
        Spread of right less left over what both sigmas predict, median over bands; NaN without sigma.
    worst : (band, float)
        The band of the largest ratio.
    difference : ndarray, (bands,)
        Right over left − 1, medians over the overlap.
    rms : float
        Relative difference of the band mean.
    weights : ndarray, (2, samples, bands), float32
        Of the left and the right strip in the overlap; each pair sums to 1.
    """

    joint: StripJoint
    ratio: float
    worst: tuple[str, float]
    difference: np.ndarray
    rms: float
    weights: np.ndarray

    def record(self) -> dict[str, Any]:
        """Return what is kept of the seam, JSON-ready."""
        joint = self.joint
        return {
            "offset_px": [round(v, 3) for v in joint.offset],
            "error_px": round(joint.error, 4),
            "course": joint.course,
            "swing_px": round(joint.swing, 3),
            "overlap_px": round(joint.overlap, 2),
            "correlation": round(joint.correlation, 4),
            "difference_rms": round(self.rms, 5),
            "difference_over_sigma": None if np.isnan(self.ratio) else round(self.ratio, 3),
        }

    def notes(self, names: str) -> Iterator[str]:
        """Report how two strips were joined, and whether they differ by more than noise."""
        joint, worst = self.joint, float(np.nanmax(np.abs(self.difference)))
        swing = f", {joint.course} of ± {joint.swing:.2f} px" if joint.swing >= 0.01 else ""
        noise = "" if np.isnan(self.ratio) else f", {self.ratio:.2f} times their noise"
        yield (
            f"{names} share {joint.overlap:.2f} samples (shift {joint.offset[1]:.2f} lines, ± {joint.error:.2f} px"
            f"{swing}); the seam differs by {100 * self.rms:.1f} % rms{noise}, by {100 * worst:.1f} % in its worst band"
        )
        if self.ratio > MOST_RATIO:
            yield (
                f"{names} differ in their overlap by {self.ratio:.1f} times their sigma (in "
                f"{self.worst[0]} by {self.worst[1]:.1f} times): light, focus or object changed "
                "between the passes"
            )


@dataclass(frozen=True, eq=False)
class JoinedStrips:
    """Strips of one scan, joined line by line on request.

    Parameters
    ----------
    strips : tuple of _PlacedStrip
        Left to right.
    seams : tuple of Seam
        Between neighbours.
    """

    strips: tuple[_PlacedStrip, ...]
    seams: tuple[Seam, ...]
    notes: tuple[str, ...] = field(default=())

    @classmethod
    def of(cls, strips: Sequence[Strip]) -> JoinedStrips:
        """Find how strips lie, in one pass over each, and compare them where they overlap."""
        notes, greys = [], []
        for strip in strips:
            grey, lost = _greys(strip, _band_weights(strips[0]))
            greys.append(grey)
            notes += [*strip.notes, *describe_loss(strip.context, lost, strip.shape)]
        joints = [_joint(strips, greys, number) for number in range(len(strips) - 1)]
        lying = list(_placed_strips(strips, joints))
        seams = [_compare(lying[n], lying[n + 1], joint) for n, joint in enumerate(joints)]
        for number, seam in enumerate(seams, 1):
            notes += seam.notes(f"strips {number} and {number + 1}")
        strips[0].context.measured["strips"] = [seam.record() for seam in seams]
        return cls(tuple(lying), tuple(seams), tuple(dict.fromkeys(notes)))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, samples, bands)."""
        first = self.strips[0].strip.shape
        return first[0], max(one.stop for one in self.strips), first[2]

    def flat(self, start: int, stop: int) -> FlatLines:
        """Return lines `start` to `stop`, the same for any block; what was lost is in the notes already."""
        _, width, bands = self.shape
        joined = self.strips[0].rows(start, stop)
        here, covered = _padded_across(joined, width), self.strips[0].stop
        for lying, seam in zip(self.strips[1:], self.seams, strict=True):
            part, common = lying.rows(start, stop), max(0, covered - lying.first)
            zone = slice(lying.first, covered)
            whole = _columns(here, zone), _columns(part, slice(0, common))
            _put(here, zone, _averaged(*whole, seam.weights))
            _put(here, slice(covered, lying.stop), _columns(part, slice(common, None)))
            covered = max(covered, lying.stop)
        return FlatLines(here, np.zeros(bands, np.int64))


def _padded_across(flat: Calibrated, width: int) -> Calibrated:
    lines, samples, bands = flat.values.shape
    values = np.full((lines, width, bands), np.nan, np.float32)
    flags = np.full(values.shape, Flag.OUTSIDE.value, np.uint8)
    variance = None if flat.variance is None else np.full(values.shape, np.nan, np.float32)
    joined = Calibrated(values, flags, variance, flat.quantity)
    _put(joined, slice(0, samples), flat)
    return joined


def _columns(flat: Calibrated, columns: slice) -> Calibrated:
    variance = None if flat.variance is None else flat.variance[:, columns]
    return replace(
        flat, values=flat.values[:, columns], flags=flat.flags[:, columns], variance=variance
    )


def _put(into: Calibrated, columns: slice, flat: Calibrated) -> None:
    into.values[:, columns], into.flags[:, columns] = flat.values, flat.flags
    if into.variance is not None:
        into.variance[:, columns] = flat.variance


def _averaged(left: Calibrated, right: Calibrated, weights: np.ndarray) -> Calibrated:
    """Average what two strips saw; where one is saturated, a defect or not there, the other counts alone."""
    pair = left, right
    there = [np.isfinite(one.values) & ~is_flagged(one.flags, Flag.OUTSIDE) for one in pair]
    sound = [there[n] & ~is_flagged(pair[n].flags, UNTRUSTED) for n in range(2)]
    used = [sound[n] | (there[n] & ~sound[1 - n]) for n in range(2)]
    shares = [np.where(use, w, np.float32(0)) for use, w in zip(used, weights, strict=True)]
    total = shares[0] + shares[1]
    some = total > 0
    shares = [np.divide(w, total, out=np.zeros_like(w), where=some) for w in shares]
    values = sum(np.where(u, w * p.values, 0) for u, w, p in zip(used, shares, pair, strict=True))
    flags = np.where(used[0], left.flags, 0) | np.where(used[1], right.flags, 0)
    variance = None
    if left.variance is not None and right.variance is not None:
        noise = left.variance, right.variance
        sums = sum(np.where(u, w * w * v, 0) for u, w, v in zip(used, shares, noise, strict=True))
        variance = np.where(some, sums, np.nan).astype(np.float32)
    return Calibrated(
        np.where(some, values, np.nan).astype(np.float32),
        np.where(some, flags, left.flags | right.flags).astype(np.uint8),
        variance,
        left.quantity,
    )


# --- how strips lie, and what they show of the same


def _band_weights(strip: Strip) -> np.ndarray:
    """Return how much each band counts in the pictures that strips are matched by, (bands,): noisy ones little."""
    variance = strip.flat(0, min(strip.shape[0], WEIGHED_LINES)).flat.variance
    if variance is None:
        return np.ones(strip.shape[2], np.float32)
    noise = np.nan_to_num(np.nanmean(variance, (0, 1), dtype=np.float64), nan=np.inf)
    weights = 1 / np.maximum(noise, np.median(noise) / 4)
    return (
        np.asarray(weights / weights.max(), np.float32)
        if weights.any()
        else np.ones(len(noise), np.float32)
    )


def _greys(strip: Strip, weights: np.ndarray) -> tuple[Greys, np.ndarray]:
    """Return means over the even and over the odd bands of a strip, and how many values each band has lost."""
    lines, samples, bands = strip.shape
    halves = [slice(n if bands > 1 else 0, None, 2) for n in range(2)]
    joined = np.full((2, lines, samples), np.nan, np.float32)
    lost, step = np.zeros(bands, np.int64), block_lines(strip.shape)
    for start in range(0, lines, step):
        block = strip.flat(start, min(start + step, lines))
        lost += block.lost
        sound = np.isfinite(block.flat.values) & ~is_flagged(block.flat.flags, UNTRUSTED)
        values = np.where(sound, block.flat.values, np.float32(0))
        for grey, half in zip(joined, halves, strict=True):
            count = (sound[..., half] * weights[half]).sum(-1)
            known = count > weights[half].sum() / 2
            sums = (values[..., half] * weights[half]).sum(-1)
            np.divide(sums, count, out=grey[start : start + step], where=known)
    return (joined[0], joined[1]), lost


def _joint(strips: Sequence[Strip], greys: Sequence[Greys], number: int) -> StripJoint:
    """Find how strip `number` + 1 lies to the one before; a refusal names both files."""
    try:
        return find_joint(greys[number], greys[number + 1])
    except RegistrationRefused as refused:
        names = [strips[n].file.frame.path.name for n in (number, number + 1)]
        (problem,) = refused.problems
        fix = problem.fix
        try:
            joint = find_joint(greys[number + 1], greys[number])
            fix = (
                f"{names[1]} lies to the left of {names[0]} (they share {joint.overlap:.1f} samples): "
                "name the files in order from left to right."
            )
        except RegistrationRefused:
            pass
        raise CalibrationRefused(
            replace(
                problem,
                message=f"strips {number + 1} and {number + 2}, {names[0]} and {names[1]}, cannot be joined",
                file=str(strips[number + 1].file.frame.path),
                field=f"cameras.{strips[0].context.camera.name}.files",
                fix=fix,
            )
        ) from None


def _placed_strips(strips: Sequence[Strip], joints: Sequence[StripJoint]) -> Iterator[_PlacedStrip]:
    height, transform, whole = strips[0].shape[0], Affine.identity(), True
    yield _PlacedStrip.of(strips[0], transform, height, whole=True)
    steps: list[Transform] = []
    for strip, joint in zip(strips[1:], joints, strict=True):
        steps.append(joint.transform)
        whole = whole and joint.course == "whole pixels"
        yield _PlacedStrip.of(strip, Composed(*steps), height, whole=whole)


def _compare(left: _PlacedStrip, right: _PlacedStrip, joint: StripJoint) -> Seam:
    """Compare two strips in lines all over their overlap."""
    zone = slice(right.first - left.first, left.stop - left.first)
    common, tall = left.stop - right.first, 2 * SIDE
    starts = np.arange(0, max(1, left.height - tall + 1), tall)
    starts = starts[:: max(1, len(starts) // SAMPLED)]
    parts: list[list[Calibrated]] = [[], []]
    gains = []
    for start in starts.tolist():
        stop = min(start + tall, left.height)
        parts[0].append(_columns(left.rows(start, stop), zone))
        parts[1].append(_columns(right.rows(start, stop), slice(0, common)))
        gains.append([one.noise_gain(start + SIDE) for one in (left, right)])
    pair = [_stacked(some) for some in parts]
    return _seam(pair, np.mean(gains, 0), joint, left.strip)


def _stacked(parts: Sequence[Calibrated]) -> Calibrated:
    variances = [part.variance for part in parts if part.variance is not None]
    return Calibrated(
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.flags for part in parts]),
        np.concatenate(variances) if len(variances) == len(parts) else None,
        parts[0].quantity,
    )


def _seam(
    pair: Sequence[Calibrated], gains: Sequence[float], joint: StripJoint, strip: Strip
) -> Seam:
    """Describe the difference of two strips; `gains` are the shares of noise that interpolation left them."""
    flags = pair[0].flags | pair[1].flags
    clean = (flags == 0) & np.isfinite(pair[0].values) & np.isfinite(pair[1].values)
    one, two = (_block_means(np.where(clean, part.values, np.nan)) for part in pair)
    labels = [band.label for band in strip.context.sensor.bands]
    ratio, worst, noise = np.nan, ("", np.nan), None
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # medians of what has no clean pixel
        difference = _median(two) / _median(one) - 1
        mean = np.nanmean(one, 2), np.nanmean(two, 2)
        rms = float(np.sqrt(np.nanmean((mean[1] - mean[0]) ** 2)) / np.nanmean(np.abs(mean[0])))
        if pair[0].variance is not None and pair[1].variance is not None:
            spread = [
                np.where(clean, p.variance, np.nan).astype(np.float64)
                for p in pair
                if p.variance is not None
            ]
            noise = [np.nanmean(variance, 0) for variance in spread]
            blocks = sum(_block_means(v) / g for v, g in zip(spread, gains, strict=True)) / SIDE**2
            ratios = 1.4826 * _median(np.abs(two - one) / np.sqrt(blocks))
            ratio = float(np.nanmedian(ratios))
            if np.isfinite(ratios).any():
                at = int(np.nanargmax(ratios))
                worst = labels[at], float(ratios[at])
    return Seam(joint, ratio, worst, difference, rms, _weights(pair[0].values.shape[1:], noise))


def _block_means(values: np.ndarray) -> np.ndarray:
    """Return means of blocks of `SIDE` px a side, (rows, columns, bands), float64; NaN where a pixel is."""
    rows, columns = (n // SIDE for n in values.shape[:2])
    cut = values[: rows * SIDE, : columns * SIDE].astype(np.float64)
    return np.asarray(cut.reshape(rows, SIDE, columns, SIDE, -1).mean((1, 3)))


def _median(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.nanmedian(values.reshape(-1, values.shape[-1]), axis=0))


def _weights(shape: tuple[int, ...], noise: Sequence[np.ndarray] | None) -> np.ndarray:
    """Return the shares of left and right strip, (2, samples, bands): by noise, and fading where a strip ends.

    The noise is the mean of a sample and band over the scan, so that weights do not follow single values.
    """
    samples = shape[0]
    fade = np.minimum(1.0, (np.arange(samples) + 1) / (samples // TAPER + 1))
    shares = [np.broadcast_to(f[:, None], shape).copy() for f in (fade[::-1], fade)]
    if noise is not None:
        sound = np.isfinite(noise[0]) & np.isfinite(noise[1]) & (noise[0] > 0) & (noise[1] > 0)
        for share, variance in zip(shares, noise, strict=True):
            np.divide(share, variance, out=share, where=sound)
    total = shares[0] + shares[1]
    return np.stack([share / total for share in shares]).astype(np.float32)


def _require_one_time(context: SensorContext, templates: ScanTemplates) -> None:
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

"""Dark and white of line scans, some lines at a time; those of a mirror scanner are as large as the scan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.exposures import best_exposure
from levkas.calibration.sensor_context import Times, by_exposure, timed, times_of
from levkas.calibration.templates import CalibrationRefused, Template, average
from levkas.core.problems import Problem

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.sensor_context import SensorContext
    from levkas.campaign.discovery.captures import FrameRef
    from levkas.readers.envi import EnviFile

TRIPLES = 64
"""Threes of neighbouring lines of a mirror scanner's dark and white that tell its noise."""
MOST_VALUES = 2_000_000
"""Of these that are looked at: every so-many-th sample, all bands."""


@dataclass(frozen=True)
class FrameLines:
    """The shots of a mirror scanner's dark, or of its white, read where they are asked for.

    Parameters
    ----------
    bench : Bench
    frames : tuple of FrameRef
    opened : tuple of EnviFile
        Of each.
    times : Times
        Of all of them.
    """

    bench: SensorContext
    frames: tuple[FrameRef, ...]
    opened: tuple[EnviFile, ...]
    times: Times = None

    @classmethod
    def by_exposure(
        cls, bench: SensorContext, frames: Sequence[FrameRef], shape: tuple[int, int, int]
    ) -> list[FrameLines]:
        """Open shots for a scan of a shape, exposure by exposure, shortest first.

        Raises CalibrationRefused, ``E_SIZE``, where one is of another size than the scan, or type than the first.
        """
        from levkas.readers.envi import open_envi

        if not frames:
            return []
        opened = {frame: open_envi(frame.path) for frame in frames}
        first = opened[frames[0]].facts
        for frame, one in opened.items():
            found = one.facts
            if found.shape != shape or found.dtype != first.dtype:
                raise CalibrationRefused(
                    Problem(
                        "E_SIZE",
                        "dark or white and object are of different sizes",
                        str(frame.path),
                        found=f"{found.shape} {found.dtype}",
                        expected=f"{shape} {first.dtype}",
                        fix="Capture templates in the object's mode; crops of other sessions do not fit.",
                    )
                )
        return [
            cls(bench, tuple(group), tuple(opened[frame] for frame in group), times)
            for times, group in by_exposure(frames)
        ]

    def lines(self, start: int, stop: int) -> Template:
        """Average lines `start` to `stop` of all shots, what is no number marked as lost."""
        shots = self._read(start, stop)
        return timed(gaps_marked(average(shots, saturation=self.bench.saturation)), self.times)

    def thinned(self, step: int) -> Template:
        """Average every `step`-th sample of every `step`-th line, gaps closed."""
        height = self.opened[0].facts.shape[0]
        shots = (
            np.concatenate([lines[:, ::step] for lines in self._thin(number, height, step)])
            for number in range(len(self.opened))
        )
        made = average(shots, saturation=self.bench.saturation)
        return timed(self.bench.whole(made, self.frames), self.times)

    def _thin(self, number: int, height: int, step: int) -> Iterator[np.ndarray]:
        """Yield lines of one shot, codes checked."""
        one, frame = self.opened[number], self.frames[number]
        together = height if step == 1 else 1
        for y in range(0, height, max(step, together)):
            yield self.bench.checked(one.read_lines(y, y + together), frame)

    def _read(self, start: int, stop: int) -> Iterator[np.ndarray]:
        for one, frame in zip(self.opened, self.frames, strict=True):
            yield self.bench.checked(one.read_lines(start, stop), frame)


def best_white(whites: Sequence[Template], step: int = 1) -> int:
    """Return which of the whites of several exposures serves: the longest that is not saturated.

    Every `step`-th pixel a side is looked at. Raises CalibrationRefused where exposures are not known.
    """
    if len(whites) == 1:
        return 0
    seen = [thinned(white, step) if step > 1 else white for white in whites]
    best = best_exposure(seen)
    return next(i for i, white in enumerate(seen) if white is best)


def gaps_marked(shot: Template) -> Template:
    """Mark what is no number; unlike `gaps.close_gaps`, the same for any lines around it."""
    lost = ~np.isfinite(shot.mean)
    variance = shot.variance
    if variance is not None:
        lost |= ~np.isfinite(variance)
    if not lost.any():
        return shot
    return replace(
        shot,
        mean=np.where(lost, np.float32(0), shot.mean),
        variance=None if variance is None else np.where(lost, np.float32(0), variance),
        saturated=shot.saturated & ~lost,
        black=shot.black & ~lost,
        lost=lost,
    )


def thinned(template: Template, step: int) -> Template:
    """Return every `step`-th pixel a side, as `FrameLines.thinned` gives it of files."""
    part = np.s_[::step, ::step]
    variance, lost = template.variance, template.lost
    return replace(
        template,
        mean=template.mean[part],
        variance=None if variance is None else variance[part],
        saturated=template.saturated[part],
        black=template.black[part],
        lost=None if lost is None else lost[part],
    )


def noise_behind_mirror(bench: SensorContext, white_frame: FrameRef | None) -> NoiseModel | None:
    """Fit the noise of a mirror scanner to neighbouring lines of its white and its dark.

    A mirror leads the view over the board: lines have other light, and the sensels of (sample, band) are
    the same in all. What is left of a line between two others is free of both, and noise, with the
    texture of the board. None without a white.
    """
    from levkas.building.capture_statistics import note_noise
    from levkas.calibration.noise_fit import fit_noise

    if white_frame is None:
        return None
    dark_frame = _dark_like(bench, white_frame)
    dark = _triples(bench, dark_frame) if dark_frame else None
    white = _triples(bench, white_frame)
    black = bench.black or 0.0
    stacks, level = [white] if white else [], None
    if dark is not None:
        level = _mean_line(dark)
        # At no light at all: sorted by their signal, its lines would be sorted by their noise.
        stacks.append(replace(dark, mean=np.broadcast_to(level.mean, dark.mean.shape)))
    noise = fit_noise(stacks, level, black=black, step=bench.step) if white else None
    if noise is not None:  # its dark is at hand some lines at a time
        noise = replace(noise, level=None)
    note_noise(bench.told, noise, dark, black, bench.saturation)
    return noise


def _dark_like(bench: SensorContext, white: FrameRef) -> FrameRef | None:
    """Return the dark of the white's exposure, else the first."""
    darks, time = bench.sensor.dark, times_of(white)
    return next((d for d in darks if times_of(d) == time), darks[0] if darks else None)


def _triples(bench: SensorContext, frame: FrameRef) -> Template | None:
    """Return lines between two others as if they were two shots each; None of fewer than three lines."""
    from levkas.calibration.sensor_context import read_cube
    from levkas.readers.envi import open_envi
    from levkas.readers.frames import read_facts

    envi = read_facts(frame.path).kind == "envi"
    opened = open_envi(frame.path) if envi else None
    cube = None if envi else read_cube(frame)
    height = opened.facts.shape[0] if opened else len(cube)  # type: ignore[arg-type]
    if height < 3:
        return None
    starts = np.unique(np.linspace(0, height - 3, TRIPLES).round().astype(int)).tolist()
    parts = []
    for y in starts:
        three = opened.read_lines(y, y + 3) if opened else cube[y : y + 3]  # type: ignore[index]
        step = max(1, len(starts) * three[0].size // MOST_VALUES)
        parts.append(bench.checked(three, frame)[:, ::step])
    codes = np.stack(parts).astype(np.float64)
    mean = codes.mean(1)
    rest = codes[:, 0] - 2 * codes[:, 1] + codes[:, 2]
    full = np.inf if bench.saturation is None else bench.saturation
    with np.errstate(invalid="ignore"):
        spread = np.square(rest) / 6  # 1 + 4 + 1 variances of one shot
        saturated, black = np.any(codes >= full, axis=1), np.any(codes <= 0, axis=1)
    made = Template(mean.astype(np.float32), spread.astype(np.float32), 2, saturated, black)
    return bench.whole(made, [frame])


def _mean_line(dark: Template) -> Template:
    """Return a dark as one line, the mean of all."""
    mean = dark.mean.mean(0, dtype=np.float64, keepdims=True).astype(np.float32)
    none = np.zeros(mean.shape, bool)
    return Template(mean, None, dark.count, none, none)

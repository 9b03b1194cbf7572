"""Dark and white of line scans, some lines at a time; those of a mirror scanner are as large as the scan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.templates import CalibrationRefused, Template, average
from levkas.problems import Problem

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from levkas.building.bench import Bench
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.discovery import FrameRef
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
    """

    bench: Bench
    frames: tuple[FrameRef, ...]
    opened: tuple[EnviFile, ...]

    @classmethod
    def of(
        cls, bench: Bench, frames: Sequence[FrameRef], shape: tuple[int, int, int]
    ) -> FrameLines | None:
        """Open shots for a scan of a shape; None without one.

        Raises CalibrationRefused, ``E_SIZE``, where one is of another size than the scan, or type than the first.
        """
        from levkas.readers.envi import open_envi

        if not frames:
            return None
        opened = tuple(open_envi(frame.path) for frame in frames)
        first = opened[0].facts
        for frame, one in zip(frames, opened, strict=True):
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
        return cls(bench, tuple(frames), opened)

    def lines(self, start: int, stop: int) -> Template:
        """Average lines `start` to `stop` of all shots, what is no number marked as lost."""
        shots = self._read(start, stop)
        return gaps_marked(average(shots, saturation=self.bench.saturation))

    def thinned(self, step: int) -> Template:
        """Average every `step`-th sample of every `step`-th line, gaps closed."""
        height = self.opened[0].facts.shape[0]
        shots = (
            np.concatenate([lines[:, ::step] for lines in self._thin(number, height, step)])
            for number in range(len(self.opened))
        )
        return self.bench.whole(average(shots, saturation=self.bench.saturation), self.frames)

    def _thin(self, number: int, height: int, step: int) -> Iterator[np.ndarray]:
        """Yield lines of one shot, codes checked."""
        one, frame = self.opened[number], self.frames[number]
        together = height if step == 1 else 1
        for y in range(0, height, max(step, together)):
            yield self.bench.checked(one.read_lines(y, y + together), frame)

    def _read(self, start: int, stop: int) -> Iterator[np.ndarray]:
        for one, frame in zip(self.opened, self.frames, strict=True):
            yield self.bench.checked(one.read_lines(start, stop), frame)


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


def noise_behind_mirror(bench: Bench) -> NoiseModel | None:
    """Fit the noise of a mirror scanner to neighbouring lines of its white and its dark.

    A mirror leads the view over the board: lines have other light, and the sensels of (sample, band) are
    the same in all. What is left of a line between two others is free of both, and noise, with the
    texture of the board. None without a white.
    """
    from levkas.building.measuring import note_noise
    from levkas.calibration.noise_fit import fit_noise

    if not bench.sensor.white:
        return None
    dark = _triples(bench, bench.sensor.dark[0]) if bench.sensor.dark else None
    white = _triples(bench, bench.sensor.white[0])
    black = bench.black or 0.0
    stacks, level = [white] if white else [], None
    if dark is not None:
        level = _mean_line(dark)
        # At no light at all: sorted by their signal, its lines would be sorted by their noise.
        stacks.append(replace(dark, mean=np.broadcast_to(level.mean, dark.mean.shape)))
    noise = fit_noise(stacks, level, black=black) if white else None
    note_noise(bench.told, noise, dark, black, bench.saturation)
    return noise


def _triples(bench: Bench, frame: FrameRef) -> Template | None:
    """Return lines between two others as if they were two shots each; None of fewer than three lines."""
    from levkas.building.bench import read_cube
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

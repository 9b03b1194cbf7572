"""Dark, white and noise of a line scanner, read some lines at a time.

A push-broom camera has one line of sensels: its dark and white are that line, averaged along the scan.
Behind a mirror every line sees other light: dark and white are as large as the scan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from levkas.calibration.clipped_darks import MANY_ZEROS, pairs_of_lines
from levkas.calibration.darks import level_under
from levkas.calibration.exposures import best_exposure
from levkas.calibration.lamp import (
    average_steady,
    lamp_along,
    lamp_between,
    require_agreement,
)
from levkas.calibration.noise_fit import fit_noise
from levkas.calibration.sensor import (
    Times,
    by_exposure,
    capture_times,
    placing,
    read_cube,
    spread,
    timed,
    times_of,
    white_shots,
)
from levkas.calibration.templates import CalibrationRefused, ShotLevels, Template, average
from levkas.calibration.white_area import WhiteArea, find_white_area, find_white_line
from levkas.calibration.whites import check_white, thinning
from levkas.core.machine import tile_rows
from levkas.core.problems import Problem
from levkas.readers.envi import EnviFile, open_envi
from levkas.readers.frames import read_facts
from levkas.stages.exposures import noise_of, require_same_size
from levkas.stages.measurements import lamp_numbers, light_of, sensor_noise

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.sensor import SensorCapture
    from levkas.campaign.discovery.captures import FrameRef

BLOCK_SAMPLES = 4_000_000
"""Samples of a block of lines, where $LEVKAS_TILE does not say how many lines."""
MOST_LINES = 256
"""Of a mirror scanner's dark that was clipped: its levels are then known to a sixteenth of its noise."""
TRIPLES = 64
"""Threes of neighbouring lines of a mirror scanner's dark and white that show its noise."""
MOST_VALUES = 2_000_000
"""Of these that are looked at: every so-many-th sample, all bands."""


def blocks_of(shape: tuple[int, int, int], start: int, stop: int) -> Iterator[tuple[int, int]]:
    """Yield the blocks in which lines `start` to `stop` of a scan, (lines, samples, bands), are worked on."""
    lines, samples, bands = shape
    step = tile_rows(BLOCK_SAMPLES // (samples * bands), lines)
    for y in range(start, stop, step):
        yield y, min(y + step, stop)


@dataclass(frozen=True, eq=False)
class ScanFile:
    """One frame of a line scan: its lines are read from an ENVI file when needed, of another they are held."""

    frame: FrameRef
    content: EnviFile | np.ndarray
    shape: tuple[int, int, int]
    """(lines, samples, bands)."""
    dtype: np.dtype

    @classmethod
    def open(cls, frame: FrameRef) -> ScanFile:
        """Open an ENVI file, or read a TIFF whose pages are the bands."""
        if read_facts(frame.path).kind == "envi":
            envi = open_envi(frame.path)
            lines, samples, bands = (int(n) for n in envi.facts.shape)
            return cls(frame, envi, (lines, samples, bands), np.dtype(envi.facts.dtype))
        cube = read_cube(frame)
        lines, samples, bands = cube.shape
        return cls(frame, cube, (lines, samples, bands), cube.dtype)

    @property
    def holds_nothing(self) -> bool:
        """Whether the file declares a value for samples that hold nothing."""
        return read_facts(self.frame.path).nodata is not None

    def read(self, start: int, stop: int) -> np.ndarray:
        """Return lines `start` to `stop`, (lines, samples, bands)."""
        if isinstance(self.content, np.ndarray):
            return self.content[start:stop]
        lines, order = self.content.read_lines(start, stop), self.frame.order
        return np.take(lines, order, axis=-1) if order else lines

    def blocks(self) -> Iterator[np.ndarray]:
        """Yield all lines, some at a time."""
        for start, stop in blocks_of(self.shape, 0, self.shape[0]):
            yield self.read(start, stop)


@dataclass(frozen=True)
class FrameLines:
    """The shots of a mirror scanner's dark, or of its white, at one exposure."""

    context: SensorCapture
    files: tuple[ScanFile, ...]
    times: Times = None

    @property
    def frames(self) -> tuple[FrameRef, ...]:
        """All shots."""
        return tuple(file.frame for file in self.files)

    @classmethod
    def by_exposure(
        cls, context: SensorCapture, role: Literal["dark", "white"], shape: tuple[int, int, int]
    ) -> list[FrameLines]:
        """Open the shots of a role for a scan of a shape, exposure by exposure, shortest first.

        Raises CalibrationRefused, ``E_SIZE``, where one is of another size than the scan, or type than the first.
        """
        frames = context.sensor.dark if role == "dark" else context.sensor.white
        files = {frame: ScanFile.open(frame) for frame in frames}
        for frame, file in files.items():
            found, expected = (file.shape, file.dtype), (shape, files[frames[0]].dtype)
            if found != expected:
                fix = (
                    "Capture dark and white in the same mode and with the same crop as the object."
                )
                one, other = (" ".join(map(str, some)) for some in (found, expected))
                what, path = f"{role} and object differ in size", str(frame.path)
                raise CalibrationRefused(Problem("E_SIZE", what, path, None, one, other, fix))
        return [
            cls(context, tuple(files[frame] for frame in group), times)
            for times, group in by_exposure(frames)
        ]

    def lines(self, start: int, stop: int) -> Template:
        """Average lines `start` to `stop` of all shots, what is no number marked as lost."""
        shots = (self.context.checked(file.read(start, stop), file.frame) for file in self.files)
        clip = self.context.black_clip
        mean = average(shots, saturation=self.context.saturation, black_clip=clip)
        return timed(gaps_marked(mean), self.times)

    def thinned(self, step: int, darks: Sequence[Template] = ()) -> Template:
        """Average every `step`-th sample of every `step`-th line, gaps closed; `darks` are thinned like it."""
        context = self.context
        template = average_steady(
            lambda: (np.concatenate([*self._thin(file, step)]) for file in self.files),
            context.level_under(self.frames, darks),
            saturation=context.saturation,
            black_clip=context.black_clip,
            times_s=capture_times(self.frames),
            white=self.frames[0] in context.sensor.white,
        )
        return timed(context.whole(template, self.frames), self.times)

    def _thin(self, file: ScanFile, step: int) -> Iterator[np.ndarray]:
        """Yield lines of one shot, codes checked."""
        height = file.shape[0]
        together = height if step == 1 else 1
        for y in range(0, height, max(step, together)):
            yield self.context.checked(file.read(y, y + together), file.frame)[:, ::step]


class ScanTemplates(NamedTuple):
    """Darks, white and noise of a line scanner: templates of one line, or of a mirror scanner of all lines."""

    darks: tuple[Template | FrameLines, ...]
    white: Template | FrameLines | None
    noise: NoiseModel | None
    area: WhiteArea = WhiteArea()

    def uncovered(self, start: int, stop: int) -> np.ndarray | None:
        """Return where lines `start` to `stop` have no white board, (lines or 1, samples); None where all have."""
        plane = self.area.uncovered
        return plane if plane is None or len(plane) == 1 else plane[start:stop]


def templates_of_scan(context: SensorCapture, shape: tuple[int, int, int]) -> ScanTemplates:
    """Prepare dark, white and noise for scans of a shape, and note light and noise of the sensor.

    Raises CalibrationRefused where sizes differ, or the white cannot serve.
    """
    if context.camera.scan == "mirror":
        return _of_mirror(context, shape)
    return _of_pushbroom(context, shape)


def _of_pushbroom(context: SensorCapture, shape: tuple[int, int, int]) -> ScanTemplates:
    sensor, record = context.sensor, context.record
    labels = [band.label for band in sensor.bands]

    darks = [
        timed(context.unclipped(average_lines(context, frames), _pairs(frames[0])), times)
        for times, frames in by_exposure(sensor.dark)
    ]
    whites = [
        timed(average_lines(context, frames, darks), times)
        for times, frames in by_exposure(sensor.white)
    ]
    require_same_size(context, shape, darks, whites)
    white, area = whites[best_white(whites)] if whites else None, WhiteArea()
    if white is not None and white.shots is not None:
        lines = shape[0] * len(sensor.object)  # strips are captured one after the other
        record.lamp = lamp_numbers(labels, lamp_along(white.shots, lines))
    record.clipped_darks |= context.clipped_darks(darks)
    record.white_shots = white_shots(whites)
    record.light = light_of(white, darks, None, labels)
    noise = noise_of(context, [], [white] if white else [], darks)
    dark = darks[0] if darks else None
    record.sensor = sensor_noise(noise, dark, context.black or 0.0, context.saturation)
    if white is not None:
        with placing(sensor.white):
            area = find_white_line(white, level_under(white, darks, black=context.black))
    return ScanTemplates(tuple(darks), white, noise, area)


def average_lines(
    context: SensorCapture, frames: Sequence[FrameRef], darks: Sequence[Template] = ()
) -> Template:
    """Average the dark or white of a push-broom camera along the scan, (1, samples, bands): each line is a shot."""
    files = [ScanFile.open(frame) for frame in frames]

    def lines() -> Iterator[np.ndarray]:
        for file in files:
            for block in file.blocks():
                yield from context.checked(block, file.frame)[:, None]

    white = frames[0] in context.sensor.white
    template = average_steady(
        lines,
        context.level_under(frames, darks),
        saturation=context.saturation,
        black_clip=context.black_clip,
        white=white,
    )
    if white and template.shots is not None and template.shots.differing:
        with placing(frames):  # what moves all along is found as such
            require_agreement(template.shots)
    return context.whole(template, frames)


def _pairs(frame: FrameRef) -> list[np.ndarray]:
    """Return pairs of neighbouring lines of a dark, (1, samples, bands) each."""
    file = ScanFile.open(frame)
    return [file.read(y, y + 1) for y in pairs_of_lines(*file.shape[:2])]


def _of_mirror(context: SensorCapture, shape: tuple[int, int, int]) -> ScanTemplates:
    """Open dark and white; the white is checked by every so-many-th pixel."""
    sensor, record, step = context.sensor, context.record, thinning(shape[:2])
    labels = [band.label for band in sensor.bands]
    darks = [_of_one_line(one, step) for one in FrameLines.by_exposure(context, "dark", shape)]
    whites = FrameLines.by_exposure(context, "white", shape)
    white, area = None, WhiteArea()
    if whites:
        under = [d.thinned(step) if isinstance(d, FrameLines) else _columns(d, step) for d in darks]
        looked = [one.thinned(step, under) for one in whites]
        chosen = best_white(looked)
        white, thinned = whites[chosen], looked[chosen]
        with placing(white.frames):
            require_agreement(thinned.shots, [str(frame.path) for frame in white.frames])
        record.white_shots = white_shots([thinned])
        if thinned.shots is not None:  # a scan shows nothing of its own lamp
            times, none = capture_times(sensor.object), np.zeros(len(labels))
            single = ShotLevels(np.ones((1, len(labels))), none, times)
            record.lamp = lamp_numbers(labels, lamp_between(thinned.shots, single))
        level = level_under(thinned, under, black=context.black)
        with placing(sensor.white):
            try:
                check_white(thinned, level, None, labels)
            except CalibrationRefused as refused:
                problems = map(context.with_full_scale, refused.problems)
                raise CalibrationRefused(*problems) from None
            area = _area_behind_mirror(context, thinned, level, step, shape)
        record.light = light_of(thinned, under, None, labels, period=(step, step))
    noise = _noise_behind_mirror(context, white.frames[0] if white else None, darks)
    return ScanTemplates(tuple(darks), white, noise, area)


def _area_behind_mirror(
    context: SensorCapture,
    white: Template,
    level: np.ndarray,
    step: int,
    shape: tuple[int, int, int],
) -> WhiteArea:
    """Find where a mirror scanner's white shows the object, in every `step`-th line and sample of both."""
    file = ScanFile.open(context.sensor.object[0])
    if file.shape != shape:
        return WhiteArea()
    shot = FrameLines(context, (file,), times_of(file.frame)).thinned(step)
    found = find_white_area(shot, white, (level, level))
    rows, columns = (
        np.minimum(np.arange(n) // step, m - 1)
        for n, m in zip(shape[:2], white.mean.shape[:2], strict=True)
    )
    return found.at(rows, columns)


def _of_one_line(dark: FrameLines, step: int) -> Template | FrameLines:
    """Return a mirror scanner's dark that was clipped as one line, of many: no single line shows its level.

    Every `step`-th line and sample shows whether it was.
    """
    if np.mean(dark.thinned(step).black) <= MANY_ZEROS:
        return dark
    context, file = dark.context, dark.files[0]
    starts = spread(range(0, file.shape[0]), MOST_LINES)
    lines = (context.checked(file.read(y, y + 1), file.frame) for y in starts)
    line = average(lines, saturation=context.saturation, black_clip=context.black_clip)
    template = context.unclipped(context.whole(line, dark.frames), _pairs(file.frame))
    template = timed(template, dark.times)
    context.record.clipped_darks |= context.clipped_darks([template])
    return dark if template.fit is None else template


def _columns(line: Template, step: int) -> Template:
    """Return every `step`-th sample of one line."""
    arrays = {name: getattr(line, name)[:, ::step] for name in ("mean", "saturated", "black")}
    return replace(line, variance=None, fit=None, **arrays)


def lines_of(template: Template | FrameLines, start: int, stop: int) -> Template:
    """Return the lines of a template that belong to some of the scan, or the one that serves all."""
    return template.lines(start, stop) if isinstance(template, FrameLines) else template


def best_white(whites: Sequence[Template]) -> int:
    """Return which of the whites of several exposures serves: the longest that is not saturated.

    Raises CalibrationRefused where exposures are not known.
    """
    best = best_exposure(whites) if len(whites) > 1 else whites[0]
    return next(i for i, white in enumerate(whites) if white is best)


def gaps_marked(shot: Template) -> Template:
    """Mark what is no number; unlike `templates.close_gaps`, the same for any lines around it."""
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


def _noise_behind_mirror(
    context: SensorCapture, white_frame: FrameRef | None, darks: Sequence[Template | FrameLines]
) -> NoiseModel | None:
    """Fit the noise of a mirror scanner to neighbouring lines of its white and its dark; None without a white.

    A mirror leads the view over the board: lines have other light, and the sensels of (sample, band) are
    the same in all. What is left of a line between two others is free of both, and noise, with the
    texture of the board.
    """
    if white_frame is None:
        return None
    white, stacks, levels = _triples(context, white_frame), [], []
    dark = next((one for one in darks if isinstance(one, Template)), None)  # it was clipped
    frames = sorted(context.sensor.dark, key=lambda d: times_of(d) != times_of(white_frame))
    if dark is not None:
        stacks = [one for one in darks if isinstance(one, Template)]
        levels = stacks[:1]
    elif frames and (dark := _triples(context, frames[0])) is not None:
        mean = dark.mean.mean(0, dtype=np.float64, keepdims=True).astype(np.float32)
        none = np.zeros(mean.shape, bool)
        levels = [Template(mean, None, dark.count, none, none)]
        # At no light at all: sorted by their signal, its lines would be sorted by their noise.
        stacks = [replace(dark, mean=np.broadcast_to(mean, dark.mean.shape))]
    black, noise = context.black or 0.0, None
    if white is not None:
        noise = fit_noise([white, *stacks], levels, black=black, step=context.step)
    if noise is not None:  # its dark is at hand some lines at a time
        noise = replace(noise, level=None)
    context.record.sensor = sensor_noise(noise, dark, black, context.saturation)
    return noise


def _triples(context: SensorCapture, frame: FrameRef) -> Template | None:
    """Return lines between two others as if they were two shots each; None of fewer than three lines."""
    file = ScanFile.open(frame)
    height = file.shape[0]
    if height < 3:
        return None
    starts = np.unique(np.linspace(0, height - 3, TRIPLES).round().astype(int)).tolist()
    parts = []
    for y in starts:
        three = file.read(y, y + 3)
        step = max(1, len(starts) * three[0].size // MOST_VALUES)
        parts.append(context.checked(three, frame)[:, ::step])
    codes = np.stack(parts).astype(np.float64)
    mean = codes.mean(1)
    rest = codes[:, 0] - 2 * codes[:, 1] + codes[:, 2]
    full = np.inf if context.saturation is None else context.saturation
    least = -np.inf if context.black_clip is None else context.black_clip
    with np.errstate(invalid="ignore"):
        spread = np.square(rest) / 6  # 1 + 4 + 1 variances of one shot
        saturated, black = np.any(codes >= full, axis=1), np.any(codes <= least, axis=1)
    template = Template(mean.astype(np.float32), spread.astype(np.float32), 2, saturated, black)
    return context.whole(template, [frame])

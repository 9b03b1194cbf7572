"""Flat-fielded lines of one file of a line scan: the same values for any block that they are part of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from levkas.calibration.flatfield import Calibrated, describe_darks, less_sure
from levkas.calibration.sensor_context import (
    SensorContext,
    placed,
    timed,
    times_in,
    times_of,
)
from levkas.calibration.stated_exposures import doubt_scaling
from levkas.calibration.templates import (
    CalibrationRefused,
    Template,
    as_absent,
    describe_lost,
    gaps_of,
    no_values,
    single_shot,
)
from levkas.calibration.whites import WhiteBoard
from levkas.core.cube import Flag
from levkas.stages.exposures import flatten
from levkas.stages.scan_templates import (
    FrameLines,
    ScanFile,
    ScanTemplates,
    gaps_marked,
    lines_of,
)


class FlatLines(NamedTuple):
    """Flat-fielded lines, and how many values of each band, (bands,), a frame had lost."""

    flat: Calibrated
    lost: np.ndarray


@dataclass(frozen=True, eq=False)
class Strip:
    """One file of a line scan, with what its lines are flat-fielded by."""

    context: SensorContext
    file: ScanFile
    templates: ScanTemplates

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, samples, bands)."""
        return self.file.shape

    @property
    def notes(self) -> tuple[str, ...]:
        """What exposures leave in doubt, known before a line is calibrated."""
        context, times = self.context, times_of(self.file.frame)
        darks = [lines_of(dark, 0, 1) for dark in self.templates.darks]
        white = None if self.templates.white is None else lines_of(self.templates.white, 0, 1)
        doubt = doubt_scaling(context, times, times_in(white)) if white is not None else ""
        none = np.zeros((1, 1, len(context.sensor.bands)), bool)
        shot = timed(Template(none.astype(np.float32), None, 1, none, none), times)
        notes = (
            doubt,
            *describe_darks(shot, darks, white, context.black),
            *self.templates.area.notes,
        )
        return tuple(note for note in notes if note)

    def flat(self, start: int, stop: int) -> FlatLines:
        """Flat-field lines `start` to `stop`; the same values for any block that they are part of."""
        context, frame = self.context, self.file.frame
        codes = context.checked(self.file.read(start, stop), frame)
        shape = codes.shape
        clip = context.black_clip
        shot = single_shot(codes, saturation=context.saturation, black_clip=clip)
        del codes
        shot = timed(gaps_marked(shot), times_of(frame))
        if self.file.holds_nothing:
            shot = as_absent(shot)
        darks = [lines_of(dark, start, stop) for dark in self.templates.darks]
        white = self.templates.white
        lit = None if white is None else lines_of(white, start, stop)
        flat = flatten(
            context,
            shot,
            darks,
            lit,
            board=WhiteBoard(
                context.reflectance,
                labels=[band.label for band in context.sensor.bands],
                checked=start > 0 or isinstance(white, FrameLines),
                unit=context.unit_of(frame),
            ),
            noise=self.templates.noise,
        )
        flat = less_sure(flat, self.templates.unsure(start, stop))
        uncovered = self.templates.uncovered(start, stop)
        if uncovered is not None:  # where the white shows no board nothing is known
            values = np.where(uncovered[..., None], np.float32(np.nan), flat.values)
            flags = np.where(uncovered[..., None], flat.flags | Flag.OUTSIDE, flat.flags)
            flat = replace(flat, values=values, flags=flags.astype(np.uint8))
        lost = gaps_of(shot, *darks, lit)
        if lost is None:
            return FlatLines(flat, np.zeros(shape[2], np.int64))
        if shot.absent is not None:
            lost = lost & ~shot.absent
        return FlatLines(flat, np.broadcast_to(lost, shape).sum((0, 1)))


def describe_loss(
    context: SensorContext, lost: np.ndarray, shape: tuple[int, int, int]
) -> list[str]:
    """Report how many values of a scan are no finite numbers, of counts by band; nothing where all are.

    Raises CalibrationRefused where a band has no finite value at all.
    """
    every = shape[0] * shape[1]
    if (empty := np.flatnonzero(lost == every)).size:
        refused = no_values(int(empty[0]), shape)
        raise CalibrationRefused(*(placed(p, context.sensor.object) for p in refused.problems))
    count = int(lost.sum())
    return [describe_lost(count, every * shape[2], context.camera.name)] if count else []

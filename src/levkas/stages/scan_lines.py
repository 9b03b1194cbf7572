"""Flat-fielded lines of one file of a line scan: the same values for any block that they are part of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from levkas.calibration.darks import SAME_TIME
from levkas.calibration.exposures import doubt_scaling
from levkas.calibration.findings import Finding
from levkas.calibration.flatfield import Calibrated, describe_darks, pair_darks
from levkas.calibration.sensor import (
    SensorCapture,
    listed,
    placed,
    timed,
    times_in,
    times_of,
)
from levkas.calibration.templates import (
    CalibrationRefused,
    Template,
    as_absent,
    average,
    bands_alike,
    gaps_of,
    no_values,
    pick_bands,
)
from levkas.calibration.whites import WhiteBoard
from levkas.core.cube import Flag
from levkas.stages.exposures import flatten
from levkas.stages.measurements import DARK_FRAMES, PHOTONS, WHITE_FRAMES
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

    context: SensorCapture
    file: ScanFile
    templates: ScanTemplates

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, samples, bands)."""
        return self.file.shape

    @property
    def notes(self) -> tuple[Finding | str, ...]:
        """What exposures leave in doubt, known before a line is calibrated."""
        context, times = self.context, times_of(self.file.frame)
        shot, darks, white = self._line(0)
        lit = listed(times_in(white)) if white is not None else ()
        notes: tuple[Finding | str | None, ...] = (
            *doubt_scaling(listed(times), lit, SAME_TIME),
            *describe_darks(shot, darks, white, context.black),
            *self.templates.area.notes,
        )
        return tuple(note for note in notes if note)

    def _line(self, at: int) -> tuple[Template, list[Template], Template | None]:
        """Return an empty line, and the darks and the white of line `at`."""
        none = np.zeros((1, 1, len(self.context.sensor.bands)), bool)
        empty = Template(none.astype(np.float32), None, 1, none, none)
        white = self.templates.white
        return (
            timed(empty, times_of(self.file.frame)),
            [lines_of(dark, at, at + 1) for dark in self.templates.darks],
            None if white is None else lines_of(white, at, at + 1),
        )

    def noise_shares(self, levels: np.ndarray) -> dict[str, dict[str, float]]:
        """Return what lines, white and darks add to the noise of each band at some levels, (bands,), all in reflectance.

        By the white and the darks of the middle line, and the noise model: that of the published sigma within a seventh.
        """
        shot, darks, white = self._line(self.shape[0] // 2)
        noise, labels = self.templates.noise, [band.label for band in self.context.sensor.bands]
        if noise is None or white is None:
            return {}
        board = np.broadcast_to(np.asarray(self.context.reflectance, float), len(labels))
        found = {}
        for bands in bands_alike(shot, *darks, white) or [np.arange(len(labels))]:
            own = [pick_bands(dark, bands) for dark in darks]
            object_, lit = (pick_bands(one, bands) for one in (shot, white))
            under, white_under, scale, _ = pair_darks(
                object_, own or None, lit, self.context.black_level
            )
            light = np.median((lit.mean - white_under.mean).reshape(-1, len(bands)), 0)
            light = np.maximum(light, 1e-9)
            per_count = board[bands] * scale / light
            signal = levels[bands] / per_count
            ratio = signal / light
            of_dark, of_other = (d.share * noise.read_under(d) for d in (under, white_under))
            if white_under is under:
                of_dark, of_other = of_dark * (1 - ratio) ** 2, 0.0
            counts = {
                PHOTONS: noise.variance(signal),
                WHITE_FRAMES: np.square(ratio) * noise.variance(light) / lit.count,
                DARK_FRAMES: of_dark + np.square(ratio) * of_other,
            }
            sizes = {name: per_count * np.sqrt(variance) for name, variance in counts.items()}
            for k, band in enumerate(bands):
                found[labels[band]] = {n: float(f"{size[k]:.4g}") for n, size in sizes.items()}
        return found

    def flat(self, start: int, stop: int) -> FlatLines:
        """Flat-field lines `start` to `stop`; the same values for any block that they are part of."""
        context, frame = self.context, self.file.frame
        codes = context.checked(self.file.read(start, stop), frame)
        shape = codes.shape
        clip = context.black_clip
        shot = average([codes], saturation=context.saturation, black_clip=clip)
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


def describe_loss(context: SensorCapture, lost: np.ndarray, pixels: int) -> list[Finding]:
    """Report how many values of a scan of so many pixels are no finite numbers, of counts by band; nothing where all are.

    Raises CalibrationRefused where a band has no finite value at all.
    """
    if (empty := np.flatnonzero(lost == pixels)).size:
        refused = no_values(int(empty[0]), (pixels, 1, len(lost)))
        raise CalibrationRefused(*(placed(p, context.sensor.object) for p in refused.problems))
    count = int(lost.sum())
    return [Finding("lost", "all bands", count, pixels * len(lost))] if count else []

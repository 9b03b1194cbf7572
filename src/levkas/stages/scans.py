"""Line scans: calibrated by blocks of lines, which are held in memory, or passed on where they are too many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from levkas.calibration.agreement import compare_facts
from levkas.calibration.denoising import Projecting, Subspace, describe_removed, find_subspace
from levkas.calibration.flatfield import Calibrated
from levkas.calibration.sensor_context import SensorContext, placing
from levkas.calibration.sensor_notes import describe_sensor, doubts_of
from levkas.calibration.stated_exposures import require_black, require_exposures
from levkas.colour.srgb import counts_white, find_rendering
from levkas.core.cube import UNRELIABLE, Band, Cube, CubeRows, is_flagged
from levkas.core.rounding import round_root
from levkas.core.threads import each, made_ahead
from levkas.core.transpose import transpose
from levkas.readers.frames import read_facts
from levkas.registration.bands import BandImage
from levkas.stages.above_white import COUNTS, count_above, describe_above, require_light
from levkas.stages.capture_statistics import NOISE, VIEW, Middle, describe_lamp
from levkas.stages.exposures import cube_of, mark_glare_in
from levkas.stages.scan_lines import FlatLines, Strip, describe_loss
from levkas.stages.scan_templates import block_lines
from levkas.stages.shared_noise import neighbour_correlation
from levkas.stages.spectra import board_of
from levkas.stages.streaming import resample_scan
from levkas.stages.strips import JoinedStrips, lines_of_scan

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.geometry.transforms import Transform
    from levkas.stages.template_cache import TemplateCache

STREAMED_SAMPLES = 100_000_000
"""A scan of more samples, of a mirror scanner of a third as many, is not held in memory. Layers, maps and
records end in the same bytes either way but for the last bits of resampled values; the range on the report's
page is then that of every sixteenth pixel. A constant, so that results do not hang on the machine's memory."""
LOOKED_AT_PX, THINNED = 1_000_000, 16
"""Most pixels of a band as registration takes it; every sixteenth a side is kept in mind for range and noise."""


def is_streamed(capture: Capture, campaign: Campaign) -> bool:
    """Return whether a capture is a line scan in ENVI files that is larger than is held in memory.

    Dark and white of a mirror scanner are as large, and have to be ENVI files too.
    """
    camera, sensor = campaign.cameras[capture.camera], capture.sensors[0]
    if not camera.traits.is_scanned or capture.camera == campaign.reference.camera:
        return False
    frames = [*sensor.object]
    if camera.scan == "mirror":
        frames += [*sensor.dark, *sensor.white]
    facts = [read_facts(frame.path) for frame in frames]
    samples = sum(int(np.prod(one.shape, dtype=object)) for one in facts[: len(sensor.object)])
    samples *= 3 if camera.scan == "mirror" else 1
    return all(one.kind == "envi" for one in facts) and samples > STREAMED_SAMPLES


def factor_of(shape: tuple[int, int, int]) -> int:
    """Return how many px a side of a scan, (lines, samples, bands), make a pixel of its pictures."""
    return max(1, int(np.ceil(np.sqrt(shape[0] * shape[1] / LOOKED_AT_PX))))


class ScanSummary(NamedTuple):
    """What one pass over all lines of a scan shows: notes, pictures for registration, focus by band."""

    notes: tuple[str, ...]
    pictures: list[BandImage]
    focus: list[dict[str, Any]]


@dataclass(eq=False)
class Scan:
    """A capture whose lines are calibrated whenever they are needed: a line scan.

    Parameters
    ----------
    source : Strip or JoinedStrips
        Of its flat-fielded lines.
    where : str
        Object and layer, for warnings.
    captured, aligns
        As of `native_cubes.Native`.
    stated : tuple of str
        Notes on what its files state.
    """

    context: SensorContext
    source: Strip | JoinedStrips
    where: str = ""
    captured: str | None = None
    aligns: Mapping[str, object] = field(default_factory=dict)
    stated: tuple[str, ...] = ()
    is_streamed: ClassVar[bool] = True
    thinning: ClassVar[int] = THINNED
    _summary: ScanSummary | None = field(default=None, init=False)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Complete when all lines have been calibrated once."""
        notes = self._summary.notes if self._summary else ()
        return tuple(dict.fromkeys(f"{self.where}: {note}" for note in (*self._doubts, *notes)))

    @cached_property
    def _doubts(self) -> tuple[str, ...]:
        doubts = (*self.stated, *doubts_of(self.context), *describe_sensor(self.context))
        return (*doubts, *self.source.notes, *describe_lamp(self.measured))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, samples, bands)."""
        return self.source.shape

    @property
    def bands(self) -> tuple[Band, ...]:
        """All bands."""
        return self.context.sensor.bands

    @cached_property
    def _first(self) -> Calibrated:
        return self.source.flat(0, 1).flat

    @property
    def quantity(self) -> str:
        """``"reflectance"`` where there is a white, else ``"counts"``."""
        return self._first.quantity

    @property
    def has_sigma(self) -> bool:
        """Whether the noise is known."""
        return self._first.variance is not None

    @cached_property
    def subspace(self) -> Subspace | None:
        """The signal subspace of the whole scan if HySime is used; found in one pass."""
        if not self.context.camera.denoise:
            return None
        return find_subspace(block.flat.values for block in self._flat_blocks(0, self.shape[0]))

    @property
    def factor(self) -> int:
        """Side, px, of the blocks that make a pixel of the pictures that registration sees."""
        return factor_of(self.shape)

    @property
    def measured(self) -> dict[str, dict[str, Any]]:
        """What was measured of the sensor."""
        return {self.context.sensor.name: self.context.measured}

    @property
    def focus(self) -> list[dict[str, Any]]:
        """Blur of the sharpest edges, band by band."""
        return self.summary.focus

    def sensors(self) -> Iterator[tuple[str, CubeRows]]:
        """Yield the sensor's name and its lines, from which `summary` follows."""
        rows = CubeRows(self.passed(), self.shape, self.bands, self.quantity, self.has_sigma)
        yield self.context.sensor.name, rows

    def packed(self) -> Scan:
        """Return the scan itself: it holds nothing."""
        return self

    def size_of(self, _label: str) -> list[int]:
        """Return [width, height] of any band."""
        return [self.shape[1], self.shape[0]]

    def blocks(self, start: int, stop: int) -> Iterator[Cube]:
        """Yield lines `start` to `stop`, calibrated, some at a time."""
        projecting = Projecting(self.subspace) if self.subspace else None
        for flat, _ in self._flat_blocks(start, stop):
            yield self._finished(flat, projecting)
            del flat  # its memory is that of the lines, which may have been done with

    def whole(self) -> tuple[Cube, tuple[str, ...]]:
        """Calibrate all lines; return them in memory, and notes.

        Raises CalibrationRefused where a band has no finite value at all.
        """
        values, flags = np.empty(self.shape, np.float32), np.empty(self.shape, np.uint8)
        sigma = np.empty(self.shape, np.float32) if self.has_sigma else None
        calibration, y = ScanPass(self), 0
        for block in calibration.blocks():
            rows = slice(y, y + len(block.values))
            y = rows.stop
            values[rows], flags[rows] = block.values, block.flags
            if sigma is not None:
                sigma[rows] = block.sigma
        calibration.note()
        cube = Cube(values, flags, sigma, self.bands, self.quantity)
        return cube, (*self.source.notes, *calibration.notes())

    def passed(self) -> Iterator[Cube]:
        """Yield all lines, calibrated; pictures, focus and warnings are known when the last has been taken.

        Raises CalibrationRefused where a band has no finite value at all.
        """
        calibration, pictures = ScanPass(self), Pictures(self.shape, self.bands, self.factor)
        middle = Middle(self.shape, self.bands)
        for cube in made_ahead(calibration.blocks()):
            pictures.add(cube)
            middle.add(cube)
            yield cube
        calibration.note()
        self._summary = ScanSummary(calibration.notes(), pictures.images(), middle.focus())

    @property
    def summary(self) -> ScanSummary:
        """What a pass over all lines shows; one is made where there was none."""
        if self._summary is None:
            for _ in self.passed():
                pass
        assert self._summary is not None
        return self._summary

    def images(self) -> list[BandImage]:
        """Return every band as registration takes it: means of blocks of `factor` x `factor` px."""
        return self.summary.pictures

    @property
    def white(self) -> float | None:
        """Count that pictures show as white, of the whole scan; None for reflectance, where it is 1."""
        if self.quantity == "reflectance":
            return None
        shown = [np.where(i.valid, i.values, np.float32(np.nan))[::4, ::4] for i in self.images()]
        return counts_white(np.stack(shown, -1), find_rendering(self.bands), step=1)

    def noise_correlation(self, maps: Mapping[str, Transform], size: tuple[int, int]) -> np.ndarray:
        """Return the correlation of the noise of neighbours on the grid."""
        return neighbour_correlation([maps[band.label] for band in self.bands], size[::-1])

    def on_grid(
        self, maps: Mapping[str, Transform], size: tuple[int, int], *, spool: Path
    ) -> CubeRows:
        """Return the layer's rows, each pixel interpolated once, as they are taken."""
        with placing(self.context.sensor.object):
            return resample_scan(self, [maps[band.label] for band in self.bands], size, spool=spool)

    def _flat_blocks(self, start: int, stop: int) -> Iterator[FlatLines]:
        step = block_lines(self.shape)
        for y in range(start, stop, step):
            yield self.source.flat(y, min(y + step, stop))

    def _finished(self, flat: Calibrated, projecting: Projecting | None) -> Cube:
        """Round flat-fielded lines and flag glare; `projecting` takes noise away before."""
        values, variance = flat.values, flat.variance
        if projecting is not None:
            if variance is not None:
                variance = np.square(round_root(variance))
            values, variance = projecting(values, variance)
        return mark_glare_in(cube_of(self.context, values, flat.flags, variance, flat.quantity))


class ScanPass:
    """One pass over lines of a scan, which counts what frames lost and what denoising takes away.

    `lost` are the values of each band, (bands,), that are no finite numbers, and 0 in the cubes; `above` is what `count_above` gives,
    `sums` are of all `count` values of each band.
    """

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self.lost = np.zeros(scan.shape[2], np.int64)
        self.above = np.zeros((COUNTS, scan.shape[2]), np.int64)
        self.sums, self.count = np.zeros(scan.shape[2]), 0
        self._projecting = Projecting(scan.subspace) if scan.subspace else None

    def blocks(self) -> Iterator[Cube]:
        """Yield all lines, calibrated, some at a time."""
        for block in self._scan._flat_blocks(0, self._scan.shape[0]):
            self.lost += block.lost
            cube = self._scan._finished(block.flat, self._projecting)
            self.above += count_above(cube)
            for line in cube.values:  # one by one: sums do not depend on how lines come in
                self.sums += line.sum(0, dtype=float)
                self.count += len(line)
            yield cube
            del cube  # its memory is that of the lines, which may have been done with

    def note(self) -> None:
        """Note the mean of the view, and what makes the noise there, in what was measured of the sensor."""
        scan = self._scan
        if scan.quantity != "reflectance":
            return
        levels = self.sums / max(self.count, 1)
        strip = (
            scan.source.strips[0].strip if isinstance(scan.source, JoinedStrips) else scan.source
        )
        measured, labels = scan.context.measured, [band.label for band in scan.bands]
        measured[VIEW] = {
            b: float(f"{at:.4g}") for b, at in zip(labels, levels.tolist(), strict=True)
        }
        if shares := strip.noise_shares(levels):
            measured[NOISE] = shares

    def notes(self) -> tuple[str, ...]:
        """Report what was lost and taken away; raises CalibrationRefused where a band has no finite value."""
        notes = describe_loss(self._scan.context, self.lost, self._scan.shape)
        if (projection := self._projecting) is not None:
            notes.append(describe_removed(projection.subspace, projection.removed, projection.most))
        labels = [band.label for band in self._scan.bands]
        with placing(self._scan.context.sensor.object):
            require_light(self.above, labels)
        return (*notes, *describe_above(self.above, labels))


class Pictures:
    """Every band of a scan of some `shape`, (lines, samples, bands), as registration takes it, gathered while its lines pass by.

    A pixel is the mean of `factor` x `factor` px.
    """

    def __init__(self, shape: tuple[int, int, int], bands: Sequence[Band], factor: int) -> None:
        self._bands, self._factor = bands, factor
        size = (shape[0] // factor, shape[1] // factor)
        self._sums = np.zeros((len(bands), *size), np.float32)
        self._counts: np.ndarray = np.zeros(self._sums.shape, np.uint16)
        self._line = 0

    def add(self, cube: Cube) -> None:
        """Take the next lines."""
        factor, width = self._factor, self._sums.shape[2]
        shape = (width, factor, cube.values.shape[2])
        for values, flags in zip(cube.values, cube.flags, strict=True):
            row = self._line // factor
            self._line += 1
            if row >= self._sums.shape[1]:
                return
            good = ~is_flagged(flags[: width * factor], UNRELIABLE)
            filled = np.where(good, values[: width * factor], np.float32(0)).reshape(shape)
            # Line by line and sample by sample: the sums do not depend on how lines come in.
            for k in range(factor):
                self._sums[:, row] += transpose(filled[:, k])
            self._counts[:, row] += transpose(good.reshape(shape).sum(1, dtype=np.uint16))

    def images(self) -> list[BandImage]:
        """Return the pictures, in the memory of the sums: nothing can be added any more."""
        least = self._factor**2 / 2

        def image(band: Band, sums: np.ndarray, counts: np.ndarray) -> BandImage:
            values = np.divide(sums, np.maximum(counts, 1), out=sums)
            valid = (counts >= least) & (not band.bad)
            return BandImage(band.label, band.wavelength, values, valid)

        return each(image, self._bands, self._sums, self._counts)


def open_scan(capture: Capture, campaign: Campaign, templates: TemplateCache) -> Scan:
    """Open a line scan: dark, white and noise are prepared; of the object only strips that are to be joined are read.

    Raises Refused as `calibrate.develop` does.
    """
    sensor = capture.sensors[0]
    facts = read_facts(sensor.object[0].path)
    camera = campaign.cameras[capture.camera]
    board = board_of(campaign, capture, sensor)
    context = SensorContext(
        *(campaign, camera, sensor, facts, templates),
        reflectance=board.reflectance,
        doubts=board.notes,
    )
    stated = tuple(compare_facts(camera, sensor, context.alignments))
    require_exposures(context)
    require_black(context)
    where, aligns = f"{capture.object}/{capture.layer}", {sensor.name: sensor.align}
    lines = lines_of_scan(context)
    return Scan(context, lines, where, facts.captured, aligns, stated=stated)


def develop_scan(context: SensorContext) -> tuple[Cube, list[str]]:
    """Calibrate a line scan that is held in memory, strips joined; return it with notes.

    Raises CalibrationRefused as `flat_field` does, and where strips cannot be joined.
    """
    cube, notes = Scan(context, lines_of_scan(context)).whole()
    return cube, [*notes]

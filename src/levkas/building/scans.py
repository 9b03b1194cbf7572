"""Line scans: calibrated by blocks of lines, which are held in memory, or passed on where they are too many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.building.capture_statistics import Middle
from levkas.building.exposures import cube_of, flatten, mark_glare_in
from levkas.building.scan_templates import (
    FrameLines,
    ScanFile,
    ScanTemplates,
    block_lines,
    gaps_marked,
    lines_of,
    templates_of_scan,
)
from levkas.building.spectra import white_reflectance
from levkas.calibration.denoising import Projecting, Subspace, describe_removed, find_subspace
from levkas.calibration.flatfield import Calibrated, describe_darks
from levkas.calibration.pushbroom import join_strips
from levkas.calibration.sensor_context import (
    SensorContext,
    by_exposure,
    doubt_scaling,
    doubts_of,
    placed,
    require_exposures,
    timed,
    times_in,
    times_of,
)
from levkas.calibration.templates import (
    CalibrationRefused,
    Template,
    describe_lost,
    gaps_of,
    no_values,
    single_shot,
)
from levkas.calibration.whites import WhiteBoard
from levkas.core.cube import UNRELIABLE, Band, Cube
from levkas.core.files import replacing
from levkas.core.problems import Problem
from levkas.core.rounding import round_root
from levkas.readers.frames import read_facts
from levkas.registration.bands import BandImage

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from levkas.building.template_cache import TemplateCache
    from levkas.calibration.pushbroom import Seam
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture

STREAMED_SAMPLES = 400_000_000
"""A scan of more samples, of a mirror scanner of a third as many, is not held in memory. Layers, maps and
records end in the same bytes either way but for the last bits of resampled values; the range on the report's
page is then that of every sixteenth pixel. A constant, so that results do not hang on the machine's memory."""
LOOKED_AT_PX = 1_000_000
"""Most pixels of a band as registration sees it."""
PASSING_BYTES, STRIPS_BYTES, PICTURE_BYTES = 1e8, 8e5, 7
"""Of what passes by at a time, of strips of a band that are gathered, and of a pixel of a band's picture."""
Lines = tuple[int, int]
"""First line, and the one behind the last."""


def is_streamed(capture: Capture, campaign: Campaign) -> bool:
    """Tell whether a capture is a line scan in one ENVI file that is larger than is held in memory.

    Dark and white of a mirror scanner are as large, and have to be ENVI files too.
    """
    camera, sensor = campaign.cameras[capture.camera], capture.sensors[0]
    if camera.kind != "cube" or capture.camera == campaign.reference.camera:
        return False
    if len(sensor.object) != 1:
        return False
    frames = [*sensor.object]
    if camera.scan == "mirror":
        frames += [*sensor.dark, *sensor.white]
    facts = [read_facts(frame.path) for frame in frames]
    samples = int(np.prod(facts[0].shape, dtype=object)) * (3 if camera.scan == "mirror" else 1)
    return all(one.kind == "envi" for one in facts) and samples > STREAMED_SAMPLES


def factor_of(shape: tuple[int, int, int]) -> int:
    """Return how many px a side of a scan, (lines, samples, bands), make a pixel of its pictures."""
    return max(1, int(np.ceil(np.sqrt(shape[0] * shape[1] / LOOKED_AT_PX))))


def bytes_of_pass(capture: Capture, lines: Lines | None = None) -> float:
    """Return the bytes that a pass over lines of a streamed scan takes at least, default all: pictures above all."""
    whole, samples, bands = (int(n) for n in read_facts(capture.sensors[0].object[0].path).shape)
    start, stop = lines or (0, whole)
    pixels = (stop - start) * samples / factor_of((whole, samples, bands)) ** 2
    return PASSING_BYTES + bands * (STRIPS_BYTES + PICTURE_BYTES * pixels)


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

    @cached_property
    def reflectance(self) -> Any:
        """Of the white, a number or one a band."""
        return white_reflectance(self.context.campaign, self.context.sensor.bands)

    @property
    def notes(self) -> tuple[str, ...]:
        """What exposures leave in doubt, known before a line is calibrated."""
        context, times = self.context, times_of(self.file.frame)
        darks = [lines_of(dark, 0, 1) for dark in self.templates.darks]
        white = None if self.templates.white is None else lines_of(self.templates.white, 0, 1)
        doubt = doubt_scaling(context, times, times_in(white)) if white is not None else ""
        none = np.zeros((1, 1, len(context.sensor.bands)), bool)
        shot = timed(Template(none.astype(np.float32), None, 1, none, none), times)
        notes = (doubt, *describe_darks(shot, darks, white, context.black))
        return tuple(note for note in notes if note)

    def flat(self, start: int, stop: int) -> FlatLines:
        """Flat-field lines `start` to `stop`; the same values for any block that they are part of."""
        context, frame = self.context, self.file.frame
        codes = context.checked(self.file.read(start, stop), frame)
        shape = codes.shape
        shot = single_shot(codes, saturation=context.saturation)
        del codes
        shot = timed(gaps_marked(shot), times_of(frame))
        darks = [lines_of(dark, start, stop) for dark in self.templates.darks]
        white = self.templates.white
        lit = None if white is None else lines_of(white, start, stop)
        flat = flatten(
            context,
            shot,
            darks,
            lit,
            board=WhiteBoard(
                self.reflectance,
                labels=[band.label for band in context.sensor.bands],
                checked=start > 0 or isinstance(white, FrameLines),
            ),
            noise=self.templates.noise,
        )
        lost = gaps_of(shot, *darks, lit)
        if lost is None:
            return FlatLines(flat, np.zeros(shape[2], np.int64))
        return FlatLines(flat, np.broadcast_to(lost, shape).sum((0, 1)))


@dataclass(frozen=True, eq=False)
class JoinedStrips:
    """Strips of one scan that were flat-fielded and joined, in memory."""

    whole: Calibrated
    notes: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, samples, bands)."""
        lines, samples, bands = self.whole.values.shape
        return int(lines), int(samples), int(bands)

    def flat(self, start: int, stop: int) -> FlatLines:
        """Return lines `start` to `stop`; what was lost is in the notes already."""
        rows, whole = slice(start, stop), self.whole
        variance = None if whole.variance is None else whole.variance[rows].copy()
        parts = whole.values[rows].copy(), whole.flags[rows].copy(), variance
        return FlatLines(Calibrated(*parts, whole.quantity), np.zeros(self.shape[2], np.int64))


class ScanSummary(NamedTuple):
    """What one pass over all lines of a scan shows: notes, pictures for registration, focus by band."""

    notes: tuple[str, ...]
    pictures: list[BandImage]
    focus: list[dict[str, Any]]


@dataclass(eq=False)
class Scan:
    """One line scan whose lines are calibrated whenever they are needed, in place of `Native`.

    Parameters
    ----------
    context : SensorContext
    source : Strip or JoinedStrips
        Of its flat-fielded lines.
    where : str
        Object and layer, for warnings.
    aligns, captured
        As of `Native`.
    pictures : Path, optional
        What `keep_pictures` has written of the scan.
    """

    context: SensorContext
    source: Strip | JoinedStrips
    where: str = ""
    captured: str | None = None
    aligns: Mapping[str, object] = field(default_factory=dict)
    pictures: Path | None = None
    _summary: ScanSummary | None = field(default=None, init=False)

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of `Native`; complete when all lines have been calibrated once."""
        seen = self._summary.notes if self._summary else ()
        return tuple(dict.fromkeys(f"{self.where}: {note}" for note in (*self._doubts, *seen)))

    @cached_property
    def _doubts(self) -> tuple[str, ...]:
        return (*doubts_of(self.context), *self.source.notes)

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
        """The signal subspace of the whole scan where HySime is asked for; found in one pass."""
        if not self.context.camera.denoise:
            return None
        return find_subspace(block.flat.values for block in self._flat_blocks(0, self.shape[0]))

    @property
    def factor(self) -> int:
        """Side, px, of the blocks that make a pixel of the pictures that registration sees."""
        return factor_of(self.shape)

    @property
    def learnt(self) -> dict[str, dict[str, Any]]:
        """What was learnt of the sensor, as of `Native`."""
        return {self.context.sensor.name: self.context.told}

    def without_sigma(self) -> Scan:
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
        cube = Cube(values, flags, sigma, self.bands, self.quantity)
        return cube, (*self.source.notes, *calibration.notes())

    def passed(self) -> Iterator[Cube]:
        """Yield all lines, calibrated; pictures, focus and warnings are known when the last has been taken.

        Raises CalibrationRefused where a band has no finite value at all.
        """
        seen = LinesSeen(self)
        yield from seen.blocks()
        self._summary = seen.summary()

    def joined(self, parts: Iterable[tuple[Lines, Mapping[str, np.ndarray]]]) -> None:
        """Take what parts have seen, their lines and `LinesSeen.arrays` of each, in place of a pass.

        Raises CalibrationRefused where a band has no finite value at all.
        """
        seen = LinesSeen(self)
        for lines, arrays in parts:
            seen.join(lines, arrays)
        self._summary = seen.summary()

    @property
    def summary(self) -> ScanSummary:
        """What a pass over all lines shows; one is made where there was none."""
        if self._summary is None:
            for _ in self.passed():
                pass
        assert self._summary is not None
        return self._summary

    def images(self) -> list[BandImage]:
        """Return every band as registration sees it: means of blocks of `factor` x `factor` px."""
        if self._summary is None and self.pictures is not None:
            return self._kept
        return self.summary.pictures

    def keep_pictures(self, path: Path) -> None:
        """Write `images` to a file, so that they need no pass; raises WriteRefused."""
        with replacing(path) as handle:
            for image in self.images():
                handle.write(np.ascontiguousarray(image.values, np.float32).data)
                handle.write(np.packbits(image.valid).data)

    @cached_property
    def _kept(self) -> list[BandImage]:
        assert self.pictures is not None
        shape = (self.shape[0] // self.factor, self.shape[1] // self.factor)
        made, count = [], shape[0] * shape[1]
        with self.pictures.open("rb") as handle:
            for band in self.bands:
                values = np.fromfile(handle, np.float32, count).reshape(shape)
                bits = np.fromfile(handle, np.uint8, -(-count // 8))
                valid = np.unpackbits(bits, count=count).astype(bool).reshape(shape)
                made.append(BandImage(band.label, band.wavelength, values, valid))
        return made

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

    `lost` are the values of each band, (bands,), that are no finite numbers.
    """

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self.lost = np.zeros(scan.shape[2], np.int64)
        self._projecting = Projecting(scan.subspace) if scan.subspace else None

    def blocks(self, start: int = 0, stop: int | None = None) -> Iterator[Cube]:
        """Yield lines `start` to `stop`, default all, calibrated, some at a time."""
        for block in self._scan._flat_blocks(start, stop or self._scan.shape[0]):
            self.lost += block.lost
            yield self._scan._finished(block.flat, self._projecting)

    def notes(self) -> tuple[str, ...]:
        """Say what was lost and taken away; raises CalibrationRefused where a band has no finite value."""
        notes = describe_loss(self._scan.context, self.lost, self._scan.shape)
        if (made := self._projecting) is not None:
            notes.append(describe_removed(made.subspace, made.removed, made.most))
        return tuple(notes)


def describe_loss(
    context: SensorContext, lost: np.ndarray, shape: tuple[int, int, int]
) -> list[str]:
    """Say how many values of a scan are no finite numbers, of counts by band; nothing where all are.

    Raises CalibrationRefused where a band has no finite value at all.
    """
    every = shape[0] * shape[1]
    if (empty := np.flatnonzero(lost == every)).size:
        refused = no_values(int(empty[0]), shape)
        raise CalibrationRefused(*(placed(p, context.sensor.object) for p in refused.problems))
    count = int(lost.sum())
    return [describe_lost(count, every * shape[2], context.camera.name)] if count else []


class LinesSeen:
    """What lines of a scan show while they pass by: values that were lost, pictures, the middle.

    Parameters
    ----------
    scan : Scan
    lines : (start, stop), optional
        Those that pass, `start` a multiple of ``scan.factor``; default all.
    """

    def __init__(self, scan: Scan, lines: Lines | None = None) -> None:
        self._lines = lines or (0, scan.shape[0])
        self._pass, self._pictures = ScanPass(scan), Pictures(scan, self._lines)
        self._middle = Middle(scan.shape, scan.bands, self._lines[0])

    def blocks(self) -> Iterator[Cube]:
        """Yield the lines, calibrated, some at a time."""
        for cube in self._pass.blocks(*self._lines):
            self._pictures.add(cube)
            self._middle.add(cube)
            yield cube

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what the lines have shown, for `join`."""
        middle = self._middle.arrays(*self._lines)
        return {"lost": self._pass.lost, **self._pictures.arrays(), **middle}

    def join(self, lines: Lines, arrays: Mapping[str, np.ndarray]) -> None:
        """Take lines that passed elsewhere, as `arrays` gave them there; not of a scan that is denoised."""
        self._pass.lost += arrays["lost"]
        self._pictures.join(lines, arrays)
        self._middle.join(arrays, *lines)

    def summary(self) -> ScanSummary:
        """Return what all lines have shown; raises CalibrationRefused where a band has no finite value."""
        return ScanSummary(self._pass.notes(), self._pictures.images(), self._middle.focus())


class Pictures:
    """Every band of a scan as registration sees it, gathered while its lines, all or some, pass by."""

    def __init__(self, scan: Scan, lines: Lines) -> None:
        self._bands, self._factor = scan.bands, scan.factor
        _, samples, bands = scan.shape
        rows, width = self._rows(lines), samples // self._factor
        self._sums = np.zeros((bands, rows.stop - rows.start, width), np.float32)
        self._counts: np.ndarray = np.zeros(self._sums.shape, np.uint16)
        self._line = 0

    def _rows(self, lines: Lines) -> slice:
        return slice(lines[0] // self._factor, lines[1] // self._factor)

    def add(self, cube: Cube) -> None:
        """Take the next lines."""
        factor, width = self._factor, self._sums.shape[2]
        shape = (width, factor, cube.values.shape[2])
        for values, flags in zip(cube.values, cube.flags, strict=True):
            row = self._line // factor
            self._line += 1
            if row >= self._sums.shape[1]:
                return
            good = (flags[: width * factor] & UNRELIABLE) == 0
            seen = np.where(good, values[: width * factor], np.float32(0)).reshape(shape)
            # Line by line and sample by sample: the sums do not depend on how lines come in.
            for k in range(factor):
                self._sums[:, row] += seen[:, k].T
            self._counts[:, row] += good.reshape(shape).sum(1, dtype=np.uint16).T

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the sums of values that can be relied on, and their counts, (bands, rows, columns)."""
        return {"sums": self._sums, "counts": self._counts}

    def join(self, lines: Lines, arrays: Mapping[str, np.ndarray]) -> None:
        """Take the sums and counts of some lines."""
        rows = self._rows(lines)
        self._sums[:, rows], self._counts[:, rows] = arrays["sums"], arrays["counts"]

    def images(self) -> list[BandImage]:
        """Return the pictures, in the memory of the sums: nothing can be added any more."""
        made, least = [], self._factor**2 / 2
        for band, sums, counts in zip(self._bands, self._sums, self._counts, strict=True):
            values = np.divide(sums, np.maximum(counts, 1), out=sums)
            made.append(BandImage(band.label, band.wavelength, values, counts >= least))
        return made


def open_scan(capture: Capture, campaign: Campaign, templates: TemplateCache) -> Scan:
    """Open a line scan of one file: dark, white and noise are prepared, no line of the object is read.

    Raises Refused as `calibrate.develop` does.
    """
    sensor = capture.sensors[0]
    facts = read_facts(sensor.object[0].path)
    camera = campaign.cameras[capture.camera]
    context = SensorContext(campaign, camera, sensor, facts, templates)
    require_exposures(context)
    where, aligns = f"{capture.object}/{capture.layer}", {sensor.name: sensor.align}
    return Scan(context, _strips_of(context)[0], where, facts.captured, aligns)


def develop_scan(context: SensorContext) -> tuple[Cube, list[str]]:
    """Calibrate a line scan that is held in memory, strips joined; return it with notes.

    Raises
    ------
    CalibrationRefused
        As `flat_field` does, and where strips cannot be joined.
    """
    strips = _strips_of(context)
    _require_one_time(context, strips[0].templates)
    source: Strip | JoinedStrips = strips[0]
    if len(strips) > 1:
        source = _joined(strips)
    cube, notes = Scan(context, source).whole()
    return cube, [*notes]


def _strips_of(context: SensorContext) -> list[Strip]:
    files = [ScanFile.open(frame) for frame in context.sensor.object]
    templates = templates_of_scan(context, files[0].shape)
    return [Strip(context, file, templates) for file in files]


def _joined(strips: Sequence[Strip]) -> JoinedStrips:
    """Flat-field strips and join them from left to right."""
    made = [strip.flat(0, strip.shape[0]) for strip in strips]
    whole, seams = join_strips([block.flat for block in made])
    notes = []
    for strip, block in zip(strips, made, strict=True):
        notes += [*strip.notes, *describe_loss(strip.context, block.lost, strip.shape)]
    notes += [_describe_seam(number, seam) for number, seam in enumerate(seams, 1)]
    return JoinedStrips(whole, tuple(dict.fromkeys(notes)))


def _require_one_time(context: SensorContext, templates: ScanTemplates) -> None:
    """Refuse strips of several exposures where there is no white: their counts cannot be joined."""
    strips = by_exposure(context.sensor.object)
    if templates.white is None and len(strips) > 1:
        problem = Problem(
            "E_EXPOSURES",
            f"{context.camera.name}: strips of several exposures, and no white",
            field="targets.white",
            found=", ".join(frames[0].path.name for _, frames in strips),
            expected="strips of one exposure, or a white",
            fix="Capture a white, or leave the other exposures out of `files`.",
        )
        raise CalibrationRefused(placed(problem, context.sensor.object))


def _describe_seam(number: int, seam: Seam) -> str:
    worst = float(np.nanmax(np.abs(seam.difference)))
    return (
        f"strips {number} and {number + 1} share {seam.overlap} samples (shift {seam.shift} lines); "
        f"the seam differs by {100 * seam.rms:.1f} % rms, by {100 * worst:.1f} % in its worst band"
    )

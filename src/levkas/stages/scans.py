"""Line scans: calibrated by blocks of lines, which are held in memory, or taken whenever they are needed where they are too many."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.agreement import compare_facts
from levkas.calibration.denoising import Projecting, Subspace, describe_removed, find_subspace
from levkas.calibration.findings import Finding, decide
from levkas.calibration.flatfield import Calibrated
from levkas.calibration.record import findings_of, findings_of_lamp
from levkas.calibration.sensor import SensorCapture, placing
from levkas.core.cube import UNRELIABLE, Band, Cube, is_flagged
from levkas.core.rounding import round_root
from levkas.core.threads import each, made_ahead
from levkas.core.transpose import transpose
from levkas.geometry.transforms import Affine, Composed, Inverse
from levkas.readers.frames import read_facts
from levkas.registration.bands import BandImage
from levkas.stages.above_white import COUNTS, count_above, findings_of_counts
from levkas.stages.capture_statistics import Middle
from levkas.stages.exposures import cube_of, doubts_of, mark_glare_in, open_frames, require_sound
from levkas.stages.measurements import stray_light_by
from levkas.stages.parts import (
    CalibratedCapture,
    Part,
    PartPlace,
    Placement,
    median_focus,
)
from levkas.stages.scan_lines import FlatLines, Strip, describe_loss
from levkas.stages.scan_templates import ScanFile, blocks_of, templates_of_scan
from levkas.stages.strips import place_strips, require_one_time

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.stages.template_cache import TemplateCache

STREAMED_SAMPLES = 100_000_000
"""A scan of more samples, of a mirror scanner of a third as many, is not held in memory. Layers, maps and
records end in the same bytes either way but for the last bits of resampled values; the range on the report's
page is then that of every sixteenth pixel. A constant, so that results do not hang on the machine's memory."""
LOOKED_AT_PX = 1_000_000
"""Most pixels of a band of a strip as registration takes it."""


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


def open_scan(capture: Capture, campaign: Campaign, templates: TemplateCache) -> CalibratedCapture:
    """Open a line scan: dark, white and noise are prepared; of the object only strips that are to be joined are read.

    Raises Refused as `calibrate.develop` does.
    """
    return Scan.open(capture, campaign, templates).streamed()


def develop_scan(
    capture: Capture, campaign: Campaign, templates: TemplateCache
) -> CalibratedCapture:
    """Calibrate a line scan that is held in memory.

    Raises Refused: CalibrationRefused where a band has no finite value at all, and where strips cannot be placed.
    """
    return Scan.open(capture, campaign, templates).held()


@dataclass(eq=False)
class Scan:
    """A line scan: its strips, left to right, in px of the first, and what is known of it before its lines are calibrated."""

    capture: Capture
    context: SensorCapture
    strips: Sequence[Strip]
    placement: Placement | None
    notes: tuple[Finding | str, ...]
    boxes: Sequence[tuple[int, int, int, int]] = ()
    """Light traps."""

    @classmethod
    def open(cls, capture: Capture, campaign: Campaign, templates: TemplateCache) -> Scan:
        """Prepare dark, white and noise, and place the strips."""
        sensor = capture.sensors[0]
        context = open_frames(capture, campaign, sensor, templates)
        stated = compare_facts(context.camera, sensor, context.alignments)
        require_sound(context)
        files = [ScanFile.open(frame) for frame in sensor.object]
        prepared = templates_of_scan(context, files[0].shape)
        strips = [Strip(context, file, prepared) for file in files]
        require_one_time(context, prepared)
        notes: list[Finding | str] = [*stated, *doubts_of(context)]
        placement = None
        if len(strips) > 1:
            placement, found = place_strips(strips)
            notes += found
        notes += [*findings_of(context.record), *chain.from_iterable(one.notes for one in strips)]
        notes += findings_of_lamp([context.record])
        if prepared.noise is None and not context.holds_reflectance:
            notes.append(Finding("no_sigma"))
        traps = capture.boxes(campaign.targets.traps.get(capture.object, {}))
        return cls(capture, context, strips, placement, (*notes,), traps.get(sensor.name, []))

    @property
    def bands(self) -> tuple[Band, ...]:
        """All bands."""
        return self.context.sensor.bands

    def streamed(self) -> CalibratedCapture:
        """Return the capture, its lines calibrated whenever they are taken."""
        parts = []
        for number, strip in enumerate(self.strips, 1):
            like, lines = self.room(strip, 0), LineBuffer(self, strip)
            facts = self.context.sensor.name, self.bands, strip.shape, like.quantity, like.has_sigma
            parts.append(Part(*facts, lines.read, str(number), is_held=False))
        return self._captured(parts, survey=self._survey)

    def held(self) -> CalibratedCapture:
        """Return the capture, all lines calibrated now."""
        passing, parts, name = ScanPass(self), [], self.context.sensor.name
        for number, strip in enumerate(self.strips, 1):
            cube, y = self.room(strip, strip.shape[0]), 0
            for block in passing.blocks(strip):
                _copy(block, slice(None), cube, y)
                y += len(block.values)
                del block  # before the next lines are made
            parts.append(Part.held(cube, name, name=str(number)))
        made = self._captured(parts, focus=median_focus(passing.focus))
        notes = passing.notes()
        if self.boxes:
            box = self.boxes, self.capture.object
            self.context.record.stray_light, found = stray_light_by(made.cubes[name], *box)
            notes += found
        made.measured, made.warnings = self._measured, self._warnings(notes)
        return made

    @property
    def _measured(self) -> dict[str, dict[str, Any]]:
        return {self.context.sensor.name: self.context.record.to_json()}

    def _captured(self, parts: Sequence[Part], **more: Any) -> CalibratedCapture:
        sensor = self.context.sensor
        return CalibratedCapture(
            parts,
            {sensor.name: sensor.align},
            self.context.facts.captured,
            self._warnings(()),
            self._measured,
            placement=self.placement,
            **more,
        )

    def _warnings(self, notes: Sequence[Finding | str]) -> tuple[str, ...]:
        where = f"{self.capture.object}/{self.capture.layer}"
        with placing(self.context.sensor.object):
            return tuple(f"{where}: {note}" for note in decide((*self.notes, *notes)))

    def _survey(self, made: CalibratedCapture) -> None:
        """Pass over all lines: warnings, focus and pictures are known at the end."""
        passing, pictures = ScanPass(self), []
        lines, samples, _ = max(strip.shape for strip in self.strips)
        made.factor = max(1, int(np.ceil(np.sqrt(lines * samples / LOOKED_AT_PX))))
        for strip in self.strips:
            means = Pictures(strip.shape, self.bands, made.factor)
            for cube in made_ahead(passing.blocks(strip)):
                means.add(cube)
                del cube  # before the next lines are made
            pictures.append(means.images())
        made.warnings, made.measured = self._warnings(passing.notes()), self._measured
        made.focus = median_focus(passing.focus)
        made.pictures = pictures[0] if self.placement is None else self._joined(pictures, made)

    def _joined(
        self, pictures: Sequence[Sequence[BandImage]], made: CalibratedCapture
    ) -> list[BandImage]:
        """Return the pictures of all strips as those of one scan."""
        assert self.placement is not None
        grow = Affine.of_box(0, 0, made.factor)
        width, height = (side // made.factor for side in self.placement.size)
        parts, places = [], {}
        for part, images in zip(made.parts, pictures, strict=True):
            values = np.stack([image.values for image in images], -1)
            lost = np.stack([~image.valid for image in images], -1).astype(np.uint8)
            cube = Cube(values, lost, None, self.bands, made.quantity)
            parts.append(Part.held(cube, part.sensor, name=part.name))
            onto = next(iter(self.placement.parts[part.name].maps.values()))  # one of all bands
            onto = Composed(grow, onto, Inverse(grow))
            places[part.name] = PartPlace(dict.fromkeys(cube.labels, onto))
        return CalibratedCapture(parts, placement=Placement(places, (width, height))).images()

    # --- lines

    def room(self, strip: Strip, lines: int) -> Cube:
        """Return memory for calibrated lines of a strip."""
        flat = self._first[id(strip)]
        shape = (lines, *strip.shape[1:])
        sigma = None if flat.variance is None else np.empty(shape, np.float32)
        arrays = np.empty(shape, np.float32), np.empty(shape, np.uint8), sigma
        return Cube(*arrays, self.bands, flat.quantity)

    @cached_property
    def _first(self) -> dict[int, Calibrated]:
        """The first line of every strip."""
        return {id(strip): strip.flat(0, 1).flat for strip in self.strips}

    @cached_property
    def subspace(self) -> Subspace | None:
        """The signal subspace of the whole scan if HySime is used; found in one pass."""
        if not self.context.camera.denoise:
            return None
        strips = (self.flat_blocks(strip, 0, strip.shape[0]) for strip in self.strips)
        return find_subspace(block.flat.values for block in chain.from_iterable(strips))

    def flat_blocks(self, strip: Strip, start: int, stop: int) -> Iterator[FlatLines]:
        """Yield flat-fielded lines of a strip, some at a time."""
        for block in blocks_of(strip.shape, start, stop):
            yield strip.flat(*block)

    def finished(self, lines: FlatLines, projecting: Projecting | None) -> Cube:
        """Return lines rounded and glare flagged; `projecting` takes noise away before."""
        flat = lines.flat
        values, variance = flat.values, flat.variance
        if projecting is not None:
            if variance is not None:
                variance = np.square(round_root(variance))
            values, variance = projecting(values, variance)
        return mark_glare_in(cube_of(self.context, values, flat.flags, variance, flat.quantity))


class LineBuffer:
    """Stretches of calibrated lines of a strip: lines that a stretch has in common with the one before are not calibrated again."""

    def __init__(self, scan: Scan, strip: Strip) -> None:
        self._scan, self._strip = scan, strip
        self._last: tuple[int, Cube] | None = None

    def read(self, start: int, stop: int, noisy: bool) -> Cube:
        """Return lines `start` to `stop`; sigma is kept for the next stretch, and cannot be written to."""
        scan, lines, fresh = self._scan, self._scan.room(self._strip, stop - start), start
        if self._last is not None:
            first, before = self._last
            if first <= start < first + len(before.values):
                fresh = min(first + len(before.values), stop)
                _copy(before, slice(start - first, fresh - first), lines, 0)
            self._last = None
            del before  # its memory goes before more is taken
        projecting = Projecting(scan.subspace) if scan.subspace else None
        for block in scan.flat_blocks(self._strip, fresh, stop):
            _copy(scan.finished(block, projecting), slice(None), lines, fresh - start)
            fresh += len(block.flat.values)
            del block  # before the next lines are made
        if lines.sigma is not None:
            lines.sigma.flags.writeable = False
        self._last = start, lines
        return lines


def _copy(source: Cube, rows: slice, into: Cube, at: int) -> None:
    """Copy rows of a cube to those of another from `at` on."""
    count = len(source.values[rows])
    for name in ("values", "flags", "sigma"):
        if (array := getattr(source, name)) is not None:
            getattr(into, name)[at : at + count] = array[rows]


class ScanPass:
    """One pass over all lines of a scan, which counts what frames lost and what denoising takes away."""

    def __init__(self, scan: Scan) -> None:
        self._scan, bands = scan, len(scan.bands)
        self._lost = np.zeros(bands, np.int64)
        self._above = np.zeros((COUNTS, bands), np.int64)
        self._sums, self._count = np.zeros(bands), 0
        self._projecting = Projecting(scan.subspace) if scan.subspace else None
        self._quantity = "counts"
        self.focus: list[list[dict[str, Any]]] = []
        """Of every strip that has passed."""

    def blocks(self, strip: Strip) -> Iterator[Cube]:
        """Yield all lines of a strip, calibrated, some at a time."""
        middle = Middle(strip.shape, self._scan.bands)
        for block in self._scan.flat_blocks(strip, 0, strip.shape[0]):
            self._lost += block.lost
            cube = self._scan.finished(block, self._projecting)
            self._quantity = cube.quantity
            self._above += count_above(cube)
            for line in cube.values:  # one by one: sums do not depend on how lines come in
                self._sums += line.sum(0, dtype=float)
                self._count += len(line)
            middle.add(cube)
            yield cube
            del cube, block  # their memory is that of the lines, which may have been done with
        self.focus.append(middle.focus())

    def notes(self) -> list[Finding | str]:
        """Report what was lost and taken away; note the mean of the view, and what makes the noise there.

        Raises CalibrationRefused where a band has no finite value at all.
        """
        scan, labels = self._scan, [band.label for band in self._scan.bands]
        if self._quantity == "reflectance":
            levels = self._sums / max(self._count, 1)
            means = zip(labels, levels.tolist(), strict=True)
            record = scan.context.record
            record.mean_of_view = {label: float(f"{at:.4g}") for label, at in means}
            if shares := scan.strips[0].noise_shares(levels):
                record.noise_shares = shares
        pixels = sum(strip.shape[0] * strip.shape[1] for strip in scan.strips)
        notes: list[Finding | str] = [*describe_loss(scan.context, self._lost, pixels)]
        if (projection := self._projecting) is not None:
            notes.append(describe_removed(projection.subspace, projection.removed, projection.most))
        return [*notes, *findings_of_counts(self._above, labels)]


class Pictures:
    """Every band of a strip as registration takes it, gathered while its lines pass by: means of `factor` x `factor` px."""

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

"""Line scans too large for memory: calibrated some lines at a time, whenever they are asked for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.building.exposures import mark_glare_in
from levkas.building.line_templates import FrameLines, gaps_marked
from levkas.calibration.denoising import describe_removed
from levkas.calibration.lines import LineField
from levkas.calibration.sensor_context import Times, timed, times_of
from levkas.calibration.templates import (
    CalibrationRefused,
    Template,
    bands_alike,
    describe_lost,
    gaps_of,
    no_values,
)
from levkas.calibration.whites import WhiteBoard
from levkas.core.cube import UNRELIABLE, Cube, Flag
from levkas.core.machine import count_threads, tile_rows
from levkas.core.rounding import round_root, round_values
from levkas.registration.bands import BandImage

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from levkas.calibration.denoising import Projecting, Subspace
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.sensor_context import SensorContext
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.core.cube import Band, Cube
    from levkas.readers.envi import EnviFile

STREAMED_SAMPLES = 400_000_000
"""A cube of more samples, of a mirror scanner of a third as many, is streamed. Layers, maps and records end
in the same bytes either way; the range on the report's page is then that of every sixteenth pixel. A constant,
so that which way a scan goes does not hang on the memory that happens to be there."""
BLOCK_SAMPLES = 8_000_000
"""Calibrated at once, where $LEVKAS_TILE does not say how many lines."""
LOOKED_AT_PX = 1_000_000
"""Most pixels of a band as registration sees it."""


def is_streamed(capture: Capture, campaign: Campaign) -> bool:
    """Tell whether a capture is a line scan in one ENVI file that is larger than is held in memory.

    Dark and white of a mirror scanner are as large, and have to be ENVI files too.
    """
    from levkas.readers.frames import read_facts

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


@dataclass(frozen=True, eq=False)
class RawLines:
    """Some lines as they are in the file, with the darks and the white that belong to them.

    Templates are one line high for all, or as high as `codes`.
    """

    codes: np.ndarray
    darks: tuple[Template, ...]
    white: Template | None


@dataclass(frozen=True, eq=False)
class Scan:
    """One line scan with its templates, in place of `Native`.

    Parameters
    ----------
    opened : EnviFile
    bench : SensorContext
    darks : tuple of Template or FrameLines
    white : Template, FrameLines or None
        One line each, or of a mirror scanner what its lines are read from.
    noise : NoiseModel or None
    reflectance : float or ndarray
        Of the white.
    where : str
        Object and layer, for warnings.
    aligns, captured
        As of `Native`.
    doubts : tuple of str
        Warnings that are known before a line is read.
    told : list of str
        Warnings that `Passage` adds when all lines have been seen.
    focus : list of dict
        As `focusing.focus_of` gives it; known when all lines have been seen.
    """

    opened: EnviFile
    bench: SensorContext
    darks: tuple[Template | FrameLines, ...]
    white: Template | FrameLines | None
    noise: NoiseModel | None
    reflectance: Any
    where: str
    captured: str | None = None
    doubts: tuple[str, ...] = ()
    aligns: Mapping[str, object] = field(default_factory=dict)
    pictures: list[BandImage] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    focus: list[dict[str, Any]] = field(default_factory=list)

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of `Native`."""
        return (*self.doubts, *self.told)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, samples, bands)."""
        lines, samples, bands = self.opened.facts.shape
        return int(lines), int(samples), int(bands)

    @property
    def bands(self) -> tuple[Band, ...]:
        """All bands."""
        return self.bench.sensor.bands

    @property
    def quantity(self) -> str:
        """``"reflectance"`` where there is a white, else ``"counts"``."""
        return "counts" if self.white is None else "reflectance"

    @cached_property
    def has_sigma(self) -> bool:
        """Whether the noise is known."""
        return self._flat(self._raw(0, 1)).sigma is not None

    @cached_property
    def field(self) -> LineField | None:
        """The flat field of every line; None where each line has its own, as behind a mirror, or each band its times."""
        lines = [one for one in self.darks if isinstance(one, Template)]
        if len(lines) < len(self.darks) or isinstance(self.white, FrameLines):
            return None
        if isinstance(self.times, tuple) or bands_alike(*lines, self.white):
            return None
        return LineField.of(
            lines,
            self.white,
            exposure_s=self.times,
            shape=self.shape[1:],
            reflectance=self.reflectance,
            black=self.bench.black,
            noise=self.noise,
            labels=[band.label for band in self.bands],
        )

    @cached_property
    def times(self) -> Times:
        """Exposure of the object."""
        return times_of(self.bench.sensor.object[0])

    @cached_property
    def subspace(self) -> Subspace | None:
        """The signal subspace of the whole scan where HySime is asked for; found in one passage."""
        from levkas.calibration.denoising import find_subspace

        if not self.bench.camera.denoise:
            return None
        return find_subspace(_as_numbers(self._flat(raw)) for raw in self.raw_blocks())

    @property
    def factor(self) -> int:
        """Side, px, of the blocks that make a pixel of the pictures that registration sees."""
        lines, samples, _ = self.shape
        return max(1, int(np.ceil(np.sqrt(lines * samples / LOOKED_AT_PX))))

    @property
    def learnt(self) -> dict[str, dict[str, Any]]:
        """What was learnt of the sensor, as of `Native`."""
        return {self.bench.sensor.name: self.bench.told}

    def without_sigma(self) -> Scan:
        """Return the scan itself: it holds nothing."""
        return self

    def size_of(self, _label: str) -> list[int]:
        """Return [width, height] of any band."""
        return [self.shape[1], self.shape[0]]

    def lines(
        self, start: int, stop: int, into: Cube | None = None, *, squared: bool = False
    ) -> Cube:
        """Calibrate lines `start` to `stop`; the same values for any block that they are part of.

        They are written to the arrays of `into`, of as many lines, where it is given; `squared`, the
        square of sigma takes its place.
        """
        whole = self.room(stop - start) if into is None else into
        step = lines_at_once(self.shape)
        for y in range(start, stop, step):
            last = min(y + step, stop)
            part = rows_of(whole, y - start, last - start)
            self.calibrated(self._raw(y, last), into=part, squared=squared)
        return whole

    def room(self, lines: int) -> Cube:
        """Return arrays for so many lines, not filled."""
        shape = (lines, *self.shape[1:])
        sigma = np.empty(shape, np.float32) if self.has_sigma else None
        values, flags = np.empty(shape, np.float32), np.empty(shape, np.uint8)
        return Cube(values, flags, sigma, self.bands, self.quantity)

    def blocks(self) -> Iterator[Cube]:
        """Yield all lines, some at a time."""
        return (self.calibrated(raw) for raw in self.raw_blocks())

    def raw_blocks(self) -> Iterator[RawLines]:
        """Yield all lines as they are in the file."""
        step = lines_at_once(self.shape)
        for start in range(0, self.shape[0], step):
            yield self._raw(start, min(start + step, self.shape[0]))

    def calibrated(
        self,
        raw: RawLines,
        projecting: Projecting | None = None,
        into: Cube | None = None,
        *,
        squared: bool = False,
    ) -> Cube:
        """Calibrate raw lines; `projecting` gathers what HySime takes away.

        They are written to the arrays of `into` where it is given, with `squared` as for `lines`.
        """
        from levkas.calibration.denoising import Projecting

        cube = self._flat(raw, into, squared)
        values = cube.values
        if self.subspace is not None:
            spread = cube.sigma
            if spread is not None and not squared:
                np.square(spread, out=spread)
            project = projecting or Projecting(self.subspace)
            projected, variance = project(_as_numbers(cube), spread)
            values = np.where(np.isnan(projected), cube.values, projected)
            if spread is not None and variance is not None:
                round_root(variance, out=spread)
                if squared:
                    np.square(spread, out=spread)
        if self._exact:
            out = None if into is None else into.values
            cube = replace(cube, values=round_values(values, out=out))
        return mark_glare_in(cube, squared=squared)

    def _raw(self, start: int, stop: int) -> RawLines:
        codes = self.opened.read_lines(start, stop, turned=False)
        return RawLines(
            self.bench.checked(codes, self.bench.sensor.object[0]),
            tuple(_lines_of(dark, start, stop) for dark in self.darks),
            None if self.white is None else _lines_of(self.white, start, stop),
        )

    @property
    def _exact(self) -> bool:
        """Whether values are rounded when noise is taken away, and not before."""
        return bool(self.bench.camera.denoise)

    def _flat(self, raw: RawLines, into: Cube | None = None, squared: bool = False) -> Cube:
        if self.field is None or raw.codes.dtype not in (np.uint8, np.uint16):
            cube = self._flat_by_frames(raw, into)
            if squared and cube.sigma is not None:
                np.square(cube.sigma, out=cube.sigma)
            return cube
        made = self.field.develop(
            raw.codes,
            saturation=self.bench.saturation,
            threads=count_threads(),
            exact=self._exact,
            squared=squared,
            out=None if into is None else (into.values, into.flags, into.sigma),
        )
        return Cube(*made, self.bands, self.quantity)

    def _flat_by_frames(self, raw: RawLines, into: Cube | None) -> Cube:
        """Calibrate lines as whole frames are; the white of a mirror scanner was looked at as it was opened."""
        from levkas.building.exposures import cube_of, flatten
        from levkas.calibration.templates import average

        flat = flatten(
            self.bench,
            timed(
                gaps_marked(average(iter([raw.codes]), saturation=self.bench.saturation)),
                self.times,
            ),
            list(raw.darks),
            raw.white,
            board=WhiteBoard(
                self.reflectance,
                labels=[band.label for band in self.bands],
                checked=isinstance(self.white, FrameLines),
            ),
            noise=self.noise,
        )
        parts = flat.values, flat.flags, flat.variance, flat.quantity
        cube = cube_of(self.bench, *parts, exact=self._exact)
        if into is None:
            return cube
        into.values[...], into.flags[...] = cube.values, cube.flags
        if into.sigma is not None and cube.sigma is not None:
            into.sigma[...] = cube.sigma
        return into

    def images(self) -> list[BandImage]:
        """Return every band as registration sees it: means of blocks of `factor` x `factor` px."""
        if not self.pictures:
            reducer = Reducer(self)
            for cube in self.blocks():
                reducer.add(cube)
            self.pictures.extend(reducer.images())
        return self.pictures


def _lines_of(template: Template | FrameLines, start: int, stop: int) -> Template:
    """Return the lines of a template that belong to some of the scan, or the one that serves all."""
    return template.lines(start, stop) if isinstance(template, FrameLines) else template


def _as_numbers(cube: Cube) -> np.ndarray:
    """Return the values, NaN where there is none: `developing.cube_of` writes 0 there."""
    return np.where(cube.flags & np.uint8(Flag.OUTSIDE), np.float32(np.nan), cube.values)


def rows_of(cube: Cube, start: int, stop: int) -> Cube:
    """Return rows `start` to `stop` of a cube, in its memory."""
    rows = slice(start, stop)
    sigma = None if cube.sigma is None else cube.sigma[rows]
    return replace(cube, values=cube.values[rows], flags=cube.flags[rows], sigma=sigma)


def lines_at_once(shape: tuple[int, int, int]) -> int:
    """Return how many lines of a scan, (lines, samples, bands), are calibrated at a time."""
    lines, samples, bands = shape
    return tile_rows(BLOCK_SAMPLES // (samples * bands), lines)


class Passage:
    """All lines of a scan, calibrated once, and what is to be told of them.

    To be iterated over once; `Scan.told` has the warnings then.
    """

    def __init__(self, scan: Scan) -> None:
        from levkas.calibration.denoising import Projecting

        self._scan = scan
        self._lost = np.zeros(scan.shape[2], np.int64)
        self._projecting = Projecting(scan.subspace) if scan.subspace else None

    def __iter__(self) -> Iterator[Cube]:
        """Yield some lines at a time.

        Raises CalibrationRefused where a band has no finite value at all.
        """
        for raw in self._scan.raw_blocks():
            whole = raw.codes.dtype.kind in "ui"
            lost = np.zeros((1, 1, 1), bool) if whole else ~np.isfinite(raw.codes)
            if (templates := gaps_of(*raw.darks, raw.white)) is not None:
                lost = lost | templates
            if lost.any():
                self._lost += np.broadcast_to(lost, raw.codes.shape).sum((0, 1))
            yield self._scan.calibrated(raw, self._projecting)
        self._tell()

    def _tell(self) -> None:
        from levkas.calibration.sensor_context import placed

        bench, shape = self._scan.bench, self._scan.shape
        every = shape[0] * shape[1]
        if (empty := np.flatnonzero(self._lost == every)).size:
            refused = no_values(int(empty[0]), shape)
            raise CalibrationRefused(*(placed(p, bench.sensor.object) for p in refused.problems))
        notes = []
        if count := int(self._lost.sum()):
            notes.append(describe_lost(count, every * shape[2], bench.camera.name))
        if (made := self._projecting) is not None:
            notes.append(describe_removed(made.subspace, made.removed, made.most))
        self._scan.told[:] = [f"{self._scan.where}: {note}" for note in notes]


class Reducer:
    """Gathers the pictures of a scan while its lines pass by."""

    def __init__(self, scan: Scan) -> None:
        self._scan, self._factor = scan, scan.factor
        lines, samples, bands = scan.shape
        height, width = lines // self._factor, samples // self._factor
        self._sums = np.zeros((bands, height, width), np.float32)
        self._counts = np.zeros((bands, height, width), np.uint16)
        self._row: tuple[np.ndarray, np.ndarray] | None = None
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
            good = (flags[: width * factor] & UNRELIABLE) == 0
            seen = np.where(good, values[: width * factor], np.float32(0)).reshape(shape)
            # Line by line and sample by sample: the sums do not depend on how lines come in.
            for k in range(factor):
                self._sums[:, row] += seen[:, k].T
            self._counts[:, row] += good.reshape(shape).sum(1, dtype=np.uint16).T

    def images(self) -> list[BandImage]:
        """Return the pictures."""
        least = self._factor**2 / 2
        return [
            BandImage(
                band.label,
                band.wavelength,
                (sums / np.maximum(counts, 1)).astype(np.float32),
                counts >= least,
            )
            for band, sums, counts in zip(self._scan.bands, self._sums, self._counts, strict=True)
        ]

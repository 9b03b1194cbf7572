"""Line scans too large for memory: calibrated some lines at a time, whenever they are asked for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.building.flatfielding import mark_glare_in
from levkas.building.native import UNRELIABLE
from levkas.calibration.denoising import describe_removed
from levkas.calibration.gaps import describe_lost, gaps_of, no_values
from levkas.calibration.lines import LineField
from levkas.calibration.templates import CalibrationRefused
from levkas.cube import Cube, Flag
from levkas.machine import count_threads, tile_rows
from levkas.registration.images import BandImage
from levkas.rounding import round_values

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from levkas.building.developing import Bench
    from levkas.calibration.denoising import Projecting, Subspace
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.templates import Template
    from levkas.campaign import Campaign
    from levkas.cube import Band
    from levkas.discovery import Capture
    from levkas.readers.envi import EnviFile

STREAMED_SAMPLES = 400_000_000
"""A cube of more samples is streamed. A constant, not a share of the memory that happens to be
there: which way a scan goes shows in its bytes."""
BLOCK_SAMPLES = 8_000_000
"""Calibrated at once, where $LEVKAS_TILE does not say how many lines."""
LOOKED_AT_PX = 1_000_000
"""Most pixels of a band as registration sees it."""


def is_streamed(capture: Capture, campaign: Campaign) -> bool:
    """Tell whether a capture is a line scan in one ENVI file that is larger than is held in memory."""
    from levkas.readers.frames import read_facts

    camera = campaign.cameras[capture.camera]
    if camera.kind != "cube" or camera.scan == "mirror":
        return False
    frames = capture.sensors[0].object
    if len(frames) != 1 or capture.camera == campaign.reference.camera:
        return False
    facts = read_facts(frames[0].path)
    return facts.kind == "envi" and int(np.prod(facts.shape, dtype=object)) > STREAMED_SAMPLES


@dataclass(frozen=True, eq=False)
class Scan:
    """One line scan with its templates, in place of `Native`.

    Parameters
    ----------
    opened : EnviFile
    bench : Bench
    dark, white : Template or None
        One line each.
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
    bench: Bench
    dark: Template | None
    white: Template | None
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
    def field(self) -> LineField:
        """The flat field of every line."""
        return LineField.of(
            self.dark,
            self.white,
            shape=self.shape[1:],
            reflectance=self.reflectance,
            black=self.bench.black,
            noise=self.noise,
            labels=[band.label for band in self.bands],
        )

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

    def lines(self, start: int, stop: int, into: Cube | None = None) -> Cube:
        """Calibrate lines `start` to `stop`; the same values for any block that they are part of.

        They are written to the arrays of `into`, of as many lines, where it is given.
        """
        whole = self.room(stop - start) if into is None else into
        step = lines_at_once(self.shape)
        for y in range(start, stop, step):
            last = min(y + step, stop)
            self._block(y, last, rows_of(whole, y - start, last - start))
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

    def raw_blocks(self) -> Iterator[np.ndarray]:
        """Yield all lines as they are in the file."""
        step = lines_at_once(self.shape)
        for start in range(0, self.shape[0], step):
            yield self._raw(start, min(start + step, self.shape[0]))

    def calibrated(
        self, raw: np.ndarray, projecting: Projecting | None = None, into: Cube | None = None
    ) -> Cube:
        """Calibrate raw lines; `projecting` gathers what HySime takes away.

        They are written to the arrays of `into` where it is given.
        """
        from levkas.calibration.denoising import Projecting

        cube = self._flat(raw, into)
        values = cube.values
        if self.subspace is not None:
            projected = (projecting or Projecting(self.subspace))(_as_numbers(cube))
            values = np.where(np.isnan(projected), cube.values, projected)
        if self._exact:
            out = None if into is None else into.values
            cube = replace(cube, values=round_values(values, out=out))
        return mark_glare_in(cube)

    def _block(self, start: int, stop: int, into: Cube | None = None) -> Cube:
        return self.calibrated(self._raw(start, stop), into=into)

    def _raw(self, start: int, stop: int) -> np.ndarray:
        raw = self.opened.read_lines(start, stop, turned=False)
        return self.bench.checked(raw, self.bench.sensor.object[0])

    @property
    def _exact(self) -> bool:
        """Whether values are rounded when noise is taken away, and not before."""
        return bool(self.bench.camera.denoise)

    def _flat(self, raw: np.ndarray, into: Cube | None = None) -> Cube:
        from levkas.building.developing import cube_of, flatten
        from levkas.calibration.templates import average

        if raw.dtype in (np.uint8, np.uint16):
            made = self.field.develop(
                raw,
                saturation=self.bench.saturation,
                threads=count_threads(),
                exact=self._exact,
                out=None if into is None else (into.values, into.flags, into.sigma),
            )
            return Cube(*made, self.bands, self.quantity)
        flat = flatten(
            self.bench,
            _with_gaps(average(iter([raw]), saturation=self.bench.saturation)),
            [self.dark] if self.dark else [],
            self.white,
            white_reflectance=self.reflectance,
            noise=self.noise,
            labels=[band.label for band in self.bands],
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


def _as_numbers(cube: Cube) -> np.ndarray:
    """Return the values, NaN where there is none: `developing.cube_of` writes 0 there."""
    return np.where(cube.flags & np.uint8(Flag.OUTSIDE), np.float32(np.nan), cube.values)


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
        templates = gaps_of(self._scan.dark, self._scan.white)
        for raw in self._scan.raw_blocks():
            lost = np.zeros((1, 1, 1), bool) if raw.dtype.kind in "ui" else ~np.isfinite(raw)
            if templates is not None:
                lost = lost | templates
            if lost.any():
                self._lost += np.broadcast_to(lost, raw.shape).sum((0, 1))
            yield self._scan.calibrated(raw, self._projecting)
        self._tell()

    def _tell(self) -> None:
        from levkas.building.developing import placed

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


def _with_gaps(shot: Template) -> Template:
    """Mark what is no number; unlike `gaps.close_gaps`, the same for any lines around it."""
    lost = ~np.isfinite(shot.mean)
    if not lost.any():
        return shot
    return replace(
        shot,
        mean=np.where(lost, np.float32(0), shot.mean),
        saturated=shot.saturated & ~lost,
        black=shot.black & ~lost,
        lost=lost,
    )


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


def open_scan(capture: Capture, campaign: Campaign, shelf: Any) -> Scan:
    """Average the templates of a line scan; no line of the object is read.

    Raises Refused as `developing.develop` does.
    """
    from levkas.building.developing import Bench, doubts_of, line_noise
    from levkas.building.measuring import note_light
    from levkas.building.whiteboard import white_reflectance
    from levkas.calibration.scanning import average_lines
    from levkas.readers.envi import open_envi
    from levkas.readers.frames import read_facts

    sensor = capture.sensors[0]
    facts = read_facts(sensor.object[0].path)
    bench = Bench(campaign, campaign.cameras[capture.camera], sensor, facts, shelf)

    def template(frames: Any) -> Template | None:
        if not frames:
            return None
        blocks = (bench.checked(block, frame) for frame in frames for block in _line_blocks(frame))
        return bench.whole(average_lines(blocks, saturation=bench.saturation), frames)

    dark, white = template(sensor.dark), template(sensor.white)
    note_light(bench.told, white, [dark] if dark else [], None, [b.label for b in sensor.bands])
    where = f"{capture.object}/{capture.layer}"
    return Scan(
        open_envi(sensor.object[0].path),
        bench,
        dark,
        white,
        line_noise(bench, dark, white),
        white_reflectance(campaign, sensor.bands),
        where,
        facts.captured,
        tuple(f"{where}: {doubt}" for doubt in doubts_of(bench)),
        {sensor.name: sensor.align},
    )


def rows_of(cube: Cube, start: int, stop: int) -> Cube:
    """Return rows `start` to `stop` of a cube, in its memory."""
    rows = slice(start, stop)
    sigma = None if cube.sigma is None else cube.sigma[rows]
    return replace(cube, values=cube.values[rows], flags=cube.flags[rows], sigma=sigma)


def lines_at_once(shape: tuple[int, int, int]) -> int:
    """Return how many lines of a scan, (lines, samples, bands), are calibrated at a time."""
    lines, samples, bands = shape
    return tile_rows(BLOCK_SAMPLES // (samples * bands), lines)


def _line_blocks(frame: Any) -> Iterator[np.ndarray]:
    from levkas.building.developing import read_cube
    from levkas.readers.envi import open_envi
    from levkas.readers.frames import read_facts

    if read_facts(frame.path).kind != "envi":
        yield read_cube(frame)
        return
    opened = open_envi(frame.path)
    lines, samples, bands = opened.facts.shape
    step = lines_at_once((lines, samples, bands))
    for start in range(0, lines, step):
        yield opened.read_lines(start, min(start + step, lines))

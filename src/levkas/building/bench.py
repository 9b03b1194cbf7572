"""What holds for every frame of one sensor: how it is read, averaged, checked and doubted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.building.codes import check_codes, doubt_codes, spread, thin_rows
from levkas.building.exposure_times import times_of
from levkas.calibration.invalid_values import close_gaps
from levkas.calibration.templates import CalibrationRefused, Template, average
from levkas.core.problems import Problem
from levkas.readers.frames import Facts, read_facts, read_frame

if TYPE_CHECKING:
    from levkas.building.shelf import Shelf
    from levkas.campaign.campaign import Camera, Campaign
    from levkas.campaign.discovery.captures import FrameRef, SensorFrames

GLIMPSE_LINES = 64


@dataclass(frozen=True)
class Bench:
    """What holds for every frame of one sensor."""

    campaign: Campaign
    camera: Camera
    sensor: SensorFrames
    facts: Facts
    shelf: Shelf
    told: dict[str, Any] = field(default_factory=dict)
    """What is learnt of sensor and light on the way, for the reports."""

    @property
    def saturation(self) -> float | None:
        """Code at which a sensel is full: declared, the file's own, or the full scale of `bits`."""
        declared = self.camera.saturation or self.facts.saturation
        if declared:
            return float(declared)
        bits = self.camera.bits or (
            self.facts.bits if np.dtype(self.facts.dtype).kind == "u" else None
        )
        return float(2**bits - 1) if bits else None

    @property
    def unmended(self) -> bool:
        """Whether defects are left out instead of replaced from their neighbours."""
        return self.camera.kind == "cube"

    @property
    def black(self) -> float | None:
        """Declared, else the file's own black level, counts; None where nobody says."""
        return self.camera.black if self.camera.black is not None else self.facts.black

    @cached_property
    def step(self) -> float:
        """Counts from one code of the files to the next: 16 where 12 bits stand at the upper end of 16."""
        from levkas.quality.emva1288.code_spacing import find_step

        few = 1 if self.facts.kind == "raw" else 2
        frames = [*spread(self.sensor.object, few), *spread(self.sensor.white, few)]
        return find_step(thin_rows(_glimpse(frame)) for frame in frames)

    def average(self, frames: Sequence[FrameRef], *, kept: bool = False) -> Template:
        """Average shots of one exposure; templates are kept for the other objects."""
        exposure = exposure_of(frames[0])

        def make() -> Template:
            try:
                return average(self.read(frames), saturation=self.saturation, exposure_s=exposure)
            except CalibrationRefused as refused:
                raise type(refused)(*(placed(p, frames) for p in refused.problems)) from None

        if not kept:
            return self.whole(make(), frames)
        made = self.shelf.template(
            frames, make, saturation=self.saturation, exposure=exposure, bits=self.camera.bits
        )
        return self.whole(made, frames)

    def read(self, frames: Iterable[FrameRef]) -> Iterator[np.ndarray]:
        """Read frame by frame, codes checked against the bits that are declared."""
        for frame in frames:
            yield self.checked(read_frame(frame.path, page=frame.page), frame)

    def checked(self, values: np.ndarray, frame: FrameRef) -> np.ndarray:
        """Return a frame's values; raises CalibrationRefused where `bits` does not hold."""
        if self.camera.bits is not None:
            full = self.camera.saturation or self.facts.saturation
            check_codes(values, frame.path, self.camera.name, self.camera.bits, full)
        return values

    def whole(self, template: Template, frames: Sequence[FrameRef]) -> Template:
        """Return a template whose every value is a number, what was none marked as lost."""
        try:
            return close_gaps(template)
        except CalibrationRefused as refused:
            raise CalibrationRefused(*(placed(p, frames) for p in refused.problems)) from None

    def templates(self, frames: Sequence[FrameRef]) -> list[Template]:
        """Average frames exposure by exposure, shortest first."""
        times = sorted({exposure_of(f) for f in frames}, key=lambda t: (t is not None, t or 0.0))
        return [self.average([f for f in frames if exposure_of(f) == t], kept=True) for t in times]


def exposure_of(frame: FrameRef) -> float | None:
    """Exposure from the file's name or the manifest, else from its EXIF or header, s; None of a list by bands."""
    times = times_of(frame)
    return None if isinstance(times, tuple) else times


def read_cube(frame: FrameRef) -> np.ndarray:
    """Read (lines, samples, bands): ENVI, or a TIFF whose pages are the bands."""
    pages = read_facts(frame.path).pages
    if pages > 1:
        planes = [read_frame(frame.path, page=page) for page in range(pages)]
        return np.ascontiguousarray(np.stack(planes, axis=-1))
    values = read_frame(frame.path)
    return values if values.ndim == 3 else values[..., None]


def placed(problem: Problem, frames: Sequence[FrameRef]) -> Problem:
    """Name the folder of the frames where the kernels, which know no files, could not."""
    names = ", ".join(f.path.name for f in frames[:3]) + (" …" if len(frames) > 3 else "")
    return problem if problem.file else replace(problem, file=f"{frames[0].path.parent}: {names}")


def doubts_of(bench: Bench) -> list[str]:
    """What a person should know before believing the values."""
    camera = bench.camera
    doubts = _doubt_bits(bench)
    targets = bench.campaign.targets
    if camera.kind == "image":
        return doubts
    if not bench.sensor.white:
        doubts.append("no white reference is declared: the cube stays in counts")
    elif targets.white and not isinstance(targets.white.reflectance, str):
        given = targets.white.reflectance
        doubts.append(
            f"the white board is taken for {1.0 if given is None else given:g} at every wavelength; "
            "a CSV of its spectrum in targets.white.reflectance is better"
        )
    return doubts


def _doubt_bits(bench: Bench) -> list[str]:
    """Whether a few frames, whites above all, look like 8 bits where more are declared."""
    bits, full = bench.camera.bits, bench.saturation
    if bits is None or bits <= 8 or full is None or bench.facts.kind == "raw":
        return []
    frames = [*spread(bench.sensor.object, 3), *spread(bench.sensor.white, 3)]
    return [f"{bench.camera.name}: {d}" for d in doubt_codes(map(_glimpse, frames), bits, full)]


def _glimpse(frame: FrameRef) -> np.ndarray:
    """Read a frame; of a line scan some lines in its middle."""
    if read_facts(frame.path).kind != "envi":
        return read_frame(frame.path, page=frame.page)
    from levkas.readers.envi import open_envi

    scan = open_envi(frame.path)
    middle, half = scan.facts.shape[0] // 2, GLIMPSE_LINES // 2
    return scan.read_lines(max(0, middle - half), min(scan.facts.shape[0], middle + half + 1))

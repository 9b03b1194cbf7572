"""What holds for every frame of one sensor: how it is read, averaged, checked and doubted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property, partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from levkas.calibration.agreement import Aligned, check_alike, facts_of
from levkas.calibration.clipped_darks import MANY_ZEROS, black_clip_of, is_clipped, unclip
from levkas.calibration.code_checks import FEW_CODES, check_codes, thin_rows
from levkas.calibration.code_spacing import find_alignment, find_step
from levkas.calibration.darks import level_under
from levkas.calibration.differing_shots import require_agreement
from levkas.calibration.drift import average_steady
from levkas.calibration.full_scale import (
    FullScale,
    SceneShots,
    find_full_scale,
    level_of_a_quiet_white,
    stated_full_scale,
)
from levkas.calibration.linearity import (
    ALIKE,
    CURVED,
    PERIOD,
    Point,
    check_linearity,
    find_bend,
    find_points,
)
from levkas.calibration.patterns import thin_periods
from levkas.calibration.templates import CalibrationRefused, Template, as_absent, close_gaps
from levkas.core.problems import Problem
from levkas.core.threads import made_ahead
from levkas.readers.compared_facts import SCALE
from levkas.readers.frames import Facts, read_facts, read_frame, read_plane, read_sample

if TYPE_CHECKING:
    from levkas.calibration.chart_light import ChartLight
    from levkas.campaign.campaign import Camera, Campaign
    from levkas.campaign.discovery.captures import FrameRef, SensorFrames

GLIMPSE_LINES, FEW_PIXELS = 64, 1000
MOST_GLIMPSED = 2
"""Frames of a role of which some rows are looked at."""
SHOTS = 4
"""Of a dark that was clipped: what they show of noise and fixed pattern suffices."""
CLIPPED_DARKS, FULL_SCALE, BEND, STRAIGHTNESS = (
    "clipped_darks",
    "full_scale",
    "bend",
    "straightness",
)
QUIET_WHITE, SENSOR, OFFSET, WHITE_SHOTS = "quiet_white", "sensor", "offset", "white_shots"
UNLIKE_NOISE = "unlike_noise"
"""Names, among what is measured of a sensor, of darks that were clipped, the code at which it is full, its bend and how straight it is, a white
without shot noise, gain and noise, the counts that its exposure series have without light, shots of a white that differ, and
the variance of bands whose noise is not that of the others, over that."""
BLACK, BLACK_ERROR = "black", 0.5
"""Name, among the same, of a black level by an exposure series; and its standard error, counts, at most: a quarter of a small read noise."""
SERIES = 3
"""Bands of a tunable filter whose exposure series show the sensor's curve: it is the same sensor."""
SAMPLED, PERIODS = 1 << 18, 20
"""Values of a frame by which the full scale is looked for, and rows that are taken together: whole mosaics' of up to 5."""


class Averages(Protocol):
    """Templates that are kept from one average to the next, as `stages.template_cache` does."""

    def template(
        self,
        frames: Sequence[FrameRef],
        average: Callable[[], Template],
        *,
        level: np.ndarray | float | None,
        **parameters: object,
    ) -> Template:
        """Return the template of some frames above a level, as it is kept or by `average`."""


@dataclass(frozen=True)
class SensorContext:
    """What holds for every frame of one sensor."""

    campaign: Campaign
    camera: Camera
    sensor: SensorFrames
    facts: Facts
    cache: Averages | None
    measured: dict[str, Any] = field(default_factory=dict)
    """What is measured of sensor and light on the way, for the reports."""
    light: ChartLight | None = None
    """By a chart, in place of a white."""
    reflectance: float | np.ndarray = 1.0
    """Of the white board, one number or one a band of the sensor."""
    doubts: tuple[str, ...] = ()
    """Of that reflectance."""
    _glimpses: dict[str, list[np.ndarray]] = field(default_factory=dict, repr=False)

    @cached_property
    def saturation(self) -> float | None:
        """Code at which a sensel is full: where its frames pile up, at most what is declared."""
        found, stated = self._measured_full_scale(), self.stated
        if found is None:
            return stated.counts if stated else None
        record = {"counts": found.counts, "source": found.source}
        self.measured[FULL_SCALE] = {**record, "stated": stated.source if stated else None}
        return found.counts

    @property
    def stated(self) -> FullScale | None:
        """Full scale that campaign or file state."""
        camera = self.camera
        return stated_full_scale(self.facts, saturation=camera.saturation, bits=camera.bits)

    def _measured_full_scale(self) -> FullScale | None:
        """Return the full scale by the frames of object and white, where it lies below what is declared."""
        if not self.camera.traits.is_calibrated or np.dtype(self.facts.dtype).kind != "u":
            return None
        lit, darks = self._sampled()
        found = find_full_scale(lit, darks, period=self.period[1])
        stated = self.stated
        if found is None and (quiet := level_of_a_quiet_white(lit, darks, period=self.period[1])):
            self.measured[QUIET_WHITE] = quiet
        return found if found and (stated is None or found.counts < stated.counts) else None

    def _sampled(self) -> tuple[list[SceneShots], list[np.ndarray]]:
        """Return samples of the scenes and of the darks."""
        sensor = self.sensor
        strips = self.camera.traits.is_scanned
        lit = [
            SceneShots([*map(_sample, some)], role == "white")
            for role, frames in (("object", sensor.object), ("white", sensor.white))
            for some in ([[f] for f in frames] if strips else _repeats(frames))
        ]
        return lit, [_sample(some[0]) for some in _repeats(sensor.dark)[:SHOTS]]

    @property
    def unmended(self) -> bool:
        """Whether defects are left out instead of replaced from their neighbours."""
        return self.camera.traits.is_scanned

    @property
    def period(self) -> tuple[int, int]:
        """Rows and columns of the mosaic's pattern."""
        pattern = self.sensor.pattern
        return (len(pattern), len(pattern[0])) if pattern else (1, 1)

    @cached_property
    def black(self) -> float | None:
        """Declared, else the file's own black level, the mean over the frame, else that of an exposure series if it is needed, counts; None if not known."""
        stated = self._stated_black
        return self._black_of_series() if stated is None else stated

    @property
    def _stated_black(self) -> float | None:
        return self.camera.black if self.camera.black is not None else self.facts.black

    def _black_of_series(self) -> float | None:
        """Return the counts at no time at all by which exposures of a scene lie on a line, where darks are of one other time."""
        sensor, full = self.sensor, self.saturation
        darks = {times_of(frame) for frame in sensor.dark}
        lit = {times_of(frame) for frame in (*sensor.object, *sensor.white)}
        if len(darks) != 1 or full is None or lit <= darks or self.camera.traits.is_scanned:
            return None
        for shots, under in self._series():
            found = check_linearity(shots, saturation=full, fit_offset=True, period=PERIOD)
            highest = float(np.median(under[0].mean)) if under else 0.0
            sure = found.rms <= CURVED and found.offset_error <= BLACK_ERROR
            if len(shots) > 2 and sure and found.offset <= highest + 3 * BLACK_ERROR:
                self.measured[BLACK] = {"counts": found.offset, "error": found.offset_error}
                return found.offset
        return None

    @cached_property
    def black_level(self) -> float | np.ndarray | None:
        """Black as it is subtracted, counts: of every sensel, (h, w), where the file has no single number."""
        if self.camera.black is None and self.facts.blacks is not None:
            return self.facts.blacks.plane(self.facts.shape)
        return self.black

    @cached_property
    def holds_reflectance(self) -> bool:
        """Whether the object's files state their reflectance, and nothing else is there to make it."""
        frames = (*self.sensor.white, *self.sensor.chart, *self.sensor.dark)
        if not self.camera.traits.is_calibrated or frames or SCALE in self.camera.overrule:
            return False
        return all(read_facts(frame.path).reflectance_scale for frame in self.sensor.object)

    def unit_of(self, frame: FrameRef) -> tuple[float, ...] | None:
        """Return the value of reflectance 1.0 in every band of a frame of the object; None of counts."""
        return facts_of(frame).reflectance_scale if self.holds_reflectance else None

    @cached_property
    def black_clip(self) -> float | None:
        """Code at which a value is clipped at black; None of reflectance, and of frames whose noise goes below 0: of their darks, else of the object."""
        if self.holds_reflectance:
            return None
        if np.dtype(self.facts.dtype).kind == "u":
            return 0.0
        return black_clip_of(self.glimpses("dark") or self.glimpses("object"))

    @cached_property
    def step(self) -> float:
        """Counts from one code of the files to the next: 16 where 12 bits stand at the upper end of 16."""
        return find_step([*self.glimpses("object"), *self.glimpses("white")])

    def glimpses(self, role: str) -> list[np.ndarray]:
        """Return rows of the first and the last frame of a role, of a camera raw of the first."""
        if role not in self._glimpses:
            most = 1 if self.facts.kind == "raw" else MOST_GLIMPSED
            frames = spread(getattr(self.sensor, role), most)
            self._glimpses[role] = [thin_rows(glimpse(frame)).copy() for frame in frames]
        return self._glimpses[role]

    @cached_property
    def alignments(self) -> list[Aligned]:
        """Where the codes of some frames stand in their words.

        Nothing of one frame, and of camera raws, which LibRaw aligns.
        """
        sensor, facts = self.sensor, self.facts
        single = len((*sensor.object, *sensor.white, *sensor.chart, *sensor.dark)) < 2
        if single or facts.kind == "raw":
            return []
        found = []
        for role in ("object", "white", "chart", "dark"):
            frames = spread(getattr(sensor, role), MOST_GLIMPSED)
            for frame, values in zip(frames, self.glimpses(role), strict=True):
                one = find_alignment([values])
                if one is not None:
                    found.append(Aligned(role, frame.path, one))
        return found

    def note_bend(self) -> None:
        """Note in `measured` how straight the sensor is, and its counts without light, by the exposure series of objects and whites."""
        if self.camera.traits.bands_in == "file" or self.saturation is None:
            return
        points: list[Point] = []
        hidden = False
        levels = [self.black or 0.0]
        for which, (shots, darks) in enumerate(self._series()):
            # The level of such darks is fitted to the series itself.
            hidden |= bool(darks) and all(np.mean(dark.black) > 0.5 for dark in darks)
            found = find_points(
                *(shots, darks),
                saturation=self.saturation,
                black=self.black,
                period=self.period if self.sensor.pattern else PERIOD,
                contrast=ALIKE,
            )
            first = points[-1].group + 1 if points else 0
            points += [p._replace(group=p.group + first, series=which) for p in found]
            levels += [float(np.median(dark.mean)) for dark in darks[:1]]
        bend = find_bend(points, self.saturation - levels[-1])
        if abs(bend.offset) > BLACK_ERROR and not hidden:
            self.measured[OFFSET] = {"counts": bend.offset, "error": bend.offset_error}
        if bend.is_sure:
            self.measured[BEND] = bend.size
        if np.isfinite(bend.error):
            self.measured[STRAIGHTNESS] = float(f"{np.hypot(bend.size, bend.error):.3g}")

    def _series(self) -> Iterator[tuple[list[Template], list[Template]]]:
        """Yield exposures of some scenes that have several, with their darks."""
        sensor = self.sensor
        for frames in (sensor.object, sensor.white):
            bands: dict[str | None, list[FrameRef]] = {}
            for frame in frames:
                bands.setdefault(frame.band, []).append(frame)
            several = [
                band
                for band, some in bands.items()
                if len({exposure_of(f) for f in some} - {None}) > 1
            ]
            for band in spread(several, SERIES):
                own = [f for f in sensor.dark if f.band == band]
                darks = self.templates(own or [f for f in sensor.dark if f.band is None])
                groups = [g for time, g in by_exposure(bands[band]) if isinstance(time, float)]
                level = darks[0].mean if darks else self._stated_black or 0.0
                shots = [self.whole(self._averaged(group, level), group) for group in groups]
                if len({template.mean.shape for template in (*shots, *darks)}) == 1:
                    yield shots, darks

    def with_full_scale(self, problem: Problem) -> Problem:
        """Return the refusal of a saturated white with the counts at which the sensor is full."""
        if problem.code != "E_WHITE_SATURATED" or self.saturation is None:
            return problem
        return replace(problem, found=f"{problem.found} at {self.saturation:g} counts or more")

    def average(
        self, frames: Sequence[FrameRef], darks: Sequence[Template] = (), *, kept: bool = False
    ) -> Template:
        """Average shots of one exposure above their `darks`; templates are kept for the other objects.

        A dark that was clipped at black comes as if it had not been, where enough of it is above.
        """
        dark = frames[0] in self.sensor.dark
        level = self.level_under(frames, darks) if dark or len(frames) > 1 else 0.0
        make = partial(self._dark, frames) if dark else partial(self._averaged, frames, level)
        if not kept or self.cache is None:
            template = make()
        else:
            template = self.cache.template(
                frames,
                make,
                saturation=self.saturation,
                exposure=exposure_of(frames[0]),
                bits=self.camera.bits,
                overrule=self.camera.overrule,
                level=level,
                black_clip=self.black_clip,
                **({"dark": (self.step, self.period)} if dark else {}),
            )
        with placing(frames):
            require_agreement(template.shots, [str(frame.path) for frame in frames])
        self.note_white(template, frames)
        return self.whole(template, frames)

    def note_white(self, white: Template, frames: Sequence[FrameRef]) -> None:
        """Note by how much parts of the shots of a white differ, in `measured`."""
        if frames[0] in self.sensor.white and white.shots is not None and white.shots.apart:
            self.measured.setdefault(WHITE_SHOTS, {})[frames[0].band or ""] = white.shots.apart

    def _dark(self, frames: Sequence[FrameRef]) -> Template:
        return self.unclipped(self._averaged(frames, None), islice(self.read(frames), SHOTS))

    def unclipped(self, dark: Template, shots: Iterable[np.ndarray]) -> Template:
        """Return a dark as if it had not been clipped, by some of its shots; as it is where these do not show it."""
        if np.mean(dark.black) <= MANY_ZEROS:
            return dark
        try:
            return unclip(dark, [*shots], period=self.period, step=self.step or 1.0)
        except CalibrationRefused:
            return dark

    def _averaged(self, frames: Sequence[FrameRef], level: np.ndarray | float | None) -> Template:
        try:
            return average_steady(
                lambda: made_ahead(self.read(frames)),
                level,
                period=self.period,
                saturation=self.saturation,
                black_clip=self.black_clip,
                exposure_s=exposure_of(frames[0]),
                times_s=capture_times(frames),
                white=frames[0] in self.sensor.white,
            )
        except CalibrationRefused as refused:
            raise type(refused)(*(placed(p, frames) for p in refused.problems)) from None

    def level_under(
        self, frames: Sequence[FrameRef], darks: Sequence[Template]
    ) -> np.ndarray | float | None:
        """Return counts without light of frames of one exposure; None where they are darks themselves."""
        if frames[0] in self.sensor.dark:
            return None
        if not darks:
            return 0.0 if self.black_level is None else self.black_level
        try:
            return level_under(timed(darks[0], times_of(frames[0])), darks, black=self.black_level)
        except CalibrationRefused:  # as whoever subtracts it will find
            return darks[0].mean

    def read(self, frames: Iterable[FrameRef]) -> Iterator[np.ndarray]:
        """Read frame by frame, codes checked against the bits that are declared, and against the other frames."""
        for frame in frames:
            values = self.checked(self.frame(frame), frame)
            if frame in self.sensor.object and self.camera.traits.is_calibrated:
                self._require_variety(values, frame)
            first = self.facts, self.sensor.object[0].path
            rows = thin_rows(values, FEW_CODES)
            check_alike(self.camera, first, self.alignments, rows, frame.path)
            yield values

    def _require_variety(self, values: np.ndarray, frame: FrameRef) -> None:
        """Refuse a frame of an object that holds one code, neither black nor full: no sensor gives that."""
        code, full = values.flat[0], np.inf if self.saturation is None else self.saturation
        if values.dtype.kind not in "ui" or not 0 < code < full or values.size < FEW_PIXELS:
            return
        if np.all(values[0] == code) and np.all(values == code):
            problem = Problem(
                "E_CONSTANT",
                f"{self.camera.name}: the frame holds one value",
                str(frame.path),
                found=f"{code} in every pixel",
                expected="what a sensor recorded, with its noise",
                fix="The frame was damaged or exported empty: copy or export it again, or remove it from the campaign.",
            )
            raise CalibrationRefused(problem)

    def frame(self, frame: FrameRef) -> np.ndarray:
        """Read a frame as it is stored; of a mosaic, or of a band in a file of its own, one sample a pixel."""
        planes = self.camera.traits.bands_in == "files" or self.sensor.pattern is not None
        return (read_plane if planes else read_frame)(frame.path, page=frame.page)

    def checked(self, values: np.ndarray, frame: FrameRef) -> np.ndarray:
        """Return a frame's values; raises CalibrationRefused where `bits` does not hold."""
        if self.camera.bits is not None:
            full = self.camera.saturation or self.facts.saturation
            check_codes(values, frame.path, self.camera.name, self.camera.bits, full)
        return values

    def whole(self, template: Template, frames: Sequence[FrameRef]) -> Template:
        """Return a template whose every value is a number, what was none marked as lost, or as absent."""
        try:
            closed = close_gaps(template)
        except CalibrationRefused as refused:
            raise CalibrationRefused(*(placed(p, frames) for p in refused.problems)) from None
        return as_absent(closed) if read_facts(frames[0].path).nodata is not None else closed

    def templates(
        self, frames: Sequence[FrameRef], darks: Sequence[Template] = ()
    ) -> list[Template]:
        """Average frames exposure by exposure, shortest first, above their `darks`."""
        times = sorted({exposure_of(f) for f in frames}, key=lambda t: (t is not None, t or 0.0))
        return [
            self.average([f for f in frames if exposure_of(f) == t], darks, kept=True)
            for t in times
        ]

    def darks(self, frames: Sequence[FrameRef]) -> list[Template]:
        """Average darks exposure by exposure, shortest first, and note those that were clipped."""
        averaged = self.templates(frames)
        for dark in averaged:
            self.note_dark(dark, frames[0].band or "")
        return averaged

    def note_dark(self, dark: Template, band: str = "") -> None:
        """Note black and noise of a dark that was clipped, or that they cannot be had, in `measured`."""
        name = f"{band} {f'{dark.exposure_s:g} s' if dark.exposure_s else ''}".strip()
        if dark.fit is not None:
            blacks = [round(black, 4) for black in dark.fit.blacks]
            found = {"black": blacks, "noise": dark.fit.noise, "zeros": dark.fit.zeros}
            self.measured.setdefault(CLIPPED_DARKS, {})[name] = found
        elif np.mean(dark.black) > MANY_ZEROS and (
            is_clipped(dark.mean) or np.median(dark.mean) < (self.step or 1.0) / 2
        ):
            self.measured.setdefault(CLIPPED_DARKS, {})[name] = {
                "zeros": float(np.mean(dark.black))
            }


def exposure_of(frame: FrameRef) -> float | None:
    """Exposure from the file's name or the manifest, else from its EXIF or header, s; None of a list by bands."""
    times = times_of(frame)
    return None if isinstance(times, tuple) else times


def capture_times(frames: Sequence[FrameRef]) -> tuple[float, ...] | None:
    """Return when frames were captured, s since 1970, by their files; None where one does not state it."""
    moments = []
    for frame in frames:
        try:
            moment = datetime.fromisoformat(read_facts(frame.path).captured or "")
        except ValueError:
            return None
        moments.append(moment if moment.tzinfo else moment.replace(tzinfo=UTC))
    return tuple(moment.timestamp() for moment in moments)


def read_cube(frame: FrameRef) -> np.ndarray:
    """Read (lines, samples, bands), bands in the object's order: ENVI, or a TIFF whose pages are the bands."""
    pages = read_facts(frame.path).pages
    if pages > 1:
        order = frame.order or range(pages)
        planes = [read_frame(frame.path, page=page) for page in order]
        return np.ascontiguousarray(np.stack(planes, axis=-1))
    values = read_frame(frame.path)
    values = values if values.ndim == 3 else values[..., None]
    return np.take(values, frame.order, axis=-1) if frame.order else values


def placed(problem: Problem, frames: Sequence[FrameRef]) -> Problem:
    """Name the file, or the folder of several frames, where the kernels, which know no files, could not."""
    if len(frames) == 1:
        return problem if problem.file else replace(problem, file=str(frames[0].path))
    names = ", ".join(f.path.name for f in frames[:3]) + (" …" if len(frames) > 3 else "")
    return problem if problem.file else replace(problem, file=f"{frames[0].path.parent}: {names}")


@contextmanager
def placing(frames: Sequence[FrameRef]) -> Iterator[None]:
    """Name the folder of the frames in the refusals of kernels, which know no files."""
    try:
        yield
    except CalibrationRefused as refused:
        raise type(refused)(*(placed(p, frames) for p in refused.problems)) from None


def _repeats(frames: Sequence[FrameRef]) -> list[list[FrameRef]]:
    """Return two shots of each scene, band and exposure, where there are as many."""
    groups: dict[object, list[FrameRef]] = {}
    for frame in frames:
        groups.setdefault((frame.band, frame.page, times_of(frame)), []).append(frame)
    return [group[:2] for group in groups.values()]


def _sample(frame: FrameRef) -> np.ndarray:
    """Read a frame; of it, or of a line scan, lines evenly over all, about `SAMPLED` values."""
    facts = read_facts(frame.path)
    if facts.kind != "envi":
        if facts.pages == 1:
            return read_sample(frame.path, most=SAMPLED)
        whole = read_cube(frame) if frame.page is None else read_frame(frame.path, page=frame.page)
        return thin_periods(whole, PERIODS, SAMPLED)
    from levkas.readers.envi import open_envi

    scan = open_envi(frame.path)
    lines, samples, bands = scan.facts.shape
    count = max(1, min(lines, SAMPLED // (samples * bands)))
    places = np.linspace(0, lines - 1, count).round().astype(int).tolist()
    return np.concatenate([scan.read_lines(y, y + 1) for y in dict.fromkeys(places)])


def glimpse(frame: FrameRef) -> np.ndarray:
    """Read a frame, of a line scan some lines in its middle; where samples may hold nothing the others, in a row."""
    facts = read_facts(frame.path)
    if facts.kind != "envi":
        values = read_frame(frame.path, page=frame.page)
    else:
        from levkas.readers.envi import open_envi

        scan = open_envi(frame.path)
        middle, half = scan.facts.shape[0] // 2, GLIMPSE_LINES // 2
        stop = min(scan.facts.shape[0], middle + half + 1)
        values = scan.read_lines(max(0, middle - half), stop)
    return values if facts.nodata is None else values[np.isfinite(values)].astype(facts.dtype)


def spread(items: Sequence, count: int) -> list:
    """Return up to `count` items spread over a sequence, none twice.

    >>> spread("abcdefg", 3)
    ['a', 'd', 'g']
    """
    last = len(items) - 1
    places = {round(i * last / max(count - 1, 1)) for i in range(count)} if items else set()
    return [items[place] for place in sorted(places)]


Times = float | tuple[float, ...] | None
"""Of a frame, s: one, one a band where a header lists several, or not known."""
NAMED = 3
"""Frames that a message names."""


def times_of(frame: FrameRef) -> Times:
    """Return the exposure that the name or the manifest states, else EXIF or the header of the file."""
    if frame.exposure_s is not None:
        return frame.exposure_s
    facts = facts_of(frame)
    if facts.kind == "raw" and facts.exposure_s is None:
        facts = read_facts(frame.path)
    return facts.band_times_s or facts.exposure_s


def by_exposure(frames: Sequence[FrameRef]) -> list[tuple[Times, list[FrameRef]]]:
    """Group frames of equal exposure, shortest first."""
    groups: dict[Times, list[FrameRef]] = {}
    for frame in frames:
        groups.setdefault(times_of(frame), []).append(frame)
    return sorted(groups.items(), key=lambda item: listed(item[0]))


def timed(template: Template, times: Times) -> Template:
    """Return a template with its exposure."""
    if isinstance(times, tuple):
        return replace(template, exposure_s=None, band_times_s=times)
    return replace(template, exposure_s=times)


def times_in(template: Template) -> Times:
    """Return the exposure of a template."""
    return template.band_times_s or template.exposure_s


def templates_by_exposure(
    frames: Sequence[FrameRef], make: Callable[[list[FrameRef]], Template]
) -> list[Template]:
    """Average frames exposure by exposure, shortest first."""
    return [timed(make(group), times) for times, group in by_exposure(frames)]


def listed(times: Times) -> tuple[float, ...]:
    """Return the exposures of a frame, s; none where it is not known."""
    if times is None:
        return ()
    return times if isinstance(times, tuple) else (times,)

"""One sensor in one capture: its frames, each decoded once, and what their summaries say of all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from levkas.calibration.agreement import Aligned, facts_of
from levkas.calibration.clipped_darks import MANY_ZEROS, black_clip_of, is_clipped, unclip
from levkas.calibration.codes import (
    FullScale,
    SceneShots,
    doubt_codes,
    find_full_scale,
    find_step,
    level_of_a_quiet_white,
    stated_full_scale,
)
from levkas.calibration.darks import level_under
from levkas.calibration.exposures import find_black
from levkas.calibration.findings import Finding, refusal
from levkas.calibration.lamp import average_steady, require_agreement
from levkas.calibration.record import ClippedDark, FullScaleRecord, SensorRecord
from levkas.calibration.summary import SAMPLED, Summary, summarise, summarise_lines
from levkas.calibration.templates import CalibrationRefused, Template, as_absent, close_gaps
from levkas.core.problems import Problem, Refused, gathered
from levkas.core.threads import each, made_ahead
from levkas.readers.compared_facts import SCALE
from levkas.readers.frames import (
    Facts,
    UnreadableCapture,
    read_facts,
    read_frame,
    read_headers,
    read_plane,
)

if TYPE_CHECKING:
    from levkas.calibration.chart_light import ChartLight
    from levkas.campaign.campaign import Camera
    from levkas.campaign.discovery.captures import FrameRef, SensorFrames
    from levkas.core.cube import Cube

HELD, MIDDLE = 1 << 30, 64
"""Bytes of decoded frames that are held until they are averaged; more are decoded twice (33 bands of 1.4 Mpx, with whites, have 0.2 GB).
Neighbouring lines of a scan of which the codes are looked at."""
FEW_PIXELS, SHOTS, SERIES, MOST_PROBLEMS = 1000, 4, 3, 50
"""A smaller frame may hold one code by chance; shots of a clipped dark that show its noise and pattern; bands of a tunable filter whose
exposure series show black and curve of the sensor, which is the same; unreadable files that are named."""
ROLES = ("object", "white", "chart", "dark")
Times = float | tuple[float, ...] | None
"""Exposure of a frame, s: one, one a band where a header lists several, or not known."""


class Kept(Protocol):
    """Templates and summaries that are kept from one capture to the next, by `stages.template_cache`, or made."""

    def template(
        self, frames: Sequence[FrameRef], average: Callable[[], Template], **parameters: object
    ) -> Template: ...

    def summary(self, frame: FrameRef, make: Callable[[], Summary]) -> Summary: ...


class Frames:
    """Decoded frames of a sensor: each leaves its summary, and its values until it is averaged, as far as `HELD` reaches."""

    def __init__(self, camera: Camera, sensor: SensorFrames, kept: Kept | None) -> None:
        planes = camera.traits.bands_in == "files" or sensor.pattern is not None
        self._one = read_plane if planes else read_frame
        self._scanned, self._kept, self._own = camera.traits.is_scanned, kept, {*sensor.object}
        self._values: dict[FrameRef, np.ndarray] = {}
        self._bytes = 0

    def decode(self, frame: FrameRef) -> np.ndarray:
        """Return a frame as it is stored; of a mosaic, or of a band in a file of its own, one sample a pixel."""
        if frame in self._values:
            return self._values[frame]
        if self._scanned:
            return read_cube(frame)
        return self._one(frame.path, page=frame.page)

    def summary(self, frame: FrameRef) -> Summary:
        """Decode a frame for its summary, or take that which is kept."""
        make = partial(self._summarise, frame)
        alone = self._kept is None or frame in self._own
        return make() if alone else self._kept.summary(frame, make)  # type: ignore[union-attr]

    def _summarise(self, frame: FrameRef) -> Summary:
        facts = read_headers(frame.path)
        stored = np.dtype(facts.dtype) if facts.nodata is not None else None
        if facts.kind == "envi" and self._scanned:
            return _summary_of_scan(frame, stored)
        values = self.decode(frame)
        if self._bytes + values.nbytes <= HELD:
            self._values[frame] = values
            self._bytes += values.nbytes
        return summarise(values, stored=stored)

    def release(self, frames: Iterable[FrameRef]) -> None:
        """Let go of the values of frames that were averaged."""
        for frame in frames:
            if (values := self._values.pop(frame, None)) is not None:
                self._bytes -= values.nbytes


def _summary_of_scan(frame: FrameRef, stored: np.dtype | None) -> Summary:
    from levkas.readers.envi import open_envi

    scan = open_envi(frame.path)
    lines, samples, bands = scan.facts.shape
    count = max(1, min(lines, SAMPLED // (samples * bands)))
    places = dict.fromkeys(np.linspace(0, lines - 1, count).round().astype(int).tolist())
    evenly = np.concatenate([scan.read_lines(y, y + 1) for y in places])
    first = max(0, lines // 2 - MIDDLE // 2)
    return summarise_lines(evenly, scan.read_lines(first, min(lines, first + MIDDLE + 1)), stored)


@dataclass(frozen=True, eq=False)
class SensorCapture:
    """What holds for all frames of one sensor in one capture, by campaign, headers (`facts` of the object's first frame) and summaries.

    `saturation` is the code at which a sensel is full: where its frames pile up, at most what is `stated`. `black` is declared, else the
    file's own, the mean over the frame, else that of an exposure series if it is needed, counts; `black_level`, a number or (h, w), is it
    as it is subtracted. `black_clip` is the code at which a value is clipped at black; None of reflectance, and of frames whose noise goes
    below 0. `step` are counts from one code of the files to the next: 16 where 12 bits stand at the upper end of 16. `holds_reflectance`
    is whether the object's files state their reflectance, and nothing else is there to make it. `alignments` are those of each frame, of
    camera raws none, which LibRaw aligns; `problems` what is wrong with single frames; `doubts` those of the white and of the codes.
    `record` is what was measured before anything was averaged; a scan adds to it. `light` by a chart takes the place of a white.
    """

    camera: Camera
    sensor: SensorFrames
    facts: Facts
    frames: Frames
    kept: Kept | None = None
    stated: FullScale | None = None
    saturation: float | None = None
    black: float | None = None
    black_level: float | np.ndarray | None = None
    black_clip: float | None = 0.0
    step: float = 1.0
    holds_reflectance: bool = False
    alignments: tuple[Aligned, ...] = ()
    problems: tuple[Problem, ...] = ()
    record: SensorRecord = field(default_factory=SensorRecord)
    light: ChartLight | None = None
    reflectance: float | np.ndarray = 1.0
    doubts: tuple[Finding | str, ...] = ()
    _made: dict[tuple[FrameRef, ...], Template] = field(default_factory=dict, repr=False)

    @property
    def unmended(self) -> bool:
        """Whether defects are left out instead of replaced from their neighbours."""
        return self.camera.traits.is_scanned

    @property
    def period(self) -> tuple[int, int]:
        """Rows and columns of the mosaic's pattern."""
        pattern = self.sensor.pattern
        return (len(pattern), len(pattern[0])) if pattern else (1, 1)

    def unit_of(self, frame: FrameRef) -> tuple[float, ...] | None:
        """Return the value of reflectance 1.0 in every band of a frame of the object; None of counts."""
        return facts_of(frame).reflectance_scale if self.holds_reflectance else None

    def with_full_scale(self, problem: Problem) -> Problem:
        """Return the refusal of a saturated white with the counts at which the sensor is full."""
        if problem.code != "E_WHITE_SATURATED" or self.saturation is None:
            return problem
        return replace(problem, found=f"{problem.found} at {self.saturation:g} counts or more")

    def checked(self, values: np.ndarray, frame: FrameRef) -> np.ndarray:
        """Return values of a frame; raises CalibrationRefused where they do not keep to the bits that are declared."""
        if values.dtype.kind in "ui":
            require_bits(self.camera, self.facts, frame, values.dtype, float(values.max(initial=0)))
        return values

    def read(self, frames: Iterable[FrameRef]) -> Iterator[np.ndarray]:
        """Yield frame by frame as it is stored."""
        for frame in frames:
            yield self.checked(self.frames.decode(frame), frame)

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

    def average(self, frames: Sequence[FrameRef], darks: Sequence[Template] = ()) -> Template:
        """Average shots of one exposure above their `darks`.

        A dark that was clipped at black comes as if it had not been, where enough of it is above.
        """
        if (made := self._made.get(key := tuple(frames))) is not None:
            return made
        dark = frames[0] in self.sensor.dark
        level = self.level_under(frames, darks) if dark or len(frames) > 1 else 0.0
        make = partial(self._averaged, frames, level, dark=dark)
        kept = None if frames[0] in self.sensor.object else self.kept
        template = make() if kept is None else kept.template(
            frames, make, level=level, saturation=self.saturation, exposure=exposure_of(frames[0]),
            black_clip=self.black_clip, **({"dark": (self.step, self.period)} if dark else {}),
        )  # fmt: skip
        self.frames.release(frames)
        with placing(frames):
            require_agreement(template.shots, [str(frame.path) for frame in frames])
        template = self.whole(template, frames)
        self._made[key] = template
        return template

    def forget(self, band: str) -> None:
        """Let go of the templates of a band."""
        for frames in [f for f in self._made if all(one.band == band for one in f)]:
            del self._made[frames]

    def unclipped(self, dark: Template, shots: Iterable[np.ndarray]) -> Template:
        """Return a dark as if it had not been clipped, by some of its shots; as it is where these do not show it."""
        if np.mean(dark.black) <= MANY_ZEROS:
            return dark
        try:
            return unclip(dark, [*shots], period=self.period, step=self.step or 1.0)
        except CalibrationRefused:
            return dark

    def _averaged(
        self, frames: Sequence[FrameRef], level: np.ndarray | float | None, *, dark: bool
    ) -> Template:
        with placing(frames):
            made = average_steady(
                lambda: made_ahead(self.read(frames)),
                level,
                period=self.period,
                saturation=self.saturation,
                black_clip=self.black_clip,
                exposure_s=exposure_of(frames[0]),
                times_s=capture_times(frames),
                white=frames[0] in self.sensor.white,
            )
        return self.unclipped(made, islice(self.read(frames), SHOTS)) if dark else made

    def whole(self, template: Template, frames: Sequence[FrameRef]) -> Template:
        """Return a template whose every value is a number, what was none marked as lost, or as absent."""
        with placing(frames):
            closed = close_gaps(template)
        return as_absent(closed) if read_facts(frames[0].path).nodata is not None else closed

    def templates(
        self, frames: Sequence[FrameRef], darks: Sequence[Template] = ()
    ) -> list[Template]:
        """Average frames exposure by exposure, shortest first, above their `darks`."""
        groups: dict[float | None, list[FrameRef]] = {}
        for frame in frames:
            groups.setdefault(exposure_of(frame), []).append(frame)
        times = sorted(groups, key=lambda t: (t is not None, t or 0.0))
        return [self.average(groups[t], darks) for t in times]

    def clipped_darks(self, darks: Sequence[Template], band: str = "") -> dict[str, ClippedDark]:
        """Return black and noise of darks that were clipped, or that they cannot be had, by band and exposure."""
        found: dict[str, ClippedDark] = {}
        for dark in darks:
            name = f"{band} {f'{dark.exposure_s:g} s' if dark.exposure_s else ''}".strip()
            if dark.fit is not None:
                blacks = [round(black, 4) for black in dark.fit.blacks]
                found[name] = {"black": blacks, "noise": dark.fit.noise, "zeros": dark.fit.zeros}
            elif np.mean(dark.black) > MANY_ZEROS and (
                is_clipped(dark.mean) or np.median(dark.mean) < (self.step or 1.0) / 2
            ):
                found[name] = {"zeros": float(np.mean(dark.black))}
        return found


def white_shots(whites: Sequence[Template], band: str = "") -> dict[str, float]:
    """Return by how much parts of the shots of a white differ, by its band; nothing where none does."""
    apart = max((white.shots.apart for white in whites if white.shots), default=0.0)
    return {band: apart} if apart else {}


class SensorCube(NamedTuple):
    """What the function of a camera's kind makes of a sensor: its cube, what a person should know, what was measured."""

    cube: Cube
    notes: Sequence[Finding | str] = ()
    record: SensorRecord = SensorRecord()


# --- what holds for all frames --------------------------------------------------------------------


def open_sensor(
    camera: Camera,
    sensor: SensorFrames,
    kept: Kept | None = None,
    *,
    light: ChartLight | None = None,
    reflectance: float | np.ndarray = 1.0,
    doubts: Sequence[Finding | str] = (),
) -> SensorCapture:
    """Decode the frames of a sensor for their summaries, and return what holds for all of them.

    Raises UnreadableCapture with every frame that cannot be read.
    """
    frames = Frames(camera, sensor, kept)
    summaries = _summaries(frames, sensor) if camera.traits.is_calibrated else {}
    facts = read_facts(sensor.object[0].path)  # of a camera raw they are known when it is decoded
    stated = stated_full_scale(facts, saturation=camera.saturation, bits=camera.bits)
    first = SensorCapture(
        *(camera, sensor, facts, frames, kept, stated), stated.counts if stated else None,
        light=light, reflectance=reflectance, black=facts.black if camera.black is None else camera.black,
        doubts=tuple(doubts),
    )  # fmt: skip
    own = camera.black is None and facts.blacks is not None
    first = replace(first, black_level=facts.blacks.plane(facts.shape) if own else first.black)  # type: ignore[union-attr]
    if not camera.traits.is_calibrated:
        return first
    reflects = _holds_reflectance(camera, sensor)
    codes = {role: [summaries[f].codes for f in getattr(sensor, role)] for role in ROLES}
    clip = None if reflects else 0.0
    if clip is not None and np.dtype(facts.dtype).kind != "u":
        clip = black_clip_of(codes["dark"] or codes["object"])
    aligned = [
        Aligned(role, frame.path, one)
        for role in ROLES
        for frame in getattr(sensor, role)
        if facts.kind != "raw" and (one := summaries[frame].alignment) is not None
    ]
    found = replace(
        first,
        holds_reflectance=reflects,
        black_clip=clip,
        step=find_step([*codes["object"], *codes["white"]]),
        alignments=tuple(aligned),
        problems=tuple(p for f, one in summaries.items() for p in _wrong_with(first, f, one)),
    )
    found = _with_full_scale(found, summaries)
    if facts.kind != "raw":
        bright = [*codes["object"], *codes["white"]]
        odd = doubt_codes(bright, camera.bits, found.saturation)
        found = replace(found, doubts=(*odd, *found.doubts))
    return _with_black_of_series(found)


def _summaries(frames: Frames, sensor: SensorFrames) -> dict[FrameRef, Summary]:
    """Decode every frame for its summary; raises UnreadableCapture with all that cannot be read."""
    every = list(dict.fromkeys(f for role in ROLES for f in getattr(sensor, role)))

    def look(frame: FrameRef) -> Summary | Refused:
        try:
            return frames.summary(frame)
        except Refused as refused:
            return refused

    looked = dict(zip(every, each(look, every), strict=True))
    wrong = [p for one in looked.values() if isinstance(one, Refused) for p in one.problems]
    if wrong:
        raise UnreadableCapture(*gathered(wrong[:MOST_PROBLEMS], cut=len(wrong) > MOST_PROBLEMS))
    return {frame: one for frame, one in looked.items() if isinstance(one, Summary)}


def _wrong_with(context: SensorCapture, frame: FrameRef, made: Summary) -> Sequence[Problem]:
    """Return what is wrong with a frame: codes beyond the bits; of an object one code, neither black nor full."""
    if made.sample.dtype.kind not in "ui":
        return ()
    try:
        require_bits(context.camera, context.facts, frame, made.sample.dtype, made.top)
    except CalibrationRefused as refused:
        return refused.problems
    full = np.inf if context.saturation is None else context.saturation
    enough = made.sample.size >= FEW_PIXELS
    if frame in context.sensor.object and made.constant and 0 < made.constant < full and enough:
        return (Finding("constant", number=made.constant, file=str(frame.path)).problem(),)
    return ()


def require_bits(camera: Camera, facts: Facts, frame: FrameRef, kind: np.dtype, top: float) -> None:
    """Refuse a frame of 8 bits where more are declared, and codes up to `top` beyond both full scales."""
    if camera.bits is None:
        return
    stored, limit = 8 * kind.itemsize, 2.0**camera.bits - 1
    # 4095 · 16 where 12 bits stand at the upper end of 16.
    most = max(limit, camera.saturation or facts.saturation or 0.0)
    where = {"file": str(frame.path), "camera": camera.name}
    if stored == 8 < camera.bits:
        raise refusal("eight_bits", number=top, limit=limit, **where)
    if top > most:
        raise refusal("codes_exceed", number=top, limit=most, **where)


def _holds_reflectance(camera: Camera, sensor: SensorFrames) -> bool:
    if (*sensor.white, *sensor.chart, *sensor.dark) or SCALE in camera.overrule:
        return False
    return all(read_facts(frame.path).reflectance_scale for frame in sensor.object)


def _with_full_scale(context: SensorCapture, summaries: dict[FrameRef, Summary]) -> SensorCapture:
    """Return the sensor with the full scale that the frames of object and white show, where it lies below what is stated."""
    if np.dtype(context.facts.dtype).kind != "u":
        return context
    sensor, stated, record = context.sensor, context.stated, context.record
    strips = context.camera.traits.is_scanned

    lit = [
        SceneShots([summaries[f].sample for f in shots], frames is sensor.white)
        for frames in (sensor.object, sensor.white)
        for shots in ([[f] for f in frames] if strips else _repeats(frames))
    ]
    darks = [summaries[shots[0]].sample for shots in _repeats(sensor.dark)[:SHOTS]]
    found = find_full_scale(lit, darks, period=context.period[1])
    if found is None:
        record.quiet_white = level_of_a_quiet_white(lit, darks, period=context.period[1])
    elif stated is None or found.counts < stated.counts:
        source = stated.source if stated else None
        record.full_scale = FullScaleRecord(counts=found.counts, source=found.source, stated=source)
        return replace(context, saturation=found.counts)
    return context


def _repeats(frames: Sequence[FrameRef]) -> list[list[FrameRef]]:
    """Return two shots of each scene, band and exposure, where there are as many."""
    groups: dict[object, list[FrameRef]] = {}
    for frame in frames:
        groups.setdefault((frame.band, frame.page, times_of(frame)), []).append(frame)
    return [group[:2] for group in groups.values()]


def _with_black_of_series(context: SensorCapture) -> SensorCapture:
    """Return the sensor with the counts at no time at all by which exposures of a scene lie on a line, where darks are of one other time."""
    sensor, full = context.sensor, context.saturation
    if context.black is not None or full is None or context.camera.traits.is_scanned:
        return context
    darks = {times_of(frame) for frame in sensor.dark}
    if len(darks) != 1 or {times_of(f) for f in (*sensor.object, *sensor.white)} <= darks:
        return context
    for frames in (sensor.object, sensor.white):
        for band in bands_of_series(frames):
            own = [f for f in sensor.dark if f.band == band]
            under = context.templates(own or [f for f in sensor.dark if f.band is None])
            shots = context.templates([f for f in frames if f.band == band], under)
            if found := find_black(shots, under, saturation=full):
                context.record.black = found
                return replace(context, black=found["counts"], black_level=found["counts"])
    return context


def bands_of_series(frames: Iterable[FrameRef]) -> list[str | None]:
    """Return a few bands, of those with several exposures, that show black and curve of the sensor."""
    times: dict[str | None, set[float]] = {}
    for frame in frames:
        own, time = times.setdefault(frame.band, set()), exposure_of(frame)
        own |= set() if time is None else {time}
    return spread([band for band, own in times.items() if len(own) > 1], SERIES)


# --- frames ---------------------------------------------------------------------------------------


def exposure_of(frame: FrameRef) -> float | None:
    """Exposure from the file's name or the manifest, else from its EXIF or header, s; None of a list by bands."""
    times = times_of(frame)
    return None if isinstance(times, tuple) else times


def times_of(frame: FrameRef) -> Times:
    """Return the exposure that the name or the manifest states, else EXIF or the header of the file."""
    if frame.exposure_s is not None:
        return frame.exposure_s
    facts = facts_of(frame)
    if facts.kind == "raw" and facts.exposure_s is None:
        facts = read_facts(frame.path)
    return facts.band_times_s or facts.exposure_s


def listed(times: Times) -> tuple[float, ...]:
    """Return the exposures of a frame, s; none where it is not known."""
    if times is None:
        return ()
    return times if isinstance(times, tuple) else (times,)


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
    if (pages := read_facts(frame.path).pages) > 1:
        planes = [read_frame(frame.path, page=page) for page in frame.order or range(pages)]
        return np.ascontiguousarray(np.stack(planes, axis=-1))
    values = read_frame(frame.path)
    values = values if values.ndim == 3 else values[..., None]
    return np.take(values, frame.order, axis=-1) if frame.order else values


def placed(problem: Problem, frames: Sequence[FrameRef]) -> Problem:
    """Name the file, or the folder of several frames, where the kernels, which know no files, could not."""
    if problem.file:
        return problem
    if len(frames) == 1:
        return replace(problem, file=str(frames[0].path))
    names = ", ".join(f.path.name for f in frames[:3]) + (" …" if len(frames) > 3 else "")
    return replace(problem, file=f"{frames[0].path.parent}: {names}")


@contextmanager
def placing(frames: Sequence[FrameRef]) -> Iterator[None]:
    """Name the folder of the frames in the refusals of kernels, which know no files."""
    try:
        yield
    except CalibrationRefused as refused:
        raise CalibrationRefused(*(placed(p, frames) for p in refused.problems)) from None


def spread(items: Sequence, count: int) -> list:
    """Return up to `count` items spread over a sequence, none twice.

    >>> spread("abcdefg", 3)
    ['a', 'd', 'g']
    """
    last = len(items) - 1
    places = {round(i * last / max(count - 1, 1)) for i in range(count)} if items else set()
    return [items[place] for place in sorted(places)]

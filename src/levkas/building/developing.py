"""Raw frames of one capture to calibrated cubes in native pixels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.building.codes import CodesRefused, check_codes, doubt_codes, spread
from levkas.building.native import GROUP, ROWS, Native
from levkas.building.whiteboard import white_reflectance
from levkas.calibration.flatfield import Calibrated, flat_field
from levkas.calibration.gaps import close_gaps, describe_gaps, gaps_of
from levkas.calibration.templates import CalibrationRefused, Template, average
from levkas.cube import Cube, Flag
from levkas.problems import Problem, Refused
from levkas.readers.frames import Facts, UnreadableCapture, read_facts, read_frame
from levkas.rounding import round_root, round_values

if TYPE_CHECKING:
    from levkas.building.shelf import Shelf
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.scanning import Seam
    from levkas.campaign import Camera, Campaign
    from levkas.discovery import Capture, FrameRef, SensorFrames


GLIMPSE_LINES = 64
MOST_PROBLEMS = 50


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


@dataclass(frozen=True)
class Exposed:
    """An object's frames as one; merged exposures are above dark already."""

    shot: Template
    shots: list[Template]
    above_dark: bool = False


def develop(capture: Capture, campaign: Campaign, shelf: Shelf) -> Native:
    """Calibrate every sensor of a capture.

    Raises
    ------
    Refused
        UnreadableCapture or CalibrationRefused, with the files in question.
    """
    camera = campaign.cameras[capture.camera]
    cubes, notes, captured = {}, [], None
    learnt: dict[str, dict[str, Any]] = {}
    try:
        for sensor in capture.sensors:
            facts = read_facts(sensor.object[0].path)
            captured = captured or facts.captured
            bench = Bench(campaign, camera, sensor, facts, shelf)
            notes += doubts_of(bench)
            cubes[sensor.name] = DEVELOPERS[camera.kind](bench, notes)
            learnt[sensor.name] = bench.told
    except (UnreadableCapture, CodesRefused) as refused:
        raise type(refused)(*_all_problems(capture, campaign, shelf, refused)) from None
    aligns = {sensor.name: sensor.align for sensor in capture.sensors}
    where = f"{capture.object}/{capture.layer}"
    told = tuple(dict.fromkeys(f"{where}: {note}" for note in notes if note))
    return Native(cubes, aligns, captured, told, learnt)


def _all_problems(
    capture: Capture, campaign: Campaign, shelf: Shelf, first: Refused
) -> list[Problem]:
    """What is wrong with every frame of a capture: who mends one wants to know of the others."""
    problems = list(first.problems)
    for sensor in capture.sensors:
        for frame in (*sensor.object, *sensor.white, *sensor.dark):
            try:
                facts = read_facts(frame.path)
                bench = Bench(campaign, campaign.cameras[capture.camera], sensor, facts, shelf)
                bench.checked(read_frame(frame.path, page=frame.page), frame)
            except Refused as refused:
                problems += refused.problems
            if len(problems) > MOST_PROBLEMS:
                return list(dict.fromkeys(problems))[:MOST_PROBLEMS]
    return list(dict.fromkeys(problems))


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


def exposure_of(frame: FrameRef) -> float | None:
    """Exposure from the file's name, else from its EXIF, s."""
    if frame.exposure_s is not None or frame.path.suffix.lower() in (".hdr", ".png"):
        return frame.exposure_s
    return _exposure_told(frame.path, frame.path.stat().st_mtime_ns)


@lru_cache(maxsize=4096)
def _exposure_told(path: Path, _stamp: int) -> float | None:
    """EXIF of one file, asked for once: a camera raw costs half a second."""
    return read_facts(path).exposure_s


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


def flatten(
    bench: Bench, shot: Template, dark: list[Template], white: Template | None, **more: Any
) -> Calibrated:
    """Flat-field with the files named in every refusal."""
    try:
        flat = flat_field(shot, dark or None, white, black=bench.black, **more)
    except CalibrationRefused as refused:
        frames = bench.sensor.white or bench.sensor.object
        raise CalibrationRefused(*(placed(p, frames) for p in refused.problems)) from None
    flat = _with_movement(bench, flat, shot, dark, more.get("noise"))
    lost = gaps_of(shot, *dark, white)
    if lost is None:
        return flat
    labels: list[str] = list(more.get("labels") or ())
    lost = np.broadcast_to(lost, flat.values.shape)
    note = describe_gaps(lost, labels[0] if len(labels) == 1 else bench.camera.name)
    values, variance = flat.values, flat.variance
    if bench.unmended:  # not replaced from its neighbours: the value is gone
        values = np.where(lost, np.float32(np.nan), values)
        variance = None if variance is None else np.where(lost, np.float32(np.nan), variance)
    flags = np.where(lost, flat.flags | np.uint8(Flag.DEFECT), flat.flags)
    notes = (*flat.notes, note)
    return replace(flat, values=values, variance=variance, flags=flags, notes=notes)


def _with_movement(
    bench: Bench, flat: Calibrated, shot: Template, dark: list[Template], noise: NoiseModel | None
) -> Calibrated:
    """Flag what moved between the object's shots, and say how much of it did."""
    from levkas.calibration.moving import find_moved

    if shot.count < 2 or noise is None or noise.source != "temporal":
        return flat
    rows = bench.sensor.pattern or ((None,),)
    # One number for the dark: a hot sensel's current counts as light, as it does for its noise.
    level = float(np.median(dark[0].mean)) if dark else bench.black or 0.0
    moved = find_moved(shot, noise, level, period=(len(rows), len(rows[0])))
    share = float(np.mean(moved))
    if not share:
        return flat
    note = f"{bench.camera.name}: {100 * share:.2g} % of the pixels moved between shots, flagged"
    flags = np.where(moved, flat.flags | np.uint8(Flag.MOVED), flat.flags)
    return replace(flat, flags=flags, notes=(*flat.notes, note))


def _noise(
    shots: list[Template], whites: list[Template | None], darks: list[Template], bench: Bench
) -> NoiseModel | None:
    """Noise of the sensor from stacks, or from single shots where there are no stacks."""
    from levkas.building.measuring import note_noise
    from levkas.calibration.noise_fit import fit_noise, fit_noise_single

    dark = darks[0] if darks else None
    stacks = [t for t in (*shots, *(w for w in whites if w is not None)) if t.count > 1]
    black = bench.black or 0.0
    fitted = fit_noise(stacks, dark, black=black) if stacks else None
    if fitted is None:
        pattern = bench.sensor.pattern
        fitted = fit_noise_single(shots, whites, dark, black=black, pattern=pattern)
    note_noise(bench.told, fitted, dark, black, bench.saturation)
    return fitted


def cube_of(
    bench: Bench,
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    quantity: str,
    *,
    exact: bool = False,
) -> Cube:
    """Return values, flags and sigma of one sensor; what could not be said is 0 and flagged.

    Values that are `exact` are still to be rounded.
    """
    sigma = None
    if variance is not None:
        sigma = round_root(variance, out=variance if variance.dtype == np.float32 else None)
    if not exact:
        values = round_values(values, out=values if values.dtype == np.float32 else None)
    lost = ~np.isfinite(values)
    if lost.any():
        values = np.where(lost, np.float32(0), values)
        flags = np.where(lost, flags | (Flag.DEFECT | Flag.OUTSIDE), flags).astype(np.uint8)
    return Cube(values, flags, sigma, bench.sensor.bands, quantity)


def _expose(bench: Bench, frames: Sequence[FrameRef]) -> list[Template]:
    """Average the object's shots, exposure by exposure."""
    times = sorted({exposure_of(f) for f in frames}, key=lambda t: (t is not None, t or 0.0))
    if len(times) > 1 and bench.camera.exposures == "one":
        from levkas.discovery import CaptureRefused

        raise CaptureRefused(
            Problem(
                "E_EXPOSURES",
                f"{bench.camera.name}: shots of several exposures",
                str(frames[0].path.parent),
                f"cameras.{bench.camera.name}.exposures",
                ", ".join(f"{t:g} s" for t in times if t),
                "one exposure",
                'Write exposures = "best" (the longest unsaturated) or "merge".',
            )
        )
    return [bench.average([f for f in frames if exposure_of(f) == t]) for t in times]


def _exposed(bench: Bench, frames: Sequence[FrameRef], darks: list[Template]) -> Exposed:
    """The object's frames as one: averaged, the best exposure, or all merged above dark."""
    from levkas.calibration.exposures import best_exposure

    shots = _expose(bench, frames)
    if len(shots) == 1:
        return Exposed(shots[0], shots)
    if bench.camera.exposures == "merge":
        return Exposed(_merged(bench, shots, darks), shots, above_dark=True)
    return Exposed(best_exposure(shots), shots)


def _merged(bench: Bench, shots: list[Template], darks: list[Template]) -> Template:
    """An exposure series in counts a second above dark."""
    from levkas.calibration.exposures import merge_exposures

    if bench.saturation is None:
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                f"{bench.camera.name}: exposures cannot be merged without a saturation level",
                field=f"cameras.{bench.camera.name}.saturation",
                fix="Declare `bits` or `saturation`.",
            )
        )
    pattern = bench.sensor.pattern
    more: dict[str, Any] = {"period": (len(pattern), len(pattern[0]))} if pattern else {}
    return merge_exposures(
        shots, darks, saturation=bench.saturation, black=bench.black, **more
    ).template


def _white(
    bench: Bench, frames: Sequence[FrameRef], darks: list[Template], above_dark: bool
) -> Template | None:
    """The white of one exposure; above dark where the object is."""
    from levkas.calibration.darks import match_dark
    from levkas.calibration.exposures import best_exposure

    if not frames:
        return None
    whites = bench.templates(frames)
    if not above_dark:
        return whites[0] if len(whites) == 1 else best_exposure(whites)
    if len(whites) > 1:
        return _merged(bench, whites, darks)
    white = whites[0]
    under = match_dark(darks or None, white.exposure_s, black=bench.black)
    return replace(white, mean=(white.mean - under.mean).astype(np.float32))


def _defects(darks: list[Template], white: Template | None, pattern: Any) -> np.ndarray | None:
    """Hot sensels of the longest dark and dead ones of the white."""
    from levkas.calibration.defects import find_defects

    if not darks and white is None:
        return None
    return find_defects(darks[-1] if darks else None, white, pattern)


def develop_mosaic(bench: Bench, notes: list[str]) -> Cube:
    """A mosaic: flat field on the mosaic, then demosaic; or a sensor without one."""
    from levkas.building.measuring import note_light
    from levkas.calibration.defects import replace_defects
    from levkas.calibration.mosaic import demosaic

    sensor, camera = bench.sensor, bench.camera
    darks = bench.templates(sensor.dark)
    exposed = _exposed(bench, sensor.object, darks)
    white = _white(bench, sensor.white, darks, exposed.above_dark)
    noise = _noise(exposed.shots, [white] * len(exposed.shots), darks, bench)
    pattern = sensor.pattern
    under = [] if exposed.above_dark else darks
    note_light(bench.told, white, under, pattern, [b.label for b in sensor.bands])
    defects = _defects(darks, white, pattern)
    reflectance = white_reflectance(bench.campaign, sensor.bands)
    flat = flatten(
        bench,
        exposed.shot,
        [] if exposed.above_dark else darks,
        white,
        white_reflectance=reflectance,
        noise=noise,
        defects=defects,
        pattern=pattern,
        labels=[b.label for b in sensor.bands],
    )
    notes.extend(flat.notes)
    values, flags, variance = replace_defects(
        flat.values, flat.flags, flat.variance, pattern=pattern
    )
    if pattern is None:
        deep = values.shape if values.ndim == 3 else (*values.shape, 1)
        variance = None if variance is None else variance.reshape(deep)
        return cube_of(bench, values.reshape(deep), flags.reshape(deep), variance, flat.quantity)
    method = camera.demosaic or (
        "bilinear" if camera.kind == "sensors" and len(pattern) == 2 else None
    )
    made = demosaic(
        values, flags, variance, pattern, method=method, channels=[b.label for b in sensor.bands]
    )
    return cube_of(bench, *made, flat.quantity)


def develop_bands(bench: Bench, notes: list[str]) -> Cube:
    """One file a band: each with its own templates; behind narrow filters a mosaic is equalised."""
    bands = bench.sensor.bands
    reflectances = np.broadcast_to(white_reflectance(bench.campaign, bands), len(bands))
    noise = _noise_of_bands(bench)
    shape = (*bench.facts.shape[:2], len(bands))
    values, flags = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    variance: np.ndarray | None = np.empty(shape, np.float32)
    quantity = "reflectance"
    for start in range(0, len(bands), GROUP):
        group = []
        for i, band in enumerate(bands[start : start + GROUP], start):
            flat = _band(bench, band.label, float(reflectances[i]), noise)
            notes.extend(flat.notes)
            quantity = flat.quantity
            _check_shape(bench, band.label, flat.values.shape, shape[:2])
            group.append(flat)
        _interleave([flat.values for flat in group], values, start)
        _interleave([flat.flags for flat in group], flags, start)
        variances = [flat.variance for flat in group if flat.variance is not None]
        if variance is not None and len(variances) == len(group):
            _interleave(variances, variance, start)
        else:
            variance = None
    return cube_of(bench, values, flags, variance, quantity)


def _interleave(planes: Sequence[np.ndarray], cube: np.ndarray, start: int) -> None:
    """Copy planes to a cube's bands from `start` on, in one passage over its memory."""
    for y in range(0, len(cube), ROWS):
        rows = np.stack([plane[y : y + ROWS] for plane in planes])
        cube[y : y + ROWS, :, start : start + len(planes)] = np.moveaxis(rows, 0, 2)


def _band(bench: Bench, label: str, reflectance: float, noise: NoiseModel | None) -> Calibrated:
    """One band of one file, or of one file an exposure."""
    from levkas.building.measuring import note_light
    from levkas.calibration.defects import replace_defects
    from levkas.calibration.equalising import equalise_phases

    sensor = bench.sensor
    darks = bench.templates(_of_band(sensor.dark, label))
    exposed = _exposed(bench, [f for f in sensor.object if f.band == label], darks)
    frames = _require(_of_band(sensor.white, label), bench, label)
    white = _white(bench, frames, darks, exposed.above_dark)
    note_light(bench.told, white, [] if exposed.above_dark else darks, None, [label])
    flat = flatten(
        bench,
        exposed.shot,
        [] if exposed.above_dark else darks,
        white,
        white_reflectance=reflectance,
        noise=noise,
        defects=_defects(darks, white, sensor.pattern),
        labels=[label],
    )
    plane = replace_defects(flat.values, flat.flags, flat.variance, pattern=sensor.pattern)
    if sensor.pattern is not None:
        plane = equalise_phases(*plane, sensor.pattern)
    return replace(flat, values=plane[0], flags=plane[1], variance=plane[2])


def _require(frames: list[FrameRef], bench: Bench, label: str) -> list[FrameRef]:
    if not frames and bench.sensor.white:
        raise CalibrationRefused(
            Problem(
                "E_TEMPLATE_MISSING",
                f"{bench.camera.name}: no white for band {label}",
                str(bench.sensor.white[0].path.parent),
                f"cameras.{bench.camera.name}.files",
                "no file",
                f"a white frame of {label}",
                "Add the frame, or leave the band out of `wavelengths`.",
            )
        )
    return frames


def _of_band(frames: Sequence[FrameRef], label: str) -> list[FrameRef]:
    """Templates of one band: its own where frames carry a band, else those shared by all."""
    own = [f for f in frames if f.band == label]
    return own or [f for f in frames if f.band is None]


def _check_shape(
    bench: Bench, label: str, found: tuple[int, ...], expected: tuple[int, ...]
) -> None:
    if found != expected:
        path = next(f.path for f in bench.sensor.object if f.band == label)
        raise CalibrationRefused(
            Problem(
                "E_SIZE",
                f"{bench.camera.name}: band {label} has another size than the others",
                str(path),
                "width, height",
                f"{found[1]} x {found[0]}",
                f"{expected[1]} x {expected[0]}",
                "Take the frame of the right camera.",
            )
        )


def _noise_of_bands(bench: Bench) -> NoiseModel | None:
    """Fit the sensor's noise once, on a few bands spread over the range: it is the same sensor."""
    bands = bench.sensor.bands
    chosen = sorted({len(bands) // 4, len(bands) // 2, (3 * len(bands)) // 4})
    shots, whites, darks = [], [], []
    for i in chosen:
        label = bands[i].label
        shots.append(bench.average([f for f in bench.sensor.object if f.band == label][:1]))
        darks = bench.templates(_of_band(bench.sensor.dark, label))
        whites.append(_white(bench, _of_band(bench.sensor.white, label), darks, False))
    return _noise(shots, whites, darks, bench)


def develop_cube(bench: Bench, notes: list[str]) -> Cube:
    """A line scan: dark and white averaged along the scan, or frames for a mirror scanner."""
    from levkas.building.measuring import note_light
    from levkas.calibration.scanning import average_lines, join_strips

    sensor, mirror = bench.sensor, bench.camera.scan == "mirror"

    def template(frames: Sequence[FrameRef]) -> Template | None:
        if not frames:
            return None
        blocks = (bench.checked(read_cube(frame), frame) for frame in frames)
        join = average if mirror else average_lines
        return bench.whole(join(blocks, saturation=bench.saturation), frames)

    dark, white = template(sensor.dark), template(sensor.white)
    darks = [dark] if dark else []
    note_light(bench.told, white, darks, None, [b.label for b in sensor.bands])
    reflectance = white_reflectance(bench.campaign, sensor.bands)
    noise = None if mirror else line_noise(bench, dark, white)
    strips = []
    for frame in sensor.object:
        block = bench.checked(read_cube(frame), frame)
        shot = bench.whole(average(iter([block]), saturation=bench.saturation), [frame])
        del block
        if mirror:
            noise = noise or _noise([shot], [], darks, bench)
        flat = flatten(
            bench,
            shot,
            darks,
            white,
            white_reflectance=reflectance,
            noise=noise,
            labels=[b.label for b in sensor.bands],
        )
        notes.extend(flat.notes)
        strips.append(flat)
    whole = strips[0]
    if len(strips) > 1:
        whole, seams = join_strips(strips)
        notes.extend(_describe_seam(i, seam) for i, seam in enumerate(seams, 1))
    values = _denoised(bench, whole.values, notes) if bench.camera.denoise else whole.values
    return cube_of(bench, values, whole.flags, whole.variance, whole.quantity)


def line_noise(bench: Bench, dark: Template | None, white: Template | None) -> NoiseModel | None:
    """Noise of a push-broom camera: its white is one line, seen many times."""
    return _noise([], [white] if white else [], [dark] if dark else [], bench)


def _describe_seam(number: int, seam: Seam) -> str:
    worst = float(np.nanmax(np.abs(seam.difference)))
    return (
        f"strips {number} and {number + 1} share {seam.overlap} samples (shift {seam.shift} lines); "
        f"the seam differs by {100 * seam.rms:.1f} % rms, by {100 * worst:.1f} % in its worst band"
    )


def _denoised(bench: Bench, values: np.ndarray, notes: list[str]) -> np.ndarray:
    """Project a cube on its signal subspace (HySime), and say what that took away."""
    from levkas.calibration.denoising import denoise, describe_removed

    made = denoise(values)
    notes.append(describe_removed(made.subspace, made.removed, made.removed_most))
    return made.values


def develop_image(bench: Bench, notes: list[str]) -> Cube:
    """A photograph or radiograph: nothing to calibrate, its codes as they are."""
    shot = bench.average(bench.sensor.object)
    values = shot.mean[..., None] if shot.mean.ndim == 2 else shot.mean
    if shot.lost is not None:
        notes.append(describe_gaps(shot.lost, bench.camera.name))
        values = np.where(shot.lost.reshape(values.shape), np.float32(np.nan), values)
    saturated = shot.saturated.reshape(values.shape)
    flags = np.where(saturated, np.uint8(Flag.SATURATED), np.uint8(0))
    variance = (
        None
        if shot.variance is None
        else (shot.variance / shot.count).reshape(values.shape).astype(np.float32)
    )
    return cube_of(bench, np.ascontiguousarray(values, np.float32), flags, variance, "counts")


DEVELOPERS = {
    "mosaic": develop_mosaic,
    "sensors": develop_mosaic,
    "bands": develop_bands,
    "cube": develop_cube,
    "image": develop_image,
}

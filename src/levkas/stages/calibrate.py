"""Raw frames of one capture to calibrated cubes in native pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.calibration.agreement import compare_facts
from levkas.calibration.defects import replace_defects
from levkas.calibration.equalising import equalise_phases
from levkas.calibration.findings import Finding, decide, refusal
from levkas.calibration.flatfield import Calibrated
from levkas.calibration.mosaic import demosaic
from levkas.calibration.noise_fit import mean_variance
from levkas.calibration.record import SensorNoise, SensorRecord, findings_of, findings_of_lamp
from levkas.calibration.reflectance import defects_of
from levkas.calibration.sensor import (
    SensorCapture,
    SensorCube,
    bands_of_series,
    exposure_of,
    placed,
    placing,
    white_shots,
)
from levkas.calibration.templates import CalibrationRefused
from levkas.calibration.white_area import WhiteArea, joined_area
from levkas.calibration.whites import WhiteBoard
from levkas.core.cube import Flag
from levkas.core.files import remove, together
from levkas.core.problems import Problem
from levkas.core.threads import each, in_threads
from levkas.core.transpose import transpose
from levkas.database.registrations import read_registration
from levkas.readers.frames import read_facts
from levkas.stages.above_white import count_above, findings_of_counts
from levkas.stages.capture_statistics import focus_of
from levkas.stages.chart_white import lights_by_chart
from levkas.stages.exposures import (
    average_shots,
    check_scaling,
    cube_of,
    doubts_of,
    expose,
    flatten,
    lost_values,
    mark_glare_in,
    noise_of,
    noise_of_band,
    open_frames,
    require_same_size,
    require_sound,
    require_white,
    white_area_of,
    white_of,
)
from levkas.stages.measurements import (
    Series,
    Stacks,
    light_of,
    measure_stacks,
    rounded,
    sensels_of,
    sensor_noise,
    series_of,
    straightness,
    stray_light_by,
)
from levkas.stages.native_files import filed_parts, part_name, require_memory, write_native
from levkas.stages.parts import CalibratedCapture, Part, Placement, median_focus
from levkas.stages.scans import develop_scan, is_streamed, open_scan
from levkas.stages.shared_noise import Mosaic
from levkas.stages.spectra import broad_centroids, credits_of
from levkas.stages.written import Written

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.calibration.chart_light import ChartLight
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.calibration.templates import Template
    from levkas.campaign.campaign import Camera, Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef, SensorFrames
    from levkas.database.layout import Places
    from levkas.stages.template_cache import TemplateCache

MOST_PROBLEMS = 50
GROUP, ROWS = 8, 16
"""Bands that are laid into a cube in one passage over some rows, in which they lie innermost."""


def calibrate(
    capture: Capture, campaign: Campaign, templates: TemplateCache, places: Places
) -> CalibratedCapture:
    """Calibrate a capture; tiles, and a scan that is larger than memory, are calibrated as they are written.

    Raises Refused: UnreadableCapture or CalibrationRefused, with the files in question; TooLarge.
    """
    if capture.tiles:
        for tile in capture.tiles:
            require_memory(tile, campaign.cameras[capture.camera].kind)
        return CalibratedCapture(
            (),
            {sensor.name: sensor.align for sensor in capture.sensors},
            read_facts(capture.sensors[0].object[0].path).captured,
            tuple(_contradictions(capture, campaign)),
            coming=(develop(tile, campaign, templates) for tile in capture.tiles),
        )
    if is_streamed(capture, campaign):
        return open_scan(capture, campaign, templates)
    require_memory(capture, campaign.cameras[capture.camera].kind)
    return develop(capture, campaign, templates)


def _contradictions(capture: Capture, campaign: Campaign) -> Iterator[str]:
    """Compare what files of different tiles state; raises CalibrationRefused where they contradict each other."""
    where, camera = f"{capture.object}/{capture.layer}", campaign.cameras[capture.camera]
    for sensor in capture.sensors:
        notes = compare_facts(camera, sensor)
        yield from (f"{where}: {note}" for note in (*notes, *sensor.remarks))


def write_calibrated(
    made: CalibratedCapture, capture: Capture, campaign: Campaign, places: Places
) -> Written:
    """Write a calibrated capture in native pixels where these are asked for.

    Tiles are written in any case: beside the database, where it holds no native pixels.
    """
    credits = credits_of(campaign, capture.object, made.captured or "")
    centroids = broad_centroids(campaign, capture.camera, capture.bands)
    is_published = campaign.database.native
    folder, quantity = folder_of(capture, campaign, places), "reflectance"
    files: list[Path] = []
    with together():
        made.complete()
        if capture.tiles:
            files, quantity = _write_tiles(made, capture, campaign, places, folder)
        elif is_published:
            parts = ((name, made.sensor(name)) for name in made.by_sensor)
            files = write_native(parts, capture, places, credits, centroids)
    if capture.tiles:
        made.parts = _tiles_in_files(capture, campaign, places, quantity)
    notes = {
        "quantity": made.quantity,
        "warnings": list(made.warnings),
        "captured": made.captured or "",
        "measured": dict(made.measured),
        "focus": made.focus,
    }
    if is_published:
        return Written(files, notes, warnings=made.warnings)
    return Written([], notes, aside=tuple(files), warnings=made.warnings)


def _write_tiles(
    made: CalibratedCapture,
    capture: Capture,
    campaign: Campaign,
    places: Places,
    folder: Path | None,
) -> tuple[list[Path], str]:
    """Write the tiles of a capture as they are calibrated; return the files and the quantity that all tiles have."""
    credits = credits_of(campaign, capture.object, made.captured or "")
    centroids = broad_centroids(campaign, capture.camera, capture.bands)
    files, warnings, focus, quantity = [], [*made.warnings], [], "reflectance"
    for tile in capture.tiles:
        native = next(made.coming)
        parts = ((part_name(tile, name), native.sensor(name)) for name in native.by_sensor)
        files += write_native(parts, capture, places, credits, centroids, folder)
        quantity = native.quantity if quantity == "reflectance" else quantity
        warnings += native.warnings
        focus.append(native.focus)
        made.measured = made.measured or native.measured
        del native, parts  # their memory goes before the next ones are made
    made.warnings, made.focus = tuple(dict.fromkeys(warnings)), median_focus(focus)
    return files, quantity


def _tiles_in_files(
    capture: Capture, campaign: Campaign, places: Places, quantity: str
) -> list[Part]:
    folder, mosaics = folder_of(capture, campaign, places), mosaics_of(capture, campaign)
    return [*filed_parts(capture, places, mosaics, quantity, folder)]


def write_shown(
    made: CalibratedCapture, capture: Capture, campaign: Campaign, places: Places, folder: Path
) -> None:
    """Write a calibrated capture in native pixels into a folder of its own, beside older ones, which go; tiles joined in px of the reference."""
    for older in folder.parent.glob("native-*"):
        remove(older)
    credits = credits_of(campaign, capture.object, made.captured or "")
    centroids = broad_centroids(campaign, capture.camera, capture.bands)
    with together():
        parts = ((name, made.sensor(name)) for name in made.by_sensor)
        write_native(parts, capture, places, credits, centroids, folder)


def folder_of(capture: Capture, campaign: Campaign, places: Places) -> Path | None:
    """Return where tiles are kept that the database does not hold; None where it does."""
    native = campaign.database.native
    return None if native else places.kept_native(capture.object, capture.layer)


def load_calibrated(
    capture: Capture,
    campaign: Campaign,
    places: Places,
    notes: Mapping[str, Any],
    templates: TemplateCache,
) -> CalibratedCapture:
    """Return what `calibrate` returned: tiles from their files, others calibrated again, which takes a sixth of reading a file.

    `notes` are those of the record.
    """
    if capture.tiles:
        return CalibratedCapture(
            _tiles_in_files(capture, campaign, places, notes.get("quantity", "counts")),
            {sensor.name: sensor.align for sensor in capture.sensors},
            notes.get("captured") or None,
            tuple(notes.get("warnings", ())),
            notes.get("measured", {}),
            notes.get("focus", []),
            _placement_of(places.registration(capture.object, capture.layer)),
        )
    if is_streamed(capture, campaign):
        return open_scan(capture, campaign, templates)
    return develop(capture, campaign, templates)


def _placement_of(path: Path) -> Placement | None:
    """Return where tiles were placed, by the registration record of their layer; None before they are."""
    record = read_registration(path) if path.is_file() else {}
    return Placement.of(record) if record.get("tiles") else None


def mosaics_of(capture: Capture, campaign: Campaign) -> dict[str, Mosaic]:
    """Return the sensors of a capture whose values were demosaiced."""
    camera = campaign.cameras[capture.camera]
    if not camera.traits.is_demosaiced:
        return {}
    return {
        s.name: Mosaic(s.pattern, demosaicing_of(camera, s), [b.label for b in s.bands])
        for s in capture.sensors
        if s.pattern is not None
    }


def develop(capture: Capture, campaign: Campaign, templates: TemplateCache) -> CalibratedCapture:
    """Calibrate every sensor of a capture, held in memory.

    Raises Refused: UnreadableCapture or CalibrationRefused, with the files in question.
    """
    camera, mosaics = campaign.cameras[capture.camera], mosaics_of(capture, campaign)
    if camera.traits.is_scanned:
        return develop_scan(capture, campaign, templates)
    lights = _lights_of(capture, campaign, templates)
    traps = capture.boxes(campaign.targets.traps.get(capture.object, {}))
    contexts = [
        open_frames(capture, campaign, s, templates, lights.get(s.name)) for s in capture.sensors
    ]
    notes: list[Finding | str] = [*_agreeing(contexts)]
    parts, records, focus = [], {}, []
    for context in contexts:
        name = context.sensor.name
        require_sound(context)
        if context.light is not None:
            _require_chart_of_size(context, context.light)
            context.record.chart_white = dict(context.light.record)
        made = developer_of(camera)(context)
        cube = mark_glare_in(made.cube)
        record = records[name] = SensorRecord()
        record.add([context.record, made.record])
        record.stray_light, trapped = stray_light_by(cube, traps.get(name, []), capture.object)
        notes += [*doubts_of(context), *made.notes, *trapped]
        notes += findings_of(record, in_files=camera.traits.bands_in == "files")
        if cube.sigma is None and camera.traits.is_calibrated and not context.holds_reflectance:
            notes.append(Finding("no_sigma"))
        notes += findings_of_counts(count_above(cube), cube.labels)
        focus += focus_of([cube])
        parts.append(Part.held(cube, name, mosaic=mosaics.get(name)))
        del cube, made  # its sigma, which is packed
    notes += findings_of_lamp(records.values())
    where = f"{capture.object}/{capture.layer}"
    with placing([frame for sensor in capture.sensors for frame in sensor.object]):
        warnings = tuple(f"{where}: {note}" for note in decide(notes))
    aligns = {sensor.name: sensor.align for sensor in capture.sensors}
    stated = (context.facts.captured for context in contexts)
    captured = next((one for one in stated if one), None)
    measured = {name: record.to_json() for name, record in records.items()}
    return CalibratedCapture(parts, aligns, captured, warnings, measured, focus)


def _agreeing(contexts: Sequence[SensorCapture]) -> Iterator[str]:
    """Compare what the files of every sensor state; yield notes. Raises CalibrationRefused with all contradictions."""
    problems: list[Problem] = []
    for context in contexts:
        try:
            yield from compare_facts(context.camera, context.sensor, context.alignments)
        except CalibrationRefused as refused:
            problems += refused.problems
    if problems:
        raise CalibrationRefused(*problems)


def _lights_of(
    capture: Capture, campaign: Campaign, templates: TemplateCache
) -> dict[str, ChartLight]:
    """Return the light of every sensor by the chart that is its white; nothing where there is no such chart."""
    if not any(sensor.chart for sensor in capture.sensors):
        return {}
    sensors = tuple(replace(s, object=s.chart, chart=()) for s in capture.sensors)
    made = develop(replace(capture, sensors=sensors), campaign, templates)
    return lights_by_chart(capture, campaign, made)


def _require_chart_of_size(context: SensorCapture, light: ChartLight) -> None:
    """Refuse a chart whose frames have another size than the object's: its light lies elsewhere."""
    if context.facts.shape[:2] != light.size:
        found, expected = (f"{w} x {h}" for h, w in (light.size, context.facts.shape[:2]))
        wrong = Finding("chart_size", camera=context.camera.name, found=found, expected=expected)
        raise CalibrationRefused(placed(wrong.problem(), context.sensor.chart))


class _Flat(NamedTuple):
    """Flat-fielded values, what was measured, exposure series, where the white shows the board, and what a person should know."""

    values: Calibrated
    record: SensorRecord
    series: list[Series]
    area: WhiteArea
    notes: list[Finding | str]


def _flat(
    context: SensorCapture,
    stacks: tuple[list[Template], list[Template], list[Template]],
    board: WhiteBoard,
    noise: NoiseModel | None,
    area: WhiteArea | None = None,
    *,
    band: str = "",
    looked_at: tuple[bool, bool] = (True, True),
) -> _Flat:
    """Flat-field shots, by whites and darks, each exposure by exposure; `looked_at` is whether series of shots and whites are compared."""
    shots, whites, darks = stacks
    labels, pattern = list(board.labels or ()), context.sensor.pattern
    exposed = expose(context, shots, darks, noise)
    merged = exposed.shot.above_dark
    white = white_of(context, whites, darks, noise=noise, merged=merged, band=band)
    require_white(context, white, darks, labels)
    area = area or white_area_of(context, exposed.shot, white, darks)
    notes = check_scaling(context, exposed, white, (shots, whites), darks)
    defects = defects_of(darks, white, pattern, area.uncovered)
    flat = flatten(
        *(context, exposed.shot, darks, white),
        board=board, noise=noise, defects=defects, moved=exposed.moved,
    )  # fmt: skip
    record = measure_stacks(Stacks(context, exposed.shot, darks, white, board), flat, noise)
    record.light = light_of(white, darks, board.pattern, labels)
    record.white_shots = white_shots(whites, band)
    compared = (some for some, is_one in zip((shots, whites), looked_at, strict=True) if is_one)
    series = [found for some in compared for found in series_of(context, some, darks)]
    return _Flat(flat, record, series, area, [*flat.notes, *notes])


def develop_mosaic(context: SensorCapture) -> SensorCube:
    """A mosaic: flat field on the mosaic, then demosaic; or a sensor without one."""
    sensor, pattern = context.sensor, context.sensor.pattern
    labels = [band.label for band in sensor.bands]
    darks = context.templates(sensor.dark)
    shots = average_shots(context, sensor.object, darks)
    whites = context.templates(sensor.white, darks)
    require_same_size(context, shots[0].mean.shape, darks, whites)
    white = white_of(context, whites, darks)
    noise = noise_of(context, shots, [white] * len(shots), darks)
    unit = context.unit_of(sensor.object[0])
    board = WhiteBoard(context.reflectance, pattern, labels, unit=unit)
    flat, record, series, area, notes = _flat(context, (shots, whites, darks), board, noise)
    record.sensor = _sensor_noise(context, noise, darks)
    record.clipped_darks = context.clipped_darks(darks)
    record.add([straightness(context, series)])
    notes += [*area.notes, *_doubts_of_noise(noise)]
    values, flags, variance = replace_defects(
        flat.values, flat.flags, flat.variance, pattern=pattern
    )
    if pattern is None:
        deep = values.shape if values.ndim == 3 else (*values.shape, 1)
        variance = None if variance is None else variance.reshape(deep)
        made = (values.reshape(deep), flags.reshape(deep), variance)
    else:
        record.sensels = sensels_of(values, flags, variance, pattern, labels)
        method = demosaicing_of(context.camera, sensor)
        made = demosaic(values, flags, variance, pattern, method=method, channels=labels)
    return SensorCube(cube_of(context, *made, flat.quantity, area.uncovered), notes, record)


def _sensor_noise(
    context: SensorCapture, noise: NoiseModel | None, darks: Sequence[Template]
) -> SensorNoise | None:
    dark = darks[0] if darks else None
    return sensor_noise(noise, dark, context.black or 0.0, context.saturation)


def _doubts_of_noise(noise: NoiseModel | None) -> list[Finding]:
    return [Finding("single_shots")] if noise is not None and noise.source == "spatial" else []


def demosaicing_of(camera: Camera, sensor: SensorFrames) -> str | None:
    """Return the method that is declared for a mosaic, or the kind's own; None for the pattern's own."""
    beam_splitter = camera.traits.bands_in == "sensors" and len(sensor.pattern or ()) == 2
    return camera.demosaic or ("bilinear" if beam_splitter else None)


def develop_image(context: SensorCapture) -> SensorCube:
    """A photograph or radiograph: nothing to calibrate, its codes as they are."""
    shot = context.average(context.sensor.object)
    shape = shot.mean.shape if shot.mean.ndim == 3 else (*shot.mean.shape, 1)
    values, notes = shot.mean.reshape(shape), []
    if shot.lost is not None:
        notes.append(lost_values(shot.lost, "all bands"))
        values = np.where(shot.lost.reshape(shape), np.float32(np.nan), values)
    flags = np.where(shot.saturated.reshape(shape), np.uint8(Flag.SATURATED), np.uint8(0))
    if shot.absent is not None:
        absent = shot.absent.reshape(shape)
        values = np.where(absent, np.float32(np.nan), values)
        flags = np.where(absent, np.uint8(Flag.OUTSIDE), flags)
    variance = None
    if shot.variance is not None:
        variance = mean_variance(shot, step=context.step).reshape(shape)
    values = np.ascontiguousarray(values, np.float32)
    return SensorCube(cube_of(context, values, flags, variance, "counts"), notes)


def develop_bands(context: SensorCapture) -> SensorCube:
    """One file a band: each with its own templates; behind narrow filters a mosaic is equalised."""
    bands = context.sensor.bands
    reflectances = np.broadcast_to(context.reflectance, len(bands))
    require_one_size(context)
    darks = context.templates([f for f in context.sensor.dark if f.band is None])
    noise, area, sensor = _noise_of_bands(context)
    shape = (*context.facts.shape[:2], len(bands))
    values, flags = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    variance: np.ndarray | None = np.empty(shape, np.float32)
    notes: list[Finding | str] = [*area.notes, *_doubts_of_noise(noise)]
    record = SensorRecord(sensor=sensor, clipped_darks=context.clipped_darks(darks))
    series: list[Series] = []
    quantity = "reflectance"
    for start in range(0, len(bands), GROUP):
        some = slice(start, start + GROUP)
        labels = [band.label for band in bands[some]]
        group = each(partial(_band, context, noise, area), labels, reflectances[some].tolist())
        flats = [one.values for one in group]
        notes += [note for one in group for note in one.notes]
        series += [found for one in group for found in one.series]
        record.add(one.record for one in group)
        quantity = flats[-1].quantity
        _interleave([flat.values for flat in flats], values, start)
        _interleave([flat.flags for flat in flats], flags, start)
        variances = [flat.variance for flat in flats if flat.variance is not None]
        if variance is not None and len(variances) == len(group):
            _interleave(variances, variance, start)
        else:
            variance = None
    record.add([straightness(context, series)])
    cube = cube_of(context, values, flags, variance, quantity, area.uncovered)
    return SensorCube(cube, notes, record)


def _interleave(planes: Sequence[np.ndarray], cube: np.ndarray, band: int) -> None:
    """Copy planes to a cube's bands from `band` on, in one passage over its memory."""

    def lay(start: int, stop: int, into: np.ndarray) -> None:
        for y in range(start, stop, ROWS):
            part = slice(y, min(y + ROWS, stop))
            rows = np.stack([plane[part] for plane in planes])
            turned = transpose(rows.reshape(len(planes), -1))
            into[part] = turned.reshape(*rows.shape[1:], -1)

    in_threads(lay, len(cube), cube[..., band : band + len(planes)])


def _band(
    context: SensorCapture,
    noise: NoiseModel | None,
    area: WhiteArea,
    label: str,
    reflectance: float,
) -> _Flat:
    """One band of one file, or of one file an exposure."""
    sensor = context.sensor
    stacks = _stacks_of_band(context, label)
    noise, unlike = noise_of_band(context, noise, *stacks)
    unit = context.unit_of(next(f for f in sensor.object if f.band == label))
    board = WhiteBoard(reflectance, labels=[label], unit=unit)
    looked_at = label in bands_of_series(sensor.object), label in bands_of_series(sensor.white)
    made = _flat(context, stacks, board, noise, area, band=label, looked_at=looked_at)
    if unlike != 1.0:
        made.record.unlike_noise[label] = rounded(unlike, 3)
    if any(f.band == label for f in sensor.dark):
        made.record.clipped_darks = context.clipped_darks(stacks[2], label)
    context.forget(label)
    flat = made.values
    plane = replace_defects(flat.values, flat.flags, flat.variance, pattern=sensor.pattern)
    if sensor.pattern is not None:
        plane = equalise_phases(*plane, sensor.pattern)
    flat = replace(flat, values=plane[0], flags=plane[1], variance=plane[2])
    return made._replace(values=flat)


def _of_band(frames: Sequence[FrameRef], label: str) -> list[FrameRef]:
    """Templates of one band: its own where frames carry a band, else those shared by all."""
    own = [f for f in frames if f.band == label]
    return own or [f for f in frames if f.band is None]


def _stacks_of_band(
    context: SensorCapture, label: str
) -> tuple[list[Template], list[Template], list[Template]]:
    """Return shots, whites and darks of a band, each exposure by exposure."""
    sensor = context.sensor
    darks = context.templates(_of_band(sensor.dark, label))
    shots = average_shots(context, [f for f in sensor.object if f.band == label], darks)
    frames = _of_band(sensor.white, label)
    if sensor.white and not frames:
        folder = str(sensor.white[0].path.parent)
        raise refusal("white_missing", label, file=folder, camera=context.camera.name)
    whites = context.templates(frames, darks)
    require_same_size(context, shots[0].mean.shape, darks, whites)
    return shots, whites, darks


def require_one_size(context: SensorCapture) -> None:
    """Refuse bands of another size than most of them, before any statistic takes several together."""
    sizes = {f.path: read_facts(f.path).shape[:2] for f in context.sensor.object}
    usual = Counter(sizes.values()).most_common(1)[0][0]
    problems = [
        Finding(
            "band_size",
            frame.band or "",
            file=str(frame.path),
            found="{1} x {0}".format(*sizes[frame.path]),
            expected="{1} x {0}".format(*usual),
        ).problem()
        for frame in context.sensor.object
        if sizes[frame.path] != usual
    ]
    if problems:
        raise CalibrationRefused(*problems[:MOST_PROBLEMS])


def _noise_of_bands(
    context: SensorCapture,
) -> tuple[NoiseModel | None, WhiteArea, SensorNoise | None]:
    """Fit the sensor's noise once, on a few bands spread over the range: it is the same sensor.

    The same bands show where the white shows the object in place of the board.
    """
    bands = context.sensor.bands
    chosen = sorted({len(bands) // 4, len(bands) // 2, (3 * len(bands)) // 4})
    found = each(partial(_white_of_band, context), [bands[i].label for i in chosen])
    shots, whites, sets, areas = zip(*found, strict=True)
    own_darks = any(f.band for f in context.sensor.dark)
    darks = [dark for some in (sets if own_darks else sets[:1]) for dark in some]
    noise = noise_of(context, [*shots], [*whites], darks)
    return noise, joined_area(areas), _sensor_noise(context, noise, darks)


def _white_of_band(
    context: SensorCapture, label: str
) -> tuple[Template, Template | None, list[Template], WhiteArea]:
    """Return shot, white and darks of one band at its first exposure, and where the white shows the board."""
    shots, whites, darks = _stacks_of_band(context, label)
    first = next(f for f in context.sensor.object if f.band == label)
    time = exposure_of(first)
    shot = next(one for one in shots if one.exposure_s == time)
    white = white_of(context, whites, darks, band=label)
    return shot, white, darks, white_area_of(context, shot, white, darks)


def developer_of(camera: Camera) -> Callable[[SensorCapture], SensorCube]:
    """Return the function that the row of a camera's kind names (`levkas.campaign.camera_kinds.KINDS`)."""
    module, _, name = camera.traits.develop.partition(":")
    found: Callable[[SensorCapture], SensorCube] = getattr(import_module(module), name)
    return found

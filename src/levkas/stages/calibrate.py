"""Raw frames of one capture to calibrated cubes in native pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.agreement import compare_facts
from levkas.calibration.chart_light import CHART_WHITE
from levkas.calibration.code_checks import CodesRefused
from levkas.calibration.defects import replace_defects
from levkas.calibration.equalising import equalise_phases
from levkas.calibration.flatfield import Calibrated
from levkas.calibration.mosaic import demosaic
from levkas.calibration.noise_fit import mean_variance
from levkas.calibration.sensor_context import (
    SensorContext,
    exposure_of,
    placed,
    placing,
)
from levkas.calibration.sensor_notes import describe_sensor, doubts_of
from levkas.calibration.stated_exposures import require_black, require_exposures
from levkas.calibration.templates import CalibrationRefused, Template, describe_gaps
from levkas.calibration.white_area import WhiteArea, joined_area
from levkas.calibration.whites import WhiteBoard
from levkas.core.cube import Cube, Flag
from levkas.core.files import remove, together
from levkas.core.problems import Problem, Refused, gathered
from levkas.core.threads import each, in_threads
from levkas.core.transpose import transpose
from levkas.database.registrations import read_registration
from levkas.readers.frames import UnreadableCapture, read_facts
from levkas.stages.above_white import count_above, describe_above, require_light
from levkas.stages.capture_statistics import (
    describe_lamp,
    focus_of,
    note_light,
    note_sensels,
    note_traps,
)
from levkas.stages.chart_white import lights_by_chart
from levkas.stages.exposures import (
    average_shots,
    check_scaling,
    cube_of,
    defects_of,
    expose,
    flatten,
    mark_glare_in,
    noise_of,
    noise_of_band,
    require_same_size,
    require_white,
    white_area_of,
    white_of,
)
from levkas.stages.native_files import filed_parts, part_name, require_memory, write_native
from levkas.stages.parts import CalibratedCapture, Part, Placement, median_focus
from levkas.stages.scans import develop_scan, is_streamed, open_scan
from levkas.stages.shared_noise import Mosaic
from levkas.stages.spectra import board_of, broad_centroids, credits_of
from levkas.stages.written import Written

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.calibration.chart_light import ChartLight
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.campaign.campaign import Camera, Campaign
    from levkas.campaign.discovery.captures import Capture, FrameRef, SensorFrames
    from levkas.database.layout import Places
    from levkas.stages.template_cache import TemplateCache

MOST_PROBLEMS = 50
Noted = tuple[Cube, list[str]]
"""Of one sensor, and what a person should know of it."""


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
            tuple(_contradictions(capture, campaign, templates)),
            coming=(develop(tile, campaign, templates) for tile in capture.tiles),
        )
    if is_streamed(capture, campaign):
        return open_scan(capture, campaign, templates)
    require_memory(capture, campaign.cameras[capture.camera].kind)
    return develop(capture, campaign, templates)


def _contradictions(
    capture: Capture, campaign: Campaign, templates: TemplateCache
) -> Iterator[str]:
    """Compare what files of different tiles state; raises CalibrationRefused where they contradict each other."""
    where, camera = f"{capture.object}/{capture.layer}", campaign.cameras[capture.camera]
    for sensor in capture.sensors:
        facts = read_facts(sensor.object[0].path)
        context = SensorContext(campaign, camera, sensor, facts, templates)
        notes = compare_facts(camera, sensor, context.alignments)
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
    folder, files, quantity = folder_of(capture, campaign, places), [], "reflectance"
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
    try:
        if campaign.cameras[capture.camera].traits.is_scanned:
            return develop_scan(capture, campaign, templates)
        return _develop_frames(capture, campaign, templates)
    except (UnreadableCapture, CodesRefused) as refused:
        raise type(refused)(*_all_problems(capture, campaign, templates, refused)) from None


def _develop_frames(
    capture: Capture, campaign: Campaign, templates: TemplateCache
) -> CalibratedCapture:
    camera, mosaics = campaign.cameras[capture.camera], mosaics_of(capture, campaign)
    parts, notes, captured, focus = [], [], None, []
    measured: dict[str, dict[str, Any]] = {}
    lights = _lights_of(capture, campaign, templates)
    traps = capture.boxes(campaign.targets.traps.get(capture.object, {}))
    contexts = []
    for sensor in capture.sensors:
        board, facts = board_of(campaign, capture, sensor), read_facts(sensor.object[0].path)
        contexts.append(
            SensorContext(
                *(campaign, camera, sensor, facts, templates),
                light=lights.get(sensor.name),
                reflectance=board.reflectance,
                doubts=board.notes,
            )
        )
    notes += _compare_all(contexts)
    for context in contexts:
        sensor, light = context.sensor, context.light
        captured = captured or context.facts.captured
        if camera.traits.is_calibrated:
            require_exposures(context)
            require_black(context)
        notes += doubts_of(context)
        if light is not None:
            _require_chart_of_size(context, light)
            context.measured[CHART_WHITE] = dict(light.record)
        cube, found = developer_of(camera)(context)
        cube = mark_glare_in(cube)
        context.note_bend()
        notes += [*found, *describe_sensor(context)]
        notes += note_traps(context.measured, cube, traps.get(sensor.name, []), capture.object)
        counts = count_above(cube)
        with placing(sensor.object):
            require_light(counts, cube.labels)
        notes += describe_above(counts, cube.labels)
        measured[sensor.name] = context.measured
        focus += focus_of([cube])
        parts.append(Part.held(cube, sensor.name, mosaic=mosaics.get(sensor.name)))
        del cube  # its sigma, which is packed
    notes += describe_lamp(measured)
    aligns = {sensor.name: sensor.align for sensor in capture.sensors}
    where = f"{capture.object}/{capture.layer}"
    warnings = tuple(dict.fromkeys(f"{where}: {note}" for note in notes if note))
    return CalibratedCapture(parts, aligns, captured, warnings, measured, focus)


def _compare_all(contexts: Sequence[SensorContext]) -> list[str]:
    """Compare what the files of every sensor state; return notes. Raises CalibrationRefused with all contradictions."""
    notes: list[str] = []
    problems: list[Problem] = []
    for context in contexts:
        try:
            notes += compare_facts(context.camera, context.sensor, context.alignments)
        except CalibrationRefused as refused:
            problems += refused.problems
    if problems:
        raise CalibrationRefused(*problems)
    return notes


def _lights_of(
    capture: Capture, campaign: Campaign, templates: TemplateCache
) -> dict[str, ChartLight]:
    """Return the light of every sensor by the chart that is its white; nothing where there is no such chart."""
    if not any(sensor.chart for sensor in capture.sensors):
        return {}
    sensors = tuple(replace(s, object=s.chart, chart=()) for s in capture.sensors)
    made = develop(replace(capture, sensors=sensors), campaign, templates)
    return lights_by_chart(capture, campaign, made)


def _require_chart_of_size(context: SensorContext, light: ChartLight) -> None:
    """Refuse a chart whose frames have another size than the object's: its light lies elsewhere."""
    height, width = context.facts.shape[:2]
    size = light.size
    if (height, width) != size:
        problem = Problem(
            "E_SIZE",
            f"{context.camera.name}: chart and object differ in size",
            field=f"cameras.{context.camera.name}.white.chart",
            found=f"{size[1]} x {size[0]}",
            expected=f"{width} x {height}",
            fix="Capture the chart in the object's mode.",
        )
        raise CalibrationRefused(placed(problem, context.sensor.chart))


def _all_problems(
    capture: Capture, campaign: Campaign, templates: TemplateCache, first: Refused
) -> list[Problem]:
    """What is wrong with every frame of a capture: who mends one wants to know of the others."""
    problems = list(first.problems)
    for sensor in capture.sensors:
        for frame in (*sensor.object, *sensor.white, *sensor.dark, *sensor.chart):
            try:
                facts = read_facts(frame.path)
                context = SensorContext(
                    campaign, campaign.cameras[capture.camera], sensor, facts, templates
                )
                context.checked(context.frame(frame), frame)
            except Refused as refused:
                problems += refused.problems
            if len(problems) > MOST_PROBLEMS:
                return gathered(problems, cut=True)
    return gathered(problems)


def develop_mosaic(context: SensorContext) -> Noted:
    """A mosaic: flat field on the mosaic, then demosaic; or a sensor without one."""
    sensor, camera = context.sensor, context.camera
    darks = context.darks(sensor.dark)
    shots = average_shots(context, sensor.object, darks)
    whites = context.templates(sensor.white, darks)
    require_same_size(context, shots[0].mean.shape, darks, whites)
    white = white_of(context, whites, darks)
    require_white(context, white, darks, [band.label for band in sensor.bands])
    noise = noise_of(context, shots, [white] * len(shots), darks)
    exposed = expose(context, shots, darks, noise)
    if exposed.shot.above_dark:
        white = white_of(context, whites, darks, noise=noise, merged=True)
    area = white_area_of(context, exposed.shot, white, darks)
    notes = [check_scaling(context, exposed, white, (shots, whites), darks), *area.notes]
    pattern = sensor.pattern
    note_light(context.measured, white, darks, pattern, [b.label for b in sensor.bands])
    defects = defects_of(darks, white, pattern, area.uncovered)
    flat = flatten(
        context,
        exposed.shot,
        darks,
        white,
        moved=exposed.moved,
        board=WhiteBoard(
            *(context.reflectance, pattern, [b.label for b in sensor.bands]),
            unit=context.unit_of(sensor.object[0]),
        ),
        noise=noise,
        defects=defects,
    )
    notes.extend(flat.notes)
    values, flags, variance = replace_defects(
        flat.values, flat.flags, flat.variance, pattern=pattern
    )
    if pattern is None:
        deep = values.shape if values.ndim == 3 else (*values.shape, 1)
        variance = None if variance is None else variance.reshape(deep)
        deepened = (values.reshape(deep), flags.reshape(deep), variance)
        return cube_of(context, *deepened, flat.quantity, area.uncovered), notes
    note_sensels(
        context.measured, values, flags, variance, pattern, [b.label for b in sensor.bands]
    )
    made = demosaic(
        values,
        flags,
        variance,
        pattern,
        method=demosaicing_of(camera, sensor),
        channels=[b.label for b in sensor.bands],
    )
    return cube_of(context, *made, flat.quantity, area.uncovered), notes


def demosaicing_of(camera: Camera, sensor: SensorFrames) -> str | None:
    """Return the method that is declared for a mosaic, or the kind's own; None for the pattern's own."""
    beam_splitter = camera.traits.bands_in == "sensors" and len(sensor.pattern or ()) == 2
    return camera.demosaic or ("bilinear" if beam_splitter else None)


def develop_image(context: SensorContext) -> Noted:
    """A photograph or radiograph: nothing to calibrate, its codes as they are."""
    shot = context.average(context.sensor.object)
    values = shot.mean[..., None] if shot.mean.ndim == 2 else shot.mean
    notes = []
    if shot.lost is not None:
        notes.append(describe_gaps(shot.lost, context.camera.name))
        values = np.where(shot.lost.reshape(values.shape), np.float32(np.nan), values)
    saturated = shot.saturated.reshape(values.shape)
    flags = np.where(saturated, np.uint8(Flag.SATURATED), np.uint8(0))
    if shot.absent is not None:
        absent = shot.absent.reshape(values.shape)
        values = np.where(absent, np.float32(np.nan), values)
        flags = np.where(absent, np.uint8(Flag.OUTSIDE), flags)
    variance = None
    if shot.variance is not None:
        variance = mean_variance(shot, step=context.step).reshape(values.shape)
    values = np.ascontiguousarray(values, np.float32)
    return cube_of(context, values, flags, variance, "counts"), notes


GROUP, ROWS = 8, 16
"""Bands that are laid into a cube in one passage over some rows, in which they lie innermost."""


def develop_bands(context: SensorContext) -> Noted:
    """One file a band: each with its own templates; behind narrow filters a mosaic is equalised."""
    bands = context.sensor.bands
    reflectances = np.broadcast_to(context.reflectance, len(bands))
    require_one_size(context)
    noise, area = _noise_of_bands(context)
    shape = (*context.facts.shape[:2], len(bands))
    values, flags = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    variance: np.ndarray | None = np.empty(shape, np.float32)
    notes: list[str] = [*area.notes]
    quantity = "reflectance"
    for start in range(0, len(bands), GROUP):
        some = slice(start, start + GROUP)
        labels = [band.label for band in bands[some]]
        group = each(partial(_band, context, noise, area), labels, reflectances[some].tolist())
        for flat in group:
            notes.extend(flat.notes)
            quantity = flat.quantity
        _interleave([flat.values for flat in group], values, start)
        _interleave([flat.flags for flat in group], flags, start)
        variances = [flat.variance for flat in group if flat.variance is not None]
        if variance is not None and len(variances) == len(group):
            _interleave(variances, variance, start)
        else:
            variance = None
    _put_in_order(context.measured, [band.label for band in bands])
    return cube_of(context, values, flags, variance, quantity, area.uncovered), notes


def _put_in_order(measured: dict[str, Any], labels: Sequence[str]) -> None:
    """Put what was measured band by band in the order of the bands, whichever was done first."""
    for name, value in measured.items():
        if isinstance(value, dict) and value.keys() <= set(labels):
            measured[name] = {label: value[label] for label in labels if label in value}


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
    context: SensorContext,
    noise: NoiseModel | None,
    area: WhiteArea,
    label: str,
    reflectance: float,
) -> Calibrated:
    """One band of one file, or of one file an exposure."""
    sensor = context.sensor
    darks = context.darks(_of_band(sensor.dark, label))
    shots = average_shots(context, [f for f in sensor.object if f.band == label], darks)
    frames = _require(_of_band(sensor.white, label), context, label)
    whites = context.templates(frames, darks)
    require_same_size(context, shots[0].mean.shape, darks, whites)
    noise = noise_of_band(context, noise, shots, whites, darks, label)
    exposed = expose(context, shots, darks, noise)
    white = white_of(
        *(context, whites, darks), noise=noise, merged=exposed.shot.above_dark, band=label
    )
    require_white(context, white, darks, [label])
    doubt = check_scaling(context, exposed, white, (shots, whites), darks)
    note_light(context.measured, white, darks, None, [label])
    flat = flatten(
        context,
        exposed.shot,
        darks,
        white,
        moved=exposed.moved,
        board=WhiteBoard(
            reflectance,
            labels=[label],
            unit=context.unit_of(next(f for f in sensor.object if f.band == label)),
        ),
        noise=noise,
        defects=defects_of(darks, white, sensor.pattern, area.uncovered),
    )
    plane = replace_defects(flat.values, flat.flags, flat.variance, pattern=sensor.pattern)
    if sensor.pattern is not None:
        plane = equalise_phases(*plane, sensor.pattern)
    notes = tuple(note for note in (*flat.notes, doubt) if note)
    return replace(flat, values=plane[0], flags=plane[1], variance=plane[2], notes=notes)


def _require(frames: list[FrameRef], context: SensorContext, label: str) -> list[FrameRef]:
    if not frames and context.sensor.white:
        raise CalibrationRefused(
            Problem(
                "E_TEMPLATE_MISSING",
                f"{context.camera.name}: no white for band {label}",
                str(context.sensor.white[0].path.parent),
                f"cameras.{context.camera.name}.files",
                "no file",
                f"a white frame of {label}",
                "Add the frame, or remove the band from `wavelengths`.",
            )
        )
    return frames


def _of_band(frames: Sequence[FrameRef], label: str) -> list[FrameRef]:
    """Templates of one band: its own where frames carry a band, else those shared by all."""
    own = [f for f in frames if f.band == label]
    return own or [f for f in frames if f.band is None]


def require_one_size(context: SensorContext) -> None:
    """Refuse bands of another size than most of them, before any statistic takes several together."""
    sizes = {f.path: read_facts(f.path).shape[:2] for f in context.sensor.object}
    usual = Counter(sizes.values()).most_common(1)[0][0]
    problems = [
        Problem(
            "E_SIZE",
            f"{context.camera.name}: band {frame.band} differs in size from the other bands",
            str(frame.path),
            "width, height",
            f"{sizes[frame.path][1]} x {sizes[frame.path][0]}",
            f"{usual[1]} x {usual[0]}",
            "Use a frame of the correct camera, captured in the mode of the others.",
        )
        for frame in context.sensor.object
        if sizes[frame.path] != usual
    ]
    if problems:
        raise CalibrationRefused(*problems[:MOST_PROBLEMS])


def _noise_of_bands(context: SensorContext) -> tuple[NoiseModel | None, WhiteArea]:
    """Fit the sensor's noise once, on a few bands spread over the range: it is the same sensor.

    The same bands show where the white shows the object in place of the board.
    """
    bands = context.sensor.bands
    chosen = sorted({len(bands) // 4, len(bands) // 2, (3 * len(bands)) // 4})
    found = each(partial(_white_of_band, context), [bands[i].label for i in chosen])
    shots, whites, sets, areas = zip(*found, strict=True)
    own_darks = any(f.band for f in context.sensor.dark)
    darks = [dark for some in (sets if own_darks else sets[:1]) for dark in some]
    return noise_of(context, [*shots], [*whites], darks), joined_area(areas)


def _white_of_band(
    context: SensorContext, label: str
) -> tuple[Template, Template | None, list[Template], WhiteArea]:
    """Return shot, white and darks of one band at its first exposure, and where the white shows the board."""
    frames = [f for f in context.sensor.object if f.band == label]
    alike = [f for f in frames if exposure_of(f) == exposure_of(frames[0])]
    darks = context.darks(_of_band(context.sensor.dark, label))
    (shot,) = average_shots(context, alike, darks)
    whites = context.templates(_of_band(context.sensor.white, label), darks)
    white = white_of(context, whites, darks, band=label)
    require_same_size(context, shot.mean.shape, darks, [white] if white else [])
    return shot, white, darks, white_area_of(context, shot, white, darks)


def developer_of(camera: Camera) -> Callable[[SensorContext], Noted]:
    """Return the function that the row of a camera's kind names (`levkas.campaign.camera_kinds.KINDS`)."""
    module, _, name = camera.traits.develop.partition(":")
    found: Callable[[SensorContext], Noted] = getattr(import_module(module), name)
    return found

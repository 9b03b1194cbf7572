"""A large line scan as a build opens it: its templates, and what they tell before a line is read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from levkas.building.exposures import require_same_size
from levkas.building.line_templates import FrameLines, best_white, noise_behind_mirror
from levkas.building.scans import Scan, lines_at_once
from levkas.calibration.sensor_context import (
    doubt_scaling,
    require_exposures,
    templates_by_exposure,
    timed,
    times_in,
    times_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from levkas.calibration.sensor_context import SensorContext
    from levkas.calibration.templates import Template
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture


def open_scan(capture: Capture, campaign: Campaign, shelf: Any) -> Scan:
    """Average the templates of a push-broom scan, open those of a mirror scanner; no line of the object is read.

    Raises Refused as `developing.develop` does.
    """
    from levkas.building.spectra import white_reflectance
    from levkas.calibration.sensor_context import SensorContext, doubts_of
    from levkas.readers.envi import open_envi
    from levkas.readers.frames import read_facts

    sensor = capture.sensors[0]
    facts = read_facts(sensor.object[0].path)
    bench = SensorContext(campaign, campaign.cameras[capture.camera], sensor, facts, shelf)
    require_exposures(bench)
    prepare = _of_frames if bench.camera.scan == "mirror" else _of_lines
    darks, white, noise = prepare(bench)
    where = f"{capture.object}/{capture.layer}"
    return Scan(
        open_envi(sensor.object[0].path),
        bench,
        darks,
        white,
        noise,
        white_reflectance(campaign, sensor.bands),
        where,
        facts.captured,
        tuple(
            f"{where}: {doubt}" for doubt in (*doubts_of(bench), *_doubt_times(bench, darks, white))
        ),
        {sensor.name: sensor.align},
    )


def _doubt_times(
    bench: SensorContext,
    darks: tuple[Template | FrameLines, ...],
    white: Template | FrameLines | None,
) -> list[str]:
    """Return what exposures leave in doubt, as `developing.develop_cube` notes it."""
    import numpy as np

    from levkas.calibration.flatfield import describe_darks
    from levkas.calibration.templates import Template

    times = times_of(bench.sensor.object[0])
    first = [one.lines(0, 1) if isinstance(one, FrameLines) else one for one in darks]
    lit = white.lines(0, 1) if isinstance(white, FrameLines) else white
    doubts = [doubt_scaling(bench, times, times_in(lit))] if lit is not None else []
    none = np.zeros((1, 1, len(bench.sensor.bands)), bool)
    shot = timed(Template(none.astype(np.float32), None, 1, none, none), times)
    return [doubt for doubt in (*doubts, *describe_darks(shot, first, lit, bench.black)) if doubt]


def _of_lines(bench: SensorContext) -> tuple[tuple[Template, ...], Template | None, Any]:
    """Return darks, white and noise of a push-broom camera: one line, seen many times."""
    from levkas.building.capture_statistics import note_light
    from levkas.building.exposures import line_noise
    from levkas.calibration.pushbroom import average_lines

    def make(frames: Any) -> Template:
        blocks = (bench.checked(block, frame) for frame in frames for block in _line_blocks(frame))
        return bench.whole(average_lines(blocks, saturation=bench.saturation), frames)

    sensor = bench.sensor
    darks, whites = (templates_by_exposure(f, make) for f in (sensor.dark, sensor.white))
    require_same_size(bench, bench.facts.shape, darks, whites)
    white = whites[best_white(whites)] if whites else None
    labels = [band.label for band in sensor.bands]
    note_light(bench.told, white, darks, None, labels)
    return tuple(darks), white, line_noise(bench, darks, white)


def _of_frames(bench: SensorContext) -> tuple[tuple[FrameLines, ...], FrameLines | None, Any]:
    """Return darks, white and noise of a mirror scanner; its white is looked at by every so-many-th pixel.

    Raises CalibrationRefused as `flat_field` does of the whole.
    """
    from levkas.building.capture_statistics import note_light
    from levkas.calibration.darks import level_under
    from levkas.calibration.sensor_context import placed
    from levkas.calibration.templates import CalibrationRefused
    from levkas.calibration.whites import check_white, thinning

    sensor, shape = bench.sensor, tuple(int(n) for n in bench.facts.shape)
    labels = [band.label for band in sensor.bands]
    darks, whites = (
        FrameLines.by_exposure(bench, frames, shape)  # type: ignore[arg-type]
        for frames in (sensor.dark, sensor.white)
    )
    white = None
    if whites:
        step = thinning(shape[:2])
        looked = [one.thinned(step) for one in whites]
        chosen = best_white(looked)
        white, seen, under = whites[chosen], looked[chosen], [dark.thinned(step) for dark in darks]
        try:
            check_white(seen, level_under(seen, under, black=bench.black), None, labels)
        except CalibrationRefused as refused:
            raise CalibrationRefused(*(placed(p, sensor.white) for p in refused.problems)) from None
        note_light(bench.told, seen, under, None, labels, period=(step, step))
    return tuple(darks), white, noise_behind_mirror(bench, white.frames[0] if white else None)


def _line_blocks(frame: Any) -> Iterator[np.ndarray]:
    from levkas.calibration.sensor_context import read_cube
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

"""A large line scan as a build opens it: its templates, and what they tell before a line is read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from levkas.building.flatfielding import require_same_size
from levkas.building.line_templates import FrameLines, noise_behind_mirror
from levkas.building.scans import Scan, lines_at_once

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from levkas.building.bench import Bench
    from levkas.calibration.templates import Template
    from levkas.campaign import Campaign
    from levkas.discovery import Capture


def open_scan(capture: Capture, campaign: Campaign, shelf: Any) -> Scan:
    """Average the templates of a push-broom scan, open those of a mirror scanner; no line of the object is read.

    Raises Refused as `developing.develop` does.
    """
    from levkas.building.bench import Bench, doubts_of
    from levkas.building.whiteboard import white_reflectance
    from levkas.readers.envi import open_envi
    from levkas.readers.frames import read_facts

    sensor = capture.sensors[0]
    facts = read_facts(sensor.object[0].path)
    bench = Bench(campaign, campaign.cameras[capture.camera], sensor, facts, shelf)
    prepare = _of_frames if bench.camera.scan == "mirror" else _of_lines
    dark, white, noise = prepare(bench)
    where = f"{capture.object}/{capture.layer}"
    return Scan(
        open_envi(sensor.object[0].path),
        bench,
        dark,
        white,
        noise,
        white_reflectance(campaign, sensor.bands),
        where,
        facts.captured,
        tuple(f"{where}: {doubt}" for doubt in doubts_of(bench)),
        {sensor.name: sensor.align},
    )


def _of_lines(bench: Bench) -> tuple[Template | None, Template | None, Any]:
    """Return dark, white and noise of a push-broom camera: one line, seen many times."""
    from levkas.building.developing import line_noise
    from levkas.building.measuring import note_light
    from levkas.calibration.scanning import average_lines

    def template(frames: Any) -> Template | None:
        if not frames:
            return None
        blocks = (bench.checked(block, frame) for frame in frames for block in _line_blocks(frame))
        return bench.whole(average_lines(blocks, saturation=bench.saturation), frames)

    sensor = bench.sensor
    dark, white = template(sensor.dark), template(sensor.white)
    require_same_size(bench, bench.facts.shape, [dark] if dark else [], [white] if white else [])
    labels = [band.label for band in sensor.bands]
    note_light(bench.told, white, [dark] if dark else [], None, labels)
    return dark, white, line_noise(bench, dark, white)


def _of_frames(bench: Bench) -> tuple[FrameLines | None, FrameLines | None, Any]:
    """Return dark, white and noise of a mirror scanner; its white is looked at by every so-many-th pixel.

    Raises CalibrationRefused as `flat_field` does of the whole.
    """
    from levkas.building.bench import placed
    from levkas.building.measuring import note_light
    from levkas.calibration.darks import match_dark
    from levkas.calibration.templates import CalibrationRefused
    from levkas.calibration.whites import check_white, thinning

    sensor, shape = bench.sensor, tuple(int(n) for n in bench.facts.shape)
    labels = [band.label for band in sensor.bands]
    dark, white = (FrameLines.of(bench, f, shape) for f in (sensor.dark, sensor.white))  # type: ignore[arg-type]
    if white is not None:
        step = thinning(white.opened[0].facts.shape[:2])
        seen, under = white.thinned(step), [dark.thinned(step)] if dark else []
        try:
            check_white(seen, match_dark(under or None, None, black=bench.black), None, labels)
        except CalibrationRefused as refused:
            raise CalibrationRefused(*(placed(p, sensor.white) for p in refused.problems)) from None
        note_light(bench.told, seen, under, None, labels, period=(step, step))
    return dark, white, noise_behind_mirror(bench)


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

"""Cameras with a file a band: tunable filters and filter wheels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from levkas.building.bench import Bench, exposure_of
from levkas.building.exposing import average_shots, check_scaling, expose, noise_of, white_of
from levkas.building.flatfielding import cube_of, defects_of, flatten, require_same_size
from levkas.building.native import GROUP, ROWS
from levkas.building.whiteboard import white_reflectance
from levkas.calibration.flatfield import Calibrated
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.core.cube import Cube
from levkas.core.problems import Problem

if TYPE_CHECKING:
    from levkas.calibration.noise_fit import NoiseModel
    from levkas.campaign.discovery.captures import FrameRef


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
    shots = average_shots(bench, [f for f in sensor.object if f.band == label])
    frames = _require(_of_band(sensor.white, label), bench, label)
    whites = bench.templates(frames) if frames else []
    require_same_size(bench, shots[0].mean.shape, darks, whites)
    exposed = expose(bench, shots, darks, noise)
    white = white_of(bench, frames, darks, noise=noise, merged=exposed.shot.above_dark)
    doubt = check_scaling(bench, exposed, white, (shots, whites), darks)
    note_light(bench.told, white, darks, None, [label])
    flat = flatten(
        bench,
        exposed.shot,
        darks,
        white,
        moved=exposed.moved,
        white_reflectance=reflectance,
        noise=noise,
        defects=defects_of(darks, white, sensor.pattern),
        labels=[label],
    )
    plane = replace_defects(flat.values, flat.flags, flat.variance, pattern=sensor.pattern)
    if sensor.pattern is not None:
        plane = equalise_phases(*plane, sensor.pattern)
    notes = (*flat.notes, doubt) if doubt else flat.notes
    return replace(flat, values=plane[0], flags=plane[1], variance=plane[2], notes=notes)


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
    shots, whites, darks = [], [], list[Template]()
    for i in chosen:
        label = bands[i].label
        frames = [f for f in bench.sensor.object if f.band == label]
        alike = [f for f in frames if exposure_of(f) == exposure_of(frames[0])]
        shots.append(bench.average(alike))
        own = bench.templates(_of_band(bench.sensor.dark, label))
        white = white_of(bench, _of_band(bench.sensor.white, label), own)
        require_same_size(bench, shots[-1].mean.shape, own, [white] if white else [])
        whites.append(white)
        darks += own if any(f.band for f in bench.sensor.dark) or not darks else []
    return noise_of(bench, shots, whites, darks)

"""Every band of one capture on the grid, each pixel interpolated once."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.chart_light import LightNodes, light_variance, variance_under_light
from levkas.core.cube import Cube, Flag, is_flagged
from levkas.core.disk import require_space
from levkas.core.rounding import round_root, round_values
from levkas.database.credits import credits_of
from levkas.database.grey import grey_of, read_grey
from levkas.database.layers import Layer, write_layer
from levkas.database.preview import encode_png
from levkas.geometry.grid import Grid
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Composed, Transform
from levkas.quality.evaluation.similarity import structural_similarity
from levkas.quality.image_quality.glare import setup_gains
from levkas.stages.calibrate import demosaicing_of
from levkas.stages.capture_statistics import (
    DefaultLayer,
    count_flags,
    describe_flags,
    flag_and_count,
    ranges_of,
)
from levkas.stages.native_cubes import FiledSigma, Native, PackedSigma, least_bytes
from levkas.stages.reference import ReferenceFrame, maps_of
from levkas.stages.shared_noise import Mosaic, shared_by_strips, shared_noise
from levkas.stages.spectra import broad_centroids
from levkas.stages.streaming import Passing, resample_scan, white_of
from levkas.stages.written import Written

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.catalogue import Entry
    from levkas.stages.scans import Scan

LONGEST_MAP = 640
"""Longest side of an SSIM map on a page, px."""
LIGHT_NODES = 97
"""Places a side of the grid at which the sigma of a chart's light is looked up."""


@dataclass(frozen=True)
class GridTarget:
    """The layer that a capture is resampled to.

    Parameters
    ----------
    capture : Capture
    layer : Layer
    grid : Grid
    transforms : dict of label to Transform
        Reference px → native px.
    verdict : str
        Of the registration, for the catalogue.
    encoded : bool
        Whether values are those of an image file, which are shown as they are.
    default : DefaultLayer or None
        The same camera's layer under its default setup, where it was published like this one.
    """

    capture: Capture
    layer: Layer
    grid: Grid
    transforms: dict[str, Transform]
    verdict: str
    encoded: bool
    default: DefaultLayer | None


def target_of(
    capture: Capture,
    native: Native | Scan,
    frame: ReferenceFrame,
    record: dict[str, Any],
    captured: str,
) -> GridTarget:
    """Return the layer that a capture is resampled to; `record` is that of its registration."""
    campaign, places, name = frame.campaign, frame.places, capture.object
    grid, sampling, _ = frame.layout()
    layer = Layer(
        *(name, capture.camera, capture.setup, sampling or nan),
        credits_of(campaign, name, captured),
        broad_centroids(campaign, capture.camera, capture.bands),
    )
    shape = (grid.size[1], grid.size[0], len(native.bands))
    default = None
    if capture.setup and native.quantity == "reflectance":
        values, flags = (places.layer(name, capture.camera, kind=k) for k in (".tif", ".flags.tif"))
        default = DefaultLayer.open(values, flags, shape)
    encoded = not campaign.cameras[capture.camera].traits.is_calibrated
    verdict = record["verdict"]["decision"]
    return GridTarget(capture, layer, grid, maps_of(record), verdict, encoded, default)


def mosaics_of(capture: Capture, campaign: Campaign) -> dict[str, Mosaic]:
    """Return the sensors of a capture whose values were demosaiced."""
    camera = campaign.cameras[capture.camera]
    if not camera.traits.is_demosaiced:
        return {}
    return {
        s.name: Mosaic(s.pattern, demosaicing_of(campaign, camera, s), [b.label for b in s.bands])
        for s in capture.sensors
        if s.pattern is not None
    }


def flag_glare_in(cube: Cube, target: GridTarget) -> dict[str, int]:
    """Set the flags of glare in a layer; return the pixels by sign."""
    return flag_and_count(cube, target.default.rows() if target.default else None)


def write_resampled(
    cube: Cube,
    glare: dict[str, int],
    target: GridTarget,
    frame: ReferenceFrame,
    before: Callable[[], object],
) -> Written:
    """Write a layer; `before` as of `core.files.together`."""
    least = least_bytes(cube.values.size, cube.quantity, noisy=cube.sigma is not None)
    require_space(frame.places.output, 2 * least)  # as TIFF and as Zarr
    entry, files = write_layer(
        frame.places.output,
        target.layer,
        cube,
        verdict=target.verdict,
        encoded=target.encoded,
        before=before,
    )
    ranges = ranges_of(cube)
    grey = grey_of(cube.values, cube.flags)
    notes = _notes(entry, similarity(frame, target.capture, grey), count_flags(cube.flags))
    return Written(files, {**notes, "glare": glare, "ranges": ranges})


def stream_resampled(
    scan: Scan, target: GridTarget, frame: ReferenceFrame, before: Callable[[], object]
) -> Written:
    """Resample and write a scan some rows at a time; `before` as of `core.files.together`."""
    grid, default = target.grid, target.default
    maps = [Composed(grid.transform, target.transforms[band.label]) for band in scan.bands]
    passing = Passing(default, gains_of_scan(default, scan, maps) if default else None)
    rows = resample_scan(scan, maps, grid.size, spool=frame.places.kept)
    entry, files = write_layer(
        frame.places.output,
        target.layer,
        replace(rows, blocks=passing.noting(rows.blocks)),
        verdict=target.verdict,
        white=white_of(scan),
        before=before,
    )
    notes = _notes(entry, similarity(frame, target.capture, passing.grey), passing.flags)
    return Written(files, {**notes, "glare": passing.glare, "ranges": passing.ranges(scan.bands)})


def _notes(entry: Entry, similar: dict[str, Any], flags: np.ndarray) -> dict[str, Any]:
    return {**similar, "flags": describe_flags(flags), "entry": entry.to_row()}


def similarity(
    frame: ReferenceFrame, capture: Capture, grey: tuple[np.ndarray, np.ndarray]
) -> dict[str, Any]:
    """Return SSIM against the reference layer, and its map as PNG text, for the report."""
    none = {"ssim": None, "ssim_map": ""}
    if capture is frame.capture:
        frame.grey = grey
        return none
    if frame.grey is None:
        frame.grey = read_grey(frame.places.layer(capture.object, frame.capture.camera))
    score, full = structural_similarity(frame.grey[0], grey[0], frame.grey[1] & grey[1])
    if np.isnan(score):
        return none
    picture = base64.b64encode(encode_png(shrink_map(full))).decode("ascii")
    return {"ssim": score, "ssim_map": picture}


def shrink_map(full: np.ndarray) -> np.ndarray:
    """Return an SSIM map as bytes, 0 to 255 for 0 to 1, at most `LONGEST_MAP` px long."""
    step = max(1, -(-max(full.shape) // LONGEST_MAP))
    height, width = (n // step * step for n in full.shape)
    blocks = np.nan_to_num(full[:height, :width]).reshape(height // step, step, width // step, step)
    return np.asarray(np.round(255 * np.clip(blocks.mean((1, 3)), 0, 1)), np.uint8)


def resample(
    native: Native,
    transforms: dict[str, Transform],
    grid: Grid,
    sigmas: dict[str, PackedSigma | FiledSigma],
    mosaics: Mapping[str, Mosaic],
    lights: Mapping[str, Mapping[str, Any]],
    seams: Sequence[Mapping[str, Any]] = (),
) -> Cube:
    """Return the capture on the grid; orientation, crop, scale and registration are one map.

    `sigmas` are taken out one by one, so that their memory goes. `mosaics` are the sensors that were
    demosaiced: neighbours of theirs share noise. `lights` are records of the light's sigma, of sensors whose
    white is a chart: all neighbours share its error, and no interpolation makes it smaller. `seams` are records of
    strips that were joined: those moved by a fraction of a pixel share noise too.
    """
    shape = (grid.size[1], grid.size[0])
    parts = []
    for sensor, cube in native.cubes.items():
        maps = [Composed(grid.transform, transforms[band.label]) for band in cube.bands]
        sigma = sigmas.pop(sensor).unpack() if sensor in sigmas else None
        # In place: a scan's sigma is most of a gigabyte.
        variance = None if sigma is None else np.square(sigma, out=sigma)
        shared = lights.get(sensor)
        if variance is not None and shared:
            variance -= light_variance(cube.values, shared, cube.labels)
            np.maximum(variance, 0, out=variance)
        if variance is not None and sensor in mosaics:
            variance *= shared_noise(mosaics[sensor], maps, shape)
        if variance is not None and seams:
            variance *= shared_by_strips(seams, cube.values.shape[1], maps, shape)[:, None]
        warped = warp(cube.values, maps, shape, flags=cube.flags, variance=variance)
        found = warped.variance
        if found is not None and shared:
            found += _light_on_grid(warped.values, shared, cube.labels, maps)
        if found is not None:
            found = round_root(found, out=found)
        parts.append((round_values(warped.values, out=warped.values), warped.flags, found))
    values, flags, spreads = zip(*parts, strict=True)
    known = [s for s in spreads if s is not None]
    return Cube(
        _joined(values),
        _joined(flags),
        _joined(known) if len(known) == len(parts) else None,
        native.bands,
        native.quantity,
    )


def _light_on_grid(
    values: np.ndarray,
    sigmas: Mapping[str, Any],
    labels: Sequence[str],
    maps: Sequence[Transform],
) -> np.ndarray:
    """Return the variance that the light of a chart gives to resampled values; `maps` are grid px → native px."""
    rows, columns = (np.arange(n) for n in values.shape[:2])
    y, x = (np.linspace(0, n - 1, LIGHT_NODES) for n in values.shape[:2])
    points = np.stack([part.ravel() for part in np.meshgrid(x, y)], 1)
    found = np.empty(values.shape, np.float32)
    for i, (label, one) in enumerate(zip(labels, maps, strict=True)):
        there = np.nan_to_num(one(points), nan=-1.0)
        share = LightNodes.from_record(sigmas[label]).near(there).reshape(len(y), len(x))
        share = LightNodes(x, y, share).at(rows, columns)
        found[..., i] = variance_under_light(values[..., i], share, sigmas[label])
    return found


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)


COMPARED = 20_000
"""Pixels of a scan's pictures from which the ratio of two setups is taken, evenly over the layer."""
UNKNOWN = Flag.OUTSIDE | Flag.SATURATED


def gains_of_scan(layer: DefaultLayer, scan: Scan, maps: Sequence[Transform]) -> np.ndarray:
    """Return `setup_gains` of a scan before its rows are resampled: of its pictures.

    A pixel of the pictures is compared with the mean of as many grid pixels as it covers.

    Parameters
    ----------
    maps : sequence of Transform
        Grid px → native px, one a band.
    """
    height, width, _ = layer.values.shape
    side = _side(maps[0], (height, width), scan.factor)
    tall, wide = height // side, width // side
    step = max(1, int(np.sqrt(tall * wide / COMPARED)))
    across, down = np.arange(0, wide, step), np.arange(0, tall, step)
    paint, known = _means(layer, down, across, side)
    x, y = np.meshgrid(*(n * side + (side - 1) / 2 for n in (across, down)))
    places = np.stack([x.ravel(), y.ravel()], 1)
    values, flags = np.zeros(paint.shape, np.float32), np.full(paint.shape, Flag.OUTSIDE, np.uint8)
    for band, (one, image) in enumerate(zip(maps, scan.images(), strict=True)):
        # NaN, where a place is not known, is beyond any edge.
        spots = np.rint(np.nan_to_num((one(places) + 0.5) / scan.factor - 0.5, nan=-9)).astype(int)
        inside = ((spots >= 0) & (spots < image.values.shape[::-1])).all(1)
        column, row = spots[inside].T
        mask = inside.reshape(paint.shape[:2])
        values[mask, band] = image.values[row, column]
        flags[mask, band] = np.where(image.valid[row, column], 0, Flag.OUTSIDE)
    return setup_gains(values, flags, paint, known)


def _side(one: Transform, shape: tuple[int, int], factor: int) -> int:
    """Return how many grid pixels a pixel of the pictures is wide, in the grid's middle."""
    x, y = shape[1] / 2, shape[0] / 2
    a, b, c = one(np.array([[x, y], [x + 1, y], [x, y + 1]]))
    pixels = float(np.sqrt(np.linalg.norm(b - a) * np.linalg.norm(c - a)))
    most = min(shape)
    return int(np.clip(round(factor / pixels), 1, most)) if pixels > 0 else 1


def _means(
    layer: DefaultLayer, down: np.ndarray, across: np.ndarray, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of blocks of `side` x `side` px, and flags; one is not known where a pixel is not."""
    values, flags = [], []
    wide = (int(across[-1]) + 1) * side
    for row in down:
        part, marks = layer.rows(row * side, (row + 1) * side)
        shape = (side, wide // side, side, part.shape[2])
        lost = is_flagged(marks[:, :wide], UNKNOWN).reshape(shape).any((0, 2))
        values.append(np.nan_to_num(part[:, :wide]).reshape(shape).mean((0, 2))[across])
        flags.append(np.where(lost, np.uint8(Flag.OUTSIDE), np.uint8(0))[across])
    return np.stack(values), np.stack(flags)

"""Every band of one capture on the grid, each pixel interpolated once."""

from __future__ import annotations

import base64
from dataclasses import replace
from math import nan, prod
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.sensor import placing
from levkas.colour.srgb import counts_white, find_rendering
from levkas.core.disk import require_space
from levkas.core.rounding import STEP_PER_SIGMA
from levkas.database.grey import read_grey
from levkas.database.layers import Layer, write_layer
from levkas.database.preview import encode_png
from levkas.geometry.joining import describe_steps
from levkas.quality.evaluation.similarity import structural_similarity
from levkas.quality.image_quality.glare import setup_gains
from levkas.readers.frames import read_facts
from levkas.registration.record import decided
from levkas.stages.capture_statistics import DefaultLayer, LayerStatistics, describe_flags
from levkas.stages.native_files import least_bytes
from levkas.stages.parts import GridRows, Placement, noise_correlation, on_grid, stacked
from levkas.stages.reference import maps_on_grid
from levkas.stages.spectra import broad_centroids, credits_of
from levkas.stages.written import Written

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.stages.parts import CalibratedCapture
    from levkas.stages.reference import ReferenceFrame

THINNED_SAMPLES, THINNED = 100_000_000, 16
"""Of a layer of more values every sixteenth pixel a side makes its range and noise."""
COMPARED_BLOCKS = 12
"""Of rows, over the layer, in which two setups are compared."""
LONGEST_MAP = 640
"""Longest side of an SSIM map on a page, px."""


def resample(
    capture: Capture, native: CalibratedCapture, frame: ReferenceFrame, record: dict[str, Any]
) -> Written:
    """Write a capture on the grid, by the `record` of its registration; orientation, crop, scale and registration are one map.

    What is held whole is interpolated before anything is written; rows of a scan, of tiles and of strips as they are written.
    """
    campaign, places, maps = frame.campaign, frame.places, maps_on_grid(record)
    width, height = record["grid"]["size"]
    shape, where = (height, width, len(native.bands)), (capture.object, capture.camera)
    layer = Layer(
        *(*where, capture.setup, record["grid"]["px_per_mm"] or nan),
        credits_of(campaign, capture.object, native.captured or ""),
        broad_centroids(campaign, capture.camera, capture.bands),
    )
    if capture.tiles:
        native.placement = Placement.of(record)
    with placing(capture.sensors[0].object):
        grid = on_grid(native, maps, (width, height), spool=places.kept)
    if grid.has_sigma:
        layer = replace(layer, step_per_sigma=STEP_PER_SIGMA)
    default, gains, notes = None, None, dict[str, Any]()
    if capture.setup and native.quantity == "reflectance" and native.is_held:
        values, flags = (places.layer(*where, kind=kind) for kind in (".tif", ".flags.tif"))
        default = DefaultLayer.open(values, flags, shape)
    if default is not None and len(grid.blocks()) > 1:
        gains = _gains(on_grid(native, maps, (width, height)), default)
    if grid.has_sigma and native.quantity == "reflectance":
        notes["noise_correlation"] = noise_correlation(native, maps, (width, height)).tolist()
    thinned = not native.is_held or prod(shape) > THINNED_SAMPLES
    statistics = LayerStatistics(default, gains, THINNED if thinned else 1)
    rows, white, seams = grid.cube(), _white_of(native), grid.seams
    del native, grid  # their memory goes before the layer is written
    least = least_bytes(prod(shape), rows.quantity, noisy=rows.has_sigma)
    require_space(places.output, 2 * least)  # as TIFF and as Zarr
    entry, files = write_layer(
        places.output,
        layer,
        statistics.flagged(rows),
        verdict=decided(record["verdict"]),
        encoded=_is_encoded(capture, campaign),
        white=white,
    )
    notes |= {
        **_similarity(frame, capture, statistics.grey),
        "flags": describe_flags(statistics.flags),
        "entry": entry.to_row(),
        "glare": statistics.glare,
        "ranges": statistics.ranges(),
        **statistics.sigma_map(),
    }
    warnings: tuple[str, ...] = ()
    if seams:
        notes["seams"] = [one for some in seams.values() for one in some.records()]
        found = describe_steps(notes["seams"])
        warnings = tuple(f"{capture.object}/{capture.layer}: {text}" for text in found)
        notes["warnings"] = list(warnings)
    return Written(files, notes, warnings=warnings)


def _is_encoded(capture: Capture, campaign: Campaign) -> bool:
    if campaign.cameras[capture.camera].traits.is_calibrated:
        return False  # below: colours of a camera raw are proportional to light
    return read_facts(capture.sensors[0].object[0].path).kind != "raw-colours"


def _gains(grid: GridRows, default: DefaultLayer) -> np.ndarray:
    """Return the gains of this setup over the default one, by band, from some rows over the layer."""
    blocks = grid.blocks()
    chosen = np.unique(np.linspace(0, len(blocks) - 1, COMPARED_BLOCKS).round().astype(int))
    ours = stacked([grid.rows(*blocks[number]) for number in chosen], axis=0)
    theirs = zip(*(default.rows(*blocks[number]) for number in chosen), strict=True)
    return setup_gains(ours.values, ours.flags, *(np.concatenate(parts) for parts in theirs))


def _white_of(native: CalibratedCapture) -> float | None:
    """Return the count that pictures of a scan show as white; None where the rows themselves show it."""
    if native.is_held or native.quantity == "reflectance":
        return None
    shown = [np.where(i.valid, i.values, np.float32(np.nan))[::4, ::4] for i in native.images()]
    return counts_white(np.stack(shown, -1), find_rendering(native.bands), step=1)


def _similarity(
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
    picture = base64.b64encode(encode_png(_shrink_map(full))).decode("ascii")
    return {"ssim": score, "ssim_map": picture}


def _shrink_map(full: np.ndarray) -> np.ndarray:
    """Return an SSIM map as bytes, 0 to 255 for 0 to 1, at most `LONGEST_MAP` px long."""
    step = max(1, -(-max(full.shape) // LONGEST_MAP))
    height, width = (n // step * step for n in full.shape)
    blocks = np.nan_to_num(full[:height, :width]).reshape(height // step, step, width // step, step)
    return np.asarray(np.round(255 * np.clip(blocks.mean((1, 3)), 0, 1)), np.uint8)

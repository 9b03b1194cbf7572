"""Every band of one capture on the grid, each pixel interpolated once."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field, replace
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
    from collections.abc import Mapping

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.core.cube import Cube, CubeRows
    from levkas.geometry.joining import Seams
    from levkas.geometry.transforms import Transform
    from levkas.stages.parts import CalibratedCapture
    from levkas.stages.reference import ReferenceFrame

THINNED_SAMPLES, THINNED = 100_000_000, 16
"""Of a layer of more values every sixteenth pixel a side makes its range and noise."""
COMPARED_BLOCKS = 12
"""Of rows, over the layer, in which two setups are compared."""
LONGEST_MAP = 640
"""Longest side of an SSIM map on a page, px."""


@dataclass(frozen=True)
class GridTarget:
    """The layer that a capture is resampled to.

    Parameters
    ----------
    size : (width, height)
    maps : dict of label to Transform
        Grid px → native px.
    verdict : str
        Of the registration, for the catalogue.
    encoded : bool
        Whether values are those of an image file, which are shown as they are.
    default : DefaultLayer or None
        The same camera's layer under its default setup, where it was published like this one.
    """

    capture: Capture
    layer: Layer
    size: tuple[int, int]
    maps: dict[str, Transform]
    verdict: str
    encoded: bool
    default: DefaultLayer | None


def target_of(
    capture: Capture, native: CalibratedCapture, frame: ReferenceFrame, record: dict[str, Any]
) -> GridTarget:
    """Return the layer that a capture is resampled to; `record` is that of its registration."""
    campaign, places, name = frame.campaign, frame.places, capture.object
    grid = record["grid"]
    layer = Layer(
        *(name, capture.camera, capture.setup, grid["px_per_mm"] or nan),
        credits_of(campaign, name, native.captured or ""),
        broad_centroids(campaign, capture.camera, capture.bands),
    )
    width, height = grid["size"]
    shape = (height, width, len(native.bands))
    default = None
    if capture.tiles:
        native.placement = Placement.of(record)
    if capture.setup and native.quantity == "reflectance" and native.is_held:
        values, flags = (places.layer(name, capture.camera, kind=k) for k in (".tif", ".flags.tif"))
        default = DefaultLayer.open(values, flags, shape)
    verdict, encoded = decided(record["verdict"]), _is_encoded(capture, campaign)
    size, maps = (width, height), maps_on_grid(record)
    return GridTarget(capture, layer, size, maps, verdict, encoded, default)


def _is_encoded(capture: Capture, campaign: Campaign) -> bool:
    if campaign.cameras[capture.camera].traits.is_calibrated:
        return False  # below: colours of a camera raw are proportional to light
    return read_facts(capture.sensors[0].object[0].path).kind != "raw-colours"


@dataclass(frozen=True)
class Resampled:
    """A capture on the grid, before it is written.

    Parameters
    ----------
    statistics : LayerStatistics
        Of the rows that have passed.
    white : float or None
        Count shown as white, as of `database.layers.write_layer`.
    correlation : ndarray or None
        Of the noise of neighbours, `neighbour_correlation`; None where noise is not known.
    seams : dict of sensor to Seams
        What tiles or strips differ by, of the rows that have passed.
    """

    rows: Cube | CubeRows
    statistics: LayerStatistics
    white: float | None
    correlation: np.ndarray | None = None
    seams: Mapping[str, Seams] = field(default_factory=dict)


def resample(native: CalibratedCapture, target: GridTarget, frame: ReferenceFrame) -> Resampled:
    """Return a capture on the grid; orientation, crop, scale and registration are one map.

    What is held whole is interpolated now; rows of a scan are when they are written.
    """
    size, default, maps = target.size, target.default, target.maps
    with placing(target.capture.sensors[0].object):
        grid = on_grid(native, maps, size, spool=frame.places.kept)
    several = default is not None and len(grid.blocks()) > 1
    gains = _gains(on_grid(native, maps, size), default) if default and several else None
    correlation = None
    if grid.has_sigma and native.quantity == "reflectance":
        correlation = noise_correlation(native, maps, size)
    thinned = not native.is_held or prod(size) * len(native.bands) > THINNED_SAMPLES
    statistics = LayerStatistics(default, gains, THINNED if thinned else 1)
    return Resampled(grid.cube(), statistics, _white_of(native), correlation, grid.seams)


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


def write_resampled(made: Resampled, target: GridTarget, frame: ReferenceFrame) -> Written:
    """Write a layer."""
    rows, statistics = made.rows, made.statistics
    least = least_bytes(prod(rows.shape), rows.quantity, noisy=rows.has_sigma)
    require_space(frame.places.output, 2 * least)  # as TIFF and as Zarr
    layer = replace(target.layer, step_per_sigma=STEP_PER_SIGMA) if rows.has_sigma else target.layer
    entry, files = write_layer(
        frame.places.output,
        layer,
        statistics.flagged(rows),
        verdict=target.verdict,
        encoded=target.encoded,
        white=made.white,
    )
    notes = {
        **similarity(frame, target.capture, statistics.grey),
        "flags": describe_flags(statistics.flags),
        "entry": entry.to_row(),
        "glare": statistics.glare,
        "ranges": statistics.ranges(),
        **statistics.sigma_map(),
    }
    warnings: tuple[str, ...] = ()
    if made.correlation is not None:
        notes["noise_correlation"] = made.correlation.tolist()
    if made.seams:
        notes["seams"] = [one for seams in made.seams.values() for one in seams.records()]
        where = f"{target.capture.object}/{target.capture.layer}"
        warnings = tuple(f"{where}: {text}" for text in describe_steps(notes["seams"]))
        notes["warnings"] = list(warnings)
    return Written(files, notes, warnings=warnings)


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

"""The uncertainty budget of a layer: what its frames showed, what is declared, and what is unknown.

Rows are `levkas.calibration.error_sources.ErrorSource`. What a build measures on the way is in what calibration measured of each sensor.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import isnan, radians, tan
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.chart_light import CHART_WHITE
from levkas.calibration.drift import LAMP
from levkas.calibration.error_sources import ErrorSource
from levkas.calibration.sensor_context import CLIPPED_DARKS, STRAIGHTNESS
from levkas.stages.capture_statistics import BLACK_WANDER, NOISE, ROUNDING, STRAYED, VIEW
from levkas.stages.spectra import levels_of_board, read_board_uncertainty

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.core.cube import Band

WHITE, LAMP_ROW, BLACK_ROW = "white board", "lamp between white and object", "black level"
LINEARITY, STRAY, WAVELENGTH, ANGLE = "linearity", "stray light", "wavelength", "angle of the light"
CHART = "chart as white"
RAISE_BLACK = "darks that are not clipped at zero: raise the camera's black level (offset)"
NO_WHITE = "frames of a white board: without them values are counts, which no other camera's or day's can be compared with"


def budget_of(
    campaign: Campaign,
    capture: Capture,
    measured: Mapping[str, Mapping[str, Any]],
    strayed: Mapping[str, Any] | None = None,
    *,
    quantity: str = "reflectance",
) -> tuple[ErrorSource, ...]:
    """Return the rows of a capture's budget, all sensors together; of values in counts those that need no white.

    Raises Refused where the spectrum of the white cannot be read.

    Parameters
    ----------
    measured : mapping of str to mapping
        What calibration noted of each sensor.
    strayed : mapping, optional
        Stray light that charts of the camera showed, as `levkas.quality.targets.stray_light.OfView.to_dict` writes it.
    quantity : str
        Of the layer's values: ``"reflectance"`` or ``"counts"``.
    """
    camera = campaign.cameras[capture.camera]
    has_white = any(sensor.white or sensor.chart for sensor in capture.sensors)
    if not camera.traits.is_calibrated or (quantity == "reflectance" and not has_white):
        return ()
    bands = [band for sensor in capture.sensors for band in sensor.bands]
    at_once = camera.traits.bands_in != "files"
    one_sensor, declared = len(capture.sensors) == 1, camera.uncertainty
    rows = [
        *_noise(bands, measured),
        *_white(campaign, capture, measured),
        *_light(bands, measured, at_once, one_sensor),
        _declared(
            *(
                LINEARITY,
                "relative",
                bands,
                declared.linearity,
                _response_errors(capture, measured),
            ),
            "frames of the white at three exposures or more, or declare `uncertainty.linearity` of the camera",
            zero_at=levels_of_board(campaign, capture) if has_white else {},
            all_bands=one_sensor,
        ),
        _stray_light(bands, measured, declared.stray_light, strayed or {}),
        _declared(
            *(
                WAVELENGTH,
                "nm",
                [b for b in bands if not isnan(b.wavelength)],
                declared.wavelength_nm,
                {},
            ),
            "a wavelength standard, or declare `uncertainty.wavelength_nm` of the camera",
            # One prism disperses all bands of a scanner; filters are made one by one.
            all_bands=camera.traits.is_scanned,
        ),
        _angle(campaign, capture, bands),
    ]
    return tuple(rows if has_white else _in_counts(rows))


def _in_counts(rows: Sequence[ErrorSource]) -> Iterator[ErrorSource]:
    """Yield the rows of values without a white: what it would be common to is one row, that there is none."""
    for row in rows:
        if row.name == WHITE:
            yield ErrorSource(
                WHITE, "relative", {}, "campaign", all_bands=True, basis="unknown", advice=NO_WHITE
            )
        elif row.name not in (LAMP_ROW, ANGLE):
            yield replace(row, unit="counts") if row.unit == "reflectance" else row


def _noise(
    bands: Sequence[Band], measured: Mapping[str, Mapping[str, Any]]
) -> Iterator[ErrorSource]:
    """Yield what the published sigma of pixels is made of, where that is known."""
    shares: dict[str, dict[str, float]] = {}
    for of_sensor in measured.values():
        for label, own in of_sensor.get(NOISE, {}).items():
            for name, size in own.items():
                shares.setdefault(name, {})[label] = size
        for label, step in of_sensor.get(ROUNDING, {}).items():
            if step:
                shares.setdefault("code spacing", {})[label] = step / 12**0.5
    labels = {band.label for band in bands}
    for name, size in shares.items():
        own = {label: value for label, value in size.items() if label in labels}
        if any(own.values()):  # a black level without darks has no noise
            yield ErrorSource(name, "reflectance", own, "pixel", all_bands=False)


def _white(
    campaign: Campaign,
    capture: Capture,
    measured: Mapping[str, Mapping[str, Any]],
) -> Iterator[ErrorSource]:
    """Yield what is not known of the reflectance of the white board or of the chart in its place."""
    charts = {
        name: of_sensor[CHART_WHITE]
        for name, of_sensor in measured.items()
        if CHART_WHITE in of_sensor
    }
    if charts:
        found = {label: one for chart in charts.values() for label, one in chart["bands"].items()}
        relative, absolute = (
            {label: one["sigma_of_patches"][k] for label, one in found.items()} for k in (0, 1)
        )
        light = {b: float(np.hypot(found[b]["sigma_in_frame"], relative[b])) for b in found}
        most = max(one["sigma_most"] for one in found.values())
        beyond = max(float(chart["beyond_the_chart"]) for chart in charts.values())
        advice = (
            f"the light is known to {100 * most:.2g} % in places beyond the chart: a chart as large as the object"
            if beyond
            else ""
        )
        yield ErrorSource(CHART, "relative", light, "frame", all_bands=False, advice=advice)
        yield ErrorSource(CHART, "reflectance", absolute, "frame", all_bands=False)
        return
    row = ErrorSource(WHITE, "relative", {}, "campaign", all_bands=True)
    white = campaign.targets.white
    sizes = read_board_uncertainty(campaign, capture)
    if white is None or sizes is None:
        advice = "the standard uncertainty of its certificate: `uncertainty` of `targets.white`, or a third column of its CSV"
        yield replace(row, basis="unknown", advice=advice)
        return
    owner = white.reflectance if isinstance(white.reflectance, str) else ""
    yield replace(row, size=sizes, basis="declared", owner=owner)


def _light(
    bands: Sequence[Band],
    measured: Mapping[str, Mapping[str, Any]],
    at_once: bool,
    one_sensor: bool,
) -> Iterator[ErrorSource]:
    """Yield how far the lamp and the black level are known between white, dark and object.

    Bands that are exposed at once share the lamp; those of a tunable filter do not see it at one time. Each sensor has a black level
    of its own.
    """
    found = {
        label: one
        for of_sensor in measured.values()
        for label, one in of_sensor.get(LAMP, {}).items()
    }
    several = {
        label: one
        for label, one in found.items()
        if one["white"] is not None or one["object"] is not None
    }
    lamp = {label: float(one["sigma"] or 0.0) for label, one in several.items()}
    row = ErrorSource(LAMP_ROW, "relative", lamp, "frame", all_bands=at_once)
    if len(several) < len({band.label for band in bands}):
        row = replace(
            row,
            basis=row.basis if lamp else "unknown",
            advice="two shots or more of the white before the object and after it",
        )
    yield row
    black = {
        label: float(one["black_sigma"] or 0.0)
        for label, one in found.items()
        if one["black"] is not None
    }
    for of_sensor in measured.values():
        black |= of_sensor.get(BLACK_WANDER, {})
    row = ErrorSource(BLACK_ROW, "reflectance", black, "frame", all_bands=at_once and one_sensor)
    if len(black) < len({band.label for band in bands}):
        clipped = any(of_sensor.get(CLIPPED_DARKS) for of_sensor in measured.values())
        advice = RAISE_BLACK if clipped else "two darks or more, before the object and after it"
        row = replace(row, basis=row.basis if black else "unknown", advice=advice)
    yield row


def _response_errors(
    capture: Capture, measured: Mapping[str, Mapping[str, Any]]
) -> dict[str, float]:
    """Return how far exposure series showed the sensor off a line, relative, by band."""
    found: dict[str, float] = {}
    for sensor in capture.sensors:
        error = measured.get(sensor.name, {}).get(STRAIGHTNESS)
        if error is not None:
            found |= {band.label: float(error) for band in sensor.bands}
    return found


def _declared(
    name: str,
    unit: Any,
    bands: Sequence[Band],
    size: float | None,
    measured: Mapping[str, float],
    advice: str,
    *,
    all_bands: bool = True,
    zero_at: Mapping[str, float] | None = None,
) -> ErrorSource:
    """Return a row that is measured, else declared, else not known; it is the camera's in all its captures."""
    row = ErrorSource(name, unit, measured, "camera", all_bands=all_bands)
    if measured or size is not None:
        row = replace(row, zero_at=zero_at or {})
    if measured:
        return row
    if size is None:
        return replace(row, basis="unknown", advice=advice)
    return replace(row, size={band.label: float(size) for band in bands}, basis="declared")


def _stray_light(
    bands: Sequence[Band],
    measured: Mapping[str, Mapping[str, Any]],
    declared: float | None,
    strayed: Mapping[str, Any],
) -> ErrorSource:
    """Return by what share of the view's light values may err: what traps or a chart showed is not taken off, or its error left.

    Of what is declared and what is measured the smaller counts, as long as they do not contradict each other.
    """
    sizes: dict[str, float] = {}
    found = [
        one
        for one in (strayed, *(of_sensor.get(STRAYED) for of_sensor in measured.values()))
        if one
    ]
    numbers = {label: number for one in found for label, number in one["bands"].items()}
    for band in bands if found else ():
        share, error = numbers.get(band.label, (found[-1]["share"], found[-1]["error"]))
        size = float(np.hypot(share, error))
        if declared is not None and abs(share) - 2 * error <= declared:
            size = min(size, declared)
        sizes[band.label] = size
    if all(size == declared for size in sizes.values()):
        sizes = {}
    return _declared(
        *(STRAY, "reflectance", bands, declared, sizes),
        "a chart with black patches or a light trap (`targets.traps`), or declare `uncertainty.stray_light` of the camera",
        zero_at={
            b: at for of_sensor in measured.values() for b, at in of_sensor.get(VIEW, {}).items()
        },
    )


def _angle(campaign: Campaign, capture: Capture, bands: Sequence[Band]) -> ErrorSource:
    """Return what a white that stood at another angle than the object does to all values: tan θ · δθ, Lambert's law."""
    row = ErrorSource(ANGLE, "relative", {}, "frame", all_bands=True)
    setup = campaign.setups.get(capture.setup or campaign.campaign.setup or "default")
    if setup is None or setup.angle_deg is None or setup.angle_uncertainty_deg is None:
        advice = "`angle_deg` and `angle_uncertainty_deg` of the setup: how far white and object stood in one plane"
        return replace(row, basis="unknown", advice=advice)
    size = float(tan(radians(setup.angle_deg)) * radians(setup.angle_uncertainty_deg))
    return replace(row, size={band.label: size for band in bands}, basis="declared")

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
from levkas.calibration.error_sources import ErrorSource
from levkas.stages.spectra import levels_of_board, read_board_uncertainty

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.core.cube import Band

Measured = Mapping[str, Mapping[str, Any]]
Sizes = Mapping[str, float]

WHITE, CHART, LAMP_ROW = "white board", "chart as white", "lamp between white and object"
BLACK_ROW, LINEARITY, STRAY = "black level", "linearity", "stray light"
WAVELENGTH, ANGLE = "wavelength", "angle of the light"
ADVICE = {
    WHITE: "the standard uncertainty of its certificate: `uncertainty` of `targets.white`, or a third column of its CSV",
    LAMP_ROW: "two shots or more of the white before the object and after it",
    BLACK_ROW: "two darks or more, before the object and after it",
    "clipped_darks": "darks that are not clipped at zero: raise the camera's black level (offset)",
    LINEARITY: "frames of the white at three exposures or more, or declare `uncertainty.linearity` of the camera",
    STRAY: "a chart with black patches or a light trap (`targets.traps`), or declare `uncertainty.stray_light` of the camera",
    WAVELENGTH: "a wavelength standard, or declare `uncertainty.wavelength_nm` of the camera",
    ANGLE: "`angle_deg` and `angle_uncertainty_deg` of the setup: how far white and object stood in one plane",
    "no white": "frames of a white board: without them values are counts, which no other camera's or day's can be compared with",
}
"""What to capture or to declare, to know what is not known."""


def budget_of(
    campaign: Campaign,
    capture: Capture,
    measured: Measured,
    strayed: Mapping[str, Any] | None = None,
    *,
    quantity: str = "reflectance",
) -> tuple[ErrorSource, ...]:
    """Return the rows of a capture's budget, all sensors together; of values in counts those that need no white.

    `measured` is what calibration noted of each sensor; `strayed` stray light that charts of the camera showed, as
    `levkas.quality.targets.stray_light.OfView.to_dict` writes it; `quantity` of the values ``"reflectance"`` or ``"counts"``.

    Raises Refused where the spectrum of the white cannot be read.
    """
    camera = campaign.cameras[capture.camera]
    has_white = any(sensor.white or sensor.chart for sensor in capture.sensors)
    if not camera.traits.is_calibrated or (quantity == "reflectance" and not has_white):
        return ()
    bands = [band for sensor in capture.sensors for band in sensor.bands]
    known_nm = [band for band in bands if not isnan(band.wavelength)]
    one_sensor, declared = len(capture.sensors) == 1, camera.uncertainty
    linearity = {
        band.label: float(error)
        for sensor in capture.sensors
        if (error := measured.get(sensor.name, {}).get("straightness")) is not None
        for band in sensor.bands
    }
    bent = levels_of_board(campaign, capture) if has_white else {}
    strays = _stray_light(bands, measured, declared.stray_light, strayed or {})
    rows = [
        *_noise(bands, measured),
        *_white(campaign, capture, measured),
        *_light(bands, measured, camera.traits.bands_in != "files", one_sensor),
        _of_camera(LINEARITY, "relative", bands, declared.linearity, linearity, bent, one_sensor),
        _of_camera(
            STRAY,
            "reflectance",
            bands,
            declared.stray_light,
            strays,
            _all(measured, "mean_of_view"),
        ),
        # One prism disperses all bands of a scanner; filters are made one by one.
        _of_camera(
            *(WAVELENGTH, "nm", known_nm, declared.wavelength_nm, {}, {}),
            camera.traits.is_scanned,
        ),
        _angle(campaign, capture, bands),
    ]
    if has_white:
        return tuple(rows)
    no_white = ErrorSource(WHITE, "relative", {}, "campaign", True, "unknown", ADVICE["no white"])
    return tuple(
        no_white if row.name == WHITE else
        replace(row, unit="counts") if row.unit == "reflectance" else row
        for row in rows
        if row.name not in (LAMP_ROW, ANGLE)
    )  # fmt: skip


def _all(measured: Measured, key: str) -> dict[str, Any]:
    """Return what was measured of every band of all sensors under one key, by label."""
    return {label: one for of in measured.values() for label, one in of.get(key, {}).items()}


def _noise(bands: Sequence[Band], measured: Measured) -> Iterator[ErrorSource]:
    """Yield what the published sigma of pixels is made of, where that is known."""
    shares: dict[str, dict[str, float]] = {}
    for label, own in _all(measured, "noise_shares").items():
        for name, size in own.items():
            shares.setdefault(name, {})[label] = size
    steps = {label: step / 12**0.5 for label, step in _all(measured, "rounding").items() if step}
    labels = {band.label for band in bands}
    for name, size in (shares | {"code spacing": steps}).items():
        own = {label: value for label, value in size.items() if label in labels}
        if any(own.values()):  # a black level without darks has no noise
            yield ErrorSource(name, "reflectance", own, "pixel", all_bands=False)


def _white(campaign: Campaign, capture: Capture, measured: Measured) -> Iterator[ErrorSource]:
    """Yield what is not known of the reflectance of the white board or of the chart in its place."""
    charts = [of[CHART_WHITE]["bands"] for of in measured.values() if CHART_WHITE in of]
    if charts:
        sizes = {label: one["sigma"] for bands in charts for label, one in bands.items()}
        yield ErrorSource(CHART, "relative", sizes, "frame", all_bands=False)
        return
    white, board = campaign.targets.white, read_board_uncertainty(campaign, capture)
    if white is None or board is None:
        yield ErrorSource(WHITE, "relative", {}, "campaign", True, "unknown", ADVICE[WHITE])
        return
    owner = white.reflectance if isinstance(white.reflectance, str) else ""
    yield ErrorSource(WHITE, "relative", board, "campaign", True, "declared", owner=owner)


def _light(
    bands: Sequence[Band], measured: Measured, at_once: bool, one_sensor: bool
) -> Iterator[ErrorSource]:
    """Yield how far the lamp and the black level are known between white, dark and object.

    Bands that are exposed at once share the lamp; those of a tunable filter do not see it at one time. Each sensor has a black level
    of its own.
    """
    found = _all(measured, "lamp")
    lamp = {
        label: float(one["sigma"] or 0.0)
        for label, one in found.items()
        if one["white"] is not None or one["object"] is not None
    }
    black = {
        b: float(one["black_sigma"] or 0.0) for b, one in found.items() if one["black"] is not None
    }
    black |= _all(measured, "black_wander")
    clipped = any(of.get("clipped_darks") for of in measured.values())
    for name, unit, sizes, all_bands, advice in (
        (LAMP_ROW, "relative", lamp, at_once, LAMP_ROW),
        (
            BLACK_ROW,
            "reflectance",
            black,
            at_once and one_sensor,
            "clipped_darks" if clipped else BLACK_ROW,
        ),
    ):
        row = ErrorSource(name, unit, sizes, "frame", all_bands, "measured" if sizes else "unknown")  # type: ignore[arg-type]
        whole = len(sizes) >= len({band.label for band in bands})
        yield row if whole else replace(row, advice=ADVICE[advice])


def _of_camera(
    name: str,
    unit: Any,
    bands: Sequence[Band],
    declared: float | None,
    measured: Sizes,
    zero_at: Sizes,
    all_bands: bool = True,
) -> ErrorSource:
    """Return a row that is measured, else declared, else not known; it is the camera's in all its captures."""
    if measured:
        return ErrorSource(name, unit, measured, "camera", all_bands, zero_at=zero_at)
    if declared is None:
        return ErrorSource(name, unit, {}, "camera", all_bands, "unknown", ADVICE[name])
    sizes = {band.label: float(declared) for band in bands}
    return ErrorSource(name, unit, sizes, "camera", all_bands, "declared", zero_at=zero_at)


def _stray_light(
    bands: Sequence[Band], measured: Measured, declared: float | None, strayed: Mapping[str, Any]
) -> Sizes:
    """Return by what share of the view's light values may err: what traps or a chart showed, which is not taken off, and its error.

    Of what is declared and what is measured the smaller counts, as long as they do not contradict each other.
    """
    found = [one for one in (strayed, *(of.get("stray_light") for of in measured.values())) if one]
    numbers = {label: number for one in found for label, number in one["bands"].items()}
    sizes: dict[str, float] = {}
    for band in bands if found else ():
        share, error = numbers.get(band.label, (found[-1]["share"], found[-1]["error"]))
        size = float(np.hypot(share, error))
        if declared is not None and abs(share) - 2 * error <= declared:
            size = min(size, declared)
        sizes[band.label] = size
    return {} if all(size == declared for size in sizes.values()) else sizes


def _angle(campaign: Campaign, capture: Capture, bands: Sequence[Band]) -> ErrorSource:
    """Return what a white that stood at another angle than the object does to all values: tan θ · δθ, Lambert's law."""
    setup = campaign.setups.get(capture.setup or campaign.campaign.setup or "default")
    if setup is None or setup.angle_deg is None or setup.angle_uncertainty_deg is None:
        return ErrorSource(ANGLE, "relative", {}, "frame", True, "unknown", ADVICE[ANGLE])
    size = float(tan(radians(setup.angle_deg)) * radians(setup.angle_uncertainty_deg))
    sizes = {band.label: size for band in bands}
    return ErrorSource(ANGLE, "relative", sizes, "frame", True, "declared")

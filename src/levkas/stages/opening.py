"""Frames of a capture opened for calibration: with the board that their white shows."""

from __future__ import annotations

from typing import TYPE_CHECKING

from levkas.calibration.findings import Finding
from levkas.calibration.sensor import SensorCapture, open_sensor
from levkas.stages.spectra import board_of

if TYPE_CHECKING:
    from levkas.calibration.chart_light import ChartLight
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, SensorFrames
    from levkas.stages.template_cache import TemplateCache


def open_frames(
    capture: Capture,
    campaign: Campaign,
    sensor: SensorFrames,
    templates: TemplateCache,
    light: ChartLight | None = None,
) -> SensorCapture:
    """Decode the frames of a sensor, and return what holds for all of them."""
    board, white = board_of(campaign, capture, sensor), campaign.targets.white
    doubts: list[Finding | str] = [*board.notes]
    if light is None and sensor.white and white and white.reflectance is None:
        doubts.append(Finding("white_unknown"))
    camera, reflectance = campaign.cameras[capture.camera], board.reflectance
    return open_sensor(
        *(camera, sensor, templates), light=light, reflectance=reflectance, doubts=doubts
    )

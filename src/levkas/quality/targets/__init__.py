"""Colour charts and image quality: noise, range, glare, light, focus; arrays in, numbers out."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "CHARTS": "targets.charts",
    "ChartRefused": "targets.charts",
    "chart_of": "targets.charts",
    "reference_of": "targets.charts",
    "place_patches": "targets.charts",
    "locate_chart": "targets.locating",
    "measure_patches": "targets.patches",
    "noise_planes": "targets.patches",
    "find_preblur": "targets.patches",
    "light_field": "image_quality.light",
    "band_sharpness": "image_quality.sharpness",
    "scene_ranges": "image_quality.dynamic_range",
    "sensor_stops": "image_quality.dynamic_range",
    "find_glare": "image_quality.glare",
    "choose_places": "image_quality.light",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'levkas.quality.targets' has no attribute {name!r}")
    return getattr(import_module(f"levkas.quality.{_HOMES[name]}"), name)

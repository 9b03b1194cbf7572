"""What captures are worth: noise, range, glare, light, focus, charts; arrays in, numbers out."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "CHARTS": "charts",
    "ChartRefused": "charts",
    "chart_of": "charts",
    "reference_of": "charts",
    "place_patches": "charts",
    "locate_chart": "locating",
    "measure_patches": "patches",
    "noise_planes": "patches",
    "find_preblur": "levkas.quality.image_quality.noise_correlation",
    "light_field": "levkas.quality.image_quality.light",
    "band_sharpness": "levkas.quality.image_quality.sharpness",
    "scene_ranges": "levkas.quality.image_quality.dynamic_range",
    "sensor_stops": "levkas.quality.image_quality.dynamic_range",
    "find_glare": "levkas.quality.image_quality.glare",
    "choose_places": "places",
    "delta_e_2000": "levkas.quality.image_quality.indicators",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'levkas.quality.targets' has no attribute {name!r}")
    return getattr(import_module(f"levkas.quality.targets.{_HOMES[name]}"), name)

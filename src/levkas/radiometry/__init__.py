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
    "find_preblur": "blur",
    "light_field": "light",
    "band_sharpness": "sharpness",
    "scene_ranges": "ranges",
    "sensor_stops": "ranges",
    "find_glare": "glare",
    "choose_places": "places",
    "delta_e_2000": "indicators",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'levkas.radiometry' has no attribute {name!r}")
    return getattr(import_module(f"levkas.radiometry.{_HOMES[name]}"), name)

"""Plan the light before a lamp is hung: geometry, framing and exposure."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "PlanRefused": "tables",
    "StudioSetup": "setup",
    "load_setup": "loading",
    "plan_light": "light",
    "compare_lightings": "light",
    "find_setup": "loading",
    "optimise": "optimisation",
    "plan_framing": "framing",
    "plan_exposure": "exposure_plan",
    "illuminate": "setup",
    "sample_surface": "surface",
    "colour_temperature": "spectra",
    "GRID": "spectra",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'levkas.planning' has no attribute {name!r}")
    return getattr(import_module(f"levkas.planning.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__

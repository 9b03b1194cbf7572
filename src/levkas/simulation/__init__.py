"""Simulated campaigns: an icon, five cameras, their raw files, and the exact truth about them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "simulate_campaign": "campaigns",
    "PRESETS": "presets",
    "Preset": "presets",
    "Simulated": "campaigns",
    "SimulationRefused": "presets",
    "Truth": "truth",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    # Loaded on first use: the kernels bring numba with them.
    if name not in _HOMES:
        raise AttributeError(f"module 'levkas.simulation' has no attribute {name!r}")
    return getattr(import_module(f"levkas.simulation.{_HOMES[name]}"), name)

"""Levkas: raw captures of a painting to one calibrated, registered spectral image database."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "build": "building",
    "status": "building",
    "load_campaign": "campaign.campaign",
    "find_captures": "campaign.discovery.find_captures",
    "calibrate": "calibration.reflectance",
    "open": "database",
    "hold_instructions": "core.instructions",
    "read_stiff": "database.spectral_tiff",
    "write_stiff": "database.spectral_tiff",
    "read_spectra": "readers.spectral_library",
    "write_spectra": "readers.spectral_library",
    "estimate": "estimation.experiment",
    "read_mtiff": "database.spectral_tiff",
    "map_points": "database.pixel_frames",
    "assess": "quality.evaluation.layer_report",
    "register": "registration",
    "warp": "geometry.resample",
    "Grid": "geometry.grid",
    "simulate_campaign": "simulation",
    "Band": "core.cube",
    "Cube": "core.cube",
    "Flag": "core.cube",
    "Problem": "core.problems",
    "Refused": "core.problems",
    "Affine": "geometry.transforms",
    "Homography": "geometry.transforms",
    "Polynomial": "geometry.transforms",
    "Lens": "geometry.transforms",
    "Composed": "geometry.transforms",
    "Inverse": "geometry.transforms",
    "Sensor": "calibration.noise_model",
    "noise_variance": "calibration.noise_model",
    "structural_similarity": "quality.evaluation.similarity",
    "position_errors": "quality.evaluation.similarity",
}
__all__ = sorted([*_HOMES, "__version__"])


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'levkas' has no attribute {name!r}")
    return getattr(import_module(f"levkas.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__

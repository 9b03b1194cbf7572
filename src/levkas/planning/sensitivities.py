"""Cameras in their places, with the quantum efficiency of every channel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.refusals import PlanRefused, wrong
from levkas.planning.setup import Camera
from levkas.planning.spectra import GRID, read_table

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.planning.tables import Bench, CameraKeys

FAINT = 0.01
"""Share of its peak below which a sensitivity need not be covered by a lamp's spectrum."""


def place_camera(name: str, keys: CameraKeys, bench: Bench, root: Path, *, file: str) -> Camera:
    """Return a camera in its place.

    Raises
    ------
    PlanRefused
        Where it has no place or two, or its sensitivities cannot be read.
    """
    at = f"cameras.{name}"
    if (keys.distance_mm is None) == (keys.place_mm is None):
        raise PlanRefused(
            wrong(file, f"{at}.distance_mm", "a camera has a place: distance_mm or place_mm",
                  expected="one of the two")
        )  # fmt: skip
    aim = np.zeros(3) if isinstance(keys.aim_mm, str) else np.array([*keys.aim_mm, 0.0])
    before = np.array([0.0, 0.0, keys.distance_mm or 0.0])
    place = aim + before if keys.place_mm is None else np.array(keys.place_mm)
    if keys.sensitivity is None:
        return Camera(name, keys, place, aim, *_bands(keys))
    w, table, labels = read_table(root / keys.sensitivity, field=f"{at}.sensitivity", file=file)
    if keys.wavelengths is not None:
        return Camera(name, keys, place, aim, *_tuned(keys, w, table[:, 0]))
    labels = labels or [f"C{i + 1}" for i in range(table.shape[1])]
    table = np.maximum(table, 0) * keys.peak_qe / max(table.max(), 1e-12)
    quantum = np.stack([np.interp(GRID, w, c, left=0, right=0) for c in table.T])
    centres = quantum @ GRID / np.maximum(quantum.sum(1), 1e-12)
    strong = (table >= FAINT * table.max(0)).any(1)
    seen = (float(w[strong][0]), float(w[strong][-1]))
    _check_sensors(keys, labels, f"{at}.sensors", file)
    return Camera(name, keys, place, aim, tuple(labels), centres, quantum, seen)


def _check_sensors(keys: CameraKeys, labels: list[str], field: str, file: str) -> None:
    named = [label for sensor in keys.sensors for label in sensor]
    if named and sorted(named) != sorted(labels):
        raise PlanRefused(
            wrong(file, field, "the sensors do not share the channels out", ", ".join(named),
                  f"each of {', '.join(labels)} once")
        )  # fmt: skip


def _bands(
    keys: CameraKeys,
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, tuple[float, float]]:
    """Gaussian bands over the peak efficiency, or one flat channel where nothing is said."""
    if keys.wavelengths is None:
        flat = np.where((GRID >= 400) & (GRID <= 720), keys.peak_qe, 0.0)
        return ("grey",), np.array([560.0]), flat[None], (400.0, 720.0)
    return _tuned(keys, np.array([GRID[0], GRID[-1]]), np.ones(2))


def _tuned(
    keys: CameraKeys, w: np.ndarray, efficiency: np.ndarray
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, tuple[float, float]]:
    """Return bands of a tunable filter: Gaussians under the sensor's own efficiency."""
    assert keys.wavelengths is not None
    centres = np.array(keys.wavelengths.values())
    width = keys.fwhm_nm / 2.3548
    shapes = np.exp(-0.5 * ((GRID - centres[:, None]) / width) ** 2)
    held = np.interp(GRID, w, efficiency) * keys.peak_qe / efficiency.max()
    reach = keys.fwhm_nm
    seen = (float(centres[0] - reach / 2), float(centres[-1] + reach / 2))
    return tuple(f"{c:g} nm" for c in centres), centres, shapes * held, seen

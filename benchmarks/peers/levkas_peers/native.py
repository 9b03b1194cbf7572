"""Calibrated bands of one layer, read back from a database as a method of registration sees them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.cube import UNRELIABLE, is_flagged
from levkas.database.opening import open_pixels
from levkas.quality.evaluation.native_layers import native_files
from levkas.registration import BandImage


@dataclass(frozen=True)
class NativeLayer:
    """One camera under one setup, native pixels.

    Parameters
    ----------
    sensors : dict of str to (values, flags, labels, wavelengths)
        values and flags (h, w, bands).
    """

    sensors: dict[str, tuple[np.ndarray, np.ndarray, list[str], list[float]]]

    def images(self) -> list[BandImage]:
        """Return every band as registration sees it; saturated pixels are not valid."""
        return [
            BandImage(
                label,
                wavelength,
                np.ascontiguousarray(values[..., i], np.float32),
                np.isfinite(values[..., i]) & ~is_flagged(flags[..., i], UNRELIABLE),
                sensor,
            )
            for sensor, (values, flags, labels, waves) in self.sensors.items()
            for i, (label, wavelength) in enumerate(zip(labels, waves, strict=True))
        ]


def read_native_layer(database: Path, name: str, camera: str, setup: str) -> NativeLayer:
    """Read the native files of a layer.

    Raises ComparisonRefused where the database has none: it has them with ``[database] native = true``.
    """
    sensors: dict[str, Any] = {}
    for part, path in native_files(database, name, camera, setup).items():
        array = open_pixels(path)
        flags = path.with_name(path.stem + ".flags.tif")
        values = np.asarray(array.values, np.float32)
        sensors[part] = (
            values,
            np.asarray(open_pixels(flags).values, np.uint8)
            if flags.is_file()
            else np.zeros(values.shape, np.uint8),
            [str(label) for label in array["band"].values],
            [float(w) for w in array["wavelength"].values],
        )
    return NativeLayer(sensors)

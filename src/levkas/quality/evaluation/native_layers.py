"""Calibrated bands of one layer, read back from a database as a method of registration sees them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.registration import BandImage


class ComparisonRefused(Refused):
    """No layer on which methods could be compared."""


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
        from levkas.core.cube import UNRELIABLE, is_flagged
        from levkas.registration import BandImage

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

    Raises
    ------
    ComparisonRefused
        Where the database has none: it has them with ``[database] native = true``.
    """
    from levkas.database.layout import Places
    from levkas.database.opening import open_pixels

    places = Places(database)
    first = places.native(name, camera, setup, "")
    sensors: dict[str, Any] = {}
    for path in sorted(first.parent.glob(first.stem + "*.tif")):
        if path.name.endswith((".flags.tif", ".sigma.tif")):
            continue
        array = open_pixels(path)
        labelled = (array.attrs.get("camera", camera), array.attrs.get("setup", setup) or "")
        if labelled != (camera, setup):
            continue
        flags = path.with_name(path.stem + ".flags.tif")
        values = np.asarray(array.values, np.float32)
        sensors[path.stem.removeprefix(first.stem).removeprefix("_")] = (
            values,
            np.asarray(open_pixels(flags).values, np.uint8)
            if flags.is_file()
            else np.zeros(values.shape, np.uint8),
            [str(label) for label in array["band"].values],
            [float(w) for w in array["wavelength"].values],
        )
    if not sensors:
        raise no_native(f"{name}/{camera}", first)
    return NativeLayer(sensors)


def no_native(what: str, path: Path) -> ComparisonRefused:
    """Return the refusal of a layer, or of a database, that has no native pixels at `path`."""
    return ComparisonRefused(
        Problem(
            "E_UNREADABLE",
            f"{what} has no native pixels in the database",
            file=str(path),
            field="database.native",
            found="false",
            expected="true",
            fix="Set `native = true` under `[database]` in campaign.toml, and build again.",
        )
    )

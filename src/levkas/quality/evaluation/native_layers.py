"""Calibrated bands of one layer, read back from a database as a method of registration sees them."""

from __future__ import annotations

from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem, Refused
from levkas.database.containment import check_inside
from levkas.database.layout import layer_name

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
    from levkas.database.opening import open_pixels

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


def native_files(
    database: Path, name: str, camera: str, setup: str, folder: Path | None = None
) -> dict[str, Path]:
    """Return the files with the native pixels of a layer, by the names of its sensors and tiles.

    They are those of the database unless another `folder` is given.

    Raises
    ------
    ComparisonRefused
        Where the database has none.
    """
    from levkas.database.described import open_tiff
    from levkas.database.layout import Places

    first = Places(database).native(name, camera, setup, "", folder=folder)
    found = {}
    for path in sorted(first.parent.glob(escape(first.stem) + "*.tif")):
        if path.name.endswith((".flags.tif", ".sigma.tif")):
            continue
        if folder is None:
            check_inside(database, path)
        facts = open_tiff(path).facts
        if (facts.get("camera", camera), facts.get("setup", setup) or "") == (camera, setup):
            found[path.stem.removeprefix(first.stem).removeprefix("_")] = path
    if not found:
        raise no_native(f"{name}/{layer_name(camera, setup)}", first)
    return found


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

"""Exact truth of a simulated campaign: the position of any point in any band of any camera."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.cube import find_band
from levkas.core.files import write_bytes, write_json
from levkas.simulation.optics import (
    ChromaticOptics,
    Viewpoint,
    base_to_band,
    base_to_panel,
    native_to_base,
    panel_to_base,
)
from levkas.simulation.painting import Panel

SAME_MM = 1e-4
GRID_POINTS = 3000
MARGIN = 0.02


@dataclass(frozen=True)
class BandGeometry:
    """What sets one band of a camera apart: its wavelength (nm) and the sensor that records it."""

    label: str
    wavelength: float
    sensor: str = ""


@dataclass(frozen=True, eq=False)
class CameraGeometry:
    """Geometry that a camera has before every object.

    Parameters
    ----------
    width, height : int
        Native pixels of each sensor.
    sensors : dict of str to ndarray, (2, 3)
        Pixels of the first sensor → this one.
    """

    width: int
    height: int
    bands: tuple[BandGeometry, ...]
    chromatic: ChromaticOptics = field(default_factory=ChromaticOptics)
    sensors: dict[str, np.ndarray] = field(default_factory=dict)

    def band(self, label: str) -> BandGeometry:
        """Return the band that `label` names; raises `levkas.core.problems.Refused` where none is."""
        return self.bands[find_band([b.label for b in self.bands], label)]

    def step(self, band: str | None) -> tuple[tuple[float, float, float, float], np.ndarray]:
        """Return (chromatic terms, sensor matrix) of `band`; of no band, those that do nothing."""
        if band is None:
            return (1.0, 0.0, 0.0, 0.0), np.eye(2, 3)
        chosen = self.band(band)
        return self.chromatic.at(chosen.wavelength), self.sensors.get(chosen.sensor, np.eye(2, 3))


@dataclass(frozen=True, eq=False)
class SimulatedTruth:
    """Exact maps of a simulated campaign.

    Parameters
    ----------
    reference : tuple of str
        (camera, band).
    panels : dict of str to Panel
        By object.
    views : dict of str to dict of str to View
        By object, then camera.

    Cameras that capture in tiles are a frame a tile, ``CAMERA#TILE``.
    """

    reference: tuple[str, str]
    panels: dict[str, Panel]
    cameras: dict[str, CameraGeometry]
    views: dict[str, dict[str, Viewpoint]]

    def from_panel(
        self, points: np.ndarray, camera: str, band: str | None = None, *, name: str | None = None
    ) -> np.ndarray:
        """Map panel points to native pixels of a band.

        Parameters
        ----------
        points : ndarray, (n, 2)
            (s, t) on the board, mm.
        camera, band : str
            Without a band: base pixels, free of chromatic magnification and sensor misalignment.
        name : str, optional
            The object; the first one if left out.

        Returns
        -------
        pixels : ndarray, (n, 2)
            NaN where the point is not on the board, is hidden by a ledge, or misses the sensor.
        """
        name, points = name or next(iter(self.panels)), np.asarray(points, float)
        panel, view, geometry = self.panels[name], self.views[name][camera], self.cameras[camera]
        base = panel_to_base(points, view, panel)
        with np.errstate(invalid="ignore"):
            in_view = np.abs(base_to_panel(base, view, panel) - points).max(1, initial=0) < SAME_MM
        pixels = base_to_band(base, view, *geometry.step(band))
        size = np.array([geometry.width, geometry.height])
        with np.errstate(invalid="ignore"):
            inside = np.all((pixels >= -0.5) & (pixels < size - 0.5), axis=1)
        good = in_view & inside & panel.contains(points)
        return np.where(good[:, None], pixels, np.nan)

    def to_panel(
        self, pixels: np.ndarray, camera: str, band: str | None = None, *, name: str | None = None
    ) -> np.ndarray:
        """Map native pixels of a band to the panel points (s, t), mm, that they see; else NaN."""
        name = name or next(iter(self.panels))
        panel, view = self.panels[name], self.views[name][camera]
        base = native_to_base(pixels, view, *self.cameras[camera].step(band))
        points = base_to_panel(base, view, panel)
        with np.errstate(invalid="ignore"):
            return np.where(panel.contains(points)[:, None], points, np.nan)

    def map(
        self, points: np.ndarray, camera: str, band: str | None = None, *, name: str | None = None
    ) -> np.ndarray:
        """Map reference pixels to native pixels of a band, exact to 1e-6 px.

        Parameters
        ----------
        points : ndarray, (n, 2)
            Pixels of the reference band.
        camera, band : str
            Without a band: without chromatic magnification and sensor misalignment.
        name : str, optional
            The object; the first one if left out.

        Returns
        -------
        pixels : ndarray, (n, 2)
            NaN where a point is outside the board or either image, or hidden from the camera.
        """
        return self.from_panel(
            self.to_panel(points, *self.reference, name=name), camera, band, name=name
        )

    def inverse(
        self, pixels: np.ndarray, camera: str, band: str | None = None, *, name: str | None = None
    ) -> np.ndarray:
        """Map native pixels of a band to reference pixels; NaN as in `map`."""
        return self.from_panel(
            self.to_panel(pixels, camera, band, name=name), *self.reference, name=name
        )

    def grid(self, *, name: str | None = None, count: int = GRID_POINTS) -> np.ndarray:
        """Return about `count` reference pixels in a regular grid that every camera sees.

        Returns
        -------
        points : ndarray, (n, 2)
            Reference px, a fiftieth of the board's size away from its edges.
        """
        name = name or next(iter(self.panels))
        panel, (camera, band) = self.panels[name], self.reference
        half = np.array([panel.width_mm, panel.height_mm]) * (0.5 - MARGIN)
        edges = np.stack(np.meshgrid(np.linspace(-1, 1, 41), [-1.0, 1.0]), -1).reshape(-1, 2)
        edges = np.vstack([edges, edges[:, ::-1]]) * half
        outline = self.from_panel(edges, camera, band, name=name)
        low, high = np.nanmin(outline, 0), np.nanmax(outline, 0)
        step = float(np.sqrt(np.prod(high - low) / count))
        axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
        points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
        on_board = self.to_panel(points, camera, band, name=name)
        with np.errstate(invalid="ignore"):
            points = points[np.all(np.abs(on_board) <= half, axis=1)]
        for other in self.cameras:
            if "#" not in other:  # no tile sees all of the object
                points = points[np.isfinite(self.map(points, other, name=name)).all(1)]
        return points

    def panel_grid(self, *, name: str | None = None, count: int = GRID_POINTS) -> np.ndarray:
        """Return about `count` points (s, t) on the board, mm, in a regular grid, a fiftieth of its size from its edges."""
        panel = self.panels[name or next(iter(self.panels))]
        sides = np.array([panel.width_mm, panel.height_mm]) * (1 - 2 * MARGIN)
        step = float(np.sqrt(np.prod(sides) / count))
        axes = [np.arange(-side / 2 + step / 2, side / 2, step) for side in sides]
        return np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)

    def save(self, folder: Path) -> None:
        """Write `truth.json` and the point files of CONTRACT.md, last section, into `folder`."""
        write_json(folder / "truth.json", self.to_dict())
        if any("#" in frame for frame in self.cameras):
            self._save_tiles(folder)
            return
        for name in self.panels:
            points = self.grid(name=name)
            rows = {c: self.rows(points, c, name=name) for c in self.cameras}
            in_view = np.all([np.isfinite(r).all((0, 2)) for r in rows.values()], axis=0)
            write_bytes(folder / f"{name}_ref_px.npy", _npy(points[in_view]))
            for camera, pixels in rows.items():
                write_bytes(folder / f"{name}_{camera}_px.npy", _npy(pixels[:, in_view]))

    def _save_tiles(self, folder: Path) -> None:
        """Write points of the board, and where every frame and tile sees them; NaN where it does not."""
        for name in self.panels:
            places = self.panel_grid(name=name)
            write_bytes(folder / f"{name}_panel_mm.npy", _npy(places))
            for frame, geometry in self.cameras.items():
                labels = [None, *(band.label for band in geometry.bands)]
                rows = [self.from_panel(places, frame, label, name=name) for label in labels]
                write_bytes(folder / f"{name}_{frame}_px.npy", _npy(np.stack(rows)))
            camera, band = self.reference
            if camera in self.cameras:
                pixels = self.from_panel(places, camera, band, name=name)
                write_bytes(folder / f"{name}_ref_px.npy", _npy(pixels))

    def rows(self, points: np.ndarray, camera: str, *, name: str | None = None) -> np.ndarray:
        """Return where `points` (n, 2), reference px, lie: (1 + bands, n, 2), first without band."""
        name = name or next(iter(self.panels))
        view, geometry = self.views[name][camera], self.cameras[camera]
        base = self.map(points, camera, name=name)
        bands = [base_to_band(base, view, *geometry.step(b.label)) for b in geometry.bands]
        return np.stack([base, *bands])

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON-ready record that `truth.json` holds."""
        cameras: dict[str, dict[str, Any]] = {
            name: {
                "width": g.width,
                "height": g.height,
                "bands": [b.label for b in g.bands],
                "wavelengths": [b.wavelength for b in g.bands],
                "band_sensors": [b.sensor for b in g.bands],
                "chromatic": vars(g.chromatic),
                "sensors": {k: np.asarray(m).tolist() for k, m in g.sensors.items()},
            }
            for name, g in self.cameras.items()
        }
        sensors = [(k, m) for g in cameras.values() for k, m in g["sensors"].items()]
        return {
            "reference": ":".join(self.reference),
            "objects": list(self.panels),
            "ccd": {k: m for k, m in sensors if m != np.eye(2, 3).tolist()},
            "cameras": cameras,
            "panels": {name: panel.to_dict() for name, panel in self.panels.items()},
            "views": {o: {c: v.to_dict() for c, v in by.items()} for o, by in self.views.items()},
        }

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> SimulatedTruth:
        """Return the truth that `to_dict` recorded."""
        cameras = {
            name: CameraGeometry(
                r["width"],
                r["height"],
                tuple(
                    BandGeometry(*b)
                    for b in zip(r["bands"], r["wavelengths"], r["band_sensors"], strict=True)
                ),
                ChromaticOptics(**{k: tuple(v) for k, v in r["chromatic"].items()}),
                {k: np.array(m) for k, m in r["sensors"].items()},
            )
            for name, r in record["cameras"].items()
        }
        camera, band = record["reference"].split(":", 1)
        return cls(
            (camera, band),
            {name: Panel(**p) for name, p in record["panels"].items()},
            cameras,
            {
                o: {c: Viewpoint.from_dict(v) for c, v in by.items()}
                for o, by in record["views"].items()
            },
        )

    @classmethod
    def load(cls, folder: Path | str) -> SimulatedTruth:
        """Read the truth of a campaign that `simulate_campaign` wrote, from its `truth` folder."""
        return cls.from_dict(json.loads((Path(folder) / "truth.json").read_text(encoding="utf-8")))


def _npy(array: np.ndarray) -> bytes:
    buffer = BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()

"""Capture of a painting, a white board or the dark by a simulated camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from levkas.simulation.cameras import BandModel, CameraModel, SensorModel
from levkas.simulation.lighting import SETUPS, SimulatedLight, compose, light
from levkas.simulation.optics import Viewpoint, band_to_base
from levkas.simulation.painting import Painting, Panel
from levkas.simulation.pigments import WAVELENGTHS
from levkas.simulation.rendering import RayLattice, render, tabulate
from levkas.simulation.sensing import FixedPattern, expose, fixed_pattern, key

WHITE_REFLECTANCE = 0.98
TABLE_REFLECTANCE = 0.045


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One exposure of one sensor; of a band where it has its own file."""

    sensor: str
    band: str
    shot: int
    counts: np.ndarray


@dataclass(frozen=True, eq=False)
class Sight:
    """A painting before a camera: what `reflectance` needs, tabulated once for all bands."""

    camera: CameraModel
    view: Viewpoint
    panel: Panel
    painting: Painting
    lit: SimulatedLight
    lattice: RayLattice

    def reflectance(
        self, band: BandModel, sensor: SensorModel, *, supersampling: int = 3
    ) -> np.ndarray:
        """Return the reflectance factor that each sensel of a band integrates, without noise.

        Returns
        -------
        image : ndarray, (height, width), float32
            What flat-fielding with a perfect white would give.
        """
        chromatic = self.camera.chromatic.at(band.centre)
        return render(
            compose(self.painting, self.lit, band.response, WAVELENGTHS),
            self.lattice,
            *band_to_base(self.view, chromatic, self.camera.affine(sensor)),
            surroundings=TABLE_REFLECTANCE,
            blur=self.camera.blur_at(band.centre),
            supersampling=supersampling,
        )


def look(
    camera: CameraModel,
    view: Viewpoint,
    panel: Panel,
    painting: Painting,
    *,
    setup: str | None = None,
    lattice: RayLattice | None = None,
) -> Sight:
    """Put a painting before a camera, under a setup of `lighting.SETUPS` or the camera's own."""
    lit = light(painting, panel, view, SETUPS[setup or camera.setup])
    return Sight(camera, view, panel, painting, lit, lattice or tabulate(view, panel))


@dataclass(frozen=True, eq=False)
class SimulatedCamera:
    """A camera at work: its model, its light, and the fixed patterns of its sensors.

    Parameters
    ----------
    model : CameraModel
    root : int
        Seed of the campaign; fixed patterns and noise follow from it and the names.
    setup : str
        "" for the camera's own lighting.
    supersampling : int
    """

    model: CameraModel
    root: int
    setup: str = ""
    supersampling: int = 3
    _patterns: dict[str, FixedPattern] = field(default_factory=dict)

    @cached_property
    def illumination(self) -> np.ndarray:
        """Light on each sensel, (height, width) float32, 1 where it is brightest.

        Lamps drop by a tenth over the picture, the lens by its vignetting; a line scanner has the
        same light on every line.
        """
        m = self.model
        rng = np.random.default_rng(key(self.root, "light", m.name, self.setup))
        x = np.linspace(-1, 1, m.width)[None, :]
        y = np.linspace(-1, 1, m.height)[:, None] * (0 if m.scan else m.height / m.width)
        drop, lean = rng.uniform(0.06, 0.10), rng.normal(0, 0.03, 2)
        lamps = 1 - drop * (x**2 + 0.6 * y**2) + lean[0] * x + lean[1] * y
        r2 = (x**2 + y**2) / (1 + (m.height / m.width) ** 2)
        field = lamps * (1 - m.vignetting * r2 * (0.75 + 0.25 * r2))
        return (field / field.max()).astype(np.float32)

    def electrons(self, band: BandModel, sensor: SensorModel) -> np.ndarray:
        """Return the photo-electrons of a perfect diffuser, (height, width) float32."""
        noise = sensor.noise
        room = (noise.saturation - noise.black) / noise.gain
        return self.illumination * np.float32(band.level * room / WHITE_REFLECTANCE)

    def pattern(self, sensor: SensorModel, band: str = "") -> FixedPattern:
        """Return the fixed pattern of a sensor; of a scanner, one line of `band`, repeated."""
        m, rows = self.model, self.model.height
        if not m.scan:
            band = ""
        if sensor.name not in self._patterns:
            rng = np.random.default_rng(key(self.root, "pattern", m.name, sensor.name, band))
            shape = (1, m.width) if m.scan else (rows, m.width)
            drawn = fixed_pattern(shape, sensor.noise, rng)
            if m.scan:
                lines = [np.repeat(a, rows, 0) for a in vars(drawn).values()]
                # Of a scanner only one band is at work at a time, and the lines are many.
                return FixedPattern(*lines)
            self._patterns[sensor.name] = drawn
        return self._patterns[sensor.name]

    def shoot(
        self, target: str, sight: Sight | None, *, white: bool = False
    ) -> Iterator[SimulatedFrame]:
        """Yield the frames of an object or chart (`sight`), of the white board, or of the dark.

        Parameters
        ----------
        target : str
            Its name: noise follows from it.
        sight : Sight or None
        white : bool
            Without a sight: the white board, else the dark.
        """
        m = self.model
        for sensor in m.sensors:
            if m.kind in ("bands", "cube"):
                for index in sensor.bands:
                    band = m.bands[index]
                    exposure = self._exposure(band, sensor, sight, white)
                    yield from self._frames(target, sensor, band.label, exposure, sight, white)
            else:
                exposure = self._mosaic(sensor, sight, white)
                yield from self._frames(target, sensor, "", exposure, sight, white)

    def _exposure(
        self, band: BandModel, sensor: SensorModel, sight: Sight | None, white: bool
    ) -> np.ndarray:
        if sight is not None:
            seen = sight.reflectance(band, sensor, supersampling=self.supersampling)
            return self.electrons(band, sensor) * seen
        if white:
            return self.electrons(band, sensor) * np.float32(WHITE_REFLECTANCE)
        return np.zeros_like(self.illumination)

    def _mosaic(self, sensor: SensorModel, sight: Sight | None, white: bool) -> np.ndarray:
        bands = [self.model.bands[i] for i in sensor.bands]
        if sensor.pattern is None:
            return self._exposure(bands[0], sensor, sight, white)
        full = np.empty_like(self.illumination)
        rows, columns = len(sensor.pattern), len(sensor.pattern[0])
        for k, band in enumerate(bands):
            channel = self._exposure(band, sensor, sight, white)
            for i, line in enumerate(sensor.pattern):
                for j, owner in enumerate(line):
                    if owner == k:
                        sites = (slice(i, None, rows), slice(j, None, columns))
                        full[sites] = channel[sites]
        return full

    def _frames(
        self,
        target: str,
        sensor: SensorModel,
        band: str,
        exposure: np.ndarray,
        sight: Sight | None,
        white: bool,
    ) -> Iterator[SimulatedFrame]:
        m = self.model
        templates = m.whites if white else m.darks
        count = m.shots if sight is not None else templates
        fixed = self.pattern(sensor, band)
        if m.scan and sight is None:
            # One file of `count` lines.
            exposure, count = exposure[:1].repeat(templates, 0), 1
            fixed = FixedPattern(*(a[:1].repeat(templates, 0) for a in vars(fixed).values()))
        for shot in range(count):
            seed = key(self.root, "noise", m.name, self.setup, target, sensor.name, band, str(shot))
            yield SimulatedFrame(
                sensor.name, band, shot, expose(exposure, sensor.noise, fixed, seed)
            )

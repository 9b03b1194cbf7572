"""Capture of a painting, a white board or the dark: light on each sensel to counts, Eq. (2) of [mirhashemi2019]_.

Every random number is a hash of (key of the frame, index of the sensel): the same bytes come out
whatever the number of threads, and any frame can be made without those before it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from levkas.campaign.camera_kinds import KINDS
from levkas.core.compiled import njit
from levkas.core.threads import in_threads
from levkas.simulation.cameras import BandModel, CameraModel, SensorModel
from levkas.simulation.lighting import SETUPS, SimulatedLight, compose, light
from levkas.simulation.optics import Viewpoint, band_to_base
from levkas.simulation.painting import Painting, Panel
from levkas.simulation.pigments import WAVELENGTHS
from levkas.simulation.rendering import RayLattice, render, tabulate

if TYPE_CHECKING:
    from levkas.calibration.noise_model import Sensor

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
class PaintingView:
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


def view_painting(
    camera: CameraModel,
    view: Viewpoint,
    panel: Panel,
    painting: Painting,
    *,
    setup: str | None = None,
    lattice: RayLattice | None = None,
) -> PaintingView:
    """Put a painting before a camera, under a setup of `lighting.SETUPS` or the camera's own."""
    lit = light(painting, panel, view, SETUPS[setup or camera.setup])
    return PaintingView(camera, view, panel, painting, lit, lattice or tabulate(view, panel))


@dataclass(frozen=True, eq=False)
class SimulatedCamera:
    """A camera at work: its model, its light, and the fixed patterns of its sensors.

    Parameters
    ----------
    root : int
        Seed of the campaign; fixed patterns and noise follow from it and the names.
    setup : str
        "" for the camera's own lighting.
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
        self, target: str, sight: PaintingView | None, *, white: bool = False
    ) -> Iterator[SimulatedFrame]:
        """Yield the frames of an object or chart (`sight`), of the white board, or of the dark.

        Parameters
        ----------
        target : str
            Its name: noise follows from it.
        white : bool
            Without a sight: the white board, else the dark.
        """
        m = self.model
        for sensor in m.sensors:
            if not KINDS[m.kind].is_broad:
                for index in sensor.bands:
                    band = m.bands[index]
                    exposure = self._exposure(band, sensor, sight, white)
                    yield from self._frames(target, sensor, band.label, exposure, sight, white)
            else:
                exposure = self._mosaic(sensor, sight, white)
                yield from self._frames(target, sensor, "", exposure, sight, white)

    def _exposure(
        self, band: BandModel, sensor: SensorModel, sight: PaintingView | None, white: bool
    ) -> np.ndarray:
        if sight is not None:
            reflectance = sight.reflectance(band, sensor, supersampling=self.supersampling)
            return self.electrons(band, sensor) * reflectance
        if white:
            return self.electrons(band, sensor) * np.float32(WHITE_REFLECTANCE)
        return np.zeros_like(self.illumination)

    def _mosaic(self, sensor: SensorModel, sight: PaintingView | None, white: bool) -> np.ndarray:
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
        sight: PaintingView | None,
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


FEW = 24.0


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """What stays the same from frame to frame; arrays (rows, columns), float32.

    Parameters
    ----------
    response : ndarray
        1 + u of Eq. (2); near 0 where a sensel is dead.
    dark : ndarray
        Mean dark current over the sensor's: 1, or tens to hundreds where a sensel is hot.
    dark_response : ndarray
        1 + v of Eq. (2).
    """

    response: np.ndarray
    dark: np.ndarray
    dark_response: np.ndarray


def key(root: int, *names: str) -> np.ndarray:
    """Return the key, uint64 (1,), of whatever has these `names`."""
    parts = [crc32(name.encode()) for name in names]
    return np.random.SeedSequence([root, *parts]).generate_state(1, np.uint64)


def fixed_pattern(
    shape: tuple[int, int],
    sensor: Sensor,
    rng: np.random.Generator,
    *,
    hot: float = 2e-4,
    dead: float = 4e-5,
) -> FixedPattern:
    """Draw a sensor's fixed pattern.

    Parameters
    ----------
    shape : (rows, columns)
    hot, dead : float
        Shares of sensels.
    """
    response = 1 + sensor.prnu * rng.standard_normal(shape, np.float32)
    dark_response = 1 + sensor.dsnu * rng.standard_normal(shape, np.float32)
    dark = np.ones(shape, np.float32)
    count = round(hot * response.size)
    dark.flat[rng.integers(0, dark.size, count)] = rng.uniform(20, 400, count)
    count = round(dead * response.size)
    response.flat[rng.integers(0, dark.size, count)] = rng.uniform(0, 0.15, count)
    return FixedPattern(response, dark, dark_response)


def expose(
    exposure: np.ndarray, sensor: Sensor, pattern: FixedPattern, seed: np.ndarray
) -> np.ndarray:
    """Return one frame.

    Parameters
    ----------
    exposure : ndarray, (rows, columns), float32
        Mean photo-electrons e of each sensel.
    seed : ndarray, (1,), uint64
        What `key` returns; one a frame.

    Returns
    -------
    counts : ndarray, (rows, columns), uint16

    Notes
    -----
    Poisson counts of mean 24 and more are drawn as rounded normal deviates with the skewness
    restored (Cornish–Fisher), wrong by less than 1e-3 in probability; smaller ones exactly.
    """
    counts = np.empty(exposure.shape, np.uint16)
    numbers = np.array(
        [
            sensor.dark,
            sensor.read,
            sensor.gain,
            sensor.black,
            float(sensor.saturation),
            sensor.full_well,
        ]
    )
    in_threads(
        _expose,
        len(exposure),
        np.ascontiguousarray(exposure, np.float32),
        (pattern.response, pattern.dark, pattern.dark_response),
        numbers,
        _poisson_table(sensor.dark),
        seed[0],
        counts,
    )
    return counts


def _poisson_table(mean: float) -> np.ndarray:
    """Return the distribution function of a Poisson variate, for looking the common dark up."""
    from scipy.special import pdtr

    return pdtr(np.arange(int(mean + 12 * np.sqrt(mean) + 24)), mean)


@njit
def _uniform(state: np.uint64) -> float:
    """Return a number in (0, 1) from a counter: splitmix64's finaliser."""
    z = state
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (float(z >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@njit
def _poisson(mean: float, normal: float, uniform: float) -> float:
    if mean >= FEW:
        root = np.sqrt(mean)
        return max(np.floor(mean + root * normal + (normal * normal - 1.0) / 6.0 + 0.5), 0.0)
    # Inversion by sequential search.
    share = np.exp(-mean)
    total, k = share, 0.0
    while uniform > total and k < 200.0:
        k += 1.0
        share *= mean / k
        total += share
    return k


@njit(cache=True)
def _expose(
    first: int,
    stop: int,
    exposure: np.ndarray,
    pattern: tuple[np.ndarray, np.ndarray, np.ndarray],
    c: np.ndarray,
    table: np.ndarray,
    seed: np.uint64,
    counts: np.ndarray,
) -> None:
    response, dark, dark_response = pattern
    columns = exposure.shape[1]
    golden = np.uint64(0x9E3779B97F4A7C15)
    start = int(c[0])
    for i in range(first, stop):
        for j in range(columns):
            at = seed + np.uint64(4) * np.uint64(i * columns + j) * golden
            u0, u1 = _uniform(at), _uniform(at + golden)
            u2 = _uniform(at + np.uint64(2) * golden)
            # Box and Muller: one pair serves the shot noise and the read-out.
            radius, angle = np.sqrt(-2.0 * np.log(u0)), 2.0 * np.pi * u1
            shot = _poisson(exposure[i, j], radius * np.cos(angle), u2)
            u3 = _uniform(at + np.uint64(3) * golden)
            if dark[i, j] == 1.0:
                k = start
                while k > 0 and u3 <= table[k - 1]:
                    k -= 1
                while k < len(table) - 1 and u3 > table[k]:
                    k += 1
                thermal = float(k)
            else:
                mean = c[0] * dark[i, j]
                # A logistic deviate of spread 1 stands in for a normal one: hot sensels are few.
                thermal = _poisson(mean, np.sqrt(3.0) / np.pi * np.log(u3 / (1.0 - u3)), u3)
            value = shot * response[i, j] + thermal * dark_response[i, j]
            value = min(value, c[5]) + c[1] * radius * np.sin(angle)
            count = np.floor(value * c[2] + c[3] + 0.5)
            counts[i, j] = np.uint16(min(max(count, 0.0), c[4]))

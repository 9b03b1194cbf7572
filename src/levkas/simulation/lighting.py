"""Simulated lamps: shading of the relief, glare of varnish and gold.

A reflectance factor is the light that a camera gets over what it would get from a flat white
diffuser in the panel's plane. Paint gives its reflectance times the shading; varnish and gold leaf
add a lobe of facets, GGX of [walter2007]_. Crossed polarisers let their leak through of that lobe, and
twice as much of it as of what is diffuse, which has lost its polarisation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.colour.microfacet import transmitted
from levkas.core.compiled import njit
from levkas.core.threads import in_threads
from levkas.simulation.rendering import Texture

if TYPE_CHECKING:
    from levkas.simulation.optics import Viewpoint
    from levkas.simulation.painting import Painting, Panel

VARNISH_MIRROR = 0.04
PAINT_TRANSPARENT_NM, PAINT_EDGE_NM, PAINT_TRANSPARENCY = 820.0, 55.0, 0.85
MACRO_STEP_MM = 0.5
PENUMBRA_MM = 0.35
LEAK = 1e-3  # of crossed sheet polarisers over parallel ones, as in a setup file of the planner
POINTS = 4  # of a large lamp a side


@dataclass(frozen=True)
class SimulatedLamp:
    """A lamp: degrees from the panel's normal, degrees from X towards Y, mm, relative power.

    `size_mm` is the side of a square that faces the panel's middle; 0 is a small lamp.
    """

    elevation: float
    azimuth: float
    distance_mm: float = 2100.0
    power: float = 1.0
    size_mm: float = 0.0

    def place(self) -> np.ndarray:
        """Return its place in the world, mm, (3,)."""
        e, a = np.radians(self.elevation), np.radians(self.azimuth)
        return self.distance_mm * np.array(
            [np.sin(e) * np.cos(a), np.sin(e) * np.sin(a), -np.cos(e)]
        )

    def points(self) -> np.ndarray:
        """Return the points of light that stand for it, mm, (1 or 16, 3)."""
        middle = self.place()
        if not self.size_mm:
            return middle[None]
        side = np.array([-middle[1], middle[0], 0.0]) / np.hypot(*middle[:2])
        up = np.cross(middle, side) / self.distance_mm
        offsets = ((np.arange(POINTS) + 0.5) / POINTS - 0.5) * self.size_mm
        x, y = (g.ravel()[:, None] for g in np.meshgrid(offsets, offsets))
        return middle + x * side + y * up


@dataclass(frozen=True)
class SimulatedLighting:
    """Lamps, and what stands before them and the camera.

    Parameters
    ----------
    crossed : bool
        Sheet polarisers before lamps and camera, crossed.
    illuminant : str
        CIE illuminant to which filters bring the lamps; D50, as the cameras' own, without.
    """

    lamps: tuple[SimulatedLamp, ...]
    crossed: bool = False
    illuminant: str = "D50"


def _pair(elevation: float, distance_mm: float, **more: float) -> tuple[SimulatedLamp, ...]:
    return tuple(SimulatedLamp(elevation, a, distance_mm, **more) for a in (0.0, 180.0))


SETUPS: dict[str, SimulatedLighting] = {
    "proposed": SimulatedLighting(_pair(70.0, 2100.0)),
    "45-degree": SimulatedLighting((SimulatedLamp(45.0, 195.0, 1500.0),)),
    "crossed": SimulatedLighting(_pair(45.0, 1500.0), crossed=True),
    "soft": SimulatedLighting(_pair(45.0, 1000.0, size_mm=600.0)),
    "d65": SimulatedLighting(_pair(70.0, 2100.0), illuminant="D65"),
    "scan": SimulatedLighting((SimulatedLamp(45.0, 90.0, 500.0),)),
}


@dataclass(frozen=True, eq=False)
class SimulatedLight:
    """What a setup does to a painting, as one camera records it; arrays (rows, columns), float32.

    Parameters
    ----------
    shade : ndarray
        Factor on the reflectance of paint.
    gold, varnish : ndarray
        Reflectance factor of a perfect mirror with the roughness of gold leaf, of varnish.
    """

    shade: np.ndarray
    gold: np.ndarray
    varnish: np.ndarray


def light(
    painting: Painting, panel: Panel, view: Viewpoint, lighting: SimulatedLighting
) -> SimulatedLight:
    """Light a painting for one camera; the lamps of a line scanner travel with it."""
    lamps = lighting.lamps
    points = [(place, lamp) for lamp in lamps for place in lamp.points()]
    s = np.arange(-panel.width_mm / 2, panel.width_mm / 2 + 2 * MACRO_STEP_MM, MACRO_STEP_MM)
    t = np.arange(-panel.height_mm / 2, panel.height_mm / 2 + 2 * MACRO_STEP_MM, MACRO_STEP_MM)
    height = panel.heights(np.stack(np.meshgrid(s, t), -1).reshape(-1, 2)).reshape(len(t), len(s))
    across, along = np.gradient(height, MACRO_STEP_MM)
    lit = [_reached(height, place) for place, _ in points]
    macro = np.stack([along, across, *lit], -1).astype(np.float32)
    eye = -np.reshape(view.rotation, (3, 3)).T @ np.array(view.translation)
    power = sum(lamp.power for lamp in lamps)
    entered = sum(lamp.power * transmitted(lamp.elevation) for lamp in lamps) / power
    numbers = np.array(
        [
            painting.px_per_mm,
            panel.width_mm / 2,
            panel.height_mm / 2,
            panel.radius_mm,
            *eye,
            *(view.motion or (0.0, 0.0, 0.0)),
            *painting.facets,
            1 - painting.gloss * (1 - entered / transmitted(45.0)),
            MACRO_STEP_MM,
        ]
    )
    places = np.array([[*place, lamp.power * lamp.distance_mm**2] for place, lamp in points])
    out = np.empty((3, *painting.relief.shape), np.float32)
    in_threads(_light, len(painting.relief), painting.relief, macro, numbers, places, out)
    if lighting.crossed:
        out[1:] *= np.float32(2 * LEAK)
    return SimulatedLight(*out)


def _reached(height: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return how far a point of light reaches each node past the ledge, 0 to 1, with a soft edge."""
    low = np.array([place[0], place[1]]) / -place[2]
    reach = (height.max() - height.min()) * np.hypot(*low)
    hidden = np.full(height.shape, -np.inf)
    for step in range(1, int(np.ceil(reach / MACRO_STEP_MM)) + 1):
        rise = step * MACRO_STEP_MM / max(np.hypot(*low), 1e-9)
        dx, dy = np.round(step * low / max(np.hypot(*low), 1e-9)).astype(int)
        rows = np.clip(np.arange(height.shape[0]) + dy, 0, height.shape[0] - 1)
        columns = np.clip(np.arange(height.shape[1]) + dx, 0, height.shape[1] - 1)
        hidden = np.maximum(hidden, height[np.ix_(rows, columns)] - height - rise)
    return np.clip(0.5 - hidden / PENUMBRA_MM, 0, 1)


def transparency(wavelengths: np.ndarray) -> np.ndarray:
    """Return how far paint lets the drawing below show: nothing in the visible, most at 1 µm.

    >>> transparency(np.array([500.0, 1000.0])).round(2)
    array([0.  , 0.82])
    """
    x = (np.asarray(wavelengths, float) - PAINT_TRANSPARENT_NM) / PAINT_EDGE_NM
    return PAINT_TRANSPARENCY / (1 + np.exp(-x))


def compose(
    painting: Painting, lit: SimulatedLight, response: np.ndarray, wavelengths: np.ndarray
) -> Texture:
    """Return the reflectance factor of a lit painting in one band.

    Parameters
    ----------
    response : ndarray, (n,)
        Light times sensitivity at `wavelengths`, of sum 1.
    wavelengths : ndarray, (n,), nm
        Those of the painting's spectra.
    """
    paints = painting.spectra @ response / 255
    metal = np.where(painting.metal, paints, 0).astype(np.float32)
    paint = np.where(painting.metal, 0, paints).astype(np.float32)
    gilt = painting.metal.astype(np.float32) / np.float32(255)
    mirror = np.float32(VARNISH_MIRROR * painting.gloss)
    through_paint = np.float32(transparency(wavelengths) @ response / 255)
    maps = _Maps(painting.amounts, painting.underdrawing, lit.shade, lit.gold, lit.varnish)
    values = np.empty(lit.shade.shape, np.float32)
    factors = _BandFactors(paint, metal, gilt, through_paint, mirror)
    in_threads(_compose, len(values), maps, factors, values)
    return Texture(values, painting.px_per_mm)


class _Maps(NamedTuple):
    """What lies where on a lit painting: `amounts` (rows, columns, pigments), the others (rows, columns)."""

    amounts: np.ndarray
    under: np.ndarray
    shade: np.ndarray
    gold: np.ndarray
    varnish: np.ndarray


class _BandFactors(NamedTuple):
    """Reflectance in one band: of pigments as `paint` and `metal`, (pigments,), and of the layers above and below."""

    paint: np.ndarray
    metal: np.ndarray
    gilt: np.ndarray
    through_paint: np.float32
    mirror: np.float32


@njit(cache=True)
def _compose(start, stop, maps, band, out):  # type: ignore[no-untyped-def]
    """Fill reflectance factors, (rows, columns), float32, of `_Maps` and `_BandFactors`."""
    amounts, under, shade, gold, varnish = maps
    paint, metal, gilt, through_paint, mirror = band
    one = np.float32(1.0)
    for i in range(start, stop):
        for j in range(out.shape[1]):
            diffuse, lobe, leaf = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for k in range(amounts.shape[2]):
                a = np.float32(amounts[i, j, k])
                diffuse += a * paint[k]
                lobe += a * metal[k]
                leaf += a * gilt[k]
            value = diffuse * shade[i, j] * (one - through_paint * np.float32(under[i, j]))
            out[i, j] = value + lobe * gold[i, j] + (one - leaf) * mirror * varnish[i, j]


@njit
def _lobe(cosine: float, alpha: float, toward_light: float, toward_eye: float) -> float:
    """Return π·D·G / (4 n·v) of GGX with Smith's shadowing, to be weighted by n-free irradiance."""
    spread = cosine * cosine * (alpha * alpha - 1.0) + 1.0
    facets = alpha * alpha / (np.pi * spread * spread)
    shadow = 1.0
    for c in (toward_light, toward_eye):
        shadow *= 2.0 * c / (c + np.sqrt(alpha * alpha + (1.0 - alpha * alpha) * c * c))
    return np.pi * facets * shadow / (4.0 * toward_eye)


@njit(cache=True)
def _light(
    start: int,
    stop: int,
    relief: np.ndarray,
    macro: np.ndarray,
    c: np.ndarray,
    lamps: np.ndarray,
    out: np.ndarray,
) -> None:
    rows, columns = relief.shape
    for i in range(start, stop):
        up, down = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(columns):
            left, right = max(j - 1, 0), min(j + 1, columns - 1)
            s, t = (j + 0.5) / c[0] - c[1], (i + 0.5) / c[0] - c[2]
            u = min((s + c[1]) / c[13], macro.shape[1] - 1.001)
            v = min((t + c[2]) / c[13], macro.shape[0] - 1.001)
            k, m = int(v), int(u)
            fv, fu = v - k, u - m
            a, b, d, e = (1 - fv) * (1 - fu), (1 - fv) * fu, fv * (1 - fu), fv * fu
            p0, p1, p2, p3 = macro[k, m], macro[k, m + 1], macro[k + 1, m], macro[k + 1, m + 1]
            p = a * p0[0] + b * p1[0] + d * p2[0] + e * p3[0]
            q = a * p0[1] + b * p1[1] + d * p2[1] + e * p3[1]
            # Micrometres over millimetres.
            p += 1e-3 * c[0] * (relief[i, right] - relief[i, left]) / (right - left)
            q += 1e-3 * c[0] * (relief[down, j] - relief[up, j]) / (down - up)
            sine, cosine = np.sin(t / c[3]), np.cos(t / c[3])
            size = np.sqrt(1.0 + p * p + q * q)
            nx, ny, nz = -p / size, (sine - q * cosine) / size, (-cosine - q * sine) / size
            x, y, z = s, c[3] * sine, c[3] * (1.0 - cosine)
            travel = x * c[7] + y * c[8] + z * c[9]
            ahead = travel - (c[4] * c[7] + c[5] * c[8] + c[6] * c[9])
            vx, vy, vz = c[4] + ahead * c[7] - x, c[5] + ahead * c[8] - y, c[6] + ahead * c[9] - z
            far = np.sqrt(vx * vx + vy * vy + vz * vz)
            vx, vy, vz = vx / far, vy / far, vz / far
            facing = max(nx * vx + ny * vy + nz * vz, 1e-3)
            got, flat, gold, varnish = 0.0, 0.0, 0.0, 0.0
            for n in range(lamps.shape[0]):
                lx = lamps[n, 0] + travel * c[7] - x
                ly = lamps[n, 1] + travel * c[8] - y
                lz = lamps[n, 2] + travel * c[9] - z
                d2 = lx * lx + ly * ly + lz * lz
                away = np.sqrt(d2)
                lx, ly, lz, strength = lx / away, ly / away, lz / away, lamps[n, 3] / d2
                flat += strength * max(-lz, 0.0)
                incident = nx * lx + ny * ly + nz * lz
                open_ = a * p0[2 + n] + b * p1[2 + n] + d * p2[2 + n] + e * p3[2 + n]
                strength *= open_
                if incident <= 1e-3:
                    continue
                got += strength * incident
                hx, hy, hz = lx + vx, ly + vy, lz + vz
                half = np.sqrt(hx * hx + hy * hy + hz * hz)
                tilt = (nx * hx + ny * hy + nz * hz) / half
                gold += strength * _lobe(tilt, c[10], incident, facing)
                varnish += strength * _lobe(tilt, c[11], incident, facing)
            out[0, i, j] = got / flat * c[12]
            out[1, i, j] = gold / flat
            out[2, i, j] = varnish / flat

"""Captures with planted errors, each of a known size: panels, laboratories' errors, frames, and the budget that states them.

Cameras are those of tests/promises, which share no line with the package.
"""

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.stats import norm

import levkas
from levkas.calibration.error_sources import ErrorSource
from levkas.core.cube import Band
from levkas.database.described import Pixels
from levkas.database.region_uncertainty import LayerBudget

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "promises"))
from camera import Camera, Habits

LIGHT, TOP, SLANT = 3000.0, 4095.0, 45.0
"""Counts of a perfect diffuser, of the full scale; degrees between light and normal."""
SIZES = {
    "white board": 0.01, "lamp between white and object": 0.02, "black level": 1.0, "linearity": 0.005,
    "stray light": 0.01, "wavelength": 1.0, "angle of the light": 2.0, "place": 0.2,
}  # fmt: skip
"""Standard uncertainties: relative, counts of the black level, nm, degrees, px."""
NONE = dict.fromkeys(SIZES, 0.0)
NM = np.array([430.0, 490.0, 550.0, 610.0, 670.0])
NINE = [["a", "b", "c"], ["d", "e", "f"], ["g", "h", "i"]]


@dataclass(frozen=True)
class Kind:
    """A kind of camera: where its bands lie, and which of them share an error."""

    nm: np.ndarray
    lamp_at_once: bool = False
    one_sensor: bool = True
    prism: bool = False
    fwhm: float = 10.0

    def labels(self) -> list[str]:
        """Names of the bands."""
        return [f"{nm:g} nm" for nm in self.nm]

    def weights(self, lighting: str) -> list[tuple[np.ndarray, np.ndarray]]:
        """What each band sees of every wavelength under a lighting: nm, and weights of sum 1."""
        found = []
        for centre in self.nm:
            nm = centre + self.fwhm * np.linspace(-1.2, 1.2, 13)
            seen = np.exp(-4 * np.log(2) * ((nm - centre) / self.fwhm) ** 2)
            seen *= LIGHTINGS[lighting](nm)
            found.append((nm, seen / seen.sum()))
        return found


KINDS = {
    "bands": Kind(np.arange(400.0, 721, 20), fwhm=15.0),
    "mosaic": Kind(np.arange(410.0, 711, 37.5), lamp_at_once=True, fwhm=25.0),
    "sensors": Kind(np.arange(430.0, 691, 52), lamp_at_once=True, one_sensor=False, fwhm=40.0),
    "cube": Kind(np.arange(400.0, 721, 10), lamp_at_once=True, prism=True, fwhm=5.0),
}
LIGHTINGS = {
    "even": np.ones_like,
    # Planck's law at 3000 K, and blue at 450 nm below a phosphor at 570 nm.
    "halogen": lambda nm: (500 / nm) ** 5 / (np.exp(1.4388e7 / (3000 * nm)) - 1),
    "LED": lambda nm: (
        np.exp(-(((nm - 450) / 14) ** 2)) + 0.7 * np.exp(-(((nm - 570) / 80) ** 2)) + 0.01
    ),
}
"""Power of a lighting by wavelength, in any unit."""


@dataclass(frozen=True)
class Errors:
    """One draw of every error of one capture; of what bands do not share, one each."""

    white: float
    lamp: np.ndarray
    black: np.ndarray
    bend: np.ndarray
    stray: float
    nm: np.ndarray
    angle: float
    place: np.ndarray

    @classmethod
    def draw(cls, rng, sizes, kind):
        """Draw errors of some sizes for a kind of camera."""
        n = len(kind.nm)

        def of(name, shared):
            return sizes[name] * (
                np.full(n, rng.standard_normal()) if shared else rng.standard_normal(n)
            )

        return cls(
            sizes["white board"] * rng.standard_normal(),
            of("lamp between white and object", kind.lamp_at_once),
            of("black level", kind.lamp_at_once and kind.one_sensor),
            of("linearity", kind.one_sensor),
            sizes["stray light"] * rng.standard_normal(),
            of("wavelength", kind.prism),
            sizes["angle of the light"] * rng.standard_normal(),
            sizes["place"] * rng.standard_normal(2),
        )  # fmt: skip


class EvenDraws:
    """Normal numbers of one of some draws, which together lie evenly: the k-th of all of them are their quantiles in some order."""

    def __init__(self, number, count):
        self.number, self.count, self.rng = number, count, np.random.default_rng(0)

    def standard_normal(self, several=1):
        """Return one number or several."""
        places = [
            self.rng.permutation(self.count)[self.number % self.count] for _ in range(several)
        ]
        made = norm.ppf((np.array(places) + 0.5) / self.count)
        return made if several > 1 else float(made[0])


@dataclass(frozen=True)
class Panel:
    """Patches in a grid, each of a smooth spectrum and, on slopes, a little brighter to one side; or even."""

    spectra: np.ndarray
    """(rows, columns, 4): tone, height, middle nm and width nm of a step."""
    side: int
    slopes: np.ndarray = field(default_factory=lambda: np.zeros(2))

    @classmethod
    def draw(cls, rng, rows, columns, side, *, slope=0.0):
        """Draw spectra; `slope` is the standard deviation of the relative change over a pixel."""
        low, high = [0.03, 0.05, 450, 50], [0.25, 0.65, 650, 110]
        return cls(
            rng.uniform(low, high, (rows, columns, 4)),
            side,
            slope * rng.uniform(-(3**0.5), 3**0.5, 2),
        )

    @property
    def shape(self):
        """Rows and columns, px."""
        return tuple(self.side * n for n in self.spectra.shape[:2])

    def seen(self, nm, place=(0.0, 0.0)):
        """Return reflectances at one wavelength, (h, w), from a place that lies off by some px in x and y."""
        tone, height, middle, width = np.moveaxis(self.spectra, -1, 0)
        level = tone + height / (1 + np.exp(-(nm - middle) / width))
        y, x = (np.arange(n) % self.side - (self.side - 1) / 2 for n in self.shape)
        over = self.slopes[0] * (x + place[0]) + self.slopes[1] * (y[:, None] + place[1])
        return np.kron(level, np.ones((self.side, self.side))) * (1 + over)

    def corners(self):
        """Return least x and y of every patch, (p, 2)."""
        y, x = np.indices(self.spectra.shape[:2])
        return self.side * np.stack([x.ravel(), y.ravel()], 1)


def tilt_of(degrees):
    """Return by what a white that stands otherwise by some degrees is brighter than one that stands as the object."""
    return float(np.cos(np.deg2rad(SLANT + degrees)) / np.cos(np.deg2rad(SLANT)))


def capture(kind, panel, errors, seed, *, shots=4, lighting=None):
    """Calibrate one capture of a panel with errors; return its cube. Without a lighting bands see one wavelength each."""
    made = KINDS[kind] if isinstance(kind, str) else kind
    camera = Camera(panel.shape, Habits(light=LIGHT, seed=seed), line=made.prism)
    lit = (1 + errors.white) * tilt_of(errors.angle)
    alone = [(np.array([nm]), np.ones(1)) for nm in made.nm]
    weights = alone if lighting is None else made.weights(lighting)
    frames = {"dark": [], "white": [], "object": []}
    for k, (nm, shares) in enumerate(weights):
        camera.habits = replace(
            camera.habits, curve=errors.bend[k] * TOP / LIGHT, stray=errors.stray
        )
        each = zip((nm + errors.nm[k]).tolist(), shares.tolist(), strict=True)
        seen = sum(share * panel.seen(one, errors.place) for one, share in each)
        level = camera.habits.black
        frames["dark"].append([camera.frame(0.0, 1.0, lamp=0.0) for _ in range(shots)])
        frames["white"].append([camera.frame(lit, 1.0) for _ in range(shots)])
        frames["object"].append([
            camera.frame(seen, 1.0, lamp=1 + errors.lamp[k], black=level + errors.black[k])
        ])  # fmt: skip
    if kind == "mosaic":
        y, x = (np.arange(n) for n in panel.shape)
        which = 3 * (y[:, None] % 3) + x % 3
        flat = {
            name: [np.choose(which, one) for one in zip(*bands, strict=True)]
            for name, bands in frames.items()
        }
        return levkas.calibrate(
            flat["object"], flat["dark"], flat["white"],
            pattern=NINE, wavelengths=made.nm, saturation=TOP,
        )  # fmt: skip
    stacks = {name: list(np.stack(bands, -1)) for name, bands in frames.items()}
    if made.prism:
        for name in ("dark", "white"):  # lines of one line of sensels
            stacks[name] = [line[None] for shot in stacks[name] for line in shot[:16]]
    return levkas.calibrate(
        stacks["object"], stacks["dark"], stacks["white"], wavelengths=made.nm, saturation=TOP
    )


def budget(kind, sizes, cube, white=""):
    """Return the rows of what was planted, as `levkas.stages.budget` makes them of what is declared."""
    labels, view = kind.labels(), np.nanmean(cube.values, (0, 1))
    planted = {
        "white board": ("relative", 1.0, "campaign", True),
        "lamp between white and object": ("relative", 1.0, "frame", kind.lamp_at_once),
        "black level": ("reflectance", 1 / LIGHT, "frame", kind.lamp_at_once and kind.one_sensor),
        "linearity": ("relative", 1.0, "camera", kind.one_sensor),
        "stray light": ("reflectance", 1.0, "camera", True),
        "wavelength": ("nm", 1.0, "camera", kind.prism),
        "angle of the light": (
            "relative", float(np.deg2rad(1) * np.tan(np.deg2rad(SLANT))), "frame", True,
        ),
    }  # fmt: skip
    zero = {"linearity": 1 + 0 * view, "stray light": view}
    return LayerBudget(tuple(
        ErrorSource(
            name, unit, dict.fromkeys(labels, scale * sizes[name]), extent, all_bands=shared,
            owner=white if name == "white board" else "",
            zero_at=dict(zip(labels, zero.get(name, ()), strict=False)),
        )
        for name, (unit, scale, extent, shared) in planted.items()
    ))  # fmt: skip


def arrays_of(cube, kind):
    """Return the pixels of a cube, and its bands, as a layer has them."""
    bands = [Band(label, nm) for label, nm in zip(kind.labels(), kind.nm, strict=True)]
    return Pixels(cube.values, cube.flags, cube.sigma), bands

"""Do intervals hold the truth, and do ten laboratories agree? Errors of known size, planted into simulated captures.

    python benchmarks/uncertainty.py [arrays] [rows] [builds] [laboratories] [dates] [--results FILE]

Cameras are those of tests/promises, which share no line with the package. `arrays` draws all errors at once and goes through
`levkas.calibrate`; `rows` draws one at a time; `builds` builds whole campaigns, in which what can be measured is; ten `laboratories`
measure one panel of even patches, each with errors of its own, with one of two whites and under one of two lightings. `dates` builds
two sessions of one painting, which lies elsewhere in the second, and looks for changes as `levkas agree` does.
"""

import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from results import record, taken_option
from scipy import ndimage
from scipy.stats import norm

import levkas
from levkas.building.run import build
from levkas.calibration.error_sources import ErrorSource
from levkas.colour.gamut import delta_e_2000, lab_of
from levkas.core.cube import Band
from levkas.database.described import Pixels
from levkas.database.layout import LayerId
from levkas.database.region_uncertainty import (
    LayerBudget,
    combine,
    mean_of_region,
    uncertain_region,
    with_place,
)
from levkas.database.regions import make_region
from levkas.quality.evaluation.camera_agreement import PatchMeans, compare_all
from levkas.quality.evaluation.database_agreement import compare_databases

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "promises"))
from camera import Camera, Habits, write_campaign

DRAWS, ALONE, BUILDS, BUILDS_ALONE, PANELS, DATES = 1000, 24, 40, 36, 6, 6
COURSES = ("steady", "settling", "wandering")


# --- captures with errors of known size

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


# --- arrays ---------------------------------------------------------------------------------------

SIDE = 104
QUANTITIES = (
    "one pixel", "mean of 10²", "mean of 10⁴", "difference of bands", "ratio of bands",
    "ratio of regions", "ΔE00",
)  # fmt: skip
FILTERS = Kind(NM)


def draw_arrays(seed, sizes=SIZES, *, shots=4, of_all=DRAWS):
    """Calibrate one of some draws; return (Uncertain, truth) of every quantity."""
    rng = np.random.default_rng(seed)
    panel = Panel.draw(rng, 1, 2, SIDE, slope=0.004)
    errors = Errors.draw(EvenDraws(seed, of_all), sizes, FILTERS)
    cube = capture(FILTERS, panel, errors, seed, shots=shots)
    labels, parts = FILTERS.labels(), arrays_of(cube, FILTERS)
    rows = with_place(budget(FILTERS, sizes, cube), labels, np.full(len(NM), sizes["place"]))
    truth = np.stack([panel.seen(nm) for nm in NM], -1)

    def read(side, left=0):
        start = (SIDE - side) // 2
        x0, y0, x1, y1 = left + start, start, left + start + side, start + side
        mean = mean_of_region(*parts, make_region(None, (x0, y0, x1 - 1, y1 - 1), None))
        exact = truth[y0:y1, x0:x1].mean((0, 1))
        return uncertain_region(mean, rows, LayerId("panel", "cam"), (side, left)), exact

    one, some, many, other = read(1), read(10), read(100), read(10, SIDE)
    numbers = [one, some, many]
    for make in (np.subtract, np.divide):
        made = some[0].through(lambda v, m=make: m(v[3:4], v[1:2]))
        numbers.append((made, make(some[1][3:4], some[1][1:2])))
    for of, make in (("ratio", np.divide), ("delta_e", lambda a, b: colour_difference(a, b, NM))):
        made = combine(of, labels, NM, some[0], other[0])[0]
        numbers.append((made, make(some[1], other[1])))
    return numbers


def colour_difference(first, second, nm):
    """Return ΔE2000 of two spectra, (n,), (1,)."""
    return delta_e_2000(lab_of(first[None], nm), lab_of(second[None], nm))


def coverage(draws):
    """Return the share of truths within U, k = 2, quantity by quantity, and the spread of (x − truth)/u."""
    found = {}
    for name, pairs in zip(QUANTITIES, zip(*draws, strict=True), strict=True):
        miss = np.concatenate([(made.values - exact) / made.sigma for made, exact in pairs])
        found[name] = (float(np.mean(np.abs(miss) <= 2)), float(np.sqrt(np.mean(miss**2))))
    return found


def run_rows(count):
    """Return (planted over what the budget has, rms) of every row, drawn alone, in the mean of 10⁴ pixels."""
    found = {}
    for name, size in SIZES.items():
        errors, sizes = [], NONE | {name: size}
        for seed in range(count):
            made, exact = draw_arrays(seed, sizes, of_all=count)[2]
            errors.append((made.values - exact, made.by_source().get(name, 0 * exact)))
        missed, stated = (np.sqrt(np.mean(np.square(part))) for part in zip(*errors, strict=True))
        found[name] = float(missed / stated)
    return found


# --- builds ---------------------------------------------------------------------------------------

SHAPE, TILES = (120, 180), (4, 6)
MIDDLES = (450, 550, 650)
STATED = """
[cameras.cam.uncertainty]
wavelength_nm = {wavelength}
linearity = {linearity}
stray_light = {stray light}
[setups.default]
angle_deg = 45
angle_uncertainty_deg = {angle of the light}
"""


def draw_course(kind, rng):
    """Return how a lamp or black level gets to its last level, shares of that evenly in time: steady, settling, or wandering."""
    at = np.linspace(0, 1, 61)
    if kind == "steady":
        return at
    if kind == "settling":  # with a time constant of a fifth of the session up to all of it
        rate = rng.uniform(1, 5)
        return (1 - np.exp(-rate * at)) / (1 - np.exp(-rate))
    return np.append(0.0, np.cumsum(rng.standard_normal(60)) / 60**0.5)


def draw_build(seed, sizes=SIZES, *, of_all=BUILDS):
    """Build a campaign of a new draw; return (quantity, value − truth, U) of every tile.

    Whites before and after the object say what the lamp did, several darks what the black level did: nothing is declared of them.
    They drift steadily, settle or wander, three builds in turns, for all bands alike in one of two such turns, else for each by itself.
    """
    rng = np.random.default_rng(seed)
    panel = Panel.draw(rng, *TILES, SHAPE[0] // TILES[0])
    kind = Kind(np.array(MIDDLES, float))
    errors = Errors.draw(EvenDraws(seed, of_all), sizes, kind)
    level = (1 + errors.white) * tilt_of(errors.angle)
    alike = seed // len(COURSES) % 2
    lamp, black = (tuple(np.where(alike, e[0], e).tolist()) for e in (errors.lamp, errors.black))
    course = tuple(draw_course(COURSES[seed % len(COURSES)], rng).tolist())
    habits = Habits(
        light=LIGHT, seed=seed, shots=(6, 6, 3), after=3, clock=30.0, board=(level, level),
        drift=lamp, wander=black, course=course,
        stray=errors.stray, curve=float(errors.bend[0]) * TOP / LIGHT,
    )  # fmt: skip
    seen = np.stack([panel.seen(nm + d) for nm, d in zip(MIDDLES, errors.nm, strict=True)], -1)
    truth = np.stack([panel.seen(nm) for nm in MIDDLES], -1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "c"
        write_campaign(folder, "bands", habits, SHAPE, truth=seen)
        text = (folder / "campaign.toml").read_text()
        text = text.replace(
            "reflectance = 1.0", f"reflectance = 1.0, uncertainty = {sizes['white board']}"
        )
        (folder / "campaign.toml").write_text(text + STATED.format(**sizes))
        for step in build(folder):
            if step.state in ("refused", "failed"):
                raise SystemExit("\n".join(map(str, step.problems)))
        layer = levkas.open(folder / "database")["panel"]["cam"]
        return _read(layer, panel, truth, rng)


def _read(layer, panel, truth, rng):
    """Return (quantity, value − truth, U) rows of regions of every tile."""
    found, labels = [], [str(label) for label in layer.band.values]
    corners = panel.corners() + panel.side // 2
    other = (4, 4, 23, 23)

    def note(name, region, want, **more):
        made = layer.levkas.uncertainty(rectangle=region, **more)
        found.extend(
            (name, float(v - w), float(u))
            for v, w, u in zip(made.value, np.ravel(want), made.U, strict=True)
        )

    for x, y in corners.tolist():
        exact = truth[y, x]
        a, b = (int(n) for n in rng.integers(-8, 8, 2))
        note("one pixel", (x + a, y + b, x + a, y + b), exact)
        square = (x - 5, y - 5, x + 4, y + 4)
        note("mean of 10²", square, exact)
        two = [labels[2], labels[0]]
        note("difference of bands", square, exact[2] - exact[0], bands=two, of="difference")
        note("ratio of bands", square, exact[2] / exact[0], bands=two, of="ratio")
        if (x, y) != tuple(corners[0]):
            beside = {"rectangle": other}
            note("ratio of regions", square, exact / truth[8, 8], of="ratio", beside=beside)
            exact_e = colour_difference(exact, truth[8, 8], np.array(MIDDLES, float))
            note("ΔE00", square, exact_e, of="delta_e", beside=beside)
    whole = (4, 4, SHAPE[1] - 5, SHAPE[0] - 5)
    note("mean of 10⁴", whole, truth[4:-4, 4:-4].mean((0, 1)))
    return found


def coverage_of_builds(builds):
    """Return the share of truths within U, quantity by quantity, and the spread of (x − truth)/u."""
    found = {}
    for name in QUANTITIES[:-1]:
        miss = np.array([e / (u / 2) for rows in builds for n, e, u in rows if n == name])
        found[name] = (float(np.mean(np.abs(miss) <= 2)), float(np.sqrt(np.mean(miss**2))))
    return found


def rows_of_builds(count):
    """Return (error over row, rms) of what builds measure, each drawn alone, in the mean of 10⁴ pixels; and by its course."""
    found = {}
    for name in ("lamp between white and object", "black level"):
        squares = {course: [] for course in COURSES}
        for seed in range(count):
            read = draw_build(seed, NONE | {name: SIZES[name]}, of_all=count)
            pairs = [(e**2, (u / 2) ** 2) for what, e, u in read if what == "mean of 10⁴"]
            squares[COURSES[seed % len(COURSES)]] += pairs  # of this source alone
        squares[""] = [one for several in squares.values() for one in several]
        for course, own in squares.items():
            missed, stated = np.mean(own, 0)
            found[name, course or "builds"] = float(np.sqrt(missed / stated))
    return found


# --- laboratories ---------------------------------------------------------------------------------

FLEET = (
    "bands",
    "cube",
    "mosaic",
    "sensors",
    "cube",
    "bands",
    "mosaic",
    "sensors",
    "bands",
    "cube",
)
CAREFUL = {
    "white board": 0.003, "lamp between white and object": 0.003, "black level": 0.5, "linearity": 0.002,
    "stray light": 0.003, "wavelength": 0.3, "angle of the light": 0.3, "place": 0.2,
}  # fmt: skip
"""Of laboratories whose errors, 0.8 % of a value, are small enough that an undeclared one of 5 % stands out."""
PATCH, WITHIN = 18, 12
"""Side of a patch, px, and of what is compared of it: bands of a mosaic are interpolated."""


def lighting_of(number):
    """Return the lighting of a laboratory: every kind of camera is under either."""
    return ("halogen", "LED")[number // 4 % 2]


def measure(number, panel, sizes, rng, whites, *, wrong=0.0):
    """Return what one laboratory has on the patches; `wrong` is what its white is off undeclared."""
    name, made = f"laboratory {number}", KINDS[FLEET[number]]
    white, lighting = number % len(whites), lighting_of(number)
    errors = replace(Errors.draw(rng, sizes, made), white=whites[white] + wrong)
    cube = capture(FLEET[number], panel, errors, int(rng.integers(1 << 30)), lighting=lighting)
    rows, parts = budget(made, sizes, cube, white=f"white {white}"), arrays_of(cube, made)
    rows = with_place(rows, made.labels(), np.full(len(made.nm), sizes["place"]))
    layer, corners = LayerId("panel", name, lighting), panel.corners() + (PATCH - WITHIN) // 2
    means = []
    for x, y in corners.tolist():
        region = make_region(None, (x, y, x + WITHIN - 1, y + WITHIN - 1), None)
        means.append(mean_of_region(*parts, region))
    numbers = tuple(uncertain_region(mean, rows, layer, k) for k, mean in enumerate(means))
    return PatchMeans(layer, corners, tuple(means), numbers, np.full(len(made.nm), made.fwhm))


def compare_laboratories(seed, sizes, *, wrong=None):
    """Let ten laboratories measure one panel with two whites under two lightings; return the agreement of all pairs of them."""
    rng = np.random.default_rng(seed)
    panel = Panel.draw(rng, 4, 8, PATCH)
    whites = sizes["white board"] * rng.standard_normal(2)
    layers = [
        measure(k, panel, sizes, rng, whites, wrong=0.05 * (k == wrong)) for k in range(len(FLEET))
    ]
    seen = {
        layer.layer.name: dict(zip(layer.labels, made.weights(lighting_of(k)), strict=True))
        for k, (layer, made) in enumerate(zip(layers, map(KINDS.get, FLEET), strict=True))
    }
    return compare_all(layers, seen)


def run_laboratories(count, sizes):
    """Return shares of regions and of pairs with E_n of 1 or less, and the same per pair of kinds and of lightings, over some panels."""
    regions, pairs, kinds = [], [], {}
    for seed in range(count):
        found = compare_laboratories(seed, sizes)
        assert len(found) == 45
        for pair in found:
            expected = np.concatenate([band.expected for band in pair.bands])
            inside = expected[np.isfinite(expected)] <= 1
            regions.append(inside)
            pairs.append(not pair.contradictions)
            names = " – ".join(
                sorted(FLEET[int(one.camera[-1])] for one in (pair.first, pair.second))
            )
            lights = "two lightings" if pair.other_light else "one lighting"
            for group in (names, lights):
                kinds.setdefault(group, []).append(inside)
    by_kind = {k: float(np.concatenate(v).mean()) for k, v in sorted(kinds.items())}
    return float(np.concatenate(regions).mean()), float(np.mean(pairs)), by_kind


def run_wrong_white(count, sizes):
    """Return which share of pairs with a white that is wrong by 5 %, and of the others, is named."""
    named, others = [], []
    for seed in range(count):
        odd = seed % len(FLEET)
        for pair in compare_laboratories(1000 + seed, sizes, wrong=odd):
            has = str(odd) in (pair.first.camera[-1], pair.second.camera[-1])
            (named if has else others).append(bool(pair.contradictions))
    return float(np.mean(named)), float(np.mean(others))


# --- dates ----------------------------------------------------------------------------------------

GRID, WIDE, STEP, DISTANCE = (260, 340), 5, 0.01, 40
"""Pixels of a session; of a change its side, px, its size in reflectance, and how far it is to the next."""
LENS = 0.8
"""Standard deviation of the spread of a lens and of sensels, px: a camera has no edge sharper than this."""
TURN, SHIFT = np.deg2rad(0.4), np.array([2.3, -1.6])


def painting(seed):
    """Return even areas of paints with edges and grain, (h, w, 3), somewhat larger than a session sees."""
    rng = np.random.default_rng(seed)
    shape = tuple(n + 40 for n in GRID)
    paints = rng.uniform(0.15, 0.75, (8, 1)) * rng.uniform(0.7, 1.2, (8, 3))
    areas = ndimage.gaussian_filter(rng.standard_normal(shape), 7)
    which = np.digitize(areas, np.quantile(areas, np.arange(1, 8) / 8))
    grain = ndimage.gaussian_filter(rng.standard_normal(shape), 1.2) / 0.25
    tones = rng.permutation(paints)[which] * (1 + 0.03 * grain)[..., None]
    return ndimage.gaussian_filter(tones, (LENS, LENS, 0))


def session(folder, scene, place, seed):
    """Capture and build a painting that lies at a place, angle and shift; return its database."""
    turn, shift = place
    middle = (np.array(GRID) - 1) / 2
    y, x = (n - m for n, m in zip(np.indices(GRID), middle, strict=True))
    at = [np.cos(turn) * y - np.sin(turn) * x, np.sin(turn) * y + np.cos(turn) * x]
    at = np.stack(at) + (middle + 20 + shift)[:, None, None]
    seen = [ndimage.map_coordinates(scene[..., k], at, order=3) for k in range(3)]
    habits = Habits(light=LIGHT, seed=seed, shots=(6, 6, 3))
    write_campaign(folder, "bands", habits, GRID, truth=np.stack(seen, -1))
    for step in build(folder):
        if step.state in ("refused", "failed"):
            raise SystemExit("\n".join(map(str, step.problems)))
    return folder / "database"


def draw_dates(seed):
    """Return the share of an unchanged painting that is marked at 1 %, and which share of each planted change is."""
    before, rng = painting(seed), np.random.default_rng(seed)
    after = before.copy()
    y, x = (np.arange(60, n + 20 - 40, DISTANCE) for n in GRID)
    corners = [(a, b) for a in y.tolist() for b in x.tolist()]
    for a, b in corners:
        after[a : a + WIDE, b : b + WIDE] += STEP * rng.choice((-1, 1))
    here, there = (0.0, np.zeros(2)), (TURN, SHIFT)
    with tempfile.TemporaryDirectory() as name:
        made = [
            session(Path(name) / str(k), scene, place, 3 * seed + k)
            for k, (scene, place) in enumerate(((before, here), (before, there), (after, there)))
        ]
        still, changed = (compare_databases(made[0], other)[0].changes for other in made[1:])
    marked = [changed.mask[a - 20 :, b - 20 :][:WIDE, :WIDE].mean() for a, b in corners]
    return still.share, marked


# --- all of it ------------------------------------------------------------------------------------


def tell(path, table, values):
    """Print figures, and bring those of a file up to date."""
    for name, value in values.items():
        what, aspect = (name, "") if isinstance(name, str) else name
        print(f"{table:24} {what:32} {aspect:10} {value:.4g}", flush=True)
    record(path, table, values)


def run_arrays(path):
    """Measure the coverage of intervals on arrays."""
    found = coverage([draw_arrays(seed) for seed in range(DRAWS)])
    tell(path, "coverage", {(n, "arrays"): 100 * share for n, (share, _) in found.items()})


def run_alone(path):
    """Measure every row of the budget alone."""
    found = run_rows(ALONE)
    tell(path, "budget-rows", {(name, "arrays"): ratio for name, ratio in found.items()})


def run_builds(path):
    """Measure the coverage of intervals over whole builds."""
    found = coverage_of_builds([draw_build(seed) for seed in range(BUILDS)])
    tell(path, "coverage", {(n, "builds"): 100 * share for n, (share, _) in found.items()})
    tell(path, "budget-rows", rows_of_builds(BUILDS_ALONE))


def run_agreement(path):
    """Let laboratories measure panels."""
    found = {}
    for name, sizes in (("all errors", SIZES), ("careful", CAREFUL)):
        regions, pairs, kinds = run_laboratories(PANELS, sizes)
        found[f"{name}: Eₙ ≤ 1"] = 100 * regions
        print(name, pairs, kinds)
    named, others = run_wrong_white(PANELS, CAREFUL)
    found["white 5 % off: pairs named"] = 100 * named
    found["white 5 % off: others named"] = 100 * others
    tell(path, "laboratories", found)


def run_dates(path):
    """Look for changes between two sessions."""
    shares, marked = zip(*(draw_dates(seed) for seed in range(DATES)), strict=True)
    found = np.concatenate(marked)
    print("false alarms of each, %", np.round(100 * np.array(shares), 3))
    print(len(found), "changes, of whose pixels are marked, %", 100 * found.mean())
    tell(path, "laboratories", {
        "dates: false alarms at 1 %": 100 * float(np.mean(shares)),
        "dates: changes of 0.01 marked": 100 * float(np.mean(found >= 0.5)),
    })  # fmt: skip


PARTS = {
    "arrays": run_arrays,
    "rows": run_alone,
    "builds": run_builds,
    "laboratories": run_agreement,
    "dates": run_dates,
}

if __name__ == "__main__":
    results = taken_option()
    for name in sys.argv[1:] or PARTS:
        PARTS[name](results)

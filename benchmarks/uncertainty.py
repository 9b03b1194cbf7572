"""Do intervals hold the truth, and do ten laboratories agree? Errors of known size, planted into simulated captures.

    python benchmarks/uncertainty.py [arrays] [rows] [builds] [laboratories] [--results FILE]

Cameras are those of tests/promises, which share no line with the package. `arrays` draws all errors at once and goes through
`levkas.calibrate`; `rows` draws one at a time; `builds` builds whole campaigns, in which what can be measured is; ten `laboratories`
measure one panel of even patches, each with errors of its own and with one of two whites.
"""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from planted_errors import (
    KINDS,
    LIGHT,
    NM,
    NONE,
    SIZES,
    TOP,
    Errors,
    EvenDraws,
    Kind,
    Panel,
    arrays_of,
    budget,
    capture,
    tilt_of,
)
from results import record, taken_option

import levkas
from levkas.building.run import build
from levkas.colour.gamut import delta_e_2000, lab_of
from levkas.database.layout import LayerId
from levkas.database.region_uncertainty import combine, mean_of_region, uncertain_region, with_place
from levkas.database.regions import make_region
from levkas.quality.evaluation.camera_agreement import PatchMeans, compare_all

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "promises"))
from camera import Habits, write_campaign

DRAWS, ALONE, BUILDS, BUILDS_ALONE, PANELS = 400, 24, 40, 8, 6


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


def draw_build(seed, sizes=SIZES, *, of_all=BUILDS):
    """Build a campaign of a new draw; return (quantity, value − truth, U) of every tile, the budget's rows, and the errors.

    Whites before and after the object say what the lamp did, several darks what the black level did: nothing is declared of them.
    """
    rng = np.random.default_rng(seed)
    panel = Panel.draw(rng, *TILES, SHAPE[0] // TILES[0])
    kind = Kind(np.array(MIDDLES, float))
    errors = Errors.draw(EvenDraws(seed, of_all), sizes, kind)
    level = (1 + errors.white) * tilt_of(errors.angle)
    habits = Habits(
        light=LIGHT, seed=seed, shots=(6, 6, 3), after=3, clock=30.0, board=(level, level),
        drift=float(errors.lamp[0]), wander=float(errors.black[0]), stray=errors.stray,
        curve=float(errors.bend[0]) * TOP / LIGHT,
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
        steps = json.loads((folder / "database/objects/panel/provenance.json").read_text())["steps"]
        rows = next(s["uncertainty"] for s in steps if s["stage"] == "calibrate")
        return _read(layer, panel, truth, rng), {row["source"]: row for row in rows}, errors


def _read(layer, panel, truth, rng):
    """Return (quantity, value − truth, U) rows of regions of every tile."""
    found, labels = [], [str(label) for label in layer.band.values]
    corners = panel.corners() + panel.side // 2
    other = (4, 4, 23, 23)

    def note(name, region, want, **more):
        made = layer.uncertainty(rectangle=region, **more)
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
    for name in QUANTITIES:
        miss = np.array([e / (u / 2) for rows, *_ in builds for n, e, u in rows if n == name])
        found[name] = (float(np.mean(np.abs(miss) <= 2)), float(np.sqrt(np.mean(miss**2))))
    return found


def rows_of_builds(count):
    """Return (error over row, rms) of what builds measure, each drawn alone, in the mean of 10⁴ pixels."""
    found = {}
    for name in ("lamp between white and object", "black level"):
        errors, stated = [], []
        for seed in range(count):
            read, rows, _ = draw_build(seed, NONE | {name: SIZES[name]}, of_all=count)
            errors += [e for what, e, _ in read if what == "mean of 10⁴"]
            middle = 0.3 if rows[name]["unit"] == "relative" else 1.0  # mean of the panel
            stated += [middle * size for size in rows[name]["size"].values()]
        found[name] = float(np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(stated))))
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


def measure(number, panel, sizes, rng, whites, *, wrong=0.0):
    """Return what one laboratory has on the patches; `wrong` is what its white is off undeclared."""
    name, made = f"laboratory {number}", KINDS[FLEET[number]]
    white = number % len(whites)
    errors = replace(Errors.draw(rng, sizes, made), white=whites[white] + wrong)
    cube = capture(FLEET[number], panel, errors, int(rng.integers(1 << 30)))
    rows, parts = budget(made, sizes, cube, white=f"white {white}"), arrays_of(cube, made)
    rows = with_place(rows, made.labels(), np.full(len(made.nm), sizes["place"]))
    layer, corners = LayerId("panel", name), panel.corners() + (PATCH - WITHIN) // 2
    means = []
    for x, y in corners.tolist():
        region = make_region(None, (x, y, x + WITHIN - 1, y + WITHIN - 1), None)
        means.append(mean_of_region(*parts, region))
    numbers = tuple(uncertain_region(mean, rows, layer, k) for k, mean in enumerate(means))
    return PatchMeans(layer, corners, tuple(means), numbers, np.full(len(made.nm), 10.0))


def compare_laboratories(seed, sizes, *, wrong=None):
    """Let ten laboratories measure one panel with two whites; return the agreement of all pairs of them."""
    rng = np.random.default_rng(seed)
    panel = Panel.draw(rng, 4, 8, PATCH)
    whites = sizes["white board"] * rng.standard_normal(2)
    layers = [
        measure(k, panel, sizes, rng, whites, wrong=0.05 * (k == wrong)) for k in range(len(FLEET))
    ]
    return compare_all(layers, {})


def run_laboratories(count, sizes):
    """Return shares of regions and of pairs with E_n of 1 or less, and the same per pair of kinds, over some panels."""
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
                sorted(FLEET[int(one.name[-1])] for one in (pair.first, pair.second))
            )
            kinds.setdefault(names, []).append(inside)
    by_kind = {k: float(np.concatenate(v).mean()) for k, v in sorted(kinds.items())}
    return float(np.concatenate(regions).mean()), float(np.mean(pairs)), by_kind


def run_wrong_white(count, sizes):
    """Return which share of pairs with a white that is wrong by 5 %, and of the others, is named."""
    named, others = [], []
    for seed in range(count):
        odd = seed % len(FLEET)
        for pair in compare_laboratories(1000 + seed, sizes, wrong=odd):
            has = str(odd) in (pair.first.name[-1], pair.second.name[-1])
            (named if has else others).append(bool(pair.contradictions))
    return float(np.mean(named)), float(np.mean(others))


# --- all of it ------------------------------------------------------------------------------------


def tell(path, table, values):
    """Print figures, and bring those of a file up to date."""
    for (what, aspect), value in values.items():
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
    alone = rows_of_builds(BUILDS_ALONE)
    tell(path, "budget-rows", {(name, "builds"): ratio for name, ratio in alone.items()})


def run_agreement(path):
    """Let laboratories measure panels."""
    found = {}
    for name, sizes in (("errors as above", SIZES), ("careful", CAREFUL)):
        regions, pairs, kinds = run_laboratories(PANELS, sizes)
        found[f"{name}: Eₙ ≤ 1", ""] = 100 * regions
        print(name, pairs, kinds)
    named, others = run_wrong_white(PANELS, CAREFUL)
    found["careful, a white 5 % off: its pairs named", ""] = 100 * named
    found["careful, a white 5 % off: others named", ""] = 100 * others
    tell(path, "laboratories", found)


PARTS = {
    "arrays": run_arrays,
    "rows": run_alone,
    "builds": run_builds,
    "laboratories": run_agreement,
}

if __name__ == "__main__":
    results = taken_option()
    for name in sys.argv[1:] or PARTS:
        PARTS[name](results)

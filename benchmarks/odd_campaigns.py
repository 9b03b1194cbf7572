"""Make small campaigns of odd frames at random, and look at, examine and build them: all must end in a
value or a refusal.

    python benchmarks/odd_campaigns.py [SECONDS] [SEED]

Kinds of cameras, sizes from one pixel on, types, exposures, shots and keys are drawn; darks and whites may
be missing, several, one line, of another size, saturated, black or with a NaN. A second camera, registered
to the first, every fourth time. Prints runs, refusals by code, and every exception that was no refusal
with the seed that makes it again (`odd_campaigns.py 0 SEED` runs that one alone).
"""

import logging
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import tifffile

from levkas.building import build, summarise
from levkas.campaign.guess import look
from levkas.core.problems import Refused
from levkas.pages.emva1288 import render_page
from levkas.quality.emva1288 import examine_with_seed

KINDS = ("mosaic", "bands", "cube", "cube", "mirror", "image", "sensors")
SIZES = (*[(64, 60)] * 4, (33, 47), (16, 16), (8, 8), (128, 7), (1, 40), (40, 1), (2, 3), (1, 1))
TYPES = ("uint16", "uint16", "uint16", "uint8", "int16", "float32", "float64")
TEMPLATES = (*["sound"] * 6, "none", "several", "of another size", "with a NaN", "of one line")
WHITES = (*TEMPLATES, "saturated", "black")
ENVI_TYPES = {"uint8": 1, "int16": 2, "float32": 4, "float64": 5, "uint16": 12}
PATTERNS = ('pattern = "RGGB"', 'pattern = [["A", "B", "C"], ["D", "E", "F"]]', "")
LEVELS = {"dark": 100, "white": 3000, "panel": 1500}
GRIDS = ("", "[grid]\nrotate = 90\n", '[grid]\nregion = "auto"\n', "[grid]\nmirror = true\n")


def write_cube(path, cube):
    """Write (lines, samples, bands) as an ENVI file."""
    lines, samples, bands = cube.shape
    path.with_suffix(".raw").write_bytes(np.ascontiguousarray(cube.transpose(0, 2, 1)).tobytes())
    path.write_text(
        f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\ninterleave = bil\n"
        f"data type = {ENVI_TYPES[cube.dtype.name]}\nbyte order = 0\n"
        f"wavelength = {{{', '.join(str(400 + 40 * b) for b in range(bands))}}}\n"
    )


def keys_of(draw, kind, dtype, exposures, bands):
    """Return the lines of a camera's table."""
    keys = [f'kind = "{"cube" if kind == "mirror" else kind}"']
    keys += ['scan = "mirror"'] if kind == "mirror" else []
    keys += [f"wavelengths = {[500 + 20 * b for b in range(bands)]}"] if kind == "bands" else []
    keys += [draw.choice(PATTERNS)] if kind == "mosaic" else []
    keys += (
        ['pattern = [["A", "B"], ["C", "D"]]'] if kind == "bands" and draw.random() < 0.3 else []
    )
    keys += ['denoise = "hysime"'] if kind in ("cube", "mirror") and draw.random() < 0.2 else []
    if exposures != [None]:
        keys.append(f'exposures = "{draw.choice(["one", "best", "merge"])}"')
    for key, share in ((f"bits = {8 if dtype == 'uint8' else 12}", 0.5), ("black = 60", 0.2)):
        keys += [key] if draw.random() < share else []
    return keys


def frame(rng, target, how, size, kind, bands, exposure, dtype):
    """Return the numbers of one frame."""
    height, width = (
        (1 if how == "of one line" else size[0]),
        size[1] + 2 * (how == "of another size"),
    )
    deep = (bands,) if kind in ("cube", "mirror") else ()
    light = (LEVELS[target] - 100) * (1.0 if exposure is None else exposure / 0.4)
    codes = rng.normal(100 + light, 8, (height, width, *deep))
    codes *= 0.2 + rng.random(codes.shape) if target == "panel" else 1
    codes = {"saturated": np.full_like(codes, 4095), "black": 0 * codes}.get(how, codes)
    most, scale = (255, 0.05) if dtype == "uint8" else (4095, 1)
    codes = np.clip(codes * scale, 0, most).astype(dtype)
    if codes.dtype.kind == "f" and how == "with a NaN":
        codes.flat[rng.integers(codes.size)] = np.nan
    return codes


def make(folder, seed):
    """Write a campaign that follows from a seed."""
    draw, rng = random.Random(seed), np.random.default_rng(seed)
    kind, size, dtype = draw.choice(KINDS), draw.choice(SIZES), draw.choice(TYPES)
    lines = kind in ("cube", "mirror")
    bands = draw.choice([1, 2, 3, 6]) if lines or kind == "bands" else 1
    exposures = draw.choice([[None], [None], [0.1, 0.4], [0.1]])
    shots = 1 if lines else draw.choice([1, 1, 2, 3])
    how = {"dark": draw.choice(TEMPLATES), "white": draw.choice(WHITES), "panel": "sound"}
    envi = lines and draw.random() < 0.5
    pattern = "{target}" + ("_{wavelength}nm" if kind == "bands" else "") + "_{shot}"
    pattern += ("" if exposures == [None] else "_{exposure}s") + (".hdr" if envi else ".tif")
    for target in (t for t in LEVELS if how[t] != "none"):
        count = shots if target == "panel" else 3 if how[target] == "several" else 1
        for band in range(bands if kind == "bands" else 1):
            for shot in range(count):
                for exposure in exposures:
                    codes = frame(rng, target, how[target], size, kind, bands, exposure, dtype)
                    facts = {"target": target, "wavelength": 500 + 20 * band, "shot": shot}
                    path = folder / pattern.format(**facts, exposure=exposure)
                    if envi:
                        write_cube(path, codes)
                    else:
                        planes = codes.transpose(2, 0, 1) if lines else codes
                        tifffile.imwrite(path, planes, photometric="minisblack", metadata=None)
    keys = keys_of(draw, kind, dtype, exposures, bands)
    table = f'files = "{pattern}"'
    if kind == "sensors":
        table = f'[[cameras.c.sensors]]\nname = "A"\n{table}\n' + draw.choice(
            ['pattern = "RGGB"', 'bands = ["x"]']
        )
    targets = [f'dark = "{t}"' if t == "dark" else f'{t} = {{ names = "{t}", reflectance = 0.9 }}'
               for t in ("dark", "white") if how[t] != "none"]  # fmt: skip
    second, reference, grid = "", "c", ""
    if draw.random() < 0.25:
        photo = rng.integers(0, 250, draw.choice([(120, 160), (64, 60), (9, 9)])).astype(np.uint8)
        tifffile.imwrite(folder / "photo_panel.tif", photo, photometric="minisblack")
        second = '[cameras.photo]\nkind = "image"\nfiles = "photo_{target}.tif"\n'
        reference, grid = "photo", draw.choice(GRIDS)
    (folder / "campaign.toml").write_text(
        f'[campaign]\nreference = "{reference}"\n{grid}{second}[cameras.c]\n'
        + "\n".join([*keys, table, "[targets]", *targets, 'objects = ["panel"]', ""])
    )
    return f"{kind} {size} {dtype} {how} {exposures} {shots} shots {keys}"


def attempt(folder):
    """Look at, examine and build a campaign; return the codes of what was refused."""
    codes = []

    def noting(work):
        try:
            return work()
        except Refused as refused:
            codes.extend(p.code for p in refused.problems)

    noting(lambda: look(folder).to_report())
    noting(lambda: render_page(examine_with_seed(folder)))
    report = noting(lambda: summarise(build(folder, output=folder / "database")))
    return {*codes, *(p.code for p in (report.problems if report else ()))}


def main(seconds, seed):
    """Run for some seconds, one campaign at least; return how many kinds of exceptions there were."""
    runs, built, codes, odd, started = 0, 0, Counter(), {}, time.perf_counter()
    while not runs or time.perf_counter() - started < seconds:
        with tempfile.TemporaryDirectory() as folder:
            told = make(Path(folder), seed + runs)
            try:
                found = attempt(Path(folder))
                codes.update(found)
                built += not found
            except Exception as error:
                places = [
                    f for f in traceback.extract_tb(error.__traceback__) if "levkas" in f.filename
                ]
                place = f"{Path(places[-1].filename).name}:{places[-1].lineno}"
                odd.setdefault(
                    f"{type(error).__name__} at {place}: {str(error)[:100]}", (seed + runs, told)
                )
        runs += 1
    print(
        f"{runs} campaigns in {seconds:g} s from seed {seed}, {built} without a refusal; refused:"
    )
    print("  " + ", ".join(f"{code} {count}" for code, count in codes.most_common()))
    for error, (number, told) in odd.items():
        print(f"--- {error}\n    seed {number}: {told}")
    print(f"{len(odd)} kinds of exceptions that were no refusal")
    return len(odd)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    logging.disable(logging.ERROR)
    given = [float(n) for n in sys.argv[1:]] + [120.0, 0][len(sys.argv) - 1 :]
    sys.exit(1 if main(given[0], int(given[1])) else 0)

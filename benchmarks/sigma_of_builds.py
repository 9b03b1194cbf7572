"""Bias and spread of (R − truth)/sigma over whole builds of simulated cameras: python benchmarks/sigma_of_builds.py [KIND …]

A goal of 0.3 % and of 0.95–1.05 in every band and decade of reflectance. Each campaign has a black level, a dark
current, exposures that differ from band to band, PRNU, and frames of 16 bits of a 12-bit camera; in some the black
level is 0 or next to it, so that darks are clipped.
"""

import json
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import tifffile

from levkas.building.run import build
from levkas.calibration.patterns import channel_table
from levkas.core.cube import Flag
from levkas.database.spectral_tiff import read_tiff_pages
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine
from levkas.stages.shared_noise import Mosaic, shared_noise

GAIN, READ, BLACK, PRNU, CURRENT = 0.25, 2.0, 64.0, 0.012, 40.0
"""Counts an electron; counts; counts; share; electrons a second."""
OFFSETS = 0.5
"""Counts, spread of the black level from sensel to sensel."""
TIMES = (0.02, 0.1, 0.5, 2.0)
"""Seconds, a band each."""
LIGHT = 14_000.0
"""Electrons of a perfect diffuser where it is brightest."""
DECADES = (0.0, 0.004, 0.01, 0.05, 0.1, 0.3, 1.1)
WAVELENGTHS = (450, 550, 650, 750)
TILE = 20

HEAD = """
[campaign]
reference = "cam"
[database]
native = true
[targets]
dark = "dark"
white = { names = "white", reflectance = 1.0 }
objects = ["panel"]
[cameras.cam]
"""
BANDS = 'kind = "bands"\nfiles = "raw/{target}_{wavelength}nm_{exposure}ms_{shot}.tif"\n'
BANDS += f"wavelengths = {list(WAVELENGTHS)}\n"
FRAMES = 'files = "raw/{target}_{exposure}ms_{shot}.tif"\n'
KEYS = {
    "bands": BANDS,
    "mosaic": 'kind = "mosaic"\npattern = "RGGB"\n' + FRAMES,
    "sensors": 'kind = "sensors"\n[[cameras.cam.sensors]]\nname = "a"\nbands = ["a"]\n' + FRAMES,
    "cube": 'kind = "cube"\nfiles = "raw/{target}.hdr"\n',
    "mirror": 'kind = "cube"\nscan = "mirror"\nfiles = "raw/{target}.hdr"\n',
    "image": 'kind = "image"\nfiles = "raw/{target}_{shot}.tif"\n',
}


class Camera:
    """A sensor whose frames hold `16 · step`-fold codes; `read` in counts of 12 bits."""

    def __init__(self, shape, *, read=READ, step=1, bits=12, black=BLACK, gain=GAIN, seed=1):
        self.rng, self.shape, self.read, self.step = np.random.default_rng(seed), shape, read, step
        self.gain, self.top = gain, 2**bits - 1
        fixed = np.random.default_rng(99).standard_normal((2, *shape))
        self.response, self.black = 1 + PRNU * fixed[0], black + OFFSETS * fixed[1]

    def frame(self, reflectance, seconds, light=LIGHT, lamp=1.0):
        """Return codes of one shot; `lamp` is its light over the mean."""
        electrons = light * lamp * reflectance * self.response
        dark = self.rng.poisson(CURRENT * seconds, self.shape)
        counts = self.gain * (self.rng.poisson(electrons) + dark)
        raw = np.rint(counts + self.rng.normal(self.black, self.read, self.shape))
        return (raw.clip(0, self.top) * self.step).astype(np.uint16 if self.top > 255 else np.uint8)


def scene(shape):
    """Tiles of reflectances from 0.002 to 1, and where these are uniform: registration needs edges."""
    down, across = (n // TILE for n in shape)
    tones = np.geomspace(0.002, 1.0, down * across)
    tones = np.random.default_rng(7).permutation(tones).reshape(down, across)
    inner = np.zeros((TILE, TILE), bool)
    inner[4:-4, 4:-4] = True
    return np.kron(tones, np.ones((TILE, TILE))), np.kron(np.ones_like(tones), inner) > 0


def targets(truth, shots, whites, darks):
    """Yield each target's name, reflectance, light and number of shots."""
    yield "dark", 0 * truth, darks
    yield "white", 0 * truth + 1, whites
    yield "panel", truth, shots


def steady(name, shot, band=0):
    """Return the light of a shot of a target in a band, over the mean."""
    return 1.0


def write_campaign(
    folder, kind, camera, truth, *, shots=1, whites=4, darks=8, times=TIMES, lamp=steady
):
    """Write a campaign of one camera and one panel under a lamp."""
    raw = folder / "raw"
    raw.mkdir(parents=True)
    for name, reflectance, count in targets(truth, shots, whites, darks):
        if kind in ("cube", "mirror"):
            lines = np.arange(camera.shape[0])
            level = [np.array([lamp(name, y, b) for y in lines])[:, None] for b in range(4)]
            cube = [camera.frame(reflectance, times[0], lamp=one) for one in level]
            whole = name == "panel" or kind == "mirror"
            write_envi(raw / name, np.stack(cube, -1)[: None if whole else 100])
            continue
        for i in range(count):
            if kind == "bands":
                for b, (wavelength, time) in enumerate(zip(WAVELENGTHS, times, strict=True)):
                    path = raw / f"{name}_{wavelength}nm_{1000 * time:g}ms_{i}.tif"
                    level = lamp(name, i, b)
                    tifffile.imwrite(path, camera.frame(reflectance, time, lamp=level))
            elif kind == "image":
                if name == "panel":
                    level = lamp(name, i)
                    frame = camera.frame(reflectance, times[0], lamp=level)
                    tifffile.imwrite(raw / f"{name}_{i}.tif", frame)
            else:
                path = raw / f"{name}_{1000 * times[1]:g}ms_{i}.tif"
                tifffile.imwrite(path, camera.frame(reflectance, times[1], lamp=lamp(name, i)))
    bits = 8 if camera.top == 255 else 16 if camera.step > 1 else 12
    full = f"bits = {bits}\nsaturation = {camera.top * camera.step}\n"
    (folder / "campaign.toml").write_text(HEAD + full + KEYS[kind])
    return folder


def write_envi(base, cube, wavelengths=WAVELENGTHS):
    """Write (lines, samples, bands) as ENVI, line by line."""
    lines, samples, bands = cube.shape
    base.with_suffix(".raw").write_bytes(np.ascontiguousarray(cube.transpose(0, 2, 1)).tobytes())
    base.with_suffix(".hdr").write_text(
        f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\ninterleave = bil\n"
        f"data type = {12 if cube.dtype == np.uint16 else 1}\nbyte order = 0\n"
        f"wavelength = {{{', '.join(map(str, wavelengths))}}}\n"
    )


def built(folder, native=True):
    """Build; return values, sigma and flags of the one layer as calibrated, or on the grid."""
    for step in build(folder):
        del step
    where = folder / "database" / "objects" / "panel"
    base = next((where / "native" if native else where).glob("*.sigma.tif"))
    stem = base.name[: -len(".sigma.tif")]
    parts = (base.with_name(f"{stem}{kind}.tif") for kind in ("", ".sigma", ".flags"))
    values, sigma, flags = (read_tiff_pages(part) for part in parts)
    return [np.atleast_3d(values), np.atleast_3d(sigma), np.atleast_3d(flags)]


def spreads(values, sigma, flags, truth, tones, mask):
    """Return (band, decade, spread, share within 1.96, pixels) rows."""
    rows = []
    for band in range(values.shape[2]):
        good = (flags[..., band] & ~np.uint8(Flag.BLACK) == 0) & mask[..., band]
        miss = (values[..., band] - truth) / sigma[..., band]
        for low, high in pairwise(DECADES):
            part = miss[good & (tones >= low) & (tones < high)]
            if len(part) > 300:
                off = (values[..., band] / truth - 1)[good & (tones >= low) & (tones < high)]
                rows.append((band, f"{low:g}–{high:g}", float(part.std()),
                             float(np.mean(np.abs(part) < 1.96)), len(part), float(off.mean()),
                             float(off.std() / np.sqrt(len(off)))))  # fmt: skip
    return rows


SHAPE = (240, 320)
CASES = {
    "bands": ("bands", {}, {}),
    "bands, 2 shots": ("bands", {}, {"shots": 2}),
    "bands, one of each": ("bands", {}, {"whites": 1, "darks": 1}),
    "bands, 16-fold codes": ("bands", {"step": 16}, {}),
    "bands, coarse codes": ("bands", {"read": 0.2, "gain": 0.02}, {"shots": 3}),
    "bands, black 0": ("bands", {"black": 0}, {}),
    "bands, black 0, 4 shots": ("bands", {"black": 0}, {"shots": 4}),
    "bands, black 0, one of each": ("bands", {"black": 0}, {"whites": 1, "darks": 1}),
    "bands, black 3, read noise 2.5": ("bands", {"black": 3, "read": 2.5}, {}),
    "bands, black 0, 16-fold codes": ("bands", {"black": 0, "step": 16}, {}),
    "mosaic": ("mosaic", {}, {}),
    "mosaic, black 0": ("mosaic", {"black": 0}, {}),
    "mosaic, 16-fold codes": ("mosaic", {"step": 16}, {}),
    "sensors": ("sensors", {}, {}),
    "sensors, black 0": ("sensors", {"black": 0}, {"shots": 2}),
    "cube": ("cube", {}, {}),
    "cube, black 0": ("cube", {"black": 0}, {}),
    "mirror": ("mirror", {}, {}),
    "mirror, black 0": ("mirror", {"black": 0}, {}),
    "cube, 16-fold codes": ("cube", {"step": 16}, {}),
    "image, 4 shots": ("image", {}, {"shots": 4}),
}


NINE = [["a", "b", "c"], ["d", "e", "f"], ["g", "h", "i"]]
MOSAICS = {
    "Malvar": ([["R", "G"], ["G", "B"]], "malvar"),
    "bilinear": ([["R", "G"], ["G", "B"]], "bilinear"),
    "nine bands": (NINE, "normalised"),
}


def painted(kind, shape, channels):
    """Return reflectances, (h, w, channels): waves of 250 px, or discs and brush marks blurred by half a pixel."""
    y, x = np.indices(shape)
    if kind == "smooth":
        waves = [np.sin(x / 40 + k) * np.cos(y / 50 - k) for k in range(channels)]
        return np.stack([0.4 + 0.3 * wave for wave in waves], -1)
    rng, side = np.random.default_rng(3), [4 * n for n in shape]
    mixing = rng.uniform(0, 1, (3, channels))
    big = np.full((*side, 3), 0.4, np.float32)
    for _ in range(shape[0] * shape[1] // 350):
        place = rng.integers(0, side[::-1]).tolist()
        colour = rng.uniform(0.02, 0.9, 3).tolist()
        cv2.circle(big, place, int(rng.integers(8, 160)), colour, -1, cv2.LINE_AA)
    marks = cv2.GaussianBlur(rng.standard_normal(side).astype(np.float32), (0, 0), 3)
    big = cv2.GaussianBlur(big * (1 + 0.12 * marks[..., None] / marks.std()), (0, 0), 2)
    seen = cv2.resize(big, shape[::-1], interpolation=cv2.INTER_AREA).astype(float)
    return seen @ (mixing / mixing.sum(0))


def run_mosaic(name, kind, shape=(480, 640)):
    """Build a mosaic of a painted scene; return what is measured and what is interpolated over sigma.

    The third is that of all values moved by half a pixel, the last how much larger than the error sigma is
    in the median of the interpolated.
    """
    rows, method = MOSAICS[name]
    table = channel_table(rows)
    truth = painted(kind, shape, int(table.max()) + 1)
    y, x = np.indices(shape)
    which = table[y % len(table), x % len(table)][..., None]
    camera = Camera(shape)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c"
        write_campaign(path, "mosaic", camera, np.take_along_axis(truth, which, 2)[..., 0])
        keys = (path / "campaign.toml").read_text().replace('"RGGB"', json.dumps(rows))
        (path / "campaign.toml").write_text(keys + f'demosaic = "{method}"\n')
        values, sigma, flags = built(path)
    inner = np.zeros(values.shape, bool)
    inner[6:-6, 6:-6] = True
    inner &= flags == 0
    own = np.zeros(values.shape, bool)
    np.put_along_axis(own, which, True, 2)
    miss = (values - truth) / sigma
    half = Affine(np.array([[1.0, 0, 0.5], [0, 1.0, 0.5]]))
    names = list(dict.fromkeys(c for row in rows for c in row))
    shared = shared_noise(Mosaic(rows, method, names), [half] * len(names), shape)
    moved = warp(values, half, shape, flags=flags, variance=sigma**2 * shared)
    exact = warp(truth.astype(np.float32), half, shape)
    shifted = ((moved.values - exact.values) / np.sqrt(moved.variance))[8:-8, 8:-8]
    shifted = shifted[moved.flags[8:-8, 8:-8] == 0]
    apart = inner & ~own
    over = np.median(sigma[apart]) / (np.median(np.abs(values - truth)[apart]) / 0.6745)
    return (
        float(miss[inner & own].std()),
        float(miss[apart].std()),
        float(shifted.std()),
        float(over),
    )


def run_hysime(shape=(160, 200), bands=60):
    """Build a line scan of mixtures of five spectra, denoised; return spreads least and most of its bands.

    The third is that over the sigma that the values had before.
    """
    at = np.linspace(0, 1, bands)
    pure = [np.exp(-(((at - c) / 0.15) ** 2)) + 0.1 for c in np.linspace(0, 1, 5)]
    truth = np.random.default_rng(5).dirichlet(np.full(5, 0.5), shape) @ np.array(pure) * 0.8
    cameras = [Camera((1, shape[1]), seed=band) for band in range(bands)]
    for camera in cameras:
        camera.shape = shape
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c"
        write_campaign(path, "cube", Camera(shape), truth[..., 0])
        for name, scale, lines in (("dark", 0, 100), ("white", 1, 100), ("panel", None, shape[0])):
            seen = truth if scale is None else np.full(truth.shape, float(scale))
            cube = [c.frame(seen[..., b], 0.02)[:lines] for b, c in enumerate(cameras)]
            write_envi(path / "raw" / name, np.stack(cube, -1), range(400, 400 + 10 * bands, 10))
        before = built(path)[1]
        text = (path / "campaign.toml").read_text()
        (path / "campaign.toml").write_text(text + 'denoise = "hysime"\n')
        values, sigma, flags = built(path)
    miss = np.where(flags == 0, values - truth, np.nan)
    spread = np.nanstd(miss / sigma, (0, 1))
    return float(spread.min()), float(spread.max()), float(np.nanstd(miss / before))


def run(name, shape=SHAPE):
    """Build one case; return its rows."""
    kind, sensor, more = CASES[name]
    camera, (tones, inside) = Camera(shape, **sensor), scene(shape)
    if kind in ("cube", "mirror"):  # one line of sensels
        camera.response, camera.black = camera.response[:1], camera.black[:1]
    with tempfile.TemporaryDirectory() as folder:
        made = built(write_campaign(Path(folder) / "c", kind, camera, tones, **more))
    inside, truth = np.repeat(inside[..., None], made[0].shape[2], 2), tones
    if kind == "image":  # counts, the black and the dark current with them
        electrons = (LIGHT * tones + CURRENT * TIMES[0]) * camera.response
        truth = (camera.gain * electrons + camera.black) * camera.step
    if kind == "mosaic":  # what was measured
        measured = np.zeros(made[0].shape, bool)
        for (y, x), band in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
            measured[y::2, x::2, band] = True
        inside &= measured
    return spreads(*made, truth, tones, inside)


def main(names):
    """Print a row for every case, with the decades that are farthest off."""
    print("| case | band: spread by decade of reflectance | within 1.96 σ | bias, % (± of it) |")
    print("|---|---|---|---|")
    for name in names or CASES:
        rows = run(name)
        for band in sorted({row[0] for row in rows}):
            own = [row for row in rows if row[0] == band]
            levels = ", ".join(f"{row[2]:.3f}" for row in own)
            shares = (
                f"{100 * min(row[3] for row in own):.1f}–{100 * max(row[3] for row in own):.1f} %"
            )
            off = ", ".join(f"{100 * row[5]:+.2f} ({100 * row[6]:.2f})" for row in own)
            print(f"| {name} | {band}: {levels} | {shares} | {off} |", flush=True)
    if names:
        return
    least, most, before = run_hysime()
    print(
        f"| cube of 60 bands, HySime | {least:.3f}–{most:.3f} | over the sigma before {before:.3f} |"
    )
    print(
        "\n| mosaic | scene | measured | interpolated | moved by half a pixel | sigma over error, median |"
    )
    print("|---|---|---|---|---|---|")
    for name in MOSAICS:
        for kind in ("smooth", "detailed"):
            ratios = " | ".join(f"{number:.2f}" for number in run_mosaic(name, kind))
            print(f"| {name} | {kind} | {ratios} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

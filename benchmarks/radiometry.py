"""What radiometry must come out as, with what was seen: python benchmarks/radiometry.py [SHARED [DATABASE]]

SHARED is the folder that holds `data` (real captures) and `campaigns`; without it their rows are left out.
DATABASE is what `levkas build examples/two-paintings` made, for the rows of the published grid.
"""

import json
import re
import sys
from pathlib import Path

import numpy as np
import tifffile
from scipy.ndimage import uniform_filter

from levkas.calibration.exposures import merge_exposures
from levkas.calibration.flatfield import flat_field
from levkas.calibration.linearity import check_linearity
from levkas.calibration.mosaic import demosaic
from levkas.calibration.noise_fit import NoiseModel, fit_noise
from levkas.calibration.noise_model import Sensor, sample_values, snr_db
from levkas.calibration.templates import average
from levkas.calibration.whites import WhiteBoard
from levkas.core.cube import Flag
from levkas.database.spectral_tiff import read_tiff_pages
from levkas.geometry import from_dict
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine
from levkas.quality.image_quality.glare import mark_glare
from levkas.quality.targets.patches import find_preblur

GAIN, READ, BLACK, FULL, PRNU = 0.1, 2.0, 64.0, 4095, 0.019


def row(what, goal, seen):
    print(f"| {what} | {goal} | {seen} |", flush=True)


def shots(electrons, count, rng):
    """Raw frames of a sensor of which everything is known; the PRNU is the same in each."""
    response = 1 + PRNU * np.random.default_rng(99).standard_normal(np.shape(electrons))
    for _ in range(count):
        light = rng.poisson(electrons * response) * GAIN
        raw = np.rint(light + rng.normal(BLACK, READ, np.shape(electrons)))
        yield np.clip(raw, 0, FULL).astype(np.uint16)


def closed_form():
    """SNR of 307,200 samples against the closed form, the paper's sensor, dark subtracted or not."""
    rng, sensor, worst = np.random.default_rng(4), Sensor(), 0.0
    for exposure in np.geomspace(10, 45_000, 12):
        values = sample_values(exposure, sensor, 640 * 480, rng)
        for subtracted in (True, False):
            mean = values.mean() - (sensor.dark if subtracted else 0)
            told = snr_db(exposure, sensor, subtract_dark=subtracted)
            worst = max(worst, abs(float(10 * np.log10(mean / values.std()) - told)))
    row("SNR, closed form against simulation", "0.05 dB", f"{worst:.3f} dB")


def honesty():
    """Spread of (R − truth)/sigma, as calibrated and after a shift by half a pixel."""
    rng, (y, x) = np.random.default_rng(1), np.indices((600, 800))
    shade = 1 - 0.4 * ((y / 600 - 0.5) ** 2 + (x / 800 - 0.5) ** 2)

    def truth(dx, dy):
        return 0.45 + 0.4 * np.sin((x + dx) / 40) * np.cos((y + dy) / 50)

    dark, white, panel = (
        average(shots(30_000 * shade * r, n, rng))
        for r, n in ((0 * shade, 8), (1 + 0 * shade, 6), (truth(0, 0), 3))
    )
    made = flat_field(panel, dark, white, noise=fit_noise([dark, white, panel], dark))
    half = Affine(np.array([[1.0, 0, 0.5], [0, 1.0, 0.5]]))
    moved = warp(made.values, half, made.values.shape, variance=made.variance)
    inside = np.s_[4:-4, 4:-4]
    for name, found, exact in (
        ("as calibrated", made, truth(0, 0)),
        ("after resampling", moved, truth(0.5, 0.5)),
    ):
        z = ((found.values - exact) / np.sqrt(found.variance))[inside]
        seen = f"{z.std():.3f}; {100 * np.mean(np.abs(z) < 1.96):.1f} %"
        row(f"(R − truth)/sigma, {name}", "spread 0.95–1.05; 94–96 % within ± 1.96", seen)


def merging():
    """Variance of a merge of four exposures over the Cramér–Rao bound, and its bias."""
    rng, times = np.random.default_rng(3), (0.1, 0.4, 1.6, 6.4)
    rates = np.geomspace(20, 200_000, 200) * np.ones((3000, 1))
    noise = NoiseModel(GAIN, READ**2 + 1 / 12)
    series = [average(shots(rates * t, 1, rng), saturation=FULL, exposure_s=t) for t in times]
    dark = [average(shots(0 * rates, 40, rng), exposure_s=t) for t in times]
    merged = merge_exposures(series, dark, saturation=FULL, noise=noise).template
    response = 1 + PRNU * np.random.default_rng(99).standard_normal(rates.shape)
    truth, level = GAIN * rates * response, GAIN * rates[0]
    clear = [level * t * 1.1 + BLACK < 0.98 * FULL for t in times]
    apart = [level * t * 0.9 + BLACK > 0.98 * FULL for t in times]
    sharp = np.all([c | a for c, a in zip(clear, apart, strict=True)], axis=0) & clear[0]
    bound = 1 / sum(c * t**2 / noise.variance(level * t) for c, t in zip(clear, times, strict=True))
    # Of the bias only what stands out of its own noise: columns of 100 counts a second and more.
    over = float(((merged.mean - truth).var(0) / bound)[sharp].mean())
    bright = sharp & (level > 100)
    bias = float(np.abs(merged.mean.mean(0) / truth.mean(0) - 1)[bright].max())
    row("HDR merge over the Cramér–Rao bound", "1.02", f"{over:.3f}")
    row("HDR merge, bias", "0.3 %", f"{100 * bias:.2f} %")


def preblur():
    """A 3x3 box in white noise, and alarms in a thousand sets of white noise."""
    rng = np.random.default_rng(2)
    factor = find_preblur(uniform_filter(rng.standard_normal((1000, 1000)), 3)).factor
    alarms = sum(find_preblur(list(rng.standard_normal((4, 25, 25)))).found for _ in range(1000))
    row(
        "blur of a 3x3 box: its share of the noise found",
        "1 %",
        f"{100 * abs(factor / 3 - 1):.2f} %",
    )
    row("alarms in 1,000 sets of white noise", "0", f"{alarms}")


def filter_wheel(folder):
    """Deviation from linearity of the real filter wheel, black fitted, and what merging leaves."""
    told = []
    for band in range(400, 701, 50):
        series = [
            average(
                [tifffile.imread(f)],
                saturation=255,
                exposure_s=int(re.search(r"_(\d+)ms", f.name)[1]) / 1000,
            )
            for f in sorted(folder.glob(f"frames/*_{band}nm_*.tif"))
        ]
        told.append(check_linearity(series, saturation=255, fit_offset=True).rms)
    seen = f"{100 * min(told):.2f} to {100 * max(told):.2f} %"
    row("filter wheel, seven bands: linearity, black fitted", "1.3 % rms", seen)


def board(folder):
    """One white of two-paintings against the other two: the board reflects 0.98."""
    dark = average([tifffile.imread(f) for f in sorted((folder / "dark").iterdir())])
    whites = [tifffile.imread(f) for f in sorted((folder / "white").iterdir())]
    one, rest = average(whites[:1]), average(whites[1:])
    noise = fit_noise([dark, rest], dark)
    made = flat_field(one, dark, rest, board=WhiteBoard(0.98), noise=noise)
    z = (made.values - 0.98) / np.sqrt(made.variance)
    seen = f"{made.values.mean():.4f}; {z.std():.3f}"
    row(
        "two-paintings, colour camera: a white against others, mean and spread over sigma",
        "0.98; 1",
        seen,
    )


def reflectance(folder, dark, name):
    """Calibrated colour frames of one painting, native px, glare marked; and the saturated sensels."""
    frames = [tifffile.imread(f) for f in sorted((folder / name).iterdir())]
    whites = [tifffile.imread(f) for f in sorted((folder / "white").iterdir())]
    shot, white = average(frames, saturation=FULL), average(whites, saturation=FULL)
    noise = fit_noise([dark, white, shot], dark)
    flat = flat_field(shot, dark, white, board=WhiteBoard(0.98), noise=noise)
    values, flags, variance = demosaic(flat.values, flat.flags, flat.variance, "RGGB")
    mark_glare(values, flags, np.sqrt(variance))
    return values, flags, np.max(frames, axis=0) >= FULL


def told(what, found, flagged, full, lifted):
    """Rows of what is flagged among saturated pixels, all others, and those that show paint."""
    row(
        f"{what}: saturated, flagged", "99 %", f"{100 * flagged[full].mean():.2f} % of {full.sum()}"
    )
    paint = found & ~full & (lifted < 0.1)
    seen = f"{100 * flagged[paint].mean():.3f} % of {paint.sum()}"
    row(f"{what}: paint as under the default lighting, flagged", "1 %", seen)
    rest = found & ~full & flagged
    seen = f"{100 * rest.sum() / (found & ~full).sum():.1f} %; 99 % of them by {np.quantile(lifted[rest], 0.01):.2f}"
    row(f"{what}: all that is not saturated, flagged; brighter than by default", "", seen)


def glare(folder):
    """Glare of the 45-degree lighting against what the same sensels see under the default one."""
    dark = average([tifffile.imread(f) for f in sorted((folder / "d80/dark").iterdir())])
    for name in ("icon1", "icon2"):
        plain, _, _ = reflectance(folder / "d80", dark, name)
        values, flags, full = reflectance(folder / "45-degree/d80", dark, name)
        flagged = (flags & Flag.GLARE).any(-1)
        # By the sensel's own channel, for what demosaicing gives is none that was seen.
        own = np.tile([[0, 1], [1, 2]], (full.shape[0] // 2, full.shape[1] // 2))
        lifted = np.take_along_axis(values - plain, own[..., None], 2)[..., 0]
        told(f"two-paintings, {name}, native", np.ones(full.shape, bool), flagged, full, lifted)


def glare_on_grid(folder, database):
    """The same on the published grid, a pixel of which stands for the native one that it lies on."""
    for name in ("icon1", "icon2"):
        base = database / "objects" / name
        plain, values = (read_tiff_pages(base / f"{name}_d80{s}.tif") for s in ("", "_45-degree"))
        flags = read_tiff_pages(base / f"{name}_d80_45-degree.flags.tif")
        record = json.loads((base / "registration/d80@45-degree.json").read_text("utf-8"))
        frames = sorted((folder / "45-degree/d80" / name).iterdir())
        full = np.max([tifffile.imread(f) for f in frames], axis=0) >= FULL
        y, x = np.indices(values.shape[:2])
        places = np.stack([x.ravel(), y.ravel()], 1).astype(float)
        u, v = np.rint(from_dict(record["bands"]["G"]["transform"])(places)).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < full.shape[1]) & (v < full.shape[0])
        here = np.zeros(inside.shape, bool)
        here[inside] = full[v[inside], u[inside]]
        found = ~(flags & Flag.OUTSIDE).any(-1)
        here = here.reshape(found.shape) & found
        lifted = np.where(found, (values - plain).min(-1), 0)
        told(f"two-paintings, {name}, grid", found, (flags & Flag.GLARE).any(-1), here, lifted)


def main():
    print("| | asked | seen |\n|---|---|---|")
    closed_form()
    honesty()
    merging()
    preblur()
    if len(sys.argv) > 1:
        shared = Path(sys.argv[1])
        filter_wheel(shared / "data/filterwheel-disks")
        board(shared / "campaigns/two-paintings/raw/d80")
        glare(shared / "campaigns/two-paintings/raw")
    if len(sys.argv) > 2:
        glare_on_grid(shared / "campaigns/two-paintings/raw", Path(sys.argv[2]))


if __name__ == "__main__":
    main()

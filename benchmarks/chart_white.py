"""Reflectance by a chart in place of a white, on simulated filter cameras with a planted light.

python benchmarks/chart_white.py [DRAWS]

Prints a Markdown table: errors on the chart and beyond it, with the fitted light field and with even light, the share
of pixels within 1.96 sigma, and the held-out error that the record gives.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import tifffile

from levkas.building.calibrate import develop
from levkas.building.hashes import HASHES, Hashes
from levkas.building.template_cache import TemplateCache
from levkas.calibration.chart_light import CHART_WHITE as KEY
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.quality.targets.charts import CHARTS, reference_of

CLASSIC = CHARTS["ColorChecker24"]
NM = np.array([480, 600])
HEIGHT, WIDTH = 250, 350
Y, X = np.mgrid[:HEIGHT, :WIDTH]
U, V = (X - WIDTH / 2) / (WIDTH / 2), (Y - HEIGHT / 2) / (HEIGHT / 2)
LIGHTS = {
    "even": np.ones((HEIGHT, WIDTH)),
    "gradient": 1 + 0.25 * U - 0.15 * V,
    "lamp and lens": (1 + 0.2 * U - 0.1 * V) * np.exp(-(U**2 + V**2) / 4),
}
CHARTS_AT = {"a third of the frame": (40, 50, 40), "an eighth": (60, 150, 24)}
KEYS = """
[campaign]
reference = "vis:600 nm"
[cameras.vis]
kind = "bands"
files = "raw/{{target}}/{{wavelength}}nm_{{shot}}.tif"
bits = 12
white = {{ chart = "macbeth", corners = {corners} }}
[targets]
dark = "dark"
charts = {{ macbeth = "ColorChecker24" }}
objects = ["panel"]
"""


def write(folder, light, scatter, place, rng):
    """Write a campaign: gain 0.2 counts per electron, PRNU 0.5 %, two shots; return the panel's reflectance."""
    y, x, pitch = place
    spectra = reference_of(CLASSIC).at(NM.astype(float))
    spectra = spectra * (1 + scatter * rng.standard_normal(spectra.shape))
    chart = np.full((HEIGHT, WIDTH, len(NM)), 0.15)
    for spectrum, (c, r) in zip(spectra, CLASSIC.centres.astype(int), strict=True):
        chart[y + pitch * r : y + pitch * (r + 1), x + pitch * c : x + pitch * (c + 1)] = spectrum
    panel = np.kron(rng.uniform(0.03, 0.9, (25, 35, len(NM))), np.ones((10, 10, 1)))
    fixed = 1 + 0.005 * rng.standard_normal((HEIGHT, WIDTH))
    for name, scene in (("dark", 0 * panel), ("macbeth", chart), ("panel", panel)):
        (folder / "raw" / name).mkdir(parents=True)
        for i, nm in enumerate(NM):
            for shot in range(2):
                level = 3000 * light * fixed * scene[..., i]
                noisy = 60 + level + np.sqrt(4 + 0.2 * level) * rng.standard_normal(level.shape)
                frame = np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)
                tifffile.imwrite(folder / "raw" / name / f"{nm}nm_{shot}.tif", frame)
    a, b = x + pitch / 2 - 0.5, y + pitch / 2 - 0.5
    right, bottom = a + 5 * pitch, b + 3 * pitch
    corners = [[a, b], [right, b], [right, bottom], [a, bottom]]
    (folder / "campaign.toml").write_text(KEYS.format(corners=corners))
    return panel


def measure(light, scatter, place, seed):
    """Return errors on the chart and beyond, with the field and even, shares within sigma, held-out errors."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        panel = write(folder, light, scatter, place, np.random.default_rng(seed))
        campaign = load_campaign(folder)
        (capture,), _ = find_captures(campaign)
        (folder / "kept").mkdir()
        hashes = Hashes(folder / "kept" / HASHES)
        made = develop(capture, campaign, TemplateCache(folder / "kept", hashes, shared=False))
    cube, record = made.cubes[""], made.learnt[""][KEY]
    y, x, pitch = place
    inside = (x + pitch / 4 < X) & (x + 5.75 * pitch > X)
    inside &= (y + pitch / 4 < Y) & (y + 3.75 * pitch > Y)
    # The level that even light has: by the grey patches, weighted as their levels are.
    greys = light[int(y + 3.5 * pitch), [int(x + pitch * (k + 0.5)) for k in range(6)]]
    off, even = cube.values - panel, panel * (light / greys.mean() - 1)[..., None]
    held = np.abs(off) < 1.96 * cube.sigma
    bands = record["bands"].values()
    return [
        *(np.mean(part[where] ** 2) for part in (off, even) for where in (inside, ~inside)),
        *(np.mean(held[where]) for where in (inside, ~inside)),
        *(np.mean([b[key] ** 2 for b in bands]) for key in ("held_out", "held_out_even_light")),
    ]


def main(draws=5):
    """Print the table."""
    print("| light | patches differ by | chart | error on it | even light | error beyond | even light "
          "| within 1.96 sigma on it | beyond | held out | even light |")  # fmt: skip
    print("|---|---:|---|" + "---:|" * 8)
    for name, light in LIGHTS.items():
        for scatter in (0.0, 0.02):
            for where, place in CHARTS_AT.items():
                found = np.mean([measure(light, scatter, place, k) for k in range(draws)], 0)
                errors = [f"{np.sqrt(found[k]):.3f}" for k in (0, 2, 1, 3)]
                shares = [f"{100 * found[k]:.1f} %" for k in (4, 5)]
                held = [f"{np.sqrt(found[k]):.3f}" for k in (6, 7)]
                print(f"| {name} | {100 * scatter:g} % | {where} | {' | '.join(errors + shares + held)} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

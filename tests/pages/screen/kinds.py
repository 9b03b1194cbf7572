"""Every kind of page that Levkas writes as one file, of small made-up data."""

from pathlib import Path

import numpy as np
import tifffile

from levkas.pages.camera import CameraReport, light_row, render_camera, sensor_row
from levkas.pages.charts import ChartSection, Swatch
from levkas.pages.page import Figure
from levkas.pages.plots import Line, picture_with_areas, plot
from levkas.pages.radiometry import channel_colours, draw_light

BENCH = Path(__file__).resolve().parents[3] / "examples" / "plan" / "bench.toml"
KINDS = ("report", "camera", "plan", "radiometry")
CAMPAIGN = """
[campaign]
title = "Panels of the north wall"
reference = { camera = "cam" }
[cameras.cam]
kind = "mosaic"
pattern = "RGGB"
files = "raw/{target}_{shot}.tif"
bits = 12
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.98 }
objects = ["panel"]
"""


def write_kinds(folder):
    """Write a page of each kind: kind → path."""
    from .test_report import COLOUR, LOST, REFERENCE, XRAY, written

    folder.mkdir(parents=True, exist_ok=True)
    paths = {"report": written(folder, [REFERENCE, COLOUR, XRAY, LOST])}
    texts = {
        "camera": camera(),
        "plan": plan(),
        "radiometry": radiometry(folder / "campaign"),
    }
    for kind, text in texts.items():
        paths[kind] = folder / f"{kind}.html"
        paths[kind].write_text(text, encoding="utf-8")
    return paths


def camera():
    """The page of a camera with a light field and a chart."""
    v, u = np.mgrid[-1:1:24j, -1:1:32j]
    levels = np.exp(-0.35 * ((u - 0.2) ** 2 + v**2))
    light = {
        "size": (3200, 2400), "rectangle": (600, 400, 1800, 1500), "share": 0.35, "drop": 0.1,
        "step": (100, 100), "uniformity": 0.55, "bits": (11.2, 10.1),
    }  # fmt: skip
    sensor = {"gain": 0.16, "read_noise": 1.29, "full": 4030.0, "stops": 11.6, "source": "temporal"}
    names = ["light skin", "blue sky", "orange", "white", "neutral 5", "black"]
    grey = np.linspace(0.1, 0.95, 120)[None] * np.ones((60, 1))
    corners = np.array([[4, 8], [14, 8], [14, 26], [4, 26]], float)
    areas = corners + np.stack([18 * np.arange(len(names)), np.full(len(names), 12)], 1)[:, None]
    labels = [f"{nm} nm" for nm in range(420, 721, 20)]
    lines = [
        Line(label, [0.03, 0.09, 0.2, 0.4, 0.9], [8 + i / 3 + 7 * k for k in range(5)], colour)
        for i, (label, colour) in enumerate(zip(labels, channel_colours(labels), strict=True))
    ]
    svg = plot(lines, x="signal of the channel", y="SNR, dB (10·log10)", log="x")
    swatches = [
        Swatch(name, colour, other, difference)
        for name, colour, other, difference in zip(
            names,
            ("#c49180", "#627a9d", "#d67e2c", "#f3f3f2", "#7a7a79", "#343434"),
            ("#c29682", "#627a9c", "#d97b2f", "#f3f3f0", "#7a7a7a", "#313132"),
            ("1.9", "0.4", "2.2", "0.5", "0.3", "1.1"),
            strict=True,
        )
    ]
    chart = ChartSection(
        "panel", "ColorChecker Classic, rank correlation 0.998.", ["Mind the glare."],
        [Figure(picture_with_areas(grey, areas, names), "the sampled areas")], [Figure(svg, "SNR")],
        [["ΔE2000, mean", "1.3", "0", "4 stars", "level A"]], ("mean", "SNR"), [["white", "0.9", "90"]], swatches,
        [["550 nm", "2 borders of grey patches, x", "0.211", "0.402", "80 %", "1.00", "+0.12"]],
    )  # fmt: skip
    return render_camera(
        CameraReport(
            title="d80", subtitle="camera of Panels", sensors=[sensor_row("", sensor)],
            lights=[light_row("R", light)], figures=draw_light(light, levels, "R"), charts=[chart],
        )
    )  # fmt: skip


def plan():
    """The plan of the bench of the paper."""
    import tempfile

    from levkas.pages.plan import write_report
    from levkas.planning import load_setup

    with tempfile.TemporaryDirectory() as place:
        return write_report(Path(place) / "plan.html", load_setup(BENCH)).read_text("utf-8")


def radiometry(folder):
    """Radiometry of a camera whose gain, noise and PRNU are known."""
    from levkas.pages.emva1288 import render_examination
    from levkas.quality.emva1288 import examine_with_seed

    rng, fixed = np.random.default_rng(1), np.random.default_rng(2)
    shape = (256, 384)
    response = 1 + 0.02 * fixed.standard_normal(shape)
    scene = np.linspace(0.1, 0.9, shape[1]) * np.ones((shape[0], 1))
    (folder / "raw").mkdir(parents=True)
    for target, electrons in (("dark", 0.0), ("white", 28_000.0), ("panel", 28_000.0 * scene)):
        for shot in range(3):
            raw = np.rint(rng.poisson(electrons * response, shape) * 0.1 + rng.normal(64, 2, shape))
            name = folder / "raw" / f"{target}_{shot}.tif"
            tifffile.imwrite(name, raw.clip(0, 4095).astype(np.uint16), photometric="minisblack")
    (folder / "campaign.toml").write_text(CAMPAIGN)
    return render_examination(examine_with_seed(folder))

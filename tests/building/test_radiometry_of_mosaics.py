"""Noise that a report tells of a mosaic camera is that of its sensels, whatever detail the scene has."""

import json
import re

import numpy as np
import tifffile

from levkas.building.run import build

CAMPAIGN = """
[campaign]
reference = "cam"
[targets]
dark = "dark"
white = { names = "white", reflectance = 1.0 }
objects = ["panel"]
[cameras.cam]
kind = "mosaic"
pattern = "RGGB"
bits = 12
files = "raw/{target}_{shot}.tif"
"""
FULL, GAIN, READ, BLACK = 3200.0, 0.25, 2.0, 64.0


def test_a_detailed_scene_has_the_noise_of_its_sensels(tmp_path):
    rng = np.random.default_rng(3)
    shape = (200, 240)
    scene = rng.choice([0.3, 0.7], shape)  # from sensel to sensel: interpolation knows nothing

    def frame(light):
        counts = GAIN * rng.poisson(light * FULL / GAIN, shape) + rng.normal(BLACK, READ, shape)
        return np.rint(counts).clip(0, 4095).astype(np.uint16)

    (tmp_path / "raw").mkdir()
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    lights = {"panel_1": scene}
    lights |= {f"dark_{n}": 0 * scene for n in range(4)} | {
        f"white_{n}": 1 + 0 * scene for n in range(4)
    }
    for name, light in lights.items():
        tifffile.imwrite(tmp_path / "raw" / f"{name}.tif", frame(light))
    assert [step.line for step in build(tmp_path) if step.state in ("refused", "failed")] == []
    page = (tmp_path / "database" / "objects" / "panel" / "report.html").read_text()
    cells = re.findall(r"<td[^>]*>(.*?)</td>", page[page.index("Median SNR") :], re.DOTALL)
    noise_told, snr_told = (float(cell.split()[0]) for cell in cells[1:3])
    # One shot over the mean of four whites: u² = (v + r² v_white/4) / FULL², half of the sensels at each.
    r = np.array([0.3, 0.7])
    variance = GAIN * FULL * r + READ**2 + r**2 * (GAIN * FULL + READ**2) / 4
    noise = np.sqrt(variance) / FULL
    assert noise[0] * 0.95 < noise_told < noise[1] * 1.05
    assert (r / noise)[0] * 0.95 < snr_told < (r / noise)[1] * 1.05
    assert "more light" not in page
    camera = json.loads((tmp_path / "database" / "cameras" / "cam" / "camera.json").read_text())
    assert "sensels" not in json.dumps(camera)

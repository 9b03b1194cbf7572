"""A mosaic without darks whose file states the black of each sensel."""

import numpy as np
import pytest
import tifffile

from levkas.calibration.templates import CalibrationRefused
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

SIZE = (120, 160)
CAMPAIGN = """
[campaign]
reference = { camera = "cam" }
[cameras.cam]
kind = "mosaic"
files = "raw/{target}_{shot}.tif"
MORE
[targets]
dark = DARK
white = "white"
objects = ["panel"]
"""
LEVELS = (60, 64, 66, 110)
DELTA = np.linspace(0, 79, SIZE[0]).round().astype(int)
BLACK = np.tile([LEVELS[:2], LEVELS[2:]], (SIZE[0] // 2, SIZE[1] // 2)) + DELTA[:, None]


def truth():
    """A dark painting: an error of the black shows."""
    y, x = np.indices(SIZE)
    return 0.04 + 0.02 * np.sin(x / 17) * np.cos(y / 23)


def make(folder, *, levels=LEVELS, dark=False, more="", shots=2):
    rng = np.random.default_rng(3)
    tags = [
        (33421, 3, 2, (2, 2), True),
        (33422, 1, 4, (0, 1, 1, 2), True),
        (50713, 3, 2, (2, 2), True),
        (50714, 4, len(levels), levels, True),
        (50716, 10, SIZE[0], tuple(n for d in DELTA for n in (int(d), 1)), True),
        (50717, 4, 1, 4095, True),
    ]
    (folder / "raw").mkdir(parents=True)
    for target, light in (("dark", 0 * BLACK), ("white", 1 + 0 * BLACK), ("panel", truth())):
        for shot in range(shots if target != "dark" else 2 * dark):
            codes = np.rint(BLACK + 3000 * light + rng.normal(0, 2, SIZE)).astype(np.uint16)
            name = folder / f"raw/{target}_{shot}.tif"
            tifffile.imwrite(name, codes, photometric=32803, extratags=tags, metadata=None)
    text = CAMPAIGN.replace("MORE", more).replace("DARK", '"dark"' if dark else "[]")
    (folder / "campaign.toml").write_text(text)
    return folder


def developed(folder):
    campaign = load_campaign(folder)
    (capture,), refused = find_captures(campaign)
    assert not refused
    return develop(capture, campaign, TemplateCache(folder)).cubes[""]


def test_black_is_subtracted_by_phase_and_row_and_sigma_says_so(tmp_path):
    cube = developed(make(tmp_path / "c"))
    miss = cube.values - truth()[..., None]
    assert abs(miss.mean((0, 1))).max() < 2e-5  # a hundredth of the least that 16 counts would do
    assert abs(miss[:20].mean()) < 5e-5 and abs(miss[-20:].mean()) < 5e-5
    assert not (cube.flags & 0xFE).any()
    own = np.s_[::2, ::2, 0]  # sensels of red, not interpolated
    assert 0.9 < (miss[own] / cube.sigma[own]).std() < 1.1


def test_levels_that_are_not_understood_are_refused_and_darks_help(tmp_path):
    odd = (60, 64, 66)
    with pytest.raises(CalibrationRefused, match="black levels") as refused:
        developed(make(tmp_path / "a", levels=odd))
    (problem,) = refused.value.problems
    assert "darks" in problem.fix and problem.file.endswith("panel_0.tif")
    dark = developed(make(tmp_path / "b", levels=odd, dark=True))
    assert abs((dark.values - truth()[..., None]).mean()) < 5e-5
    flat = developed(make(tmp_path / "c", levels=odd, more="black = 75"))
    assert abs((flat.values - truth()[..., None])[:20].mean()) > 1e-3  # as it was declared

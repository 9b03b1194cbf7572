"""A stack of which one shot shows something else is refused by name, whatever the kind of camera."""

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter, shift

from levkas.calibration.templates import CalibrationRefused
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

SHAPE = (160, 200)
CAMPAIGN = """
[campaign]
reference = { camera = "cam" }
[cameras.cam]
kind = "KIND"
KEYS
[targets]
TEMPLATES
objects = ["panel"]
"""
KEYS = {
    "bands": 'files = "raw/{target}_{wavelength}nm_{shot}.tif"',
    "mosaic": 'files = "raw/{target}_{shot}.tif"\npattern = "RGGB"',
    "sensors": "\n".join(
        f'[[cameras.cam.sensors]]\nname = "{n}"\nfiles = "raw/{{target}}_{n}_{{shot}}.tif"\nbands = ["{n}"]'
        for n in "ab"
    ),
    "image": 'files = "raw/{target}_{shot}.tif"',
}
NAMES = {"bands": ("450nm_", "550nm_"), "mosaic": ("",), "sensors": ("a_", "b_"), "image": ("",)}
PERIOD = {"mosaic": 2}


def panel(seed):
    rng = np.random.default_rng(seed)
    layers = [gaussian_filter(rng.standard_normal(SHAPE), s) * s for s in (2, 4, 8, 16)]
    return 0.06 + 0.8 / (1 + np.exp(-3 * sum(layers)))


def make(folder, kind, second, count=3):
    """Write a campaign of three shots a band, the second of which is `second`, and templates."""
    rng, templates = np.random.default_rng(5), 'dark = "dark"\nwhite = "white"'
    (folder / "raw").mkdir(parents=True)
    shots = [second if k == 1 else panel(1) for k in range(count)]
    for name in NAMES[kind]:
        for target, scenes in (("dark", [0] * 2), ("white", [1] * 2), ("panel", shots)):
            if kind == "image" and target != "panel":
                continue
            for k, scene in enumerate(scenes):
                light = 2500 * np.broadcast_to(scene, SHAPE)
                codes = 60 + rng.normal(light, np.sqrt(4 + 0.3 * light))
                codes = np.clip(np.rint(codes), 0, 4095).astype(np.uint16)
                tifffile.imwrite(folder / f"raw/{target}_{name}{k}.tif", codes)
    text = CAMPAIGN.replace("KIND", kind).replace("KEYS", KEYS[kind])
    text = text.replace("TEMPLATES", "" if kind == "image" else templates)
    (folder / "campaign.toml").write_text(text)
    campaign = load_campaign(folder)
    (capture,), refused = find_captures(campaign)
    assert not refused
    return capture, campaign, TemplateCache(folder)


CHANGES = {
    "scene": (panel(2), lambda x: x < 0.5),
    "place": (shift(panel(1), (0, 8), mode="nearest"), lambda x: abs(x - 8) < 0.5),
    "light": (panel(1) * np.linspace(0.5, 1.5, SHAPE[1]), lambda x: x > 20),
    "exposure": (1.26 * panel(1), lambda x: abs(x - 1.26) < 0.1),
}


@pytest.mark.parametrize("kind", KEYS)
@pytest.mark.parametrize("what", CHANGES)
def test_a_shot_that_is_none_is_refused_by_name(kind, what, tmp_path):
    with pytest.raises(CalibrationRefused) as refused:
        develop(*make(tmp_path / "c", kind, CHANGES[what][0]))
    problems = refused.value.problems
    assert {(p.code, p.field) for p in problems} == {("E_UNLIKE_SHOTS", what)}
    assert {p.file[-6:] for p in problems} == {"_1.tif"}
    by = [float(p.found.split(" by ")[-1].split()[0]) for p in problems if " by " in p.found]
    assert all(map(CHANGES[what][1], by))


@pytest.mark.parametrize("kind", KEYS)
def test_a_lamp_that_sank_by_five_per_cent_is_one(kind, tmp_path):
    native = develop(*make(tmp_path / "c", kind, 0.95 * panel(1)))
    assert native.cubes

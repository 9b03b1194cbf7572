"""A camera that sets its gain by itself, and another one for each filter, and says so nowhere: sigma is right in each band."""

import numpy as np
import pytest
import tifffile

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

READ, BLACK, WELL = 6.0, 100.0, 12_000.0
"""Read noise and the white, electrons; black level, counts."""
SHAPE = (80, 120)
PANEL = np.kron(np.random.default_rng(2).uniform(0.05, 0.9, (5, 6)), np.ones((16, 20)))
BANDS = (450, 500, 550, 600, 650, 700)
HEAD = """
[campaign]
reference = "cam"
[targets]
dark = "dark"
white = { names = "white", reflectance = 1.0 }
objects = ["panel"]
[cameras.cam]
bits = 16
"""


def write(folder, gains, *, shots=(4, 4), flicker=0.0, full=None):
    """Write frames of a tunable filter: counts per electron by band; shots of white and panel; flicker, relative; wells by band."""
    rng, raw = np.random.default_rng(5), folder / "raw"
    raw.mkdir(parents=True)
    for wavelength, gain in zip(BANDS, gains, strict=True):
        for name, light, count in (
            ("dark", 0 * PANEL, 4),
            ("white", WELL + 0 * PANEL, shots[0]),
            ("panel", WELL * PANEL, shots[1]),
        ):
            for take in range(count):
                lamp = 1 + flicker * rng.standard_normal()
                electrons = np.minimum(
                    rng.poisson(light * lamp), (full or {}).get(wavelength, np.inf)
                )
                electrons = electrons + rng.normal(0, READ, SHAPE)
                codes = np.rint(BLACK + gain * electrons).clip(0, 65535).astype(np.uint16)
                tifffile.imwrite(raw / f"{name}_{wavelength}nm_{take}.tif", codes)
    (folder / "campaign.toml").write_text(
        f'{HEAD}kind = "bands"\nfiles = "raw/{{target}}_{{wavelength}}nm_{{shot}}.tif"\n'
        f"wavelengths = {[*BANDS]}\n"
    )
    return folder


def developed(folder):
    campaign = load_campaign(folder)
    captures, _ = find_captures(campaign)
    return develop(captures[0], campaign, TemplateCache(folder / "kept"))


def errors_over_sigma(made):
    """Rms of (value - truth)/sigma, band by band."""
    cube = made.cubes[""]
    apart = (cube.values - PANEL[..., None]) / cube.sigma
    return np.sqrt(np.mean(apart**2, axis=(0, 1)))


@pytest.mark.parametrize(
    "gains",
    [
        (1.0, 1.0, 1.0, 4.0, 1.0, 1.0),  # one of the bands that the model is fitted to
        (4.0, 1.0, 1.0, 1.0, 1.0, 1.0),
        (2.0, 1.0, 1.0, 1.0, 1.0, 0.3),
        (1.0, 0.5, 2.0, 1.0, 4.0, 3.0),
    ],
    ids=str,
)
@pytest.mark.parametrize("shots", [(4, 4), (4, 1), (2, 2)], ids=str)
def test_sigma_is_right_in_each_band_whatever_its_gain(tmp_path, gains, shots):
    made = developed(write(tmp_path, gains, shots=shots))
    # A panel of 9,600 px: 0.7 % by chance.
    assert errors_over_sigma(made) == pytest.approx(np.ones(len(BANDS)), abs=0.08)
    (note,) = [w for w in made.warnings if "differs from band to band" in w]
    assert "gain" in note and "cam" in note


@pytest.mark.parametrize("shots", [(4, 4), (4, 1), (2, 2)], ids=str)
def test_one_gain_is_one_noise(tmp_path, shots):
    made = developed(write(tmp_path, [1.5] * len(BANDS), shots=shots))
    assert errors_over_sigma(made) == pytest.approx(np.ones(len(BANDS)), abs=0.05)
    assert "unlike_noise" not in made.measured[""]
    assert not [w for w in made.warnings if "differs from band to band" in w]


@pytest.mark.parametrize("flicker", [0.01, 0.03])
def test_a_lamp_that_flickers_is_no_other_gain(tmp_path, flicker):
    made = developed(write(tmp_path, [1.0] * len(BANDS), flicker=flicker))
    assert "unlike_noise" not in made.measured[""]


@pytest.mark.parametrize("shots", [(4, 4), (4, 1)], ids=str)
@pytest.mark.parametrize("band", [450, 600])  # the model of all is fitted to 600 nm, too
def test_a_white_that_is_full_in_one_band_makes_sigma_no_smaller(tmp_path, shots, band):
    """Full wells at 9,000 electrons, which differ by 1 % from sensel to sensel, in front of the read noise."""
    full = np.full(SHAPE, 9_000.0) * (1 + 0.01 * np.random.default_rng(7).standard_normal(SHAPE))
    whole = developed(write(tmp_path / "whole", [1.0] * len(BANDS), shots=shots))
    made = developed(write(tmp_path / "full", [1.0] * len(BANDS), shots=shots, full={band: full}))
    sigma, expected = (np.median(m.cubes[""].sigma[..., BANDS.index(band)]) for m in (made, whole))
    assert sigma >= expected


@pytest.mark.parametrize("balanced", [True, False])
def test_channels_of_a_mosaic_that_were_multiplied_are_named(tmp_path, balanced):
    rng, raw = np.random.default_rng(5), tmp_path / "raw"
    raw.mkdir()
    gain = np.tile([[2.0, 1.0], [1.0, 1.6]], (SHAPE[0] // 2, SHAPE[1] // 2)) if balanced else 1.0
    for name, light in (("dark", 0 * PANEL), ("white", WELL + 0 * PANEL), ("panel", WELL * PANEL)):
        for take in range(4):
            electrons = rng.poisson(light) + rng.normal(0, READ, SHAPE)
            codes = np.rint(BLACK + gain * electrons).clip(0, 65535).astype(np.uint16)
            tifffile.imwrite(raw / f"{name}_{take}.tif", codes)
    (tmp_path / "campaign.toml").write_text(
        f'{HEAD}kind = "mosaic"\nfiles = "raw/{{target}}_{{shot}}.tif"\npattern = "RGGB"\n'
    )
    made = developed(tmp_path)
    notes = [w for w in made.warnings if "differs from band to band" in w]
    assert len(notes) == balanced and all("white balance" in note for note in notes)

"""Campaigns through `levkas radiometry`: what is planted comes back, whatever the exposures of darks and whites."""

import json

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.cli import app
from levkas.core.problems import Refused
from levkas.pages.emva1288 import render_examination
from levkas.quality.emva1288 import examine_with_seed

CAMPAIGN = """
[campaign]
reference = {{ camera = "cam" }}
[cameras.cam]
{kind}
files = "raw/{{target}}_{{exposure}}s_{{shot}}.tif"
exposures = "best"
{more}
[targets]
dark = "dark"
white = {{ names = "white", reflectance = 0.98 }}
objects = ["panel"]
"""
MOSAIC = 'kind = "mosaic"\npattern = "RGGB"'
GAIN, BLACK, READ, CURRENT, PRNU = 1.5, 40.0, 6.0, 50.0, 0.005
"""DN/e⁻, DN, e⁻, e⁻/s, share."""
SHAPE = (256, 384)


class Sensor:
    """Dark current that differs by a tenth from sensel to sensel, PRNU of half a per cent."""

    def __init__(self, black=BLACK, current=CURRENT):
        fixed = np.random.default_rng(1)
        self.rng, self.black = np.random.default_rng(2), black
        self.response = 1 + PRNU * fixed.standard_normal(SHAPE)
        self.current = current * (1 + 0.1 * fixed.standard_normal(SHAPE))

    def shot(self, electrons, time):
        """Codes of one shot, uint16."""
        light = self.rng.poisson(electrons * self.response + self.current * time)
        values = GAIN * (light + READ * self.rng.standard_normal(SHAPE)) + self.black
        return np.rint(values).clip(0, 65535).astype(np.uint16)


def planted(
    folder,
    *,
    darks=(1.0,),
    whites=(1.0,),
    panels=(1.0,),
    shots=3,
    white=22_000.0,
    more="bits = 16",
    **camera,
):
    sensor = Sensor(**camera)
    (folder / "raw").mkdir(parents=True)
    for target, electrons, times in (
        ("dark", 0.0, darks), ("white", white, whites), ("panel", 9_000.0, panels),
    ):  # fmt: skip
        for time in times:
            for shot in range(shots):
                path = folder / "raw" / f"{target}_{time:g}s_{shot}.tif"
                tifffile.imwrite(path, sensor.shot(electrons, time), photometric="minisblack")
    (folder / "campaign.toml").write_text(CAMPAIGN.format(kind=MOSAIC, more=more))
    return folder


def check(channels):
    """Each channel is within what is asked for, their mean within what chance leaves of it."""
    for channel in channels:
        assert channel.gain.value == pytest.approx(GAIN, rel=0.03)
        assert channel.black == pytest.approx(BLACK, abs=0.05)
        assert channel.prnu == pytest.approx(PRNU, rel=0.03)
        assert channel.dark_noise == pytest.approx(READ, rel=0.03)
    assert np.mean([channel.gain.value for channel in channels]) == pytest.approx(GAIN, rel=0.01)


@pytest.mark.parametrize(
    ("darks", "whites"),
    [
        pytest.param((0.1, 10.0), (10.0,), marks=pytest.mark.exhaustive),
        ((0.1, 4.0), (10.0,)),
        pytest.param((0.1, 1.0, 10.0), (0.1, 1.0, 10.0), marks=pytest.mark.slow),
    ],
    ids=["its own", "none of its own", "a series"],
)
def test_the_dark_current_is_neither_gain_nor_prnu(tmp_path, darks, whites):
    found = examine_with_seed(planted(tmp_path / "c", darks=darks, whites=whites))
    assert found.ok, found.problems
    channels = found.sensors[0].channels
    assert list(channels) == ["R", "G", "B"]
    check(channels.values())
    for channel in channels.values():
        assert channel.dark_current == pytest.approx(CURRENT, rel=0.02)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return planted(tmp_path_factory.mktemp("radiometry") / "campaign", current=0.0)


def tunable(folder, *, shots):
    """A tunable filter with a time, and a dark, for each band."""
    sensor = Sensor()
    panel = np.kron(sensor.rng.uniform(0.1, 0.9, (16, 24)), np.ones((16, 16)))
    (folder / "raw").mkdir(parents=True)
    for band, time in ((500, 0.5), (550, 2.0), (600, 8.0)):
        for target, electrons in (
            ("dark", 0.0), ("white", 22_000.0 + 10 * (band - 550)), ("panel", 20_000.0 * panel),
        ):  # fmt: skip
            for shot in range(shots):
                path = folder / "raw" / f"{target}_{band}nm_{1000 * time:g}ms_{shot}.tif"
                tifffile.imwrite(path, sensor.shot(electrons, time), photometric="minisblack")
    text = CAMPAIGN.format(
        kind='kind = "bands"', more="bits = 16\nwavelengths = [500, 550, 600]"
    ).replace("_{exposure}s", "_{wavelength}nm_{exposure}ms")
    (folder / "campaign.toml").write_text(text)
    return folder


def test_a_dark_time_a_band_leaves_black_gain_and_prnu_as_they_are(tmp_path):
    found = examine_with_seed(tunable(tmp_path / "c", shots=3))
    assert found.ok, found.problems
    (channel,) = found.sensors[0].channels.values()
    check([channel])
    assert channel.dark_current == pytest.approx(CURRENT, rel=0.02)


def scan(folder):
    for name, level in (("dark", 100), ("white", 3000), ("panel", 1500)):
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.raw").write_bytes(np.full(8 * 160 * 96, level, np.uint16).tobytes())
        (folder / f"{name}.hdr").write_text(
            "ENVI\nsamples = 160\nlines = 8\nbands = 96\ninterleave = bil\ndata type = 12\n"
        )
    text = CAMPAIGN.format(kind='kind = "cube"', more="bits = 12").replace('exposures = "best"', "")
    (folder / "campaign.toml").write_text(
        text.replace("raw/{target}_{exposure}s_{shot}.tif", "{target}.hdr")
    )
    return folder


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda folder: planted(folder, shots=1), "E_SHOTS"),
        (lambda folder: tunable(folder, shots=1), "E_SHOTS"),
        (lambda folder: planted(folder, black=0.0, current=0.0), "E_TEMPLATE_MISSING"),  # clipped
        (lambda folder: planted(folder, white=9_000.0, more=""), "E_BITS"),
        (scan, "E_SHOTS"),
    ],
    ids=["one shot", "one shot a band", "clipped darks", "no full scale", "line scanner"],
)
def test_what_cannot_be_measured_is_refused(tmp_path, make, code):
    found = examine_with_seed(make(tmp_path / "c"))
    assert {p.code for p in found.problems} == {code} and not found.sensors[0].channels


def test_unknown_cameras_and_folders_without_a_campaign_are_refused(folder, tmp_path):
    with pytest.raises(Refused) as refused:
        examine_with_seed(folder, cameras=["cma"])
    assert refused.value.problems[0].found == "cma"
    with pytest.raises(Refused):
        examine_with_seed(tmp_path)


def test_the_command_writes_nothing_unless_asked_and_the_same_page_for_a_seed(folder, tmp_path):
    before = sorted(folder.rglob("*"))
    assert CliRunner().invoke(app, ["radiometry", str(folder)]).exit_code == 0
    assert sorted(folder.rglob("*")) == before
    page = tmp_path / "report" / "cameras.html"
    words = ["radiometry", str(folder), "-o", str(page), "--seed", "3", "--json"]
    report = json.loads(CliRunner().invoke(app, words).output)
    gain = report["cameras"][0]["channels"][0]["gain"]
    assert gain["low"] < gain["value"] < gain["high"] and gain["unit"] == "DN/e⁻"
    text = page.read_text()
    assert "//" not in text and text == render_examination(examine_with_seed(folder, seed=3))


def test_a_foreign_simulated_camera_comes_back(two_paintings, tmp_path):
    raw = two_paintings / "raw" / "d80"
    text = CAMPAIGN.format(kind=MOSAIC, more="bits = 12").replace('exposures = "best"', "")
    text = text.replace("raw/{target}_{exposure}s_{shot}", f"{raw}/{{target}}/DSC_{{shot}}")
    (tmp_path / "campaign.toml").write_text(text.replace("panel", "icon1"))
    (sensor,) = examine_with_seed(tmp_path).sensors
    for channel in sensor.channels.values():
        # 12 bits over 25,000 electrons above black 64: 0.161 counts each; PRNU of 1.2 %.
        assert channel.gain.value == pytest.approx(4031 / 25_000, rel=0.03)
        assert channel.prnu == pytest.approx(0.012, rel=0.03)

"""Sensors with a dark current: what is planted comes back, whatever the exposures of darks and whites."""

import numpy as np
import pytest
import tifffile

from levkas.quality.emva1288 import examine_with_seed

GAIN, BLACK, READ, CURRENT, PRNU = 1.5, 40.0, 6.0, 50.0, 0.005
"""DN/e⁻, DN, e⁻, e⁻/s, share."""
SHAPE = (256, 384)
CAMPAIGN = """
[campaign]
reference = { camera = "cam" }
[cameras.cam]
kind = "mosaic"
pattern = "RGGB"
files = "raw/{target}_{exposure}s_{shot}.tif"
bits = 16
exposures = "best"
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.98 }
objects = ["panel"]
"""


class Sensor:
    """Dark current that differs by a tenth from sensel to sensel, PRNU of half a per cent."""

    def __init__(self, seed=1):
        fixed = np.random.default_rng(seed)
        self.rng = np.random.default_rng(seed + 1)
        self.response = 1 + PRNU * fixed.standard_normal(SHAPE)
        self.current = CURRENT * (1 + 0.1 * fixed.standard_normal(SHAPE))

    def shot(self, electrons, time):
        """Codes of one shot, uint16."""
        light = self.rng.poisson(electrons * self.response + self.current * time)
        values = GAIN * (light + READ * self.rng.standard_normal(SHAPE)) + BLACK
        return np.rint(values).clip(0, 65535).astype(np.uint16)


def write(folder, name, frame):
    folder.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(folder / name, frame, photometric="minisblack")


def planted(folder, *, darks, whites, panels=(1.0,), shots=3):
    sensor = Sensor()
    for target, electrons, times in (
        ("dark", 0.0, darks),
        ("white", 22_000.0, whites),
        ("panel", 9_000.0, panels),
    ):
        for time in times:
            for shot in range(shots):
                write(
                    folder / "raw", f"{target}_{time:g}s_{shot}.tif", sensor.shot(electrons, time)
                )
    (folder / "campaign.toml").write_text(CAMPAIGN)
    return folder


def check(channels):
    """Each channel is within what is asked for, their mean within what chance leaves of it."""
    for channel in channels:
        assert channel.gain.value == pytest.approx(GAIN, rel=0.03)
        assert channel.black.value == pytest.approx(BLACK, abs=0.05)
        assert channel.prnu.value == pytest.approx(PRNU, rel=0.03)
        assert channel.dark_noise is None or channel.dark_noise.value == pytest.approx(
            READ, rel=0.03
        )
    assert np.mean([channel.gain.value for channel in channels]) == pytest.approx(GAIN, rel=0.01)


@pytest.mark.parametrize(
    ("darks", "whites"),
    [
        pytest.param((0.1, 10.0), (10.0,), marks=pytest.mark.slow),
        ((0.1, 4.0), (10.0,)),
        ((0.1, 1.0, 10.0), (0.1, 1.0, 10.0)),
    ],
    ids=["its own", "none of its own", "a series"],
)
def test_the_dark_current_is_neither_gain_nor_prnu(tmp_path, darks, whites):
    found = examine_with_seed(planted(tmp_path, darks=darks, whites=whites))
    assert found.ok, found.problems
    (sensor,) = found.sensors
    check(sensor.channels.values())
    for channel in sensor.channels.values():
        assert channel.dark_noise is not None
        assert channel.dark_current.value == pytest.approx(CURRENT, rel=0.02)
    assert not any("exposure" in note and "dark" in note for note in sensor.notes)


def test_a_white_without_a_dark_of_its_exposure_is_doubted(tmp_path):
    found = examine_with_seed(planted(tmp_path, darks=(0.1,), whites=(10.0,), panels=(0.1,)))
    (sensor,) = found.sensors
    (note,) = [n for n in sensor.notes if "no dark of" in n]
    assert "10 s" in note and "PRNU" in note and "Capture darks" in note


BANDS = ((500, 0.5), (550, 2.0), (600, 8.0))
"""nm, s."""


def tunable(folder, *, shots):
    """A tunable filter with a time, and a dark, for each band."""
    sensor = Sensor(seed=5)
    panel = np.kron(sensor.rng.uniform(0.1, 0.9, (16, 24)), np.ones((16, 16)))
    for band, time in BANDS:
        for target, electrons in (
            ("dark", 0.0),
            ("white", 22_000.0 + 10 * (band - 550)),
            ("panel", 20_000.0 * panel),
        ):
            for shot in range(shots):
                name = f"{target}_{band}nm_{1000 * time:g}ms_{shot}.tif"
                write(folder / "raw", name, sensor.shot(electrons, time))
    text = CAMPAIGN.replace('kind = "mosaic"\npattern = "RGGB"', 'kind = "bands"')
    text = text.replace("{target}_{exposure}s", "{target}_{wavelength}nm_{exposure}ms")
    text = text.replace("bits = 16", "bits = 16\nwavelengths = [500, 550, 600]")
    (folder / "campaign.toml").write_text(text)
    return folder


def test_a_dark_time_a_band_leaves_black_gain_and_prnu_as_they_are(tmp_path):
    found = examine_with_seed(tunable(tmp_path, shots=3))
    assert found.ok, found.problems
    (channel,) = found.sensors[0].channels.values()
    check([channel])
    assert channel.dark_noise is not None
    assert channel.dark_current.value == pytest.approx(CURRENT, rel=0.02)


def scan(folder, bands, *, current=0.0, times=(0.02, 0.02), lines=200, samples=1024):
    """A push-broom scan of a few bands: dark and white of `times`, s; returns the planted PRNU."""
    rng = np.random.default_rng(bands)
    response = 1 + 0.012 * rng.standard_normal((samples, bands))
    leak = current * (1 + 0.1 * rng.standard_normal((samples, bands)))
    light = 9_000 * (1 - 0.3 * np.linspace(-1, 1, samples)[:, None] ** 2)
    light = light * (0.6 + 0.4 * np.cos(np.arange(bands)))
    for name, electrons, time in (
        *(("dark", 0 * light, t) for t in dict.fromkeys(times)),
        ("white", light, times[-1]),
        ("panel", 0.5 * light, times[-1]),
    ):
        observed = rng.poisson(electrons * response + leak * time, (lines, samples, bands))
        raw = 0.4 * observed + rng.normal(100, 3, observed.shape)
        stem = folder / f"{name}_{1000 * time:g}ms"
        stem.with_suffix(".raw").write_bytes(raw.round().astype("<u2").transpose(0, 2, 1).tobytes())
        stem.with_suffix(".hdr").write_text(
            f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\ninterleave = bil\n"
            "data type = 12\nbyte order = 0\n"
        )
    text = CAMPAIGN.replace('kind = "mosaic"\npattern = "RGGB"', 'kind = "cube"')
    text = text.replace("raw/{target}_{exposure}s_{shot}.tif", "{target}_{exposure}ms.hdr")
    text = text.replace('bits = 16\nexposures = "best"', "bits = 12")
    (folder / "campaign.toml").write_text(text)
    return float(np.std(response))


@pytest.mark.slow
@pytest.mark.parametrize("bands", [1, 4, 15, 16])
def test_line_scans_of_few_bands_are_measured(tmp_path, bands):
    prnu = scan(tmp_path, bands)
    found = examine_with_seed(tmp_path)
    assert found.ok, found.problems
    channel = found.sensors[0].channels["all"]
    assert channel.gain.value == pytest.approx(0.4, rel=0.03)
    assert channel.prnu.value == pytest.approx(prnu, rel=0.03)
    assert channel.dark_noise.value == pytest.approx(3 / 0.4, rel=0.03)
    assert channel.black.value == pytest.approx(100, abs=0.05)


@pytest.mark.slow
def test_a_line_scan_takes_the_dark_of_its_white(tmp_path):
    prnu = scan(tmp_path, 16, current=2_000.0, times=(0.02, 0.4))
    found = examine_with_seed(tmp_path)
    assert found.ok, found.problems
    channel = found.sensors[0].channels["all"]
    assert channel.gain.value == pytest.approx(0.4, rel=0.01)
    assert channel.prnu.value == pytest.approx(prnu, rel=0.03)
    assert channel.black.value == pytest.approx(100, abs=0.05)
    assert channel.dark_noise.value == pytest.approx(3 / 0.4, rel=0.03)


def test_a_line_scan_too_small_for_statistics_says_so(tmp_path):
    scan(tmp_path, 1, samples=40)
    found = examine_with_seed(tmp_path)
    (problem,) = found.problems
    assert problem.code == "E_SIZE" and "saturated" not in str(problem)

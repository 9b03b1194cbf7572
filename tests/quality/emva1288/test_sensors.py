"""Campaigns and folders through `levkas radiometry`."""

import json

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.cli import app
from levkas.core.problems import Refused
from levkas.pages.emva1288 import render_examination
from levkas.quality.emva1288 import examine_with_seed
from levkas.quality.emva1288.facts import describe_files, describe_frame

CAMPAIGN = """
[campaign]
reference = {{ camera = "cam" }}
[cameras.cam]
kind = "mosaic"
pattern = "RGGB"
files = "raw/{{target}}_{{shot}}.tif"
bits = 12
{more}
[targets]
dark = "dark"
white = {{ names = "white", reflectance = 0.98 }}
objects = ["panel"]
"""


def make(folder, *, shots=3, black=64.0, more="", gain=0.1, read=2.0):
    """A campaign of one camera whose gain, noise and PRNU are known."""
    rng, fixed = np.random.default_rng(1), np.random.default_rng(2)
    shape = (256, 384)
    response = 1 + 0.02 * fixed.standard_normal(shape)
    scene = np.linspace(0.1, 0.9, shape[1]) * np.ones((shape[0], 1))
    (folder / "raw").mkdir(parents=True)
    for target, electrons in (("dark", 0.0), ("white", 28_000.0), ("panel", 28_000.0 * scene)):
        for shot in range(shots):
            light = rng.poisson(electrons * response, shape) * gain
            raw = np.rint(light + rng.normal(black, read, shape)).clip(0, 4095)
            name = folder / "raw" / f"{target}_{shot}.tif"
            tifffile.imwrite(name, raw.astype(np.uint16), photometric="minisblack")
    (folder / "campaign.toml").write_text(CAMPAIGN.format(more=more))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make(tmp_path_factory.mktemp("radiometry") / "campaign")


def test_a_campaign_tells_its_camera(folder):
    found = examine_with_seed(folder)
    (sensor,) = found.sensors
    assert found.ok and list(sensor.channels) == ["R", "G", "B"]
    for channel in sensor.channels.values():
        assert channel.gain.value == pytest.approx(0.1, rel=0.03)
        assert channel.dark_noise.value == pytest.approx(20.0, rel=0.03)
        assert channel.prnu.value == pytest.approx(0.02, rel=0.03)
        assert channel.black.value == pytest.approx(64.0, abs=0.05)
    assert [name for name, _ in sensor.light] == ["white", "panel"]
    assert not any(drift.noticed for _, drift in sensor.light)


def test_the_brightest_pixel_is_no_full_scale(folder, tmp_path):
    text = (folder / "campaign.toml").read_text().replace("bits = 12\n", "")
    text = text.replace("raw/", f"{folder}/raw/")
    (tmp_path / "campaign.toml").write_text(text)
    found = examine_with_seed(tmp_path)
    (sensor,) = found.sensors
    for channel in sensor.channels.values():
        assert channel.gain.value == pytest.approx(0.1, rel=0.03)
        assert channel.full_well is channel.snr is channel.dynamic_range is None
    assert sensor.facts.white is None
    assert any("`bits`" in note and "left out" in note for note in sensor.notes)
    assert (
        "photon transfer curve" in render_examination(found) and "SNR at saturation" in found.text
    )


def test_clipped_darks_are_refused_and_a_declared_black_takes_their_place(tmp_path):
    found = examine_with_seed(make(tmp_path / "c", black=0.0))
    assert [p.code for p in found.problems] == ["E_TEMPLATE_MISSING"]
    assert any("clipped at zero" in note for note in found.sensors[0].notes)
    (sensor,) = examine_with_seed(make(tmp_path / "b", black=0.0, more="black = 0")).sensors
    for channel in sensor.channels.values():
        assert channel.gain.value == pytest.approx(0.1, rel=0.03)
        assert channel.prnu.value == pytest.approx(0.02, rel=0.03)


def test_one_shot_of_each_is_refused_with_what_to_capture(tmp_path):
    found = examine_with_seed(make(tmp_path / "c", shots=1))
    assert [p.code for p in found.problems] == ["E_SHOTS"]
    assert "twice or more" in found.problems[0].fix
    result = CliRunner().invoke(app, ["radiometry", str(tmp_path / "c")])
    assert result.exit_code == 1


def tunable(folder, *, times=(1.0,)):
    """One shot a band, or one an exposure, behind a tunable filter; hot sensels in every frame."""
    rng, fixed = np.random.default_rng(1), np.random.default_rng(2)
    shape = (256, 384)
    response = 1 + 0.012 * fixed.standard_normal(shape)
    hot = 400.0 * (fixed.random(shape) < 1e-4)
    scene = np.kron(fixed.uniform(0.1, 0.9, (16, 24)), np.ones((16, 16)))
    (folder / "raw").mkdir(parents=True)
    for band, light in ((500, 9_000.0), (550, 14_000.0), (600, 11_000.0)):
        for target, electrons in (("dark", 0 * scene), ("white", 1 + 0 * scene), ("panel", scene)):
            for time in times:
                counts = 0.25 * rng.poisson(light * time * electrons * response)
                raw = np.rint(counts + hot + rng.normal(64, 2, shape)).clip(0, 4095)
                name = folder / "raw" / f"{target}_{band}nm_{1000 * time:g}ms.tif"
                tifffile.imwrite(name, raw.astype(np.uint16), photometric="minisblack")
    text = CAMPAIGN.format(more="wavelengths = [500, 550, 600]").replace(
        "{target}_{shot}", "{target}_{wavelength}nm_{exposure}ms"
    )
    text = text.replace('kind = "mosaic"\npattern = "RGGB"', 'kind = "bands"\nexposures = "best"')
    (folder / "campaign.toml").write_text(text)
    return folder


@pytest.mark.parametrize("times", [(1.0,), (0.25, 0.5, 1.0)])
def test_one_shot_a_band_or_exposure_is_no_repeat(tmp_path, times):
    found = examine_with_seed(tunable(tmp_path / "c", times=times))
    assert {p.code for p in found.problems} == {"E_SHOTS"} and not found.sensors[0].channels


def test_an_unknown_camera_is_named_with_the_known_ones(folder):
    with pytest.raises(Refused, match=r"no camera of this name.*found: cma; expected: cam"):
        examine_with_seed(folder, cameras=["cma"])


def test_the_command_writes_nothing_unless_asked(folder, tmp_path):
    before = sorted(p for p in folder.rglob("*"))
    result = CliRunner().invoke(app, ["radiometry", str(folder)])
    assert result.exit_code == 0, result.output
    assert "system gain K" in result.output and "stops, log₂" in result.output
    assert sorted(p for p in folder.rglob("*")) == before
    page = tmp_path / "report" / "cameras.html"
    report = json.loads(
        CliRunner().invoke(app, ["radiometry", str(folder), "-o", str(page), "--json"]).output
    )
    assert report["page"] == str(page)
    (camera,) = report["cameras"]
    gain = camera["channels"][0]["gain"]
    assert gain["low"] < gain["value"] < gain["high"] and gain["unit"] == "DN/e⁻"
    text = page.read_text()
    assert "photon transfer curve" in text and "//" not in text


def test_the_same_seed_gives_the_same_page(folder):
    one, two = (render_examination(examine_with_seed(folder, seed=3)) for _ in range(2))
    assert one == two


def test_raw_facts_of_a_frame(folder):
    facts = describe_frame(folder / "raw" / "white_0.tif")
    assert (facts.size, facts.bits, facts.zeros) == ("384 x 256", 12, 0.0)
    assert facts.levels.count < 1000 and not facts.levels.curved


def test_facts_of_a_folder_name_what_cannot_be_read(folder, tmp_path):
    good = (folder / "raw" / "white_0.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(good)
    (tmp_path / "b.tif").write_bytes(good[: len(good) // 2])
    (tmp_path / "notes.txt").write_text("no frame")
    frames, levels, problems = describe_files(tmp_path)
    assert len(frames) == 1 and levels.count == frames[0].levels.count
    assert [p.file for p in problems] == [str(tmp_path / "b.tif")]


def test_a_folder_without_frames_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("no frame")
    result = CliRunner().invoke(app, ["radiometry", str(tmp_path)])
    assert result.exit_code == 1
    assert "E_NO_FRAMES" in result.output


def test_twelve_bits_at_the_upper_end_of_sixteen_are_seen(real_data):
    facts = describe_frame(real_data / "rededge-5lens" / "IMG_0000_1.tif")
    assert facts.levels.spacing == 16
    assert (facts.black, facts.white, facts.iso) == (4800, 65520, 100)
    assert "4096 of" in facts.curve


def test_a_foreign_simulated_camera_comes_back(two_paintings, tmp_path):
    raw = two_paintings / "raw" / "d80"
    text = CAMPAIGN.format(more="").replace("raw/{target}_{shot}", f"{raw}/{{target}}/DSC_{{shot}}")
    (tmp_path / "campaign.toml").write_text(text.replace("panel", "icon1"))
    (sensor,) = examine_with_seed(tmp_path).sensors
    assert list(sensor.channels) == ["R", "G", "B"]
    for channel in sensor.channels.values():
        # 12 bits over 25,000 electrons above black 64: 0.161 counts each; PRNU of 1.2 %.
        assert channel.gain.value == pytest.approx(4031 / 25_000, rel=0.03)
        assert channel.prnu.value == pytest.approx(0.012, rel=0.03)


def test_a_line_scanner_tells_its_prnu_along_the_samples(two_paintings, tmp_path):
    raw = two_paintings / "raw" / "v10"
    text = CAMPAIGN.format(more="").replace('kind = "mosaic"\npattern = "RGGB"', 'kind = "cube"')
    text = text.replace("raw/{target}_{shot}.tif", f"{raw}/{{target}}.hdr").replace(
        "panel", "icon1"
    )
    (tmp_path / "campaign.toml").write_text(text)
    (sensor,) = examine_with_seed(tmp_path).sensors
    prnu = sensor.channels["all"].prnu  # one line of 330 samples and 25 bands: 8,000 sensels
    assert prnu.value == pytest.approx(0.012, rel=0.12) and prnu.low < 0.0125


def test_a_mirror_scanner_is_refused_with_what_to_capture(tmp_path):
    for name, level in (("dark", 100), ("white", 3000), ("panel", 1500)):
        (tmp_path / f"{name}.raw").write_bytes(np.full(8 * 160 * 96, level, np.uint16).tobytes())
        (tmp_path / f"{name}.hdr").write_text(
            "ENVI\nsamples = 160\nlines = 8\nbands = 96\ninterleave = bil\ndata type = 12\n"
        )
    text = CAMPAIGN.format(more='scan = "mirror"').replace(
        'kind = "mosaic"\npattern = "RGGB"', 'kind = "cube"'
    )
    (tmp_path / "campaign.toml").write_text(text.replace("raw/{target}_{shot}.tif", "{target}.hdr"))
    (sensor,) = examine_with_seed(tmp_path).sensors
    (problem,) = sensor.problems
    assert not sensor.channels
    assert (problem.code, problem.field) == ("E_SHOTS", "cameras.cam.scan")


def test_a_camera_that_bends_and_a_white_that_saturates_are_told(tmp_path):
    rng, raw = np.random.default_rng(5), tmp_path / "raw"
    raw.mkdir()
    scene = np.kron(np.linspace(0.3, 0.9, 16).reshape(4, 4), np.ones((48, 48)))
    for target, electrons in (("dark", 0.0), ("white", 200_000.0), ("panel", 30_000.0)):
        for time in (0.25, 0.5, 1.0):
            for shot in "ab":
                light = rng.poisson(electrons * time * scene) * 0.1
                observed = light - 0.2 * light**2 / 4000 + rng.normal(64, 2, scene.shape)
                path = raw / f"{target}_{shot}_{time}s.tif"
                codes = np.full(scene.shape, 4095.0) if target == "white" else np.rint(observed)
                tifffile.imwrite(path, codes.astype(np.uint16), photometric="minisblack")
    text = CAMPAIGN.format(more='exposures = "best"').replace(
        "_{shot}.tif", "_{shot}_{exposure}s.tif"
    )
    (tmp_path / "campaign.toml").write_text(text)
    (sensor,) = examine_with_seed(tmp_path).sensors
    reported = " / ".join(sensor.notes)
    assert "counts do not scale between exposures" in reported and "at one time" in reported
    assert "white is saturated everywhere" in reported
    (_, found), *_ = sensor.linearity
    assert found.offset == 0 and found.rms > 0.015

"""Whole campaigns, made tiny: layout, truth, determinism, and reflectance recovered from raw files."""

import hashlib
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tifffile

from levkas.calibration.noise_model import noise_variance
from levkas.quality.evaluation.similarity import read_truth
from levkas.simulation.campaigns import Simulated, SimulatedSession, simulate_campaign
from levkas.simulation.capture import WHITE_REFLECTANCE, view_painting
from levkas.simulation.presets import PRESETS, SimulationRefused, choose_cameras
from levkas.simulation.truth import SimulatedTruth

TINY = replace(PRESETS["small"], scale=0.1, fineness=1.0, supersampling=2)


def simulate(folder, seed=11, **options):
    steps = list(simulate_campaign(folder, seed=seed, **{"preset": TINY, **options}))
    assert isinstance(steps[-1], Simulated)
    done = [s.done for s in steps]
    assert done == sorted(done)
    assert done[-1] == steps[-1].total
    return steps[-1]


def digests(folder):
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiny")
    return folder, simulate(folder, setups=True)


@pytest.mark.slow
def test_a_campaign_has_raw_files_truth_and_a_campaign_toml(tiny):
    folder, result = tiny
    facts = tomllib.loads(result.campaign.read_text())
    assert list(facts["cameras"]) == ["d80", "msbs", "lctf-vis", "lctf-nir", "v10"]
    assert facts["campaign"]["reference"] == {"camera": "lctf-vis", "band": "550 nm"}
    assert [s["name"] for s in facts["cameras"]["msbs"]["sensors"]] == ["ccd1", "ccd2", "ccd3"]
    assert (folder / facts["targets"]["white"]["reflectance"]).is_file()
    assert len(list((folder / "raw/d80/icon1").glob("DSC_*.tif"))) == 2
    assert len(list((folder / "raw/lctf-vis/icon1").glob("*nm_00.tif"))) == 16
    assert (folder / "raw/45-degree/d80/icon1/DSC_1000.tif").is_file()
    frame = tifffile.imread(folder / "raw/d80/icon1/DSC_1000.tif")
    assert (frame.dtype, frame.shape) == (np.uint16, (262, 390))
    assert frame.max() <= 4095


def test_the_truth_has_the_layout_that_evaluate_reads(tiny):
    folder, result = tiny
    for camera, bands in (("d80", 3), ("msbs", 7), ("lctf-vis", 16), ("lctf-nir", 11), ("v10", 25)):
        known = read_truth(folder / "truth", "icon1", camera)
        assert known is not None
        assert len(known.bands) == bands
        assert all(np.isfinite(p).all() for p in known.bands.values())
    known = read_truth(folder / "truth", "icon1", "lctf-vis")
    np.testing.assert_allclose(known.bands["550 nm"], known.reference, atol=1e-9)
    again = SimulatedTruth.load(folder / "truth")
    np.testing.assert_array_equal(
        again.map(known.reference, "v10", "900 nm"),
        result.truth.map(known.reference, "v10", "900 nm"),
    )


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_of_any_subset(tiny, tmp_path):
    folder, _ = tiny
    simulate(tmp_path / "one", cameras=["v10"], setups=True)  # as uneven as the whole one
    first, second = digests(folder), digests(tmp_path / "one")
    raw = {name: d for name, d in second.items() if name.startswith("raw/")}
    assert any("v10" in name for name in raw)
    assert all("v10" in name or "lctf-vis" in name for name in raw)
    assert raw.items() <= first.items()
    simulate(tmp_path / "again", cameras=["v10"], seed=12)
    assert digests(tmp_path / "again")["raw/v10/icon1.raw"] != first["raw/v10/icon1.raw"]


def test_flat_fielding_recovers_the_reflectance_within_its_noise():
    preset = replace(TINY, scale=0.12)
    models = choose_cameras(preset, ["lctf-vis"])
    session = SimulatedSession(preset, models, 3, 1)
    camera = session.cameras["lctf-vis"]
    model = camera.model
    band, sensor = model.bands[7], model.sensors[0]
    painting = session.paint("icon1", 0)
    sight = view_painting(
        model, session.views["icon1"]["lctf-vis"], session.panels["icon1"], painting
    )
    truth = sight.reflectance(band, sensor, supersampling=preset.supersampling)
    frames = {
        name: next(f for f in camera.shoot(name, s, white=name == "white") if f.band == band.label)
        for name, s in (("icon1", sight), ("dark", None), ("white", None))
    }
    s, d, w = (frames[n].counts.astype(float) for n in ("icon1", "dark", "white"))
    found = (s - d) / (w - d) * WHITE_REFLECTANCE
    light = camera.electrons(band, sensor)
    noise = replace(sensor.noise, prnu=0.0, dsnu=0.0)
    gain = noise.gain
    step = 1 / 12 / gain**2
    vs, vw, vd = (noise_variance(light * r, noise) + step for r in (truth, WHITE_REFLECTANCE, 0.0))
    r = truth / WHITE_REFLECTANCE
    u = np.sqrt(vs + r**2 * vw + (1 - r) ** 2 * vd) / (light * WHITE_REFLECTANCE)
    fixed = camera.pattern(sensor)
    usual = (s < 4095) & (fixed.dark == 1) & (fixed.response > 0.5)
    score = ((found - truth) / (u * WHITE_REFLECTANCE))[usual]
    assert abs(score.mean()) < 0.05
    assert 0.95 < score.std() < 1.05
    assert 0.94 < (np.abs(score) < 1.96).mean() < 0.96


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"preset": "soft"}, "preset"),
        ({"cameras": ["d90"]}, "cameras"),
        ({"scale": 1.5}, "scale"),
        ({"setups": ["raking"]}, "setup"),
        ({"preset": replace(TINY, unevenness_deg=40.0)}, "unevenness"),
        ({"objects": 0}, "objects"),
    ],
)
def test_what_cannot_be_simulated_is_refused(tmp_path, options, field):
    with pytest.raises(SimulationRefused) as refused:
        list(simulate_campaign(tmp_path / "a", **options))
    assert refused.value.problems[0].field == field
    assert not (tmp_path / "a").exists()


def test_a_simulation_that_is_stopped_leaves_nothing(tmp_path):
    steps = simulate_campaign(tmp_path / "a", preset=TINY, cameras=["d80"])
    for _ in range(3):
        next(steps)
    steps.close()
    assert list(tmp_path.iterdir()) == []

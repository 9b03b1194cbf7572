"""Planned exposure series against simulated captures: darkest paint before and after, shares, ISO, refusals."""

import json

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.building import build
from levkas.calibration.exposures import merge_exposures, merge_weight
from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.templates import Template
from levkas.cli import app
from levkas.planning import PlanRefused
from levkas.planning.exposure_advice import NoAdvice, advise_frames
from levkas.planning.exposure_series import SeriesWish, plan_series
from levkas.planning.series_report import series_text
from levkas.planning.tables import StudioCameraKeys

BLACK, FULL, GAIN, READ = 64.0, 4095, 0.2, 2.0  # counts, counts per electron, counts of noise
RATE = 4000.0  # counts a second of R = 1
PATCHES = np.array([0.0008, 0.004, 0.02, 0.08, 0.3, 1.0, 2.0, 4.0])
KEYS = StudioCameraKeys.model_validate(
    {"pixels": [256, 128], "pitch_um": 6.0, "focal_mm": 60, "f_number": 8,
     "full_well_e": (FULL - BLACK) / GAIN, "read_e": READ / GAIN, "dark_e_per_s": 0.0}
)  # fmt: skip
CAMPAIGN = f"""
[campaign]
title = "series"
reference = {{ camera = "cam" }}
[database]
native = true
[cameras.cam]
kind = "bands"
files = "raw/{{target}}_{{wavelength}}nm_{{exposure}}ms_{{shot}}.tif"
bits = 12
black = {BLACK:g}
exposures = "merge"
[targets]
white = {{ names = "white", reflectance = 1.0 }}
objects = ["panel"]
"""


def scene(side=64):
    """Paint under gold: eight patches over 12 stops."""
    return np.kron(PATCHES.reshape(2, 4), np.ones((side, side)))


def capture(reflectance, time_s, rng, *, gain=GAIN, rate=RATE, read=READ):
    electrons = rate * reflectance * time_s / GAIN
    counts = gain * rng.poisson(electrons) + rng.normal(BLACK, read, reflectance.shape)
    return np.rint(counts).clip(0, FULL).astype(np.uint16)


def write(folder, name, time_s, shot, frame, **more):
    folder.mkdir(exist_ok=True, parents=True)
    path = folder / f"{name}_550nm_{1000 * time_s:g}ms_{shot}.tif"
    tifffile.imwrite(path, frame, photometric="minisblack", **more)
    return path


@pytest.fixture
def requested(tmp_path):
    """The object at an exposure that holds the gold, twice, and at one that shows the dark."""
    rng = np.random.default_rng(1)
    return [
        write(tmp_path / "asked", "panel", t, shot, capture(scene(), t, rng))
        for t, shots in ((0.2, 2), (8.0, 2))
        for shot in range(shots)
    ]


def planned(frames, keys=KEYS, **wish):
    advice = advise_frames(frames, black=BLACK, bits=12, is_white=False)
    return plan_series(advice[0], SeriesWish(**{"snr": 20.0, "quantile": 0.05, **wish}), keys)


def test_the_merge_weighs_as_the_plan_says():
    clear = np.zeros((4, 4), bool)
    shots = [
        Template(np.full((4, 4), v, "f4"), None, 1, clear, clear, t)
        for v, t in ((164, 1), (464, 4))
    ]
    merged = merge_exposures(shots, saturation=4095, black=64.0, noise=NoiseModel(0.2, 4.0))
    said = sum(merge_weight(100.0, t, gain=0.2, read_variance=4.0) for t in (1, 4))
    np.testing.assert_allclose(merged.template.variance, 1 / said, rtol=1e-5)


def test_a_build_of_the_planned_series_has_the_predicted_signal_to_noise(requested, tmp_path):
    plan = planned(requested)
    times = [e.time_s for e in plan.exposures]
    assert len(times) == 3 and not plan.suffices
    assert plan.darkest == pytest.approx(RATE * PATCHES[0], rel=0.03)
    assert plan.snr_single < 2 < 20 <= plan.snr_series < 22
    rng, folder = np.random.default_rng(2), tmp_path / "campaign"
    for time in times:
        write(folder / "raw", "panel", time, 0, capture(scene(), time, rng))
    for shot in range(16):
        write(folder / "raw", "white", 0.4, shot, capture(np.ones(scene().shape), 0.4, rng))
    (folder / "campaign.toml").write_text(CAMPAIGN)
    assert not [step for step in build(folder) if step.state in ("refused", "failed")]
    values = tifffile.imread(folder / "database/objects/panel/native/panel_cam.tif")
    dark = values[4:60, 4:60]
    assert dark.mean() == pytest.approx(PATCHES[0], rel=0.02)
    achieved = dark.mean() / dark.std()
    assert achieved == pytest.approx(plan.snr_series, rel=0.1)
    for patch, reflectance in enumerate(PATCHES):
        y, x = divmod(patch, 4)
        part = values[64 * y + 4 : 64 * y + 60, 64 * x + 4 : 64 * x + 60]
        said = np.interp(RATE * reflectance, plan.curve[0], plan.curve[2])
        white = 1 / np.sqrt(16 * RATE * 0.4 / GAIN)  # noise of the mean of whites, besides
        assert part.mean() / part.std() == pytest.approx(1 / np.hypot(1 / said, white), rel=0.1)
        assert said >= 19.5


def test_shares_are_those_of_the_patches(requested):
    plan = planned(requested)
    unsaturated = [e.unsaturated for e in plan.exposures]
    assert unsaturated[0] == 1.0 and unsaturated == sorted(unsaturated, reverse=True)
    last = plan.exposures[-1]
    assert last.reaches + 0.07 > last.unsaturated  # half of the darkest patch reaches 20 exactly
    assert sum(e.decides for e in plan.exposures) == pytest.approx(1, abs=0.03)
    assert plan.below_series < 0.08 < plan.below_single


def test_one_exposure_is_said_to_suffice_where_the_scene_fits(tmp_path):
    rng = np.random.default_rng(3)
    fits = np.maximum(scene(), 0.3)
    frames = [write(tmp_path, "panel", 0.2, k, capture(fits, 0.2, rng)) for k in range(2)]
    plan = planned(frames)
    assert plan.suffices and len(plan.exposures) == 1
    assert "one exposure suffices" in series_text([plan])


@pytest.mark.parametrize(("read", "after", "longest", "iso"), [
    (10.0, 9.9, 2.0, 800.0),  # nearly all behind the amplifier, and too little time: amplify
    (10.0, 0.0, 2.0, 100.0),  # nothing behind it: ISO only takes full well away
    (10.0, 9.9, None, 100.0),  # with all the time it takes, the largest full well needs fewest exposures
])  # fmt: skip
def test_iso_is_chosen_by_where_the_read_noise_arises(requested, read, after, longest, iso):
    keys = KEYS.model_copy(update={"read_e": read, "read_after_e": after, "isos": (100.0, 200.0, 400.0, 800.0)})  # fmt: skip
    plan = planned(requested, keys, longest_s=longest)
    assert plan.sensor.iso == iso
    if iso == 800:
        electrons = [plan.darkest / plan.sensor.gain * e.time_s for e in plan.exposures]
        noise = (read**2 - after**2) + (after / 8) ** 2 + 1 / 12 / plan.sensor.gain**2
        by_hand = np.sqrt(sum(e**2 / (e + noise) for e in electrons))
        assert plan.snr_series == pytest.approx(by_hand, rel=1e-6)
        assert "read noise 10.1 → 1.9 e⁻" in plan.iso_words


def test_the_noise_is_measured_by_shots_and_never_by_texture_or_exposures(requested, tmp_path):
    rng = np.random.default_rng(7)
    texture = scene() * np.exp(0.3 * rng.standard_normal(scene().shape))
    frames = [
        write(tmp_path / "three", "panel", t, 0, capture(texture, t, rng)) for t in (0.1, 0.8, 6.4)
    ]
    twice = write(tmp_path / "three", "panel", 0.8, 1, capture(texture, 0.8, rng))
    for found in (planned(requested, None), planned([*frames, twice], None)):
        assert found.sensor.gain == pytest.approx(GAIN, rel=0.08)
        assert found.sensor.read_variance == pytest.approx(READ**2 + 1 / 12, rel=0.12)
    with pytest.raises(NoAdvice, match="one shot of an object cannot separate"):
        planned(frames, None)


def test_without_both_numbers_no_iso_is_chosen(requested):
    assert planned(requested, None).iso_words.startswith("not chosen")
    assert planned(requested).iso_words.startswith("not chosen")


def test_what_frames_or_sensor_cannot_give_is_refused(requested, tmp_path):
    with pytest.raises(NoAdvice, match="do not show how dark"):
        planned(requested[:2], quantile=0.05)
    with pytest.raises(NoAdvice, match="no exposure of this sensor reaches"):
        planned(requested, snr=500.0)
    with pytest.raises(PlanRefused, match="does not lie in the frame"):
        planned(requested, region=(200, 0, 100, 64))
    with pytest.raises(PlanRefused, match="larger than the whole"):
        planned(requested, KEYS.model_copy(update={"read_after_e": 30.0, "isos": (100.0,)}))
    with pytest.raises(PlanRefused, match="quantile is out of range"):
        SeriesWish(quantile=0.7)
    with pytest.raises(NoAdvice, match="exposure is not known"):
        nameless = tmp_path / "panel.tif"
        tifffile.imwrite(nameless, capture(scene(), 0.2, np.random.default_rng(1)))
        planned([nameless])


@pytest.mark.slow
def test_the_command_plans_writes_its_page_and_its_record(requested, tmp_path):
    page = tmp_path / "series.html"
    names = [str(p) for p in requested]
    options = ["--black", "64", "--bits", "12", "--quantile", "0.05", "-o", str(page)]
    done = CliRunner().invoke(app, ["plan", "series", *names, *options, "--json"])
    assert done.exit_code == 0, done.output
    series = json.loads(done.stdout)["series"][0]
    assert 3 <= len(series["exposures"]) <= 4 and series["snr_darkest_series"] >= 19.9
    text = page.read_text()
    assert "SNR" in text and f"<strong>{series['exposures'][0]['time_s']:g}</strong>" in text
    result = CliRunner().invoke(app, ["plan", "series", *names, *options[:-2]])
    one = CliRunner().invoke(app, ["plan", "series", names[0], *options[:-2]])
    assert one.exit_code == 0 and "set " in one.stdout and "no series for" in one.stdout
    assert "merged" in result.stdout and 'exposures = "merge"' in result.stdout
    assert (
        CliRunner().invoke(app, ["plan", "series", *names, *options]).exit_code != 0
    )  # stands there
    assert CliRunner().invoke(app, ["plan", "series", *names, "--camera", "x"]).exit_code != 0

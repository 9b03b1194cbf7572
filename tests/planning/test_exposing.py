"""Exposure of a setup file against hand-worked numbers."""

import numpy as np
import pytest

from levkas.planning import PlanRefused, load_setup, plan_exposure
from levkas.planning.exposure_plan import electron_rates
from levkas.planning.spectra import GRID


def by_camera(setup, name=None):
    return {e.camera: e for e in plan_exposure(setup, name)}


def test_the_bench_needs_about_the_paper_s_exposures(bench):
    """One second for the colour camera, 250 to 350 ms at ISO 400 for the others' wells of a third."""
    found = by_camera(bench)
    assert 0.8 <= found["d80"].channels[0].time_s <= 1.3
    assert all(0.5 <= c.time_s <= 1.2 for c in found["msbs"].channels)


def test_electrons_of_a_pixel_are_those_of_the_camera_equation(bench):
    lighting, camera = bench.lighting(), bench.cameras["d80"]
    spectrum = np.zeros(len(GRID))
    at = int(np.flatnonzero(GRID == 550)[0])
    spectrum[at] = 0.5  # W/m²/nm over 2 nm: 1 W/m² of green
    rate = electron_rates(bench, camera, lighting, spectrum)[1]
    photons = 1.0 * 550e-9 / 1.98644586e-25
    lens = 0.9 / (4 * (8 * (1 + 80 / 1820)) ** 2)
    quantum = camera.quantum[1][at]
    assert rate == pytest.approx(photons * 0.95 * quantum * lens * (6.05e-6) ** 2, rel=1e-3)


def test_light_of_unknown_strength_is_refused(rewritten):
    setup = load_setup(rewritten(("power_w = 400\nbeam_deg", "beam_deg")))
    with pytest.raises(PlanRefused) as refused:
        plan_exposure(setup)
    assert refused.value.problems[0].code == "E_NO_POWER"


def test_the_limiting_channel_is_blue_under_halogen_and_less_so_under_d50(rewritten, bench):
    bare = load_setup(rewritten(('filters = ["d50-filter"]\npower_w', "power_w")))
    without, with_filter = by_camera(bare)["msbs"], by_camera(bench)["msbs"]
    assert without.limiting == with_filter.limiting == "B2"
    share = [
        min(c.share_of_full for c in e.channels) / max(c.share_of_full for c in e.channels)
        for e in (without, with_filter)
    ]
    assert share[1] > 2.5 * share[0]


def test_channels_of_one_sensor_share_a_time_and_bands_of_a_tunable_filter_do_not(bench):
    found = by_camera(bench)
    times = {c.name: c.time_s for c in found["msbs"].channels}
    assert times["R1"] == times["G1"] == times["B1"] != times["IR"]
    assert max(c.share_of_full for c in found["msbs"].channels) == pytest.approx(0.85)
    tuned = [c.share_of_full for c in found["lctf-vis"].channels if not c.too_long]
    assert max(tuned) == pytest.approx(0.85) == pytest.approx(min(tuned))

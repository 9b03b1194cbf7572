"""The lamps' model fitted to a simulated measured white."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.calibration.noise_model import Sensor, noise_variance
from levkas.planning import fit_lamps
from levkas.planning.lamp_fit import moved_lighting
from levkas.planning.setup import illuminate


def measured(lighting, size, rng, shape=(96, 126)):
    """A white frame: vignetting, and the noise of the paper's sensor at 85 %."""
    x = (np.arange(shape[1]) + 0.5) / shape[1] * size[0] - size[0] / 2
    y = (np.arange(shape[0]) + 0.5) / shape[0] * size[1] - size[1] / 2
    points = np.stack([*np.meshgrid(x, y), np.zeros(shape)], -1)
    normals = np.zeros_like(points)
    normals[..., 2] = 1
    light = illuminate(lighting.lamps, points, normals)
    light = light * (1 - 0.06 * (points[..., 0] ** 2 + points[..., 1] ** 2) / 250**2)
    electrons = 0.85 * 45_000 * light / light.max()
    return electrons + rng.normal(size=shape) * np.sqrt(noise_variance(electrons, Sensor()))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_measured_white_is_explained_within_1_5_per_cent(bench, seed):
    rng = np.random.default_rng(seed)
    plan = bench.lighting()
    hung = moved_lighting(plan, rng.normal(0, 0.7, (2, 7)))
    white = measured(hung, bench.object.size_mm, rng)
    found = fit_lamps(white, plan, bench.object)
    assert found.residual <= 0.015
    truth = measured(hung, bench.object.size_mm, np.random.default_rng(0))
    block = 126 // 24
    rows, columns = 96 // block, 126 // block
    coarse = (
        truth[: rows * block, : columns * block].reshape(rows, block, columns, block).mean((1, 3))
    )
    ratio = coarse / coarse.mean() / (found.model / found.model.mean())
    assert np.sqrt(np.mean((ratio / ratio.mean() - 1) ** 2)) <= 0.015


def test_a_weak_lamp_is_found_out(bench):
    plan = bench.lighting()
    shifts = np.zeros((2, 7))
    shifts[0, 0] = -1.0  # three quarters of the power
    hung = moved_lighting(plan, shifts)
    white = measured(hung, bench.object.size_mm, np.random.default_rng(5))
    found = fit_lamps(white, plan, bench.object)
    one, other = found.lighting.lamps
    assert one.candela / other.candela < 0.9 and len(found.moved) == 2
    assert found.drop > 0.1


def misses(found, hung):
    """How far each lamp is from where it hangs, and by how much it is said to be, mm."""
    pairs = zip(hung.lamps, found.lighting.lamps, strict=True)
    return [np.linalg.norm(a.place - b.place) for a, b in pairs], [e.place_mm for e in found.errors]


@pytest.mark.parametrize("far", [1.0, 2.0])
def test_how_far_lamps_are_off_is_known_also_where_they_hang_far_from_the_plan(bench, far):
    plan, away, said, planned = bench.lighting(), [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        hung = moved_lighting(plan, rng.normal(0, far, (2, 7)))
        found = fit_lamps(measured(hung, bench.object.size_mm, rng), plan, bench.object)
        assert found.residual < 0.015
        one, other = misses(found, hung)
        away, said = away + one, said + other
        planned += [
            np.linalg.norm(a.place - b.place) for a, b in zip(hung.lamps, plan.lamps, strict=True)
        ]
    errors = np.array(away) / np.array(said)
    assert 0.7 < np.sqrt(np.mean(errors**2)) < 1.3
    assert np.mean(away) < 0.7 * np.mean(planned)


def test_a_lamp_that_shines_alone_is_placed_far_better(bench):
    plan = bench.lighting()
    plan = replace(plan, lamps=plan.lamps[:1])
    away = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        hung = moved_lighting(plan, rng.normal(0, 1, (1, 7)))
        white = measured(hung, bench.object.size_mm, rng, shape=(480, 630))
        away += misses(fit_lamps(white, plan, bench.object), hung)[0]
    assert np.mean(away) < 70  # of 240 by which it misses its plan


def test_a_dark_white_is_refused(bench):
    with pytest.raises(ValueError, match="finite values above 0"):
        fit_lamps(np.zeros((20, 20)), bench.lighting(), bench.object)

"""Tests of stray light on a chart: charts whose patches are not the published ones, light that is added, darks too dark."""

from itertools import product

import numpy as np
import pytest
from scipy.signal import fftconvolve

from levkas.core.cube import Band, Cube
from levkas.quality.targets.charts import chart_of, reference_of
from levkas.quality.targets.stray_light import measure_stray_light, stray_light_of_trap

CLASSIC = chart_of("ColorChecker24")
NM = np.array([450.0, 550.0, 650.0])
BANDS = [Band(f"{nm:g} nm", nm) for nm in NM]


def one_chart(seed, share=0.0, scale=1.0):
    """Patches as one chart has them, 1 to 3 % from the mean of charts, its black by 0.002, under light of a share."""
    rng = np.random.default_rng(seed)
    spectra = reference_of(CLASSIC).at(NM)
    own = spectra * (1 + 0.015 * rng.standard_normal((24, 1))) + 0.001 * rng.standard_normal(
        (24, 1)
    )
    return scale * (own + share) / (1 + share)


@pytest.mark.parametrize("share", [0.01, 0.05, -0.015])
def test_light_that_lies_on_all_patches_is_measured_and_named(share):
    found = [
        measure_stray_light(one_chart(seed, share), NM, CLASSIC, reference_of(CLASSIC))
        for seed in range(50)
    ]
    shares = np.array([one.shares for one in found])
    assert np.abs(shares.mean() - share / (1 + share)) < 0.0008
    assert (
        np.mean(np.abs(shares - share / (1 + share)) < 2 * np.array([one.errors for one in found]))
        > 0.9
    )
    assert np.mean([one.worst is not None for one in found]) > 0.95


def test_other_charts_and_whites_of_another_reflectance_are_no_stray_light():
    for seed in range(50):
        stray = measure_stray_light(one_chart(seed, scale=0.9), NM, CLASSIC, reference_of(CLASSIC))
        assert stray.worst is None


def test_a_trap_shows_the_share_to_a_quarter_whatever_the_form_of_the_stray_light():
    found = []
    for seed, (reach, power) in product((1, 2, 3), ((20, None), (60, None), (60, 3), (200, 3))):
        rng = np.random.default_rng(seed)
        x = np.kron(rng.uniform(0.02, 0.9, (8, 10)), np.ones((20, 20)))
        x[60:80, 80:100] = 0.0
        shot = (strayed(x, 0.01, reach, power) + 0.0005 * rng.standard_normal(x.shape))[..., None]
        cube = Cube(shot.astype(np.float32), np.zeros(shot.shape, np.uint8), None, BANDS[:1])
        made = stray_light_of_trap(cube, [(82, 62, 16, 16)])
        found.append((made.shares[0] - 0.01) / made.errors[0])
    assert np.mean(np.abs(found) < 2) > 0.9


def strayed(x, share, reach, power):
    """Return what a camera records of x, (h, w), that spreads a share as exp(-r/reach) or as the cube of the distance."""
    tall, wide = x.shape
    y, across = np.mgrid[-tall : tall + 1, -wide : wide + 1]
    r = np.hypot(y, across) / reach
    fall = np.exp(-r) if power is None else (1 + r**2) ** (-power / 2)
    light, weight = (fftconvolve(a, fall, "same") for a in (x, np.ones(x.shape)))
    return (1 - share) * x + share * light / weight

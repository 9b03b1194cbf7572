"""What holds for all of calibration: inputs stay as they are, threads do not matter."""

import numpy as np
import pytest

from levkas.calibration.defects import find_defects, replace_defects
from levkas.calibration.denoising import Projecting, find_subspace
from levkas.calibration.equalising import equalise_phases
from levkas.calibration.exposures import merge_exposures
from levkas.calibration.flatfield import flat_field
from levkas.calibration.lamp import average_steady
from levkas.calibration.mosaic import demosaic
from levkas.calibration.noise_fit import NoiseModel, fit_noise
from levkas.calibration.templates import Template, average
from levkas.core import threads

NOISE = NoiseModel(0.1, 4.0)


def frozen(array):
    array.flags.writeable = False
    return array


def template(level, *, exposure_s=None, count=3, shape=(50, 60)):
    rng = np.random.default_rng(int(level))
    made = average(
        [rng.integers(level, level + 90, shape).astype(np.uint16) for _ in range(count)],
        saturation=level + 89,
        exposure_s=exposure_s,
    )
    arrays = (made.mean, made.variance, made.saturated, made.black)
    return Template(*map(frozen, arrays[:2]), made.count, *map(frozen, arrays[2:]), made.exposure_s)


def frames(kind):
    rng = np.random.default_rng(1)
    return [frozen(rng.integers(0, 200, (50, 60)).astype(kind)) for _ in range(4)]


def mosaic():
    rng = np.random.default_rng(2)
    values = rng.uniform(1, 2, (50, 60)).astype(np.float32)
    flags = (rng.random(values.shape) < 0.01).astype(np.uint8) * 8
    return frozen(values), frozen(flags), frozen(values * 0.01)


def spectra():
    rng = np.random.default_rng(3)
    smooth = rng.random((40, 50, 2)) @ np.stack([np.ones(20), np.linspace(0, 1, 20)])
    return frozen((smooth + 0.01 * rng.standard_normal(smooth.shape)).astype(np.float32))


def unsteady():
    scene = np.random.default_rng(1).normal(1000, 5, (2, 50, 60))
    return [
        frozen(np.rint(20 + s * x).astype(np.uint16))
        for s, x in zip((0.9, 1.1), scene, strict=True)
    ]


STEPS = {
    "average codes": lambda: average(frames(np.uint16), saturation=199),
    "average steady": lambda: average_steady(unsteady, frozen(np.full((50, 60), 20.0))),
    "flat field": lambda: flat_field(template(200), template(20), template(900), noise=NOISE),
    "flat field of stacks": lambda: flat_field(template(200), template(20), template(900)),
    "fit noise": lambda: fit_noise([template(200), template(900)], [template(20)]),
    "find defects": lambda: find_defects(template(20), template(900), "RGGB"),
    "replace defects": lambda: replace_defects(*mosaic(), "RGGB"),
    "malvar": lambda: demosaic(*mosaic(), "RGGB"),
    "normalised": lambda: demosaic(*mosaic(), ["ABC", "DEF", "GHI"]),
    "equalise": lambda: equalise_phases(*mosaic(), "GBRG"),
    "merge": lambda: merge_exposures(
        [template(4000, exposure_s=1.0), template(8000, exposure_s=2.0)],
        saturation=65535,
        noise=NOISE,
    ),
    "denoise": lambda: Projecting(find_subspace([spectra()]))(spectra()),
}


def contents(value):
    """Return the bytes of every array in a result, however it is nested."""
    if isinstance(value, np.ndarray):
        return [value.tobytes()]
    if isinstance(value, (tuple, list)):
        return [part for item in value for part in contents(item)]
    if hasattr(value, "__dataclass_fields__"):
        return contents([getattr(value, name) for name in value.__dataclass_fields__])
    return [repr(value)]


@pytest.mark.parametrize("step", STEPS)
def test_read_only_input_serves_and_threads_do_not_matter(step, monkeypatch):
    monkeypatch.setattr(threads, "WORTH_THREADS", 0)
    monkeypatch.setenv("LEVKAS_THREADS", "1")
    alone = contents(STEPS[step]())
    monkeypatch.setenv("LEVKAS_THREADS", "2")
    assert alone == contents(STEPS[step]())

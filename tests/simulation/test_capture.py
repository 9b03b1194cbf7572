"""Cameras at work: mosaics of any pattern, scanners whose sensels return on every line."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.simulation.cameras import SensorModel, camera_models
from levkas.simulation.capture import SimulatedCamera, view_painting
from levkas.simulation.icon import paint_icon
from levkas.simulation.painting import Panel

PANEL = Panel(radius_mm=3000.0, depth_mm=3.0)


@pytest.fixture(scope="module")
def painting():
    return paint_icon(PANEL, 1.0, np.random.default_rng(1))


@pytest.mark.parametrize(
    "pattern",
    [((0, 1), (1, 2)), ((1, 2), (0, 1)), ((0, 1, 2), (3, 4, 5), (6, 7, 8))],
    ids=["RGGB", "GBRG", "3x3"],
)
def test_each_sensel_of_a_mosaic_holds_its_own_channel(painting, pattern):
    bands = camera_models()["lctf-vis"].bands[::3][: max(map(max, pattern)) + 1]
    sensor = SensorModel("", tuple(range(len(bands))), pattern)
    model = replace(camera_models()["d80"], bands=bands, sensors=(sensor,)).scaled(0.05)
    camera = SimulatedCamera(model, root=4, supersampling=2)
    sight = view_painting(model, model.view(), PANEL, painting)
    frame = next(camera.shoot("icon1", sight))
    n = len(pattern)
    for i, row in enumerate(pattern):
        for j, k in enumerate(row):
            observed = sight.reflectance(bands[k], sensor, supersampling=2)
            expected = (camera.electrons(bands[k], sensor) * observed)[i::n, j::n]
            counts = frame.counts[i::n, j::n] / sensor.noise.gain
            assert np.corrcoef(expected.ravel(), counts.ravel())[0, 1] > 0.99, (i, j)


def test_a_scanner_repeats_its_line_of_sensels(painting):
    model = camera_models(thin=True)["v10"].scaled(0.1)
    camera = SimulatedCamera(model, root=4, supersampling=2)
    fixed = camera.pattern(model.sensors[0], "550 nm")
    assert np.ptp(fixed.response, axis=0).max() == 0 < np.ptp(fixed.response, axis=1).min()
    other = camera.pattern(model.sensors[0], "600 nm")
    assert (other.response != fixed.response).any()
    white = next(camera.shoot("white", None, white=True))
    assert white.counts.shape == (32, model.width)

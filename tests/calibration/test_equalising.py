import numpy as np
import pytest

from levkas.calibration.equalising import equalise_phases, phase_gains
from levkas.core.cube import Flag

SEES = np.array([[0.6, 1.0], [0.02, 0.55]])


def observed(scene, sees=SEES):
    rows, columns = sees.shape
    y, x = np.indices(scene.shape)
    return (scene * sees[y % rows, x % columns]).astype(np.float32)


def blobs(shape, centres, width):
    y, x = np.indices(shape)
    depth = [np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * width**2)) for cx, cy in centres]
    return 1000 * (1 - 0.8 * np.max(depth, axis=0))


def centroid(picture, start):
    left, top = (max(0, round(float(c)) - 12) for c in start)
    right, bottom = (round(float(c)) + 13 for c in start)
    part = picture[top:bottom, left:right].astype(float)
    low, high = np.percentile(part, 5), np.percentile(part, 90)
    dark = np.clip((high - part) / (high - low), 0, 1)
    dark[dark < 0.15] = 0
    y, x = np.indices(part.shape)
    return np.array([np.sum(x * dark), np.sum(y * dark)]) / dark.sum() + (left, top)


@pytest.mark.parametrize("shape", [(60, 70), (33, 47)])  # an odd one has phases of several sizes
def test_a_plane_comes_back_whole_and_unmoved(shape):
    y, x = np.mgrid[: shape[0], : shape[1]]
    plane = 2000 + 3.0 * x - 2.0 * y
    made, flags, _ = equalise_phases(observed(plane), np.zeros(plane.shape, np.uint8), None, "GBRG")
    np.testing.assert_allclose(made, plane, rtol=2e-4)
    assert not flags.any()


def test_gains_come_back_and_the_weak_phase_is_dropped():
    rng = np.random.default_rng(0)
    scene = blobs((120, 140), [(40, 50), (90, 60)], 9)
    raw = observed(scene) + rng.normal(0, 4, scene.shape).astype(np.float32)
    found = phase_gains(raw, np.zeros(raw.shape, np.uint8), None, "GBRG")
    np.testing.assert_allclose(found.gains, SEES, atol=0.005)
    assert (found.weights > 0).tolist() == [[True, True], [False, True]]
    assert found.weights[0, 1] == 1


def test_a_saturated_phase_is_dropped():
    raw = np.minimum(observed(np.full((60, 60), 300.0)), 255)
    flags = np.where(raw >= 255, Flag.SATURATED, 0).astype(np.uint8)
    made, noted, _ = equalise_phases(raw, flags, None, "GBRG")
    # The green of gain 0.6 is now the strongest: the scale is its.
    np.testing.assert_allclose(made, 180, rtol=1e-5)
    assert not noted.any()


@pytest.mark.parametrize("sees", [SEES, np.array([[0.05, 1], [0.01, 0.05]])])
def test_blobs_stay_where_they_are(sees):
    centres = [(30.3, 40.6), (80.75, 41.2), (55.5, 90.9)]
    raw = observed(blobs((130, 120), centres, 4.0), sees)
    made, _, _ = equalise_phases(raw, np.zeros(raw.shape, np.uint8), None, "GBRG")
    for centre in centres:
        assert centroid(made, centre) == pytest.approx(centre, abs=0.03)


def test_flags_and_variance_travel():
    raw, flags = observed(np.full((40, 40), 500.0)), np.zeros((40, 40), np.uint8)
    flags[20, 21] = Flag.DEFECT
    noise = np.full(raw.shape, 9, np.float32)
    _, noted, variance = equalise_phases(raw, flags, noise, "GBRG")
    assert noted[20, 21] == Flag.DEFECT
    assert noted[20, 22] == Flag.DEFECT | Flag.NEAR
    # Never worse than what the strongest phase alone interpolates to: 1 at its own place.
    assert np.all(variance[2:-2, 2:-2] < 9)

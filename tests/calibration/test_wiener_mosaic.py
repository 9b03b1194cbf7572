"""Weights for a camera's own channels: exact on planes, the best for scenes of their covariance, with a sigma that holds."""

import cv2
import numpy as np
import pytest

from levkas.calibration.mosaic import demosaic
from levkas.calibration.patterns import channel_table
from levkas.calibration.templates import CalibrationRefused
from levkas.calibration.wiener_mosaic import correlate_channels, wiener_method

BAYER, NINE = (["R", "G"], ["G", "B"]), (["a", "b", "c"], ["d", "e", "f"], ["g", "h", "i"])
CLOSE = np.array([[1, 0.9, 0.7], [0.9, 1, 0.9], [0.7, 0.9, 1]])


def made(mosaic, pattern, method, variance=None):
    flags = np.zeros(mosaic.shape, np.uint8)
    values, _, spread = demosaic(mosaic.astype(np.float32), flags, variance, pattern, method=method)
    return values, spread


def field(correlation, shape=(400, 460), seed=0):
    """Return a scene whose detail falls off as a linear variogram's, its channels correlated as told."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    spectrum = np.hypot(np.hypot(fy, fx), 1 / 200) ** -1.5  # |d| in two dimensions: 1/f³ in power
    waves = rng.standard_normal((3, *shape))
    planes = np.stack([np.fft.irfft2(np.fft.rfft2(w) * spectrum, shape) for w in waves], -1)
    scene = planes @ np.linalg.cholesky(correlation).T
    return 0.45 + 0.08 * scene / scene.std()


def sampled(scene, pattern=BAYER):
    y, x = np.indices(scene.shape[:2])
    table = channel_table(pattern)
    which = table[y % len(table), x % len(table)]
    own = which[..., None] == np.arange(scene.shape[2])
    return np.take_along_axis(scene, which[..., None], 2)[..., 0], own


@pytest.mark.parametrize("pattern, count", [(BAYER, 3), (("GB", "RG"), 3), (NINE, 9)])
def test_planes_that_differ_by_channel_are_exact(pattern, count):
    y, x = np.mgrid[:31, :37].astype(float)
    scene = np.stack([0.3 + 0.01 * k * x - 0.02 * y + k for k in range(count)], -1)
    close = 0.8 + 0.2 * np.eye(count)
    values, _ = made(sampled(scene, pattern)[0], pattern, wiener_method(close))
    np.testing.assert_allclose(values, scene, atol=1e-5)


def test_channels_that_have_nothing_in_common_do_not_mix():
    y, x = np.indices((40, 40))
    mosaic = np.where((y % 2 == 0) & (x % 2 == 0), np.random.default_rng(0).random((40, 40)), 0.5)
    values, _ = made(mosaic, BAYER, wiener_method(np.eye(3)))
    assert np.abs(values[..., 1:] - 0.5).max() < 1e-6


@pytest.mark.parametrize("correlation", [CLOSE, 0.3 + 0.7 * np.eye(3)], ids=["close", "apart"])
def test_own_weights_are_the_best_for_channels_so_correlated(correlation):
    scene = field(correlation)
    mosaic, own = sampled(scene)
    inner = np.s_[8:-8, 8:-8]

    def error(method):
        miss = (made(mosaic, BAYER, method)[0] - scene)[inner][~own[inner]]
        return float(np.sqrt(np.mean(miss**2)))

    best = error(wiener_method(correlation))
    others = [np.eye(3), 0.6 + 0.4 * np.eye(3), CLOSE, 0.97 + 0.03 * np.eye(3)]
    assert best < error("malvar") and best < error("bilinear")
    assert all(best < 1.002 * error(wiener_method(other)) for other in others)


def test_sigma_of_own_weights_holds():
    scene = field(CLOSE, seed=2)
    scene = np.clip(cv2.GaussianBlur(scene, (0, 0), 0.7), 0.02, 1)
    mosaic, own = sampled(scene)
    variance = np.float32(1e-6 + 1e-4 * mosaic)
    noisy = mosaic + np.sqrt(variance) * np.random.default_rng(1).standard_normal(mosaic.shape)
    values, spread = made(noisy, BAYER, wiener_method(CLOSE), variance)
    pull = ((values - scene) / np.sqrt(spread))[8:-8, 8:-8]
    own = own[8:-8, 8:-8]
    assert pull[own].std() == pytest.approx(1, abs=0.02)
    assert 0.7 < pull[~own].std() < 1.05
    assert np.mean(np.abs(pull[~own]) < 1.96) > 0.94


def test_narrow_channels_are_correlated_by_their_distance():
    wavelengths = np.arange(400.0, 701.0, 1.0)
    narrow = np.stack([np.abs(wavelengths - at) < 0.5 for at in (450, 500, 650)], 1).astype(float)
    found = correlate_channels(wavelengths, narrow * [1.0, 2.0, 0.1])
    apart = np.abs(np.subtract.outer([450, 500, 650], [450, 500, 650])) / 10
    np.testing.assert_allclose(found, 0.9**apart, atol=1e-9)


def test_a_channel_that_sees_nothing_is_refused():
    with pytest.raises(CalibrationRefused, match="channel 2 is 0 at every wavelength"):
        correlate_channels(np.array([500.0, 510.0]), np.array([[1.0, 0.0], [1.0, 0.0]]))

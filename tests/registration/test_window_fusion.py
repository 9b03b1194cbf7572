import numpy as np
import pytest

from levkas.registration.local_shifts import WindowShifts
from levkas.registration.window_fusion import total_information

CELL, SIGMA = 16.0, 0.05


def observed(shift, sigma=SIGMA, said=SIGMA, columns=40, rows=30, seed=0):
    """Windows of one band that see `shift`, (n, 2) → (n, 2), with noise, and say that it is `said`."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    centres = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * CELL
    noisy = shift(centres) + sigma * rng.standard_normal(centres.shape)
    information = np.broadcast_to(np.eye(2) / said**2, (len(centres), 2, 2))
    n = len(centres)
    return [WindowShifts(centres, noisy, information, np.full(n, 0.9), np.zeros((1, 1)))]


def still(points):
    return np.zeros_like(points)


def test_knowledge_is_that_of_the_noise_whatever_windows_say_of_it():
    expected = 1200 * 2 / SIGMA**2
    assert total_information(observed(still)) == pytest.approx(expected, rel=0.1)
    assert total_information(observed(still, said=0.2 * SIGMA)) == pytest.approx(expected, rel=0.1)

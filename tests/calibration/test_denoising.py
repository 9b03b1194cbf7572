import numpy as np
import pytest

from levkas.calibration.denoising import Projecting, find_subspace
from levkas.calibration.templates import CalibrationRefused

BANDS, PARTS = 60, 5


def cubes(level=0.01, seed=0):
    """Return mixtures of five smooth spectra, without and with white noise."""
    rng = np.random.default_rng(seed)
    at = np.linspace(0, 1, BANDS)
    spectra = [np.exp(-(((at - c) / 0.15) ** 2)) + 0.1 for c in np.linspace(0, 1, PARTS)]
    clean = (rng.dirichlet(np.full(PARTS, 0.5), (40, 50)) @ np.array(spectra)).astype(np.float32)
    return clean, (clean + level * rng.standard_normal(clean.shape)).astype(np.float32)


def test_dimension_and_noise_come_back():
    _, noisy = cubes()
    found = find_subspace([noisy])
    assert found.k == PARTS
    # A band is predicted from others that are noisy too: a few percent too much.
    assert found.noise.mean() == pytest.approx(0.01, rel=0.1)
    np.testing.assert_allclose(found.basis.T @ found.basis, np.eye(PARTS), atol=1e-10)


def denoise(values, variance=None, lines=256):
    """Project a cube block by block, as a scan is."""
    starts = range(0, len(values), lines)
    made = Projecting(find_subspace(values[y : y + lines] for y in starts))
    parts = [
        made(values[y : y + lines], None if variance is None else variance[y : y + lines])
        for y in starts
    ]
    made.values = np.concatenate([part for part, _ in parts])
    made.variance = None if variance is None else np.concatenate([spread for _, spread in parts])
    return made


def test_denoising_brings_the_truth_nearer_and_takes_no_more_than_noise():
    clean, noisy = cubes()
    made = denoise(noisy)
    # Of 60 dimensions of noise 5 stay: √(60/5) = 3.46 at best.
    assert (noisy - clean).std() / (made.values - clean).std() > 3.2
    np.testing.assert_allclose(made.removed, made.subspace.noise, rtol=0.2)
    assert 0.9 < made.most < 1.5


def test_blocks_do_not_matter():
    _, noisy = cubes()
    whole, parts = denoise(noisy, lines=1000), denoise(noisy, lines=7)
    np.testing.assert_allclose(whole.values, parts.values, rtol=1e-6)


def test_binned_bands_are_refused():
    clean, noisy = cubes()
    noise = noisy - clean
    binned = clean + (noise + np.roll(noise, 1, 2)) / np.sqrt(2)
    with pytest.raises(CalibrationRefused) as refused:
        denoise(binned.astype(np.float32))
    assert refused.value.problems[0].code == "E_CORRELATED"
    with pytest.raises(CalibrationRefused):  # too few spectra
        find_subspace([noisy[:3]])


def test_unknown_spectra_come_back_unknown():
    _, noisy = cubes()
    noisy[5, 6, 7] = np.nan
    made = denoise(noisy)
    np.testing.assert_array_equal(made.values[5, 6], noisy[5, 6])
    assert np.isfinite(np.delete(made.values.reshape(-1, BANDS), 5 * 50 + 6, 0)).all()


def test_sigma_is_that_of_what_the_projection_keeps():
    clean, _ = cubes()
    level = np.linspace(0.005, 0.02, BANDS).astype(np.float32)
    noisy = clean + level * np.random.default_rng(3).standard_normal(clean.shape).astype("f4")
    made = denoise(noisy, np.broadcast_to(level**2, clean.shape))
    miss = (made.values - clean) / np.sqrt(made.variance)
    assert miss.std() == pytest.approx(1, abs=0.04)
    assert (miss.std((0, 1)) < 1.12).all()
    # Five of 60 dimensions stay: sigma of the raw spectra would be 3.4 times too large.
    assert np.median(level / np.sqrt(made.variance)) > 2.5


def test_sigma_holds_what_was_taken_from_a_rare_spectrum():
    clean, noisy = cubes()
    clean[3, 4, ::2] += 0.05
    clean[3, 4, 1::2] -= 0.05
    noisy[3, 4, ::2] += 0.05
    noisy[3, 4, 1::2] -= 0.05
    made = denoise(noisy, np.full(noisy.shape, 1e-4, np.float32))
    assert 4 < made.most < 6  # a saw of ±5 sigma in one spectrum of 2,000
    miss = (made.values - clean) / np.sqrt(made.variance)
    assert miss[3, 4].std() < 1.3
    assert np.sqrt(made.variance[3, 4]).mean() > 0.04 > 10 * np.sqrt(made.variance[5, 5]).mean()

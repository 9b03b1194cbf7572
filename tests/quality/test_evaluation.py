import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from levkas.geometry.transforms import Affine
from levkas.quality.evaluation.similarity import (
    position_errors,
    read_truth,
    structural_similarity,
    summarise_errors,
)
from levkas.readers.facts import UnreadableCapture


def textured(rng, shape=(64, 80)):
    return gaussian_filter(rng.standard_normal(shape), 1.5)


def test_an_error_of_one_native_pixel_is_half_a_reference_pixel_at_scale_two():
    points = np.array([[3.0, 4.0], [5.0, 1.0]])
    twice = Affine.scaling(2.0)
    assert np.allclose(position_errors(twice, points, twice(points) + np.array([1.0, 0.0])), 0.5)


def test_points_without_an_inverse_count_as_infinitely_wrong():
    summary = summarise_errors("550 nm", np.array([0.1, np.nan]), np.eye(2))
    assert summary.max == np.inf and summary.mean == np.inf
    assert np.isnan(summarise_errors("R", np.array([]), np.zeros((0, 2))).mean)


@pytest.mark.parametrize("reach", [0.0, 1.0])
def test_the_interval_of_a_mean_error_holds_the_mean_of_such_pictures(reach):
    """Errors that are alike over some px, and those that are not; pictures of 96 px, each with other errors about one mean."""
    rng, held = np.random.default_rng(4), 0
    places = np.stack(np.meshgrid(*2 * [np.arange(0.0, 96, 3)]), -1).reshape(-1, 2)
    for _ in range(400):
        field = gaussian_filter(rng.standard_normal((96, 96)), reach, mode="wrap")
        errors = 0.1 + 0.03 * field[::3, ::3].ravel() / field.std()
        found = summarise_errors("R", errors, places)
        held += abs(found.mean - 0.1) <= 2 * found.mean_u
    assert held / 400 == pytest.approx(0.945, abs=0.03)  # of 400 draws: 0.011 by chance


def test_ssim_of_an_image_with_itself_is_one_whatever_gain_and_bias():
    image = textured(np.random.default_rng(1))
    valid = np.ones(image.shape, bool)
    score, full = structural_similarity(image, 3 * image + 7, valid)
    assert score == pytest.approx(1.0, abs=1e-9) and full.shape == image.shape


def test_ssim_falls_when_the_image_is_shifted_and_ignores_what_is_not_valid():
    image = textured(np.random.default_rng(2))
    valid = np.ones(image.shape, bool)
    shifted, _ = structural_similarity(image, np.roll(image, 1, axis=1), valid)
    assert shifted < 0.9
    broken, half = image.copy(), valid.copy()
    broken[:, 60:], half[:, 50:] = 99.0, False
    score, full = structural_similarity(image, broken, half)
    assert score > 0.99 and np.isnan(full[:, 50:]).all()


@pytest.mark.parametrize("rows", [7, 64, 90])
def test_ssim_is_that_of_the_whole_picture_by_any_rows(monkeypatch, rows):
    from skimage.metrics import structural_similarity as ssim

    from levkas.quality.evaluation import similarity

    image = textured(np.random.default_rng(3))[:95]
    valid = np.ones(image.shape, bool)
    other = image + 0.3 * np.roll(image, 2, axis=0)
    alike = (other - other.mean()) * image.std() / other.std() + image.mean()
    both = np.percentile(np.stack([image, alike]), (0.1, 99.9))
    _, whole = ssim(image, alike, data_range=np.ptp(both), gaussian_weights=True, full=True)
    monkeypatch.setattr(similarity, "SSIM_ROWS", rows)
    score, full = structural_similarity(image, other, valid)
    np.testing.assert_allclose(full, whole, rtol=1e-5)
    assert score == pytest.approx(whole.mean(), abs=1e-6)


def test_truth_that_does_not_fit_its_description_is_refused(tmp_path):
    record = {"cameras": {"nir": {"bands": ["800 nm", "900 nm"]}}}
    (tmp_path / "truth.json").write_text(json.dumps(record))
    np.save(tmp_path / "icon_ref_px.npy", np.zeros((5, 2)))
    np.save(tmp_path / "icon_nir_px.npy", np.zeros((2, 5, 2)))
    with pytest.raises(UnreadableCapture, match="3 x 5 x 2"):
        read_truth(tmp_path, "icon", "nir")
    np.save(tmp_path / "icon_nir_px.npy", np.zeros((3, 5, 2)))
    assert list(read_truth(tmp_path, "icon", "nir").bands) == ["800 nm", "900 nm"]
    assert read_truth(tmp_path, "icon", "rgb") is None

import numpy as np
import pytest
from scipy import ndimage

from levkas.geometry.transforms import Affine, Composed, Homography, Lens
from levkas.registration.chromatic import fit_chromatic, zero_displacement
from levkas.registration.features import CameraFeatures
from levkas.registration.initial import find_initial_transform
from levkas.registration.local_shifts import (
    Predictor,
    WindowShifts,
    highpass,
    smoothing_warp,
)
from levkas.registration.model_selection import SelectionTerms, select_model
from levkas.registration.models import Observations
from levkas.registration.predictors import principal_components

RNG = np.random.default_rng


def texture(rng, shape=(150, 190), sigma=1.6):
    return ndimage.gaussian_filter(rng.standard_normal(shape), sigma).astype(np.float32)


def moved(image, shift):
    """See `image` at p + shift."""
    return smoothing_warp(
        image, Affine(np.array([[1, 0, shift[0]], [0, 1, shift[1]]], float)), image.shape
    )


def lattice(n=20, size=(400.0, 300.0)):
    x, y = np.meshgrid(np.linspace(0, size[0], n), np.linspace(0, size[1], n))
    return np.stack([x, y], -1).reshape(-1, 2)


def observed(truth, points, rng, noise=0.02, outliers=0.0):
    jacobian = truth.jacobian(points)
    errors = noise * rng.standard_normal(points.shape)
    wrong = rng.random(len(points)) < outliers
    errors[wrong] += rng.uniform(-3, 3, (int(wrong.sum()), 2))
    target = truth(points) + np.einsum("nab,nb->na", jacobian, errors)
    information = np.broadcast_to(np.eye(2) / noise**2, (len(points), 2, 2))
    return Observations(points, target, jacobian, information)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.45), (0.5, 0.5)])
def test_a_shift_between_weighted_sums_is_recovered_to_a_hundredth_of_a_pixel(shift):
    rng = RNG(1)
    layers = [texture(rng) for _ in range(3)]
    here = np.stack([highpass(moved(layer, (0, 0))) for layer in layers])
    mixed = -0.7 * layers[0] + 1.3 * layers[1] + 0.2 * layers[2]
    predictor = Predictor(here, cell=12)
    left = np.array(shift)
    for _ in range(3):  # the first step overshoots: central differences are shorter than slopes
        imaged = predictor.compare(highpass(moved(mixed, left)))
        left = left - np.median(imaged.shift[imaged.r2 > 0.5], 0)
    assert np.abs(left).max() < 0.01


def test_windows_of_a_masked_target_are_unusable_and_others_keep_their_answer():
    rng = RNG(2)
    layer = texture(rng)
    predictor = Predictor(highpass(moved(layer, (0, 0)))[None], cell=12)
    whole = highpass(moved(layer, (0.2, 0)))
    holed = whole.copy()
    holed[:, 95:] = np.nan
    a, b = predictor.compare(whole), predictor.compare(holed)
    far = a.centres[:, 0] < 70
    assert np.allclose(a.shift[far], b.shift[far])
    assert not b.information[a.centres[:, 0] > 125].any()


def test_ladder_takes_the_lens_for_a_lens_and_not_more_than_a_homography_for_an_affine():
    points = lattice(18)
    affine = Affine(np.array([[1.1, 0.02, 4], [-0.01, 1.09, 7]]))
    low = select_model(observed(affine, points, RNG(3)), SelectionTerms(spacing=60))
    assert low.name in ("similarity", "homography")
    plane = Homography(np.array([[1.2, 0.01, 3], [0.0, 1.21, 5], [3e-5, -2e-5, 1]]))
    lens = Composed(plane, Lens(np.array([240.0, 180]), 240.0, (0.02, -0.004)))
    high = select_model(observed(lens, points, RNG(4), outliers=0.1), SelectionTerms(spacing=60))
    error = np.linalg.norm(high.transform(points) - lens(points), axis=1)
    assert high.scores["homography+lens"] < high.scores["homography"] / 2
    assert error.mean() < 0.02


def test_sigma_of_the_jackknife_is_of_the_size_of_the_true_error():
    points = lattice(14)
    truth = Affine(np.array([[1.0, 0.02, 4], [-0.01, 1.0, 7]]))
    ratios = []
    for seed in range(5):
        selected = select_model(
            observed(truth, points, RNG(seed), noise=0.1), SelectionTerms(spacing=60)
        )
        error = np.linalg.norm(selected.transform(points) - truth(points), axis=1)
        ratios.append(np.sqrt((error**2).mean() / 2 / (selected.sigma(points) ** 2).mean()))
    assert 0.5 < np.median(ratios) < 2


def windows_of(field, points, rng, noise):
    shift = field(points) + noise * rng.standard_normal(points.shape)
    information = np.broadcast_to(np.eye(2) / noise**2, (len(points), 2, 2)).copy()
    return WindowShifts(points, shift, information, np.ones(len(points)), np.zeros((1, 1)))


def test_magnifications_of_bands_are_recovered_smoothly_and_a_blind_band_is_interpolated():
    rng, points = RNG(6), lattice()
    centre, spread = np.array([200.0, 150]), 200.0
    wavelengths = np.arange(450.0, 700, 25)
    truth = 0.002 * (wavelengths - 550) / 100
    imaged = [windows_of(lambda p, m=m: -m * (p - centre), points, rng, 0.05) for m in truth]
    imaged[2] = WindowShifts(
        points, imaged[2].shift, np.zeros((400, 2, 2)), imaged[2].r2, imaged[2].position_sensitivity
    )
    model = fit_chromatic(imaged, zero_displacement(10, centre, spread), wavelengths, fixed=4)
    for band, magnification in enumerate(truth):
        wanted = points + magnification * (points - centre)
        error = np.linalg.norm(model.transform(band)(points) - wanted, axis=1)
        assert error.mean() < (0.05 if band == 2 else 0.02), band
    assert np.allclose(model.transform(4)(points), points)


def test_key_points_find_mirrored_turned_and_inverted_pictures():
    rng = RNG(7)
    picture = texture(rng, (260, 320), 2.0) + 0.5 * texture(rng, (260, 320), 5.0)
    other = np.ascontiguousarray(-np.rot90(picture[:, ::-1]))
    found = find_initial_transform(CameraFeatures([picture]), CameraFeatures([other]))
    assert found is not None and found.mirrored
    # rot90 of the mirror: (x, y) → (y, x)
    points = lattice(6, (300.0, 240.0)) + 8
    assert np.linalg.norm(found.transform(points) - points[:, ::-1], axis=1).max() < 1.0


@pytest.mark.slow
def test_a_patchwork_whose_contrast_turns_here_and_there_is_found():
    """Patches of two pictures have nothing to do with one another; their edges lie alike."""
    rng = RNG(8)
    seeds, rows = rng.uniform(0, 1, (160, 2)) * (300, 400), np.mgrid[0:300, 0:400]
    near = np.argmin(((rows.reshape(2, -1, 1) - seeds.T[:, None]) ** 2).sum(0), 1).reshape(300, 400)
    pictures = []
    for _ in range(2):
        patches = rng.uniform(0.1, 0.9, 160)[near] + rng.normal(0, 0.01, near.shape)
        pictures.append(ndimage.gaussian_filter(patches, 1.0).astype(np.float32))
    turned = np.ascontiguousarray(np.rot90(pictures[1])[20:, :280])
    found = find_initial_transform(CameraFeatures([pictures[0]]), CameraFeatures([turned]))
    assert found is not None
    x, y = np.meshgrid(np.arange(40.0, 360, 40), np.arange(40.0, 260, 40))
    points = np.stack([x.ravel(), y.ravel()], 1)
    truth = np.stack([points[:, 1], 399 - points[:, 0] - 20], 1)
    assert np.median(np.linalg.norm(found.transform(points) - truth, axis=1)) < 2


def test_principal_images_are_the_same_bytes_for_any_number_of_threads(monkeypatch):
    rng = np.random.default_rng(3)
    stack = rng.uniform(0.2, 0.9, (33, 311, 419)).astype(np.float32)
    found = set()
    for count in ("1", "2", "3", "4"):
        monkeypatch.setenv("LEVKAS_THREADS", count)
        found.add(principal_components(stack).images.tobytes())
    assert len(found) == 1

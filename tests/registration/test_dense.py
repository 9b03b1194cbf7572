from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage, spatial

from levkas.geometry import from_dict
from levkas.geometry.spline import SplineShift
from levkas.geometry.transforms import Affine, Composed, Homography, Lens
from levkas.registration.bands import sqrt_transform
from levkas.registration.chromatic import fit_chromatic, zero_displacement
from levkas.registration.features import (
    CameraFeatures,
    ScaledFeatures,
    invert_descriptors,
    mirror_descriptors,
)
from levkas.registration.initial import find_initial_transform
from levkas.registration.local_shifts import (
    Predictor,
    WindowShifts,
    highpass,
    reduce,
    smoothing_warp,
)
from levkas.registration.model_selection import HOMOGRAPHY, MODELS, SelectionTerms, select_model
from levkas.registration.models import (
    Observations,
    fit_polynomial,
    fit_similarity,
    inflate_covariance,
    scale_covariance,
)
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


def test_warp_reproduces_a_ramp_and_reduce_keeps_its_place():
    x = np.mgrid[:60, :80][1].astype(np.float32)
    imaged = smoothing_warp(x, Affine(np.array([[1.0, 0, 3.3], [0, 1, 2.6]])), (40, 50))
    assert np.nanmax(np.abs(imaged - (x[:40, :50] + 3.3))) < 1e-5
    assert np.allclose(reduce(x, 4)[0, :3], [1.5, 5.5, 9.5])


def test_fits_are_exact_on_their_own_family():
    points, turn = lattice(), np.deg2rad(30)
    turned = 1.4 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    for linear in (turned, turned @ np.diag([-1.0, 1.0])):
        truth = Affine(np.column_stack([linear, [5.0, -3]]))
        imaged = observed(truth, points, RNG(0), noise=1e-9)
        assert np.allclose(fit_similarity(imaged)(points), truth(points), atol=1e-6)
        assert np.allclose(fit_polynomial(imaged, 2)(points), truth(points), atol=1e-6)


def test_ladder_takes_the_lens_for_a_lens_and_not_more_than_an_affine_for_an_affine():
    points = lattice(18)
    affine = Affine(np.array([[1.1, 0.02, 4], [-0.01, 1.09, 7]]))
    low = select_model(observed(affine, points, RNG(3)), SelectionTerms(spacing=60))
    assert list(MODELS).index(low.spec) <= list(MODELS).index(HOMOGRAPHY)
    plane = Homography(np.array([[1.2, 0.01, 3], [0.0, 1.21, 5], [3e-5, -2e-5, 1]]))
    lens = Composed(plane, Lens(np.array([240.0, 180]), 240.0, (0.02, -0.004)))
    high = select_model(observed(lens, points, RNG(4), outliers=0.1), SelectionTerms(spacing=60))
    error = np.linalg.norm(high.transform(points) - lens(points), axis=1)
    assert high.scores["homography+lens"] < high.scores["homography"] / 2
    assert error.mean() < 0.02


@pytest.mark.slow
def test_windows_that_share_pixels_do_not_vouch_for_a_richer_model():
    points, truth = lattice(18), Affine(np.array([[1.1, 0.02, 4], [-0.01, 1.09, 7]]))
    cell = float(np.ptp(np.unique(points[:, 0]))) / 17
    overfit, sound = 0, 0
    for seed in range(4):
        noise = RNG(seed).normal(0, 0.5, (20, 20, 2))
        tent = np.array([0.25, 0.5, 0.25])
        for axis in (0, 1):  # each window takes in its neighbours, as three cells across do
            noise = np.apply_along_axis(np.convolve, axis, noise, tent, "valid")
        imaged = observed(truth, points, RNG(seed), noise=0.01)
        imaged = replace(imaged, target=imaged.target + noise.reshape(-1, 2))
        rungs = list(MODELS)
        overfit += rungs.index(select_model(imaged, SelectionTerms(spacing=60)).spec.plain) > 2
        sound += (
            select_model(imaged, SelectionTerms(spacing=60, apart=2.01 * cell)).spec in rungs[:3]
        )
    assert overfit >= 2
    assert sound >= 3


def test_a_stiff_model_is_not_sure_where_another_might_as_well_be_right():
    points = lattice(12)
    truth = Homography(np.array([[1.1, 0.02, 4], [-0.01, 1.09, 7], [6e-6, -4e-6, 1]]))
    alone, among, wrong = [], [], []
    for seed in range(6):
        selected = select_model(
            observed(truth, points, RNG(seed), noise=1.5), SelectionTerms(spacing=60)
        )
        miss = selected.transform(points) - truth(points)
        wrong.append((miss**2).mean())
        alone.append((replace(selected, alternatives=()).sigma(points) ** 2).mean())
        among.append((selected.sigma(points) ** 2).mean())
    assert np.mean(among) > 1.1 * np.mean(alone)
    assert 0.3 < np.sqrt(np.mean(wrong) / np.mean(among)) < 1.8


def test_a_map_from_elsewhere_stands_where_windows_know_less():
    points, truth = lattice(6), Affine(np.array([[1.1, 0.02, 4], [-0.01, 1.09, 7]]))
    imaged = observed(truth, points, RNG(1), noise=2.0)
    assert (
        select_model(imaged, SelectionTerms(spacing=60, coarse=True), standing=truth).transform
        is truth
    )
    off = Affine(np.array([[1.1, 0.02, 14], [-0.01, 1.09, 7]]))
    assert (
        select_model(imaged, SelectionTerms(spacing=60, coarse=True), standing=off).transform
        is not off
    )


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


def test_common_variance_is_found_and_outliers_lose_their_weight():
    rng = RNG(5)
    residuals = 0.1 * rng.standard_normal((500, 2))
    residuals[:20] += 5
    information = np.broadcast_to(np.eye(2) * 1e6, (500, 2, 2))
    floored, weights = inflate_covariance(residuals, information)
    assert floored[0, 0, 0] == pytest.approx(100, rel=0.2)
    assert weights[:20].max() < 1e-3 < 0.3 < np.median(weights)


def test_sigmas_of_windows_are_scaled_or_floored_as_their_residuals_scatter():
    rng = RNG(15)
    sigmas = rng.choice([0.01, 0.1], 3000)
    information = np.eye(2) / sigmas[:, None, None] ** 2
    scaled, weights = scale_covariance(
        3 * sigmas[:, None] * rng.standard_normal((3000, 2)), information
    )
    assert np.sqrt(scaled[:, 0, 0]) * sigmas == pytest.approx(1 / 3, rel=0.15)
    assert 0.4 < np.median(weights) <= 1
    floored, _ = scale_covariance(
        np.hypot(sigmas, 0.05)[:, None] * rng.standard_normal((3000, 2)), information
    )
    assert floored[:, 0, 0] ** -0.5 == pytest.approx(np.hypot(sigmas, 0.05), rel=0.15)


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


def test_bands_that_predict_one_another_come_to_rest_though_one_is_mistaken():
    rng, points = RNG(16), lattice()
    centre, spread = np.array([200.0, 150]), 200.0
    near = np.abs(np.subtract.outer(np.arange(10), np.arange(10)))
    leaning = np.where(near == 1, 1.0, 0.0)  # what neighbours predict lies where they lie
    leaning /= leaning.sum(1, keepdims=True)
    truth = 0.0004 * (np.arange(10) - 5)
    bow = 0.02 * ((points[:, :1] - centre[0]) / spread) ** 2 * [1.0, 0.0]
    model, left = zero_displacement(10, centre, spread), np.zeros(1)
    for _ in range(8):
        placed = np.stack([model.transform(i)(points) - points for i in range(10)])
        away = placed - truth[:, None, None] * (points - centre)
        apart = away - np.einsum("ij,jna->ina", leaning, away)
        apart[0] += bow
        imaged = [windows_of(lambda p, a=a: a, points, rng, 0.01) for a in apart]
        wavelengths = np.linspace(450.0, 700, 10)
        model = fit_chromatic(imaged, model, wavelengths, fixed=5, sensitivity=leaning)
        placed = np.stack([model.transform(i)(points) - points for i in range(10)])
        left = placed - truth[:, None, None] * (points - centre)
    assert np.linalg.norm(left, axis=2).mean() < 0.04


def test_key_points_find_mirrored_turned_and_inverted_pictures():
    rng = RNG(7)
    picture = texture(rng, (260, 320), 2.0) + 0.5 * texture(rng, (260, 320), 5.0)
    other = np.ascontiguousarray(-np.rot90(picture[:, ::-1]))
    found = find_initial_transform(CameraFeatures([picture]), CameraFeatures([other]))
    assert found is not None and found.mirrored
    # rot90 of the mirror: (x, y) → (y, x)
    points = lattice(6, (300.0, 240.0)) + 8
    assert np.linalg.norm(found.transform(points) - points[:, ::-1], axis=1).max() < 1.0


def test_descriptor_permutations_are_involutions():
    d = RNG(8).random((3, 128)).astype(np.float32)
    assert np.array_equal(invert_descriptors(invert_descriptors(d)), d)
    assert np.array_equal(mirror_descriptors(mirror_descriptors(d)), d)


def test_edges_know_no_sign():
    picture = texture(RNG(3), (240, 320), 4.0)
    ours, theirs = (
        CameraFeatures([image]).at(1000)[ScaledFeatures.EDGES] for image in (picture, -picture)
    )
    assert len(ours.points) > 100
    near = spatial.cKDTree(theirs.points).query(ours.points)[0]
    assert (near < 0.01).mean() > 0.98


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


@pytest.mark.slow
def test_unrelated_pictures_have_no_start():
    rng = RNG(9)
    a, b = (texture(rng, (260, 320), 2.0) for _ in range(2))
    assert find_initial_transform(CameraFeatures([a]), CameraFeatures([b])) is None


def test_principal_images_span_their_bands_and_leanings_sum_to_one():
    rng = RNG(10)
    layers = [texture(rng) for _ in range(2)]
    weights = (0.0, 0.3, 0.6, 1.0)
    bands = [sqrt_transform(1 + (1 - t) * layers[0] + t * layers[1]) for t in weights]
    palette = principal_components(np.stack(bands)).high_passed()
    imaged = Predictor(palette.images, cell=12).compare(highpass(bands[1]))
    assert np.median(imaged.r2[imaged.r2 > 0]) > 0.99
    assert palette.position_sensitivity(imaged).sum() == pytest.approx(1)


def test_spline_shift_goes_there_and_back_and_is_stored():
    t = SplineShift(np.zeros(2), 40.0, RNG(11).normal(0, 0.5, (9, 11, 2)))
    points = lattice(9, (300.0, 220.0)) + 5
    assert np.allclose(t.inverse(t(points)), points, atol=1e-6)
    assert np.allclose(from_dict(t.to_dict())(points), t(points))
    step = 1e-5
    for axis in (0, 1):
        numeric = (t(points + step * np.eye(2)[axis]) - t(points)) / step
        assert np.allclose(t.jacobian(points)[:, :, axis], numeric, atol=1e-4)

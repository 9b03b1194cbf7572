import numba
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from levkas.cube import Flag
from levkas.transforms import Affine, Composed, Polynomial
from levkas.warping import Lattice, warp

RNG = np.random.default_rng(3)


def ramp(h, w):
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    return np.stack([x, y], -1)


def bent(size=100.0):
    points = np.stack(np.meshgrid(np.arange(0, size, 9), np.arange(0, size, 9)), -1).reshape(-1, 2)
    u, v = (points / size - 0.5).T
    return Polynomial.fit(
        points, points + np.stack([2 * u**2 + v, 1.5 * u * v - 3 * v**3], 1), order=3
    )


@pytest.mark.parametrize("scale", [0.3, 0.9, 1.0, 1.7, 2.8])
def test_a_ramp_stays_a_ramp_to_the_border_whatever_the_scale(scale):
    source = ramp(80, 90)
    transform = Composed(
        Affine(np.array([[0.98, 0.17, 0.3], [-0.17, 0.98, 14.2]])), Affine.scaling(scale)
    )
    shape = (30, 28)
    warped = warp(source, transform, shape)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    expected = transform(np.stack([x.ravel(), y.ravel()], 1).astype(float)).reshape(*shape, 2)
    seen = (warped.flags & Flag.OUTSIDE) == 0
    assert seen.mean() > 0.3
    assert np.abs(warped.values - expected)[seen].max() < 1e-4


def test_the_identity_changes_nothing():
    source = RNG.normal(size=(20, 30, 4)).astype(np.float32)
    assert np.array_equal(warp(source, Affine.identity(), (20, 30)).values, source)


def test_a_planted_shift_is_resampled_as_the_scene_would_be():
    scene = gaussian_filter(RNG.standard_normal((140, 150)), 3)
    shifted = warp(
        scene[..., None].astype(np.float32),
        Affine(np.array([[1.0, 0, 0.37], [0, 1, -0.21]])),
        (140, 150),
    )
    from scipy.ndimage import shift

    exact = shift(scene, (0.21, -0.37), order=5, mode="nearest")
    assert (
        np.abs(shifted.values[8:-8, 8:-8, 0] - exact[8:-8, 8:-8]).max() < 0.004 * scene.std() * 10
    )


def test_what_is_finer_than_the_grid_does_not_alias():
    y, x = np.mgrid[0:120, 0:120]
    checker = ((x + y) % 2).astype(np.float32)[..., None]
    coarse = warp(checker, Affine.scaling(3.0), (40, 40)).values
    assert np.abs(coarse[2:-2, 2:-2] - 0.5).max() < 0.02


def test_nothing_is_invented_outside_the_source():
    source = np.ones((10, 10, 1), np.float32)
    warped = warp(source, Affine(np.array([[1.0, 0, -3.0], [0, 1, 0]])), (10, 10))
    outside = (warped.flags[..., 0] & Flag.OUTSIDE) != 0
    assert outside[:, :3].all() and not outside[:, 3:].any()
    assert np.isnan(warped.values[outside]).all()


def test_flags_go_by_what_took_part():
    source, flags = np.ones((9, 9, 1), np.float32), np.zeros((9, 9, 1), np.uint8)
    flags[4, 4] = Flag.SATURATED
    same = warp(source, Affine.identity(), (9, 9), flags=flags).flags[..., 0]
    assert same[4, 4] & Flag.SATURATED and np.count_nonzero(same) == 1
    half = warp(source, Affine(np.array([[1.0, 0, 0.5], [0, 1, 0]])), (9, 8), flags=flags).flags[
        ..., 0
    ]
    assert half[4, 3] & Flag.NEAR and half[4, 3] & Flag.SATURATED and half[4, 0] == 0


def test_variance_is_the_sum_of_squared_weights():
    source, variance = np.zeros((60, 60, 1), np.float32), np.full((60, 60, 1), 4.0, np.float32)
    halfway = Affine(np.array([[1.0, 0, 0.5], [0, 1, 0]]))
    weights = np.array([-1, 9, 9, -1]) / 16
    warped = warp(source, halfway, (40, 40), variance=variance)
    assert warped.variance[20, 20, 0] == pytest.approx(4 * np.sum(weights**2), rel=1e-5)
    samples = RNG.normal(0, 2, (200, 200, 1)).astype(np.float32)
    coarse = warp(samples, Affine.scaling(2.5), (80, 80), variance=np.full_like(samples, 4.0))
    assert coarse.values[3:-3, 3:-3].var() == pytest.approx(
        coarse.variance[3:-3, 3:-3].mean(), rel=0.06
    )


def test_bands_with_maps_of_their_own_are_what_each_alone_would_be():
    source = RNG.normal(size=(50, 60, 3)).astype(np.float32)
    maps = [Affine(np.array([[1.0, 0, s], [0, 1, -s]])) for s in (0.2, 0.7, 1.3)]
    together = warp(source, maps, (48, 55)).values
    for b, transform in enumerate(maps):
        alone = warp(source[..., b : b + 1], transform, (48, 55)).values
        assert np.array_equal(together[..., b : b + 1], alone, equal_nan=True)


def test_the_number_of_threads_does_not_change_a_byte():
    source = RNG.normal(size=(90, 100, 2)).astype(np.float32)
    before = numba.get_num_threads()
    results = []
    for threads in (1, min(2, before)):
        numba.set_num_threads(threads)
        results.append(warp(source, bent(), (95, 95), variance=np.abs(source)))
    numba.set_num_threads(before)
    assert results[0].values.tobytes() == results[1].values.tobytes()
    assert results[0].variance.tobytes() == results[1].variance.tobytes()


def test_a_map_between_its_nodes_errs_less_than_a_ten_thousandth_of_a_pixel():
    assert Lattice.of(bent(), (100, 100)).error(bent(), (100, 100)) < 1e-4

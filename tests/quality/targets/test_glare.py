import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from levkas.core.cube import Flag
from levkas.quality.image_quality.dynamic_range import scene_ranges, sensor_stops
from levkas.quality.image_quality.glare import find_glare, mark_glare
from levkas.quality.image_quality.sharpness import band_sharpness, edge_blur


def painting(seed=1, shape=(60, 80, 3)):
    rng = np.random.default_rng(seed)
    blocks = rng.uniform(0.03, 0.85, (shape[0] // 10, shape[1] // 10, shape[2]))
    return np.kron(blocks, np.ones((10, 10, 1))).astype(np.float32)


def clear(values):
    return np.zeros(values.shape, np.uint8)


def test_paint_is_no_glare_and_not_lifted():
    paint = painting()
    assert not find_glare(paint, clear(paint)).mask.any()
    brighter = paint * np.float32(1.13)  # lamps at another angle: the Fresnel loss of varnish
    found = find_glare(brighter, clear(paint), other=(paint, clear(paint)))
    assert not found.mask.any() and not found.lifted.any()


def test_what_is_added_to_all_bands_is_lifted_and_what_follows_the_paint_is_not():
    paint = painting()
    shown = paint.copy()
    shown[10:30, 20:50] += 0.25
    shown[40:50, :, 0] += 0.25  # one band alone: no mirror does that
    found = find_glare(shown, clear(paint), other=(paint, clear(paint)))
    truth = np.zeros(paint.shape[:2], bool)
    truth[10:30, 20:50] = True
    np.testing.assert_array_equal(found.lifted, truth)
    assert not found.mask.any()  # paint is seen through it: 0.85 + 0.25 could be paint's


def test_a_saturated_glint_is_found_and_an_overexposed_shadow_is_not():
    paint = np.minimum(painting(), 0.5)
    flags = clear(paint)
    paint[20:26, 20:26], flags[20:26, 20:26] = 1.1, Flag.SATURATED
    flags[40:50, 40:50] = Flag.SATURATED
    found = find_glare(paint, flags)
    assert found.saturated[20:26, 20:26].all() and np.count_nonzero(found.mask) == 36


def test_brighter_than_paint_in_any_band_is_glare_beyond_the_noise():
    paint = np.full((1, 4, 3), 0.5, np.float32)
    paint[0, 1] = 1.3
    paint[0, 2] = (1.6, 0.9, 0.4)
    paint[0, 3] = 1.3
    sigma = np.zeros_like(paint)
    sigma[0, 3] = 0.05
    found = find_glare(paint, clear(paint), sigma)
    assert found.bright.tolist() == [[False, True, True, False]]


def test_bands_that_do_not_yet_lie_on_one_another_are_marked_each_by_itself():
    values = np.full((1, 2, 2), 0.4, np.float32)
    values[0, 0, 1] = 1.5
    flags = clear(values)
    flags[0, 1, 0], values[0, 1, 0] = Flag.SATURATED, 0.95
    mark_glare(values, flags)
    assert flags.tolist() == [[[0, Flag.GLARE], [Flag.SATURATED | Flag.GLARE, 0]]]


def test_range_of_a_scene_is_what_was_planted_and_noise_is_its_floor():
    rng = np.random.default_rng(2)
    values = np.exp2(rng.uniform(-7, 0, (200, 200, 1))).astype(np.float32)
    flags = clear(values)
    free = scene_ranges(values, flags, None, ["G"])[0]
    assert free.stops == pytest.approx(7, abs=0.05) and np.isnan(free.snr)
    noisy = scene_ranges(values, flags, np.full_like(values, 1 / 32), ["G"])[0]
    assert noisy.stops == pytest.approx(5, abs=0.05)
    assert noisy.noise == pytest.approx(1 / 32)
    flags[:20] = Flag.SATURATED
    assert scene_ranges(values, flags, None, ["G"])[0].clipped == pytest.approx(0.1)
    assert np.isnan(sensor_stops(100, 0.0))


@pytest.mark.parametrize("blur", [0.8, 1.5, 3.0])
def test_blur_of_edges_is_what_was_planted_whatever_the_contrast(blur):
    rng = np.random.default_rng(3)
    scene = gaussian_filter(np.kron(rng.random((20, 20)), np.ones((24, 24))), blur)
    # A pixel's own width adds a twelfth to the square.
    true = np.sqrt(blur**2 + 1 / 12)
    for contrast in (1.0, 0.1):
        found, edges = edge_blur(0.3 + contrast * scene)
        assert edges >= 50 and found == pytest.approx(true, rel=0.1)


def test_the_band_out_of_focus_is_the_softest_and_noise_has_no_focus():
    rng = np.random.default_rng(4)
    scene = np.kron(rng.random((16, 16)), np.ones((24, 24)))
    stack = np.stack(
        [gaussian_filter(scene, s) for s in (0.8, 2.0)] + [rng.random(scene.shape)], -1
    )
    sharp, soft, noise = band_sharpness(stack, ["550 nm", "410 nm", "noise"])
    assert soft.blur_px > 2 * sharp.blur_px and np.isnan(noise.blur_px)


@pytest.mark.parametrize("blur", [0.45, 1.5])
def test_thin_lines_do_not_look_sharper_than_the_lens(blur):
    rng, fine = np.random.default_rng(6), 4
    size = 384 * fine
    scene = np.kron(rng.random((8, 8)), np.ones((size // 8, size // 8)))
    y, x = np.mgrid[:size, :size]
    for k in range(40):
        turn, (a, b) = rng.random() * np.pi, rng.random(2) * size
        off = np.abs((x - a) * np.cos(turn) + (y - b) * np.sin(turn))
        scene[off < 3] += 0.4 * (-1) ** k
    observed = gaussian_filter(scene, blur * fine)
    observed = observed.reshape(384, fine, 384, fine).mean((1, 3))
    found, edges = edge_blur(observed)
    # Without the choice of steps the sharpest one came out at the floor, 0.25 px.
    assert edges >= 50 and found == pytest.approx(np.sqrt(blur**2 + 1 / 12), abs=0.25)

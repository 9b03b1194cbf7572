"""Displacement finer than a check window: patches and ripples that frames and scans show, and pictures that agree."""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from levkas.geometry.transforms import Affine
from levkas.registration import register
from levkas.registration.fine_displacement import measure_fine_displacement
from levkas.registration.local_shifts import highpass
from levkas.registration.verdict_rules import agrees_within_windows, describe_blindness

MARGIN = 60  # of the painting about the reference, as in conftest
PLACE = Affine(np.array([[1.0, -0.01, 4.0], [0.01, 1.0, 3.0]]))
X, Y = np.meshgrid(np.arange(310.0), np.arange(240.0))


@pytest.fixture(scope="module")
def painting(studio):
    return studio.paint(43)


@pytest.fixture(scope="module")
def front(studio, painting):
    return studio.photograph(painting, Affine.identity(), seed=1)


def observed(painting, shift=(0.0, 0.0), *, noise=0.004, seed=2, curve=1.0):
    """Return what a camera sees whose every px is off by `shift`, two (240, 310) px."""
    places = PLACE.inverse(np.stack([(X + shift[0]).ravel(), (Y + shift[1]).ravel()], 1)) + MARGIN
    values = ndimage.map_coordinates(painting, places.T[::-1], order=3, mode="nearest")
    values = np.clip(values.reshape(X.shape), 0.01, None) ** curve
    return (values + np.random.default_rng(seed).normal(0, noise, X.shape)).astype(np.float32)


def measured(front, picture):
    return measure_fine_displacement(highpass(front)[None], picture, PLACE)


def objection(found):
    return agrees_within_windows({"fine_displacement": found.to_dict()})


def patch(x, y, side):
    return ((np.abs(X - x) < side / 2) & (np.abs(Y - y) < side / 2)).astype(float)


@pytest.mark.parametrize(("side", "shift"), [(44, (2.0, 0.0)), (36, (0.0, -3.0)), (60, (1.2, 1.2))])
def test_a_patch_that_moved_is_named_with_place_and_size(painting, front, side, shift):
    moved = patch(200, 100, side)
    found = measured(front, observed(painting, (shift[0] * moved, shift[1] * moved)))
    assert found.size == pytest.approx(np.hypot(*shift), rel=0.15)
    x, y, width, height = found.box
    home = PLACE.inverse(np.array([[200.0, 100.0]]))[0]
    assert np.abs(np.array([x + width / 2, y + height / 2]) - home).max() < 8
    assert max(abs(width - side), abs(height - side)) <= 12
    assert objection(found).decision == "warn"
    assert (
        "lies" in objection(found).reason and "px beside the map (x, y" in objection(found).reason
    )
    # The patch is no displacement of the whole picture.
    assert found.rms < 0.1


@pytest.mark.parametrize(("size", "period"), [(1.0, 25), (0.6, 40), (0.7, 32)])
def test_a_ripple_in_x_and_y_is_found_with_its_period(painting, front, size, period):
    wave = size * np.sin(2 * np.pi * X / period) * np.sin(2 * np.pi * Y / period)
    found = measured(front, observed(painting, (wave, 0.3 * wave)))
    # Windows of 18 px show a part of it, so that the size is a least one.
    assert 0.18 * size < found.rms < 0.6 * size
    assert found.period == pytest.approx((period, period), rel=0.08)
    assert objection(found).decision == "warn" and "px in x and" in objection(found).reason


def test_where_pictures_agree_nothing_is_found(painting, front):
    for seed, (noise, curve) in enumerate(
        [(0.004, 1.0), (0.03, 1.0), (0.06, 1.0), (0.01, 0.5), (0.01, 2.0)]
    ):
        found = measured(front, observed(painting, noise=noise, seed=seed, curve=curve))
        assert (found.rms or 0.0) < 0.05 and found.sigma == 0.0
        assert objection(found) is None


def test_the_noise_of_a_coarse_camera_is_no_displacement(painting, front):
    """Averaged over more than a px of its own, its noise would be alike in neighbours, and look like detail that moved."""
    place = Affine(np.array([[0.3, 0.0, 0.2], [0.0, 0.3, 0.1]]))
    x, y = np.meshgrid(np.arange(90.0), np.arange(69.0))
    places = place.inverse(np.stack([x.ravel(), y.ravel()], 1)) + MARGIN
    soft = cv2.GaussianBlur(painting, (0, 0), 1.5)
    values = ndimage.map_coordinates(soft, places.T[::-1], order=3).reshape(x.shape)
    known = highpass(front[1::3, 1::3][:76])[None]
    for noise in (0.01, 0.04):
        noisy = values + np.random.default_rng(5).normal(0, noise, x.shape)
        found = measure_fine_displacement(known, noisy.astype(np.float32), place, step=3)
        assert found is None or objection(found) is None


def test_unlike_pigments_stains_and_noise_move_nothing(painting, front):
    rng = np.random.default_rng(6)
    stains = cv2.GaussianBlur(rng.normal(0, 1, X.shape), (0, 0), 2.5)
    picture = observed(painting)
    stained = picture + (0.6 * stains / stains.std() * picture.std()).astype(np.float32)
    other = np.where(patch(90, 90, 70) > 0, 0.9 - picture, picture)
    for one in (stained, other.astype(np.float32)):
        assert objection(measured(front, one)) is None


@pytest.mark.parametrize(("shade", "groove"), [(0.02, 0.05), (0.05, 0.1)])
@pytest.mark.parametrize("angle", [90, 120])
def test_grooves_lit_from_another_side_are_not_displaced(studio, painting, shade, groove, angle):
    """Walls of grooves are bright on the side of the lamp: beside where they are bright by another, without having moved."""
    grain = cv2.GaussianBlur(np.random.default_rng(3).normal(0, 1, painting.shape), (0, 0), 1.5)
    depth = -np.abs(grain / grain.std())
    slope = np.stack(np.gradient(depth)[::-1])
    y, x = np.mgrid[: painting.shape[0], : painting.shape[1]]
    gilded = (np.abs(x - 170) < 30) & (np.abs(y - 170) < 30)

    def lit_from(degrees):
        lamp = np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])
        shading = np.tensordot(lamp, slope, 1) / slope.std()
        return painting + gilded * (groove * depth + shade * shading)

    front = studio.photograph(lit_from(0), Affine.identity(), seed=1)
    assert objection(measured(front, observed(lit_from(angle)))) is None


def test_a_smooth_error_of_the_map_is_not_finer_than_a_window(painting, front):
    bend = 0.4 * np.sin(2 * np.pi * X / 300)
    assert measured(front, observed(painting, (bend, 0 * bend))).rms < 0.1


def test_pictures_without_fine_detail_say_what_would_have_been_found(painting, front):
    soft = [cv2.GaussianBlur(one, (0, 0), 4.0) for one in (front, observed(painting, noise=0.0))]
    noisy = [
        one + np.random.default_rng(k).normal(0, 0.01, one.shape).astype(np.float32)
        for k, one in enumerate(soft)
    ]
    found = measured(*noisy)
    assert found.least is None or found.least > 0.75
    assert "would" in describe_blindness({"fine_displacement": found.to_dict()})
    sharp = measured(front, observed(painting))
    assert sharp.least < 0.3 and describe_blindness({"fine_displacement": sharp.to_dict()}) == ""


def test_pictures_too_small_or_empty_show_nothing(front):
    assert measure_fine_displacement(highpass(front)[None, :12], front, PLACE) is None
    assert measured(front, np.full_like(front, np.nan)) is None


def test_a_map_beside_which_a_patch_lies_is_doubtful(painting, front):
    moved = patch(200, 100, 44)
    found = register(front, observed(painting, (2.0 * moved, 0 * moved)))
    assert found.verdict.decision == "warn"
    assert "A part smaller than the check windows lies " in " ".join(found.verdict.reasons)
    assert "flicker" in found.verdict.next_step
    numbers = found.verdict.numbers["sensor"]["verification"]["fine_displacement"]
    assert numbers["size_px"] == pytest.approx(2.0, rel=0.15)


def test_sigma_holds_a_ripple(painting, front):
    wave = np.sin(2 * np.pi * X / 30) * np.sin(2 * np.pi * Y / 30)
    found = register(front, observed(painting, (wave, wave)))
    assert found.verdict.decision == "warn" and "30 px in x" in " ".join(found.verdict.reasons)
    assert found.sigma["1"].values.min() > 0.2

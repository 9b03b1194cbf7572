"""Maps of one scan: weak pictures whose signal is gathered, and that share one map far coarser than the photograph."""

import numpy as np
import pytest
from scipy import ndimage

from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.bands import sqrt_images
from levkas.registration.features import CameraFeatures, grey_pictures
from levkas.registration.initial import find_coarse_transform
from levkas.registration.map_stack import gather_signal

COARSE = 8
TURN = np.deg2rad(2.0)
LINEAR = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]]) / COARSE
SHIFT = np.array([4.3, -2.2])


def pigments(seed, shape):
    """Four pigments in patches with ragged rims, (4, h, w) of 0 and 1."""
    rng = np.random.default_rng(seed)
    fields = [
        sum(ndimage.gaussian_filter(rng.normal(size=shape), s) * s for s in (7, 20, 50))
        for _ in range(4)
    ]
    return np.stack(fields).argmax(0) == np.arange(4)[:, None, None]


def photograph(paint, seed):
    tones = np.array([0.75, 0.45, 0.25, 0.08])[:, None, None]
    grain = np.random.default_rng(seed).normal(0, 0.03, paint.shape[1:])
    return BandImage.of("G", (tones * paint).sum(0) * (1 + grain))


def scan(paint, seed, counts, size=(112, 88)):
    """Maps of three of the pigments and three of nothing; every other line is a third of a px aside."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(*(np.arange(n, dtype=float) for n in size))
    places = np.stack([x + np.where(y % 2, 1, -1) / 6, y], -1) - SHIFT
    column, row = np.moveaxis(places @ np.linalg.inv(LINEAR).T, -1, 0)
    maps = []
    for name, layer in zip(("Pb", "Hg", "Cu"), paint[:3].astype(float), strict=True):
        soft = ndimage.gaussian_filter(layer, 0.4 * COARSE)
        share = ndimage.map_coordinates(soft, [row, column], order=1, mode="nearest")
        maps.append(BandImage.of(name, rng.poisson(counts * (0.2 + share)).astype(np.float32)))
    for name in ("Ar", "Ti", "Zn"):
        maps.append(BandImage.of(name, rng.poisson(0.2 * counts, x.shape).astype(np.float32)))
    return maps


@pytest.fixture(scope="module")
def painting():
    return pigments(3, (720, 900))


def test_signal_is_gathered_in_as_few_pictures_as_there_are_pigments(painting):
    maps = scan(painting, 1, 12.0)
    gathered = gather_signal(maps)
    assert 2 <= len(gathered) <= 3
    again = gather_signal(maps[::-1])
    for one, other in zip(gathered, again, strict=True):
        assert abs(np.corrcoef(one.values.ravel(), other.values.ravel())[0, 1]) > 0.999


def test_key_points_and_large_blocks_start_maps_right_to_a_px_in_all_corners(painting):
    maps = scan(painting, 1, 25.0)
    ours, theirs = (
        CameraFeatures(grey_pictures(list(sqrt_images(bands).values())))
        for bands in ([photograph(painting, 5)], gather_signal(maps))
    )
    begun = find_coarse_transform(ours, theirs)
    corners = np.array([[60.0, 60.0], [840.0, 60.0], [840.0, 660.0], [60.0, 660.0]])
    errors = begun.transform(corners) - corners @ LINEAR.T - SHIFT
    # The homography of the key points alone is 3 px off in one corner.
    assert not begun.by_outlines and np.abs(errors).max() < 0.6


@pytest.mark.slow
def test_a_stack_of_weak_maps_at_an_eighth_of_the_sampling_is_registered(painting):
    maps = scan(painting, 1, 12.0)
    found = register([photograph(painting, 5)], maps, reference_band="G", one_scan=True)
    x, y = np.meshgrid(np.linspace(60, 840, 14), np.linspace(60, 660, 11))
    points = np.stack([x.ravel(), y.ravel()], 1)
    errors = np.linalg.norm(found.transforms["Pb"](points) - points @ LINEAR.T - SHIFT, axis=1)
    assert errors.mean() < 0.3 and found.verdict.decision != "refuse"
    assert all(found.transforms[one.label] is found.transforms["Pb"] for one in maps)


@pytest.mark.slow
def test_a_scan_of_another_painting_is_refused(painting):
    maps = scan(pigments(8, (720, 900)), 1, 40.0)
    try:
        found = register([photograph(painting, 5)], maps, reference_band="G", one_scan=True)
    except RegistrationRefused:
        return
    assert found.verdict.decision == "refuse"

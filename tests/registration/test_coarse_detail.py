"""Relief whose shading moves with the light: fine and coarse detail disagree, the reason says so and sigma holds it."""

import numpy as np
import pytest
from scipy import ndimage

from levkas.geometry.transforms import Affine
from levkas.registration import BandImage, register
from levkas.registration.coarse_detail import (
    CoarseShift,
    describe_coarse_detail,
    hold_coarse_detail,
    mean_shift,
)
from levkas.registration.local_shifts import WindowShifts
from levkas.registration.record import Sigma
from levkas.registration.verdict_rules import coarse_detail_agrees

WIDTH, HEIGHT = 560, 450
PLACE = Affine(np.array([[1.15, -0.02, 6.0], [0.02, 1.15, 3.0]]))
REFERENCE = {450: (0.7, 0.2, 0.1), 530: (0.3, 0.6, 0.1), 610: (0.1, 0.5, 0.4), 690: (0.1, 0.2, 0.7)}
TARGET = {470: (0.2, 0.3, 0.5), 630: (0.6, 0.3, 0.1)}


def lamp(elevation, azimuth):
    """Return the direction of a lamp, degrees from the normal and from x towards y."""
    e, a = np.radians((elevation, azimuth))
    return np.array([np.sin(e) * np.cos(a), np.sin(e) * np.sin(a), np.cos(e)])


def shading(relief, lamps):
    """Return the light on a surface of heights `relief`, px, over that on a flat one: Lambert's law."""
    down, across = np.gradient(relief)
    normal = np.sqrt(1 + down**2 + across**2)
    lights = [
        np.maximum(at[2] - at[0] * across - at[1] * down, 0) / (normal * at[2]) for at in lamps
    ]
    return np.mean(lights, axis=0)


def pair(depth):
    """Return the bands of a reference and of another camera: patches of paint, raised gold lines `depth` px high."""
    rng = np.random.default_rng(3)

    def grain(sigma):
        field = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), sigma)
        return field / field.std()

    patches = [
        0.35 + 0.1 * np.sign(grain(12)) + 0.06 * np.sign(grain(7)) + 0.03 * grain(2)
        for _ in range(3)
    ]
    lines = ndimage.gaussian_filter((np.abs(grain(5)) < 0.12).astype(float), 1.0)
    paint = [ndimage.gaussian_filter(p, 0.8) + 0.14 * lines for p in patches]
    above, one = (lamp(70, 0), lamp(70, 180)), (lamp(45, 90),)
    x, y = np.meshgrid(np.arange(630.0), np.arange(500.0))
    places = PLACE.inverse(np.stack([x.ravel(), y.ravel()], 1)).T[::-1]

    def seen(mix, lamps):
        light = np.tensordot(mix, paint, 1) * shading(depth * lines, lamps)
        return ndimage.gaussian_filter(light, 0.5)

    def band(nm, values):
        values = values + rng.normal(0, 0.004, values.shape)
        return BandImage.of(f"{nm} nm", values.astype("f4"), nm)

    theirs = {
        nm: ndimage.map_coordinates(seen(mix, one), places, order=3, mode="nearest")
        for nm, mix in TARGET.items()
    }
    return (
        [band(nm, seen(mix, above)) for nm, mix in REFERENCE.items()],
        [band(nm, values.reshape(x.shape)) for nm, values in theirs.items()],
    )


def registered(depth):
    """Return the registration, and the root mean square error over sigma of each band."""
    reference, target = pair(depth)
    found = register(reference, target, reference_band="530 nm")
    x, y = np.meshgrid(np.linspace(30, WIDTH - 30, 9), np.linspace(30, HEIGHT - 30, 7))
    points = np.stack([x.ravel(), y.ravel()], 1)
    ratios = []
    for label, transform in found.transforms.items():
        error = (transform(points) - PLACE(points)) / PLACE.matrix[0, 0]
        variance = found.sigma[label](points) ** 2
        ratios.append(float(np.sqrt(np.mean(np.square(error).sum(1) / 2 / variance))))
    return found, ratios


@pytest.mark.slow
def test_relief_under_another_light_is_reported_and_held_by_sigma():
    found, ratios = registered(0.15)
    assert found.verdict.decision == "accept"
    assert any("Fine and coarse detail of" in reason for reason in found.verdict.reasons)
    assert min(ratios) > 0.6 and max(ratios) < 1.4


@pytest.mark.slow
def test_a_flat_surface_under_another_light_is_not():
    found, ratios = registered(0.0)
    assert not any("coarse detail" in reason for reason in found.verdict.reasons)
    assert max(ratios) < 1.4


def lattice(shift, *, noise, columns=15, rows=12):
    """Return windows of the mean `shift` whose shifts scatter by `noise`, px, as their information has it."""
    x, y = np.meshgrid(np.arange(columns) * 48.0, np.arange(rows) * 48.0)
    rng = np.random.default_rng(4)
    # Each window is the mean of the three by three cells about it.
    cells = rng.normal(0, 3 * noise, (rows + 2, columns + 2, 2))
    shifts = ndimage.uniform_filter(cells, (3, 3, 1))[1:-1, 1:-1].reshape(-1, 2) + shift
    n = rows * columns
    information = np.tile(np.eye(2) / noise**2, (n, 1, 1))
    return WindowShifts(
        np.stack([x.ravel(), y.ravel()], 1), shifts, information, np.ones(n), np.eye(1)
    )


def test_deviations_count_the_scatter_of_windows_and_the_sigma_of_the_map():
    still, moved = (mean_shift(lattice(s, noise=0.03), 0.003) for s in (0.0, (0.0, 0.1)))
    assert still.deviations < 3 and moved.deviations > 6
    assert moved.px == pytest.approx(0.1, abs=0.02)
    assert mean_shift(lattice((0.0, 0.1), noise=0.03), 0.1).deviations < 1.2


def test_of_few_windows_nothing_is_concluded():
    assert mean_shift(lattice((0.0, 0.5), noise=0.03, columns=6, rows=6), 0.003) is None


def test_bands_that_are_off_hold_it_and_those_beside_them_that_were_not_measured():
    flat, labels = (
        Sigma(np.arange(2.0), np.arange(2.0), np.full((2, 2), 0.01)),
        ["a", "b", "c", "d"],
    )
    shifts = {"a": CoarseShift(0.1, 9.0), "c": CoarseShift(0.3, 2.0), "d": CoarseShift(0.01, 9.0)}
    apart = describe_coarse_detail(shifts, labels, 1)
    held = hold_coarse_detail(dict.fromkeys(labels, flat), apart)
    assert apart["bands"] == ["a"]
    assert [held[label].values[0, 0] > 0.1 for label in labels] == [True, True, False, False]
    assert hold_coarse_detail({"a": flat}, None) == {"a": flat}


def test_many_bands_are_named_by_their_range():
    few = coarse_detail_agrees({"coarse_detail": {"bands": ["R", "G"], "px": 0.051}})
    many = coarse_detail_agrees(
        {"coarse_detail": {"bands": [f"{n} nm" for n in range(9)], "px": 1.0}}
    )
    assert few.decision == "unchecked" and "of R and G lie 0.05 px apart" in few.reason
    assert "of 9 bands (0 nm to 8 nm)" in many.reason
    assert coarse_detail_agrees({"coarse_detail": None}) is None

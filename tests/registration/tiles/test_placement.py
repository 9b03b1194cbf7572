"""Tiles cut from one texture by known maps, placed again."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from levkas.geometry.transforms import Composed, Homography, Inverse, Lens
from levkas.registration import BandImage, RegistrationRefused
from levkas.registration.manual_points import ManualPoints
from levkas.registration.tiles import place_tiles

SIZE, STEP = (200, 160), (150, 120)
GRID = np.stack(np.meshgrid(np.linspace(0, 199, 5), np.linspace(0, 159, 5)), -1).reshape(-1, 2)


def texture(seed, shape=(320, 400)):
    rng = np.random.default_rng(seed)
    parts = [gaussian_filter(rng.normal(size=shape), s) * s**1.3 for s in (1.2, 2.5, 6, 15)]
    values = sum(parts)
    return 0.5 + 0.12 * values / values.std()


def cut(scene, corner, rng, lens):
    turn = rng.normal() * 0.01
    middle = (np.array(SIZE) - 1) / 2
    matrix = np.eye(3)
    matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    matrix[:2, 2] = corner + middle
    away = np.eye(3)
    away[:2, 2] = -middle
    onto = Composed(Inverse(lens), Homography(matrix @ away))
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    places = onto(np.stack([x.ravel(), y.ravel()], 1).astype(float))
    values = map_coordinates(spline_filter(scene), places.T[::-1], order=3, prefilter=False)
    values = values.reshape(SIZE[::-1]) + rng.normal(size=SIZE[::-1]) * 0.005
    return BandImage.of("1", values.astype(np.float32)), onto


@pytest.fixture(scope="module")
def mosaic():
    rng, scene = np.random.default_rng(7), texture(1)
    lens = Lens((np.array(SIZE) - 1) / 2, 100.0, (0.008, 0.0))
    tiles, truth, corners = {}, {}, {}
    for row in range(2):
        for column in range(2):
            name = f"r{row}c{column}"
            corners[name] = (20 + STEP[0] * column, 20 + STEP[1] * row)
            tiles[name], truth[name] = cut(
                scene, np.array(corners[name]) + rng.normal(size=2) * 4, rng, lens
            )
    return tiles, truth, corners


@pytest.fixture(scope="module")
def placed(mosaic):
    tiles, _truth, _ = mosaic
    foreign, _ = cut(texture(2), (100, 100), np.random.default_rng(0), Lens(np.zeros(2), 100.0))
    return place_tiles({**tiles, "stranger": foreign, "twin": tiles["r0c1"]})


def errors(placement, truth):
    ours = np.concatenate([placement.transforms[name](GRID) for name in sorted(truth)])
    theirs = np.concatenate([truth[name](GRID) for name in sorted(truth)])
    return np.linalg.norm(Homography.fit(ours, theirs)(ours) - theirs, axis=1)


def test_tiles_lie_where_they_were_cut(mosaic, placed):
    _, truth, _ = mosaic
    off = errors(placed, truth)
    assert off.mean() < 0.25  # tiles of 200 px; most of it bends all of them
    assert off.max() < 0.4
    assert placed.rms < 0.05


def test_what_does_not_belong_is_left_out_with_its_reason(placed):
    assert set(placed.left_out) == {"stranger", "twin"}
    assert "r0c1" in placed.left_out["twin"]
    assert "nothing" in placed.left_out["stranger"]
    assert (
        set(placed.transforms) == set(placed.sigma) == {f"r{r}c{c}" for r in (0, 1) for c in (0, 1)}
    )


@pytest.mark.slow
def test_pairs_by_hand_place_a_tile_that_key_points_do_not(mosaic):
    tiles, truth, _ = mosaic
    rng, clear = np.random.default_rng(4), tiles["r1c1"].values
    blurred = gaussian_filter(clear, 4) + rng.normal(size=clear.shape).astype(np.float32) * 0.01
    some = {**tiles, "r1c1": BandImage.of("1", blurred)}
    places = np.array([[160.0, 12.0], [192.0, 30.0], [170.0, 90.0], [195.0, 140.0], [158.0, 120.0]])
    there = truth["r1c1"].inverse(truth["r1c0"](places)) + rng.normal(size=(5, 2)) * 0.7
    pairs = np.hstack([places, there])
    assert set(place_tiles(some).left_out) == {"r1c1"}
    started = place_tiles(some, by_hand={("r1c0", "r1c1"): ManualPoints(added=pairs)})
    assert started.left_out == {} and errors(started, truth).max() < 0.6
    plain = BandImage.of("1", 0.4 + rng.normal(size=clear.shape).astype(np.float32) * 0.01)
    by_hand = {("r1c1", "r1c0"): ManualPoints(added=pairs[:, [2, 3, 0, 1]])}
    assert set(place_tiles({**tiles, "r1c1": plain}, by_hand=by_hand).left_out) == {"r1c1"}


def test_a_tile_without_detail_lies_where_its_position_says(mosaic):
    tiles, truth, corners = mosaic
    plain = BandImage.of(
        "1", (0.5 + 0.005 * np.random.default_rng(3).normal(size=SIZE[::-1])).astype(np.float32)
    )
    placed = place_tiles({**tiles, "r1c1": plain}, starts=corners)
    assert set(placed.by_position) == {"r1c1"}
    others = {name: one for name, one in truth.items() if name != "r1c1"}
    middle = np.array([[99.5, 79.5]])
    ours = np.concatenate([placed.transforms[name](middle) for name in sorted(truth)])
    theirs = np.concatenate([truth[name](middle) for name in sorted(truth)])
    at = sorted(truth).index("r1c1")
    fit = Homography.fit(
        np.concatenate([placed.transforms[name](GRID) for name in sorted(others)]),
        np.concatenate([others[name](GRID) for name in sorted(others)]),
    )
    off = np.hypot(*(fit(ours[at : at + 1]) - theirs[at])[0])
    assert off < 4 * placed.sigma["r1c1"]
    assert placed.sigma["r1c1"] > 5 * placed.sigma["r0c1"]


def test_a_repeated_ornament_is_placed_by_positions_and_by_nothing_else():
    cell = texture(5, (60, 60))
    rng, lens = np.random.default_rng(1), Lens(np.zeros(2), 100.0)
    cell[:30] = cell[:30, ::-1]
    scene = np.tile(cell, (8, 11))
    corners = {"a": (20, 20), "b": (150, 20)}
    tiles = {name: cut(scene, np.array(corner), rng, lens)[0] for name, corner in corners.items()}
    with pytest.raises(RegistrationRefused, match="no two tiles overlap"):
        place_tiles(tiles)
    placed = place_tiles(tiles, starts=corners)
    apart = placed.transforms["b"](GRID[12:13]) - placed.transforms["a"](GRID[12:13])
    assert np.abs(apart - (130, 0)).max() < 6  # tiles are turned a little; a period is 60


def test_more_than_two_hundred_tiles_are_refused(mosaic):
    tiles, _, _ = mosaic
    with pytest.raises(RegistrationRefused) as refused:
        place_tiles(dict.fromkeys(map(str, range(201)), tiles["r0c0"]))
    (problem,) = refused.value.problems
    assert (problem.code, problem.field) == ("E_TILES", "tiles")

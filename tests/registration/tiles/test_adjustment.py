"""One adjustment of all tiles, on observations without pictures; truth is made by matrices of its own."""

from itertools import combinations

import numpy as np
import pytest

from levkas.registration.tiles.adjustment import SHARED, TileMaps, Windows, adjust, choose_lens
from levkas.registration.tiles.placement import consistent_pairs
from levkas.registration.tiles.search import similarity

SIZE = (400, 300)


def grid_pairs(rows, columns):
    index = np.arange(rows * columns).reshape(rows, columns)
    across = np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1)
    down = np.stack([index[:-1].ravel(), index[1:].ravel()], 1)
    return np.concatenate([across, down])


def planted(rows, columns, rng, *, noise, k1=0.01, many=20):
    """Windows of tiles seen through one lens: plane → tile by a homography, then radial distortion about the middle."""
    middle, reach = (np.array(SIZE) - 1) / 2, SIZE[0] / 2
    count, views = rows * columns, []
    for n in range(count):
        turn, size = rng.normal() * 0.01, 1 + rng.normal() * 1e-3
        place = np.array([n % columns * 320.0, n // columns * 240.0]) + rng.normal(size=2) * 5
        matrix = np.eye(3)
        matrix[:2, :2] = size * np.array(
            [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
        )
        tilt = np.eye(3)
        tilt[2, :2] = rng.normal(size=2) * 5e-6
        away = np.eye(3)
        away[:2, 2] = -place
        views.append(tilt @ matrix @ away)

    def see(n, points):
        lifted = points @ views[n][:, :2].T + views[n][:, 2]
        u = lifted[:, :2] / lifted[:, 2:] / reach
        return u * (1 + k1 * (u**2).sum(1, keepdims=True)) * reach + middle

    pairs, first, second, overlap = grid_pairs(rows, columns), [], [], []
    for k, (i, j) in enumerate(pairs):
        centre = np.linalg.inv(views[i])[:2, 2] / np.linalg.inv(views[i])[2, 2]
        points = centre + rng.uniform(-1, 1, (4000, 2)) * 220
        a, b = see(i, points), see(j, points)
        inside = ((a >= 0) & (b >= 0) & (a <= np.array(SIZE) - 1) & (b <= np.array(SIZE) - 1)).all(
            1
        )
        here = np.flatnonzero(inside)[:many]
        first.append(a[here] + rng.normal(size=(len(here), 2)) * noise)
        second.append(b[here])
        overlap.append(np.full(len(here), k))
    information = np.tile(np.eye(2) / max(noise, 1e-3) ** 2, (sum(map(len, first)), 1, 1))
    windows = Windows(
        pairs, np.concatenate(overlap), np.concatenate(first), np.concatenate(second), information
    )
    own = np.zeros((count, 8))
    own[:, 2] = np.arange(count) % columns * 320.0
    own[:, 3] = np.arange(count) // columns * 240.0
    return windows, TileMaps(SIZE, own, np.zeros(SHARED)), views, see


def errors(adjusted, views, see, rng):
    """Where tiles put points of the plane, less where these lie, after one homography of all."""
    from levkas.geometry.transforms import Homography

    laid, true, tile = [], [], []
    for n, view in enumerate(views):
        centre = np.linalg.inv(view)[:2, 2] / np.linalg.inv(view)[2, 2]
        points = centre + np.stack(np.meshgrid([-160, 0, 160], [-120, 0, 120]), -1).reshape(-1, 2)
        laid.append(adjusted.maps.transform(n)(see(n, points)))
        true.append(points)
        tile += [n] * 9
    laid, true = np.concatenate(laid), np.concatenate(true)
    return Homography.fit(laid, true)(laid) - true, np.array(tile)


def test_tiles_and_their_lens_are_recovered():
    rng = np.random.default_rng(2)
    windows, begin, views, see = planted(3, 4, rng, noise=0.001)
    adjusted = adjust(windows, begin)
    off, _ = errors(adjusted, views, see, rng)
    assert (
        np.abs(off).max() < 0.15
    )  # windows to 0.001 px; what bends a whole mosaic is known from loops alone
    assert adjusted.maps.lens.radial[0] == pytest.approx(0.01, abs=3e-4)


def test_a_mosaic_does_not_shrink_to_have_smaller_residuals():
    windows, begin, *_ = planted(3, 4, np.random.default_rng(6), noise=0.3, many=120)
    assert adjust(windows, begin).maps.own[:, 0].mean() == pytest.approx(0, abs=1e-6)


def test_windows_left_out_choose_the_lens():
    rng = np.random.default_rng(4)
    none, _ = choose_lens(*planted(3, 3, rng, noise=0.02, k1=0.0)[:2])
    lens, _ = choose_lens(*planted(3, 3, rng, noise=0.02)[:2])
    assert (none, lens) == (False, True)


def test_an_overlap_one_period_off_closes_no_loop():
    place = {
        name: 100.0 * np.array(at)
        for name, at in zip("abcd", ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True)
    }
    corners = np.array([[0.0, 0], [100, 0], [0, 100]])
    maps = {
        (a, b): similarity(corners, corners + place[a] - place[b])
        for a, b in combinations("abcd", 2)
    }
    wrong = maps["a", "b"].matrix.copy()
    wrong[:, 2] += (40, 0)
    maps["a", "b"] = type(maps["a", "b"])(wrong)
    kept, refused = consistent_pairs(maps, dict.fromkeys(maps, 10.0), (220, 220), 3.0)
    assert set(refused) == {("a", "b")} and len(kept) == 5

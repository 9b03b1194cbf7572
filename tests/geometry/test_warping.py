"""Resampling against an exact evaluation per band, on ramps, and under every way to cut the work."""

import numpy as np
import pytest

from levkas.core.cube import Flag
from levkas.geometry.depth_step import DepthStepShift
from levkas.geometry.grid import Grid
from levkas.geometry.pixel_maps import STEP_SHARE, TOLERANCE_PX, _evaluate, lay
from levkas.geometry.resample import Warped, source_rows, warp
from levkas.geometry.transforms import Affine, Composed, Inverse, Lens

SHAPE = (90, 130)
SOURCE = (110, 150)


def shift(x, y):
    return Affine(np.array([[1.0, 0, x], [0, 1, y]]))


def camera_map(band=0, spread=0.02):
    """Rotation, scale and a lens; bands differ by magnification, as lateral chromatic aberration."""
    turn = Affine(np.array([[0.99, 0.05, 6.3], [-0.05, 1.01, 12.8]]))
    lens = Lens(np.array([75.0, 55.0]), 90.0, (0.004 + spread * band / 100, -0.002), (1e-4, 2e-4))
    zoom = 1 + spread * band / 10
    return Composed(
        turn, lens, Affine(np.array([[zoom, 0, 75 * (1 - zoom)], [0, zoom, 0.3 * band * spread]]))
    )


def exact_places(transform, shape=SHAPE):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return transform(np.stack([x.ravel(), y.ravel()], 1).astype(float)).reshape(*shape, 2)


def keys_cubic(d):
    d = np.abs(d)
    near = 1.5 * d**3 - 2.5 * d**2 + 1
    far = -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2
    return np.where(d < 1, near, np.where(d < 2, far, 0))


def reference_warp(band, transform, shape=SHAPE):
    """Sum the textbook kernel in float64, and tell where all 4 x 4 taps are in the image."""
    p = exact_places(transform, shape)
    whole = np.floor(p).astype(int)
    h, w = band.shape
    inside = (whole >= 1).all(-1) & (whole[..., 0] + 2 < w) & (whole[..., 1] + 2 < h)
    total = np.zeros(shape)
    for r in range(-1, 3):
        for k in range(-1, 3):
            x, y = whole[..., 0] + k, whole[..., 1] + r
            weight = keys_cubic(p[..., 0] - x) * keys_cubic(p[..., 1] - y)
            total += weight * band[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)].astype(float)
    return total, inside


@pytest.fixture(scope="module")
def cube():
    return np.random.default_rng(4).uniform(0.05, 1.0, (*SOURCE, 21)).astype(np.float32)


def same(a, b):
    pairs = ((a.values, b.values), (a.flags, b.flags), (a.variance, b.variance))
    return all((x is None and y is None) or x.tobytes() == y.tobytes() for x, y in pairs)


# --- against exact evaluation -------------------------------------------------------------------


def test_one_map_for_all_bands_agrees_with_an_exact_evaluation(cube):
    warped = warp(cube, camera_map(), SHAPE)
    for b in (0, 20):
        expected, inside = reference_warp(cube[..., b], camera_map())
        assert inside.mean() > 0.8
        assert np.abs(warped.values[..., b] - expected)[inside].max() < 2 * TOLERANCE_PX


def filter_wheel(band):
    """Filters that are tilted shift each band by some pixels, in no order."""
    return Composed(camera_map(), shift(*np.random.default_rng(band).uniform(-3, 3, 2)))


@pytest.mark.parametrize("spread", [0.0005, 0.02, 0.03, None])
def test_maps_of_their_own_agree_with_an_exact_evaluation(cube, spread):
    maps = [camera_map(b, spread) if spread else filter_wheel(b) for b in range(21)]
    warped = warp(cube, maps, SHAPE)
    for b in (0, 7, 20):
        expected, inside = reference_warp(cube[..., b], maps[b])
        assert inside.mean() > 0.7
        # Noise of full contrast moves by up to 0.6 a pixel.
        assert np.abs(warped.values[..., b] - expected)[inside].max() < 2 * TOLERANCE_PX


def test_lattice_is_checked_against_the_map_and_falls_back_to_every_pixel():
    smooth = lay(camera_map(), SHAPE)
    assert smooth.lattices[0].table is not None
    assert smooth.error <= TOLERANCE_PX

    class Step(Affine):
        """A ledge: no lattice follows it."""

        def __call__(self, points):
            return super().__call__(points) + np.where(points[:, :1] > 61.5, 0.7, 0.0)

    ledge = Step(np.eye(2, 3))
    assert lay(ledge, SHAPE).lattices[0].table is None
    ramp = np.arange(150, dtype=np.float32) + np.zeros((110, 1), np.float32)
    warped = warp(ramp, ledge, SHAPE).values
    assert np.allclose(warped, exact_places(ledge)[..., 0], atol=1e-5)


def test_map_without_an_answer_somewhere_is_outside_there():
    fold = Lens(np.array([65.0, 45.0]), 60.0, (-0.25, 0.0))
    inverse = Inverse(fold)
    lost = ~np.isfinite(exact_places(inverse)).all(-1)
    assert 0.01 < lost.mean() < 0.5
    with np.errstate(invalid="ignore"):
        warped = warp(np.ones(SOURCE, np.float32), inverse, SHAPE)
    assert np.all(warped.flags[lost] == Flag.OUTSIDE)
    assert np.all(np.isnan(warped.values) == (warped.flags == Flag.OUTSIDE))


# --- ramps --------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 2.8])
def test_a_ramp_shows_the_position_up_to_the_edge(scale):
    h, w = (int(n * scale) for n in SOURCE)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    source = np.stack([x, y], -1)
    transform = Composed(camera_map(), Affine.scaling(scale))
    warped = warp(source, transform, SHAPE)
    places = exact_places(transform)
    inside = ((places >= -0.5) & (places <= (w - 0.5, h - 0.5))).all(-1)
    assert np.array_equal(inside, warped.flags[..., 0] == 0)
    assert np.abs(warped.values - places)[inside].max() < 2 * TOLERANCE_PX
    assert np.all(np.isnan(warped.values[~inside]))


def test_half_a_pixel_beyond_the_outermost_centre_belongs_to_the_image():
    source = np.array([[1.0, 2.0, 4.0]], np.float32)
    places = Composed(shift(-1, 0), Affine(np.array([[0.25, 0, 0], [0, 1, 0]])))
    warped = warp(source, places, (1, 16))
    # Places −0.25 … 3.5: from 2.75 on there is nothing (2.5 is the edge of the last pixel).
    assert warped.flags[0].tolist() == [0] * 12 + [1] * 4
    assert np.isfinite(warped.values[0, :12]).all()
    assert np.isnan(warped.values[0, 12:]).all()
    assert warped.values[0, [1, 5, 9]].tolist() == [1.0, 2.0, 4.0]


# --- what must not change a bit -----------------------------------------------------------------


def test_identity_copies_every_bit(cube):
    flags = (np.arange(cube.size).reshape(cube.shape) % 97 == 0).astype(np.uint8) * 4
    warped = warp(cube, Affine.identity(), SOURCE, flags=flags, variance=cube)
    assert np.array_equal(warped.values, cube)
    assert np.array_equal(warped.flags, flags)
    assert np.array_equal(warped.variance, cube)


def test_quarter_turn_copies_every_bit(cube):
    grid = Grid((150, 110), mirror=True, rotate=270)
    warped = warp(cube, grid.transform, grid.shape)
    assert np.array_equal(warped.values, np.rot90(cube[:, ::-1], 1))


def everything(cube, **changes):
    """A warp with all that can happen: flags, holes, edges, variance, maps of their own."""
    rng = np.random.default_rng(1)
    source, flags = cube.copy(), np.zeros(cube.shape, np.uint8)
    for bit in (1, 2, 4, 8):
        flags.flat[rng.integers(0, cube.size, 300)] |= bit
    source.flat[rng.integers(0, cube.size, 300)] = np.nan
    maps = [camera_map(b, 0.05) for b in range(cube.shape[2])]
    return source, maps, {"flags": flags, "variance": cube**2, **changes}


def near(a, b):
    """Flags alike, values and variances to rounding."""
    pairs = [(x, y) for x, y in ((a.values, b.values), (a.variance, b.variance)) if x is not None]
    return np.array_equal(a.flags, b.flags) and all(
        np.allclose(x, y, atol=1e-6, equal_nan=True) for x, y in pairs
    )


@pytest.mark.parametrize("scale", [1.0, 2.2])
def test_tiles_and_threads_give_the_same_bytes(cube, scale, monkeypatch):
    source, maps, given_ = everything(cube)
    maps = [Composed(Affine.scaling(scale), m) for m in maps]
    monkeypatch.setenv("LEVKAS_THREADS", "1")
    whole = warp(source, maps, SHAPE, **given_)
    monkeypatch.setenv("LEVKAS_THREADS", "3")
    assert same(whole, warp(source, maps, SHAPE, **given_))
    for rows in ((0, 17), (17, 18), (18, 90)):
        part = warp(source, maps, SHAPE, rows=rows, **given_)
        assert part.values.tobytes() == whole.values[slice(*rows)].tobytes()
        assert part.flags.tobytes() == whole.flags[slice(*rows)].tobytes()
        assert part.variance.tobytes() == whole.variance[slice(*rows)].tobytes()


@pytest.mark.parametrize("scale", [1.0, 2.2])
def test_a_band_is_the_same_whatever_others_are_resampled_with_it(cube, scale):
    source, maps, given_ = everything(cube)
    maps = [Composed(Affine.scaling(scale), m) for m in maps]
    shape = (int(90 / scale), int(130 / scale))
    whole = warp(source, maps, shape, **given_)
    for bands in ((0, 1), (1, 5), (5, 21)):
        cut = slice(*bands)
        twins = {k: np.ascontiguousarray(given_[k][..., cut]) for k in ("flags", "variance")}
        part = warp(source[..., cut], maps[cut], shape, **twins)
        each = Warped(whole.values[..., cut], whole.flags[..., cut], whole.variance[..., cut])
        assert near(part, each)


@pytest.mark.parametrize("scale", [1.0, 2.2])
def test_flags_of_all_bands_are_passed_on_as_those_of_each(cube, scale):
    rng = np.random.default_rng(6)
    flags = np.where(rng.random(cube.shape) < 0.4, rng.choice([2, 4, 8, 14], cube.shape), 0)
    flags = flags.astype(np.uint8)
    flags[50, 60:64, 3] |= np.uint8(Flag.OUTSIDE)
    coarser = [Composed(camera_map(), Affine.scaling(scale)) for _ in range(21)]
    shape = (int(90 / scale), int(130 / scale))
    each = warp(cube, coarser, shape, flags=flags, variance=cube**2)
    assert near(each, warp(cube, coarser[0], shape, flags=flags, variance=cube**2))
    assert len(np.unique(each.flags)) > 5


@pytest.mark.parametrize("scale", [1.0, 2.2])
def test_source_rows_are_enough_and_too_few_are_an_error(cube, scale):
    tall = np.repeat(cube[..., :3], 3, axis=0)
    maps = lay([Composed(camera_map(b), Affine.scaling(1, scale)) for b in range(3)], SHAPE)
    whole = warp(tall, maps, SHAPE, variance=tall)
    for rows in ((0, 30), (30, 61), (61, 90)):
        low, high = source_rows(maps, SHAPE, rows, len(tall))
        assert high - low < 110
        part = tall[low:high]
        tile = warp(part, maps, SHAPE, rows=rows, held=(low, len(tall)), variance=part)
        assert tile.values.tobytes() == whole.values[slice(*rows)].tobytes()
    with pytest.raises(ValueError):
        warp(tall[40:60], maps, SHAPE, held=(40, len(tall)))


def test_out_is_written_and_inputs_are_left_alone(cube):
    source, maps, given_ = everything(cube)
    kept = [a.copy() for a in (source, given_["flags"], given_["variance"])]
    fresh = warp(source, maps, SHAPE, **given_)
    shape = (*SHAPE, 21)
    out = Warped(
        np.ones(shape, np.float32), np.full(shape, 255, np.uint8), np.ones(shape, np.float32)
    )
    assert warp(source, maps, SHAPE, out=out, **given_) is out
    assert same(fresh, out)
    for before, after in zip(kept, (source, given_["flags"], given_["variance"]), strict=True):
        assert before.tobytes() == after.tobytes()
    with pytest.raises(ValueError):
        warp(out.values, maps, SHAPE, out=Warped(out.values[:90, :130], out.flags, None))


# --- flags, holes, variance ---------------------------------------------------------------------


def spot(kind, value, at=(10, 10)):
    image, flags = np.full((21, 21), 0.5, np.float32), np.zeros((21, 21), np.uint8)
    image[at], flags[at] = value, kind
    return image, flags


def test_a_flag_stays_on_its_pixel_and_its_neighbours_are_near():
    image, flags = spot(Flag.SATURATED, 1.0)
    warped = warp(image, shift(0.25, 0), (21, 21), flags=flags)
    # Place x + 0.25: weights of −1 … 2 are −0.070, 0.867, 0.227, −0.023.
    row = warped.flags[10, 7:13].tolist()
    near = Flag.SATURATED | Flag.NEAR
    assert row == [0, 0, near, Flag.SATURATED, near, 0]
    assert not warped.flags[[8, 9, 11, 12]].any()


@pytest.mark.parametrize("scale", [1.0, 3.0, 10.0])
def test_a_flagged_region_is_flagged_at_any_scale(scale):
    n = int(40 * scale)
    flags = np.zeros((n, n), np.uint8)
    flags[:, n // 2 :] = Flag.SATURATED
    image = np.full((n, n), 0.5, np.float32)
    warped = warp(image, Composed(Affine.scaling(scale), shift(0.3, 0)), (38, 38), flags=flags)
    assert np.all(warped.flags[:, 21:] & Flag.SATURATED)
    assert not warped.flags[:, :17].any()


@pytest.mark.parametrize("hole", ["nan", "outside"])
def test_what_is_not_there_does_not_spread(hole):
    image, flags = spot(
        Flag.OUTSIDE if hole == "outside" else 0, 99.0 if hole == "outside" else np.nan
    )
    warped = warp(image, shift(0.25, 0.3), (21, 21), flags=flags)
    assert np.isnan(warped.values[10, 10])
    assert warped.flags[10, 10] == Flag.OUTSIDE
    valid = np.ones((21, 21), bool)
    valid[10, 10] = False
    valid[-1] = valid[:, -1] = warped.flags[0, -1] == 0
    assert np.allclose(warped.values[valid], 0.5)
    assert warped.flags[10, 9] == warped.flags[9, 9] == Flag.NEAR
    assert (warped.flags != 0).sum() < 40


def test_variance_adds_with_squared_weights():
    ones = np.ones((12, 12), np.float32)
    warped = warp(ones, shift(0.5, 0), (12, 12), variance=ones)
    # Weights −1/16, 9/16, 9/16, −1/16: squares sum to 164/256.
    assert np.allclose(warped.variance[5, 3:9], 164 / 256)
    assert np.allclose(
        warp(ones, shift(0.5, 0.5), (12, 12), variance=ones).variance[5, 5], (164 / 256) ** 2
    )


def test_a_coarse_grid_is_not_aliased():
    x = np.arange(600)
    stripes = np.tile((0.5 + 0.5 * np.cos(np.pi * x * 0.9)).astype(np.float32), (600, 1))
    warped = warp(stripes, Affine.scaling(3.0), (200, 200))
    # 0.45 cycles a source px are 1.35 a grid px: nothing of them may be left.
    assert warped.values[5:-5, 5:-5].std() < 0.01
    slow = np.tile((0.5 + 0.5 * np.cos(np.pi * x * 0.05)).astype(np.float32), (600, 1))
    assert warp(slow, Affine.scaling(3.0), (200, 200)).values.std() > 0.33


# --- sizes and wrong use ------------------------------------------------------------------------


def test_the_step_of_a_ledge_is_laid_out_as_exactly_as_its_place_is_known():
    lines = np.array([[1, 0.005, -156], [-1, -0.005, 1236], [-0.005, 1, -156], [0.005, -1, 884.0]])
    ledge = DepthStepShift(
        lines, 33.0, np.array([696.0, 520]), 696.0, np.array([[0.6, 0.2], [0, 0], [0, 0]])
    )
    whole = Composed(ledge, Affine.scaling(1.0))
    lattice = lay(whole, (1040, 1392)).lattices[0]
    assert lattice.table is not None and lattice.segment >= 4
    y, x = np.mgrid[0:1040:3, 0:1392]
    points = np.stack([x.ravel(), y.ravel()], -1).astype(float)
    laid = _evaluate(lattice.table, (1040, 1392), lattice.segment, x[0], y[:, 0])
    error = np.abs(laid - whole(points)).max()
    # Half again as much as at the places that are checked.
    assert TOLERANCE_PX < lattice.error <= STEP_SHARE * ledge.most
    assert error < 1.5 * STEP_SHARE * ledge.most


@pytest.mark.parametrize(
    "changes",
    [
        {"flags": np.zeros((5, 5), np.uint8)},
        {"rows": (0, 9)},
        {"held": (5, 10)},
        {"source": np.ones((8, 8))},
        {"transforms": [shift(0, 0), shift(1, 0)]},
        {"transforms": lay(Affine.identity(), (9, 9))},
    ],
    ids=str,
)
def test_wrong_use_is_refused(changes):
    sound = {"source": np.ones((8, 8), np.float32), "transforms": shift(0, 0), "shape": (8, 8)}
    with pytest.raises(ValueError):
        warp(**(sound | changes))

import numpy as np
import pytest
from scipy import ndimage

from levkas.geometry.transforms import Composed, Homography, Lens
from levkas.registration import BandImage, RegistrationRefused, register

SIZE = (200, 260)


def paint(rng, pigments=3):
    """Soft-edged random patches: abundance of each pigment, (pigments, h, w) at twice the sampling."""
    shape = (2 * SIZE[0] + 160, 2 * SIZE[1] + 160)
    fields = [ndimage.gaussian_filter(rng.standard_normal(shape), s) for s in (2.0, 3, 4, 6)]
    stack = np.stack([f / f.std() for f in fields[:pigments]])
    return ndimage.gaussian_filter(1 / (1 + np.exp(-3 * stack)), (0, 1.2, 1.2))


def look(scene, mixture, points, rng, noise=0.002):
    """See the scene at `points`, (h, w, 2) reference px."""
    image = np.tensordot(mixture, scene, 1)
    at = [2 * points[..., k] + 80.5 for k in (1, 0)]
    observed = ndimage.map_coordinates(image, at, order=3, mode="nearest")
    return (observed + noise * rng.standard_normal(observed.shape)).astype(np.float32)


def grid(shape):
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    return np.stack([x, y], -1)


@pytest.fixture(scope="module")
def pair():
    """Four reference bands, three target bands with lens and chromatic magnification, and truth."""
    rng = np.random.default_rng(7)
    scene = paint(rng)
    reference = [
        BandImage.of(f"{w} nm", look(scene, rng.random(3), grid(SIZE), rng), w)
        for w in (450, 500, 550, 600)
    ]
    turn = np.deg2rad(4.0)
    matrix = np.array(
        [
            [1.3 * np.cos(turn), -1.3 * np.sin(turn), 8.0],
            [1.3 * np.sin(turn), 1.3 * np.cos(turn), -12.0],
            [2e-5, -1e-5, 1.0],
        ]
    )
    base = Composed(Homography(matrix), Lens(np.array([160.0, 130]), 160.0, (0.01, -0.002)))
    truths, target = {}, []
    for k, magnification in enumerate((0.9995, 1.0, 1.0006)):
        middle = np.array([129.5, 99.5])
        shrink = np.diag([magnification, magnification, 1.0])
        shrink[:2, 2] = middle * (1 - magnification)
        truths[f"B{k}"] = Composed(Homography(shrink), base)
        points = truths[f"B{k}"].inverse(grid((270, 330)).reshape(-1, 2)).reshape(270, 330, 2)
        # An inverted band among them: gains are free in sign.
        mixture = rng.random(3) * (-1 if k == 2 else 1)
        target.append(BandImage.of(f"B{k}", look(scene, mixture, points, rng)))
    return reference, target, truths


def errors(registration, truths):
    points = grid(SIZE)[25:-25:10, 25:-25:10].reshape(-1, 2)
    result = {}
    for label, truth in truths.items():
        miss = registration.transforms[label](points) - truth(points)
        jacobian = truth.jacobian(points)
        result[label] = np.linalg.norm(np.linalg.solve(jacobian, miss[..., None])[..., 0], axis=1)
    return result


@pytest.mark.slow
def test_planted_lens_and_magnification_are_recovered_in_every_band(pair):
    reference, target, truths = pair
    found = register(reference, target, reference_band="550 nm")
    assert found.verdict.decision == "accept"
    for label, error in errors(found, truths).items():
        assert error.mean() < 0.03, label
        assert error.max() < 0.15, label


def test_own_bands_stay_where_they_are(pair):
    reference, _, _ = pair
    found = register(reference, reference, reference_band="550 nm")
    points = grid(SIZE)[20:-20:10, 20:-20:10].reshape(-1, 2)
    assert np.array_equal(found.transforms["550 nm"](points), points)
    for label, transform in found.transforms.items():
        assert np.linalg.norm(transform(points) - points, axis=1).mean() < 0.03, label


@pytest.mark.slow
def test_same_input_gives_same_answer(pair):
    reference, target, _ = pair
    one, two = (register(reference, target[:1], reference_band="550 nm") for _ in range(2))
    assert one.to_dict() == two.to_dict()


@pytest.mark.slow
def test_another_painting_is_refused(pair):
    reference, _, _ = pair
    rng = np.random.default_rng(99)
    other = [BandImage.of("R", look(paint(rng), rng.random(3), grid(SIZE), rng))]
    with pytest.raises(RegistrationRefused) as refused:
        register(reference, other, reference_band="550 nm")
    assert refused.value.problems[0].code in ("E_MATCHES", "E_WINDOWS", "E_FOLD")


@pytest.mark.slow
def test_blank_target_is_refused_by_name(pair):
    reference, _, _ = pair
    blank = [BandImage.of("R", np.full(SIZE, 0.5, np.float32))]
    with pytest.raises(RegistrationRefused) as refused:
        register(reference, blank, reference_band="550 nm")
    assert refused.value.problems[0].code == "E_MATCHES"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("moved", "measured"),
    [
        ({}, range(30, 40)),
        pytest.param({32: 1.0}, [90], marks=pytest.mark.slow),
        pytest.param({k: k // 2 % 2 for k in range(90)}, [90], marks=pytest.mark.slow),
    ],
)
def test_of_many_bands_some_are_measured_and_all_where_neighbours_do_not_tell_of_one_another(
    moved, measured
):
    """Every third is measured, and some that seem to lie elsewhere as they mix the paints otherwise.

    Band 32 lies between measured ones: a nudge between two shots moves it alone.
    """
    rng = np.random.default_rng(11)
    scene, wavelengths = paint(rng), np.arange(400.0, 850, 5)
    reference = [
        BandImage.of(f"{w} nm", look(scene, rng.random(3), grid(SIZE), rng), w)
        for w in (450, 500, 550, 600)
    ]
    truths, target = {}, []
    for k, nm in enumerate(wavelengths):
        shift = np.array([0.8 * (nm - 550) / 300, moved.get(k, 0)])
        matrix = np.array([[1.0, 0.01, 3.0 + shift[0]], [-0.01, 1.0, 5.0 + shift[1]], [0, 0, 1.0]])
        truths[f"L{k}"] = Homography(matrix)
        points = truths[f"L{k}"].inverse(grid((210, 270)).reshape(-1, 2)).reshape(210, 270, 2)
        target.append(BandImage.of(f"L{k}", look(scene, rng.random(3), points, rng), nm))
    found = register(reference, target, reference_band="550 nm")
    assert sum(band["windows"] > 0 for band in found.errors["bands"].values()) in measured
    assert found.errors["bands"].keys() == found.sigma.keys() == truths.keys()
    assert list(found.errors["bands"]) == list(truths)
    for label, error in errors(found, truths).items():
        assert error.mean() < (0.06 if (label, moved) == ("L32", {32: 1.0}) else 0.03), label
    assert found.verdict.decision == "accept"


@pytest.mark.slow
def test_plain_arrays_are_registered_as_their_bands_are():
    rng = np.random.default_rng(5)
    scene = ndimage.gaussian_filter(rng.random((200, 240)), 2)
    reference, target = scene[:180, :220], np.dstack([scene[4:184, 6:226], 1 - scene[4:184, 6:226]])
    found = register(reference, target)
    assert list(found.transforms) == ["1", "2"]
    assert found.verdict.decision == "accept"
    for transform in found.transforms.values():
        assert np.abs(transform(np.array([[100.0, 90.0]])) - [94.0, 86.0]).max() < 0.05
    masked = np.ma.masked_array(reference, np.arange(220) < 40 + 0 * reference)
    hidden = np.where(masked.mask, np.nan, reference)
    again = [register(one, target[..., 0]).transforms["1"] for one in (masked, hidden)]
    places = rng.uniform(50, 170, (20, 2))
    np.testing.assert_array_equal(again[0](places), again[1](places))
    bands = [BandImage.of("a", target[..., 0]), BandImage.of("b", target[..., 1])]
    named = register([BandImage.of("c", reference)], bands, reference_band="c")
    points = rng.uniform(0, 180, (50, 2))
    np.testing.assert_array_equal(named.transforms["b"](points), found.transforms["2"](points))


@pytest.mark.parametrize(
    "wrong", [np.zeros(40), np.zeros((2, 40, 40, 3)), np.zeros((40, 40), complex), "picture.png",
              [np.zeros((40, 40))], None, 5, np.full((40, 40), np.nan), np.zeros((40, 40), bool)]
)  # fmt: skip
def test_what_is_no_picture_is_refused_by_name(wrong):
    picture = np.random.default_rng(1).random((40, 40))
    for given, name in (((wrong, picture), "reference"), ((picture, wrong), "target")):
        with pytest.raises(RegistrationRefused) as refused:
            register(*given)
        assert (refused.value.problems[0].code, refused.value.problems[0].field) == (
            "E_VALUE",
            name,
        )

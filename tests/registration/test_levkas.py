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

"""Sensors of one camera: each is registered by itself; a declared alignment is a start and is checked."""

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.registration import BandImage, RegistrationRefused, register

POINTS = np.array([[60.0, 50.0], [220.0, 160.0]])
TURN = Affine(np.array([[1.0, -0.004, 3.4], [0.004, 1.0, -2.2]]))


def band(label, values, sensor):
    return BandImage(label, 550.0, values, np.isfinite(values), sensor)


@pytest.fixture(scope="module")
def camera(studio):
    """A camera of two sensors; `TURN` maps px of the first to px of the second."""
    painting = studio.paint(11)
    first = studio.photograph(painting, Affine.identity(), seed=1)
    second = studio.photograph(painting, TURN.inverse, seed=2)
    return [band("a", first, "ccd1"), band("b", 0.2 + 0.7 * second, "ccd2")]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["levkas", "mirhashemi2019"])
def test_every_sensor_is_registered_by_itself(front, camera, method):
    for x, decision in ((0.0, "accept"), (100.0, "warn")):
        found = register(
            front, camera, reference_band="r", align={"ccd2": moved(TURN, x, 0.0)}, method=method
        )
        for label, truth in (("a", Affine.identity()), ("b", TURN)):
            # Some hundred key points of about 0.2 px each.
            most = 0.05 if method == "levkas" else 0.3
            np.testing.assert_allclose(found.transforms[label](POINTS), truth(POINTS), atol=most)
        assert found.verdict.decision == decision
        assert found.verdict.numbers["ccd2"]["align_apart_px"] == pytest.approx(x, abs=0.4)


def test_a_matrix_of_another_shape_is_refused(front, camera):
    with pytest.raises(RegistrationRefused) as refused:
        register(front, camera, reference_band="r", align={"ccd2": np.eye(3)})
    assert refused.value.problems[0].field == "align"


# --- the default method: a declared alignment is a start and is checked


def turned(degrees, scale):
    """Return px of the first sensor → px of a coarser sensor about the same middle, and its size."""
    angle, size = np.deg2rad(degrees), np.round(np.array([300, 230]) * scale).astype(int)
    rows = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = np.array([149.5, 114.5])
    return Affine(np.column_stack([rows, (size - 1) / 2 - rows @ middle])), tuple(size.tolist())


@pytest.fixture(scope="module")
def front(studio):
    return [band("r", studio.photograph(studio.paint(11), Affine.identity(), seed=5), "")]


def moved(transform, x, y):
    return Affine(transform.matrix + np.array([[0, 0, x], [0, 0, y]]))


@pytest.mark.slow
def test_a_declared_alignment_begins_where_key_points_find_nothing(studio, camera, front):
    hard, size = turned(137, 0.4)
    picture = studio.photograph(studio.paint(11), hard.inverse, size, seed=2, noise=0.2)
    both = [camera[0], band("b", picture, "ccd2")]
    with pytest.raises(RegistrationRefused) as refused:
        register(front, both, reference_band="r")
    assert refused.value.problems[0].code == "E_MATCHES"
    found = register(front, both, reference_band="r", align={"ccd2": moved(hard, 1.5, -1.0)})
    np.testing.assert_allclose(found.transforms["b"](POINTS), hard(POINTS), atol=0.4)
    assert found.verdict.decision != "refuse"
    assert 1.0 < found.verdict.numbers["ccd2"]["align_apart_px"] < 3.0

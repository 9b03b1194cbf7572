"""Sensors of one camera: measured or given, and the grey picture that they share."""

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.alignment import align_sensors, camera_grey

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


def test_a_planted_alignment_is_measured(camera):
    found = align_sensors(camera)
    corners = np.array([[0.0, 0], [299, 0], [299, 229], [0, 229]])
    np.testing.assert_array_equal(found["ccd1"](corners), corners)
    # Some hundred key points of about 0.2 px each.
    np.testing.assert_allclose(found["ccd2"](corners), TURN(corners), atol=0.12)


def test_a_given_alignment_is_taken(camera):
    found = align_sensors(camera, given={"ccd2": TURN.matrix.tolist()})
    np.testing.assert_array_equal(found["ccd2"].matrix, TURN.matrix)


def test_alignments_can_start_at_another_sensor(camera):
    found = align_sensors(camera, given={"ccd2": TURN}, first="ccd2")
    points = np.array([[10.0, 20.0], [200.0, 100.0]])
    np.testing.assert_allclose(found["ccd1"](points), TURN.inverse(points), atol=1e-9)
    np.testing.assert_array_equal(found["ccd2"](points), points)


def test_a_matrix_of_another_shape_is_refused(camera):
    with pytest.raises(RegistrationRefused, match="ccd2"):
        align_sensors(camera, given={"ccd2": np.eye(3)})


def test_sensors_without_anything_in_common_are_refused(camera):
    blank = band("b", np.full((230, 300), 0.5, np.float32), "ccd2")
    with pytest.raises(RegistrationRefused, match="too little common detail"):
        align_sensors([camera[0], blank])


def test_the_grey_picture_lies_in_the_frame_of_the_first_sensor(camera):
    values, valid = camera_grey(camera, {"ccd1": Affine.identity(), "ccd2": TURN}, "ccd1")
    inner = slice(20, -20), slice(20, -20)
    expected = 0.5 * camera[0].values + 0.5 * (0.2 + 0.7 * camera[0].values)
    assert valid[inner].all() and not valid[0].any()
    assert np.corrcoef(values[inner].ravel(), expected[inner].ravel())[0, 1] > 0.99


def test_every_band_gets_the_map_of_its_sensor(studio, camera):
    reference = [band("r", studio.photograph(studio.paint(11), Affine.identity(), seed=5), "")]
    found = register(
        reference, camera, reference_band="r", method="mirhashemi2019", align={"ccd2": TURN}
    )
    points = np.array([[60.0, 50.0], [220.0, 160.0]])
    np.testing.assert_allclose(found.transforms["a"](points), points, atol=0.3)
    np.testing.assert_allclose(
        found.transforms["b"](points), TURN(found.transforms["a"](points)), atol=1e-9
    )


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
    with pytest.raises(RegistrationRefused, match="too few key points") as refused:
        register(front, both, reference_band="r")
    assert "align" in refused.value.problems[0].fix
    found = register(front, both, reference_band="r", align={"ccd2": moved(hard, 1.5, -1.0)})
    points = np.array([[60.0, 50.0], [220.0, 160.0]])
    np.testing.assert_allclose(found.transforms["b"](points), hard(points), atol=0.4)
    assert found.verdict.decision != "refuse"
    assert 1.0 < found.verdict.numbers["ccd2"]["align_apart_px"] < 3.0


@pytest.mark.slow
def test_the_first_sensor_begins_where_another_ones_alignment_puts_it(studio, camera, front):
    hard, size = turned(137, 0.4)
    picture = studio.photograph(studio.paint(11), hard.inverse, size, seed=2, noise=0.2)
    both = [band("b", picture, "ccd2"), camera[0]]
    back = Affine(np.linalg.inv(np.vstack([hard.matrix, [0, 0, 1]]))[:2])
    found = register(front, both, reference_band="r", align={"ccd1": back})
    points = np.array([[60.0, 50.0], [220.0, 160.0]])
    np.testing.assert_allclose(found.transforms["b"](points), hard(points), atol=0.4)


@pytest.mark.slow
def test_an_alignment_that_contradicts_the_pictures_is_named_and_moves_nothing(camera, front):
    for x, decision in ((0.0, "accept"), (100.0, "warn")):
        found = register(front, camera, reference_band="r", align={"ccd2": moved(TURN, x, 0.0)})
        points = np.array([[60.0, 50.0], [220.0, 160.0]])
        np.testing.assert_allclose(found.transforms["b"](points), TURN(points), atol=0.05)
        assert found.verdict.decision == decision
        assert found.verdict.numbers["ccd2"]["align_apart_px"] == pytest.approx(x, abs=0.2)
    assert "sensor ccd2: The sensor lies 100.0 of its px" in found.verdict.reasons[0]


@pytest.mark.slow
@pytest.mark.parametrize("reference", ["a", pytest.param("b", marks=pytest.mark.exhaustive)])
def test_other_sensors_of_the_reference_camera_are_checked_too(camera, reference):
    wrong = {"ccd2": moved(TURN, 30.0, 0.0)}
    for method, decision in (("levkas", "warn"), ("mirhashemi2019", "refuse")):
        found = register(camera, camera, reference_band=reference, align=wrong, method=method)
        assert found.verdict.decision == decision
        assert "30.0 of its px" in " ".join(found.verdict.reasons)


def test_the_papers_method_refuses_an_alignment_that_contradicts_the_pictures(camera, front):
    found = register(
        front, camera, reference_band="r", method="mirhashemi2019",
        align={"ccd2": moved(TURN, 12.0, 5.0)},
    )  # fmt: skip
    assert found.verdict.decision == "refuse"
    assert "13.0 of its px" in " ".join(found.verdict.reasons)

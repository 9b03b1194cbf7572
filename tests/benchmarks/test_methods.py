"""Methods set side by side on a small built campaign; dual-bootstrap ICP finds a planted map, and refuses another picture."""

import json
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from levkas.geometry.transforms import Affine

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import methods
from levkas_peers.dual_bootstrap import gdbicp_quadratic, gdbicp_radial
from levkas_peers.growing import LADDERS
from levkas_peers.opencv import opencv_ecc, opencv_sift_magsac
from levkas_peers.pair import AnyMap, NoAnswer, Pair
from levkas_peers.structures import find_structures

pytestmark = pytest.mark.slow

SHAPE = (180, 230)
CENTRE = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])
SPREAD = float(np.hypot(*SHAPE)) / 2


def painting(seed):
    rng = np.random.default_rng(seed)
    noise = gaussian_filter(rng.standard_normal((SHAPE[0] + 120, SHAPE[1] + 120)), 4)
    patches = (noise > 0) * 1.0 + 0.5 * (gaussian_filter(rng.standard_normal(noise.shape), 9) > 0)
    grain = gaussian_filter(rng.standard_normal(noise.shape), 1.2)
    return gaussian_filter(patches, 0.8) + 0.4 * grain


def planted(name):
    """A map of one family: a degree of rotation, a shift, and what the family can bend."""
    form = LADDERS[name][-1]
    turn = np.deg2rad(1.5)
    linear = 1.01 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    if name == "quadratic":
        rows = np.vstack(
            [[0.012, -0.008], linear.T, [[0.004, -0.003], [0.002, 0.004], [-0.003, 0.002]]]
        )
        parameters = rows.ravel()
    else:
        parameters = np.array([*linear[0], 0.012, *linear[1], -0.008, 0.01, -0.006, 0.006, -0.004])
    return lambda points: form.apply(parameters, (points - CENTRE) / SPREAD) * SPREAD + CENTRE


def pair(function, seed=1, other=None):
    """The reference and a target in which reference points lie where `function` puts them."""
    big = painting(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    here = np.stack([x.ravel(), y.ravel()], 1)
    back = AnyMap(function).inverse(here)
    target = map_coordinates(
        big if other is None else painting(other), back[:, ::-1].T + 60, order=3
    )
    rng = np.random.default_rng(7)
    images = [big[60 : 60 + SHAPE[0], 60 : 60 + SHAPE[1]], target.reshape(SHAPE)]
    images = [(i + 0.01 * rng.standard_normal(SHAPE)).astype(np.float32) for i in images]
    valid = np.ones(SHAPE, bool)
    return Pair(
        images[0], valid, 1 + 0.5 * images[1], valid, Affine.identity(), (0, 0), Affine.identity()
    )


def lattice():
    x, y = np.meshgrid(np.linspace(15, SHAPE[1] - 16, 9), np.linspace(15, SHAPE[0] - 16, 7))
    return np.stack([x.ravel(), y.ravel()], 1)


def errors(answer, function):
    points = lattice()
    return np.linalg.norm(answer.found(points) - function(points), axis=1)


@pytest.mark.parametrize(
    ("name", "method"), [("quadratic", gdbicp_quadratic), ("radial", gdbicp_radial)]
)
def test_a_planted_map_is_found_between_pictures_of_another_gain(name, method):
    function = planted(name)
    one = pair(function)
    answer = method(one)
    assert answer.decision == "accept" and errors(answer, function).max() < 0.25
    assert answer.note.startswith("quadratic" if name == "quadratic" else "homography and radial")


def test_another_painting_is_not_aligned(monkeypatch):
    monkeypatch.setattr("levkas_peers.dual_bootstrap.MOST_STARTS", 3)
    with pytest.raises(NoAnswer, match="none of 3 starts"):
        gdbicp_radial(pair(planted("radial"), other=99))


def test_a_blank_picture_is_not_aligned():
    one = pair(planted("quadratic"))
    blank = np.ones(SHAPE, np.float32)
    with pytest.raises(NoAnswer):
        gdbicp_quadratic(
            Pair(
                one.reference,
                one.reference_valid,
                blank,
                one.target_valid,
                one.start,
                (0, 0),
                one.back,
            )
        )


@pytest.mark.parametrize("method", [opencv_sift_magsac, opencv_ecc])
def test_a_planted_homography_is_found_by_the_peers(method):
    from levkas.geometry.transforms import Homography

    matrix = np.array([[1.01, -0.02, 4.0], [0.018, 0.99, -3.0], [2e-5, -1e-5, 1.0]])
    one = pair(Homography(matrix))
    assert errors(method(one), Homography(matrix)).max() < 0.5


def test_faces_lie_on_an_edge_with_their_normal_across_it():
    image = np.zeros((60, 80)) + (np.arange(80) > 40.3)
    found = find_structures(gaussian_filter(image, 1.5), np.ones(image.shape, bool))
    strong = np.abs(found.faces[:, 0] - 40.5) < 3
    assert strong.any() and np.abs(found.faces[strong, 0] - 40.5).max() < 0.1
    assert np.abs(found.normals[strong, 0]).min() > 0.999


def test_every_form_lifted_is_the_same_map():
    points = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    for ladder in LADDERS.values():
        parameters = np.array([0.98, 0.05, 0.1, -0.2])
        expected = ladder[0].apply(parameters, points)
        for poorer, richer in pairwise(ladder):
            parameters = richer.lift[poorer.name](parameters)
            np.testing.assert_allclose(richer.apply(parameters, points), expected, atol=1e-12)


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """A built campaign: a photograph, and another of twice its size, with the truth of four points."""
    import cv2

    from levkas.building import build

    folder = tmp_path_factory.mktemp("compare")
    rng = np.random.default_rng(3)
    big = np.full((400, 480), 90, np.float32)
    for _ in range(300):
        x, y, r = (int(rng.integers(0, m)) for m in (480, 400, 26))
        cv2.circle(big, (x, y), r + 4, float(rng.integers(20, 235)), -1, cv2.LINE_AA)
    half = cv2.resize(big, (240, 200), interpolation=cv2.INTER_AREA)
    for part, picture in (("vis", half), ("photo", big)):
        (folder / part).mkdir()
        data = cv2.imencode(".png", np.dstack([picture] * 3).clip(0, 255).astype(np.uint8))[1]
        (folder / part / "icon1.png").write_bytes(data.tobytes())
    (folder / "campaign.toml").write_text(
        '[campaign]\nreference = { camera = "vis", band = "G" }\n'
        '[cameras.vis]\nkind = "image"\nfiles = "vis/{target}.png"\n'
        '[cameras.photo]\nkind = "image"\nfiles = "photo/{target}.png"\n'
        "[database]\nnative = true\n"
        '[targets]\nobjects = ["icon1"]\n'
    )
    list(build(folder))
    points = np.array([[40, 40], [200, 50], [180, 160], [60, 150.0]])
    (folder / "truth").mkdir()
    truth = {"cameras": {"photo": {"bands": ["R", "G", "B"]}}}
    (folder / "truth/truth.json").write_text(json.dumps(truth))
    np.save(folder / "truth/icon1_ref_px.npy", points)
    np.save(folder / "truth/icon1_photo_px.npy", np.stack([points * 2 + 0.5] * 4))
    return folder


def test_methods_are_set_side_by_side_with_errors_maps_and_memory(database, tmp_path):
    names = ["levkas", "mirhashemi2019", "opencv-sift-magsac"]
    rows = list(methods.compare(database, names, output=tmp_path))
    assert [row["method"] for row in rows] == names
    for row in rows:
        assert row["failure"] == "" and row["ssim"] > 0.9, row
        assert max(band["error_mean"] for band in row["bands"]) < 0.2
        assert row["peak_mib"] > 50 and row["cpu_seconds"] > 0
    figure = methods.draw(rows, tmp_path)
    assert len(figure.axes[0].lines) == 3 and sum(len(a.images) for a in figure.axes) == 2
    assert [one["failures"] for one in methods.summary(rows)] == [0, 0, 0]


def test_a_method_that_takes_too_long_is_stopped_and_counted_as_failed(database):
    (row,) = methods.compare(database, ["opencv-ecc"], limit_s=0.05)
    assert row["failure"] and not row["bands"]
    (one,) = methods.summary([row])
    assert one["failures"] == 1 and one["error_mean"] is None

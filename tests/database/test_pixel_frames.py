import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.core.files import write_json
from levkas.core.problems import Refused
from levkas.database.pixel_frames import (
    MappingRefused,
    find_map,
    find_position_sigma,
    map_points,
    map_table,
)
from levkas.geometry.transforms import Affine, Composed, Homography, Polynomial

GRID = Composed(Affine(np.array([[0.0, 1, 5], [-1, 0, 90]])), Affine.scaling(2.0))


def polynomial(scale, offset):
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 300, (200, 2))
    bent = points * scale + offset + 1e-5 * (points - 150) ** 2
    return Polynomial.fit(points, bent, order=3)


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    folder = tmp_path_factory.mktemp("db")
    homography = Homography(np.array([[0.5, 0.01, 3], [0, 0.52, 2], [1e-5, 0, 1]]))
    grid = {"transform": GRID.to_dict(), "size": [40, 50]}
    layers = {
        "vis": (
            "vis:550 nm",
            {"540 nm": Affine(np.array([[1.0, 0, 0.5], [0, 1, 0]])), "550 nm": Affine.identity()},
            (300, 200),
        ),
        "d80": (
            {"camera": "d80", "band": "G"},
            {"R": polynomial(2.7, 8), "G": polynomial(2.7, 9)},
            (900, 600),
        ),
        "d80@45-degree": ("d80@45-degree:G", {"G": homography}, (900, 600)),
    }
    for name, (target, bands, size) in layers.items():
        record = {
            "reference": {"camera": "vis", "band": "550 nm"} if name == "vis" else "vis:550 nm",
            "target": target,
            "verdict": {"decision": "accept", "reasons": []},
            "bands": {k: {"transform": t.to_dict(), "size": list(size)} for k, t in bands.items()},
            "grid": grid,
        }
        write_json(folder / "objects" / "icon1" / "registration" / f"{name}.json", record)
    refused = {
        "verdict": {"decision": "refuse", "reasons": ["7 matches of 10"], "next_step": "Add pairs."}
    }
    write_json(folder / "objects" / "icon1" / "registration" / "v10.json", {**refused, "bands": {}})
    return folder


FRAMES = ["grid", "vis", "vis:540", "d80", "d80:R", "d80@45-degree", "d80@45-degree:G"]


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(FRAMES), st.sampled_from(FRAMES), st.integers(0, 2**32 - 1))
def test_there_and_back_is_where_it_began(database, source, target, seed):
    start = np.random.default_rng(seed).uniform(0, 39, (20, 2))
    points = map_points(database, "icon1", start, source="grid", target=source)
    assert np.isfinite(points).any()
    there = map_points(database, "icon1", points, source=source, target=target)
    back = map_points(database, "icon1", there, source=target, target=source)
    known = np.isfinite(there).all(axis=1)
    np.testing.assert_allclose(back[known], points[known], atol=1e-6)
    np.testing.assert_allclose(
        find_map(database, "icon1", source, target).inverse(there)[known], points[known], atol=1e-6
    )


def test_a_path_through_the_reference_is_the_composition(database):
    reference = GRID(np.array([[10.0, 20.0]]))
    mapped = map_points(database, "icon1", np.array([[10.0, 20.0]]), source="grid", target="d80")
    np.testing.assert_allclose(mapped, polynomial(2.7, 9)(reference), atol=1e-9)


def test_outside_what_is_known_is_nan_in_the_same_rows(database):
    text = "x,y\n10,20\n-0.6,5\n39.4,49.4\n40,10\nnan,nan\n"
    rows = map_table(database, "icon1", text, source="grid", target="vis").splitlines()
    assert rows[0] == "x,y"
    assert [row == "nan,nan" for row in rows[1:]] == [False, True, False, True, True]
    # 899, 599 is on the colour image but beyond the reference's 300 x 200.
    for target in ("vis", "d80:R", "grid"):
        out = map_points(database, "icon1", np.array([[899.0, 599.0]]), source="d80", target=target)
        assert np.isnan(out).all()


def test_an_edge_that_went_through_a_map_is_still_on_the_image(database):
    corners = np.array([[-0.5, -0.5], [39.5, 49.5]])
    there = map_points(database, "icon1", corners, source="grid", target="vis")
    back = map_points(database, "icon1", there, source="vis", target="grid")
    np.testing.assert_allclose(back, corners, atol=1e-9)


NO_FRAMES = ["", ":R", "a:", "a@", "@s", "a@:R", "nir", "vis:700 nm", "v10"]


@pytest.mark.parametrize(
    ("name", "source"),
    [("icon2", "grid"), ("../icon1", "grid"), *(("icon1", frame) for frame in NO_FRAMES)],
)
def test_frames_that_are_none_or_not_there_are_refused(database, name, source):
    with pytest.raises(Refused):
        map_points(database, name, np.zeros((1, 2)), source=source, target="grid")


def test_tables_that_are_none_are_refused_with_all_their_lines(database):
    with pytest.raises(MappingRefused):
        map_table(database, "icon1", "1,2\n", source="grid", target="vis")
    with pytest.raises(MappingRefused) as info:
        map_table(database, "icon1", "x,y\n1,a\n\n3\n4,5\n", source="grid", target="vis")
    assert [p.found for p in info.value.problems] == ["1,a", "3"]
    assert map_table(database, "icon1", "\ufeffx,y\n", source="grid", target="vis") == "x,y\n"


def test_the_sigma_of_a_band_lies_on_the_grid_and_is_nan_where_it_does_not_see(database):
    path = database / "objects" / "icon1" / "registration" / "vis.json"
    record = json.loads(path.read_text())
    # Grows by 0.01 px for each px to the right; the band lies 0.5 px to the side of the reference.
    x, y = [0.0, 299.0], [0.0, 199.0]
    record["bands"]["540 nm"]["sigma"] = {"x": x, "y": y, "sigma_px": [[0.0, 2.99]] * 2}
    write_json(path, record)
    found = find_position_sigma(database, "icon1", "vis", band="540")
    assert found.shape == (50, 40)
    points = np.array([[3.0, 7.0], [30.0, 20.0]])
    where = find_map(database, "icon1", "grid", "vis:550 nm")(points)
    for (column, row), (across, _) in zip(points.astype(int), where, strict=True):
        np.testing.assert_allclose(found[row, column], 0.01 * across, rtol=1e-5)
    observed = find_map(database, "icon1", "grid", "vis:540 nm")
    y, x = np.mgrid[:50, :40]
    outside = np.isnan(observed(np.stack([x.ravel(), y.ravel()], 1))).any(1).reshape(50, 40)
    np.testing.assert_array_equal(np.isnan(found), outside)
    assert find_position_sigma(database, "icon1", "d80") is None

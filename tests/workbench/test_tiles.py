"""Tiles in the workbench: each a frame against the reference, one of the reference's own beside a neighbour. Where they lie is written down, not found."""

import json

import cv2
import numpy as np
import pytest

from levkas.campaign.edits import read_edits
from levkas.core.cube import Band, Cube
from levkas.core.problems import Refused
from levkas.database.layers import Layer, write_tiffs
from levkas.geometry.transforms import Affine
from levkas.workbench.library import FrameMissing, Library
from levkas.workbench.server.routes import describe_frame
from levkas.workbench.session import OperationRefused

CORNERS = {"r1c1": (0, 0), "r1c2": (80, 2), "r2c1": (-1, 70), "r2c2": (81, 72)}
TILE, MOSAIC, SHIFT = (120, 100), (202, 173), (1, 0)
REASON = "shows nothing that any other tile shows"
CAMPAIGN = """[campaign]
reference = { camera = "photo" }
[cameras.photo]
kind = "image"
files = "photo/{target}_r{row}c{column}.png"
[cameras.xray]
kind = "image"
files = "xray/{target}_{tile}.png"
"""


def shifted(x, y):
    return Affine(np.array([[1.0, 0, -x], [0, 1, -y]]))


@pytest.fixture
def folder(tmp_path):
    """Four tiles of which the last is left out, and two of a radiograph, cut at whole px; in the mosaic they lie one px to the right."""
    scene = cv2.GaussianBlur(np.random.default_rng(3).uniform(0, 9000, (200, 240)), (0, 0), 2)
    scene = scene.astype(np.uint16)
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    kept = tmp_path / "database.kept/one"
    records = tmp_path / "database/objects/one/registration"
    records.mkdir(parents=True)
    places = {"photo": CORNERS, "xray": {"left": (10, 20), "right": (60, 40)}}
    for camera, corners in places.items():
        (tmp_path / camera).mkdir()
        (kept / camera / "native").mkdir(parents=True)
        tiles = {}
        for name, (x, y) in corners.items():
            part = scene[y + 5 : y + 5 + TILE[1], x + 5 : x + 5 + TILE[0]]
            cv2.imwrite(str(tmp_path / f"{camera}/one_{name}.png"), part)
            values = part.astype(np.float32)[..., None]
            cube = Cube(values, np.zeros(values.shape, np.uint8), None, (Band("grey"),), "counts")
            stem = kept / camera / f"native/one_{camera}_tile-{name}"
            write_tiffs(stem, Layer("one", camera, ""), cube)
            onto = shifted(x + SHIFT[0], y + SHIFT[1]).to_dict()
            tiles[name] = {
                "verdict": {"decision": "accept", "reasons": [], "next_step": ""},
                "size": list(TILE), "bands": {"grey": {"size": list(TILE), "transform": onto}},
            }  # fmt: skip
        lost = "r2c2" if camera == "photo" else "right"
        verdict = {"decision": "refuse", "reasons": [REASON], "next_step": ""}
        tiles[lost] = {"verdict": verdict, "size": list(TILE)}
        overlap = {"tiles": ["r2c1", "r2c2"], "windows": 0, "used": False, "reason": "unlike"}
        known = {"transform": Affine.identity().to_dict(), "size": list(MOSAIC)}
        record = {
            "object": "one", "camera": camera, "setup": "", "method": "levkas",
            "reference": {"camera": "photo", "band": "grey", "size": list(MOSAIC)},
            "target": {"camera": camera, "setup": "", "band": "grey"},
            "grid": {"size": MOSAIC, "transform": Affine.identity().to_dict(), "px_per_mm": None},
            "verdict": {"decision": "warn", "reasons": [f"Tile {lost} {REASON}"], "next_step": ""},
            "model": {"kind": "tiles"}, "errors": {}, "trace": {}, "bands": {"grey": known},
            "tiles": tiles, "placement": {"overlaps": [overlap]},
        }  # fmt: skip
        (records / f"{camera}.json").write_text(json.dumps(record))
    return tmp_path


def row_of(library, camera, tile=""):
    return next(r for r in library.list() if (r["camera"], r["tile"]) == (camera, tile))


def test_every_tile_is_listed_and_a_hole_has_its_reason(folder):
    rows = Library(folder).list()
    assert [(r["camera"], r["tile"]) for r in rows] == [
        ("photo", ""), *(("photo", tile) for tile in CORNERS), ("xray", "left"), ("xray", "right")
    ]  # fmt: skip
    assert [r["reference"] for r in rows] == [True] + 6 * [False]
    lost = {(r["camera"], r["tile"]): r["reason"] for r in rows if r["decision"] == "refuse"}
    assert lost == {("photo", "r2c2"): REASON, ("xray", "right"): REASON}


def test_a_tile_of_the_reference_is_corrected_beside_a_neighbour(folder):
    library = Library(folder)
    frame = library.open(row_of(library, "photo", "r2c2")["id"])
    told = describe_frame(frame)
    assert (told["camera"], told["reference"]["camera"]) == ("photo#r2c2", "photo#r1c2")
    assert told["size"] == told["target_size"] == list(TILE) and not told["built"]
    assert told["verdict"]["next_step"]
    choices = {one["tile"]: one["id"] for one in library.neighbours(frame.view)}
    assert set(choices) == {"r1c1", "r1c2", "r2c1"} and choices["r1c2"] == frame.key
    other = library.open(choices["r2c1"])
    for one in (frame, other):
        one.session.apply("add", [90.0, 10.0, 9.0, 8.0])
    assert set(read_edits(folder / "edits.toml").frames) == {
        ("one", "photo#r2c2#r1c2"), ("one", "photo#r2c2#r2c1")
    }  # fmt: skip
    with pytest.raises(OperationRefused):
        frame.session.draw(((1, 1), (90, 1), (90, 90)))
    accepted = library.open(row_of(library, "photo", "r1c2")["id"])
    step = np.subtract(CORNERS[accepted.view.beside.tile], CORNERS["r1c2"])
    np.testing.assert_allclose(accepted.built(np.array([[30.0, 40.0]]))[0] - [30, 40], step)
    with pytest.raises(FrameMissing):
        library.open(choices["r2c1"].replace("-", "x-"))


def test_a_tile_of_another_camera_is_corrected_against_the_mosaic(folder):
    library = Library(folder)
    right, left = (library.open(row_of(library, "xray", t)["id"]) for t in ("right", "left"))
    assert tuple(right.session.found.size) == MOSAIC and right.session.found.target_size == TILE
    mosaic, tile = left.picture("reference"), left.picture("target")
    assert mosaic.size == MOSAIC and tile.size == TILE
    x, y = np.add((10, 20), SHIFT)  # both are stretched to eight bits, each by its own range
    part = mosaic.pixels[y : y + 60, x : x + 100].astype(float)
    assert (
        np.corrcoef(part.ravel(), tile.pixels[:60, :100].ravel().astype(float))[0, 1] > 0.99
    )  # 0.94 where it is a px off
    right.session.apply("add", [90.0, 60.0, 29.0, 20.0])
    assert set(read_edits(folder / "edits.toml").frames) == {("one", "xray#right")}
    assert library.registered_with(right)["registered"] is None


@pytest.mark.parametrize(
    "frame",
    ["photo#r2c2", "photo#r2c2#r2c2", "xray#left#right", "xray#top", "photo#r2c2#r9c9"],
)
def test_a_tile_is_named_with_a_neighbour_where_it_is_of_the_reference(folder, frame):
    from levkas.building.plan import read_plan

    pairs = "added = [[1.0, 2.0, 3.0, 4.0]]"
    (folder / "edits.toml").write_text(f'version = 1\n[objects.one.cameras."{frame}"]\n{pairs}\n')
    with pytest.raises(Refused):
        read_plan(folder)

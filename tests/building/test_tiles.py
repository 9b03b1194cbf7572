"""Paintings in tiles, from files to layers. Tiles are cut out of one picture by known homographies, with noise."""

import json
from itertools import product

import cv2
import numpy as np
import pytest
import tifffile

from levkas.building import build
from levkas.database.pixel_frames import find_map, map_points
from levkas.geometry.transforms import Homography

pytestmark = pytest.mark.slow
WIDTH, HEIGHT = 460, 380
TILE = (220, 190)
NOISE = 0.004
KEYS = """[campaign]
reference = { camera = "photo" }
[cameras.photo]
kind = "image"
files = "photo/{target}_r{row}c{column}.tif"
[cameras.infrared]
kind = "image"
files = "infrared/{target}.tif"
"""
POSITIONS = "tile,x,y\n" + "".join(
    f"r{i + 1}c{j + 1},{130 * j},{140 * i}\n" for i in range(2) for j in range(3)
)
XRAY = """[cameras.xray]
kind = "image"
files = "xray/{target}_{tile}.tif"
"""


def painting(seed):
    """Detail of all sizes, none finer than 2 px, 0.1 … 0.9."""
    rng = np.random.default_rng(seed)
    total = np.zeros((HEIGHT + 80, WIDTH + 80), np.float32)
    for blur in (1.2, 2.5, 5.0, 12.0):
        layer = cv2.GaussianBlur(rng.standard_normal(total.shape).astype(np.float32), (0, 0), blur)
        total += layer / layer.std()
    return np.clip(0.5 + 0.1 * total, 0.05, 0.95)


def cut(picture, homography, size, rng):
    """Return what a frame sees: its px → px of the picture by a homography, the spline of order 3 in between."""
    from scipy.ndimage import map_coordinates

    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    places = homography(np.stack([x.ravel(), y.ravel()], 1))
    values = map_coordinates(picture, places[:, ::-1].T, order=3, mode="constant", cval=0.0)
    values = values.reshape(size[::-1]) + NOISE * rng.standard_normal(size[::-1])
    return np.clip(np.round(values * 60000), 0, 65535).astype(np.uint16)


def laid(x, y, turn, scale=1.0, tilt=(0.0, 0.0)):
    c, s = scale * np.cos(np.radians(turn)), scale * np.sin(np.radians(turn))
    return Homography(np.array([[c, -s, x], [s, c, y], [*tilt, 1.0]]))


def write(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, values, photometric="minisblack")


def make(folder, *, xray=False, seed=1):
    """Write the campaign; return where its frames lie, px of each → px of the picture."""
    rng, picture = np.random.default_rng(seed), painting(seed)
    other = cv2.GaussianBlur(picture, (0, 0), 0.8) ** 1.3
    frames = {}
    for i, j in product(range(2), range(3)):
        x, y = 40 + 130 * j + rng.uniform(-3, 3), 40 + 140 * i + rng.uniform(-3, 3)
        frames[f"photo#r{i + 1}c{j + 1}"] = laid(x, y, rng.uniform(-0.6, 0.6), tilt=(1e-6, -1e-6))
    frames["infrared"] = laid(45, 42, 1.5, 1.45)
    for name, x in (("left", 50), ("right", 230)) if xray else ():
        frames[f"xray#{name}"] = laid(x, 60, -0.8, 0.9)
    for frame, homography in frames.items():
        camera, _, tile = frame.partition("#")
        size = {"photo": TILE, "infrared": (300, 250), "xray": (260, 340)}[camera]
        source = picture if camera == "photo" else other
        name = f"{camera}/one{'_' if tile else ''}{tile}.tif"
        write(folder / name, cut(source, homography, size, rng))
    (folder / "campaign.toml").write_text(KEYS + (XRAY if xray else ""))
    return frames


def steps_of(folder):
    return {(s.key.camera, s.key.stage): s for s in build(folder) if s.finished}


def record_of(folder, camera):
    path = folder / f"database/objects/one/registration/{camera}.json"
    return json.loads(path.read_text())


def error(folder, frames, source, target):
    """Distances, px of the target, of a map between two frames from the truth."""
    x, y = np.meshgrid(np.linspace(5, TILE[0] - 6, 12), np.linspace(5, TILE[1] - 6, 12))
    points = np.stack([x.ravel(), y.ravel()], 1)
    found = map_points(folder / "database", "one", points, source=source, target=target)
    truth = frames[target].inverse(frames[source](points))
    known = np.isfinite(found).all(1)
    assert known.sum() > 5
    return np.linalg.norm(found - truth, axis=1)[known]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiles")
    frames = make(folder)
    steps = steps_of(folder)
    assert [s.line for s in steps.values() if s.state != "done"] == []
    return folder, frames


def test_every_tile_is_placed_and_mapped(built):
    folder, frames = built
    record = record_of(folder, "photo")
    assert record["verdict"]["decision"] == "accept", record["verdict"]
    assert len(record["tiles"]) == 6
    for source, target in (
        ("photo#r1c1", "photo#r1c2"), ("photo#r1c2", "photo#r2c2"), ("photo#r1c2", "infrared"),
        ("photo#r2c3", "infrared"),
    ):  # fmt: skip
        found = error(folder, frames, source, target)
        assert found.mean() < 0.06, (source, target)
        assert found.max() < 0.25, (source, target)


def test_the_layer_is_the_picture_without_a_seam(built):
    folder, frames = built
    from scipy.ndimage import map_coordinates

    import levkas

    values = levkas.open(folder / "database")["one"]["photo"].values[..., 0]
    to_tile = find_map(folder / "database", "one", "grid", "photo#r1c1")
    y, x = np.mgrid[30:150, 30:190]
    points = np.stack([x.ravel(), y.ravel()], 1).astype(float)
    places = frames["photo#r1c1"](to_tile(points))
    truth = map_coordinates(painting(1), places[:, ::-1].T, order=3).reshape(x.shape)
    off = values[30:150, 30:190] / 60000 - truth
    assert np.nanstd(off) < 2 * NOISE


def test_steps_between_tiles_are_said_and_other_positions_place_them_anew(tmp_path):
    make(tmp_path)
    keys, infrared = KEYS.split("[cameras.infrared]")
    infrared = "[cameras.infrared]" + infrared
    bright = tmp_path / "photo/one_r1c2.tif"
    write(bright, np.clip(tifffile.imread(bright) * 1.06, 0, 65535).astype(np.uint16))
    assert steps_of(tmp_path)["photo", "resample"].warnings
    (tmp_path / "stage.csv").write_text(POSITIONS)
    (tmp_path / "campaign.toml").write_text(keys + 'positions = "stage.csv"\n' + infrared)
    assert steps_of(tmp_path)["photo", "resample"].state == "done"
    (tmp_path / "stage.csv").write_text(POSITIONS.replace("130", "131"))
    steps = steps_of(tmp_path)
    assert [steps["photo", stage].state for stage in ("register", "resample")] == ["done", "done"]
    assert steps["infrared", "register"].state == "done"  # it lies on tiles that may lie elsewhere


def test_tiles_in_wrong_order_one_twice_and_one_missing(tmp_path):
    """Names say where tiles are, and they are wrong: what tiles show goes before."""
    frames = make(tmp_path)
    (tmp_path / "infrared/one.tif").unlink()
    (tmp_path / "infrared").rmdir()
    text = KEYS[: KEYS.index("[cameras.infrared]")]
    (tmp_path / "campaign.toml").write_text(text)
    photo = tmp_path / "photo"
    (photo / "one_r1c1.tif").rename(photo / "aside.tif")
    (photo / "one_r2c2.tif").rename(photo / "one_r1c1.tif")
    (photo / "aside.tif").rename(photo / "one_r2c2.tif")
    twin = tifffile.imread(photo / "one_r1c2.tif")
    (photo / "one_r1c3.tif").unlink()
    write(photo / "one_r3c1.tif", twin)
    steps = steps_of(tmp_path)
    assert {s.state for s in steps.values()} == {"done"}
    record = record_of(tmp_path, "photo")
    lost = [t for t, one in record["tiles"].items() if "bands" not in one]
    assert len(lost) == 1
    assert lost[0] in ("r1c2", "r3c1")
    frames["photo#r1c1"], frames["photo#r2c2"] = frames["photo#r2c2"], frames["photo#r1c1"]
    assert error(tmp_path, frames, "photo#r1c1", "photo#r2c3").mean() < 0.06


def test_refused_tiles_are_placed_by_pairs_and_any_order_of_them_gives_the_same_bytes(tmp_path):
    """Two tiles too blurred to be found: that of the reference is found where pairs put it, one of plain ground is placed by hand."""
    frames = make(tmp_path, xray=True)
    text = KEYS[: KEYS.index("[cameras.infrared]")] + XRAY
    (tmp_path / "campaign.toml").write_text(text)
    rng = np.random.default_rng(5)
    for path, blur in (("photo/one_r2c3.tif", 4), ("xray/one_right.tif", 60)):
        values = tifffile.imread(tmp_path / path).astype(np.float32)
        values = cv2.GaussianBlur(values, (0, 0), blur) + 1800 * rng.standard_normal(values.shape)
        write(tmp_path / path, np.clip(values, 0, 65535).astype(np.uint16))
    steps_of(tmp_path)
    for camera, lost in (("photo", "r2c3"), ("xray", "right")):
        tiles = record_of(tmp_path, camera)["tiles"]
        assert [t for t, one in tiles.items() if "bands" not in one] == [lost]
    to_mosaic = find_map(tmp_path / "database", "one", "photo#r1c2", "grid")
    own = np.array([[145.0, 10], [210, 20], [205, 170], [150, 160], [180, 90]])
    there = frames["photo#r2c3"].inverse(frames["photo#r2c2"](own))
    beside = np.hstack([own, there + rng.normal(0, 0.5, own.shape)])
    own = np.array([[100.0, 40], [200, 30], [205, 170], [110, 160], [150, 90]])
    there = frames["xray#right"].inverse(frames["photo#r1c2"](own))
    onto = np.hstack([to_mosaic(own), there + rng.normal(0, 0.5, own.shape)])

    def edited(order):
        tables = (("photo#r2c3#r2c2", beside, ""), ("xray#right", onto, 'accept = "by hand"\n'))
        rows = {name: [[round(float(v), 2) for v in row] for row in pairs[::order]]
                for name, pairs, _ in tables}  # fmt: skip
        parts = [f'[objects.one.cameras."{n}"]\n{more}added = {rows[n]}\n' for n, _, more in tables]
        (tmp_path / "edits.toml").write_text("version = 1\n" + "".join(parts[::order]))
        assert {s.state for s in steps_of(tmp_path).values()} <= {"done", "fresh"}
        base = tmp_path / "database/objects/one"
        return {p.name: p.read_bytes() for p in sorted(base.rglob("*")) if p.is_file()}

    first = edited(1)
    record = record_of(tmp_path, "photo")
    assert record["verdict"]["decision"] == "accept" and record["pairs_by_hand"] == 5
    found = error(tmp_path, frames, "photo#r2c2", "photo#r2c3")
    assert found.max() < 0.5  # of a picture blurred over 4 px
    record = record_of(tmp_path, "xray")
    assert record["verdict"]["decision"] == "warn"
    assert record["tiles"]["right"]["verdict"]["decision"] == "by hand"
    found = error(tmp_path, frames, "photo#r1c2", "xray#right")
    assert found.mean() < 1.5
    assert edited(-1) == first

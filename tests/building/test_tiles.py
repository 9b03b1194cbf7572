"""Paintings in tiles, from files to layers. Tiles are cut out of one picture by known homographies, with noise."""

import json
import subprocess
import sys
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from levkas.building import build
from levkas.core.digests import hash_tree
from levkas.database.pixel_frames import find_map, map_points
from levkas.geometry.transforms import Homography
from levkas.quality.evaluation.layer_report import assess

sys.path.insert(0, str(Path(__file__).parent))
from circumstances import run

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
    whole = assess(folder / "database")
    assert {r["camera"]: len(r.get("tiles", ())) for r in whole.results}["photo"] == 6


@pytest.mark.slow
def test_macro_photographs_are_tiles_of_a_tenth_of_the_scale(tmp_path):
    rng, picture = np.random.default_rng(3), painting(3)
    frames = {"photo": laid(40, 40, 0.0), "macro#a": laid(90, 80, 2.0, 0.12)}
    frames["macro#b"] = laid(280, 200, -1.0, 0.1)
    write(tmp_path / "photo/one.tif", cut(picture, frames["photo"], (WIDTH, HEIGHT), rng))
    for name in "ab":
        tile = cut(picture, frames[f"macro#{name}"], (1500, 1200), rng)
        write(tmp_path / f"macro/one_{name}.tif", tile)
    (tmp_path / "campaign.toml").write_text(
        """[campaign]
reference = { camera = "photo" }
[cameras.photo]
kind = "image"
files = "photo/{target}.tif"
[cameras.macro]
kind = "image"
files = "macro/{target}_{tile}.tif"
"""
    )
    assert [step.line for step in steps_of(tmp_path).values() if step.state != "done"] == []
    for target in ("macro#a", "macro#b"):
        record = record_of(tmp_path, "macro")
        assert record["tiles"][target[-1]]["verdict"]["decision"] == "accept", record["tiles"]
        points = np.stack(np.meshgrid(np.linspace(20, 1480, 9), np.linspace(20, 1180, 9)), -1)
        points = points.reshape(-1, 2)
        found = map_points(tmp_path / "database", "one", points, source=target, target="photo")
        off = np.linalg.norm(found - frames["photo"].inverse(frames[target](points)), axis=1)
        assert off.mean() < 0.05, target  # px of the overview: half a px of the macro
        assert off.max() < 0.15, target


@pytest.mark.slow
def test_tiles_are_levelled_by_recorded_gains_only_where_that_is_asked(tmp_path):
    make(tmp_path)
    keys, infrared = KEYS.split("[cameras.infrared]")
    infrared = "[cameras.infrared]" + infrared
    bright = tmp_path / "photo/one_r1c2.tif"
    counts = tifffile.imread(bright)
    write(bright, np.clip(counts * 1.06, 0, 65535).astype(np.uint16))
    found = {}
    for name, more in (("as captured", ""), ("levelled", "level_tiles = true\n")):
        (tmp_path / "campaign.toml").write_text(keys + more + infrared)
        steps = steps_of(tmp_path)
        assert steps["photo", "register"].state == ("fresh" if more else "done")
        assert steps["photo", "resample"].state == "done"
        found[name] = steps["photo", "resample"].warnings
    (tmp_path / "stage.csv").write_text(POSITIONS)
    (tmp_path / "campaign.toml").write_text(keys + 'positions = "stage.csv"\n' + infrared)
    assert steps_of(tmp_path)["photo", "resample"].state == "done"
    (tmp_path / "stage.csv").write_text(POSITIONS.replace("130", "131"))
    steps = steps_of(tmp_path)
    assert [steps["photo", stage].state for stage in ("register", "resample")] == ["done", "done"]
    assert steps["infrared", "register"].state == "done"  # it lies on tiles that may lie elsewhere
    assert any("differ by" in text and "r1c2" in text for text in found["as captured"])
    assert not any("where they meet" in text for text in found["levelled"]), found["levelled"]
    assert any("levelled by gains of -" in text for text in found["levelled"])


def test_built_again_all_is_fresh(built):
    folder, _ = built
    assert {s.state for s in steps_of(folder).values()} == {"fresh"}


@pytest.mark.slow
def test_a_tile_of_another_painting_is_a_hole(tmp_path):
    frames = make(tmp_path, xray=True)
    rng = np.random.default_rng(5)
    write(tmp_path / "photo/one_r2c3.tif", cut(painting(7), laid(100, 90, 0.0), TILE, rng))
    write(tmp_path / "xray/one_right.tif", cut(painting(8), laid(100, 60, 0.0), (260, 340), rng))
    steps = steps_of(tmp_path)
    assert {s.state for s in steps.values()} == {"done"}
    for camera, lost in (("photo", "r2c3"), ("xray", "right")):
        record = record_of(tmp_path, camera)
        assert record["verdict"]["decision"] == "warn"
        assert [t for t, one in record["tiles"].items() if "bands" not in one] == [lost]
        assert any(lost in reason for reason in record["verdict"]["reasons"])
    found = error(tmp_path, frames, "photo#r1c1", "xray#left")
    assert found.mean() < 0.06
    assert found.max() < 0.25


def test_the_report_shows_the_tiles(built):
    folder, _ = built
    page = (folder / "database/objects/one/report.html").read_text()
    assert "6 tiles of 6" in page
    assert 'aria-label="tiles of the layer"' in page


def test_of_a_large_mosaic_some_bands_are_held_or_a_coarser_overview(built, monkeypatch):
    from levkas.building.plan import read_plan
    from levkas.database.layout import Places
    from levkas.registration import RegistrationRefused
    from levkas.stages import tiles

    folder, _ = built
    plan = read_plan(folder)
    places = Places(folder / "database")
    native = tiles.TiledCapture(plan.captures[0], places, places.kept_native("one", "photo"), {})
    width, height = native.placed.size
    (whole,) = native.images("grey")
    assert whole.label == "grey"
    monkeypatch.setattr(tiles, "MOST_SAMPLES", width * height - 1)
    with pytest.raises(RegistrationRefused) as refused:
        native.images("grey")
    assert refused.value.problems[0].code == "E_SIZE"
    (overview,) = native.images("grey", step=native.step)
    assert overview.size == (width // 2, height // 2)
    inside = np.s_[: height // 2 * 2, : width // 2 * 2]
    means = whole.values[inside].reshape(height // 2, 2, width // 2, 2).mean((1, 3))
    off = (overview.values - means)[20:-20, 20:-20]
    assert np.nanstd(off) < 0.1 * np.nanstd(means)
    (part,) = native.images("grey", (30, 40, 130, 90))
    ratio = part.values / whole.values[40:90, 30:130]  # counts: each is a share of its own largest
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=1e-4)


@pytest.mark.slow
def test_other_tiles_are_registered_to_a_mosaic_too_large_to_be_held(tmp_path, monkeypatch):
    from levkas.stages import tiles

    frames = make(tmp_path, xray=True)
    campaign = tmp_path / "campaign.toml"
    campaign.write_text(
        campaign.read_text().replace("infrared/{target}.tif", "infrared/{target}{tile}.tif")
    )
    infrared = tmp_path / "infrared/one.tif"
    infrared.rename(infrared.with_name("one1.tif"))  # the only tile, of more px than are held
    frames["infrared#1"] = frames.pop("infrared")
    monkeypatch.setattr(tiles, "MOST_SAMPLES", 119_000)
    assert [step.line for step in steps_of(tmp_path).values() if step.state != "done"] == []
    for target in ("xray#left", "xray#right", "infrared#1"):
        found = error(tmp_path, frames, "photo#r1c2", target)
        assert found.mean() < 0.08, target
        assert found.max() < 0.25, target


@pytest.mark.slow
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
    assert any("shows the same as" in reason for reason in record["verdict"]["reasons"])
    frames["photo#r1c1"], frames["photo#r2c2"] = frames["photo#r2c2"], frames["photo#r1c1"]
    assert error(tmp_path, frames, "photo#r1c1", "photo#r2c3").mean() < 0.06


@pytest.mark.slow
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
    assert any("Tile right" in r and "by hand" in r for r in record["verdict"]["reasons"])
    found = error(tmp_path, frames, "photo#r1c2", "xray#right")
    assert found.mean() < 1.5
    assert edited(-1) == first


def make_few(folder, *, plain=(), overlap=90, positions=False):
    """Write a campaign of 2 x 2 tiles, and a radiograph in one; `plain` rectangles of the painting, x0, y0, x1, y1, are gold without texture."""
    rng, picture = np.random.default_rng(11), painting(11)
    for x0, y0, x1, y1 in plain:
        picture[y0:y1, x0:x1] = 0.5
    frames = {}
    for i, j in product(range(2), range(2)):
        x, y = 40 + (TILE[0] - overlap) * j, 40 + (TILE[1] - overlap) * i
        frames[f"photo#r{i + 1}c{j + 1}"] = laid(x + rng.uniform(-2, 2), y, rng.uniform(-0.5, 0.5))
    for name, homography in frames.items():
        tile = cut(picture, homography, TILE, rng)
        write(folder / f"photo/one_{name.partition('#')[2]}.tif", tile)
    frames["xray#all"] = laid(70, 60, -0.8, 0.9)
    other = cv2.GaussianBlur(picture, (0, 0), 0.8) ** 1.3
    write(folder / "xray/one_all.tif", cut(other, frames["xray#all"], (260, 240), rng))
    text = KEYS[: KEYS.index("[cameras.infrared]")]
    if positions:
        text += 'positions = "stage.csv"\n'
        rows = [f"r{i + 1}c{j + 1},{(TILE[0] - overlap) * j},{(TILE[1] - overlap) * i}\n"
                for i, j in product(range(2), range(2))]  # fmt: skip
        (folder / "stage.csv").write_text("tile,x,y\n" + "".join(rows))
    (folder / "campaign.toml").write_text(text + XRAY)
    return frames


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    folder = tmp_path_factory.mktemp("few") / "campaign"
    make_few(folder)
    assert {s.state for s in steps_of(folder).values()} == {"done"}
    return folder, hash_tree(folder / "database")


@pytest.mark.slow
def test_order_of_files_threads_and_rows_change_no_byte(few, tmp_path):
    folder, expected = few
    assert run(folder, tmp_path / "threads", "3 threads, 97 rows") == expected


UNTIL = """
import os, signal, sys, threading, time
from pathlib import Path
from levkas.building import build
def die():
    while not Path(sys.argv[3]).exists():
        time.sleep(0.002)
    os.kill(os.getpid(), signal.SIGKILL)
threading.Thread(target=die, daemon=True).start()
for step in build(sys.argv[1], output=sys.argv[2]):
    if step.finished and step.label == sys.argv[4]:
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_build_that_is_killed_among_its_tiles_goes_on(few, tmp_path):
    """Killed while tiles are calibrated, then when those of the reference are placed: the third build ends in the bytes of one."""
    folder, expected = few
    output = tmp_path / "database"
    third = tmp_path / "database.kept/one/photo/native/one_photo_tile-r2c1.tif"
    for file, step in ((third, ""), (tmp_path / "never", "one/photo register")):
        command = [sys.executable, "-c", UNTIL, folder, output, file, step]
        assert subprocess.run(list(map(str, command)), check=False).returncode == -9
        assert not (output / "catalogue.csv").exists()
    steps = [s for s in build(folder, output=output) if s.finished]
    states = {(s.key.camera, s.key.stage): s.state for s in steps}
    assert states["photo", "calibrate"] == states["photo", "register"] == "fresh"
    assert hash_tree(output) == expected


@pytest.mark.slow
def test_gold_without_texture_in_one_overlap_is_passed_by_others(tmp_path):
    """What r1c1 and r1c2 share is plain; both are held by the tiles below them."""
    frames = make_few(tmp_path, plain=((165, 0, 265, 240),))
    assert {s.state for s in steps_of(tmp_path).values()} == {"done"}
    record = record_of(tmp_path, "photo")
    assert record["verdict"]["decision"] == "accept", record["verdict"]
    used = [o["tiles"] for o in record["placement"]["overlaps"] if o["used"]]
    assert ["r1c1", "r1c2"] not in used and ["r1c1", "r2c1"] in used
    found = error(tmp_path, frames, "photo#r1c1", "photo#r2c2")
    assert found.mean() < 0.15 and found.max() < 0.4


@pytest.mark.slow
def test_a_tile_that_only_its_position_holds_is_doubtful(tmp_path):
    """All that r1c2 shares with others is plain gold: it lies where the stage says, and nobody is told that it is right."""
    make_few(tmp_path, plain=((165, 0, 265, 235), (165, 135, 395, 235)), positions=True)
    steps_of(tmp_path)
    record = record_of(tmp_path, "photo")
    assert record["verdict"]["decision"] == "warn"
    assert set(record["placement"]["by_position"]) == {"r1c2"}
    assert record["tiles"]["r1c2"]["verdict"]["decision"] == "warn"
    (reason,) = record["verdict"]["reasons"]
    assert reason.startswith("Tile r1c2") and "its position is known to" in reason
    assert record["tiles"]["r1c2"]["sigma_px"] > 5 * record["tiles"]["r2c1"]["sigma_px"]


@pytest.mark.slow
def test_an_overlap_of_seven_pixels_is_refused_and_nothing_published(tmp_path):
    """3 % of 220 px: no window fits in, and no tile is put anywhere by it."""
    make_few(tmp_path, overlap=7)
    steps = steps_of(tmp_path)
    assert steps["photo", "register"].state == "refused"
    assert "no two tiles overlap" in steps["photo", "register"].line
    assert not (tmp_path / "database/objects/one/one_photo.tif").exists()


REPEATED = """[campaign]
reference = { camera = "photo" }
[cameras.photo]
kind = "image"
files = "photo/{target}.tif"
[cameras.xray]
kind = "image"
files = "xray/{target}_r{row}c{column}.tif"
"""


@pytest.mark.slow
def test_a_repeated_ornament_places_no_tile_one_period_off(tmp_path):
    """A frieze of one figure every 30 px; its tile has most detail, and is tried before the others say where it lies."""
    rng, picture = np.random.default_rng(4), painting(4)
    figure = np.clip(0.5 + 1.4 * (painting(9)[100:130, 100:130] - 0.5), 0.05, 0.95)
    picture[40:280, 300:510] = np.tile(figure, (8, 7))
    frames = {"photo": laid(30, 30, 0.0)}
    write(tmp_path / "photo/one.tif", cut(picture, frames["photo"], (WIDTH, HEIGHT), rng))
    for i, j in product(range(2), range(3)):
        at = 40 + 140 * j + rng.uniform(-2, 2), 40 + 160 * i + rng.uniform(-2, 2)
        frames[f"xray#r{i + 1}c{j + 1}"] = laid(*at, rng.uniform(-0.4, 0.4), 1.02)
    for name, frame in frames.items():
        if "#" in name:
            tile = cut(picture, frame, (160, 175), rng)
            write(tmp_path / f"xray/one_{name[5:]}.tif", tile)
    (tmp_path / "campaign.toml").write_text(REPEATED)
    steps_of(tmp_path)
    tiles = record_of(tmp_path, "xray")["tiles"]
    points = np.array([[40.0, 40], [80, 90], [120, 130]])
    for tile, one in tiles.items():
        if "bands" in one:
            target = frames[f"xray#{tile}"]
            source = f"xray#{tile}"
            found = map_points(tmp_path / "database", "one", points, source=source, target="photo")
            off = np.linalg.norm(found - frames["photo"].inverse(target(points)), axis=1)
            assert off.max() < 0.5, (tile, off)
    lost = {t: one["verdict"]["reasons"] for t, one in tiles.items() if "bands" not in one}
    assert set(lost) <= {"r1c3"}, lost  # it shows nothing but the frieze

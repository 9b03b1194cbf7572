"""Where the tests find real captures, the campaign made by other hands, and one small world that is built already."""

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# No test times anything: on a busy machine an example may take as long as it takes. The same examples every time, so
# that a change is judged by what it changed; `make exhaustive` draws others, and more.
settings.register_profile(
    "levkas", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile(
    "explore", settings.get_profile("levkas"), derandomize=False, max_examples=1000
)
settings.load_profile("levkas")

sys.path.insert(0, str(Path(__file__).parent))
from world import World, build_world  # noqa: E402

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real captures, `$LEVKAS_REAL_DATA` or `shared/data` beside the checkout."""
    folder = Path(os.environ.get("LEVKAS_REAL_DATA", SHARED / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real captures: {folder} is not there; set LEVKAS_REAL_DATA")
    return folder


@pytest.fixture(scope="session")
def two_paintings() -> Path:
    """Folder of the simulated campaign from another generator, `shared/campaigns`."""
    folder = Path(os.environ.get("LEVKAS_CAMPAIGNS", SHARED / "campaigns")) / "two-paintings"
    if not folder.is_dir():
        pytest.skip(f"no foreign campaign: {folder} is not there; set LEVKAS_CAMPAIGNS")
    return folder


@pytest.fixture(scope="session")
def chromium_path() -> str:
    """Program of a Chromium or Chrome, `$LEVKAS_CHROMIUM` or one on the path."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
    requested = os.environ.get("LEVKAS_CHROMIUM")
    found = requested or next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.skip(
            "no Chromium: install one (`apt-get install chromium`, `brew install --cask chromium`) "
            "or set LEVKAS_CHROMIUM"
        )
    return found


@pytest.fixture(scope="session")
def world(tmp_path_factory) -> World:
    """One campaign of five cameras, built once for all processes of a run; to be read, and copied where it is to change."""
    shared = tmp_path_factory.getbasetemp()
    return build_world(shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared)


FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]


@pytest.fixture(scope="session")
def chromium(chromium_path):
    """Headless Chromium, one for all tests of a process: Playwright does not start twice in one."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium_path, args=FLAGS, headless=True)
        yield browser
        browser.close()


CORRECTABLE = """
[campaign]
title = TITLE
date = 2019-08-29
reference = { camera = "photo", band = "G" }
[cameras.photo]
kind = "image"
files = "photo/{target}.png"
[cameras.xray]
kind = "image"
files = "xray/{target}.png"
[registration]
stop = 6.0
[targets]
objects = NAMES
"""
TURN = np.deg2rad(6.0)
SLOPE = 1.3 * np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
MATRIX = np.column_stack([SLOPE, [40.0, 12.0]])
PHOTO_SIZE, XRAY_SIZE, WRONG_PX = (420, 340), (620, 520), 4.0


class Correctable:
    """A campaign as it stands after a build, without the cost of one; the truth is known.

    Each object has a photograph and an inverted radiograph through `truth`, 240 matches with 0.1 px
    of noise, and one planted wrong pair, 4 reference px off, which `stop` = 6 px does not remove.
    """

    photo_size, xray_size, wrong_px = PHOTO_SIZE, XRAY_SIZE, WRONG_PX

    def truth(self, points):
        """Reference px → px of the radiograph."""
        return np.asarray(points, float) @ MATRIX[:, :2].T + MATRIX[:, 2]

    def make(self, folder, names=("icon",), *, title="Plates", matched=True, texts=None):
        """Write the campaign and its database; `texts` replaces reasons of the verdict."""
        import cv2

        from levkas.geometry.transforms import Affine

        (folder / "campaign.toml").parent.mkdir(parents=True, exist_ok=True)
        text = CORRECTABLE.replace("TITLE", json.dumps(title, ensure_ascii=False))
        (folder / "campaign.toml").write_text(
            text.replace("NAMES", json.dumps(list(names), ensure_ascii=False))
        )
        for seed, name in enumerate(names):
            photo = painted(seed)
            warped = cv2.warpAffine(255 - photo, MATRIX, XRAY_SIZE, flags=cv2.INTER_CUBIC)
            for camera, picture in (("photo", np.dstack([photo] * 3)), ("xray", warped)):
                (folder / camera).mkdir(exist_ok=True)
                data = cv2.imencode(".png", picture)[1]
                (folder / camera / f"{name}.png").write_bytes(data.tobytes())
                self.write_layer(folder, name, camera, picture)
            grid = {"size": PHOTO_SIZE, "transform": Affine.identity().to_dict(), "px_per_mm": 2.0}
            reference = {"camera": "photo", "band": "G", "size": list(PHOTO_SIZE)}
            for camera in ("photo", "xray"):
                reason = (texts or {}).get("reason", "240 of 241 matches are kept.")
                band = "grey" if camera == "xray" else "G"
                map_ = Affine(MATRIX) if camera == "xray" else Affine.identity()
                record = {
                    "object": name, "camera": camera, "setup": "", "method": "mirhashemi2019",
                    "reference": reference, "grid": grid,
                    "target": {"camera": camera, "setup": "", "band": band},
                    "verdict": {"decision": "accept" if matched else "refuse",
                                "reasons": [reason], "next_step": "", "numbers": {}},
                    "model": {"kind": "levkas", "sensors": []}, "errors": {}, "trace": {},
                    "bands": {band: {"transform": map_.to_dict()}} if matched else {},
                }  # fmt: skip
                place = folder / "database" / "objects" / name / "registration"
                place.mkdir(parents=True, exist_ok=True)
                (place / f"{camera}.json").write_text(json.dumps(record))
                if matched:
                    (place / f"{camera}.matches.csv").write_text(self._matches(camera, seed))
        return folder

    def _matches(self, camera, seed):
        rng = np.random.default_rng(seed)
        count = 241 if camera == "xray" else 0
        reference = rng.uniform(15, np.array(PHOTO_SIZE) - 15, (count, 2))
        target = self.truth(reference + rng.normal(0, 0.1, (count, 2)))
        if count:
            reference[0] = (210.0, 170.0)
            target[0] = self.truth(reference[0] + [WRONG_PX * 0.8, WRONG_PX * 0.6])
        head = "reference_x,reference_y,target_x,target_y,residual,leave_one_out,weight,state,reason,round"
        rows = [f"{a:.6f},{b:.6f},{c:.6f},{d:.6f},0.1,0.1,1,kept,," for (a, b), (c, d)
                in zip(reference, target, strict=True)]  # fmt: skip
        return "\n".join([head, *rows]) + "\n"

    def write_layer(self, folder, name, camera, picture):
        """Write the native pixels of a layer."""
        from levkas.core.cube import Band, Cube
        from levkas.database.layers import Layer, write_tiffs

        values = np.atleast_3d(picture).astype(np.float32)
        labels = ["R", "G", "B"] if camera == "photo" else ["grey"]
        bands = tuple(Band(label) for label in labels)
        flags = np.zeros(values.shape, np.uint8)
        flags[20:60, 30:80] = 2
        place = folder / "database" / "objects" / name / "native"
        place.mkdir(parents=True, exist_ok=True)
        write_tiffs(place / f"{name}_{camera}", Layer(name, camera, ""),
                    Cube(values, flags, None, bands, "counts"))  # fmt: skip


def painted(seed):
    """Patches, strokes and grain, (340, 420) uint8: structure wherever one looks."""
    import cv2

    rng = np.random.default_rng(seed)
    width, height = PHOTO_SIZE
    image = np.full((height, width), 110, np.float32)
    for _ in range(220):
        middle = rng.integers(0, PHOTO_SIZE).tolist()
        cv2.circle(image, middle, int(rng.integers(3, 30)), float(rng.integers(30, 225)), -1)
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    grain = cv2.GaussianBlur(rng.standard_normal(image.shape).astype(np.float32), (0, 0), 1.6)
    return np.clip(image + 60 * grain, 5, 250).astype(np.uint8)


@pytest.fixture(scope="session")
def correctable() -> Correctable:
    """Return what makes campaigns for the workbench."""
    return Correctable()


TURNED = """
[campaign]
title = "Two plates"
creator = "Doe, Jane"
licence = "CC-BY-4.0"
date = 2019-08-29
reference = { camera = "photo", band = "G" }
[cameras.photo]
kind = "image"
files = "photo/{target}.png"
[cameras.xray]
kind = "image"
files = "xray/{target}.png"
[targets]
objects = NAMES
"""


class TurnedPlates:
    """Photographs and inverted radiographs on their side; that of "bad" is grainy and out of focus.

    Of "bad" no key points agree: by itself it is refused (`E_MATCHES`).
    """

    angle, scale = np.deg2rad(40.0), 1.9

    def __init__(self):
        cosine, sine = np.cos(self.angle), np.sin(self.angle)
        self.matrix = self.scale * np.array([[cosine, -sine], [sine, cosine]])
        self.shift = np.array([299.5, 259.5]) - self.matrix @ [160, 140]

    def truth(self, points):
        """Where points of the photograph lie in the radiograph."""
        return (2 * np.asarray(points) + 0.5 - self.shift) @ np.linalg.inv(self.matrix).T

    def make(self, folder, names=("bad", "good")):
        """Write the campaign."""
        import cv2

        rng = np.random.default_rng(5)
        for seed, (name, blur, grain) in enumerate((("bad", 8.0, 40.0), ("good", 0.8, 1.0))):
            if name not in names:
                continue
            big = strokes(seed)
            soft = cv2.GaussianBlur(big, (0, 0), blur)
            how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
            place = np.column_stack([self.matrix, self.shift])
            observed = 255 - cv2.warpAffine(soft, place, (320, 280), flags=how, borderValue=5)
            observed = observed + grain * rng.standard_normal(observed.shape)
            photo = cv2.resize(big, (300, 260), interpolation=cv2.INTER_AREA)
            for part, picture in (("photo", np.dstack([photo] * 3)), ("xray", observed)):
                (folder / part).mkdir(parents=True, exist_ok=True)
                data = cv2.imencode(".png", picture.clip(0, 255).astype(np.uint8))[1]
                (folder / part / f"{name}.png").write_bytes(data.tobytes())
        (folder / "campaign.toml").write_text(TURNED.replace("NAMES", json.dumps(list(names))))
        return folder


def strokes(seed):
    """Patches, strokes and grain at twice the photograph's size, (520, 600) float32."""
    import cv2

    rng = np.random.default_rng(seed)
    image = np.full((520, 600), 90, np.float32)
    for _ in range(160):
        x, y, r = rng.integers(0, 600), rng.integers(0, 520), int(rng.integers(6, 60))
        cv2.circle(image, (int(x), int(y)), r, float(rng.integers(20, 235)), -1, cv2.LINE_AA)
    for _ in range(160):
        points = rng.integers(0, [600, 520], (3, 2)).astype(np.int32)
        cv2.polylines(image, [points], False, float(rng.integers(20, 235)), 3, cv2.LINE_AA)
    grain = cv2.GaussianBlur(rng.standard_normal(image.shape).astype(np.float32), (0, 0), 2)
    return np.clip(image + 60 * grain, 5, 250)


@pytest.fixture(scope="session")
def turned_plates() -> TurnedPlates:
    """Return what makes a campaign of which one camera cannot be registered by itself."""
    return TurnedPlates()


@pytest.fixture(scope="session")
def doubtful(tmp_path_factory):
    """A built campaign: of an infrared picture 3, 5 px aside the right part shows something else, and an X-ray shows nothing."""
    import cv2

    from levkas.building import build

    folder = tmp_path_factory.mktemp("doubtful")
    seen, else_, none = (
        cv2.resize(strokes(seed), (300, 260), interpolation=cv2.INTER_AREA) for seed in (1, 2, 3)
    )
    seen, moved = seen[10:, 10:], np.roll(seen, (3, 5), (0, 1))[10:, 10:]
    moved[:, 190:] = else_[10:, 200:]
    pictures = {"photo": np.dstack([seen] * 3), "infrared": moved, "xray": none[10:, 10:]}
    text = TURNED.replace("NAMES", '["one"]')
    for part, picture in pictures.items():
        (folder / part).mkdir()
        data = cv2.imencode(".png", picture.astype(np.uint8))[1]
        (folder / part / "one.png").write_bytes(data.tobytes())
    infrared = (
        text.partition("[cameras.xray]")[2].partition("[targets]")[0].replace("xray", "infrared")
    )
    (folder / "campaign.toml").write_text(f"{text}[cameras.infrared]{infrared}")
    list(build(folder))
    return folder

"""What holds for every test and doctest."""

import importlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from itertools import cycle
from pathlib import Path

from levkas.core.instructions import hold_instructions

hold_instructions()  # before NumPy is loaded: what tests build in this process is what commands build

# One thread of linear algebra in this process, as a build has: threads of small problems wait for one another with the processor
# busy, half of the time of a registration. The libraries ask once, when they are loaded; what tests start chooses for itself.
THREADS = "OPENBLAS_NUM_THREADS"
chosen = os.environ.get(THREADS)
os.environ[THREADS] = chosen or "1"
for library in ("numpy", "scipy.linalg"):  # each has an OpenBLAS of its own
    importlib.import_module(library)
if chosen is None:
    del os.environ[THREADS]

import numpy as np  # noqa: E402
import pytest  # noqa: E402


@pytest.fixture(autouse=True)
def numbers_as_numpy_prints_them() -> Iterator[None]:
    """colour-science turns NumPy's printing back by ten years for the whole process."""
    with np.printoptions(legacy=False):
        yield


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk() -> Iterator[None]:
    """Spare the syncs of this process: no test outlasts a loss of power, and those about one note the calls.

    A build syncs a hundred times, a tenth of its time. Commands in processes of their own do so as ever.
    """
    from levkas.core import files

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        patch.setattr(files, "_sync_file_system", lambda descriptor: None)
        yield


DURATIONS = Path(__file__).parent / "tests" / "durations.json"
"""Seconds of each test file, as `tests/record_durations.py` wrote them."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is `exhaustive`, and slow tests of other turns; put the longest files first.

    What starts last ends last, and leaves the other processes idle. LEVKAS_SLOW_TURN = 2/5 takes the slow tests of the third of five
    parts of the files, which take about as long as each other.
    """
    seconds = json.loads(DURATIONS.read_text(encoding="utf-8"))
    left = set()
    if not os.environ.get("LEVKAS_EVERY_CASE"):
        left = {item for item in items if item.get_closest_marker("exhaustive")}
    if turn := os.environ.get("LEVKAS_SLOW_TURN"):
        number, turns = map(int, turn.split("/"))
        slow = [item for item in items if item.get_closest_marker("slow")]
        files = sorted({item.location[0] for item in slow}, key=lambda f: (-seconds.get(f, 0), f))
        turn_of = dict(zip(files, cycle([*range(turns), *reversed(range(turns))])))
        left |= {item for item in slow if turn_of[item.location[0]] != number % turns}
    config.hook.pytest_deselected(items=[*left])
    items[:] = [item for item in items if item not in left]
    items.sort(key=lambda item: -seconds.get(item.location[0], 0))


KEYS = """
[campaign]
title = "Plates"
date = 2019-08-29
reference = { camera = "photo", band = "G" }
[cameras.photo]
kind = "image"
files = "photo/{target}.png"
[cameras.infrared]
kind = "image"
files = "infrared/{target}.png"
[targets]
objects = OBJECTS
"""


@pytest.fixture(scope="session")
def make_plates() -> Callable[..., Path]:
    """Return a function that writes a campaign of some objects, each with two small pictures."""

    def make(folder: Path, names: Sequence[str] = ("one", "two")) -> Path:
        import cv2

        for number, name in enumerate(sorted(names)):
            rng = np.random.default_rng(number)
            big = np.full((400, 480), 90, np.float32)
            for _ in range(150):
                centre = rng.integers(0, [480, 400]).tolist()
                radius, grey = int(rng.integers(4, 40)), float(rng.integers(20, 235))
                cv2.circle(big, centre, radius, grey, -1, cv2.LINE_AA)
            grain = cv2.GaussianBlur(rng.standard_normal(big.shape).astype(np.float32), (0, 0), 2)
            big = np.clip(big + 60 * grain, 5, 250)
            photo = cv2.resize(big, (240, 200), interpolation=cv2.INTER_AREA)
            matrix = np.array([[1.9, 0.04, 6.0], [-0.04, 1.9, 9.0]])
            how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
            infrared = 255 - cv2.warpAffine(big, matrix, (250, 210), flags=how, borderValue=5)
            for part, picture in (("photo", np.dstack([photo] * 3)), ("infrared", infrared)):
                (folder / part).mkdir(parents=True, exist_ok=True)
                data = cv2.imencode(".png", picture.clip(0, 255).astype(np.uint8))[1]
                (folder / part / f"{name}.png").write_bytes(data.tobytes())
        (folder / "campaign.toml").write_text(KEYS.replace("OBJECTS", json.dumps(list(names))))
        return folder

    return make


@pytest.fixture(scope="session")
def plates(make_plates: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a campaign of the object ``one``, a photograph and an infrared picture, built."""
    from levkas.building import build

    folder: Path = make_plates(tmp_path_factory.mktemp("plates"), ["one"])
    assert [step.line for step in build(folder) if step.state in ("refused", "failed")] == []
    return folder


@pytest.fixture(autouse=True)
def names_of_doctests(request: pytest.FixtureRequest) -> None:
    """Give a doctest that mentions it the folder `plates`, and an empty folder `folder`."""
    test = getattr(request.node, "dtest", None)
    if test is not None:
        source = "".join(example.source for example in test.examples)
        for name, fixture in (("plates", "plates"), ("folder", "tmp_path")):
            if name in source:
                test.globs.setdefault(name, request.getfixturevalue(fixture))

"""What an edit costs on screen: refit, answer and redraw with 10,000 pairs; tiles of 100 Mpx.

    python benchmarks/workbench.py [--page]

Writes a table in Markdown to standard output. With `--page` the time from a key to the finished drawing is
measured too, in a headless Chromium (needs playwright and the built pages).
"""

from __future__ import annotations

import shutil
import statistics
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from results import record, taken_option

from levkas.campaign.edits import Edits, FrameEdits, write_edits
from levkas.core.cube import Band
from levkas.geometry.transforms import Affine
from levkas.registration.record import Matches
from levkas.workbench.answer import describe, to_bytes
from levkas.workbench.correlation import find_partner
from levkas.workbench.frame import RegistrationView, SensorView
from levkas.workbench.library import Library
from levkas.workbench.pictures import ShownPicture, encode, warped_tile
from levkas.workbench.session import CorrectionSession, RecordedPairs

SIZE = (1392, 1040)
REPEATS = 15
ON_SCREEN = 25


def plant(n: int, wrong: int) -> RecordedPairs:
    """Return `n` pairs of a bent map, `wrong` of them 2 to 90 px off."""
    rng = np.random.default_rng(1)
    target = rng.uniform(0, SIZE, (n, 2))
    u, v = ((target - np.array(SIZE) / 2) / 700).T
    reference = target + np.stack([3 * u**3 + 2 * v**2 + 5, 4 * v * u**2 - 3], 1)
    reference += rng.normal(0, 0.2, (n, 2))
    angle, reach = rng.uniform(0, 2 * np.pi, wrong), rng.uniform(2, 90, wrong)
    reference[:wrong] += np.stack([np.cos(angle), np.sin(angle)], 1) * reach[:, None]
    return RecordedPairs(Matches.of(reference, target), SIZE, SIZE)


def timed(work, repeats: int = REPEATS) -> float:
    """Return the median of seconds."""
    taken = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return statistics.median(taken)


def edits(n: int, wrong: int, folder: Path) -> list[tuple[str, float]]:
    """Deletion with refit, the answer's text, and saving."""
    path = folder / "edits.toml"

    def save(edits: FrameEdits) -> None:
        write_edits(path, Edits({("icon", "nir"): edits}))

    session = CorrectionSession(plant(n, wrong))
    session_record = describe(session)
    rows = iter(range(wrong, n))

    def answer() -> bytes:
        return to_bytes(describe(session, session_record["places"]))

    def delete() -> None:
        session.apply("delete", session_record["pairs"][next(rows)])
        session.view  # noqa: B018

    delete()
    return [
        (f"{n:,} pairs, {wrong:,} removed: a deletion with refit", timed(delete)),
        ("  the answer", timed(answer)),
        ("  saved (with fsync)", timed(lambda: save(session.edits))),
    ]


def tiles() -> list[tuple[str, float]]:
    """Tiles of a picture of 100 million pixels."""
    rng = np.random.default_rng(0)
    block = rng.integers(0, 255, (1000, 1000)).astype(np.uint8)
    picture = ShownPicture(np.tile(block, (10, 10)))
    began = time.perf_counter()
    assert picture.levels
    reduced = time.perf_counter() - began
    turn = Affine(np.array([[0.98, -0.05, 300.0], [0.05, 0.98, 10.0]]))
    size = (10_000, 10_000)
    places = iter(np.random.default_rng(2).integers(2, 30, (1000, 2)).tolist())
    return [
        ("100 Mpx: all reduced copies, once", reduced),
        ("  a tile, encoded", timed(lambda: encode(picture.tile(0, *next(places))))),
        (
            "  a tile brought on to the reference, encoded",
            timed(lambda: encode(*warped_tile(picture, turn, size, 0, *next(places)))),
        ),
        (
            "  the partner of a place",
            timed(lambda: find_partner(picture, picture, turn, np.array([5000.0, 5000.0]))),
        ),
    ]


class Planted(Library):
    """One camera whose pairs were planted."""

    def __init__(self, found: RecordedPairs, path: Path) -> None:
        super().__init__(path)
        view, main = (
            SensorView(
                SimpleNamespace(object="icon", layer=name, camera=name, setup="", sensors=(one,)),
                one,
            )
            for name, one in (
                (name, SimpleNamespace(name="", bands=(Band(label, float(label[:3])),)))
                for name, label in (("nir", "900 nm"), ("vis", "550 nm"))
            )
        )
        picture = ShownPicture(
            np.random.default_rng(0).integers(0, 255, SIZE[::-1]).astype(np.uint8)
        )
        record = {"verdict": {"decision": "accept", "reasons": [], "next_step": ""}, "bands": {}}
        remember = partial(self.remember, "icon", "nir")
        session = CorrectionSession(found, FrameEdits(), self._keep, remember=remember)
        self._planted = RegistrationView(
            view, main, record, {}, session, "900 nm", "550 nm",
            lambda capture, band: picture, lambda capture, band: picture.pixels,
        )  # fmt: skip
        self.campaign = SimpleNamespace(campaign=SimpleNamespace(title="Planted pairs"), root=path)

    def list(self) -> list[dict]:
        words = ("setup", "sensor", "bands", "reason", "corrections")
        row = dict.fromkeys(words, "") | {"id": "planted", "reference": False, "object": "icon"}
        return [
            {**row, "camera": "nir", "title": "icon", "decision": "accept", "verdict": "accepted"}
        ]

    def open(self, key: str) -> RegistrationView:
        return self._planted

    def registered_with(self, frame: RegistrationView) -> None:
        return None

    def _keep(self, before: FrameEdits, after: FrameEdits) -> FrameEdits:
        write_edits(self.path / "edits.toml", Edits({("icon", "nir"): after}))
        return after


DELETE = """async (row) => {
  const { store } = levkasWorkbench;
  store.choose({ row });
  await new Promise((r) => setTimeout(r, 150));
  const began = performance.now();
  dispatchEvent(new KeyboardEvent("keydown", { key: "Delete" }));
  await store.settled();
  await new Promise((r) => requestAnimationFrame(() => setTimeout(r)));
  return performance.now() - began;
}"""


OVERLAY = """async (row) => {
  const { store, stage } = levkasWorkbench;
  const frame = () => new Promise((r) => requestAnimationFrame(() => setTimeout(r)));
  store.choose({ row });
  await new Promise((r) => setTimeout(r, 150));
  const began = performance.now();
  dispatchEvent(new KeyboardEvent("keydown", { key: "Delete" }));
  await store.settled();
  do await frame(); while (!stage.settled);
  return performance.now() - began;
}"""


def page(wrong: int) -> list[tuple[str, float]]:
    """Key to finished drawing in a browser: median and worst, side by side and in an overlay."""
    import uvicorn
    from playwright.sync_api import sync_playwright

    from levkas.workbench.server.app import _listen, make_app

    token = "t" * 43
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        listening = _listen(0)
        port = listening.getsockname()[1]
        app = make_app(Planted(plant(10_000, wrong), Path(folder)), port=port, token=token)
        server = uvicorn.Server(uvicorn.Config(app, log_level="error", ws="none", lifespan="off"))
        threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True).start()
        chromium = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        view = chromium.new_page(viewport={"width": 1440, "height": 900})
        view.goto(f"http://127.0.0.1:{port}/#{token}")
        view.wait_for_function("() => window.levkasWorkbench && levkasWorkbench.stage.settled")
        rows = iter(range(wrong, 10_000, 7))

        def taken(script: str) -> list[float]:
            return [view.evaluate(script, next(rows)) / 1000 for _ in range(ON_SCREEN + 3)][3:]

        beside = taken(DELETE)
        view.keyboard.press("c")
        view.wait_for_function("() => levkasWorkbench.stage.settled")
        over = taken(OVERLAY)
        chromium.close()
        server.should_exit = True
    what = f"10,000 pairs, {wrong:,} removed: from the key to the finished drawing"
    return [
        (f"{what}, median of {ON_SCREEN}", statistics.median(beside)),
        ("  the worst of them", max(beside)),
        ("  the same under the curtain, median", statistics.median(over)),
        ("  the worst of them", max(over)),
    ]


def main() -> None:
    """Print the table."""
    results = taken_option()
    with tempfile.TemporaryDirectory() as folder:
        rows = edits(10_000, 0, Path(folder)) + edits(10_000, 5_000, Path(folder))
    rows += tiles()
    if "--page" in sys.argv:
        figures = {}
        for wrong, name in ((0, "none removed before"), (5_000, "5,000 removed before")):
            measured = page(wrong)
            rows += measured
            figures[name, "side by side"] = 1000 * measured[0][1]
            figures[name, "under the curtain"] = 1000 * measured[2][1]
        record(results, "workbench", figures)
    print("| what | ms |\n|---|---|")
    for name, seconds in rows:
        print(f"| {name} | {1000 * seconds:.0f} |")


if __name__ == "__main__":
    main()

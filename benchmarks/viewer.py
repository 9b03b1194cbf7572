"""Speed of the viewer in a real Chromium: many objects, or one large one with --one.

    python benchmarks/viewer.py [--objects 100] [--width 640]
    python benchmarks/viewer.py --one [--results FILE]

Writes a database of simulated panels, its viewer, and opens `index.html` from a static server on this
machine and from file://, each several times in a fresh profile. Told are the first contentful paint,
the largest, the load event, and the bytes that came over the wire till everything in view was drawn.

With --one it is a single object of 1.6 Mpx, 16 narrow bands with sigma and flags beside a camera of 3 bands. Told are the
same for its page, the time from a move of the pointer to the spectrum of that pixel, where its tile was loaded before and
where it was not, from a region of a million pixels to its numbers, and from the key press to a saved picture (ms).
"""

import argparse
import functools
import json
import shutil
import tempfile
import threading
import time
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright
from results import add_option, record

from levkas.core.cube import Band, Cube, Flag
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.publish.viewer import About, write_viewer

FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
PAINTS = """() => new Promise(done => {
  let largest = 0;
  new PerformanceObserver(list => { for (const e of list.getEntries()) largest = e.startTime; })
    .observe({type: 'largest-contentful-paint', buffered: true});
  setTimeout(() => {
    const first = performance.getEntriesByName('first-contentful-paint')[0]?.startTime;
    const load = performance.getEntriesByType('navigation')[0].loadEventEnd;
    done({first, largest, load});
  }, 1200);
})"""


def write_database(root: Path, count: int, width: int) -> None:
    """Objects of one camera, with detail like a painting's so that thumbnails weigh what they do."""
    rng, entries = np.random.default_rng(1), []
    height = width * 4 // 3
    y, x = np.mgrid[0:height, 0:width] / width
    for number in range(count):
        base = [np.sin(f * x + p) * np.cos(g * y + p) for f, g, p in rng.uniform(3, 60, (3, 3))]
        values = 0.4 + 0.25 * np.stack(base, -1) + rng.normal(0, 0.06, (height, width, 3))
        bands = tuple(Band(name) for name in "RGB")
        cube = Cube(
            values.astype(np.float32), np.zeros(values.shape, np.uint8), None, bands, "reflectance"
        )
        layer = Layer(f"panel{number:03d}", "d80")
        entries.append(write_layer(root, layer, cube)[0])
    write_catalogue(root, entries)


def write_one(root: Path) -> None:
    """One object as large as a small painting at 5 px per mm, with two cameras."""
    rng, entries = np.random.default_rng(1), []
    height, width = ONE
    y, x = np.mgrid[0:height, 0:width] / 200
    for camera, names in CAMERAS.items():
        base = 0.4 + 0.3 * np.sin(9 * x + 3 * y) * np.cos(7 * y)
        values = base[..., None] * np.linspace(0.6, 1.3, len(names))
        values += rng.normal(0, 0.01, values.shape)
        flags = (rng.random(values.shape) < 0.01).astype(np.uint8) * np.uint8(Flag.SATURATED)
        sigma = np.full(values.shape, 0.01, np.float32)
        bands = tuple(Band(n, float(n.split()[0]), 10.0) if "nm" in n else Band(n) for n in names)
        cube = Cube(values.astype(np.float32), flags, sigma, bands, "reflectance")
        entries.append(write_layer(root, Layer("panel", camera), cube)[0])
    write_catalogue(root, entries)


ONE = (1250, 1280)
CAMERAS = {"lctf": [f"{w} nm" for w in range(410, 711, 20)], "rgb": ["R", "G", "B"]}
HOVER = """async (places) => {
  const {stage} = levkasViewer, box = stage.left.viewer.container, times = [];
  const place = document.querySelector('.place');
  for (const [x, y] of places) {
    const [clientX, clientY] = stage.left.pageOf(x, y), from = performance.now();
    box.dispatchEvent(new PointerEvent('pointermove', {clientX, clientY, bubbles: true}));
    while (place.dataset.pixel !== `${x},${y}`) await new Promise(r => setTimeout(r, 1));
    times.push(performance.now() - from);
  }
  return times.sort((a, b) => a - b);
}"""
REGION = """async () => {
  const from = performance.now(), {state} = levkasViewer;
  state.regions.value = [{name: 'All', kind: 'rectangle', points: [[100, 100], [1099, 1099]]}];
  const words = () => document.querySelector('#regions .region-words')?.dataset.n;
  while (!words()) await new Promise(r => setTimeout(r, 1));
  return performance.now() - from;
}"""
BAND = """async () => {
  const list = document.querySelector('[aria-label="Band of the histogram"]');
  const words = () => document.querySelector('#regions .region-words').dataset.mean;
  const before = words(), from = performance.now();
  list.value = '3';
  list.dispatchEvent(new Event('change'));
  while (words() === before) await new Promise(r => setTimeout(r, 1));
  return performance.now() - from;
}"""


def measure_one(chromium, address: str) -> dict:
    """Time of what a reader does on the page of one object, ms."""
    context = chromium.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.goto(address)
    measured = page.evaluate(PAINTS)
    page.wait_for_function("() => window.levkasViewer?.stage.settled")
    rng = np.random.default_rng(2)
    wide = rng.integers([5, 5], [ONE[1] - 5, ONE[0] - 5], (60, 2)).tolist()
    near = (rng.integers(0, 40, (60, 2)) + 600).tolist()
    for name, places in (("hover, new tile", wide), ("hover, same tile", near)):
        times = page.evaluate(HOVER, places)
        measured[name] = {"median": times[len(times) // 2], "of 20 the slowest": times[-3]}
    measured["region of a million pixels"] = page.evaluate(REGION)
    measured["another band of it"] = page.evaluate(BAND)
    began = time.perf_counter()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save picture").click()
    download.value.path()
    measured["saved picture"] = 1000 * (time.perf_counter() - began)
    context.close()
    return measured


class Counting(SimpleHTTPRequestHandler):
    """Serves quietly and counts what it sends."""

    sent = 0

    def copyfile(self, source, outputfile):
        data = source.read()
        Counting.sent += len(data)
        outputfile.write(data)

    def log_message(self, *args):
        pass


def measure(chromium, address: str, runs: int) -> dict:
    runs_measured = []
    for _ in range(runs):
        Counting.sent = 0
        context = chromium.new_context(viewport={"width": 1280, "height": 900})
        page = context.new_page()
        page.goto(address)
        runs_measured.append({**page.evaluate(PAINTS), "bytes": Counting.sent})
        context.close()
    return {key: sorted(one[key] for one in runs_measured)[runs // 2] for key in runs_measured[0]}


def figures(found: dict, options: argparse.Namespace) -> dict[tuple[str, str], float]:
    """Return times by row and column of the results file, ms."""
    made = {}
    for how, column in (("file", "file://"), ("http", "server")):
        one = found[how]
        if not options.one:
            made[f"{options.objects} objects, first paint", column] = one["first"]
            continue
        made["first paint", column] = one["first"]
        made["region of 1 Mpx", column] = one["region of a million pixels"]
        for name, median, slow in (
            ("hover, new tile", "spectrum, new tile, median", "third slowest of 60"),
            (
                "hover, same tile",
                "spectrum, loaded tile, median",
                "loaded tile, third slowest of 60",
            ),
        ):
            made[median, column] = one[name]["median"]
            made[slow, column] = one[name]["of 20 the slowest"]
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--one", action="store_true", help="one large object")
    parser.add_argument("--objects", type=int, default=100)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--keep", type=Path, help="folder for the database; used again if there")
    add_option(parser)
    options = parser.parse_args()
    if shutil.which("chromium") is None:
        print("no Chromium on this machine: not measured")
        return
    root = options.keep or Path(tempfile.mkdtemp())
    if not (root / "index.html").is_file():
        if options.one:
            write_one(root)
        else:
            write_database(root, options.objects, options.width)
        began = time.perf_counter()

        def write(name, data):
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

        list(write_viewer(root, write, About(title="A hundred panels", licence="CC0-1.0")))
        print(
            f"viewer of {1 if options.one else options.objects} objects written in {time.perf_counter() - began:.1f} s"
        )
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Counting, directory=str(root)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as driver:
        path = shutil.which("chromium")
        chromium = driver.chromium.launch(executable_path=path, args=FLAGS, headless=True)
        name = "viewer/objects/panel/index.html" if options.one else "index.html"
        addresses = {
            "http": f"http://127.0.0.1:{server.server_port}/{name}",
            "file": (root / name).resolve().as_uri(),
        }
        found = {how: measure(chromium, url, options.runs) for how, url in addresses.items()}
        for how, url in addresses.items() if options.one else ():
            found[how] |= measure_one(chromium, url)
        chromium.close()
    server.shutdown()
    print(json.dumps(found, indent=1))
    record(options.results, "viewer", figures(found, options))
    if not options.one:
        sent = {f"viewer of {options.objects} objects, sent": found["http"]["bytes"] / 1e6}
        record(options.results, "speed", sent)
    if options.keep is None:
        shutil.rmtree(root)


if __name__ == "__main__":
    main()

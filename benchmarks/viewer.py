"""First paint of the viewer's contact sheet with many objects, in a real Chromium.

    python benchmarks/viewer.py [--objects 100] [--width 640]

Writes a database of simulated panels, its viewer, and opens `index.html` from a static server on this
machine and from file://, each several times in a fresh profile. Told are the first contentful paint,
the largest, the load event, and the bytes that came over the wire till everything in view was drawn.
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

from levkas.core.cube import Band, Cube
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
        entries.append(write_layer(root, layer, cube, zarr=False)[0])
    write_catalogue(root, entries)


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
    seen = []
    for _ in range(runs):
        Counting.sent = 0
        context = chromium.new_context(viewport={"width": 1280, "height": 900})
        page = context.new_page()
        page.goto(address)
        seen.append({**page.evaluate(PAINTS), "bytes": Counting.sent})
        context.close()
    return {key: sorted(one[key] for one in seen)[runs // 2] for key in seen[0]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, default=100)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--keep", type=Path, help="folder for the database; used again if there")
    options = parser.parse_args()
    if shutil.which("chromium") is None:
        print("no Chromium on this machine: not measured")
        return
    root = options.keep or Path(tempfile.mkdtemp())
    if not (root / "index.html").is_file():
        write_database(root, options.objects, options.width)
        began = time.perf_counter()

        def write(name, data):
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

        list(write_viewer(root, write, About(title="A hundred panels", licence="CC0-1.0")))
        print(f"viewer of {options.objects} objects written in {time.perf_counter() - began:.1f} s")
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Counting, directory=str(root)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as driver:
        path = shutil.which("chromium")
        chromium = driver.chromium.launch(executable_path=path, args=FLAGS, headless=True)
        addresses = {
            "http": f"http://127.0.0.1:{server.server_port}/index.html",
            "file": (root / "index.html").resolve().as_uri(),
        }
        found = {how: measure(chromium, url, options.runs) for how, url in addresses.items()}
        chromium.close()
    server.shutdown()
    print(json.dumps(found, indent=1))
    if options.keep is None:
        shutil.rmtree(root)


if __name__ == "__main__":
    main()

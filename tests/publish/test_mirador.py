"""Mirador opens a manifest and shows every layer of its Choice; skipped where it is not installed.

``npm install mirador``, then ``LEVKAS_MIRADOR=node_modules/mirador/dist/mirador.min.js pytest …``
"""

import functools
import http.server
import os
import shutil
import threading
from pathlib import Path

import pytest

PAGE = """<!doctype html><meta charset="utf-8"><body><div id="m"></div>
<script src="mirador.min.js"></script>
<script>
window.viewer = Mirador.viewer({id: "m", windows: [{manifestId: location.origin + "/iiif/icon1/manifest.json"}],
 window: {defaultSideBarPanel: "layers", sideBarOpen: true, panels: {layers: true}}});
</script>"""


@pytest.fixture
def mirador() -> Path:
    script = Path(os.environ.get("LEVKAS_MIRADOR", "node_modules/mirador/dist/mirador.min.js"))
    if not script.is_file():
        pytest.skip("Mirador is not installed: npm install mirador, and say where: LEVKAS_MIRADOR")
    return script


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


def test_mirador_shows_the_manifest_and_its_layers(database, publish, mirador, chromium, tmp_path):
    made = functools.partial(Quiet, directory=str(tmp_path / "site"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), made) as server:
        base = f"http://127.0.0.1:{server.server_port}/"
        folder = publish(database, url=base)
        (tmp_path / "site").mkdir()
        shutil.copytree(folder / "iiif", tmp_path / "site/iiif")
        shutil.copy(mirador, tmp_path / "site/mirador.min.js")
        (tmp_path / "site/index.html").write_text(PAGE)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page, requested = chromium.new_page(viewport={"width": 1200, "height": 800}), []
        page.on("response", lambda answer: requested.append((answer.url, answer.status)))
        page.goto(base + "index.html")
        page.wait_for_selector("text=The icon1", timeout=180_000)
        page.wait_for_selector("text=vis: 11 bands", timeout=180_000)
        page.wait_for_selector("text=rgb: 3 bands", timeout=180_000)
        page.wait_for_function("document.querySelector('canvas') !== null", timeout=180_000)
        page.wait_for_timeout(2000)
        if picture := os.environ.get("LEVKAS_MIRADOR_PICTURE"):
            page.screenshot(path=picture)
        server.shutdown()
    ours = [(url, status) for url, status in requested if "/iiif/" in url]
    assert any(url.endswith("vis/info.json") for url, _ in ours)
    assert any(url.endswith("default.jpg") for url, _ in ours)
    assert all(status in (200, 304) for _, status in ours), ours

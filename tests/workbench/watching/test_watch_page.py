"""The page of a watched session: what it tells a browser, what it refuses, and that a second one shows the same."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile
from starlette.testclient import TestClient

from levkas.pages.screen import ScreenMissing, read_built
from levkas.workbench.server.guard import cookie_of
from levkas.workbench.watching import WatchedSession
from levkas.workbench.watching.cache import MeasureCache
from levkas.workbench.watching.page import SessionBoard, WatchServer, make_watch_app

PORT, TOKEN = 8765, "t" * 43
CAMPAIGN = """
[campaign]
reference = { camera = "grey", band = "550 nm" }
[cameras.grey]
kind = "bands"
files = "{target}_{wavelength}nm.tif"
wavelengths = [550, 650]
bits = 12
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.98 }
objects = ["icon"]
"""


def put(home, name: str, level: float) -> None:
    codes = np.random.default_rng(len(name)).normal(level, 8, (100, 140)).clip(0, 4095)
    tifffile.imwrite(home / name, codes.astype(np.uint16), metadata=None)


@pytest.fixture
def board(tmp_path):
    home = tmp_path / "icons"
    home.mkdir()
    (home / "campaign.toml").write_text(CAMPAIGN)
    put(home, "dark_550nm.tif", 64)
    put(home, "white_550nm.tif", 6000)
    session = WatchedSession(home, MeasureCache(tmp_path / "cache"))
    board = SessionBoard(session)
    board.publish(session.settle())
    return board


@pytest.fixture
def client(board):
    app = make_watch_app(board, port=PORT, token=TOKEN)
    return TestClient(app, base_url=f"http://127.0.0.1:{PORT}")


def test_nothing_of_the_session_is_shown_without_the_token(client):
    assert client.get("/").status_code == 200
    for path in ("/api/session", "/api/picture?name=white_550nm.tif"):
        assert client.get(path).status_code == 401


def test_whoever_has_the_token_sees_frames_pictures_and_what_is_new(client, board):
    client.cookies.set(cookie_of(PORT), TOKEN)
    news = client.get("/api/session").json()
    record = news["session"]
    assert record["folder"] == "icons" and record["counts"]["stop"] == 1
    picture = client.get("/api/picture", params={"name": "white_550nm.tif"})
    assert picture.content.startswith(b"\x89PNG")
    known = f"/api/session?known={news['version']}"
    assert "session" not in client.get(known).json()
    home = board.session.watch.root
    (home / "white_550nm.tif").unlink()
    put(home, "white_650nm.tif", 3000)
    board.publish(board.session.settle())
    changed = client.get(known).json()["session"]
    assert [f["name"] for f in changed["frames"]] == ["dark_550nm.tif", "white_650nm.tif"]
    for name in ("../../etc/passwd", "campaign.toml", ""):
        assert client.get("/api/picture", params={"name": name}).status_code == 404


@pytest.mark.slow
def test_the_page_shows_a_clipped_white(board, chromium):
    try:
        read_built("watch.js")
    except ScreenMissing:
        pytest.skip("the pages were not built")
    server = WatchServer(board)
    try:
        page = chromium.new_page(viewport={"width": 1440, "height": 900})
        told = []
        page.on("console", lambda message: told.append(message.text))
        page.goto(server.address.url)
        page.get_by_text("full scale").first.wait_for()
        verdict = page.locator(".card.stop .verdict")
        assert verdict.inner_text().lower() == "stop"
        assert page.evaluate("document.documentElement.scrollWidth") <= 1440
        assert told == []
        page.close()
    finally:
        server.stop()

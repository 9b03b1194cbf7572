"""A real headless Chromium for the pages, in which no request to another host passes unnoticed."""

import functools
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

import pytest

from .database import write_database
from .serving import Served, opened


class Browsing:
    """Pages of one test: `open` gives a playwright page; `foreign` and `errors` gather meanwhile."""

    def __init__(self, chromium):
        self.chromium, self.contexts = chromium, []
        self.opened, self.requests, self.errors, self.dialogs = set(), [], [], []

    def open(self, address, *, width=1280, height=900, scheme="light", **options):
        """Open an address in a fresh profile and wait until it is loaded."""
        page = self.page(width=width, height=height, scheme=scheme, **options)
        self.opened.add(_host(address))
        page.goto(address)
        return page

    def page(self, *, width=1280, height=900, scheme="light", **options):
        """Make a blank page in a fresh profile."""
        context = self.chromium.new_context(
            viewport={"width": width, "height": height}, color_scheme=scheme, **options
        )
        context.set_default_timeout(120_000)
        self.contexts.append(context)
        page = context.new_page()
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("websocket", lambda socket: self.requests.append(socket.url))
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", self._hear)
        page.on("dialog", self._dismiss)
        return page

    def allow(self, address):
        """Let requests go to the host of this address."""
        self.opened.add(_host(address))

    @property
    def foreign(self):
        """Requests that left the hosts that were opened."""
        return [url for url in self.requests if _host(url) not in {*self.opened, ""}]

    def _hear(self, message):
        if message.type == "error":
            self.errors.append(message.text)

    def _dismiss(self, dialog):
        self.dialogs.append(dialog.message)
        dialog.dismiss()


def _host(address):
    parts = urlsplit(address)
    return "" if parts.scheme in ("file", "data", "blob", "about") else parts.netloc


@pytest.fixture
def browser(chromium, serve):
    """Browse; afterwards no request may have gone elsewhere, and no page may have failed.

    Pages are closed before what serves them: a picture cut off on its way is no failure of a page.
    """
    browsing = Browsing(chromium)
    yield browsing
    for context in browsing.contexts:
        context.close()
    assert browsing.foreign == []
    assert browsing.errors == []
    assert browsing.dialogs == []


@pytest.fixture
def serve():
    """Serve folders as `python -m http.server` does: `serve(folder)` gives their address."""
    servers = []

    def start(folder):
        handler = functools.partial(_Quiet, directory=str(folder))
        server = _Patient(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


class _Patient(ThreadingHTTPServer):
    request_queue_size = 128


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


@pytest.fixture(scope="module")
def inspected():
    """Serve campaigns; needs the built page."""
    from levkas.pages.screen import ScreenMissing, read_built

    try:
        read_built("workbench.js")
    except ScreenMissing:
        pytest.skip("the front-end is not built: run `make frontend`")
    served = []

    def start(folder):
        served.append(Served(folder))
        return served[-1]

    yield start
    for one in served:
        one.stop()


@pytest.fixture(scope="module")
def served(correctable, inspected, tmp_path_factory):
    """The server of a campaign with one planted wrong pair."""
    return inspected(correctable.make(tmp_path_factory.mktemp("bench") / "campaign"))


@pytest.fixture
def bench(served, browser):
    """The workbench without any correction, opened: (page, server)."""
    served.edits_path.unlink(missing_ok=True)
    served.library.turns.clear()
    served.library._frames.clear()
    return opened(browser, served), served


@pytest.fixture(scope="session")
def add_viewer():
    """Return a function that writes the viewer into a database's folder."""
    from levkas.pages.screen import ScreenMissing, read_built
    from levkas.publish.viewer import About, write_viewer

    try:
        read_built("viewer.js")
    except ScreenMissing:
        pytest.skip("the pages are not built: run `make frontend`")

    def add(folder, **about):
        def write(name, data):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

        facts = {
            "title": "A small database",
            "creator": "Ada Painter",
            "licence": "CC BY 4.0",
            "licence_url": "https://creativecommons.org/licenses/by/4.0/",
            "citation": "Painter, Ada (2019). A small database.",
        }
        list(write_viewer(folder, write, About(**{**facts, **about})))
        return folder

    return add


@pytest.fixture(scope="session")
def viewer(add_viewer, tmp_path_factory):
    """Folder of a database of two objects with its viewer; the second has a refused camera."""
    folder = tmp_path_factory.mktemp("viewer") / "database"
    return add_viewer(write_database(folder, {"icon1": "First icon", "icon2": "Second icon"}))


@pytest.fixture(scope="session")
def publish_with():
    """Return a function that publishes a database under a title and a creator, and gives the folder."""
    import json

    from levkas.database.manifest import write_manifest
    from levkas.publish import run

    def publish(database, title, creator, **options):
        facts = {"title": title, "creator": creator, "date": "2019-06-30", "licence": "CC-BY-4.0"}
        lines = [f"{key} = {json.dumps(value)}\n" for key, value in facts.items()]
        (database / "database.toml").write_text("".join(lines), encoding="utf-8")
        write_manifest(database)
        return run.summarise(run.publish(database, iiif=False, **options)).output

    return publish


@pytest.fixture
def address(viewer, serve):
    """Return a function giving the address of a page of the small viewer, by file or http."""

    def find(how, name="viewer/objects/icon1/index.html", fragment=""):
        base = viewer.as_uri() if how == "file" else serve(viewer)
        return f"{base}/{name}{fragment}"

    return find

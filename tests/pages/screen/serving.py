"""The workbench's server in a thread of the tests, and its page."""

import threading
import time

from levkas.campaign.edits import FrameEdits, read_edits
from levkas.workbench.library import Library

TOKEN = "t" * 43
READY = "() => window.levkasWorkbench && levkasWorkbench.stage.settled"


class Served:
    """A server in a thread: its address, and the folder of its campaign."""

    def __init__(self, folder):
        import uvicorn

        from levkas.workbench.server.app import listen_on, make_app

        self.folder, self.library = folder, Library(folder)
        self.listening = listen_on(0)
        self.port = self.listening.getsockname()[1]
        app = make_app(self.library, port=self.port, token=TOKEN)
        config = uvicorn.Config(app, log_level="error", ws="none", lifespan="off")
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(
            target=self.server.run, kwargs={"sockets": [self.listening]}, daemon=True
        )
        self.thread.start()
        while not self.server.started:
            time.sleep(0.01)

    @property
    def edits_path(self):
        return self.folder / "edits.toml"

    @property
    def address(self):
        return f"http://127.0.0.1:{self.port}/#{TOKEN}"

    @property
    def edits(self):
        edits = read_edits(self.edits_path)
        return edits.frames.get(("icon", "xray"), FrameEdits())

    def stop(self):
        self.server.should_exit = True
        self.thread.join(60)
        self.listening.close()


def pause(page, milliseconds):
    """Wait by the clock of the page: its own timers that end sooner have ended, and are drawn, on a busy machine too."""
    page.evaluate(
        """(wait) => new Promise((done) => setTimeout(
          () => requestAnimationFrame(() => requestAnimationFrame(done)), wait))""",
        milliseconds,
    )


def opened(browser, server, **options):
    page = browser.open(server.address, **options)
    page.wait_for_function(READY)
    return page


def told(page, what):
    return page.evaluate(
        f"async () => {{ await levkasWorkbench.store.settled(); return levkasWorkbench.store.{what}; }}"
    )
